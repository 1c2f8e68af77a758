"""What a picture cannot show: directions below the noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from plenocli.base.progress import note
from plenocli.inverse.picture.estimators import Estimators
from plenocli.inverse.picture.solvers.least_squares import resolution
from plenocli.inverse.picture.solvers.lmmse import Lmmse

CONTRAST = 0.1
"""What a point of a photograph differs from its lenslet's brightness, standard deviation: the
measure of what noise hides.
"""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What of an object the own superpixel tells apart.

    by_point: (row, column) from 0 (in the null space) to 1, mean of the bands.
    share: its mean.
    degrees: degrees of freedom that the data determine: the trace of the influence of LMMSE with
        the contrasts that it finds, a mean over the lenslets.
    points: of the object, all bands together.
    by_band: share of each band, where there are several.
    symmetric: whether an object and itself turned look alike.
    """

    by_point: np.ndarray
    share: float
    degrees: float
    points: int
    by_band: tuple[float, ...] | None
    symmetric: bool

    def as_json(self) -> dict[str, Any]:
        """All but the map, as artefacts and summaries hold it."""
        told: dict[str, Any] = {
            "share": self.share,
            "degrees_of_freedom": self.degrees,
            "points": self.points,
        }
        told |= {} if self.by_band is None else {"bands": list(self.by_band)}
        return told | ({"symmetric": True} if self.symmetric else {})


def what_is_seen(estimators: Estimators, y: np.ndarray, lmmse: Lmmse) -> Seen:
    """What is seen at the noise of an LMMSE; a note where half of the object is not.

    y: (lenslet_row, lenslet_column, pixel) own light.
    """
    from plenocli.forward.propagation.diagnosis import SYMMETRY_WARNING, symmetry_defect

    svd, system = estimators.svd, estimators.system
    share = resolution(svd, lmmse.sigma, CONTRAST).reshape(-1, *system.object_shape)
    own = system.own.reshape(-1, share[0].size)
    symmetric = bool(symmetry_defect(own) < SYMMETRY_WARNING)
    if symmetric:
        note(
            "half of the object cannot be seen: object points opposite each other about the "
            "lenslet's axis give the same superpixel, and only their sum is measured (move "
            "the sensor out of the pupil's conjugate plane)"
        )
    return Seen(
        by_point=share.mean(axis=0),
        share=float(share.mean()),
        degrees=lmmse.degrees(y.reshape(-1, y.shape[2]).T),
        points=share.size,
        by_band=tuple(share.mean(axis=(1, 2)).tolist()) if len(share) > 1 else None,
        symmetric=symmetric,
    )
