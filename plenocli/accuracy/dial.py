"""The dial: which computation of a system matrix meets the accuracy asked for at the least cost."""

import math

import numpy as np

from plenocli.errors import NumericsError, UsageError
from plenocli.optics.geometry import geometry
from plenocli.optics.plan import PifPlan, blur_ring, coherent_window, predicted_outside, size_band, window_error

BEST_ACCURACY = 1e-8
"""Finest accuracy on offer: two rings of neighbours and double precision."""


def plan_pif(camera, *, wavelengths=None, superpixels="auto", coherent_ring="auto", accuracy=1e-4, dtype=np.float32, points=None):
    """Choose how to compute the system matrix of `camera`; no optics is computed.

    wavelengths: metres (default: the camera's); superpixels: "auto" or odd (rows, columns); coherent_ring: "auto", 0, 1 or 2;
    accuracy: relative L2 error of each column against the converged paraxial model. Returns a PifPlan; UsageError or
    NumericsError where the request cannot be met.
    """
    wavelengths = tuple(wavelengths or camera.light.wavelengths)
    if not BEST_ACCURACY <= accuracy < 1:
        raise NumericsError(f"accuracy {accuracy:g} cannot be reached", "accuracy", f"ask for {BEST_ACCURACY:g} to below 1")
    views = [geometry(camera, w) for w in wavelengths]
    reasons, warnings = [], []
    grid = _superpixels(superpixels, views, accuracy, reasons)
    ring = _ring(coherent_ring, views, grid, accuracy, reasons, warnings)
    tolerance = accuracy / 2
    bands = tuple(size_band(view, grid, ring, accuracy, tolerance) for view in views)
    double = np.dtype(dtype) == np.float64 or accuracy < 1e-5
    reasons.append(f"{'double' if double else 'single'} precision: rounding stays below the accuracy asked for")
    _check(views, grid, warnings)
    count = int(np.prod(views[0].object_shape)) if points is None else len(range(*points.indices(int(np.prod(views[0].object_shape)))))
    shape = (len(bands), grid[0] * grid[1], int(np.prod(views[0].pixel_shape)), count)
    seconds = sum(_seconds(b, views[0], shape, double, camera.lenslet_array.aperture_shape) for b in bands)
    nodes = {"lenslet": [b.lenslet_nodes for b in bands], "pixel": [b.pixel_nodes for b in bands], "psf": [b.psf_nodes for b in bands]}
    return PifPlan("fresnel", grid, ring, accuracy, tolerance, double, bands, shape, seconds, int(np.prod(shape)) * np.dtype(dtype).itemsize,
                   tuple(reasons), tuple(warnings), nodes,
                   math.hypot(0.5 * accuracy, max(window_error(v, grid, ring) for v in views)), np.dtype(dtype).name)


def _ring(asked, views, grid, accuracy, reasons, warnings):
    """Rings of lenslets beyond the superpixels kept and beyond the blur whose fields add."""
    if asked not in ("auto", 0, 1, 2):
        raise UsageError(f"coherent ring {asked!r} is not auto, 0, 1 or 2", "coherent_ring")
    if asked == 0:
        reasons.append("isolated lenslets as asked: light of neighbours is left out")
        return 0
    rings = (1, 2) if asked == "auto" else (asked,)
    errors = {ring: max(window_error(v, grid, ring) for v in views) for ring in rings}
    ring = next((r for r in rings if errors[r] <= accuracy), rings[-1])
    reasons.append(f"{ring} ring(s) of neighbour lenslets join coherently{'' if asked == 'auto' else ' as asked'}: "
                   f"what lies further out changes a column by about {errors[ring]:.1g}")
    if errors[ring] > accuracy:
        warnings.append(f"lenslets beyond the coherent window change columns by about {errors[ring]:.1g}, more than the accuracy {accuracy:g}")
    return ring


def _superpixels(asked, views, accuracy, reasons):
    if asked != "auto":
        rows, columns = (int(n) for n in asked)
        if rows < 1 or columns < 1 or rows % 2 == 0 or columns % 2 == 0:
            raise UsageError(f"superpixels {rows}x{columns} are not centred on the object's lenslet", "superpixels", "give odd numbers such as 1x1 or 3x3")
        reasons.append(f"superpixels {rows}x{columns} as asked")
        return rows, columns
    ring = max(blur_ring(view) for view in views)
    reasons.append(f"geometric blur {max(v.blur / v.D2 for v in views):.2f} lenslets: superpixels under it kept, ring {ring}")
    if accuracy < 0.05:
        wanted = ring
        while max(predicted_outside(v, wanted) for v in views) > 0.05 and wanted < ring + 4:
            wanted += 1
        if wanted > ring:
            reasons.append(
                f"ring {wanted} kept for diffraction: it leaves about {max(predicted_outside(v, wanted) for v in views):.3f} "
                "of a corner point's light outside (limit 0.05)")
        ring = wanted
    return 2 * ring + 1, 2 * ring + 1


def _check(views, grid, warnings):
    view = views[0]
    for axis, name in ((0, "rows"), (1, "columns")):
        size = view.pixel_shape[axis] * view.pixel_pitch
        if abs(size / view.superpixel_pitch - 1) > 1e-4:
            warnings.append(
                f"superpixels are {view.superpixel_pitch / view.pixel_pitch:.3f} pixels apart, not {view.pixel_shape[axis]} ({name}): A is for the "
                "grid centred on each superpixel, not for one sensor raster")
    phase = max(v.quartic_phase for v in views)
    if phase > 0.1:
        warnings.append(f"the paraxial model drops {phase:.2f} rad at a lenslet's edge: fringes differ from exact propagation there")
    ring = (min(grid) - 1) // 2
    if max(v.blur / (2 * v.D2) for v in views) > ring + 1e-9:
        warnings.append("the geometric blur reaches beyond the superpixels kept: their light is missing from the columns")


def _seconds(band, view, shape, double, aperture):
    """One-core estimate from the product count (8 flops a complex multiply-add, 30 or 60 GFLOP/s sustained) and the squares."""
    fine = view.pixel_shape[0] * view.pixel_shape[1] * band.pixel_nodes**2
    terms = band.terms if aperture == "square" else (1 if band.window is None else 2 * band.window + 1) * band.lenslet_nodes
    work = 8.0 * fine * terms / (30e9 if double else 60e9) + fine * (3e-9 if double else 1.5e-9)
    setup = band.psf_nodes**3 * 8e-9 + 0.05
    return work * shape[1] * shape[3] + setup
