"""Figures of merit by the names under which DEFINITIONS explain them and score documents list
them.
"""

from dataclasses import fields, is_dataclass
from typing import Any

from plenocli.base.text import json_value

Figure = float | int | str | None | list[float | None]
"""One figure as JSON knows it: None where it is infinite or does not apply, a list by band."""


def figures(score: Any) -> dict[str, Figure]:
    """Name -> figure of a score, in the order of its fields.

    score: a frozen dataclass whose fields are named as in DEFINITIONS; a field that holds another
        such dataclass stands for the fields of that; None is left out, NaN does not apply.
    """
    found: dict[str, Figure] = {}
    for field in fields(score):
        value = getattr(score, field.name)
        if is_dataclass(value):
            found |= figures(value)
        elif value is not None:
            found[field.name] = json_value(value)
    return found
