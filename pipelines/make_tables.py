"""Freeze the colorimetric tables that plenocli uses: `python
pipelines/make_tables.py [TABLES.npz]`.

The numbers come from colour-science, whose import takes two seconds; the small file written here is
read in a millisecond. Rerun after an upgrade of colour-science; a test compares file and library.
"""

import sys
import warnings
from pathlib import Path

import numpy as np

CHART = "ColorChecker N Ohta"
ILLUMINANTS = ("A", "D50", "D65", "E")
OBSERVER = "CIE 1931 2 Degree Standard Observer"
CAMERAS = ("Nikon 5100 (NPL)", "Sigma SDMerill (NPL)")


def _colour():
    """colour-science, imported without its remark about an absent matplotlib."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    return colour


def collect():
    """dict of arrays: wavelengths in nm (float64), tables as colour-science
    holds them (float64).
    """
    colour = _colour()
    from colour.quality.cfi2017 import load_TCS_CIE2017

    surfaces = load_TCS_CIE2017(colour.SpectralShape(380, 780, 5))
    chart = colour.SDS_COLOURCHECKERS[CHART]
    observer = colour.MSDS_CMFS[OBSERVER]
    tables = {
        "chart/names": np.array(list(chart)),
        "chart/wavelength_nm": next(iter(chart.values())).wavelengths,
        "chart/reflectance": np.array([spectrum.values for spectrum in chart.values()]),
        "surfaces/wavelength_nm": surfaces.wavelengths,
        "surfaces/reflectance": np.ascontiguousarray(surfaces.values.T),
        "observer/wavelength_nm": observer.wavelengths,
        "observer/xyz": observer.values.T,
    }
    for name in ILLUMINANTS:
        spectrum = colour.SDS_ILLUMINANTS[name]
        tables[f"illuminant/{name}/wavelength_nm"] = spectrum.wavelengths
        tables[f"illuminant/{name}/power"] = spectrum.values
    for name in CAMERAS:
        camera = colour.MSDS_CAMERA_SENSITIVITIES[name]
        tables[f"camera/{name}/wavelength_nm"] = camera.wavelengths
        tables[f"camera/{name}/letters"] = np.array([label[0].upper() for label in camera.labels])
        tables[f"camera/{name}/sensitivity"] = camera.values.T
    return tables


TABLES = Path(__file__).resolve().parents[1] / "plenocli" / "forward" / "scene" / "tables.npz"


def main(path=TABLES):
    np.savez_compressed(path, **collect())


if __name__ == "__main__":
    main(*sys.argv[1:])
