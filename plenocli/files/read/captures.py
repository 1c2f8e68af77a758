"""Captures as superpixels in the units of the system matrix: y = A x + noise with x the radiance
relative to white.
"""

from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.progress import note
from plenocli.base.tiling import to_blocks
from plenocli.forward.sensor.frames import tiled
from plenocli.inverse.picture.lenslet_model import Superpixels


def read_superpixels(path, system, calibration=None):
    """Superpixels of a capture: tiled as its file says, or cut out along the lenslet grid of a
    calibration artefact.

    system: LensletMatrix.
    InputError where sizes disagree or the sensor is saturated beyond use.
    """
    from plenocli.files.images.mosaic import read_mosaic

    mosaic = read_mosaic(path)
    if mosaic.cfa != "mono":
        raise InputError(
            f"has the colour filter array {mosaic.cfa}; the system matrix knows none",
            path,
            "use --calibration with --method block-mean, or demux",
        )
    if calibration is not None:
        signal, white = calibrated(path, mosaic, calibration)
        if signal.shape[2] != system.own.shape[0]:
            raise InputError(
                (
                    f"holds windows of {signal.shape[2]} pixels, the system matrix "
                    f"{system.own.shape[0]}"
                ),
                calibration,
                "simulate-pif with pixels_per_lenslet as measured",
            )
        lit = np.all(np.isfinite(signal), axis=2)
        scale = system.own.sum() / np.where(lit, white.sum(axis=2), np.inf)
        return Superpixels(
            y=np.where(lit[:, :, None], signal, 0) * scale[:, :, None], sigma=None, scene=None
        )
    light = mosaic.meta.get("illuminant")
    if system.illuminant and light and light != system.illuminant:
        note(
            f"{Path(path).name} was lit by {light}, the system matrix has its bands for "
            f"{system.illuminant}: colours will be off"
        )
    shape = tuple(int(n) for n in mosaic.meta.get("superpixel_shape", system.pixel_shape))
    if shape != system.pixel_shape:
        raise InputError(
            (
                f"has superpixels of {shape[0]} x {shape[1]} pixels, the system matrix "
                f"{system.pixel_shape[0]} x {system.pixel_shape[1]}"
            ),
            path,
            "use the pif of this camera",
        )
    rows, columns = mosaic.values.shape
    if rows % shape[0] or columns % shape[1]:
        raise InputError(
            (
                f"has {rows} x {columns} pixels, no whole number of superpixels of "
                f"{shape[0]} x {shape[1]}"
            ),
            path,
            "give --calibration to find the lenslets",
        )
    signal = mosaic.values - tiled(mosaic.black, (rows, columns), float)
    unit = _unit(path, mosaic)
    over = float(np.mean(mosaic.values >= mosaic.white)) if np.isfinite(mosaic.white) else 0.0
    if over > 0:
        note(
            f"{Path(path).name}: {over:.2%} of the pixels are saturated; the "
            "picture is too dark there"
        )
    sigma = mosaic.meta.get("noise_sigma")
    return Superpixels(
        y=to_blocks(signal, shape) / unit,
        sigma=None if sigma is None else float(sigma) / unit,
        scene=mosaic.meta.get("target"),
        accuracy=mosaic.meta.get("accuracy"),
        matrix=mosaic.meta.get("inputs", {}).get("pif", {}).get("sha256"),
    )


def calibrated(path, mosaic, calibration):
    """(signal, white): a capture's and the white reference's windows (lenslet_row, lenslet_column,
    pixel), dark subtracted.

    NaN where a superpixel is not wholly on the sensor. InputError where the two sensors differ.
    """
    from plenocli.files.artefacts.container import read_artefact
    from plenocli.forward.sensor.superpixel import extract

    found = read_artefact(calibration, "calibration")
    data = found.data
    for name in ("response/origin", "response/window", "response/white", "dark/mean"):
        if name not in data:
            raise InputError(f"lacks {name}", calibration, "run calibrate again")
    if np.ndim(data["dark/mean"]) == 2 and data["dark/mean"].shape != mosaic.values.shape:
        raise InputError(
            (
                f"is {mosaic.values.shape[0]} x {mosaic.values.shape[1]} px, the calibration "
                f"{data['dark/mean'].shape[0]} x {data['dark/mean'].shape[1]}"
            ),
            path,
            "use captures of the calibrated camera",
        )
    reference = found.attrs.get("response", {}).get("exposure_s") or found.attrs.get(
        "white", {}
    ).get("exposure")
    scale = reference / mosaic.exposure_s if reference and mosaic.exposure_s else 1.0
    signal = extract(
        (mosaic.values - data["dark/mean"]) * scale,
        data["response/origin"],
        tuple(int(n) for n in data["response/window"]),
    )
    valid = data["grid/valid"].astype(bool)
    signal[~valid] = np.nan
    white = np.broadcast_to(data["response/white"], signal.shape)
    return signal, white


def _unit(path, mosaic):
    """What one unit of A x is in the units of the mosaic."""
    if mosaic.units == "relative":
        return 1.0
    electrons = mosaic.meta.get("electrons_per_unit") or mosaic.meta.get("notes", {}).get(
        "electrons_per_unit"
    )
    if not electrons:
        raise InputError(
            "does not say how many electrons white gives, so that the picture would have no scale",
            path,
            "give --calibration with a white reference",
        )
    return float(electrons) * ((mosaic.gain or 1.0) if mosaic.units == "DN" else 1.0)
