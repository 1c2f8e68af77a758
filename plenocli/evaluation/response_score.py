"""Two calibrations side by side: a predicted response and a measured one, or two measured ones."""

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.text import by


def score_calibration(path, truth):
    """(wavelengths (band,) m, metrics) of the response of calibration `path` against that of
    calibration `truth`.
    """
    from plenocli.evaluation.metrics.response import score_response

    if truth is None:
        raise UsageError(
            "the truth is missing", path, "name with --truth the calibration to compare with"
        )
    response, other, wavelengths, _ = paired_responses(path, truth)
    return wavelengths, score_response(response, other)


def paired_responses(path, truth):
    """Responses (lenslet, pixel, band) of two calibrations over the lenslets and bands of both;
    (first, second, wavelengths, window).

    Where one of them is shared by all lenslets, it stands beside every lenslet of the other that
    has neighbours on all sides (the others lack light). InputError where windows or bands differ.
    """
    first, second = (_read(name) for name in (path, truth))
    if first["window"] != second["window"]:
        raise InputError(
            f"has windows of {by(first['window'])} px, {truth} of {by(second['window'])}",
            path,
            "compare calibrations of one camera",
        )
    near = [
        (i, j)
        for i, w in enumerate(first["wavelength"])
        for j, v in enumerate(second["wavelength"])
        if abs(w - v) < 0.05e-9
    ]
    if not near:
        raise InputError(
            "has no band of the other calibration",
            path,
            "predict the bands that were measured: --wavelength",
        )
    ours, theirs = (list(part) for part in zip(*near))
    a, b = first["response"][..., ours], second["response"][..., theirs]
    if a.ndim == 4 and b.ndim == 4:
        if a.shape != b.shape:
            raise InputError(
                f"has {by(a.shape[:2])} lenslets, {truth} {by(b.shape[:2])}",
                path,
                "predict on the measured grid: simulate-response --grid",
            )
        valid = first["valid"] & second["valid"]
        a, b = a[valid], b[valid]
    elif a.ndim == 4:
        a = a[_inner(first["valid"])]
    elif b.ndim == 4:
        b = b[_inner(second["valid"])]
    a, b = (part.reshape(-1, *part.shape[-2:]) for part in (a, b))
    shape = (max(len(a), len(b)), *a.shape[1:])
    a, b = (np.broadcast_to(part, shape).astype(float) for part in (a, b))
    return a, b, first["wavelength"][ours], first["window"]


def _read(path):
    from plenocli.files.artefacts.container import read_artefact

    data = read_artefact(path, "calibration").data
    if "response/F" not in data:
        raise InputError(
            "holds no response F, only the lenslet grid", path, "calibrate with --band captures"
        )
    return {
        "response": data["response/F"],
        "wavelength": data["response/wavelength"],
        "window": tuple(int(n) for n in data["response/window"]),
        "valid": data["grid/valid"].astype(bool),
    }


def _inner(valid):
    """Valid lenslets with neighbours on all sides, or all valid ones where none has."""
    inner = np.zeros_like(valid)
    inner[1:-1, 1:-1] = valid[1:-1, 1:-1]
    return inner if inner.any() else valid
