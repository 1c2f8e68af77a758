"""How a system matrix is computed: node counts, coherent neighbours, precision.

Chosen before any work (plenocli.forward.accuracy).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.camera.pupil import wavefront_slope
from plenocli.forward.camera.quadrature import band_rule, nodes_for
from plenocli.forward.camera.sections.main_lens import noll_indices
from plenocli.forward.propagation.fresnel.paraxial_error import oblique_error
from plenocli.forward.propagation.fresnel.spread_function import psf_nodes
from plenocli.forward.propagation.fresnel.spread_terms import expected_terms
from plenocli.forward.propagation.fresnel.trial_columns import (
    TrialColumns,
    cut_field,
    trial_columns,
)
from plenocli.forward.propagation.plan import BandPlan

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera

Tries: TypeAlias = Callable[
    ["Camera", "Geometry", tuple[int, int], int | None, bool], TrialColumns | None
]
"""What tries columns: trial_columns or the like."""
FRINGES = ((0.65, 1.0), (4.0, 2.0), (0.1, 2.0), (0.03, 2.0))
"""Weight a N^-b of the fringes between lenslets 1, 2, ... apart in a column, N their cells."""
LAW = 0.5
"""Share of an accuracy that pixel_error may reach: it says as little as that of the true error.
"""
WHOLE, BESIDE = (1.0, 1.0, 1.0), (0.65, 0.65, 0.3)
"""Shares of these in a column and in what superpixels beside its own hold of it in focus: fringes
of one lenslet, of it with the next, with others (measured: at most 0.5, 0.62 and 0.2).
"""
BESIDE_CELLS = 15
"""Diffraction cells of a lenslet from which BESIDE holds."""
FITTED_CELLS = 210
"""Diffraction cells of a lenslet up to which pixel_error was compared with columns."""
FEW_FRINGES = 3.0, 1.0
"""Cycles a pixel of one lenslet's light, in focus and out of it, up to which the light's own
size does not matter to the pixels' nodes.
"""
LATE = 8.0
"""How much more lenslets that a blurred point lights interfere in such pixels than FRINGES has
it: up to the end of their band.
"""
MOST_NODES = 200
"""Nodes of a pixel per axis that are out of reach."""
RULES, MAX_RULE = 8, 20
"""Steps of quadrature.band_rule that are tried, and the most nodes for which they are."""
MANY = 512
"""Distances between lenslets of which fringes are looked at, evenly spaced where there are more."""
PSF_CUT_EFFECT = 0.3
"""Effect of the spread function's cut on a column, over the cut's root energy
(measured, worst column).
"""
TOUCHING = 0.999
"""Width of square lenslets over their pitch from which on no point lies in a gap."""
BRIGHT = 0.25
"""Light of the dimmest point of square lenslets that touch: a corner's, which four share."""
UNTRIED, UNTRIED_WEIGHT = 1e-6, 3.0
"""Light that the dimmest point is expected to have where columns are too large to be tried, and by
how much finer pixels are then sampled.
"""
ASIDE, BENT = 1.5, 4.0
"""By how much finer pixels are sampled off the axis, and how much more where that changes a column
by its own size.
"""
TRIED_CUT_EFFECT = 0.06
"""The same where columns were tried, whose cut is for the dimmest point."""
FOUND_CUT_EFFECT, COARSE_CUT = (0.1, 0.3), 3e-3
"""The same over the root energy that is known to be cut, below and above a coarse cut."""
NARROWING_LOSS = 2.0
"""Root energy that superpixels together may lose where each keeps only the terms that it needs,
over the spread function's cut.
"""


def blur_ring(geometry: Geometry) -> int:
    """Lenslets that the geometric blur of a point at the lenslet's edge reaches beyond
    its own, per side.
    """
    return math.ceil(geometry.blur / (2 * geometry.D2 * geometry.row_spacing) - 1e-9)


def predicted_outside(geometry: Geometry, ring: int) -> float:
    """Share of a corner point's light that falls outside a window of lenslets.

    ring: lenslets on either side of the own one.

    Returns the asymptotic tail of an in-focus spread function beyond the geometric blur, 2/(pi v),
    v = pi r D1/(lambda z2).
    """
    distance = ring * geometry.D2 - geometry.blur / 2
    if distance <= 0:
        return 1.0
    return min(1.0, 2 * geometry.wavelength * geometry.z2 / (math.pi**2 * distance * geometry.D1))


def coherent_window(geometry: Geometry, superpixels: tuple[int, int], ring: int) -> int | None:
    """Lenslets on either side of the object's own whose fields add.

    All of them act on every superpixel kept: an image point on a border between lenslets would else
    lose the interference of its two halves, which cancels their edge diffraction far out.

    superpixels: (rows, columns) kept;
    ring: of coherent neighbours.

    Returns None for isolated lenslets, ring 0.
    """
    return (
        None
        if ring == 0
        else max(math.ceil(max(geometry.reach(superpixels))), blur_ring(geometry)) + ring
    )


def neighbour_fringes(geometry: Geometry) -> float:
    """Cycles in a pixel of the fringes of a lenslet with the next."""
    return geometry.D2 * geometry.pixel_active / (geometry.wavelength * geometry.z3)


def _half_phase(geometry: Geometry, far: float) -> float:
    """Largest change of the phase (rad over half a lenslet) where its light is followed to a
    superpixel `far` lenslets away.
    """
    half_width = max(geometry.lenslet_extent)
    raster = 0 if geometry.pixel_shift is None else 1
    reach = (
        max(geometry.pixel_shape) + raster
    ) * geometry.pixel_pitch / 2 + far * geometry.superpixel_pitch
    return (
        half_width
        * geometry.k
        * (reach / geometry.z3 + geometry.D1 / 2 / geometry.z2 + abs(geometry.kappa) * half_width)
    )


def size_band(
    camera: Camera,
    geometry: Geometry,
    superpixels: tuple[int, int],
    ring: int,
    accuracy: float,
    tolerance: float,
    dim: bool = False,
    tries: Tries = trial_columns,
) -> BandPlan:
    """As Model.size, of the paraxial models; the phase across a lenslet counts the far edge of the
    outermost superpixel that it lights.

    superpixels: (rows, columns) kept;
    ring: rings of coherent neighbours, 0 for isolated lenslets;
    accuracy: that sampling may use up;
    tolerance: root-energy cut of the spread function;
    dim: whether superpixels beside the object's own may have fewer nodes, where so little light
        falls on them that it does not tell;
    tries: how columns are tried.

    Raises NumericsError as psf_nodes.
    """
    window = coherent_window(geometry, superpixels, ring)
    accuracy /= _finer_aside(geometry)
    lit = max(geometry.reach(superpixels, window))
    far = 0 if window is None else max(geometry.reach(superpixels)) + lit
    active = geometry.pixel_active / (geometry.wavelength * geometry.z3)
    own = 2 * max(geometry.lenslet_extent) * active
    joint = (1 if window is None else 2 * lit + 1) * geometry.D2 * active
    half = geometry.field_half(superpixels, window)
    count = psf_nodes(geometry, half)
    light = own, joint, geometry.diffraction_cells, geometry.blur / geometry.D2
    cut_effect, errors, beside = PSF_CUT_EFFECT * tolerance, [], None
    if touch(geometry):
        faintest = BRIGHT
        nodes, rule = pixel_nodes(accuracy, *light)
        errors.append(pixel_error(nodes, rule, *light))
        sharp = geometry.blur == 0 and geometry.diffraction_cells > BESIDE_CELLS
        fewer = pixel_nodes(accuracy, *light, BESIDE) if dim and sharp and window else (nodes, 0)
        if fewer[0] < nodes:
            beside = fewer
            # a point at a corner lights two of them
            errors.append(math.sqrt(2) * pixel_error(*fewer, *light, BESIDE))
    else:
        tried, error = _beside_gaps(camera, geometry, superpixels, window, light, tries)
        # a point between lenslets is dim, and what is missed weighs more in its column
        faintest, weight = UNTRIED, UNTRIED_WEIGHT
        if tried is not None:
            faintest, weight = tried.faintest, tried.beyond
            cut_effect = TRIED_CUT_EFFECT * tolerance
        nodes, rule = _required(_fewest(error, accuracy / 1.5 / weight), joint)
        errors.append(weight * error(nodes, rule))
    root = dimness(faintest)
    terms = expected_terms(geometry.k * geometry.D1 / 2 * half / geometry.z2, root * tolerance)
    cut = cut_field(camera, geometry, half, root * tolerance)
    if cut is not None:
        terms, tail = cut
        cut_effect = FOUND_CUT_EFFECT[tail > COARSE_CUT] * tail / root
    return BandPlan(
        wavelength=geometry.wavelength,
        window=window,
        lenslet_nodes=nodes_for(_half_phase(geometry, far)),
        pixel_nodes=nodes,
        psf_nodes=count,
        terms=terms,
        half=half,
        spread_cut=root * tolerance,
        faintest=root,
        sampling=math.hypot(cut_effect, *errors),
        pixel_rule=rule,
        beside=beside,
    )


def _finer_aside(geometry: Geometry) -> float:
    """By how much finer pixels are sampled off the axis, whose columns were tried on it."""
    if geometry.chief == (0.0, 0.0):
        return 1.0
    return ASIDE + BENT * min(1.0, oblique_error(geometry, False))


def touch(geometry: Geometry) -> bool:
    """Whether lenslets are square and leave no gaps."""
    return geometry.lenslet_shape == "square" and geometry.lenslet_width >= TOUCHING * geometry.D2


def dimness(light: float) -> float:
    """Root of a point's light, over that of the dimmest of square lenslets that touch, at most 1:
    what is missed of the brightest weighs so much more in its column.
    """
    return min(1.0, math.sqrt(light / BRIGHT))


def _beside_gaps(
    camera: Camera,
    geometry: Geometry,
    superpixels: tuple[int, int],
    window: int | None,
    light: tuple[float, float, float, float],
    tries: Tries,
) -> tuple[TrialColumns | None, Callable[[int, int], float]]:
    """(columns tried, None for none; what rules of a pixel's nodes miss) between lenslets that
    leave gaps, or are round: by a law what could not be tried.
    """
    symmetric = is_symmetric(camera)
    tried = tries(camera, geometry, superpixels, window, symmetric)
    if tried is not None:
        far = _fringes_beside_gaps(geometry, light)
        return tried, tried.error if tried.reach(window) else partial(_worse, tried.error, far)
    alone = None
    if window is not None:
        alone = tries(camera, geometry, superpixels, None, symmetric)
    if alone is None:
        return None, _fringes_beside_gaps(geometry, light)
    return alone, partial(_worse, alone.error, _untried(geometry, light))


def _fringes_beside_gaps(
    geometry: Geometry, light: tuple[float, float, float, float]
) -> Callable[[int, int], float]:
    """pixel_error of `light`, larger where lenslets leave gaps."""
    faint = 1 + min(20.0, 80 * (1 - geometry.lenslet_width / geometry.D2))
    return lambda count, rule: faint * pixel_error(count, rule, *light)


def _untried(
    geometry: Geometry, light: tuple[float, float, float, float]
) -> Callable[[int, int], float]:
    """pixel_error of `light` where neighbours' fringes could not be tried: those of lenslets side
    by side, or under one point's blur, may be all that a point between lenslets has.
    """
    own, joint, _, blur = light
    beside = neighbour_fringes(geometry)
    cycles = np.linspace(0, min(joint, own + max(1.0, blur) * beside), MANY)
    return partial(
        _worse,
        _fringes_beside_gaps(geometry, light),
        lambda count, rule: float(rule_error(count, cycles, rule).max()),
    )


def _worse(
    one: Callable[[int, int], float], other: Callable[[int, int], float], count: int, rule: int
) -> float:
    return max(one(count, rule), other(count, rule))


def is_symmetric(camera: Camera) -> bool:
    """Whether pupil, filters and wavefront error are mirrored by both axes and the diagonals, as
    the dial counts on.
    """
    lens = camera.main_lens
    plain = (
        lens.aperture_shape != "image"
        and camera.filter_array is None
        and lens.wavefront is None
        and not lens.rims
    )
    return plain and all(noll_indices(term.noll)[1] == 0 for term in lens.aberrations or ())


def field_features(camera: Camera, geometry: Geometry, band: BandPlan) -> dict[str, float]:
    """What bringing the spread function into separable terms consists of: the square and the
    cube of its nodes along an axis, of a real or a complex function, and waves of the pupil.
    """
    even = is_symmetric(camera)
    nodes = band.psf_nodes / 2 if even else band.psf_nodes
    if has_real_field(camera, geometry):
        return {"field_cubed_real": nodes**3, "field_squared_real": nodes**2}
    found = {"field_cubed_complex": nodes**3, "field_squared_complex": nodes**2}
    return found if even else found | {"pupil_waves": pupil_waves(camera, geometry, band)}


def has_real_field(camera: Camera, geometry: Geometry) -> bool:
    """Whether the spread function is real: of symmetric pupils in focus."""
    return is_symmetric(camera) and geometry.blur == 0


def pupil_waves(camera: Camera, geometry: Geometry, band: BandPlan) -> float:
    """Nodes of a pupil without symmetry, each with as many waves as the spread function's axis has
    nodes.
    """
    g, lens = geometry, camera.main_lens
    slope = math.sqrt(2) * band.half / g.z2 + abs(g.eps) * g.D1 / 2 + wavefront_slope(lens)
    return float(nodes_for(g.k * slope * g.D1 / 2) ** 2 * band.psf_nodes)


def superpixels_of(count: int) -> tuple[int, int]:
    """(rows, columns) of so many superpixels: a square block, else one row."""
    side = math.isqrt(count)
    return (side, side) if side * side == count else (1, count)


def expected_symmetry(
    camera: Camera, geometry: Geometry, shape: tuple[int, ...]
) -> tuple[bool, bool, bool]:
    """(flip rows, flip columns, exchange both) of the points that map columns of a matrix onto
    columns.

    shape: (band, superpixel, pixel, point).
    """
    superpixels, (rows, columns) = superpixels_of(shape[1]), geometry.object_shape
    if shape[3] < rows * columns or not is_symmetric(camera):
        return False, False, False
    flip_rows, flip_columns, turn = geometry.mirrors(superpixels)
    turn = (
        turn
        and flip_rows == flip_columns
        and rows == columns
        and geometry.pixel_shape[0] == geometry.pixel_shape[1]
        and superpixels[0] == superpixels[1]
    )
    return flip_rows, flip_columns, turn


def distinct(camera: Camera, geometry: Geometry, shape: tuple[int, ...]) -> tuple[int, int]:
    """What symmetry leaves to compute of a matrix.

    shape: (band, superpixel, pixel, point).

    Returns (points whose columns it needs on every superpixel, pairs of a superpixel and a point).
    """
    superpixels, (rows, columns) = superpixels_of(shape[1]), geometry.object_shape
    flip_rows, flip_columns, turn = expected_symmetry(camera, geometry, shape)
    if not (flip_rows or flip_columns or turn):
        return shape[3], shape[1] * shape[3]

    def lines(flip: bool, points: int, superpixels: int) -> tuple[int, int]:
        """Of all superpixels of an axis and of the object's own: lines of points to compute."""
        own = (points + 1) // 2 if flip else points
        return own + (superpixels // 2 if flip else superpixels - 1) * points, own

    (down, own_down), (across, own_across) = (
        lines(flip_rows, rows, superpixels[0]),
        lines(flip_columns, columns, superpixels[1]),
    )
    if turn:
        return own_down * (own_down + 1) // 2, down * (down + 1) // 2
    return own_down * own_across, down * across


@lru_cache(maxsize=1024)
def pixel_nodes(
    accuracy: float,
    own: float,
    joint: float,
    cells: float,
    blur: float,
    shares: tuple[float, float, float] = WHOLE,
) -> tuple[int, int]:
    """Fewest nodes per axis of a pixel that keep an accuracy.

    accuracy: the estimated error is at most LAW of it;
    own: cycles a pixel up to which one lenslet's light makes fringes;
    joint: up to which all lenslets together do;
    cells: diffraction cells of a lenslet;
    blur: of a point out of focus, in lenslets;
    shares: WHOLE or BESIDE.

    Returns (nodes, step of quadrature.band_rule).
    """
    light = own, joint, cells, blur, shares
    found = _fewest(lambda count, rule: pixel_error(count, rule, *light), LAW * accuracy)
    return _required(found, joint)


def _required(found: tuple[int, int] | None, joint: float) -> tuple[int, int]:
    if found is None:
        raise NumericsError(
            f"{joint:.0f} interference fringes a pixel cannot be integrated",
            "sensor.pixel_pitch",
            "use smaller pixels",
        )
    return found


def _fewest(error: Callable[[int, int], float], most: float) -> tuple[int, int] | None:
    """As pixel_nodes, that keep an estimate error(nodes, step of quadrature.band_rule) within
    `most`; None where MOST_NODES are too few.
    """
    count = next((n for n in range(2, MOST_NODES) if error(n, 0) <= most), None)
    if count is None:
        return None
    best = count, 0
    # rules made for a band of frequencies need fewer nodes than Gauss-Legendre's
    while 2 < best[0] <= MAX_RULE:
        errors = [error(best[0] - 1, step) for step in range(RULES)]
        if min(errors) > most:
            break
        best = best[0] - 1, errors.index(min(errors))
    return best


@lru_cache(maxsize=4096)
def pixel_error(
    count: int,
    rule: int,
    own: float,
    joint: float,
    cells: float,
    blur: float,
    shares: tuple[float, float, float] = WHOLE,
) -> float:
    """Estimated relative error of a column from the quadrature over its pixels.

    The light of two lenslets n apart makes fringes of (n - 1) own to (n + 1) own cycles a pixel,
    most of them in the middle.

    count: nodes per axis;
    rule: step of quadrature.band_rule;
    own, joint, cells, blur, shares: as for pixel_nodes.

    Returns a tenth to twice the error measured against converged columns (770 of 12 cameras,
    isolated and joined, blurred over up to 5 lenslets, rules 0 to 7).
    """
    # rules of wide bands err where the light is, not at its end; out of focus each lenslet's light
    # is small and has sharp edges
    spread = (1 + min(own / 2, 2.0) if rule >= 5 else 1.0) * (1.3 if rule and blur else 1.0)
    # beyond the cells that were compared more was missed than they let expect: 2 % at 412 cells,
    # where this has 2.5
    spread *= max(1.0, cells / FITTED_CELLS) ** 2
    share = np.linspace(0, 1, 65)[1:-1]
    alone = float((rule_error(count, share * own, rule) * (1 - share)).max())
    alone *= (1 + 0.6 * blur) * min(0.5, 1.6 * spread * (1 + 5 / cells) / (1 + own) * cells**-0.5)
    many = own > FEW_FRINGES[blur > 0]
    if many:
        alone = max(alone, _patch_error(count, rule, own, cells, blur))
    worst = shares[0] * alone
    for apart, error in _fringe_errors(count, rule, own, round(joint / own)):
        size, power = FRINGES[min(apart, len(FRINGES)) - 1]
        weight = size * cells**-power
        # lenslets that a blurred point lights evenly
        if apart == 1:
            weight = max(weight, 0.35 * min(1.0, blur / 2) ** 1.8)
        elif apart <= blur:
            weight = max(weight, FRINGES[0][0] / (cells * apart**2))
        if many and blur:
            weight *= LATE
        worst = max(worst, shares[min(apart, 2)] * min(0.5, weight) * error)
    return worst


def _fringe_errors(count: int, rule: int, own: float, lenslets: int) -> Iterator[tuple[int, float]]:
    """(n, the rule's largest error for the fringes of lenslets n apart, weighted with how many
    there are of each frequency) for n from 1 to below `lenslets`, at most MANY of them.
    """
    beside = max(lenslets, 1) - 1
    some = sorted({*np.linspace(1, beside, min(beside, MANY)).round().astype(int).tolist()})
    apart, share, (t, w) = (
        np.array(some, int)[:, None],
        np.linspace(-1, 1, 65)[1:-1],
        band_rule(count, rule),
    )
    whole, part = np.pi * own * apart * t, np.pi * own * np.outer(t, share)
    found = (np.cos(whole) * w) @ np.cos(part) - (np.sin(whole) * w) @ np.sin(part)
    errors = (np.abs(found / 2 - np.sinc(own * (apart + share))) * (1 - np.abs(share))).max(axis=1)
    return zip(some, errors.tolist())


def _patch_error(count: int, rule: int, own: float, cells: float, blur: float) -> float:
    """Relative error of a column from the evenly lit patch that one lenslet throws: the pupil's
    image, out of focus that part of it, down to one cycle. Its spectrum along an axis falls as
    1/(pi f width) and ends at `own`, in focus smoothly, out of it as the transfer function of a
    defocused lens does (Hopkins 1955): late. What was measured was 0.2 to 1.5 times this (225
    random cameras, own 1 to 57, blur 0 to 5).
    """
    share = (np.arange(96) + 0.5) / 96
    share, step = share**2, own * 2 * share / 96
    width = max(cells / own / max(blur, 1.0), 1 / own)
    patch = np.minimum(1, 1 / (np.pi * own * share * width))
    light = np.minimum(1 - share, patch) if blur else (1 - share) * patch
    return float(
        np.sqrt(
            10
            * max(1.0, width)
            * ((light * rule_error(count, own * share, rule)) ** 2 * step).sum()
        )
    )


def rule_error(count: int, cycles: np.ndarray, rule: int = 0) -> np.ndarray:
    """Error of a rule for cos(2 pi c t) on a unit pixel.

    count: nodes;
    cycles: c, of any shape;
    rule: step of quadrature.band_rule.

    Returns numbers of the shape of c.
    """
    t, w = band_rule(count, rule)
    return np.abs(np.cos(np.pi * np.outer(cycles, t)) @ w / 2 - np.sinc(cycles))
