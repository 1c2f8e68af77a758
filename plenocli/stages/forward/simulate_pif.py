"""simulate-pif: the system matrix of a camera by wave optics, with what it can
and cannot resolve.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from plenocli.base.errors import NumericsError, UsageError
from plenocli.base.progress import bar, note

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.forward.accuracy.explain import Considered
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.accuracy_record import AccuracyRecord
    from plenocli.forward.propagation.diagnosis import Diagnosis
    from plenocli.forward.propagation.plan import PifPlan
    from plenocli.forward.propagation.system_matrix import LensletWindow, SystemMatrix


DARK = 1e-9
"""Share of a point's light below which a matrix has none."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What the command line says beyond the camera.

    wavelengths: m, empty for the camera's;
    spectral_step: m, "auto" or None;
    superpixels: "auto" or odd (rows, columns);
    coherent_ring: "auto" or a number of rings;
    accuracy: relative L2 error of the worst column, None for what the noise lets be seen;
    model: "auto", "ray", "fresnel" or "exact";
    scene: file of the scene that the matrix is for;
    lenslet: (row, column) of the array, None for the one on the axis;
    dtype: "auto", "float32" or "float64".
    """

    wavelengths: tuple[float, ...] = ()
    spectral_step: float | Literal["auto"] | None = None
    superpixels: tuple[int, int] | str = "auto"
    coherent_ring: int | str = "auto"
    accuracy: float | None = None
    model: str = "auto"
    scene: Path | str | None = None
    lenslet: tuple[int, int] | None = None
    dtype: str = "auto"


@dataclass(frozen=True, kw_only=True)
class PlanSummary:
    """What --explain tells; no matrix was computed.

    plan: several lines of text;
    memory, bytes: at work, and of the result;
    seconds: of one core of this machine.
    """

    plan: str
    memory: int
    accuracy: AccuracyRecord
    considered: list[Considered]
    seconds: float
    bytes: int
    superpixels: tuple[int, int]
    coherent_ring: int
    estimated_accuracy: float

    def as_json(self) -> dict[str, Any]:
        """The fields by name."""
        return _named(self) | {
            "accuracy": self.accuracy.as_json(),
            "considered": [c.as_json() for c in self.considered],
        }

    def line(self) -> str:
        """What people read."""
        return self.plan


@dataclass(frozen=True, kw_only=True)
class PifSummary:
    """What was computed and written.

    pixels, points: of a superpixel and of the object under one lenslet;
    wavelengths: (band,) m;
    kappa, eps: 1/m;
    dtype: that A is stored in;
    nominal_seconds: of one core at nominal rates, as planned.
    """

    output: str
    bands: int
    superpixels: tuple[int, int]
    pixels: int
    points: int
    wavelengths: list[float]
    model: str
    rung: str
    coherent_ring: int
    accuracy: float
    estimated_accuracy: float
    kappa: float
    eps: float
    bytes: int
    dtype: str
    nominal_seconds: float
    quartic_phase_rad: float
    warnings: list[str]
    diagnosis: Diagnosis

    def as_json(self) -> dict[str, Any]:
        """The fields by name, those of the diagnosis that are known among them."""
        found = self.diagnosis
        known = {
            "rank": found.rank,
            "rank_60db": found.rank_60db,
            "condition": found.condition,
            "condition_is_bound": found.condition_is_bound,
            "resolution": found.resolution,
            "symmetry_defect": found.symmetry_defect,
            "energy_min": found.energy_min,
            "energy_max": found.energy_max,
        }
        report = _named(self)
        del report["diagnosis"]
        return report | {name: value for name, value in known.items() if value is not None}

    def line(self) -> str:
        """One sentence for people."""
        found, (rows, columns) = self.diagnosis, self.superpixels
        text = (
            f"{Path(self.output)}: A of {self.bands} band(s), {rows}x{columns} superpixels, "
            f"{self.pixels} pixels, {self.points} points; column energy "
            f"{_share(min(found.energy_min))} to {_share(max(found.energy_max))}"
        )
        if not (found.rank is None or found.rank_60db is None or found.condition is None):
            text += (
                f"; rank {min(found.rank)} ({min(found.rank_60db)} above 60 dB noise), "
                f"condition {_condition(found, self.dtype)}"
            )
        if found.symmetry_defect is not None:
            text += f"; symmetry defect {min(found.symmetry_defect):.1e}"
        return f"{text}; {self.rung}, estimated error {self.estimated_accuracy:.1g}"


def _share(energy: float) -> str:
    return f"{energy:.3f}" if energy >= 0.001 else f"{energy:.1e}"


def _condition(found: Diagnosis, dtype: str) -> str:
    """The worst condition of all bands, and why it is a bound where it is one."""
    assert found.condition is not None and found.condition_is_bound is not None
    worst = max(range(len(found.condition)), key=found.condition.__getitem__)
    if not found.condition_is_bound[worst]:
        return f"{found.condition[worst]:.1e}"
    return (
        f"at least {found.condition[worst]:.1e} (smaller singular values are the rounding "
        f"of {dtype})"
    )


def _named(summary: PlanSummary | PifSummary) -> dict[str, Any]:
    return {field.name: getattr(summary, field.name) for field in fields(summary)}


def run_simulate_pif(
    camera_path: Path | str,
    output: Path | str | None,
    settings: Settings,
    *,
    explain: bool = False,
    overwrite: bool = False,
    workers: int = 1,
    command: str = "",
) -> PifSummary | PlanSummary:
    """Compute A and write it as a pif artefact.

    camera_path: camera description (.toml);
    output: file to write (.h5), not needed with `explain`;
    explain: only make the plan;
    overwrite: whether `output` may exist;
    workers: threads;
    command: what the artefact says it was made by.

    Raises InputError and ConfigError for the camera, UsageError for options, NumericsError where
    memory or accuracy do not suffice, OutputError where the file cannot be written.
    """
    from plenocli.base.budget import budget, one_thread, within
    from plenocli.files.artefacts import pif_pieces
    from plenocli.files.artefacts.container import write_artefact
    from plenocli.files.read.cameras import read_camera
    from plenocli.forward.propagation.diagnosis import describe
    from plenocli.forward.propagation.system_matrix import build_pif

    if not explain:
        _require_output(camera_path, output, overwrite)
    camera = read_camera(camera_path)
    plan = _planned(camera, settings)
    if explain:
        return _explained(plan, pif_pieces.cost(plan)[1], pif_pieces.refusal(plan, camera_path))
    assert output is not None  # _require_output
    chosen = pif_pieces.layout(plan, camera_path)
    _announce(plan, pif_pieces.cost(plan)[1])
    provenance = _provenance(camera_path, camera, settings, plan, command)

    def finish(matrix: SystemMatrix, found: Diagnosis) -> Artefact:
        return _artefact(camera, settings, matrix, found, provenance)

    # the diagnosis too: its singular values must not depend on the cores of a machine
    with (
        one_thread(),
        within(replace(budget(), threads=workers)),
        bar(None, total=plan.shape[0] * plan.shape[3], label="columns of A") as shown,
    ):

        def progress(done: int, total: int) -> None:
            shown.update(done - shown.n)

        if chosen.streamed:
            matrix, found = pif_pieces.stream_pif(
                camera, plan, output, chosen, finish, overwrite=overwrite, progress=progress
            )
        else:
            matrix = build_pif(camera, plan, progress=progress)
            found = describe(matrix)
    for warning in found.warnings:
        note(warning)
    if not chosen.streamed:
        write_artefact(output, finish(matrix, found), overwrite=overwrite)
    return _summary(str(output), matrix, found, plan)


def _require_output(camera_path: Path | str, output: Path | str | None, overwrite: bool) -> None:
    """UsageError or OutputError where the artefact could not be written."""
    from plenocli.files.atomic import check_output

    if output is None:
        raise UsageError(
            "no output file given",
            "--output",
            "write -o pif.h5, or --explain to see the plan only",
        )
    check_output(output, overwrite=overwrite, inputs=[camera_path], suffixes=(".h5",))


def _planned(camera: Camera, settings: Settings) -> PifPlan:
    from plenocli.files.read.scene_needs import read_needs
    from plenocli.forward.accuracy.dial import plan_pif

    return plan_pif(
        camera,
        wavelengths=_wavelengths(camera, settings),
        superpixels=settings.superpixels,
        coherent_ring=settings.coherent_ring,
        accuracy=settings.accuracy,
        model=settings.model,
        dtype=settings.dtype,
        needs=read_needs(settings.scene, camera) if settings.scene else None,
        lenslet=settings.lenslet,
    )


def _announce(plan: PifPlan, memory: int) -> None:
    """Tell the warnings of a plan, and that the work takes long where it does."""
    from plenocli.forward.accuracy.explain import expectation

    for line in (*plan.warnings, expectation(plan, memory)):
        if line:
            note(line)


def _provenance(
    camera_path: Path | str, camera: Camera, settings: Settings, plan: PifPlan, command: str
) -> Provenance:
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.config.camera_file import to_toml
    from plenocli.files.read.cameras import camera_files

    scene = settings.scene if settings.scene and Path(settings.scene).is_file() else None
    return Provenance(
        command=command,
        inputs=describe_inputs(camera_files(camera_path, camera) | {"scene": scene}),
        seed=None,
        config=to_toml(camera),
        accuracy=plan.accuracy_record().as_json(),
    )


def _explained(plan: PifPlan, memory: int, refusal: str | None) -> PlanSummary:
    from plenocli.forward.accuracy.dial import seconds_here
    from plenocli.forward.accuracy.explain import candidates, explain

    if refusal:
        plan = replace(plan, warnings=(*plan.warnings, f"would be refused: {refusal}"))
    return PlanSummary(
        plan=explain(plan, memory),
        memory=memory,
        accuracy=plan.accuracy_record(),
        considered=candidates(plan),
        seconds=seconds_here(plan.chosen),
        bytes=plan.bytes,
        superpixels=plan.superpixels,
        coherent_ring=plan.coherent_ring,
        estimated_accuracy=plan.estimated,
    )


def _wavelengths(camera: Camera, settings: Settings) -> tuple[float, ...] | None:
    if settings.wavelengths and settings.spectral_step is not None:
        raise UsageError(
            "--wavelength and --spectral-step contradict each other", fix="leave one of them out"
        )
    if settings.wavelengths:
        return tuple(sorted(set(settings.wavelengths)))
    if settings.spectral_step is None:
        return None
    from plenocli.forward.scene.light import broadband
    from plenocli.forward.scene.tables import illuminant

    step = None if settings.spectral_step == "auto" else settings.spectral_step
    return tuple(
        float(w)
        for w in broadband(
            camera, lambda w: illuminant(camera.light.illuminant, w), step
        ).wavelengths
    )


def _window(camera: Camera, lenslet: tuple[int, int]) -> LensletWindow:
    from plenocli.forward.camera.geometry import lenslet_shift
    from plenocli.forward.propagation.system_matrix import LensletWindow

    row, column, shift = lenslet_shift(camera, *lenslet)
    return LensletWindow(lenslet=lenslet, first_pixel=(row, column), pixel_shift=shift)


def _artefact(
    camera: Camera,
    settings: Settings,
    matrix: SystemMatrix,
    found: Diagnosis,
    provenance: Provenance,
) -> Artefact:
    from plenocli.files.artefacts.container import Artefact

    if not max(found.energy_max) > DARK:
        raise NumericsError(
            f"no more than {max(found.energy_max):.1g} of any point's light lands on the "
            "superpixels kept",
            "the matrix",
            "keep more superpixels, or mend the distances, apertures and pixels of the camera",
        )
    if settings.lenslet is not None:
        window = _window(camera, settings.lenslet)
        matrix = replace(matrix, notes=replace(matrix.notes, window=window))
    return Artefact(
        "pif", *_contents(matrix, found, camera.lenslet_array.lattice), provenance=provenance
    )


def _contents(
    matrix: SystemMatrix, found: Diagnosis, lattice: str
) -> tuple[dict[str, np.ndarray | None], dict[str, Any]]:
    """Datasets and attributes of a pif artefact."""
    notes = matrix.notes
    data = {
        "pif/A": matrix.A,
        "pif/wavelength": matrix.wavelengths,
        "pif/lenslet_offset": np.asarray(matrix.lenslet_offset, np.int32),
        "pif/pixel_shape": np.array(matrix.pixel_shape, np.int32),
        "pif/object_shape": np.array(matrix.object_shape, np.int32),
        "pif/column_energy": matrix.column_energy,
        "pif/singular_values": found.singular_values,
    }
    attrs = {
        "coherent_ring": notes.coherent_ring,
        "kappa": notes.kappa,
        "eps": notes.eps,
        "superpixel_pitch": notes.superpixel_pitch,
        "model": notes.model,
        "notes": notes.as_json(),
        "rank": found.rank,
        "condition": found.condition,
        "resolution": found.resolution,
        "symmetry_defect": found.symmetry_defect,
        "lattice": lattice,
    }
    return (
        {name: value for name, value in data.items() if name == "pif/A" or value is not None},
        {"pif": {name: value for name, value in attrs.items() if value is not None}},
    )


def _summary(output: str, matrix: SystemMatrix, found: Diagnosis, plan: PifPlan) -> PifSummary:
    bands, _, pixels, points = plan.shape
    return PifSummary(
        output=output,
        bands=bands,
        superpixels=plan.superpixels,
        pixels=pixels,
        points=points,
        wavelengths=matrix.wavelengths.tolist(),
        model=plan.model,
        rung=plan.rung,
        coherent_ring=plan.coherent_ring,
        accuracy=plan.accuracy,
        estimated_accuracy=plan.estimated,
        kappa=matrix.notes.kappa,
        eps=matrix.notes.eps,
        bytes=plan.bytes,
        dtype=plan.dtype,
        nominal_seconds=plan.chosen.seconds(),
        quartic_phase_rad=matrix.notes.quartic_phase_rad,
        warnings=[*plan.warnings, *found.warnings],
        diagnosis=found,
    )
