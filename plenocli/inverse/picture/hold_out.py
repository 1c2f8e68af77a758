"""A judgement of a matrix on a capture whose truth nobody knows: pixels are left out and predicted
from all others.

What a lenslet shows is finer than its pixels by far, so that single pixels are told as well by
those next to them, with no model at all; patches of pixels are not. Beside the model stand what
goes without one: the pixels around, interpolated as they are recorded and after white has been
divided out, and the block mean of the lenslet times white.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from plenocli.base.text import Record
from plenocli.base.tiling import to_blocks, to_plane
from plenocli.inverse.picture.estimators import root_mean_square
from plenocli.inverse.picture.lenslet_model import LensletMatrix

PATCHES = (1, 2, 4)
"""Sides of what is left out, pixels of the matrix."""
STRUCTURED = 5.0
"""Times the noise that block means leave over, from which on a lenslet shows something."""

Predict = Callable[[np.ndarray], np.ndarray]
"""(weight (lenslet_row, lenslet_column, pixel), 0 at what is left out) -> superpixels A x."""


@dataclass(frozen=True, kw_only=True)
class HeldOut(Record):
    """Root mean square errors of predictions of pixels that were left out, in shares of the
    brightest pixel of white; the noise of these pixels is in all of them.

    patch: pixels on a side of what was left out.
    pixels: how many were.
    structured: whether of lenslets only that show something, or of all.
    noise: that the pixels are expected to have.
    model: of the matrix.
    both: of the matrix, and of what it leaves over at the pixels around, interpolated.
    neighbours: of the pixels around, interpolated with the least bending.
    neighbours_over_white: the same after white has been divided out.
    block_mean: of one brightness for each lenslet.
    """

    patch: int
    pixels: int
    structured: bool
    noise: float
    model: float
    both: float
    neighbours: float
    neighbours_over_white: float
    block_mean: float

    @property
    def sentence(self) -> str:
        """For a person."""
        which = "lenslets that show something" if self.structured else "all lenslets"
        return (
            f"patches of {self.patch} x {self.patch} pixels left out of {which}, predicted within "
            f"{self.model:.2%} of white (noise {self.noise:.2%}), by the pixels around over white "
            f"{self.neighbours_over_white:.2%}"
        )


def judge(
    system: LensletMatrix,
    y: np.ndarray,
    weight: np.ndarray,
    predict: Predict,
    share: float,
    rng: np.random.Generator,
    patches: tuple[int, ...],
) -> tuple[HeldOut, ...]:
    """Leave pixels out and predict them.

    system: the matrix.
    y: (lenslet_row, lenslet_column, pixel) in units of A x.
    weight: like y, one over a pixel's variance, 0 for a pixel that counts for nothing.
    predict: by the matrix.
    share: of the pixels that are left out.
    rng: which of them.
    patches: sides of what is left out, pixels.

    Returns two a patch, of all lenslets that have their neighbours and of those that show
    something; nothing where there are none.
    docs/model.md, "Real light".
    """
    even = system.blocks.sum(axis=(0, 2), dtype=float)
    inner = np.zeros(y.shape[:2], bool)
    inner[1:-1, 1:-1] = True
    inner &= (weight > 0).mean(axis=2) > 0.5
    rest = np.where(weight > 0, y - _block_mean(y, weight, even), 0)
    counted = np.maximum((weight > 0).sum(axis=2), 1)
    structured = inner & (np.sum(weight * rest**2, axis=2) > STRUCTURED**2 * counted)
    found = []
    for patch in patches:
        out = _left_out(system.pixel_shape, y.shape[:2], patch, share, rng) & (weight > 0)
        left = np.where(out, 0, weight)
        model = predict(left)
        made = (
            model,
            model + interpolated((y - model) / even, left, system.pixel_shape) * even,
            interpolated(y, left, system.pixel_shape),
            interpolated(y / even, left, system.pixel_shape) * even,
            _block_mean(y, left, even),
        )
        for which in (inner, structured):
            at = out & which[..., None]
            if at.any():
                errors = [root_mean_square((one - y)[at]) / even.max() for one in made]
                found.append(
                    HeldOut(
                        patch=patch,
                        pixels=int(np.count_nonzero(at)),
                        structured=which is structured,
                        noise=root_mean_square(1 / np.sqrt(weight[at])) / float(even.max()),
                        model=errors[0],
                        both=errors[1],
                        neighbours=errors[2],
                        neighbours_over_white=errors[3],
                        block_mean=errors[4],
                    )
                )
    return tuple(found)


def interpolated(y: np.ndarray, weight: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Superpixels whose missing pixels bend as little as possible: the biharmonic equation on the
    sensor as the superpixels tile it.

    y: (lenslet_row, lenslet_column, pixel).
    weight: like y, 0 where a pixel is missing.
    shape: (rows, columns) of a superpixel, px.
    """
    from scipy.sparse import diags_array, eye_array, kron
    from scipy.sparse.linalg import spsolve

    plane = to_plane(np.where(weight > 0, y, 0.0), shape)
    lost = to_plane(weight, shape).ravel() <= 0
    second = [diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(n, n)) for n in plane.shape]
    bending = kron(second[0], eye_array(plane.shape[1])) + kron(
        eye_array(plane.shape[0]), second[1]
    )
    energy = (bending.T @ bending).tocsr()[lost]
    values = plane.ravel()
    if lost.any():
        values[lost] = spsolve(energy[:, lost].tocsc(), -(energy[:, ~lost] @ values[~lost]))
    return to_blocks(values.reshape(plane.shape), shape)


def _left_out(
    shape: tuple[int, int],
    count: tuple[int, ...],
    patch: int,
    share: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """(lenslet_row, lenslet_column, pixel), patches of superpixels of `shape`."""
    cells = rng.random((*count, -(-shape[0] // patch), -(-shape[1] // patch))) < share
    out = cells.repeat(patch, axis=2).repeat(patch, axis=3)[:, :, : shape[0], : shape[1]]
    return out.reshape(*count, -1)


def _block_mean(y: np.ndarray, weight: np.ndarray, even: np.ndarray) -> np.ndarray:
    """Even superpixels of the brightness that lenslets have over white."""
    known = weight > 0
    total = np.where(known, y, 0).sum(axis=2)
    white = np.where(known, even, 0).sum(axis=2)
    return np.divide(total, white, out=np.zeros_like(total), where=white > 0)[..., None] * even
