"""Saturated pixels as censored data: all that is known of them is that they are no darker than
where they were clipped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from plenocli.inverse.picture.nuisances.pixel_model import AtContrast, PixelModel

ROUNDS = 30
"""Changes of the set of pixels that lie above the clipping level, at most."""
CONTRASTS = 6
"""Rounds of contrast and pixels in turn, at most."""
PILE, SHARE = 4, 1e-3
"""A sensor clips where so many times more pixels, and this share of all, have the largest value
than have the next one.
"""


@dataclass(frozen=True, kw_only=True)
class SaturationFound:
    """Pixels that were clipped, and imputed.

    pixels: how many; lenslets: that have some; share: of all pixels.
    declared: whether the capture says where its sensor saturates.
    raised: mean of what they were raised by, over the level at which they were clipped; None where
        they were left as they are.
    """

    pixels: int
    lenslets: int
    share: float
    declared: bool
    raised: float | None = None

    @property
    def found(self) -> bool:
        """Whether there is anything to tell."""
        return self.pixels > 0

    @property
    def sentence(self) -> str:
        """What was found, for a person."""
        how = "" if self.declared else ", by the pile-up at the largest value"
        where = f"{self.share:.2%} of the pixels, in {self.lenslets} lenslets, are saturated{how}: "
        if self.raised is None:
            return where + "the picture is too dark there"
        return where + (
            f"they count as no darker than that, and were raised by {self.raised:.1%} on average; "
            "what was brighter is a guess there"
        )

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts hold them."""
        return {
            "saturated": {
                "pixels": self.pixels,
                "lenslets": self.lenslets,
                "share": self.share,
                "declared": self.declared,
                "raised": self.raised,
            }
        }


def saturation(
    clipped: np.ndarray, *, declared: bool, raised: float | None = None
) -> tuple[SaturationFound, ...]:
    """What there is to tell of clipped pixels (lenslet, pixel): nothing where there are none."""
    if not clipped.any():
        return ()
    return (
        SaturationFound(
            pixels=int(np.count_nonzero(clipped)),
            lenslets=int(np.count_nonzero(clipped.any(axis=1))),
            share=float(np.mean(clipped)),
            declared=declared,
            raised=raised,
        ),
    )


def piled_up(y: np.ndarray) -> float | None:
    """The level at which y (any shape) was clipped although nobody says so, None where it was not:
    the largest value, where it is that of far more pixels than the next one.
    """
    known = y[np.isfinite(y)]
    if not known.size:
        return None
    largest = known.max()
    at_largest = int(np.count_nonzero(known == largest))
    if at_largest < max(2 * PILE, SHARE * known.size):
        return None
    lower = known[known < largest]
    at_next = int(np.count_nonzero(lower == lower.max())) if lower.size else known.size
    return float(largest) if at_largest >= PILE * at_next else None


def censored(model: PixelModel, y: np.ndarray, clipped: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """The most likely superpixel whose clipped pixels are no darker than where they were clipped.

    model: without a veil.
    y: (pixel,) with the level at the clipped ones.
    clipped, lost: (pixel,); of lost ones nothing is known.

    Returns y (pixel,); the contrast is that of the result.
    """
    found, above, last = y, clipped, -1
    for _ in range(CONTRASTS):
        scale = int(model.rest(found[:, None]).scale[0])
        if scale == last:
            break
        found, above = _at_contrast(model.at(scale), y, clipped, lost, above)
        last = scale
    return found


def _at_contrast(
    model: AtContrast, y: np.ndarray, clipped: np.ndarray, lost: np.ndarray, above: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(y, which clipped pixels lie above the level), as `censored`, at one contrast.

    Of the clipped pixels, those that the others put higher take that value; the rest stay where
    they are: the conditions of Kuhn and Tucker of the quadratic problem, by changes of that set.

    above: where to begin.
    """
    above, tried = above.copy(), y.copy()
    for _ in range(ROUNDS):
        tried = np.where(above | lost, tried, y)
        at = np.flatnonzero(above | lost)
        if len(at):
            tried[at] -= model.step(at, model.rest(tried)[at])
        change = clipped & np.where(above, tried < y, model.rest(tried) < -1e-9 * np.abs(y))
        if not change.any():
            break
        above ^= change
    return np.where(clipped, np.maximum(tried, y), tried), above
