"""Which figures a score shows, and what they mean."""

from collections.abc import Iterable, Mapping
from types import ModuleType

from plenocli.base.errors import UsageError
from plenocli.evaluation import expected
from plenocli.evaluation.metrics import (
    classes,
    classify,
    coherence,
    depth,
    quality,
    response,
    snr,
    spectral,
    volume,
)
from plenocli.evaluation.metrics.figures import Figure
from plenocli.evaluation.scores import ResultScore

GROUPS: Mapping[str, tuple[str, ...]] = {
    "psnr": ("psnr_db", "psnr_inner_db", "psnr_clipped_db"),
    "ssim": ("ssim",),
    "block-mean": ("block_mean_psnr_db", "gain_over_block_mean_db"),
    "rmse": ("rmse", "rmse_per_band"),
    "intervals": ("interval_coverage",),
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
    "classes": (
        "classes_seen",
        "class_accuracy",
        "class_accuracy_low",
        "class_accuracy_high",
        "class_accuracy_predicted",
        "class_distance",
    ),
    "expected": (
        "rmse_expected",
        "rmse_expected_per_band",
        "noise_expected_per_band",
        "reference_snr_expected_db",
        "class_accuracy_expected",
        "class_accuracy_ideal",
        "class_distance_ideal",
        "detection_auc_expected",
    ),
    "detection": (
        "detection_auc",
        "detection_auc_low",
        "detection_auc_high",
        "detection_auc_predicted",
        "target_contrast",
    ),
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
        "depth_layer_errors",
        "depth_distance_m",
        "depth_distance_error_m",
        "depth_limit_m",
    ),
    "limits": (
        "noise_relative",
        "model_error_relative",
        "limited_by",
        "noise_raised",
        "detail_kept",
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
        "random_candes_romberg",
        "random_effective_mean",
        "dead_atoms",
        "invisible_atoms",
        "atoms",
        "points",
        "pixels",
    ),
}
"""What --metric may ask for, and the numbers that each brings."""


_NEEDED = {
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
    "classes": "give spectra and the spectra of --classes",
    "expected": "give a calibration of simulate-response and the spectra of --classes",
    "detection": "give --classes, and with --detect the one that is looked for",
    "single-pixel": "give spectra of demux --method single-pixel among the results",
}


def keep_chosen(figures: Mapping[str, Figure], groups: Iterable[str]) -> Mapping[str, Figure]:
    """Only the figures that are asked for.

    figures: by name.
    groups: names of GROUPS; all figures are kept without any.

    Raises UsageError where one of them brought none.
    """
    groups = tuple(groups)
    if not groups:
        return figures
    for group in groups:
        if not any(name in figures for name in GROUPS[group]):
            raise UsageError(
                f"--metric {group} does not apply to this result with what was given",
                fix=_NEEDED.get(group, "leave it out"),
            )
    wanted = {name for group in groups for name in GROUPS[group]}
    wanted |= {"snr_target"} if "snr" in groups else set()
    return {name: value for name, value in figures.items() if name in wanted}


_HOMES: Mapping[str, tuple[ModuleType, ...]] = {
    "dictionary": (coherence,),
    "image": (quality,),
    "spectra": (spectral,),
    "lightfield": (depth,),
    "calibration": (response,),
    "volume": (volume,),
}


def every_definition() -> dict[str, str]:
    """What each figure of pictures, spectra and planes means, by its name."""
    homes = (quality, spectral, snr, classify, classes, expected, depth, volume)
    return {name: text for home in homes for name, text in home.DEFINITIONS.items()}


def definitions_of(results: Iterable[ResultScore]) -> dict[str, str]:
    """What each figure of the results means, in the order in which they appear."""
    found = {}
    for result in results:
        home: tuple[ModuleType, ...] = _HOMES.get(result.kind, ())
        if result.wavelengths_nm and result.kind != "calibration":
            home = (spectral, quality)
        for name in result.figures:
            for module in (*home, snr, classify, classes, expected):
                if name in module.DEFINITIONS:
                    found[name] = module.DEFINITIONS[name]
                    break
    return found
