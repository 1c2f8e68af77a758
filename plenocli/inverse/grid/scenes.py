"""The lenslet grid from captures of any scene, where there is no white image or an old one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.inverse.grid import detect, distortion, lattice, template, white_image
from plenocli.inverse.grid.lenslet_grid import LensletGrid

SCALES = (4, 8, 16, 32, 64)
"""px of Gaussians that take the scene off before repeats are looked for."""
AGREE = 0.03
"""By which the pitch of another scale or direction may differ."""
NOISE = 0.2
"""Of the mean contrast of what is left, which is added to that about a pixel before it is divided
by: dark noise then stays less than lenslets.
"""
DARK = 0.02
"""Of the usual light, which is no light."""
HALF = 0.5
"""Of the mean light of a cell, which counts half as much as any highlight."""
ACROSS = 20
"""Cells a side in which dark lines are looked for: few enough for one pitch to hold in all."""
LINES = 24
"""Places across a cell where a line of it may lie."""
CROSSED = 0.04
"""Of the mean light, by which lines across cells may be darker than those along their sides."""
SURE = 2.0
"""Standard deviations from which on lenslets are believed to have moved."""


def find_scene_grid(
    captures: Sequence[np.ndarray],
    cfa: str = "mono",
    lattice_kind: str = "auto",
    near: Sequence[float] | None = None,
    *,
    parts: bool = False,
    count: Sequence[int] | None = None,
) -> LensletGrid:
    """The grid of lenslets behind which there is a scene, with the error that is expected of it.

    The light of each cell is evened, so that what is left is what all superpixels have in common;
    slopes of light within superpixels are fitted beside their places, so that edges tell these.
    captures: one or several (row, column), without dark, of lenslets that did not move between;
        the rest as plenocli.inverse.grid.detect.find_grid's.

    Raises as find_grid, and NumericsError where no period stands out of the scene, or one that is
    also the scene's.
    docs/model.md, section 9.
    """
    pictures = [white_image.prepare(capture, cfa) for capture in captures]
    period = _period([_without_colours(p, cfa) for p in pictures])
    pitch = _pitch(period)
    evened = np.mean([even_light(_without_colours(p, cfa), pitch) for p in pictures], axis=0)
    if not parts:
        _check_sides(evened, period)
    grid = detect.find_grid(
        evened, "mono", None, lattice_kind, near, parts=parts, count=count, scene=period
    )
    if np.ptp(grid.pitch) > AGREE * grid.pitch.min():
        raise NumericsError(
            f"no lenslet lattice in the capture: superpixels {grid.pitch[0]:.1f} x "
            f"{grid.pitch[1]:.1f} px apart are those of a pattern in the scene",
            fix="give a capture of another scene, or a white image",
        )
    return grid


@dataclass(frozen=True)
class GridMotion:
    """How lenslets moved since a white image.

    grid: where they are.
    rms: px, by which they seem to have moved; grid is where they were unless that is more than
        SURE times its expected_error.
    moved: whether it is.
    """

    grid: LensletGrid
    rms: float
    moved: bool


def moved_grid(
    grid: LensletGrid, white: np.ndarray, captures: Sequence[np.ndarray], cfa: str = "mono"
) -> GridMotion:
    """The grid of an older white image, carried to captures of a scene.

    Shift, turn and stretch since the white image: what slopes of light do to places is the same in
    both as far as light is.
    white: (row, column), the image that `grid` comes from, without dark; captures: as
        find_scene_grid's.
    """
    pitch, where = float(grid.pitch.min()), grid.valid
    index, centres = np.argwhere(where), grid.centres[where]
    images = [
        np.mean(
            [even_light(_without_colours(white_image.prepare(p, cfa), cfa), pitch) for p in group],
            axis=0,
        )
        for group in ([white], captures)
    ]
    way = []
    for tilted in (True, False):
        old, new = (
            template.register(image, centres, grid.basis, share=1.0, tilted=tilted)[0]
            for image in images
        )
        way.append(new - old)
    weight = np.where(lattice.surrounded(index, "square"), 1.0, detect.BORDER_WEIGHT)
    motion, error = distortion.choose_by_blocks(centres, way[0], weight, ("affine",))
    other = distortion.fit_model("affine", centres, way[1], weight)
    light = np.sqrt(np.mean(np.sum((motion.at(centres) - other.at(centres)) ** 2, axis=1)))
    error = float(np.hypot(error, detect.LIGHT * light))
    rms = float(np.sqrt(np.mean(np.sum(motion.at(centres) ** 2, axis=1))))
    moved = rms > SURE * error
    return GridMotion(
        replace(
            grid,
            centres=grid.centres + motion.at(grid.centres) if moved else grid.centres,
            expected_error=error,
        ),
        rms,
        moved,
    )


def shifted_mosaic(mosaic: np.ndarray, step: np.ndarray, cfa: str) -> np.ndarray:
    """A mosaic (row, column) moved by `step` (2,) px, each colour by linear interpolation; NaN
    stays beside NaN.
    """
    from scipy.ndimage import shift

    period = 1 if cfa == "mono" else 2
    out = np.empty(mosaic.shape, np.float32)
    for i in range(period):
        for j in range(period):
            plane = mosaic[i::period, j::period]
            out[i::period, j::period] = shift(plane, step / period, order=1, mode="nearest")
    return out


def even_light(image: np.ndarray, pitch: float) -> np.ndarray:
    """An image (row, column) over its mean within a cell, r, as r / (r + HALF): highlights of the
    scene hardly count, gaps between superpixels fully.
    """
    from scipy.ndimage import uniform_filter

    light = np.maximum(image, 0)
    size = max(3, round(pitch))
    around = uniform_filter(uniform_filter(light, size), size)
    out = light / (around + DARK * around.mean() + np.finfo(np.float32).tiny)
    return (out / (out + HALF)).astype(np.float32)


def _even_contrast(logarithm: np.ndarray, scale: int) -> np.ndarray:
    """What a Gaussian of `scale` px takes off the logarithm of an image (row, column), over its
    contrast about each pixel: hard borders of a scene would outdo lenslets, and lags from one part
    of high contrast to another be preferred to the lattice's.
    """
    from scipy.ndimage import gaussian_filter, uniform_filter

    detail = logarithm - gaussian_filter(logarithm, scale)
    power = uniform_filter(uniform_filter(detail**2, scale), scale)
    contrast = np.sqrt(np.maximum(power, 0))
    return detail / (contrast + NOISE * contrast.mean() + np.finfo(np.float32).tiny)


def _without_colours(picture: np.ndarray, cfa: str) -> np.ndarray:
    return picture if cfa == "mono" else template.smoothed(picture)


def _pitch(found: lattice.Periodicity) -> float:
    return float("nan") if found.basis is None else float(np.hypot(*found.basis.T).min())


def _check_sides(image: np.ndarray, found: lattice.Periodicity) -> None:
    """Refuse a square lattice of every other lenslet, which a scene lights like a chessboard: dark
    lines between lenslets then run along the diagonals of its cells.

    image: (row, column), evened.
    """
    if found.basis is None or lattice.kind_of(found.basis) != "square":
        return
    step = max(1, int(_pitch(found) / LINES))
    part = white_image.brightest_crop(image, round(ACROSS * _pitch(found)))[::step, ::step]
    basis = found.basis / step
    sides, diagonals = (
        _darkest_line(part, one) for one in (basis, np.array([[0.5, 0.5], [0.5, -0.5]]) @ basis)
    )
    if diagonals < sides - CROSSED * part.mean():
        raise NumericsError(
            f"no lenslet lattice in the capture: it repeats every {_pitch(found):.1f} px, but dark "
            "lines run across such superpixels, not between them: the scene or filters make every "
            "other lenslet or part of one brighter",
            fix="give a capture of another scene, a white image, or the camera with its filters",
        )


def _darkest_line(image: np.ndarray, basis: np.ndarray) -> float:
    """Light on the darkest lines of an image (row, column) along the two vectors of a lattice,
    basis (2, 2) px, all cells laid on one another: the mean of both.
    """
    at = np.indices(image.shape).reshape(2, -1).T @ np.linalg.inv(basis)
    darkest = []
    for place in at.T:
        line = (place % 1 * LINES).astype(int)
        count = np.bincount(line)  # where pixels and cells share a step some hold no pixel
        light = np.bincount(line, image.ravel())
        darkest.append((light[count > 0] / count[count > 0]).min())
    return float(np.mean(darkest))


def _period(pictures: Sequence[np.ndarray]) -> lattice.Periodicity:
    """The period that stands out most where slow changes of brightness are taken off, and does so
    at two scales at least; as long in one direction as in the other, which a scene's is not.
    """
    found: list[tuple[int, lattice.Periodicity]] = []
    reason = "no period is the same at two scales and in two directions"
    for number, picture in enumerate(pictures):
        part = np.maximum(white_image.brightest_crop(picture, 1024), 0)
        logarithm = np.log(part + DARK * part.mean())
        for scale in SCALES:
            seen = lattice.find_basis(_even_contrast(logarithm, scale))
            if seen.basis is not None and np.ptp(np.hypot(*seen.basis.T)) < AGREE * _pitch(seen):
                found.append((number, seen))
    for _, best in sorted(found, key=lambda one: -one[1].strength):
        alike = [(n, one) for n, one in found if abs(_pitch(one) / _pitch(best) - 1) < AGREE]
        if len(alike) > len({n for n, _ in alike}):  # one picture at two scales, whatever others
            # what is slow in a scene correlates half way, too, and passed for parts
            return replace(best, structure=min(one.structure for _, one in alike))
    raise NumericsError(f"no lenslet lattice in the capture: {reason}", fix=white_image.FIX)
