"""Values as JSON knows them."""

import math


def plain(value):
    """A copy without what JSON lacks: arrays become lists, paths text, and numbers that are not finite None (an infinite PSNR: no error at all)."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, (str, int, bool, type(None))) else str(value)
