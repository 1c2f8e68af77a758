"""From the field on the lenslet array to pixel energies: matrix transforms on quadrature nodes.

In coordinates x' from a lenslet's centre and v from its superpixel's centre (which lies at D2 (1 +
z3/z2) per lenslet), lenslet n of the neighbourhood contributes, per axis,

    exp(j k [n^2 D2^2/2 (1/z2 + 1/z3) - n D2 v/z3]) / sqrt(lambda z3)
      * integral of h(n D2 + x' - xp) exp(j k kappa x'^2/2) exp(-j k x' (v - n D2
          (1 + z3/z2))/z3) dx'

with kappa = 1/z2 + 1/z3 - 1/f2, the same for every lenslet. Fields of one object point add before
the square is taken. Pixel energies are sums over `nodes` points per axis; sub-nodes run slowest, so
that summing them is adding whole planes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.quadrature import band_rule

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry


def sensor_nodes(
    geometry: Geometry, axis: int, count: int, place: float = 0.0, rule: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Quadrature nodes of a superpixel's pixels along one axis.

    axis: 0 rows, 1 columns;
    count: nodes in a pixel;
    place: where the superpixel's centre lies along the axis, in superpixel pitches; it matters on a
        sensor's own raster only;
    rule: step of quadrature.band_rule, 0 for Gauss-Legendre.

    Returns (positions from the superpixel's centre (count, pixel) m, weights (count, pixel) m).
    """
    t, w = band_rule(count, rule)
    if geometry.borders is not None:
        low, high = geometry.pixel_spans(axis, place)
        return (low + high) / 2 + (high - low) / 2 * t[:, None], (high - low) / 2 * w[:, None]
    half = geometry.pixel_active / 2
    return half * t[:, None] + (
        geometry.pixels(axis) + geometry.window_shift(axis, place)
    ), np.broadcast_to(half * w[:, None], (count, geometry.pixel_shape[axis]))


def lenslet_kernel(
    geometry: Geometry,
    n: float,
    v: np.ndarray,
    weight: np.ndarray,
    x: np.ndarray,
    dtype: np.typing.DTypeLike = complex,
) -> np.ndarray:
    """The per-axis kernel from a lenslet to sensor nodes.

    n: lenslets between it and the superpixel;
    v: (node,) on the sensor, m from the superpixel's centre;
    weight: (node,) m, folded in as square roots;
    x: (place,) on the lenslet, m from its centre;
    dtype: complex64 or complex128.

    Returns (node, place), m^(-1/2).
    docs/model.md, "From the array to the sensor".
    """
    g = geometry
    relay = 1 / g.z2 + 1 / g.z3
    phase = n * n * g.D2**2 / 2 * relay - n * g.D2 / g.z3 * v
    phase = phase[:, None] + g.kappa / 2 * x * x - x * (v - n * g.superpixel_pitch)[:, None] / g.z3
    kernel = np.empty(phase.shape, dtype)
    phase /= g.wavelength  # in turns, which single precision can hold once whole ones are gone
    phase -= np.rint(phase)
    phase = (2 * np.pi * phase).astype(kernel.real.dtype)
    amplitude = np.sqrt(weight / (g.wavelength * g.z3))[:, None].astype(phase.dtype)
    # twice as fast as a complex exponential
    kernel.real, kernel.imag = amplitude * np.cos(phase), amplitude * np.sin(phase)
    return kernel


def lit_lenslets(reach: int, window: int | None) -> range:
    """Lenslets along one axis whose light is followed.

    reach: superpixels kept on either side;
    window: coherent lenslets on either side, None where each superpixel is lit by its own only.
    """
    far = reach if window is None else window
    return range(-far, far + 1)


def pixel_energy(field: np.ndarray) -> np.ndarray:
    """Energy of each pixel from the field on its nodes.

    field: (point, p, pixel row, p, pixel column) complex, weights included, overwritten.

    Returns (point, pixel row, pixel column), shares of the light.
    """
    count, p, py, _, px = field.shape
    parts = field.view(field.real.dtype).reshape(count, p, py, p, px, 2)
    np.multiply(parts, parts, out=parts)
    energy = parts[:, :, :, 0] if p == 1 else parts.sum(axis=3)
    energy = energy.sum(axis=1)
    return energy[..., 0] + energy[..., 1]
