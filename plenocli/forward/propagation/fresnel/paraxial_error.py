"""How far paraxial columns are from exact ones, told from where paraxial optics sends rays amiss:
on the axis, where columns that were computed by both tell more, and behind a lenslet that sees the
pupil at an angle.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry

FEW_CELLS, MOST_BLUR = 5.0, 6.0
"""Diffraction cells up to which each lenslet that a blurred point lights adds its own error: the
light of few cells goes far aside, and joins.
"""
OTHER_SHAPES = 2.0
"""What the law says too little of lenslets that leave gaps, or have few cells."""
OBLIQUE = 1.7
"""Error of the worst column over the root mean square by which rays are moved in pupil images,
times the root of the image's width over that of its rim (docs/model.md, "Exact propagation").
"""
RIM, ACROSS = 16, 5
"""Rays from the pupil's rim, and through a lenslet along either axis."""
GRAZING = 1e-3
"""Squared cosine below which a ray is taken to go no flatter."""


def paraxial_error(
    geometry: Geometry, parabolic: bool, tried: tuple[float, float] | None = None
) -> float:
    """Estimated relative L2 error of the worst column of the paraxial model against the exact one,
    at the geometry's own place on the array.

    parabolic: profile of the lenslets, else hyperbolic;
    tried: least and most that it can be on the axis, as columns that were computed tell; None for
        lenslets such as the law was found on, square ones that touch.

    docs/model.md, "Exact propagation".
    """
    few = min(1.0, FEW_CELLS / geometry.diffraction_cells)
    lit = 1 + few * min(MOST_BLUR, geometry.blur / geometry.D2)
    on_axis = lit * _on_axis(geometry, parabolic)
    if tried is not None:
        least, most = tried
        on_axis = min(max(OTHER_SHAPES * on_axis, least), most)
    return min(1.0, math.hypot(on_axis, lit * oblique_error(geometry, parabolic)))


def oblique_error(geometry: Geometry, parabolic: bool) -> float:
    """Estimated relative L2 difference of the worst column of a lenslet off the axis from that of
    the lenslet on it; 0 on the axis.

    parabolic: profile of the lenslets, else hyperbolic.

    Returns a number, 1 at the most.
    docs/model.md, "Exact propagation".
    """
    if geometry.chief == (0.0, 0.0):
        return 0.0
    there, here = (_missed(g, parabolic) for g in (geometry, replace(geometry, chief=(0.0, 0.0))))
    pupil, _ = _half_angles(geometry)
    moved = math.sqrt(max(0.0, there - here)) / (geometry.z3 * pupil)
    # of a point out of focus each lenslet sees a part of the pupil, and what is moved is a larger
    # share of that
    part = math.sqrt(1 + geometry.blur / geometry.D2)
    rim = max(2.0, _rim_root(geometry, pupil))
    gap = 1 - geometry.lenslet_width / geometry.D2
    # the pupil is seen narrower, by the cube of the angle's cosine, and so are the rings that are
    # all the light of points between lenslets
    narrower = 1 - (1 + (math.hypot(*geometry.chief) / geometry.z2) ** 2) ** -1.5
    rings = narrower * math.pi * geometry.diffraction_cells * gap / math.sqrt(2)
    return min(1.0, math.hypot(OBLIQUE * moved * rim * part * (1 + 3 * gap), rings))


def _on_axis(geometry: Geometry, parabolic: bool) -> float:
    """The error on the axis: 0.9 to 2.5 times what was found on 24 cameras (f/1.5 to f/64)."""
    pupil, lenslet = _half_angles(geometry)
    moved = 1.5 * lenslet * (pupil + lenslet) + (lenslet**3 / (2 * pupil) if parabolic else 0.0)
    dim = 1 + 5 * (1 - geometry.lenslet_width / geometry.D2)
    return 0.5 * moved * _rim_root(geometry, pupil) * dim


def _half_angles(geometry: Geometry) -> tuple[float, float]:
    """Tangents at the rims of pupil and lenslet: where a lenslet has few cells, diffraction spreads
    light further than these.
    """
    spread = geometry.wavelength / (2 * geometry.D2)
    return (
        math.hypot(geometry.D1 / (2 * geometry.z2), spread),
        math.hypot(geometry.D2 / (2 * geometry.f2), spread),
    )


def _rim_root(geometry: Geometry, pupil: float) -> float:
    """Root of the pupil image's width over that of its rim, a pixel or a diffraction cell."""
    across = 2 * geometry.z3 * pupil / geometry.pixel_pitch
    return math.sqrt(max(1.0, min(across, geometry.diffraction_cells)))


def _missed(geometry: Geometry, parabolic: bool) -> float:
    """Mean square (m^2) of where rays land less where paraxial optics has them land."""
    g, turn = geometry, 2 * np.pi * np.arange(RIM) / RIM
    rim = g.D1 / 2 * np.stack([np.sin(turn), np.cos(turn)], axis=-1)
    side = g.lenslet_width * np.linspace(-0.5, 0.5, ACROSS)
    x = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 1, 2)
    come = np.asarray(g.chief) + x - rim
    sine = come / np.sqrt(g.z2**2 + _square(come))
    sine = sine - x / (g.f2 if parabolic else np.sqrt(g.f2**2 + _square(x)))
    exact = sine / np.sqrt(np.maximum(1 - _square(sine), GRAZING))
    return float(g.z3**2 * _square(exact - (come / g.z2 - x / g.f2)).mean())


def _square(vectors: np.ndarray) -> np.ndarray:
    return (vectors**2).sum(axis=-1, keepdims=True)
