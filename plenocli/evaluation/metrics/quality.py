"""Quality of a picture against its truth.

Pictures are (..., row, column) with linear values; white is 1.0 and that is the peak of the PSNR,
whatever the picture's own maximum. Nothing is clipped or rounded here. See
docs/model.md, "Measures".
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from plenocli.base.tiling import Plane
from plenocli.forward.scene.sample import block_mean

Picture = np.ndarray | Plane
PEAK = 1.0
INTERVAL = 1.96
"""Standard deviations, each way, of an interval of 95 %."""

_WINDOW = 11
"""Samples of a side of the window of the structural similarity."""

DEFINITIONS = {
    "psnr_db": (
        "10 log10(1 / mean squared error) over the whole picture and all bands; peak 1.0, values "
        "neither clipped nor rounded"
    ),
    "psnr_inner_db": "PSNR without the outermost ring of lenslets",
    "psnr_clipped_db": "PSNR after clipping the result to 0..1",
    "rmse": "square root of the mean squared error over the whole picture",
    "ssim": (
        "mean structural similarity (Wang et al. 2004: Gaussian window, sigma 1.5 pixels, data "
        "range 1.0), averaged over bands"
    ),
    "block_mean_psnr_db": (
        "PSNR of the truth averaged over each lenslet's block: what a camera without resolution "
        "inside the lenslet would get"
    ),
    "gain_over_block_mean_db": "psnr_db - block_mean_psnr_db",
    "noise_relative": "noise of the capture over its root mean square",
    "model_error_relative": (
        "estimated error of the system matrix against the capture, relative; 0 where the capture "
        "was simulated with the same matrix"
    ),
    "limited_by": "the larger of the two: noise or model",
    "noise_raised": (
        "root mean square of the noise that was reckoned with over the capture's own: 1 where "
        "nothing in the capture speaks against the system matrix"
    ),
    "detail_kept": (
        "share of the method's detail that was kept, as far as it is no noise and goes on across "
        "the lenslets' borders; the rest is the mean of each lenslet"
    ),
    "interval_coverage": (
        "share of the points that lie within 1.96 predicted standard deviations of the truth; 0.95 "
        "where these hold"
    ),
    "seen_share": (
        "share of the directions of a lenslet's object that stand above the capture's noise; the "
        "rest lies in the null space and is filled in by the method"
    ),
}


@dataclass(frozen=True)
class LensletScore:
    """What needs the lenslets' blocks; NaN where it does not apply.

    psnr_inner_db, block_mean_psnr_db, gain_over_block_mean_db: dB, see DEFINITIONS.
    """

    psnr_inner_db: float
    block_mean_psnr_db: float
    gain_over_block_mean_db: float


@dataclass(frozen=True, kw_only=True)
class PictureScore:
    """Measures of one picture; see DEFINITIONS.

    psnr_db, psnr_clipped_db: dB, infinite for equal pictures.
    rmse: in the unit of the picture.
    ssim: -1 to 1, NaN where the picture is too small for it.
    interval_coverage: see DEFINITIONS, None where no deviation is known.
    lenslets: None where their blocks are not known.
    """

    psnr_db: float
    psnr_clipped_db: float
    rmse: float
    ssim: float
    interval_coverage: float | None = None
    lenslets: LensletScore | None = None


def rmse(estimate: Picture, truth: Picture) -> float:
    """Root mean squared error over all samples, in the unit of the samples."""
    squared = _Mean()
    for _, found, true in _bands(estimate, truth):
        squared.add((found - true) ** 2)
    return float(np.sqrt(squared.value))


def psnr(estimate: Picture, truth: Picture) -> float:
    """Peak signal-to-noise ratio with peak 1.0.

    estimate, truth: (..., row, column), linear, white is 1.

    Returns -20 log10(rmse), dB; infinite for equal pictures.
    """
    return _decibel(rmse(estimate, truth))


def _decibel(error: float) -> float:
    return float("inf") if error == 0 else float(-20 * np.log10(error / PEAK))


class _Mean:
    """A mean of what comes in parts; of a single part its own."""

    def __init__(self) -> None:
        self._total, self._count = 0.0, 0

    def add(self, values: np.ndarray) -> None:
        """Count a part in."""
        self._total += float(np.sum(values))
        self._count += values.size

    @property
    def value(self) -> float:
        """NaN without a part."""
        return self._total / self._count if self._count else np.nan


def _bands(
    estimate: Picture, truth: Picture, multiple: int = 1
) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """(rows, estimate, truth) of two pictures of one shape, from the first row to the last."""
    estimate, truth = Plane.of(estimate), Plane.of(truth)
    if estimate.shape != truth.shape:
        raise ValueError(f"estimate is {estimate.shape}, truth is {truth.shape}")
    for rows in truth.in_bands(multiple):
        yield rows, estimate.window(rows), truth.window(rows)


def ssim(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Mean structural similarity with data range 1.0.

    estimate, truth: (row, column), or (band, row, column), whose bands are averaged.

    Returns -1 to 1; NaN for pictures smaller than the window of 11 x 11 samples.
    Wang et al., IEEE Trans. Image Processing 13 (2004) 600-612 (window and constants).
    """
    from skimage.metrics import structural_similarity

    estimate, truth = (np.asarray(values, dtype=np.float64) for values in (estimate, truth))
    if min(truth.shape[-2:]) < _WINDOW:
        return np.nan
    bands = zip(
        estimate.reshape(-1, *truth.shape[-2:]), truth.reshape(-1, *truth.shape[-2:]), strict=True
    )
    return float(
        np.mean(
            [
                structural_similarity(
                    t,
                    e,
                    data_range=PEAK,
                    gaussian_weights=True,
                    sigma=1.5,
                    use_sample_covariance=False,
                )
                for e, t in bands
            ]
        )
    )


def block_mean_baseline(truth: np.ndarray, block: tuple[int, int]) -> np.ndarray:
    """The truth with each lenslet's block replaced by its mean.

    truth: (..., row, column).
    block: (rows, columns) of samples under a lenslet.

    Returns an array like truth.
    """
    means = block_mean(truth, block)
    return np.repeat(np.repeat(means, block[0], axis=-2), block[1], axis=-1)


def score_picture(
    estimate: Picture,
    truth: Picture,
    block: tuple[int, int] | None = None,
    sigma: Picture | None = None,
) -> PictureScore:
    """All measures of DEFINITIONS for one picture, which is worked through in bands of rows.

    estimate, truth: (..., row, column), linear, white is 1.
    block: (rows, columns) of samples under one lenslet; without it the lenslet-wise measures
        are left out.
    sigma: predicted standard deviation, like estimate: half the width of the interval of 95 % over
        INTERVAL.
    """
    shape, deviation = Plane.of(truth).shape, None if sigma is None else Plane.of(sigma)
    whole, clipped, within, middle, baseline = (_Mean() for _ in range(5))
    similarity = _Similarity(shape)
    for rows, found, true in _bands(estimate, truth, block[0] if block else 1):
        error = found - true
        whole.add(error**2)
        clipped.add((np.clip(found, 0, PEAK) - true) ** 2)
        similarity.add(found, true)
        if deviation is not None:
            within.add(np.abs(error) <= INTERVAL * deviation.window(rows))
        if block is not None:
            middle.add(_inner(error, block, rows, shape[-2]) ** 2)
            baseline.add((block_mean_baseline(true, block) - true) ** 2)
    error = float(np.sqrt(whole.value))
    lenslets = None
    if block is not None:
        floor = _decibel(float(np.sqrt(baseline.value)))
        lenslets = LensletScore(
            psnr_inner_db=_decibel(float(np.sqrt(middle.value))),
            block_mean_psnr_db=floor,
            gain_over_block_mean_db=_decibel(error) - floor if np.isfinite(floor) else np.nan,
        )
    return PictureScore(
        psnr_db=_decibel(error),
        psnr_clipped_db=_decibel(float(np.sqrt(clipped.value))),
        rmse=error,
        ssim=similarity.value,
        interval_coverage=None if sigma is None else within.value,
        lenslets=lenslets,
    )


def _inner(error: np.ndarray, block: tuple[int, int], rows: slice, count: int) -> np.ndarray:
    """What of the rows of a picture of `count` rows is not under its outermost lenslets."""
    (height, width), columns = block, error.shape[-1]
    first, last = max(height - rows.start, 0), min(count - height, rows.stop) - rows.start
    return error[..., first : max(last, first), width : max(columns - width, width)]


class _Similarity:
    """Mean structural similarity of a picture that comes in bands of rows, each with those of the
    last one that its windows reach into.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.value, self._rows = np.nan, 0
        self._small = min(shape[-2:]) < _WINDOW
        self._held: tuple[np.ndarray, ...] = ()

    def add(self, *pair: np.ndarray) -> None:
        """Count the next band of estimate and truth in, (..., row, column)."""
        if self._small:
            return
        if self._held:
            pair = tuple(np.concatenate(two, axis=-2) for two in zip(self._held, pair))
        rows = pair[0].shape[-2] - _WINDOW + 1
        self._held = tuple(one[..., rows:, :] for one in pair)
        self._rows += rows
        before = 0.0 if self._rows == rows else self.value
        self.value = before + (ssim(*pair) - before) * (rows / self._rows)
