"""simulate-pif: the system matrix of a camera by wave optics, with what it can
and cannot resolve.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from plenocli.base.errors import UsageError
from plenocli.base.progress import bar, note


@dataclass(frozen=True)
class Settings:
    """What the command line says beyond the camera: wavelengths in m (empty: the camera's),
    spectral_step m, "auto" or None.
    """

    wavelengths: tuple = ()
    spectral_step: object = None
    superpixels: object = "auto"
    coherent_ring: object = "auto"
    accuracy: float | None = None
    model: str = "auto"
    scene: str | None = None
    lenslet: tuple | None = None
    dtype: str = "auto"


def run_simulate_pif(
    camera_path, output, settings, *, explain=False, overwrite=False, workers=1, command=""
):
    """Compute A and write it as a pif artefact; returns a summary dict.

    With `explain` only the plan is made.

    Errors: InputError and ConfigError for the camera, UsageError for options, NumericsError where
    memory or accuracy do not suffice, OutputError where the file cannot be written.
    """
    from plenocli.base.budget import one_thread
    from plenocli.files.artefacts import pif_pieces
    from plenocli.files.artefacts.container import Artefact, write_artefact
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output
    from plenocli.files.config.camera_file import to_toml
    from plenocli.files.read.cameras import camera_files, read_camera
    from plenocli.files.read.scene_needs import read_needs
    from plenocli.forward.accuracy.dial import plan_pif
    from plenocli.forward.accuracy.explain import expectation
    from plenocli.forward.propagation.diagnosis import describe
    from plenocli.forward.propagation.system_matrix import build_pif

    if not explain:
        if output is None:
            raise UsageError(
                "no output file given",
                "--output",
                "write -o pif.h5, or --explain to see the plan only",
            )
        check_output(output, overwrite=overwrite, inputs=[camera_path], suffixes=(".h5",))
    camera = read_camera(camera_path)
    needs = read_needs(settings.scene, camera) if settings.scene else None
    plan = plan_pif(
        camera,
        wavelengths=_wavelengths(camera, settings),
        superpixels=settings.superpixels,
        coherent_ring=settings.coherent_ring,
        accuracy=settings.accuracy,
        model=settings.model,
        dtype=settings.dtype,
        needs=needs,
        lenslet=settings.lenslet,
    )
    if explain:
        return _explained(plan, pif_pieces.cost(plan)[1])
    chosen = pif_pieces.layout(plan, camera_path)
    for line in (*plan.warnings, expectation(plan, pif_pieces.cost(plan)[1])):
        if line:
            note(line)
    scene = settings.scene if settings.scene and Path(settings.scene).is_file() else None
    provenance = Provenance(
        command,
        describe_inputs(camera_files(camera_path, camera) | {"scene": scene}),
        None,
        to_toml(camera),
        plan.accuracy_record().as_json(),
    )

    def finish(pif, found):
        data, attrs = _contents(pif, found)
        attrs["pif"]["lattice"] = camera.lenslet_array.lattice
        if settings.lenslet is not None:
            attrs["pif"]["notes"] |= _window(camera, settings.lenslet)
        return Artefact("pif", data, attrs, provenance)

    # the diagnosis too: its singular values must not depend on the cores of a machine
    with (
        one_thread(),
        bar(None, total=plan.shape[0] * plan.shape[3], label="columns of A") as progress,
    ):
        options = dict(
            progress=lambda done, total: progress.update(done - progress.n), workers=workers
        )
        if chosen.streamed:
            pif, found = pif_pieces.stream_pif(
                camera, plan, output, chosen, finish, overwrite=overwrite, **options
            )
        else:
            pif = build_pif(camera, plan, **options)
            found = describe(pif)
    for warning in found["warnings"]:
        note(warning)
    if not chosen.streamed:
        write_artefact(output, finish(pif, found), overwrite=overwrite)
    return _summary(output, pif, found, plan)


def _explained(plan, memory):
    from plenocli.forward.accuracy.explain import candidates, explain

    considered = candidates(plan)
    return {
        "plan": explain(plan, memory),
        "memory": memory,
        "accuracy": plan.accuracy_record().as_json(),
        "considered": considered,
        "seconds": next(c["seconds"] for c in considered if c["chosen"]),
        "bytes": plan.bytes,
        "superpixels": list(plan.superpixels),
        "coherent_ring": plan.coherent_ring,
        "estimated_accuracy": plan.estimated,
    }


def _wavelengths(camera, settings):
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


def _window(camera, lenslet):
    """Where the pixels of an off-axis lenslet's own superpixel lie on the sensor."""
    from plenocli.forward.camera.geometry import lenslet_shift

    row, column, shift = lenslet_shift(camera, *lenslet)
    return {"lenslet": list(lenslet), "first_pixel": [row, column], "pixel_shift": list(shift)}


def _contents(pif, found):
    data = {
        "pif/A": pif.A,
        "pif/wavelength": pif.wavelength,
        "pif/lenslet_offset": np.asarray(pif.lenslet_offset, np.int32),
        "pif/pixel_shape": np.array(pif.pixel_shape, np.int32),
        "pif/object_shape": np.array(pif.object_shape, np.int32),
        "pif/column_energy": pif.column_energy,
    }
    notes = pif.notes
    attrs = {
        "coherent_ring": notes["coherent_ring"],
        "kappa": notes["kappa"],
        "eps": notes["eps"],
        "superpixel_pitch": notes["superpixel_pitch"],
        "model": notes["model"],
        "notes": notes,
    }
    if "singular_values" in found:
        data["pif/singular_values"] = found["singular_values"]
    attrs |= {key: found[key] for key in ("rank", "condition", "symmetry_defect") if key in found}
    return data, {"pif": attrs}


def _summary(output, pif, found, plan):
    keep = {
        key: found[key]
        for key in ("rank", "rank_60db", "condition", "symmetry_defect", "energy_min", "energy_max")
        if key in found
    }
    bands, _, pixels, points = plan.shape
    return {
        "output": str(output),
        "bands": bands,
        "superpixels": list(plan.superpixels),
        "pixels": pixels,
        "points": points,
        "wavelengths": pif.wavelength.tolist(),
        "model": plan.model,
        "rung": plan.rung,
        "coherent_ring": plan.coherent_ring,
        "accuracy": plan.accuracy,
        "estimated_accuracy": plan.estimated,
        "kappa": pif.notes["kappa"],
        "eps": pif.notes["eps"],
        "bytes": plan.bytes,
        "nominal_seconds": plan.chosen.seconds(),
        "quartic_phase_rad": pif.notes["quartic_phase_rad"],
        "warnings": [*plan.warnings, *found["warnings"]],
        **keep,
    }


def line(report):
    """One sentence about what run_simulate_pif did, for people."""
    if "plan" in report:
        return report["plan"]
    low, high = min(report["energy_min"]), max(report["energy_max"])
    text = (
        f"{Path(report['output'])}: A of {report['bands']} band(s), "
        f"{report['superpixels'][0]}x{report['superpixels'][1]} superpixels, {report['pixels']} "
        f"pixels, {report['points']} points; column energy {low:.3f} to {high:.3f}"
    )
    if "rank" in report:
        text += (
            f"; rank {min(report['rank'])} ({min(report['rank_60db'])} above 60 dB noise), "
            f"condition {max(report['condition']):.1e}"
        )
    if "symmetry_defect" in report:
        text += f"; symmetry defect {min(report['symmetry_defect']):.1e}"
    return f"{text}; {report['rung']}, estimated error {report['estimated_accuracy']:.1g}"
