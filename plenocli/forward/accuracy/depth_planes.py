"""How many planes stand for a scene's depth: system matrices at a few distances, between which
polynomials in the defocus interpolate (docs/model.md, "The dial").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import ConfigError, NumericsError
from plenocli.forward.camera.pupil import aperture_picture

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.plan import PifPlan

SHARE = 0.5
"""Share of the accuracy that interpolation between planes may use up."""
MOST_PLANES = 1000
ERROR_FACTOR = (0.8, 0.28, 0.33, 0.38)
"""Largest error of the worst column between n = 1 to 4 planes that stand s apart (one plane: in a
range of s), over s^n, s in radians of the standard deviation of the phase over the pupil.
"""
_PUPIL_CELLS = 200


@dataclass(frozen=True, kw_only=True)
class DepthPlanes:
    """The planes that stand for a scene's depth.

    distances: m from the main lens, nearest first;
    depth: nearest and farthest distance (m) of the scene;
    error: of the worst column of an interpolated matrix against that of its own plane, 0 where the
        scene lies in the planes.
    """

    distances: tuple[float, ...]
    depth: tuple[float, float]
    error: float
    kind = "planes"

    def as_json(self) -> dict[str, list[float]]:
        """Where they are."""
        return {"distances": list(self.distances)}

    def line(self) -> str:
        """One sentence for people."""
        near, far = (f"{d:.4g}" for d in self.depth)
        count = len(self.distances)
        if count > 1:
            between = f"interpolation between them in 1/distance is off by {self.error:.1g}"
            return f"depth {near} to {far} m: {count} planes, the fewest; {between}"
        if self.error:
            return f"depth {near} to {far} m: one plane stands for it, to {self.error:.1g}"
        return f"depth {near} m: one plane"

    def told(self, plan: PifPlan) -> PifPlan:
        """The plan of one of the planes, with what interpolation adds to its error."""
        split = plan.split | ({"depth": self.error} if self.error else {})
        return replace(
            plan,
            split=split,
            estimated=math.hypot(*split.values()),
            reasons=(*plan.reasons, self.line()),
        )


def left_for_planes(accuracy: float) -> float:
    """What interpolation between planes leaves of an accuracy to each plane's own matrix."""
    return accuracy * math.sqrt(1 - SHARE**2)


def depth_planes(
    camera: Camera, wavelength: float, depth: tuple[float, float], accuracy: float
) -> DepthPlanes:
    """The fewest planes between which matrices may be interpolated.

    wavelength: m, the shortest;
    depth: nearest and farthest distance (m);
    accuracy: of the worst column, of which interpolation uses SHARE at most.

    Raises NumericsError where that takes more than MOST_PLANES.
    """
    near, far = depth
    span = 1 / near - 1 / far
    if span <= 0:
        return DepthPlanes(distances=(near,), depth=depth, error=0.0)
    phase = span * math.pi / wavelength * _spread(camera)
    allowed = SHARE * accuracy
    if _error(phase, 1) <= allowed:
        return DepthPlanes(
            distances=(2 / (1 / near + 1 / far),), depth=depth, error=_error(phase, 1)
        )
    # the error falls with every plane but for a step up from three to four
    least = 2 + max(0, math.ceil(phase * (ERROR_FACTOR[-1] / allowed) ** 0.25) - 1)
    count = next((n for n in (2, 3) if _error(phase, n) <= allowed), max(4, least))
    if count > MOST_PLANES:
        raise NumericsError(
            f"depth from {near:.4g} to {far:.4g} m takes {count} planes, more than {MOST_PLANES}, "
            f"for an error of {allowed:.2g} between them",
            "depth",
            "ask for a coarser accuracy or give the scene less depth",
        )
    inverse = np.linspace(1 / near, 1 / far, count)
    return DepthPlanes(
        distances=(near, *(1 / inverse[1:-1]).tolist(), far),
        depth=depth,
        error=_error(phase, count),
    )


def plane_camera(camera: Camera, distance: float) -> Camera:
    """The camera with its object at a distance (m).

    Raises ConfigError where such a camera cannot be.
    """
    try:
        return camera.replace(**{"object.distance": distance})
    except ConfigError as error:
        raise error.at(f"depth {distance:.4g} m") from None


def plane_weights(distances: Sequence[float], distance: float) -> tuple[np.ndarray, np.ndarray]:
    """What to mix for the matrix of a distance between planes.

    distances: of the planes, m, nearest first, evenly spaced in their inverse;
    distance: m.

    Returns (numbers of at most four planes, their weights): Lagrange's polynomial in the inverse
    distance through the nearest ones.
    """
    inverse = 1 / np.asarray(distances)
    count = min(4, len(inverse))
    place = int(np.searchsorted(-inverse, -1 / distance))
    first = min(max(place - count // 2, 0), len(inverse) - count)
    used = np.arange(first, first + count)
    weights = np.ones(count)
    for i, j in np.argwhere(~np.eye(count, dtype=bool)):
        weights[i] *= (1 / distance - inverse[used[j]]) / (inverse[used[i]] - inverse[used[j]])
    return used, weights


def _error(phase: float, planes: int) -> float:
    """Error between planes.

    phase: standard deviation over the pupil (rad) of what the phase changes by over the range;
    planes: how many, evenly spaced.
    """
    order = min(planes, len(ERROR_FACTOR))
    return ERROR_FACTOR[order - 1] * (phase / max(planes - 1, 1)) ** order


def _spread(camera: Camera) -> float:
    """Standard deviation (m^2) of the squared radius over the light in the pupil."""
    lens = camera.main_lens
    half = lens.aperture_diameter / 2
    across = ((np.arange(_PUPIL_CELLS) + 0.5) / _PUPIL_CELLS * 2 - 1) * half
    light = aperture_picture(lens, across[:, None], across[None, :])
    squares = across[:, None] ** 2 + across[None, :] ** 2
    mean = float((light * squares).sum() / light.sum())
    return math.sqrt(float((light * (squares - mean) ** 2).sum() / light.sum()))
