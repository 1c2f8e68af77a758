"""Bright spots of a known size: maxima of the smoothed picture and windowed centroids."""

import numpy as np

WINDOW = (0.25, 0.7)  # sigma and radius, of the pitch; wider windows take in the neighbours
WIDE_WINDOW = (0.33, 0.95)  # for superpixels with several bright parts: only the fundamental period is left
SMALL_WINDOW = (0.17, 0.48)
CORE_SIGMA = 0.13  # of the pitch: the middle of a spot, which the frame does not cut in a whole cell


def find_maxima(image, pitch, sigma=0.18, threshold=0.06):
    """Maxima (N, 2), px, of `image` smoothed by a Gaussian of `sigma` pitches, above `threshold` of its bright level.

    Large spots are searched in a picture shrunk by whole block means.
    """
    from scipy import ndimage

    shrink = max(1, int(pitch // 10))
    rows, columns = (n // shrink for n in image.shape)
    small = image[: rows * shrink, : columns * shrink].reshape(rows, shrink, columns, shrink).mean(axis=(1, 3))
    smooth = ndimage.gaussian_filter(small, sigma * pitch / shrink, truncate=3.0, mode="nearest")
    size = max(3, 2 * int(0.25 * pitch / shrink) + 1)
    level = np.percentile(smooth[:: max(1, rows // 500), :: max(1, columns // 500)], 98)
    peak = (smooth == ndimage.maximum_filter(smooth, size)) & (smooth > threshold * level)
    return np.argwhere(peak) * float(shrink) + (shrink - 1) / 2


def windowed_centroids(image, centres, pitch, slope=None, iterations=3, window=WINDOW, clip=None, batch_pixels=3_000_000):
    """Windowed centroids: where the tapered-Gaussian-weighted first moment vanishes (Newton steps).

    image (rows, columns); centres (N, 2) px, first guesses; pitch px; slope: relative illumination gradient
    (N, 2) per px, divided out of each patch; window: sigma and radius in pitches; clip: cut patches at
    this share of their own bright level, which makes edges count more than what a superpixel shows inside. Where the frame cuts a window, only pixels whose mirror image
    about the centre is also in the frame count, so that a cut does not pull.
    Returns positions (N, 2) px and flux (N,): mean of the middle of the spot.
    """
    image = np.ascontiguousarray(image, np.float32)
    centres = np.array(centres, float)
    half = int(np.ceil(window[1] * pitch)) + 1
    flux = np.zeros(len(centres))
    batch = max(1, batch_pixels // (2 * half + 1) ** 2)
    for start in range(0, len(centres), batch):
        part = slice(start, start + batch)
        centres[part], flux[part] = _newton(image, centres[part], pitch, half, None if slope is None else slope[part], iterations, window, clip)
    return centres, flux


def _newton(image, centre, pitch, half, slope, iterations, window, clip):
    first = np.rint(centre).astype(int)
    reach = np.arange(-half, half + 1)
    line = [np.clip(first[:, axis, None] + reach, 0, image.shape[axis] - 1) for axis in (0, 1)]
    patch = image[line[0][:, :, None], line[1][:, None, :]]
    if slope is not None:
        tilt = 1 + slope[:, 0, None, None] * reach[None, :, None] + slope[:, 1, None, None] * reach[None, None, :]
        patch = patch / np.maximum(tilt, 0.2).astype(np.float32)
    if clip is not None:
        positive = np.maximum(patch, 0)
        level = np.einsum("nyx,nyx->n", positive, positive) / np.maximum(positive.sum(axis=(1, 2)), 1e-20)
        patch = np.minimum(patch, (clip * level)[:, None, None].astype(np.float32))
    offset = centre - first
    variance, radius = (window[0] * pitch) ** 2, window[1] * pitch
    for _ in range(iterations):
        arms = [reach - offset[:, axis, None] for axis in (0, 1)]
        weights, slopes = [], []
        for axis, arm in enumerate(arms):
            edge = image.shape[axis] - 1
            here = first[:, axis, None] + offset[:, axis, None]
            inside = np.abs(arm) <= np.minimum(here, edge - here) + 0.5
            bell, taper = np.exp(-(arm**2) / (2 * variance)) * inside, np.clip(1 - (arm / radius) ** 2, 0, None)
            weights.append((bell * taper**2).astype(np.float32))
            slopes.append(bell * taper * (taper * (1 - arm**2 / variance) - 4 * (arm / radius) ** 2))
        along = [(patch @ weights[1][:, :, None])[..., 0], (weights[0][:, None, :] @ patch)[:, 0]]
        for axis in (0, 1):
            moment = (along[axis] * weights[axis] * arms[axis]).sum(axis=1)
            fall = (along[axis] * slopes[axis]).sum(axis=1)  # minus the derivative of the moment with the centre
            least = 0.03 * np.abs(along[axis] * weights[axis]).sum(axis=1) + 1e-30
            offset[:, axis] += np.clip(moment / np.maximum(fall, least), -0.1 * pitch, 0.1 * pitch)
    core = [np.exp(-0.5 * ((reach - offset[:, axis, None]) / (CORE_SIGMA * pitch)) ** 2).astype(np.float32) for axis in (0, 1)]
    flux = np.einsum("ny,ny->n", (patch @ core[1][:, :, None])[..., 0], core[0]) / (core[0].sum(axis=1) * core[1].sum(axis=1))
    return first + offset, flux


def register(image, centres, pitch, rounds=3):
    """Positions (N, 2), px, of superpixels by least squares on their common look (an empirical template).

    image; centres (N, 2) px from a fitted lattice, whole cells within the frame. Each cell is scale * template
    shifted by a part of a pixel + offset; the template is the mean of all. Holds for superpixels of any inner
    structure, where a centroid is drawn to the brightest part. The mean shift is zero: the phase stays the lattice's.
    """
    from scipy.ndimage import map_coordinates

    reach = np.arange(-int(0.55 * pitch), int(0.55 * pitch) + 1.0)
    patches = np.empty((len(centres), len(reach), len(reach)), np.float32)
    centres = np.array(centres, float)
    for _ in range(rounds):
        for i, (row, column) in enumerate(centres):
            grid = np.meshgrid(row + reach, column + reach, indexing="ij")
            patches[i] = map_coordinates(image, grid, order=1, mode="nearest")
        flat = patches.reshape(len(patches), -1)
        template = (flat / np.maximum(flat.mean(axis=1, keepdims=True), 1e-20)).mean(axis=0).reshape(len(reach), -1)
        down, right = np.gradient(template)
        design = np.stack([template.ravel(), down.ravel(), right.ravel(), np.ones(template.size)], axis=1)
        fit = np.linalg.lstsq(design, flat.T.astype(float), rcond=None)[0]
        shift = -fit[1:3].T / np.where(fit[0] > 0, fit[0], np.inf)[:, None]
        centres += np.clip(shift - np.median(shift, axis=0), -0.1 * pitch, 0.1 * pitch)
    return centres
