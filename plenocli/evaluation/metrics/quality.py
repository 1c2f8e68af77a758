"""Quality of a picture against its truth.

Pictures are (..., row, column) with linear values; white is 1.0 and that is the peak of the PSNR,
whatever the picture's own maximum. Nothing is clipped or rounded here. See
docs/model.md, "Measures".
"""

import numpy as np

from plenocli.forward.scene.sample import block_mean

PEAK = 1.0

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
    "loss_at_most_db": (
        "how much larger the error is at most than what LMMSE expects where the system matrix is "
        "right and knows all of the light; dB"
    ),
    "seen_share": (
        "share of the directions of a lenslet's object that stand above the capture's noise; the "
        "rest lies in the null space and is filled in by the method"
    ),
}


def _pair(estimate, truth):
    estimate, truth = (np.asarray(values, dtype=np.float64) for values in (estimate, truth))
    if estimate.shape != truth.shape:
        raise ValueError(f"estimate is {estimate.shape}, truth is {truth.shape}")
    return estimate, truth


def rmse(estimate, truth):
    """Root mean squared error over all samples, in the unit of the samples."""
    estimate, truth = _pair(estimate, truth)
    return float(np.sqrt(np.mean((estimate - truth) ** 2)))


def psnr(estimate, truth):
    """Peak signal-to-noise ratio in dB with peak 1.0: -20 log10(rmse); infinite
    for equal pictures.
    """
    error = rmse(estimate, truth)
    return float("inf") if error == 0 else float(-20 * np.log10(error / PEAK))


def inner(values, block, border=1):
    """`values` (..., row, column) without `border` rings of lenslets of `block` (h, w) samples;
    None if nothing is left.
    """
    (height, width), (rows, cols) = block, np.shape(values)[-2:]
    top, left = border * height, border * width
    if rows <= 2 * top or cols <= 2 * left:
        return None
    return np.asarray(values)[..., top : rows - top, left : cols - left]


def ssim(estimate, truth):
    """Mean structural similarity, -1..1, with data range 1.0; bands of a (band, row, column)
    cube are averaged.

    Window and constants of Wang et al., IEEE Trans. Image Processing 13 (2004) 600-612. None for
    pictures smaller than the window of 11 x 11 samples.
    """
    from skimage.metrics import structural_similarity

    estimate, truth = _pair(estimate, truth)
    if min(truth.shape[-2:]) < 11:
        return None
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


def block_mean_baseline(truth, block):
    """The truth with each lenslet's block (h, w) replaced by its mean; same shape as `truth`
    (..., row, column).
    """
    means = block_mean(truth, block)
    return np.repeat(np.repeat(means, block[0], axis=-2), block[1], axis=-1)


def score_picture(estimate, truth, block=None):
    """All measures of DEFINITIONS for one picture, a dict of floats (None where
    one does not apply).

    block: samples of the object grid under one lenslet (h, w); without it the lenslet-wise
        measures are left out.
    """
    estimate, truth = _pair(estimate, truth)
    scores = {
        "psnr_db": psnr(estimate, truth),
        "psnr_clipped_db": psnr(np.clip(estimate, 0, PEAK), truth),
        "rmse": rmse(estimate, truth),
        "ssim": ssim(estimate, truth),
    }
    if block is not None:
        middle = inner(estimate, block)
        scores["psnr_inner_db"] = None if middle is None else psnr(middle, inner(truth, block))
        baseline = psnr(block_mean_baseline(truth, block), truth)
        scores["block_mean_psnr_db"] = baseline
        scores["gain_over_block_mean_db"] = (
            scores["psnr_db"] - baseline if np.isfinite(baseline) else None
        )
    return scores
