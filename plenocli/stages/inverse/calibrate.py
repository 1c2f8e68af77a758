"""calibrate: lenslet grid, white, dark and response F of a camera from its captures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import UsageError
from plenocli.base.progress import note
from plenocli.files.read.series import read_series, true_centres
from plenocli.inverse.calibration.calibration import there
from plenocli.inverse.calibration.measure import Measured, NarrowBands, calibrate

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.calibration.calibration import Response
    from plenocli.inverse.grid.lenslet_grid import LensletGrid

Name = str | Path

GRID_ERROR = 0.1
"""px rms, the expected error up to which a grid from scenes is accepted unasked."""
_GRID_BYTES = 24
"""A pixel, that finding the lenslets of a white image takes."""
ASTRAY = 1.0
"""px rms by which centres may miss those that a simulated capture knows before a warning."""


@dataclass(frozen=True, kw_only=True)
class ResponseSummary:
    """What calibrate says of a response F.

    bands_nm: (band,) nm.
    condition, angles_deg, bias: plenocli.inverse.calibration.calibration.Quality.
    columns: how it came about, in words.
    response: "own", "shared" or "low-rank".
    """

    bands_nm: list[float]
    condition: float
    columns: str
    response: str
    angles_deg: list[list[float]]
    bias: list[float] | None


@dataclass(frozen=True, kw_only=True)
class CalibrateSummary:
    """What calibrate found.

    output: the calibration file.
    lattice, pitch_px, angle_deg, rms_px, model: of plenocli.inverse.grid.lenslet_grid.LensletGrid.
    residual_median_px, residual_worst_px, residual_worst_lenslet: distances of measured centres
        from the lattice.
    lenslets: how many can be used.
    array: rows and columns of lenslets.
    window: rows and columns of a superpixel's window, px.
    noise: where gain and read noise come from, in words.
    gain_dn_per_e: None where it is not known.
    response: None without --band captures.
    expected_error_px: of a grid from captures of a scene.
    deviation_px: root mean square distance from the true centres, of a simulated capture.
    """

    output: str
    lattice: str
    pitch_px: list[float]
    angle_deg: float
    rms_px: float
    model: str
    residual_median_px: float
    residual_worst_px: float
    residual_worst_lenslet: list[int]
    lenslets: int
    array: list[int]
    window: list[int]
    noise: str
    gain_dn_per_e: float | None
    response: ResponseSummary | None = None
    expected_error_px: float | None = None
    deviation_px: float | None = None

    def as_json(self) -> dict[str, Any]:
        """The summary as --json prints it: one flat object, without what there is none of."""
        flat = asdict(self)
        response = flat.pop("response")
        for name in ("deviation_px", "expected_error_px"):
            if flat[name] is None:
                del flat[name]
        return flat | (response or {})


def run_calibrate(
    output: Name,
    *,
    whites: Sequence[Name] = (),
    scenes: Sequence[Name] = (),
    grid_error: float = GRID_ERROR,
    darks: Sequence[Name] = (),
    bands: Sequence[tuple[float, Name]] = (),
    across: Sequence[tuple[float, Name]] = (),
    radiances: Sequence[tuple[float, float]] = (),
    camera: Name | None = None,
    response: str = "auto",
    lattice: str = "auto",
    cfa: str | None = None,
    near: tuple[float, float] | None = None,
    overwrite: bool = False,
    command: str = "",
) -> CalibrateSummary:
    """Calibrate a camera and write `output`.

    whites, scenes, darks: captures, folders and patterns of them; whites or scenes at least.
    grid_error: px rms, the largest expected error of a grid from scenes that is accepted.
    bands: (wavelength m, capture) pairs, several a band allowed.
    across: the same under light polarised along 90 degrees, where that of `bands` is along 0.
    radiances: (wavelength m, relative radiance of that source) pairs, 1 where not given.
    camera: TOML for gain and read noise.
    response: own, shared, low-rank or auto (plenocli.inverse.calibration.measured_response).
    lattice: auto, square or hexagonal.
    cfa: colour filter array of PNG and TIFF mosaics (default: the camera's, else mono).
    near: (row, column) px close to any superpixel's centre (see find_grid).

    Raises InputError for files, NumericsError where there is no lattice or no light.
    """
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output
    from plenocli.files.config.camera_file import to_toml
    from plenocli.files.read.calibrations import write_calibration
    from plenocli.files.read.cameras import camera_files, read_camera
    from plenocli.files.read.captures import named_captures

    whites, scenes, darks = map(named_captures, (whites, scenes, darks))
    if not whites and not scenes:
        raise UsageError("there is neither --white nor --scene", fix="give one of them")
    if bands and not whites:
        raise UsageError("--band needs --white: a scene does not tell how bright white is")
    bands, across = _in_order(bands), _in_order(across)
    _check_radiances(radiances, bands)
    _check_across(across, bands)
    roles: dict[str, Any] = {
        "white": list(whites),
        "scene": list(scenes),
        "dark": list(darks),
        "camera": camera,
        **_band_roles(bands),
        **_band_roles(across, " across"),
    }
    check_output(
        output,
        overwrite=overwrite,
        inputs=[
            *whites,
            *scenes,
            *darks,
            camera,
            *(path for _, path in (*bands, *across)),
        ],
        suffixes=(".h5",),
    )
    description = read_camera(camera) if camera else None
    roles |= camera_files(camera, description) if camera and description else {}
    cfa = cfa or (description.sensor.cfa if description else None)
    captures = read_series([*whites, *scenes], cfa=cfa)
    needed = _GRID_BYTES * captures[0].mosaic.size
    budget().require(needed, "finding the lenslets", [*whites, *scenes][0], "crop the captures")
    white = captures[: len(whites)]
    found = calibrate(
        white,
        scenes=captures[len(whites) :],
        grid_error=grid_error,
        darks=read_series(darks, captures[0], cfa),
        bands=_narrow_bands(bands, across, dict(radiances), white[0]) if bands else None,
        camera=description,
        response=response,
        lattice=lattice,
        near=near,
    )
    summary = _summary(output, found, [*whites, *scenes][0])
    config = to_toml(description) if description else ""
    provenance = Provenance(
        command=command, inputs=describe_inputs(roles), seed=None, config=config
    )
    write_calibration(output, found.calibration, provenance, overwrite=overwrite)
    return summary


def _in_order(pairs: Sequence[tuple[float, Name]]) -> list[tuple[float, Name]]:
    """(wavelength, capture) pairs by wavelength, of folders and patterns what they stand for."""
    from plenocli.files.read.captures import named_captures

    several = [(w, path) for w, name in pairs for path in named_captures([name])]
    return sorted(several, key=lambda pair: pair[0])


def _check_radiances(
    radiances: Sequence[tuple[float, float]], bands: Sequence[tuple[float, Name]]
) -> None:
    """Refuse the radiance of a band that there is none of."""
    if unknown := [w for w, _ in radiances if not any(abs(w - band) < 1e-12 for band, _ in bands)]:
        raise UsageError(
            f"--band-radiance names {unknown[0] * 1e9:g} nm, of which there is no --band"
        )


def _check_across(
    across: Sequence[tuple[float, Name]], bands: Sequence[tuple[float, Name]]
) -> None:
    """Refuse bands that are known in one polarisation alone."""
    if across and {w for w, _ in across} != {w for w, _ in bands}:
        raise UsageError(
            "--band and --band-across are not of the same bands",
            fix="give each band under light along 0 degrees (--band) and along 90 (--band-across)",
        )


def _narrow_bands(
    bands: Sequence[tuple[float, Name]],
    across: Sequence[tuple[float, Name]],
    radiances: dict[float, float],
    white: Capture,
) -> NarrowBands:
    """The captures of the bands, each read when it is looked at."""

    def of(pairs: Sequence[tuple[float, Name]]) -> Callable[[float], Sequence[Capture]]:
        return lambda wavelength: read_series(
            [path for w, path in pairs if w == wavelength], white, white.cfa
        )

    return NarrowBands(
        wavelengths=list(dict.fromkeys(w for w, _ in bands)),
        captures=of(bands),
        across=of(across) if across else None,
        radiances=radiances,
    )


def _band_roles(bands: Sequence[tuple[float, Name]], suffix: str = "") -> dict[str, list[Name]]:
    roles: dict[str, list[Name]] = {}
    for wavelength, path in bands:
        roles.setdefault(f"band {wavelength * 1e9:.6g}nm{suffix}", []).append(path)
    return roles


def _summary(output: Name, measured: Measured, white: Name) -> CalibrateSummary:
    found, calibration, noise = measured.grid, measured.calibration, measured.noise
    residual = there(found.residual)
    row, column = np.unravel_index(
        np.nanargmax(np.where(found.valid, residual, np.nan)), found.valid.shape
    )
    grid, response = calibration.grid, calibration.response
    return CalibrateSummary(
        output=str(output),
        lattice=found.lattice,
        pitch_px=[float(p) for p in found.pitch],
        angle_deg=found.angle,
        rms_px=found.rms,
        model=found.model,
        residual_median_px=float(np.nanmedian(residual[found.valid])),
        residual_worst_px=float(residual[row, column]),
        residual_worst_lenslet=[int(row), int(column)],
        lenslets=int(grid.valid.sum()),
        array=list(grid.valid.shape),
        window=list(there(calibration.windows).shape),
        noise=noise.source,
        gain_dn_per_e=noise.gain,
        response=None if response is None else _response_summary(response),
        expected_error_px=grid.expected_error,
        deviation_px=_deviation(grid, white),
    )


def _response_summary(response: Response) -> ResponseSummary:
    quality, notes = there(response.quality), there(response.notes)
    return ResponseSummary(
        bands_nm=[float(w * 1e9) for w in response.wavelengths],
        condition=quality.condition,
        columns=notes["text"],
        response=notes["response"],
        angles_deg=quality.angles,
        bias=quality.bias,
    )


def _deviation(grid: LensletGrid, white: Name) -> float | None:
    """Root mean square distance, px, of the lenslets from where a simulated capture knows them to
    be; None for others.
    """
    from scipy.spatial import cKDTree

    truth = true_centres(white)
    if truth is None:
        return None
    miss, _ = cKDTree(truth.reshape(-1, 2)).query(grid.centres[grid.valid])
    deviation = float(np.sqrt(np.mean(miss**2)))
    note(f"the simulated capture knows its centres: found within {deviation:.4f} px rms")
    if deviation > ASTRAY:
        note(
            "warning: superpixels are cut that far from where they are, which takes light of "
            "neighbours for their own; filters in the pupil that differ much draw the grid to the "
            "brightest: give --camera, whose filter array tells of them"
        )
    return deviation
