"""The field behind a main lens whose exit wave is a sphere, in direction cosines: what the
exact model has for h.

A well corrected lens sends a wave towards the image point that is spherical, not paraxially so.
Expanded about the image point, what is left of the phase k(|xi - x| - |xi - xp|) from the pupil
point xi is -k s.(x - xp) with the direction cosines s = xi/sqrt(z2^2 + |xi|^2) (Debye; Born and
Wolf, section 8.8), so that

    h(d) = 1/(lambda N) * integral of P(xi) a(s) exp(-j k s.d) d^2 s,
    N^2 = integral of a(s)^2 d^2 s over the aperture,

again a function of d = x - xp alone whose |h|^2 integrates to the share of the light that the
filters pass. The amplitude a is a choice (`main_lens.apodisation`): 1/(1 - s^2) for an evenly lit
plane pupil, (1 - s^2)^(-1/4) for a lens that keeps the sine condition, 1 for Airy's pattern. An
object out of focus sends a sphere about its own image point, z2' behind the lens, 1/z2' = 1/z2 -
eps: that wave differs from the one towards the array by the path sqrt(z2^2 + r^2) - z2 -
sqrt(z2'^2 + r^2) + z2'.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.pupil import wavefront, wavefront_slope
from plenocli.forward.camera.pupil_quadrature import pupil_rows
from plenocli.forward.camera.quadrature import gauss, nodes_for
from plenocli.forward.propagation.fresnel.radial import hankel_series, is_radial, radial_field
from plenocli.forward.propagation.fresnel.spread_function import mirrored

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.camera.sections.main_lens import MainLens

APODISATION: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "uniform-pupil": lambda cos2: 1 / cos2,
    "aplanatic": lambda cos2: cos2**-0.25,
    "uniform-sine": np.ones_like,
}
TRANSFORM_VALUES = 1 << 21
"""Numbers in a slab of pupil nodes x field points."""


def spherical_field(
    camera: Camera, geometry: Geometry, dy: np.ndarray, dx: np.ndarray
) -> np.ndarray:
    """Spread function of a main lens whose exit wave is a sphere, by quadrature over any pupil that
    pupil_rows knows.

    dy, dx: m on the array, of even length and symmetric about 0.

    Returns h (len(dy), len(dx)), 1/m, real where a radial pupil makes it so.
    Born and Wolf, section 8.8.
    """
    if is_radial(camera):
        return radial_field(camera, geometry, dy, dx, spherical_profile)
    g, lens = geometry, camera.main_lens
    reach = math.hypot(np.abs(dy).max(), np.abs(dx).max())
    total: np.ndarray | int = 0
    for rows in pupil_rows(camera, g, g.k * reach / g.z2):
        r2 = rows.y[:, None] ** 2 + rows.x**2
        cos2 = g.z2**2 / (g.z2**2 + r2)
        # pupil_rows has the paraxial defocus; the difference of the two spheres takes its place
        weight = rows.weight * np.exp(1j * g.k * (defocus_path(g, r2) - g.eps * r2 / 2))
        weight *= APODISATION[lens.apodisation](cos2) * cos2**2 / g.z2**2
        total = total + _transform(rows.y, rows.x, weight, np.sqrt(cos2) * g.k / g.z2, dy, dx)
    return np.asarray(total / (g.wavelength * math.sqrt(aperture_norm(lens, g))))


def spherical_profile(camera: Camera, geometry: Geometry, reach: float) -> np.ndarray:
    """As radial.profile, for a spherical exit wave."""
    g, outer = geometry, camera.main_lens.aperture_diameter / 2
    sines, weight = radial_waves(camera, geometry, reach)
    return hankel_series(g.k * reach * sines, weight, g.k * reach * outer / math.hypot(outer, g.z2))


def radial_waves(camera: Camera, geometry: Geometry, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """The spread function of a radial pupil as a sum of Bessel functions, h(d) = sum of weight
    J0(k s |d|).

    reach: largest distance |d|, m.

    Returns (direction sines s (node,), weights (node,) 1/m, complex).
    """
    g, lens = geometry, camera.main_lens
    outer = lens.aperture_diameter / 2
    inner = outer * (lens.obscuration or 0.0)
    rate, half = g.k * reach, (outer - inner) / 2
    t, w = gauss(
        nodes_for(half * (rate / g.z2 + g.k * (abs(g.eps) * outer + wavefront_slope(lens))))
    )
    rho = inner + half * (t + 1)
    cos2 = g.z2**2 / (g.z2**2 + rho * rho)
    phase = g.k * (wavefront(lens, np.zeros_like(rho), rho) + defocus_path(g, rho * rho))
    weight = (
        half
        * w
        * rho
        * APODISATION[lens.apodisation](cos2)
        * cos2**2
        / g.z2**2
        * np.exp(1j * phase)
    )
    norm = 2 * np.pi / (g.wavelength * math.sqrt(aperture_norm(lens, g)))
    return rho * np.sqrt(cos2) / g.z2, norm * weight


def defocus_path(geometry: Geometry, r2: np.ndarray) -> np.ndarray:
    """Path (m) by which a wave towards the object's image is ahead of one towards the array.

    r2: squared pupil radii, m^2.
    """
    here, image = 1 / geometry.z2, 1 / geometry.z2 - geometry.eps
    return r2 * (
        here / (1 + np.sqrt(1 + here * here * r2)) - image / (1 + np.sqrt(1 + image * image * r2))
    )


def _transform(
    y: np.ndarray,
    x: np.ndarray,
    weight: np.ndarray,
    rate: np.ndarray,
    dy: np.ndarray,
    dx: np.ndarray,
) -> np.ndarray:
    """sum of weight exp(-j rate (y dy + x dx)) over one panel of the pupil, by parts even
    and odd in dy and dx.
    """
    even_y, even_x = (mirrored(y, x, weight, axis) for axis in (0, 1))
    y, x = np.broadcast_to(y[:, None], x.shape), x
    for even, axis in ((even_y, 0), (even_x, 1)):
        if even:
            y, x, weight, rate = (_folded(a, axis, a is weight) for a in (y, x, weight, rate))
    y, x, weight = (rate * y).ravel(), (rate * x).ravel(), weight.ravel()
    if np.abs(weight.imag).max() < 1e-15 * np.abs(weight).max():
        weight = weight.real
    rows, columns = len(dy) // 2, len(dx) // 2
    parts = np.zeros((2, 2, rows, columns), weight.dtype)
    step = max(1, TRANSFORM_VALUES // (rows + columns))
    for start in range(0, len(weight), step):
        some = slice(start, start + step)
        py, px = np.outer(dy[rows:], y[some]), np.outer(dx[columns:], x[some])
        left = [np.cos(py)] + ([] if even_y else [np.sin(py)])
        right = [weight[some] * np.cos(px)] + ([] if even_x else [weight[some] * np.sin(px)])
        for i, a in enumerate(left):
            for j, b in enumerate(right):
                parts[i, j] += _times_transposed(a, b)
    (cc, cs), (sc, ss) = parts
    quadrants = [[cc - ss * (a * b) - 1j * (a * sc + b * cs) for b in (-1, 1)] for a in (-1, 1)]
    quadrants = [
        [q[:: 1 if a else -1, :: 1 if b else -1] for b, q in enumerate(row)]
        for a, row in enumerate(quadrants)
    ]
    return np.block(quadrants)


def _folded(a: np.ndarray, axis: int, weight: bool) -> np.ndarray:
    """The half of a mirror-symmetric array from its middle on; weights count twice but on
    the middle itself.
    """
    count = a.shape[axis]
    half = np.take(a, range(count // 2, count), axis)
    if weight:
        half = half * 2
        if count % 2:
            half[(0,) if axis == 0 else (slice(None), 0)] /= 2
    return half


def _times_transposed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a b^T for a real a and a real or complex b."""
    if not np.iscomplexobj(b):
        return a @ b.T
    out = np.empty((len(a), len(b)), complex)
    out.real, out.imag = a @ b.real.T, a @ b.imag.T
    return out


def aperture_norm(lens: MainLens, geometry: Geometry) -> float:
    """Integral of a(s)^2 d^2 s over the open aperture P1, filters not counted."""
    radius, shade = lens.aperture_diameter / 2, APODISATION[lens.apodisation]
    t, w = gauss(64)
    if lens.aperture_shape == "image":
        image = lens.samples("aperture_image")
        t, w = gauss(3)
        places = ((np.arange(len(image))[:, None] + 0.5 + t / 2) / len(image) - 0.5) * 2 * radius
        cos2 = geometry.z2**2 / (geometry.z2**2 + places[:, :, None, None] ** 2 + places**2)
        within = np.einsum("iajb,a,b->ij", (shade(cos2) * cos2) ** 2, w / 2, w / 2)
        return (image * within).mean() * (2 * radius / geometry.z2) ** 2
    if lens.aperture_shape == "square":
        cos2 = geometry.z2**2 / (geometry.z2**2 + radius**2 * (t[:, None] ** 2 + t**2))
        return ((shade(cos2) * cos2) ** 2 * w * w[:, None]).sum() * (radius / geometry.z2) ** 2
    low, high = (
        (r / geometry.z2) ** 2 / (1 + (r / geometry.z2) ** 2)
        for r in (radius * (lens.obscuration or 0.0), radius)
    )
    s2 = (low + high) / 2 + (high - low) / 2 * t
    return math.pi * (high - low) / 2 * (w * shade(1 - s2) ** 2).sum()
