"""The way up to the most likely camera: Levenberg's steps on Fisher's matrix, lengthened while the
evidence rises, with noise that starts as large as the captures' misfit makes it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from plenocli.inverse.fit.evidence import Evidence, EvidenceAt
from plenocli.inverse.fit.finer import FinerModel
from plenocli.inverse.fit.lenslet import LensletFamily, MatrixAt, fringes_a_pixel
from plenocli.inverse.fit.optics import CameraFamily

GAIN = 0.3
"""A step that makes the captures less than this more likely (log) is the last one."""
ENOUGH = 3.0
"""So is one that gains less than this where Fisher's matrix promised no more: what is left to gain
is below what the parameters' standard deviations stand for, and there are valleys to creep along.
"""
LONGER = 2.5
"""By how much a step that helped is lengthened, again and again."""
SURPRISE = 1.4
"""Of the gain that was promised: a step that gains less is not lengthened. Of a parabola with a
promised and another curvature, LONGER steps are higher only where the first gains more.
"""
FAR = 20.0
"""No step is longer, in tolerances, before it has shown that it helps."""
NODES = 2
"""Of a pixel along each side, where a finer model makes up for what they miss."""
CHANGED = 0.1
"""Of the noise: what the difference of a finer model may have changed by at the end of a climb."""
UNDAMPED = 1e-5
"""Least damping of steps."""
KEPT = 4
"""Steps that Fisher's matrix is kept for, where they help."""
STALE = 1.5
"""By how much the noise may fall meanwhile."""
MISFIT = 1.02
"""Noise over the noise told, above which mirrored cameras are looked at on the way."""
COARSE = 2.0
"""Quadrature nodes a period of the finest fringes of what Fisher's matrix is made of."""


@dataclass(frozen=True)
class _Fisher:
    """Fisher's matrix (parameter, parameter), the noise factor where it was made, and how many
    steps it was used for since.
    """

    matrix: np.ndarray
    factor: float
    age: int = 1

    def serves(self, at: Point) -> bool:
        """Whether a step from a point may still be made on it."""
        return self.age < KEPT and self.factor < STALE * at.factor


@dataclass(frozen=True, kw_only=True)
class Point:
    """A camera on the way.

    x: (parameter,) from the described camera, in tolerances;
    height: log of the evidence and of what is believed of the parameters, at noise `factor` times
        the noise told;
    finer: (pixel, point) what a finer model adds to the paraxial matrix, None where none does.
    """

    x: np.ndarray
    factor: float
    height: float
    evidence: EvidenceAt
    paraxial: MatrixAt
    finer: np.ndarray | None

    @property
    def matrix(self) -> np.ndarray:
        """(pixel, point), what the captures were held against."""
        paraxial = self.paraxial.matrix
        return paraxial if self.finer is None else paraxial + self.finer


class Ascent:
    """One problem: a family of cameras and captures of one of them."""

    def __init__(
        self,
        family: CameraFamily,
        evidence: Evidence,
        *,
        tolerance: float = 1e-5,
        model: FinerModel | None = None,
        rounds: int = 0,
        progress: Callable[[], object] | None = None,
    ) -> None:
        """tolerance: root energy of the spread function that may be lost; model: finer than the
        paraxial one, whose difference from it is brought up to date `rounds` times at the most;
        progress: called at every step.
        """
        self.family, self.evidence, self._progress = family, evidence, progress
        self._model, self._rounds = model, rounds
        nodes = None if model is None else NODES
        self.lenslets = LensletFamily(family, tolerance=tolerance, pixel_nodes=nodes)
        few = max(1, math.ceil(COARSE * fringes_a_pixel(family)))
        self._coarse = LensletFamily(family, tolerance=max(tolerance, 1e-3), pixel_nodes=few)
        self._state: tuple[MatrixAt, list[np.ndarray]] | None = None

    def values(self, x: np.ndarray) -> np.ndarray:
        """(parameter,) in their units, of x in tolerances."""
        return self.family.start + x * self.family.tolerance

    def point(
        self,
        x: np.ndarray,
        factor: float | None = None,
        *,
        slopes: bool = False,
        finer: np.ndarray | None = None,
    ) -> Point:
        """The Point at x.

        factor: of the noise, None for the most likely one, 1 at the least;
        finer: as in Point.
        """
        matrix = self.lenslets.at(self.values(x), slopes=slopes)
        found = self.evidence.at(matrix.matrix if finer is None else matrix.matrix + finer)
        if factor is None:
            factor = max(1.0, found.noise_factor())
        height = found.value(factor) - 0.5 * float(x @ x)
        return Point(
            x=x, factor=factor, height=height, evidence=found, paraxial=matrix, finer=finer
        )

    def information(self, at: Point) -> np.ndarray:
        """Fisher's matrix by parameters in tolerances, with what is believed of them (parameter,
        parameter), from a coarse matrix.
        """
        state, slopes, turn = self._slopes(at)
        counts = at.evidence.contrasts(at.factor)
        by_optics = self.evidence.at(state.matrix).fisher(slopes, at.factor, counts)
        return turn.T @ by_optics @ turn + np.eye(len(at.x))

    def products(self, at: Point) -> np.ndarray:
        """Products of the matrix's slopes by parameters in tolerances (parameter, parameter)."""
        _, slopes, turn = self._slopes(at)
        # slopes are transposed views: their own order costs no copies
        pairs = [[float(np.vdot(a.T, b.T)) for b in slopes] for a in slopes]
        return turn.T @ np.array(pairs) @ turn

    def _slopes(self, at: Point) -> tuple[MatrixAt, list[np.ndarray], np.ndarray]:
        """(a coarse matrix at a point, its slopes by the optics, derivatives of the optics by
        parameters in tolerances).
        """
        values = self.values(at.x)
        if self._state is None or not np.array_equal(self._state[0].values, values):
            state = self._coarse.at(values, slopes=True)
            slopes = [state.slope(place) for place in range(len(self.family.optics(values)))]
            self._state = state, slopes
        return *self._state, self.family.jacobian(values) * self.family.tolerance

    def settle(self, x: np.ndarray, steps: int) -> Point:
        """The Point where climbs from x end whose matrix is the finer model's there: each with the
        difference of the models where the climb before ended, until that changes no more.
        """
        at = self.climb(x, steps, self.difference(x))
        for _ in range(self._rounds):
            finer = self.difference(at.x)
            if finer is None or at.finer is None:
                break
            # relative to the matrix as the noise is to the captures
            changed = np.linalg.norm(finer - at.finer) / np.linalg.norm(at.matrix)
            if changed * self.evidence.quiet < CHANGED:
                break
            at = self.climb(at.x, steps, finer)
        return at

    def difference(self, x: np.ndarray) -> np.ndarray | None:
        """What the finer model adds to the paraxial matrix at x, None without a finer model."""
        if self._model is None:
            return None
        values = self.values(x)
        return self._model.matrix(values) - self.lenslets.at(values).matrix

    def climb(self, x: np.ndarray, steps: int, finer: np.ndarray | None = None) -> Point:
        """The Point, with slopes, where going on from x gains nothing, or after so many steps;
        finer: as in Point, kept.
        """
        at, damping = self.point(x, slopes=True, finer=finer), 1e-3
        fisher, patient = _Fisher(np.eye(len(x)), np.inf), True
        for step in range(steps):
            if self._progress is not None:
                self._progress()
            rise = at.paraxial.back(at.evidence.by_matrix(at.factor)) * self.family.tolerance - at.x
            best = at
            if fisher.serves(at):
                best, damping = self._step(at, fisher.matrix, rise, damping, 1)
                fisher = replace(fisher, age=fisher.age + 1)
            if best is at:
                fisher = _Fisher(self.information(at), at.factor)
                best, damping = self._step(at, fisher.matrix, rise, damping, 6)
            if at.factor > MISFIT and step % 3 == 2:
                best = max([best, *self._mirrored(best)], key=lambda p: p.height)
            gain = best.height - at.height
            promised = 0.5 * float(rise @ np.linalg.solve(fisher.matrix, rise))
            if best is not at:
                at = self.point(best.x, slopes=True, finer=best.finer)
            if max(gain, promised) < ENOUGH or (gain < GAIN and not patient):
                break
            if gain < GAIN:
                # damping goes with each parameter's own information: it stops steps along valleys
                damping, patient = UNDAMPED, False
                fisher = replace(fisher, age=KEPT)
        return at

    def _step(
        self, at: Point, fisher: np.ndarray, rise: np.ndarray, damping: float, tries: int
    ) -> tuple[Point, float]:
        """(the Point after one step, `at` itself where none rises; damping for the next).

        fisher: (parameter, parameter); rise: (parameter,) derivatives of the height; tries: how
        often the damping is raised.
        """
        for _ in range(tries):
            way = _damped(fisher, damping, rise)
            while np.linalg.norm(way) > FAR:
                damping *= 3
                way = _damped(fisher, damping, rise)
            best = self._along(at, way, float(rise @ way - 0.5 * way @ fisher @ way))
            if best is not at:
                return best, max(damping / 5, UNDAMPED)
            damping = max(damping * 10, 1e-2)
        return at, damping

    def _along(self, at: Point, way: np.ndarray, promised: float) -> Point:
        """The highest of the points at + way, at + LONGER way, ... as far as they rise; `at`
        itself where none does. Where the first gains about what was promised it is near the top.
        """
        best, length = at, 1.0
        while length < 400:
            found = self.point(at.x + length * way, at.factor, finer=at.finer)
            if not found.height > best.height:
                break
            best, length = found, length * LONGER
            if found.height - at.height < SURPRISE * promised:
                break
        return best

    def _mirrored(self, at: Point) -> list[Point]:
        """Cameras with defocus and aberrations mirrored, but not the lenslets' curvature, which
        captures tell weakly so that it stays behind on the wrong side: as it is, and as described.
        """
        mirrored = self.family.mirrored(self.values(at.x))
        if mirrored is None:
            return []
        found = []
        place = self.family.place("lenslet focal length")
        for kept in (at.x[place], 0.0):
            x = (mirrored - self.family.start) / self.family.tolerance
            x[place] = kept
            finer = None if at.finer is None else at.finer[:, ::-1]
            found.append(self.point(x, at.factor, finer=finer))
        return found


def _damped(fisher: np.ndarray, damping: float, rise: np.ndarray) -> np.ndarray:
    return np.linalg.solve(fisher + damping * np.diag(np.diag(fisher)), rise)
