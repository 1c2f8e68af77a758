"""Slow, explicit oracle of lenslets off the axis: nothing is expanded about a chief ray.

Every point of the exit pupil sends a spherical wave to every node of the lenslet, with exact
distances, and every node of the lenslet one to every node of the sensor (rayleigh.py). It shares no
code with plenocli.forward. Positions are (y, x) in metres from the optical axis.
"""

import numpy as np

from tests.reference.fresnel import sensor_nodes
from tests.reference.rayleigh import lens_phase, nodes, rayleigh_products
from tests.reference.tensor import weights

try:
    from numba import njit
except ImportError:
    njit = None

PUPIL_AMPLITUDE = {"uniform-pupil": 0.0, "aplanatic": 1.5, "uniform-sine": 2.0}
"""Power of the cosine that the amplitude on the plane of the pupil goes with (seen from
the axis).
"""


def pupil_points(camera, wavelength, reach, density=1.0):
    """Nodes of a round or square pupil, weights A(xi) d^2 xi/sqrt(integral of A^2) and the
    wavefront error there, none: (y, x, weight, m).

    reach: m on the array between an image point and where its field is wanted.
    """
    lens, z = camera.main_lens, camera.lenslet_array.distance
    k, radius = 2 * np.pi / wavelength, lens.aperture_diameter / 2
    phase = density * k * radius / z * reach
    eps = 1 / camera.object.distance + 1 / z - 1 / lens.focal_length
    phase += k * abs(eps) * radius**2
    if lens.aperture_shape == "square":
        p, w = nodes(-radius, radius, phase / radius)
        y, x, weight = np.repeat(p, len(p)), np.tile(p, len(p)), np.outer(w, w).ravel()
    else:
        inner = radius * lens.obscuration
        r, w = nodes(inner, radius, phase / radius)
        turns = int(40 + 1.2 * phase)
        phi = 2 * np.pi * (np.arange(turns) + 0.5) / turns
        y, x = np.outer(r, np.sin(phi)).ravel(), np.outer(r, np.cos(phi)).ravel()
        weight = np.repeat(w * r, turns) * 2 * np.pi / turns
    size = (z * z / (z * z + y * y + x * x)) ** (PUPIL_AMPLITUDE[lens.apodisation] / 2)
    return y, x, weight * size / np.sqrt((weight * size**2).sum()), 0.0


def cut_pupil(shift, azimuth, coma):
    """As pupil_points, of a round pupil that a disc of its size cuts, and with coma in one
    direction: a function like it.

    shift: of the disc, over the pupil's radius, against the direction at `azimuth` (rad, +x to +y);
    coma: coefficient of sqrt(8) (3 rho^3 - 2 rho) cos(theta - azimuth), m.
    """

    def points(camera, wavelength, reach, density=1.0):
        lens, z = camera.main_lens, camera.lenslet_array.distance
        k, radius = 2 * np.pi / wavelength, lens.aperture_diameter / 2
        slope = density * k * (radius / z * reach + 20 * abs(coma)) / radius
        along, weights = [], []
        middle = -shift * radius / 2
        for start in (-radius, (1 - shift) * radius):
            # chords grow as a root from the tips: cosines take it off
            size = middle - start
            t, w = nodes(0, np.pi / 2, slope * abs(size) + 20)
            along.append(start + size * (1 - np.cos(t)))
            weights.append(abs(size) * np.sin(t) * w)
        along, weights = np.concatenate(along), np.concatenate(weights)
        side = np.maximum(np.abs(along), np.abs(along + shift * radius))
        half = np.sqrt(np.maximum(radius**2 - side**2, 0))
        t, w = nodes(-1, 1, slope * radius)
        a, b = np.repeat(along, len(t)), np.outer(half, t).ravel()
        weight = np.outer(weights * half, w).ravel()
        y = a * np.sin(azimuth) + b * np.cos(azimuth)
        x = a * np.cos(azimuth) - b * np.sin(azimuth)
        power = PUPIL_AMPLITUDE[lens.apodisation]
        size = (z * z / (z * z + y * y + x * x)) ** (power / 2)
        r, wr = nodes(0, radius, 20 / radius)
        whole = 2 * np.pi * (wr * r * (z * z / (z * z + r * r)) ** power).sum()
        rho2 = (a * a + b * b) / radius**2
        late = coma * np.sqrt(8) * (3 * rho2 - 2) * a / radius
        return y, x, weight * size / np.sqrt(whole), late

    return points


def field_on_lenslet(camera, wavelength, image_point, y, x, pupil):
    """Field on the grid y, x of a point imaged at `image_point`: (len(y), len(x)), 1/m."""
    k, z = 2 * np.pi / wavelength, camera.lenslet_array.distance
    py, px, weight, late = pupil
    eps = 1 / camera.object.distance + 1 / z - 1 / camera.main_lens.focal_length
    image = 1 / (1 / z - eps)
    if abs(eps) * z < 1e-9:
        image = z
    iy, ix = (a * image / z for a in image_point)
    before = np.sign(image) * np.sqrt(image**2 + (iy - py) ** 2 + (ix - px) ** 2)
    middle = np.hypot(z, np.hypot(*image_point)) - np.sign(image) * np.hypot(
        image, np.hypot(iy, ix)
    )
    # lengths in turns, so that compiled sines see small numbers
    parts = (_fast_spheres if njit else _spheres)(
        np.asarray(y), np.asarray(x), py, px, weight, before + middle - late, z, k
    )
    return parts * z / wavelength


def _spheres(y, x, py, px, weight, before, z, k):
    out = np.zeros((len(y), len(x)), complex)
    for a, b, w, r in zip(py, px, weight, before):
        side = np.sqrt(z * z + (y[:, None] - a) ** 2 + (x - b) ** 2)
        out += w / side**2 * np.exp(1j * k * (side - r))
    return out


def _loops(y, x, py, px, weight, before, z, k):
    real, imag = np.zeros((len(y), len(x))), np.zeros((len(y), len(x)))
    for n in range(len(py)):
        for i in range(len(y)):
            dy2 = z * z + (y[i] - py[n]) ** 2
            for j in range(len(x)):
                q = dy2 + (x[j] - px[n]) ** 2
                side = np.sqrt(q)
                turns = k / (2 * np.pi) * (side - before[n])
                t = (turns - np.floor(turns + 0.5)) * (np.pi / 2)
                t2 = t * t
                s = t * (
                    1 - t2 / 6 * (1 - t2 / 20 * (1 - t2 / 42 * (1 - t2 / 72 * (1 - t2 / 110))))
                )
                c = 1 - t2 / 2 * (
                    1 - t2 / 12 * (1 - t2 / 30 * (1 - t2 / 56 * (1 - t2 / 90 * (1 - t2 / 132))))
                )
                s, c = 2 * s * c, 1 - 2 * s * s
                s, c = 2 * s * c, 1 - 2 * s * s
                size = weight[n] / q
                real[i, j] += size * c
                imag[i, j] += size * s
    return real + 1j * imag


_fast_spheres = njit(fastmath=True, error_model="numpy", cache=True)(_loops) if njit else None


def _opening(shape, half, slope):
    """Nodes of the rectangle around an opening, and their weights: (y, x, (len(y), len(x)))."""
    high = half * (2 / np.sqrt(3) if shape == "hexagon" else 1)
    if shape == "square":
        (y, wy), (x, wx) = nodes(-half, half, slope), nodes(-half, half, slope)
        return y, x, np.outer(wy, wx)
    t = nodes(-1, 1, 2 * slope * high)[0]
    return high * t, half * t, high * half * weights(shape, len(t))


def oblique_columns(
    camera,
    wavelength,
    place,
    image_points,
    *,
    lenslets=((0, 0),),
    superpixel=(0, 0),
    rows=None,
    density=1.0,
    pixel_nodes=6,
    shift=(0.0, 0.0),
    pupil_of=pupil_points,
):
    """Energy in each pixel (of `rows`, default all) from points behind a lenslet off the axis:
    (point, row, column).

    place: where the lenslet stands, m;
    image_points: from the lenslet's centre, m;
    lenslets: (row, column) from it, whose fields add;
    superpixel: whose pixels are wanted, likewise;
    shift: of their window from the chief ray, in pixels;
    pupil_of: its nodes, as pupil_points.
    """
    array, sensor = camera.lenslet_array, camera.sensor
    k, z = 2 * np.pi / wavelength, sensor.distance
    width = array.pitch * array.fill_factor
    spread = 1 + z / array.distance
    centre = tuple(
        (p + s * array.pitch) * spread + a * sensor.pixel_pitch
        for p, s, a in zip(place, superpixel, shift)
    )
    (v, wv), (u, wu) = sensor_nodes(
        centre,
        sensor.pixels_per_lenslet,
        sensor.pixel_pitch,
        sensor.pixel_pitch * np.sqrt(sensor.pixel_fill_factor),
        pixel_nodes,
    )
    if rows is not None:
        chosen = (np.asarray(rows)[:, None] * pixel_nodes + np.arange(pixel_nodes)).ravel()
        v, wv = v[chosen], wv[chosen]
    total = np.zeros((len(image_points), len(v), len(u)), complex)
    for row, column in lenslets:
        middle = place[0] + row * array.pitch, place[1] + column * array.pitch
        half = width / 2
        tall = half * (2 / np.sqrt(3) if array.aperture_shape == "hexagon" else 1)
        edge, ways = np.linspace(-tall, tall, 41), []
        other = np.hypot(*middle) / array.distance
        for ends, m in ((v, middle[0]), (u, middle[1])):
            d = np.array([[ends.min()], [ends.max()]]) - m - edge
            far = np.hypot(d, z)
            # the way to the sensor, the lens, and the main lens's wave to either rim of its pupil
            rim = camera.main_lens.aperture_diameter / 2 * np.array([-1, 1])[:, None, None]
            come = (m + edge - rim) / np.sqrt(array.distance**2 + (m + edge - rim) ** 2)
            bend = edge / array.focal_length
            ways.append(np.abs(come - bend - d / far).max())
        slope = density * k * (max(ways) * 1.1 + 0.3 * other**2 * np.ptp(edge) / z)
        y, x, weight = _opening(array.aperture_shape, half, slope)
        lens = lens_phase(array.profile, array.focal_length, y, x, k) * weight
        fields = []
        for point in image_points:
            at = tuple(p + q for p, q in zip(place, point))
            reach = np.hypot(*(abs(m - a) + half for m, a in zip(middle, at)))
            pupil = pupil_of(camera, wavelength, reach, density)
            fields.append(
                field_on_lenslet(camera, wavelength, at, y + middle[0], x + middle[1], pupil)
            )
        total += rayleigh_products(
            np.array(fields) * lens, y + middle[0], x + middle[1], v, u, z, k, 1e-9
        )
    energy = np.abs(total) ** 2 * wv[:, None] * wu
    return energy.reshape(
        len(image_points), -1, pixel_nodes, sensor.pixels_per_lenslet[1], pixel_nodes
    ).sum(axis=(2, 4))
