"""What a paraxial matrix behind square lenslets consists of, counted before it is computed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from plenocli.forward.propagation.costs import Features
from plenocli.forward.propagation.fresnel.spread_function import psf_nodes
from plenocli.forward.propagation.fresnel.square import narrows
from plenocli.forward.propagation.plan import BandPlan
from plenocli.forward.propagation.sampling import (
    distinct,
    field_features,
    is_symmetric,
    superpixels_of,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera


def features(
    camera: Camera, geometry: Geometry, band: BandPlan, shape: tuple[int, ...], double: bool
) -> Features:
    """What a matrix consists of: the tables that SquareLenslets fills and the products
    of its columns.
    """
    grid = superpixels_of(shape[1])
    terms, even = 1 if _is_separable(camera) else band.terms, is_symmetric(camera)
    real, item = even and geometry.blur == 0, 16 if double else 8
    axes = 1 if real else 2
    own, columns = distinct(camera, geometry, shape)
    narrow = narrows(geometry, band, grid, double)
    beside = band.beside[0] if narrow and band.beside else band.pixel_nodes
    nodes = math.prod(geometry.pixel_shape) * (
        own * band.pixel_nodes**2 + (columns - own) * beside**2
    )
    lines = geometry.pixel_shape[0] * band.pixel_nodes
    lit = grid[0] if band.window is None else 2 * band.window + 1
    few = lit * min(psf_nodes(geometry, geometry.lenslet_width / 2), band.lenslet_nodes)
    half = band.psf_nodes / 2 if even else band.psf_nodes
    points = (geometry.object_shape[0] + 1) // 2 if even else geometry.object_shape[0]
    table = geometry.object_shape[0] * grid[0] * lines * terms
    carried = points * grid[0] * lines * terms * (few if band.window is not None else few / lit)
    kernels = (2 * lit - 1) * lines
    seconds = {
        "process": 1.0,
        "spread_values": axes * points * few * half,
        "kernel_values": axes * kernels * band.lenslet_nodes,
        "table_values": axes * table,
        "carried": axes * axes * carried * (item / 8),
        "lines": columns / geometry.object_shape[0],
        "sensor_values_double" if double else "sensor_values_single": nodes,
        "written_double" if double else "written_single": math.prod(shape[1:]),
        **field_features(camera, geometry, band),
    }
    if narrow:
        seconds |= {"narrowed": max(grid) * table / grid[0] * math.sqrt(terms)}
    return Features(
        {"sensor_narrowed" if narrow else "sensor": 8.0 * nodes * terms},
        seconds,
        (
            {
                "tables": item * axes * (table + kernels * few),
                "field_squared": half**2,
                "process": 1.0,
            },
        ),
    )


def _is_separable(camera: Camera) -> bool:
    """Whether the spread function is a single product: a plain square pupil."""
    lens = camera.main_lens
    return (
        lens.aperture_shape == "square"
        and camera.filter_array is None
        and lens.wavefront is None
        and not lens.aberrations
        and not lens.rims
    )
