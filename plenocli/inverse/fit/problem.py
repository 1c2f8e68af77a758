"""What a fit starts from: captures in units of photographs, the cameras that may have made them,
and how likely each is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError
from plenocli.forward.camera.geometry import geometry
from plenocli.inverse.fit.evidence import Evidence, Lenslets
from plenocli.inverse.fit.lenslet import LensletFamily
from plenocli.inverse.fit.optics import CameraFamily, Parameter, all_parameters, require_fittable
from plenocli.inverse.fit.prior import BRIGHTNESS, photograph_prior

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

HIDDEN = 0.03
"""Patterns of photographs that all together stay below so much of the noise are left out."""
LOST = 0.01
"""Of the noise: what may be cut from the spread function."""


@dataclass(frozen=True)
class CapturedLenslets:
    """Superpixels of one capture.

    y: (lenslet_row, lenslet_column, pixel) in any units of A x; NaN where nothing is known, which
        is filled in before it comes here. Lenslets with such values, or all 0, are left out.
    sigma: standard deviation of their noise, in these units.
    saturated: like y, which pixels were clipped; None where nobody says.
    """

    y: np.ndarray
    sigma: float
    saturated: np.ndarray | None = None

    @property
    def used(self) -> np.ndarray:
        """(lenslet_row, lenslet_column) whether a lenslet holds light."""
        return np.isfinite(self.y).all(axis=2) & (self.y != 0).any(axis=2)

    def middle(self, most: int) -> CapturedLenslets:
        """The lenslets in the middle, `most` a side; itself where there are no more."""
        count = self.y.shape[0], self.y.shape[1]
        if max(count) <= most:
            return self
        at = middle_of(count, most)
        clipped = None if self.saturated is None else self.saturated[at]
        return CapturedLenslets(self.y[at], self.sigma, clipped)


def middle_of(count: tuple[int, int], most: int) -> tuple[slice, slice]:
    """The lenslets in the middle of `count` (rows, columns), `most` a side at most."""
    first = (max(0, (n - most) // 2) for n in count)
    rows, columns = (slice(start, min(start + most, n)) for start, n in zip(first, count))
    return rows, columns


@dataclass(frozen=True, kw_only=True)
class FitProblem:
    """Captures of one camera, and what may have made them.

    family: of cameras;
    captures: the lenslets that are looked at;
    evidence: of these, in units of photographs;
    told: (pixel, point) the paraxial matrix as described, by which these units go.
    """

    family: CameraFamily
    captures: tuple[CapturedLenslets, ...]
    evidence: Evidence
    told: np.ndarray

    def of(self, captures: Sequence[CapturedLenslets]) -> FitProblem:
        """The same of the same captures with other pixels filled in."""
        data = [_in_units_of_photographs(c, self.told) for c in captures]
        evidence = Evidence(data, self.evidence.prior)
        return replace(self, captures=tuple(captures), evidence=evidence)

    @property
    def tolerance(self) -> float:
        """Root energy of the spread function that may be lost."""
        return min(max(LOST / self.evidence.quiet, 1e-6), 1e-4)


def fit_problem(
    camera: Camera,
    captures: Sequence[CapturedLenslets],
    pictures: Sequence[np.ndarray],
    *,
    parameters: Sequence[Parameter] | None = None,
    lenslets: int,
    seed: int = 0,
) -> FitProblem:
    """The FitProblem of captures.

    camera, captures, pictures, parameters, seed: as in fit_camera;
    lenslets: looked at along each side of a capture, from its middle.

    Raises UsageError for other cameras, InputError for captures that hold nothing.
    """
    require_fittable(camera)
    family = camera_family(camera, parameters)
    told = _as_described(family)
    middle = tuple(c.middle(lenslets) for c in captures)
    data = [_in_units_of_photographs(c, told) for c in middle]
    prior = photograph_prior(pictures, family.geometry.object_shape, seed)
    seen = prior.seen(told, HIDDEN * min(c.sigma for c in data))
    return FitProblem(family=family, captures=middle, evidence=Evidence(data, seen), told=told)


def camera_family(camera: Camera, parameters: Sequence[Parameter] | None = None) -> CameraFamily:
    """The cameras around a described one; parameters: None for all_parameters."""
    shift = (0.0, 0.0) if camera.fitted is None else camera.fitted.pixel_shift
    known = tuple(all_parameters(camera) if parameters is None else parameters)
    return CameraFamily(camera, geometry(camera, camera.light.wavelengths[0], shift), known)


def described_matrix(camera: Camera) -> np.ndarray:
    """The matrix (pixel, point) of one lenslet of a camera as described, where fits start."""
    return _as_described(camera_family(camera))


def _as_described(family: CameraFamily) -> np.ndarray:
    return LensletFamily(family, tolerance=1e-4).at(family.start).matrix


def _in_units_of_photographs(capture: CapturedLenslets, told: np.ndarray) -> Lenslets:
    """The lenslets as bright as photographs are; told: matrix (pixel, point) as described."""
    y = np.asarray(capture.y, float)[capture.used].T
    if y.size == 0 or not float(y.sum()) > 0:
        raise InputError("holds no light that a fit could look at")
    if not capture.sigma > 0:
        raise InputError("does not say how strong its noise is", fix="give --noise-sigma")
    level = y.sum(axis=0) / float(told.sum())
    unit = float(np.sqrt(np.mean(level**2))) / BRIGHTNESS
    return Lenslets(y / unit, capture.sigma / unit)
