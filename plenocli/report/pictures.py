"""Pictures of the spatial chain: capture, system matrix, reconstructions, dictionary.

Every function returns PNG bytes.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.tiling import Plane
from plenocli.report.drawing import (
    COLOURS,
    GRID_LINE,
    LEVEL_MAP,
    LIGHT_MAP,
    SIGN_MAP,
    bare,
    colour_bar,
    drawing,
    nanometres,
    overview,
    show_map,
    show_picture,
    thumbnail,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.image import AxesImage
    from matplotlib.patches import Rectangle

Shape = tuple[int, ...]
Entry = tuple[str, np.ndarray | Plane, str]
"""Label, values (row, column) and caption of a result."""
ZOOMED = 3
"""Superpixels per side in the close-up."""
HISTORY = {
    "validation_psnr": "PSNR on held-out patches [dB]",
    "change": "change of the atoms (norm)",
    "coherence_max": "coherence of A phi, largest",
    "coherence_mean": "coherence of A phi, mean",
    "dead_share": "share of atoms replaced",
    "nonzeros": "coefficients of a patch",
    "step_residual": "residual of the step (relative)",
    "worst_gap": "duality gap, worst (relative)",
}
"""What learning records, in words."""


def capture_picture(
    mosaic: np.ndarray | Plane,
    units: str = "",
    centres: np.ndarray | None = None,
    pitch: tuple[float, ...] | None = None,
    black: float = 0.0,
    colour: tuple[np.ndarray, int] | None = None,
) -> bytes:
    """A capture: the whole mosaic with its lenslet grid, and the middle superpixels close up.

    mosaic: (row, column).
    units: of its values.
    centres: (lenslet_row, lenslet_column, 2) px, or None.
    pitch: (row, column) px or None, used where centres are missing, for superpixels that tile from
        the corner.
    black: level above which values are shown, on one scale for both parts.
    colour: (row, column, 3) linear sRGB that is shown as a whole instead of values, and the pixels
        of the sensor along a side of one of its; None of grey captures.

    Returns PNG.
    """
    from plenocli.forward.scene.colour import encode_srgb

    plane = Plane.of(mosaic).through(lambda values: values - black)
    seen = overview(plane)
    top = float(np.percentile(seen.sample, 99.9)) or 1.0
    shown, step = seen.small, seen.step
    del seen  # its sample is as large as all that is drawn
    centres = _tiling(plane.shape, pitch) if centres is None and pitch is not None else centres
    if centres is not None and not np.isfinite(centres).all(axis=-1).any():
        centres = None
    rows, cols = plane.shape
    with drawing(10.2, 4.75) as made:
        whole, close = made.figure.subplots(1, 2)
        if colour is not None:
            shown, step = encode_srgb(colour[0]), colour[1]
        whole.imshow(
            shown,
            cmap=LIGHT_MAP,
            vmin=0,
            vmax=top,
            extent=(-0.5, step * shown.shape[1] - 0.5, step * shown.shape[0] - 0.5, -0.5),
        )
        whole.set(
            xlabel="column [px]",
            ylabel="row [px]",
            title=f"{rows} x {cols} pixels"
            + ("" if step == 1 else f", shown {step} times smaller"),
        )
        box = _middle(plane.shape, centres)
        image = _close_up(close, plane, box, top)
        close.set(
            xlabel="column [px]",
            title="close-up"
            if centres is None
            else f"{ZOOMED} x {ZOOMED} superpixels in the middle",
        )
        if centres is not None:
            if centres.shape[0] * centres.shape[1] <= 2500:
                _lattice(whole, centres, 0.35)
            else:
                near = (slice(max(n // 2 - 9, 0), n // 2 + 10) for n in centres.shape[:2])
                centres = centres[tuple(near)]
            _lattice(close, centres, 0.9)
        whole.add_patch(_outline(box))
        colour_bar(close, image, f"signal [{units}]" if units else "signal")
    return made.png


def _close_up(
    axes: "Axes", mosaic: Plane, box: tuple[int, int, int, int], top: float
) -> "AxesImage":
    """A part of a capture, rows and columns from and to, white at `top`."""
    return axes.imshow(
        mosaic.window(slice(*box[:2]), slice(*box[2:])),
        cmap=LIGHT_MAP,
        vmin=0,
        vmax=top,
        interpolation="nearest",
        extent=(box[2] - 0.5, box[3] - 0.5, box[1] - 0.5, box[0] - 0.5),
    )


def _tiling(shape: Shape, pitch: tuple[float, ...]) -> np.ndarray:
    count = [max(int(n / p + 1e-6), 1) for n, p in zip(shape, pitch, strict=True)]
    row, col = ((np.arange(n) + 0.5) * p - 0.5 for n, p in zip(count, pitch, strict=True))
    return np.stack(np.meshgrid(row, col, indexing="ij"), axis=-1)


def _middle(shape: Shape, centres: np.ndarray | None) -> tuple[int, int, int, int]:
    """Row and column range of the middle ZOOMED x ZOOMED superpixels, or of the
    middle of the frame.
    """
    if centres is None or min(centres.shape[:2]) < 1:
        half = [min(n, 160) // 2 for n in shape]
        middle = [n // 2 for n in shape]
    else:
        centre = centres[centres.shape[0] // 2, centres.shape[1] // 2]
        half = [max(int(ZOOMED / 2 * p), 2) for p in _spacing(centres, shape)]
        middle = [
            int(np.nan_to_num(c, nan=n / 2) + 0.5) for c, n in zip(centre, shape, strict=True)
        ]
    low = [
        min(max(m - h, 0), max(n - 2 * h, 0)) for m, h, n in zip(middle, half, shape, strict=True)
    ]
    high = [min(b + 2 * h, n) for b, h, n in zip(low, half, shape, strict=True)]
    return low[0], high[0], low[1], high[1]


def _spacing(centres: np.ndarray, shape: Shape) -> list[float]:
    """Median (row, column) spacing of lenslets in px; the frame's size along an
    axis with one lenslet.
    """
    found = []
    for axis in (0, 1):
        steps = np.abs(np.diff(centres[..., axis], axis=axis))
        steps = steps[np.isfinite(steps)]
        found.append(float(np.median(steps)) if steps.size else float(shape[axis]))
    return found


def _lattice(axes: "Axes", centres: np.ndarray, width: float) -> None:
    """Boundaries between neighbouring superpixels along rows and columns; follows
    rotated and bent grids.
    """
    limits = axes.get_xlim(), axes.get_ylim()
    for points in (centres, np.swapaxes(centres, 0, 1)):
        if len(points) < 2:
            continue
        between = (points[1:] + points[:-1]) / 2
        for line in between:
            if len(line) > 1:
                line = np.vstack(
                    [1.5 * line[0] - 0.5 * line[1], line, 1.5 * line[-1] - 0.5 * line[-2]]
                )
            axes.plot(line[:, 1], line[:, 0], color=GRID_LINE, linewidth=width, alpha=0.9)
    axes.set(xlim=limits[0], ylim=limits[1])


def _outline(box: tuple[int, int, int, int]) -> "Rectangle":
    from matplotlib.patches import Rectangle

    return Rectangle(
        (box[2] - 0.5, box[0] - 0.5),
        box[3] - box[2],
        box[1] - box[0],
        fill=False,
        edgecolor="white",
        linewidth=1.0,
    )


def pif_columns(
    matrix: np.ndarray,
    pixel_shape: Shape,
    object_shape: Shape,
    offsets: np.ndarray,
    per_side: int = 3,
    points: Sequence[tuple[int, int]] | None = None,
) -> bytes:
    """What the sensor sees of single object points: columns of A laid out on the superpixels.

    matrix: (lenslet, pixel, point).
    pixel_shape, object_shape: (rows, columns) of a superpixel and of an object block.
    offsets: (lenslet, 2) superpixel (row, column) from the point's own.
    per_side: points along each side, where none are given.
    points: (row, column) each.

    The panels stand as the points' images do on the lenslet. Square-root scale, because the outer
    fringes are weak.

    Returns PNG.
    """
    if points is None:
        rows, columns = (
            np.unique(np.round(np.linspace(0, n - 1, min(per_side, n))).astype(int))
            for n in object_shape
        )
        points, across = [(i, j) for i in rows for j in columns], len(columns)
    else:
        across = min(4 if len(points) == 4 else 3, len(points))
    lines = -(-len(points) // across)
    with drawing(2.4 * max(across, 2) + 0.6, 2.35 * lines + 0.15) as made:
        panels = made.figure.subplots(lines, across, squeeze=False)
        for axes in panels.flat[len(points) :]:
            axes.set_axis_off()
        pictures = [
            on_superpixels(matrix[:, :, i * object_shape[1] + j], pixel_shape, offsets)
            for i, j in points
        ]
        top = max(picture.max() for picture in pictures) or 1.0
        for axes, (i, j), picture in zip(panels.flat, points, pictures, strict=False):
            image = axes.imshow(
                picture, cmap=LIGHT_MAP, norm=_root_norm(top), interpolation="nearest"
            )
            bare(axes, f"point ({i}, {j}), {picture.sum():.0%} of its light")
            for line in range(1, picture.shape[0] // pixel_shape[0]):
                axes.axhline(line * pixel_shape[0] - 0.5, color=GRID_LINE, linewidth=0.6)
            for line in range(1, picture.shape[1] // pixel_shape[1]):
                axes.axvline(line * pixel_shape[1] - 0.5, color=GRID_LINE, linewidth=0.6)
        bar = made.figure.colorbar(image, ax=panels, fraction=0.03, pad=0.01)
        bar.set_label("share of the point's light in a pixel")
        bar.outline.set_linewidth(0.4)
    return made.png


def _root_norm(top: float) -> "Normalize":
    from matplotlib.colors import PowerNorm

    return PowerNorm(0.5, vmin=0, vmax=top)


def on_superpixels(column: np.ndarray, pixel_shape: Shape, offsets: np.ndarray) -> np.ndarray:
    """One column (lenslet, pixel) as a picture of all superpixels, each at its offset."""
    offsets = np.asarray(offsets) - np.min(offsets, axis=0)
    height, width = pixel_shape
    picture = np.zeros((offsets[:, 0].max() * height + height, offsets[:, 1].max() * width + width))
    for (row, col), values in zip(offsets, column, strict=True):
        picture[row * height : (row + 1) * height, col * width : (col + 1) * width] = (
            values.reshape(pixel_shape)
        )
    return picture


def matrix_picture(matrix: np.ndarray) -> bytes:
    """A of one superpixel, (pixel, point): what each pixel has of each object point, square-root
    scale, as PNG.
    """
    shown, step = thumbnail(np.asarray(matrix, dtype=np.float64), 700)
    with drawing(7.2, 4.6) as made:
        axes = made.figure.subplots()
        image = axes.imshow(
            shown,
            cmap=LIGHT_MAP,
            norm=_root_norm(float(shown.max()) or 1.0),
            interpolation="nearest",
            aspect="auto",
            extent=(-0.5, step * shown.shape[1] - 0.5, step * shown.shape[0] - 0.5, -0.5),
        )
        axes.set(
            xlabel="object point, row by row",
            ylabel="pixel of the superpixel, row by row",
            title=f"A, {matrix.shape[0]} x {matrix.shape[1]}",
        )
        colour_bar(axes, image, "share of a point's light in a pixel")
    return made.png


def matrix_summary(
    singular_values: np.ndarray | None,
    column_energy: np.ndarray,
    wavelengths: np.ndarray,
    object_shape: Shape,
    *,
    labels: Sequence[str] | None = None,
    resolution: np.ndarray | None = None,
) -> bytes:
    """Singular values of A relative to the largest, one line a band, and the share of light kept by
    object point.

    singular_values: (band, value) or (value,), or None.
    column_energy: (band, point).
    wavelengths: (band,) m; of many bands six are drawn.
    object_shape: (rows, columns) of an object block.
    labels: what to say of each band beside its wavelength, or None.
    resolution: (band,) share of the largest below which values are rounding, or None.

    Returns PNG.
    """
    values = None if singular_values is None else np.atleast_2d(singular_values)
    with drawing(9.4, 3.6) as made:
        left, right = made.figure.subplots(1, 2, width_ratios=(1.55, 1))
        chosen = np.unique(
            np.round(np.linspace(0, len(wavelengths) - 1, min(len(wavelengths), 6))).astype(int)
        )
        for number, band in enumerate(chosen):
            if values is None:
                break
            one = values[min(band, len(values) - 1)]
            kept = one[one > 0]
            words = "" if labels is None or not labels[band] else f", {labels[band]}"
            if len(kept):
                left.semilogy(
                    np.arange(1, len(kept) + 1),
                    kept / kept[0],
                    color=COLOURS[number],
                    label=nanometres(wavelengths[band]) + words,
                )
                if resolution is not None:
                    left.axhline(
                        resolution[band],
                        color=COLOURS[number],
                        linestyle=":",
                        label="below: rounding" if number == len(chosen) - 1 else None,
                    )
        left.set(xlabel="number", ylabel="singular value, relative to the largest")
        left.grid(True)
        if values is not None:
            left.legend(loc="upper right")
        energy = np.asarray(column_energy)[0].reshape(object_shape) * 100
        show_map(
            right,
            energy,
            f"light on the superpixels kept, {nanometres(wavelengths[0])}",
            "share of a point's light [%]",
            cmap=LEVEL_MAP,
            vmin=0,
            vmax=100,
        )
        right.set(xlabel="object point, column", ylabel="object point, row")
    return made.png


def reconstructions(entries: Sequence[Entry], truth: np.ndarray | Plane, columns: int = 4) -> bytes:
    """Reconstructions beside the truth, each above its error; light encoded for the screen,
    white = 1.

    entries: (label, values (row, column), caption) each. One error scale for all, that of the
        typical result.
    truth: (row, column).
    columns: at most.

    Returns PNG.
    """
    true, seen = overview(truth), [overview(values) for _, values, _ in entries]
    errors = [one.small - true.small for one in seen]
    typical = [np.percentile(np.abs(one.sample - true.sample), 98) for one in seen]
    # Methods differ by decades: the scale is that of the typical method and never beyond half of
    # white; poor ones saturate.
    top = min(max(float(np.median(typical)), 1e-6), 0.5) if errors else 1.0
    columns = min(columns, len(entries) + 1)
    lines = -(-(len(entries) + 1) // columns)
    panel = 10.2 / columns
    aspect = Plane.of(truth).shape[0] / Plane.of(truth).shape[1]
    with drawing(10.2, lines * (2 * panel * aspect + 0.55)) as made:
        panels = made.figure.subplots(2 * lines, columns, squeeze=False)
        for axes in panels.flat:
            axes.set_axis_off()
        panels[0, 0].set_axis_on()
        show_picture(panels[0, 0], true.small, "truth")
        image = None
        for number, ((label, _, caption), one, error) in enumerate(
            zip(entries, seen, errors, strict=True), start=1
        ):
            line, column = divmod(number, columns)
            above, below = panels[2 * line, column], panels[2 * line + 1, column]
            above.set_axis_on()
            below.set_axis_on()
            show_picture(above, one.small, f"{label}\n{caption}" if caption else label)
            image = below.imshow(error, cmap=SIGN_MAP, vmin=-top, vmax=top)
            bare(below)
        if image is not None:
            bar = made.figure.colorbar(
                image,
                cax=panels[1, 0].inset_axes([0.04, 0.8, 0.92, 0.05]),
                orientation="horizontal",
                ticks=[-top, 0, top],
                format="%.2g",
            )
            bar.set_label("error: result - truth\n(white = 1)")
            bar.outline.set_linewidth(0.4)
    return made.png


def close_ups(
    entries: Sequence[Entry],
    truth: np.ndarray | Plane,
    block: tuple[int, int],
    lenslets: int = 3,
    columns: int = 4,
) -> bytes:
    """The fields of the middle lenslets of truth and results, enlarged, with the lenslets' borders.

    entries: as for reconstructions.
    truth: (row, column).
    block: (rows, columns) of samples under a lenslet.
    lenslets: along each side.
    columns: at most.

    Returns PNG.
    """
    boxes = []
    for size, side in zip(Plane.of(truth).shape, block, strict=True):
        count = size // side
        first = max((count - lenslets) // 2, 0) * side
        boxes.append(slice(first, min(first + lenslets * side, size)))
    named = [("truth", truth), *((label, values) for label, values, _ in entries)]
    parts = [(label, Plane.of(values).window(*boxes)) for label, values in named]
    columns = min(columns, len(parts))
    lines = -(-len(parts) // columns)
    panel = 10.2 / columns
    with drawing(10.2, lines * (panel * parts[0][1].shape[0] / parts[0][1].shape[1] + 0.3)) as made:
        panels = made.figure.subplots(lines, columns, squeeze=False)
        for axes in panels.flat:
            axes.set_axis_off()
        for axes, (label, values) in zip(panels.flat, parts, strict=False):
            axes.set_axis_on()
            show_picture(axes, values, label, interpolation="nearest")
            for line in range(1, lenslets):
                axes.axhline(line * block[0] - 0.5, color=GRID_LINE, linewidth=0.5, alpha=0.8)
                axes.axvline(line * block[1] - 0.5, color=GRID_LINE, linewidth=0.5, alpha=0.8)
    return made.png


def picture(values: np.ndarray | Plane, title: str = "") -> bytes:
    """One reconstructed picture (row, column), or in colour (row, column, 3), without truth, as
    PNG.
    """
    if isinstance(values, np.ndarray) and values.ndim == 3:
        small, sample = values.astype(np.float64), values
    else:
        seen = overview(values)
        small, sample = seen.small, seen.sample
    top = float(np.percentile(sample, 99.8))
    height = 5.4 * small.shape[0] / small.shape[1]
    with drawing(5.4, min(height, 9) + 0.3) as made:
        show_picture(made.figure.subplots(), small / top if top > 0 else small, title)
    return made.png


def seen_map(share: np.ndarray) -> bytes:
    """What of a lenslet's object the sensor tells apart, 0 to 1, by object point (row, column), as
    PNG.
    """
    with drawing(4.6, 3.8) as made:
        axes = made.figure.subplots()
        show_map(
            axes,
            share,
            "seen of the object under a lenslet",
            "share that is told apart, by object point",
            cmap=LEVEL_MAP,
            vmin=0,
            vmax=1,
        )
    return made.png


def dictionary_atoms(
    atoms: np.ndarray,
    object_shape: Shape,
    matrix: np.ndarray | None = None,
    pixel_shape: Shape | None = None,
    per_side: int = 10,
) -> bytes:
    """Atoms in object space and on the sensor, each on its own scale.

    atoms: (point, atom); the first per_side^2 by order of use are those in the file's order.
    object_shape: (rows, columns) of an atom.
    matrix: A (pixel, point), through which the sensor sees them, or None.
    pixel_shape: (rows, columns) of a superpixel, where A is given.
    per_side: atoms along each side.

    Returns PNG.
    """
    count = min(per_side * per_side, atoms.shape[1])
    chosen = atoms[:, :count]
    parts = [("atoms in object space", chosen, object_shape)]
    if matrix is not None:
        assert pixel_shape is not None
        parts.append(("the same atoms on the sensor, A phi", matrix @ chosen, pixel_shape))
    with drawing(5.1 * len(parts), 5.0 * -(-count // per_side) / per_side + 0.35) as made:
        for axes, (title, columns, shape) in zip(
            np.ravel(made.figure.subplots(1, len(parts))), parts, strict=True
        ):
            axes.imshow(
                _mosaic_of(columns, shape, per_side),
                cmap="gray",
                vmin=-1,
                vmax=1,
                interpolation="nearest",
            )
            bare(axes, f"{title} ({count} of {atoms.shape[1]}, each on its own scale)")
    return made.png


def _mosaic_of(columns: np.ndarray, shape: Shape, per_side: int) -> np.ndarray:
    """Columns (sample, n) as small pictures side by side, each scaled to its largest
    magnitude, on a white gap.
    """
    gap = max(1, min(shape) // 12)
    height, width = shape[0] + gap, shape[1] + gap
    lines = -(-columns.shape[1] // per_side)
    canvas = np.ones((lines * height + gap, per_side * width + gap))
    for number, column in enumerate(columns.T):
        row, col = divmod(number, per_side)
        scale = np.abs(column).max() or 1.0
        canvas[gap + row * height :, gap + col * width :][: shape[0], : shape[1]] = (
            column.reshape(shape) / scale
        )
    return canvas


def learning_history(history: Mapping[str, np.ndarray]) -> bytes:
    """How learning went: one small panel for each recorded value.

    history: name -> (iteration,).

    Returns PNG, nothing where nothing was recorded.
    """
    named = {
        name: np.asarray(v, dtype=float)
        for name, v in history.items()
        if np.ndim(v) == 1 and len(v) and np.isfinite(np.asarray(v, float)).any()
    }
    if not named:
        return b""
    columns = min(4, len(named))
    lines = -(-len(named) // columns)
    with drawing(2.55 * columns, 1.9 * lines) as made:
        panels = made.figure.subplots(lines, columns, squeeze=False)
        for axes in panels.flat:
            axes.set_axis_off()
        for axes, (name, values) in zip(panels.flat, named.items(), strict=False):
            axes.set_axis_on()
            axes.plot(
                np.arange(1, len(values) + 1),
                values,
                color=COLOURS[0],
                marker="." if len(values) < 40 else "",
            )
            axes.set(title=HISTORY.get(name, name.replace("_", " ")), xlabel="iteration")
            axes.xaxis.get_major_locator().set_params(integer=True)
            axes.grid(True)
    return made.png


def fit_picture(
    names: Sequence[str], change: np.ndarray, sigma: np.ndarray, correlation: np.ndarray
) -> bytes:
    """Parameters with error bars, and the correlations of their errors.

    change, sigma: (parameter,) in tolerances.
    correlation: (parameter, parameter).

    Returns a PNG.
    """
    places = np.arange(len(names))
    with drawing(7.5, 0.28 * len(names) + 0.9) as made:
        left, right = made.figure.subplots(1, 2, sharey=True)
        left.errorbar(change, places, xerr=sigma, fmt="o", color=COLOURS[0], markersize=3)
        left.axvline(0, color=COLOURS[7], linewidth=0.7)
        left.set_yticks(places, list(names))
        left.set_xlabel("change, tolerances")
        image = right.imshow(correlation, cmap=SIGN_MAP, vmin=-1, vmax=1, aspect="auto")
        right.set_xticks([])
        right.set_title("correlation of the errors")
        made.figure.colorbar(image, ax=right)
    return made.png
