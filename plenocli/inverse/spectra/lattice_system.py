"""Least squares over a lattice of lenslets that all answer alike: y_l = sum_o F_o b_(l-o) + noise.

With stationary weights 1/v the normal equations are a convolution, whose Fourier transform leaves
one small system for each frequency. What superpixels add to the unknowns fades within PAD lenslets,
so that one inverse, at the frequencies of a tile, serves all tiles of an array. Beyond the array
lenslets are taken to be mirrored. docs/model.md, section 9, "Neighbours".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from plenocli.inverse.spectra.field_modes import EVEN, FieldModes

PAD = 8
"""Lenslets on each side by which an unknown is told: what those further away add is 0.1 of its
standard deviation.
"""
TILE = 24
"""Lenslets a side, without their PAD, that are solved at a time, at most."""
IMPULSE = 16
"""Lenslets a side of the lattice on which what one pixel does to the answer is computed."""
FREQUENCY = 2 * np.pi * np.fft.fftfreq(IMPULSE)
"""Of that lattice, radians a lenslet."""
STEPS = 12
"""Of a solution, at most: the border and lost pixels take more than one."""
SETTLED, ENOUGH = 0.99, 0.05
"""Share of the answers, and standard deviations by which the last step may have moved them."""
REMEMBERED = 4
"""Steps from which the next is made longer or shorter."""
FAINT = 1e-4
"""Of the strongest direction of a superpixel, over the noise: fainter ones are not looked along."""
UNTOLD = 1e-3
"""Variance that a direction has beforehand, over the noise's, below which it tells nothing."""
EXACT = 24
"""Unknowns up to which the inverse is of double precision: without a prior there may be some that
light hardly tells apart.
"""


@dataclass(frozen=True, kw_only=True)
class PointPrior:
    """Values of object points that are alike where they are near: normal, of mean `mean` and
    covariance C rho^(fields apart down + across), or C rho^(lenslets apart) where they change from
    lenslet to lenslet alone.

    mean: (band,).
    inverse: (band, band), of C.
    rho: correlation of points a field apart.
    modes: of a field, which are known of them.
    stepped: share of the covariance down and across that is even within fields.
    """

    mean: np.ndarray
    inverse: np.ndarray
    rho: float
    modes: FieldModes = EVEN
    stepped: tuple[float, float] = (0.0, 0.0)

    @property
    def even(self) -> np.ndarray:
        """The mean of the unknowns (mode * band,)."""
        return np.outer(self.modes.even, self.mean).ravel()

    @property
    def spread(self) -> np.ndarray:
        """Standard deviations of the unknowns (mode * band,)."""
        near, even = np.diagonal(self._near()), self._level**2
        axes = [near + share * (even - near) for share in self.stepped]
        modes = axes[0][self.modes.kept[:, 0]] * axes[1][self.modes.kept[:, 1]]
        return np.sqrt(np.outer(modes, np.diagonal(np.linalg.inv(self.inverse)))).ravel()

    def precision(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Inverse covariance of modes at frequencies (n,) and (m,), radians a lenslet, all bands
        alike: (n, m, mode, mode) complex.
        """
        down, across = map(self._axis, (rows, columns), self.stepped)
        first, second = (np.ix_(one, one) for one in self.modes.kept.T)
        covariance = down[:, None, *first] * across[None, :, *second]
        return np.linalg.inv(covariance)

    @property
    def _level(self) -> np.ndarray:
        """Amounts of patterns along an axis (pattern,) where all points are 1."""
        return np.asarray(self.modes.weights.sum(axis=1))

    def _axis(self, frequency: np.ndarray, stepped: float) -> np.ndarray:
        """Covariance of patterns along one axis at frequencies (n,): (n, pattern, pattern)."""
        place = np.arange(self.modes.points) / self.modes.points
        before = self.modes.weights @ self._alike(1 + place[:, None] - place) @ self.modes.weights.T
        turn = np.exp(-1j * frequency)[:, None, None]
        out = before * turn / (1 - self.rho * turn)
        within = self._near() + out + out.conj().swapaxes(1, 2)
        chain = (1 - self.rho**2) / np.abs(1 - self.rho * turn) ** 2
        return np.asarray(
            (1 - stepped) * within + stepped * chain * np.outer(self._level, self._level)
        )

    def _near(self) -> np.ndarray:
        """Covariance of patterns along an axis of one field."""
        place = np.arange(self.modes.points) / self.modes.points
        alike = self._alike(np.abs(place[:, None] - place))
        return np.asarray(self.modes.weights @ alike @ self.modes.weights.T)

    def _alike(self, apart: np.ndarray) -> np.ndarray:
        return np.power(float(self.rho), apart)


class LatticeSystem:
    """The system of one array; superpixels and unknowns are (lenslet_row, lenslet_column, ...).

    blocks: F_o (block, pixel, unknown).
    offsets: (block, 2), o: superpixels from the lenslet.
    variance: v (pixel,), inf where a pixel says nothing.
    shape: rows and columns of lenslets.
    prior: of the unknowns, modes times bands; None: one value a band, and no prior.
    """

    def __init__(
        self,
        blocks: np.ndarray,
        offsets: np.ndarray,
        variance: np.ndarray,
        shape: tuple[int, int],
        prior: PointPrior | None = None,
    ) -> None:
        """Set the system up; nothing is solved yet."""
        from scipy.fft import next_fast_len

        self.offsets, self.shape, self.prior = offsets, shape, prior
        self.reach = int(np.abs(offsets).max())
        self.unknowns = blocks.shape[-1]
        self.modes = EVEN if prior is None else prior.modes
        self.tiles = tuple(-(-n // TILE) for n in shape)
        self.tile = tuple(
            next_fast_len(-(-n // k) + 2 * PAD, real=True) for n, k in zip(shape, self.tiles)
        )
        self._variance = variance
        self._there = np.concatenate(list(blocks.swapaxes(1, 2))).astype(np.float32)
        even = np.zeros(self.unknowns) if prior is None else prior.even
        self._even = even.astype(np.float32)

    @cached_property
    def _along(self) -> tuple[np.ndarray, np.ndarray]:
        """The few directions in which unknowns act on superpixels, of unit noise: what pixels tell
        of them (pixel, direction), and what unknowns do to them (block * unknown, direction).
        """
        weight = 1 / np.sqrt(self._variance)
        act = self._there.astype(float) * weight
        strong = act
        if self.prior is not None:
            strong = act * np.tile(self.prior.spread, len(self.offsets))[:, None]
        if len(act) < len(weight):
            power, turn = np.linalg.eigh(strong @ strong.T)
            turn = strong.T @ turn / np.sqrt(np.maximum(power, 1e-300))
        else:
            power, turn = np.linalg.eigh(strong.T @ strong)
        turn = turn[:, power > (FAINT**2 * power[-1] if self.prior is None else UNTOLD)]
        return (weight[:, None] * turn).astype(np.float32), (act @ turn).astype(np.float32)

    def directions(self, values: np.ndarray) -> np.ndarray:
        """What superpixels (..., pixel) show along the directions: (..., direction)."""
        return values.astype(np.float32, copy=False) @ self._along[0]

    def mean(self, b: np.ndarray) -> np.ndarray:
        """Of the fields, (rows, columns, band), of unknowns."""
        mean = self.modes.mean
        return np.einsum("rcmk,m->rck", b.reshape(*b.shape[:2], len(mean), -1), mean)

    def mirrored(self, b: np.ndarray, beyond: int) -> np.ndarray:
        """Unknowns, and what they are up to `beyond` lenslets outside, object points mirrored."""
        places, turned = zip(*(_mirror(n, beyond) for n in self.shape))
        x = b[np.ix_(*places)]
        if len(self.modes.kept) == 1:
            return x
        shape, x = x.shape, x.reshape(*x.shape[:2], len(self.modes.kept), -1)
        down, across = (one.astype(x.dtype) for one in self.modes.mirrored)
        x[turned[0]] = down @ x[turned[0]]
        x[:, turned[1]] = across @ x[:, turned[1]]
        return x.reshape(shape)

    def forward(self, b: np.ndarray) -> np.ndarray:
        """Superpixels (rows, columns, pixel) float32 of unknowns."""
        return (
            self._reaching(b, np.ones(self.shape, bool), 0).reshape(*self.shape, -1) @ self._there
        )

    def _reaching(self, b: np.ndarray, which: np.ndarray, beyond: int) -> np.ndarray:
        """Unknowns that reach superpixels: (superpixel, block * unknown) float32.

        which: (row, column) bool, of the array and `beyond` lenslets about it.
        """
        wide = self.mirrored(b.astype(np.float32, copy=False), beyond + self.reach)
        row, column = np.nonzero(which)
        out = np.empty((len(row), len(self.offsets), self.unknowns), np.float32)
        for k, (down, across) in enumerate(self.offsets):
            out[:, k] = wide[row + self.reach - down, column + self.reach - across]
        return out.reshape(len(row), -1)

    def solved(
        self,
        values: np.ndarray,
        start: np.ndarray,
        own: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> np.ndarray:
        """Unknowns from superpixels. What is not seen, beyond the border and where pixels are lost,
        counts as the unknowns foretell it, until that moves them no more.

        values: (rows, columns, pixel), NaN where lost.
        start: a first guess.
        own: from means, what superpixels have beside `forward`; None: nothing.
        """
        scale, grid = np.sqrt(self.impulse[2]).min(), tuple(n + 2 * PAD for n in self.shape)
        lost = np.isnan(values).any(axis=-1)
        foretold, inside = np.ones(grid, bool), (slice(PAD, -PAD),) * 2
        foretold[inside] = lost
        act = self._along[1]
        even = np.tile(self._even, len(self.offsets)) @ act
        whole = np.pad(self.directions(np.nan_to_num(values)) - even, [(PAD, PAD)] * 2 + [(0, 0)])

        def told(b: np.ndarray) -> np.ndarray:
            out, seen = whole.copy(), values
            if own is not None:
                seen = values - own(self.mean(b))
                out[inside] = self.directions(np.nan_to_num(seen)) - even
            out[foretold] = self._reaching(b - self._even, foretold, PAD) @ act
            if lost.any():
                apart = seen[lost] - self._reaching(b, lost, 0) @ self._there
                out[inside][lost] += self.directions(np.nan_to_num(apart))
            return out

        known = told(start)
        b = self._even + self._answered(known)
        changing = foretold if own is None else np.ones(grid, bool)
        steps = _Steps()
        for _ in range(STEPS):
            change = np.zeros_like(known)
            change[changing] = steps.next(known[changing], (told(b) - known)[changing])
            step = self._answered(change)
            known, b = known + change, b + step
            if np.quantile(np.abs(self.mean(step)), SETTLED) < ENOUGH * scale:
                break
        return b

    def answered(self, values: np.ndarray) -> np.ndarray:
        """Unknowns, off their mean, from superpixels off theirs, where those outside are not."""
        return self._answered(np.pad(self.directions(values), [(PAD, PAD)] * 2 + [(0, 0)]))

    def _answered(self, told: np.ndarray) -> np.ndarray:
        """Unknowns by what directions tell, (row, column, direction) of the array and PAD about it,
        tile by tile.
        """
        from scipy.fft import irfft2, rfft2

        inner = [n - 2 * PAD for n in self.tile]
        wide = np.zeros(
            (*(n * k + 2 * PAD for n, k in zip(inner, self.tiles)), told.shape[-1]), np.float32
        )
        wide[: told.shape[0], : told.shape[1]] = told
        corners = [
            (row, column)
            for row in range(0, wide.shape[0] - 2 * PAD, inner[0])
            for column in range(0, wide.shape[1] - 2 * PAD, inner[1])
        ]
        parts = [wide[r : r + self.tile[0], c : c + self.tile[1]] for r, c in corners]
        some = [k for k, part in enumerate(parts) if part.any()]
        out = np.zeros((*(n * k for n, k in zip(inner, self.tiles)), self.unknowns), np.float32)
        if some:
            spectrum = rfft2(np.stack([parts[k] for k in some], axis=2), axes=(0, 1))
            found = irfft2(spectrum @ self._gain, s=self.tile, axes=(0, 1))[PAD:-PAD, PAD:-PAD]
            for place, k in enumerate(some):
                row, column = corners[k]
                out[row : row + inner[0], column : column + inner[1]] = found[:, :, place]
        return out[: self.shape[0], : self.shape[1]]

    def _acts(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """What unknowns do to directions at frequencies, radians a lenslet: (len(rows),
        len(columns), unknown, direction).
        """
        phases = [
            np.exp(-1j * np.multiply.outer(k, self.offsets[:, axis]))
            for axis, k in enumerate((rows, columns))
        ]
        phase, act = phases[0][:, None] * phases[1][None], self._along[1]
        if self.unknowns > EXACT:
            phase = phase.astype(np.complex64)
        out = phase @ act.reshape(len(self.offsets), -1)
        return out.reshape(len(rows), len(columns), self.unknowns, -1)

    def _normal(self, acts: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """A^T V^-1 A and the prior's precision: (len(rows), len(columns), unknown, unknown)."""
        out = acts.conj() @ acts.swapaxes(-1, -2)
        if self.prior is not None:
            before = self.prior.precision(rows, columns)
            out += np.kron(before, self.prior.inverse).astype(out.dtype)
        return out

    @cached_property
    def _gain(self) -> np.ndarray:
        """Unknowns from directions at the frequencies of a tile: (row, column, direction, unknown)
        complex64.
        """
        rows, columns = self.tile
        frequencies = 2 * np.pi * np.fft.fftfreq(rows), 2 * np.pi * np.fft.rfftfreq(columns)
        acts = self._acts(*frequencies)
        gain = _inverted(self._normal(acts, *frequencies)) @ acts.conj()
        return np.ascontiguousarray(gain.swapaxes(-1, -2), np.complex64)

    @cached_property
    def _sampled(self) -> tuple[np.ndarray, np.ndarray]:
        """`_acts` and `_normal` at FREQUENCY."""
        acts = self._acts(FREQUENCY, FREQUENCY)
        return acts, self._normal(acts, FREQUENCY, FREQUENCY)

    def surprise(self, left: np.ndarray, scale: np.ndarray, b: np.ndarray) -> float:
        """-2 ln of the evidence a lenslet (but for what all systems of a capture share): what is
        left over of the data, how far the answer is from its prior, and how much of the prior the
        data rule out.

        left: of the superpixels.
        scale: (pixel,), its standard deviation.
        b: the answer.
        """
        from scipy.fft import irfft2, rfft2

        assert self.prior is not None
        bands = len(self.prior.mean)
        before = bands * np.linalg.slogdet(self.prior.precision(FREQUENCY, FREQUENCY))[1]
        before += self.unknowns // bands * np.linalg.slogdet(self.prior.inverse)[1]
        ruled_out = np.linalg.slogdet(self._sampled[1])[1] - before
        apart = self.mirrored(b - self._even, PAD).astype(np.float32)
        spectrum = rfft2(apart, axes=(0, 1))
        rows, columns = apart.shape[:2]
        whole = 2 * np.pi * np.fft.fftfreq(rows), 2 * np.pi * np.fft.rfftfreq(columns)
        precision = self.prior.precision(*whole).astype(np.complex64)
        pulled = precision @ spectrum.reshape(*spectrum.shape[:2], -1, bands) @ self.prior.inverse
        pull = irfft2(pulled.reshape(spectrum.shape), s=(rows, columns), axes=(0, 1))
        inner = (slice(PAD, -PAD),) * 2
        power = ((left / scale) ** 2).sum() + (apart[inner] * pull[inner]).sum()
        return float(power / (self.shape[0] * self.shape[1]) + ruled_out.mean())

    @cached_property
    def impulse(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What a pixel of superpixel l + d adds to the band values (mean over points) of lenslet l.

        Returns d (n, 2); h (n, band, pixel); and (band,) the variance that the prior leaves beside
        the noise of variance v.
        """
        acts, normal = self._sampled
        bands = self.unknowns // len(self.modes.kept)
        mean = np.kron(self.modes.mean[:, None], np.eye(bands))
        turned = np.linalg.solve(normal, np.broadcast_to(mean, (*normal.shape[:3], bands)))
        posterior = np.einsum("dk,rcdk->k", mean, turned).real / IMPULSE**2
        spread = np.fft.ifft2(turned.swapaxes(-1, -2) @ acts, axes=(0, 1)).real
        near = range(-self.reach - 1, self.reach + 2)
        where = np.array([(i, j) for i in near for j in near])
        h = spread[where[:, 0] % IMPULSE, where[:, 1] % IMPULSE] @ self._along[0].T
        return where, h, posterior


class _Steps:
    """Longer or shorter steps towards where none is left: the combination of the last ones that
    leaves least (D. G. Anderson, J. ACM 12, 547, 1965).
    """

    def __init__(self) -> None:
        """Nothing is remembered."""
        self._past: list[tuple[np.ndarray, np.ndarray]] = []

    def next(self, place: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The step to take.

        place: where it starts.
        step: the plain one from there.
        """
        past, now = self._past[-REMEMBERED:], (place, step)
        self._past = [*past, now]
        if not past:
            return step
        moved, apart = (np.array([now[k] - one[k] for one in past]) for k in (0, 1))
        flat = apart.reshape(len(past), -1)
        normal = flat @ flat.T
        normal += 1e-6 * np.trace(normal) * np.eye(len(past))
        share = np.linalg.solve(normal, flat @ step.ravel())
        return step - np.tensordot(share, moved + apart, 1).astype(step.dtype)


def _inverted(normal: np.ndarray) -> np.ndarray:
    """Of matrices (row, column, unknown, unknown)."""
    try:
        return np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        # unknowns that light does not tell apart, as of two bands alike: rounding alone is left
        size = np.trace(normal, axis1=2, axis2=3).real[..., None, None]
        least = 4 * np.finfo(np.float32).eps * size * np.eye(normal.shape[-1])
        return np.linalg.inv(normal + least.astype(normal.real.dtype))


def _mirror(count: int, beyond: int) -> tuple[np.ndarray, np.ndarray]:
    """Which of `count` lenslets stands at each place from `beyond` before the first to as many
    after the last, and whether it is mirrored there.
    """
    place = np.arange(-beyond, count + beyond) % (2 * count)
    turned = place >= count
    return np.where(turned, 2 * count - 1 - place, place), turned
