"""Band radiances behind a lenslet from its pixels: x = F b + noise, with predicted
standard deviations.

F (..., pixel, band) is the response of a superpixel, x (..., pixel) its values, b (..., band) the
radiances. Leading axes (lenslets) broadcast and are worked off in batches. Least squares goes
through QR and SVD factorisations, never through F^T F, whose condition number is the square.
Sources: Berkner et al. 2013, section on spectral demultiplexing; S. M. Kay, Fundamentals of
Statistical Signal Processing I (1993), ch. 6 (BLUE) and 12 (LMMSE).
"""

from __future__ import annotations

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.sensor.noise import Noise

METHODS = ("pinv", "single-pixel", "wls", "lmmse", "nnls")
BATCH_NUMBERS = 4_000_000
LARGEST_CONDITION = 1e10


def choose_pixels(response: np.ndarray) -> np.ndarray:
    """Pixel with the largest response in each band.

    response: (..., pixel, band) of a calibration, never of a capture (noise wins there).

    Returns (..., band).
    """
    return np.where(np.isfinite(response), response, -np.inf).argmax(axis=-2)


def condition_number(response: np.ndarray) -> np.ndarray:
    """Condition number of each F by its singular values.

    response: (..., pixel, band).

    Returns (...), inf where a band is invisible, NaN where F is NaN throughout.
    """
    clean = _masked(response)
    value = np.linalg.svd(clean, compute_uv=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(value[..., 0] > 0, value[..., 0] / value[..., -1], np.nan)


def column_angles(response: np.ndarray) -> np.ndarray:
    """Angles between the columns of F: 90 is perfect separation, 0 none.

    response: (..., pixel, band).

    Returns (..., band, band) degrees.
    """
    clean = _masked(response)
    length = np.sqrt((clean**2).sum(axis=-2))
    unit = clean / np.where(length > 0, length, np.inf)[..., None, :]
    return np.degrees(np.arccos(np.clip(np.swapaxes(unit, -1, -2) @ unit, -1, 1)))


def calibration_bias(response: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Errors-in-variables bias B of least squares with a measured F-hat: its mean answer is (I + B)
    b.

    response: (..., pixel, band).
    variance: (pixel, band) of its entries, independent of each other. To second order, B = E[F+ dF
        F+ dF] - (F^T F)^-1 E[dF^T (I - F F+) dF]: the second term, which dominates with many
        pixels, attenuates; the first can amplify where pixels are few.

    Returns (..., band, band).
    Expansion of the pseudo-inverse: G. H. Golub, V. Pereyra 1973.
    """
    f = _masked(response)
    pseudo = np.linalg.pinv(f)
    variance = np.where((f != 0).any(axis=-1, keepdims=True), np.nan_to_num(variance), 0.0)
    leverage = np.einsum("...pk,...kp->...p", f, pseudo)
    back = np.einsum("...ip,...jp,...pj->...ij", pseudo, pseudo, variance, optimize=True)
    lost = (variance * (1 - leverage)[..., None]).sum(axis=-2)
    return back - (pseudo @ np.swapaxes(pseudo, -1, -2)) * lost[..., None, :]


def noise_variance(
    response: np.ndarray,
    radiance: np.ndarray,
    noise: Noise,
    response_variance: np.ndarray | None = None,
) -> np.ndarray:
    """Variance of pixel values: that of their noise, and of what the calibration does not know.

    response: F (..., pixel, band).
    radiance: (..., band), the expected one, not the outcome of a noisy pixel; negative parts count
        as zero.
    noise: of the signal, with that of the rounding.
    response_variance: (..., pixel, band) or (band,), adds b^2 var(F); its leading axes broadcast.

    Returns (..., pixel), units^2.
    """
    radiance = np.clip(radiance, 0, None)
    mean = (np.nan_to_num(response) @ radiance[..., None])[..., 0]
    variance = np.asarray(noise.variance(mean))
    if response_variance is not None:
        spread = np.nan_to_num(response_variance)
        if spread.ndim < 2:
            spread = np.broadcast_to(spread, response.shape[-2:])
        variance = variance + (spread @ (radiance**2)[..., None])[..., 0]
    return variance


def demultiplex(
    response: np.ndarray,
    values: np.ndarray,
    method: str = "pinv",
    *,
    variance: np.ndarray | float | None = None,
    pixels: np.ndarray | None = None,
    prior: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Radiances b and their predicted standard deviations.

    response: F (..., pixel, band) or shared (pixel, band); NaN masks a pixel.
    values: x (..., pixel); NaN masks a pixel.
    method:
      pinv          b = F^+ x; covariance F^+ S F^+T
      wls           least squares weighted by S^-1; covariance (F^T S^-1 F)^-1
      lmmse         with the prior; covariance (C^-1 + F^T S^-1 F)^-1
      nnls          b >= 0, otherwise as wls where S is known, as pinv where not; sigma of the
                    unconstrained answer
      single-pixel  b_k = x[p_k] / F[p_k, k] for the calibrated `pixels`; sigma without the
      crosstalk
                    bias
    variance: S (..., pixel) or scalar, of the values. Without it S is estimated from the residual,
        one number a superpixel.
    pixels: (..., band), for single-pixel.
    prior: mean (band,) and covariance C (band, band) of the radiances, for lmmse.

    Returns two (..., band); NaN for superpixels with fewer good pixels than bands, or whose F has a
    condition number above 1e10.
    Raises NumericsError where wls or lmmse lack the variance, or lmmse the prior.
    """
    _check(method, variance is not None, prior is not None)
    if method == "single-pixel" and pixels is None:
        pixels = choose_pixels(response)
    values = np.asarray(values)
    lead, count, bands = values.shape[:-1], values.shape[-1], response.shape[-1]
    total = int(np.prod(lead))
    flat = values.reshape(total, count)
    per_lenslet = response.ndim > 2
    response = response.reshape(total, count, bands) if per_lenslet else response
    noise = (
        None if variance is None else np.broadcast_to(variance, values.shape).reshape(total, count)
    )
    if pixels is not None:
        pixels = np.broadcast_to(pixels, (*lead, bands)).reshape(total, bands)
    out = np.empty((2, total, bands))
    step = max(1, BATCH_NUMBERS // (count * bands))
    for start in range(0, total, step):
        part = slice(start, start + step)
        f = response[part] if per_lenslet else response[None]
        one = None if noise is None else noise[part]
        if method == "single-pixel" and pixels is not None:
            out[:, part] = _single_pixel(f, flat[part], pixels[part], one)
        else:
            out[:, part] = _least_squares(f, flat[part], method, one, prior)
    return out[0].reshape(*lead, bands), out[1].reshape(*lead, bands)


def _check(method: str, with_variance: bool, with_prior: bool) -> None:
    """Refuse a method that is unknown or lacks what it needs."""
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}")
    if not with_variance and method in ("wls", "lmmse"):
        raise NumericsError(
            f"{method} weighs pixels by their noise, which is not known",
            fix="give the sensor's gain and read noise (--camera) or use pinv",
        )
    if not with_prior and method == "lmmse":
        raise NumericsError("lmmse needs the mean and covariance of the radiances", fix="use wls")


def _masked(response: np.ndarray) -> np.ndarray:
    """F with zero rows where a pixel is not known in every band: such a row takes no
    part in least squares.
    """
    response = np.asarray(response, float)
    return np.where(np.isfinite(response).all(axis=-1)[..., None], response, 0.0)


def _least_squares(
    response: np.ndarray,
    values: np.ndarray,
    method: str,
    variance: np.ndarray | None,
    prior: tuple[np.ndarray, np.ndarray] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """One batch: response (lenslet or 1, pixel, band), values (lenslet, pixel), variance
    (lenslet, pixel) or None.
    """
    f, x = _masked(response), values.astype(float)
    bands = f.shape[-1]
    used = np.isfinite(x) & (f != 0).any(axis=-1)
    x = np.where(used, x, 0.0)
    if not used.all():
        f = np.where(used[..., None], f, 0.0)
    weighted = method in ("wls", "lmmse") or (method == "nnls" and variance is not None)
    if weighted:
        assert variance is not None
        root = 1 / np.sqrt(np.where(used, variance, 1.0))
        f, x = f * root[..., None], x * root
    if method == "lmmse":
        assert prior is not None
        mean, covariance = (np.asarray(p, float) for p in prior)
        inverse_root = np.linalg.inv(np.linalg.cholesky(covariance))
        f = np.concatenate([f, np.broadcast_to(inverse_root, (len(f), bands, bands))], axis=1)
        x = np.concatenate([x, np.broadcast_to(inverse_root @ mean, (len(x), bands))], axis=1)
    q, r = np.linalg.qr(f)
    projected = (np.swapaxes(q, -1, -2) @ x[..., None])[..., 0]
    singular = np.linalg.svd(r, compute_uv=False)
    known = np.isfinite(values).sum(axis=-1) >= (0 if method == "lmmse" else bands)
    solvable = singular[:, -1] > singular[:, 0] / LARGEST_CONDITION
    inverse = np.linalg.inv(np.where(solvable[:, None, None], r, np.eye(bands)))
    b = (inverse @ projected[..., None])[..., 0]
    sigma = _sigma(inverse, q, f, x, b, variance, used, weighted)
    if method == "nnls":
        b = _non_negative(np.broadcast_to(r, (len(x), bands, bands)), projected, b)
    enough = (known & solvable)[:, None]
    return np.where(enough, b, np.nan), np.where(enough, sigma, np.nan)


def _sigma(
    inverse: np.ndarray,
    q: np.ndarray,
    f: np.ndarray,
    x: np.ndarray,
    b: np.ndarray,
    variance: np.ndarray | None,
    used: np.ndarray,
    weighted: bool,
) -> np.ndarray:
    """Standard deviations (..., band): R^-1 R^-T for whitened rows, F^+ S F^+T else."""
    if weighted:
        return np.broadcast_to(np.sqrt((inverse**2).sum(axis=-1)), b.shape)
    if variance is None:
        residual = x - (f @ b[..., None])[..., 0]
        freedom = np.maximum(used.sum(axis=-1) - b.shape[-1], 1)
        spread = np.sqrt(np.where(used, residual**2, 0).sum(axis=-1) / freedom)
        return spread[..., None] * np.sqrt((inverse**2).sum(axis=-1))
    pseudo = inverse @ np.swapaxes(q, -1, -2)
    return np.sqrt((pseudo**2 @ np.where(used, variance, 0.0)[..., None])[..., 0])


def _non_negative(r: np.ndarray, projected: np.ndarray, b: np.ndarray) -> np.ndarray:
    """min |R b - Q^T x| with b >= 0 where the free answer b has a negative part; R
    stands for F exactly.
    """
    from scipy.optimize import nnls

    b = np.array(b)
    for i in np.flatnonzero((b < 0).any(axis=-1) & np.isfinite(b).all(axis=-1)):
        b[i] = nnls(r[i], projected[i])[0]
    return b


def _single_pixel(
    response: np.ndarray, values: np.ndarray, pixels: np.ndarray, variance: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    rows = np.arange(len(values))[:, None]
    picked = values[rows, pixels].astype(float)
    bands = np.arange(response.shape[-1])
    f = response[0 if len(response) == 1 else rows, pixels, bands].astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        b = np.where(f > 0, picked / f, np.nan)
        sigma = np.full_like(b, np.nan) if variance is None else np.sqrt(variance[rows, pixels]) / f
    return b, np.where(np.isfinite(b), sigma, np.nan)
