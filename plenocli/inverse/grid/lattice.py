"""Two-dimensional point lattices: the basis seen in an autocorrelation, reduced bases,
indexing, array order.

Vectors are (row, column) in pixels. A basis is a (2, 2) array whose first vector points down the
picture and whose second points right; a site (m, n) lies at origin + m * basis[0] + n * basis[1].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

SMALLEST_PITCH, LARGEST_PITCH = 4.5, 330.0
AS_WELL, WELL = 0.93, 0.8
"""Of the correlation at a lattice's points, from which on points half way are points of it, and
where that makes a hexagonal one of a rectangular one.
"""
SQUARE_STEPS = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
HEXAGONAL_STEPS = np.array([(1, 0), (-1, 0), (0, 1), (0, -1), (1, -1), (-1, 1)])


def autocorrelation(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Autocorrelation of an image after removal of a quadratic trend, 1 at zero lag.

    The image is tapered (Hann) and every lag is divided by the taper's own overlap, so that peaks
    of a periodic image keep their height. Unlike a Fourier peak, an autocorrelation peak does not
    vanish where the form factor of a single lenslet has a zero.
    image: (row, column).

    Returns the correlation (lag, lag) and the overlap, zero lag in the middle, lags up to half the
    image.
    """
    from scipy import fft

    rows, columns = image.shape
    flat = image - _quadratic_trend(image)
    taper = np.hanning(rows + 2)[1:-1, None] * np.hanning(columns + 2)[None, 1:-1]
    shape = [fft.next_fast_len(int(1.5 * n) + 1, real=True) for n in (rows, columns)]

    def correlate(x: np.ndarray) -> np.ndarray:
        spectrum = fft.rfft2(x, shape)
        return fft.irfft2(spectrum.real**2 + spectrum.imag**2, shape)

    half = (rows // 2, columns // 2)
    overlap = _centre(correlate(taper.astype(np.float32)), half)
    value = _centre(correlate((flat * taper).astype(np.float32)), half)
    value = value / np.maximum(overlap, 1e-3 * overlap.max())
    peak = value[half]
    return (value / peak if peak > 0 else value * 0), overlap / overlap.max()


@dataclass(frozen=True)
class Periodicity:
    """How an image repeats.

    basis: (2, 2) px, the two shortest independent vectors; None: there is no lattice of peaks.
    structure: the correlation half a step away relative to a whole step: above about 0.3 the
        superpixels hold several bright parts (filters in the pupil) rather than one spot.
    strength: correlation at the strongest repeat.
    reason: why there is no lattice, in words.
    """

    basis: np.ndarray | None = None
    structure: float = 0.0
    strength: float = 0.0
    reason: str = ""


def find_basis(image: np.ndarray) -> Periodicity:
    """The two shortest independent vectors of the lattice in an image, by its autocorrelation; the
    search covers lags of 4.5 to 330 px that fit into 0.48 of the image.

    image: (row, column).
    """
    from scipy import ndimage

    value, overlap = autocorrelation(image)
    centre = np.array(value.shape) // 2
    lag = np.indices(value.shape) - centre[:, None, None]
    radius = np.hypot(*lag)
    ring = _first_negative_ring(value, radius)
    if ring is None:
        return Periodicity(
            reason="its autocorrelation never turns negative (no repeating structure)"
        )
    smooth = ndimage.gaussian_filter(value, max(0.6, 0.2 * ring))
    reach = min(LARGEST_PITCH * 2.1, 0.96 * min(centre))
    size = int(max(3, 2 * (ring // 2) + 1))
    peak = (smooth == ndimage.maximum_filter(smooth, size)) & (
        radius > max(SMALLEST_PITCH, 1.2 * ring)
    )
    peak &= (radius < reach) & (overlap > 0.05) & ((lag[0] > 0) | ((lag[0] == 0) & (lag[1] > 0)))
    where = np.argwhere(peak)
    if len(where) < 2:
        return Periodicity(reason="its autocorrelation has no second peak")
    height = smooth[tuple(where.T)]
    strength = float(height.max())
    if strength < 0.03:
        return Periodicity(reason=f"the strongest repeat correlates by only {strength:.3f} (noise)")
    # parts of a superpixel repeat too, but less well
    strong = where[height > 0.85 * strength] - centre
    strong = strong[np.argsort(np.hypot(*strong.T))]
    first = strong[0]
    sine = (
        np.abs(first[0] * strong[:, 1] - first[1] * strong[:, 0])
        / np.hypot(*first)
        / np.hypot(*strong.T)
    )
    rest = strong[sine > 0.4]
    if not len(rest) or np.hypot(*rest[0]) > 2.1 * np.hypot(*first):
        return Periodicity(reason="it repeats in one direction only")
    basis = _refine_basis(smooth, centre, reduced(np.array([first, rest[0]], float)))
    basis = _with_halves(smooth, centre, reduced(basis), max(SMALLEST_PITCH, 1.2 * ring))
    half = np.rint(centre + 0.5 * np.array([basis[0], basis[1], basis[0] + basis[1]])).astype(int)
    return Periodicity(basis, float(smooth[tuple(half.T)].max()) / strength, strength)


def reduced(basis: np.ndarray) -> np.ndarray:
    """Gauss-Lagrange reduction of a basis (2, 2): the shortest pair, at an angle of 60 to 90
    degrees.
    """
    a, b = np.array(basis, float)
    for _ in range(50):
        if a @ a > b @ b:
            a, b = b, a
        k = np.rint(a @ b / (a @ a))
        if k == 0:
            break
        b = b - k * a
    return np.array([a, b if a @ b >= 0 else -b])


def kind_of(basis: np.ndarray) -> str:
    """ "square" or "hexagonal": whichever the reduced `basis` is nearer to in angle
    and in side ratio.
    """
    a, b = reduced(basis)
    cosine = a @ b / np.sqrt((a @ a) * (b @ b))
    ratio = np.sqrt((a @ a) / (b @ b))
    # A hexagonal lattice has cosine 1/2; a square or rectangular one 0. A stretched
    # hexagonal one keeps both.
    return "hexagonal" if cosine > 0.25 and ratio > 0.7 else "square"


def oriented(basis: np.ndarray, kind: str) -> np.ndarray:
    """The basis in the order of the picture: [down, right], right being the short vector nearest to
    the +column axis.

    On a hexagonal lattice `down` makes 60 degrees with `right` (towards the next column).
    basis: (2, 2) px.
    kind: "square" or "hexagonal".
    """
    a, b = reduced(basis)
    shortest = [a, b, a - b] if kind == "hexagonal" else [a, b]
    short = np.array(shortest + [-v for v in shortest])
    right = short[np.argmax(short[:, 1] / np.hypot(*short.T))]
    turn = np.degrees(np.arctan2(short[:, 0], short[:, 1]) - np.arctan2(*right))
    wanted = 60.0 if kind == "hexagonal" else 90.0
    off = np.abs((turn - wanted + 180) % 360 - 180)
    return np.array([short[np.argmin(off)], right])


def index_sites(
    spots: np.ndarray, basis: np.ndarray, kind: str, start: int, gate: float = 0.28
) -> tuple[np.ndarray, np.ndarray]:
    """Number spots by walking outwards from one of them, one lattice step at a time. Every site
    passes its own slowly adapted basis on, so perspective and distortion do not add up.

    spots: (N, 2) px.
    basis: (2, 2) px as `oriented`.
    kind: "square" or "hexagonal".
    start: number of the first spot.
    gate: largest miss of a prediction, in pitches.

    Returns index (N, 2) int and found (N,) bool.
    """
    from scipy.spatial import cKDTree

    tree, count = cKDTree(spots), len(spots)
    steps = HEXAGONAL_STEPS if kind == "hexagonal" else SQUARE_STEPS
    pitch = np.hypot(*basis.T).min()
    index, found = np.zeros((count, 2), int), np.zeros(count, bool)
    local = np.broadcast_to(basis, (count, 2, 2)).copy()
    half = int(2.5 * np.ptp(spots, axis=0).max() / pitch) + 8
    taken = np.zeros((2 * half + 1, 2 * half + 1), bool)
    front = np.array([start])
    found[start], taken[half, half] = True, True
    while front.size:
        origin = np.repeat(front, len(steps))
        step = np.tile(steps, (len(front), 1))
        site = index[origin] + step
        guess = spots[origin] + np.einsum("ks,ksd->kd", step, local[origin])
        miss, hit = tree.query(guess, distance_upper_bound=gate * pitch)
        good = (hit < count) & (np.abs(site) < half).all(axis=1)
        good[good] &= ~found[hit[good]] & ~taken[tuple((site[good] + half).T)]
        order = np.flatnonzero(good)[np.argsort(miss[good], kind="stable")]
        order = order[np.sort(np.unique(hit[order], return_index=True)[1])]
        key = (site[order, 0] + half) * (2 * half + 1) + site[order, 1] + half
        order = order[np.sort(np.unique(key, return_index=True)[1])]
        front = hit[order]
        index[front], found[front] = site[order], True
        taken[tuple((site[order] + half).T)] = True
        error = spots[front] - guess[order]
        weight = step[order] / (step[order] ** 2).sum(axis=1, keepdims=True)
        local[front] = local[origin[order]] + 0.3 * weight[:, :, None] * error[:, None, :]
    return index, found


def surrounded(index: np.ndarray, kind: str) -> np.ndarray:
    """Which (N,) of the sites `index` (N, 2) have all neighbours, 6 on a hexagonal and 8 on a
    square lattice, among them.
    """
    return _neighbours(index, np.ones(len(index), bool), kind) == len(_ring(kind))


def enclosed(there: np.ndarray, possible: np.ndarray, index: np.ndarray, kind: str) -> np.ndarray:
    """Sites of which three quarters of their possible neighbours are there.

    there, possible: (lenslet_row, lenslet_column) bool.
    index: (lenslet_row, lenslet_column, 2).
    kind: "square" or "hexagonal".

    Returns which of the possible ones, (lenslet_row, lenslet_column).
    """
    have, could = (
        _neighbours(index.reshape(-1, 2), x.ravel(), kind).reshape(there.shape)
        for x in (there, possible)
    )
    return possible & (have >= 0.75 * could) & (have >= 2)


def _ring(kind: str) -> np.ndarray:
    return (
        HEXAGONAL_STEPS
        if kind == "hexagonal"
        else np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
    )


def _neighbours(index: np.ndarray, there: np.ndarray, kind: str) -> np.ndarray:
    """How many (N,) neighbours of each site are `there` (N,)."""
    site = index - index.min(axis=0) + 1
    taken = np.zeros(site.max(axis=0) + 2, int)
    taken[tuple(site.T)] = there
    return sum(taken[tuple((site + step).T)] for step in _ring(kind))


def to_array(index: np.ndarray, kind: str) -> np.ndarray:
    """(row, column) of the lenslet array for lattice indices (m, n): hexagonal rows stay
    upright (offset rows).
    """
    index = np.asarray(index)
    shift = index[..., 0] // 2 if kind == "hexagonal" else 0
    return np.stack([index[..., 0], index[..., 1] + shift], axis=-1)


def from_array(site: np.ndarray, kind: str) -> np.ndarray:
    """Inverse of `to_array`."""
    site = np.asarray(site)
    shift = site[..., 0] // 2 if kind == "hexagonal" else 0
    return np.stack([site[..., 0], site[..., 1] - shift], axis=-1)


def _quadratic_trend(image: np.ndarray) -> np.ndarray:
    """Least-squares quadratic surface, fitted on a coarse sub-sample."""
    y, x = (np.linspace(-1, 1, n) for n in image.shape)
    step = max(1, min(image.shape) // 128)
    basis = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
    ys, xs = np.meshgrid(y[::step], x[::step], indexing="ij")
    design = np.stack([ys.ravel() ** i * xs.ravel() ** j for i, j in basis], axis=1)
    fit = np.linalg.lstsq(design, image[::step, ::step].ravel().astype(float), rcond=None)[0]
    return sum(c * (y[:, None] ** i) * (x[None, :] ** j) for c, (i, j) in zip(fit, basis))


def _centre(value: np.ndarray, half: tuple[int, int]) -> np.ndarray:
    """Lags -half..half of a circular correlation, as one array with zero lag at index `half`."""
    rows = np.arange(-half[0], half[0] + 1)
    columns = np.arange(-half[1], half[1] + 1)
    return value[np.ix_(rows, columns)]


def _first_negative_ring(value: np.ndarray, radius: np.ndarray) -> int | None:
    """First radius, px, at which the mean over directions is negative: the end
    of the central peak.
    """
    whole = np.rint(radius).astype(int)
    limit = min(value.shape) // 2
    inside = whole <= limit
    mean = np.bincount(whole[inside], value[inside]) / np.bincount(whole[inside])
    negative = np.flatnonzero(mean[1:] < 0)
    return int(negative[0]) + 1 if negative.size else None


def _refine_basis(value: np.ndarray, centre: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Least squares of the basis on the sub-pixel peaks at combinations of up to six steps."""
    limit = 0.92 * centre
    for reach in (1, 2, 4, 6):
        steps = np.array(
            [(i, j) for i in range(reach + 1) for j in range(-reach, reach + 1) if i or j > 0]
        )
        lag = steps @ basis
        keep = (np.abs(lag) < limit - 3).all(axis=1)
        radius = 0.22 * np.hypot(*basis.T).min()
        peaks, used = [], []
        for step, guess in zip(steps[keep], lag[keep]):
            peak = _peak_near(value, centre + guess, radius)
            if peak is not None:
                peaks.append(peak - centre)
                used.append(step)
        if len(used) >= 3:
            basis = np.linalg.lstsq(np.array(used, float), np.array(peaks), rcond=None)[0]
    return basis


def _with_halves(
    value: np.ndarray, centre: np.ndarray, basis: np.ndarray, least: float
) -> np.ndarray:
    """The basis with the points half way between those of its lattice that correlate as well:
    narrow peaks, of thin lines, may be missed where they fall between samples. No vector is
    shorter than `least`, px.
    """
    steps = np.array(list(np.ndindex(5, 5))) - 2

    def height(offset: tuple[float, float]) -> float:
        """Mean height of the peaks near the lattice's points, so far aside."""
        at = (steps + offset) @ basis
        at = np.rint(at[(np.hypot(*at.T) > 1) & (np.abs(at) < centre - 2).all(axis=1)] + centre)
        near = at.astype(int)[:, None] + np.array(list(np.ndindex(3, 3))) - 1
        return float(value[near[..., 0], near[..., 1]].mean()) if len(at) else -1.0

    short, long = sorted(np.hypot(*basis.T))
    hexagonal = abs(long / short / math.sqrt(3) - 1) < 0.03  # with its middle, as no square is
    for offset in ((0.5, 0.5), (0.5, 0.0), (0.0, 0.5)):
        enough = WELL if hexagonal and min(offset) else AS_WELL
        if height(offset) > enough * height((0.0, 0.0)):
            halved = [(0.5, 0.5), (0.5, -0.5)] if min(offset) else np.eye(2) - np.diag(offset)
            finer = reduced(np.array(halved) @ basis)
            if np.hypot(*finer[0]) > least:
                return _with_halves(value, centre, finer, least)
    return basis


def _peak_near(value: np.ndarray, guess: np.ndarray, radius: float) -> np.ndarray | None:
    """Sub-pixel maximum of `value` within `radius` of `guess` (parabola through three samples
    an axis), or None.
    """
    low = np.maximum(np.ceil(guess - max(radius, 1.01)).astype(int), 1)
    high = np.minimum(np.floor(guess + max(radius, 1.01)).astype(int), np.array(value.shape) - 2)
    if (high <= low).any():
        return None
    window = value[low[0] : high[0] + 1, low[1] : high[1] + 1]
    i, j = np.unravel_index(np.argmax(window), window.shape) + low
    out = []
    for line, at in ((value[i - 1 : i + 2, j], i), (value[i, j - 1 : j + 2], j)):
        curvature = line[0] - 2 * line[1] + line[2]
        if curvature >= 0 or line[1] < line[0] or line[1] < line[2]:
            return None
        out.append(at + 0.5 * (line[0] - line[2]) / curvature)
    return np.array(out)
