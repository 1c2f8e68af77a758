"""Superpixels that are mirror images of one another, in grids of any shape."""

import numpy as np
import pytest

from plenocli.forward.propagation.symmetry import superpixel_orbits


@pytest.mark.parametrize("rows, columns", [(1, 1), (3, 3), (9, 1), (1, 9), (5, 3)])
@pytest.mark.parametrize("symmetry", [(1, 1, 1), (1, 1, 0), (0, 0, 1), (1, 0, 1), (0, 0, 0)])
def test_every_superpixel_follows_from_one_that_is_there(rows, columns, symmetry):
    """By the turn that is said, applied to the offset itself; each follows from one alone."""
    offsets = np.argwhere(np.ones((rows, columns))) - (rows // 2, columns // 2)
    seen = []
    for first, members in superpixel_orbits(offsets, symmetry):
        for number, (turned, *flips) in members:
            place = offsets[first][::-1] if turned else offsets[first]
            assert (np.where(flips, -place, place) == offsets[number]).all()
            seen.append(number)
    assert sorted(seen) == list(range(rows * columns))
