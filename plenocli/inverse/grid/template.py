"""Sub-pixel places of superpixels by least squares on their common look: an empirical
template, fitted robustly.

A centroid is moved by dust, by a neighbour that is missing and by noise far from the edges; a fit
of the mean superpixel is not, since pixels that do not follow it lose their weight, and edges count
as much as they tell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

REACH = 0.56  # of the pitch: radius of the window
PHASES = 8  # sub-pixel phases an axis, at which the template is tabled; the rest is first order
SIZE = 24  # px: larger superpixels are shrunk by whole block means to below twice this
# px^2 of that smoothing: it moves a spot under uneven light by VARIANCE times the relative
# slope, towards the dark
VARIANCE = 0.5
# share of a tilt that is no shift, below which the two are not told apart: bells have 0.03,
# discs 0.4 and more
DEGENERATE = 0.1
SMOOTHING = 0.8  # px: sampled discs and edges are aliased beyond


@dataclass(frozen=True, kw_only=True)
class _Patch:
    """What counts of a patch of P x P pixels around a superpixel.

    half: px from its middle to its edge.
    pixels: (K, 2) px from the middle, which count.
    taper: (K,), how much.
    spline: interpolation of P samples (a spline with P values).
    place: (P, P, 2) px, of all pixels.
    owner: (P, P, 2) px, of the superpixel that they belong to.
    """

    half: int
    pixels: np.ndarray
    taper: np.ndarray
    spline: Callable[..., np.ndarray]
    place: np.ndarray
    owner: np.ndarray

    @property
    def flat(self) -> np.ndarray:
        return np.ravel_multi_index(tuple(self.pixels.T + self.half), (2 * self.half + 1,) * 2)

    def shifted(self, by: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Matrices (N, P, P) that take P samples to their values, or slopes, at places
        moved `by` (N,) px.
        """
        reach = np.arange(-self.half, self.half + 1.0)
        return self.spline(np.clip(reach + by[:, None], -self.half, self.half), derivative).astype(
            np.float32
        )

    @property
    def arms(self) -> np.ndarray:
        """(P, P, 2) px, of each pixel from the middle of the superpixel that it belongs to."""
        return (self.place - self.owner).astype(np.float32)

    def lever(self, share: float) -> np.ndarray:
        """Arms (P, P, 2), px, on which the illumination's slope acts: see `register`."""
        return (share * self.place + (1 - share) * self.owner).astype(np.float32)


def register(
    image: np.ndarray,
    centres: np.ndarray,
    basis: np.ndarray,
    slope: np.ndarray | None = None,
    symmetric: bool = True,
    share: float | None = None,
    tilted: bool = False,
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Places of superpixels by a fit of their common look.

    Each patch is a * template(r - shift) + b under light that changes by `slope`: a share of it
    continuously, the rest from one superpixel to the next (a lenslet dimmed as a whole).
    image: (row, column).
    centres: (N, 2) px, near those of whole cells.
    basis: (2, 2) px, the lattice, which says whose light a pixel shows.
    slope: (N, 2), of the light, relative per px; None: none.
    symmetric: superpixels have a centre, that of the template's point symmetry; otherwise
        (superpixels of several parts) the median shift is zero: the phase stays that of `centres`.
    share: of the light's slope that is continuous, 0 to 1; None: what the pixels say, 1 where they
        say nothing.
    tilted: light falls off within each superpixel by a slope of its own, as in captures of a scene;
        then edges alone tell places.

    Returns positions (N, 2) px, quality (N,), the share of a patch's pixels that follow the
    template, and whether the share is known: given, or said by the pixels.
    """
    pitch = np.hypot(*np.asarray(basis).T).min()
    shrink = max(1, int(pitch // SIZE))
    small = _block_means(np.asarray(image, np.float32), shrink)
    place = (np.asarray(centres, float) - (shrink - 1) / 2) / shrink
    slope = np.zeros_like(place) if slope is None else slope * shrink
    window = _make_patch(np.asarray(basis) / shrink)
    told, said, quality = share is not None, share, np.ones(len(place))
    share = 1.0 if said is None else said
    first = place.copy()
    for turn in range(2):
        if turn == 1:  # edges sharper than two pixels cannot be interpolated
            small = smoothed(small)
        template = _template(small, place, slope, window.lever(share), quality, window)
        bank = _bank(template, window, tilted=tilted)
        spread = _usual_miss(small, place, slope, window.lever(share), bank, window)
        if turn == 0 and not told and not tilted:
            said = _share_within(small, place, slope, bank, spread, window)
            share = 1.0 if said is None else said
        place, quality = _fit_all(small, place, slope, window.lever(share), bank, spread, window)
        place = place + (
            _centre(template, window, tilted=tilted)
            if symmetric
            else -np.median(place - first, axis=0)
        )
    place = place + share * VARIANCE * slope
    return place * shrink + (shrink - 1) / 2, quality, said is not None


def _block_means(image: np.ndarray, shrink: int) -> np.ndarray:
    rows, columns = (n // shrink for n in image.shape)
    return np.ascontiguousarray(
        image[: rows * shrink, : columns * shrink]
        .reshape(rows, shrink, columns, shrink)
        .mean(axis=(1, 3))
    )


def smoothed(image: np.ndarray) -> np.ndarray:
    """(1 2 1)/4 smoothing of `image` (rows, columns) along both axes: a pattern of period
    two vanishes exactly.
    """
    for axis in (0, 1):
        image = np.moveaxis(image, axis, 0)
        out = 0.5 * image
        out[1:] += 0.25 * image[:-1]
        out[:-1] += 0.25 * image[1:]
        out[0] += 0.25 * image[0]
        out[-1] += 0.25 * image[-1]
        image = np.moveaxis(out, 0, axis)
    return np.ascontiguousarray(image)


def _make_patch(basis: np.ndarray) -> _Patch:
    """What counts of a patch for a lattice in (shrunk) px.

    Shifting is cubic spline interpolation, a matrix per phase.
    """
    from scipy.interpolate import make_interp_spline

    pitch = np.hypot(*basis.T).min()
    half = int(np.ceil(REACH * pitch)) + 3
    reach = np.arange(-half, half + 1.0)
    unit = make_interp_spline(reach, np.eye(len(reach)), k=3)
    place = np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1)
    sites = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 2), axis=-1).reshape(-1, 2) @ basis
    owner = sites[np.argmin(((place[:, :, None] - sites) ** 2).sum(axis=-1), axis=-1)]
    pixels = np.argwhere(np.hypot(*np.moveaxis(place, -1, 0)) < REACH * pitch) - half
    taper = np.clip((1 - np.hypot(*pixels.T) / (REACH * pitch)) / 0.2, 0, 1)
    return _Patch(
        half=half,
        pixels=pixels,
        taper=taper.astype(np.float32),
        spline=unit,
        place=place,
        owner=owner,
    )


def _centre(template: np.ndarray, window: _Patch, *, tilted: bool) -> np.ndarray:
    """Centre (2,), px, of the template: about which it, smoothed as far as its sampling demands,
    is best its own point reflection, but for a slope of its light if it may be `tilted`.
    """
    from scipy.ndimage import gaussian_filter, shift

    weight, centre = np.zeros(template.size), np.zeros(2)
    weight[window.flat] = window.taper
    smooth = gaussian_filter(template.astype(float), SMOOTHING, mode="nearest")
    for _ in range(3):
        here = shift(smooth, -centre, mode="nearest")
        even, odd = (here + here[::-1, ::-1]) / 2, (here - here[::-1, ::-1]) / 2
        columns = np.stack([-g.ravel() for g in np.gradient(even)])
        if tilted:
            columns = np.concatenate([columns, even.ravel() * window.arms.reshape(-1, 2).T])
        heavy = columns * weight
        step = np.linalg.lstsq(heavy @ columns.T, heavy @ odd.ravel(), rcond=1e-6)[0]
        centre = centre + step[:2]
    return centre


def _bank(template: np.ndarray, window: _Patch, *, tilted: bool = False) -> np.ndarray:
    """The template at all sub-pixel phases: columns (PHASES^2, 4 or 6, K) template, minus
    its gradient, one, and if `tilted` the template times both arms.
    """
    phases = (np.arange(PHASES) + 0.5) / PHASES - 0.5
    back = window.shifted(-phases), window.shifted(-phases, 1)
    down, right = back[0] @ template, back[1] @ template
    columns = [
        np.einsum("apq,brq->abpr", a, b, optimize=True)
        for a, b in ((down, back[0]), (-right, back[0]), (-down, back[1]))
    ]
    columns = [c.reshape(PHASES**2, -1)[:, window.flat] for c in columns]
    slopes = [columns[0] * arm for arm in window.arms.reshape(-1, 2)[window.flat].T]
    return np.stack([*columns, np.ones_like(columns[0]), *(slopes if tilted else [])], axis=1)


def _groups(
    place: np.ndarray, most: int
) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """Sites that share a sub-pixel phase, at most `most` at a time: (phase number, phase (2,)
    px, sites, their pixels (n, 2)).
    """
    pixel = np.rint(place).astype(int)
    step = np.clip(np.floor((place - pixel + 0.5) * PHASES).astype(int), 0, PHASES - 1)
    number = step @ (PHASES, 1)
    order = np.argsort(number, kind="stable")
    for sites in np.split(order, np.flatnonzero(np.diff(number[order])) + 1):
        for start in range(0, len(sites), most):
            part = sites[start : start + most]
            yield number[part[0]], (step[part[0]] + 0.5) / PHASES - 0.5, part, pixel[part]


def _patches(
    image: np.ndarray, pixel: np.ndarray, slope: np.ndarray, lever: np.ndarray, window: _Patch
) -> tuple[np.ndarray, np.ndarray | bool]:
    """Pixels (N, K) around `pixel` with the illumination divided out, and which (N, K) lie in
    the frame; lever (P, P, 2) px.
    """
    rows, columns = image.shape
    low, high = pixel.min(axis=0) - window.half, pixel.max(axis=0) + window.half
    whole = (low >= 0).all() and (high < image.shape).all()
    where = (pixel @ (columns, 1))[:, None] + window.pixels @ (columns, 1)
    inside = True
    if not whole:
        y, x = (pixel[:, axis, None] + window.pixels[:, axis] for axis in (0, 1))
        inside = (y >= 0) & (y < rows) & (x >= 0) & (x < columns)
        where = np.where(inside, where, 0)
    patch = image.ravel()[where]
    if slope.any():
        patch /= np.maximum(
            1 + slope.astype(np.float32) @ lever.reshape(-1, 2)[window.flat].T, np.float32(0.2)
        )
    return patch, inside


def _sample(
    place: np.ndarray, shape: tuple[int, ...], half: int, quality: np.ndarray, most: int
) -> np.ndarray:
    """Up to `most` sites, evenly taken, whose patch lies in the frame (or else any) and
    follows the template.
    """
    good = (np.rint(place) >= half).all(axis=1) & (np.rint(place) + half < np.array(shape)).all(
        axis=1
    )
    good &= quality >= np.median(quality) - 0.05
    chosen = np.flatnonzero(good) if good.sum() >= 9 else np.arange(len(place))
    return chosen[:: max(1, -(-len(chosen) // most))]


def _template(
    image: np.ndarray,
    place: np.ndarray,
    slope: np.ndarray,
    lever: np.ndarray,
    quality: np.ndarray,
    window: _Patch,
) -> np.ndarray:
    """Mean look (P, P) of a superpixel of unit level: the mean of the middle half of all
    patches, shifted to their centres.
    """
    chosen = _sample(place, image.shape, window.half, quality, 600)
    pixel = np.rint(place[chosen]).astype(int)
    reach = np.arange(-window.half, window.half + 1)
    line = [np.clip(pixel[:, axis, None] + reach, 0, image.shape[axis] - 1) for axis in (0, 1)]
    patch = image[line[0][:, :, None], line[1][:, None, :]]
    patch /= np.maximum(
        1 + np.einsum("nd,yxd->nyx", slope[chosen].astype(np.float32), lever), np.float32(0.2)
    )
    level = patch.reshape(len(patch), -1)[:, window.flat].mean(axis=1)
    patch /= np.maximum(level, 1e-20)[:, None, None]
    phase = (place[chosen] - pixel).T
    there, back = (
        [window.shifted(sign * phase[0]), window.shifted(sign * phase[1]).transpose(0, 2, 1)]
        for sign in (1, -1)
    )
    mean: np.ndarray = np.zeros((), patch.dtype)
    quarter = len(patch) // 4
    for turn in range(3):  # interpolation blurs: what is left of the patches, moved back, is put in
        rest = patch if turn == 0 else patch - back[0] @ mean @ back[1]
        mean = mean + np.sort(there[0] @ rest @ there[1], axis=0)[
            quarter : len(patch) - quarter
        ].mean(axis=0)
    return mean


def _solve(
    columns: np.ndarray, patch: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted least squares of patches (N, K) on columns (C, K): coefficients (N, C) and normal
    matrices (N, C, C).
    """
    count = len(columns)
    i, j = np.triu_indices(count)
    normal = np.empty((len(patch), count, count))
    normal[:, i, j] = normal[:, j, i] = weight @ (columns[i] * columns[j]).T
    right = (weight * patch) @ columns.T
    normal += 1e-7 * np.einsum("nii->ni", normal)[:, :, None] * np.eye(count) + 1e-30 * np.eye(
        count
    )
    return np.linalg.solve(normal, right[..., None].astype(float))[..., 0], normal


def _trust(
    fit: np.ndarray, columns: np.ndarray, patch: np.ndarray, spread: np.ndarray
) -> np.ndarray:
    """Tukey weights (N, K) of pixels by their miss from the fit, six times the usual one
    being worth nothing.
    """
    miss = patch - fit.astype(np.float32) @ columns
    miss /= spread
    miss *= (1 / (6 * np.maximum(fit[:, :1], 1e-9))).astype(np.float32)
    np.clip(miss, -1, 1, out=miss)
    np.multiply(miss, miss, out=miss)
    np.subtract(1, miss, out=miss)
    return np.multiply(miss, miss, out=miss)


def _usual_miss(
    image: np.ndarray,
    place: np.ndarray,
    slope: np.ndarray,
    lever: np.ndarray,
    bank: np.ndarray,
    window: _Patch,
) -> np.ndarray:
    """Usual miss (K,) of a patch of unit level from the template, pixel by pixel: noise and what
    varies from one to the next.
    """
    chosen = _sample(place, image.shape, window.half, np.ones(len(place)), 600)
    misses = []
    for number, _, sites, pixel in _groups(place[chosen], 4096):
        patch, inside = _patches(image, pixel, slope[chosen[sites]], lever, window)
        fit, _ = _solve(bank[number], patch, np.broadcast_to(inside * window.taper, patch.shape))
        misses.append(
            np.abs(patch - fit.astype(np.float32) @ bank[number]) / np.maximum(fit[:, :1], 1e-20)
        )
    spread = 1.48 * np.median(np.concatenate(misses), axis=0)
    return np.maximum(spread, 0.3 * np.percentile(spread, 90) + 1e-9).astype(np.float32)


def _fit_all(
    image: np.ndarray,
    place: np.ndarray,
    slope: np.ndarray,
    lever: np.ndarray,
    bank: np.ndarray,
    spread: np.ndarray,
    window: _Patch,
    iterations: int = 4,
) -> tuple[np.ndarray, np.ndarray]:
    """New places (N, 2) and the share (N,) of pixels that follow the template: Tukey weights,
    from where the lattice expects each.
    """
    out, quality = np.empty_like(place), np.empty(len(place))
    for number, phase, sites, pixel in _groups(place, 1 + 400_000 // len(spread)):
        columns = bank[number]
        patch, inside = _patches(image, pixel, slope[sites], lever, window)
        base = np.broadcast_to(inside * (window.taper / spread**2), patch.shape)
        level, _ = _solve(columns[[0, 3]], patch, base)
        fit = np.zeros((len(sites), len(columns)))
        fit[:, [0, 3]] = level
        for _ in range(iterations):
            trust = _trust(fit, columns, patch, spread)
            fit, _ = _solve(columns, patch, base * trust)
        quality[sites] = ((trust > 0.25) & (base > 0)).sum(axis=1) / np.maximum(
            (base > 0).sum(axis=1), 1
        )
        shift = fit[:, 1:3] / np.where(fit[:, :1] > 0, fit[:, :1], np.inf)
        out[sites] = pixel + phase + np.clip(shift, -2, 2)
    return out, quality


def _share_within(
    image: np.ndarray,
    place: np.ndarray,
    slope: np.ndarray,
    bank: np.ndarray,
    spread: np.ndarray,
    window: _Patch,
) -> float | None:
    """How much (0..1) of the illumination's gradient across lenslets also holds
    within a superpixel.

    Light that falls off continuously over the sensor has it all, a vignetting that dims whole
    superpixels none. Fitted to the pixels of all sites together, beside the shift of each. Where
    these cannot tell (a tilted bell is a moved one: nearly nothing of the tilt is left beside the
    shift) it is None.
    """
    chosen = _sample(place, image.shape, window.half, np.ones(len(place)), 2000)
    whole = window.lever(0)
    arms = window.arms.reshape(-1, 2)[window.flat].T
    value, trust, total = [], [], []
    for number, _, sites, pixel in _groups(place[chosen], 1 + 400_000 // len(spread)):
        tilt = slope[chosen[sites]]
        patch, inside = _patches(image, pixel, tilt, whole, window)
        columns = np.concatenate([bank[number], bank[number][0] * arms])
        base = np.broadcast_to(inside * (window.taper / spread**2), patch.shape)
        fit, _ = _solve(columns, patch, base)
        weight = base * _trust(fit, columns, patch, spread)
        fit, normal = _solve(columns, patch, weight)
        level = np.maximum(fit[:, 0], 1e-9)
        # the tilt's column, with all columns
        joint = np.einsum("nij,nj->ni", normal[:, :, 4:], tilt)
        own = np.einsum("ni,ni->n", joint[:, 4:], tilt)
        beside = np.linalg.solve(normal[:, :4, :4], joint[:, :4, None])[..., 0]
        right = (weight * patch) @ columns.T
        value.append(
            (
                np.einsum("ni,ni->n", right[:, 4:], tilt)
                - np.einsum("ni,ni->n", right[:, :4], beside)
            )
            / level
        )
        trust.append(own - np.einsum("ni,ni->n", joint[:, :4], beside))
        total.append(own)
    values, trusts, totals = (np.concatenate(x) for x in (value, trust, total))
    if trusts.sum() <= DEGENERATE * totals.sum():
        return None
    return float(np.clip((values.sum() + 1.0) / (trusts.sum() + 1.0), 0, 1))  # 1: a prior of 1 +- 1
