"""simulate-pif: the system matrix of a camera by wave optics, with what it can
and cannot resolve.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from plenocli.base.errors import NumericsError, UsageError
from plenocli.base.progress import bar, note
from plenocli.stages.forward.pif_summary import PifSummary, PlanSummary, SeveralSummary, summary_of

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.forward.accuracy.depth_planes import DepthPlanes
    from plenocli.forward.accuracy.field_nodes import FieldNodes
    from plenocli.forward.accuracy.scene_needs import SceneNeeds
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.diagnosis import Diagnosis
    from plenocli.forward.propagation.plan import PifPlan
    from plenocli.forward.propagation.system_matrix import LensletWindow, SystemMatrix
    from plenocli.stages.forward.simulate_stack import StackSummary


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
    calibration: file with the white image of a microscope, which shows its pupil;
    lenslet: (row, column) of the array, None for the one on the axis;
    field_nodes: places of the field along an axis whose matrices stand for all lenslets, an odd
        number, "auto" or None for the axis alone;
    dtype: "auto", "float32" or "float64";
    device: "cpu" or "cuda", where the products of an exact model are compressed.
    """

    wavelengths: tuple[float, ...] = ()
    spectral_step: float | Literal["auto"] | None = None
    superpixels: tuple[int, int] | str = "auto"
    coherent_ring: int | str = "auto"
    accuracy: float | None = None
    model: str = "auto"
    scene: Path | str | None = None
    calibration: Path | str | None = None
    lenslet: tuple[int, int] | None = None
    field_nodes: int | Literal["auto"] | None = None
    dtype: str = "auto"
    device: str = "cpu"


def run_simulate_pif(
    camera_path: Path | str,
    output: Path | str | None,
    settings: Settings,
    *,
    explain: bool = False,
    overwrite: bool = False,
    workers: int = 1,
    command: str = "",
) -> PifSummary | SeveralSummary | PlanSummary | StackSummary:
    """Compute A and write it as a pif artefact; of a scene with depth one a plane, of a whole array
    one a place of the field, and an index; of a microscope the kernels of its volume.

    camera_path: camera description (.toml);
    output: file to write (.h5), not needed with `explain`;
    explain: only make the plan;
    overwrite: whether `output` may exist;
    workers: threads;
    command: what the artefact says it was made by.

    Raises InputError and ConfigError for the camera, UsageError for options, NumericsError where
    memory or accuracy do not suffice, OutputError where the file cannot be written.
    """
    from plenocli.files.config.camera_file import describes_microscope
    from plenocli.files.read.cameras import read_camera

    if not explain:
        _require_output(camera_path, output, overwrite)
    microscope = describes_microscope(camera_path)
    camera = None if microscope else read_camera(camera_path)
    if camera is None or camera.object.planes is not None:
        from plenocli.stages.forward.simulate_stack import run_simulate_stack

        return run_simulate_stack(
            camera_path,
            output,
            camera=camera,
            accuracy=settings.accuracy,
            model=_model_of_volume(settings),
            calibration=settings.calibration,
            explain=explain,
            overwrite=overwrite,
            workers=workers,
            command=command,
        )
    if settings.calibration is not None:
        raise UsageError(
            "measures the pupil of an [objective], which this camera has not",
            "--calibration",
            "leave it out",
        )
    needs = _needs(settings.scene, camera)
    planes = _planes(camera, settings, needs)
    field = _field(camera, settings, needs)
    nodes = None if field is None else field[0]
    jobs = _jobs(camera, settings, needs, planes) if field is None else field[1]
    if explain:
        return _explained(jobs, planes or nodes, camera_path)
    assert output is not None  # _require_output
    task = _Task(
        camera_path=camera_path,
        settings=settings,
        overwrite=overwrite,
        workers=workers,
        command=command,
    )
    if len(jobs) == 1:
        return _write(task, jobs[0], output)
    several = planes or nodes
    assert several is not None
    return _write_several(task, jobs, several, output)


def _needs(scene: Path | str | None, camera: Camera) -> SceneNeeds | None:
    """What the scene requires; None where there is none."""
    if not scene:
        return None
    from plenocli.files.read.scene_needs import read_needs

    return read_needs(scene, camera)


def _model_of_volume(settings: Settings) -> str:
    """The model; UsageError where settings ask for what the kernels of a volume do not have."""
    plain = Settings(
        accuracy=settings.accuracy, model=settings.model, calibration=settings.calibration
    )
    for name, value in asdict(settings).items():
        if value != getattr(plain, name):
            option = "--" + ("wavelength" if name == "wavelengths" else name.replace("_", "-"))
            raise UsageError(
                "does not go with the planes of a volume, whose voxels and wavelength are in the "
                "description",
                option,
                "leave it out",
            )
    return settings.model


@dataclass(frozen=True)
class _Job:
    """One matrix: the camera focused on its own plane, and the plan."""

    camera: Camera
    plan: PifPlan


@dataclass(frozen=True, kw_only=True)
class _Task:
    """What all matrices of one command have in common, as run_simulate_pif takes it."""

    camera_path: Path | str
    settings: Settings
    overwrite: bool
    workers: int
    command: str
    announced: set[str] = field(default_factory=set)


def _planes(camera: Camera, settings: Settings, needs: SceneNeeds | None) -> DepthPlanes | None:
    """The planes that stand for the depth of a scene; None where it says nothing of depth."""
    if needs is None or needs.depth is None:
        return None
    from plenocli.forward.accuracy.depth_planes import depth_planes, plane_camera

    near, far = needs.depth
    middle = _planned(plane_camera(camera, 2 / (1 / near + 1 / far)), settings, needs)
    wavelength = min(band.wavelength for band in middle.bands)
    return depth_planes(camera, wavelength, needs.depth, middle.accuracy)


def _jobs(
    camera: Camera, settings: Settings, needs: SceneNeeds | None, planes: DepthPlanes | None
) -> list[_Job]:
    """The matrices to compute: one, or one a plane, each with a neighbourhood of its own."""
    if planes is None:
        return [_Job(camera, _planned(camera, settings, needs))]
    from plenocli.forward.accuracy.depth_planes import left_for_planes, plane_camera

    if planes.error and settings.accuracy is not None:
        settings = replace(settings, accuracy=left_for_planes(settings.accuracy))
    found = []
    for distance in planes.distances:
        own = plane_camera(camera, distance)
        found.append(_Job(own, planes.told(_planned(own, settings, needs))))
    return found


def _field(
    camera: Camera, settings: Settings, needs: SceneNeeds | None
) -> tuple[FieldNodes, list[_Job]] | None:
    """The places of the field that stand for the array, and the matrices to compute; None where one
    matrix was asked for.
    """
    if settings.field_nodes is None:
        return None
    from plenocli.forward.accuracy.field_nodes import PlansOfPlaces, field_nodes

    for other, given in (
        ("--lenslet", settings.lenslet is not None),
        ("a scene with depth", needs is not None and needs.depth is not None),
    ):
        if given:
            raise UsageError(
                f"places of the field and {other} exclude each other",
                "--field-nodes",
                "leave one of them out",
            )
    if camera.lenslet_array.lattice != "square":
        raise UsageError(
            "a hexagonal lattice has no places of the field yet",
            "--field-nodes",
            "take --lenslet, one matrix a lenslet",
        )
    plan_at = PlansOfPlaces(camera, **_request(camera, settings, needs))
    count = None if settings.field_nodes == "auto" else settings.field_nodes
    nodes = field_nodes(camera, plan_at, count)
    if nodes.error > plan_at.accuracy:
        note(
            f"between {len(nodes.rows)}x{len(nodes.columns)} places of the field columns are off "
            f"by about {nodes.error:.1g}, more than the accuracy {plan_at.accuracy:.1g}"
            + ("" if count is None else "; --field-nodes auto takes as many as it needs")
        )
    return nodes, [_Job(camera, nodes.told(plan_at(place))) for place in nodes.places]


def _write(task: _Task, job: _Job, output: Path | str) -> PifSummary:
    """Compute one matrix into its file."""
    from plenocli.base.budget import on_threads, one_thread
    from plenocli.files.artefacts import pif_pieces
    from plenocli.files.artefacts.writing import write_artefact
    from plenocli.forward.propagation.diagnosis import describe
    from plenocli.forward.propagation.models import on_device
    from plenocli.forward.propagation.system_matrix import build_pif

    camera, plan = job.camera, on_device(job.plan, task.settings.device)
    provenance = _provenance(task.camera_path, camera, task.settings, plan, task.command)

    def finish(matrix: SystemMatrix, found: Diagnosis) -> Artefact:
        return _artefact(camera, task.settings, matrix, found, provenance)

    # the diagnosis too: its singular values must not depend on the cores of a machine
    with one_thread(), on_threads(task.workers):
        chosen = pif_pieces.layout(plan, task.camera_path)
        _announce(camera, plan, pif_pieces.cost(plan)[1], task)
        with bar(None, total=plan.shape[0] * plan.shape[3], label="columns of A") as shown:

            def progress(done: int, total: int) -> None:
                shown.update(done - shown.n)

            if chosen.streamed:
                matrix, found = pif_pieces.stream_pif(
                    camera,
                    plan,
                    output,
                    chosen,
                    finish,
                    overwrite=task.overwrite,
                    progress=progress,
                )
            else:
                matrix = build_pif(camera, plan, progress=progress)
                found = describe(matrix)
    for warning in found.warnings:
        note(warning)
    if not chosen.streamed:
        write_artefact(output, finish(matrix, found), overwrite=task.overwrite)
    return summary_of(str(output), matrix, found, plan)


def _write_several(
    task: _Task, jobs: list[_Job], several: DepthPlanes | FieldNodes, output: Path | str
) -> SeveralSummary:
    """Compute the matrices of all planes or places into files of their own, then the index; all
    appear together.
    """
    from plenocli.files.artefacts import pif_pieces
    from plenocli.files.artefacts.shards import shard_path, write_field, write_planes
    from plenocli.files.atomic import check_output, together
    from plenocli.forward.accuracy.field_nodes import FieldNodes

    files = [shard_path(output, number) for number in range(len(jobs))]
    for job, file in zip(jobs, files):
        check_output(file, overwrite=task.overwrite, inputs=[task.camera_path], suffixes=(".h5",))
        pif_pieces.layout(job.plan, task.camera_path)  # refused before the first is computed
    note(several.line())
    with together():
        made = [_write(task, job, file) for job, file in zip(jobs, files)]
        provenance = _provenance(
            task.camera_path, jobs[0].camera, task.settings, jobs[0].plan, task.command
        )
        if isinstance(several, FieldNodes):
            write_field(output, several, provenance, overwrite=task.overwrite)
        else:
            write_planes(
                output, several.distances, several.error, provenance, overwrite=task.overwrite
            )
    return SeveralSummary(output=str(output), several=several, made=made)


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


def _planned(camera: Camera, settings: Settings, needs: SceneNeeds | None) -> PifPlan:
    from plenocli.forward.accuracy.dial import plan_pif

    request = _request(camera, settings, needs)
    return plan_pif(camera, **request, lenslet=settings.lenslet)


def _request(camera: Camera, settings: Settings, needs: SceneNeeds | None) -> dict[str, Any]:
    """What the dial is asked, wherever the lenslet stands."""
    return dict(
        wavelengths=_wavelengths(camera, settings),
        superpixels=settings.superpixels,
        coherent_ring=settings.coherent_ring,
        accuracy=settings.accuracy,
        model=settings.model,
        dtype=settings.dtype,
        needs=needs,
    )


def _announce(camera: Camera, plan: PifPlan, memory: int, task: _Task) -> None:
    """Tell the warnings of a plan that this task did not tell before, that it does not take the
    device where it does not, and that the work takes long where it does.
    """
    from plenocli.forward.accuracy.explain import command_seconds, expectation

    beside = command_seconds(camera, plan).beside
    elsewhere, device = "", task.settings.device
    if plan.device != device:
        elsewhere = f"--device {device}: {plan.rung}, is computed on the processor"
    for line in (*plan.warnings, elsewhere, expectation(plan, memory, beside=beside)):
        if line and line not in task.announced:
            note(line)
            task.announced.add(line)


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


def _explained(
    jobs: list[_Job], several: DepthPlanes | FieldNodes | None, camera_path: Path | str
) -> PlanSummary:
    """The plan of all matrices; in detail that of the dearest one."""
    from plenocli.files.artefacts import pif_pieces
    from plenocli.forward.accuracy.explain import (
        PlaneCost,
        command_seconds,
        considered,
        explain,
        planes_table,
    )

    took = [command_seconds(job.camera, job.plan) for job in jobs]
    costs = [
        PlaneCost(
            distance=job.camera.object.distance,
            superpixels=job.plan.superpixels,
            seconds=times.together - times.start,
            bytes=job.plan.bytes,
            memory=pif_pieces.cost(job.plan)[1],
        )
        for job, times in zip(jobs, took)
    ]
    dearest = max(range(len(jobs)), key=lambda n: costs[n].seconds)
    plan = jobs[dearest].plan
    refusal = pif_pieces.refusal(plan, camera_path)
    if refusal:
        plan = replace(plan, warnings=(*plan.warnings, f"would be refused: {refusal}"))
    text = explain(plan, costs[dearest].memory, took[dearest])
    of_planes = several is not None and several.kind == "planes" and len(jobs) > 1
    if several is not None and len(jobs) > 1:
        table = planes_table(costs) if of_planes else []
        text = "\n".join([several.line(), *table, "", "the dearest:", text])
    return PlanSummary(
        plan=text,
        memory=max(cost.memory for cost in costs),
        accuracy=plan.accuracy_record(),
        considered=considered(plan),
        seconds=took[0].start + sum(cost.seconds for cost in costs),
        bytes=sum(cost.bytes for cost in costs),
        superpixels=plan.superpixels,
        coherent_ring=plan.coherent_ring,
        estimated_accuracy=plan.estimated,
        planes=costs if of_planes else [],
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
