"""Correlation length, variance and noise of a specimen, by the likelihood of what was seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plenocli.base.linear_maps import BlockCirculant
from plenocli.base.random_streams import stream
from plenocli.inverse.volume.lattice import Lattice, exponential_factor, through_prior
from plenocli.inverse.volume.measurement import Problem

FREQUENCIES = 24
"""Of the lattice, at which the likelihood is computed."""
COMPLETING = 20
"""Steps of least squares, whose prediction stands in for pixels that are missing."""
LEAST_EIGENVALUE = 1e-12
"""Share of the largest one below which a direction is taken for noise alone."""


@dataclass(frozen=True)
class Fitted:
    """Most likely parameters.

    length: m.
    variance: of a voxel.
    noise: variance over what was assumed.
    """

    length: float
    variance: float
    noise: float


def fit_prior(
    problem: Problem, lattice: Lattice, variance: np.ndarray, mean: float, length: float | None
) -> Fitted:
    """The most likely correlation length, variance and noise.

    problem: held-out pixels count too, as three numbers are no risk to them.
    lattice: the frequencies of its map.
    variance: (pixel,) of the noise, up to a factor that is found; infinite where none counts.
    mean: of a voxel.
    length: m, where it is known.

    Whittle's likelihood at FREQUENCIES frequencies of the completed array, by the eigenvalues of
    the covariance there.
    """
    from scipy.optimize import minimize_scalar

    chosen, seen = _observed(problem, lattice, variance, mean)
    depths = np.array(problem.voxels.depths)
    whitening = 1 / np.sqrt(variance)

    def at(length: float) -> tuple[float, Fitted]:
        factor = exponential_factor(lattice, depths, length, chosen)
        modes = [
            _modes(through_prior(whitening[:, None] * problem.op.spectrum[k], mixing, root), y)
            for k, mixing, root, y in zip(chosen, lattice.mixing[chosen], factor, seen)
        ]
        free = np.count_nonzero(whitening) - np.array([len(m[0]) for m in modes])
        eigenvalues, powers = (np.concatenate(column) for column in zip(*(m[:2] for m in modes)))
        rest = sum(m[2] for m in modes)
        return _most_likely(eigenvalues, powers, rest, float(free.sum()), length)

    if length is None:
        extent = min(problem.op.range.shape[:2]) * problem.voxels.point_shape[0]
        bounds = np.log(problem.voxels.pitch * np.array([0.3, max(extent / 4, 1.0)]))
        found = minimize_scalar(
            lambda log: at(float(np.exp(log)))[0],
            bounds=bounds,
            method="bounded",
            options={"xatol": 0.15},
        )
        length = float(np.exp(found.x))
    return at(length)[1]


def _observed(
    problem: Problem, lattice: Lattice, variance: np.ndarray, mean: float
) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (n,) and the whitened array there, (n, pixel), pixels that are missing
    foretold; as strong as if none were.
    """
    op = problem.op
    rows, columns, pixels = op.range.shape
    y = np.zeros((*op.torus, pixels))
    expected = mean * problem.light_on_pixels
    whitening = 1 / np.sqrt(variance)
    y[:rows, :columns] = (problem.signal - expected) * whitening
    known = np.zeros(y.shape, bool)
    known[:rows, :columns] = (problem.counts | problem.held) & (whitening > 0)
    if not known.all():
        y[~known] = _completed(op, y, known, whitening)[~known]
    found = np.fft.rfft2(y, axes=(0, 1)).reshape(-1, pixels) / np.sqrt(
        known[..., whitening > 0].sum() / np.count_nonzero(whitening)
    )
    count = min(FREQUENCIES, len(found) - 1)  # the mean stands at the first
    chosen = 1 + np.sort(
        stream(0, "volume-likelihood").choice(len(found) - 1, count, replace=False)
    )
    return chosen, found[chosen]


def _completed(
    op: BlockCirculant, y: np.ndarray, known: np.ndarray, whitening: np.ndarray
) -> np.ndarray:
    """What a volume that explains the known pixels throws on all of them: least squares, by few
    enough steps to leave noise out. Windows would spread every frequency over the next ones,
    whose matrices are others.
    """
    from scipy.sparse.linalg import LinearOperator, lsmr

    whole = op.on_torus()
    scale = known * whitening

    def forward(x: np.ndarray) -> np.ndarray:
        return (scale * whole.forward(x.reshape(whole.domain.shape))).ravel()

    def adjoint(light: np.ndarray) -> np.ndarray:
        return whole.adjoint(scale * light.reshape(whole.range.shape)).ravel().astype(float)

    masked = LinearOperator(
        (whole.range.size, whole.domain.size), matvec=forward, rmatvec=adjoint, dtype=float
    )
    found = lsmr(masked, (known * y).ravel(), maxiter=COMPLETING, atol=0, btol=0, conlim=0)[0]
    return whole.forward(found.reshape(whole.domain.shape)) * whitening


def _modes(b: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Eigenvalues of B B', the power of y along them, and what is left of it."""
    eigenvalues, vectors = np.linalg.eigh(b.conj().T @ b)
    kept = eigenvalues > LEAST_EIGENVALUE * eigenvalues[-1]
    along = np.abs(vectors[:, kept].conj().T @ (b.conj().T @ y)) ** 2 / eigenvalues[kept]
    return eigenvalues[kept], along, max(float(np.sum(np.abs(y) ** 2) - along.sum()), 0.0)


def _most_likely(
    eigenvalues: np.ndarray, powers: np.ndarray, rest: float, free: float, length: float
) -> tuple[float, Fitted]:
    """The least -log likelihood over variance and noise, and where it is."""
    from scipy.optimize import minimize

    def cost(logs: np.ndarray) -> tuple[float, np.ndarray]:
        variance, noise = np.exp(logs)
        total = variance * eigenvalues + noise
        slope = 1 / total - powers / total**2
        value = np.sum(np.log(total) + powers / total) + free * logs[1] + rest / noise
        by_noise = noise * slope.sum() + free - rest / noise
        return float(value), np.array([variance * np.sum(eigenvalues * slope), by_noise])

    noise = max(rest, 1e-12 * powers.sum()) / max(free, 1.0)
    start = np.log([max(powers.sum(), 1e-300) / eigenvalues.sum(), max(noise, 1e-300)])
    found = minimize(cost, start, jac=True, method="L-BFGS-B")
    variance, noise = np.exp(found.x)
    return float(found.fun), Fitted(length, float(variance), float(noise))
