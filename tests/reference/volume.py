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
