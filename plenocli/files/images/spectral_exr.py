"""Spectral pictures as EXR in the layout of Fichet, Pacanowski & Wilkie, "An OpenEXR Layout for
Spectral Images", Journal of Computer Graphics Techniques 10(3), 2021: one channel a band, named by
its wavelength with a decimal comma ("T.450,000000nm" reflectance, "S0.450,000000nm" radiance), and
R, G, B for viewers.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.errors import InputError
from plenocli.files.images.exr import channel_names, read_exr, write_exr

LIGHT = 299_792_458.0
_PREFIX = {"reflectance": "T", "radiance": "S0"}
_MULTIPLIER = {
    "": 1.0,
    "Y": 1e24,
    "Z": 1e21,
    "E": 1e18,
    "P": 1e15,
    "T": 1e12,
    "G": 1e9,
    "M": 1e6,
    "k": 1e3,
    "h": 1e2,
    "da": 1e1,
    "d": 1e-1,
    "c": 1e-2,
    "m": 1e-3,
    "u": 1e-6,
    "n": 1e-9,
    "p": 1e-12,
    "f": 1e-15,
    "a": 1e-18,
    "z": 1e-21,
    "y": 1e-24,
}
_CHANNEL = re.compile(
    r"(S[0-3]|T|sigma)\.(\d*,?\d*(?:[eE][-+]?\d+)?)(Y|Z|E|P|T|G|M|k|h|da|d|c|m|u|"
    r"n|p|f|a|z|y)?(m|Hz)"
)


@dataclass(frozen=True, kw_only=True)
class Spectral:
    """A spectral picture as its file holds it.

    wavelengths: (band,) m, ascending.
    values: (band, row, column) float32.
    quantity: "reflectance" or "radiance".
    sigma: like values, or None.
    attrs: text attributes by their names.
    """

    wavelengths: np.ndarray
    values: np.ndarray
    quantity: str
    sigma: np.ndarray | None = None
    attrs: dict[str, str] = field(default_factory=dict)


def write_spectral_exr(
    path: str | os.PathLike[str],
    wavelengths: ArrayLike,
    cube: ArrayLike,
    quantity: str = "reflectance",
    rgb: np.ndarray | None = None,
    sigma: np.ndarray | None = None,
    attrs: Mapping[str, str] | None = None,
    *,
    others: Mapping[str, np.ndarray] | None = None,
    overwrite: bool = False,
    compression: str = "zip",
) -> None:
    """Write a spectral picture.

    wavelengths: (band,) m, ascending.
    cube: (band, row, column).
    quantity: "reflectance" (channels T) or "radiance" (channels S0, unit W m^-2 sr^-1 in each band,
        or relative where attrs says so with "emissiveUnits").
    rgb: (3, row, column) linear preview; computed where None.
    sigma: like the cube, into channels "sigma.<wavelength>" that other readers skip.
    attrs: text by its names.
    others: further cubes, each in channels of its name that other readers skip likewise.

    Raises ValueError, UsageError, OutputError.
    """
    wavelengths, cube = (
        np.asarray(wavelengths, dtype=np.float64),
        np.asarray(cube, dtype=np.float32),
    )
    if cube.ndim != 3 or wavelengths.shape != cube.shape[:1] or (np.diff(wavelengths) <= 0).any():
        raise ValueError(
            f"{wavelengths.shape} wavelengths, which must ascend, do not fit a cube "
            f"of shape {cube.shape}"
        )
    labels = [f"{w * 1e9:.6f}nm".replace(".", ",") for w in wavelengths]
    if len(set(labels)) != len(labels):
        raise ValueError("wavelengths are closer than 1e-6 nm")
    channels = {
        f"{_PREFIX[quantity]}.{label}": plane for label, plane in zip(labels, cube, strict=True)
    }
    beside = dict(others or {}) | ({} if sigma is None else {"sigma": np.asarray(sigma)})
    for name, values in beside.items():
        channels |= {f"{name}.{label}": one for label, one in zip(labels, values, strict=True)}
    channels |= dict(zip("RGB", preview(wavelengths, cube) if rgb is None else rgb, strict=True))
    layout = {"spectralLayoutVersion": "1.0"}
    if quantity == "radiance":
        layout |= {"emissiveUnits": "W.m^-2.sr^-1", "polarisationHandedness": "right"}
    write_exr(
        path, channels, layout | dict(attrs or {}), overwrite=overwrite, compression=compression
    )


def is_spectral(path: str | os.PathLike[str]) -> bool:
    """Whether the EXR at `path` has spectral channels.

    Raises InputError.
    """
    return any(_band(name) for name in channel_names(path))


def read_spectral_exr(path: str | os.PathLike[str], quantity: str | None = None) -> Spectral:
    """Read a spectral picture. Polarised (S1 to S3) and bispectral channels are left out.

    quantity: which one, where a file holds both radiance and reflectance.

    Raises InputError.
    """
    channels, attrs = read_exr(path)
    bands: dict[str, dict[float, np.ndarray]] = {}
    for name in channels:
        found = _band(name)
        if found:
            prefix, wavelength = found
            if wavelength in bands.setdefault(prefix, {}):
                raise InputError(
                    f"holds two '{prefix}' channels of {wavelength * 1e9:g} nm",
                    path,
                    "make it again",
                )
            bands[prefix][wavelength] = channels[name]
    there = [name for name, prefix in _PREFIX.items() if prefix in bands]
    if not there:
        raise InputError(
            "holds no spectral channels such as T.450,000000nm or S0.450,000000nm",
            path,
            "give a spectral EXR",
        )
    if quantity is None and len(there) > 1:
        raise InputError(
            "holds both radiance and reflectance", path, "keep the channels of one of them"
        )
    quantity = quantity or there[0]
    if quantity not in there:
        raise InputError(f"holds {there[0]}, not {quantity}", path, "give another file")
    planes = bands[_PREFIX[quantity]]
    wavelengths = np.array(sorted(planes))
    sigma = bands.get("sigma", {})
    complete = set(sigma) == set(planes)
    if any((plane < 0).any() for plane in sigma.values()):
        raise InputError("holds standard deviations below 0", path, "make it again")
    return Spectral(
        wavelengths=wavelengths,
        values=np.stack([planes[w] for w in wavelengths]),
        quantity=quantity,
        sigma=np.stack([sigma[w] for w in wavelengths]) if complete else None,
        attrs=attrs,
    )


def _band(name: str) -> tuple[str, float] | None:
    """("T", "S0".. or "sigma", wavelength in m) of a channel name, or None; frequencies are
    turned into wavelengths.
    """
    match = _CHANNEL.fullmatch(name)
    if match is None:
        return None
    try:
        number = float(match[2].replace(",", "."))
    except ValueError:
        return None
    value = number * _MULTIPLIER[match[3] or ""]
    if not 0 < value < np.inf:
        return None
    # to a femtometre: two spellings of one wavelength must meet
    return match[1], round(value if match[4] == "m" else LIGHT / value, 15)


def preview(wavelengths: np.ndarray, cube: np.ndarray) -> np.ndarray:
    """Linear sRGB (3, row, column) of a spectral picture (band, row, column) under equal energy,
    for looking at only; a flat unit spectrum gives white.
    """
    from plenocli.forward.scene.colour import preview_rgb

    return np.maximum(preview_rgb(wavelengths, cube, "E"), 0.0)
