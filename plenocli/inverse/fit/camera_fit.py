"""A camera as its captures say it is, with how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

UNTOLD = 0.5
"""A parameter whose standard deviation stays above this share of its tolerance was not measured."""
TOGETHER = 0.95
"""Parameters with a correlation beyond this cannot be told apart."""


@dataclass(frozen=True, kw_only=True)
class FittedParameter:
    """One parameter of a camera.

    name: as a person says it;
    unit: of the values, "m" or "px";
    described, value: before and after the fit;
    sigma: standard deviation of the value;
    tolerance: standard deviation of what was believed before.
    """

    name: str
    unit: str
    described: float
    value: float
    sigma: float
    tolerance: float

    @property
    def measured(self) -> bool:
        """Whether the captures say more of it than was believed before."""
        return self.sigma < UNTOLD * self.tolerance


@dataclass(frozen=True, kw_only=True)
class CameraFit:
    """What a fit found.

    camera: the fitted one, its shift and remaining uncertainty in its section `fitted`; the
        described one where the fit is not accepted;
    parameters: what was fitted;
    correlation: (parameter, parameter) of their errors;
    accepted: whether the fitted camera explains the captures;
    why: it is accepted or not, a sentence;
    noise_ratio, noise_ratio_before: most likely noise over the noise told, under the fitted and
        under the described camera;
    model_error: relative root mean square error of the fitted matrix that is still expected;
    turned: squared steps over the borders of lenslets under the mirrored camera, whose objects
        are turned by 180 degrees, over those under this one; None where no two lenslets touch;
    matrix: (pixel, point) of `camera`;
    lenslets: how many were looked at.
    """

    camera: Camera
    parameters: tuple[FittedParameter, ...]
    correlation: np.ndarray
    accepted: bool
    why: str
    noise_ratio: float
    noise_ratio_before: float
    model_error: float
    turned: float | None
    matrix: np.ndarray
    lenslets: int

    @property
    def inseparable(self) -> tuple[tuple[str, str], ...]:
        """Pairs of names of parameters that the captures do not tell apart."""
        names = [p.name for p in self.parameters]
        pairs = np.argwhere(np.triu(np.abs(self.correlation) > TOGETHER, 1))
        return tuple((names[i], names[j]) for i, j in pairs)

    def as_json(self) -> dict[str, Any]:
        """The fields by name, without camera and matrix."""
        return {
            "accepted": self.accepted,
            "why": self.why,
            "noise_ratio": self.noise_ratio,
            "noise_ratio_before": self.noise_ratio_before,
            "model_error": self.model_error,
            "turned": self.turned,
            "lenslets": self.lenslets,
            "parameters": {
                p.name: {
                    "unit": p.unit,
                    "described": p.described,
                    "value": p.value,
                    "sigma": p.sigma,
                    "tolerance": p.tolerance,
                    "measured": p.measured,
                }
                for p in self.parameters
            },
            "inseparable": [list(pair) for pair in self.inseparable],
        }
