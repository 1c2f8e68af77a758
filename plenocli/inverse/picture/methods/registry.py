"""The methods of reconstruct by name."""

from __future__ import annotations

from plenocli.inverse.picture.methods.method import Method
from plenocli.inverse.picture.methods.per_lenslet import (
    BLOCK_MEAN,
    DICTIONARY,
    LMMSE,
    NNLS,
    TIKHONOV,
    TSVD,
)
from plenocli.inverse.picture.methods.trial import AUTO
from plenocli.inverse.picture.methods.weighted import WEIGHTED
from plenocli.inverse.picture.methods.whole_picture import PNP, TV

ALL: tuple[Method, ...] = (
    AUTO,
    BLOCK_MEAN,
    TIKHONOV,
    TSVD,
    NNLS,
    LMMSE,
    WEIGHTED,
    DICTIONARY,
    TV,
    PNP,
)
"""In the order in which --method offers them."""
METHODS = {method.name: method for method in ALL}


def takers(option: str) -> tuple[str, ...]:
    """Names of the methods to which an option means something."""
    return tuple(name for name, method in METHODS.items() if option in method.options)
