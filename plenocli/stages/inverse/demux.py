"""demux: band radiances or reflectances behind every lenslet of captures, with predicted
standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.budget import one_thread
from plenocli.base.errors import InputError, NumericsError
from plenocli.base.progress import collected_notes, note
from plenocli.base.text import Record
from plenocli.base.tiling import FORGETFUL, Keeper
from plenocli.execution.batch import outcomes, plan_batch, summarise
from plenocli.execution.pool import absolute, open_pool
from plenocli.files.images.mosaic import capture_in_file
from plenocli.files.read.captures import describe_capture, named_captures, room_beside
from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE
from plenocli.inverse.spectra.bands import stokes
from plenocli.inverse.spectra.demultiplexer import Demultiplexer, method_of_white, tell_misfit

if TYPE_CHECKING:
    from plenocli.execution.batch import Batch, BatchSummary
    from plenocli.inverse.calibration.calibration import Calibration
    from plenocli.inverse.registration.alignment import Registration
    from plenocli.inverse.spectra.spectra import Spectra

Name = str | Path
FEW = 6
"""Tiles of a capture up to which none is kept: some seconds of work."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How captures are demultiplexed.

    method: pinv, single-pixel, wls, lmmse, nnls, coupled, fine or auto.
    reference: capture of the white reference that makes reflectances of radiances, or None.
    reference_reflectance: of the white reference.
    register: auto, on or off, whether captures are brought into line with the calibration
        (plenocli.inverse.registration.alignment).
    camera: description of the calibrated camera, from which neighbours' light is predicted; None:
        as the calibration describes it, if it does.
    prior: labelled spectra whose mean and covariance lmmse starts from; None: many surfaces.
    """

    method: str = "auto"
    reference: Path | None = None
    reference_reflectance: float = REFERENCE_REFLECTANCE
    register: str = "auto"
    camera: Path | None = None
    prior: Path | None = None


@dataclass(frozen=True, kw_only=True)
class CaptureSummary:
    """What came of one capture.

    capture, output: file names.
    method, reason, registration, warning: plenocli.inverse.spectra.spectra.Trace.
    quantity: "radiance" or "reflectance".
    lenslets: how many have a value in every band.
    array: rows and columns of lenslets.
    bands_nm: (band,) nm.
    known: (band,), how many lenslets have a value.
    mean, sigma: (band,), over those, mean value and standard deviation; None: unknown.
    """

    capture: str
    output: str
    method: str
    reason: str
    registration: Registration | None
    warning: str | None
    quantity: str
    lenslets: int
    array: list[int]
    bands_nm: list[float]
    known: list[int]
    mean: list[float | None]
    sigma: list[float | None] | None

    def as_json(self) -> dict[str, Any]:
        """The entry of --json."""
        registration = None if self.registration is None else self.registration.as_json()
        flat = {field.name: getattr(self, field.name) for field in fields(self)}
        return flat | {"registration": registration}


@dataclass(frozen=True)
class DemuxSummary(Record):
    """What a run did.

    output: file or folder.
    done, skipped: captures demultiplexed now, and finished before.
    captures: those done now, in their order.
    """

    output: str
    done: int
    skipped: int
    captures: tuple[CaptureSummary, ...]


def run_demux(
    captures: Sequence[Name],
    output: Name,
    *,
    calibration: Name,
    settings: Settings = Settings(),
    suffix: str = ".exr",
    workers: int = 1,
    scheduler: str | None = None,
    overwrite: bool = False,
    command: str = "",
) -> DemuxSummary:
    """Demultiplex every capture.

    One capture gives the file `output` (.exr or .h5), several a folder with one file each, named
    after the capture; finished ones are skipped unless overwrite. A capture that fails does not
    stop the others: its message is printed and an error is raised at the end, with the exit
    code of the worst.
    captures: files, folders of them, or patterns (plenocli.files.read.captures.named_captures).
    workers: captures that are read and demultiplexed at the same time, in threads; they share one
        calibration, and results are written one at a time.
    scheduler: a Dask cluster that demultiplexes them instead (plenocli.execution.pool).
    """
    # a library of its own, which the limit below reaches only once it is loaded
    import scipy.linalg.blas  # noqa: F401

    others = [calibration, settings.reference, settings.camera, settings.prior]
    captures = named_captures(captures, others)
    batch = plan_batch(
        captures,
        output,
        suffix,
        "spectra are",
        overwrite=overwrite,
        inputs=[*captures, *others],
    )
    # captures are what runs side by side, and the bytes must not depend on how many
    with one_thread():
        # a broken calibration ends the run here, before any capture
        job = (
            CaptureDemultiplexer(
                calibration,
                settings,
                dict(batch.todo) if scheduler is None else {},
                overwrite,
                command,
                threads=min(workers, len(batch.todo)),
            )
            if batch.todo
            else None
        )
        _say_what_is_old(batch, calibration, settings)
        if job is None:
            return _summary(summarise(batch, ()))
        work = (
            job.demux
            if scheduler is None
            else partial(
                demux_elsewhere,
                Setup(
                    absolute(calibration),
                    replace(
                        settings,
                        reference=absolute(settings.reference),
                        camera=absolute(settings.camera),
                        prior=absolute(settings.prior),
                    ),
                    tuple(i["sha256"] for i in job.inputs.values()),
                ),
            )
        )
        with open_pool(min(workers, len(batch.todo)), scheduler, threads=True) as pool:
            return _summary(summarise(batch, outcomes(batch, pool, work, job.write)))


def _summary(done: BatchSummary) -> DemuxSummary:
    return DemuxSummary(
        output=done.output, done=len(done.reports), skipped=done.skipped, captures=done.reports
    )


def _say_what_is_old(batch: Batch, calibration: Name, settings: Settings) -> None:
    """A note where finished results, which stay, were made in another way than this run would
    make them, or are damaged.
    """
    from plenocli.files.artefacts.provenance import describe_inputs

    kept = [target for job in batch.jobs if job not in batch.todo for target in job[1:]]
    if not kept:
        return
    ours = _recipe(
        describe_inputs(_roles(calibration, settings)),
        settings.method,
        settings.register == "off",
    )
    old = [target.name for target in kept if _recipe_of(target) != ours]
    if old:
        note(
            f"warning: {len(old)} of {len(kept)} finished results in {batch.output} were made "
            "with another calibration, reference, camera or method, or are damaged, and stay as "
            "they are "
            f"({', '.join(old[:3])}{', ...' if len(old) > 3 else ''}): delete them, or pass "
            "--overwrite to make all anew"
        )


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What makes two results of one capture differ: digests of the calibration, the reference,
    the camera and the prior, the method asked for, and whether nobody looked for motion.
    """

    calibration: str | None
    reference: str | None
    camera: str | None
    prior: str | None
    method: str
    unregistered: bool


def _recipe(inputs: dict[str, Any], method: str, unregistered: bool) -> Recipe:
    calibration, reference, camera, prior = (
        inputs.get(role, {}).get("sha256")
        for role in ("calibration", "reference", "camera", "prior")
    )
    return Recipe(
        calibration=calibration,
        reference=reference,
        camera=camera,
        prior=prior,
        method=method,
        unregistered=unregistered,
    )


def _roles(calibration: Name, settings: Settings) -> dict[str, Any]:
    """Files that a result is made from beside its capture."""
    return {
        "calibration": calibration,
        "reference": settings.reference,
        "camera": settings.camera,
        "prior": settings.prior,
    }


def _recipe_of(target: Path) -> Recipe | None:
    """The recipe of a finished result, None where it cannot be read."""
    from plenocli.files.images.spectra import read_origin

    try:
        origin = read_origin(target)
        return _recipe(origin.inputs, origin.asked, not origin.registered)
    except (InputError, KeyError, TypeError, ValueError):
        return None


@dataclass(frozen=True)
class Setup:
    """What another process needs to demultiplex captures: calibration, settings, and digests that
    tell their files from others of the same name.
    """

    calibration: Name
    settings: Settings
    digests: tuple[str, ...]


@lru_cache(maxsize=1)
def _demultiplexer(setup: Setup) -> CaptureDemultiplexer:
    return CaptureDemultiplexer(setup.calibration, setup.settings, {}, False, "")


def demux_elsewhere(setup: Setup, capture: Name) -> tuple[Spectra, dict[str, Any]]:
    """CaptureDemultiplexer.demux in a process of its own, which reads the calibration once.

    capture: its file.
    """
    return _demultiplexer(setup).demux(capture)


class CaptureDemultiplexer:
    """What any number of captures need: calibration read and factored, white reference
    demultiplexed, once.

    calibration: its file.
    settings: how captures are demultiplexed.
    targets: results by the captures that follow, beside which one that cannot be read in parts is
        decoded where it is large, and finished tiles of a single large one are kept, for a run
        after one that was killed; empty: they are many, and not written here.
    overwrite: whether results replace files.
    command: for their provenance.
    threads: for factoring the response.
    """

    def __init__(
        self,
        calibration: Name,
        settings: Settings,
        targets: Mapping[Path, Path],
        overwrite: bool,
        command: str,
        threads: int = 1,
    ) -> None:
        from plenocli.files.artefacts.provenance import describe_inputs
        from plenocli.files.read.calibrations import read_described
        from plenocli.files.read.cameras import read_camera
        from plenocli.files.read.class_table import read_labelled
        from plenocli.inverse.calibration.calibration import there

        self.settings, self.overwrite, self.command = settings, overwrite, command
        self.targets, several = targets, len(targets) != 1
        self.inputs = describe_inputs(_roles(calibration, settings))
        found, described = read_described(
            calibration, needs=("response", "windows", "white", "dark"), in_file=True
        )
        only = None if several else next(iter(targets.items()))
        self.keeper: Keeper = FORGETFUL if only is None else self._keeper(*only, found)
        # remarks on results, told with the first of them: a refusal comes alone
        with collected_notes() as self.remarks:
            self.solver = Demultiplexer(
                found,
                method=settings.method,
                register=settings.register,
                ratio=settings.reference is not None,
                camera=described if settings.camera is None else read_camera(settings.camera),
                known=None
                if settings.prior is None
                else read_labelled(settings.prior, there(found.response).wavelengths),
                threads=threads,
                several=several or settings.reference is not None,
                keeper=self.keeper,
                where=calibration,
            )
        self.reference: Spectra | None = None
        if settings.reference is not None:
            self.reference = self.demux(settings.reference, self._method_of_reference())[0]

    def _keeper(self, capture: Path, target: Path, calibration: Calibration) -> Keeper:
        """What keeps tiles until the result is written, but where there are few."""
        from plenocli.files.bench import Bench
        from plenocli.inverse.calibration.calibration import there
        from plenocli.inverse.spectra.factored import tile_of

        lenslets = int(calibration.grid.valid.sum())
        if lenslets < FEW * tile_of(there(calibration.response).matrix):
            return FORGETFUL
        plain = replace(self.settings, reference=None, camera=None, prior=None)
        return Bench.beside(target, (plain, self.inputs, describe_capture(capture)))

    def _method_of_reference(self) -> str:
        """The white reference is even, so that lenslets need not know of each other, and is
        demultiplexed without a prior, whose pull would not divide out.
        """
        return method_of_white(self.settings.method)

    def demux(self, path: Name, method: str | None = None) -> tuple[Spectra, dict[str, Any]]:
        """Radiances of one capture, registered to the calibration, and its name and digest.

        method: of a reference, whose misfit is told with each capture's.
        """
        room = room_beside(self.targets.get(Path(path)))
        capture = capture_in_file(path, cfa=self.solver.responses.cfa, room=room)
        keeper = self.keeper.under("capture" if method is None else "reference")
        found = self.solver.estimate(capture, path, method, keeper)
        if method is None:
            told = {str(path): found}
            if self.reference is not None:
                told[str(self.settings.reference)] = self.reference
            tell_misfit(told)
        return found, describe_capture(path)

    def write(
        self, done: tuple[Spectra, dict[str, Any]], capture: Name, target: Name
    ) -> CaptureSummary:
        """Write what `demux` returned for `capture` to the file `target`."""
        from plenocli.files.artefacts.provenance import Provenance
        from plenocli.files.bench import clear
        from plenocli.files.images.spectra import write_spectra

        found, own = done
        # the white reference may have been asked for by another method than the captures
        found = replace(found, trace=replace(found.trace, asked=self.settings.method))
        if self.reference is not None:
            found = found.relative_to(self.reference, self.settings.reference_reflectance)
            if not np.isfinite(found.value).any():
                raise NumericsError(
                    "no lenslet has light in capture and reference", capture, "check the reference"
                )
        found = stokes(found)
        write_spectra(
            target,
            found,
            Provenance(command=self.command, inputs=own | self.inputs),
            reference=self.settings.reference,
            overwrite=self.overwrite,
        )
        clear(Path(target))
        while self.remarks:
            note(self.remarks.pop(0))
        return _capture_summary(found, capture, target)


def _capture_summary(found: Spectra, capture: Name, target: Name) -> CaptureSummary:
    seen = np.isfinite(found.value)
    sigma = _means(found.sigma)
    return CaptureSummary(
        capture=Path(capture).name,
        output=str(target),
        method=found.method,
        reason=found.trace.reason,
        registration=found.trace.registration,
        warning=found.trace.warning,
        quantity=found.quantity,
        lenslets=int(seen.all(axis=0).sum()),
        array=list(found.value.shape[1:]),
        bands_nm=[float(w * 1e9) for w in found.wavelength],
        known=[int(n) for n in seen.sum(axis=(1, 2))],
        mean=_means(found.value),
        sigma=sigma if any(one is not None for one in sigma) else None,
    )


def _means(values: np.ndarray) -> list[float | None]:
    """Mean of the known values of each band, None where there is none."""
    known = [band[np.isfinite(band)] for band in values]
    return [float(band.mean()) if band.size else None for band in known]
