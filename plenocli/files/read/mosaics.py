"""Mosaics from files as calibrate and demux use them: values with levels, exposure and noise,
checked against each other.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.text import by


@dataclass(frozen=True)
class Exposure:
    """One capture.

    values (rows, columns) as stored;
    black (2, 2) and white in `units`;
    gain in units per electron or None;
    seconds or None;
    band: centre wavelength, m, or None;
    sigma: known white noise, or None.
    """

    path: Path
    values: np.ndarray
    cfa: str
    black: np.ndarray
    white: float
    gain: float | None
    seconds: float | None
    units: str
    band: float | None
    sigma: float | None


def read_exposure(path, like=None, cfa=None):
    """Read a capture (.h5, .exr, RAW, DNG, PNG, TIFF).

    `like`: an Exposure whose size, CFA and units it must share.

    cfa: what a PNG or TIFF cannot say; other files must agree with it (None: they say
        it, images are mono).
    """
    from plenocli.files.images.mosaic import read_mosaic

    m = read_mosaic(path, cfa=cfa)
    meta = getattr(m, "meta", None) or {}
    sigma = meta.get("noise_sigma")
    white = np.inf if m.white is None or not np.isfinite(m.white) else float(m.white)
    black = np.broadcast_to(np.asarray(0.0 if m.black is None else m.black, float), (2, 2))
    exposure = Exposure(
        Path(path),
        np.asarray(m.values),
        m.cfa,
        black,
        white,
        m.gain,
        m.exposure_s,
        m.units,
        m.band_m,
        float(sigma) if sigma else None,
    )
    if like is not None:
        for what, ours, theirs in (
            ("size", by(exposure.values.shape), by(like.values.shape)),
            ("colour filter array", exposure.cfa, like.cfa),
            ("unit", exposure.units, like.units),
        ):
            if ours != theirs:
                raise InputError(
                    f"has another {what} ({ours}) than {like.path.name} ({theirs})",
                    path,
                    "use captures of one camera at one setting",
                )
    return exposure


def read_exposures(paths, like=None, cfa=None):
    """Several captures of one kind; the first (or `like`) sets size and CFA."""
    out = []
    for path in paths:
        out.append(read_exposure(path, like or (out[0] if out else None), cfa))
    return out


def check_exposure_times(exposures):
    """Either all or none of the captures know their exposure time; else their scales
    cannot be compared.
    """
    known = [e for e in exposures if e.seconds is not None]
    if known and len(known) != len(exposures):
        lost = next(e for e in exposures if e.seconds is None)
        raise InputError(
            f"does not say its exposure time, while {known[0].path.name} does",
            lost.path,
            "use files of one kind for all captures",
        )


def true_centres(path):
    """Superpixel centres (R, C, 2) px that a simulated capture knows of itself, or None."""
    if Path(path).suffix != ".h5":
        return None
    from plenocli.files.artefacts.container import read_artefact

    return read_artefact(path, "capture").data.get("capture/lenslet_centre")
