"""demux: band radiances or reflectances behind every lenslet of captures, with predicted
standard deviations.
"""

import threading
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError, NumericsError
from plenocli.base.progress import note
from plenocli.execution.batch import outcomes, plan_batch, summarise
from plenocli.execution.pool import absolute, open_pool
from plenocli.files.read.mosaics import read_exposure
from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE
from plenocli.inverse.spectra.radiance import estimate, light_prior, read_response, readout


@dataclass(frozen=True)
class Settings:
    """method: pinv, single-pixel, wls, lmmse, nnls or auto;
    reference_reflectance: of the white reference;
    register: auto, on or off, whether captures are brought into line with the
        calibration (plenocli.inverse.registration.alignment).
    """

    method: str = "auto"
    reference: Path | None = None
    reference_reflectance: float = REFERENCE_REFLECTANCE
    register: str = "auto"


def run_demux(
    captures,
    output,
    *,
    calibration,
    settings=Settings(),
    suffix=".exr",
    workers=1,
    scheduler=None,
    overwrite=False,
    command="",
):
    """Demultiplex every capture; returns a summary dict.

    One capture gives the file `output` (.exr or .h5), several a folder with one file each, named
    after the capture; finished ones are skipped unless overwrite. A capture that fails does not
    stop the others: its message is printed and an error is raised at the end, with the exit
    code of the worst.
    workers: captures that are read and demultiplexed at the same time, in threads; they share one
        calibration, and results are written one at a time.
    scheduler: a Dask cluster that demultiplexes them instead (stages.scheduler).
    """
    # a library of its own, which the limit below reaches only once it is loaded
    import scipy.linalg.blas  # noqa: F401
    from threadpoolctl import threadpool_limits

    batch = plan_batch(
        captures,
        output,
        suffix,
        "spectra are",
        overwrite=overwrite,
        inputs=[*captures, calibration, settings.reference],
    )
    # captures are what runs side by side, and the bytes must not depend on how many
    with threadpool_limits(1, "blas"):
        # a broken calibration ends the run here, before any capture
        job = (
            Demultiplexer(calibration, settings, overwrite, command, min(workers, len(batch.todo)))
            if batch.todo
            else None
        )
        _say_what_is_old(batch, calibration, settings)
        if not batch.todo:
            return summarise(batch, ())
        work = (
            job.demux
            if scheduler is None
            else partial(
                demux_elsewhere,
                (
                    absolute(calibration),
                    replace(settings, reference=absolute(settings.reference)),
                    tuple(i["sha256"] for i in job.inputs.values()),
                ),
            )
        )
        with open_pool(min(workers, len(batch.todo)), scheduler, threads=True) as pool:
            return summarise(batch, outcomes(batch, pool, work, job.write))


def _say_what_is_old(batch, calibration, settings):
    """A note where finished results, which stay, were made in another way than this run would
    make them, or are damaged.
    """
    from plenocli.files.artefacts.provenance import describe_inputs

    kept = [target for job in batch.jobs if job not in batch.todo for target in job[1:]]
    if not kept:
        return
    ours = _recipe(
        describe_inputs({"calibration": calibration, "reference": settings.reference}),
        settings.method,
        settings.register == "off",
    )
    old = [target.name for target in kept if _recipe_of(target) != ours]
    if old:
        note(
            f"warning: {len(old)} of {len(kept)} finished results in {batch.output} were made "
            "with another calibration, reference or method, or are damaged, and stay as they are "
            f"({', '.join(old[:3])}{', ...' if len(old) > 3 else ''}): delete them, or pass "
            "--overwrite to make all anew"
        )


def _recipe(inputs, method, unregistered):
    return {role: inputs.get(role, {}).get("sha256") for role in ("calibration", "reference")} | {
        "method": method,
        "unregistered": unregistered,
    }


def _recipe_of(target):
    """The recipe of a finished result, None where it cannot be read."""
    import json

    from plenocli.files.artefacts.container import read_artefact
    from plenocli.files.artefacts.provenance import read_provenance_texts
    from plenocli.files.images.spectral_exr import read_spectral_exr

    try:
        if target.suffix == ".h5":
            artefact = read_artefact(target, "spectra")
            inputs, parameters = artefact.provenance.inputs, artefact.attrs["spectra"]["parameters"]
        else:
            attrs = read_spectral_exr(target).attrs
            inputs, parameters = (
                read_provenance_texts(attrs).inputs,
                json.loads(attrs["parameters"]),
            )
        return _recipe(inputs, parameters["asked"], parameters["registration"] is None)
    except (InputError, KeyError, TypeError, ValueError):
        return None


@lru_cache(maxsize=1)
def _demultiplexer(recipe):
    return Demultiplexer(*recipe[:2], False, "")


def demux_elsewhere(recipe, capture):
    """Demultiplexer.demux of a capture in a process of its own, which reads the calibration once.

    recipe: calibration, settings, and digests that tell them from others of the same name.
    """
    return _demultiplexer(recipe).demux(capture)


class Demultiplexer:
    """What any number of captures need: calibration read and factored, white reference
    demultiplexed, once.
    """

    def __init__(self, calibration, settings, overwrite, command, threads=1):
        from plenocli.files.artefacts.provenance import describe_inputs

        self.settings, self.overwrite, self.command = settings, overwrite, command
        self.inputs = describe_inputs({"calibration": calibration, "reference": settings.reference})
        found = read_response(calibration)
        self.prior = light_prior(found)
        self.calibration, self._lock = (
            replace(found, white=None, threads=threads).prepare(),
            threading.Lock(),
        )
        self.reference = None
        if settings.reference is not None:
            self.reference = self.demux(settings.reference, self._plain_method())[0]

    def _plain_method(self):
        """The white reference is demultiplexed without a prior: a prior's pull
        would not divide out.
        """
        method = self.settings.method
        return {"auto": "pinv", "lmmse": "wls"}.get(method, method)

    def demux(self, path, method=None):
        """(Estimate, name and digest) of one capture, registered to the calibration."""
        from plenocli.files.artefacts.provenance import describe_inputs

        exposure = read_exposure(path, cfa=self.calibration.cfa)
        return self.estimate(exposure, path, method), describe_inputs({"capture": path})

    def estimate(self, exposure, path, method=None):
        """The Estimate of a capture that was read already."""
        from plenocli.inverse.registration.alignment import doubtful, judge

        method = method or self.settings.method
        signal, noise = readout(exposure, self.calibration, path)
        found = self._aligned(signal, noise, method, path, self.settings.register)
        if self.settings.register == "auto" and doubtful(found.residual, found.record):
            found = self._believed(found, signal, noise, method, path)
        if not np.isfinite(found.value).any():
            raise NumericsError(
                "no lenslet could be demultiplexed", path, "check exposure and calibration"
            )
        return replace(found, warning=judge(found.residual, found.record, path))

    def _believed(self, found, signal, noise, method, path):
        """`found`, or the estimate with motion alone corrected, or with nothing: the first that
        explains its residuals.
        """
        from plenocli.inverse.registration.alignment import believed

        plain = self._aligned(signal, noise, method, path, "off")
        if believed(found.residual, plain.residual):
            return found
        if "motion" in found.record["corrected"]:
            moved = (
                found
                if found.record["corrected"] == ["motion"]
                else self._aligned(signal, noise, method, path, "auto", levels=False)
            )
            if believed(moved.residual, plain.residual):
                return moved
        return replace(plain, record=found.record | {"corrected": []})

    def _aligned(self, signal, noise, method, path, mode, levels=True):
        from plenocli.inverse.registration.alignment import align

        c, signal, stray, record = align(self.calibration, signal, noise, mode, path, levels)
        return replace(
            estimate(
                c, signal, noise, method, self.prior, self.settings.reference is not None, stray
            ),
            record=record,
        )

    def write(self, done, capture, target):
        """Write what `demux` returned for `capture` to `target`; returns its report."""
        found, own = done
        value, sigma, reference = found.value, found.sigma, self.settings.reference
        quantity = "radiance"
        if reference is not None:
            value, sigma = _reflectance(
                value,
                sigma,
                self.reference.value,
                self.reference.sigma,
                self.settings.reference_reflectance,
            )
            quantity = "reflectance"
            if not np.isfinite(value).any():
                raise NumericsError(
                    "no lenslet has light in capture and reference", capture, "check the reference"
                )
        attrs = dict(quantity=quantity, method=found.method) | (
            {} if reference is None else {"reference": Path(reference).name}
        )
        parameters = {
            "registration": found.record,
            "warning": found.warning,
            "asked": self.settings.method,
            "reason": found.why,
            "reference_reflectance": None
            if reference is None
            else self.settings.reference_reflectance,
        }
        wavelengths = self.calibration.wavelengths
        _write(
            target,
            wavelengths,
            np.moveaxis(value, -1, 0),
            np.moveaxis(sigma, -1, 0),
            found.residual,
            attrs,
            parameters,
            own | self.inputs,
            self.overwrite,
            self.command,
        )
        seen = np.isfinite(value).all(axis=-1)
        return dict(
            capture=Path(capture).name,
            output=str(target),
            method=found.method,
            reason=found.why,
            registration=found.record,
            warning=found.warning,
            quantity=quantity,
            lenslets=int(seen.sum()),
            array=list(value.shape[:2]),
            bands_nm=[float(w * 1e9) for w in wavelengths],
            mean=[float(v) for v in value[seen].mean(axis=0)],
            sigma=[float(v) for v in np.nanmean(sigma[seen], axis=0)]
            if np.isfinite(sigma[seen]).any()
            else None,
        )


def _reflectance(value, sigma, white, white_sigma, level):
    """Ratio to the white reference times its reflectance, with both relative errors."""
    with np.errstate(divide="ignore", invalid="ignore"):
        known = np.where(white > 0, white, np.nan)
        ratio = level * value / known
        spread = level / known * np.sqrt(sigma**2 + (value / known * white_sigma) ** 2)
    return ratio, spread


def _write(
    target, wavelengths, value, sigma, residual, attrs, parameters, inputs, overwrite, command
):
    from plenocli.files.artefacts.container import Artefact, write_artefact
    from plenocli.files.artefacts.provenance import Provenance, provenance_texts
    from plenocli.files.images.spectral_exr import write_spectral_exr

    value, sigma, provenance = (
        value.astype(np.float32),
        sigma.astype(np.float32),
        Provenance(command, inputs),
    )
    if Path(target).suffix == ".h5":
        data = {"spectra/value": value, "spectra/sigma": sigma, "spectra/wavelength": wavelengths}
        if residual is not None:
            data["spectra/residual"] = residual
        write_artefact(
            target,
            Artefact("spectra", data, {"spectra": attrs | {"parameters": parameters}}, provenance),
            overwrite=overwrite,
        )
        return
    import json

    from plenocli.forward.scene.colour import preview_rgb

    whole = np.nan_to_num(value)
    if attrs["quantity"] == "reflectance":
        rgb = preview_rgb(wavelengths, whole)
    else:  # no light is taken off: shown under the one that was there
        rgb = preview_rgb(wavelengths, whole / max(float(whole.max()), 1e-30), "E")
    texts = {
        "method": attrs["method"],
        "parameters": json.dumps(parameters, sort_keys=True),
    } | provenance_texts(provenance)
    if attrs["quantity"] == "radiance":
        texts["emissiveUnits"] = "relative"
    write_spectral_exr(
        target,
        wavelengths,
        value,
        attrs["quantity"],
        rgb=rgb,
        sigma=sigma,
        attrs=texts,
        overwrite=overwrite,
    )
