"""Pictures of the spectral chain: lenslet grid, response, demultiplexed bands, spectra of
patches, error bars. PNG bytes.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from plenocli.evaluation.scores import PatchScore, ResultScore
from plenocli.report.drawing import (
    COLOURS,
    LEVEL_MAP,
    LIGHT_MAP,
    SIGN_MAP,
    TRUTH,
    bare,
    colour_bar,
    drawing,
    nanometres,
    show_picture,
    swatch,
    thumbnail,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from plenocli.forward.camera.model import Camera
    from plenocli.forward.camera.sections.filter_array import Filter


def calibration_picture(
    flat: np.ndarray | None,
    centres: np.ndarray,
    valid: np.ndarray,
    residual: np.ndarray | None = None,
    predicted: bool = False,
) -> bytes:
    """The white image with the lenslet centres found, and a close-up.

    flat: (row, column), peak 1 in each superpixel; None: the centres alone.
    centres: (lenslet_row, lenslet_column, 2) px.
    valid: (lenslet_row, lenslet_column) bool.
    residual: (lenslet_row, lenslet_column) px from the lattice, or None.
    predicted: nobody looked for them.

    Returns PNG.
    """
    centres, valid = np.asarray(centres), np.asarray(valid, dtype=bool)
    found = centres[valid & np.isfinite(centres).all(axis=-1)]
    with drawing(10.2, 4.6) as made:
        whole, close = made.figure.subplots(1, 2)
        if flat is not None:
            shown, step = thumbnail(np.nan_to_num(np.asarray(flat, dtype=np.float64)))
            limits = (-0.5, step * shown.shape[1] - 0.5, step * shown.shape[0] - 0.5, -0.5)
            look = {"cmap": "gray", "vmin": 0, "vmax": 1, "interpolation": "nearest"}
            whole.imshow(shown, extent=limits, **look)
            close.imshow(np.nan_to_num(flat), **look)
        else:
            limits = (
                found[:, 1].min() - 5,
                found[:, 1].max() + 5,
                found[:, 0].max() + 5,
                found[:, 0].min() - 5,
            )
        colours = (
            np.full(len(found), 0.0)
            if residual is None or predicted
            else np.asarray(residual)[valid & np.isfinite(centres).all(axis=-1)]
        )
        size = max(0.8, min(14.0, 5000 / max(len(found), 1)))
        dots = whole.scatter(
            found[:, 1], found[:, 0], c=np.nan_to_num(colours), s=size, cmap=LEVEL_MAP, linewidths=0
        )
        whole.set(
            xlim=limits[:2],
            ylim=limits[2:],
            aspect="equal",
            xlabel="column [px]",
            ylabel="row [px]",
            title=f"{len(found)} lenslets"
            + (
                " as described"
                if predicted
                else " found" + (" on the white image" if flat is not None else "")
            ),
        )
        if residual is not None and not predicted:
            colour_bar(whole, dots, "distance from the lattice [px]")
        _middle_centres(close, found)
    return made.png


def _middle_centres(axes: "Axes", found: np.ndarray) -> None:
    """The centres (lenslet, 2) px about the middle one."""
    middle = found[np.argmin(((found - found.mean(axis=0)) ** 2).sum(axis=1))]
    nearest = np.sort(np.hypot(*(found - middle).T))
    half = 2.2 * (nearest[1] if len(nearest) > 1 else 20)
    axes.plot(found[:, 1], found[:, 0], "+", color=COLOURS[1], markersize=9, markeredgewidth=1.4)
    axes.set(
        xlim=(middle[1] - half, middle[1] + half),
        ylim=(middle[0] + half, middle[0] - half),
        aspect="equal",
        xlabel="column [px]",
        title="centres in the middle of the sensor",
    )


def response_picture(
    response: np.ndarray, window: tuple[int, ...], wavelengths: np.ndarray | np.ndarray
) -> bytes:
    """Which pixels of the superpixel answer to which band, each band on its own scale.

    response: F of one lenslet, (pixel, band).
    window: (rows, columns) of pixels.
    wavelengths: (band,) m.

    Returns PNG.
    """
    count = len(wavelengths)
    with drawing(min(2.5 * count, 10.2), 2.7) as made:
        panels = made.figure.subplots(1, count, squeeze=False)[0]
        for band, axes in enumerate(panels):
            values = np.nan_to_num(np.asarray(response)[:, band]).reshape(window)
            image = axes.imshow(values, cmap=LIGHT_MAP, vmin=0, interpolation="nearest")
            bare(axes, nanometres(wavelengths[band]))
            colour_bar(axes, image, "")
    return made.png


def response_errors(
    error: np.ndarray, peak: np.ndarray, window: tuple[int, ...], wavelengths: np.ndarray
) -> bytes:
    """Which pixels of the superpixel differ between two responses, on one scale.

    error: (pixel, band) difference.
    peak: (band,) brightest pixel.
    window: (rows, columns) of pixels.
    wavelengths: (band,) m.

    Returns PNG.
    """
    count = len(wavelengths)
    shares = 100 * np.asarray(error) / np.asarray(peak)
    limit = float(np.nanmax(np.abs(shares))) or 1.0
    with drawing(min(2.5 * count, 10.2), 2.7) as made:
        panels = made.figure.subplots(1, count, squeeze=False)[0]
        for band, axes in enumerate(panels):
            image = axes.imshow(
                np.nan_to_num(shares[:, band]).reshape(window),
                cmap=SIGN_MAP,
                vmin=-limit,
                vmax=limit,
                interpolation="nearest",
            )
            bare(axes, nanometres(wavelengths[band]))
        made.figure.colorbar(image, ax=list(panels), fraction=0.02, pad=0.01, label="% of the peak")
    return made.png


def _filter_name(one: "Filter") -> str:
    """What stands in a cell: its wavelength in nm, or how much it lets through."""
    state = f"\n{one.polariser.removesuffix(' deg')}\N{DEGREE SIGN}" if one.polariser else ""
    if one.middle is not None:
        return f"{one.middle * 1e9:.4g}{state}"
    return ("clear" if one.transmittance == 1 else f"{one.transmittance:.3g}") + state


def _filter_colour(one: "Filter") -> tuple[float, float, float]:
    """The colour (red, green, blue) in which a filter is drawn: that of its light, as bright as the
    screen shows it; grey where it lets all through alike.
    """
    from plenocli.forward.camera.pupil import filter_transmittance
    from plenocli.forward.scene.colour import preview_rgb

    if one.middle is None:
        return (0.6, 0.6, 0.6)
    wavelengths = np.linspace(400e-9, 700e-9, 61)
    through = [filter_transmittance(one, w) for w in wavelengths]
    red, green, blue = np.clip(preview_rgb(wavelengths, np.reshape(through, (-1, 1, 1))), 0, None)[
        :, 0, 0
    ]
    top = max(red, green, blue, 1e-9)
    red, green, blue = (float(0.85 * (c / top) ** (1 / 2.2)) for c in (red, green, blue))
    return red, green, blue


def filters_picture(camera: "Camera") -> bytes:
    """The filter array in the pupil of the main lens, and what filters and sensor let through, by
    wavelength, as PNG; nothing without filters.
    """
    from matplotlib.patches import Circle, Rectangle

    from plenocli.forward.camera.pupil import filter_places, filter_transmittance
    from plenocli.forward.sensor.cfa import sensitivity

    if camera.filter_array is None:
        return b""
    filters, half = camera.filter_array.filters, camera.main_lens.aperture_diameter / 2 * 1e3
    wavelengths = np.linspace(400e-9, 700e-9, 601)
    letters, curves = sensitivity(camera, wavelengths)
    with drawing(8.6, 2.9) as made:
        pupil, through = made.figure.subplots(1, 2, width_ratios=(1, 2.2))
        square = camera.main_lens.aperture_shape in ("square", "image")
        pupil.add_patch(
            Rectangle((-half, -half), 2 * half, 2 * half, color="#444444")
            if square
            else Circle((0, 0), half, color="#444444")
        )
        for cells, one in zip(filter_places(camera.filter_array), filters, strict=True):
            colour = _filter_colour(one)
            for y0, y1, x0, x1 in cells:
                pupil.add_patch(
                    Rectangle((x0 * 1e3, y0 * 1e3), (x1 - x0) * 1e3, (y1 - y0) * 1e3, color=colour)
                )
            if cells:
                y0, y1, x0, x1 = max(cells, key=lambda c: (c[1] - c[0]) * (c[3] - c[2]))
                pupil.text(
                    (x0 + x1) * 500,
                    (y0 + y1) * 500,
                    _filter_name(one),
                    ha="center",
                    va="center",
                    color="black" if np.dot(colour, (0.2, 0.7, 0.1)) > 0.5 else "white",
                )
            through.plot(
                wavelengths * 1e9, [filter_transmittance(one, w) for w in wavelengths], color=colour
            )
        pupil.set(
            xlim=(-1.05 * half, 1.05 * half),
            ylim=(1.05 * half, -1.05 * half),
            aspect="equal",
            xlabel="pupil [mm]",
            title="filters [nm]",
        )
        for letter, curve in zip(letters, curves, strict=True):
            name = "sensor" if len(letters) == 1 else letter
            _sensitivity_curve(through, wavelengths, curve, name)
        through.set(
            xlim=(400, 700),
            ylim=(0, 1.05),
            xlabel="wavelength [nm]",
            title="transmittance, and quantum efficiency of the sensor",
        )
        through.grid(True)
    return made.png


def _sensitivity_curve(axes: "Axes", wavelengths: np.ndarray, curve: np.ndarray, name: str) -> None:
    """The quantum efficiency (n,) of one colour over wavelengths (n,) m, named where it peaks."""
    axes.plot(wavelengths * 1e9, curve, color=TRUTH, linestyle="--", linewidth=0.9)
    top = np.argmax(curve) if np.ptp(curve) else len(curve) * 14 // 15
    axes.annotate(
        name, (wavelengths[top] * 1e9, curve[top]), ha="center", va="bottom", fontsize=7.5
    )


def band_pictures(
    cube: np.ndarray, wavelengths: np.ndarray, quantity: str = "value", light: str = "D65"
) -> bytes:
    """Demultiplexed bands on one scale, and the colour they make together (white = 1).

    cube: (band, row, column).
    wavelengths: (band,) m.
    quantity: of the values, "reflectance" or another word.
    light: name of the illuminant.

    Returns PNG.
    """
    from plenocli.forward.scene.colour import preview_rgb

    cube = np.asarray(cube, dtype=np.float64)
    known = cube[np.isfinite(cube)]
    top = (float(np.percentile(known, 99.5)) if known.size else 0.0) or 1.0
    scale = 1.0 if quantity == "reflectance" else top
    shown = min(len(wavelengths), 8)
    chosen = np.unique(np.round(np.linspace(0, len(wavelengths) - 1, shown)).astype(int))
    columns = min(5, len(chosen) + 1)
    lines = -(-(len(chosen) + 1) // columns)
    panel = 10.2 / columns
    with drawing(10.2, lines * (panel * cube.shape[1] / cube.shape[2] * 0.96 + 0.35)) as made:
        panels = made.figure.subplots(lines, columns, squeeze=False)
        for axes in panels.flat:
            axes.set_axis_off()
        panels[0, 0].set_axis_on()
        show_picture(
            panels[0, 0],
            np.moveaxis(preview_rgb(wavelengths, np.nan_to_num(cube) / scale, light), 0, -1),
            f"colour from {len(wavelengths)} bands",
            interpolation="nearest",
        )
        used = [panels.flat[0]]
        for axes, band in zip(panels.flat[1:], chosen, strict=False):
            axes.set_axis_on()
            image = axes.imshow(cube[band], cmap="gray", vmin=0, vmax=top, interpolation="nearest")
            bare(axes, nanometres(wavelengths[band]))
            used.append(axes)
        bar = made.figure.colorbar(
            image, ax=list(panels.flat), fraction=0.02, pad=0.01, shrink=0.85
        )
        bar.set_label(quantity)
        bar.outline.set_linewidth(0.4)
    return made.png


def lenslet_spectra(
    cube: np.ndarray,
    sigma: np.ndarray | None,
    wavelengths: np.ndarray,
    quantity: str = "value",
    lenslets: Sequence[tuple[int, int]] | None = None,
) -> bytes:
    """Spectra of single lenslets with one standard deviation.

    cube: (band, row, column).
    sigma: like the cube, None where unknown.
    wavelengths: (band,) m.
    quantity: of the values, in words.
    lenslets: (row, column) each; by default those whose brightness is at five even ranks, which
        shows dark and bright ones.

    Returns PNG.
    """
    cube = np.asarray(cube, dtype=np.float64)
    if lenslets is None:
        level = cube.mean(axis=0)
        known = np.argwhere(np.isfinite(level))
        order = known[np.argsort(level[tuple(known.T)], kind="stable")]
        lenslets = (
            [
                (int(order[k][0]), int(order[k][1]))
                for k in np.unique(
                    np.round(np.linspace(0.02, 0.98, 5) * (len(order) - 1)).astype(int)
                )
            ]
            if len(order)
            else []
        )
    with drawing(6.4, 3.4) as made:
        axes = made.figure.subplots()
        for number, (row, col) in enumerate(lenslets):
            std = None if sigma is None else np.asarray(sigma)[:, row, col]
            axes.errorbar(
                np.asarray(wavelengths) * 1e9,
                cube[:, row, col],
                std,
                marker="o",
                markersize=3.5,
                capsize=2.5,
                linewidth=1.1,
                color=COLOURS[number % len(COLOURS)],
                label=f"lenslet ({row}, {col})",
            )
        axes.set(xlabel="wavelength [nm]", ylabel=quantity)
        axes.grid(True)
        if lenslets:
            made.figure.legend(loc="outside right upper")
    return made.png


def patch_spectra(
    entries: Sequence[tuple[str, Sequence[PatchScore]]],
    wavelengths_nm: Sequence[float],
) -> bytes:
    """Spectra of the chart's patches: truth as a line, each result as points with +- one standard
    deviation; a colour strip beneath each title shows the patch.

    entries: (label, patches) of each result.
    wavelengths_nm: (band,).

    Returns PNG.
    """
    from plenocli.forward.scene.colour import preview_rgb
    from plenocli.forward.scene.tables import colorchecker

    bands = np.asarray(wavelengths_nm, dtype=float)
    wanted = {p.label: p for _, patches in entries for p in patches}
    order = sorted(wanted)
    columns = 6 if len(order) > 6 else 3
    lines = -(-len(order) // columns)
    _, table_wavelengths, table = colorchecker()
    colours = preview_rgb(table_wavelengths, table.T[:, :, None])[..., 0].T
    height = (1.5 if columns == 6 else 2.1) * lines + 0.8
    with drawing(10.2, height, layout=None) as made:
        panels = made.figure.subplots(
            lines,
            columns,
            squeeze=False,
            sharex=True,
            sharey=True,
            gridspec_kw={
                "left": 0.055,
                "right": 0.99,
                "bottom": 0.48 / height,
                "top": 1 - 0.55 / height,
                "wspace": 0.12 if columns == 6 else 0.07,
                "hspace": 0.28,
            },
        )
        for axes in panels.flat[len(order) :]:
            axes.set_axis_off()
        for place, (axes, label) in enumerate(zip(panels.flat, order, strict=False)):
            axes.axhspan(1.06, 1.14, color=swatch(colours[label - 1]), linewidth=0)
            axes.plot(
                table_wavelengths * 1e9,
                table[label - 1],
                color="#bbbbbb",
                linewidth=1,
                label="chart, full spectrum" if not place else None,
            )
            _patch_panel(axes, wanted[label], entries, bands, named=not place)
        made.figure.supxlabel("wavelength [nm]", fontsize=8.5, y=0.06 / height)
        made.figure.supylabel("reflectance", fontsize=8.5, x=0.004)
        made.figure.legend(loc="upper center", ncols=len(entries) + 2)
    return made.png


def _patch_panel(
    axes: "Axes",
    wanted: PatchScore,
    entries: Sequence[tuple[str, Sequence[PatchScore]]],
    bands: np.ndarray,
    named: bool,
) -> None:
    """One patch: its truth and what each result found; `named`: with entries for the legend."""
    if wanted.truth is not None:
        axes.plot(
            bands,
            wanted.truth,
            "_",
            color=TRUTH,
            markersize=9,
            markeredgewidth=1.4,
            label="truth" if named else None,
        )
    apart = 0.012 * np.ptp(bands) if len(entries) > 1 else 0.0
    for number, (name, patches) in enumerate(entries):
        for patch in patches:
            if patch.label == wanted.label:
                shift = (number - (len(entries) - 1) / 2) * apart
                _points(axes, bands + shift, patch.mean, patch.std, number, name if named else None)
    axes.set_title(wanted.name, fontsize=8)
    axes.set_ylim(-0.05, 1.14)
    if 400 <= bands.min() and bands.max() <= 700:
        axes.set(xlim=(400, 700), xticks=(450, 550, 650))
    axes.grid(True)


def _points(
    axes: "Axes",
    bands: np.ndarray,
    values: Sequence[float] | np.ndarray,
    std: Sequence[float],
    number: int,
    label: str | None,
) -> None:
    """Points of the result `number` with one standard deviation."""
    axes.errorbar(
        bands,
        values,
        std,
        fmt="o",
        markersize=3.2,
        capsize=1.8,
        linewidth=0.9,
        color=COLOURS[number % len(COLOURS)],
        label=label,
    )


def accuracy_bars(results: Sequence[ResultScore]) -> bytes:
    """Error and SNR per band for each result, as the paper's Fig. 7.

    results: those without bands are left out.

    Left: RMSE averaged over the six patches (over all lenslets where no patches are known). Right:
    capture SNR, with the predicted SNR as a tick.

    Returns PNG.
    """
    shown = [one for one in results if one.wavelengths_nm and "rmse_per_band" in one.figures]
    six = all("six_patch_rmse_per_band" in one.figures for one in shown)
    error_name = "six_patch_rmse_per_band" if six else "rmse_per_band"
    with_snr = any(one.bands("snr_capture_db") for one in shown)
    with drawing(9.6 if with_snr else 5.4, 3.1) as made:
        panels = made.figure.subplots(1, 2 if with_snr else 1, squeeze=False).ravel()
        _bars(panels[0], shown, error_name)
        panels[0].set(
            ylabel="RMSE in reflectance",
            title="error, mean of the six patches" if six else "error over all lenslets",
        )
        if with_snr:
            _bars(panels[1], shown, "snr_capture_db", "snr_predicted_db")
            panels[1].set(ylabel="SNR [dB]", title="capture SNR on white (tick: predicted)")
        made.figure.legend(
            *panels[0].get_legend_handles_labels(),
            loc="outside lower center",
            ncols=min(len(shown), 4),
        )
    return made.png


def _bars(axes: "Axes", results: Sequence[ResultScore], name: str, tick: str = "") -> None:
    """A figure by band of each result as bars; `tick`: another one marked on them."""
    bands = results[0].wavelengths_nm
    width = 0.8 / len(results)
    for number, one in enumerate(results):
        place = np.arange(len(bands)) + (number - (len(results) - 1) / 2) * width
        axes.bar(
            place,
            _known(one.bands(name) or [None] * len(bands)),
            0.9 * width,
            color=COLOURS[number % len(COLOURS)],
            label=one.label or one.name,
        )
        if one.bands(tick):
            axes.plot(
                place,
                _known(one.bands(tick)),
                "_",
                color=TRUTH,
                markersize=60 * width,
                markeredgewidth=1.3,
            )
    axes.set_xticks(range(len(bands)), [f"{w:g} nm" for w in bands])
    axes.tick_params(axis="x", length=0)
    axes.grid(True, axis="y")


def _known(values: Sequence[float | None]) -> list[float]:
    """Values with NaN where there is none."""
    return [np.nan if value is None else value for value in values]
