"""How likely captures are under a matrix, whatever the objects: the marginal likelihood of LMMSE
over all lenslets, its derivatives by the matrix, and its curvature.

A lenslet's superpixel is y = A x + b + n, x = B c with coefficients c of the PhotographPrior at one
of CONTRASTS, b an even veil and n white noise. With M = [A B, veil] D, D the standard deviations,
and (d, V) = eigh(M^T M), u = V^T M^T y,

    log p(y | contrast)
        = -1/2 [(P - q) log s^2 + sum log(d + s^2) + (|y|^2 - sum u^2/(d + s^2))/s^2]

but for a constant; lenslets add, contrasts are averaged over. docs/model.md, "A camera that fits
itself".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from plenocli.inverse.fit.prior import CONTRASTS, PhotographPrior

VEIL = 0.02
"""Standard deviation of an even veil over the mean of a capture."""


@dataclass(frozen=True)
class Lenslets:
    """Superpixels of one capture, as a fit takes them.

    y: (pixel, lenslet) in units of A x, with x about as bright as photographs are.
    sigma: standard deviation of their noise.
    """

    y: np.ndarray
    sigma: float


class Evidence:
    """How likely captures are under a matrix A and noise `factor` times as strong as told."""

    def __init__(self, captures: Sequence[Lenslets], prior: PhotographPrior) -> None:
        self.captures, self.prior = tuple(captures), prior
        self.scales = [np.append(prior.scales(k), 1.0) for k in CONTRASTS]

    @property
    def lenslets(self) -> int:
        """How many of them there are in all captures."""
        return sum(c.y.shape[1] for c in self.captures)

    @property
    def values(self) -> int:
        """How many pixels there are in all captures."""
        return sum(c.y.size for c in self.captures)

    @property
    def quiet(self) -> float:
        """Root mean square of the quietest capture over its noise."""
        return max(float(np.sqrt(np.mean(c.y**2))) / c.sigma for c in self.captures)

    def at(self, A: np.ndarray) -> EvidenceAt:
        """The evidence under a matrix A (pixel, point)."""
        return EvidenceAt(self, A)


@dataclass(frozen=True)
class _Spectrum:
    """One capture under one contrast: (d, V) of M^T M, u (coefficient, lenslet)."""

    values: np.ndarray
    vectors: np.ndarray
    u: np.ndarray


class EvidenceAt:
    """The evidence under one matrix, at any noise."""

    def __init__(self, evidence: Evidence, A: np.ndarray) -> None:
        self._of = evidence
        self._seen = np.asarray(A @ evidence.prior.patterns.astype(A.dtype), float)
        self._whole = [self._with_veil(c) for c in evidence.captures]
        self._spectra = [self._by_contrast(m, c) for m, c in zip(self._whole, evidence.captures)]

    def _with_veil(self, capture: Lenslets) -> np.ndarray:
        veil = np.full((len(self._seen), 1), VEIL * float(np.mean(capture.y)))
        return np.hstack([self._seen, veil])

    def _by_contrast(self, whole: np.ndarray, capture: Lenslets) -> list[_Spectrum]:
        gram, seen = whole.T @ whole, whole.T @ capture.y
        found = []
        for scale in self._of.scales:
            values, vectors = np.linalg.eigh(scale[:, None] * gram * scale)
            u = vectors.T @ (scale[:, None] * seen)
            found.append(_Spectrum(np.maximum(values, 0), vectors, u))
        return found

    def _likelihood(self, index: int, factor: float) -> np.ndarray:
        """log p(y | contrast), (contrast, lenslet), of one capture."""
        capture = self._of.captures[index]
        noise = (factor * capture.sigma) ** 2
        energy = np.einsum("pl,pl->l", capture.y, capture.y)
        rows = []
        for spectrum in self._spectra[index]:
            left = spectrum.values + noise
            explained = (1 / left) @ spectrum.u**2
            free = len(capture.y) - len(left)
            rows.append(
                -0.5 * (free * np.log(noise) + np.log(left).sum() + (energy - explained) / noise)
            )
        return np.array(rows)

    def value(self, factor: float) -> float:
        """The logarithm of the evidence at `factor` times the noise told, but for a constant."""
        total = 0.0
        for index in range(len(self._of.captures)):
            each = logsumexp(self._likelihood(index, factor), axis=0)
            total += float(np.sum(each - np.log(len(CONTRASTS))))
        return total

    def noise_factor(self, *, least: float = 0.5, most: float = 1e3) -> float:
        """The most likely factor of the noise, within these limits."""
        from scipy.optimize import minimize_scalar

        grid = np.linspace(np.log(least), np.log(most), 24)
        values = [self.value(float(np.exp(g))) for g in grid]
        best = int(np.argmax(values))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        found = minimize_scalar(
            lambda g: -self.value(float(np.exp(g))),
            bounds=(low, high),
            method="bounded",
            options={"xatol": 1e-4},
        )
        return float(np.exp(found.x))

    def by_matrix(self, factor: float) -> np.ndarray:
        """The derivatives of `value` by the matrix, (pixel, point)."""
        by_seen = np.zeros_like(self._seen)
        for index, (capture, whole) in enumerate(zip(self._of.captures, self._whole)):
            noise = (factor * capture.sigma) ** 2
            likelihood = self._likelihood(index, factor)
            weight = np.exp(likelihood - logsumexp(likelihood, axis=0))
            outer = np.zeros((whole.shape[1], whole.shape[1]))
            data = np.zeros((capture.y.shape[0], whole.shape[1]))
            for spectrum, scale, share in zip(self._spectra[index], self._of.scales, weight):
                found = spectrum.vectors @ (spectrum.u / (spectrum.values + noise)[:, None])
                found = scale[:, None] * found
                left = spectrum.vectors / (spectrum.values + noise) @ spectrum.vectors.T
                outer += (found * share) @ found.T / noise
                outer += share.sum() * scale[:, None] * left * scale
                data += (capture.y * share) @ found.T / noise
            by_seen += (data - whole @ outer)[:, :-1]
        return by_seen @ self._of.prior.patterns.T

    def objects(self, index: int, factor: float) -> np.ndarray:
        """What lies in front of the lenslets of a capture, as far as they tell, (point, lenslet).

        index: of the capture.
        """
        noise = (factor * self._of.captures[index].sigma) ** 2
        likelihood = self._likelihood(index, factor)
        weight = np.exp(likelihood - logsumexp(likelihood, axis=0))
        found = np.zeros_like(self._spectra[index][0].u)
        for spectrum, scale, share in zip(self._spectra[index], self._of.scales, weight):
            mean = spectrum.vectors @ (spectrum.u / (spectrum.values + noise)[:, None])
            found += scale[:, None] * mean * share
        return self._of.prior.patterns @ found[:-1]

    def curvature(self, rises: Sequence[np.ndarray], factor: float) -> np.ndarray:
        """How fast the slopes of `value` fall with numbers that the matrix depends on, by Gauss
        and Newton: r^T Lambda^-1 r summed over lenslets, Lambda = M M^T + s^2 at the contrast that
        is the likeliest for each.

        rises: for every capture (number, pixel, lenslet) dA x, x as `objects` gives them.

        Returns (number, number).
        """
        total = np.zeros((len(rises[0]), len(rises[0])))
        for index, (capture, rise) in enumerate(zip(self._of.captures, rises)):
            noise = (factor * capture.sigma) ** 2
            likeliest = self._likelihood(index, factor).argmax(axis=0)
            for contrast in np.unique(likeliest):
                spectrum, scale = self._spectra[index][contrast], self._of.scales[contrast]
                left = np.asarray(rise[:, :, likeliest == contrast], float)
                told = (spectrum.vectors.T * scale) @ (self._whole[index].T @ left)
                told /= np.sqrt(spectrum.values + noise)[:, None]
                total += (_products(left) - _products(told)) / noise
        return total


def _products(rises: np.ndarray) -> np.ndarray:
    flat = rises.reshape(len(rises), -1)
    return flat @ flat.T
