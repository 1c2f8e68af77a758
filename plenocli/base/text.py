"""Values as JSON knows them, shapes and values as a person writes them."""

import json
import math
from collections.abc import Iterable
from typing import Any


def json_value(value: Any) -> Any:
    """A copy without what JSON lacks: arrays become lists, paths text, and numbers that are not
    finite None (an infinite PSNR: no error at all).
    """
    if isinstance(value, dict):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_value(item) for item in value]
    if hasattr(value, "tolist"):
        return json_value(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, (str, int, bool, type(None))) else str(value)


def by(shape: Iterable[int]) -> str:
    """ "4 x 6" of (4, 6)."""
    return " x ".join(str(int(n)) for n in shape)


def shown(value: object) -> str:
    """A value of a TOML file as it may stand there."""
    return json.dumps(value, ensure_ascii=False, default=str)
