"""Lenses that the tests share."""

import math

from plenocli.forward.camera.glass import AIR, Medium, medium
from plenocli.forward.camera.prescription import Prescription, Surface

D_LINE = 587.5618e-9


def glass(n):
    return Medium(f"n{n}", "constant", (n,))


def singlet(r1, r2, thickness, n, stop_radius=1e-3, image_distance=0.0):
    """A lens of radii r1, r2 (m; infinite for a plane) with the stop at its first surface."""
    c1, c2 = (0.0 if math.isinf(r) else 1 / r for r in (r1, r2))
    return Prescription(
        surfaces=(
            Surface(curvature=c1, thickness=thickness, medium=glass(n)),
            Surface(curvature=c2, thickness=image_distance),
        ),
        stop=0,
        stop_radius=stop_radius,
    )


def triplet():
    """A Cooke triplet of 50 mm, F/5, with the stop between its second and third lens, in mm from
    a textbook prescription.
    """
    rows = [
        (22.01359, 3.25896, "N-SK16"),
        (-435.76044, 6.00755, None),
        (-22.21328, 0.99997, "F2"),
        (20.29192, 2.3, None),
        (math.inf, 2.45041, None),
        (79.6836, 2.95208, "N-SK16"),
        (-18.39533, 42.2, None),
    ]
    surfaces = tuple(
        Surface(
            curvature=0.0 if math.isinf(r) else 1e3 / r,
            thickness=t * 1e-3,
            medium=medium(g) if g else AIR,
        )
        for r, t, g in rows
    )
    return Prescription(
        surfaces=surfaces, stop=4, stop_radius=4.1e-3, design_wavelength=D_LINE, name="triplet"
    )
