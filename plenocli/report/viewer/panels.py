"""What the viewer shows of one file of each kind: stacks of pictures, light fields, volumes."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from plenocli.base.tiling import to_blocks
from plenocli.base.units import format_length
from plenocli.evaluation.results import Result
from plenocli.inverse.lightfield import refocus as focus

if TYPE_CHECKING:
    from plenocli.files.results.matrices import StoredMatrix
    from plenocli.files.results.volumes import StoredVolume
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.calibration.calibration import Calibration
    from plenocli.inverse.lightfield.planes import LightField
    from plenocli.inverse.lightfield.samples import Channels, Samples

Map = Literal["light", "level", "sign", "colour"]
MOST_VIEWS = 15
"""Views along each side of the pupil that are made of a capture."""
BARS = 1.96
"""Standard deviations to either side, 95 % of normal errors."""


@dataclass(frozen=True, kw_only=True)
class Layer:
    """A picture that lies over others on the same place.

    name: of it.
    values: (plane, row, column); one plane serves all others; of "colour" linear sRGB in three.
    map: amounts of light, other levels, differences around 0, or colour.
    low, high: shown black and white; of a difference white is in between.
    unit: of the values, in which they are told.
    """

    name: str
    values: np.ndarray
    map: Map = "light"
    low: float = 0.0
    high: float = 1.0
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class Stack:
    """Layers over each other, with planes along an axis.

    labels: of the planes; none for a single one.
    axis: what the planes go along.
    ticks: (plane,) where each is on the axis, along which a click draws; None for planes in no
        order.
    drawn, bars: numbers of the layers that a click draws and of their half error bars, or None.
    block: values of the file (along each side) whose mean one value is.
    """

    title: str
    caption: str
    layers: list[Layer]
    labels: list[str]
    axis: str = ""
    ticks: list[float] | None = None
    drawn: int | None = None
    bars: int | None = None
    block: int = 1


@dataclass(frozen=True, kw_only=True)
class Field:
    """A light field, focused in the page: every view is moved by slope times its place.

    views: (view_row, view_column, channel, row, column), one channel where they are grey.
    places: (view_row,) and (view_column,), pitches that a view moves at slope 1.
    slopes: least, largest and first one.
    channels: names of the channels, none of grey ones.
    to_rgb: three rows that make linear sRGB of the channels; none of grey ones.
    planes: pictures (plane, channel, row, column) as the file holds them, each at its slope; None
        without.
    depth: layers of the depth map, slope first; none without.
    """

    title: str
    caption: str
    views: np.ndarray
    places: list[list[float]]
    slopes: list[float]
    high: float
    step: int
    channels: list[str]
    to_rgb: list[list[float]]
    planes: np.ndarray | None
    plane_slopes: list[float]
    plane_labels: list[str]
    depth: list[Layer]


@dataclass(frozen=True, kw_only=True)
class Volume:
    """A volume with its standard deviation.

    layers: value, and sigma where it is known.
    depths: (plane,) as words; sizes: (plane, row, column) spacing in m.
    """

    title: str
    caption: str
    layers: list[Layer]
    depths: list[str]
    sizes: list[float]
    block: int


Panel = Stack | Field | Volume


def thinned(values: np.ndarray, most: int) -> tuple[np.ndarray, int]:
    """Planes averaged over whole blocks until they have at most `most` values.

    values: (..., row, column); what lies over the last whole block is left out, NaN is not counted.

    Returns the means and the side of a block.
    """
    block = 1
    rows, columns = values.shape[-2:]
    planes = values.size // max(rows * columns, 1)
    while planes * (rows // block) * (columns // block) > most and block < min(rows, columns):
        block += 1
    if block == 1:
        return values, 1
    flat = values[..., : rows // block * block, : columns // block * block]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # blocks without a known value stay NaN
        means = [
            np.nanmean(to_blocks(plane, (block, block)), axis=-1)
            for plane in flat.reshape(-1, *flat.shape[-2:])
        ]
    return np.reshape(means, (*values.shape[:-2], rows // block, columns // block)), block


def _top(values: np.ndarray, share: float = 99.5) -> float:
    known = values[np.isfinite(values)]
    return max(float(np.percentile(known, share)), 1e-30) if known.size else 1.0


def _span(values: np.ndarray) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [2, 98]).tolist() if known.size else (0.0, 1.0)
    return low, high if high > low else low + max(abs(low), 1.0) * 1e-6


def levels(name: str, values: np.ndarray, map: Map = "level", unit: str = "") -> Layer:
    """A layer (plane, row, column) or (row, column) that is shown from its least to its largest."""
    low, high = _span(values)
    stack = values if values.ndim == 3 else values[None]
    return Layer(name=name, values=stack, map=map, low=low, high=high, unit=unit)


def picture_panels(results: Sequence[Result], truth: np.ndarray | None, most: int) -> list[Panel]:
    """Pictures of one size: the truth, each result, its error and its standard deviation.

    truth: like their values, or None.
    """
    share = most // (3 * len(results) + 1)
    top = max(1.0, _top(results[0].values)) if truth is not None else _top(results[0].values)
    layers, block = [], 1
    if truth is not None:
        layers.append(Layer(name="truth", values=thinned(truth, share)[0][None], high=top))
    for result in results:
        values, block = thinned(result.values, share)
        name = result.method or result.name
        name = name if len(results) == 1 or name == result.name else f"{name} ({result.name})"
        layers.append(Layer(name=name, values=values[None], high=top))
        if result.rgb is not None and truth is None:
            colour = thinned(result.rgb, share)[0] / top
            layers.insert(0, Layer(name="colour", values=colour, map="colour"))
    for layer, result in zip(layers[-len(results) :], list(results), strict=True):
        if truth is not None:
            error, span = thinned(result.values - truth, share)[0], 0.0
            span = _top(np.abs(error), 99)
            layers.append(
                Layer(
                    name=f"error of {layer.name}",
                    values=error[None],
                    map="sign",
                    low=-span,
                    high=span,
                )
            )
        if result.sigma is not None:
            layers.append(levels(f"σ of {layer.name}", thinned(result.sigma, share)[0]))
    names = ", ".join(result.path.name for result in results[:3])
    names += f" and {len(results) - 3} more" if len(results) > 3 else ""
    return [Stack(title=names, caption="Relative radiance.", layers=layers, labels=[], block=block)]


def spectra_panels(result: Result, truth: np.ndarray | None, most: int) -> list[Panel]:
    """Bands with their colour, a spectrum with error bars wherever one clicks.

    truth: (band, row, column), or None.
    """
    from plenocli.forward.scene.colour import preview_rgb

    share = most // 3
    values, block = thinned(result.values, share)
    ticks = [float(w) * 1e9 for w in result.bands]
    unit = result.quantity or "relative radiance"
    scale = 1.0 if unit == "reflectance" else _top(values)
    colour = preview_rgb(result.bands, np.nan_to_num(values) / scale)
    layers = [
        Layer(name="band", values=values, high=_top(values), unit=unit),
        Layer(name="colour", values=colour, map="colour"),
    ]
    if truth is not None:
        true = thinned(truth, share)[0]
        span = _top(np.abs(values - true), 99)
        layers.append(Layer(name="truth", values=true, high=layers[0].high, unit=unit))
        layers.append(
            Layer(name="error", values=values - true, map="sign", low=-span, high=span, unit=unit)
        )
    bars = None
    if result.sigma is not None:
        bars = len(layers)
        sigma = thinned(np.asarray(result.sigma, np.float64), share)[0]
        layers.append(levels("σ", sigma, unit=unit))
    return [
        Stack(
            title=result.path.name,
            caption=f"{result.method or 'spectra'}: {unit} in {len(ticks)} bands. Click for a "
            f"spectrum; bars are {BARS:g} σ each way.",
            layers=layers,
            labels=[f"{tick:.4g} nm" for tick in ticks],
            axis="wavelength (nm)",
            ticks=ticks,
            drawn=0,
            bars=bars,
            block=block,
        )
    ]


def capture_panels(
    capture: Capture, name: str, samples: tuple[Samples, tuple[int, int]] | None, most: int
) -> list[Panel]:
    """A capture as it was read, and as a light field where its lenslets are known.

    samples: what its pixels saw, and (rows, columns) of a view; None where nobody says.
    """
    share = most if samples is None else most // 2
    mosaic, block = thinned(np.asarray(capture.mosaic, np.float64), share)
    low = float(np.mean(capture.levels.black))
    words = [name, capture.metadata.target, None if capture.cfa == "mono" else capture.cfa]
    picture = Stack(
        title=f"{name}: sensor",
        caption=f"{', '.join(str(w) for w in words if w)}.",
        layers=[
            Layer(
                name="mosaic",
                values=mosaic[None],
                low=low,
                high=max(_top(mosaic), low + 1e-30),
                unit=capture.units,
            )
        ],
        labels=[],
        block=block,
    )
    return [picture] if samples is None else [_captured_field(*samples, name, share), picture]


def _captured_field(samples: Samples, shape: tuple[int, int], name: str, most: int) -> Field:
    reach, channels = samples.reach(), samples.channels
    across = int(np.floor(2 * reach * np.sqrt(0.5) + 1e-6)) + 1
    across = across if channels is None else max(1, across // 2)  # a colour has every other pixel
    each = shape[0] * shape[1] * len(samples.parts())
    count = min(across, MOST_VIEWS, max(1, int(np.sqrt(most / each))))
    views = focus.views_in_colour(samples, count, shape)
    places = view_places(count, 2 * reach, samples.pitch)
    return _field(name, views, places, slopes=[-3.0, 3.0, 0.0], channels=channels)


def view_places(count: int, pupil: float, pitch: float) -> list[float]:
    """Pitches by which the picture of each of `count` views along a side moves at slope 1.

    pupil: width of the pupil's image, px; views share the square within it.
    pitch: lenslet spacing, px.
    """
    side = pupil * np.sqrt(0.5)
    return ((np.arange(count) + 0.5) / count * side / pitch - side / pitch / 2).tolist()


def _field(
    name: str,
    views: np.ndarray,
    places: list[float],
    *,
    slopes: list[float],
    channels: Channels | None = None,
    field: LightField | None = None,
    most: int = 0,
) -> Field:
    planes = None if field is None else _planes(field)
    if planes is not None and planes.size > most:
        planes = thinned(planes, most)[0]
    return Field(
        title=name,
        caption="Light field: refocused in this page by moving and adding its views; drag for "
        "another view through the pupil.",
        views=views,
        places=[places, places],
        slopes=slopes,
        high=_top(views),
        step=max(1, min(focus.STEP, 480 // max(views.shape[3:]))),
        channels=[] if channels is None else list(channels.names),
        to_rgb=[] if channels is None else channels.to_rgb.tolist(),
        planes=planes,
        plane_slopes=[] if field is None else field.slopes.tolist(),
        plane_labels=[] if field is None else _plane_labels(field),
        depth=[] if field is None else _depth_layers(field),
    )


def _planes(field: LightField) -> np.ndarray:
    """(plane, channel, row, column)."""
    return field.pictures[:, None] if field.colours is None else field.colours.pictures


def _plane_labels(field: LightField) -> list[str]:
    distances = np.full(len(field.slopes), np.nan) if field.distances is None else field.distances
    return [
        f"slope {slope:.3g}" + (f", {1e3 * d:.4g} mm" if np.isfinite(d) else "")
        for slope, d in zip(field.slopes, distances, strict=True)
    ]


def _depth_layers(field: LightField) -> list[Layer]:
    depth = field.depth
    if depth is None:
        return []
    layers = [levels("slope", depth.slope, unit="px/px")]
    if depth.distance is not None and np.isfinite(depth.distance).any():
        layers.append(levels("distance", 1e3 * depth.distance, unit="mm"))
    return [*layers, Layer(name="confidence", values=depth.confidence[None], map="level")]


def lightfield_panels(
    field: LightField, name: str, size: tuple[float, float], most: int
) -> list[Panel]:
    """Planes, depth and views that refocus made.

    size: width of the pupil's image and spacing of the lenslets, px.
    """
    slopes = [float(field.slopes.min()), float(field.slopes.max())]
    first = float(field.slopes[int(np.argmax(field.sharpness))])
    if slopes[0] == slopes[1]:
        slopes = [slopes[0] - 1, slopes[1] + 1]
    if field.views is not None:
        colours = field.colours
        seen = field.views[:, :, None] if colours is None else colours.views
        assert seen is not None  # views in colour are kept where grey ones are
        views, block = thinned(seen, most // 2)
        places = [place / block for place in view_places(len(views), *size)]
        channels = None if colours is None else colours.channels
        made = _field(
            name,
            views,
            places,
            slopes=[*slopes, first],
            channels=channels,
            field=field,
            most=most // 2,
        )
        return [made]
    planes, block = thinned(field.pictures, most)
    layers = [Layer(name="plane", values=planes, high=_top(planes))]
    panels: list[Panel] = [
        Stack(
            title=name,
            caption="Planes of the capture.",
            layers=layers,
            labels=_plane_labels(field),
            block=block,
        )
    ]
    depth = _depth_layers(field)
    if depth:
        panels.append(Stack(title=f"{name}, depth", caption="Depth.", layers=depth, labels=[]))
    return panels


def volume_panels(volume: StoredVolume, name: str, most: int) -> list[Panel]:
    """Three slices through a point of a volume, the standard deviation beside them."""
    value, block = thinned(volume.value, most // 2)
    layers = [Layer(name="value", values=value, high=_top(value, 99.9))]
    if volume.sigma is not None:
        sigma = thinned(volume.sigma, most // 2)[0]
        layers.append(Layer(name="σ", values=sigma, map="level", high=_top(sigma, 99.9)))
    rows, columns = volume.spacing
    return [
        Volume(
            title=name,
            caption=f"{volume.method or 'known'} volume: slices across the axis (xy), along "
            "columns (xz) and along rows (yz); click one to move the others.",
            layers=layers,
            depths=[format_length(float(d)) for d in volume.depth],
            sizes=[volume.step, rows * block, columns * block],
            block=block,
        )
    ]


def calibration_panels(calibration: Calibration, name: str, most: int) -> list[Panel]:
    """The white image, what is known of each lenslet, and the response in every band."""
    made: list[Panel] = []
    white, response, windows = calibration.white, calibration.response, calibration.windows
    if white is not None and white.flat is not None:
        flat, block = thinned(np.asarray(white.flat, np.float64), most // 2)
        layer = Layer(name="white", values=flat[None])
        made.append(
            Stack(
                title=f"{name}: white",
                caption="White image, peak 1 in each superpixel.",
                layers=[layer],
                labels=[],
                block=block,
            )
        )
    grid = calibration.grid
    lenslets = [levels("usable", grid.valid.astype(float))]
    if white is not None and white.level is not None:
        lenslets.insert(0, levels("white level", white.level, unit=calibration.sensor.units))
    lenslets += [
        levels(f"centre, {axis}", grid.centres[..., i], unit="px")
        for i, axis in enumerate(("row", "column"))
    ]
    made.append(
        Stack(title=f"{name}: lenslets", caption="One value a lenslet.", layers=lenslets, labels=[])
    )
    if response is not None and windows is not None:
        made.append(_response_panel(calibration, name, most // 4))
    return made


def _response_panel(calibration: Calibration, name: str, most: int) -> Stack:
    """The response of the middle usable lenslet, or of all where they share it."""
    response, windows = calibration.response, calibration.windows
    assert response is not None and windows is not None
    matrix, which = np.asarray(response.matrix), "all lenslets"
    if not response.shared:
        usable = np.argwhere(calibration.grid.valid)
        middle = np.asarray(calibration.grid.valid.shape) / 2
        row, column = usable[np.argmin(((usable - middle) ** 2).sum(axis=1))].tolist()
        matrix, which = matrix[row, column], f"lenslet ({row}, {column})"
    bands, block = thinned(matrix.T.reshape(-1, *windows.shape).astype(np.float64), most)
    ticks = [float(w) * 1e9 for w in response.wavelengths]
    return Stack(
        title=f"{name}: response",
        caption=f"Signal of each pixel of {which} for unit radiance in a band.",
        layers=[
            Layer(name="F", values=bands, high=_top(bands, 99.9), unit=calibration.sensor.units)
        ],
        labels=[f"{tick:.4g} nm" for tick in ticks],
        axis="wavelength (nm)",
        ticks=ticks,
        drawn=0,
        block=block,
    )


def matrix_panels(matrix: StoredMatrix, name: str, most: int) -> list[Panel]:
    """What the sensor sees of each object point: the columns of A on the superpixels."""
    from plenocli.report.pictures import on_superpixels

    blocks, size = matrix.blocks[0], matrix.object_shape
    pixels = blocks.shape[0] * blocks.shape[1]
    number = size[0] * size[1]
    count = min(number, max(1, most // pixels))
    chosen = np.unique(np.linspace(0, number - 1, count).round().astype(int))
    columns = np.array(
        [on_superpixels(blocks[:, :, i], matrix.pixel_shape, matrix.offsets) for i in chosen]
    )
    columns, block = thinned(columns, most)
    return [
        Stack(
            title=name,
            caption="What the sensor sees of one object point: a column of A on its superpixels.",
            layers=[Layer(name="share of the light", values=columns, high=_top(columns, 99.9))],
            labels=[f"({i // size[1]}, {i % size[1]})" for i in chosen.tolist()],
            axis="object point",
            block=block,
        )
    ]


def dictionary_panels(result: Result, most: int) -> list[Panel]:
    """The atoms of a dictionary, one a plane, in the file's order."""
    shape = result.object_shape or (len(result.values), 1)
    count = min(result.values.shape[1], max(1, most // len(result.values)))
    atoms = result.values[:, :count].T.reshape(-1, *shape)
    span = float(np.abs(atoms).max()) or 1.0
    layer = Layer(name="atom", values=atoms, map="sign", low=-span, high=span)
    return [
        Stack(
            title=result.path.name,
            caption="Object patches, unit norm.",
            layers=[layer],
            labels=[f"{i} of {result.values.shape[1]}" for i in range(count)],
            axis="atom",
        )
    ]
