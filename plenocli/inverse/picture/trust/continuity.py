"""Continuity of a picture across the borders of lenslets: a measure of its error without the truth.

A picture is m + t, the brightness of each lenslet and the detail in it; d and D are the jumps of m
and t across all borders. The factor on t that makes d + factor D least, -<d, D> / <D, D>, is
compared with that of photographs under the right matrix, captured with the same noise.

docs/model.md, "Spatial reconstruction".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from plenocli.inverse.picture.solvers.lmmse import Lmmse
from plenocli.inverse.prior.natural_images import draw_patches

GROUPS, FIRST = 8, 6
"""Groups of coordinates whose detail is judged apart, and how many coordinates the first has."""
DRAWN, PIECES = 400, 60
"""Pieces of 2x2 lenslets of photographs that are drawn, and how many of the capture's contrast are
taken.
"""
LEAST_REFERENCE = 0.2
"""Least factor of photographs that anything is compared with."""
SPREAD, ALIKE = 0.5, 5.0
"""How far the factors of the groups may differ from the common one, and how many points along a
border say the same.
"""


@dataclass(frozen=True, kw_only=True)
class Jumps:
    """Differences across the borders of lenslets.

    level: (pair,) of the lenslets' brightness.
    detail: (pair, group) of what coordinates of each group add to it.
    along: points along a border: so many pairs in a row are of the same one.
    """

    level: np.ndarray
    detail: np.ndarray
    along: int = 1

    @property
    def factor(self) -> float:
        """The factor on all of the detail that makes the jumps least; 1 without detail."""
        whole = self.detail.sum(axis=1)
        power = float(whole @ whole)
        return -float(self.level @ whole) / power if power > 0 else 1.0

    @property
    def strongest(self) -> Jumps:
        """With the first group of coordinates alone."""
        return replace(self, detail=self.detail[:, :1])

    @property
    def deviation(self) -> float:
        """Standard deviation of the factor by chance of the borders, which may differ as much as
        they do.
        """
        whole = self.detail.sum(axis=1)
        power = float(whole @ whole)
        if not power > 0:
            return 0.0
        pull = (self.level + self.factor * whole) * whole
        each = np.add.reduceat(pull, np.arange(0, len(pull), self.along))
        return float(np.sqrt(np.sum(each**2))) / power


def jumps(x: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Differences of adjacent points on either side of the borders between lenslets, (pair,).

    x: (.., lenslet_row, lenslet_column, point) points of several bands one band after the other.
    shape: (rows, columns) of an object in one band.
    """
    blocks = x.reshape(*x.shape[:-1], -1, *shape)
    across = blocks[..., :, :-1, :, :, -1] - blocks[..., :, 1:, :, :, 0]
    down = blocks[..., :-1, :, :, -1, :] - blocks[..., 1:, :, :, 0, :]
    return np.concatenate([across.ravel(), down.ravel()])


def groups(power: np.ndarray) -> list[np.ndarray]:
    """Coordinates (k,) of an Lmmse by falling power, in groups that grow."""
    order, count = np.argsort(-power, kind="stable"), max(len(power), 1)
    ends = np.round(np.geomspace(min(FIRST, count), count, GROUPS)).astype(int)
    cuts = np.unique(np.concatenate([[0], ends]))
    return [order[a:b] for a, b in zip(cuts[:-1], cuts[1:])]


def detail_jumps(lmmse: Lmmse, y: np.ndarray, shape: tuple[int, int]) -> Jumps:
    """Jumps of the estimates of `lmmse` from superpixels y (.., lenslet_row, lenslet_column,
    pixel), by `groups` of its coordinates; shape as in `jumps`.
    """
    stacked = y.reshape(-1, y.shape[-1]).T
    shrunk = lmmse.likely_detail(stacked)
    level = lmmse.even @ (lmmse.levels @ stacked)

    def of(x: np.ndarray) -> np.ndarray:
        return jumps(x.T.reshape(*y.shape[:-1], -1), shape)

    parts = [of(lmmse.gain[:, group] @ shrunk[group]) for group in groups(lmmse.power)]
    # what is expected of every field belongs to its detail
    parts[0] = parts[0] + of(np.broadcast_to(lmmse.mean[:, None], level.shape))
    return Jumps(level=of(level), detail=np.stack(parts, axis=1), along=min(shape))


def pieces(
    pictures: Sequence[np.ndarray],
    shape: tuple[int, int],
    contrast: float,
    bright: float,
    rng: np.random.Generator,
) -> np.ndarray | None:
    """Pieces of photographs of 2x2 lenslets, (piece, 2, 2, point), None where no picture is large
    enough.

    pictures: (row, column) linear luminance.
    shape: (rows, columns) of an object.
    contrast: variance within a lenslet over its squared brightness that they are to have, about.
    bright: their mean.
    """
    rows, columns = shape
    large = [p for p in pictures if p.shape[0] >= 2 * rows and p.shape[1] >= 2 * columns]
    if not large:
        return None
    drawn = draw_patches(large, (2 * rows, 2 * columns), DRAWN, rng).T
    blocks = drawn.reshape(-1, 2, rows, 2, columns).transpose(0, 1, 3, 2, 4)
    blocks = blocks.reshape(len(drawn), 2, 2, -1)
    within = blocks.var(axis=3).mean(axis=(1, 2))
    within = within / np.maximum(blocks.mean(axis=(1, 2, 3)) ** 2, 1e-9)
    unlike = np.abs(np.log(np.maximum(within, 1e-9) / max(contrast, 1e-9)))
    taken = blocks[np.argsort(unlike, kind="stable")[:PIECES]]
    return taken * (bright / taken.mean())


def group_factors(found: Jumps, reference: Jumps) -> np.ndarray:
    """(group,) factors from 0 to 1 on the detail of each group, relative to photographs under the
    right matrix.

    A Gaussian posterior: the common factor of all groups, give or take SPREAD of it, and the least
    squares of the jumps, of which ALIKE along a border say the same.
    """
    own = reference.detail.T @ reference.detail
    own += 0.02 * np.diag(np.diag(own)) + np.finfo(float).tiny * np.eye(len(own))
    right = np.linalg.solve(own, -(reference.detail.T @ reference.level))
    right = np.maximum(right, LEAST_REFERENCE)
    gram, target = found.detail.T @ found.detail, -(found.detail.T @ found.level)
    best = np.linalg.lstsq(found.detail, -found.level, rcond=None)[0]
    left = found.level + found.detail @ best
    variance = max(ALIKE * float(np.mean(left**2)), np.finfo(float).tiny)
    common = float(np.clip(relative_factor(found, reference), 0, 1))
    weight = 1 / (SPREAD * right) ** 2
    factor = np.linalg.solve(
        gram / variance + np.diag(weight), target / variance + weight * common * right
    )
    return np.clip(factor / right, 0, 1)


def relative_factor(found: Jumps, reference: Jumps) -> float:
    """The factor of a capture over that of photographs under the right matrix: about 1 where the
    matrix is right, 0 where the detail has nothing to do with the scene.
    """
    return found.factor / max(reference.factor, LEAST_REFERENCE)
