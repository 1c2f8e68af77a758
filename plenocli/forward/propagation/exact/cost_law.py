"""What an exact matrix consists of, counted before it is computed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plenocli.forward.propagation.costs import Features, summed
from plenocli.forward.propagation.exact.oblique import field_work, orders_for
from plenocli.forward.propagation.exact.term_counts import (
    MANY_CELLS,
    ExactBand,
    TermLaw,
    corner_phase,
    field_products,
    field_rank,
    fine_rank,
    is_spanned,
    own_products,
    own_terms,
    require_sketch,
    sketch_size,
    term_law,
)
from plenocli.forward.propagation.fresnel.separable_fields import field_operations, lines_serve
from plenocli.forward.propagation.fresnel.spread_function import psf_nodes
from plenocli.forward.propagation.sampling import (
    distinct,
    is_symmetric,
    pupil_waves,
    superpixels_of,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.plan import BandPlan

OBLIQUE_TERMS = 2.0
"""Terms of the main lens's field off the axis over those on it."""
SPANNED = 1.25
"""Columns that span a field over its terms by singular vectors."""
CAUTION = 1.3
"""By how much more terms than expected a field is refused at once rather than after minutes."""


@dataclass(frozen=True)
class _Kind:
    """Superpixels that need tables of the same size.

    count: how many;
    aside: by how many axes they lie beside the object's own;
    rows: columns of both factors together (sensor nodes times points);
    halves: 1 where one factor serves both axes, else 2.
    """

    count: int
    aside: int
    rows: int
    halves: int


@dataclass(frozen=True, kw_only=True)
class _Sizes:
    """Sizes of the computation.

    lit: lenslets along one axis that light a superpixel;
    points, lines, nodes: of the object, of the pixels' nodes and of the factors along one axis;
    beside: superpixels of an axis beside the own one whose tables are computed;
    across: nodes of one lenslet along one axis;
    few: nodes of the spread function on one lenslet;
    decades: as TermLaw.decades;
    phase: corner_phase;
    ranks, products: expected of a superpixel, by the number of axes that it lies aside;
    kinds: superpixels by the size of their tables.
    """

    lit: int
    points: int
    lines: int
    nodes: int
    rows: int
    beside: int
    across: float
    few: int
    decades: float
    phase: float
    ranks: list[float]
    products: list[float]
    kinds: list[_Kind]

    @property
    def joined(self) -> float:
        """By how much longer the factors of all lenslets together are than each one's: they meet on
        the pixels' nodes.
        """
        return 1.0 if self.lit == 1 else self.lines / self.nodes

    def spanned(self, kind: _Kind) -> bool:
        """Whether the columns of a sketch are the terms of such superpixels."""
        return self.lit == 1 and is_spanned(sketch_size(self.ranks[kind.aside]))

    def kept(self, kind: _Kind) -> float:
        """Terms of their tables."""
        return self.ranks[kind.aside] * (SPANNED if self.spanned(kind) else 1.0)

    @property
    def tables(self) -> int:
        """Superpixels whose tables are computed."""
        return sum(kind.count for kind in self.kinds)


def features(
    camera: Camera,
    geometry: Geometry,
    band: BandPlan,
    shape: tuple[int, ...],
    double: bool,
    numbers: TermLaw | None = None,
) -> Features:
    """What a matrix consists of, as Model.features; `numbers` of the laws of terms instead of the
    usual ones.

    Raises NumericsError where the superpixels beside the lenslet's own are expected to have more
    terms than a sketch may hold.
    """
    assert isinstance(band, ExactBand)
    n = numbers or term_law()
    oblique = geometry.chief != (0.0, 0.0)
    even, item = is_symmetric(camera) and not oblique, 16 if double else 8
    sizes = _sizes(camera, geometry, band, superpixels_of(shape[1]), n)
    written, count = math.prod(shape[1:]), columns(camera, geometry, shape)
    fine = math.prod(geometry.pixel_shape) * band.pixel_nodes**2
    mean = sum(kind.count * sizes.kept(kind) for kind in sizes.kinds) / sizes.tables
    # terms that go with the point, too
    terms = band.terms * (OBLIQUE_TERMS if oblique else 1)
    orders = orders_for(geometry, band.cut / 2)
    rows = sizes.lit * terms * sizes.rows
    operations = {
        "interval_values": 4 * rows * sizes.across,
        "interval_terms": 8 * rows * terms,
        # joined fields are multiplied on fewer numbers a pixel than nodes
        "sensor_isolated" if sizes.lit == 1 else "sensor_joined": _point_operations(
            geometry, band, sizes, mean
        )
        * count,
    }
    wide = item / 8  # what is twice as long takes twice the time
    seconds = {
        "process": 1.0,
        "spread_values": wide
        * (sizes.lit * sizes.points * sizes.few * band.psf_nodes * terms)
        * orders,
        "lines": count / geometry.object_shape[0],
        "sensor_values_double" if double else "sensor_values_single": count * fine,
        "written_double" if double else "written_single": written,
    }
    field = field_seconds(camera, geometry, band, band.cut / 2, wide)
    # the coupling of the own lenslet's terms is dense before it is looked at, and larger seen from
    # superpixels beside it
    own = _pupil_share(camera, n) * own_products(geometry, band, _parabolic(camera), n)
    held = {
        "own_coupling_isolated" if sizes.lit == 1 else "own_coupling_joined": item * own**2,
        "field_squared": (band.psf_nodes / (2 if even else 1)) ** 2 * orders**2,
        "intervals": item
        * (sizes.beside + 1)
        * (sizes.lit * sizes.across * sizes.points)
        * own_terms(geometry, band, band.cut),
        "factors": item
        * sizes.tables
        * sizes.points
        * mean
        * (sizes.nodes if _modes(band, sizes, mean) else sizes.lines),
        "process": 1.0,
    }
    lenslets = min(1.0, n.lenslets_coarse + n.lenslets_a_decade * sizes.decades)
    return Features(
        summed([operations, *(_table_operations(kind, sizes, band) for kind in sizes.kinds)]),
        summed(
            [seconds, field, *(_table_seconds(kind, sizes, wide, lenslets) for kind in sizes.kinds)]
        ),
        tuple(held | _table_bytes(kind, sizes, geometry, item) for kind in sizes.kinds),
    )


def _parabolic(camera: Camera) -> bool:
    return camera.lenslet_array.profile == "parabolic"


def columns(camera: Camera, geometry: Geometry, shape: tuple[int, ...]) -> int:
    """Pairs of a superpixel and a point that symmetry leaves to compute: a lenslet off the axis has
    one mirror at the most.
    """
    if geometry.chief == (0.0, 0.0):
        return distinct(camera, geometry, (shape[0], shape[1], shape[2], shape[3]))[1]
    mirror = 0.0 in geometry.chief or geometry.chief[0] == geometry.chief[1]
    return math.ceil(shape[1] * shape[3] / (2 if mirror and is_symmetric(camera) else 1))


def field_seconds(
    camera: Camera, geometry: Geometry, band: BandPlan, tolerance: float, wide: float
) -> dict[str, float]:
    """What bringing the main lens's field into terms consists of; on the axis the cube of its
    nodes, `wide` times, and waves of the pupil.
    """
    if geometry.chief != (0.0, 0.0):
        return field_work(geometry, band.half, tolerance)
    if is_symmetric(camera):
        return {"field_cubed": wide * band.psf_nodes**3 / 8}
    waves = pupil_waves(camera, geometry, band)
    return {"field_cubed": wide * band.psf_nodes**3, "pupil_waves": waves}


def _pupil_share(camera: Camera, n: TermLaw) -> float:
    """Share of terms that the shape of the pupil leaves."""
    square = is_symmetric(camera) and camera.main_lens.aperture_shape == "square"
    return n.separable_pupil if square else 1.0


def _sizes(
    camera: Camera, geometry: Geometry, band: ExactBand, grid: tuple[int, int], n: TermLaw
) -> _Sizes:
    parabolic, plain = _parabolic(camera), _pupil_share(camera, n)
    even = is_symmetric(camera) and geometry.chief == (0.0, 0.0)
    lit = 1 if band.window is None else 2 * band.window + 1
    points, lines = max(geometry.object_shape), band.pixel_nodes * max(geometry.pixel_shape)
    nodes = band.sensor_count or lines
    beside = grid[0] // 2 if even else grid[0] - 1
    ranks = [plain * field_rank(geometry, band, parabolic, aside, n) for aside in range(3)]
    if band.window is not None:
        require_sketch(CAUTION * ranks[sum(count > 1 for count in grid)])
        more = fine_rank(geometry, band, n)
        ranks = [rank * more for rank in ranks]
    # on an axis of symmetry half of the points are computed
    own, other = nodes * ((points + 1) // 2 if even else points), nodes * points
    kinds = (
        [
            _Kind(1, 0, own, 1),
            _Kind(beside, 1, own + other, 2),
            _Kind(beside, 2, other, 1),
            _Kind(beside * (beside - 1) // 2, 2, 2 * other, 2),
        ]
        if even
        else [
            _Kind(1, 0, 2 * own, 2),
            _Kind(2 * beside, 1, own + other, 2),
            _Kind(beside**2, 2, 2 * other, 2),
        ]
    )
    return _Sizes(
        lit=lit,
        points=points,
        lines=lines,
        nodes=nodes,
        rows=own + beside * other,
        beside=beside,
        # as far as light comes: the lenslets beside the superpixel
        across=min(band.lenslet_nodes, band.lenslet_nodes * (2 / (lit + 1)) + n.nodes_beside),
        few=psf_nodes(geometry, geometry.lenslet_width / 2),
        decades=n.decades(band.cut),
        phase=corner_phase(geometry),
        ranks=ranks,
        products=[
            plain * field_products(geometry, band, parabolic, aside, n) for aside in range(3)
        ],
        kinds=[kind for kind in kinds if kind.count],
    )


def _modes(band: ExactBand, sizes: _Sizes, terms: float) -> bool:
    """Whether fields of so many terms are multiplied on functions of the superpixel."""
    if sizes.lit > 1 or not band.sensor_count:
        return False
    return lines_serve((sizes.lines, sizes.lines), terms, (sizes.nodes, sizes.nodes))


def _point_operations(geometry: Geometry, band: ExactBand, sizes: _Sizes, terms: float) -> float:
    """Real operations that a point's field takes on the nodes of a superpixel."""
    v, u = (band.pixel_nodes * pixels for pixels in geometry.pixel_shape)
    lines = (sizes.nodes, sizes.nodes) if _modes(band, sizes, terms) else None
    return field_operations((v, u), terms, lines)


def _table_operations(kind: _Kind, sizes: _Sizes, band: ExactBand) -> dict[str, float]:
    rank, products = sizes.ranks[kind.aside], sizes.products[kind.aside]
    sketch, rows = sketch_size(rank), kind.count * kind.rows
    joined = rows * sizes.joined
    shown = band.sensor_count and not _modes(band, sizes, sizes.kept(kind))
    parts = {
        "intervals_applied": rows * products * sizes.across,
        "prolate": rows * sizes.lines * rank if shown else 0.0,
    }
    if sizes.spanned(kind):
        # first on either side of the sketch, then twice on what is kept of it
        twice = sketch / 2 + sizes.kept(kind)
        return parts | {"spanned": rows * products * twice, "basis": rows * sketch**2 / 4}
    # of many lenslets each brings few terms, so that products are narrow and wait for memory
    return parts | {
        "sketch_isolated" if sizes.lit == 1 else "sketch_joined": joined * products * sketch,
        "basis": joined * sketch**2,
        "coupling": kind.count * sketch**3,
    }


def _table_seconds(kind: _Kind, sizes: _Sizes, wide: float, lenslets: float) -> dict[str, float]:
    products = wide * kind.count * kind.rows * sizes.products[kind.aside]
    if sizes.lit == 1:
        return {
            "tables_isolated": kind.count,
            "products_isolated": products,
            "phase_isolated": wide * kind.count * sizes.phase,
        }
    # coarse cuts drop most lenslets
    kept = wide * kind.count * sizes.lit**2 * kind.halves * lenslets
    return {
        "tables_joined": kind.count,
        "products_joined": products,
        "lenslets": kept,
        "lenslet_phase": kept * sizes.phase,
        "lenslet_values": kept * sizes.nodes * sizes.across,
    }


def _table_bytes(kind: _Kind, sizes: _Sizes, geometry: Geometry, item: int) -> dict[str, float]:
    """What is held while a table of this kind is compressed."""
    rows = kind.rows * sizes.joined
    columns = item * rows * sizes.products[kind.aside]
    found = {"sketch": item * rows * sketch_size(sizes.ranks[kind.aside])}
    if sizes.lit == 1:
        return found | {"columns_isolated": columns}
    # fine fields have far fewer terms a lenslet than products, and are narrowed to them; terms
    # that neighbours' edges bring come on top
    fine = min(1.0, sizes.decades)
    edges = max(0.0, sizes.decades - 1) * math.sqrt(geometry.diffraction_cells / MANY_CELLS)
    return found | {
        "columns_coarse": columns * (1 - fine),
        "columns_fine": columns * fine,
        "columns_of_edges": columns * edges,
        "columns_of_edges_aside": columns * edges * kind.aside,
    }
