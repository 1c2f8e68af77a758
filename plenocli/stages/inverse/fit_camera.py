"""fit-camera: a camera's description made true by its own captures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plenocli.base.errors import NumericsError, UsageError

if TYPE_CHECKING:
    import numpy as np

    from plenocli.forward.camera.model import Camera
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.fit.camera_fit import CameraFit, FittedParameter
    from plenocli.inverse.fit.optics import Parameter
    from plenocli.inverse.fit.problem import CapturedLenslets

TOLD = 20.0
"""Time (s) from which on a fit says before how long it takes."""


@dataclass(frozen=True, kw_only=True)
class CameraFitSummary:
    """What fit-camera found.

    output: the fitted description.
    captures: how many were looked at.
    fit: the CameraFit.
    """

    output: str
    captures: int
    fit: CameraFit

    def as_json(self) -> dict[str, Any]:
        """Names and values of --json."""
        return {"output": self.output, "captures": self.captures} | self.fit.as_json()

    def line(self) -> str:
        """One line for a person, and one for each parameter."""
        fit = self.fit
        head = (
            f"{self.output}: {fit.why} (as described {fit.noise_ratio_before:.3g} times), "
            f"{fit.lenslets} lenslets; a matrix made from it is off by about {fit.model_error:.1g}"
        )
        return "\n".join([head, *(f"  {text}" for text in told(fit))])


def run_fit_camera(
    captures: Sequence[Path],
    output: Path,
    *,
    camera: Path,
    calibration: Path | None = None,
    details: Path | None = None,
    training: Sequence[str] = (),
    noise_sigma: float | None = None,
    fixed: Sequence[str] = (),
    model: str = "auto",
    seed: int = 0,
    overwrite: bool = False,
    command: str = "",
) -> CameraFitSummary:
    """Fit a camera to captures and write its description.

    captures: files, all of one camera.
    output: the fitted description (.toml).
    camera: the description to start from.
    calibration: along whose lenslet grid captures are cut out; without it as they say themselves.
    details: artefact (.h5) with parameters, standard deviations and correlations.
    training: photographs for the statistics; () for those of scikit-image.
    noise_sigma: standard deviation of the noise in units of A x; None as the captures say.
    fixed: names of parameters that stay as described.
    model: of propagation, as simulate-pif takes it; "auto" for the one that simulated captures were
        made with, or the finest.
    seed: of the training patches.

    Raises UsageError, InputError, OutputError; NumericsError where no camera near the described one
    explains the captures: then nothing is written.
    """
    from plenocli.files.atomic import publish, together
    from plenocli.files.images.mosaic import read_capture
    from plenocli.files.read.calibrations import read_white
    from plenocli.files.read.training import files_of
    from plenocli.inverse.fit.captures import believed_model, captured_lenslets
    from plenocli.inverse.fit.causes import beyond_parameters
    from plenocli.inverse.fit.optics import parameters_without

    inputs = [*captures, camera, calibration, *(files_of(training) or ())]
    _check_outputs(output := Path(output), details, inputs, overwrite=overwrite)
    described, named = _described(camera, output)
    parameters = parameters_without(described, fixed)
    grid = None if calibration is None else read_white(calibration)
    read = [read_capture(path) for path in captures]
    lenslets = [
        captured_lenslets(one, described, grid, noise_sigma=noise_sigma, where=calibration)
        for one in read
    ]
    pictures = _photographs(training, read, described.object.samples_per_lenslet)
    fit = fitted(
        described,
        lenslets,
        pictures,
        name="the fit",
        parameters=parameters,
        model=believed_model(model, read),
        seed=seed,
    )
    if not fit.accepted:
        other = beyond_parameters(
            described, lenslets, pictures, described=fit.noise_ratio_before, seed=seed
        )
        raise NumericsError(
            f"no camera near the described one explains the captures: the best {fit.why}",
            Path(camera).name,
            "check its distances, the calibration and --noise-sigma, or give more captures"
            if other is None
            else other[1],
        )
    with together():
        if details is not None:
            origin = {**named, "capture": captures, "calibration": calibration}
            _write_details(fit, details, origin, command=command, seed=seed, overwrite=overwrite)
        publish(output, fitted_toml(fit, camera, captures).encode(), overwrite=overwrite)
    return CameraFitSummary(output=str(output), captures=len(captures), fit=fit)


def fitted(
    camera: Camera,
    captures: Sequence[CapturedLenslets],
    pictures: Sequence[np.ndarray],
    *,
    name: str,
    parameters: Sequence[Parameter] | None = None,
    model: str,
    seed: int,
) -> CameraFit:
    """The CameraFit of fit_camera, its time told before and its steps shown; name: of what takes
    the time.
    """
    from plenocli.base.progress import bar, note
    from plenocli.inverse.fit.fit import STEPS, expected_seconds, fit_camera

    seconds = expected_seconds(camera)
    if seconds > TOLD:
        note(f"{name} takes about {seconds:.0f} s of one core, up to four times that at worst")
    with bar(None, STEPS, "steps of the fit") as progress:
        return fit_camera(
            camera,
            captures,
            pictures,
            parameters=parameters,
            model=model,
            seed=seed,
            progress=progress.update,
        )


def _check_outputs(
    output: Path, details: Path | None, inputs: Sequence[Any], *, overwrite: bool
) -> None:
    from plenocli.files.atomic import check_output

    check_output(output, overwrite=overwrite, inputs=inputs, suffixes=(".toml",))
    if details is not None:
        check_output(
            details, overwrite=overwrite, inputs=inputs, others=[output], suffixes=(".h5",)
        )


def _described(camera: Path, output: Path) -> tuple[Camera, dict[str, Any]]:
    """(the camera to start from, files that describe it); UsageError where it is not fitted, or
    its fitted description would not find the files that it names.
    """
    from plenocli.files.read.cameras import camera_files, read_camera
    from plenocli.inverse.fit.optics import require_fittable

    described = read_camera(camera)
    require_fittable(described)
    named = camera_files(camera, described)
    if len(named) > 1 and output.resolve().parent != Path(camera).resolve().parent:
        raise UsageError(
            f"names files beside {Path(camera).name}", output, "write OUT into the folder of CAMERA"
        )
    return described, dict(named)


def _write_details(
    fit: CameraFit,
    details: Path,
    origin: dict[str, Any],
    *,
    command: str,
    seed: int,
    overwrite: bool,
) -> None:
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.artefacts.writing import write_artefact
    from plenocli.files.results.camera_fits import fit_artefact

    provenance = Provenance(command=command, inputs=describe_inputs(origin), seed=seed)
    write_artefact(details, fit_artefact(fit, provenance), overwrite=overwrite)


def _photographs(
    training: Sequence[str], captures: Sequence[Capture], shape: tuple[int, int]
) -> list[np.ndarray]:
    """Training pictures at several scales, without the scene of the captures."""
    from plenocli.files.read.training import read_training
    from plenocli.inverse.prior.natural_images import at_scales

    scenes = {one.metadata.target for one in captures if one.metadata.target}
    pictures = read_training(training, shape, not_scene=scenes.pop() if len(scenes) == 1 else None)
    return [picture for _, picture in at_scales(pictures, shape)]


def told(fit: CameraFit) -> list[str]:
    """A line for each parameter, and what captures do not tell apart."""
    lines = [_line(parameter) for parameter in fit.parameters]
    for one, other in fit.inseparable:
        lines.append(f"{one} and {other} are not told apart: only together do they fit")
    return lines


def _line(parameter: FittedParameter) -> str:
    """Values with as many digits as the standard deviation gives them."""
    name, unit = "px", 1.0
    if parameter.unit == "m":
        largest = max(abs(parameter.value), abs(parameter.described), parameter.sigma)
        name, unit = next(
            (n, u)
            for n, u in (("mm", 1e-3), ("um", 1e-6), ("nm", 1e-9))
            if largest >= u or n == "nm"
        )
    scaled = [v / unit for v in (parameter.value, parameter.sigma, parameter.described)]
    digits = max(0, 1 - math.floor(math.log10(max(scaled[1], 1e-12))))
    value, sigma, described = (f"{v:.{digits}f}" for v in scaled)
    untold = "" if parameter.measured else ", not measured: no more than was believed before"
    return f"{parameter.name}: {value} +- {sigma} {name} (described {described}){untold}"


def fitted_toml(fit: CameraFit, camera: Path, captures: Sequence[Path]) -> str:
    """The description of the fitted camera, its uncertainty in comments."""
    from plenocli.files.config.camera_file import to_toml

    names = ", ".join(Path(path).name for path in captures)
    head = [
        f"{Path(camera).name}, fitted to {names} by plenocli fit-camera",
        fit.why,
        "values with one standard deviation:",
        *(f"  {text}" for text in told(fit)),
    ]
    return "\n".join([*(f"# {text}" for text in head), "", to_toml(fit.camera)])
