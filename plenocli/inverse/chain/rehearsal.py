"""What chains lose, rehearsed: a small part of the scene is captured by a cheap pilot matrix and
inverted with matrices that are as wrong as each chain's would be.

The pilot is the finest matrix and candidates are themselves; where that takes long it is the
paraxial model, and how a candidate is wrong is computed on isolated lenslets: its own superpixel
less that of the finest model, with its true structure. docs/model.md, "The cheapest chain".
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.base.progress import collected_notes
from plenocli.base.tiling import to_blocks
from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.accuracy.limiting_error import what_limits
from plenocli.forward.camera.model import Camera
from plenocli.forward.propagation.plan import PifPlan
from plenocli.forward.propagation.system_matrix import build_pif
from plenocli.forward.scene.light import Quadrature
from plenocli.forward.scene.sample import ALL
from plenocli.forward.scene.scenes import Scene
from plenocli.forward.sensor.exposure.options import ExposureOptions
from plenocli.forward.sensor.exposure.simulate import SimulatedCapture, simulate_capture
from plenocli.inverse.chain.chains import MatrixOption
from plenocli.inverse.picture.estimate import estimate
from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels, gathered
from plenocli.inverse.picture.methods.registry import METHODS
from plenocli.inverse.picture.superpixels import superpixels
from plenocli.inverse.prior.scene_prior import ReadPictures

SIDE = 16
"""Lenslets (a side) of the part of the scene that is captured."""
REFINE = 3
"""Points of the scene (a side) for each of the picture: objects are finer than any picture."""
FINER = 3.0
"""What the reference is more accurate than the finest candidate."""
FINEST = 1e-6
LONG = 5.0
"""Seconds of the matrix of the capture from which on the pilot is paraxial."""
DRAWS = 2
"""Captures, which differ in their noise: what reconstruct finds may hang on it."""


class Middle:
    """The middle of a scene: `part` of `whole` lenslets (rows, columns)."""

    def __init__(self, scene: Scene, whole: tuple[int, int], part: tuple[int, int]) -> None:
        self.scene, self.whole, self.part = scene, whole, part
        self.spectral = scene.spectral

    def at(self, wavelength: float, rows: int, columns: int, part: slice = ALL) -> np.ndarray:
        """Reflectance (row, column), as it is there in a capture of the whole."""
        fine = (rows // self.part[0], columns // self.part[1])
        picture = self.scene.at(wavelength, self.whole[0] * fine[0], self.whole[1] * fine[1])
        row, column = ((w - p) // 2 * n for w, p, n in zip(self.whole, self.part, fine))
        return picture[row : row + rows, column : column + columns][part]


class Rehearsal:
    """Pictures that chains would give of a part of a scene, and how good they are.

    noise: of a pixel relative to the signal, of the capture that was made.
    runs: reconstructions so far.
    """

    def __init__(
        self,
        camera: Camera,
        source: Quadrature,
        scene: Scene,
        exposure: ExposureOptions,
        read_pictures: ReadPictures,
        finest: MatrixOption,
        *,
        name: str,
        seed: int = 0,
    ) -> None:
        """Make the pilot and the capture.

        source, scene, exposure: as simulate_capture takes them.
        read_pictures: gives the photographs that statistics are from.
        finest: of the candidates.
        name: of the scene, which training leaves out.

        Raises NumericsError and ConfigError as simulate_capture.
        """
        self.camera, self.seed, self.runs = camera, seed, 0
        count = camera.lenslet_array.count
        part = (min(count[0], SIDE), min(count[1], SIDE))
        self.lenslets = part[0] * part[1]
        small = camera.replace(**{"lenslet_array.count": part})
        middle = Middle(scene, (count[0], count[1]), part)

        def captured(plan: PifPlan, draw: int = 0) -> SimulatedCapture:
            options = replace(
                exposure,
                refine=REFINE,
                model=plan.model,
                accuracy=plan.accuracy,
                superpixels=plan.superpixels,
                seed=seed + 1 + draw,
            )
            return simulate_capture(small, source, middle, options, name=name)

        made = None
        if REFINE**2 * finest.plan.chosen.seconds() <= LONG:
            with suppress(NumericsError):
                plan, made = finest.plan, captured(finest.plan)
        if made is None:
            plan = _paraxial(camera, finest.superpixels, finest.accuracy)
            made = captured(plan)
        self.exact = plan is finest.plan
        self.pilot = _matrix(camera, plan)
        shots = [made, *(captured(plan, draw) for draw in range(1, DRAWS))]
        self.data = [superpixels(shot.capture, self.pilot) for shot in shots]
        seen = made.in_memory().scene
        assert isinstance(seen, np.ndarray)
        self.truth = to_blocks(np.asarray(seen[0], float), self.pilot.object_shape)
        data = self.data[0]
        self.noise = data.known_sigma / float(np.sqrt(np.mean(np.square(data.y))))
        finer = max(finest.accuracy / FINER, FINEST)
        self._reference = None
        if not self.exact:
            self._reference = self._isolated("exact", finer)
            if self._reference is None:
                self._reference = self._isolated("fresnel", finer)
        self._wrong: dict[tuple[str, float], np.ndarray] = {}
        self._ready: dict[MatrixOption, Estimators] = {}
        self._found: dict[tuple[MatrixOption, str], np.ndarray] = {}
        self._first = Estimators(self.pilot, Options(seed=seed), read_pictures)

    def psnr(self, matrix: MatrixOption, method: str) -> np.ndarray:
        """PSNR (dB, peak 1; of every draw) of the picture that a chain gives of the part."""
        key = matrix, method
        if key not in self._found:
            self._found[key] = np.array([self._tried(matrix, method, d) for d in self.data])
        return self._found[key]

    def known(self, matrix: MatrixOption, method: str) -> np.ndarray | None:
        """The same of a chain that was rehearsed; None of another."""
        return self._found.get((matrix, method))

    def _tried(self, matrix: MatrixOption, method: str, data: Superpixels) -> float:
        estimators = self._estimators(matrix)
        limits = what_limits(self.noise, estimators.system.accuracy)
        off = 0.0 if limits is None or limits.limited_by == "noise" else limits.model_error
        made = estimators.with_options(Options(method=method, seed=self.seed))
        with collected_notes():
            found, _ = estimate(made, METHODS[method], data, model_error=off)
        self.runs += 1
        error = float(np.mean(np.square(found.value.reshape(self.truth.shape) - self.truth)))
        return -10 * float(np.log10(max(error, 1e-12)))

    def _estimators(self, matrix: MatrixOption) -> Estimators:
        if matrix not in self._ready:
            self._ready[matrix] = self._first.with_matrix(self._as_wrong_as(matrix))
        return self._ready[matrix]

    def _as_wrong_as(self, matrix: MatrixOption) -> LensletMatrix:
        """The matrix itself, which costs no more than the finest, where that is the pilot; else the
        pilot with the error that it would have.
        """
        if self.exact:
            return _matrix(self.camera, matrix.plan)
        key = matrix.model, matrix.accuracy
        if key not in self._wrong:
            found = self._isolated(*key)
            own = self.pilot.own
            self._wrong[key] = (
                np.zeros_like(own)
                if found is None or self._reference is None
                else found - self._reference
            )
        own = self.pilot.own + self._wrong[key]
        record = matrix.plan.accuracy_record()
        if matrix.own_only:
            alone = np.zeros((1, 2), int)
            return replace(self.pilot, blocks=own[None], offsets=alone, accuracy=record)
        blocks = self.pilot.blocks.astype(float)
        blocks[np.flatnonzero(np.all(self.pilot.offsets == 0, axis=1))[0]] = own
        return replace(self.pilot, blocks=blocks, accuracy=record)

    def _isolated(self, model: str, accuracy: float) -> np.ndarray | None:
        """(pixel, point) own superpixel of a lenslet without neighbours; None where the model does
        not reach that.
        """
        try:
            plan = plan_pif(
                self.camera,
                model=model,
                accuracy=accuracy,
                superpixels=(1, 1),
                coherent_ring=0,
                dtype=np.float64,
            )
        except NumericsError:
            return None
        return _matrix(self.camera, plan).own


def _paraxial(camera: Camera, superpixels: tuple[int, int], accuracy: float) -> PifPlan:
    """The plan of the pilot: paraxial, as accurate as the finest candidate, or nearly."""
    while True:
        try:
            return plan_pif(camera, model="fresnel", accuracy=accuracy, superpixels=superpixels)
        except NumericsError:
            if accuracy > 0.1:
                raise
            accuracy = float(f"{2 * accuracy:.2g}")


def _matrix(camera: Camera, plan: PifPlan) -> LensletMatrix:
    matrix = build_pif(camera, plan)
    if matrix.A is None:
        raise NumericsError("the pilot matrix does not fit the memory", fix="give --mem-limit more")
    return LensletMatrix(
        path=Path("pilot"),
        blocks=gathered(matrix.A),
        offsets=np.asarray(matrix.lenslet_offset, int),
        pixel_shape=matrix.pixel_shape,
        object_shape=matrix.object_shape,
        accuracy=plan.accuracy_record(),
    )
