"""What a lattice of lenslets is to the finer lattice of points: each of its frequencies mixes as
many frequencies of the finer one as a lenslet has points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plenocli.inverse.volume.measurement import Voxels


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
        lateral=np.hypot(turns[..., 0], turns[..., 1]) / voxels.pitch,
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
