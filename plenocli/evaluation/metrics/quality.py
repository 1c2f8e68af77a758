"""Quality of a picture against its truth.

Pictures are (..., row, column) with linear values; white is 1.0 and that is the peak of the PSNR,
whatever the picture's own maximum. Nothing is clipped or rounded here. See
docs/model.md, "Measures".
"""

from dataclasses import dataclass

import numpy as np

from plenocli.forward.scene.sample import block_mean

PEAK = 1.0
INTERVAL = 1.96
"""Standard deviations, each way, of an interval of 95 %."""

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


def _pair(estimate: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    estimate, truth = (np.asarray(values, dtype=np.float64) for values in (estimate, truth))
    if estimate.shape != truth.shape:
        raise ValueError(f"estimate is {estimate.shape}, truth is {truth.shape}")
    return estimate, truth


def rmse(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Root mean squared error over all samples, in the unit of the samples."""
    estimate, truth = _pair(estimate, truth)
    return float(np.sqrt(np.mean((estimate - truth) ** 2)))


def psnr(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio with peak 1.0.

    estimate, truth: (..., row, column), linear, white is 1.

    Returns -20 log10(rmse), dB; infinite for equal pictures.
    """
    error = rmse(estimate, truth)
    return float("inf") if error == 0 else float(-20 * np.log10(error / PEAK))


def inner(values: np.ndarray, block: tuple[int, int], border: int = 1) -> np.ndarray | None:
    """A picture without its outer lenslets.

    values: (..., row, column).
    block: (rows, columns) of samples under a lenslet.
    border: rings of lenslets that are left out.

    Returns a view of (..., row, column), None if nothing is left.
    """
    (height, width), (rows, cols) = block, np.shape(values)[-2:]
    top, left = border * height, border * width
    if rows <= 2 * top or cols <= 2 * left:
        return None
    return np.asarray(values)[..., top : rows - top, left : cols - left]


def ssim(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Mean structural similarity with data range 1.0.

    estimate, truth: (row, column), or (band, row, column), whose bands are averaged.

    Returns -1 to 1; NaN for pictures smaller than the window of 11 x 11 samples.
    Wang et al., IEEE Trans. Image Processing 13 (2004) 600-612 (window and constants).
    """
    from skimage.metrics import structural_similarity

    estimate, truth = _pair(estimate, truth)
    if min(truth.shape[-2:]) < 11:
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


def coverage(estimate: np.ndarray, truth: np.ndarray, sigma: np.ndarray) -> float:
    """Share of the samples whose interval of 95 % holds the truth.

    estimate, truth, sigma: of one shape; sigma is half the width of the interval over INTERVAL.
    """
    return float(np.mean(np.abs(estimate - truth) <= INTERVAL * sigma))


def block_mean_baseline(truth: np.ndarray, block: tuple[int, int]) -> np.ndarray:
    """The truth with each lenslet's block replaced by its mean.

    truth: (..., row, column).
    block: (rows, columns) of samples under a lenslet.

    Returns an array like truth.
    """
    means = block_mean(truth, block)
    return np.repeat(np.repeat(means, block[0], axis=-2), block[1], axis=-1)


def score_picture(
    estimate: np.ndarray,
    truth: np.ndarray,
    block: tuple[int, int] | None = None,
    sigma: np.ndarray | None = None,
) -> PictureScore:
    """All measures of DEFINITIONS for one picture.

    estimate, truth: (..., row, column), linear, white is 1.
    block: (rows, columns) of samples under one lenslet; without it the lenslet-wise measures
        are left out.
    sigma: predicted standard deviation, like estimate.
    """
    estimate, truth = _pair(estimate, truth)
    whole = psnr(estimate, truth)
    return PictureScore(
        psnr_db=whole,
        psnr_clipped_db=psnr(np.clip(estimate, 0, PEAK), truth),
        rmse=rmse(estimate, truth),
        ssim=ssim(estimate, truth),
        interval_coverage=None if sigma is None else coverage(estimate, truth, sigma),
        lenslets=None if block is None else _score_lenslets(estimate, truth, whole, block),
    )


def _score_lenslets(
    estimate: np.ndarray, truth: np.ndarray, whole: float, block: tuple[int, int]
) -> LensletScore:
    """Measures that need the blocks; `whole`: PSNR of the whole picture, dB."""
    middle, true_middle = inner(estimate, block), inner(truth, block)
    baseline = psnr(block_mean_baseline(truth, block), truth)
    return LensletScore(
        np.nan if middle is None or true_middle is None else psnr(middle, true_middle),
        baseline,
        whole - baseline if np.isfinite(baseline) else np.nan,
    )
