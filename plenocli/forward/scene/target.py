"""A ColorChecker in a picture: where its patches are, the picture of it upright, and how
evenly it was lit.

Chart coordinates (y, x) count patches: patch row r and column c cover r..r+1 and c..c+1 with half
of the frame around them, as in plenocli.forward.scene.chart. Picture coordinates are (row, column),
pixel centres at integers.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.errors import NumericsError
from plenocli.forward.scene.chart import PATCH_COLS, PATCH_ROWS

FRAME = 0.35  # of a patch's pitch: how far the chart reaches beyond its outer patches
# of the illumination's logarithm in rows and columns; fixed in advance, not fitted to a chart
DEGREE = 2
# px: side of the blocks whose brightest part is paper even where something is printed on it
BLOCK = 14
PAPER = 92.0  # percentile of a block that is paper
UPPER = 0.9  # quantile with which the fit starts: paper is the brightest thing around
TUKEY = 4.685


def patch_cores(labels: ArrayLike, erosion: int = 5) -> np.ndarray:
    """A label map without the edges of its patches.

    labels: (row, column) int, 0 for nothing.
    erosion: px taken off the edges of every patch (8-neighbours).

    Returns (row, column) int.
    """
    from scipy.ndimage import binary_erosion

    labels, core = np.asarray(labels, int), np.zeros(np.shape(labels), int)
    for label in np.unique(labels[labels > 0]):
        core[
            binary_erosion(labels == label, np.ones((3, 3)), iterations=erosion)
            if erosion
            else labels == label
        ] = label
    return core


def find_chart(labels: np.ndarray) -> np.ndarray:
    """Projective map from chart to picture coordinates, from the centres of the labelled patches.

    Least squares over the four or more patches seen, by direct linear transformation with
    normalised points.

    labels: (row, column) int, 1..24 on the patches.

    Returns H (3, 3).
    Raises NumericsError where patches are missing or in a line.
    R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., algorithm 4.2.
    """
    seen = [k for k in range(1, PATCH_ROWS * PATCH_COLS + 1) if (labels == k).any()]
    if len(seen) < 4:
        raise NumericsError(
            f"the label map shows {len(seen)} patches; four place a chart",
            fix="give a map with the patches as 1 to 24",
        )
    chart = np.array([[(k - 1) // PATCH_COLS + 0.5, (k - 1) % PATCH_COLS + 0.5] for k in seen])
    picture = np.array([np.argwhere(labels == k).mean(axis=0) for k in seen])
    (a, source), (b, target) = _normalised(chart), _normalised(picture)
    rows = []
    for (y, x), (v, u) in zip(source, target):
        rows += [[y, x, 1, 0, 0, 0, -v * y, -v * x, -v], [0, 0, 0, y, x, 1, -u * y, -u * x, -u]]
    _, singular, right = np.linalg.svd(np.array(rows))
    if singular[7] < 1e-6 * singular[0]:
        raise NumericsError(
            "the patches of the label map lie in a line",
            fix="give a map with patches of at least two rows and columns",
        )
    found = np.linalg.inv(b) @ right[-1].reshape(3, 3) @ a
    return found / found[2, 2]


def _normalised(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(similarity (3, 3), points moved by it) with their mean at 0 and their
    mean distance sqrt 2.
    """
    mean = points.mean(axis=0)
    scale = np.sqrt(2) / max(np.linalg.norm(points - mean, axis=1).mean(), 1e-12)
    return np.array([[scale, 0, -scale * mean[0]], [0, scale, -scale * mean[1]], [0, 0, 1]]), (
        points - mean
    ) * scale


def project(chart: np.ndarray, points: ArrayLike) -> np.ndarray:
    """Points moved by a projective map.

    chart: (3, 3) the map.
    points: (..., 2).

    Returns (..., 2).
    """
    moved = np.asarray(points, float) @ chart[:, :2].T + chart[:, 2]
    return moved[..., :2] / moved[..., 2:]


def outside(chart: np.ndarray, shape: tuple[int, int], frame: float = FRAME) -> np.ndarray:
    """Which pixels lie beyond the chart and its frame.

    chart: (3, 3) map from chart to picture coordinates.
    shape: (rows, columns) of the picture.
    frame: share of a patch's pitch by which the chart reaches beyond its outer patches.

    Returns (rows, columns) bool.
    """
    place = np.stack(
        np.meshgrid(*(np.arange(n, dtype=float) for n in shape), indexing="ij"), axis=-1
    )
    y, x = np.moveaxis(project(np.linalg.inv(chart), place), -1, 0)
    return ~((y > -frame) & (y < PATCH_ROWS + frame) & (x > -frame) & (x < PATCH_COLS + frame))


def upright(
    picture: np.ndarray, sites: np.ndarray, chart: np.ndarray, grid: tuple[int, int], finer: int = 3
) -> np.ndarray:
    """The chart of a picture on cells that tile its 4 x 6 patches.

    Values between sites are linear in rows and columns; NaN at a site leaves it out.

    picture: (row, column).
    sites: (row, column) bool, the pixels that count (one colour of a mosaic).
    chart: (3, 3) map from chart to picture coordinates.
    grid: (rows, cols) of cells.
    finer: a cell is the mean of finer x finer such values.

    Returns (rows, cols) float64, NaN where nothing was near.
    """
    from scipy.ndimage import map_coordinates

    rows, cols = grid
    y, x = (
        (np.arange(n * finer) + 0.5) * patches / (n * finer)
        for n, patches in ((rows, PATCH_ROWS), (cols, PATCH_COLS))
    )
    place = project(chart, np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1))
    good = sites & np.isfinite(picture)
    tent = np.array([0.5, 1, 0.5])
    total, weight = (_smoothed(np.where(good, v, 0.0), tent) for v in (picture, 1.0))
    total, weight = (
        map_coordinates(v, np.moveaxis(place, -1, 0), order=1, mode="constant")
        for v in (total, weight)
    )
    fine = np.divide(total, weight, out=np.full(total.shape, np.nan), where=weight > 0.05)
    return fine.reshape(rows, finer, cols, finer).mean(axis=(1, 3))


def _smoothed(values: np.ndarray, tent: np.ndarray) -> np.ndarray:
    from scipy.ndimage import convolve1d

    return convolve1d(convolve1d(values, tent, 0, mode="constant"), tent, 1, mode="constant")


def paper_field(
    pictures: np.ndarray,
    sites: np.ndarray,
    where: np.ndarray,
    degree: int = DEGREE,
    block: int = BLOCK,
) -> tuple[np.ndarray, int]:
    """Relative illumination from the white paper around a chart.

    Its logarithm is a polynomial in rows and columns, fitted to the PAPER percentile of blocks that
    lie in the surroundings entirely. The fit starts from the UPPER quantile (anything but paper is
    darker) and ends with Tukey's weights, one weight a block for all bands.

    pictures: (band, row, column).
    sites: (band, row, column) bool, the pixels that count.
    where: (row, column) bool, the surroundings.
    degree: total degree of the polynomial.
    block: px, side of a block.

    Returns (illumination (band, row, column), number of blocks that told it).
    Raises NumericsError where there are too few blocks.
    """
    place, level = _blocks(pictures, sites, where, block)
    shape = where.shape
    terms = (degree + 1) * (degree + 2) // 2
    if len(place) < 3 * terms:
        raise NumericsError(
            (
                f"the surroundings of the chart hold {len(place)} blocks of {block} px, too few to "
                "tell the illumination"
            ),
            fix="use --flatten none",
        )
    design = _polynomial(place, shape, degree)
    fit = np.linalg.lstsq(design, level, rcond=None)[0]
    for _ in range(100):
        rest = level - design @ fit
        weight = np.sqrt(np.where(rest > 0, UPPER, 1 - UPPER) / np.maximum(np.abs(rest), 1e-3))
        fit = np.stack(
            [
                np.linalg.lstsq(design * w[:, None], y * w, rcond=None)[0]
                for w, y in zip(weight.T, level.T)
            ],
            axis=1,
        )
    for _ in range(30):
        rest = level - design @ fit
        miss = np.sqrt(np.mean((rest - np.median(rest, axis=0)) ** 2, axis=1))
        weight = np.clip(1 - (miss / (TUKEY * 1.4826 * max(np.median(miss), 1e-9))) ** 2, 0, None)
        fit = np.linalg.lstsq(design * weight[:, None], level * weight[:, None], rcond=None)[0]
    everywhere = np.stack(
        np.meshgrid(*(np.arange(n, dtype=float) for n in shape), indexing="ij"), axis=-1
    )
    field = np.moveaxis(np.exp(_polynomial(everywhere, shape, degree) @ fit), -1, 0)
    return field, int((weight > 0).sum())


def _blocks(
    pictures: np.ndarray, sites: np.ndarray, where: np.ndarray, block: int
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (n, 2) of the blocks of surroundings, and the logarithm (n, band) of
    their bright part.
    """
    place, level = [], []
    rows, columns = where.shape
    for row in range(0, rows - block + 1, block):
        for column in range(0, columns - block + 1, block):
            part = (slice(row, row + block), slice(column, column + block))
            if not where[part].all():
                continue
            values = [
                picture[part][site[part] & np.isfinite(picture[part])]
                for picture, site in zip(pictures, sites)
            ]
            if min(len(v) for v in values) < 10:
                continue
            bright = [np.percentile(v, PAPER) for v in values]
            if min(bright) > 0:
                place.append((row + (block - 1) / 2, column + (block - 1) / 2))
                level.append(np.log(bright))
    return np.array(place).reshape(-1, 2), np.array(level).reshape(len(level), len(pictures))


def _polynomial(place: np.ndarray, shape: Sequence[int], degree: int) -> np.ndarray:
    """Monomials (..., term) of rows and columns scaled to about -1..1 by the wider
    side of the picture.
    """
    half = max(shape) / 2
    y, x = ((place[..., axis] - (shape[axis] - 1) / 2) / half for axis in (0, 1))
    return np.stack(
        [y**i * x**k for i in range(degree + 1) for k in range(degree + 1 - i)], axis=-1
    )
