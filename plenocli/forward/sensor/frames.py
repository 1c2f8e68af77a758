"""Exposures of one scene made into one image: dark removed, exposure divided out, saturation
masked, noise measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from plenocli.base.errors import InputError
from plenocli.base.text import by
from plenocli.base.tiling import EVERYTHING, Plane
from plenocli.forward.sensor.noise import Noise

# of the way from black to the white level: averaging electronics saturate softly
SATURATION = 0.985
SAME_EXPOSURE = 0.01
REACH = 1e12
"""Of white, beyond which sums of squares in single precision overflow sooner or later."""


@dataclass(frozen=True, kw_only=True)
class Dark:
    """What the sensor reports without light.

    mean: (row, column) DN at `exposure`; a Plane where it stays in its file.
    black: (2, 2) by position, DN.
    exposure: s, None where unknown.
    sigma: temporal noise of one frame, DN; None where no dark frame was given.
    variance: of the mean itself, DN^2.
    """

    mean: np.ndarray
    black: np.ndarray
    exposure: float | None
    sigma: float | None
    variance: float = 0.0

    @cached_property
    def flat(self) -> bool:
        """Whether the dark image is the black level everywhere."""
        level = np.asarray(self.black, self.mean.dtype)
        return all((self.mean[i::2, j::2] == level[i, j]).all() for i, j in np.ndindex(2, 2))

    def rows(self, rows: slice) -> Dark:
        """That of some rows of the sensor, from an even one on, in memory."""
        return replace(self, mean=Plane.of(self.mean).read(rows, EVERYTHING))

    def growth(self, exposure: float | None) -> np.float32 | None:
        """Factor by which the part above the black level grows at another exposure (s), None where
        the dark image is the same.
        """
        if (
            self.exposure is None
            or exposure is None
            or abs(exposure / self.exposure - 1) < SAME_EXPOSURE
        ):
            return None
        return np.float32(exposure / self.exposure)

    def at(self, exposure: float | None) -> np.ndarray:
        """Expected dark image (row, column), DN, at another exposure (s): the part above the black
        level grows with time.
        """
        growth = self.growth(exposure)
        if growth is None:
            return self.mean
        level = tiled(self.black, self.mean.shape)
        return level + (self.mean - level) * growth


def tiled(level: ArrayLike, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> np.ndarray:
    """A (2, 2) level by position, repeated over (rows, columns)."""
    rows, columns = shape
    return np.tile(np.asarray(level, dtype), ((rows + 1) // 2, (columns + 1) // 2))[:rows, :columns]


def make_dark(
    frames: Sequence[np.ndarray],
    exposures: Sequence[float | None],
    black: ArrayLike,
    shape: tuple[int, ...],
) -> Dark:
    """Dark from dark frames (possibly none): the mean of those at the longest exposure, noise from
    differences.

    Without frames the black level stands for the dark image. The noise of a single frame is a
    robust spread over pixels, at least the rounding's.
    frames: (row, column) each, DN.
    exposures: s or None each.
    black: (2, 2) by position, DN.
    shape: (rows, columns) of the sensor.
    """
    if not frames:
        return Dark(
            mean=tiled(black, shape), black=np.asarray(black, float), exposure=None, sigma=None
        )
    longest = max((e for e in exposures if e is not None), default=None)
    chosen = [
        np.asarray(f, np.float32)
        for f, e in zip(frames, exposures)
        if longest is None or (e and abs(e / longest - 1) < SAME_EXPOSURE)
    ]
    mean = np.asarray(sum(chosen) / np.float32(len(chosen)))
    if len(chosen) > 1:
        spread = float(
            np.sqrt(np.mean([np.var(a - b) / 2 for a, b in zip(chosen[::2], chosen[1::2])]))
        )
    else:
        low, high = np.percentile((mean - tiled(black, shape))[::3, ::3], [15.87, 84.13])
        spread = float(high - low) / 2
    spread = max(spread, 1 / np.sqrt(12))
    return Dark(
        mean=mean,
        black=np.asarray(black, float),
        exposure=longest,
        sigma=spread,
        variance=spread**2 / len(chosen),
    )


def saturated(values: np.ndarray, black: ArrayLike, white: float | None) -> np.ndarray:
    """Mask of pixels at or near the white level.

    values: (row, column) DN.
    black: (2, 2) by position, DN.
    white: DN; None or inf where unknown: then nothing is saturated.
    """
    if white is None or not np.isfinite(white):
        return np.zeros(values.shape, bool)
    top = tiled(np.asarray(black) + SATURATION * (white - np.asarray(black)), values.shape)
    return values >= top


def require_sensor(
    shape: Sequence[int], calibrated: Sequence[int], path: str | Path | None
) -> None:
    """InputError for a capture of another sensor than that of its calibration.

    shape, calibrated: (rows, columns) px.
    path: of the capture.
    """
    if tuple(shape) != tuple(calibrated):
        raise InputError(
            f"is {by(shape)} px, the calibration {by(calibrated)}",
            path,
            "use captures of the calibrated camera",
        )


def require_in_reach(signal: np.ndarray, path: str | Path | None, brightest: float = 1.0) -> None:
    """InputError for light that is no sensor's, as of a file in another unit.

    signal: of any shape; NaN where unknown.
    path: of the capture.
    brightest: white, in the unit of the signal.
    """
    most = max(float(np.fmax.reduce(side, axis=None, initial=0)) for side in (signal, -signal))
    most /= brightest
    if most > REACH:
        raise InputError(
            f"has pixels of {most:.2g} times the light of white",
            path,
            "give it in the unit of its white image, as the sensor counts",
        )


def merge(
    frames: Sequence[np.ndarray],
    exposures: Sequence[float | None],
    dark: Dark,
    white: float | None,
    reference: float | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean signal of several frames, at one exposure time.

    sum of (frame - dark) over sum of exposures, saturated pixels left out: the least-noise average
    of shot-limited frames.
    frames: (row, column) each, DN.
    exposures: s each, or all None (taken as equal).
    white: saturation level, DN.
    reference: exposure time of the signal, s, None where unknown.

    Returns signal (row, column) float32 DN, NaN where never good, and weight (row, column), good
    exposure time in units of the reference: the variance of the signal is that of one frame
    (Noise.variance) over the weight, for frames near that exposure.
    """
    total: np.ndarray | float = 0.0
    time: np.ndarray | float = 0.0
    for frame, exposure in zip(frames, exposures):
        good = ~saturated(frame, dark.black, white)
        share = 1.0 if exposure is None or reference is None else exposure / reference
        total = total + np.where(good, np.asarray(frame, np.float32) - dark.at(exposure), 0)
        time = time + good.astype(np.float32) * np.float32(share)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(time > 0, total / time, np.nan).astype(np.float32), np.asarray(time)


def photon_transfer(
    first: np.ndarray, second: np.ndarray, limit: float = np.inf, bins: int = 24
) -> Noise | None:
    """The sensor's noise from two frames of one still scene.

    Half the variance of the difference against the mean, by bins of the mean; a straight line
    through the bins.
    first, second: (row, column) signals, DN.
    limit: largest mean of the two that counts, DN.
    bins: how many of about equal numbers of pixels.

    Returns gain and read variance, None where the picture has no range of levels.
    EMVA Standard 1288, photon transfer method.
    """
    first, second = np.asarray(first, float).ravel(), np.asarray(second, float).ravel()
    mean, half = (first + second) / 2, (first - second) ** 2 / 2
    good = np.isfinite(mean) & (mean < limit)
    if good.sum() < 1000:
        return None
    mean, half = mean[good], half[good]
    edges = np.unique(np.quantile(mean, np.linspace(0, 1, bins + 1)))
    if len(edges) < 5:
        return None
    which = np.clip(np.searchsorted(edges, mean, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(which, minlength=len(edges) - 1)
    full = count > 50
    if full.sum() < 4:
        return None
    x = np.bincount(which, mean, len(count))[full] / count[full]
    y = np.bincount(which, half, len(count))[full] / count[full]
    # the variance of a variance goes with its square
    weight = np.sqrt(count[full]) / np.maximum(y, 1e-12)
    slope, offset = np.linalg.lstsq(
        np.stack([x, np.ones_like(x)], axis=1) * weight[:, None], y * weight, rcond=None
    )[0]
    return Noise(gain=float(slope), read_variance=float(max(offset, 0.0))) if slope > 0 else None


def bad_pixels(white: np.ndarray, dark: Dark, top: float | None, step: int) -> np.ndarray:
    """Mask of pixels that do not follow the light: dead in the white image, or hot in the dark one.

    white: (row, column) signal, NaN where saturated, DN.
    top: white level, DN.
    step: px from a pixel to the next of its colour: 1 mono, 2 mosaic.
    """
    bad = dead_pixels(np.nan_to_num(white), step)
    if dark.sigma is not None:
        level = tiled(dark.black, dark.mean.shape)
        excess = dark.mean - level - np.median((dark.mean - level)[::3, ::3])
        scale = top if top is not None and np.isfinite(top) else np.nanmax(white)
        bad |= excess > max(12 * dark.sigma, 0.02 * scale)
    return bad


def dead_pixels(image: np.ndarray, step: int = 1) -> np.ndarray:
    """Mask of pixels far outside the range of their four neighbours `step` px away: dead, or
    hot.
    """
    neighbours = shifted_neighbours(image, step)
    high, low = np.maximum.reduce(neighbours), np.minimum.reduce(neighbours)
    sample = (image - high)[::7, ::7]
    noise = 1.48 * np.median(np.abs(sample - np.median(sample)))
    return (image > 3 * np.abs(high) + 6 * noise) | (image < low / 3 - 3 * noise)


def shifted_neighbours(image: np.ndarray, step: int) -> list[np.ndarray]:
    """The image moved by `step` px in the four directions, mirrored at its edges."""
    padded = np.pad(image, step, mode="reflect")
    rows, columns = image.shape
    return [
        padded[:rows, step : step + columns],
        padded[2 * step :, step : step + columns],
        padded[step : step + rows, :columns],
        padded[step : step + rows, 2 * step :],
    ]
