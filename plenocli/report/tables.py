"""Numbers of a score document as rows of text, for the terminal and the page alike."""

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
    "noise_relative": ("noise of the capture, relative", ""),
    "model_error_relative": ("error of the model, relative", ""),
    "limited_by": ("limited by", ""),
    "loss_at_most_db": ("error over what LMMSE expects of a faultless model, at most", "dB"),
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
    "dead_atoms": ("dead atoms", ""),
    "invisible_atoms": ("invisible atoms", ""),
}
"""Metric -> (what people read, unit); the order is that of the table."""


def metric_rows(document):
    """(header, rows) of text for a score document: metric names first, then one column a result.

    Metrics with one value a band take one row a band, named by its wavelength where all results
    share their bands.
    """
    results = document["results"]
    header = ["", *(entry.get("label", entry["name"]) for entry in results)]
    found = {name for entry in results for name in entry["metrics"]}
    names = [name for name in LABELS if name in found] + sorted(found - set(LABELS))
    rows = []
    for name in names:
        values = [entry["metrics"].get(name) for entry in results]
        label, unit = LABELS.get(name, (name.replace("_", " "), ""))
        unit = f" [{unit}]" if unit else ""
        bands = max((len(v) for v in values if isinstance(v, list)), default=0)
        if not bands:
            rows.append(
                [
                    label + unit,
                    *(
                        _cell(name, name in e["metrics"], v)
                        for e, v in zip(results, values, strict=True)
                    ),
                ]
            )
        for band in range(bands):
            of_band = [v[band] if isinstance(v, list) and band < len(v) else None for v in values]
            given = [isinstance(v, list) and band < len(v) for v in values]
            rows.append(
                [
                    f"{label}, {_band_name(results, band)}{unit}",
                    *(_cell(name, g, v) for g, v in zip(given, of_band, strict=True)),
                ]
            )
    return header, rows


def _band_name(results, band):
    names = {
        f"{entry['wavelengths_nm'][band]:g} nm"
        for entry in results
        if band < len(entry.get("wavelengths_nm", ()))
    }
    return names.pop() if len(names) == 1 else f"band {band + 1}"


def _cell(name, given, value):
    if not given:
        return ""
    if value is None:
        return "none"
    if isinstance(value, (int, str)):
        return str(value)
    if name.endswith("_db"):
        return f"{value:.2f}"
    if name in ("ssim",) or name.startswith("coherence_effective"):
        return f"{value:.4f}"
    return f"{value:.4g}"
