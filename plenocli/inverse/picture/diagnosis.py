"""What a picture cannot show: directions below the noise, and what a wrong matrix may cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from plenocli.base.progress import note
from plenocli.inverse.picture.estimators import Estimators
from plenocli.inverse.picture.lenslet_model import Superpixels
from plenocli.inverse.picture.reconstruction import Reconstruction
from plenocli.inverse.picture.solvers.least_squares import resolution

CONTRAST = 0.1
"""What a point of a photograph differs from its lenslet's brightness, standard deviation: the
measure of what noise hides.
"""
HIDDEN = 3.0
"""What is wrong with a capture, over what is found of it: objects imitate the rest
(docs/model.md, "Spatial reconstruction").
"""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What of an object the own superpixel tells apart.

    by_point: (row, column) from 0 (in the null space) to 1, mean of the bands.
    share: its mean.
    directions: that stand above the noise.
    points: of the object, all bands together.
    by_band: share of each band, where there are several.
    symmetric: whether an object and itself turned look alike.
    """

    by_point: np.ndarray
    share: float
    directions: int
    points: int
    by_band: tuple[float, ...] | None
    symmetric: bool

    def as_json(self) -> dict[str, Any]:
        """All but the map, as artefacts and summaries hold it."""
        told: dict[str, Any] = {
            "share": self.share,
            "directions": self.directions,
            "points": self.points,
        }
        told |= {} if self.by_band is None else {"bands": list(self.by_band)}
        return told | ({"symmetric": True} if self.symmetric else {})


def what_is_seen(estimators: Estimators, sigma: float) -> Seen:
    """What is seen at noise `sigma` of a pixel; a note where half of the object is not."""
    from plenocli.forward.propagation.diagnosis import SYMMETRY_WARNING, symmetry_defect

    svd, system = estimators.svd, estimators.system
    share = resolution(svd, sigma, CONTRAST).reshape(-1, *system.object_shape)
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
        directions=int(np.count_nonzero(svd.s * CONTRAST > sigma)),
        points=share.size,
        by_band=tuple(share.mean(axis=(1, 2)).tolist()) if len(share) > 1 else None,
        symmetric=symmetric,
    )


def loss_db(
    estimators: Estimators, data: Superpixels, found: Reconstruction, error: float
) -> float | None:
    """How much larger than what LMMSE expects of a capture that is A x and noise alone the error of
    the picture is at most.

    HIDDEN times the error of the matrix and what the capture holds beyond noise may all fall upon
    the few directions that are seen, where noise has only their share of the pixels: with so much
    more noise LMMSE's error is reckoned. The picture of another method is off by no more than that
    and its distance from LMMSE's.

    data: the capture.
    found: its picture.
    error: of the matrix, root mean square of a pixel.

    Returns dB, None where that is not known, or where the method has no use for the statistics of
    photographs.
    """
    excess = None if found.noise_level is None else found.noise_level.excess
    if excess is None or found.from_lmmse is None or data.sigma is None:
        return None
    svd = estimators.svd
    share = max(1, int(np.count_nonzero(svd.s * CONTRAST > data.sigma))) / len(svd.u)
    wrong = HIDDEN * np.hypot(excess, error) / np.sqrt(share)
    scale = 1.0 if found.scale is None else found.scale
    now, known = (
        estimators.prior.lmmse(float(sigma), data.scene).expected(scale)
        for sigma in (np.hypot(data.sigma, wrong), data.sigma)
    )
    return 20 * float(np.log10((now + found.from_lmmse) / known))
