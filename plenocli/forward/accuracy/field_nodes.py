"""How many matrices stand for a whole array: those of a few places of the field, between which
polynomials in the place interpolate (docs/model.md, "Fields that change over the field").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.camera.geometry import corner_ray, geometry
from plenocli.forward.propagation.sampling import is_symmetric
from plenocli.forward.propagation.symmetry import Turn
from plenocli.forward.propagation.system_matrix import PifBuilder

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.plan import PifPlan

Place = tuple[float, float]
"""(rows, columns) m on the array from the optical axis."""
SHARE = 0.5
"""Share of the accuracy that interpolation between places may use up."""
MOST_NODES = 11
"""Places along an axis that are tried by themselves."""
TRIED = 4
"""Points along an axis whose columns tell the error between places."""


@dataclass(frozen=True, kw_only=True)
class FieldNodes:
    """The places whose matrices stand for all lenslets: Chebyshev and Lobatto's, the middle and the
    edges of the array among them.

    rows, columns: (row_node,) and (column_node,) m from the axis, ascending;
    file: (row_node, column_node) number of the matrix that serves a place;
    turn: (row_node, column_node, 3) how it is turned for that place, a Turn;
    error: of the worst column between them, relative.
    """

    rows: np.ndarray
    columns: np.ndarray
    file: np.ndarray
    turn: np.ndarray
    error: float = math.nan
    kind = "places"

    def as_json(self) -> dict[str, list[int]]:
        """How many there are along rows and columns."""
        return {"nodes": [len(self.rows), len(self.columns)]}

    @property
    def places(self) -> list[Place]:
        """Where the matrices are computed, by number."""
        homes = [np.argwhere((self.file == n) & ~self.turn.any(axis=2))[0] for n in self.numbers]
        return [(float(self.rows[i]), float(self.columns[j])) for i, j in homes]

    @property
    def numbers(self) -> range:
        """Numbers of the matrices."""
        return range(int(self.file.max()) + 1)

    def weights(self, axis: int, places: np.ndarray) -> np.ndarray:
        """What to mix for places along one axis.

        axis: 0 rows, 1 columns;
        places: (place,) m.

        Returns (place, node): Lagrange's polynomials through all nodes.
        """
        nodes = self.columns if axis else self.rows
        places = np.asarray(places, float)
        out = np.ones((len(places), len(nodes)))
        for i, j in np.argwhere(~np.eye(len(nodes), dtype=bool)):
            out[:, i] *= (places - nodes[j]) / (nodes[i] - nodes[j])
        return out

    def mix(self, place: Place) -> list[tuple[float, int, Turn]]:
        """What the matrix of a place is mixed of: (weight, number of the matrix, how turned)."""
        down, across = (self.weights(axis, np.array([place[axis]]))[0] for axis in (0, 1))
        return [
            (float(a * b), int(self.file[i, j]), self.turn_at(i, j))
            for i, a in enumerate(down)
            for j, b in enumerate(across)
            if a * b
        ]

    def turn_at(self, row: int, column: int) -> Turn:
        """How the matrix of a place follows from that of its file."""
        turned, rows, columns = (bool(flag) for flag in self.turn[row, column])
        return turned, rows, columns

    def line(self) -> str:
        """One sentence for people."""
        return (
            f"{len(self.rows)}x{len(self.columns)} places of the field stand for all lenslets, "
            f"{len(self.numbers)} of them computed; between them columns are off by about "
            f"{self.error:.1g}"
        )

    def told(self, plan: PifPlan) -> PifPlan:
        """The plan of one of the places, with what interpolation adds to its error."""
        split = plan.split | {"field": self.error}
        return replace(
            plan,
            split=split,
            estimated=math.hypot(*split.values()),
            reasons=(*plan.reasons, self.line()),
        )


def turned_matrix(A: np.ndarray, how: Turn) -> np.ndarray:
    """The matrix of the place that a Turn leads to: a view.

    A: (.., superpixel row, superpixel column, pixel row, pixel column, point row, point column);
    how: the Turn.
    """
    turned, rows, columns = how
    if turned:
        lead = tuple(range(A.ndim - 6))
        A = A.transpose(*lead, *(A.ndim - 6 + n for n in (1, 0, 3, 2, 5, 4)))
    A = A[..., ::-1, :, ::-1, :, ::-1, :] if rows else A
    return A[..., ::-1, :, ::-1, :, ::-1] if columns else A


def turned_blocks(
    A: np.ndarray,
    offsets: np.ndarray,
    shapes: tuple[Sequence[int], Sequence[int]],
    how: Turn,
) -> np.ndarray:
    """The same of a matrix as files hold it, a copy where it is turned.

    A: (.., lenslet offset, pixel, point);
    offsets: (lenslet offset, 2), a block about the object's own;
    shapes: of a superpixel and of an object, rows and columns.
    """
    if not any(how):
        return A
    side = np.abs(offsets).max(axis=0) * 2 + 1
    planes = A.reshape(*A.shape[:-3], *side, *shapes[0], *shapes[1])
    return np.ascontiguousarray(turned_matrix(planes, how)).reshape(A.shape)


class PlansOfPlaces:
    """Plans of the matrices of places, all of the same superpixels and type.

    accuracy: that all have to meet, interpolation included.
    """

    def __init__(self, camera: Camera, **request: Any) -> None:
        """request: as for plan_pif."""
        ends = [plan_pif(camera, **request, chief=at) for at in ((0.0, 0.0), corner_ray(camera))]
        self._camera = camera
        self.accuracy = request.get("accuracy") or max(plan.accuracy for plan in ends)
        rows, columns = (max(plan.superpixels[axis] for plan in ends) for axis in (0, 1))
        self._request = request | {"superpixels": (rows, columns), "dtype": ends[0].dtype}
        if request.get("accuracy") is not None:
            self._request["accuracy"] *= math.sqrt(1 - SHARE**2)

    def __call__(self, place: Place) -> PifPlan:
        """The plan of a place."""
        return plan_pif(self._camera, **self._request, chief=place)


def lay_nodes(camera: Camera, count: int, superpixels: tuple[int, int]) -> FieldNodes:
    """Places for an array, `count` along each axis that has more than one lenslet.

    Those that are mirror images of one another by the lattice, the pupil and the array share a
    matrix.

    superpixels: (rows, columns) kept.
    """
    array = camera.lenslet_array
    halves = [(n - 1) / 2 * array.pitch for n in array.count]
    lines = [
        half * -np.cos(np.pi * np.arange(count) / (count - 1))
        if half and count > 1
        else np.zeros(1)
        for half in halves
    ]
    for line in lines:
        line[len(line) // 2] = 0.0
    flips, turns = _symmetry(camera, superpixels)
    turns = turns and halves[0] == halves[1]
    shape = len(lines[0]), len(lines[1])
    file, turn = np.zeros(shape, int), np.zeros((*shape, 3), bool)
    known: dict[tuple[int, int], int] = {}
    for i, j in np.ndindex(shape):
        a, b = i - shape[0] // 2, j - shape[1] // 2
        rows, columns = (a < 0 and flips), (b < 0 and flips)
        a, b = (abs(a), abs(b)) if flips else (a, b)
        turned = turns and a > b
        file[i, j] = known.setdefault((b, a) if turned else (a, b), len(known))
        turn[i, j] = turned, rows, columns
    return FieldNodes(rows=lines[0], columns=lines[1], file=file, turn=turn)


def _symmetry(camera: Camera, superpixels: tuple[int, int]) -> tuple[bool, bool]:
    """Whether mirrors of rows and of columns, and their exchange, map the camera onto itself."""
    lens = camera.main_lens
    if not is_symmetric(camera) or camera.lenslet_array.lattice != "square":
        return False, False
    shift = (0.0, 0.0) if camera.fitted is None else camera.fitted.pixel_shift
    plain = geometry(camera, camera.light.wavelengths[0], shift if any(shift) else None)
    rows, columns, turn = plain.mirrors(superpixels)
    square = all(
        a == b
        for a, b in (
            superpixels,
            camera.sensor.pixels_per_lenslet,
            camera.object.samples_per_lenslet,
        )
    )
    return rows and columns and not any(shift), turn and square and lens.aperture_shape != "image"


def field_nodes(
    camera: Camera,
    plan_at: PlansOfPlaces,
    count: int | None = None,
) -> FieldNodes:
    """The fewest places between which matrices may be interpolated.

    plan_at: of whose accuracy interpolation uses SHARE at most;
    count: places along an axis, an odd number; None: the fewest that serve, MOST_NODES where none
        do.

    Errors between places are measured: some columns of places in between are computed and compared.
    """
    tried = _Columns(camera, plan_at)
    found = None
    for n in [count] if count else range(1, MOST_NODES + 1, 2):
        nodes = lay_nodes(camera, n, plan_at((0.0, 0.0)).superpixels)
        found = replace(nodes, error=tried.error(nodes))
        if found.error <= SHARE * plan_at.accuracy:
            break
    assert found is not None
    return found


class _Columns:
    """Some columns of the matrices of places, at the shortest wavelength."""

    def __init__(self, camera: Camera, plan_at: PlansOfPlaces) -> None:
        self._camera, self._plan_at = camera, plan_at
        self._known: dict[Place, np.ndarray] = {}

    def error(self, nodes: FieldNodes) -> float:
        """Largest relative L2 error of a column between nodes, near the array's corner and edge."""
        if nodes.file.size == 1:
            return self._error_at(nodes, corner_ray(self._camera))
        outer, inner = ([_between(line, n) for line in (nodes.rows, nodes.columns)] for n in (1, 2))
        edge = float(nodes.rows[-1])
        trials = {(outer[0], outer[1]), (edge, outer[1]), (outer[0], inner[1])}
        return max(self._error_at(nodes, place) for place in sorted(trials))

    def _error_at(self, nodes: FieldNodes, place: Place) -> float:
        homes = nodes.places
        mixed = sum(
            weight * turned_matrix(self._at(homes[number]), how)
            for weight, number, how in nodes.mix(place)
        )
        true = self._at(place)
        axes = (0, 1, 2, 3)
        return float(np.sqrt(((mixed - true) ** 2).sum(axis=axes) / (true**2).sum(axis=axes)).max())

    def _at(self, place: Place) -> np.ndarray:
        if place not in self._known:
            plan = self._plan_at(place)
            wavelength = min(band.wavelength for band in plan.bands)
            builder = PifBuilder(self._camera, wavelength, plan, dtype=np.float64)
            rows, columns = (_some(n) for n in builder.object_shape)
            points = (rows[:, None] * builder.object_shape[1] + columns).ravel()
            A = np.stack([builder.columns(np.array([p]))[:, :, 0] for p in points], axis=-1)
            self._known[place] = A.reshape(
                *plan.superpixels, *builder.pixel_shape, len(rows), len(columns)
            )
        return self._known[place]


def _between(line: np.ndarray, number: int) -> float:
    """The middle between the `number`-th outermost node and the next one further in."""
    if len(line) <= number:
        return float(line[-1])
    return float(line[-number] + line[-number - 1]) / 2


def _some(count: int) -> np.ndarray:
    """At most TRIED numbers below `count`, mirror images of one another."""
    if count <= TRIED:
        return np.arange(count)
    return np.array([0, count // 3, count - 1 - count // 3, count - 1])
