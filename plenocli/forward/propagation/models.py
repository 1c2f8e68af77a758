"""The rungs: every way to compute a system matrix, where it holds, how far it is from the finest
one and what it costs.

The finest model is scalar and exact from the lenslets to the sensor
(plenocli.forward.propagation.exact.lenslets). Errors are relative L2 norms of the worst
column against it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from plenocli.forward.propagation import rays
from plenocli.forward.propagation.costs import Cost
from plenocli.forward.propagation.exact import lenslets as exact
from plenocli.forward.propagation.fresnel import shaped
from plenocli.forward.propagation.fresnel.spread_function import psf_nodes
from plenocli.forward.propagation.fresnel.square import narrows
from plenocli.forward.propagation.sampling import (
    distinct,
    field_seconds,
    grid_of,
    is_symmetric,
    size_band,
)


@dataclass(frozen=True)
class Rung:
    """One way: `model` ray, fresnel or exact; `valid_for(camera, view)` None or why not;
    `error_bound(camera, view)` against the finest model; `size(view, grid, ring, sampling,
    tolerance)` a BandPlan; `cost(camera, view, band, shape, double)` a Cost.
    """

    name: str
    model: str
    valid_for: Callable
    error_bound: Callable
    size: Callable
    cost: Callable


def _square_only(camera, view):
    array = camera.lenslet_array
    if array.lattice != "square" or array.aperture_shape != "square":
        return f"{array.aperture_shape} lenslets on a {array.lattice} lattice are not separable"
    return None


def is_separable(camera):
    """Whether the spread function is a single product: a plain square pupil."""
    lens = camera.main_lens
    return (
        lens.aperture_shape == "square"
        and camera.filter_array is None
        and lens.wavefront is None
        and not lens.aberrations
    )


def _ray_error(camera, view):
    # a law within 2.5 of what was measured promises only what its double is
    return min(2.0, math.hypot(2 * rays.error_bound(camera, view), _paraxial_error(camera, view)))


def _paraxial_error(camera, view):
    return exact.fresnel_model_error(view, camera.lenslet_array.profile == "parabolic")


def _no_error(camera, view):
    return 0.0


def _square_cost(camera, view, band, shape, double):
    """Counted from the tables that SquareLenslets fills; the factors are fitted to process
    times (docs/model.md).
    """
    grid = grid_of(shape[1])
    terms, even = 1 if is_separable(camera) else band.terms, is_symmetric(camera)
    real = even and view.blur == 0
    (own, pairs), pixels, lines = (
        distinct(camera, view, shape),
        view.pixel_shape[0] * view.pixel_shape[1],
        view.pixel_shape[0] * band.pixel_nodes,
    )
    narrow = narrows(view, band, grid, double)
    beside = band.beside[0] if narrow and band.beside else band.pixel_nodes
    # of all columns on all superpixels: nodes of the sensor
    fine = pixels * (own * band.pixel_nodes**2 + (pairs - own) * beside**2)
    item, axes = (16 if double else 8), (1 if real else 2)
    lit = grid[0] if band.window is None else 2 * band.window + 1
    few = lit * min(psf_nodes(view, view.lenslet_width / 2), band.lenslet_nodes)
    half = band.psf_nodes / 2 if even else band.psf_nodes
    points = (view.object_shape[0] + 1) // 2 if even else view.object_shape[0]
    carried = points * grid[0] * lines * terms * (few if band.window is not None else few / lit)
    table = view.object_shape[0] * grid[0] * lines * terms
    setup = field_seconds(camera, view, band) + axes * (
        1.6e-8 * points * few * half
        + 8e-8 * (2 * lit - 1) * lines * band.lenslet_nodes
        + 1e-8 * table
        + 2.5e-11 * (1 if real else 2) * carried * (2 if double else 1)
    )
    size = int(np.prod(shape[1:]))
    if narrow:  # superpixels keep half to three quarters of the terms
        setup += 1.5e-9 * max(grid) * table / grid[0] * terms**0.5
        terms *= 0.65
    return Cost(
        operations=8.0 * 1.2 * fine * terms,
        seconds=setup
        + pairs * 2.5e-5
        + fine * (4e-9 if double else 3e-9)
        + size * (2e-8 if double else 7e-9)
        + 0.005,
        bytes=int(item * axes * (table + (2 * lit - 1) * lines * few) + 60 * half**2) + (3 << 22),
    )


RUNGS = (
    Rung("rays", "ray", rays.valid_for, _ray_error, rays.size_band, rays.cost),
    Rung(
        "fresnel, low rank",
        "fresnel",
        _square_only,
        _paraxial_error,
        partial(size_band, dim=True),
        _square_cost,
    ),
    Rung(
        "fresnel, triple product",
        "fresnel",
        shaped.valid_for,
        _paraxial_error,
        size_band,
        shaped.cost,
    ),
    Rung("exact, low rank", "exact", exact.valid_for, _no_error, exact.exact_band, exact.cost),
)
"""Coarse to fine; of two that serve, the dial takes the one that costs less."""
