"""Spectral results in score: errors, patches, classification, SNR, and each method
against single pixel.
"""

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.text import by
from plenocli.files.read.results import CHART, read_labels

WHITE_LABEL = 19  # of the chart's patches row by row, the first of the last row
SINGLE = "single-pixel"


def score_spectra(path, result, truth, context):
    """(metrics, patches) of a spectral cube."""
    from plenocli.evaluation.metrics.quality import score_picture
    from plenocli.evaluation.metrics.spectral import patch_statistics, score_cube, score_patches
    from plenocli.forward.scene.tables import SIX_PATCHES, colorchecker, patch_index

    values = _reflectance(path, result, context)
    labels = None if context.patches is None else read_labels(context.patches, result.grid)
    scores = score_cube(values, truth, result.wavelengths, context.light)
    if not scores["lenslets"]:
        raise InputError(
            "has no lenslet with values in all bands",
            path,
            "check the calibration it was made with",
        )
    if result.kind == "image":
        scores |= score_picture(values, truth)
    listed = []
    if labels is not None:
        six = tuple(patch_index(name) + 1 for name in SIX_PATCHES)
        scores |= score_patches(values, truth, labels, six)
        true = patch_statistics(truth, labels)
        scores |= _classification(values, labels, true)
        names = colorchecker()[0]
        for label, found in patch_statistics(values, labels).items():
            listed.append(
                {
                    "label": label,
                    "name": names[label - 1],
                    "lenslets": found["count"],
                    "mean": found["mean"].tolist(),
                    "std": found["std"].tolist(),
                    "truth": true[label]["mean"].tolist() if label in true else None,
                    "one_of_six": label in six,
                }
            )
    scores |= _snr(result, labels, _whites(path, result, context))
    return scores, listed


def _reflectance(path, result, context):
    """The result's values as reflectance: as they are, or radiance divided by that
    of the white target.
    """
    from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE

    if result.quantity != "radiance":
        return result.values
    whites = _whites(path, result, context)
    if whites is None:
        if str(context.truth) == CHART:
            raise UsageError(
                "holds radiance, the truth is reflectance",
                path,
                "demux with --reference, or name the spectra of a white target with --white",
            )
        return result.values
    white = whites[0].mean(axis=0)
    if white.shape != result.values.shape:
        raise UsageError(
            (
                f"has {by(result.values.shape)} values (band x row x column), the white "
                f"target {by(white.shape)}"
            ),
            path,
            "demultiplex both with one calibration",
        )
    return (
        np.divide(result.values, white, out=np.full_like(white, np.nan), where=white > 0)
        * REFERENCE_REFLECTANCE
    )


def _snr(result, labels, whites):
    """Capture and predicted SNR on the white target, or on the chart's white patch
    where there is none.
    """
    from plenocli.evaluation.metrics.snr import snr_capture, snr_predicted

    if whites is not None:
        frames, sigma = whites
        target = (
            f"white target, {len(frames)} frames over time"
            if len(frames) > 1
            else "white target, one frame over its lenslets"
        )
    elif labels is not None and (labels == WHITE_LABEL).any():
        here = labels == WHITE_LABEL
        frames, sigma = (
            result.values[None][:, :, here],
            None if result.sigma is None else np.asarray(result.sigma)[:, here],
        )
        target = "white patch of the chart, over its lenslets"
    else:
        return {}
    scores = {"snr_target": target, "snr_capture_db": snr_capture(frames)}
    if sigma is not None:
        scores["snr_predicted_db"] = snr_predicted(frames[0], sigma)
    for name in ("snr_capture", "snr_predicted"):
        if f"{name}_db" in scores:
            bands = scores[f"{name}_db"]
            scores[f"{name}_mean_db"] = float(bands.mean()) if np.isfinite(bands).all() else None
            scores[f"{name}_db"] = bands.tolist()
    return scores


def _whites(path, result, context):
    """(frames (frame, band, row, column), sigma or None) of the white target made by the method of
    the result, else of all there are; None without any.
    """
    groups = context.whites
    if not groups:
        return None
    if result.method in groups:
        return groups[result.method]
    if len(groups) > 1:
        raise UsageError(
            (
                f"was made by {result.method or 'an unknown method'}, the white targets by "
                f"{', '.join(sorted(groups))}"
            ),
            path,
            "demultiplex a white target by the same method",
        )
    return next(iter(groups.values()))


def _classification(values, labels, true):
    """How often spectra tell their patch; the number that needs scikit-learn only
    where it is installed.
    """
    from plenocli.evaluation.metrics.classify import cross_validated, nearest_known, samples

    spectra, patches = samples(values, labels)
    known = {label: one["mean"] for label, one in true.items()}
    if len(known) < 2 or not len(patches) or not set(patches) <= set(known):
        return {}
    scores = {"nearest_patch_accuracy": nearest_known(spectra, patches, known)}
    try:
        scores["classification_accuracy"] = cross_validated(spectra, patches)
    except ImportError:
        pass
    return scores


def against_single_pixel(scored):
    """Add to every entry of spectra what it gains over the one of single pixel extraction, where
    there is exactly one.
    """
    base = [
        entry["metrics"]
        for entry in scored
        if entry.get("method") == SINGLE and "error" not in entry
    ]
    for entry in scored:
        if (
            len(base) != 1
            or entry.get("method") == SINGLE
            or entry.get("kind") != "spectra"
            or "error" in entry
        ):
            continue
        own = entry["metrics"]
        for name, ratio in (
            ("rmse", "rmse"),
            ("six_patch_rmse", "six_patch_rmse"),
            ("delta_e_2000", "delta_e"),
        ):
            if own.get(name) is not None and base[0].get(name):
                own[f"{ratio}_over_single_pixel"] = own[name] / base[0][name]
        pair = own.get("snr_capture_mean_db"), base[0].get("snr_capture_mean_db")
        if None not in pair:
            own["snr_over_single_pixel_db"] = pair[0] - pair[1]
