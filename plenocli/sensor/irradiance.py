"""Light from a whole scene onto a whole sensor through one response that serves every lenslet."""

import numpy as np

from plenocli.operators import BlockToeplitz


def superpixel_light(columns, offsets, scene, chunk):
    """Carry a scene to the sensor: (light (lenslet_row, lenslet_column, pixel), white (pixel,)), float64.

    columns: function of a slice of object points -> blocks A_o (lenslet offset, pixel, point in the slice), so that a
    fine response streams through memory.  offsets (lenslet offset, 2).  scene (lenslet_row, lenslet_column, point)
    reflectance; beyond the array the object is dark.  white is the superpixel of a uniform white object that goes on
    beyond the array: a lenslet's own light and all of its neighbours'.
    Object points add incoherently, each for 1/point of the white object's area (docs/model.md, "The system matrix").
    """
    count, points = scene.shape[:2], scene.shape[2]
    light, white = 0.0, 0.0
    for start in range(0, points, chunk):
        part = slice(start, min(start + chunk, points))
        blocks = columns(part)
        light = light + BlockToeplitz(blocks, offsets, count).forward(scene[:, :, part])
        white = white + blocks.sum(axis=(0, 2), dtype=np.float64)
    return light.astype(np.float64), white


def to_points(picture, samples):
    """(R r, C c) object grid -> (R, C, r c) points by lenslet, row by row; samples = (r, c)."""
    (r, c), (rows, columns) = samples, picture.shape
    return picture.reshape(rows // r, r, columns // c, c).swapaxes(1, 2).reshape(rows // r, columns // c, r * c)


def to_mosaic(superpixels, shape):
    """(R, C, h w) superpixels -> (R h, C w) sensor; shape = (h, w). Undone by to_points."""
    (h, w), (rows, columns) = shape, superpixels.shape[:2]
    return superpixels.reshape(rows, columns, h, w).swapaxes(1, 2).reshape(rows * h, columns * w)
