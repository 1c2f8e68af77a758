"""Slow, explicit oracle of the exact model: Rayleigh and Sommerfeld's first integral
summed point by point.

It shares no code with plenocli.forward: the field on the array is integrated over the pupil in
direction cosines (or, with `spheres`, over spherical waves from each point of the exit pupil), the
lenslet's phase is written out, and every node of the lenslet sends z/(j lambda R^2) (1 + j/(k R))
exp(j k R) to every node of the sensor. Positions are (y, x) in metres from the optical axis.
"""

import numpy as np
from scipy.special import roots_legendre

from tests.reference.fresnel import sensor_nodes
from tests.reference.window import _disc

try:
    from numba import njit
except ImportError:
    njit = None

BLOCK = 16
"""Sensor nodes whose waves are in memory together."""
MOST = 64
"""Points along either axis that an interval may take to resolve the kernel, before it is halved."""


def nodes(low, high, slope):
    """Gauss-Legendre nodes and weights for phases of at most `slope` rad/m."""
    half = (high - low) / 2
    t, w = roots_legendre(int(np.ceil(slope * half / 2 + 3 * np.cbrt(slope * half) + 10)))
    return (low + high) / 2 + half * t, half * w


def amplitude(name, s2):
    """Amplitude in direction cosines: of an evenly lit plane pupil, of an aplanatic
    lens, of an even one.
    """
    return {
        "uniform-pupil": 1 / (1 - s2),
        "aplanatic": (1 - s2) ** -0.25,
        "uniform-sine": np.ones_like(s2),
    }[name]


def pupil_directions(camera, density=1.0, wavelength=None, reach=3.0):
    """Direction cosines and weights d^2 s a(s)/N of a round or square pupil or one given as a
    picture: (sy, sx, complex weight), N so that the light is 1.

    reach: lenslet pitches between an image point and the places where its field is wanted.
    """
    lens, z = camera.main_lens, camera.lenslet_array.distance
    k, radius, pitch = (
        2 * np.pi / (wavelength or camera.light.wavelengths[0]),
        lens.aperture_diameter / 2,
        camera.lenslet_array.pitch,
    )
    rate = density * k / z * reach * pitch
    if lens.aperture_shape == "image":
        picture = lens.samples("aperture_image")
        edges = (2 * np.arange(len(picture) + 1) / len(picture) - 1) * radius
        p, w = (np.array(a) for a in zip(*(nodes(a, b, rate) for a, b in zip(edges, edges[1:]))))
        root = np.repeat(np.repeat(np.sqrt(picture), p.shape[1], 0), p.shape[1], 1)
        p, w = p.ravel(), w.ravel()
        y, x, weight = np.repeat(p, len(p)), np.tile(p, len(p)), (np.outer(w, w) * root).ravel()
    elif lens.aperture_shape == "square":
        p, w = nodes(-radius, radius, rate)
        y, x, weight = np.repeat(p, len(p)), np.tile(p, len(p)), np.outer(w, w).ravel()
    else:
        r, w = nodes(radius * lens.obscuration, radius, rate)
        turns = int(40 + 1.3 * rate * radius)
        phi = 2 * np.pi * (np.arange(turns) + 0.5) / turns
        y, x = np.outer(r, np.sin(phi)).ravel(), np.outer(r, np.cos(phi)).ravel()
        weight = np.repeat(w * r, turns) * 2 * np.pi / turns
    r2 = y * y + x * x
    s2 = r2 / (z * z + r2)
    weight = weight * (1 - s2) ** 2 / z**2 * amplitude(lens.apodisation, s2)
    through = root.ravel() if lens.aperture_shape == "image" else 1.0
    norm = np.sqrt((weight * amplitude(lens.apodisation, s2) * through).sum())
    eps = 1 / camera.object.distance + 1 / z - 1 / camera.main_lens.focal_length
    if eps:
        image = 1 / (1 / z - eps)
        weight = weight * np.exp(
            1j
            * k
            * ((np.sqrt(z * z + r2) - z) - np.sign(image) * (np.sqrt(image**2 + r2) - abs(image)))
        )
    side = np.sqrt(z * z + r2)
    return y / side, x / side, weight / norm


def field_on_array(camera, wavelength, image_point, y, x, directions):
    """Field at the grid y, x (m, from the axis) of a point imaged at `image_point`:
    (len(y), len(x)), 1/m.
    """
    k, z = 2 * np.pi / wavelength, camera.lenslet_array.distance
    sy, sx, weight = directions
    total = np.zeros((len(y), len(x)), complex)
    for start in range(0, len(weight), 20000):
        some = slice(start, start + 20000)
        total += (np.exp(-1j * k * np.outer(y - image_point[0], sy[some])) * weight[some]) @ np.exp(
            -1j * k * np.outer(sx[some], x - image_point[1])
        )
    return total / wavelength * np.exp(0.5j * k / z * (y[:, None] ** 2 + x**2))


def main_lens_field(camera, reach):
    """The field on the array of a round, ring-shaped or square pupil as a function of (image point,
    y, x), up to `reach` (m) from the image point: the sum over direction cosines of field_on_array
    with weights that part the axes, for many nodes.
    """
    lens, z = camera.main_lens, camera.lenslet_array.distance
    k, radius = 2 * np.pi / camera.light.wavelengths[0], lens.aperture_diameter / 2
    rim = radius / np.hypot(z, radius)
    eps = 1 / camera.object.distance + 1 / z - 1 / lens.focal_length
    count = int(1.1 * k * rim * (reach + abs(eps) * lens.aperture_diameter * z) + 60)
    t, w = roots_legendre(count)
    weight = rim**2 * (
        np.outer(w, w) if lens.aperture_shape == "square" else _disc(count, 1.0, t, w)
    )
    if lens.aperture_shape == "annulus":
        inner = lens.obscuration * radius
        weight -= rim**2 * _disc(count, inner / np.hypot(z, inner) / rim, t, w)
    s2 = rim**2 * (t[:, None] ** 2 + t**2)
    weight, shape = weight.astype(complex), amplitude(lens.apodisation, s2)
    norm = np.sqrt((weight.real * shape**2).sum())
    if abs(eps) * lens.aperture_diameter * z > 1e-9 * camera.lenslet_array.pitch:
        image, r2 = 1 / (1 / z - eps), z * z * s2 / (1 - s2)
        weight = weight * np.exp(
            1j
            * k
            * ((np.sqrt(z * z + r2) - z) - np.sign(image) * (np.sqrt(image**2 + r2) - abs(image)))
        )
    weight = weight * shape / norm

    def field(point, y, x, paired=False):
        """On the grid of y and x, or `paired` at the places (y, x)."""
        lines, of = np.unique(y, return_inverse=True)
        down = np.exp(-1j * k * rim * np.outer(lines - point[0], t)) @ weight
        right = np.exp(-1j * k * rim * np.outer(x - point[1], t))
        sent = np.einsum("nt,nt->n", down[of], right) if paired else down[of] @ right.T
        y = y if paired else y[:, None]
        return sent * k / (2 * np.pi) * np.exp(0.5j * k / z * (y**2 + x**2))

    return field


def field_of_spheres(camera, wavelength, image_point, y, x, radial=60, turns=240):
    """The same for a round, evenly lit plane pupil by spherical waves with exact distances,
    pupil point by pupil point.
    """
    k, z, radius = (
        2 * np.pi / wavelength,
        camera.lenslet_array.distance,
        camera.main_lens.aperture_diameter / 2,
    )
    t, w = roots_legendre(radial)
    r, w = radius * (t + 1) / 2, radius * w / 2
    phi = 2 * np.pi * (np.arange(turns) + 0.5) / turns
    total = np.zeros((len(y), len(x)), complex)
    for ri, wi in zip(r, w):
        for angle in phi:
            py, px = ri * np.sin(angle), ri * np.cos(angle)
            side = np.sqrt(z * z + (y[:, None] - py) ** 2 + (x - px) ** 2)
            image = np.sqrt(z * z + (image_point[0] - py) ** 2 + (image_point[1] - px) ** 2)
            total += wi * ri * 2 * np.pi / turns * z / side**2 * np.exp(1j * k * (side - image))
    return total / (wavelength * np.sqrt(np.pi) * radius)


def lens_phase(profile, f, y, x, k):
    """The lenslet's phase factor at (y, x) from its centre."""
    r2 = y[:, None] ** 2 + x**2
    return np.exp(-1j * k * (r2 / (2 * f) if profile == "parabolic" else np.sqrt(f * f + r2) - f))


def pixel_energies(camera, wavelength, image_point, lenslets, centre, **how):
    """Energy in each pixel of a superpixel at `centre` (m, on the sensor) from one
    point: (rows, columns).

    how: as column_energies.
    """
    return column_energies(camera, wavelength, [image_point], lenslets, centre, **how)[0]


def column_energies(
    camera,
    wavelength,
    image_points,
    lenslets,
    centre,
    *,
    rows=None,
    density=1.0,
    pixel_nodes=6,
    f2=None,
    spheres=False,
    field=None,
):
    """Energy in each pixel (of `rows`, default all) of a superpixel at `centre` (m, on the sensor)
    from each of the `image_points`: (points, rows, columns).

    lenslets: list of (row, column) whose fields add;
    density scales the nodes of pupil and lenslet;
    field: of the main lens, as main_lens_field makes it; by default a sum over directions.
    """
    k, z = 2 * np.pi / wavelength, camera.sensor.distance
    array, sensor = camera.lenslet_array, camera.sensor
    width, f2 = array.pitch * array.fill_factor, f2 or array.focal_length
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
    if field is None:
        directions = pupil_directions(
            camera, density, wavelength, 1.5 * (1 + max(abs(n) for pair in lenslets for n in pair))
        )
    total = np.zeros((len(image_points), len(v), len(u)), complex)
    for row, column in lenslets:
        cy, cx = row * array.pitch, column * array.pitch
        # slopes of the lenslet's phase and of the way to either edge of the superpixel
        edge, ways = np.linspace(-width / 2, width / 2, 41), []
        for nodes_there, middle in ((v, cy), (u, cx)):
            d = edge - np.array([[nodes_there.min()], [nodes_there.max()]]) + middle
            bend = edge / f2 if array.profile == "parabolic" else edge / np.hypot(edge, f2)
            ways.append(np.abs(d / np.hypot(d, z) - bend).max())
        slope = (
            density
            * k
            * (1.1 * max(ways) + camera.main_lens.aperture_diameter / (2 * array.distance))
        )
        (y, wy), (x, wx) = nodes(-width / 2, width / 2, slope), nodes(-width / 2, width / 2, slope)
        lens = lens_phase(array.profile, f2, y, x, k) * wy[:, None] * wx
        if spheres:
            fields = [
                field_of_spheres(camera, wavelength, point, y + cy, x + cx)
                for point in image_points
            ]
        elif field is not None:
            fields = [field(point, y + cy, x + cx) for point in image_points]
        else:
            fields = [
                field_on_array(camera, wavelength, point, y + cy, x + cx, directions)
                for point in image_points
            ]
        total += rayleigh_sum(np.array(fields) * lens, y + cy, x + cx, v, u, z, k)
    energy = np.abs(total) ** 2 * wv[:, None] * wu
    return energy.reshape(
        len(image_points), -1, pixel_nodes, sensor.pixels_per_lenslet[1], pixel_nodes
    ).sum(axis=(2, 4))


def opening_nodes(shape, width, count):
    """Quadrature of a lenslet's opening by chords along x: y, x, weight (nodes,).

    shape: "circle", or "hexagon" of `width` across the flat sides that face +-x;
    count: nodes of a chord; about twice as many chords.
    """
    t, w = roots_legendre(count)
    if shape == "circle":
        # equidistant angles, as the integrand is periodic in them
        turn = (np.arange(2 * count) + 0.5) * np.pi / (2 * count) - np.pi / 2
        y, half = width / 2 * np.sin(turn), width / 2 * np.cos(turn)
        wy = np.pi / (2 * count) * half
    else:
        side, panels, (t2, w2) = width / np.sqrt(3), [], roots_legendre(int(0.6 * count) + 10)
        for low, high in ((-side, -side / 2), (-side / 2, side / 2), (side / 2, side)):
            panels.append(((low + high) / 2 + (high - low) / 2 * t2, (high - low) / 2 * w2))
        y, wy = (np.concatenate(parts) for parts in zip(*panels))
        half = np.minimum(width / 2, np.sqrt(3) * (side - np.abs(y)))
    return np.repeat(y, count), np.outer(half, t).ravel(), np.outer(wy * half, w).ravel()


def energies_behind_opening(camera, image_points, places, *, rows, pixel_nodes=6, centre=(0, 0)):
    """As column_energies, of one lenslet of any shape on the axis, node by node.

    places: (y, x, weight) of quadrature nodes of its opening, m;
    rows: of pixels;
    centre: of the superpixel, m.
    """
    k, array, sensor = 2 * np.pi / camera.light.wavelengths[0], camera.lenslet_array, camera.sensor
    (v, wv), (u, wu) = sensor_nodes(
        centre,
        sensor.pixels_per_lenslet,
        sensor.pixel_pitch,
        sensor.pixel_pitch * np.sqrt(sensor.pixel_fill_factor),
        pixel_nodes,
    )
    chosen = (np.asarray(rows)[:, None] * pixel_nodes + np.arange(pixel_nodes)).ravel()
    v, wv, (y, x, weight) = v[chosen], wv[chosen], places
    wave, f, r2 = main_lens_field(camera, 1.3 * array.pitch), array.focal_length, y * y + x * x
    bend = r2 / (2 * f) if array.profile == "parabolic" else np.sqrt(f * f + r2) - f
    fields = np.array([wave(point, y, x, paired=True) for point in image_points])
    fields = (fields * weight * np.exp(-1j * k * bend)).T
    total = np.empty((len(v), len(u), len(image_points)), complex)
    for i, at in enumerate(v):
        for start in range(0, len(u), BLOCK):
            q = (at - y) ** 2 + (u[start : start + BLOCK, None] - x) ** 2
            total[i, start : start + BLOCK] = (_fast_wave or _wave)(q, sensor.distance, k) @ fields
    energy = np.abs(total.transpose(2, 0, 1) * k / (2 * np.pi)) ** 2 * wv[:, None] * wu
    return energy.reshape(
        len(image_points), -1, pixel_nodes, sensor.pixels_per_lenslet[1], pixel_nodes
    ).sum(axis=(2, 4))


def rayleigh_sum(fields, y, x, v, u, z, k):
    """sum over y, x of each of `fields` (points, y, x) times K(v - y, u - x), exp(j k z) left out:
    (points, len(v), len(u)).

    Every node of the lenslet sends its wave to every node of the sensor, a few of those at a time.
    """
    count, waves = len(fields), _fast_waves if njit else _waves
    fields = fields.reshape(count, -1)
    parts = np.concatenate([fields.real, fields.imag])
    total = np.zeros((count, len(v), len(u)), complex)
    for i, at in enumerate(v):
        for start in range(0, len(u), BLOCK):
            some = slice(start, start + BLOCK)
            real, imag = (
                parts @ wave.reshape(len(wave), -1).T
                for wave in waves((at - y) ** 2, u[some], x, z, k)
            )
            total[:, i, some] = real[:count] - imag[count:] + 1j * (imag[:count] + real[count:])
    return total * k / (2j * np.pi)


def rayleigh_products(fields, y, x, v, u, z, k, tolerance=1e-12):
    """The sum of rayleigh_sum as matrix products: between short intervals the kernel K(d, e) is, to
    `tolerance` of its largest value, K(d, e_J) K(d_I, e_J)^-1 K(d_I, e) with a few displacements
    d_I, e_J, so that it is still summed as it stands.

    Intervals too wide for that are halved. ValueError where random displacements find
    the kernel missed.
    """
    waves = _fast_wave if njit else _wave
    low, high = (
        [f(a) - g(b) for a, b in ((v, y), (u, x))] for f, g in ((np.min, np.max), (np.max, np.min))
    )
    counts = _fineness(low, high, z, k)
    if max(counts) > MOST:
        which = int(np.argmax([np.ptp(a) for a in (y, x, v, u)]))
        parts = [[y, x, v, u], [y, x, v, u]]
        middle = len(parts[0][which]) // 2
        parts[0][which], parts[1][which] = parts[0][which][:middle], parts[1][which][middle:]
        split = np.split(fields, [middle], which + 1) if which < 2 else (fields, fields)
        found = [rayleigh_products(f, *part, z, k, tolerance) for f, part in zip(split, parts)]
        return found[0] + found[1] if which < 2 else np.concatenate(found, axis=which - 1)

    def kernel(d, e):
        return waves(np.add(d * d, e * e), z, k)

    grids = [
        (a + b) / 2 + (b - a) / 2 * np.cos(np.pi * (np.arange(n) + 0.5) / n)
        for a, b, n in zip(low, high, counts)
    ]
    rest, rows, columns = kernel(grids[0][:, None], grids[1]), [], []
    largest = np.abs(rest).max()
    while True:
        i, j = np.unravel_index(np.argmax(np.abs(rest)), rest.shape)
        if np.abs(rest[i, j]) < tolerance * largest or len(rows) == min(rest.shape):
            break
        rows.append(grids[0][i])
        columns.append(grids[1][j])
        rest = rest - np.outer(rest[:, j], rest[i]) / rest[i, j]
    rows, columns = np.array(rows), np.array(columns)
    matrix = kernel(rows[:, None], columns).T
    rng = np.random.default_rng(1)
    d, e = (rng.uniform(a, b, 300) for a, b in zip(low, high))
    found = (np.linalg.solve(matrix, kernel(d, columns[:, None])) * kernel(rows[:, None], e)).sum(
        axis=0
    )
    missed = np.abs(found - kernel(d, e)).max() / largest
    if missed > 1e3 * tolerance:
        raise ValueError(f"{len(rows)} displacements miss the kernel by {missed:.1e}")
    one, other = (
        kernel(v[:, None] - y, columns[:, None, None]),
        kernel(rows[:, None, None], u[:, None] - x),
    )
    sent = (one.reshape(-1, len(y)) @ fields.transpose(1, 0, 2).reshape(len(y), -1)).reshape(
        len(rows), -1
    )
    sent = np.linalg.solve(matrix, sent).reshape(len(rows), -1, len(x))
    total = sum(a @ b.T for a, b in zip(sent, other))
    return total.reshape(len(v), len(fields), len(u)).transpose(1, 0, 2) * (k / (2j * np.pi))


def _sine_cosine(turns):
    """Of 2 pi turns, from the Taylor series of a quarter of the angle: compilers
    make vectors of it.
    """
    t = (turns - np.floor(turns + 0.5)) * (np.pi / 2)
    t2 = t * t
    s = t * (
        1
        - t2
        * (1 / 6)
        * (
            1
            - t2
            * (1 / 20)
            * (
                1
                - t2 * (1 / 42) * (1 - t2 * (1 / 72) * (1 - t2 * (1 / 110) * (1 - t2 * (1 / 156))))
            )
        )
    )
    c = 1 - t2 * (1 / 2) * (
        1
        - t2
        * (1 / 12)
        * (
            1
            - t2
            * (1 / 30)
            * (
                1
                - t2 * (1 / 56) * (1 - t2 * (1 / 90) * (1 - t2 * (1 / 132) * (1 - t2 * (1 / 182))))
            )
        )
    )
    s, c = 2 * s * c, 1 - 2 * s * s
    return 2 * s * c, 1 - 2 * s * s


if njit:
    _sine_cosine = njit(fastmath=True, error_model="numpy", cache=True)(_sine_cosine)


def _wave(q, z, k):
    """z/R^2 (1 + j/(k R)) exp(j k (R - z)), R^2 = z^2 + q: of the shape of q."""
    side = np.sqrt(z * z + q)
    return z / side**2 * (1 + 1j / (k * side)) * np.exp(1j * k * q / (side + z))


def _fast_q(q, z, k):
    """The same in compiled code."""
    real, imag, flat = np.empty(q.size), np.empty(q.size), q.ravel()
    for i in range(q.size):
        side = np.sqrt(z * z + flat[i])
        turns = k / (2 * np.pi) * flat[i] / (side + z)
        s, c = _sine_cosine(turns)
        size = z / (side * side)
        tilt = size / (k * side)
        real[i], imag[i] = size * c - tilt * s, size * s + tilt * c
    out = np.empty(q.shape, np.complex128)
    out.real[:], out.imag[:] = real.reshape(q.shape), imag.reshape(q.shape)
    return out


_fast_wave = njit(fastmath=True, error_model="numpy", cache=True)(_fast_q) if njit else None


def _fineness(low, high, z, k):
    """Points along either axis that resolve what of the kernel does not separate."""
    counts = []
    for axis in (0, 1):
        d = np.linspace(low[axis], high[axis], 65)[:, None]
        e = np.array(
            [
                low[1 - axis],
                high[1 - axis],
                0.0 if low[1 - axis] < 0 < high[1 - axis] else low[1 - axis],
            ]
        )
        slopes = d / np.sqrt(z * z + d * d + e * e)
        phase = k * (high[axis] - low[axis]) / 2 * np.ptp(slopes, axis=1).max()
        counts.append(int(phase + 8 * np.cbrt(phase) + 24))
    return counts


def _waves(dy2, u, x, z, k):
    """Real and imaginary part of z/R^2 (1 + j/(k R)) exp(j k (R - z)), R^2 = z^2 + dy2 + (u -
    x)^2: (len(u), len(dy2), len(x)) each.
    """
    q = dy2[:, None] + (u[:, None, None] - x) ** 2
    side = np.sqrt(z * z + q)
    wave = z / side**2 * (1 + 1j / (k * side)) * np.exp(1j * k * q / (side + z))
    return wave.real, wave.imag


def _fast(dy2, u, x, z, k):
    """The same in compiled code."""
    real, imag = np.empty((len(u), len(dy2), len(x))), np.empty((len(u), len(dy2), len(x)))
    for i in range(len(u)):
        for a in range(len(dy2)):
            for b in range(len(x)):
                q = dy2[a] + (u[i] - x[b]) ** 2
                side = np.sqrt(z * z + q)
                turns = k / (2 * np.pi) * q / (side + z)
                s, c = _sine_cosine(turns)
                size = z / (side * side)
                tilt = size / (k * side)
                real[i, a, b] = size * c - tilt * s
                imag[i, a, b] = size * s + tilt * c
    return real, imag


_fast_waves = njit(fastmath=True, error_model="numpy", cache=True)(_fast) if njit else None
