"""What superpixels tell apart of the points of a lenslet's field: how much of their light goes to
the neighbours. docs/model.md, section 9, "Neighbours".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PATTERNS = 6
"""Of points along an axis, at most."""
MODES, UNKNOWNS = 16, 64
"""Of a field at most, and times bands."""
LEAST_MODES = 6
"""That many are kept of however many bands."""
TELLING = 2e-5
"""Of what the mean of a field tells, above which a mode counts: the noise where that is known to
1/220.
"""
ALIKE = 0.5
"""Correlation of points a field apart, by which it is judged what tells them apart."""
DARK = 0.01
"""Of the brightest pixel's variance, that all have."""


@dataclass(frozen=True, kw_only=True)
class FieldModes:
    """Patterns of the points of a lenslet's field that are told apart; what else points do is what
    it usually is beside them. Each is a product of one pattern down and one across.

    weights: (pattern, point), along an axis: amounts of the patterns from values of points.
    shapes: (point, pattern), the values of points that an amount stands for.
    kept: (mode, 2), which pattern down and which across.
    """

    weights: np.ndarray
    shapes: np.ndarray
    kept: np.ndarray

    @property
    def points(self) -> int:
        """Of a field, a side."""
        return self.weights.shape[1]

    @property
    def basis(self) -> np.ndarray:
        """Values of points, row by row, that each mode stands for: (point, mode)."""
        down, across = (self.shapes[:, one] for one in self.kept.T)
        return (down[:, None] * across[None]).reshape(-1, len(self.kept))

    @property
    def mean(self) -> np.ndarray:
        """Of the points, by modes (mode,)."""
        return self.basis.mean(axis=0)

    @property
    def even(self) -> np.ndarray:
        """Amounts of modes (mode,) where all points are 1."""
        down, across = (self.weights.sum(axis=1)[one] for one in self.kept.T)
        return down * across

    @property
    def mirrored(self) -> tuple[np.ndarray, np.ndarray]:
        """Amounts of modes (mode, mode) from those of the field upside down, and left to right."""
        turned, same = self.weights @ self.shapes[::-1], self.weights @ self.shapes
        down, across = self.kept.T
        return (
            turned[np.ix_(down, down)] * same[np.ix_(across, across)],
            same[np.ix_(down, down)] * turned[np.ix_(across, across)],
        )


EVEN = FieldModes(weights=np.ones((1, 1)), shapes=np.ones((1, 1)), kept=np.zeros((1, 2), int))
"""One value behind a lenslet."""


def field_modes(light: np.ndarray) -> FieldModes:
    """Those that change superpixels most beside photon noise, the mean of the field before all.

    light: (superpixel, pixel, point, band), of n x n points row by row.
    """
    power = _told(light)
    count = len(power)
    place = np.arange(count) / count
    size, turn = np.linalg.eigh(ALIKE ** np.abs(place[:, None] - place))
    root, back = (turn * size**0.5) @ turn.T, (turn * size**-0.5) @ turn.T
    first = back.sum(axis=1, keepdims=True)
    first /= np.linalg.norm(first)
    rest = np.eye(count) - first @ first.T
    axis = power.sum(axis=(1, 3)) + power.sum(axis=(0, 2))
    axis += axis[::-1, ::-1]  # patterns are even or odd
    # where nothing is told, too
    parity = 1e-12 * np.trace(axis) * (2 * np.eye(count) + np.eye(count)[::-1])
    others = np.linalg.eigh(rest @ (root @ axis @ root + parity) @ rest)[1][:, ::-1][
        :, : min(PATTERNS, count) - 1
    ]
    patterns = np.concatenate([first, others], axis=1)
    shapes = root @ patterns
    info = np.einsum("abcd,ai,ci,bj,dj->ij", power, *[shapes] * 4, optimize=True)
    info[0, 0] = np.inf
    most = min(int(np.count_nonzero(info > TELLING)), MODES, UNKNOWNS // light.shape[-1])
    most = max(most, LEAST_MODES)
    kept = np.argsort(-info, axis=None, kind="stable")[:most]
    level = np.where(np.arange(shapes.shape[1]) == 0, shapes[:, 0].mean(), 1)
    return FieldModes(
        weights=patterns.T @ back * level[:, None],
        shapes=shapes / level,
        kept=np.transpose(np.unravel_index(kept, info.shape)),
    )


def _told(light: np.ndarray) -> np.ndarray:
    """What superpixels tell of pairs of points over their photon noise, the mean of the field
    apart, each band alike: (row, column, row, column of points).
    """
    side = round(light.shape[2] ** 0.5)
    noise = light.sum(axis=(0, 2, 3))
    noise = noise + DARK * noise.max()
    out = np.zeros((side**2, side**2))
    for band in range(light.shape[-1]):
        part = light[..., band] / np.sqrt(noise)[:, None]
        found = np.tensordot(part, part, ((0, 1), (0, 1)))
        mean = found.sum(axis=0)  # of even fields
        out += found / mean.sum() - np.outer(mean, mean) / mean.sum() ** 2
    return out.reshape((side,) * 4)
