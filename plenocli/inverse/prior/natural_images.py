"""What natural images look like to one lenslet: training patches, their mean and covariance,
their autocovariance.
"""

from collections.abc import Sequence

import numpy as np

from plenocli.base.progress import note
from plenocli.inverse.prior.shelf import Shelf

TrainingPicture = tuple[str, np.ndarray]
"""Name and linear luminance (row, column) in [0, 1]."""

SCALES = (1, 2, 4)
"""Scenes come in all sizes: training pictures are taken at these reductions."""


def split_by_scene(
    pictures: list[TrainingPicture],
) -> tuple[list[TrainingPicture], list[TrainingPicture]]:
    """(training, held out): every fifth picture, from the third on, judges; one picture
    alone has to do both.
    """
    if len(pictures) == 1:
        note(
            "one training picture only: the validation patches come from it too, "
            "so the figures flatter"
        )
        return pictures, pictures
    held = set(range(2, len(pictures), 5)) or {len(pictures) - 1}
    return [p for k, p in enumerate(pictures) if k not in held], [pictures[k] for k in sorted(held)]


def at_scales(
    pictures: Sequence[TrainingPicture], shape: tuple[int, int], *, limit: int | None = None
) -> list[TrainingPicture]:
    """The pictures and their area averages by SCALES, as long as two blocks fit.

    shape: (rows, columns) of a block.
    limit: bytes beyond which the averages lie in a temporary file.
    """
    from plenocli.forward.scene.sample import block_mean

    out, shelf = [], Shelf(limit)
    for name, picture in pictures:
        for k in SCALES:
            rows, columns = (n // k * k for n in picture.shape)
            if k == 1:
                out.append((name, picture))
            elif min(rows // k - 2 * shape[0], columns // k - 2 * shape[1]) >= 0:
                reduced = block_mean(np.asarray(picture[:rows, :columns], float), (k, k))
                out.append((name, shelf.keep(reduced)))
    return out


def draw_patches(
    images: Sequence[np.ndarray],
    shape: tuple[int, int],
    count: int,
    rng: np.random.Generator,
    *,
    flips: bool = True,
) -> np.ndarray:
    """Random patches of natural images, as columns.

    images: arrays (row, column) of linear luminance in [0, 1]; one is drawn with probability
        proportional to the number of its patch positions, a position uniformly.
    shape: (rows, columns) of a patch, not more than those of an image.
    count: of patches.
    rng: the random stream.
    flips: mirror at random, which leaves the statistics of natural scenes alone and doubles what
        few photographs have to say.

    Returns (point, count) float64, points numbered row by row.
    Raises ValueError where an image is smaller than a patch.
    """
    rows, columns = shape
    room = [(i.shape[0] - rows + 1, i.shape[1] - columns + 1) for i in images]
    if not room or min(min(r) for r in room) < 1:
        raise ValueError(f"every training image must have at least {rows} x {columns} pixels")
    share = np.array([r * c for r, c in room], float)
    which = rng.choice(len(images), size=count, p=share / share.sum())
    place = rng.random((count, 2))
    mirror = rng.integers(0, 2, (count, 2)) if flips else np.zeros((count, 2), int)
    corner = (place * np.array(room)[which]).astype(int)
    # written one by one, which columns of a matrix would make slow
    patches = np.empty((count, rows, columns))
    for patch, image, (r, c), (down, right) in zip(
        patches, which.tolist(), corner.tolist(), mirror.tolist()
    ):
        patch[:] = images[image][r : r + rows, c : c + columns][
            :: -1 if down else 1, :: -1 if right else 1
        ]
    return patches.reshape(count, -1).T


def mean_covariance(patches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (point,) and covariance (point, point) of patches (point, count)."""
    mean = patches.mean(axis=1)
    centred = patches - mean[:, None]
    return mean, centred @ centred.T / max(patches.shape[1] - 1, 1)


def autocovariance(images: Sequence[np.ndarray], reach: int) -> tuple[float, np.ndarray]:
    """Mean and autocovariance of images taken as one stationary field.

    images: arrays (row, column).
    reach: largest lag (points) each way.

    Returns (mean, C (row lag, column lag)), lag (dr, dc) at C[dr + reach, dc + reach].

    Each image's overlap-normalised autocovariance about the common mean, weighted by its pixels,
    made symmetric under reversal of either axis. Lags beyond half an image's side rest on few
    pairs, and are tapered to zero from there. What is measured so is not quite an autocovariance:
    as one period of a periodic field its spectrum dips below zero (for photographs by a thousandth
    of the variance or less in all). It is cut there, the variance kept, so that points with all
    their lags within `reach` have a covariance.
    """
    from scipy.fft import irfft2, next_fast_len, rfft2

    total, overlap = np.zeros((2 * reach + 1,) * 2), np.zeros((2 * reach + 1,) * 2)
    mean = np.sum([i.sum(dtype=float) for i in images]) / np.sum([i.size for i in images])
    lags = np.arange(-reach, reach + 1)
    for image in images:
        shape = [next_fast_len(n + reach, real=True) for n in image.shape]
        lag_sum = irfft2(np.abs(rfft2(np.asarray(image, float) - mean, shape)) ** 2, shape)
        pairs = np.outer(*(np.maximum(n - np.abs(lags), 0) for n in image.shape))
        total += np.where(pairs > 0, lag_sum[np.ix_(lags, lags)], 0)
        overlap += pairs
    field = total / np.maximum(overlap, 1)
    field = (field + field[::-1] + field[:, ::-1] + field[::-1, ::-1]) / 4
    half = np.median([min(i.shape) for i in images]) / 2
    taper = (
        np.cos(np.pi / 2 * np.clip((np.abs(lags) - half) / max(reach - half, 1), 0, 1)) ** 2
        if reach > half
        else 1.0 + 0 * lags
    )
    field *= taper[:, None] * taper[None, :]
    proper = np.fft.fftshift(
        np.fft.ifft2(np.maximum(np.fft.fft2(np.fft.ifftshift(field)).real, 0)).real
    )
    return float(mean), proper * (
        field[reach, reach] / max(proper[reach, reach], np.finfo(float).tiny)
    )
