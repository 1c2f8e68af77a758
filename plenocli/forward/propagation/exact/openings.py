"""Matrices of lenslets of any shape, anywhere on the array and with their neighbours, by the exact
scalar kernel on whole openings: open_fields. docs/model.md, "Exact propagation".
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.camera.quadrature import nodes_for
from plenocli.forward.propagation.costs import Features
from plenocli.forward.propagation.exact.cost_law import OBLIQUE_TERMS, columns, field_seconds
from plenocli.forward.propagation.exact.oblique import orders_for
from plenocli.forward.propagation.exact.open_fields import (
    OpenFields,
    Opening,
    Place,
    lenslets_about,
    offset_of,
    opening_nodes,
    residual_of,
    seen_from,
    too_near,
)
from plenocli.forward.propagation.exact.residual import Residual
from plenocli.forward.propagation.exact.trial import exact_trial_columns
from plenocli.forward.propagation.fresnel.array_to_sensor import pixel_energy, sensor_nodes
from plenocli.forward.propagation.lenslet_fields import FieldNotes, LensletFields, PixelEnergies
from plenocli.forward.propagation.plan import BandPlan
from plenocli.forward.propagation.sampling import (
    expected_symmetry,
    size_band,
    superpixels_of,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.plan import PifPlan

MOST_PAIRS = 4000
"""Pairs of a lenslet and a superpixel beyond which a sum over openings is no plan."""
KERNEL_CUT = 0.1
"""Root mean square that may be left out of the kernel, over the accuracy asked for."""
CUT_ASIDE = 0.08
"""Effect of the spread function's cut off the axis on the dimmest column, over the cut and the
fourth root of the column's light: with it 96 % of 448 foreign cameras' errors were told within a
factor of ten.
"""
TOGETHER = 1 << 22
"""Values on the sensor of points that are gone through together."""


@dataclass(frozen=True, kw_only=True)
class OpeningBand(BandPlan):
    """A BandPlan of the exact model through whole openings: lenslet_nodes of the farthest pair of
    a lenslet and a superpixel.

    kernel_cut: root mean square that may be left out of the kernel;
    kernel_terms: products that the kernel takes, from the lenslet that is farthest.
    """

    kernel_cut: float
    kernel_terms: int


def valid_for(camera: Camera, geometry: Geometry) -> str | None:
    """As Model.valid_for: no evanescent waves on the sensor, nor lenslets whose terms separate."""
    shape, lattice = camera.lenslet_array.aperture_shape, camera.lenslet_array.lattice
    if (shape, lattice, geometry.chief) == ("square", "square", (0.0, 0.0)):
        return "square lenslets on the axis are left to separable terms"
    return too_near(geometry)


def opening_band(
    camera: Camera,
    geometry: Geometry,
    superpixels: tuple[int, int],
    ring: int,
    accuracy: float,
    tolerance: float,
) -> OpeningBand:
    """As Model.size.

    Raises NumericsError as size_band, and for more than MOST_PAIRS.
    """
    base = size_band(
        camera, geometry, superpixels, ring, accuracy, tolerance, tries=exact_trial_columns
    )
    count = math.prod(superpixels)
    if base.window is not None:
        count *= len(lenslets_about(geometry, superpixels, base.window))
    if count > MOST_PAIRS:
        raise NumericsError(
            f"{count} pairs of a lenslet and a superpixel are too many to sum over openings",
            "superpixels",
            "take fewer superpixels or coherent neighbours",
        )
    # off the axis there is more to cut
    aside, dim = geometry.chief != (0.0, 0.0), math.sqrt(base.faintest)
    moved = aside * CUT_ASIDE * base.spread_cut / dim
    cut = KERNEL_CUT * accuracy * base.faintest
    parabolic = camera.lenslet_array.profile == "parabolic"
    pairs = {pair for _, pair in _pairs(geometry, superpixels, base.window)}
    own, far = _nearest_and_farthest(geometry, pairs, cut)
    return OpeningBand(
        **vars(base)
        | {
            "lenslet_nodes": max(opening_nodes(geometry, parabolic, *pair) for pair in pairs),
            "sampling": math.hypot(base.sampling, moved, own.lost / dim),
        },
        kernel_cut=cut,
        kernel_terms=len(far.core),
    )


class OpenLenslets(LensletFields):
    """Sensor fields behind lenslets of any shape by the exact kernel; see the module."""

    shared_axis = 1

    def __init__(
        self, camera: Camera, geometry: Geometry, plan: PifPlan, band: OpeningBand
    ) -> None:
        self.geometry, self.superpixels, self.band = geometry, plan.superpixels, band
        self._fields = OpenFields(
            camera,
            geometry,
            band.half,
            (band.spread_cut, band.kernel_cut),
            band.window,
            np.dtype(np.complex128 if plan.double else np.complex64),
        )
        field = self._fields.field
        self.symmetry = field.symmetry
        self.notes = FieldNotes(
            separable_terms=band.kernel_terms, field_tail=field.tail, psf_terms=field.terms
        )

    def incident(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """As LensletFields.incident."""
        g, total = self.geometry, np.zeros(len(rows))
        count = nodes_for(4 * g.k * g.D1 / 2 / g.z2 * max(g.lenslet_extent))
        for lenslet in lenslets_about(g, self.superpixels, self.band.window):
            opening = Opening(g, self._fields.parabolic, lenslet, count)
            weight = opening.weights * opening.nearer**2
            for some, fields in self._fields.entering(opening, rows, columns):
                power = np.square(fields.real) + np.square(fields.imag)
                total[some] += np.tensordot(power, weight, 2)
        return total * (1 + self.band.sampling)

    def on_superpixel(self, sy: int, sx: int) -> PixelEnergies:
        """As LensletFields.on_superpixel."""
        reach = [(n - 1) // 2 for n in self.superpixels]
        place = self.geometry.centre(sy - reach[0], sx - reach[1])
        nodes = [
            sensor_nodes(self.geometry, axis, self.band.pixel_nodes, s, self.band.pixel_rule)
            for axis, s in enumerate(place)
        ]

        def energies(rows: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
            shape = nodes[0][0].size, nodes[1][0].size
            step = max(1, TOGETHER // math.prod(shape))
            order = np.argsort(columns, kind="stable")
            for start in range(0, len(order), step):
                part = order[start : start + step]
                lines = [(v.ravel(), w.ravel()) for v, w in nodes]
                total = self._fields.on(place, lines, rows[part], columns[part])
                out[part] = pixel_energy(
                    total.reshape(len(part), *nodes[0][0].shape, *nodes[1][0].shape)
                )

        return energies


def _pairs(
    geometry: Geometry, superpixels: tuple[int, int], window: int | None
) -> Iterator[tuple[Place, tuple[Place, Place]]]:
    """(superpixel, (offset from the lenslet, lenslet)) of all pairs."""
    for place in geometry.places(superpixels):
        for lenslet in seen_from(geometry, place, window):
            yield place, (offset_of(geometry, place, lenslet), lenslet)


def _nearest_and_farthest(
    geometry: Geometry, pairs: Collection[tuple[Place, Place]], cut: float
) -> tuple[Residual, Residual]:
    """Residuals of a lenslet's own superpixel and of the pair (offset, lenslet) farthest apart."""
    far = max(math.hypot(*offset) for offset, _ in pairs)
    farthest = min(offset for offset, _ in pairs if math.hypot(*offset) >= far)
    own = offset_of(geometry, (0.0, 0.0), (0.0, 0.0))
    return residual_of(geometry, own, cut), residual_of(geometry, farthest, cut)


def features(
    camera: Camera, geometry: Geometry, band: BandPlan, shape: tuple[int, ...], double: bool
) -> Features:
    """What a matrix consists of, as Model.features."""
    assert isinstance(band, OpeningBand)
    g, superpixels, oblique = geometry, superpixels_of(shape[1]), geometry.chief != (0.0, 0.0)
    parabolic = camera.lenslet_array.profile == "parabolic"
    lit = columns(camera, g, shape) / shape[1]
    tall, wide = (n * band.pixel_nodes for n in g.pixel_shape)
    all_pairs = [pair for _, pair in _pairs(g, superpixels, band.window)]
    nodes = np.array([opening_nodes(g, parabolic, *pair) for pair in all_pairs])
    # the kernel's products are fewer for lenslets that are near
    r = (len(_nearest_and_farthest(g, all_pairs, band.kernel_cut)[0].core) + band.kernel_terms) / 2
    made = 1.0  # share of superpixels that symmetry does not give
    if not oblique:
        flip_rows, flip_columns, turned = expected_symmetry(camera, g, shape)
        rows, across = (
            (n + flip) // (1 + flip) for n, flip in zip(superpixels, (flip_rows, flip_columns))
        )
        made = (rows * (rows + 1) / 2 if turned else rows * across) / shape[1]
    pairs = len(nodes) * made
    most, lines, terms = int(nodes.max()), max(g.object_shape), float(band.terms)
    # a wave off the axis has terms that go with the point, too
    orders, terms = orders_for(g, band.spread_cut), (OBLIQUE_TERMS if oblique else 1) * terms
    values = float((nodes**2).sum()) * lit
    # every part of the points makes its kernels anew
    parts = max(math.ceil(g.object_shape[1] / 16), math.ceil(lit * tall * wide / TOGETHER))
    twice, item = (2.0, 16) if double else (1.0, 8)
    return Features(
        {
            "products": 8.0 * r * lit * float((nodes * tall * (nodes + wide)).sum()),
            "fields": 8.0 * terms * values,
        },
        {
            "process": 1.0,
            "pairs": pairs,
            "pair_parts": pairs * parts,
            "values": twice * values,
            "sensor_values": twice * tall * wide * lit * len(nodes),
            "kernel_values": float(nodes.mean()) * r * (tall + wide) * parts * pairs,
            "spread_values": orders * pairs * parts * most * lines * band.psf_nodes * terms,
            "written": math.prod(shape[1:]),
        }
        | field_seconds(camera, g, band, band.spread_cut, twice),
        (
            {
                "process": 1.0,
                "kernels": item * band.kernel_terms * most * (tall + wide),
                "fields": item * lines * (most**2 + 2 * most * terms),
                "spread": 16 * (orders * band.psf_nodes) ** 2,
                "sensor": item * tall * wide * max(min(lit / parts, TOGETHER / tall / wide), 1),
            },
        ),
    )
