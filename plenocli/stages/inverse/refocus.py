"""refocus: views, pictures focused at other distances and a depth map from one capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import UsageError

if TYPE_CHECKING:
    from plenocli.inverse.lightfield.light_field import Optics
    from plenocli.inverse.lightfield.planes import DepthMap
    from plenocli.inverse.lightfield.samples import Samples


@dataclass(frozen=True, kw_only=True)
class RefocusSummary:
    """What refocus made.

    lenslets: rows and columns of a picture, in lenslet pitches.
    sharpest_slope: of the plane whose picture is the sharpest, px per px.
    slopes, sharpness: of every plane.
    sharpest_distance_m: None without a camera or beyond infinity.
    depth_known_share: of the depth map; None without one.
    depth_beyond_share: of the depth map, with texture but beyond the slopes tried.
    """

    output: str
    planes: int
    lenslets: list[int]
    sharpest_slope: float
    slopes: list[float]
    sharpness: list[float]
    sharpest_distance_m: float | None
    depth_known_share: float | None
    depth_beyond_share: float | None

    def as_json(self) -> dict[str, Any]:
        """The summary of --json."""
        return asdict(self)


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
    slopes: of planes; without either, `planes` slopes around the lenslets' own plane, and more
        of them, as far apart, while what has texture lies beyond. A depth map needs at least three
        planes.
    views: along each side, 0 for none.

    Raises UsageError, InputError, OutputError.
    """
    from plenocli.files.artefacts.container import write_artefact
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output
    from plenocli.files.read.cameras import read_camera
    from plenocli.files.results.lightfields import lightfield_artefact
    from plenocli.inverse.lightfield.light_field import WIDER, Optics, refocused

    output = Path(output)
    check_output(
        output, overwrite=overwrite, inputs=[capture, calibration, camera], suffixes=(".h5",)
    )
    optics = None if camera is None else Optics.of(read_camera(camera))
    tried = _slopes(slopes, distances, planes, optics)
    grow = not (slopes or distances)
    samples, shape = _samples(capture, calibration, len(tried) * (WIDER if grow else 1))
    field = refocused(samples, shape, tried, views=views, optics=optics, grow=grow)
    known, beyond = _told(field.depth, field.slopes)
    inputs = describe_inputs({"capture": capture, "calibration": calibration, "camera": camera})
    write_artefact(
        output,
        lightfield_artefact(field, samples, Provenance(command=command, inputs=inputs, seed=seed)),
        overwrite=overwrite,
    )
    best = int(np.argmax(field.sharpness))
    distance = np.nan if field.distances is None else float(field.distances[best])
    return RefocusSummary(
        output=str(output),
        planes=len(field.slopes),
        lenslets=list(shape),
        sharpest_slope=float(field.slopes[best]),
        slopes=field.slopes.tolist(),
        sharpness=field.sharpness.tolist(),
        sharpest_distance_m=None if np.isnan(distance) else distance,
        depth_known_share=known,
        depth_beyond_share=beyond,
    )


def _samples(
    capture: Path | str, calibration: Path | str | None, planes: int
) -> tuple[Samples, tuple[int, int]]:
    """Samples of a capture, or of spectra that demux made of one, and the shape of a picture."""
    from plenocli.files.images.mosaic import read_capture
    from plenocli.files.opened_file import open_file
    from plenocli.files.read.calibrations import read_calibration
    from plenocli.files.results.results import read_result
    from plenocli.inverse.lightfield.gather import samples_of, samples_of_spectra

    if open_file(capture).kind == "spectra":
        if calibration is None:
            raise UsageError(
                "holds spectra, and the calibration knows through which part of the pupil each "
                "band came",
                capture,
                "give --calibration, the one of demux",
            )
        spectra = read_result(capture, ("spectra",))
        assert spectra.wavelengths is not None
        known = read_calibration(calibration)
        return samples_of_spectra(spectra.values, spectra.wavelengths, known, where=calibration)
    found = None if calibration is None else read_calibration(calibration, response=False)
    return samples_of(read_capture(capture), found, planes=planes, where=calibration)


def _told(depth: DepthMap | None, slopes: np.ndarray) -> tuple[float | None, float | None]:
    """Shares of a depth map that are known and that lie beyond the slopes, which a note tells."""
    from plenocli.base.progress import note

    if depth is None:
        return None, None
    beyond = depth.beyond or 0.0
    if beyond > 0:
        note(
            f"{100 * beyond:.3g} % of the depth map has texture but lies beyond slopes "
            f"{slopes[0]:.3g} to {slopes[-1]:.3g}: unknown there"
        )
    return float(np.isfinite(depth.slope).mean()), beyond


def _slopes(
    slopes: Sequence[float], distances: Sequence[float], planes: int, optics: Optics | None
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
        from plenocli.inverse.lightfield.light_field import usual_slopes

        slopes = usual_slopes(planes).tolist()
    return np.array(sorted(set(float(s) for s in slopes)))
