"""Slow, explicit oracle of the system matrix: two Fresnel integrals by dense quadrature, every lens
and kernel phase written out.

It shares no code with plenocli.forward: no shift invariance, no local coordinates. Positions are
(y, x) in metres from the optical axis.
"""

import numpy as np
from scipy.special import roots_legendre


def disc_nodes(radius, radial, angular, inner=0.0):
    """Polar quadrature of an annulus: y, x, weight (nodes,)."""
    t, w = roots_legendre(radial)
    r = inner + (radius - inner) * (t + 1) / 2
    phi = (np.arange(angular) + 0.5) * 2 * np.pi / angular
    weight = np.repeat((radius - inner) / 2 * w * r, angular) * 2 * np.pi / angular
    return np.outer(r, np.sin(phi)).ravel(), np.outer(r, np.cos(phi)).ravel(), weight


def rectangle_nodes(y0, y1, x0, x1, count):
    """Tensor Gauss-Legendre quadrature of a rectangle: y, x, weight (nodes,)."""
    t, w = roots_legendre(count)
    y, x = y0 + (y1 - y0) * (t + 1) / 2, x0 + (x1 - x0) * (t + 1) / 2
    weight = np.outer(w, w).ravel() * (y1 - y0) * (x1 - x0) / 4
    return np.repeat(y, count), np.tile(x, count), weight


def hexagon_nodes(width, count):
    """Quadrature of a hexagon of `width` across its flat sides, two of which face +-x, by six
    triangles: y, x, weight (nodes,).
    """
    t, w = roots_legendre(count)
    a, wa = (t + 1) / 2, w / 2
    corners = (
        width
        / np.sqrt(3)
        * np.array([(np.cos(i * np.pi / 3), np.sin(i * np.pi / 3)) for i in range(7)])
    )
    y, x, weight = [], [], []
    for (y0, x0), (y1, x1) in zip(corners, corners[1:]):
        # p = r ((1 - s) corner0 + s corner1), 0 <= r, s <= 1
        r, s = np.repeat(a, count), np.tile(a, count)
        y.append(r * ((1 - s) * y0 + s * y1))
        x.append(r * ((1 - s) * x0 + s * x1))
        weight.append(abs(y0 * x1 - y1 * x0) * r * np.repeat(wa, count) * np.tile(wa, count))
    return np.concatenate(y), np.concatenate(x), np.concatenate(weight)


def lenslet_centre(camera, row, column):
    """Where lenslet (row, column) stands (m): axial numbers on a hexagonal lattice, whose rows
    are sqrt(3)/2 pitches apart.
    """
    pitch = camera.lenslet_array.pitch
    if camera.lenslet_array.lattice == "hexagonal":
        return row * pitch * np.sqrt(0.75), (column + 0.5 * row) * pitch
    return row * pitch, column * pitch


def sensor_nodes(centre, shape, pitch, active, count):
    """Gauss-Legendre points of each pixel around `centre`: per axis positions (pixels x
    count) and weights.
    """
    t, w = roots_legendre(count)
    axes = []
    for c, n in zip(centre, shape):
        pixels = c + (np.arange(n) - (n - 1) / 2) * pitch
        axes.append(((pixels[:, None] + active / 2 * t).ravel(), np.tile(active / 2 * w, n)))
    return axes


def pixel_energies(
    camera,
    wavelength,
    image_point,
    lenslets,
    centre,
    *,
    f1=None,
    f2=None,
    pupil=None,
    amplitude=None,
    area=None,
    pupil_nodes=(40, 96),
    lenslet_nodes=44,
    pixel_nodes=6,
):
    """Energy in each pixel of a superpixel at `centre` (m, on the sensor): (rows, columns).

    image_point (m, on the array) is where the point's chief ray lands;
    lenslets: list of (row, column) whose fields add;
    pupil: (y, x, weight) of the open aperture, default the camera's disc or square;
    amplitude: function of (y, x), complex;
    area: of the aperture (m^2) whose light counts as 1, default that of the disc,
        annulus or square.
    """
    k = 2 * np.pi / wavelength
    z1, z2, z3 = camera.object.distance, camera.lenslet_array.distance, camera.sensor.distance
    f1, f2 = f1 or camera.main_lens.focal_length, f2 or camera.lenslet_array.focal_length
    D1, D2 = camera.main_lens.aperture_diameter, camera.lenslet_array.pitch
    round_pupil = camera.main_lens.aperture_shape != "square"
    if pupil is None:
        pupil = (
            disc_nodes(D1 / 2, *pupil_nodes)
            if round_pupil
            else rectangle_nodes(-D1 / 2, D1 / 2, -D1 / 2, D1 / 2, pupil_nodes[1])
        )
    py, px, pw = pupil
    if area is None:
        area = np.pi * D1**2 / 4 * (1 - camera.main_lens.obscuration**2) if round_pupil else D1**2
    # the object point, inverted by the main lens; its spherical wave has unit
    # modulus over the pupil
    oy, ox = (-z1 / z2 * c for c in image_point)
    field = (
        np.exp(1j * k / (2 * z1) * ((py - oy) ** 2 + (px - ox) ** 2))
        * np.exp(-1j * k / (2 * f1) * (py**2 + px**2))
        * pw
        / np.sqrt(area)
    )
    if amplitude is not None:
        field = field * amplitude(py, px)
    (ty, wy), (tx, wx) = sensor_nodes(
        centre,
        camera.sensor.pixels_per_lenslet,
        camera.sensor.pixel_pitch,
        camera.sensor.pixel_pitch * np.sqrt(camera.sensor.pixel_fill_factor),
        pixel_nodes,
    )
    total = np.zeros((len(ty), len(tx)), complex)
    width = D2 * camera.lenslet_array.fill_factor
    for row, column in lenslets:
        cy, cx = lenslet_centre(camera, row, column)
        if camera.lenslet_array.aperture_shape != "square":
            hexagon = camera.lenslet_array.aperture_shape == "hexagon"
            uy, ux, uw = (
                hexagon_nodes(width, lenslet_nodes)
                if hexagon
                else disc_nodes(width / 2, lenslet_nodes, 2 * lenslet_nodes)
            )
            at_array = _hop(uy + cy, py, k / z2) * _hop(ux + cx, px, k / z2) @ field
            at_array *= np.exp(-1j * k / (2 * f2) * (uy**2 + ux**2)) * uw
            total += (_hop(ty, uy + cy, k / z3) * at_array) @ _hop(tx, ux + cx, k / z3).T
        else:
            t, w = roots_legendre(lenslet_nodes)
            u, uw = width / 2 * t, width / 2 * w * np.exp(-1j * k / (2 * f2) * (width / 2 * t) ** 2)
            at_array = np.outer(uw, uw) * (
                (_hop(u + cy, py, k / z2) * field) @ _hop(u + cx, px, k / z2).T
            )
            total += _hop(ty, u + cy, k / z3) @ at_array @ _hop(tx, u + cx, k / z3).T
    total /= wavelength * z2 * wavelength * z3
    energy = np.abs(total) ** 2 * np.outer(wy, wx)
    rows, columns = camera.sensor.pixels_per_lenslet
    return energy.reshape(rows, pixel_nodes, columns, pixel_nodes).sum(axis=(1, 3))


def _hop(to, start, rate):
    """One axis of the Fresnel kernel, exp(j k (to - start)^2/(2 z)) with
    rate = k/z: (to, start).
    """
    return np.exp(0.5j * rate * (to[:, None] - start) ** 2)
