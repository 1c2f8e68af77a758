"""Bright spots of a known size: maxima of the smoothed picture and windowed centroids."""

import numpy as np

WINDOW = (0.25, 0.7)  # sigma and radius, of the pitch; wider windows take in the neighbours
# for superpixels with several bright parts: only the fundamental period is left
WIDE_WINDOW = (0.33, 0.95)
# of the pitch: the middle of a spot, which the frame does not cut in a whole cell
CORE_SIGMA = 0.13


def find_maxima(
    image: np.ndarray, pitch: float, sigma: float = 0.18, threshold: float = 0.06
) -> np.ndarray:
    """Maxima of an image smoothed by a Gaussian; large spots are searched in a picture shrunk by
    whole block means.

    image: (row, column).
    pitch: px.
    sigma: of the Gaussian, pitches.
    threshold: share of the bright level above which a maximum counts.

    Returns (N, 2) px.
    """
    from scipy import ndimage

    shrink = max(1, int(pitch // 10))
    rows, columns = (n // shrink for n in image.shape)
    small = (
        image[: rows * shrink, : columns * shrink]
        .reshape(rows, shrink, columns, shrink)
        .mean(axis=(1, 3))
    )
    smooth = ndimage.gaussian_filter(small, sigma * pitch / shrink, truncate=3.0, mode="nearest")
    size = max(3, 2 * int(0.25 * pitch / shrink) + 1)
    level = np.percentile(smooth[:: max(1, rows // 500), :: max(1, columns // 500)], 98)
    peak = (smooth == ndimage.maximum_filter(smooth, size)) & (smooth > threshold * level)
    return np.argwhere(peak) * float(shrink) + (shrink - 1) / 2


def windowed_centroids(
    image: np.ndarray,
    centres: np.ndarray,
    pitch: float,
    iterations: int = 3,
    window: tuple[float, float] = WINDOW,
    batch_pixels: int = 3_000_000,
) -> tuple[np.ndarray, np.ndarray]:
    """Windowed centroids: where the tapered-Gaussian-weighted first moment vanishes (Newton steps).

    Where the frame cuts a window, only pixels whose mirror image about the centre is also in the
    frame count, so that a cut does not pull.
    image: (row, column).
    centres: (N, 2) px, first guesses.
    pitch: px.
    iterations: Newton steps.
    window: sigma and radius in pitches.
    batch_pixels: that are worked off together.

    Returns positions (N, 2) px and flux (N,): mean of the middle of the spot.
    """
    image = np.ascontiguousarray(image, np.float32)
    centres = np.array(centres, float)
    half = int(np.ceil(window[1] * pitch)) + 1
    flux = np.zeros(len(centres))
    batch = max(1, batch_pixels // (2 * half + 1) ** 2)
    for start in range(0, len(centres), batch):
        part = slice(start, start + batch)
        centres[part], flux[part] = _newton(image, centres[part], pitch, half, iterations, window)
    return centres, flux


def _newton(
    image: np.ndarray,
    centre: np.ndarray,
    pitch: float,
    half: int,
    iterations: int,
    window: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    first = np.rint(centre).astype(int)
    reach = np.arange(-half, half + 1)
    line = [np.clip(first[:, axis, None] + reach, 0, image.shape[axis] - 1) for axis in (0, 1)]
    patch = image[line[0][:, :, None], line[1][:, None, :]]
    offset = centre - first
    variance, radius = (window[0] * pitch) ** 2, window[1] * pitch
    for _ in range(iterations):
        arms = [reach - offset[:, axis, None] for axis in (0, 1)]
        weights, slopes = [], []
        for axis, arm in enumerate(arms):
            edge = image.shape[axis] - 1
            here = first[:, axis, None] + offset[:, axis, None]
            inside = np.abs(arm) <= np.minimum(here, edge - here) + 0.5
            bell, taper = (
                np.exp(-(arm**2) / (2 * variance)) * inside,
                np.clip(1 - (arm / radius) ** 2, 0, None),
            )
            weights.append((bell * taper**2).astype(np.float32))
            slopes.append(
                bell * taper * (taper * (1 - arm**2 / variance) - 4 * (arm / radius) ** 2)
            )
        along = [(patch @ weights[1][:, :, None])[..., 0], (weights[0][:, None, :] @ patch)[:, 0]]
        for axis in (0, 1):
            moment = (along[axis] * weights[axis] * arms[axis]).sum(axis=1)
            # minus the derivative of the moment with the centre
            fall = (along[axis] * slopes[axis]).sum(axis=1)
            least = 0.03 * np.abs(along[axis] * weights[axis]).sum(axis=1) + 1e-30
            offset[:, axis] += np.clip(moment / np.maximum(fall, least), -0.1 * pitch, 0.1 * pitch)
    core = [
        np.exp(-0.5 * ((reach - offset[:, axis, None]) / (CORE_SIGMA * pitch)) ** 2).astype(
            np.float32
        )
        for axis in (0, 1)
    ]
    flux = np.einsum("ny,ny->n", (patch @ core[1][:, :, None])[..., 0], core[0]) / (
        core[0].sum(axis=1) * core[1].sum(axis=1)
    )
    return first + offset, flux
