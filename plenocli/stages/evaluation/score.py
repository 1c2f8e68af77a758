"""score: results against the truth, side by side, as JSON, a table and (on
request) the report page.
"""

import json
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError, PlenoError, UsageError
from plenocli.base.progress import note
from plenocli.base.text import plain
from plenocli.evaluation.depth_score import score_lightfield
from plenocli.evaluation.response_score import score_calibration
from plenocli.evaluation.spectra_score import against_single_pixel, score_spectra
from plenocli.execution.batch import failed_together
from plenocli.files.read.results import CHART, block_of, read_result, read_truth, read_whites

GROUPS = {
    "psnr": ("psnr_db", "psnr_inner_db", "psnr_clipped_db"),
    "ssim": ("ssim",),
    "block-mean": ("block_mean_psnr_db", "gain_over_block_mean_db"),
    "rmse": ("rmse", "rmse_per_band"),
    "patches": (
        "patches",
        "patch_rmse_per_band",
        "six_patch_rmse",
        "six_patch_rmse_per_band",
        "six_patches_seen",
    ),
    "spectral-angle": ("spectral_angle_deg",),
    "delta-e": ("delta_e_2000",),
    "classification": ("classification_accuracy", "nearest_patch_accuracy"),
    "single-pixel": (
        "rmse_over_single_pixel",
        "six_patch_rmse_over_single_pixel",
        "delta_e_over_single_pixel",
        "snr_over_single_pixel_db",
    ),
    "response": (
        "response_gain_per_band",
        "response_error_per_band",
        "response_error_lenslet_per_band",
        "response_pixel_per_band",
        "response_leak",
    ),
    "depth": (
        "depth_slope",
        "depth_slope_found",
        "depth_slope_error",
        "depth_slope_worst",
        "depth_sure_share",
        "sharpest_slope_error",
        "depth_distance_m",
        "depth_distance_error_m",
        "depth_limit_m",
    ),
    "limits": (
        "noise_relative",
        "model_error_relative",
        "limited_by",
        "loss_at_most_db",
        "seen_share",
    ),
    "snr": (
        "snr_capture_db",
        "snr_capture_mean_db",
        "snr_predicted_db",
        "snr_predicted_mean_db",
        "snr_sensor_db",
    ),
    "coherence": (
        "coherence_raw",
        "coherence_candes_romberg",
        "coherence_effective",
        "coherence_effective_mean",
        "welch_bound",
        "exact_recovery_sparsity",
        "dead_atoms",
        "invisible_atoms",
        "atoms",
        "points",
        "pixels",
    ),
}
"""What --metric may ask for, and the numbers that each brings."""


def run_score(
    results,
    output,
    *,
    truth=None,
    report=None,
    metrics=(),
    whites=(),
    patches=None,
    pif=None,
    capture=None,
    block=None,
    sampling="fit",
    light="D65",
    camera=None,
    overwrite=False,
    command="",
):
    """Score every result, write `output` (JSON) and perhaps `report` (HTML); returns the JSON
    document as a dict.

    results: paths.
    truth: path or scene name, needed but for dictionaries.
    whites: spectra of a white target, frames.
    patches: label map or "colorchecker".
    pif: system matrix (dictionaries need it).
    capture: for its sensor-model SNR.
    block: object samples per lenslet (h, w), else from the files.
    light: for colour differences.
    camera: TOML, through whose filters spectra see the truth. One bad result does not stop the
        others: its message is printed and stands in its place; an error with the exit code of the
        worst is raised at the end.
    """
    from plenocli.files.artefacts.provenance import describe_inputs
    from plenocli.files.artefacts.shards import read_pif
    from plenocli.files.atomic import check_output, publish

    inputs = [*results, truth, *whites, patches, pif, capture, camera]
    files = [path for path in inputs if path is not None and Path(path).is_file()]
    for target, suffix in ((output, ".json"), (report, ".html")):
        if target is not None:
            check_output(target, overwrite=overwrite, inputs=files, suffixes=(suffix,))
    system = read_pif(pif) if pif else None
    context = _Context(truth, whites, patches, system, capture, block, sampling, light, camera)
    scored, pictures, errors = [], [], []
    for path in results:
        try:
            entry, picture = _score_one(path, context)
        except PlenoError as error:
            if len(results) == 1:
                raise
            entry, picture = _failed(path, error, errors), None
        scored.append(entry)
        pictures.append(picture)
    against_single_pixel(scored)
    for i, path in enumerate(results):
        try:
            if "error" not in scored[i]:
                _keep(scored[i]["metrics"], metrics)
        except PlenoError as error:
            if len(results) == 1:
                raise
            scored[i], pictures[i] = _failed(path, error, errors), None
    if len(errors) == len(results):
        raise failed_together(
            errors, len(results), "results", None, "nothing is written; see the messages above"
        )
    _name_apart(scored, results)
    document = {
        "metrics": next(entry["metrics"] for entry in scored if "error" not in entry),
        "results": scored,
        "definitions": _definitions(scored),
        "command": command,
        "inputs": describe_inputs(
            {
                "result": list(results),
                "truth": truth if truth and Path(truth).is_file() else None,
                "white": list(whites),
                "camera": camera,
                "patches": patches if patches and Path(patches).is_file() else None,
                "pif": pif,
                "capture": capture,
            }
        ),
    }
    document = plain(document)
    publish(
        output,
        (json.dumps(document, indent=1, allow_nan=False) + "\n").encode(),
        overwrite=overwrite,
    )
    if report is not None:
        from plenocli.report.score_page import score_page

        publish(report, score_page(document, pictures).encode(), overwrite=overwrite)
    if errors:
        raise failed_together(
            errors, len(results), "results", output, "the others are scored; see the messages above"
        )
    return document


def _failed(path, error, errors):
    """The entry of a result that cannot be scored; its error is told and kept."""
    note(f"error: {error}")
    errors.append((path, error))
    return {
        "name": Path(path).name,
        "error": str(error).replace(str(path), Path(path).name),
        "metrics": {},
    }


class _Context:
    """Everything a result is scored with; files are read once."""

    def __init__(self, truth, whites, patches, system, capture, block, sampling, light, camera):
        from plenocli.files.read.cameras import read_camera
        from plenocli.forward.scene.tables import illuminant

        illuminant(light, [560e-9])  # an unknown name is refused before any work
        if patches is None and str(truth) == CHART:
            patches = CHART
        self.truth, self.patches, self.system, self.block = truth, patches, system, block
        self.sampling, self.light = sampling, light
        self.whites = read_whites(whites)
        self.camera = read_camera(camera) if camera else None
        self.sensor_snr = _sensor_snr(capture) if capture else None


POINT_BYTES = 128
"""Memory for each point of a picture that is compared (measured)."""


def _score_one(path, context):
    """(JSON-able entry, what the report draws) of one result."""
    from plenocli.base.budget import budget

    result = read_result(path, ("image", "spectra", "dictionary", "calibration", "lightfield"))
    entry = {"name": Path(path).name, "kind": result.kind}
    if result.kind == "calibration":
        wavelengths, entry["metrics"] = score_calibration(path, context.truth)
        return entry | {"wavelengths_nm": [round(float(w) * 1e9, 6) for w in wavelengths]}, None
    if result.kind == "lightfield":
        entry["metrics"] = score_lightfield(path, context.truth)
        return entry, None
    if result.method:
        entry["method"] = result.method
    if result.kind == "dictionary":
        entry["metrics"] = _score_dictionary(path, result, context.system)
        return entry, {"result": result}
    if context.truth is None:
        raise UsageError(
            "the truth is missing",
            path,
            (
                "name it with --truth: a capture, photograph, spectral EXR, image, "
                "spectra or colorchecker"
            ),
        )
    truth = read_truth(context.truth, result, context.sampling, context.camera)
    if not np.isfinite(truth).any():
        raise InputError("holds no finite value", context.truth, "name a truth that has values")
    picture = {"result": result, "truth": truth}
    if result.wavelengths is None:
        budget().require(
            POINT_BYTES * truth.size,
            "the comparison",
            path,
            "score a part of it",
        )
        block = context.block or block_of(result, context.truth, context.system)
        entry["metrics"] = _score_image(path, result, truth, block)
        picture["block"] = block
    else:
        entry["wavelengths_nm"] = [round(float(w) * 1e9, 6) for w in result.wavelengths]
        entry["metrics"], entry["patches"] = score_spectra(path, result, truth, context)
        picture["patches"] = entry["patches"]
    limits = (
        result.attrs.get("parameters", {}).get("limits")
        if isinstance(result.attrs.get("parameters"), dict)
        else None
    )
    if limits:
        entry["metrics"] |= {
            "noise_relative": limits["noise"],
            "model_error_relative": limits["model_error"],
            "limited_by": limits["limited_by"],
        }
        if limits.get("loss_at_most_db") is not None:
            entry["metrics"]["loss_at_most_db"] = limits["loss_at_most_db"]
    seen = (
        result.attrs.get("parameters", {}).get("seen")
        if isinstance(result.attrs.get("parameters"), dict)
        else None
    )
    if seen:
        entry["metrics"]["seen_share"] = seen["share"]
    if context.sensor_snr is not None:
        entry["metrics"]["snr_sensor_db"] = context.sensor_snr
    return entry, picture


def _score_image(path, result, truth, block):
    from plenocli.evaluation.metrics.quality import score_picture

    if not (np.isfinite(result.values).all() and np.isfinite(truth).all()):
        raise InputError(
            "holds values that are not finite", path, "reconstruct again; pictures have no gaps"
        )
    if block is not None and any(n % b for n, b in zip(result.grid, block, strict=True)):
        raise UsageError(
            (
                f"{result.grid[0]} x {result.grid[1]} points are no whole number of {block[0]} "
                f"x {block[1]} blocks"
            ),
            path,
            "correct --block",
        )
    return score_picture(result.values, truth, block)


def _sensor_snr(path):
    """Sensor-model SNR of a capture from its mosaic and the noise it says it got."""
    from plenocli.evaluation.metrics.snr import snr_sensor
    from plenocli.files.artefacts.container import read_artefact

    capture = read_artefact(path, "capture")
    attrs = capture.attrs.get("capture", {})
    sigma = float(attrs.get("noise_sigma") or 0)
    if not sigma > 0:
        raise InputError(
            "names no noise level",
            path,
            "simulate it with capture-sim --snr, or leave --capture out",
        )
    signal = np.asarray(capture.data["capture/mosaic"], dtype=np.float64) - float(
        np.mean(attrs.get("black") or 0)
    )
    return snr_sensor(signal, sigma, noisy=True)


def _score_dictionary(path, result, system):
    """Coherence of the atoms with the matrix of their own superpixel, scaled as the
    dictionary was learnt with.
    """
    from plenocli.evaluation.metrics.coherence import coherence

    if system is None:
        raise UsageError(
            "the coherence of a dictionary depends on the system matrix",
            path,
            "name it with --pif pif.h5",
        )
    offsets = np.asarray(system.data["pif/lenslet_offset"])
    own = np.flatnonzero((offsets == 0).all(axis=1))
    matrix = system.data["pif/A"][0, own[0] if own.size else 0]
    if matrix.shape[1] != len(result.values):
        raise InputError(
            f"has atoms of {len(result.values)} points, the matrix has {matrix.shape[1]}",
            path,
            "name the matrix it was learnt for",
        )
    scale = float(result.attrs.get("scale") or 1.0)
    return coherence(
        matrix / matrix.dtype.type(scale), result.values.astype(matrix.dtype, copy=False)
    )


def _keep(scores, wanted):
    """Leave only the metrics asked for; UsageError where one could not be computed."""
    if not wanted:
        return
    for group in wanted:
        if not any(name in scores for name in GROUPS[group]):
            raise UsageError(
                f"--metric {group} does not apply to this result with what was given",
                fix=_NEEDS.get(group, "leave it out"),
            )
    names = {name for group in wanted for name in GROUPS[group]} | (
        {"snr_target"} if "snr" in wanted else set()
    )
    for name in [name for name in scores if name not in names]:
        del scores[name]


_NEEDS = {
    "snr": "name the spectra of a white target with --white, or a --capture simulated with --snr",
    "patches": "give a label map with --patches",
    "block-mean": "give the object samples per lenslet with --block 40x40",
    "coherence": "give a dictionary and --pif",
    "response": "give a calibration and name another one with --truth",
    "spectral-angle": "give a spectral result",
    "limits": "give a picture that reconstruct made with a --pif of known accuracy",
    "delta-e": "give a spectral result",
    "depth": "give planes of refocus --camera",
    "classification": (
        "give a spectral result and its --patches, two or more; one of the two numbers "
        "needs scikit-learn"
    ),
    "single-pixel": "give spectra of demux --method single-pixel among the results",
}


def _name_apart(scored, paths):
    """Short labels for the table: file stems, with the folder's name where two stems are equal,
    else with a number.
    """
    stems = [Path(path).stem for path in paths]
    labels = (
        stems
        if len(set(stems)) == len(stems)
        else [f"{Path(p).parent.name}/{stem}" for p, stem in zip(paths, stems, strict=True)]
    )
    for number, (entry, label) in enumerate(zip(scored, labels, strict=True), start=1):
        entry["label"] = label if labels.count(label) == 1 else f"{label} {number}"


def _definitions(scored):
    from plenocli.evaluation.metrics import (
        classify,
        coherence,
        depth,
        quality,
        response,
        snr,
        spectral,
    )

    found = {}
    for entry in scored:
        home = {
            "dictionary": [coherence],
            "image": [quality],
            "spectra": [spectral],
            "lightfield": [depth],
        }.get(entry.get("kind"), [])
        if entry.get("kind") == "calibration":
            home = [response]
        elif "wavelengths_nm" in entry:
            home = [spectral, quality]
        for name in entry["metrics"]:
            for module in (*home, snr, classify):
                if name in module.DEFINITIONS:
                    found[name] = module.DEFINITIONS[name]
                    break
    return found


def table(document):
    """The results side by side as text: one row a metric, one column a result."""
    from plenocli.report.tables import metric_rows

    header, rows = metric_rows(document)
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = [
        "  ".join(
            cell.ljust(w) if i == 0 else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in [header, *rows]
    ]
    lines.insert(1, "  ".join("-" * w for w in widths))
    return "\n".join(line.rstrip() for line in lines)
