"""Truths and label maps from their files, brought to the grid and the bands of a result."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.tiling import Plane
from plenocli.evaluation.results import Result
from plenocli.forward.camera.model import Camera

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.forward.scene.scenes import Scene

CHART = "colorchecker"
GREEN = 550e-9
"""Wavelength, m, at which a scene stands for a single picture."""
_AHEAD = 1 << 21
"""Points of a photograph that are made at once."""
_CHART_OVERSAMPLING = 20
"""Chart samples per lenslet and side when the truth of a mixed lenslet is averaged."""


def read_truth(
    truth: Path | str, result: Result, sampling: str = "fit", camera: Camera | None = None
) -> Plane:
    """The truth on the grid and at the wavelengths of a result.

    truth: a path, or a name that read_scene knows. A capture brings the object that it was
        simulated from; a finer grid is averaged over areas; other wavelengths are interpolated.
    sampling: how a photograph became the object, "fit" or "crop".
    camera: through whose filters a scene is seen (width, leak, light and all), instead of at
        their centres.

    Returns a plane like that of the result; that of a single picture is read when it is asked for.
    Raises InputError where no comparison is possible.
    """
    rows, cols = result.grid
    spectral = result.wavelengths is not None
    known = (
        None
        if camera is not None and Path(truth).suffix == ".h5" and _is_scene(truth)
        else _known_truth(truth)
    )
    if known is not None and camera is not None:
        raise InputError(
            "is known at some wavelengths only and cannot be seen through filters",
            truth,
            "name the scene itself: an image with wavelengths, a spectral EXR or colorchecker",
        )
    if known is None:
        return _scene_truth(truth, result, sampling, camera)
    values, wavelengths = known
    if not spectral and values.shape[0] != 1:
        raise InputError(
            f"has {values.shape[0]} bands, the result has one and does not say which",
            truth,
            "compare bands with a spectral result",
        )
    if not spectral:
        _same_aspect(values.shape[-2:], (rows, cols), truth)
        return _coarser_plane(values, rows, cols)
    bands = _at_wavelengths(values.window(), wavelengths, result.bands, truth)
    _same_aspect(bands.shape[-2:], (rows, cols), truth)
    return Plane.of(np.array([_coarser(plane, rows, cols) for plane in bands]))


def read_true_s1(truth: Path | str, result: Result) -> np.ndarray | None:
    """What is polarised of the light of a capture's scene, as read_truth has all of it: s1; None
    where the truth does not say it.
    """
    if Path(truth).suffix != ".h5":
        return None
    artefact = opened_truth(truth)
    degree = artefact.data.get("capture/polarisation")
    if degree is None or "capture/scene" not in artefact.data:
        return None
    values = artefact.data["capture/scene"].window() * degree
    values = _at_wavelengths(values, artefact.data.get("capture/wavelength"), result.bands, truth)
    return np.array([_coarser(plane, *result.grid) for plane in values])


def _scene_truth(truth: Path | str, result: Result, sampling: str, camera: Camera | None) -> Plane:
    """The truth of a scene, which has values at any wavelength."""
    from plenocli.files.read.scenes import read_scene
    from plenocli.forward.scene.labelled import SpectraChart
    from plenocli.forward.scene.scenes import Chart

    rows, cols = result.grid
    spectral = result.wavelengths is not None
    scene = read_scene(truth, sampling=sampling, spectral=spectral)
    if not spectral and scene.spectral:
        raise InputError(
            "is spectral, the result is a single picture",
            truth,
            "compare with a photograph or with the capture's own scene",
        )
    fine = _CHART_OVERSAMPLING if isinstance(scene, Chart) else 1
    whole = scene.whole(rows, cols) if isinstance(scene, SpectraChart) else np.array(True)

    def plane(wavelength: float) -> np.ndarray:
        seen = _coarser(scene.at(wavelength, rows * fine, cols * fine), rows, cols)
        return np.where(whole, seen, np.nan)

    if not spectral:
        return Plane((rows, cols), _Ahead(scene, rows, cols))
    if camera is not None:
        return Plane.of(through_filters(plane, camera, result.bands))
    return Plane.of(np.array([plane(w) for w in result.bands]))


class _Ahead:
    """Windows of a scene at GREEN on rows x columns points; more rows are made at once than are
    asked for, because each time the whole photograph is looked at.
    """

    def __init__(self, scene: "Scene", rows: int, columns: int) -> None:
        self.scene, self.shape = scene, (rows, columns)
        self._made, self._rows = np.empty((0, columns), np.float32), slice(0, 0)

    def __call__(self, rows: slice, columns: slice) -> np.ndarray:
        """As Plane.read."""
        first, last, _ = rows.indices(self.shape[0])
        if first < self._rows.start or last > self._rows.stop:
            ahead = max(last, min(first + _AHEAD // self.shape[1], self.shape[0]))
            self._rows = slice(first, ahead)
            self._made = self.scene.at(GREEN, *self.shape, self._rows)
        at = self._rows.start
        return self._made[first - at : last - at, columns]


def _is_scene(path: Path | str) -> bool:
    """Whether an .h5 is an image with wavelengths, which serves as a scene at any of them."""
    artefact = opened_truth(path)
    return artefact.kind == "image" and len(artefact.data["image/value"].shape) == 3


def opened_truth(path: Path | str) -> "Artefact":
    """An artefact that holds a truth, verified; its pictures are Stored.

    Raises InputError for another kind.
    """
    from plenocli.files.artefacts.reading import opened_artefact

    apart = ("capture/mosaic", "capture/scene", "image/value", "image/sigma")
    with opened_artefact(path, ("capture", "spectra", "image"), apart) as (artefact, stored):
        return replace(artefact, data={**artefact.data, **stored})


def through_filters(
    plane: Callable[[float], np.ndarray], camera: Camera, bands: np.ndarray
) -> np.ndarray:
    """Reflectance (band, row, column) as a camera with one filter a band sees it: mean of
    plane(wavelength), weighted with the light's photons, the filter's transmittance and the
    sensor's sensitivity (mean of its colours).

    plane: wavelength (m) -> reflectance (row, column).
    bands: (band,) m.

    Raises UsageError for a camera without filters, or without one at a band.
    """
    from plenocli.forward.camera.pupil import filter_transmittance
    from plenocli.forward.scene.light import broadband
    from plenocli.forward.scene.tables import illuminant
    from plenocli.forward.sensor.cfa import sensitivity

    if camera.filter_array is None:
        raise UsageError(
            "has no [filter_array], through which the truth could be seen",
            "--camera",
            "leave --camera out",
        )
    apart = [(f, f.middle) for f in camera.filter_array.filters if f.middle is not None]
    nearest = [min(apart, key=lambda one: abs(one[1] - band), default=None) for band in bands]
    filters = [one[0] for one in nearest if one is not None]
    far = [
        band
        for band, one in zip(bands, nearest, strict=True)
        if one is None or abs(one[1] - band) > one[0].width
    ]
    if far:
        raise UsageError(
            f"has no filter at {far[0] * 1e9:.4g} nm, a band of the result",
            "--camera",
            "name the camera that the result was made with",
        )
    light = broadband(camera, lambda wavelengths: illuminant(camera.light.illuminant, wavelengths))
    seen = sensitivity(camera, light.wavelengths)[1].mean(axis=0)
    weights = np.array(
        [
            [
                n * q * filter_transmittance(f, w)
                for w, n, q in zip(light.wavelengths, light.photons, seen, strict=True)
            ]
            for f in filters
        ]
    )
    total = 0.0
    for weight, wavelength in zip(weights.T, light.wavelengths, strict=True):
        total = total + weight[:, None, None] * plane(wavelength)
    return total / weights.sum(axis=1)[:, None, None]


def _known_truth(truth: Path | str) -> tuple[Plane, np.ndarray | None] | None:
    """(values (band, row, column), wavelengths or None) of a capture or spectra artefact; None
    for everything else.
    """
    path = Path(truth)
    if path.suffix != ".h5":
        return None
    artefact = opened_truth(path)
    kind = artefact.kind
    name, data = "scene" if kind == "capture" else "value", artefact.data
    if f"{kind}/{name}" not in data:
        raise InputError(
            "holds no scene: it was measured, or simulated without one",
            path,
            "name the truth itself with --truth",
        )
    stored = data[f"{kind}/{name}"]
    if isinstance(stored, np.ndarray):
        plane = Plane.of(stored)
    else:
        plane = Plane(stored.shape, stored.window)
    if len(plane.shape) == 2:
        picture = plane
        plane = Plane((1, *picture.shape), lambda rows, columns: picture.read(rows, columns)[None])
    return plane, data.get(f"{kind}/wavelength")


def _at_wavelengths(
    values: np.ndarray, own: np.ndarray | None, asked: np.ndarray, where: Path | str
) -> np.ndarray:
    """Bands (band, row, column) at the wavelengths `own` interpolated to those asked for, m."""
    if own is None:
        if len(values) == len(asked):
            return values
        raise InputError(
            f"has {len(values)} bands of unknown wavelength, the result has {len(asked)}",
            where,
            "give a truth that names its wavelengths",
        )
    if len(own) == 1 or asked.min() < own[0] - 1e-8 or asked.max() > own[-1] + 1e-8:
        if len(own) != len(asked) or np.abs(np.asarray(own) - asked).max() > 1e-9:
            raise InputError(
                f"covers {own[0] * 1e9:.4g} to {own[-1] * 1e9:.4g} nm, the result "
                f"{asked.min() * 1e9:.4g} to {asked.max() * 1e9:.4g} nm",
                where,
                "give a truth that covers the bands of the result",
            )
    position = np.interp(asked, own, np.arange(len(own)))
    low = np.minimum(position.astype(int), max(len(own) - 2, 0))
    part = (position - low)[:, None, None]
    high = np.minimum(low + 1, len(own) - 1)
    return (1 - part) * values[low] + part * values[high]


def _same_aspect(have: tuple[int, ...], want: tuple[int, int], where: Path | str) -> None:
    if have[0] * want[1] != have[1] * want[0] or have[0] < want[0]:
        raise InputError(
            f"is {have[0]} x {have[1]} samples, the result {want[0]} x {want[1]} (rows x columns)",
            where,
            "give the truth of the same object on the same or a finer grid",
        )


def _coarser(plane: np.ndarray, rows: int, cols: int) -> np.ndarray:
    """A plane averaged over areas to (rows, cols), float64; itself where it has that shape."""
    from plenocli.forward.scene.sample import area_average

    plane = np.asarray(plane, dtype=np.float64)
    return (
        plane
        if plane.shape == (rows, cols)
        else area_average(area_average(plane, rows, 0), cols, 1)
    )


def _coarser_plane(values: Plane, rows: int, cols: int) -> Plane:
    """One band, (1, row, column), averaged over areas to (rows, cols)."""
    from plenocli.forward.scene.sample import area_average

    high, wide = values.shape[-2:]
    if (high, wide) == (rows, cols):
        return Plane((rows, cols), lambda part, columns: values.read(part, columns)[0])
    size = high / rows

    def averaged(part: slice, columns: slice) -> np.ndarray:
        first, last, _ = part.indices(rows)
        top, bottom = int(first * size), min(math.ceil(last * size), high)
        found = values.window(slice(top, bottom))[0]
        edges = (first * size - top, min(last * size - top, bottom - top))
        found = area_average(found, last - first, 0, *edges)
        return area_average(found, cols, 1)[:, columns]

    return Plane((rows, cols), averaged)


def read_labels(source: Path | str, grid: tuple[int, int]) -> np.ndarray:
    """Label map of a ColorChecker on the lenslet grid.

    source: "colorchecker" for the chart as capture-sim lays it out, or a single-channel
        .png/.tif/.exr on this grid or one finer by a whole number, where only lenslets that see one
        label alone keep it.
    grid: (rows, columns).

    Returns (row, column) int: 0 nothing, 1..24 the patches row by row.
    Raises InputError where the map does not fit.
    """
    from plenocli.base.tiling import to_blocks
    from plenocli.forward.scene.chart import chart_labels

    rows, cols = grid
    if str(source) == CHART:
        return chart_labels(rows, cols, whole_cells=True).astype(int)
    from plenocli.files.images.mosaic import read_capture

    values = np.asarray(read_capture(source).mosaic)
    if values.ndim != 2 or values.shape[0] % rows or values.shape[1] % cols:
        raise InputError(
            f"is {' x '.join(map(str, values.shape))}, the result has {rows} x {cols} lenslets",
            source,
            "give one channel on the lenslet grid, or finer by a whole number",
        )
    labels = np.rint(values).astype(int)
    if np.abs(labels - values).max() > 1e-3 or labels.min() < 0 or labels.max() > 24:
        raise InputError(
            "holds values that are no labels",
            source,
            "use 0 for nothing and 1 to 24 for the patches",
        )
    blocks = to_blocks(labels, (values.shape[0] // rows, values.shape[1] // cols))
    return np.where((blocks == blocks[..., :1]).all(-1), blocks[..., 0], 0)
