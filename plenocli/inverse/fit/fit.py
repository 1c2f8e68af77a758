"""A camera fitted to its own captures, without a calibration target: the camera under which they
are most likely, whatever their objects are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import ConfigError
from plenocli.inverse.fit.ascent import Ascent, Point
from plenocli.inverse.fit.camera_fit import CameraFit, FittedParameter
from plenocli.inverse.fit.captures import Mender
from plenocli.inverse.fit.finer import finer_matrix
from plenocli.inverse.fit.optics import ZERNIKES, Parameter, require_fittable
from plenocli.inverse.fit.problem import CapturedLenslets, FitProblem, described_matrix, fit_problem

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

STEPS, TRIAL, TRIALS, ROUNDS = 40, 8, 3, 3
"""Steps from one start at the most, of those that it begins with, how many starts compete for being
gone on from, and how often the difference of a finer model is brought up to date.
"""
STARTS = (
    *(("focus", far) for far in (0.25, -0.25, 1.0, -1.0)),
    *((ZERNIKES[noll][0], far) for noll in (5, 6, 7, 8) for far in (0.8, -0.8)),
)
"""Further starts, in tolerances, where the way from the described camera does not lead to one that
explains the captures: in focus a camera and its mirror image are alike, and the evidence has a
saddle.
"""
LOUD = 1e-2
"""Noise over a capture's root mean square, the least that the way from a start begins with: the
evidence of a louder capture has fewer false maxima.
"""
MENDED, ALIKE = 3, 0.03
"""How often, at the most, pixels that count for nothing are filled in anew under the camera that
was found, and by how much of the noise, root mean square, that must change the captures.
"""
CERTAIN, SLACK, DEVIATIONS = 0.005, 0.01, 3.0
"""Noise over the noise told, less one, up to which a fit explains its captures, on the face of it
and at the most: photographs are not quite what the prior says, and the noise of few pixels is known
so well only.
"""
UNRESOLVED = 4e-4
"""What objects finer than the points of a lenslet may leave over, of a capture's root mean square.
"""
ALMOST = 100.0
"""By how much less likely (log) than the camera that was found a start may be that is gone on from
all the same: so much is gained on the way from a camera that is mirrored along one axis.
"""
CLEAR = 4.0
"""Steps over lenslet borders under the mirrored camera, over those under the found one, from which
on a fit that leaves more than its noise is believed altogether, and less of it before: where both
fit badly the camera is a third.
"""
TOLD, MATTERS = 1.5, 3.0
"""The same ratio from which on a camera is told from its mirror image (2.2 is the least of 60 right
fits, 1.2 the wrong one's), and by how many times the noise the light of both must differ for it to
matter which of them it is.
"""
INFLATION = 1.8
"""By how much the standard deviations exceed the curvature's: drawn cameras were farther by it."""
MATRIX_INFLATION = 1.6
"""The same for the error of the matrix, to which errors of parameters add up less."""
FINER, FINER_IN_MATRIX = 3e-3, 2e-3
"""What objects finer than the points of a lenslet add to the noise, of a capture's root mean
square, where standard deviations and the error of the matrix are worked out: such objects shift
above all the sensor distance.
"""
LEFT_OVER = 0.01
"""By how much of what a fit leaves over, beyond the noise, the variances grow."""
SECONDS = 5e-6
"""A fit takes on one core for each pixel and point of a lenslet, about."""
MOST_LENSLETS = 16
"""Lenslets looked at along each side of a capture, from its middle."""


def fit_camera(
    camera: Camera,
    captures: Sequence[CapturedLenslets],
    pictures: Sequence[np.ndarray],
    *,
    parameters: Sequence[Parameter] | None = None,
    model: str = "auto",
    seed: int = 0,
    progress: Callable[[], object] | None = None,
) -> CameraFit:
    """The camera that makes captures most likely.

    camera: as described: square lenslets, one wavelength.
    captures: of one camera, whose superpixels are cut out around their centres; pixels that are
        defective, saturated or not known are found and filled in as the rest of their lenslet has
        them under the camera that is found.
    pictures: training photographs, linear luminance (row, column) in [0, 1], at several scales.
    parameters: that may change, with their tolerances; None: all_parameters.
    model: of propagation behind which captures are believed to have come about: "auto" for the
        finest that serves, "exact" or "fresnel".
    seed: of the training patches.
    progress: called at every step.

    Returns the CameraFit; where it is not accepted, its camera is the described one.
    Raises UsageError for other cameras, InputError for captures that hold nothing.
    docs/model.md, "A camera that fits itself".
    """
    require_fittable(camera)
    mender = Mender(camera, pictures, seed)
    known = [c.middle(MOST_LENSLETS) for c in captures]
    told = described_matrix(camera)
    mended = [mender.mended(c, told) for c in known]
    problem = fit_problem(
        camera, mended, pictures, parameters=parameters, lenslets=MOST_LENSLETS, seed=seed
    )
    ascent = Ascent(
        problem.family,
        problem.evidence,
        tolerance=problem.tolerance,
        model=partial(finer_matrix, problem.family, model),
        rounds=1 if model == "fresnel" else ROUNDS,
        progress=progress,
    )
    start = np.zeros(len(problem.family.parameters))
    begun = ascent.point(start, finer=ascent.difference(start))
    limits = accepted_ratios(problem.evidence.values, problem.evidence.quiet)
    mend = partial(_mended, mender=mender, known=known)
    first = ascent.settle(ascent.climb(begun, TRIAL, LOUD * problem.evidence.quiet), STEPS)
    if not _whole(problem, known) or first.evidence.noise_factor() > limits[0]:
        first, ascent, problem = mend(first, ascent, problem)
    first = _mirrored_along_one_axis(ascent, first, limits[0])
    best = _highest(ascent, first, limits[0])
    if best is not first:
        best = _mirrored_along_one_axis(ascent, best, limits[0])
        if not _whole(problem, known):
            best, ascent, problem = mend(best, ascent, problem)
    turned, either = None, False
    if best.evidence.noise_factor() <= limits[1]:
        best, turned, unlike = _told_apart(ascent, best, problem.captures)
        either = turned is not None and turned < TOLD and unlike > MATTERS
    limit = believed_ratio(limits, turned)
    return _described(ascent, best, limit, begun, turned, either=either)


def _mended(
    at: Point,
    ascent: Ascent,
    problem: FitProblem,
    *,
    mender: Mender,
    known: Sequence[CapturedLenslets],
) -> tuple[Point, Ascent, FitProblem]:
    """Where the way goes on with the pixels that count for nothing filled in under the camera at
    hand, until that changes no more; known: the captures as they were.
    """
    for _ in range(MENDED):
        again = [mender.mended(c, at.matrix) for c in known]
        if _change(problem.captures, again) < ALIKE:
            break
        problem = problem.of(again)
        ascent = ascent.of(problem.evidence)
        at = ascent.settle(ascent.point(at.x, finer=at.finer), STEPS)
    return at, ascent, problem


def _whole(problem: FitProblem, known: Sequence[CapturedLenslets]) -> bool:
    """Whether nothing was filled in."""
    return all(a is b for a, b in zip(problem.captures, known))


def _change(before: Sequence[CapturedLenslets], after: Sequence[CapturedLenslets]) -> float:
    """Root mean square over the noise, of the capture that changed most."""
    return max(
        float(np.sqrt(np.nanmean((a.y - b.y) ** 2)) / a.sigma) for a, b in zip(after, before)
    )


def expected_seconds(camera: Camera) -> float:
    """About how long a fit takes on one core, s."""
    pixels = float(np.prod(camera.sensor.pixels_per_lenslet))
    points = float(np.prod(camera.object.samples_per_lenslet))
    return SECONDS * pixels * points


def accepted_ratios(values: int, quiet: float) -> tuple[float, float]:
    """(most likely noise over the noise told up to which a fit is taken without looking farther,
    the same up to which the best fit is accepted).

    values: pixels of all lenslets;
    quiet: root mean square of the captures over their noise.
    """
    sure = DEVIATIONS / float(np.sqrt(2 * values))
    return 1 + CERTAIN + sure, float(np.hypot(1 + SLACK, UNRESOLVED * quiet)) + sure


def believed_ratio(limits: tuple[float, float], turned: float | None) -> float:
    """Most likely noise over the noise told up to which the best fit is accepted: what is left over
    is believed of fine objects as far as pictures go on from lenslet to lenslet.

    limits: accepted_ratios;
    turned: as in CameraFit.
    """
    clear = 0.0 if turned is None else math.log(max(1.0, turned)) / math.log(CLEAR)
    return limits[0] + min(1.0, clear) ** 2 * (limits[1] - limits[0])


def _highest(ascent: Ascent, first: Point, limit: float) -> Point:
    """Where the way up led from the described camera or, if that explains nothing, where it leads
    from the best of further starts.
    """
    if first.evidence.noise_factor() <= limit:
        return first
    starts = []
    for name, far in STARTS:
        if ascent.family.has(name):
            x = np.zeros_like(first.x)
            x[ascent.family.place(name)] = far
            starts.append(ascent.point(x))
    starts = sorted(starts, key=lambda p: p.height, reverse=True)[:TRIALS]
    found = [ascent.climb(start, TRIAL, LOUD * ascent.evidence.quiet) for start in starts]
    if not found:
        return first
    x = max(found, key=_likely).x
    other = ascent.settle(ascent.point(x, finer=ascent.difference(x)), STEPS)
    return max([first, other], key=_likely)


def _mirrored_along_one_axis(ascent: Ascent, at: Point, limit: float) -> Point:
    """Where the way leads from a camera whose defocus and astigmatism have changed places, if it is
    more likely than the one that was found: both blur alike, and where noise hides the difference
    either is a maximum of the evidence, which a fit beyond `limit` may have ended on.
    """
    family, doubtful = ascent.family, at.evidence.noise_factor() > limit
    for values in family.half_mirrored(ascent.values(at.x)):
        other = ascent.point((values - family.start) / family.tolerance, finer=at.finer)
        if doubtful or _likely(other) > _likely(at) - ALMOST:
            at = max([at, ascent.climb(other, STEPS)], key=_likely)
    return at


def _likely(at: Point) -> float:
    """How likely the captures are at a point, whatever the noise."""
    return at.evidence.value(max(1.0, at.evidence.noise_factor())) - 0.5 * float(at.x @ at.x)


def _told_apart(
    ascent: Ascent, at: Point, captures: Sequence[CapturedLenslets]
) -> tuple[Point, float | None, float]:
    """(the one of a camera and its mirror image whose objects go on from lenslet to lenslet, how
    many times larger the other's steps over the borders are, how unlike both are: the difference of
    their light over the noise).
    """
    mirrored = ascent.family.mirrored(ascent.values(at.x))
    if mirrored is None:
        return at, None, 0.0
    x = (mirrored - ascent.family.start) / ascent.family.tolerance
    other = ascent.point(x, at.factor, finer=ascent.difference(x))
    steps = [_border_steps(p, ascent, captures) for p in (at, other)]
    difference = np.linalg.norm(other.matrix - at.matrix) / np.linalg.norm(at.matrix)
    unlike = float(difference) * ascent.evidence.quiet
    if steps[0] is None or steps[1] is None:
        return at, None, unlike
    if steps[0] <= steps[1]:
        return at, steps[1] / steps[0], unlike
    other = max([other, *ascent.mirrored(at, other.finer)], key=_likely)
    return ascent.settle(other, STEPS), steps[0] / steps[1], unlike


def _border_steps(at: Point, ascent: Ascent, captures: Sequence[CapturedLenslets]) -> float | None:
    """Mean squared difference of the points on both sides of the borders between lenslets, under
    one camera; None where no two lenslets touch.
    """
    shape, total, count = ascent.family.geometry.object_shape, 0.0, 0
    for index, capture in enumerate(captures):
        used = capture.used
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
    values, quiet = ascent.evidence.values, ascent.evidence.quiet
    excess = max(0.0, ratio**2 - 1 - 2 * float(np.sqrt(2 / values))) * values

    slopes = ascent.slopes(at)

    def covariance(finer: float) -> np.ndarray:
        factor = max(at.factor, float(np.hypot(1, finer * quiet)))
        return np.linalg.inv(slopes.curvature(at, factor))

    found = covariance(FINER) * (INFLATION**2 + LEFT_OVER * excess)
    sigma = np.sqrt(np.diag(found))
    correlation = found / np.outer(sigma, sigma)
    missed = float(np.sum(covariance(FINER_IN_MATRIX) * slopes.products))
    error = MATRIX_INFLATION * float(np.sqrt(max(missed, 0.0)))
    # nothing is known less well than before
    return np.minimum(sigma, 1.0), correlation, error / float(np.linalg.norm(at.matrix))


def _described(
    ascent: Ascent, at: Point, limit: float, begun: Point, turned: float | None, *, either: bool
) -> CameraFit:
    """The CameraFit of the point where a fit ended; begun: the described camera; either: whether
    it may as well be its mirror image.
    """
    family, ratio = ascent.family, at.evidence.noise_factor()
    sigma, correlation, error = _uncertainty(ascent, at, ratio)
    values = ascent.values(at.x)
    accepted, why = ratio <= limit, f"explains the captures to {ratio:.3f} times their noise"
    if not accepted:
        why = f"leaves {ratio:.3g} times the captures' noise, where {limit:.3f} would do"
    shift = family.geometry_at(values).pixel_shift or (0.0, 0.0)
    if accepted and max(map(abs, shift)) > 0.5:
        accepted, why = False, "superpixels would be off by more than half a pixel"
    if accepted and error > 1:
        accepted, why = False, "tells nothing of the matrix under the noise told"
    if accepted and either:
        accepted = False
        why = "is not told from its mirror image, whose objects are turned by 180 degrees"
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
        noise_ratio_before=begun.evidence.noise_factor(),
        model_error=error,
        turned=turned,
        matrix=np.asarray(at.matrix if accepted else begun.matrix, float),
        lenslets=ascent.evidence.lenslets,
    )
