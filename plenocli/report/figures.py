"""The figures of one file of each kind: lists of (PNG bytes, caption), for the report's page and
for `show`.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.tiling import Plane
from plenocli.evaluation.results import Result
from plenocli.files.results.matrices import StoredMatrix
from plenocli.report.drawing import Figures, overview

if TYPE_CHECKING:
    from plenocli.files.images.mosaic import StoredCapture
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.calibration.calibration import Calibration, Response

Place = tuple[int, int]


def capture_figures(
    capture: "Capture",
    name: str,
    centres: np.ndarray | None = None,
    source: "StoredCapture | None" = None,
) -> Figures:
    """A capture with its lenslet grid.

    capture: of any target.
    name: for the caption.
    centres: (lenslet_row, lenslet_column, 2) px, else the superpixels it tells of.
    source: the same where its mosaic stays in the file, which `capture` then lacks.
    """
    from plenocli.forward.sensor.cfa import colour_planes, preview
    from plenocli.report.pictures import capture_picture

    tile = capture.grid.shape if capture.grid else None
    pitch = (
        tuple(float(n) for n in np.ravel(tile)) if centres is None and tile is not None else None
    )
    words = [
        name,
        capture.metadata.target,
        None if capture.cfa == "mono" else f"colour filter array {capture.cfa}",
        None if not capture.exposure_s else f"exposure {capture.exposure_s * 1e3:g} ms",
        None if not capture.metadata.band_m else f"{capture.metadata.band_m * 1e9:g} nm light",
    ]
    window = capture.window if source is None else source.window
    shape = capture.shape if source is None else source.shape

    def colours(rows: slice, columns: slice) -> np.ndarray:
        ends = (part.indices(side // 2)[:2] for part, side in zip((rows, columns), shape))
        signal = window(*(slice(2 * first, 2 * last) for first, last in ends)).signal()
        return colour_planes(np.nan_to_num(signal), capture.cfa)

    colour = None
    if capture.cfa != "mono" and min(shape) >= 2:
        seen = overview(Plane((3, *(side // 2 for side in shape)), colours))
        colour = (preview(seen.small, capture.profile), 2 * seen.step)
    picture = capture_picture(
        Plane(shape, lambda rows, columns: window(rows, columns).mosaic),
        capture.units,
        centres,
        pitch,
        float(np.mean(capture.levels.black)),
        colour,
    )
    return [(picture, ", ".join(str(w) for w in words if w) + ".")]


def matrix_figures(matrix: StoredMatrix, points: Sequence[Place] | None = None) -> Figures:
    """Columns of A on the superpixels, A itself, singular values and energy.

    matrix: as it is stored.
    points: (row, column) of the object points whose columns are shown, else an even choice.
    """
    from plenocli.report.pictures import matrix_picture, matrix_summary, pif_columns

    columns = pif_columns(
        matrix.blocks[0], matrix.pixel_shape, matrix.object_shape, matrix.offsets, points=points
    )
    summary = matrix_summary(
        matrix.singular_values,
        matrix.column_energy,
        matrix.wavelengths,
        matrix.object_shape,
        labels=matrix.told_apart(),
        resolution=matrix.resolution,
    )
    return [
        (
            columns,
            (
                "What the sensor sees of single object points, one panel a point, square-root "
                "scale. Panels stand as the points' images do on the lenslet."
            ),
        ),
        (
            matrix_picture(matrix.own),
            (
                "The system matrix of the object's own superpixel, square-root scale: a column is "
                "what the sensor sees of one object point."
            ),
        ),
        (
            summary,
            (
                "Left: how many object patterns the sensor tells apart, and how well. Right: light "
                "that stays on the superpixels kept."
            ),
        ),
    ]


def calibration_figures(calibration: "Calibration") -> Figures:
    """The lenslet grid on the white image, and the response of the lenslet in the middle."""
    from plenocli.report.spectral_pictures import calibration_picture, response_picture

    grid, response, windows = calibration.grid, calibration.response, calibration.windows
    described = grid.model == "description"
    flat = None if calibration.white is None else calibration.white.flat
    figures = [
        (
            calibration_picture(flat, grid.centres, grid.valid, grid.residual, described),
            "The lenslet grid of the camera's description."
            if described
            else "The lenslet grid found on the white image.",
        )
    ]
    matrix = None if response is None else _middle_response(response, grid.valid)
    if response is None or windows is None or matrix is None:
        return figures
    return [
        *figures,
        (
            response_picture(matrix, windows.shape, response.wavelengths),
            (
                f"Response F of the lenslet in the middle [{calibration.sensor.units} for unit "
                "relative radiance]: pixels that answer to each band."
            ),
        ),
    ]


def _middle_response(response: "Response", valid: np.ndarray) -> np.ndarray | None:
    """F (pixel, band) of the lenslet nearest to the middle that has one, or of all.

    response: of a calibration.
    valid: (lenslet_row, lenslet_column) bool.
    """
    matrix = response.matrix
    if matrix.ndim != 4:
        return matrix
    seen = np.argwhere(np.isfinite(matrix).all(axis=(2, 3)) & valid)
    if not len(seen):
        return None
    row, col = seen[np.argmin(((seen - np.array(matrix.shape[:2]) / 2) ** 2).sum(axis=1))]
    return matrix[row, col]


def dictionary_figures(
    result: Result,
    name: str,
    matrix: StoredMatrix | None = None,
    history: bool = True,
) -> Figures:
    """The first atoms of a dictionary, and how learning went.

    result: of a dictionary.
    name: for the caption.
    matrix: through which atoms are shown on the sensor too, where it fits them.
    history: whether to show how learning went.
    """
    from plenocli.report.pictures import dictionary_atoms, learning_history

    points = len(result.values)
    fits = matrix is not None and matrix.own.shape[1] == points
    side = round(points**0.5)
    told = result.object_shape
    shape = told if told is not None and len(told) == 2 else (side, side)
    figures = []
    if shape[0] * shape[1] == points:
        atoms = dictionary_atoms(
            result.values,
            shape,
            matrix.own if matrix is not None and fits else None,
            matrix.pixel_shape if matrix is not None and fits else None,
        )
        figures.append((atoms, f"{name}: the first atoms of the dictionary."))
    if history and result.history:
        figures.append((learning_history(result.history), "How learning went."))
    return figures


def spectra_figures(result: Result, name: str, lenslets: Sequence[Place] | None = None) -> Figures:
    """Bands as pictures, and spectra with error bars; nothing of a result without bands.

    result: with bands.
    name: for the caption.
    lenslets: (row, column) whose spectra are shown, else an even choice.
    """
    from plenocli.report.spectral_pictures import band_pictures, lenslet_spectra

    if result.wavelengths is None:
        return []
    quantity = result.quantity or "value"
    return [
        (
            band_pictures(result.values, result.bands, quantity),
            f"{name}: one value a lenslet and band.",
        ),
        (
            lenslet_spectra(result.values, result.sigma, result.bands, quantity, lenslets),
            "Spectra of single lenslets, with one standard deviation where it is known.",
        ),
    ]


def image_figures(result: Result, name: str, seen: np.ndarray | None = None) -> Figures:
    """One picture without truth.

    result: with a picture.
    name: for the caption.
    seen: (object_row, object_column) share of each lenslet's object that the sensor sees, drawn
        too where it is given.
    """
    from plenocli.report.pictures import picture, seen_map

    figures = [
        (
            picture(result.plane if result.rgb is None else np.moveaxis(result.rgb, 0, -1), name),
            f"{name}{': ' + result.method if result.method else ''}; no truth to compare with.",
        )
    ]
    if seen is not None:
        figures.append(
            (
                seen_map(seen),
                (
                    f"What the sensor tells apart of the object under a lenslet: {seen.mean():.0%} "
                    "of its directions; 0 lies in the null space."
                ),
            )
        )
    return figures


def fit_figures(
    names: Sequence[str],
    value: np.ndarray,
    sigma: np.ndarray,
    described: np.ndarray,
    tolerance: np.ndarray,
    correlation: np.ndarray,
) -> Figures:
    """What a fit made of a camera: its parameters with error bars, and their correlations.

    names: of the parameters.
    value, sigma, described, tolerance: (parameter,) in units of their own.
    correlation: (parameter, parameter).
    """
    from plenocli.report.pictures import fit_picture

    picture = fit_picture(names, (value - described) / tolerance, sigma / tolerance, correlation)
    return [(picture, "Parameters of a fitted camera from the described ones, in tolerances.")]
