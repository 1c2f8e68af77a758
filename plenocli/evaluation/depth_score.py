"""A refocused capture against the plane that it shows."""

from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError, UsageError


def score_lightfield(path, truth):
    """Metrics of the light-field artefact `path` (from refocus --camera) against a plane: `truth`
    is its distance as text, such as 620mm, or the simulated capture, whose camera says it.
    UsageError, InputError.
    """
    from plenocli.evaluation.metrics.depth import counted, score_depth
    from plenocli.files.artefacts.container import read_artefact

    data = read_artefact(path, "lightfield").data
    if "depth/distance" not in data:
        raise InputError(
            "holds no distances" if "depth/slope" in data else "holds no depth map",
            path,
            "refocus three planes or more with --camera",
        )
    distance, known = _distance(truth, path), np.isfinite(data["refocus/distance"])
    if known.sum() < 2:
        raise InputError(
            "holds fewer than two planes at known distances", path, "refocus more of them"
        )
    # slopes are linear in 1/distance
    gradient, rest = np.polyfit(
        1 / data["refocus/distance"][known], data["refocus/slope"][known], 1
    )
    sure = counted(data["depth/slope"], data["depth/confidence"])
    off = np.abs(data["depth/distance"][sure] - distance)
    metrics = score_depth(
        data["depth/slope"],
        data["depth/confidence"],
        gradient / distance + rest,
        data["refocus/slope"],
        data["refocus/sharpness"],
    )
    return metrics | {
        "depth_distance_m": distance,
        "depth_distance_error_m": float(np.nanmedian(off)) if np.isfinite(off).any() else np.nan,
        "depth_limit_m": float(distance**2 / abs(gradient)),
    }


def _distance(truth, path):
    from plenocli.base.units import UnitError, parse_length
    from plenocli.files.artefacts.container import read_artefact
    from plenocli.files.config.camera_file import parse_camera

    if truth is None:
        raise UsageError(
            "the truth is missing",
            path,
            "name the plane's distance, such as --truth 620mm, or the simulated capture",
        )
    if not Path(truth).suffix == ".h5":
        try:
            return parse_length(str(truth))
        except UnitError as error:
            raise UsageError(
                f"a refocused capture is compared with the distance of a plane ({error})",
                "--truth",
                "write for example 620mm, or name the simulated capture",
            ) from None
    config = read_artefact(truth, "capture").provenance.config
    if not config:
        raise InputError(
            "does not say from how far it was taken",
            truth,
            "write the distance, such as --truth 620mm",
        )
    return parse_camera(config, truth).object.distance
