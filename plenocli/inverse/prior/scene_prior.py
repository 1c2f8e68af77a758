"""What photographs look like to one camera: training pictures, their statistics, and the LMMSE
estimators that rest on them.
"""

from pathlib import Path

import numpy as np

from plenocli.base.random_streams import stream
from plenocli.files.read.training import at_scales, read_training

PATCHES_A_POINT = 6
"""Training patches for the LMMSE covariance, for each object point."""
KEPT = 8
"""Estimators that are held for captures to come."""


class ScenePrior:
    """Training pictures and estimators for a System and its Svd, made when first
    asked for and kept.

    training: names of pictures, () for those of scikit-image. scene: name of a capture's scene,
        which is left out.
    """

    def __init__(self, system, svd, training, seed):
        self.system, self.svd, self.training, self.seed = system, svd, training, seed
        self.pictures_of, self._statistics, self._estimators = {}, {}, {}

    def pictures(self, scene, without=()):
        """Linear luminance pictures (row, column) at several scales;

        without: file names of those that are left out.
        """
        if scene not in self.pictures_of:
            shape = self.system.object_shape
            self.pictures_of[scene] = at_scales(
                read_training(self.training, shape, not_scene=scene), shape
            )
        return [
            picture for name, picture in self.pictures_of[scene] if Path(name).name not in without
        ]

    def bands(self):
        """Covariance (band, band) of the system's bands at a point, its diagonal 1 on average:
        of the reflectance of surfaces.
        """
        from plenocli.forward.scene.statistics import reflectance_statistics
        from plenocli.forward.scene.tables import surfaces

        if len(self.system.bands) < 2:
            return np.ones((1, 1))
        covariance = reflectance_statistics(surfaces(np.array(self.system.bands)))[1]
        return covariance / np.mean(np.diag(covariance)) + 1e-3 * np.eye(len(covariance))

    def lmmse(self, sigma, scene):
        """solvers.lmmse.Lmmse of a lenslet by itself, at noise sigma."""
        from plenocli.inverse.picture import lmmse
        from plenocli.inverse.prior import natural_images as natural

        if scene not in self._statistics:
            count = PATCHES_A_POINT * int(np.prod(self.system.object_shape))
            patches = natural.draw_patches(
                self.pictures(scene),
                self.system.object_shape,
                count,
                stream(self.seed, "reconstruct"),
            )
            self._statistics[scene] = natural.mean_covariance(patches)
        return self._kept(
            ("own", sigma, scene),
            lambda: lmmse.prepare(self.svd, *self._statistics[scene], sigma, self.bands()),
        )

    def joint(self, sigma, scene):
        """solvers.overlap.JointLmmse of 3x3 lenslets, at noise sigma."""
        from plenocli.inverse.picture import overlap
        from plenocli.inverse.prior import natural_images as natural

        system = self.system

        def make():
            statistics = natural.autocovariance(
                self.pictures(scene), overlap.needed_reach(system.object_shape, system.offsets)
            )
            return overlap.prepare_joint(
                self.svd,
                system.blocks,
                system.offsets,
                system.object_shape,
                *statistics,
                sigma,
                self.bands(),
            )

        return self._kept(("joint", sigma, scene), make)

    def _kept(self, key, make):
        if key not in self._estimators:
            while len(self._estimators) >= KEPT:
                self._estimators.pop(next(iter(self._estimators)))
            self._estimators[key] = make()
        return self._estimators[key]
