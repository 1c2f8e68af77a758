"""The noise that reconstruct believes.

One rule, wherever a method needs it: the noise given by the user; else the capture's own; but where
MISFIT times more than that is found in what the system matrix cannot produce, what is found,
doubled as long as photographs would need more contrast than they have to explain the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.base.progress import note
from plenocli.inverse.picture.solvers.least_squares import Svd, estimate_noise

MISFIT = 1.5
"""Noise found over the capture's own from which on it is believed: the capture holds light that
the matrix does not know.
"""
GIVEN, TOLD, FOUND, UNEXPLAINED = (
    "given",
    "from the capture",
    "estimated from what the system matrix cannot produce",
    "what photographs do not explain",
)


@dataclass(frozen=True, kw_only=True)
class NoiseLevel:
    """What is taken for noise.

    sigma: standard deviation of a pixel, in units of A x.
    source: GIVEN, TOLD, FOUND or UNEXPLAINED.
    excess: what was found beyond the capture's own noise, root mean square; None where one of the
        two is not known.
    """

    sigma: float
    source: str
    excess: float | None = None

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


def believed(
    y: np.ndarray,
    known: float | None,
    found: float | None,
    *,
    hint: str = "",
    implausible: Callable[[float], bool] | None = None,
) -> NoiseLevel:
    """What in superpixels is taken for noise.

    What the matrix cannot produce tells of light that it does not know; what it can produce by
    chance of such light looks like an enormous contrast, in which every method would drown.

    y: (.., pixel), in units of A x.
    known: the capture's own noise, standard deviation, or None.
    found: root mean square of what A x does not give, or None where that was not looked at.
    hint: what to do about unknown light, for the note.
    implausible: says of a noise whether photographs would need more contrast than they have to
        explain y.
    """
    # rounding of the data
    floor = max(1e-9 * float(np.abs(y).max(initial=0)), np.finfo(float).tiny)
    sigma, source, excess = max(known or 0.0, floor), TOLD, None
    if found is not None and known:
        excess = float(np.sqrt(max(max(found, floor) ** 2 - known**2, 0.0)))
    if known is None:
        sigma, source = max(found or 0.0, floor), FOUND
        note(f"the capture does not say its noise: sigma = {sigma:.3g}, {FOUND}")
    elif found is not None and found > MISFIT * sigma:
        note(
            f"the capture holds {found / sigma:.3g} times more than its noise that the system "
            f"matrix cannot produce: sigma = {found:.3g} is used{hint}"
        )
        sigma, source = found, FOUND
        while implausible is not None and implausible(sigma):
            sigma, source = 2 * sigma, UNEXPLAINED
        if source == UNEXPLAINED:
            note(
                f"photographs explain this capture only if sigma = {sigma:.3g}: most of the "
                "picture's detail is lost to light that the system matrix does not know"
            )
    return NoiseLevel(sigma=float(sigma), source=source, excess=excess)
