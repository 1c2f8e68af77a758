"""Defective pixels: those that lie too far from what all other pixels of their superpixel tell of
them, whether dark, hot or under dust.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from plenocli.base.tiling import spread_bands
from plenocli.inverse.picture.lenslet_model import Common, alone
from plenocli.inverse.picture.nuisances.pixel_model import CHUNK, PixelModel

FAR = 7.0
"""Standard deviations from which on a pixel is defective."""
AT_ONCE = 0.3
"""Of the largest deviation in its superpixel from which on a pixel is taken for defective in the
same round: smaller ones may be its neighbours, whose prediction it spoils.
"""
ROUNDS = 12
"""Rounds of search at most."""
TYPICAL = 512
"""Lenslets, spread over the capture, that tell how well the pixels are predicted."""
AROUND = 5
"""Pixels (a side) whose prediction is alike: what is wrong with a matrix varies slowly."""
NORMAL = 1.4826
"""Standard deviation over median absolute deviation, of a normal distribution."""


@dataclass(frozen=True, kw_only=True)
class DefectsFound:
    """Pixels that count for nothing and were imputed.

    dark, bright: found below and above what the others tell.
    known: that were known before, to the capture or its calibration.
    pixels: of all lenslets.
    """

    dark: int
    bright: int
    known: int
    pixels: int

    @property
    def found(self) -> bool:
        """Whether there is anything to tell."""
        return self.dark + self.bright + self.known > 0

    @property
    def sentence(self) -> str:
        """What was found, for a person."""
        count = self.dark + self.bright
        known = f", {self.known} were known before" if self.known else ""
        return (
            f"{count} of {self.pixels} pixels ({count / max(1, self.pixels):.3%}) are defective, "
            f"{self.dark} too dark and {self.bright} too bright for their lenslets{known}: they "
            "count for nothing"
        )

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts hold them."""
        return {
            "defects": {
                "dark": self.dark,
                "bright": self.bright,
                "known": self.known,
                "pixels": self.pixels,
            }
        }


@dataclass(frozen=True)
class Spread:
    """How far good pixels lie from their prediction, over the noise: more than 1 where the matrix
    is not quite that of the camera.

    by_pixel: (pixel,).
    """

    by_pixel: np.ndarray

    @classmethod
    def of(cls, model: PixelModel, y: np.ndarray, shape: tuple[int, int]) -> Spread:
        """Of superpixels y (pixel, signal) of `shape` (rows, columns): medians over lenslets and
        pixels around, to which defects do not matter.
        """
        count = y.shape[1]
        some = np.unique(np.linspace(0, count - 1, min(count, TYPICAL)).round().astype(int))
        far = np.empty((len(y), len(some)))

        def look(part: slice) -> None:
            of_part = np.abs(deviation(model, y[:, some[part]]))
            far[:, part] = of_part / by_lenslet(of_part)

        spread_bands(len(some), CHUNK, look)
        middle = NORMAL * np.median(far, axis=1).reshape(shape)
        # as scipy's median_filter, which takes longer to import than all else here
        around = sliding_window_view(np.pad(middle, AROUND // 2, mode="edge"), (AROUND, AROUND))
        return cls(np.median(around, axis=(2, 3)).ravel())

    def over(self, far: np.ndarray) -> np.ndarray:
        """Deviations (pixel, signal) over those of good pixels."""
        return far / np.maximum(1, self.by_pixel[:, None] * by_lenslet(np.abs(far)))


def by_lenslet(far: np.ndarray) -> np.ndarray:
    """Standard deviation of good pixels' deviations, (signal,), from absolute values `far`
    (pixel, signal).
    """
    return np.maximum(NORMAL * np.median(far, axis=0), np.finfo(float).tiny)


def deviation(model: PixelModel, y: np.ndarray) -> np.ndarray:
    """(pixel, signal): each pixel less what the others tell of it, over its standard deviation."""
    rest = model.rest(y)
    return rest.value / (model.sigma * np.sqrt(rest.open))


def find_defects(
    model: PixelModel,
    y: np.ndarray,
    unknown: np.ndarray,
    shape: tuple[int, int],
    common: Common = alone,
) -> tuple[np.ndarray, np.ndarray]:
    """Search for defective pixels, the largest deviations first, those found imputed before the
    next round.

    y: (pixel, signal), unknown ones with any value.
    unknown: (pixel, signal), True where there is nothing to judge.
    shape: (rows, columns) of a superpixel.
    common: gives the Spread, of superpixels that are a part.

    Returns (sign (pixel, signal) int8, -1 of a dark and 1 of a bright one, 0 of all others; y with
    unknown and defective pixels imputed).
    """
    clean, sign = model.impute(y, unknown), np.zeros(y.shape, np.int8)
    usual = common("spread", lambda: Spread.of(model, clean, shape))

    def look(part: slice) -> None:
        clean[:, part], sign[:, part] = _search(
            model, usual, y[:, part], clean[:, part], unknown[:, part]
        )

    spread_bands(y.shape[1], CHUNK, look)
    return sign, clean


def defects_among(
    model: PixelModel, y: np.ndarray, clipped: np.ndarray, lost: np.ndarray
) -> np.ndarray:
    """Which clipped pixels (pixel, signal) are hot: far above what the others tell of them.

    lost: (pixel, signal) that count for nothing.
    """
    hot = np.zeros(y.shape, bool)
    at = np.flatnonzero(clipped.any(axis=0))
    if len(at):
        told = model.impute(y[:, at], (clipped | lost)[:, at])
        sigma = model.uncertainty(told, (clipped | lost)[:, at])
        scale = np.maximum(1, by_lenslet(np.abs(deviation(model, told))))
        hot[:, at] = clipped[:, at] & (y[:, at] - told > FAR * scale * sigma)
    return hot


def _search(
    model: PixelModel, usual: Spread, y: np.ndarray, clean: np.ndarray, unknown: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(clean, sign) of some superpixels, see `find_defects`."""
    clean, bad = clean.copy(), np.zeros(y.shape, bool)
    at = np.arange(y.shape[1])
    for _ in range(ROUNDS):
        far = np.abs(usual.over(deviation(model, clean[:, at])))
        far[bad[:, at] | unknown[:, at]] = 0
        new = far > np.maximum(FAR, AT_ONCE * far.max(axis=0))
        at = at[new.any(axis=0)]
        if not len(at):
            break
        bad[:, at] |= new[:, new.any(axis=0)]
        clean[:, at] = model.impute(y[:, at], bad[:, at] | unknown[:, at])
    if not bad.any():
        return clean, bad.astype(np.int8)
    at = np.flatnonzero(bad.any(axis=0))
    clean[:, at], sign = _confirmed(model, usual, y[:, at], bad[:, at], unknown[:, at])
    signs = np.zeros(y.shape, np.int8)
    signs[:, at] = sign
    return clean, signs


def _confirmed(
    model: PixelModel,
    usual: Spread,
    y: np.ndarray,
    bad: np.ndarray,
    unknown: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """(clean, sign) where pixels that only a defect nearby had spoilt are good again."""
    clean = model.impute(y, bad | unknown)
    sigma = model.uncertainty(clean, bad | unknown)
    scale = np.maximum(1, usual.by_pixel[:, None] * by_lenslet(np.abs(deviation(model, clean))))
    wrong = bad & (np.abs(y - clean) > FAR * scale * sigma)
    if (wrong != bad).any():
        clean = model.impute(y, wrong | unknown)
    return clean, np.where(wrong, np.sign(y - clean), 0).astype(np.int8)
