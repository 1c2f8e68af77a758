"""What columns lose because light of lenslets far from the object's is left out: by a law where
lenslets cover their cells; elsewhere the first rings are tried.

Source: docs/model.md, "The dial".
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.propagation.fresnel.trial_columns import (
    AFFORDED,
    FEW,
    THINNED,
    VALUES,
    Hashed,
    Trial,
)
from plenocli.forward.propagation.sampling import (
    blur_ring,
    coherent_window,
    is_symmetric,
    neighbour_fringes,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera

CLOSE_AREA = 0.6
"""Share of their cells that lenslets cover from which a law tells what rings leave out."""
CLOSE, STRAIGHT = (1.5, 10.0, 3.3), 4.0
"""What that law says too little: at least, over the cells more, and at most; how much more behind
pupils with straight edges, whose light reaches further along the axes.
"""
BEYOND, ONE_CHANGE = 2.3, 2.0
"""What others leave out over what the next rings change, carried further; how much more where only
one was tried.
"""
SEEN_ASIDE = 1.6
"""What is left out of superpixels beside the own one, too."""
UNTRIED_RING = 12.0
"""What others' first ring changes over the law where that could not be tried, of round pupils."""
FOLLOWED, NEXT = 8, 4
"""Rings of lenslets whose light is followed outwards, and of how many changes the largest counts:
one may be small by chance.
"""
KEPT_CHANGES = 256
"""Changes by rings that are kept for the next plan of the same camera."""


def window_error(
    camera: Camera, geometry: Geometry, superpixels: tuple[int, int], ring: int
) -> float:
    """Estimated error because lenslets beyond the coherent window are left out: by a law where
    these cover their cells; of others what the next rings change, carried further.

    superpixels: (rows, columns) kept;
    ring: of coherent neighbours.

    Returns the relative L2 error of a column; 0 where ring is 0 by choice.
    """
    if ring == 0:
        return 0.0
    straight = 1.0 if camera.main_lens.aperture_shape in ("circle", "annulus") else STRAIGHT
    if geometry.opening_area >= CLOSE_AREA * geometry.D2**2 * geometry.row_spacing:
        least, more, most = CLOSE
        close = min(most, least + more / geometry.diffraction_cells)
        return min(1.0, close * straight * _law_of_windows(geometry, superpixels, ring))
    nearest = coherent_window(geometry, (1, 1), 1) or 1
    changes = _changes(Hashed(camera), replace(geometry, chief=(0.0, 0.0)), nearest)
    if not changes:
        untried = UNTRIED_RING * straight / (BEYOND * ONE_CHANGE)
        changes = (untried * _law_of_windows(geometry, (1, 1), 1),)
    window = coherent_window(geometry, superpixels, ring) or 0
    first = max(0, min(window - nearest, len(changes) - NEXT))
    kept = max(c / _fall(geometry, nearest + n) for n, c in enumerate(changes) if n >= first)
    beyond = BEYOND if len(changes) > 1 else BEYOND * ONE_CHANGE
    aside = 1.0 if max(superpixels) == 1 else SEEN_ASIDE
    return min(1.0, beyond * aside * kept * _fall(geometry, window))


def _fall(geometry: Geometry, window: int) -> float:
    """How the light of lenslets beyond a window falls off at least, up to a factor."""
    return window**-2 / math.sqrt(_averaging(geometry, window))


def _averaging(geometry: Geometry, window: int) -> float:
    """What grows with the cycles (w + 1) c a pixel of the fringes in which far lenslets interfere
    with the own one, and which pixels average.
    """
    return 1 + 3.5 * neighbour_fringes(geometry) * (window + 1)


@lru_cache(maxsize=KEPT_CHANGES)
def _changes(hashed: Hashed, geometry: Geometry, window: int) -> tuple[float, ...]:
    """Relative L2 changes of the worst of a few columns of an own superpixel by one ring of
    lenslets after another beyond `window`: of up to FOLLOWED rings, as many as can be tried in
    time, () for none. Twice what was found where few columns were.
    """
    for least, rings, lines in product((FEW, 1), range(FOLLOWED, 0, -1), (None, *THINNED)):
        trials = [
            Trial(geometry, (1, 1), window + n, is_symmetric(hashed.camera), 0, lines)
            for n in range(rings + 1)
        ]
        points = trials[-1].points[:FEW]
        count = min(len(points), int(AFFORDED / sum(t.cost for t in trials)))
        if count >= min(least, len(points)) and trials[-1].values <= VALUES:
            columns = np.array(
                [t.columns(hashed.camera, points[:count], False).pixels for t in trials]
            )
            changes = np.linalg.norm(np.diff(columns, axis=0), axis=2)
            found = (changes / np.linalg.norm(columns[-1], axis=1)).max(axis=1)
            return tuple(float(c) for c in found * (1 if count == len(points) else 2))
    return ()


def _sharp_window(geometry: Geometry, superpixels: tuple[int, int], ring: int) -> int:
    """Lenslets on either side as a sharp point has them: light spread over several lenslets has no
    sharp peak at a border, whose interference reaches furthest.
    """
    window, blur = coherent_window(geometry, superpixels, ring) or 0, blur_ring(geometry)
    return window - blur + (blur > 0)


def _law_of_windows(geometry: Geometry, superpixels: tuple[int, int], ring: int) -> float:
    """window_error of square lenslets that touch, within a factor of 2 of brute force (N from 5.6
    to 24 diffraction cells, c from 0.1 to 7.5, w from 1 to 6; worst point, docs/model.md).
    """
    window = _sharp_window(geometry, superpixels, ring)
    scale = 0.075 if max(superpixels) == 1 else 0.12
    return min(
        1.0,
        scale
        * (window - 0.29) ** -2
        * geometry.diffraction_cells**-1.09
        * _averaging(geometry, window) ** -1.34,
    )
