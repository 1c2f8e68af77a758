"""The lenslet grid of a white image: square or hexagonal, any rotation, pitch of 5 to 300 px.

Method: autocorrelation for the first guess, maxima of the smoothed picture, windowed centroids,
numbering by a walk over the lattice, then a robust fit of every superpixel's common look on the
illumination-flattened image (vignetting left in biases the pitch) and the simplest smooth map that
the places support. See docs/model.md, "Spectral response: calibration and demultiplexing".
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.base.progress import collected_notes, note
from plenocli.base.text import by
from plenocli.inverse.grid import distortion, lattice, template
from plenocli.inverse.grid.borders import index_at, lit_cells, to_dark_borders
from plenocli.inverse.grid.distortion import GridModel
from plenocli.inverse.grid.lattice import Periodicity
from plenocli.inverse.grid.lenslet_grid import LensletGrid
from plenocli.inverse.grid.sites import measured_sites, parts_sites
from plenocli.inverse.grid.white_image import FIX, in_frame, period_of, prepare

STRUCTURED = 0.2
"""Correlation half a step away, over that of a whole step, above which superpixels hold several
bright parts.
"""
NEARLY = 0.15
"""Of the pitch that is known about, by which it may be off."""
LONGEST_SIDE = 1.3
"""Of a cell's shorter side, that its longer one may be."""
SCATTER = 0.1
"""Of the pitch, by which spots may scatter (rms) about the best grid."""
BORDER_WEIGHT = 0.1
"""Of a lenslet without whole neighbours on all sides: light that they lack, or a cut, moves it."""
NEAR = 0.25
"""Of the pitch: what a centre may lie from where it is said to be."""
FEWEST = 100
"""Lenslets from which on a scene can be told from what repeats in it."""
LIGHT = 0.6
"""Of how far the grid of a scene moves if slopes of light within superpixels are taken for shifts:
how far off it is for what light does beyond a slope. Measured on real and simulated captures.
"""


def find_grid(
    white: np.ndarray,
    cfa: str = "mono",
    dark: np.ndarray | float | None = None,
    lattice_kind: str = "auto",
    near: Sequence[float] | None = None,
    crop: int = 1024,
    *,
    parts: bool = False,
    count: Sequence[int] | None = None,
    pitch: float | None = None,
    scene: Periodicity | None = None,
) -> LensletGrid:
    """Find the lenslet grid of a white image.

    white: (row, column).
    cfa: "mono" or four letters (RGGB ...): each position of the 2x2 pattern is scaled to the same
        mean.
    dark: of the same shape or one number, taken off first.
    lattice_kind: "auto", "square" or "hexagonal".
    near: (row, column) px close to the centre of any one superpixel; needed only where filters in
        the pupil divide superpixels by dark lines as dark as their borders: then the phase that
        fits most whole superpixels into the frame is taken, or else the darkest lines.
    crop: px, side of the part in which the lattice is looked for first.
    parts: whether superpixels are known to hold several bright parts, as those behind a filter
        array do: one that is much brighter than the others passes for all of the superpixel.
    count: lenslets (rows, columns), where they are known: of several phases that of this count is
        taken.
    pitch: px between superpixels, where it is known about: parts that look alike repeat oftener,
        and are put together unless `count` says that there are as many superpixels.
    scene: how the image repeats if it is no white one but captures of a scene, evened
        (plenocli.inverse.grid.scenes); then the error that is expected is found, too.

    Raises NumericsError, saying what was seen, where there is no lattice or none with a centre
    near `near`, InputError for an image too small or not finite. Notes where several phases would
    do, and an array of another size than `count`.
    docs/model.md, "Spectral response: calibration and demultiplexing".
    """
    mosaic = prepare(white, cfa, dark)
    # what is left of the 2x2 pattern goes
    image = mosaic if cfa == "mono" else template.smoothed(mosaic)
    period = scene or period_of(image, crop)
    basis, kind, several, times = _basis(period, lattice_kind, pitch)
    alike = max(times) > 1
    structured = several or parts or alike
    cell = basis * times[:, None]
    pitch = float(np.hypot(*cell.T).min())
    index, position, clean, slope = (
        parts_sites(image, basis, times, even=scene is None)
        if alike
        else measured_sites(image, basis, kind, pitch, structured, even=scene is None)
    )
    basis = cell
    inside = in_frame(position, image.shape, 0.5 * pitch) & clean
    model, weight = _first_model(index, position, inside, kind, pitch, even=scene is None)
    error = None
    if scene is not None:
        position[inside], model, error = _registered_scene(
            mosaic, model, index[inside], basis, weight, symmetric=not structured
        )
    else:
        position[inside], model = _registered(
            mosaic, model, index[inside], basis, slope[inside], weight, symmetric=not structured
        )
    lit = None
    if structured and kind == "square":
        moved = to_dark_borders(image, model, index[inside], pitch, near=near, count=count)
        position = position + moved.at(index) - model.at(index)
        model, lit = moved, lit_cells(image, moved, index[inside])
    miss = np.where(inside, np.hypot(*(position - model.at(index)).T), np.nan)
    if near is not None:
        _check_near(model, near, pitch)
    found = _assemble(kind, model, index, miss, clean, image.shape, pitch, lit)
    found = replace(found, expected_error=error)
    if alike and count is not None and found.valid.shape != tuple(count):
        # a description of the wrong pitch groups whole superpixels
        with contextlib.suppress(NumericsError), collected_notes():
            plain = find_grid(white, cfa, dark, lattice_kind, near, crop, parts=parts, count=count)
            if plain.valid.shape == tuple(count):
                return plain
    if count is not None and found.valid.shape != tuple(count):
        note(
            f"warning: {by(found.valid.shape)} lenslets are found where {by(count)} are known: "
            "rows or columns are dark or cut by the frame, or the grid lies aside; look at the "
            "white image, or name a superpixel's middle"
        )
    return found


def _registered(
    mosaic: np.ndarray,
    model: GridModel,
    index: np.ndarray,
    basis: np.ndarray,
    slope: np.ndarray,
    weight: np.ndarray,
    *,
    symmetric: bool,
) -> tuple[np.ndarray, GridModel]:
    """(places (N, 2) px of the sites `index` by their common look, the map through them).

    Light that falls off within superpixels moves bells, light of lenslets dimmed as a whole does
    not, and bells look alike in both: there the lattice tells, if it has no bends with the one or
    with a mixture.
    """
    first = model.at(index)
    position, _, told = template.register(mosaic, first, basis, slope, symmetric)
    model, _ = distortion.choose_model(index, position, weight)
    if told or weight.sum() < 1.5 * distortion.FREEDOM["homography"]:
        return position, model
    dimmed, _, _ = template.register(mosaic, first, basis, slope, symmetric, share=0.0)
    share = distortion.share_between(index, position, dimmed, weight)
    mixed = position + share * (dimmed - position)
    straight, _ = distortion.choose_model(index, mixed, weight)
    return (mixed, straight) if straight.kind in distortion.STRAIGHT else (position, model)


def _registered_scene(
    image: np.ndarray,
    model: GridModel,
    index: np.ndarray,
    basis: np.ndarray,
    weight: np.ndarray,
    *,
    symmetric: bool,
) -> tuple[np.ndarray, GridModel, float]:
    """(places (N, 2) px of the sites `index` by their edges, the map through them, the error that
    is expected of it, px rms): of captures of a scene.
    """
    if weight.sum() < FEWEST:
        raise NumericsError(
            f"only {len(index)} superpixels are seen, too few to tell lenslets from what repeats "
            "in a scene",
            fix=FIX,
        )
    first = model.at(index)
    position, _, _ = template.register(image, first, basis, None, symmetric, tilted=True)
    model, error = distortion.choose_by_blocks(index, position, weight)
    shifted, _, _ = template.register(image, first, basis, None, symmetric, share=1.0)
    other = distortion.fit_model(model.kind, index, shifted, weight)
    light = LIGHT * np.sqrt(np.mean(np.sum((other.at(index) - model.at(index)) ** 2, axis=1)))
    return position, model, float(np.hypot(error, light))


def _check_near(model: GridModel, near: Sequence[float], pitch: float) -> None:
    """Refuse a grid that has no centre within a quarter of the pitch of `near` (row, column) px."""
    centre = model.at(np.rint(index_at(model, near)))
    if np.hypot(*(centre - near)) > NEAR * pitch:
        raise NumericsError(
            f"no superpixel has its centre near row {near[0]:g}, column {near[1]:g}: the nearest "
            f"one that the image shows is at row {centre[0]:.1f}, column {centre[1]:.1f}",
            fix="give a pixel near the middle of a superpixel, or none to let the image decide",
        )


def _basis(
    found: Periodicity, lattice_kind: str, pitch: float | None
) -> tuple[np.ndarray, str, bool, np.ndarray]:
    """(lattice vectors [down, right] of what repeats, kind of lattice, whether it holds several
    bright parts, how many (down, right) make a superpixel); pitch: px, as of find_grid.
    """
    if found.basis is None:
        raise NumericsError(f"no lenslet lattice in the image: {found.reason}", fix=FIX)
    kind = lattice.kind_of(found.basis) if lattice_kind == "auto" else lattice_kind
    basis = lattice.oriented(found.basis, kind)
    sides = np.hypot(*basis.T)
    times = np.ones(2, int)
    if pitch is not None:
        times = np.maximum(np.rint(pitch / sides), 1).astype(int)
        times[np.abs(times * sides / pitch - 1) > NEARLY] = 1
    sides = sides * times
    if sides.max() > LONGEST_SIDE * sides.min():
        raise NumericsError(
            (
                f"no lenslet lattice in the image: it repeats every {sides[0]:.1f} by "
                f"{sides[1]:.1f} px, which no square or hexagonal array does"
            ),
            fix=FIX,
        )
    return basis, kind, found.structure > STRUCTURED, times


def _first_model(
    index: np.ndarray,
    position: np.ndarray,
    inside: np.ndarray,
    kind: str,
    pitch: float,
    *,
    even: bool,
) -> tuple[GridModel, np.ndarray]:
    """(map through the centroids of the sites inside the frame, weights of those sites); where the
    light is not `even` some may lie far off.
    """
    if inside.sum() < 9 or (np.ptp(index[inside], axis=0) < 2).any():
        raise NumericsError(
            (
                f"no lenslet lattice in the image: a pitch of {pitch:.1f} px repeats, but only "
                f"{int(inside.sum())} sites in the frame follow it"
            ),
            fix=FIX,
        )
    weight = np.where(lattice.surrounded(index[inside], kind), 1.0, BORDER_WEIGHT)
    few = slice(None, None, -(-int(inside.sum()) // distortion.ENOUGH))
    model, _ = distortion.choose_model(index[inside][few], position[inside][few], weight[few])
    miss = np.hypot(*(position - model.at(index)).T)
    scatter = np.sqrt((np.mean if even else np.median)(miss[inside] ** 2))
    if scatter > SCATTER * pitch:
        raise NumericsError(
            (
                f"no lenslet lattice in the image: spots {pitch:.1f} px apart scatter by "
                f"{np.median(miss[inside]):.1f} px about the best grid"
            ),
            fix=FIX,
        )
    return model, weight


def _assemble(
    kind: str,
    model: GridModel,
    index: np.ndarray,
    miss: np.ndarray,
    clean: np.ndarray,
    shape: tuple[int, ...],
    pitch: float,
    lit: np.ndarray | None,
) -> LensletGrid:
    """Lay the sites out as an array (R, C) without empty border rows and columns;

    lit (N, 2): more sites that hold light.
    """
    site = lattice.to_array(index, kind)
    bright = site[clean] if lit is None else lattice.to_array(lit, kind)
    low, high = bright.min(axis=0), bright.max(axis=0)
    keep = ((site >= low) & (site <= high)).all(axis=1)
    grid = np.stack(
        np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high)), indexing="ij"), axis=-1
    )
    centres = model.at(lattice.from_array(grid, kind))
    residual, valid = np.full(grid.shape[:2], np.nan), np.zeros(grid.shape[:2], bool)
    residual[tuple((site[keep] - low).T)] = miss[keep]
    valid[tuple((bright - low).T)] = True
    frame = in_frame(centres, shape, 0.5 * pitch)
    # under dust: still a lenslet
    valid = (valid & frame) | lattice.enclosed(
        valid & frame, frame, lattice.from_array(grid, kind), kind
    )
    rows, columns = (np.flatnonzero(valid.any(axis=axis)) for axis in (1, 0))
    if rows.size:  # a border of cells that the frame cuts everywhere is of no use
        block = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        centres, residual, valid = centres[block], residual[block], valid[block]
    inner = residual[valid & np.isfinite(residual)]
    place = lattice.from_array(grid[valid] if not rows.size else grid[block][valid], kind)
    mean = distortion.fit_model("affine", place, centres[valid], robust=False)
    vectors = mean.coefficients[1:] / mean.scale
    return LensletGrid(
        lattice=kind,
        pitch=np.hypot(*vectors.T),
        angle=float(np.degrees(np.arctan2(*vectors[1]))),
        centres=centres,
        valid=valid,
        residual=residual,
        rms=float(np.sqrt(np.mean(inner**2))),
        model=model.kind,
        basis=vectors,
    )
