"""How many harmonics, radii and angles exact propagation by harmonics takes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.camera.quadrature import nodes_for
from plenocli.forward.propagation.exact.trial import exact_trial_columns
from plenocli.forward.propagation.fresnel.paraxial_error import paraxial_error
from plenocli.forward.propagation.harmonics.bessel import bessel_tail
from plenocli.forward.propagation.harmonics.interpolation import tap_error
from plenocli.forward.propagation.plan import BandPlan
from plenocli.forward.propagation.sampling import dimness, is_symmetric, pixel_error

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera

TAPS = (4, 6, 8, 10, 12, 16, 20)
FINER = (1.15, 1.3, 1.45, 1.6, 1.8, 2.0, 2.3, 2.7)
"""Numbers of taps, and rates over twice the highest frequency, to choose from."""
PIXEL_EFFECT = 6.0
"""Error of the worst column from the quadrature over pixels over pixel_error, which knows of
square lenslets: points beyond a round one's rim have little but fringes (measured: up to 5.9).
"""
SHARE = 0.6
"""Of the accuracy asked for, what pixels and interpolation may take each."""
FEWEST_RADII = 24
"""Radii to a superpixel's corner: where it has no fringe light changes with the distance."""
DIMMEST = 4.0
"""Most by which interpolation weighs more in a dim point's column, of 1/16 of the brightest one's
amplitude; of less the root of how much less it has.
"""
MOST_NODES = 40
"""Most nodes per axis of a pixel."""


@dataclass(frozen=True, kw_only=True)
class HarmonicBand(BandPlan):
    """A BandPlan of the exact model by harmonics: lenslet_nodes from a lenslet's centre to its rim,
    psf_nodes cones of waves, no terms.

    orders: harmonics 0 ... orders - 1, and as many turned the other way;
    corner_orders, corner_nodes: harmonics that a hexagon's corners couple, and their radii; 0 of a
        round lenslet;
    half_turn: nodes of half a turn that the kernel's harmonics are taken from;
    radii, step: of the polar raster on the sensor, at (i + 1/2) step (m);
    angles: of that raster;
    taps: its samples along either axis that a pixel's node is interpolated from;
    finer: rate of samples over twice the highest frequency that taps are weighted for;
    rates: (radii, angles), that of the raster, no less.
    """

    orders: int
    corner_orders: int
    corner_nodes: int
    half_turn: int
    radii: int
    step: float
    angles: int
    taps: int
    finer: float
    rates: tuple[float, float]


def harmonic_band(
    camera: Camera,
    geometry: Geometry,
    superpixels: tuple[int, int],
    ring: int,
    accuracy: float,
    tolerance: float,
) -> HarmonicBand:
    """As Model.size: of isolated lenslets on their own superpixel, which are all that is followed.

    Raises NumericsError for others.
    """
    if ring or superpixels != (1, 1):
        raise NumericsError(
            "harmonics follow an isolated lenslet to its own superpixel only (--superpixels 1x1 "
            "--coherent-ring 0); the paraxial model is off by about "
            f"{paraxial_error(geometry, False):.2g}",
            "coherent_ring",
            "ask for that, or for a coarser accuracy",
        )
    g = geometry
    own = 2 * rim(g) * g.pixel_active / (g.wavelength * g.z3)

    tried = exact_trial_columns(camera, g, superpixels, None, is_symmetric(camera))
    root = 1.0 if tried is None else dimness(tried.faintest)
    # measured: 0.25 to 2.4 times tap_error; a blurred point lights a patch of the superpixel, and a
    # dim one has the finest fringes alone
    effect = max(0.3, min(2.5, 0.8 / own)) * (1.5 if g.blur > g.D2 else 1.0)
    effect *= min(1 / root, max(DIMMEST, math.sqrt(1 / root)))

    def missed(count: int) -> float:
        if tried is not None:
            return tried.beyond * tried.error(count, 0)
        return PIXEL_EFFECT * pixel_error(count, 0, own, own, g.diffraction_cells, g.blur / g.D2)

    nodes = next((n for n in range(2, MOST_NODES) if missed(n) <= SHARE * accuracy), None)
    if nodes is None:
        raise NumericsError(
            f"{own:.0f} interference fringes a pixel cannot be integrated",
            "sensor.pixel_pitch",
            "use smaller pixels",
        )
    taps, finer = _taps(SHARE * accuracy / effect, g)
    band = polar_band(g, accuracy, taps, finer, nodes, root)
    interpolated = effect * max(tap_error(taps, finer, rate) for rate in band.rates)
    return replace(band, sampling=math.hypot(missed(nodes), interpolated))


def rim(geometry: Geometry) -> float:
    """Radius (m) of the circle about a lenslet's opening."""
    return max(geometry.lenslet_extent)


def corner(geometry: Geometry) -> float:
    """Distance (m) of a superpixel's farthest pixel corner from its lenslet's axis."""
    return math.hypot(
        *(
            n * geometry.pixel_pitch / 2 + abs(geometry.window_shift(axis))
            for axis, n in enumerate(geometry.pixel_shape)
        )
    )


def farthest(geometry: Geometry) -> float:
    """Distance (m) of the farthest object point's image from its lenslet's axis."""
    return math.hypot(*(np.abs(geometry.points(axis)).max() for axis in (0, 1)))


def polar_band(
    geometry: Geometry,
    accuracy: float,
    taps: int,
    finer: float,
    nodes: int,
    faintest: float = 1.0,
) -> HarmonicBand:
    """A HarmonicBand with so many taps and samples.

    accuracy: that orders are counted for;
    taps, finer: as interpolation.tap_error;
    nodes: per axis of a pixel;
    faintest: as in BandPlan.
    """
    g, a, inner = geometry, rim(geometry), geometry.lenslet_width / 2
    sine = g.D1 / 2 / math.hypot(g.D1 / 2, g.z2)
    along = max(finer, FEWEST_RADII * _fringe(g) / corner(g))
    step = _fringe(g) / along
    far = corner(g) + taps / 2 * step
    sweep, reach = g.k * _sweep(g.z3, a, far), g.k * sine * min(a, farthest(g))
    # what is left out is a product of two Bessel functions
    tail = 0.3 * math.sqrt(accuracy * faintest)
    orders = min(bessel_tail(reach, tail), bessel_tail(sweep, tail)) + 1
    band, corner_orders, corner_nodes = min(reach, sweep), 0, 0
    q, v = np.linspace(0, a, 33)[:, None], np.linspace(-far, far, 65)
    slope = np.abs((q - v) / np.hypot(g.z3, q - v) - q / np.hypot(g.f2, q) + q / g.z2).max()
    if g.lenslet_shape == "hexagon":
        band, corner_orders = sweep, bessel_tail(sweep, tail) + 1
        # the harmonics of the sides, and the field between the two circles
        phase = np.pi / 12 * (corner_orders + orders) + g.k * (slope + sine) * (a - inner) / 2
        corner_nodes = nodes_for(phase)
    angles = _fast(max(4 * band * finer, 4.4 * max(orders, corner_orders)))
    return HarmonicBand(
        wavelength=g.wavelength,
        window=None,
        lenslet_nodes=nodes_for(g.k * (slope + sine) * a / 2),
        pixel_nodes=nodes,
        psf_nodes=nodes_for(g.D1 / 4 * g.k * ((a + farthest(g)) / g.z2 + abs(g.eps) * g.D1 / 2)),
        terms=0,
        half=a + farthest(g),
        faintest=faintest,
        orders=orders,
        corner_orders=corner_orders,
        corner_nodes=corner_nodes,
        half_turn=2
        * math.ceil((max(orders, corner_orders) + bessel_tail(sweep, accuracy / 100)) / 4),
        radii=math.ceil(far / step) + 1,
        step=step,
        angles=angles,
        taps=taps,
        finer=finer,
        rates=(along, max(finer, angles / (4 * max(band, 1.0)))),
    )


@lru_cache(maxsize=1024)
def _sweep(z: float, a: float, far: float) -> float:
    """Largest change (m a rad) of the path from the rim to the farthest radius as one turns."""
    t = np.linspace(0, np.pi, 181)
    side = np.sqrt(z * z + a * a + far * far - 2 * a * far * np.cos(t))
    return float((a * far * np.sin(t) / side).max())


def _fringe(geometry: Geometry) -> float:
    """Distance (m) of samples at twice the highest frequency along a radius."""
    return geometry.wavelength * math.hypot(geometry.z3, rim(geometry)) / (4 * rim(geometry))


def _taps(error: float, g: Geometry) -> tuple[int, float]:
    """The cheapest (taps, rate) of at most this tap_error.

    Raises NumericsError where there is none.
    """
    choices = [(t, f) for t in TAPS for f in FINER]
    found = [c for c in choices if tap_error(*c) <= error]
    if not found:  # the last digit, at no margin
        found = [c for c in choices if tap_error(*c) <= error / SHARE]
    if not found:
        raise NumericsError("the polar raster cannot be interpolated so finely", "accuracy", "")
    sine = g.D1 / 2 / math.hypot(g.D1 / 2, g.z2)
    fringe = _fringe(g)
    turn = 4 * max(g.k * sine * min(rim(g), farthest(g)), 1.0)

    def cost(choice: tuple[int, float]) -> float:
        taps, finer = choice
        radii = corner(g) * finer / fringe + taps / 2
        pixel = (g.pixel_pitch * finer / fringe + taps) ** 2
        return 8 * radii * turn * finer + 1.2 * math.prod(g.pixel_shape) * pixel

    return min(found, key=cost)


def _fast(count: float) -> int:
    """Least multiple of 4 without prime factors beyond 5, from `count` on."""
    n = 4 * math.ceil(count / 4)
    while True:
        rest = n
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return n
        n += 4
