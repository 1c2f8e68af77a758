"""Whether a capture shows any light, and how much of it is saturated: a word before results that
look like any other.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from plenocli.base.progress import note

CHANCE = 5.0
"""Standard errors of the mean light up to which it is none."""
FEW = 1e-4
"""Share of saturated pixels, such as hot ones, that goes without saying."""


@dataclass(frozen=True, kw_only=True)
class Light:
    """What pixels show.

    pixels: how many are known; saturated: share of these.
    mean, spread: of their light; least, most: the darkest and the brightest.
    """

    pixels: int
    saturated: float
    mean: float
    spread: float
    least: float
    most: float

    @classmethod
    def of(cls, parts: Iterable[tuple[np.ndarray, np.ndarray | None]]) -> Light:
        """Of parts of a capture: light, NaN where unknown, and which pixels are saturated, None
        where nobody says.
        """
        pixels, over, total, squares = 0, 0, 0.0, 0.0
        least, most = math.inf, -math.inf
        for light, clipped in parts:
            there = np.isfinite(light)
            known = light[there].astype(float)
            pixels += known.size
            if clipped is not None:
                over += int(np.count_nonzero(clipped.reshape(light.shape) & there))
            total, squares = total + known.sum(), squares + np.vdot(known, known)
            least, most = known.min(initial=least), known.max(initial=most)
        mean = total / max(pixels, 1)
        spread = math.sqrt(max(squares / max(pixels, 1) - mean**2, 0.0))
        return cls(
            pixels=pixels,
            saturated=over / max(pixels, 1),
            mean=mean,
            spread=spread,
            least=least,
            most=most,
        )

    def told(self) -> str | None:
        """What is wrong, None where nothing is."""
        if self.saturated > FEW:
            return (
                f"{self.saturated:.2%} of the pixels are saturated: what was brighter is unknown; "
                "expose shorter"
            )
        if self.pixels > 1 and self.least == self.most:
            return f"every pixel shows {self.most:.4g}: neither light nor detail; check the capture"
        if self.mean <= CHANCE * self.spread / math.sqrt(max(self.pixels, 1)):
            return "shows no light but noise: check that it is no dark frame"
        return None

    def tell(self, name: str) -> None:
        """A note of what is wrong with the capture of this name."""
        told = self.told()
        if told is not None:
            note(f"warning: {name}: {told}")
