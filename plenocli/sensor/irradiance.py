"""Light from a whole scene onto a whole sensor through one response that serves every lenslet."""

import numpy as np

from plenocli.operators import BlockToeplitz


def superpixel_light(blocks, offsets, scene):
    """Carry a scene to the sensor: (light (lenslet_row, lenslet_column, pixel), white (pixel,)), float64.

    blocks: pairs (object points, A_o (lenslet offset, pixel, point)) that cover every point once, so that a fine response
    streams through memory.  offsets (lenslet offset, 2).  scene (lenslet_row, lenslet_column, point): reflectance; beyond
    the array the object is dark.  None: no scene, and no light.  white is the superpixel of a uniform white object that
    goes on beyond the array: a lenslet's own light and all of its neighbours'.
    Object points add incoherently (docs/model.md, "The system matrix").
    """
    light, white = 0.0, 0.0
    for points, block in blocks:
        if scene is not None:
            light = light + BlockToeplitz(block, offsets, scene.shape[:2]).forward(scene[:, :, points]).astype(np.float64)
        white = white + block.sum(axis=(0, 2), dtype=np.float64)
    return light, white


def to_points(picture, samples):
    """(R r, C c) object grid -> (R, C, r c) points by lenslet, row by row; samples = (r, c)."""
    (r, c), (rows, columns) = samples, picture.shape
    return picture.reshape(rows // r, r, columns // c, c).swapaxes(1, 2).reshape(rows // r, columns // c, r * c)


def to_mosaic(superpixels, shape):
    """(R, C, h w) superpixels -> (R h, C w) sensor; shape = (h, w). Undone by to_points."""
    (h, w), (rows, columns) = shape, superpixels.shape[:2]
    return superpixels.reshape(rows, columns, h, w).swapaxes(1, 2).reshape(rows * h, columns * w)
