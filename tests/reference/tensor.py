"""Brute-force columns of a camera of any shapes: pupil and lenslets as integrals over their whole
opening, every phase written out, several points at once.

The integrand over an opening goes on smoothly to the rectangle around it. There it is
known from its values at Gauss-Legendre nodes, and so is its integral over the opening inside:
weights W_ij with sum W_ij F(y_i, x_j) = integral of F (`weights`). No chords, no shift invariance,
no separable terms, no pixel rules: it shares neither code nor ideas with plenocli.forward.
Positions are (y, x) in metres from the optical axis.
"""

from functools import lru_cache

import numpy as np
from scipy.special import eval_jacobi, roots_legendre

from tests.reference.fresnel import lenslet_centre

try:
    from numba import njit
except ImportError:
    njit = None

BLOCK = 256
"""Nodes of the sensor, and of a lenslet, between which the exact kernel is in memory together."""


def paraxial(camera, points, lenslets, superpixels, *, window=None, extra=1.0):
    """Energy in each pixel by two Fresnel integrals: (point, superpixel, pixel row, pixel column).

    points: [(y, x)] image points on the array, m;
    lenslets: [(row, column)] whose fields add, None: each superpixel's own alone;
    superpixels: [(row, column)];
    window: (pixel rows, pixel columns) from a superpixel's middle to that of its pixels;
    extra: factor on all node counts.
    """
    rule = _Rule(camera, lenslets, superpixels, window, extra)
    found = []
    for place in superpixels:
        v, u = rule.sensor(place)
        total = 0
        for lenslet in [place] if lenslets is None else lenslets:
            y, x = rule.opening(lenslet)
            down, across = (
                _fresnel(to[0], at, rule.k / rule.z3)
                for to, at in ((v, y + rule.centre(lenslet)[0]), (u, x + rule.centre(lenslet)[1]))
            )
            total = total + down @ (rule.behind(points, lenslet)) @ across.T
        total = total / (rule.wavelength * rule.z3)
        found.append(rule.pixels(total, v, u))
    return np.stack(found, axis=1)


def exact(camera, points, lenslets, superpixels, *, window=None, extra=1.0):
    """As `paraxial`, by Rayleigh and Sommerfeld's first integral behind the sphere of the main lens
    (docs/model.md, "Exact propagation").
    """
    rule = _Rule(camera, lenslets, superpixels, window, extra, True)
    found = []
    for place in superpixels:
        v, u = rule.sensor(place)
        total = np.zeros((len(points), len(v[0]), len(u[0])), complex)
        for lenslet in [place] if lenslets is None else lenslets:
            y, x = (a + c for a, c in zip(rule.opening(lenslet), rule.centre(lenslet)))
            total += _to_sensor(rule, v[0], u[0], y, x, rule.behind(points, lenslet))
        found.append(rule.pixels(total / rule.wavelength, v, u))
    return np.stack(found, axis=1)


def kernel_values(camera, lenslets, superpixels):
    """Values of the kernel that `exact` takes, a few nanoseconds each."""
    rule = _Rule(camera, lenslets, superpixels, None, 1.0, True)
    lit = 1 if lenslets is None else len(lenslets)
    on_sensor = np.prod(camera.sensor.pixels_per_lenslet) * float(rule.pixel_nodes) ** 2
    return len(superpixels) * lit * rule.lenslet_nodes**2 * on_sensor


def paraxial_products(camera, lenslets, superpixels):
    """Multiplications that `paraxial` takes for a point."""
    rule = _Rule(camera, lenslets, superpixels, None, 1.0)
    n, p = float(rule.lenslet_nodes), rule.pupil_nodes
    rows, columns = (rule.pixel_nodes * count for count in camera.sensor.pixels_per_lenslet)
    each = n * p * (n + p) + rows * n * (n + columns)
    return len(superpixels) * len(lenslets) * each


def _to_sensor(rule, v, u, y, x, fields):
    """Rayleigh and Sommerfeld's integral of fields at y, x: (point, v, u), without 1/wavelength."""
    count = len(fields)
    parts = np.concatenate([fields.real, fields.imag]).transpose(1, 2, 0)
    across = (u[:, None] - x) ** 2
    some, part = max(1, BLOCK // len(u)), max(1, BLOCK // len(x))
    total = np.zeros((count, len(v), len(u)), complex)
    waves = _fast_waves if njit else _waves
    for first in range(0, len(v), some):
        rows = slice(first, first + some)
        for start in range(0, len(y), part):
            down = (v[rows, None] - y[start : start + part]) ** 2
            onto = parts[start : start + part].reshape(-1, 2 * count)
            real, imag = (
                (kernel.reshape(-1, len(onto)) @ onto).T.reshape(2, count, -1, len(u))
                for kernel in waves(down, across, rule.z3, rule.wavelength)
            )
            total[:, rows] += real[0] - imag[1] + 1j * (real[1] + imag[0])
    return total


def _waves(down, across, z, wavelength):
    """The kernel z/R^2 (1 + j/(k R)) exp(j k (R - z)): its parts, (v, u, y, x).

    down, across: squares of what lies between sensor and lenslet, (v, y) and (u, x).
    """
    path = down[:, None, :, None] + across[:, None]
    r = np.sqrt(path + z**2)
    # R - z without cancellation
    turns = path / (r + z) / wavelength
    wave = z / r**2 * (1 + 1j * wavelength / (2 * np.pi * r)) * np.exp(2j * np.pi * (turns % 1))
    return wave.real, wave.imag


def _loops(down, across, z, wavelength):
    rows, high = down.shape
    columns, wide = across.shape
    waves = 1 / wavelength
    real = np.empty((rows, columns, high, wide))
    imag = np.empty((rows, columns, high, wide))
    for a in range(rows):
        for b in range(columns):
            for i in range(high):
                for j in range(wide):
                    path = down[a, i] + across[b, j]
                    r = np.sqrt(path + z * z)
                    near = 1 / r
                    turns = path / (r + z) * waves
                    # sine and cosine by their series within half a quadrant, then doubled
                    t = (turns - np.floor(turns + 0.5)) * (np.pi / 2)
                    q = t * t
                    s = 1 - q / 110 * (1 - q / 156 * (1 - q / 210))
                    s = t * (1 - q / 6 * (1 - q / 20 * (1 - q / 42 * (1 - q / 72 * s))))
                    c = 1 - q / 132 * (1 - q / 182 * (1 - q / 240))
                    c = 1 - q / 30 * (1 - q / 56 * (1 - q / 90 * c))
                    c = 1 - q / 2 * (1 - q / 12 * c)
                    s, c = 2 * s * c, 1 - 2 * s * s
                    s, c = 2 * s * c, 1 - 2 * s * s
                    size = z * near * near
                    late = near * wavelength / (2 * np.pi)
                    real[a, b, i, j] = size * (c - late * s)
                    imag[a, b, i, j] = size * (s + late * c)
    return real, imag


_fast_waves = njit(fastmath=True, error_model="numpy", cache=True)(_loops) if njit else None


class _Rule:
    """Nodes in the pupil, in each lenslet and in the pixels, and the wave on the way."""

    def __init__(self, camera, lenslets, superpixels, window, extra, exact=False):
        self.camera, self.extra, self.exact = camera, extra, exact
        self.window = (0.0, 0.0) if window is None else window
        (self.wavelength,) = camera.light.wavelengths
        self.k = 2 * np.pi / self.wavelength
        lens, array = camera.main_lens, camera.lenslet_array
        self.z1, self.z2, self.z3 = camera.object.distance, array.distance, camera.sensor.distance
        self.f1, self.f2, pitch = lens.focal_length, array.focal_length, array.pitch
        self.radius = lens.aperture_diameter / 2
        width = pitch * array.fill_factor
        self.box = (
            width / (np.sqrt(3) if array.aperture_shape == "hexagon" else 2),
            width / 2,
        )
        places = [self.centre(p) for p in superpixels]
        lit = places if lenslets is None else [self.centre(p) for p in lenslets]
        pixels = np.array(camera.sensor.pixels_per_lenslet) * camera.sensor.pixel_pitch / 2
        scale = 1 + self.z3 / self.z2
        # the steepest way to the sensor and the widest from a point, along an axis
        away = (
            [0.0]
            if lenslets is None
            else [abs(a[i] - b[i]) for a in places for b in lit for i in (0, 1)]
        )
        reach = max(away) * scale + max(pixels) + camera.sensor.pixel_pitch
        far = max(abs(c) for p in lit for c in p) + max(self.box) + pitch / 2
        rim = self.radius / self.z2
        curve = abs(1 / self.z2 + 1 / self.z3 - 1 / self.f2) * max(self.box)
        bent = 2 * (max(self.box) + reach) ** 3 / self.z3**3 if exact else 0.0
        self.lenslet_nodes = self.count(
            self.k * max(self.box) * (reach / self.z3 + rim + curve + bent)
        )
        eps = abs(1 / self.z1 + 1 / self.z2 - 1 / self.f1)
        self.pupil_nodes = self.count(
            self.k * self.radius * (far / self.z2 + self.radius * eps + self._slope())
        )
        # intensities of lenslets farthest apart
        spread = 2 * max(self.box) + (
            0
            if lenslets is None
            else max(abs(a[i] - b[i]) for a in lit for b in lit for i in (0, 1))
        )
        self.pixel_nodes = int(
            np.ceil(
                extra
                * (lambda p: p / 2 + 3 * np.cbrt(p) + 5)(
                    self.k * spread / self.z3 * camera.sensor.pixel_pitch / 2
                )
            )
        )

    def count(self, phase):
        """Nodes that interpolate a function of so much phase from the middle to the end."""
        return int(np.ceil(self.extra * (phase + 5 * np.cbrt(phase) + 14)))

    def centre(self, place):
        """Where a lenslet stands, m."""
        return lenslet_centre(self.camera, *place)

    def opening(self, lenslet):
        """Nodes from a lenslet's centre: (y, x)."""
        t = roots_legendre(self.lenslet_nodes)[0]
        return self.box[0] * t, self.box[1] * t

    def _wavefront(self, y, x):
        """Wavefront error at y, x, which are broadcast against each other, m."""
        lens = self.camera.main_lens
        unit = self.radius * (np.sqrt(2) if lens.aperture_shape == "square" else 1)
        total = np.zeros(np.broadcast(y, x).shape)
        for term in lens.aberrations or ():
            total += term.coefficient * zernike(term.noll, y / unit, x / unit)
        return total

    def _slope(self):
        """Largest slope of the wavefront on the square around the pupil."""
        t = np.linspace(-self.radius, self.radius, 81)
        return max(
            np.abs(a).max() for a in np.gradient(self._wavefront(t[:, None], t), t[1] - t[0])
        )

    @property
    def _pupil(self):
        """(nodes, weights of the pupil with its wavefront and amplitude, of unit light)."""
        if not hasattr(self, "_made"):
            lens, n = self.camera.main_lens, self.pupil_nodes
            t = roots_legendre(n)[0]
            weight = weights("square" if lens.aperture_shape == "square" else "circle", n)
            if lens.obscuration:
                weight = weight - weights("circle", n, lens.obscuration)
            if self.exact:
                self._made = self._directions(t, weight)
                return self._made
            y = self.radius * t
            area = self.radius**2 * weight.sum()
            phase = np.exp(1j * self.k * self._wavefront(y[:, None], y))
            self._made = y, self.radius**2 * weight * phase / np.sqrt(area)
        return self._made

    def _directions(self, t, weight):
        """The pupil of the exact model: (nodes, weights with everything but the phase towards the
        array, of unit light). Nodes are direction cosines of a round pupil, which is a disc there
        too, and places on a square one.
        """
        lens = self.camera.main_lens
        if lens.aperture_shape == "square":
            nodes = self.radius * t
            r2 = nodes[:, None] ** 2 + nodes**2
            s2 = r2 / (self.z2**2 + r2)
            solid, stretch = self.radius**2 * weight * (1 - s2) ** 2 / self.z2**2, 1.0
        else:
            rim, inner = (
                r / np.hypot(r, self.z2) for r in (self.radius, lens.obscuration * self.radius)
            )
            weight = weights("circle", len(t)) - (
                weights("circle", len(t), inner / rim) if inner else 0
            )
            nodes = rim * t
            s2 = nodes[:, None] ** 2 + nodes**2
            r2 = self.z2**2 * s2 / (1 - s2)
            solid, stretch = rim**2 * weight, self.z2 / np.sqrt(1 - s2)
        amplitude = {
            "uniform-pupil": 1 / (1 - s2),
            "aplanatic": (1 - s2) ** -0.25,
            "uniform-sine": np.ones_like(s2),
        }[lens.apodisation]
        light = (solid * amplitude**2).sum()
        phase = self.k * self._wavefront(nodes[:, None] * stretch, nodes * stretch)
        eps = 1 / self.z1 + 1 / self.z2 - 1 / self.f1
        if eps:
            image = 1 / (1 / self.z2 - eps)
            phase = phase + self.k * (
                r2 / (np.sqrt(self.z2**2 + r2) + self.z2)
                - np.sign(image) * r2 / (np.sqrt(image**2 + r2) + abs(image))
            )
        return nodes, solid * amplitude * np.exp(1j * phase) / np.sqrt(light)

    def behind(self, points, lenslet):
        """Fields behind a lenslet at its nodes, weights included: (point, y, x)."""
        y, x = self.opening(lenslet)
        cy, cx = self.centre(lenslet)
        p, pupil = self._pupil
        found = []
        for point in points:
            if self.exact:
                found.append(self._sphere(y + cy - point[0], x + cx - point[1], p, pupil))
                continue
            sides = []
            for at, c in ((y + cy, point[0]), (x + cx, point[1])):
                # the point, inverted by the main lens, the lens and the way to the array
                enters = (p + self.z1 / self.z2 * c) ** 2 / self.z1 - p**2 / self.f1
                sides.append(np.exp(0.5j * self.k * (enters + (at[:, None] - p) ** 2 / self.z2)))
            found.append(sides[0] @ pupil @ sides[1].T / (self.wavelength * self.z2))
        if self.exact:
            curve = (y[:, None] + cy) ** 2 + (x + cx) ** 2
            found = np.array(found) * np.exp(0.5j * self.k / self.z2 * curve)
        r2 = y[:, None] ** 2 + x**2
        if self.exact and self.camera.lenslet_array.profile == "hyperbolic":
            path = r2 / (np.sqrt(self.f2**2 + r2) + self.f2)
        else:
            path = r2 / (2 * self.f2)
        opening = weights(self.camera.lenslet_array.aperture_shape, self.lenslet_nodes)
        return np.array(found) * (self.box[0] * self.box[1] * opening * np.exp(-1j * self.k * path))

    def _sphere(self, dy, dx, p, pupil):
        """The exact main lens's field dy, dx from the image point: (y, x)."""
        if self.camera.main_lens.aperture_shape != "square":
            down, across = (np.exp(-1j * self.k * np.outer(d, p)) for d in (dy, dx))
            return down @ pupil @ across.T / self.wavelength
        side = np.sqrt(self.z2**2 + p[:, None] ** 2 + p**2)
        total = np.zeros((len(dy), len(dx)), complex)
        for at, away, weight in zip(p, side, pupil):
            rate = self.k / away
            total += np.exp(-1j * np.outer(dy * at, rate)) @ (
                weight[:, None] * np.exp(-1j * np.outer(rate * p, dx))
            )
        return total / self.wavelength

    def sensor(self, place):
        """Sensor nodes of a superpixel and their weights: [(v, weight)] by axis."""
        sensor, t, w = self.camera.sensor, *roots_legendre(self.pixel_nodes)
        half = sensor.pixel_pitch * np.sqrt(sensor.pixel_fill_factor) / 2
        axes = []
        for c, n, shift in zip(self.centre(place), sensor.pixels_per_lenslet, self.window):
            middle = c * (1 + self.z3 / self.z2) + shift * sensor.pixel_pitch
            pixel = middle + (np.arange(n) - (n - 1) / 2) * sensor.pixel_pitch
            axes.append(((pixel[:, None] + half * t).ravel(), np.tile(half * w, n)))
        return axes

    def pixels(self, total, v, u):
        """|field|^2 over the pixels: (point, row, column)."""
        rows, columns = self.camera.sensor.pixels_per_lenslet
        energy = np.abs(total) ** 2 * np.outer(v[1], u[1])
        return energy.reshape(len(total), rows, self.pixel_nodes, columns, -1).sum(axis=(2, 4))


@lru_cache(maxsize=64)
def weights(shape, count, size=1.0):
    """W (y node, x node) with sum W_ij F(y_i, x_j) the integral of F over the opening, for Gauss-
    Legendre nodes on [-1, 1] of the rectangle around it that resolve F.

    shape: "square", "circle" or "hexagon" (flat sides towards +-x), the rectangle scaled to
        [-1, 1]^2;
    size: of a disc about the middle.
    """
    t, w = roots_legendre(count)
    if shape == "square":
        return np.outer(w, w)
    if shape == "circle":
        rows = 2 * count + 16
        theta = (np.arange(rows) + 0.5) * np.pi / rows - np.pi / 2
        y, half = size * np.sin(theta), size * np.cos(theta)
        wy = np.pi / rows * half
    else:
        # from corner to flat side, along it, to the other corner; an eighth of a node more than a
        # product of two polynomials of that degree and a line need
        s, ws = roots_legendre(count + 4)
        panels = [(-1, -0.5), (-0.5, 0.5), (0.5, 1)]
        y = np.concatenate([(a + b) / 2 + (b - a) / 2 * s for a, b in panels])
        wy = np.concatenate([(b - a) / 2 * ws for a, b in panels])
        half = np.minimum(1.0, 2 * (1 - np.abs(y)))
    onto, ends = _legendre(y, count), _legendre(half, count + 1)
    degree = np.arange(1, count)
    chords = np.zeros((len(y), count))
    chords[:, 0] = 2 * half
    # the integral of P_k from -c to c, nothing for odd k
    chords[:, 1:] = np.where(degree % 2, 0, 2 * (ends[:, 2:] - ends[:, :-2]) / (2 * degree + 1))
    project = (_legendre(t, count) * w[:, None]).T * (np.arange(count) + 0.5)[:, None]
    return (onto @ project).T @ (wy[:, None] * (chords @ project))


def _legendre(t, count):
    """P_0 ... P_{count-1} at t: (len(t), count)."""
    return np.polynomial.legendre.legvander(t, count - 1)


def _fresnel(to, start, rate):
    """Fresnel's kernel along an axis without its constant: (to, start)."""
    return np.exp(0.5j * rate * (to[:, None] - start) ** 2)


def zernike(noll, y, x):
    """Noll's polynomial, by Jacobi's."""
    orders = [
        (n, m) for n in range(30) for m in sorted(range(-n, n + 1, 2), key=lambda m: (abs(m), m))
    ]
    n, size = orders[noll - 1][0], abs(orders[noll - 1][1])
    rho, theta = np.hypot(y, x), np.arctan2(y, x)
    half = (n - size) // 2
    radial = (-1) ** half * rho**size * eval_jacobi(half, size, 0, 1 - 2 * rho**2)
    if size == 0:
        return np.sqrt(n + 1) * radial
    # even numbers are cosines
    turn = np.cos(size * theta) if noll % 2 == 0 else np.sin(size * theta)
    return np.sqrt(2 * (n + 1)) * radial * turn
