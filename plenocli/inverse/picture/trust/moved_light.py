"""Light that a matrix leaves over because the camera displaces light otherwise than it says.

What is left of a capture outside the reach of the matrix is compared with what the estimate would
show if it moved, whatever the scene; what even light would show if it moved is looked for within.

docs/model.md, "Spatial reconstruction".
"""

from __future__ import annotations

import numpy as np

from plenocli.inverse.picture.lenslet_model import LensletMatrix
from plenocli.inverse.picture.solvers.least_squares import Svd
from plenocli.inverse.picture.solvers.lmmse import Lmmse
from plenocli.inverse.picture.trust.rough_scene import reached

LOOKED_AT = 256
"""Lenslets that are looked at, spread over all, at most."""
ALIKE, IN_STEP = 0.99, 0.04
"""Squared mean of the lenslets' brightness over its mean square from which on what goes with it is
what all have in common, and the share that no motion makes, give or take two standard deviations,
from which on that may be a scene in step with the lenslets (0.04 and more).
"""


FEW = 5
"""Bright lenslets that are too few for their scatter to tell chance."""


def moved_rest(system: LensletMatrix, svd: Svd, lmmse: Lmmse, y: np.ndarray, sigma: float) -> float:
    """How far what no object gives is what the estimate would show if it moved, in standard
    deviations of chance.

    system: the matrix.
    svd: of its own block.
    lmmse: of a lenslet by itself.
    y: (pixel, signal) superpixels.
    sigma: noise of a pixel; where it differs from pixel to pixel, what is left over tells it.
    """
    if min(*system.pixel_shape, *system.object_shape) < 2:
        return 0.0
    y = y[:, :: -(-y.shape[1] // LOOKED_AT)]
    # a star has far more light than brightness and pixels tell
    energy = np.sum(lmmse.adaptive(y)[0] ** 2, axis=0)
    basis = reached(svd, float(energy.mean()), sigma)
    seen = basis @ (basis.T @ y)
    rest = (y - seen).ravel()
    x, _, _ = lmmse.adaptive(seen)
    moved = motions(system, x)
    moved -= basis @ np.einsum("pk,mpl->mkl", basis, moved, optimize=True)
    moved = moved.reshape(len(moved), -1)
    size = np.linalg.norm(moved, axis=1)
    moved = moved[size > 0] / size[size > 0, None]
    found = moved @ rest
    weighted = moved * rest
    least = min(
        _squares(found, sigma**2 * (moved @ moved.T)), _squares(found, weighted @ weighted.T)
    )
    return _deviations(least, len(moved))


def moved_even_light(
    system: LensletMatrix, lmmse: Lmmse, y: np.ndarray
) -> tuple[np.ndarray, float]:
    """What even light of brightness 1 adds to a superpixel because it moves, (pixel,), as far as
    lenslets hold it in proportion to their brightness within the reach of the matrix; and how far
    that is no chance, in standard deviations of what their scatter tells.

    system, lmmse, y: as in `moved_rest`.
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
    return lmmse.analysis.T @ (moved * deviation), _deviations(squares, len(made))


def motions(system: LensletMatrix, x: np.ndarray) -> np.ndarray:
    """(motion, pixel, signal): how superpixels of objects x (point, signal) change with the sensor
    shifted along rows and columns, magnified and turned about its middle, with the object out of
    focus, evenly and with two astigmatisms, and with a pitch that is off; in any units.
    """
    rows, columns = system.pixel_shape
    g, h = (_places(n) for n in (rows, columns))
    g, h = g[:, None, None], h[:, None]
    p, q = (_places(n) for n in system.object_shape)
    x = x.reshape(-1, *system.object_shape, x.shape[1])

    def shown(objects: np.ndarray) -> np.ndarray:
        flat = objects.reshape(-1, objects.shape[-1])
        return (system.own @ flat).reshape(rows, columns, -1)

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
    )
    return np.stack([one.reshape(rows * columns, -1) for one in made])


def _places(count: int) -> np.ndarray:
    return np.arange(count) - (count - 1) / 2


def _squares(found: np.ndarray, covariance: np.ndarray) -> float:
    """Sum of squares of `found` in coordinates in which chance has variance 1."""
    return float(found @ np.linalg.lstsq(covariance, found, rcond=1e-9)[0])


def _deviations(squares: float, count: int) -> float:
    """The normal deviate as rare as a sum of `count` squares of normal deviates (Wilson and
    Hilferty, Proc. Nat. Acad. Sci. 17 (1931) 684).
    """
    if not count:
        return 0.0
    spread = 2 / (9 * count)
    return float((np.cbrt(max(squares, 0.0) / count) - 1 + spread) / np.sqrt(spread))
