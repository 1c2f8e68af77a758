"""The rungs: every way to compute a system matrix, where it holds, how far it is from the finest one and what it costs.

The finest model is scalar and exact from the lenslets to the sensor (plenocli.optics.exact). Errors are relative L2 norms of
the worst column against it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from plenocli.optics import exact, rays, shaped
from plenocli.optics.plan import size_band


@dataclass(frozen=True)
class Rung:
    """One way: `model` ray, fresnel or exact; `valid_for(camera, view)` None or why not; `error_bound(camera, view)` against the
    finest model; `size(view, grid, ring, sampling, tolerance)` a BandPlan; `cost(camera, view, band, shape, double)` a dict of
    `operations` (real, in products), `seconds` (what does not scale with the products, one core) and `bytes` (beyond the result)."""

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
    return min(2.0, math.hypot(rays.error_bound(camera, view), _paraxial_error(camera, view)))


def _paraxial_error(camera, view):
    """Fresnel against exact: the phase dropped at a lenslet's corner, the obliquity, and sine against tangent at the main lens."""
    aperture = math.hypot(view.D1 / 2 / view.z2, view.lenslet_width / 2 / view.z3)
    return min(1.0, 0.4 * view.quartic_phase + 1.5 * aperture**2)


def _no_error(camera, view):
    return 0.0


def _square_cost(camera, view, band, shape, double):
    fine = view.pixel_shape[0] * view.pixel_shape[1] * band.pixel_nodes**2
    columns = shape[1] * shape[3]
    return {"operations": 8.0 * fine * band.terms * columns, "seconds": fine * columns * (3e-9 if double else 1.5e-9) + band.psf_nodes**3 * 8e-9 + 0.05,
            "bytes": 1 << 27}


def _exact_cost(camera, view, band, shape, double):
    found = _square_cost(camera, view, band, shape, double)
    # terms beyond the paraxial ones carry the corner's phase, and the set-up finds them
    more = 2 + 0.5 * view.quartic_phase * 16
    return {"operations": more * found["operations"], "seconds": found["seconds"] + 0.3 * more, "bytes": 1 << 29}


RUNGS = (
    Rung("rays", "ray", rays.valid_for, _ray_error, rays.size_band, rays.cost),
    Rung("fresnel, low rank", "fresnel", _square_only, _paraxial_error, size_band, _square_cost),
    Rung("fresnel, triple product", "fresnel", shaped.valid_for, _paraxial_error, size_band, shaped.cost),
    Rung("exact, low rank", "exact", exact.valid_for, _no_error, exact.exact_band, _exact_cost),
)
"""Coarse to fine; of two that serve, the dial takes the one that costs less."""
