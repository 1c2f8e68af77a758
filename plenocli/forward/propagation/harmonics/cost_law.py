"""What a matrix by angular harmonics consists of, counted before it is computed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.propagation.costs import Features
from plenocli.forward.propagation.harmonics.corners import SIDES
from plenocli.forward.propagation.harmonics.sizing import HarmonicBand
from plenocli.forward.propagation.sampling import distinct

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.plan import BandPlan


def features(
    camera: Camera, geometry: Geometry, band: BandPlan, shape: tuple[int, ...], double: bool
) -> Features:
    """What a matrix consists of, as Model.features."""
    assert isinstance(band, HarmonicBand)
    points = distinct(camera, geometry, shape)[0]
    # corners take every point by itself
    lit = points if band.corner_orders else min(points, distances(geometry))
    real, wide = (8, 2.0) if double else (4, 1.0)
    kernel, corners = band.radii * band.lenslet_nodes, band.radii * band.corner_nodes
    both = 2.0 * band.corner_orders
    waves = 2.0 * band.orders * band.radii
    inward = band.orders * band.lenslet_nodes * band.psf_nodes
    raster, sums = band.radii * band.angles, tap_sums(geometry, band)
    nodes = math.prod(geometry.pixel_shape) / 4 * (band.pixel_nodes * band.taps) ** 2
    return Features(
        {
            "kernel_harmonics": 2.0
            * (kernel * band.orders + corners * band.corner_orders)
            * band.half_turn,
            "cones": 2.0 * waves * band.psf_nodes * band.lenslet_nodes,
            "points": 2.0 * waves * band.psf_nodes * lit,
            "coupling": 4.0 * band.corner_nodes * both * 2 * band.orders / SIDES * points,
            "corners": 8.0 * both * corners * points,
        },
        {
            "process": 1.0,
            "kernel_values": wide * (kernel + corners) * band.half_turn,
            "bessel_values": inward + band.orders * band.psf_nodes * lit,
            "light_values": inward * lit,
            "node_taps": nodes,
            "harmonic_values": wide * (waves * (points + lit) + 2 * both * band.radii * points),
            "raster_values": wide * points * raster * math.log2(band.angles),
            "tap_sums": wide * points * sums,
            "written": math.prod(shape[1:]),
        },
        (
            {
                "cones": real * waves * band.psf_nodes,
                "inward": inward * real,
                "corners": real * band.corner_orders * corners,
                "process": 1.0,
            },
            {
                "cones": real * waves * band.psf_nodes,
                "operator": (real + 4) * sums,
                "harmonics": real * (waves + both * band.radii),
                "corners": real * band.corner_orders * corners,
                "raster": real * raster,
                "process": 1.0,
            },
        ),
    )


def distances(geometry: Geometry) -> int:
    """How many different distances the points have from the lenslet's axis."""
    y, x = (geometry.points(axis) for axis in (0, 1))
    return len(np.unique(np.round(np.hypot(y[:, None], x), 15)))


def tap_sums(geometry: Geometry, band: HarmonicBand) -> float:
    """Products that the pixels of one column take of the polar raster."""
    y, x = (geometry.pixels(axis) for axis in (0, 1))
    radius = np.maximum(np.hypot(y[:, None], x), geometry.pixel_pitch / 2)
    wide = 1.1 * geometry.pixel_active  # of a square in any direction
    along = wide / band.step + band.taps
    around = np.minimum(wide / radius * band.angles / (2 * np.pi) + band.taps, band.angles)
    return float((along * around).sum())
