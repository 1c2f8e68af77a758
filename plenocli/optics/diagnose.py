"""What a system matrix can and cannot tell apart: rank, condition, symmetry, energy.

If the pupil is point-symmetric, the object in focus and the pupil imaged onto the sensor (eps = kappa = W = 0), object
points at +x and -x give the same superpixel of an isolated lenslet: half of the object is invisible (docs/model.md).
"""

import numpy as np

RANK_THRESHOLD = 1e-6
"""Singular values below this share of the largest do not count towards the rank: the rounding of a single-precision A."""
NOISE_THRESHOLD = 1e-3
"""Singular values above this share stand out of noise at 60 dB."""
SYMMETRY_WARNING = 1e-3
"""Symmetry defects below this are worth a warning: the antisymmetric half of the object is all but lost."""
LARGEST = 4000
"""Above this many object points singular values are left out: they would take minutes."""
_DIRECT = 400
_RESOLUTION = 3e-8


def singular_values(matrix):
    """Singular values (descending, float64) of one band, (..., point): rows may have any leading shape.

    Small matrices by LAPACK; larger ones through the eigenvalues of A^T A in double precision, which resolves values down
    to 3e-8 of the largest; smaller ones are reported as that bound.
    """
    matrix = matrix.reshape(-1, matrix.shape[-1])
    points = matrix.shape[1]
    if points <= _DIRECT or len(matrix) < points:
        return np.linalg.svd(matrix.astype(float), compute_uv=False)
    gram = np.zeros((points, points))
    for start in range(0, len(matrix), 4096):
        part = matrix[start:start + 4096].astype(float)
        gram += part.T @ part
    values = np.linalg.eigvalsh(gram)[::-1]
    return np.sqrt(np.maximum(values, _RESOLUTION**2 * max(values[0], 0)))


def symmetry_defect(own):
    """max |A - A'| / max |A| for one superpixel's rows `own` (pixel, point); A' is A for the object turned by 180 degrees."""
    peak = np.abs(own).max()
    return float(np.abs(own - own[:, ::-1]).max() / peak) if peak > 0 else 0.0


def describe(pif):
    """Diagnose a Pif: dict of per-band lists and arrays.

    rank (threshold 1e-6 of the largest singular value), rank_60db (1e-3), condition (largest over smallest; a lower bound
    where the smallest is under 3e-8 of it), singular_values (band, value), or absent above 4000 points, symmetry_defect of the object's
    own superpixel, energy_min, energy_max, and warnings (sentences).
    """
    own = int(np.flatnonzero((np.asarray(pif.lenslet_offset) == 0).all(axis=1))[0])
    points = pif.A.shape[-1]
    whole = points == int(np.prod(pif.object_shape))
    found = {"energy_min": pif.column_energy.min(axis=1).tolist(), "energy_max": pif.column_energy.max(axis=1).tolist(), "warnings": []}
    if whole:
        found["symmetry_defect"] = [symmetry_defect(band[own]) for band in pif.A]
        if points > 1 and min(found["symmetry_defect"]) < SYMMETRY_WARNING:
            found["warnings"].append(
                f"half of the object is invisible to an isolated lenslet: points at +x and -x give the same superpixel (symmetry defect "
                f"{min(found['symmetry_defect']):.1e}); move the sensor off the pupil's image, as to sensor.distance = "
                "lenslet_array.focal_length, or defocus a little")
    if points > LARGEST:
        return found
    values = np.array([singular_values(band) for band in pif.A])
    top = np.maximum(values[:, :1], np.finfo(float).tiny)
    found["singular_values"] = values
    found["rank"] = [int(n) for n in (values > RANK_THRESHOLD * top).sum(axis=1)]
    found["rank_60db"] = [int(n) for n in (values > NOISE_THRESHOLD * top).sum(axis=1)]
    with np.errstate(divide="ignore"):
        found["condition"] = [float(c) for c in top[:, 0] / values[:, -1]]
    return found
