"""The best linear estimate of a Gaussian volume, with a standard deviation for every voxel."""

from __future__ import annotations

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.linear_maps import times
from plenocli.base.progress import bar, note
from plenocli.inverse.volume.gain import Gain, gain_of
from plenocli.inverse.volume.lattice import exponential_factor, lattice_of
from plenocli.inverse.volume.likelihood import fit_prior
from plenocli.inverse.volume.measurement import Problem
from plenocli.inverse.volume.volume import Prior, Trial, Volume

TOLERANCE = 1e-3
"""Change of the volume in a round, relative, at which missing pixels count as filled."""
ROUNDS = 30
"""Of filling, at most."""
MOST_WEIGHT = 3.0
"""Of a pixel that is darker than its fellows, whose noise is below theirs."""
FIRST = 8
"""Rounds after which the pixels' own noise is read off their prediction."""
EVEN, WIDTH = 0.3, 1.0
"""Share of the variance that every voxel has, and the voxels over which what is added follows the
specimen's mean square.
"""
UNEXPLAINED = 30.0
"""Variance over the noise's from which on a capture is not what the kernels make of any volume;
such errors have a pattern, which the bars of voxels do not know.
"""
GAUSSIAN = 5.0
"""Kurtosis up to which a volume passes for Gaussian, which has 3."""


def lmmse(
    problem: Problem, white: bool = False, rounds: int = ROUNDS, *, uneven: bool | None = None
) -> Volume:
    """The linear estimate of the least mean square error, and its standard deviation.

    problem: pixels that do not count, and the border, are filled with what is predicted of them.
    white: take voxels for independent (Tikhonov), instead of correlated as exp(-r/l).
    rounds: of filling, at most.
    uneven: whether the errors follow the specimen; None: where the volume is no Gaussian.

    Returns a volume whose sigma is that of a Gaussian specimen of the same statistics; where they
    are uneven, it follows the specimen: sigma^2 (0.3 + e/mean e), e its local mean square.
    Raises NumericsError where memory is lacking.
    docs/model.md, "Volumes inverted".
    """
    op = problem.op
    budget().require(op.spectrum.nbytes, "the estimate's gain", fewer="take fewer planes")
    lattice = lattice_of(op.torus, problem.voxels)
    mean = mean_of(problem)
    of_pixels = class_variance(problem)
    fitted = fit_prior(problem, lattice, of_pixels, mean, 0.0 if white else None)
    if fitted.noise > UNEXPLAINED and problem.measurement.noise_is_known:
        note(
            f"what these kernels cannot produce is {fitted.noise:.0f} times the noise: planes are "
            "too far apart, or it is another microscope; error bars of voxels may be too small"
        )
    of_pixels = fitted.noise * of_pixels
    factor = exponential_factor(lattice, np.array(problem.voxels.depths), fitted.length)
    # pixels that are left out here and there are as good as more noise everywhere
    share = np.maximum(problem.counts.mean(axis=(0, 1)), 1 / problem.counts[..., 0].size)
    whitening = np.sqrt(share / of_pixels)
    gain = gain_of(op, lattice, np.sqrt(fitted.variance) * factor, whitening)
    x, light = conditional_mean(problem, gain, mean, of_pixels, rounds)
    value = problem.inside(x)
    method = "tikhonov" if white else "lmmse"
    return Volume(
        value=value,
        sigma=_sigma(problem, gain, value, is_uneven(value) if uneven is None else uneven),
        method=method,
        trace=(Trial(method, problem.misfit(light)),),
        background=float(problem.measurement.offset.mean()),
        prior=Prior(
            correlation_length=fitted.length,
            variance=fitted.variance,
            noise_variance=float(of_pixels[np.isfinite(of_pixels)].mean()),
            mean=mean,
        ),
        held_out=problem.judged(light),
        margin=problem.margin,
    )


def mean_of(problem: Problem) -> float:
    """Of a voxel: the even volume that is as bright as what was seen."""
    light = np.broadcast_to(problem.light_on_pixels, problem.signal.shape)[problem.counts]
    return float(problem.signal[problem.counts].sum(dtype=float) / light.sum(dtype=float))


def class_variance(problem: Problem) -> np.ndarray:
    """(pixel,) variance of a pixel's noise, as expected at its mean over the lenslets; 1 where the
    measurement says nothing of it, infinite where no pixel counts.
    """
    seen = problem.counts.sum(axis=(0, 1))
    mean = np.where(problem.counts, problem.signal, 0).sum(axis=(0, 1)) / np.maximum(seen, 1)
    variance = problem.measurement.variance(mean.astype(float))
    variance = variance if variance.min() > 0 else np.ones_like(variance)
    return np.where(seen > 0, variance, np.inf)


def conditional_mean(
    problem: Problem, gain: Gain, mean: float, of_pixels: np.ndarray, rounds: int = ROUNDS
) -> tuple[np.ndarray, np.ndarray]:
    """The mean of the posterior given the pixels that count, each with its own noise.

    problem: what counts.
    gain: for pixels that all count and have the noise of its whitening.
    mean: of a voxel.
    of_pixels: (pixel,) variance of the noise at a pixel's mean over the lenslets; where photons
        make it, each has its own, in proportion to what the measurement says.
    rounds: at most.

    Returns x (lenslet_row, lenslet_column, unknown) on the torus and A x like the signal.

    Pixels enter as w y + (1 - w) A x, w the gain's noise over their own: the gain is the
    step of a descent that is exact where all weights are 1, accelerated (Nesterov 1983;
    O'Donoghue and Candes 2015, restart).
    """
    whole, (rows, columns) = problem.op.on_torus(), problem.op.range.shape[:2]
    kind = problem.op.dtype.type
    y, weight = (np.zeros(whole.range.shape, problem.op.dtype) for _ in range(2))
    y[:rows, :columns] = (problem.signal - kind(mean) * problem.light_on_pixels) * gain.whitening
    weight[:rows, :columns] = _weights(problem, gain, of_pixels)
    x = point = np.zeros(whole.domain.shape, problem.op.dtype)
    whitening = gain.whitening.astype(problem.op.dtype)
    matrix = whole.device.put(gain.matrix)
    step, momentum = kind(1 / max(1.0, float(weight.max()))), 1.0
    exact = bool(np.all(weight == 1)) and problem.measurement.gain == 0
    rounds = 1 if exact else rounds
    for done in bar(range(rounds), rounds, "missing pixels"):
        light = whole.forward(point)
        if done == FIRST and problem.measurement.gain > 0:
            expected = light[:rows, :columns] + kind(mean) * problem.light_on_pixels
            counting = np.isfinite(of_pixels)
            factor = np.divide(
                of_pixels, class_variance(problem), where=counting, out=1 * of_pixels
            )
            own = factor * problem.measurement.variance(expected)
            weight[:rows, :columns] = _weights(problem, gain, own)
            step = kind(1 / max(1.0, float(weight.max())))
        filled = weight * y + (1 - weight) * (light * whitening)
        full = whole.from_frequencies(times(matrix, whole.to_frequencies(filled)))
        new = point + step * (full - point)
        change, descent = new - x, point - new
        moved = float(np.linalg.norm(change)) / max(float(np.linalg.norm(new)), 1e-30)
        if float(np.vdot(descent, change)) > 0:
            momentum = 1.0
        after = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        point = new + kind((momentum - 1) / after) * change
        x, momentum = new, after
        if moved < TOLERANCE and done > FIRST:
            break
    x = x + kind(mean)
    return x, problem.op.forward(x)


def _weights(problem: Problem, gain: Gain, own: np.ndarray) -> np.ndarray:
    """Like signal: variance of the gain's noise over a pixel's own, 0 where it does not count."""
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.minimum(gain.whitening**-2.0 / own, MOST_WEIGHT)
    return np.where(problem.counts, weight, 0)


def is_uneven(value: np.ndarray) -> bool:
    """Whether a volume is further from a Gaussian than passes for one."""
    rest = value - value.mean()
    rest = rest / (np.abs(rest).max() or 1)  # powers of any unit stay numbers
    return bool(np.mean(rest**4) > GAUSSIAN * np.mean(rest**2) ** 2)


def _sigma(problem: Problem, gain: Gain, value: np.ndarray, uneven: bool) -> np.ndarray:
    """Like value: by voxel of the lenslet, and where uneven by where the specimen is."""
    from scipy.ndimage import gaussian_filter

    rows, columns = problem.op.range.shape[:2]
    even = np.broadcast_to(gain.variance, (rows, columns, len(gain.variance)))
    variance = problem.voxels.picture(even)
    if uneven:
        local = gaussian_filter(value.astype(float) ** 2, WIDTH)
        variance = variance * (EVEN + local / local.mean())
    return np.sqrt(variance).astype(value.dtype)
