"""How many terms an exact field is expected to have before it is computed.

The laws' numbers lie with the costs that they serve (plenocli.forward.propagation.costs), and
pipelines/benchmarks/fit_costs.py compares them with the counts of computed fields.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

from plenocli.base.errors import NumericsError
from plenocli.forward.propagation.costs import law
from plenocli.forward.propagation.exact.low_rank_product import FILL, MAX_SKETCH
from plenocli.forward.propagation.fresnel.spread_terms import expected_terms
from plenocli.forward.propagation.plan import BandPlan

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry

MANY_CELLS, EDGE_CELLS = 100.0, 50.0
"""Diffraction cells of a lenslet that the effects of fine cuts and of edges are stated for."""
MARGIN = 1.12
"""How many more terms than expected the first sketch of an isolated lenslet's field holds."""
MARGINS_JOINED, MARGIN_ASIDE = (1.2, 1.18, 0.9), 0.78
"""Of many lenslets': of what is expected on the own superpixel, by the number of axes along which
it lies beside it (0.76 to 1.02, 0.82 to 1.16 and 0.7 to 0.88 of it were found with three cameras
from 1e-2 to 1e-4); and of what is expected on the superpixel itself at the least: what a sketch
misses of dim points is told by nothing else. One that is too small costs more than one that is too
large.
"""
MANY = 200
"""Columns of a first sketch beyond which singular vectors cost more than the terms that they save.
"""
FINE_DECADES = 2.0
"""Decades below the coarsest cut from which on fields with neighbours take more terms."""


@dataclass(frozen=True, kw_only=True)
class ExactBand(BandPlan):
    """A BandPlan of the exact model.

    cut: root-energy error of a mean point's field;
    sensor_count: prolate functions across a superpixel that carry the field before it goes to the
        pixels' nodes, 0: the pixels' nodes serve.
    """

    cut: float = 1e-5
    sensor_count: int = 0


@dataclass(frozen=True, kw_only=True)
class TermLaw:
    """Numbers of the laws of this module.

    coarsest_cut: coarsest root-energy cut at which terms were counted;
    kept_a_coarser_decade: share of them that a cut ten times coarser keeps;
    terms_kept, terms_by_phase, terms_phase_power: terms of the field for each of the main lens's,
        by the corner phase;
    decade_*: terms that each decade of the cut adds, by diffraction cells and corner phase;
    separable_pupil: share of terms that a square pupil without filters leaves;
    rank_*: terms with coherent neighbours for each without them: rank_joined on the own
        superpixel, more for the lenslets' edges, beside the own one and at fine cuts;
    products_*: pairs of terms from which they are compressed: products_own for each term of the
        own lenslet, products_share to products_most of that for each lenslet beside it;
    lenslets_*: share of lenslets that the coarsest cut keeps, and what each decade adds;
    nodes_beside: nodes of a lenslet more than its share of the light's way.
    """

    coarsest_cut: float
    kept_a_coarser_decade: float
    terms_kept: float
    terms_by_phase: float
    terms_phase_power: float
    decade_parabolic: float
    decade_hyperbolic: float
    decade_cells_power: float
    decade_phase_weight: float
    decade_phase_power: float
    separable_pupil: float
    rank_joined: float
    rank_edges: float
    rank_aside: float
    rank_edges_aside: float
    edges_cells_power: float
    rank_fine: float
    products_own: float
    products_hyperbolic: float
    products_phase_power: float
    products_share: float
    products_most: float
    products_cells_power: float
    products_phase_half: float
    products_aside: float
    lenslets_coarse: float
    lenslets_a_decade: float
    nodes_beside: float

    def decades(self, cut: float) -> float:
        """Decades by which a cut is finer than the coarsest, 0 for coarser ones."""
        return max(0.0, math.log10(self.coarsest_cut / cut))


@cache
def term_law() -> TermLaw:
    """The TermLaw that plans are made with."""
    return TermLaw(**law("exact, low rank").counts)


def sketch_size(terms: float, margin: float = MARGIN) -> float:
    """Columns of the random sketch that is begun with where so many terms are expected.

    margin: MARGIN, MARGIN_ASIDE or one of MARGINS_JOINED.
    """
    return margin / FILL * terms + 8


def is_spanned(sketch: float) -> bool:
    """Whether a product that a sketch of so many columns is begun for keeps its columns as they
    are, where it stands alone: singular vectors would cost more than the terms that they save.
    """
    return sketch > MANY


def require_sketch(terms: float) -> None:
    """Raises NumericsError for a field of so many terms that no sketch holds them."""
    if terms > FILL * MAX_SKETCH:
        raise NumericsError(
            (
                f"the exact field has about {terms:.0f} separable terms, more than "
                f"{int(FILL * MAX_SKETCH)}"
            ),
            "model",
            "ask for a looser accuracy or the paraxial model",
        )


def corner_phase(geometry: Geometry) -> float:
    """Phase (rad) of the kernel that does not separate, at a superpixel's largest displacements."""
    far = geometry.lenslet_width / 2 + max(geometry.pixel_shape) * geometry.pixel_pitch / 2
    return geometry.k * far**4 / (4 * geometry.z3**3)


def oblique_share(geometry: Geometry) -> float:
    """By how much more terms a lenslet off the axis has than one on it, 1 on the axis.

    Returns a number, within a third of 5 cameras' fields (docs/model.md, "Exact propagation").
    """
    if geometry.chief == (0.0, 0.0):
        return 1.0
    cy, cx = (c * geometry.z3 / geometry.z2 for c in geometry.chief)
    far = geometry.lenslet_width / 2 + max(geometry.pixel_shape) * geometry.pixel_pitch / 2
    cubed = (geometry.z3**2 + cy**2 + cx**2) ** 1.5
    both = geometry.k * abs(cy * cx) * far**2 / cubed
    along = geometry.k * math.hypot(cy, cx) * far**3 / (2 * cubed)
    return 1 + 0.6 * math.sqrt(both) + 0.25 * math.sqrt(along)


def field_terms(
    geometry: Geometry, terms: float, cut: float, parabolic: bool, numbers: TermLaw | None = None
) -> float:
    """Terms of an isolated lenslet's field.

    terms: those of the main lens's spread function;
    cut: root energy that may be lost;
    parabolic: profile of the lenslet, else hyperbolic.

    Returns a number, within 8 % rms of 144 fields (f/1.5 to f/64, cuts of 5e-3 to 5e-7).
    docs/model.md, "Exact propagation".
    """
    n = numbers or term_law()
    phase, decades = corner_phase(geometry), math.log10(n.coarsest_cut / cut)
    if decades < 0:
        coarse = field_terms(
            geometry, _spread_terms(geometry, n.coarsest_cut), n.coarsest_cut, parabolic, n
        )
        return max(2.0, n.kept_a_coarser_decade**-decades * coarse)
    each = (
        (n.decade_parabolic if parabolic else n.decade_hyperbolic)
        * geometry.diffraction_cells**n.decade_cells_power
        * (1 + n.decade_phase_weight * phase) ** n.decade_phase_power
    )
    kept = n.terms_kept + n.terms_by_phase * phase**n.terms_phase_power
    return max(2.0, (terms * kept + decades * each) * oblique_share(geometry))


def own_terms(geometry: Geometry, band: BandPlan, cut: float) -> float:
    """Terms of the main lens's spread function on one lenslet alone."""
    return band.terms if band.window is None else _spread_terms(geometry, cut)


def _spread_terms(geometry: Geometry, cut: float) -> float:
    # a cut of the field goes with one of the spread function that is 1/0.9 of it
    return expected_terms(geometry.k * geometry.D1 / 2 * geometry.D2 / geometry.z2, cut / 0.9)


def own_rank(
    geometry: Geometry, band: ExactBand, parabolic: bool, numbers: TermLaw | None = None
) -> float:
    """Terms of the field of a lenslet on its own superpixel, without neighbours."""
    own = own_terms(geometry, band, band.cut)
    return field_terms(geometry, own, band.cut, parabolic, numbers)


def field_rank(
    geometry: Geometry,
    band: ExactBand,
    parabolic: bool,
    aside: int = 0,
    numbers: TermLaw | None = None,
) -> float:
    """Terms of the field of all lenslets on a superpixel.

    aside: by how many axes (0 to 2) the superpixel lies beside the object's own.

    Returns a number, within 0.55 to 1.3 of 88 tables of 8 cameras.
    """
    n = numbers or term_law()
    own = own_rank(geometry, band, parabolic, n)
    if band.window is None:
        return own
    edges = n.decades(band.cut) * (EDGE_CELLS / geometry.diffraction_cells) ** n.edges_cells_power
    return (
        own
        * (n.rank_joined + n.rank_edges * edges)
        * (1 + (n.rank_aside + n.rank_edges_aside * edges) * aside)
    )


def fine_rank(geometry: Geometry, band: ExactBand, numbers: TermLaw | None = None) -> float:
    """By how much more terms than field_rank says fine fields with neighbours take."""
    n = numbers or term_law()
    more = max(0.0, n.decades(band.cut) - FINE_DECADES)
    return 1 + n.rank_fine * more * math.sqrt(geometry.diffraction_cells / MANY_CELLS)


def own_products(
    geometry: Geometry, band: ExactBand, parabolic: bool, numbers: TermLaw | None = None
) -> float:
    """Pairs of terms from which the field of a lenslet on its own superpixel is compressed."""
    n = numbers or term_law()
    return (
        n.products_own
        * (1 if parabolic else n.products_hyperbolic)
        * (1 + corner_phase(geometry)) ** n.products_phase_power
        * (0.7 + 0.3 * oblique_share(geometry))
        * own_rank(geometry, band, parabolic, n)
    )


def field_products(
    geometry: Geometry,
    band: ExactBand,
    parabolic: bool,
    aside: int = 0,
    numbers: TermLaw | None = None,
) -> float:
    """Pairs of terms from which the field of all lenslets on a superpixel is compressed.

    aside: as in field_rank.

    Returns a number, within 0.85 to 1.35 of 18 tables of 5 cameras.
    """
    n = numbers or term_law()
    own = own_products(geometry, band, parabolic, n)
    if band.window is None:
        return own
    phase = corner_phase(geometry)
    # what a lenslet beside the own one adds, on an average
    share = (
        min(
            n.products_most,
            n.products_share
            * n.decades(band.cut)
            * geometry.diffraction_cells**-n.products_cells_power
            * phase
            / (phase + n.products_phase_half),
        )
        * n.products_aside**aside
    )
    return own * (1 + share * ((2 * band.window + 1) ** 2 - 1))
