"""What a system matrix needs: superpixels, coherent neighbours, node counts, memory and time; chosen before any work."""

import math
from dataclasses import dataclass, field

import numpy as np

from plenocli.errors import NumericsError, UsageError
from plenocli.optics.geometry import geometry
from plenocli.optics.psf import psf_nodes
from plenocli.optics.quadrature import gauss, nodes_for

BEST_ACCURACY = 1e-8
"""Finest accuracy on offer: two rings of neighbours and double precision."""
OWN_WEIGHT, JOINT_WEIGHT = 0.2, 4e-5
"""Effect on a column of the pixel rule's error for fringes within one lenslet's light, and between lenslets (measured bounds)."""
WINDOW_ERROR = {1: 0.12, 2: 2.1e-3, 3: 1.0e-3}
"""Error from lenslets beyond w rings past the blur, times the lenslet's diffraction cells (measured; worst point, at the corner)."""


@dataclass(frozen=True)
class BandPlan:
    """Node counts of one wavelength. `window`: see coherent_window; `half`: half width (m) on which the spread
    function is needed."""

    wavelength: float
    window: int | None
    lenslet_nodes: int
    pixel_nodes: int
    psf_nodes: int
    terms: int
    half: float


@dataclass(frozen=True)
class PifPlan:
    """The chosen computation. `superpixels` (rows, columns) odd numbers; `tolerance`: root-energy cut of the spread function;
    `seconds` of one core and `bytes` of the result are estimates; `reasons` one sentence for each choice; `estimated` relative
    error of the worst column within the paraxial model (isolated lenslets: of that model)."""

    superpixels: tuple
    coherent_ring: int
    accuracy: float
    tolerance: float
    double: bool
    bands: tuple
    shape: tuple
    seconds: float
    bytes: int
    reasons: tuple = ()
    warnings: tuple = ()
    nodes: dict = field(default_factory=dict)
    estimated: float = 0.0

    def explain(self):
        """The plan in words, one choice a line."""
        rows, columns = self.superpixels
        head = [
            f"matrix: {self.shape[0]} band(s) x {self.shape[1]} superpixels ({rows}x{columns}) x {self.shape[2]} pixels "
            f"x {self.shape[3]} points, {self.bytes / 2**20:.0f} MiB",
            f"estimated time: {self.seconds:.1f} s on one core in {'double' if self.double else 'single'} precision",
        ]
        nodes = [
            f"{b.wavelength * 1e9:.1f} nm: {b.lenslet_nodes} nodes across a lenslet, {b.pixel_nodes} across a pixel, "
            f"{b.psf_nodes} across the spread function, about {b.terms} separable terms"
            for b in self.bands
        ]
        return "\n".join([*head, *(f"- {r}" for r in self.reasons), *(f"- {n}" for n in nodes), *(f"! {w}" for w in self.warnings)])


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
    bands = tuple(_band(view, grid, ring, accuracy, tolerance) for view in views)
    double = np.dtype(dtype) == np.float64 or accuracy < 1e-5
    reasons.append(f"{'double' if double else 'single'} precision: rounding stays below the accuracy asked for")
    _check(views, grid, warnings)
    count = int(np.prod(views[0].object_shape)) if points is None else len(range(*points.indices(int(np.prod(views[0].object_shape)))))
    shape = (len(bands), grid[0] * grid[1], int(np.prod(views[0].pixel_shape)), count)
    seconds = sum(_seconds(b, views[0], shape, double, camera.lenslet_array.aperture_shape) for b in bands)
    nodes = {"lenslet": [b.lenslet_nodes for b in bands], "pixel": [b.pixel_nodes for b in bands], "psf": [b.psf_nodes for b in bands]}
    return PifPlan(grid, ring, accuracy, tolerance, double, bands, shape, seconds, int(np.prod(shape)) * np.dtype(dtype).itemsize,
                   tuple(reasons), tuple(warnings), nodes,
                   math.hypot(0.5 * accuracy, max(window_error(v, grid, ring) for v in views)))


def window_error(view, grid, ring):
    """Estimated relative error of a column because lenslets beyond the coherent window are left out; 0 if ring is 0 by choice."""
    if ring == 0:
        return 0.0
    beyond = coherent_window(view, grid, ring) - _blur_ring(view)
    return WINDOW_ERROR[min(beyond, 3)] / view.diffraction_cells * (1 if max(grid) > 1 or beyond > 1 else 0.25)


def _blur_ring(view):
    return math.ceil(view.blur / (2 * view.D2) - 1e-9)


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


def predicted_outside(view, ring):
    """Share of a corner point's light that falls outside a window of (2 ring + 1)^2 lenslets, from the asymptotic tail of an
    in-focus spread function beyond the geometric blur: 2/(pi v), v = pi r D1/(lambda z2)."""
    distance = ring * view.D2 - view.blur / 2
    if distance <= 0:
        return 1.0
    return min(1.0, 2 * view.wavelength * view.z2 / (math.pi**2 * distance * view.D1))


def _superpixels(asked, views, accuracy, reasons):
    if asked != "auto":
        rows, columns = (int(n) for n in asked)
        if rows < 1 or columns < 1 or rows % 2 == 0 or columns % 2 == 0:
            raise UsageError(f"superpixels {rows}x{columns} are not centred on the object's lenslet", "superpixels", "give odd numbers such as 1x1 or 3x3")
        reasons.append(f"superpixels {rows}x{columns} as asked")
        return rows, columns
    ring = max(_blur_ring(view) for view in views)
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


def coherent_window(view, grid, ring):
    """Lenslets |m| <= window (from the object's own) whose fields add, or None for isolated lenslets (ring 0).

    All of them act on every superpixel kept: an image point on a border between lenslets would else lose the interference
    of its two halves, which cancels their edge diffraction far out.
    """
    return None if ring == 0 else max(max(grid) // 2, _blur_ring(view)) + ring


def _band(view, grid, ring, accuracy, tolerance):
    """Node counts at one wavelength; the phase across a lenslet counts the far edge of the outermost superpixel it lights."""
    half_width, window = view.lenslet_width / 2, coherent_window(view, grid, ring)
    far = 0 if window is None else max(grid) // 2 + window
    reach = max(view.pixel_shape) * view.pixel_pitch / 2 + far * view.superpixel_pitch
    slope = half_width * view.k * (reach / view.z3 + view.D1 / 2 / view.z2 + abs(view.kappa) * half_width)
    active = view.pixel_active / (view.wavelength * view.z3)
    own, joint = view.lenslet_width * active, (1 if window is None else 2 * window + 1) * view.D2 * active
    half = ((max(grid) // 2 if window is None else window) + 1) * view.D2
    count = psf_nodes(view, half)
    phase = view.k * view.D1 / 2 * half / view.z2
    terms = int(0.27 * phase + 3 + 0.6 * math.log10(1 / tolerance)) if view.blur < view.D2 else int(0.4 * phase + 10)
    return BandPlan(view.wavelength, window, nodes_for(slope), pixel_nodes(own, joint, accuracy), count, terms, half)


def pixel_nodes(own, joint, accuracy):
    """Gauss-Legendre nodes per axis of a pixel whose irradiance holds up to `own` cycles a pixel from one lenslet and up to
    `joint` from interference with its neighbours, whose fields are weak; error at most about half the accuracy."""
    for count in range(2, 200):
        error = max(OWN_WEIGHT * rule_error(count, own), JOINT_WEIGHT * rule_error(count, joint))
        if error <= accuracy / 2.4:
            return count
    raise NumericsError(f"{joint:.0f} interference fringes a pixel cannot be integrated", "sensor.pixel_pitch", "use smaller pixels")


def rule_error(count, cycles):
    """Largest error of the rule for cos(2 pi c t) on a unit pixel, c up to `cycles`."""
    t, w = gauss(count)
    c = np.linspace(0, cycles, 65)
    return float(np.abs(np.cos(np.pi * np.outer(c, t)) @ w / 2 - np.sinc(c)).max())


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
