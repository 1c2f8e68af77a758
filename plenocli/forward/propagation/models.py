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

from plenocli.forward.propagation import rays
from plenocli.forward.propagation.exact import cost_law
from plenocli.forward.propagation.exact import lenslets as exact
from plenocli.forward.propagation.fresnel import shaped, square_cost
from plenocli.forward.propagation.sampling import size_band


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


def _ray_error(camera, view):
    # a law within 2.5 of what was measured promises only what its double is
    return min(2.0, math.hypot(2 * rays.error_bound(camera, view), _paraxial_error(camera, view)))


def _paraxial_error(camera, view):
    return exact.fresnel_model_error(view, camera.lenslet_array.profile == "parabolic")


def _no_error(camera, view):
    return 0.0


RUNGS = (
    Rung("rays", "ray", rays.valid_for, _ray_error, rays.size_band, rays.cost),
    Rung(
        "fresnel, low rank",
        "fresnel",
        _square_only,
        _paraxial_error,
        partial(size_band, dim=True),
        square_cost.cost,
    ),
    Rung(
        "fresnel, triple product",
        "fresnel",
        shaped.valid_for,
        _paraxial_error,
        size_band,
        shaped.cost,
    ),
    Rung("exact, low rank", "exact", exact.valid_for, _no_error, exact.exact_band, cost_law.cost),
)
"""Coarse to fine; of two that serve, the dial takes the one that costs less."""
