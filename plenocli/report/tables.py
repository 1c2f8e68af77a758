"""Numbers of a score document as rows of text, for the terminal and the page alike."""

from collections.abc import Sequence

import numpy as np

from plenocli.evaluation.chart_score import ChartDocument
from plenocli.evaluation.metrics.figures import Figure
from plenocli.evaluation.scores import ResultScore, ScoreDocument

LABELS = {
    "psnr_db": ("PSNR", "dB"),
    "psnr_inner_db": ("PSNR without border lenslets", "dB"),
    "psnr_clipped_db": ("PSNR after clipping to 0..1", "dB"),
    "ssim": ("SSIM", ""),
    "block_mean_psnr_db": ("PSNR of the block mean", "dB"),
    "gain_over_block_mean_db": ("gain over the block mean", "dB"),
    "six_patch_rmse": ("RMSE over the six patches", ""),
    "six_patch_rmse_per_band": ("RMSE over the six patches", ""),
    "patch_rmse_per_band": ("RMSE of patch means", ""),
    "rmse": ("RMSE over everything", ""),
    "rmse_per_band": ("RMSE over everything", ""),
    "lenslets": ("lenslets compared", ""),
    "patches": ("patches seen", ""),
    "six_patches_seen": ("of the six patches seen", ""),
    "spectral_angle_deg": ("spectral angle", "deg"),
    "delta_e_2000": ("colour difference CIEDE2000", ""),
    "snr_target": ("SNR measured on", ""),
    "snr_capture_db": ("capture SNR", "dB"),
    "snr_capture_mean_db": ("capture SNR, mean of bands", "dB"),
    "snr_predicted_db": ("predicted SNR", "dB"),
    "snr_predicted_mean_db": ("predicted SNR, mean of bands", "dB"),
    "snr_sensor_db": ("sensor-model SNR", "dB"),
    "classification_accuracy": ("patches told by a trained classifier", "share"),
    "nearest_patch_accuracy": ("patches told by the nearest known spectrum", "share"),
    "rmse_over_single_pixel": ("RMSE over that of single pixel", ""),
    "six_patch_rmse_over_single_pixel": ("RMSE over the six patches over that of single pixel", ""),
    "delta_e_over_single_pixel": ("colour difference over that of single pixel", ""),
    "snr_over_single_pixel_db": ("capture SNR above single pixel's", "dB"),
    "response_error_per_band": ("error of the response", ""),
    "response_error_lenslet_per_band": ("error of the response of a single lenslet", ""),
    "response_pixel_per_band": ("largest error of a pixel over the brightest", ""),
    "response_gain_per_band": ("gain that was fitted", ""),
    "response_leak": ("leak between bands", ""),
    "classes_seen": ("classes seen", ""),
    "class_accuracy": ("lenslets told their class", "share"),
    "class_accuracy_low": ("the same, lower end of 95 %", "share"),
    "class_accuracy_high": ("the same, upper end of 95 %", "share"),
    "class_accuracy_predicted": ("the same, predicted at least", "share"),
    "class_distance": ("classes hardest to tell are apart", "sd"),
    "interval_coverage": ("points within their 95 % interval", "share"),
    "noise_relative": ("noise of the capture, relative", ""),
    "model_error_relative": ("error of the model, relative", ""),
    "limited_by": ("limited by", ""),
    "noise_raised": ("noise reckoned with, over the capture's own", ""),
    "detail_kept": ("share of the detail kept", ""),
    "seen_share": ("share of the object seen", ""),
    "depth_slope": ("slope of the plane", ""),
    "depth_slope_found": ("slope found, median", ""),
    "depth_slope_error": ("error of the slope over the geometric limit, median", ""),
    "depth_slope_worst": ("error of the slope over the geometric limit, 95 %", ""),
    "depth_sure_share": ("share of lenslets that are sure", ""),
    "sharpest_slope_error": ("error of the sharpest plane's slope", ""),
    "depth_distance_m": ("distance of the plane", "m"),
    "depth_distance_error_m": ("error of the distance, median", "m"),
    "depth_limit_m": ("geometric limit at this distance", "m"),
    "coherence_raw": ("coherence, raw", ""),
    "coherence_candes_romberg": ("coherence, Candes-Romberg", ""),
    "coherence_effective": ("coherence of A Phi, largest", ""),
    "coherence_effective_mean": ("coherence of A Phi, mean", ""),
    "welch_bound": ("Welch bound", ""),
    "exact_recovery_sparsity": ("exact recovery up to sparsity", ""),
    "random_candes_romberg": ("coherence of random atoms, Candes-Romberg", ""),
    "random_effective_mean": ("coherence of A and random atoms, mean", ""),
    "dead_atoms": ("dead atoms", ""),
    "invisible_atoms": ("invisible atoms", ""),
}
"""Metric -> (what people read, unit); the order is that of the table."""


def label_of(name: str) -> str:
    """What people read for a metric."""
    return LABELS.get(name, (name,))[0]


def label_and_unit(name: str) -> tuple[str, str]:
    """What people read for a metric, and its unit, which unlisted names end with."""
    words, _, last = name.replace("_", " ").rpartition(" ")
    units = {"db": "dB", "m": "m", "s": "s"}
    return LABELS.get(name) or (
        (words, units[last]) if last in units else (name.replace("_", " "), "")
    )


def metric_rows(document: ScoreDocument) -> tuple[list[str], list[list[str]]]:
    """The figures of a score document as text.

    Metrics with one value a band take one row a band, named by its wavelength where all results
    share their bands.

    Returns (header, rows): metric names first, then one column a result.
    """
    results = document.results
    header = ["", *(one.label or one.name for one in results)]
    found = {name for one in results for name in one.figures}
    names = [name for name in LABELS if name in found] + sorted(found - set(LABELS))
    rows = []
    for name in names:
        values = [one.figures.get(name) for one in results]
        label, unit = label_and_unit(name)
        unit = f" [{unit}]" if unit else ""
        bands = max((len(v) for v in values if isinstance(v, list)), default=0)
        if not bands:
            cells = [
                _cell(name, name in one.figures, value)
                for one, value in zip(results, values, strict=True)
            ]
            rows.append([label + unit, *cells])
        for band in range(bands):
            cells = [
                _cell(name, True, value[band])
                if isinstance(value, list) and band < len(value)
                else ""
                for value in values
            ]
            rows.append([f"{label}, {_band_name(results, band)}{unit}", *cells])
    return header, rows


def _band_name(results: Sequence[ResultScore], band: int) -> str:
    names = {
        f"{one.wavelengths_nm[band]:g} nm" for one in results if band < len(one.wavelengths_nm)
    }
    return names.pop() if len(names) == 1 else f"band {band + 1}"


def _cell(name: str, given: bool, value: Figure) -> str:
    if not given:
        return ""
    if value is None or value == []:
        return "none"
    if isinstance(value, list):  # where another result has one number
        return ", ".join(_cell(name, True, one) for one in value[:9])
    if isinstance(value, (int, str)):
        return str(value)
    if name.endswith("_db"):
        return f"{value:.2f}"
    if name in ("ssim",) or name.startswith("coherence_effective"):
        return f"{value:.4f}"
    return f"{value:.4g}"


def text_table(document: ScoreDocument) -> str:
    """The results side by side for a terminal: one row a metric, one column a result."""
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


def cell_text(value: object) -> str:
    """A value as a cell of a table: four digits, and the range of several."""
    if isinstance(value, (list, tuple, np.ndarray)):
        values = np.ravel(value)
        return (
            cell_text(values[0])
            if values.size == 1
            else f"{cell_text(values.min())} to {cell_text(values.max())}"
        )
    return f"{value:.4g}" if isinstance(value, (float, np.floating)) else str(value)


def chart_table(document: ChartDocument) -> str:
    """The measures of a chart for a terminal: errors by band and method, linearity, then every
    patch by band.
    """
    measures = document.measures
    bands = [f"{band:.0f}" for band in measures.bands_nm]
    row = "{:<42}" + "{:>8}" * (len(bands) + 1)
    lines = [row.format("RMSE of reflectance, nm", *bands, "mean")]
    for method in measures.methods:
        score = method.score
        for what, by_band, mean in (
            ("24 patches", score.rmse_24_per_band, score.rmse_24),
            ("six patches", score.rmse_six_per_band, score.rmse_six),
        ):
            cells = (f"{v:.4f}" for v in by_band)
            lines.append(row.format(f"{method.name}: {what}", *cells, f"{mean:.4f}"))
    linear = (document.linearity.get(band) for band in bands)
    cells = ("-" if one is None else f"{one.median:.4f}" for one in linear)
    lines.append(row.format("linearity: median of rate ratios", *cells, ""))
    for method in measures.methods:
        score, nominal = method.score, method.nominal
        lines.append(
            f"{method.name}: spectral angle {score.spectral_angle_deg:.2f} deg, worst "
            f"{score.spectral_angle_worst_deg:.2f}; largest error {score.worst_error:.3f}"
            + (
                ""
                if nominal is None
                else f"; 10 nm bands at the labels: 24 patches {nominal.rmse_24:.4f}, six "
                f"{nominal.rmse_six:.4f}"
            )
        )
    last = measures.methods[-1]
    lines += ["", row.format(f"{last.name}, less spectrometer", *bands, "rms")]
    for patch, found, true in zip(measures.patch_names, last.reflectance, measures.truth):
        error = found - true
        cells = (f"{v:+.3f}" for v in error)
        lines.append(row.format(patch, *cells, f"{np.sqrt(np.mean(np.square(error))):.3f}"))
    return "\n".join(line.rstrip() for line in lines)
