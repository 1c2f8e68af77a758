"""The noise of a capture: as a person gives it, as the capture says, or as it shows where the
system matrix reaches nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.base.progress import note
from plenocli.inverse.picture.solvers.least_squares import Svd, estimate_noise

GIVEN, TOLD, FOUND = (
    "given",
    "from the capture",
    "estimated from what the system matrix cannot produce",
)


@dataclass(frozen=True, kw_only=True)
class NoiseLevel:
    """The noise of a pixel.

    sigma: standard deviation, in units of A x.
    source: GIVEN, TOLD or FOUND.
    found: root mean square of what the matrix does not give, None where it gives every pattern.
    """

    sigma: float
    source: str
    found: float | None = None

    @property
    def excess(self) -> float | None:
        """What was found beyond the noise, root mean square."""
        if self.found is None:
            return None
        return float(np.sqrt(max(self.found**2 - self.sigma**2, 0.0)))

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts hold them."""
        told: dict[str, Any] = {"noise_sigma": self.sigma, "noise_source": self.source}
        return told if self.excess is None else told | {"excess": self.excess}


def outside(svd: Svd, y: np.ndarray, known: float | None) -> float | None:
    """Root mean square of what no object gives in superpixels.

    svd: of the own block.
    y: (.., pixel).
    known: the capture's own noise, or None.

    Returns None where the matrix reaches every direction and the noise is known anyway.
    Raises NumericsError where it reaches every direction and the noise is not known.
    """
    try:
        return estimate_noise(svd, y.reshape(-1, y.shape[-1]).T)
    except NumericsError:
        if not known:
            raise
        return None


def noise_level(
    y: np.ndarray, given: float | None, known: float | None, svd: Svd, own: np.ndarray
) -> NoiseLevel:
    """The noise of superpixels.

    y: (.., pixel), in units of A x.
    given: standard deviation by a person, or None.
    known: the capture's own, or None.
    svd: of the own block.
    own: superpixels without the neighbours' light, as far as that is known.

    Raises NumericsError where it is not known and the matrix reaches every pixel pattern.
    """
    # rounding of the data
    floor = max(1e-9 * float(np.abs(y).max(initial=0)), np.finfo(float).tiny)
    if given is not None:
        return NoiseLevel(sigma=float(given), source=GIVEN, found=outside(svd, own, given))
    found = outside(svd, own, known)
    if known is not None:
        return NoiseLevel(sigma=max(known, floor), source=TOLD, found=found)
    sigma = max(found or 0.0, floor)
    note(f"the capture does not say one noise of all pixels: sigma = {sigma:.3g}, {FOUND}")
    return NoiseLevel(sigma=sigma, source=FOUND, found=found)
