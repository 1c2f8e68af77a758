"""Light that a matrix leaves over because the camera displaces light otherwise than it says.

What is left of a capture outside the reach of the matrix is compared with what the estimate would
show if it moved, whatever the scene; within it, where photographs are likelier if it moved, and
what even light would show.

docs/model.md, "Spatial reconstruction".
"""

from __future__ import annotations

import numpy as np

from plenocli.base.budget import both
from plenocli.inverse.picture.lenslet_model import LensletMatrix
from plenocli.inverse.picture.solvers.least_squares import Svd
from plenocli.inverse.picture.solvers.lmmse import Lmmse, mean_scale
from plenocli.inverse.picture.trust.rough_scene import reached

MOTIONS = 10
"""How many ways light is looked for to have moved in."""
LOOKED_AT = 64
"""Lenslets that are looked at, spread over all, at most."""
ALIKE, IN_STEP = 0.99, 0.04
"""Squared mean of the lenslets' brightness over its mean square from which on what goes with it is
what all have in common, and the share that no motion makes, give or take two standard deviations,
from which on that may be a scene in step with the lenslets (0.04 and more).
"""

FEW = 5
"""Bright lenslets that are too few for their scatter to tell chance."""
STRONG = 1e-4
"""Singular value over the largest below which what moves is not looked at."""
LOUD = 0.1
"""Power over the noise from which on a coordinate is looked at, in the lenslet of most contrast."""
UNUSUAL = 0.015
"""Information that one lenslet has about what moved, by which photographs seem to move under the
right matrix, as they are not quite what their statistics say.
"""


def moved_light(
    system: LensletMatrix, svd: Svd, lmmse: Lmmse, y: np.ndarray, sigma: float
) -> float:
    """How much more likely a capture is if its light moved, in standard deviations of chance: by
    what no object gives, whatever the scene, or by that and what photographs give.

    system: the matrix.
    svd: of its own block.
    lmmse: of a lenslet by itself.
    y: (pixel, signal) superpixels.
    sigma: noise of a pixel; where it differs from pixel to pixel, what is left over tells it.
    """
    if min(*system.pixel_shape, *system.object_shape) < 2:
        return 0.0
    y = y[:, :: -(-y.shape[1] // LOOKED_AT)]
    (slopes, chance), (more, unusual) = both(
        lambda: _beyond(system, svd, lmmse, y, sigma), lambda: _within(system, lmmse, y, svd)
    )
    return max(_deviations(slopes, chance), _deviations(slopes + more, chance + unusual))


def _beyond(
    system: LensletMatrix, svd: Svd, lmmse: Lmmse, y: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes (motion,) of the likelihood of what no object gives, and their covariance."""
    # a star has far more light than brightness and pixels tell
    energy = np.sum(lmmse.likely(y) ** 2, axis=0)
    basis = reached(svd, float(energy.mean()), sigma)
    seen = basis @ (basis.T @ y)
    rest = (y - seen).ravel() / sigma
    moved = motions(system, lmmse.likely(seen), svd) / sigma
    moved -= basis @ np.einsum("pk,mpl->mkl", basis, moved, optimize=True)
    moved = moved.reshape(len(moved), -1)
    slopes, weighted = moved @ rest, moved * rest
    chances = moved @ moved.T, weighted @ weighted.T
    return slopes, min(chances, key=lambda chance: _deviations(slopes, chance))


def _within(
    system: LensletMatrix, lmmse: Lmmse, y: np.ndarray, svd: Svd | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes (motion,) of the likelihood of photographs behind what objects give, and their
    covariance, by chance and as photographs are not quite what their statistics say.

    Coordinates are uncorrelated under the right matrix, whatever their powers: only what they have
    to do with others counts. What all lenslets have in common may be a scene's that is in step with
    them and is left out; lenslets that are like no photograph count for less. The covariance is the
    mean of that of photographs and that of the estimates at hand.
    """
    w = lmmse.coordinates(y)
    scales = mean_scale(lmmse.contrast(w))
    loud = lmmse.power * scales.max() > LOUD * lmmse.noise
    if not loud.any():
        return np.zeros(MOTIONS), np.zeros((MOTIONS, MOTIONS))
    power, noise = lmmse.power[loud], lmmse.noise[loud]
    moves = lmmse.analysis[loud] @ motions(system, lmmse.gain[:, loud], svd)
    moves *= 1 - np.eye(len(power))
    w, variance = w[loud], scales * power[:, None] + noise[:, None]
    pull = w / variance
    weight = 1 / np.maximum(1, np.sum(w * pull, axis=0) / max(len(w), 1))
    share, moved = weight / weight.sum(), scales * (moves @ pull)
    common = pull @ share
    pull, moved = pull - common[:, None], moved - (moved @ share)[:, :, None]
    slopes = moved.reshape(len(moved), -1) @ (pull * weight).ravel()
    moved *= np.sqrt(weight / variance)
    seen = moved.reshape(len(moves), -1)
    chance, either = seen @ seen.T / 2, moves + moves.transpose(0, 2, 1)
    of_scale, which = np.unique(np.round(2 * np.log(scales)), return_inverse=True)
    for scale, count in zip(np.exp(of_scale / 2), np.bincount(which)):
        size = np.sqrt(scale / (scale * power + noise))
        flat = (either * np.outer(size, size)).reshape(len(moves), -1)
        chance += count / 4 * (flat @ flat.T)
    return slopes, chance * (1 + UNUSUAL * y.shape[1])


def moved_even_light(
    system: LensletMatrix, lmmse: Lmmse, y: np.ndarray
) -> tuple[np.ndarray, float]:
    """What even light of brightness 1 adds to a superpixel because it moves, (pixel,), as far as
    lenslets hold it in proportion to their brightness within the reach of the matrix; and how far
    that is no chance, in standard deviations of what their scatter tells.

    system, lmmse, y: as in `moved_light`.
    """
    nothing = np.zeros(len(y)), 0.0
    w, bright = lmmse.analysis @ y, lmmse.brightness(y)
    power = float(bright @ bright)
    few = not power**2 > FEW * float(np.sum(bright**4))
    if min(*system.pixel_shape, *system.object_shape) < 2 or few:
        return nothing
    found = w @ bright / power
    deviation = np.sqrt((w - np.outer(found, bright)) ** 2 @ bright**2) / power
    weight = np.where(deviation > 0, 1 / np.maximum(deviation, np.finfo(float).tiny), 0)
    even = motions(system, np.ones((system.own.shape[1], 1)))[:, :, 0]
    made = even @ lmmse.analysis.T * weight
    size = np.linalg.norm(made, axis=1)
    made, found = made[size > 0] / size[size > 0, None], found * weight
    moved = np.linalg.lstsq(made.T, found, rcond=1e-6)[0] @ made
    squares, others = float(moved @ moved), len(found) - len(made)
    alike = float(bright.sum()) ** 2 > ALIKE * power * len(bright)
    most = float(np.sum((found - moved) ** 2)) - others + 2 * np.sqrt(2 * max(others, 0))
    if alike and most > IN_STEP * squares:
        return nothing
    return lmmse.analysis.T @ (moved * deviation), _as_rare(squares, len(made))


def motions(system: LensletMatrix, x: np.ndarray, svd: Svd | None = None) -> np.ndarray:
    """(motion, pixel, signal): how superpixels of objects x (point, signal) change with the sensor
    shifted along rows and columns, magnified and turned about its middle, with the object out of
    focus, evenly and with two astigmatisms, with a pitch that is off and with two comas; in any
    units.

    svd: of the own block, which is then taken to be what is STRONG of it.
    """
    rows, columns = system.pixel_shape
    g, h = (_places(n) for n in (rows, columns))
    g, h = g[:, None, None], h[:, None]
    p, q = (_places(n) for n in system.object_shape)
    x = x.reshape(-1, *system.object_shape, x.shape[1])
    own = [system.own]
    if svd is not None:
        used = svd.rank(STRONG)
        own = [svd.u[:, :used] * svd.s[:used], svd.vt[:used]]

    def shown(objects: np.ndarray) -> np.ndarray:
        flat = objects.reshape(-1, objects.shape[-1])
        return np.linalg.multi_dot([*own, flat]).reshape(rows, columns, -1)

    down, right = np.gradient(shown(x), axis=(0, 1))
    lower, righter = (shown(part) for part in np.gradient(x, axis=(1, 2)))
    spread = np.gradient(shown(p[:, None, None] * x), axis=0)
    spread = spread + np.gradient(shown(q[:, None] * x), axis=1)
    made = (
        down,
        right,
        g * down + h * right,
        g * right - h * down,
        g * lower + h * righter,
        g * lower - h * righter,
        g * righter + h * lower,
        spread,
        (3 * g**2 + h**2) * lower + 2 * g * h * righter,
        2 * g * h * lower + (g**2 + 3 * h**2) * righter,
    )
    return np.stack([one.reshape(rows * columns, -1) for one in made])


def _places(count: int) -> np.ndarray:
    return np.arange(count) - (count - 1) / 2


def _deviations(found: np.ndarray, covariance: np.ndarray) -> float:
    """The normal deviate as rare as the squares of `found` in coordinates in which chance has
    variance 1 (Wilson and Hilferty, Proc. Nat. Acad. Sci. 17 (1931) 684).
    """
    size = np.sqrt(np.diag(covariance))
    kept, count = size > 0, int(np.count_nonzero(size))
    found, size = found[kept] / size[kept], size[kept]
    covariance = covariance[np.ix_(kept, kept)] / np.outer(size, size)
    squares = float(found @ np.linalg.lstsq(covariance, found, rcond=1e-9)[0])
    return _as_rare(squares, count)


def _as_rare(squares: float, count: int) -> float:
    """The normal deviate as rare as a sum of `count` squares of normal deviates."""
    if not count:
        return 0.0
    spread = 2 / (9 * count)
    return float((np.cbrt(max(squares, 0.0) / count) - 1 + spread) / np.sqrt(spread))
