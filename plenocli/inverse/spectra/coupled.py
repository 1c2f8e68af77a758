"""Radiances of all lenslets together, each with its light on its neighbours' superpixels.

`coupled` has one radiance a lenslet and band, `fine` as many as the light tells apart of the points
of its field, the answer being the points' mean: neighbours' light comes from their near edges,
which differ from their means where edges lie inside fields, and `likeliest` says whether they do,
down and across. docs/model.md, section 9, "Neighbours".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from plenocli.base.tiling import FORGETFUL, Keeper, kept
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.spectra.field_modes import EVEN
from plenocli.inverse.spectra.lattice_system import LatticeSystem, PointPrior
from plenocli.inverse.spectra.neighbours import NeighbourLight

LEAST_CORRELATION = 0.05
"""Of lenslets beside each other, as the prior takes it."""
MOST_CORRELATION = 0.98
STEPPED = 0.99
"""Of the covariance of points along an axis along which they change from lenslet to lenslet."""
PART = 16
"""Lenslets a side, at most, that are asked whether they do."""
MOST = 2.0
"""Standard deviations by which neighbours' light is changed at most."""
TURNS = 3
KNOWN_TO, OF_LIGHT = 0.035, 0.1
"""Share of what neighbours' light changes, over the array, by which the change may be wrong, where
that much of a band's light is the neighbours'; of more light by the root less, as of parts that are
wrong each by itself.
"""


@dataclass(frozen=True, kw_only=True)
class LatticeCapture:
    """One capture on its lattice.

    values: (lenslet_row, lenslet_column, pixel), NaN where unknown.
    response: F (pixel, band), of all lenslets or the mean of their own.
    own: from radiances (lenslet_row, lenslet_column, band), what responses of the lenslets' own add
        to superpixels by `response`, NaN where one is not known; None: one serves all.
    response_variance: (pixel, band) of F's entries, or None.
    noise: of the values.
    start: (lenslet_row, lenslet_column, band), a first answer without neighbours; NaN: none.
    ratio: whether errors of F divide out of the answer.
    """

    values: np.ndarray
    response: np.ndarray
    own: Callable[[np.ndarray], np.ndarray] | None
    response_variance: np.ndarray | None
    noise: Noise
    start: np.ndarray
    ratio: bool = False

    @property
    def known(self) -> np.ndarray:
        """(lenslet_row, lenslet_column, pixel), which values count."""
        return np.isfinite(self.values) & np.isfinite(self.response).all(axis=-1)

    def variance(self, radiance: np.ndarray) -> np.ndarray:
        """Of pixels (..., pixel) at radiances (..., band)."""
        b = np.clip(radiance, 0, None)
        out = np.asarray(self.noise.variance(b @ np.nan_to_num(self.response).T))
        if self.response_variance is not None:
            out = out + b**2 @ np.nan_to_num(self.response_variance).T
        return np.maximum(out, 1e-12)

    def first(self) -> np.ndarray:
        """`start`, the mean where it is not known."""
        middle = np.nanmean(self.start, axis=(0, 1))
        return np.where(np.isfinite(self.start), self.start, np.nan_to_num(middle))


@dataclass(frozen=True, kw_only=True)
class LatticeAnswer:
    """Radiances of one capture.

    value, sigma: (lenslet_row, lenslet_column, band).
    points: (lenslet_row, lenslet_column, mode * band), of the field, whose mean `value` is.
    residual: (lenslet_row, lenslet_column), mean square over the expected one.
    left: (lenslet_row, lenslet_column, pixel), of the values; 0 where unknown.
    system: that was solved.
    light: of the neighbours, as it was taken.
    """

    value: np.ndarray
    sigma: np.ndarray
    points: np.ndarray
    residual: np.ndarray
    left: np.ndarray
    system: LatticeSystem
    light: NeighbourLight

    @property
    def misfit(self) -> float:
        """Median of the residual."""
        return float(np.nanmedian(self.residual)) if np.isfinite(self.residual).any() else 0.0


def coupled(
    capture: LatticeCapture,
    light: NeighbourLight,
    fit: bool = True,
    keeper: Keeper = FORGETFUL,
) -> LatticeAnswer:
    """One radiance a lenslet and band, and no prior.

    capture: with its first answer.
    light: predicted, of the neighbours.
    fit: whether its changes are fitted to the capture.
    keeper: of each solution.
    """
    amounts, start, taken = np.zeros(len(light.changes)), capture.first(), light

    def fitted() -> tuple[np.ndarray, np.ndarray]:
        system = _coupled_system(capture, taken)
        points = _solved(system, capture, start)
        left = _left(system, capture, points)
        return points, _change_step(system, capture, light, points, left, amounts)

    for turn in range(TURNS if fit else 0):
        points, step = kept(keeper, f"fit{turn}", fitted)
        start = points.astype(np.float32)
        amounts = np.clip(amounts + step, -MOST, MOST)
        taken = light.changed(amounts)
        if np.abs(step).max() < 0.02:
            break
    system = _coupled_system(capture, taken)
    return _answered(system, capture, start, taken, keeper.under("coupled"))


def fine(
    capture: LatticeCapture,
    first: LatticeAnswer,
    light: NeighbourLight,
    stepped: tuple[float, float],
    keeper: Keeper = FORGETFUL,
) -> LatticeAnswer:
    """What lies where in each field, band by band, with the prior that the first answer shows.

    first: by `coupled`.
    light: predicted, of the neighbours.
    stepped: as PointPrior has it.
    keeper: of the solution.
    """
    prior = replace(_prior(first), stepped=stepped)
    system = LatticeSystem(
        _by_mode(capture, light),
        light.offsets,
        _stationary(capture, first.value),
        first.value.shape[:2],
        prior,
    )
    start = _even_points(first.value, light)
    return _answered(system, capture, start, light, keeper.under("fine"))


def likeliest(
    capture: LatticeCapture, first: LatticeAnswer, light: NeighbourLight
) -> tuple[float, float]:
    """Whether points change within fields (0) or from lenslet to lenslet (STEPPED), down and
    across, by the evidence of the part of the array that changes most; STEPPED both ways is
    the model of `coupled`.

    first, light: as `fine` has them.
    """
    part, prior = _liveliest(first.value), _prior(first)
    values = capture.values
    if capture.own is not None:
        values = values - capture.own(first.value)
    cut = replace(capture, values=values[part], start=capture.start[part], own=None)
    value, variance = first.value[part], _stationary(capture, first.value)
    shape, blocks, start = value.shape[:2], _by_mode(capture, light), _even_points(value, light)
    tried: dict[tuple[float, float], tuple[LatticeSystem, np.ndarray, np.ndarray]] = {}

    def solved(
        system: LatticeSystem, start: np.ndarray
    ) -> tuple[LatticeSystem, np.ndarray, np.ndarray]:
        points = _solved(system, cut, start)
        return system, points, _left(system, cut, points)

    for stepped in ((0.0, 0.0), (STEPPED, 0.0), (0.0, STEPPED)):
        alike = replace(prior, stepped=stepped)
        system = LatticeSystem(blocks, light.offsets, variance, shape, alike)
        tried[stepped] = solved(system, start)
    each = first.light.coupled(capture.response)
    alike = replace(prior, modes=EVEN)
    system = LatticeSystem(each, first.light.offsets, variance, shape, alike)
    tried[STEPPED, STEPPED] = solved(system, value)
    system, points, left = tried[0.0, 0.0]
    misfit = np.nanmedian(_residual(cut, system.mean(points), left))
    scale = np.sqrt(variance * max(1.0, float(np.nan_to_num(misfit))))

    def surprise(stepped: tuple[float, float]) -> float:
        system, points, left = tried[stepped]
        return system.surprise(left, scale, points)

    return min(tried, key=surprise)


def _by_mode(capture: LatticeCapture, light: NeighbourLight) -> np.ndarray:
    """Blocks (block, pixel, mode * band) of the light."""
    blocks = light.fine(capture.response)
    return blocks.reshape(*blocks.shape[:2], -1)


def _even_points(value: np.ndarray, light: NeighbourLight) -> np.ndarray:
    """Unknowns of fields that are as bright everywhere as their mean."""
    even = light.modes.even[:, None] * value[:, :, None]
    return even.reshape(*value.shape[:2], -1)


def _liveliest(value: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the PART lenslets a side that differ most from those beside them."""
    power = np.zeros(value.shape[:2])
    power[1:] += (np.diff(value, axis=0) ** 2).sum(axis=-1)
    power[:, 1:] += (np.diff(value, axis=1) ** 2).sum(axis=-1)
    starts = [sorted({*range(0, n - PART, PART), max(n - PART, 0)}) for n in value.shape[:2]]
    parts = [(slice(r, r + PART), slice(c, c + PART)) for r in starts[0] for c in starts[1]]
    return max(parts, key=lambda part: power[part].sum())


def neighbour_part(answer: LatticeAnswer, response: np.ndarray) -> np.ndarray:
    """What the neighbours' being other than a lenslet adds to its superpixel, (lenslet_row,
    lenslet_column, pixel): without it a capture is as if all were alike.
    """
    system = answer.system
    return system.forward(answer.points) - answer.value @ np.nan_to_num(response).T


def _coupled_system(capture: LatticeCapture, light: NeighbourLight) -> LatticeSystem:
    start = capture.first()
    return LatticeSystem(
        light.coupled(capture.response),
        light.offsets,
        _stationary(capture, start),
        start.shape[:2],
    )


def _stationary(capture: LatticeCapture, radiance: np.ndarray) -> np.ndarray:
    """Variance (pixel,) at the mean radiance, inf where F is not known."""
    variance = capture.variance(radiance.mean(axis=(0, 1)))
    return np.where(np.isfinite(capture.response).all(axis=-1), variance, np.inf)


def _solved(system: LatticeSystem, capture: LatticeCapture, points: np.ndarray) -> np.ndarray:
    """Unknowns, from a guess."""
    values = np.where(np.isfinite(capture.response).all(axis=-1), capture.values, 0)
    return system.solved(values, points, capture.own)


def _left(system: LatticeSystem, capture: LatticeCapture, points: np.ndarray) -> np.ndarray:
    """What unknowns leave of the superpixels, 0 where nothing is known."""
    left = capture.values - system.forward(points)
    if capture.own is not None:
        left -= capture.own(system.mean(points))
    return np.where(np.isfinite(left) & capture.known, left, 0)


def _answered(
    system: LatticeSystem,
    capture: LatticeCapture,
    start: np.ndarray,
    light: NeighbourLight,
    keeper: Keeper,
) -> LatticeAnswer:
    """The answer from a guess, or from its solution if an earlier run left that."""
    points = kept(keeper, "points", lambda: (_solved(system, capture, start),))[0]
    points = points.astype(np.float32, copy=False)
    return _answer(system, capture, points, _left(system, capture, points), light)


def _answer(
    system: LatticeSystem,
    capture: LatticeCapture,
    points: np.ndarray,
    left: np.ndarray,
    light: NeighbourLight,
) -> LatticeAnswer:
    value = system.mean(points)
    count, bands = capture.known.sum(axis=-1), value.shape[-1]
    residual = _residual(capture, value, left)
    # fewer pixels tell less
    share = capture.response.shape[0] / np.where(count > bands, count, np.nan)
    power = _error_power(system, capture, value) * share[..., None]
    power *= max(1.0, float(np.nanmedian(residual)))
    taken_off = np.nan_to_num(value - capture.start)
    wrong = KNOWN_TO**2 * OF_LIGHT / np.maximum(light.share, OF_LIGHT)
    power += wrong * (taken_off**2).mean(axis=(0, 1))
    return LatticeAnswer(
        value=value,
        sigma=np.sqrt(power),
        points=points,
        residual=residual,
        left=left,
        system=system,
        light=light,
    )


def _residual(capture: LatticeCapture, value: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Mean square (lenslet_row, lenslet_column) of what is left over the expected one."""
    known = capture.known
    count, bands = known.sum(axis=-1), value.shape[-1]
    freedom = np.where(count > bands, count - bands, np.nan)
    expected = capture.variance(value)
    return np.asarray(np.where(known, left**2 / expected, 0).sum(axis=-1) / freedom)


def _error_power(system: LatticeSystem, capture: LatticeCapture, value: np.ndarray) -> np.ndarray:
    """Variance of each answer: the noise of all pixels that it is made of at their own light, and
    what a prior leaves.
    """
    where, h, posterior = system.impulse
    squared, radiance = h**2, np.clip(value, 0, None)
    f, noise = np.nan_to_num(capture.response), capture.noise
    reach = np.abs(where).max()
    wide = np.pad(radiance, [(reach, reach), (reach, reach), (0, 0)], mode="symmetric")
    rows, columns = value.shape[:2]
    dark = float(np.asarray(noise.variance(np.zeros(1)))[0])
    out = np.zeros_like(value)
    for (down, across), part in zip(where, squared):
        top, left = reach + down, reach + across
        light = wide[top : top + rows, left : left + columns]
        out += noise.gain * light @ (part @ f).T + dark * part.sum(axis=-1)
    if capture.response_variance is not None and not capture.ratio:
        own = squared[(where == 0).all(axis=1)][0] @ np.nan_to_num(capture.response_variance)
        out += radiance**2 @ own.T
    v = _stationary(capture, value)
    stationary = (squared * np.where(np.isfinite(v), v, 0)).sum(axis=(0, 2))
    return out + np.maximum(posterior - stationary, 0)


def _change_step(
    system: LatticeSystem,
    capture: LatticeCapture,
    light: NeighbourLight,
    points: np.ndarray,
    left: np.ndarray,
    amounts: np.ndarray,
) -> np.ndarray:
    """Gauss-Newton step (change,) of the amounts by which light is changed; drawn to none where the
    capture tells little.
    """
    normal, right = _directions(
        system, capture, points, left, light.coupled_changes(), light.offsets
    )
    return np.linalg.solve(normal + np.eye(len(normal)), right - amounts)


def shift_step(capture: LatticeCapture, answer: LatticeAnswer, slopes: np.ndarray) -> np.ndarray:
    """Gauss-Newton step (rows, columns) px of the superpixels' displacement.

    slopes: (2, pixel, band), of F by displacement, per px.
    """
    own = np.zeros((1, 2), int)
    normal, right = _directions(
        answer.system, capture, answer.points, answer.left, slopes[:, None], own
    )
    return np.linalg.lstsq(normal, right, rcond=1e-9)[0]


def _directions(
    system: LatticeSystem,
    capture: LatticeCapture,
    points: np.ndarray,
    left: np.ndarray,
    directions: np.ndarray,
    offsets: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of amounts of directions (direction, block, pixel, unknown) in which blocks
    may be changed, radiances eliminated.
    """
    variance = _stationary(capture, points)
    seen, lines = np.ones(len(variance)), []
    weight = (capture.known / np.sqrt(variance)).astype(np.float32)
    for blocks in directions:
        change = LatticeSystem(blocks, offsets, seen, system.shape).forward(points)
        change *= capture.known
        change -= system.forward(system.answered(change))
        lines.append((change * weight).ravel())
    j, rest = np.array(lines), (left * weight).ravel()
    chi = max(1.0, float(rest @ rest) / max(int(np.count_nonzero(weight)), 1))
    return (j @ j.T / chi).astype(float), (j @ rest / chi).astype(float)


def _prior(first: LatticeAnswer) -> PointPrior:
    """Of object points, from the radiances of lenslets: their mean, the covariance of bands, and
    how alike neighbouring lenslets are.
    """
    value = first.value
    mean = value.mean(axis=(0, 1))
    apart = value - mean
    flat = apart.reshape(-1, value.shape[-1])
    noise = np.nan_to_num(first.sigma).reshape(flat.shape) ** 2
    covariance = flat.T @ flat / len(flat) - np.diag(noise.mean(axis=0))
    power = (apart**2).mean() or 1.0
    lag = np.concatenate([(apart[1:] * apart[:-1]).ravel(), (apart[:, 1:] * apart[:, :-1]).ravel()])
    alike = np.clip(lag.mean() / power if lag.size else 0, LEAST_CORRELATION, MOST_CORRELATION)
    size, basis = np.linalg.eigh(covariance)
    size = np.maximum(size, max(1e-4 * size.max(), noise.mean() * 0.01, 1e-12))
    return PointPrior(
        mean=mean,
        inverse=basis @ np.diag(1 / size) @ basis.T,
        rho=float(alike),
        modes=first.light.modes,
    )
