"""Brute-force Fresnel columns with many coherent neighbours: explicit phases, every lenslet of a
window, no shift invariance.

Fresnel's kernel, lens phases and square lenslets are products of an axis each, so light from one
line of the pupil goes to the sensor through all lenslets by a one-dimensional kernel; a weight
matrix joins the two axes over a round pupil. It shares no code with plenocli.forward and no idea
with its low-rank route. tests/reference/fresnel.py is the plainer, slower oracle.
"""

import numpy as np
from scipy.special import roots_legendre


def column_energies(
    camera, wavelength, image_point, window, superpixels, *, pixel_nodes=8, extra=1.0
):
    """Energy in each pixel of several superpixels from one point: dict (row, column) -> (pixel
    rows, pixel columns).

    image_point: (y, x) m on the array;
    window: lenslets |m| <= window of both axes act coherently (None: each superpixel's
        own lenslet alone);
    superpixels: list of (row, column);
    extra: factor on all node counts but those of pixels.
    """
    return energies(
        camera, wavelength, [image_point], window, superpixels, pixel_nodes=pixel_nodes, extra=extra
    )[0]


def energies(camera, wavelength, image_points, window, superpixels, *, pixel_nodes=8, extra=1.0):
    """As column_energies, of several points: a list of dicts."""
    rule = _Rule(camera, wavelength, window, superpixels, pixel_nodes, extra)
    weights = pupil_weights(camera, rule.pupil)
    rows, columns = camera.sensor.pixels_per_lenslet
    ways = {
        (s, n): rule.way(s, n)
        for axis, n in enumerate((rows, columns))
        for s in sorted({place[axis] for place in superpixels})
    }
    found = []
    for y, x in image_points:
        left = {
            sy: (ways[sy, rows] * rule.entering(y)) @ weights
            for sy in sorted({place[0] for place in superpixels})
        }
        blocks = {}
        for sy, sx in superpixels:
            energy = np.abs(left[sy] @ (ways[sx, columns] * rule.entering(x)).T) ** 2
            blocks[sy, sx] = energy.reshape(rows, pixel_nodes, columns, pixel_nodes).sum(
                axis=(1, 3)
            )
        found.append(blocks)
    return found


class _Rule:
    """Quadrature of one camera: nodes in the pupil, in each lenslet and in the pixels."""

    def __init__(self, camera, wavelength, window, superpixels, pixel_nodes, extra):
        self.camera, self.k, self.window, self.pixel_nodes, self.extra = (
            camera,
            2 * np.pi / wavelength,
            window,
            pixel_nodes,
            extra,
        )
        self.z1, self.z2, self.z3 = (
            camera.object.distance,
            camera.lenslet_array.distance,
            camera.sensor.distance,
        )
        self.f1, self.f2, self.D2 = (
            camera.main_lens.focal_length,
            camera.lenslet_array.focal_length,
            camera.lenslet_array.pitch,
        )
        self.half, self.radius = (
            self.D2 / 2 * camera.lenslet_array.fill_factor,
            camera.main_lens.aperture_diameter / 2,
        )
        self.wavelength = wavelength
        reach = max(abs(n) for place in superpixels for n in place) if window is None else window
        defocus = abs(1 / self.z1 + 1 / self.z2 - 1 / self.f1) * self.radius
        # twice the phase: the round pupil's weights interpolate where other rules integrate, which
        # takes a node per radian
        self.pupil = self.count(
            2 * self.k * self.radius * ((reach + 1) * self.D2 / self.z2 + defocus)
        )

    def count(self, phase):
        return int(np.ceil(self.extra * (phase / 2 + 3 * np.cbrt(phase) + 12)))

    def entering(self, place):
        """Phases at the pupil nodes of light from a point imaged at `place`, the lens included."""
        x = self.radius * roots_legendre(self.pupil)[0]
        return np.exp(
            0.5j * self.k * ((x + self.z1 / self.z2 * place) ** 2 / self.z1 - x**2 / self.f1)
        )

    def way(self, s, pixels):
        """From pupil nodes to the sensor nodes of superpixel s, weights of pixels
        included as roots.
        """
        k, sensor = self.k, self.camera.sensor
        t, w = roots_legendre(self.pixel_nodes)
        active = sensor.pixel_pitch * np.sqrt(sensor.pixel_fill_factor)
        pixel = (
            s * self.D2 * (1 + self.z3 / self.z2)
            + (np.arange(pixels) - (pixels - 1) / 2) * sensor.pixel_pitch
        )
        v = (pixel[:, None] + active / 2 * t).ravel()
        x = self.radius * roots_legendre(self.pupil)[0]
        total = np.zeros((len(v), len(x)), complex)
        for m in [s] if self.window is None else range(-self.window, self.window + 1):
            far = np.abs(v - m * self.D2 * (1 + self.z3 / self.z2)).max() / self.z3
            curve = abs(1 / self.z2 + 1 / self.z3 - 1 / self.f2) * self.half
            nodes, weight = roots_legendre(
                self.count(self.half * k * (far + self.radius / self.z2 + curve))
            )
            local = self.half * nodes
            u = m * self.D2 + local
            leaving = self.half * weight * np.exp(-0.5j * k * local**2 / self.f2)
            total += (np.exp(0.5j * k / self.z3 * (v[:, None] - u) ** 2) * leaving) @ np.exp(
                0.5j * k / self.z2 * (u[:, None] - x) ** 2
            )
        scale = np.sqrt(np.tile(active / 2 * w, pixels)) / (
            self.wavelength * np.sqrt(self.z2 * self.z3)
        )
        return scale[:, None] * total


def pupil_weights(camera, count):
    """Weights W so that sum f(y_i) W_ij g(x_j) over Gauss-Legendre nodes is the integral of f g
    over the pupil over the root of its area, for f and g that the nodes resolve: (count, count).
    Chords of a disc are integrated in closed form.
    """
    lens = camera.main_lens
    radius = lens.aperture_diameter / 2
    t, w = roots_legendre(count)
    if lens.aperture_shape == "square":
        return radius**2 * np.outer(w, w) / (2 * radius)
    rings = [(1.0, radius)] + ([(-1.0, lens.obscuration * radius)] if lens.obscuration else [])
    total = sum(sign * _disc(count, r / radius, t, w) for sign, r in rings)
    area = np.pi * radius**2 * (1 - lens.obscuration**2)
    return radius**2 * total / np.sqrt(area)


def _disc(count, r, t, w):
    """The same for the disc of radius r <= 1 about the middle of [-1, 1]^2."""
    rows = 2 * count + 16
    theta = (np.arange(rows) + 0.5) * np.pi / rows - np.pi / 2
    y, half = r * np.sin(theta), r * np.cos(theta)
    onto = _legendre(y, count) @ _project(t, w)
    ends = _legendre(half, count + 1)
    degree = np.arange(1, count)
    chords = np.zeros((rows, count))
    chords[:, 0] = 2 * half
    # the integral of P_k over [-c, c]: (P_{k+1} - P_{k-1})/(2k + 1) between the ends, 0 for odd k
    chords[:, 1:] = np.where(
        degree % 2 == 0, 2 * (ends[:, 2:] - ends[:, :-2]) / (2 * degree + 1), 0
    )
    return onto.T @ ((np.pi / rows * half)[:, None] * (chords @ _project(t, w)))


def _project(t, w):
    """From values at the nodes to Legendre coefficients: (degree, node)."""
    count = len(t)
    return (_legendre(t, count) * w[:, None]).T * ((2 * np.arange(count) + 1) / 2)[:, None]


def _legendre(t, count):
    """P_0 ... P_{count-1} at t: (len(t), count)."""
    out = np.ones((count, len(t)))
    if count > 1:
        out[1] = t
    for k in range(1, count - 1):
        out[k + 1] = ((2 * k + 1) * t * out[k] - k * out[k - 1]) / (k + 1)
    return out.T
