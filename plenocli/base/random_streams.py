"""Random streams: one a stage and seed, so that two stages with the same seed never
draw the same numbers.
"""

import numpy as np


def stream(seed, stage, index=0):
    """A numpy Generator for draw `index` of `stage`; the same arguments give the same
    numbers on every machine.
    """
    return np.random.default_rng(np.random.SeedSequence([seed, index, *stage.encode()]))
