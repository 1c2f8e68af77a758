"""The way up to the most likely camera: Levenberg's steps by Gauss and Newton's curvature,
lengthened while the evidence rises, with noise that starts as large as the misfit makes it.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from plenocli.inverse.fit.evidence import Evidence, EvidenceAt
from plenocli.inverse.fit.lenslet import LensletFamily, MatrixAt
from plenocli.inverse.fit.optics import CameraFamily

GAIN = 0.3
"""A step that makes the captures less than this more likely (log) is the last one."""
ENOUGH = 3.0
"""So is one that gains less than this where the curvature promised no more: what is left to gain
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
TRIES = 6
"""How often the damping of a step that does not rise is raised."""
MISFIT = 1.02
"""Noise over the noise told, above which mirrored cameras are looked at on the way."""


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

    def under(self, factor: float) -> Point:
        """The same camera under `factor` times the noise told."""
        height = self.evidence.value(factor) - 0.5 * float(self.x @ self.x)
        return replace(self, factor=factor, height=height)


@dataclass(frozen=True, kw_only=True)
class Slopes:
    """How things change around a Point with the parameters in tolerances.

    rise: (parameter,) derivatives of the height;
    light: for every capture (parameter, pixel, lenslet) derivatives of what the objects that the
        captures tell of make;
    products: (parameter, parameter) of the matrix's derivatives.
    """

    rise: np.ndarray
    light: tuple[np.ndarray, ...]
    products: np.ndarray

    def curvature(self, at: Point, factor: float) -> np.ndarray:
        """How fast the slopes of the height fall at `factor` times the noise told, (parameter,
        parameter), what is believed of the parameters included; at: the Point.
        """
        return at.evidence.curvature(self.light, factor) + np.eye(len(self.rise))


class Ascent:
    """One problem: a family of cameras and captures of one of them."""

    def __init__(
        self,
        family: CameraFamily,
        evidence: Evidence,
        *,
        tolerance: float = 1e-5,
        model: Callable[[np.ndarray], np.ndarray] | None = None,
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

    def of(self, evidence: Evidence) -> Ascent:
        """The same of the same captures with other pixels filled in."""
        other = copy(self)
        other.evidence = evidence
        return other

    def values(self, x: np.ndarray) -> np.ndarray:
        """(parameter,) in their units, of x in tolerances."""
        return self.family.start + x * self.family.tolerance

    def point(
        self,
        x: np.ndarray,
        factor: float | None = None,
        *,
        finer: np.ndarray | None = None,
    ) -> Point:
        """The Point at x.

        factor: of the noise, None for the most likely one, 1 at the least;
        finer: as in Point.
        """
        matrix = self.lenslets.at(self.values(x))
        found = self.evidence.at(matrix.matrix if finer is None else matrix.matrix + finer)
        at = Point(x=x, factor=1.0, height=0.0, evidence=found, paraxial=matrix, finer=finer)
        return at.under(max(1.0, found.noise_factor()) if factor is None else factor)

    def slopes(self, at: Point) -> Slopes:
        """The Slopes at a point, from one pass over the matrix's derivatives."""
        objects = [at.evidence.objects(k, at.factor) for k in range(len(self.evidence.captures))]
        borders = np.cumsum([x.shape[1] for x in objects])[:-1]
        turn = self.family.jacobian(self.values(at.x)) * self.family.tolerance
        by_matrix = at.evidence.by_matrix(at.factor)
        rise, products = np.zeros(len(turn)), np.zeros((len(turn), len(turn)))
        kind = at.paraxial.matrix.dtype
        x = np.hstack(objects).astype(kind)
        light = np.zeros((len(turn), len(by_matrix), x.shape[1]), kind)
        for points, slopes in at.paraxial.slopes():
            light += slopes.transpose(0, 2, 1) @ x[points]
            flat = slopes.reshape(len(turn), -1)
            rise += flat @ by_matrix.T[points].astype(kind).ravel()
            products += flat @ flat.T
        light = np.tensordot(turn.T.astype(kind), light, 1)
        return Slopes(
            rise=turn.T @ rise - at.x,
            light=tuple(np.split(light, borders, axis=2)),
            products=turn.T @ products @ turn,
        )

    def settle(self, at: Point, steps: int) -> Point:
        """The Point where climbs from one with the finer model's difference end whose matrix is
        the finer model's there: each with the difference of the models where the climb before
        ended, until that changes no more.
        """
        at = self.climb(at, steps)
        for _ in range(self._rounds):
            finer = self.difference(at.x)
            if finer is None or at.finer is None:
                break
            # relative to the matrix as the noise is to the captures
            changed = np.linalg.norm(finer - at.finer) / np.linalg.norm(at.matrix)
            if changed * self.evidence.quiet < CHANGED:
                break
            at = self.climb(self.point(at.x, finer=finer), steps)
        return at

    def difference(self, x: np.ndarray) -> np.ndarray | None:
        """What the finer model adds to the paraxial matrix at x, None without a finer model."""
        if self._model is None:
            return None
        values = self.values(x)
        return self._model(values) - self.lenslets.at(values).matrix

    def climb(self, at: Point, steps: int, least: float = 1.0) -> Point:
        """The Point where going on from one gains nothing, or after so many steps; what a finer
        model adds is kept.

        least: factor of the noise.
        """
        at = at.under(max(least, at.evidence.noise_factor()))
        damping, patient = 1e-3, True
        for step in range(steps):
            if self._progress is not None:
                self._progress()
            slopes = self.slopes(at)
            curvature = slopes.curvature(at, at.factor)
            best, damping = self._step(at, curvature, slopes.rise, damping)
            if at.factor > MISFIT and step % 3 == 2:
                best = max([best, *self.mirrored(best)], key=lambda p: p.height)
            gain = best.height - at.height
            promised = 0.5 * float(slopes.rise @ np.linalg.solve(curvature, slopes.rise))
            if best is not at:
                at = best.under(max(least, best.evidence.noise_factor()))
            if max(gain, promised) < ENOUGH or (gain < GAIN and not patient):
                break
            if gain < GAIN:
                # damping goes with each parameter's own information: it stops steps along valleys
                damping, patient = UNDAMPED, False
        return at

    def _step(
        self, at: Point, curvature: np.ndarray, rise: np.ndarray, damping: float
    ) -> tuple[Point, float]:
        """(the Point after one step, `at` itself where none rises; damping for the next).

        curvature: (parameter, parameter) at the point; rise: (parameter,) derivatives of the
            height.
        """
        for _ in range(TRIES):
            way = _damped(curvature, damping, rise)
            while np.linalg.norm(way) > FAR:
                damping *= 3
                way = _damped(curvature, damping, rise)
            best = self._along(at, way, float(rise @ way - 0.5 * way @ curvature @ way))
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

    def mirrored(self, at: Point, finer: np.ndarray | None = None) -> list[Point]:
        """Cameras with defocus and aberrations mirrored, but not the lenslets' curvature, which
        captures tell weakly so that it stays behind on the wrong side: as it is, and as described.

        finer: as in Point, None for that of `at`, turned.
        """
        mirrored = self.family.mirrored(self.values(at.x))
        if mirrored is None:
            return []
        found = []
        place = self.family.place("lenslet focal length")
        for kept in (at.x[place], 0.0):
            x = (mirrored - self.family.start) / self.family.tolerance
            x[place] = kept
            turned = None if at.finer is None else at.finer[:, ::-1]
            found.append(self.point(x, at.factor, finer=turned if finer is None else finer))
        return found


def _damped(curvature: np.ndarray, damping: float, rise: np.ndarray) -> np.ndarray:
    return np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), rise)
