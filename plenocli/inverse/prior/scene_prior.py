"""What photographs look like to one camera: training pictures, their statistics, and the LMMSE
estimators that rest on them.
"""

from collections.abc import Callable, Collection, Hashable
from pathlib import Path
from typing import TypeVar

import numpy as np

from plenocli.base.random_streams import stream
from plenocli.inverse.picture.lenslet_model import Keep, LensletMatrix, work_out
from plenocli.inverse.picture.nuisances.pixel_model import PixelModel
from plenocli.inverse.picture.solvers import joint_lmmse, lmmse
from plenocli.inverse.picture.solvers.least_squares import Svd
from plenocli.inverse.prior import natural_images
from plenocli.inverse.prior.natural_images import TrainingPicture, at_scales

PATCHES_A_POINT = 6
"""Training patches for the LMMSE covariance, for each object point."""
KEPT = 4
"""Estimators of each kind that are held for captures to come."""

ReadPictures = Callable[[str | None], list[TrainingPicture]]
"""Gives the training pictures without the scene of this name."""

_Key = TypeVar("_Key", bound=Hashable)
_Estimator = TypeVar(
    "_Estimator", lmmse.Lmmse, joint_lmmse.JointLmmse, PixelModel, tuple[np.ndarray, ...]
)


class ScenePrior:
    """Training pictures and the estimators that rest on them, made when first asked for and kept.

    A `scene` is the name of a capture's scene, which training leaves out, or None.
    """

    def __init__(
        self,
        system: LensletMatrix,
        svd: Callable[[], Svd],
        read_pictures: ReadPictures,
        seed: int,
        *,
        keep: Keep = work_out,
    ) -> None:
        """svd: gives that of the own block of `system`; read_pictures: called once a scene; seed:
        of the patches drawn; keep: of what photographs are like, and of what superpixels show of
        them, whatever the noise.
        """
        self.keep = keep
        self.system, self.svd, self.read_pictures, self.seed = system, svd, read_pictures, seed
        self.pictures_of: dict[str | None, list[TrainingPicture]] = {}
        self.statistics: dict[str | None, tuple[np.ndarray, np.ndarray]] = {}
        self._own: dict[tuple[float, str | None], lmmse.Lmmse] = {}
        self._pixels: dict[tuple[float, float, str | None], PixelModel] = {}
        self._joint: dict[tuple[float, str | None], joint_lmmse.JointLmmse] = {}
        self._heard: dict[tuple[float, str | None], tuple[np.ndarray, ...]] = {}
        self._lags: dict[str | None, tuple[float, np.ndarray]] = {}

    def pictures(self, scene: str | None, without: Collection[str] = ()) -> list[np.ndarray]:
        """Linear luminance pictures (row, column) at several scales.

        without: file names of those that are left out.
        """
        if scene not in self.pictures_of:
            self.pictures_of[scene] = at_scales(self.read_pictures(scene), self.system.object_shape)
        return [
            picture for name, picture in self.pictures_of[scene] if Path(name).name not in without
        ]

    def bands(self) -> np.ndarray:
        """Covariance (band, band) of the system's bands at a point, its diagonal 1 on average:
        of the reflectance of surfaces.
        """
        from plenocli.forward.scene.statistics import reflectance_statistics
        from plenocli.forward.scene.tables import surfaces

        if len(self.system.bands) < 2:
            return np.ones((1, 1))
        covariance = reflectance_statistics(surfaces(np.array(self.system.bands)))[1]
        return covariance / np.mean(np.diag(covariance)) + 1e-3 * np.eye(len(covariance))

    def lmmse(self, sigma: float, scene: str | None) -> lmmse.Lmmse:
        """LMMSE of a lenslet by itself, at noise `sigma` of a pixel."""
        if scene not in self.statistics:
            self.statistics[scene] = self._measured(self.pictures(scene))
        mean, covariance = self.statistics[scene]
        return _kept(
            self._own,
            (sigma, scene),
            lambda: lmmse.prepare(
                self.svd(),
                mean,
                covariance,
                sigma,
                self.bands(),
                matrix=[self.system.own],
                keep=self.keep,
            ),
        )

    def pixels(self, sigma: float, scene: str | None, noise: float) -> PixelModel:
        """What pixels of a superpixel tell of each other, by `lmmse`, at `noise` of a pixel."""
        own = self.lmmse(sigma, scene)
        return _kept(self._pixels, (sigma, noise, scene), lambda: PixelModel.of(own, noise))

    def _measured(self, pictures: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of the pictures' patches of an object's size."""
        shape = self.system.object_shape
        count = PATCHES_A_POINT * int(np.prod(shape))

        def measured() -> tuple[np.ndarray, np.ndarray]:
            rng = stream(self.seed, "reconstruct")
            return natural_images.mean_covariance(
                natural_images.draw_patches(pictures, shape, count, rng)
            )

        drawn = np.frombuffer(f"{shape} {count} {self.seed}".encode(), np.uint8)
        mean, covariance = self.keep("photographs", [drawn, *pictures], measured)
        return mean, covariance

    def heard(self, sigma: float, scene: str | None) -> np.ndarray:
        """Directions of a superpixel, (pixel, k), in which photographs matter at noise `sigma` of
        a pixel, the loudest last (joint_lmmse.shown_directions).
        """
        self.lmmse(sigma, scene)  # draws the patches
        covariance, bands = self.statistics[scene][1], self.bands()
        least = joint_lmmse.least_power(self.svd(), covariance, sigma, bands)

        def worked_out() -> tuple[np.ndarray, np.ndarray]:
            return joint_lmmse.shown_directions(self.svd(), covariance, least, bands)

        inputs = [self.system.own, covariance, bands, np.array(least)]
        power, shown = _kept(
            self._heard, (least, scene), lambda: self.keep("shown", inputs, worked_out)
        )
        return shown[:, power > min(joint_lmmse.LOUD * sigma**2, power[-1] / 2)]

    def joint(self, sigma: float, scene: str | None) -> joint_lmmse.JointLmmse:
        """LMMSE of a block from 3x3 superpixels, at noise `sigma` of a pixel, through the loudest
        directions.
        """
        return _kept(self._joint, (sigma, scene), lambda: self._prepared(sigma, scene))

    def _prepared(self, sigma: float, scene: str | None) -> joint_lmmse.JointLmmse:
        system = self.system
        if scene not in self._lags:
            reach = joint_lmmse.needed_reach(system.object_shape, system.offsets)
            pictures = self.pictures(scene)

            def measured() -> tuple[np.ndarray, np.ndarray]:
                mean, lags = natural_images.autocovariance(pictures, reach)
                return np.array([mean]), lags

            mean, lags = self.keep("autocovariance", [np.array(reach), *pictures], measured)
            self._lags[scene] = float(mean[0]), lags
        return joint_lmmse.prepare_joint(
            self.heard(sigma, scene)[:, -joint_lmmse.MOST :],
            system.blocks,
            system.offsets,
            system.object_shape,
            *self._lags[scene],
            sigma,
            self.bands(),
            keep=self.keep,
        )


def _kept(
    held: dict[_Key, _Estimator],
    key: _Key,
    make: Callable[[], _Estimator],
) -> _Estimator:
    """The estimator of this key, made where it is not held; the oldest makes room."""
    if key not in held:
        while len(held) >= KEPT:
            held.pop(next(iter(held)))
        held[key] = make()
    return held[key]
