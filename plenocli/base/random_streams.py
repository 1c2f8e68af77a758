"""Random streams: one a stage and seed, so that two stages with the same seed never
draw the same numbers.
"""

from __future__ import annotations

import numpy as np


def stream(seed: int, stage: str, index: int = 0) -> np.random.Generator:
    """The random numbers of a stage, the same on every machine.

    seed: of the run.
    stage: its name.
    index: of the draw, where a stage has several.
    """
    return np.random.default_rng(np.random.SeedSequence([seed, index, *stage.encode()]))


def skip(draw: np.random.Generator, count: int) -> None:
    """Leave out the next `count` numbers that `draw.random` would give."""
    bits = draw.bit_generator
    assert isinstance(bits, np.random.PCG64)
    bits.advance(count)
