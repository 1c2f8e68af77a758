"""Planes of a volume as descriptions name them: a list, or a range with a step."""

import math
import re
from typing import Any

from plenocli.base.units import format_length, parse_length

MOST_PLANES = 1000
"""Planes of a volume."""
_RANGE = re.compile(r"\s*(\S+ ?\S+)\s+to\s+(\S+ ?\S+)\s+step\s+(\S+ ?\S+)\s*")


def planes_of(value: Any) -> Any:
    """The planes of "-12 um to 12 um step 1 um" as a list; what is no text stays.

    Raises ValueError for text that is no such range.
    """
    if not isinstance(value, str):
        return value
    found = _RANGE.fullmatch(value)
    if found is None:
        raise ValueError(
            f'{value!r} is no range of planes; write for example "-12 um to 12 um step 1 um", or a '
            'list such as ["-5 um", "0 um", "5 um"]'
        )
    start, end, step = (parse_length(part) for part in found.groups())
    if not step > 0 or end < start:
        raise ValueError(f"{value!r} must rise in steps above 0")
    count = math.floor((end - start) / step * (1 + 1e-12) + 1e-9) + 1
    if count > MOST_PLANES:
        raise ValueError(f"{value!r} has {count} planes; at most {MOST_PLANES} are possible")
    # a plane in focus is at 0, not a rounding error away
    depths = (round(start / step + i, 9) * step for i in range(count))
    return [format_length(depth) for depth in depths]
