"""The picture of one capture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.budget import on_threads
from plenocli.base.progress import note
from plenocli.base.tiling import Plane, bands
from plenocli.execution.pool import InProcess, Pool
from plenocli.files.read.calibrations import read_white
from plenocli.files.read.captures import describe_capture, room_beside
from plenocli.forward.sensor.cfa import cfa_map
from plenocli.forward.sensor.light_meter import Light
from plenocli.forward.sensor.superpixel import extract_rows
from plenocli.inverse.calibration.calibration import Windows, there
from plenocli.inverse.picture.estimate import estimate
from plenocli.inverse.picture.footprint import require_reconstruction
from plenocli.inverse.picture.methods.registry import METHODS
from plenocli.inverse.picture.reconstruction import Choice, Reconstruction
from plenocli.inverse.picture.superpixels import clipped_windows, windows_of
from plenocli.inverse.picture.tiles import (
    EVERY,
    tiles_of,
)
from plenocli.stages.inverse.reconstruct.field_classes import picture_by_class
from plenocli.stages.inverse.reconstruct.fitted_matrix import likely_cause
from plenocli.stages.inverse.reconstruct.in_tiles import (
    error_that_counts,
    matrix_of_capture,
    matrix_that_serves,
    picture_in_tiles,
)
from plenocli.stages.inverse.reconstruct.recipe import (
    Recipe,
    Settings,
    estimators_by,
    estimators_of,
    field_of,
    source_of,
)
from plenocli.stages.inverse.reconstruct.solved import Solved
from plenocli.stages.inverse.reconstruct.truth import truth_of

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture

BAND = 1 << 20
"""Pixels of superpixels that are summed at a time."""


def reconstruct_capture(
    recipe: Recipe,
    capture: Path,
    *,
    targets: Mapping[Path, Path],
    pool: Pool | None = None,
    far: bool = False,
) -> Solved:
    """The picture of one capture; what many captures need is made once a process.

    targets: by the captures, the files beside which tiles may lie.
    pool: for tiles, None for this process.
    far: whether what lies there is not found by who writes the result.
    """
    settings, where = recipe.settings, None if far else targets.get(capture)
    if recipe.pif is None and recipe.calibration is not None:
        choice = Choice(method="block-mean", reason="sum over the superpixel, over that of white")
        value, rgb = _white_normalised(capture, recipe.calibration, where)
        found = Reconstruction(value=value, method=choice.method, trace=(choice,))
        return _solved(found, settings, capture, rgb=rgb)
    estimators, method = estimators_of(recipe), METHODS[settings.method]
    system = estimators.system
    source = source_of(recipe, capture, method.each_pixel, where)
    tasks, tiles = pool or InProcess(), tiles_of(estimators, method, source.count)
    if field_of(recipe) is not None:
        return picture_by_class(recipe, capture, source, tasks, where)
    if len(tiles) > 1:
        return picture_in_tiles(recipe, capture, source, tiles, tasks, where)
    data = source.cut(*EVERY)
    Light.of([(data.y, None)]).tell(capture.name)
    require_reconstruction(
        estimators,
        data.y.shape[0] * data.y.shape[1],
        data.sigma,
        capture,
        method.all_phases,
        joint=method.makes_joint_estimate(estimators),
    )
    known = truth_of(recipe, source.count)
    truth = None if known is None else known.cut(*EVERY)
    with on_threads(settings.workers):
        told = matrix_of_capture(recipe, source, capture)
        matrix, limits = matrix_that_serves(recipe, told, data)
        estimators = estimators_by(recipe, matrix)
        off, cause = error_that_counts(limits), partial(likely_cause, estimators)
        found, seen = estimate(estimators, method, data, truth, model_error=off, explain=cause)
    return _solved(
        found.as_picture(system.object_shape),
        settings,
        capture,
        seen=seen,
        limits=limits,
        block=system.object_shape,
        bands=system.bands,
    )


def _solved(found: Reconstruction, settings: Settings, capture: Path, **more: Any) -> Solved:
    picture = found.value
    return Solved(
        capture=describe_capture(capture),
        found=replace(found, value=np.maximum(picture, 0) if settings.clip else picture),
        negative_share=float(np.mean(picture < 0)),
        **more,
    )


def _white_normalised(
    capture: Path, calibration: Path, beside: Path | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """One value a lenslet (lenslet_row, lenslet_column): the superpixel's sum over that of the
    white reference; 0 where it cannot be had. Of pixels with colours also linear sRGB (3,
    lenslet_row, lenslet_column), each colour's sum over its own of white.

    Pixels that the calibration masked (dead, or under dust) are left out of both sums.
    beside: as of superpixel_source.
    """
    from plenocli.files.images.mosaic import capture_in_file

    shot = capture_in_file(capture, room=room_beside(beside))
    known = read_white(calibration, in_file=True)
    rgb_too = shot.cfa != "mono" and not set("RGB") - set(shot.cfa)
    count, pixels = known.grid.valid.shape, int(np.prod(there(known.windows).shape))
    values, colours = [], []
    parts = bands(count[0], BAND // (pixels * count[1]))
    for rows in parts:
        signal, white = windows_of(shot, known, rows)
        if rows == parts[len(parts) // 2]:  # what is wrong with all of it is wrong in the middle
            Light.of([(signal, clipped_windows(shot, known, rows))]).tell(capture.name)
        usable = np.isfinite(signal) & np.isfinite(white)
        values.append(_share(signal, white, usable))
        lit = (_of_colour(shot, there(known.windows), rows, n) for n in ("RGB" if rgb_too else ""))
        colours.append([np.nan_to_num(_share(signal, white, usable & n), posinf=0.0) for n in lit])
    value, rgb = np.concatenate(values), None
    if rgb_too:
        rgb = np.concatenate([np.stack(own) for own in colours], axis=1)
        rgb = rgb if shot.profile is None else np.tensordot(shot.profile.to_rgb, rgb, axes=1)
    lost = ~np.isfinite(value)
    if lost.any():
        note(
            f"{Path(capture).name}: {int(lost.sum())} of {lost.size} lenslets lie partly off the "
            "sensor or are dark; they are 0 in the picture"
        )
    return np.where(lost, 0, value), rgb


def _share(signal: np.ndarray, white: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Of each superpixel (row, column, pixel), the sum of what counts over that of white."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(counted, signal, 0).sum(2) / np.where(counted, white, 0).sum(2)


def _of_colour(shot: Capture, windows: Windows, rows: slice, letter: str) -> np.ndarray:
    """Which pixels of some rows of windows are of one colour, (row, column, pixel)."""

    def places(some: slice, _: slice) -> np.ndarray:
        first, last, __ = some.indices(shot.shape[0])
        return cfa_map((last - first, shot.shape[1]), shot.cfa, (first % 2, 0)) == letter

    return extract_rows(Plane(shot.shape, places), windows.origin[rows], windows.shape) == 1
