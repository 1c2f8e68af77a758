"""Brute force for volumes: a point's field by a double integral over the pupil, every lenslet's
light at every place of the sensor by Fresnel's integral, nothing separated but what products are.
"""

import numpy as np
from numpy.polynomial.legendre import leggauss


def field(x, y, depth, *, wavelength, aperture, index, phase=None, rows=160):
    """Field at places (y, x; m, on the object's side) of a point on the axis at `depth`.

    phase: (sy, sx) -> m of path, or None.
    """
    k = 2 * np.pi / wavelength
    t, w = leggauss(rows)
    total, light = np.zeros((len(y), len(x)), complex), 0.0
    for sy, wy in zip(aperture * t, aperture * w):
        chord = np.sqrt(aperture**2 - sy**2)
        sx, wx = chord * t, chord * w
        cos = np.sqrt(1 - (sx**2 + sy**2) / index**2)
        amplitude = cos**-0.5
        path = index * depth * (cos - 1)
        if phase is not None:
            path = path + phase(sy, sx)
        light += wy * np.sum(wx * amplitude**2)
        row = np.exp(1j * k * np.outer(x, sx)) @ (wx * amplitude * np.exp(1j * k * path))
        total += wy * np.exp(1j * k * sy * y)[:, None] * row
    return total / wavelength / np.sqrt(light)


def column(
    place, depth, *, camera, lenslets, reach, lenslet_nodes, pixel_nodes, phase=None, rows=160
):
    """Light of a point on all pixels (superpixel row, pixel row, superpixel column, pixel column).

    place: (y, x) of the point, m.
    camera: dict of wavelength, aperture, index, magnification, pitch, focal_length,
        sensor_distance, pixels.
    lenslets, reach: on each side whose light counts, and whose pixels are looked at.
    """
    pitch, f, d = (camera[n] for n in ("pitch", "focal_length", "sensor_distance"))
    k, pixels, m = 2 * np.pi / camera["wavelength"], camera["pixels"], camera["magnification"]
    t, w = leggauss(lenslet_nodes)
    inner = t * pitch / 2
    middles = np.arange(-lenslets, lenslets + 1) * pitch
    nodes = (middles[:, None] + inner).ravel()
    weights = np.tile(w * pitch / 2, len(middles))
    lens = np.tile(np.exp(-0.5j * k * inner**2 / f), len(middles))
    g, wg = leggauss(pixel_nodes)
    size = pitch / pixels
    centres = (np.arange((2 * reach + 1) * pixels) - ((2 * reach + 1) * pixels - 1) / 2) * size
    sensor = (centres[:, None] + g * size / 2).ravel()
    to_sensor = np.exp(0.5j * k * (sensor[:, None] - nodes) ** 2 / d) * (weights * lens)
    to_sensor /= np.sqrt(camera["wavelength"] * d)
    arriving = field(
        nodes / m - place[1],
        nodes / m - place[0],
        depth,
        wavelength=camera["wavelength"],
        aperture=camera["aperture"],
        index=camera["index"],
        phase=phase,
        rows=rows,
    )
    light = np.abs(to_sensor @ (arriving / m) @ to_sensor.T) ** 2
    n = len(centres)
    parts = light.reshape(n, pixel_nodes, n, pixel_nodes)
    whole = np.einsum("aibj,i,j->ab", parts, wg * size / 2, wg * size / 2)
    return whole.reshape(2 * reach + 1, pixels, 2 * reach + 1, pixels)


def shaped_column(place, depth, *, optics, lenslets, step, superpixels, pixel_nodes=5, rows=110):
    """Light of a point on the pixels of some superpixels, (superpixel, pixel row, pixel column), by
    a fine grid over the array on which every place belongs to the lenslet next to it.

    place: (y, x) of the point, m; the middle of a cell is at 0.
    optics: with lattice, opening, open_width as in VolumeOptics.
    lenslets: on each side; step: of the grid, m, on the array.
    superpixels: (superpixel, 2) row and column of each one's middle, pitches.
    """
    k, pitch, d = 2 * np.pi / optics.wavelength, optics.pitch, optics.sensor_distance
    hexagonal = optics.lattice == "hexagonal"
    high = np.sqrt(0.75) if hexagonal else 1.0
    first = (-high / 2, -0.25) if hexagonal else (0.0, 0.0)
    count = round((2 * lenslets + 1) * pitch / step)
    g = (np.arange(count) - (count - 1) / 2) * step
    y, x = np.meshgrid(g / pitch, g / pitch, indexing="ij")
    nearest, v = np.full(y.shape, np.inf), [np.zeros_like(y), np.zeros_like(x)]
    for near in (-1, 0, 1):
        row = np.rint((y - first[0]) / high) + near
        aside = first[1] + (row % 2) / 2 * hexagonal
        from_it = y - row * high - first[0], x - np.rint(x - aside) - aside
        nearer = np.hypot(*from_it) < nearest
        nearest[nearer] = np.hypot(*from_it)[nearer]
        for one, part in zip(v, from_it):
            one[nearer] = part[nearer] * pitch
    out = {
        "circle": np.hypot(*v),
        "hexagon": np.max([np.abs(v[1] * c + v[0] * s) for c, s in _FLAT_SIDES], axis=0),
    }[optics.opening]
    open_ = np.clip((optics.open_width / 2 - out) / step + 0.5, 0, 1)
    if optics.open_width == pitch and optics.opening == "hexagon":
        open_[:] = 1
    arriving = field(
        g / optics.magnification - place[1],
        g / optics.magnification - place[0],
        depth,
        wavelength=optics.wavelength,
        aperture=optics.aperture,
        index=optics.index,
        rows=rows,
    )
    lens = np.exp(-0.5j * k * (v[0] ** 2 + v[1] ** 2) / optics.focal_length)
    through = arriving / optics.magnification * open_ * lens
    t, w = leggauss(pixel_nodes)
    found = []
    for middle in superpixels:
        to_sensor = []
        for axis, size in enumerate((high * pitch, pitch)):
            n = optics.pixels[axis]
            centres = middle[axis] * pitch + (np.arange(n) - (n - 1) / 2) * size / n
            sensor = (centres[:, None] + t * size / n / 2).ravel()
            kernel = np.exp(0.5j * k * (sensor[:, None] - g) ** 2 / d) * step
            roots = np.tile(np.sqrt(w * size / n / 2), n)
            to_sensor.append(roots[:, None] * kernel / np.sqrt(optics.wavelength * d))
        light = np.abs(to_sensor[0] @ through @ to_sensor[1].T) ** 2
        shape = (optics.pixels[0], pixel_nodes, optics.pixels[1], pixel_nodes)
        found.append(light.reshape(shape).sum((1, 3)))
    return np.array(found)


_FLAT_SIDES = [(1.0, 0.0), (0.5, np.sqrt(0.75)), (0.5, -np.sqrt(0.75))]
