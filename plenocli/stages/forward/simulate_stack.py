"""simulate-pif of a microscope, or of a camera with planes: the kernels of a volume."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plenocli.base.errors import UsageError
from plenocli.base.progress import bar, note
from plenocli.base.text import by
from plenocli.base.units import format_length

if TYPE_CHECKING:
    from plenocli.forward.camera.microscope import Microscope
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.volume.optics import VolumeOptics
    from plenocli.forward.volume.plan import VolumePlan

DEFAULT_ACCURACY = 5e-3
"""Share of a voxel's light that may be elsewhere, where nothing is asked for."""
LONG = 5.0
"""Seconds from which on the work is announced."""


@dataclass(frozen=True, kw_only=True)
class StackSummary:
    """What simulate-pif planned, or wrote, for a volume.

    output: None for a plan.
    samples: voxels (rows, columns) of a lenslet.
    between_planes: share of a point's light elsewhere, halfway between planes, than interpolated.
    """

    output: str | None
    plan: VolumePlan
    samples: tuple[int, int]
    between_planes: float

    def as_json(self) -> dict[str, Any]:
        """What is told, by name."""
        plan = self.plan
        return {
            "output": self.output,
            "planes": len(plan.reach),
            "samples": list(self.samples),
            "rung": plan.rung,
            "accuracy": plan.asked,
            "estimated_accuracy": plan.error,
            "reach": [min(plan.reach), max(plan.reach)],
            "light_lost": max(plan.lost),
            "between_planes": self.between_planes,
            "considered": [list(one) for one in plan.considered],
            "seconds": plan.seconds,
            "bytes": plan.bytes,
        }

    def line(self) -> str:
        """What people read: one sentence, or the plan."""
        from plenocli.base.memory import size_text

        plan = self.plan
        text = (
            f"kernels of {len(plan.reach)} planes, {by(self.samples)} voxels a lenslet, light of "
            f"{min(plan.reach)} to {max(plan.reach)} lenslets on each side "
            f"({max(plan.lost):.1%} or less beyond them); "
            f"{plan.rung}, {plan.error:.1g} of a voxel's light is elsewhere"
        )
        if self.between_planes:
            text += f"; halfway between planes {self.between_planes:.2g} than between theirs"
        if self.output is not None:
            return f"{Path(self.output)}: {text}"
        tried = ", ".join(f"{name} {error:.1g}" for name, error in plan.considered)
        return (
            f"{text}\ntried: {tried}; asked {plan.asked:g}\n"
            f"about {plan.seconds:.2g} s on one core, a file of {size_text(plan.bytes)}"
        )


def run_simulate_stack(
    path: Path | str,
    output: Path | str | None,
    *,
    camera: Camera | None = None,
    accuracy: float | None,
    model: str,
    calibration: Path | str | None = None,
    explain: bool,
    overwrite: bool,
    workers: int,
    command: str,
) -> StackSummary:
    """Compute the kernels of a volume and write them.

    path: description with an [objective], or of a photographic camera with [object] planes.
    camera: the latter, read; None: the former.
    output: file to write (.h5), not needed with `explain`.
    accuracy: share of a voxel's light that may be elsewhere.
    model: "auto", "ray" or "fresnel".
    calibration: with a white image, from which the pupil is measured; None: as described.
    workers: threads.

    Raises InputError and ConfigError for the description, UsageError for options, NumericsError
    where memory or accuracy do not suffice, OutputError where the file cannot be written.
    """
    from plenocli.base.budget import Budget, budget, within
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.artefacts.writing import write_artefact
    from plenocli.files.config.camera_file import to_toml
    from plenocli.files.config.microscope_file import load_microscope, microscope_toml
    from plenocli.files.results.stacks import stack_artefact
    from plenocli.forward.volume.cameras import optics_of, optics_of_camera
    from plenocli.forward.volume.plan import between_planes, plan_volume
    from plenocli.forward.volume.stack import build_stack

    if camera is None:
        microscope = load_microscope(path)
        if calibration is not None:
            microscope = _with_measured_pupil(microscope, calibration)
        config, samples = microscope_toml(microscope), microscope.object.samples_per_lenslet
        optics = optics_of(microscope)
    elif calibration is None:
        config, samples = to_toml(camera), camera.object.samples_per_lenslet
        optics = optics_of_camera(camera)
    else:
        raise UsageError(
            "measures the pupil of an [objective], which this camera has not",
            "--calibration",
            "leave it out",
        )
    if model == "exact":
        raise UsageError(
            "volumes are computed by rays or by waves that are paraxial behind the lenslets",
            "--model",
            "take ray, fresnel or auto",
        )
    asked = DEFAULT_ACCURACY if accuracy is None else accuracy
    plan = plan_volume(optics, samples, accuracy=asked, model=model)
    between = between_planes(optics, plan)
    if camera is not None:
        _tell_of_the_voxels(optics, samples)
    if explain or output is None:
        return StackSummary(output=None, plan=plan, samples=samples, between_planes=between)
    if plan.seconds > LONG:
        note(f"about {plan.seconds:.2g} s on one core for {len(plan.reach)} planes ({plan.rung})")
    with (
        within(Budget(budget().memory, workers)),
        bar(None, len(plan.reach), "planes") as shown,
    ):
        stack = build_stack(optics, plan, shown.update)
    provenance = Provenance(
        command=command,
        inputs=describe_inputs({"camera": path, "calibration": calibration}),
        config=config,
        accuracy=stack.accuracy.as_json(),
    )
    write_artefact(output, stack_artefact(stack, provenance), overwrite=overwrite)
    return StackSummary(output=str(output), plan=plan, samples=samples, between_planes=between)


def _tell_of_the_voxels(optics: VolumeOptics, samples: tuple[int, int]) -> None:
    """Say which planes are not told apart by voxels as coarse as these."""
    from plenocli.forward.volume.plan import coarse_planes

    planes = coarse_planes(optics, samples)
    if not planes:
        return
    places = ", ".join(format_length(optics.places[n]) for n in planes)
    enough = math.ceil(optics.object_pitch / optics.resolved)
    note(
        f"what is at {places} will be taken for something in front of it or behind: voxels of "
        f"{optics.object_pitch / min(samples) * 1e6:.3g} um are too coarse so near the focused "
        f"plane, where the lens resolves {optics.resolved * 1e6:.3g} um; samples_per_lenslet = "
        f"[{enough}, {enough}] has them as fine, or name no planes there"
    )


def _with_measured_pupil(microscope: Microscope, calibration: Path | str) -> Microscope:
    """The microscope with the pupil that a white image shows."""
    from plenocli.files.read.calibrations import read_calibration
    from plenocli.forward.volume.cameras import optics_of
    from plenocli.inverse.calibration.pupil_rings import pupil_rings
    from plenocli.inverse.volume.superpixels import white_superpixel

    optics = optics_of(microscope)
    known = read_calibration(calibration, response=False)
    green = "G" if "G" in known.sensor.cfa else None  # of others there are half as many
    white = white_superpixel(known, optics.pixels, optics.lattice, green)
    found = pupil_rings(white, optics)
    note(
        f"the white image shows a pupil that reaches NA {found.aperture:.3g} (correlation "
        f"{found.alike:.3f} with its picture, {found.described:.3f} with that of the description)"
    )
    lens = microscope.objective.model_copy(
        update={"rings": found.intensity, "numerical_aperture": found.aperture}
    )
    return microscope.model_copy(update={"objective": lens})
