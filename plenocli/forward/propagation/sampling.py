"""How a system matrix is computed: node counts, coherent neighbours, precision.

Chosen before any work (plenocli.forward.accuracy).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.camera.pupil import noll_indices
from plenocli.forward.camera.quadrature import band_rule, nodes_for
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.forward.propagation.fresnel.spread_function import psf_nodes

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera

FRINGES = ((0.65, 1.0), (4.0, 2.0), (0.1, 2.0), (0.03, 2.0))
"""Weight a N^-b of the fringes between lenslets 1, 2, ... apart in a column, N the lenslet's
diffraction cells (measured, worst column, N from 1.3 to 140; beyond the table as its end).
"""
WHOLE, BESIDE = (1.0, 1.0, 1.0), (0.65, 0.65, 0.3)
"""Shares of these in a column and in what superpixels beside its own hold of it in focus: fringes
of one lenslet, of it with the next, with others (measured on four cameras of 17 to 140 diffraction
cells: at most 0.5, 0.62 and 0.2).
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
RULES, MAX_RULE = 8, 20
"""Steps of quadrature.band_rule that are tried, and the most nodes for which they are."""
MANY = 512
"""Distances between lenslets of which fringes are looked at, evenly spaced where there are more."""
CUT = 0.3
"""Effect of the spread function's cut on a column, over the cut's root energy
(measured, worst column).
"""
NARROW = 2.0
"""Root energy that superpixels together may lose where each keeps only the terms that it needs,
over the spread function's cut.
"""


@dataclass(frozen=True, kw_only=True)
class BandPlan:
    """Node counts of one wavelength.

    `window`: see coherent_window;
    `half`: half width (m) on which the spread function is needed;
    `sampling`: estimated relative error of the worst column from these counts;
    `pixel_rule`: which rule the pixels' nodes follow (quadrature.band_rule);
    `beside`: nodes and rule on superpixels beside the object's own, where these are fewer.
    """

    wavelength: float
    window: int | None
    lenslet_nodes: int
    pixel_nodes: int
    psf_nodes: int
    terms: int
    half: float
    sampling: float = 0.0
    pixel_rule: int = 0
    beside: tuple | None = None


@dataclass(frozen=True, kw_only=True)
class PifPlan:
    """The chosen computation (plenocli.forward.accuracy.dial.plan_pif makes it).

    model: ray, fresnel or exact;
    rung: its name;
    superpixels: (rows, columns) odd numbers;
    accuracy: as asked or found, by `asked_by`;
    tolerance: root-energy cut of the spread function;
    double: precision of the fields;
    shape: of the matrix;
    bytes: of the result;
    memory: with the work;
    estimated: relative error of the worst column;
    split: that error by source;
    model_error: of the model itself against the finest one, whether asked for by name or not;
    dtype: of the stored matrix;
    reasons, left_out, warnings: a sentence each;
    candidates: the rungs considered;
    pixel_shift: of an off-axis lenslet on the sensor's own raster
        (plenocli.forward.camera.geometry.lenslet_shift), None where windows are centred;
    band_nodes: wavelengths that stand for the camera's band of light, 0 for lines.
    """

    model: str
    rung: str
    superpixels: tuple
    coherent_ring: int
    accuracy: float
    asked_by: str
    tolerance: float
    double: bool
    bands: tuple
    shape: tuple
    bytes: int
    memory: int
    estimated: float
    split: dict
    model_error: float
    dtype: str = "float32"
    reasons: tuple = ()
    left_out: tuple = ()
    warnings: tuple = ()
    candidates: tuple = ()
    pixel_shift: tuple | None = None
    band_nodes: int = 0

    @property
    def chosen(self):
        """The candidate that is carried out."""
        return next(c for c in self.candidates if c.why is None)

    def accuracy_record(self) -> AccuracyRecord:
        """What a result of this plan says of its accuracy."""
        return AccuracyRecord(
            asked=self.accuracy,
            asked_by=self.asked_by,
            estimated=self.estimated,
            by_source=self.split,
            model=self.model,
            model_error=self.model_error,
            rung=self.rung,
            reasons=(*self.reasons, *self.warnings),
            left_out=tuple(self.left_out),
        )


def window_error(view, grid, ring):
    """Estimated relative error of a column because lenslets beyond the coherent window are left
    out; 0 if ring is 0 by choice.

    Far lenslets interfere with the own one in fringes of (w + 1) c cycles a pixel, which pixels
    average; fitted to brute force within a factor of 2 (N from 5.6 to 24 diffraction cells, c from
    0.1 to 7.5, w from 1 to 6; worst point, docs/model.md).
    """
    if ring == 0:
        return 0.0
    blur = blur_ring(view)
    # light spread over several lenslets has no sharp peak at a border, whose
    # interference reaches furthest
    window = coherent_window(view, grid, ring) - blur + (blur > 0)
    fringes = view.D2 * view.pixel_active / (view.wavelength * view.z3) * (window + 1)
    scale = 0.075 if max(grid) == 1 else 0.12
    return min(
        1.0,
        scale
        * (window - 0.29) ** -2
        * view.diffraction_cells**-1.09
        * (1 + 3.5 * fringes) ** -1.34,
    )


def blur_ring(view):
    """Lenslets that the geometric blur of a point at the lenslet's edge reaches beyond
    its own, per side.
    """
    return math.ceil(view.blur / (2 * view.D2 * view.row_spacing) - 1e-9)


def predicted_outside(view, ring):
    """Share of a corner point's light that falls outside a window of (2 ring + 1)^2 lenslets, from
    the asymptotic tail of an in-focus spread function beyond the geometric blur: 2/(pi v), v =
    pi r D1/(lambda z2).
    """
    distance = ring * view.D2 - view.blur / 2
    if distance <= 0:
        return 1.0
    return min(1.0, 2 * view.wavelength * view.z2 / (math.pi**2 * distance * view.D1))


def coherent_window(view, grid, ring):
    """Lenslets |m| <= window (from the object's own) whose fields add, or None for isolated
    lenslets (ring 0).

    All of them act on every superpixel kept: an image point on a border between lenslets would else
    lose the interference of its two halves, which cancels their edge diffraction far out.
    """
    return None if ring == 0 else max(math.ceil(max(view.reach(grid))), blur_ring(view)) + ring


def size_band(view, grid, ring, accuracy, tolerance, dim=False):
    """Node counts at one wavelength; the phase across a lenslet counts the far edge of the
    outermost superpixel it lights.

    dim: whether superpixels beside the object's own may have fewer nodes, where so little light
        falls on them that it does not tell.
    """
    half_width, window = max(view.lenslet_extent), coherent_window(view, grid, ring)
    lit = max(view.reach(grid, window))
    far = 0 if window is None else max(view.reach(grid)) + lit
    raster = 0 if view.pixel_shift is None else 1
    reach = (max(view.pixel_shape) + raster) * view.pixel_pitch / 2 + far * view.superpixel_pitch
    slope = (
        half_width
        * view.k
        * (reach / view.z3 + view.D1 / 2 / view.z2 + abs(view.kappa) * half_width)
    )
    active = view.pixel_active / (view.wavelength * view.z3)
    own, joint = 2 * half_width * active, (1 if window is None else 2 * lit + 1) * view.D2 * active
    half = view.field_half(grid, window)
    count = psf_nodes(view, half)
    terms = expected_terms(view.k * view.D1 / 2 * half / view.z2, tolerance)
    # a point between lenslets that do not touch is dim, and what is missed weighs
    # more in its column
    faint = 1 + min(20.0, 80 * (1 - view.lenslet_width / view.D2))
    light = own, joint, view.diffraction_cells, view.blur / view.D2
    nodes, rule = pixel_nodes(accuracy / faint, *light)
    errors, beside = [CUT * tolerance, faint * pixel_error(nodes, rule, *light)], None
    if dim and window is not None and view.blur == 0 and view.diffraction_cells > BESIDE_CELLS:
        fewer = pixel_nodes(accuracy / faint, *light, BESIDE)
        if fewer[0] < nodes:  # a point at a corner lights two of them
            beside, errors = (
                fewer,
                [*errors, math.sqrt(2) * faint * pixel_error(*fewer, *light, BESIDE)],
            )
    return BandPlan(
        wavelength=view.wavelength,
        window=window,
        lenslet_nodes=nodes_for(slope),
        pixel_nodes=nodes,
        psf_nodes=count,
        terms=terms,
        half=half,
        sampling=math.hypot(*errors),
        pixel_rule=rule,
        beside=beside,
    )


def expected_terms(phase, tolerance):
    """Separable terms of the spread function of a round pupil whose rim runs through `phase` rad
    from the middle to the end of the interval, cut at `tolerance`: within 2 terms or 10 % of those
    found for phases from 18 to 960 and cuts from 4e-9 to 5e-2.
    """
    digits = math.log10(1 / tolerance)
    if digits < 2.7:  # the rings of its tail go one by one
        return max(
            1, round((0.183 * phase + 4) * math.exp(-(0.17 + 4.8e-4 * phase) * (2.7 - digits) ** 2))
        )
    return max(
        1, round(0.183 * phase + 4 + (digits - 2.7) * max(0.0, 0.9 * math.log(max(phase, 1.0)) - 2))
    )


def is_symmetric(camera):
    """Whether pupil, filters and wavefront error are mirrored by both axes and the diagonals, as
    the dial counts on.
    """
    lens = camera.main_lens
    plain = (
        lens.aperture_shape != "image" and camera.filter_array is None and lens.wavefront is None
    )
    return plain and all(noll_indices(term.noll)[1] == 0 for term in lens.aberrations or ())


def field_features(camera: Camera, geometry: Geometry, band: BandPlan) -> dict[str, float]:
    """What bringing the spread function into separable terms consists of: the square and the
    cube of its nodes along an axis, of a real or a complex function.
    """
    even = is_symmetric(camera)
    nodes = band.psf_nodes / 2 if even else band.psf_nodes
    if even and geometry.blur == 0:
        return {"field_cubed_real": nodes**3, "field_squared_real": nodes**2}
    return {"field_cubed_complex": nodes**3, "field_squared_complex": nodes**2}


def grid_of(count):
    """(rows, columns) of so many superpixels: a square block, else one row."""
    side = math.isqrt(count)
    return (side, side) if side * side == count else (1, count)


def distinct(camera, view, shape):
    """What symmetry leaves to compute of a matrix of `shape` (band, superpixel, pixel, point):
    (points whose columns it needs on every superpixel, pairs of a superpixel and a point).
    """
    grid, (rows, columns) = grid_of(shape[1]), view.object_shape
    if shape[3] < rows * columns or not is_symmetric(camera):
        return shape[3], shape[1] * shape[3]
    flip_rows, flip_columns, turn = view.mirrors(grid)
    turn = (
        turn
        and flip_rows == flip_columns
        and rows == columns
        and view.pixel_shape[0] == view.pixel_shape[1]
        and grid[0] == grid[1]
    )

    def lines(flip, points, superpixels):
        """Of all superpixels of an axis and of the object's own: lines of points to compute."""
        own = (points + 1) // 2 if flip else points
        return own + (superpixels // 2 if flip else superpixels - 1) * points, own

    (down, own_down), (across, own_across) = (
        lines(flip_rows, rows, grid[0]),
        lines(flip_columns, columns, grid[1]),
    )
    if turn:
        return own_down * (own_down + 1) // 2, down * (down + 1) // 2
    return own_down * own_across, down * across


@lru_cache(maxsize=1024)
def pixel_nodes(accuracy, own, joint, cells, blur, shares=WHOLE):
    """Fewest nodes per axis of a pixel with an error of at most two thirds of `accuracy` (half, for
    rules that err all over their band), and the step of quadrature.band_rule.

    own: cycles a pixel up to which one lenslet's light makes fringes;
    joint: up to which all lenslets together do;
    cells: diffraction cells of a lenslet;
    blur: of a point out of focus, in lenslets;
    shares: WHOLE or BESIDE.
    """
    light = own, joint, cells, blur, shares
    count = next((n for n in range(2, 200) if pixel_error(n, 0, *light) <= accuracy / 1.5), None)
    if count is None:
        raise NumericsError(
            f"{joint:.0f} interference fringes a pixel cannot be integrated",
            "sensor.pixel_pitch",
            "use smaller pixels",
        )
    best = count, 0
    # rules made for a band of frequencies need fewer nodes than Gauss-Legendre's
    while 2 < best[0] <= MAX_RULE:
        fewer = best[0] - 1
        rule = min(range(RULES), key=lambda step: pixel_error(fewer, step, *light))
        if pixel_error(fewer, rule, *light) > accuracy / 2:
            break
        best = fewer, rule
    return best


@lru_cache(maxsize=4096)
def pixel_error(count, rule, own, joint, cells, blur, shares=WHOLE):
    """Estimated relative error of a column whose pixels are integrated by `count` nodes per axis,
    at the step `rule` of band_rule.

    The light of two lenslets n apart makes fringes of (n - 1) own to (n + 1) own cycles a pixel,
    most of them in the middle. Against converged columns (770 of 12 cameras, isolated and joined,
    blurred over up to 5 lenslets, rules 0 to 7): a tenth to twice the measured error.
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


def _fringe_errors(count, rule, own, lenslets):
    """(n, the rule's largest error for the fringes of lenslets n apart, weighted with how many
    there are of each frequency) for n from 1 to below `lenslets`, at most MANY of them.
    """
    beside = max(lenslets, 1) - 1
    some = np.unique(np.linspace(1, beside, min(beside, MANY)).round().astype(int))
    apart, share, (t, w) = some[:, None], np.linspace(-1, 1, 65)[1:-1], band_rule(count, rule)
    whole, part = np.pi * own * apart * t, np.pi * own * np.outer(t, share)
    found = (np.cos(whole) * w) @ np.cos(part) - (np.sin(whole) * w) @ np.sin(part)
    errors = (np.abs(found / 2 - np.sinc(own * (apart + share))) * (1 - np.abs(share))).max(axis=1)
    return zip(some.tolist(), errors.tolist())


def _patch_error(count, rule, own, cells, blur):
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


def rule_error(count, cycles, rule=0):
    """Error of the rule for cos(2 pi c t) on a unit pixel at each c of `cycles`."""
    t, w = band_rule(count, rule)
    return np.abs(np.cos(np.pi * np.outer(cycles, t)) @ w / 2 - np.sinc(cycles))
