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

from plenocli.base.errors import InputError, NumericsError
from plenocli.base.progress import collected_notes, note
from plenocli.base.text import by
from plenocli.forward.sensor.frames import dead_pixels, shifted_neighbours
from plenocli.inverse.grid import distortion, lattice, spots, template
from plenocli.inverse.grid.distortion import GridModel
from plenocli.inverse.grid.lattice import Periodicity
from plenocli.inverse.grid.lenslet_grid import LensletGrid

STRUCTURED = 0.2
"""Correlation half a step away, over that of a whole step, above which superpixels hold several
bright parts.
"""
NEARLY = 0.15
"""Of the pitch that is known about, by which it may be off."""
LONGEST_SIDE = 1.3
"""Of a cell's shorter side, that its longer one may be."""
STRONG = 0.6
"""Correlation, less than that of spots that repeat all over an image, 0.7 to 0.8; thin lines have
0.3 to 0.6.
"""
FAINT = 0.04
"""Of the typical light of a lenslet, below which a spot is noise of dark surroundings."""
SCATTER = 0.1
"""Of the pitch, by which spots may scatter (rms) about the best grid."""
BORDER_WEIGHT = 0.1
"""Of a lenslet without whole neighbours on all sides: light that they lack, or a cut, moves it."""
NEAR = 0.25
"""Of the pitch: what a centre may lie from where it is said to be."""
LINE = 0.1
"""Of the darkest line's depth, by which a line must stand out of what surrounds it."""
BOTTOM = 0.02
"""Of the darkest line's depth, within which a line is at its bottom."""
EDGE = 0.15
"""Of a cell: what is looked at on either side of a line's flat bottom."""
ALIKE = 0.7
"""Of the chosen lines' depth, from which on others might as well be the superpixels' borders."""
FRAME_TOLERANCE = 0.4
"""px by which a cell's edge may seem to lie outside the frame: sensors end where the array does."""
AROUND = 2
"""Sites beyond those that were measured which may be of the array, too."""
FEWEST = 100
"""Lenslets from which on a scene can be told from what repeats in it."""
LIGHT = 0.6
"""Of how far the grid of a scene moves if slopes of light within superpixels are taken for shifts:
how far off it is for what light does beyond a slope. Measured on real and simulated captures.
"""
FIX = (
    "give a white image (even light through the main lens) of a lenslet array "
    "in focus on the sensor"
)


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
    period = scene or _period(image, crop)
    basis, kind, several, times = _basis(period, lattice_kind, pitch)
    alike = max(times) > 1
    structured = several or parts or alike
    cell = basis * times[:, None]
    pitch = float(np.hypot(*cell.T).min())
    index, position, clean, slope = (
        _parts_sites(image, basis, times, even=scene is None)
        if alike
        else _measured_sites(image, basis, kind, pitch, structured, even=scene is None)
    )
    basis = cell
    inside = _whole(position, image.shape, 0.5 * pitch) & clean
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
        moved = _to_dark_borders(image, model, index[inside], pitch, near=near, count=count)
        position = position + moved.at(index) - model.at(index)
        model, lit = moved, _lit_cells(image, moved, index[inside])
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
    centre = model.at(np.rint(_index_at(model, near)))
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


def prepare(
    white: np.ndarray, cfa: str = "mono", dark: np.ndarray | float | None = None
) -> np.ndarray:
    """Float image with dark removed, the mosaic's colours equalised, dead and hot pixels replaced,
    and the background at zero; arguments as find_grid's.

    Raises as find_grid for an image that cannot hold a grid.
    """
    white = np.asarray(white)
    if white.ndim != 2 or min(white.shape) < 24:
        raise InputError(
            "a white image must be a single plane of at least 24 x 24 px, this "
            f"has {by(white.shape)}"
        )
    image = white.astype(np.float32)
    if dark is not None:
        image -= np.asarray(dark, np.float32)
    if not np.isfinite(image).all():
        raise InputError("the white image holds values that are not finite")
    if np.ptp(image) <= 0:
        raise NumericsError(
            f"no lenslet lattice in the image: every pixel has the value {float(white.flat[0]):g}",
            fix=FIX,
        )
    step = 1
    if cfa != "mono":
        step = 2
        means = np.array([[image[i::2, j::2].mean() for j in (0, 1)] for i in (0, 1)])
        if (means <= 0).any():
            raise NumericsError(
                "a colour of the mosaic saw no light in the white image",
                fix="use a broad-band white source",
            )
        for i in (0, 1):
            for j in (0, 1):
                image[i::2, j::2] *= np.float32(means.mean() / means[i, j])
    image = _replace_dead(image, step)
    sample = image[:: max(1, image.shape[0] // 1000), :: max(1, image.shape[1] // 1000)]
    return image - np.float32(np.percentile(sample, 0.5))


def _replace_dead(image: np.ndarray, step: int) -> np.ndarray:
    bad = dead_pixels(image, step)
    if not bad.any():
        return image
    out = image.copy()
    out[bad] = (sum(n[bad].astype(np.float64) for n in shifted_neighbours(image, step)) / 4).astype(
        np.float32
    )
    return out


def _period(image: np.ndarray, crop: int) -> Periodicity:
    """How a white image repeats in its brightest part. Where it does so weakly, dark surroundings
    of the array may hide thin lines: then in what is lit alone, or in the middle of that.
    """
    found = [lattice.find_basis(brightest_crop(image, crop))]
    if found[0].strength < STRONG:
        parts = (_lit_part(image, share) for share in (1.0, 0.7))
        found += [lattice.find_basis(brightest_crop(part, crop)) for part in parts]
    best = max(one.strength for one in found)
    return next(one for one in found if one.strength >= 0.9 * best)


def _lit_part(image: np.ndarray, share: float) -> np.ndarray:
    """The rows and columns that have at least half of the light of the brightest ones, `share` of
    them in the middle.
    """
    sides = []
    for axis in (0, 1):
        light = image.mean(axis=1 - axis)
        lit = np.flatnonzero(light > 0.5 * np.quantile(light, 0.95))
        first, last = (lit[0], lit[-1] + 1) if len(lit) else (0, len(light))
        cut = int((1 - share) / 2 * (last - first))
        sides.append(slice(first + cut, last - cut))
    return image[tuple(sides)]


def brightest_crop(image: np.ndarray, most: int) -> np.ndarray:
    """Up to `most` px a side around the centroid of the light."""
    clipped = np.clip(image[::4, ::4], 0, None).astype(float)
    total = clipped.sum()
    low = []
    for axis in (0, 1):
        size = min(most, image.shape[axis])
        profile = clipped.sum(axis=1 - axis)
        centre = (
            4 * (profile * np.arange(len(profile))).sum() / total
            if total > 0
            else image.shape[axis] / 2
        )
        low.append(int(np.clip(centre - size / 2, 0, image.shape[axis] - size)))
    return image[low[0] : low[0] + most, low[1] : low[1] + most]


def _measured_sites(
    image: np.ndarray,
    basis: np.ndarray,
    kind: str,
    pitch: float,
    structured: bool,
    *,
    even: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Numbered centroids on the flattened image: index (N, 2), position (N, 2), clean (N,) bool,
    slope of the light (N, 2); lenslets that are not lit evenly are refused where `even`.
    """
    window = spots.WIDE_WINDOW if structured else spots.WINDOW
    maxima = spots.find_maxima(image, pitch, 0.28 if structured else 0.18)
    if len(maxima) < 9:
        raise NumericsError(
            (
                f"no lenslet lattice in the image: {len(maxima)} bright spots at a "
                f"pitch of {pitch:.1f} px"
            ),
            fix=FIX,
        )
    position, flux = spots.windowed_centroids(image, maxima, pitch, iterations=2, window=window)
    lit = flux > FAINT * _typical(flux)
    position, flux = position[lit], flux[lit]
    middle = np.array(image.shape) / 2
    bright = np.flatnonzero(flux > 0.5 * np.median(flux))
    starts = bright[np.argsort(((position[bright] - middle) ** 2).sum(axis=1))]
    best, chosen = np.zeros(len(position), bool), None
    # a start on dust or a reflection strands the walk
    for start in starts[:: max(1, len(starts) // 6)][:6]:
        index, found = lattice.index_sites(position, basis, kind, start)
        if found.sum() > best.sum():
            best, chosen = found, index
        if best.sum() > 0.6 * len(position):
            break
    assert chosen is not None  # a walk finds its start at least
    index, first, flux = chosen[best], position[best], flux[best]
    surface, slope = _illumination(
        first, flux, image.shape, _whole(first, image.shape, 0.45 * pitch)
    )
    slope = slope / np.maximum(surface, 1e-9)[:, None]
    level = flux / np.maximum(surface, 1e-9)
    spread = 1.48 * np.median(np.abs(level - np.median(level)))
    if even and spread > 0.1:  # real white images have 0.02 at most
        raise NumericsError(
            (
                f"no lenslet lattice in the image: patches repeat every {pitch:.1f} px, but their "
                f"brightness scatters by {100 * spread:.0f} % from one to the next (a chart or a "
                "scene, not even light)"
            ),
            fix=FIX,
        )
    return index, first, level > 0.3, slope


def _parts_sites(
    image: np.ndarray, basis: np.ndarray, times: np.ndarray, *, even: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """As _measured_sites, of superpixels whose parts look alike: the first part of each, found
    where their lattice is square.

    basis: vectors [down, right] from part to part, of which `times` make a superpixel.
    """
    from scipy import ndimage

    side = float(np.hypot(*basis.T).min())
    to_image = basis / side
    corners = np.array(list(np.ndindex(2, 2))) * image.shape @ np.linalg.inv(to_image)
    low, high = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
    square = ndimage.affine_transform(
        image, to_image.T, low @ to_image, tuple((high - low).astype(int)), order=1
    )
    index, position, clean, slope = _measured_sites(
        square, side * np.eye(2), "square", side, False, even=even
    )
    first = (index % times == 0).all(axis=1)
    position = (position[first] + low) @ to_image
    slope = slope[first] @ np.linalg.inv(to_image).T
    return index[first] // times, position, clean[first], slope


def _typical(light: np.ndarray) -> float:
    """Median of what is not dark, as most of a frame may be beside a small array."""
    return float(np.median(light[light > 0.1 * np.quantile(light, 0.98)])) if light.size else 0.0


def _illumination(
    position: np.ndarray, flux: np.ndarray, shape: tuple[int, ...], whole: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Smooth surface (order up to 4) through the fluxes of `whole` lenslets: values (N,) and
    gradients (N, 2) per px.
    """
    size = np.array(shape, float) / 2
    u = (position - size) / size
    use = whole if whole.sum() >= 9 else np.ones(len(u), bool)
    order = max(k for k in range(5) if k == 0 or use.sum() >= 2.5 * (k + 1) * (k + 2) / 2)
    powers = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    design = np.stack([u[:, 0] ** i * u[:, 1] ** j for i, j in powers], axis=1)
    weight = use.astype(float)
    for _ in range(4):
        fit = np.linalg.lstsq(design * weight[:, None], flux * weight, rcond=None)[0]
        miss = np.abs(flux - design @ fit)
        weight = use / np.maximum(1, miss / max(3 * np.median(miss[use]), 1e-12))
    down = (
        np.stack([i * u[:, 0] ** max(i - 1, 0) * u[:, 1] ** j for i, j in powers], axis=1)
        @ fit
        / size[0]
    )
    right = (
        np.stack([j * u[:, 0] ** i * u[:, 1] ** max(j - 1, 0) for i, j in powers], axis=1)
        @ fit
        / size[1]
    )
    surface = np.maximum(design @ fit, 0.05 * np.median(flux))
    return surface, np.stack([down, right], axis=1)


def _to_dark_borders(
    image: np.ndarray,
    model: GridModel,
    index: np.ndarray,
    pitch: float,
    *,
    near: Sequence[float] | None,
    count: Sequence[int] | None,
) -> GridModel:
    """The map moved so that cell borders lie on dark lines between superpixels.

    The brightness of several parts draws a centroid towards the brightest; dark lines, seen in
    profiles along both lattice directions of all cells folded into one, do not care. Lines between
    the parts may be as dark as those between superpixels: of several candidates the one nearest to
    `near`, that of the known `count`, or the best filled frame, decides.
    """
    lines = [_dark_lines(image, model, index, pitch, axis) for axis in (0, 1)]
    found = []
    for down, depth_down in lines[0]:
        for right, depth_right in lines[1]:
            moved = replace(model, shift=model.shift - np.array([down, right]))
            whole = _whole(moved.at(_block(index)), image.shape, 0.5 * pitch)
            hint = 0.0
            if near is not None:
                hint = -float(np.hypot(*(moved.at(np.rint(_index_at(moved, near))) - near)))
            elif count is not None:
                lit = _lit_cells(image, moved, index)
                shape = np.ptp(lit, axis=0) + 1 if len(lit) else (0, 0)
                hint = -float(np.abs(np.subtract(shape, count)).sum())
            found.append(((hint, int(whole.sum())), depth_down + depth_right, moved))
    if not found:
        return model
    merit, depth, chosen = max(found, key=lambda one: one[:2])
    others = [m for m in found if m[2] is not chosen and m[0] == merit and m[1] > ALIKE * depth]
    if others:
        centre = chosen.at(np.rint(_index_at(chosen, np.array(image.shape) / 2)))
        note(
            "warning: lines within superpixels are nearly as dark as those between them, and "
            f"{len(others) + 1} grids fill the frame alike; the darkest lines are taken, which "
            f"puts a centre at row {centre[0]:.1f}, column {centre[1]:.1f}: if no superpixel has "
            "its middle there, say where one has"
        )
    return chosen


def _dark_lines(
    image: np.ndarray, model: GridModel, index: np.ndarray, pitch: float, axis: int
) -> list[tuple[float, float]]:
    """Dark lines across one lattice direction: [(distance of the line from the cell's
    border, cells; depth)].
    """
    from scipy.signal import find_peaks

    chosen = index[:: max(1, len(index) // 300)]
    bins = max(24, int(4 * pitch))
    along = (np.arange(bins) + 0.5) / bins
    across = (np.arange(16) + 0.5) / 16 - 0.5
    grid = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1)[
        ..., :: 1 if axis == 0 else -1
    ]
    vectors = np.stack(
        [model.at(chosen + step / 2) - model.at(chosen - step / 2) for step in np.eye(2)], axis=1
    )
    where = model.at(chosen)[:, None, None] + np.einsum("abk,nkd->nabd", grid, vectors)
    profile = _between(image, where).mean(axis=(0, 2), dtype=float)
    kernel = np.ones(max(1, bins // 24)) / max(1, bins // 24)
    smooth = np.convolve(np.tile(profile, 3), kernel, "same")[bins : 2 * bins]
    depth = smooth.max() - smooth
    # a dark band is one line, however its bottom is ruffled; folded thrice, no line is cut
    folded = np.tile(depth, 3)
    bottom = BOTTOM * depth.max()
    peaks, _ = find_peaks(folded, height=0.35 * depth.max(), prominence=LINE * depth.max())
    left = np.array([np.flatnonzero(folded[:p] < folded[p] - bottom)[-1] for p in peaks])
    right = np.array([p + np.flatnonzero(folded[p:] < folded[p] - bottom)[0] for p in peaks])
    middle = (left + right + 1) / 2 / bins - 1
    once = (middle >= 0) & (middle < 1)
    lines = []
    for peak, start, flat in zip(peaks[once], middle[once], (right - left)[once] / bins):
        others = np.abs((middle[once] - start + 0.5) % 1 - 0.5)
        reach = min(flat / 2 + EDGE, others[others > 1e-9].min(initial=0.8) / 2)
        for _ in range(2):  # the second time with the line in the middle of what is looked at
            start = start + _line(along, profile, start, reach)
        lines.append((start - 0.5, float(folded[peak])))
    return lines


def _between(image: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Values of `image` at places (..., 2) px by linear interpolation, those
    outside at the border.
    """
    where = np.clip(where, 0, np.array(image.shape) - 1)
    low = np.minimum(where.astype(int), np.array(image.shape) - 2)
    down, right = np.moveaxis((where - low).astype(np.float32), -1, 0)
    i, j = np.moveaxis(low, -1, 0)
    above = image[i, j] * (1 - right) + image[i, j + 1] * right
    return above * (1 - down) + (image[i + 1, j] * (1 - right) + image[i + 1, j + 1] * right) * down


def _line(along: np.ndarray, profile: np.ndarray, start: float, reach: float) -> float:
    """Middle of the dark line at `start` less `start`, cells: midway between two blurred edges,
    each of its own side's brightness.

    The darkest place itself, or the centre of the darkness, lies nearer to the dimmer side: a
    quarter of a pixel between a filter that passes much and one that passes little.
    """
    from scipy.optimize import least_squares
    from scipy.special import erf

    away = (along - start + 0.5) % 1 - 0.5
    close = np.abs(away) < reach
    x, y = away[close], profile[close]
    sides = [y[side] for side in (x < -0.5 * reach, x > 0.5 * reach)]
    if min(map(len, sides)) == 0:  # lines lie so near to each other that nothing is between
        return 0.0
    levels = [max(float(side.mean()), 0.0) for side in sides]
    scale = max(*levels, 1e-30)

    def miss(p):
        middle, half, blur, left, right = p
        return (
            left * (1 - erf((x - middle + half) / blur))
            + right * (1 + erf((x - middle - half) / blur))
        ) / 2 - y / scale

    found = least_squares(
        miss,
        [0.0, 0.25 * reach, 0.25 * reach, levels[0] / scale, levels[1] / scale],
        bounds=([-reach / 2, 0, 0.02 * reach, 0, 0], [reach / 2, reach, reach, 3, 3]),
        x_scale=[reach, reach, reach, 1, 1],
    )
    return float(found.x[0])


def _index_at(model: GridModel, position: Sequence[float] | np.ndarray) -> np.ndarray:
    """Index (2,), not whole, that the map takes to `position`: Newton steps
    from the affine part.
    """
    site = np.zeros(2)
    for _ in range(20):
        here = model.at(site)
        slope = np.stack([model.at(site + step) - here for step in np.eye(2)], axis=1)
        site = site + np.linalg.solve(slope, np.asarray(position, float) - here)
    return site


def _block(index: np.ndarray) -> np.ndarray:
    """Indices (M, N, 2) of a block of sites around `index` (N, 2) and AROUND more: further out no
    map is to be trusted.
    """
    low, high = index.min(axis=0) - AROUND, index.max(axis=0) + AROUND
    return np.stack(
        np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high)), indexing="ij"), axis=-1
    )


def _lit_cells(image: np.ndarray, model: GridModel, index: np.ndarray) -> np.ndarray:
    """Indices (N, 2) of the sites in the `_block` of `index` whose cell holds at least 0.3 of the
    typical light.
    """
    cells = _block(index)
    inner = np.stack(np.meshgrid(*[np.linspace(-0.4, 0.4, 9)] * 2, indexing="ij"), axis=-1)
    near = np.rint(model.at(cells[:, :, None, None] + inner)).astype(int)
    frame = np.array(image.shape) - 1
    inside = ((near >= 0) & (near <= frame)).all(axis=(-1, 2, 3))
    near = np.clip(near, 0, frame)
    light = image[near[..., 0], near[..., 1]].mean(axis=(2, 3))
    return cells[inside & (light > 0.3 * _typical(light[inside]))]


def _whole(position: np.ndarray, shape: tuple[int, ...], margin: float) -> np.ndarray:
    low = margin - 0.5 - FRAME_TOLERANCE
    return np.all((position >= low) & (position <= np.array(shape) - 1 - low), axis=-1)


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
    frame = _whole(centres, shape, 0.5 * pitch)
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
