"""White images of lenslet arrays with known centres, rendered pixel by pixel from the definition.

Every lenslet is one flat disc with a soft edge, or one bell, rigid, at its own true centre; a pixel
is the mean of the light over its area (Gauss-Legendre nodes). Nothing here knows
how grids are found.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class Array:
    """What is photographed. Lengths in px, angles in degrees, brightness relative to a full spot.

    perspective: relative change of the pitch from the middle of the frame to its corner;
    cubic: relative radial displacement at the corner;
    vignetting: loss of light at the corner, of whole lenslets ("lenslet") or of the sensor
        ("sensor", continuous);
    blur: soft edge of a disc, of the pitch;
    dust: number of dark blobs;
    dead: share of dead and hot pixels;
    gains: of the 2x2 mosaic, row by row;
    electrons: of a full spot (shot noise);
    read: noise of a pixel.
    """

    kind: str
    pitch: float
    angle: float = 0.0
    sites: int = 12
    spot: str = "disc"
    radius: float = 0.42
    blur: float = 0.03
    phase: tuple = (0.31, -0.17)
    perspective: float = 0.0
    cubic: float = 0.0
    vignetting: float = 0.0
    falloff: str = "sensor"
    dust: int = 0
    dead: float = 0.0
    gains: tuple = ()
    electrons: float = 20000.0
    read: float = 0.002
    seed: int = 0

    @property
    def shape(self):
        rows, columns = (
            2 * int(np.ceil(n * self.pitch / 2)) for n in (self.sites, 1.15 * self.sites)
        )
        return rows, columns


def lattice_vectors(array):
    """(2, 2): down and right, px; the hexagonal lattice is close-packed, 60
    degrees between them.
    """
    turn = np.radians(array.angle)
    steep = turn + np.radians(60 if array.kind == "hexagonal" else 90)
    return array.pitch * np.array([[np.sin(steep), np.cos(steep)], [np.sin(turn), np.cos(turn)]])


def true_centres(array):
    """Lattice indices (N, 2) and centres (N, 2), px, of all lenslets that touch the frame."""
    shape = np.array(array.shape)
    middle, corner = (shape - 1) / 2, np.hypot(*shape) / 2
    reach = int(1.6 * np.hypot(*shape) / array.pitch) + 2
    index = np.stack(
        np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij"), axis=-1
    ).reshape(-1, 2)
    offset = index @ lattice_vectors(array) + np.array(array.phase) * array.pitch
    near = np.hypot(*offset.T) < 1.4 * corner
    index, offset = index[near], offset[near]
    tilt = array.perspective / corner * np.array([0.6, -0.8])
    offset = offset / (1 + offset @ tilt / 2)[:, None]
    offset = offset * (1 + array.cubic * ((offset / corner) ** 2).sum(axis=1, keepdims=True))
    centres = middle + offset
    seen = ((centres > -array.pitch) & (centres < shape + array.pitch)).all(axis=1)
    return index[seen], centres[seen]


def whole(centres, array):
    """Which centres' circles, half a pitch in radius, lie in the frame, which ends half a pixel
    beyond the outer pixel centres.
    """
    margin = array.pitch / 2 - 0.5
    return ((centres >= margin) & (centres <= np.array(array.shape) - 1 - margin)).all(axis=1)


def render(array):
    """(white, centres): uint16 mosaic, black level 400, full spot 12400 before gains; true
    centres (N, 2) px.
    """
    rng = np.random.default_rng(array.seed)
    centres, shape = true_centres(array)[1], array.shape
    light = np.zeros(shape)
    for centre, level in zip(
        centres,
        _illumination(array, centres) if array.falloff == "lenslet" else np.ones(len(centres)),
    ):
        _add_spot(light, array, centre, level)
    pixels = np.stack(np.indices(shape), axis=-1).astype(float)
    if array.falloff == "sensor":
        light *= _illumination(array, pixels)
    for _ in range(array.dust):
        place, size = rng.uniform(0, shape), array.pitch * rng.uniform(0.08, 0.25)
        light *= 1 - 0.7 * np.exp(-0.5 * (((pixels - place) / size) ** 2).sum(axis=-1))
    if array.gains:
        light *= np.tile(np.reshape(array.gains, (2, 2)), (shape[0] // 2, shape[1] // 2))
    light = rng.poisson(light * array.electrons) / array.electrons + rng.normal(
        0, array.read, shape
    )
    image = np.clip(np.rint(400 + 12000 * light), 0, 16383)
    spoilt = rng.uniform(size=shape) < array.dead
    image[spoilt] = rng.choice([0, 16383], spoilt.sum())
    return image.astype(np.uint16), centres


def _illumination(array, place):
    shape = np.array(array.shape)
    return (
        1
        - array.vignetting
        * ((place - (shape - 1) / 2) ** 2).sum(axis=-1)
        / (np.hypot(*shape) / 2) ** 2
    )


def _add_spot(light, array, centre, level):
    from scipy.special import ndtr

    edge = max(array.blur * array.pitch, 0.35)
    reach = array.radius * array.pitch + 5 * edge if array.spot == "disc" else 1.2 * array.pitch
    low = np.maximum(np.ceil(centre - reach - 0.5).astype(int), 0)
    high = np.minimum(np.floor(centre + reach + 0.5).astype(int) + 1, light.shape)
    if (high <= low).any():
        return
    count = 5 if edge < 1 or array.pitch < 12 else 3 if edge < 3 else 2
    nodes, weights = np.polynomial.legendre.leggauss(count)
    y, x = (
        (np.arange(a, b)[:, None] + nodes / 2).ravel() - c for a, b, c in zip(low, high, centre)
    )
    far = np.hypot(y[:, None], x[None, :])
    value = (
        ndtr((array.radius * array.pitch - far) / edge)
        if array.spot == "disc"
        else np.exp(-0.5 * (far / (0.2 * array.pitch)) ** 2)
    )
    cells = value.reshape(high[0] - low[0], count, high[1] - low[1], count)
    light[low[0] : high[0], low[1] : high[1]] += level * np.einsum(
        "aibj,i,j->ab", cells, weights / 2, weights / 2
    )


def filled(kind, pitch, degrees, gap, lenslets, around=0, falloff=0.0, seed=0):
    """(white, centres): lenslets without borders of their own, whose light fills their cells but
    for dark lines, in a square frame; black level 15, white 3015.

    gap: of the lines, in pitches.
    lenslets: on a side, about.
    around: px of dark sensor on all sides.
    falloff: of the light in the corners.
    """
    turn, size, fine = np.deg2rad(degrees), int(lenslets * pitch), 3
    straight = np.eye(2) if kind == "square" else np.array([(np.sqrt(0.75), 0.5), (0, 1)])
    vectors = pitch * straight @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    index = np.stack(np.meshgrid(*[np.arange(-2 * lenslets, 2 * lenslets + 1)] * 2), axis=-1)
    sites = index.reshape(-1, 2) @ vectors + size / 2 + (0.3, -0.2)
    there = (np.abs(sites - size / 2) < size / 2 - pitch / 2).all(axis=1)
    places = (np.indices((size * fine,) * 2).reshape(2, -1).T + 0.5) / fine - 0.5
    away, near = cKDTree(sites).query(places, 2)
    apart = np.hypot(*(sites[near[:, 0]] - sites[near[:, 1]]).T)
    lit = (away[:, 1] ** 2 - away[:, 0] ** 2) / apart > gap * pitch
    light = (lit & there[near[:, 0]]).reshape(size, fine, size, fine).mean(axis=(1, 3))
    light *= 1 - falloff * np.clip(((np.indices(light.shape) * 2 / size - 1) ** 2).sum(0) / 2, 0, 1)
    image = np.random.default_rng(seed).poisson(3000 * np.pad(light, around) + 15).astype(float)
    return image, sites[there] + around
