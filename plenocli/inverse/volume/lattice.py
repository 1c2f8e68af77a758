"""What a lattice of lenslets is to the finer lattice of points: each of its frequencies mixes as
many frequencies of the finer one as a lenslet has points. Between points a specimen is smooth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plenocli.base.device import CPU, Device
from plenocli.base.linear_maps import BlockCirculant, torus_for
from plenocli.forward.volume.plan import BOX
from plenocli.forward.volume.stack import Stack
from plenocli.inverse.volume.measurement import Voxels

WITHIN = 1 / 24
"""x less its mean over a voxel, per second difference of the means."""
ACROSS = WITHIN + (1 - 1 / BOX**2) / 24
"""The same along rows and columns, where a kernel is already the mean over BOX points."""
EVEN = 0.01
"""Difference of the planes' spacings, relative, up to which they are even."""


@dataclass(frozen=True, kw_only=True)
class Lattice:
    """The frequencies of a torus of lenslets, those of rfft2 row by row.

    mixing: (frequency, point, fine frequency) unitary: x_k = mixing X, with X the fine lattice's
        Fourier coefficients.
    lateral: (frequency, fine frequency) magnitude, cycles a metre.
    turns: (frequency, fine frequency, 2) cycles a point, along rows and columns.
    times: (frequency,) how often each stands in the whole transform: once or twice.
    """

    mixing: np.ndarray
    lateral: np.ndarray
    turns: np.ndarray
    times: np.ndarray

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Mean over the frequencies of the whole transform, (frequency, ...) -> (...)."""
        weight = self.times.reshape(-1, *[1] * (values.ndim - 1))
        return (weight * values).sum(axis=0) / self.times.sum()


def lattice_of(torus: tuple[int, int], voxels: Voxels) -> Lattice:
    """The frequencies of a torus of (rows, columns) lenslets."""
    half = torus[1] // 2 + 1
    (row_mix, row_turns), (column_mix, column_turns) = (
        _axis(size, points, kept)
        for size, points, kept in zip(torus, voxels.point_shape, (torus[0], half))
    )
    mixing = np.einsum("kia,ljb->klijab", row_mix, column_mix)
    points = voxels.point_shape[0] * voxels.point_shape[1]
    shape = (torus[0], half, *voxels.point_shape)
    turns = np.stack(
        np.broadcast_arrays(
            np.broadcast_to(row_turns[:, None, :, None], shape), column_turns[None, :, None, :]
        ),
        axis=-1,
    ).reshape(-1, points, 2)
    times = np.full((torus[0], half), 2.0)
    times[:, 0] = 1
    if torus[1] % 2 == 0:
        times[:, -1] = 1
    return Lattice(
        mixing=mixing.reshape(-1, points, points),
        lateral=np.hypot(turns[..., 0] / voxels.row_spacing, turns[..., 1]) / voxels.pitch,
        turns=turns,
        times=times.ravel(),
    )


def _axis(size: int, points: int, kept: int) -> tuple[np.ndarray, np.ndarray]:
    """(frequency, point, alias) phases and (frequency, alias) cycles a point along an axis."""
    fine = np.arange(kept)[:, None] + size * np.arange(points)
    phase = np.exp(2j * np.pi * fine[:, None, :] * np.arange(points)[:, None] / (size * points))
    return phase / np.sqrt(points), np.fft.fftfreq(size * points)[fine]


def exponential_factor(
    lattice: Lattice, depths: np.ndarray, length: float, chosen: np.ndarray | None = None
) -> np.ndarray:
    """Lower triangular roots (frequency, fine frequency, plane, plane) of the covariance exp(-r/l)
    of voxels, of variance 1.

    depths: (plane,) m.
    length: l, m; 0 for voxels that are independent.
    chosen: numbers of the frequencies that are asked for; all by default.

    At lateral frequency q the planes' covariance is 2 pi/l Q^-3 (1 + Q|dz|) exp(-Q|dz|),
    Q^2 = q^2 + l^-2.
    """
    asked = slice(None) if chosen is None else chosen
    shape = (*lattice.lateral[asked].shape, len(depths), len(depths))
    if length == 0:
        return np.broadcast_to(np.eye(len(depths)), shape)
    q = np.hypot(2 * np.pi * lattice.lateral, 1 / length)
    power = q**-3
    power /= lattice.mean(power).mean()
    q, power = q[asked], power[asked]
    apart = np.abs(np.subtract.outer(depths, depths)) * q[..., None, None]
    covariance = (1 + apart) * np.exp(-apart)
    covariance[..., np.arange(len(depths)), np.arange(len(depths))] += 1e-10
    return np.sqrt(power)[..., None, None] * np.linalg.cholesky(covariance)


def through_prior(matrix: np.ndarray, mixing: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """A F L of one frequency: (pixel, unknown) -> (pixel, fine frequency * plane) in double.

    mixing: (point, fine frequency); factor: (fine frequency, plane, plane), lower roots.
    """
    pixels, planes = len(matrix), factor.shape[1]
    mixed = matrix.reshape(pixels, planes, -1) @ mixing
    return (mixed.transpose(2, 0, 1) @ factor).transpose(1, 0, 2).reshape(pixels, -1)


def back_through_prior(matrix: np.ndarray, mixing: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """F L M of one frequency: (fine frequency * plane, n) -> (unknown, n)."""
    points, planes = factor.shape[:2]
    deep = factor @ matrix.reshape(points, planes, -1)
    return np.tensordot(deep, mixing, (0, 1)).transpose(0, 2, 1).reshape(points * planes, -1)


def voxels_of(stack: Stack) -> Voxels:
    """The unknowns of a stack of kernels."""
    # layers of a photographic camera are told apart by parallax, not by their distance
    return Voxels(
        point_shape=stack.point_shape,
        pitch=float(np.mean(stack.spacing[:, 1])),
        depths=tuple((stack.depth - stack.depth[0]).tolist()),
        row_spacing=float(stack.spacing[0, 0] / stack.spacing[0, 1]),
    )


def map_of(stack: Stack, count: tuple[int, int], device: Device = CPU) -> BlockCirculant:
    """What `count` (rows, columns) lenslets see of a specimen that is smooth, by the means over its
    voxels, on a torus that all light fits into.

    device: of the map.

    A sum of A x over places is the integral, the mean m over voxels is x + m''/24: light is that
    of m - m''/24, and where kernels are means of two places too, of m - 7 m''/96. Along the depth
    planes are lines, and m'' is known where they are even. docs/model.md, "Volumes inverted".
    """
    op = BlockCirculant(stack.parts(), count, torus_for(count, stack.reach), device)
    _smooth(op, voxels_of(stack))
    return op


def _smooth(op: BlockCirculant, voxels: Voxels) -> None:
    """Turn a map of what is in the voxels' middles into one of their means; see map_of."""
    lattice, planes = lattice_of(op.torus, voxels), len(voxels.depths)
    sharper = np.prod(1 + 4 * ACROSS * np.sin(np.pi * lattice.turns) ** 2, axis=-1)
    across = lattice.mixing * sharper[:, None] @ lattice.mixing.conj().transpose(0, 2, 1)
    apart = np.diff(voxels.depths)
    along = np.eye(planes)
    if planes > 2 and np.ptp(apart) <= EVEN * abs(apart[0]):
        step = np.diff(np.eye(planes), axis=0)
        along = along + WITHIN * step.T @ step
    along = along.astype(op.dtype)
    for k, matrix in enumerate(op.spectrum):
        layers = matrix.reshape(len(matrix), planes, -1) @ across[k].astype(matrix.dtype)
        op.spectrum[k] = np.matmul(along, layers).reshape(len(matrix), -1)
