"""How a system matrix is computed: node counts, coherent neighbours, precision. Chosen before any work (plenocli.accuracy)."""

import math
from dataclasses import dataclass, field

import numpy as np

from plenocli.errors import NumericsError
from plenocli.optics.psf import psf_nodes
from plenocli.optics.quadrature import gauss, nodes_for

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
    """The chosen computation.

    model: ray, fresnel or exact; superpixels: (rows, columns) odd numbers; tolerance: root-energy cut of the spread function;
    seconds of one core and bytes of the result are estimates; reasons: one sentence for each choice; estimated: relative error
    of the worst column within the model (isolated lenslets: of that model); dtype: of the stored matrix.
    """

    model: str
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
    dtype: str = "float32"

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


def window_error(view, grid, ring):
    """Estimated relative error of a column because lenslets beyond the coherent window are left out; 0 if ring is 0 by choice."""
    if ring == 0:
        return 0.0
    beyond = coherent_window(view, grid, ring) - blur_ring(view)
    return WINDOW_ERROR[min(beyond, 3)] / view.diffraction_cells * (1 if max(grid) > 1 or beyond > 1 else 0.25)


def blur_ring(view):
    """Lenslets that the geometric blur of a point at the lenslet's edge reaches beyond its own, per side."""
    return math.ceil(view.blur / (2 * view.D2) - 1e-9)


def predicted_outside(view, ring):
    """Share of a corner point's light that falls outside a window of (2 ring + 1)^2 lenslets, from the asymptotic tail of an
    in-focus spread function beyond the geometric blur: 2/(pi v), v = pi r D1/(lambda z2)."""
    distance = ring * view.D2 - view.blur / 2
    if distance <= 0:
        return 1.0
    return min(1.0, 2 * view.wavelength * view.z2 / (math.pi**2 * distance * view.D1))


def coherent_window(view, grid, ring):
    """Lenslets |m| <= window (from the object's own) whose fields add, or None for isolated lenslets (ring 0).

    All of them act on every superpixel kept: an image point on a border between lenslets would else lose the interference
    of its two halves, which cancels their edge diffraction far out.
    """
    return None if ring == 0 else max(max(grid) // 2, blur_ring(view)) + ring


def size_band(view, grid, ring, accuracy, tolerance):
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
