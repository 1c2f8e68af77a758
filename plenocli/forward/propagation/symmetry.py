"""Superpixels that the symmetry of a system matrix maps onto each other."""

from collections.abc import Sequence

import numpy as np

Turn = tuple[bool, bool, bool]
"""How one superpixel follows from another: (turned, flipped rows, flipped columns)."""


def superpixel_orbits(
    offsets: np.ndarray, symmetry: Sequence[bool]
) -> list[tuple[int, list[tuple[int, Turn]]]]:
    """Superpixels that are mirror images of one another, by their numbers.

    offsets: (superpixel, 2) rows and columns;
    symmetry: (flip rows, flip columns, transpose) of A.

    Returns [(first, [(superpixel, the Turn that leads there from the first)])].
    """
    place = {tuple(o): i for i, o in enumerate(np.asarray(offsets).tolist())}
    found: dict[int, list[tuple[int, Turn]]] = {}
    turns = symmetry[2] and symmetry[0] == symmetry[1]
    for (r, c), index in place.items():
        flips = bool(r < 0 and symmetry[0]), bool(c < 0 and symmetry[1])
        a, b = (-n if flip else n for n, flip in zip((r, c), flips))
        turned = bool(turns and a > b and (b, a) in place)  # of 9x1 superpixels none has a twin
        found.setdefault(place[(b, a) if turned else (a, b)], []).append((index, (turned, *flips)))
    return list(found.items())


def turned_planes(planes: np.ndarray, how: Turn) -> np.ndarray:
    """The superpixel that a Turn leads to: a view.

    planes: (pixel row, pixel column, point row, point column) of the first of its orbit;
    how: the Turn.
    """
    turned, rows, columns = how
    planes = planes.transpose(1, 0, 3, 2) if turned else planes
    planes = planes[::-1, :, ::-1] if rows else planes
    return planes[:, ::-1, :, ::-1] if columns else planes


def fill_below_diagonal(planes: np.ndarray, share: np.ndarray, count: int) -> None:
    """Fill in points below the diagonal from those above, rows and columns exchanged.

    planes: (pixel row, pixel column, point row, point column);
    share: (point row, point column), filled alike;
    count: of the first count x count points.
    """
    turned = planes.transpose(1, 0, 3, 2)
    for j in range(count):
        planes[:, :, j + 1 : count, j] = turned[:, :, j + 1 : count, j]
        share[j + 1 : count, j] = share[j, j + 1 : count]
