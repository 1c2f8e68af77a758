"""The figures of one file of each kind: lists of (PNG bytes, caption), for the report's
page and for `show`.
"""

import numpy as np


def capture_figures(capture, name, centres=None):
    """A capture with its lenslet grid.

    capture: plenocli.forward.sensor.capture.Capture;
    centres (R, C, 2) px, else the superpixels it tells of.
    """
    from plenocli.report.pictures import capture_picture

    shape = capture.grid.shape if capture.grid else None
    pitch = (
        tuple(float(n) for n in np.ravel(shape)) if centres is None and shape is not None else None
    )
    words = [
        name,
        capture.metadata.target,
        None if capture.cfa == "mono" else f"colour filter array {capture.cfa}",
        None if not capture.exposure_s else f"exposure {capture.exposure_s * 1e3:g} ms",
        None if not capture.metadata.band_m else f"{capture.metadata.band_m * 1e9:g} nm light",
    ]
    picture = capture_picture(
        capture.mosaic, capture.units, centres, pitch, float(np.mean(capture.levels.black))
    )
    return [(picture, ", ".join(str(w) for w in words if w) + ".")]


def matrix_figures(artefact, points=None):
    """Columns of A on the superpixels (of `points`, (row, column) each; else of an even choice),
    A itself, singular values and energy.
    """
    from plenocli.report.pictures import matrix_picture, matrix_summary, pif_columns

    data = artefact.data
    pixels, objects = (
        tuple(int(n) for n in data[f"pif/{name}_shape"]) for name in ("pixel", "object")
    )
    columns = pif_columns(
        data["pif/A"][0], pixels, objects, data["pif/lenslet_offset"], points=points
    )
    summary = matrix_summary(
        data.get("pif/singular_values"),
        data["pif/column_energy"],
        data["pif/wavelength"],
        objects,
        artefact.attrs.get("pif", {}).get("rank"),
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
            matrix_picture(own_matrix(artefact)[0]),
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


def calibration_figures(artefact):
    """The lenslet grid on the white image, and the response of the lenslet in the middle."""
    from plenocli.report.spectral_pictures import calibration_picture, response_picture

    data = artefact.data
    figures = []
    if "grid/centre" in data:
        figures.append(
            (
                calibration_picture(
                    data.get("white/flat"),
                    data["grid/centre"],
                    data["grid/valid"],
                    data.get("grid/residual"),
                    _predicted(artefact),
                ),
                _grid_caption(artefact),
            )
        )
    if "response/F" not in data:
        return figures
    values, window, wavelengths = (
        data["response/F"],
        tuple(int(n) for n in data["response/window"]),
        data["response/wavelength"],
    )
    if values.ndim == 4:
        seen = np.argwhere(np.isfinite(values).all(axis=(2, 3)) & data["grid/valid"].astype(bool))
        if not len(seen):
            return figures
        row, col = seen[np.argmin(((seen - np.array(values.shape[:2]) / 2) ** 2).sum(axis=1))]
        values = values[row, col]
    units = artefact.attrs.get("response", {}).get("units", "DN")
    return [
        *figures,
        (
            response_picture(values, window, wavelengths),
            (
                f"Response F of the lenslet in the middle [{units} for unit relative radiance]: "
                "pixels that answer to each band."
            ),
        ),
    ]


def _predicted(artefact):
    model = artefact.attrs.get("grid", {}).get("model")
    return isinstance(model, dict) and model.get("kind") == "description"


def _grid_caption(artefact):
    return (
        "The lenslet grid of the camera's description."
        if _predicted(artefact)
        else "The lenslet grid found on the white image."
    )


def dictionary_figures(result, name, history=None, system=None):
    """The first atoms, on the sensor too where `system` (A of the object's own superpixel, its
    pixel shape) fits, and how learning went.
    """
    from plenocli.report.pictures import dictionary_atoms, learning_history

    matrix, pixel_shape = (
        system if system is not None and system[0].shape[1] == len(result.values) else (None, None)
    )
    shape = result.attrs.get("object_shape")
    side = round(len(result.values) ** 0.5)
    shape = tuple(int(n) for n in shape) if shape is not None and len(shape) == 2 else (side, side)
    figures = []
    if shape[0] * shape[1] == len(result.values):
        figures.append(
            (
                dictionary_atoms(result.values, shape, matrix, pixel_shape),
                f"{name}: the first atoms of the dictionary.",
            )
        )
    if history:
        figures.append((learning_history(history), "How learning went."))
    return figures


def own_matrix(pif):
    """(A of the object's own superpixel in the first band, pixel shape) of a pif artefact."""
    own = np.flatnonzero((np.asarray(pif.data["pif/lenslet_offset"]) == 0).all(axis=1))
    return pif.data["pif/A"][0, own[0] if own.size else 0], tuple(
        int(n) for n in pif.data["pif/pixel_shape"]
    )


def learning(artefact):
    """History of a dictionary artefact: name -> values by iteration."""
    return {
        key.rsplit("/", 1)[1]: values
        for key, values in artefact.data.items()
        if key.startswith("dictionary/history/")
    }


def spectra_figures(result, name, lenslets=None):
    """Bands as pictures, and spectra with error bars of `lenslets` ((row, column) each; else
    of an even choice).
    """
    from plenocli.report.spectral_pictures import band_pictures, lenslet_spectra

    quantity = result.quantity or "value"
    return [
        (
            band_pictures(result.values, result.wavelengths, quantity),
            f"{name}: one value a lenslet and band.",
        ),
        (
            lenslet_spectra(result.values, result.sigma, result.wavelengths, quantity, lenslets),
            "Spectra of single lenslets, with one standard deviation where it is known.",
        ),
    ]


def image_figures(result, name, seen=None):
    """One picture without truth, and where it is known what of each lenslet's object the sensor
    sees, (object_row, object_column).
    """
    from plenocli.report.pictures import picture, seen_map

    figures = [
        (
            picture(result.values, name),
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
