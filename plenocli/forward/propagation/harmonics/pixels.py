"""From a polar raster on the sensor to pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.propagation.fresnel.array_to_sensor import sensor_nodes
from plenocli.forward.propagation.harmonics.interpolation import tap_weights

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.propagation.harmonics.sizing import HarmonicBand


def pixel_operator(geometry: Geometry, band: HarmonicBand, real: np.dtype) -> csr_matrix:
    """What integrates over pixels what is known on the polar raster.

    real: precision.

    Returns a sparse matrix (pixel, radius x angle), m^2.
    """
    from scipy.sparse import vstack

    g, (rows, columns) = geometry, geometry.pixel_shape
    mirrored = tuple(g.window_shift(axis) == 0 for axis in (0, 1))
    few = [(n + 1) // 2 if m else n for n, m in zip(g.pixel_shape, mirrored)]
    y, x = (sensor_nodes(g, axis, band.pixel_nodes, 0.0, band.pixel_rule) for axis in (0, 1))
    at = [a[0][:, :n].T for a, n in zip((y, x), few)]
    # pixels at the border of overlapping windows are narrower
    down, across = (a[1][:, :n].T for a, n in zip((y, x), few))
    weights = down[:, None, :, None] * across[:, None, :]
    lines = [_line(band, at[0][i], at[1], weights[i], real) for i in range(few[0])]
    quadrant = vstack(lines, format="csr")
    parts, order = [], []
    for flip_y in (False, True)[: 1 + mirrored[0]]:
        for flip_x in (False, True)[: 1 + mirrored[1]]:
            i, j = np.indices(few)
            i, j = (rows - 1 - i if flip_y else i), (columns - 1 - j if flip_x else j)
            parts.append(_mirrored(quadrant, band.angles, flip_y, flip_x))
            order.append((i * columns + j).ravel())
    # the middle line of an odd number mirrors itself
    _, first = np.unique(np.concatenate(order), return_index=True)
    return vstack(parts, format="csr")[first]


def _line(
    band: HarmonicBand, y: np.ndarray, x: np.ndarray, weight: np.ndarray, real: np.dtype
) -> csr_matrix:
    """The operator of a row of pixels.

    y: (node,), x: (pixel, node) m;
    weight: (pixel, row node, column node) m^2.
    """
    from scipy.sparse import csr_matrix

    shape = len(x), len(y), x.shape[1]
    down, across = np.broadcast_to(y[:, None], shape), np.broadcast_to(x[:, None], shape)
    radius = np.hypot(down, across).reshape(len(x), -1) / band.step - 0.5
    angle = np.arctan2(down, across).reshape(len(x), -1) * band.angles / (2 * np.pi)
    inner, before = np.floor(radius).astype(int), np.floor(angle).astype(int)
    along = tap_weights((radius - inner).ravel(), band.taps, band.finer)
    around = tap_weights((angle - before).ravel(), band.taps, band.finer)
    value = along[:, :, None] * around[:, None, :]
    value *= weight.reshape(-1, 1, 1)
    # sums over a pixel's nodes: on a patch of the raster about it, as wide as the widest
    turned = (before - before[:, :1] + band.angles // 2) % band.angles - band.angles // 2
    low, left = inner.min(axis=1, keepdims=True), turned.min(axis=1, keepdims=True)
    tall, wide = np.ptp(inner, axis=1).max() + band.taps, np.ptp(turned, axis=1).max() + band.taps
    tap = np.arange(band.taps)
    rows, columns = (inner - low)[..., None] + tap, (turned - left)[..., None] + tap
    index = (np.arange(len(x))[:, None, None] * tall + rows)[..., None] * wide
    index = index + columns[..., None, :]
    patch = np.bincount(index.ravel(), value.ravel(), len(x) * tall * wide)
    patch = patch.reshape(len(x), tall, wide)
    pixel, i, j = np.nonzero(patch)
    first = band.taps // 2 - 1
    raster_i = i + low[pixel, 0] - first
    raster_j = j + (left + before[:, :1])[pixel, 0] - first
    # beyond the centre the radius goes on on the other side
    beyond = raster_i < 0
    raster_i = np.where(beyond, -1 - raster_i, raster_i)
    raster_j = (raster_j + beyond * (band.angles // 2)) % band.angles
    ends = np.concatenate([[0], np.cumsum(np.bincount(pixel, minlength=len(x)))])
    return csr_matrix(
        (patch[pixel, i, j].astype(real), raster_i * band.angles + raster_j, ends),
        (len(x), band.radii * band.angles),
    )


def _mirrored(operator: csr_matrix, angles: int, flip_y: bool, flip_x: bool) -> csr_matrix:
    from scipy.sparse import csr_matrix

    radius, angle = np.divmod(operator.indices, angles)
    angle = -angle if flip_y else angle
    angle = angles // 2 - angle if flip_x else angle
    indices = (radius * angles + angle % angles).astype(operator.indices.dtype)
    return csr_matrix((operator.data, indices, operator.indptr), operator.shape)
