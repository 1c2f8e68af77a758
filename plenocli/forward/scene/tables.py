"""Frozen spectral tables: ColorChecker, illuminants, standard observer, camera sensitivities.

Wavelengths are in metres, ascending. Every table is read between its samples by linear
interpolation; what holds outside its range is said at each function. Source of the numbers:
colour-science (see make_tables.py).
"""

import re
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.errors import ConfigError

#: The patches over which the spectral experiment averages its error (Berkner et al. 2013,
#: spectral prototype).
SIX_PATCHES = ("white 9.5 (.05 D)", "black 2 (1.5 D)", "red", "orange", "green", "blue")

_SECOND_RADIATION_CONSTANT = 1.438776877e-2  # m K, CODATA 2018
_NORMAL = 560e-9  # m: relative spectral powers are 1 here, the CIE's choice


@cache
def _tables() -> dict[str, np.ndarray]:
    with np.load(Path(__file__).with_name("tables.npz"), allow_pickle=False) as file:
        tables = {key: file[key] for key in file.files}
    for table in tables.values():
        table.flags.writeable = False
    return tables


def _names(kind: str) -> tuple[str, ...]:
    return tuple(
        dict.fromkeys(key.split("/")[1] for key in _tables() if key.startswith(kind + "/"))
    )


def illuminant_names() -> tuple[str, ...]:
    """Names of the tabulated illuminants; a blackbody is asked for by its
    temperature, as in "3200 K".
    """
    return _names("illuminant")


def camera_names() -> tuple[str, ...]:
    """Names of the cameras whose spectral sensitivity is tabulated."""
    return _names("camera")


def colorchecker(
    wavelengths: ArrayLike | None = None,
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """The 24 patches of the ColorChecker (spectra of N. Ohta, 1997).

    wavelengths: (n,) m; None for the table's own, 380 to 780 nm by 5 nm.

    Returns (names row by row from "dark skin" to "black 2 (1.5 D)", wavelengths (n,) m, reflectance
    (24, n) float64 in 0..1); a fresh array, outside the table the end values hold.
    Raises ValueError for wavelengths that are not in metres.
    """
    tables = _tables()
    own, reflectance = tables["chart/wavelength_nm"] * 1e-9, tables["chart/reflectance"]
    names = tuple(str(name) for name in tables["chart/names"])
    if wavelengths is None:
        return names, own, reflectance.copy()
    wavelengths = _checked(wavelengths)
    return names, wavelengths, np.array([np.interp(wavelengths, own, row) for row in reflectance])


def surfaces(wavelengths: ArrayLike) -> np.ndarray:
    """Reflectances of natural and man-made surfaces: nature, skin, textiles, paints, plastics,
    prints.

    wavelengths: (n,) m; the table covers 380 to 780 nm by 5 nm, end values beyond.

    Returns (99, n).
    Raises ValueError for wavelengths that are not in metres.
    The colour evaluation samples of CIE 224:2017, selected evenly from 105 000 measured spectra.
    """
    own, rows = _tables()["surfaces/wavelength_nm"] * 1e-9, _tables()["surfaces/reflectance"]
    wavelengths = _checked(wavelengths)
    return np.array([np.interp(wavelengths, own, row) for row in rows])


def patch_index(name: str) -> int:
    """Which patch of the ColorChecker is meant.

    name: of the patch, or the first word of it ("white", "black").

    Returns 0..23.
    Raises ConfigError where no patch is called so.
    """
    names = colorchecker()[0]
    if name in names:
        return names.index(name)
    short = [i for i, full in enumerate(names) if full.split()[0] == name and full[-1] == ")"]
    if len(short) == 1:
        return short[0]
    raise ConfigError(
        f"no ColorChecker patch is called {name!r}", fix=f"use one of: {', '.join(names)}"
    )


def illuminant(name: str, wavelengths: ArrayLike) -> np.ndarray:
    """Relative spectral power of a light, per unit wavelength, 1 at 560 nm.

    name: "A", "D50", "D65", "E", or a temperature such as "3200 K" for Planck's blackbody.
    wavelengths: (n,) m. Tables are 5 nm apart over 300 to 780 nm (E: 360 to 830); beyond them the
        end values hold.

    Returns (n,).
    Raises ConfigError for an unknown light, ValueError for wavelengths that are not in metres.
    """
    wavelengths = _checked(wavelengths)
    if match := re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*K\s*", str(name)):
        return blackbody(float(match[1]), wavelengths)
    if name not in illuminant_names():
        raise ConfigError(
            f"no illuminant is called {name!r}",
            fix=f'use one of: {", ".join(illuminant_names())}, or a temperature such as "3200 K"',
        )
    own, power = (_tables()[f"illuminant/{name}/{part}"] for part in ("wavelength_nm", "power"))
    return np.interp(wavelengths, own * 1e-9, power) / np.interp(_NORMAL, own * 1e-9, power)


def blackbody(temperature: float, wavelengths: ArrayLike) -> np.ndarray:
    """Planck's spectral radiance relative to that at 560 nm.

    temperature: 500 to 1e6 K.
    wavelengths: (n,) m.

    Returns (n,).
    Raises ConfigError for other temperatures.
    """
    if not 500 <= temperature <= 1e6:
        raise ConfigError(
            f"a blackbody of {temperature:g} K is no light source for a camera",
            fix="use 500 K to 1000000 K, as in 3200 K",
        )

    def planck(wavelength):
        return wavelength**-5.0 / np.expm1(_SECOND_RADIATION_CONSTANT / (wavelength * temperature))

    return planck(_checked(wavelengths)) / planck(_NORMAL)


def camera_sensitivity(name: str, wavelengths: ArrayLike) -> dict[str, np.ndarray]:
    """Relative spectral sensitivity of a camera.

    Each channel's table has its peak at 1, as published by NPL (the ratio between channels is not
    known from it); zero outside the table (380 to 780 nm for the Nikon, 400 to 680 nm for the
    Sigma).

    name: one of camera_names().
    wavelengths: (n,) m.

    Returns letter ("R", "G", "B") -> (n,).
    Raises ConfigError for an unknown camera.
    """
    if name not in camera_names():
        raise ConfigError(
            f"no sensitivity is known of a camera called {name!r}",
            "sensor.camera",
            f"use one of: {', '.join(camera_names())}",
        )
    wavelengths = _checked(wavelengths)
    own, letters, rows = (
        _tables()[f"camera/{name}/{part}"] for part in ("wavelength_nm", "letters", "sensitivity")
    )
    return {
        str(letter): np.interp(wavelengths, own * 1e-9, row, left=0.0, right=0.0)
        for letter, row in zip(letters, rows, strict=True)
    }


def observer(wavelengths: ArrayLike | None = None) -> tuple[np.ndarray, np.ndarray]:
    """CIE 1931 2-degree colour matching functions; zero outside 360 to 830 nm.

    wavelengths: (n,) m; None for the table itself, every nanometre.

    Returns (wavelengths (n,) m, xyz (3, n)).
    """
    own, xyz = _tables()["observer/wavelength_nm"] * 1e-9, _tables()["observer/xyz"]
    if wavelengths is None:
        return own, xyz.copy()
    wavelengths = _checked(wavelengths)
    return wavelengths, np.array(
        [np.interp(wavelengths, own, row, left=0.0, right=0.0) for row in xyz]
    )


def _checked(wavelengths: ArrayLike) -> np.ndarray:
    wavelengths = np.asarray(wavelengths, dtype=np.float64)
    if wavelengths.size and not (1e-8 < wavelengths.min() and wavelengths.max() < 1e-3):
        raise ValueError("wavelengths are in metres: 550 nm is 550e-9")
    return wavelengths
