"""From the array to the pixels: what one axis of a square lenslet does to a field.

Behind square lenslets the field is separable although the pupil is not: U = K E K^T. A lenslet's
field is taken apart into Legendre polynomials, whose light at any place of the sensor is a
spherical Bessel function, exactly: nodes resolve the field that arrives, whatever pattern it makes
and however far it goes. docs/model.md, "Volumes".
"""

from __future__ import annotations

import math

import numpy as np

from plenocli.forward.camera.quadrature import gauss
from plenocli.forward.volume.optics import VolumeOptics

LEAST_MODE = 2e-5
"""Size of the smallest mode of a lenslet's field that is followed, over that of the largest."""
FADE_TERMS = 10
"""More terms of a field that fades over its lenslet."""


def terms_for(optics: VolumeOptics, error: float) -> int:
    """Legendre polynomials over a lenslet that hold every arriving field to `error`."""
    half = optics.open_width / 2
    # a shifted voxel's field is as steep as any: the pupil's edge, and what the lenslet adds to it
    steep = optics.k * half * optics.aperture / optics.magnification
    left = abs(1 / optics.sensor_distance + 1 / optics.pupil_distance - 1 / optics.focal_length)
    turns = steep + optics.k * half**2 * left
    return math.ceil(turns + 2.2 * max(turns, 1.0) ** (1 / 3) * math.log10(1 / error) ** (2 / 3))


def sampling(optics: VolumeOptics, terms: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes over a lenslet, m from its middle; the matrix (mode, node) that takes the field there
    into modes of unit light; and these in Legendre terms (term, mode).

    Modes are what fields of the aperture make over a lenslet, those beyond LEAST_MODE: in focus the
    prolate functions, two thirds as many as terms.
    """
    nodes, weights = gauss(terms)
    half = optics.open_width / 2
    left = 1 / optics.sensor_distance + 1 / optics.pupil_distance - 1 / optics.focal_length
    lens = np.exp(0.5j * optics.k * left * (half * nodes) ** 2)
    norm = np.sqrt(half / (np.arange(terms) + 0.5))
    # to terms of unit light
    onto = np.polynomial.legendre.legvander(nodes, terms - 1).T / norm[:, None]
    onto = half * onto * (weights * lens)
    slopes = gauss(2 * terms)[0] * optics.k * half * optics.aperture / optics.magnification
    basis, size, _ = np.linalg.svd(onto @ np.exp(1j * np.outer(nodes, slopes)))
    basis = basis[:, : np.count_nonzero(size > LEAST_MODE * size[0])]
    return half * nodes, basis.conj().T @ onto, basis / norm[:, None]


def to_pixels(
    optics: VolumeOptics, basis: np.ndarray, axis: int, neighbours: int, count: int
) -> np.ndarray:
    """What modes over the lenslets q = p + j make at the nodes of superpixel p's pixels.

    basis: (term, mode) from `sampling`.
    neighbours: j runs from -neighbours to neighbours.
    count: of nodes a pixel.

    Returns (pixel * node, j * mode) complex.
    """
    from scipy.special import spherical_jn

    t = optics.pixel_nodes(count, axis)[0].ravel()
    half, d = optics.open_width / 2, optics.sensor_distance
    terms = len(basis)
    faded = _fade(terms)
    parts = []
    for j in range(-neighbours, neighbours + 1):
        degree = np.arange(terms if abs(j) < neighbours else len(faded))
        from_middle = t - j * optics.pitch * optics.widening
        turns = optics.k * half / d * from_middle
        # j_n(-x) = (-1)^n j_n(x): scipy's is for x > 0
        bessel = spherical_jn(degree, np.abs(turns)[:, None])
        bessel = bessel * np.where(turns < 0, -1.0, 1.0)[:, None] ** degree
        path = j**2 * optics.pitch**2 * optics.widening / (2 * d) - t * j * optics.pitch / d
        part = np.exp(1j * optics.k * path)[:, None] * 2 * half * (-1j) ** degree * bessel
        if abs(j) == neighbours:
            # mirrored for the other side: P_n(-v) = (-1)^n P_n(v)
            turn = np.sign(j) ** (np.add.outer(np.arange(len(faded)), np.arange(terms)) % 2)
            part = part @ (faded * turn)
        parts.append(part @ basis)
    return np.concatenate(parts, axis=1) / math.sqrt(optics.wavelength * d)


def _fade(terms: int) -> np.ndarray:
    """What a fading from 1 at a lenslet's left edge to 0 at its right makes of Legendre terms:
    (term after, term before).

    The field of lenslets side by side has no step where they touch; cutting it off at the last one
    that is followed would make one, whose light is wider spread than that of all steps in slope.
    """
    v, w = gauss(2 * terms + FADE_TERMS)
    basis = np.polynomial.legendre.legvander(v, terms + FADE_TERMS - 1)
    fading = np.cos(np.pi / 4 * (v + 1)) ** 2
    degrees = np.arange(terms + FADE_TERMS) + 0.5
    return degrees[:, None] * (basis.T * (w * fading)) @ basis[:, :terms]
