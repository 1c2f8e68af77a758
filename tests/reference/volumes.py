"""Volumes by dense matrices: the map of a torus as it is defined, a stationary prior by its Fourier
sums, and the conditional mean and variance of a Gaussian.
"""

import numpy as np


def kernels(planes, points, pixels, seed=0):
    """(blocks, offsets) of planes that spread farther and farther, a share of 1 a column."""
    rng, parts = np.random.default_rng(seed), []
    for plane in range(planes):
        reach = 1 if plane else 0
        offsets = np.array(
            [[r, c] for r in range(-reach, reach + 1) for c in range(-reach, reach + 1)]
        )
        blocks = rng.random((len(offsets), pixels, points)) ** 3
        blocks *= np.exp(-1.5 * (offsets**2).sum(axis=1))[:, None, None]
        parts.append((blocks / blocks.sum(axis=(0, 1)), offsets))
    return parts


def matrix(parts, count, torus):
    """(lenslet * pixel, torus lenslet * unknown) of kernels."""
    pixels, unknowns = parts[0][0].shape[1], sum(b.shape[2] for b, _ in parts)
    full = np.zeros((*count, pixels, *torus, unknowns))
    first = 0
    for blocks, offsets in parts:
        for block, (dr, dc) in zip(blocks, offsets):
            for r in range(count[0]):
                for c in range(count[1]):
                    at = (r - dr) % torus[0], (c - dc) % torus[1]
                    full[r, c, :, at[0], at[1], first : first + block.shape[1]] += block
        first += blocks.shape[2]
    return full.reshape(np.prod(count) * pixels, -1)


def places(torus, point_shape, planes):
    """(unknown, 3) plane, row and column on the fine lattice, in the order of the matrix."""
    s, t = point_shape
    order = [
        (plane, r * s + i, c * t + j)
        for r in range(torus[0])
        for c in range(torus[1])
        for plane in range(planes)
        for i in range(s)
        for j in range(t)
    ]
    return np.array(order)


def covariance(torus, point_shape, pitch, depths, length):
    """Of voxels: exp(-r/l) of variance 1, by its sum over the frequencies of the fine lattice."""
    at = places(torus, point_shape, len(depths))
    shape = torus[0] * point_shape[0], torus[1] * point_shape[1]
    rows, columns = (np.fft.fftfreq(n, pitch) for n in shape)
    q = np.sqrt(4 * np.pi**2 * np.add.outer(rows**2, columns**2) + length**-2)
    total = np.sum(q**-3)
    table = np.empty((len(depths), len(depths), *shape))
    for a, za in enumerate(depths):
        for b, zb in enumerate(depths):
            x = q * abs(za - zb)
            table[a, b] = np.fft.ifft2(q**-3 * (1 + x) * np.exp(-x)).real * q.size / total
    dr, dc = (at[:, None, axis] - at[None, :, axis] for axis in (1, 2))
    return table[at[:, None, 0], at[None, :, 0], np.mod(dr, shape[0]), np.mod(dc, shape[1])]


def conditional(a, prior, noise, y):
    """Mean and variance of x given y = A x + noise of variances `noise`."""
    gain = np.linalg.solve(a @ prior @ a.T + np.diag(noise), a @ prior).T
    return gain @ y, np.diag(prior) - np.sum(gain * (prior @ a.T), axis=1)
