"""refocus: views, pictures focused at other distances and a depth map from one capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError, UsageError

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.lightfield.planes import LightField
    from plenocli.inverse.lightfield.samples import Samples

RANGE = 3.0
"""Slopes from -RANGE to RANGE are searched where no distances are given: a lenslet's width of
parallax across the pupil is one.
"""


@dataclass(frozen=True, kw_only=True)
class RefocusSummary:
    """What refocus made.

    lenslets: rows and columns of a picture, in lenslet pitches.
    sharpest_slope: of the plane whose picture is the sharpest, px per px.
    slopes, sharpness: of every plane.
    sharpest_distance_m: None without a camera or beyond infinity.
    """

    output: str
    planes: int
    lenslets: list[int]
    sharpest_slope: float
    slopes: list[float]
    sharpness: list[float]
    sharpest_distance_m: float | None

    def as_json(self) -> dict[str, Any]:
        """The summary of --json."""
        return asdict(self)


@dataclass(frozen=True)
class _Optics:
    """Distances of a camera, m: focal length of the main lens, from it to the lenslets, from these
    to the sensor.
    """

    focal_length: float
    image_distance: float
    sensor_distance: float

    def slope(self, distance: float) -> float:
        """Of the plane at `distance` m."""
        from plenocli.inverse.lightfield.planes import slope_of

        return slope_of(distance, self.focal_length, self.image_distance, self.sensor_distance)

    def distance(self, slopes: np.ndarray) -> np.ndarray:
        """Of planes of these slopes, m; NaN beyond infinity."""
        from plenocli.inverse.lightfield.planes import distance_of

        found = distance_of(slopes, self.focal_length, self.image_distance, self.sensor_distance)
        return np.where(np.isfinite(found), found, np.nan)


def run_refocus(
    capture: Path | str,
    output: Path | str,
    *,
    calibration: Path | str | None = None,
    camera: Path | str | None = None,
    distances: Sequence[float] = (),
    slopes: Sequence[float] = (),
    planes: int = 13,
    views: int = 3,
    overwrite: bool = False,
    seed: int = 0,
    command: str = "",
) -> RefocusSummary:
    """Refocus one capture and write a light-field artefact.

    capture: mosaic, raw file or capture artefact.
    calibration: its lenslet grid and white image; a simulated capture needs none.
    camera: description (.toml) that turns slopes into distances.
    distances: of planes in front of the main lens, m (needs `camera`).
    slopes: of planes; without either, `planes` slopes from -RANGE to RANGE. A depth map needs at
        least three planes.
    views: along each side, 0 for none.

    Raises UsageError, InputError, OutputError.
    """
    from plenocli.files.artefacts.container import write_artefact
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output
    from plenocli.files.results.lightfields import lightfield_artefact

    output = Path(output)
    check_output(
        output, overwrite=overwrite, inputs=[capture, calibration, camera], suffixes=(".h5",)
    )
    optics = None if camera is None else _optics(camera)
    tried = _slopes(slopes, distances, planes, optics)
    samples, shape = _samples(capture, calibration, len(tried))
    field = _refocused(samples, shape, tried, views, optics)
    inputs = describe_inputs({"capture": capture, "calibration": calibration, "camera": camera})
    write_artefact(
        output,
        lightfield_artefact(field, samples, Provenance(command, inputs, seed)),
        overwrite=overwrite,
    )
    best = int(np.argmax(field.sharpness))
    distance = np.nan if field.distances is None else float(field.distances[best])
    return RefocusSummary(
        output=str(output),
        planes=len(tried),
        lenslets=list(shape),
        sharpest_slope=float(tried[best]),
        slopes=tried.tolist(),
        sharpness=field.sharpness.tolist(),
        sharpest_distance_m=None if np.isnan(distance) else distance,
    )


def _refocused(
    samples: Samples, shape: tuple[int, int], slopes: np.ndarray, views: int, optics: _Optics | None
) -> LightField:
    """Planes, depth map and views of the samples of a capture."""
    from plenocli.inverse.lightfield import refocus as focus
    from plenocli.inverse.lightfield.depth import depth
    from plenocli.inverse.lightfield.planes import LightField

    pictures = np.stack([focus.refocus(samples, slope, shape)[0] for slope in slopes])
    found = depth(samples, slopes.tolist(), shape) if len(slopes) >= 3 else None
    if found is not None and optics is not None:
        found = replace(found, distance=optics.distance(found.slope))
    return LightField(
        pictures=pictures,
        slopes=slopes,
        sharpness=np.array([focus.sharpness(p) for p in pictures]),
        distances=None if optics is None else optics.distance(slopes),
        depth=found,
        views=focus.views(samples, views, shape) if views else None,
    )


def _optics(path: Path | str) -> _Optics:
    """The distances of a camera file."""
    from plenocli.files.read.cameras import read_camera

    camera = read_camera(path)
    return _Optics(
        camera.main_lens.focal_length, camera.lenslet_array.distance, camera.sensor.distance
    )


def _slopes(
    slopes: Sequence[float], distances: Sequence[float], planes: int, optics: _Optics | None
) -> np.ndarray:
    """Slopes of the planes asked for, rising, each once."""
    if slopes and distances:
        raise UsageError(
            "give planes as --distance or as --slope, not both", "--slope", "leave one of them out"
        )
    if distances:
        if optics is None:
            raise UsageError(
                "distances need the camera's description",
                "--distance",
                "give --camera, or name planes by --slope",
            )
        slopes = [optics.slope(d) for d in distances]
    elif not slopes:
        slopes = np.linspace(-RANGE, RANGE, planes).tolist()
    return np.array(sorted(set(float(s) for s in slopes)))


PIXEL_BYTES, PLANE_BYTES = 126, 1
"""Memory for each pixel of the capture, and for each of its pixels and each plane (measured)."""


def _samples(
    capture: Path | str,
    calibration: Path | str | None,
    planes: int = 1,
) -> tuple[Samples, tuple[int, int]]:
    """(Samples, (rows, columns) of the picture in lenslet pitches) of a capture, along a
    calibration's grid or the tiles that its file names.
    """
    from plenocli.base.budget import budget
    from plenocli.files.images.mosaic import read_capture

    shot = read_capture(capture)
    budget().require(
        shot.mosaic.size * (PIXEL_BYTES + PLANE_BYTES * planes),
        "refocusing",
        capture,
        "cut the capture",
    )
    if shot.cfa != "mono":
        raise InputError(
            f"has the colour filter array {shot.cfa}; refocusing takes grey captures",
            capture,
            "demultiplex it first",
        )
    samples = _along_tiles(shot, capture) if calibration is None else _along_grid(shot, calibration)
    if samples.value.size == 0:
        raise InputError(
            "has no lit superpixel on the grid",
            capture,
            "check the white image and the calibration",
        )
    # pitches are measured
    rows, columns = (max(1, int(np.ceil(n / samples.pitch - 0.1))) for n in shot.shape)
    return samples, (rows, columns)


def _along_grid(shot: Capture, path: Path | str) -> Samples:
    """Samples along the grid of the calibration at `path`, relative to its white image."""
    from plenocli.files.read.calibrations import read_calibration
    from plenocli.inverse.lightfield.samples import collect

    calibration = read_calibration(path, response=False)
    white = calibration.white
    if white is None or white.flat is None or white.flat.shape != shot.shape:
        raise InputError(
            "holds no white image of this sensor",
            path,
            "calibrate with the white image of the camera that took the capture",
        )
    signal = shot.mosaic - (0.0 if calibration.dark is None else calibration.dark.mean)
    # the flat image is 1 in every superpixel: what light each has comes back
    if white.level is not None:
        signal = signal / float(np.nanmedian(white.level))
    grid = calibration.grid
    return collect(
        signal, np.nan_to_num(white.flat), grid.centres, grid.valid, float(np.mean(grid.pitch))
    )


def _along_tiles(shot: Capture, path: Path | str) -> Samples:
    """Samples along the superpixels that a simulated capture tells of, relative to what all of
    them have in common, which stands for a white image; `path`: of the capture.
    """
    from plenocli.inverse.lightfield.samples import collect

    size = shot.grid.shape if shot.grid else None
    if size is None:
        raise InputError(
            "does not say where its lenslets are",
            path,
            "give --calibration (from calibrate) with the white image of this camera",
        )
    count = [shot.shape[axis] // size[axis] for axis in (0, 1)]
    signal = shot.signal()
    mean = signal.reshape(count[0], size[0], count[1], size[1]).mean(axis=(0, 2))
    places = ((np.arange(n) + 0.5) * s - 0.5 for n, s in zip(count, size))
    return collect(
        signal / mean.max(),
        np.tile(mean / mean.max(), count),
        np.stack(np.meshgrid(*places, indexing="ij"), axis=-1),
        np.ones(count, bool),
        float(np.mean(size)),
    )
