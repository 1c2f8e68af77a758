"""Accuracy of spectra against their truth: error per band, spectral angle, colour difference.

Spectra are (..., band); cubes are (band, row, column); labels (row, column) are 0 for "nothing" and
1.. for patches. See docs/model.md, "Measures".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from plenocli.forward.scene import colour

DEFINITIONS = {
    "rmse_per_band": "square root of the mean squared error over all valid lenslets, band by band",
    "rmse": "mean of rmse_per_band over the bands",
    "patch_rmse_per_band": (
        "for each band the root mean square over the patches of (mean over a "
        "patch's lenslets - truth)"
    ),
    "six_patch_rmse_per_band": (
        "for each band the mean over the patches white, black, red, orange, green and blue of the "
        "RMSE over a patch's lenslets (Berkner et al. 2013)"
    ),
    "six_patch_rmse": "mean of six_patch_rmse_per_band over the bands",
    "s1_rmse": (
        "root mean square error over lenslets and bands of the Stokes parameter s1, the light "
        "polarised along 0 degrees less that along 90, in units of reflectance"
    ),
    "spectral_angle_deg": (
        "mean angle between spectrum and truth as vectors, degrees; blind to brightness"
    ),
    "rmse_over_single_pixel": "rmse divided by that of the result of single pixel extraction",
    "six_patch_rmse_over_single_pixel": (
        "six_patch_rmse divided by that of the result of single pixel extraction"
    ),
    "delta_e_over_single_pixel": (
        "delta_e_2000 divided by that of the result of single pixel extraction"
    ),
    "delta_e_2000": (
        "mean CIEDE2000 colour difference under the light named, spectra taken as piecewise "
        "linear between bands"
    ),
}


@dataclass(frozen=True)
class PatchStatistics:
    """What one patch shows: mean and standard deviation (band,) over its lenslets, and their
    number.
    """

    mean: np.ndarray
    std: np.ndarray
    count: int


@dataclass(frozen=True, kw_only=True)
class CubeScore:
    """Measures over all lenslets; the list by band. See DEFINITIONS."""

    lenslets: int
    rmse: float
    rmse_per_band: list[float]
    spectral_angle_deg: float
    delta_e_2000: float


@dataclass(frozen=True)
class SixPatchScore:
    """Errors over those of the paper's six patches that are seen; see DEFINITIONS."""

    six_patch_rmse_per_band: list[float]
    six_patch_rmse: float


@dataclass(frozen=True)
class PatchesScore:
    """Errors over the patches of a label map; None where no patch is seen. See DEFINITIONS."""

    patches: int
    patch_rmse_per_band: list[float] | None
    six_patches_seen: int
    six: SixPatchScore | None


@dataclass(frozen=True)
class PolarisationScore:
    """Error of what is polarised of the light; see DEFINITIONS."""

    s1_rmse: float


def score_polarisation(s1: np.ndarray, truth: np.ndarray) -> PolarisationScore | None:
    """The score of s1 (band, row, column) against the true one where it can be told, or None."""
    known = np.isfinite(s1)
    if not known.any():
        return None
    return PolarisationScore(float(np.sqrt(np.mean((s1 - truth)[known] ** 2))))


def rmse_per_band(estimate: ArrayLike, truth: ArrayLike) -> np.ndarray:
    """Root mean squared error by band, (band,), over all leading axes of spectra (..., band)."""
    difference = np.asarray(estimate, dtype=np.float64) - np.asarray(truth, dtype=np.float64)
    return np.sqrt(np.mean(difference**2, axis=tuple(range(difference.ndim - 1))))


def spectral_angle(first: ArrayLike, second: ArrayLike) -> np.ndarray:
    """Angle between spectra.

    first, second: (..., band).

    Returns (...) radians; pi/2 between a zero spectrum and any other, 0 between two. Computed as
    2 atan2(|u - v|, |u + v|) of the unit vectors (Kahan), accurate for small angles too.
    """
    first, second = (np.asarray(v, dtype=np.float64) for v in (first, second))
    norms = [np.linalg.norm(v, axis=-1, keepdims=True) for v in (first, second)]
    u, v = (
        vector / np.where(norm > 0, norm, 1)
        for vector, norm in zip((first, second), norms, strict=True)
    )
    angle = 2 * np.arctan2(np.linalg.norm(u - v, axis=-1), np.linalg.norm(u + v, axis=-1))
    zero = [norm[..., 0] == 0 for norm in norms]
    return np.where(zero[0] & zero[1], 0.0, np.where(zero[0] | zero[1], np.pi / 2, angle))


def colour_difference(
    wavelengths: np.ndarray, estimate: np.ndarray, truth: np.ndarray, light: str = "D65"
) -> np.ndarray:
    """CIEDE2000 between reflectances.

    wavelengths: (band,) m.
    estimate, truth: (..., band).
    light: name of the illuminant.

    Returns (...).
    """
    white = colour.white_point(light)
    return colour.delta_e_2000(
        *(colour.lab(colour.xyz(wavelengths, v, light), white) for v in (estimate, truth))
    )


def patch_statistics(cube: np.ndarray, labels: np.ndarray) -> dict[int, PatchStatistics]:
    """What each patch shows, by label.

    cube: (band, row, column); lenslets with NaN are left out.
    labels: (row, column), 0 for nothing.

    Returns label -> PatchStatistics: sample standard deviation, 0 where there is one lenslet.
    """
    found = {}
    for label in np.unique(labels[labels > 0]):
        spectra = np.asarray(cube, dtype=np.float64)[:, labels == label]
        spectra = spectra[:, np.isfinite(spectra).all(axis=0)]
        if count := spectra.shape[1]:
            std = spectra.std(axis=1, ddof=1) if count > 1 else np.zeros(len(spectra))
            found[int(label)] = PatchStatistics(spectra.mean(axis=1), std, count)
    return found


def score_cube(
    estimate: np.ndarray, truth: np.ndarray, wavelengths: np.ndarray, light: str = "D65"
) -> CubeScore | None:
    """Measures over all lenslets of a reflectance cube.

    estimate, truth: (band, row, column); lenslets with NaN in either are left out.
    wavelengths: (band,) m.
    light: name of the illuminant for colour differences.

    Returns None where no lenslet has values in all bands.
    """
    pair = [
        np.moveaxis(np.asarray(v, dtype=np.float64), 0, -1).reshape(-1, len(wavelengths))
        for v in (estimate, truth)
    ]
    valid = np.isfinite(pair[0]).all(1) & np.isfinite(pair[1]).all(1)
    if not valid.any():
        return None
    estimate, truth = (v[valid] for v in pair)
    bands = rmse_per_band(estimate, truth)
    return CubeScore(
        lenslets=int(valid.sum()),
        rmse=float(bands.mean()),
        rmse_per_band=bands.tolist(),
        spectral_angle_deg=float(np.degrees(spectral_angle(estimate, truth)).mean()),
        delta_e_2000=float(colour_difference(wavelengths, estimate, truth, light).mean()),
    )


def score_patches(
    estimate: np.ndarray, truth: np.ndarray, labels: np.ndarray, six: Sequence[int]
) -> PatchesScore:
    """Errors over the patches of a label map; patches without a valid lenslet are left out.

    estimate, truth: (band, row, column); the truth may differ from lenslet to lenslet.
    labels: (row, column), 0 for nothing.
    six: labels of the paper's six patches.
    """
    estimate, truth = (np.asarray(v, dtype=np.float64) for v in (estimate, truth))
    valid = np.isfinite(estimate).all(0) & np.isfinite(truth).all(0)
    labels = np.where(valid, labels, 0)
    of_mean, within = {}, {}
    for label in np.unique(labels[labels > 0]):
        e, t = estimate[:, labels == label], truth[:, labels == label]
        of_mean[int(label)] = e.mean(1) - t.mean(1)
        within[int(label)] = np.sqrt(((e - t) ** 2).mean(1))
    present = [within[label] for label in six if label in within]
    bands = np.mean(present, axis=0) if present else None
    return PatchesScore(
        len(of_mean),
        np.sqrt(np.mean(np.square(list(of_mean.values())), axis=0)).tolist() if of_mean else None,
        len(present),
        None if bands is None else SixPatchScore(bands.tolist(), float(bands.mean())),
    )
