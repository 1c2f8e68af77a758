"""A camera fitted to its own captures, without a calibration target: the camera under which they
are most likely, whatever their objects are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import ConfigError, InputError
from plenocli.forward.camera.geometry import geometry
from plenocli.inverse.fit.ascent import Ascent, Point
from plenocli.inverse.fit.camera_fit import CameraFit, FittedParameter
from plenocli.inverse.fit.evidence import Evidence, Lenslets
from plenocli.inverse.fit.lenslet import LensletFamily
from plenocli.inverse.fit.optics import (
    CameraFamily,
    Parameter,
    all_parameters,
    require_fittable,
)
from plenocli.inverse.fit.prior import BRIGHTNESS, photograph_prior

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

STEPS, TRIAL = 40, 8
"""Steps from one start at the most, and of those that compete for being gone on from."""
STARTS = (0.25, -0.25, 1.0, -1.0)
"""Further starts, in tolerances of the focus, where the way from the described camera does not lead
to one that explains the captures: in focus a camera and its mirror image are alike, and the
evidence has a saddle.
"""
HIDDEN = 0.15
"""Patterns of photographs that all together stay below so much of the noise are left out."""
LOST = 0.01
"""Of the noise: what may be cut from the spread function."""
SLACK, DEVIATIONS = 0.025, 4.0
"""Noise over the noise told, less one, up to which a fit explains its captures: photographs are
not quite what the prior says, and the noise of few pixels is known so well only.
"""
INFLATION = 2.5
"""By how much the standard deviations exceed Fisher's: draws of cameras were this much farther."""
MATRIX_INFLATION = 2.0
"""The same for the error of the matrix, to which errors of parameters add up less."""
FINER, FINER_IN_MATRIX = 3e-3, 2e-3
"""What objects finer than the points of a lenslet add to the noise, of a capture's root mean
square, where standard deviations and the error of the matrix are worked out: such objects shift
above all the sensor distance.
"""
LEFT_OVER = 0.03
"""By how much of what a fit leaves over, beyond the noise, the variances grow."""
SECONDS = 3e-5
"""A fit takes on one core for each pixel and point of a lenslet, about."""
MOST_LENSLETS = 16
"""Lenslets looked at along each side of a capture, from its middle."""


@dataclass(frozen=True)
class CapturedLenslets:
    """Superpixels of one capture.

    y: (lenslet_row, lenslet_column, pixel) in any units of A x; lenslets with values that are not
        finite, or all 0, are left out.
    sigma: standard deviation of their noise, in these units.
    """

    y: np.ndarray
    sigma: float


def fit_camera(
    camera: Camera,
    captures: Sequence[CapturedLenslets],
    pictures: Sequence[np.ndarray],
    *,
    parameters: Sequence[Parameter] | None = None,
    seed: int = 0,
    progress: Callable[[], object] | None = None,
) -> CameraFit:
    """The camera that makes captures most likely.

    camera: as described: square lenslets, one wavelength.
    captures: of one camera, whose superpixels are cut out around their centres.
    pictures: training photographs, linear luminance (row, column) in [0, 1], at several scales.
    parameters: that may change, with their tolerances; None: all_parameters.
    seed: of the training patches.
    progress: called at every step.

    Returns the CameraFit; where it is not accepted, its camera is the described one.
    Raises UsageError for other cameras, InputError for captures that hold nothing.
    docs/model.md, "A camera that fits itself".
    """
    require_fittable(camera)
    family = _family(camera, parameters)
    told = _matrix(family)
    middle = [_middle(c) for c in captures]
    data = [_scaled(c, told) for c in middle]
    prior = photograph_prior(pictures, family.geometry.object_shape, seed)
    sigma = min(c.sigma for c in data)
    evidence = Evidence(data, prior.seen(told, HIDDEN * sigma))
    signal = max(float(np.sqrt(np.mean(c.y**2))) for c in data)
    lost = min(max(LOST * sigma / signal, 1e-6), 1e-4)
    ascent = Ascent(family, evidence, tolerance=lost, progress=progress)
    before = ascent.point(np.zeros(len(family.parameters))).evidence.noise_factor()
    limit = accepted_ratio(sum(c.y.size for c in data))
    best = _highest(ascent, limit)
    turned = None
    if best.evidence.noise_factor() <= limit:
        best, turned = _told_apart(ascent, best, middle)
    return _described(ascent, best, limit, before, turned)


def described_matrix(camera: Camera) -> np.ndarray:
    """The matrix (pixel, point) of one lenslet of a camera as described, where fits start."""
    return _matrix(_family(camera, None))


def expected_seconds(camera: Camera) -> float:
    """About how long a fit takes on one core, s."""
    pixels = float(np.prod(camera.sensor.pixels_per_lenslet))
    points = float(np.prod(camera.object.samples_per_lenslet))
    return SECONDS * pixels * points


def _family(camera: Camera, parameters: Sequence[Parameter] | None) -> CameraFamily:
    shift = (0.0, 0.0) if camera.fitted is None else camera.fitted.pixel_shift
    known = tuple(all_parameters(camera) if parameters is None else parameters)
    return CameraFamily(camera, geometry(camera, camera.light.wavelengths[0], shift), known)


def _matrix(family: CameraFamily) -> np.ndarray:
    return LensletFamily(family, tolerance=1e-4).at(family.start).matrix


def accepted_ratio(values: int) -> float:
    """Most likely noise over the noise told up to which a fit of so many pixels is accepted."""
    return 1 + SLACK + DEVIATIONS / float(np.sqrt(2 * values))


def _middle(capture: CapturedLenslets) -> CapturedLenslets:
    """The lenslets in the middle of a capture."""
    rows, columns = capture.y.shape[:2]
    r, c = (max(0, (n - MOST_LENSLETS) // 2) for n in (rows, columns))
    return CapturedLenslets(
        np.asarray(capture.y, float)[r : r + MOST_LENSLETS, c : c + MOST_LENSLETS],
        float(capture.sigma),
    )


def _used(capture: CapturedLenslets) -> np.ndarray:
    """(lenslet_row, lenslet_column) whether a lenslet holds light."""
    return np.isfinite(capture.y).all(axis=2) & (capture.y != 0).any(axis=2)


def _scaled(capture: CapturedLenslets, told: np.ndarray) -> Lenslets:
    """The lenslets as bright as photographs are; told: matrix (pixel, point) as described."""
    y = capture.y[_used(capture)].T
    if y.size == 0 or not float(y.sum()) > 0:
        raise InputError("holds no light that a fit could look at")
    if not capture.sigma > 0:
        raise InputError("does not say how strong its noise is", fix="give --noise-sigma")
    level = y.sum(axis=0) / float(told.sum())
    unit = float(np.sqrt(np.mean(level**2))) / BRIGHTNESS
    return Lenslets(y / unit, capture.sigma / unit)


def _highest(ascent: Ascent, limit: float) -> Point:
    """Where the way up leads from the described camera or, if that explains nothing, from the best
    of further starts.
    """
    first = ascent.climb(np.zeros(len(ascent.family.parameters)), STEPS)
    if first.evidence.noise_factor() <= limit or not ascent.family.has("focus"):
        return first
    found = [first]
    for focus in STARTS:
        x = np.zeros_like(first.x)
        x[ascent.family.place("focus")] = focus
        found.append(ascent.climb(x, TRIAL))
    best = max(found, key=lambda p: p.evidence.value(1.0) - 0.5 * float(p.x @ p.x))
    return best if best is first else ascent.climb(best.x, STEPS)


def _told_apart(
    ascent: Ascent, at: Point, captures: Sequence[CapturedLenslets]
) -> tuple[Point, float | None]:
    """(the one of a camera and its mirror image whose objects go on from lenslet to lenslet, how
    many times larger the other's steps over the borders are).
    """
    mirrored = ascent.family.mirrored(ascent.values(at.x))
    if mirrored is None:
        return at, None
    other = ascent.point((mirrored - ascent.family.start) / ascent.family.tolerance, at.factor)
    steps = [_border_steps(p, ascent, captures) for p in (at, other)]
    if steps[0] is None or steps[1] is None:
        return at, None
    if steps[0] <= steps[1]:
        return at, steps[1] / steps[0]
    return ascent.climb(other.x, STEPS), steps[0] / steps[1]


def _border_steps(at: Point, ascent: Ascent, captures: Sequence[CapturedLenslets]) -> float | None:
    """Mean squared difference of the points on both sides of the borders between lenslets, under
    one camera; None where no two lenslets touch.
    """
    shape, total, count = ascent.family.geometry.object_shape, 0.0, 0
    for index, capture in enumerate(captures):
        used = _used(capture)
        objects = np.full((*used.shape, *shape), np.nan)
        objects[used] = at.evidence.objects(index, at.factor).T.reshape(-1, *shape)
        for steps in (
            objects[1:, :, 0, :] - objects[:-1, :, -1, :],
            objects[:, 1:, :, 0] - objects[:, :-1, :, -1],
        ):
            there = np.isfinite(steps)
            total += float(np.sum(steps[there] ** 2))
            count += int(there.sum())
    return total / count if count else None


def _uncertainty(ascent: Ascent, at: Point, ratio: float) -> tuple[np.ndarray, np.ndarray, float]:
    """(standard deviations (parameter,) in tolerances, correlations (parameter, parameter),
    relative error of the matrix) at the end of a fit that leaves `ratio` times the noise.
    """
    captures = ascent.evidence.captures
    values = sum(c.y.size for c in captures)
    quiet = max(float(np.sqrt(np.mean(c.y**2))) / c.sigma for c in captures)
    excess = max(0.0, ratio**2 - 1 - 2 * float(np.sqrt(2 / values))) * values

    def covariance(finer: float) -> tuple[np.ndarray, np.ndarray]:
        factor = max(at.factor, float(np.hypot(1, finer * quiet)))
        information, products = ascent.information(replace(at, factor=factor))
        return np.linalg.inv(information), products

    found, _ = covariance(FINER)
    found = found * (INFLATION**2 + LEFT_OVER * excess)
    sigma = np.sqrt(np.diag(found))
    correlation = found / np.outer(sigma, sigma)
    narrower, products = covariance(FINER_IN_MATRIX)
    error = MATRIX_INFLATION * float(np.sqrt(max(np.sum(narrower * products), 0.0)))
    # nothing is known less well than before
    return np.minimum(sigma, 1.0), correlation, error / float(np.linalg.norm(at.matrix.matrix))


def _described(
    ascent: Ascent, at: Point, limit: float, before: float, turned: float | None
) -> CameraFit:
    """The CameraFit of the point where a fit ended."""
    family, ratio = ascent.family, at.evidence.noise_factor()
    sigma, correlation, error = _uncertainty(ascent, at, ratio)
    values = ascent.values(at.x)
    accepted, why = ratio <= limit, f"explains the captures to {ratio:.3f} times their noise"
    if not accepted:
        why = f"leaves {ratio:.3g} times the captures' noise, where {limit:.3f} would do"
    shift = family.geometry_at(values).pixel_shift or (0.0, 0.0)
    if accepted and max(map(abs, shift)) > 0.5:
        accepted, why = False, "superpixels would be off by more than half a pixel"
    camera = family.camera
    if accepted:
        try:
            camera = family.camera_at(values).with_fit(shift, error)
        except ConfigError as trouble:
            accepted, why = False, f"would need a camera that cannot be: {trouble.what}"
    return CameraFit(
        camera=camera,
        parameters=tuple(
            FittedParameter(
                name=p.name,
                unit=p.unit,
                described=float(family.start[i]),
                value=float(values[i]),
                sigma=float(sigma[i] * p.tolerance),
                tolerance=p.tolerance,
            )
            for i, p in enumerate(family.parameters)
        ),
        correlation=correlation,
        accepted=accepted,
        why=why,
        noise_ratio=ratio,
        noise_ratio_before=before,
        model_error=error,
        turned=turned,
        matrix=np.asarray(at.matrix.matrix, float),
        lenslets=ascent.evidence.lenslets,
    )
