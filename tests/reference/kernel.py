"""Coherent kernel of two thin lenses along one axis, by dense quadrature, with every quadratic
phase and constant.

It knows nothing of pupils, arrays or directions: light may run through it either way. Square
apertures make the whole system a product of two such kernels.
"""

import numpy as np
from scipy.special import roots_legendre


def coherent_kernel(start, end, wavelength, distances, lenses, nodes):
    """Field at `end` (m) of a unit line source at each of `start` (m): complex (end, start).

    distances: the three hops (m);
    lenses: for each of the two planes a list of (centre, width, focal length) in metres of the
        openings side by side, opaque between;
    nodes: quadrature nodes in an opening of each plane.
    """
    k = 2 * np.pi / wavelength
    places, field = np.asarray(start), None
    for distance, openings, count in zip(distances, lenses, nodes):
        t, w = roots_legendre(count)
        x = np.concatenate([centre + width / 2 * t for centre, width, _ in openings])
        passed = np.concatenate(
            [
                width / 2 * w * np.exp(-1j * k / (2 * f) * (width / 2 * t) ** 2)
                for _, width, f in openings
            ]
        )
        hop = passed[:, None] * fresnel(x, places, wavelength, distance)
        field, places = hop if field is None else hop @ field, x
    return fresnel(np.asarray(end), places, wavelength, distances[2]) @ field


def fresnel(to, start, wavelength, distance):
    """Fresnel's kernel of free space along one axis: (to, start)."""
    return np.exp(1j * np.pi / (wavelength * distance) * (to[:, None] - start) ** 2) / np.sqrt(
        1j * wavelength * distance
    )
