"""Planes of refocus, into their artefact and out of it."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.tiling import EVERYTHING, Plane, by_plane
from plenocli.inverse.lightfield.planes import Colours, DepthMap, LightField
from plenocli.inverse.lightfield.refocus import STEP
from plenocli.inverse.lightfield.samples import Channels, SampleBands

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.files.images.tiff_stack import Series


def lightfield_artefact(
    field: LightField, source: SampleBands, provenance: "Provenance"
) -> "Artefact":
    """The artefact of a light field; `source`: what it was made from."""
    from plenocli.files.artefacts.container import Artefact

    data = {
        "refocus/value": field.pictures,
        "refocus/slope": field.slopes,
        "refocus/sharpness": field.sharpness,
        "refocus/distance": field.distances,
    }
    if field.depth is not None:
        data |= {
            "depth/slope": field.depth.slope,
            "depth/confidence": field.depth.confidence,
            "depth/sigma": field.depth.sigma,
            "depth/edge": field.depth.edge,
            "depth/distance": field.depth.distance,
            "depth/distance_sigma": field.depth.distance_sigma,
        }
    if field.sharp is not None:
        data |= {"depth/picture": field.sharp}
    if field.views is not None:
        data |= {"views/value": field.views}
    if field.colours is not None:
        data |= _colours(field.colours)
    attrs: dict[str, dict] = {
        "refocus": {
            "pitch": source.pitch,
            "step": STEP,
            "pupil": 2 * source.survey.reach,
            "spacing": field.spacing,
            "microscope": field.microscope or None,
        }
    }
    if field.colours is not None:
        attrs["colour"] = {"channels": list(field.colours.channels.names)}
    return Artefact("lightfield", data, attrs, provenance)


SUFFIXES = (".h5", ".tif", ".tiff", ".exr")


def write_lightfield(
    path: Path, field: LightField, source: SampleBands, provenance: "Provenance", *, overwrite: bool
) -> None:
    """Write a light field as its artefact (.h5), as an OME-TIFF, or as an EXR, by the suffix.

    field: its pictures may be in a file (plenocli.files.scratch.ScratchRows).
    source: what it was made from.

    Raises UsageError, OutputError.
    """
    if path.suffix == ".h5":
        from plenocli.files.artefacts.writing import write_artefact

        write_artefact(path, lightfield_artefact(field, source, provenance), overwrite=overwrite)
    elif path.suffix == ".exr":
        _write_exr(path, field, provenance, overwrite)
    else:
        from plenocli.files.images.tiff_stack import write_ome_tiff

        write_ome_tiff(path, list(_series(field)), overwrite=overwrite)


def _layers(field: LightField) -> dict[str, np.ndarray]:
    """Maps (row, column) of depth by their names, distances in m."""
    depth = field.depth
    if depth is None:
        return {}
    found = {
        "slope": depth.slope,
        "confidence": depth.confidence,
        "sigma": depth.sigma,
        "edge": None if depth.edge is None else depth.edge.astype(float),
        "distance": depth.distance,
        "distance_sigma": depth.distance_sigma,
    }
    return {name: values for name, values in found.items() if values is not None}


def _series(field: LightField) -> Iterator["Series"]:
    """Images of an OME-TIFF: planes first, then the picture with everything in focus, the depth
    map, and the views one after the other, row by row. Lengths are micrometres, slopes px per px.
    """
    from plenocli.files.images.tiff_stack import Series

    colours, spacing = field.colours, field.spacing
    names = ["grey"] if colours is None else list(colours.channels.names)

    def one(name: str, values: Any, pitch: float, channels: list[str], **more: Any) -> "Series":
        """Of values (..., row, column), those of one picture after the other."""
        shape = values.shape[-2:]
        pictures = math.prod(values.shape[:-2])
        known = spacing is not None and np.isfinite(spacing)
        return Series(
            name=name,
            shape=(pictures // len(channels), len(channels), *shape),
            pictures=lambda: by_plane(values),
            channels=channels,
            spacing=(spacing / pitch,) * 2 if spacing is not None and known else None,
            **more,
        )

    planes = field.pictures if colours is None else colours.pictures
    yield one("planes", planes, STEP, names, positions=field.distances)
    if field.sharp is not None:
        sharp = field.sharp if colours is None else colours.sharp
        yield one("everything in focus", sharp, STEP, names)
    maps = _layers(field)
    if maps:
        scaled = [1e6 * v if n.startswith("distance") else v for n, v in maps.items()]
        units = [f"{n} (µm)" if n.startswith("distance") else n for n in maps]
        yield one("depth", np.stack(scaled), 1.0, units)
    if field.views is not None:
        # kept in colour where they are kept in grey
        views = field.views if colours is None else colours.views
        yield one("views", views, 1.0, names, along="T")


def _write_exr(path: Path, field: LightField, provenance: "Provenance", overwrite: bool) -> None:
    """The picture with everything in focus, or the sharpest plane, as Y and in colour as R, G, B;
    depth as Z (m) where it is known, every plane as a layer; NaN where nothing is known of depth.
    """
    from plenocli.files.artefacts.provenance import provenance_texts
    from plenocli.files.images.exr import write_exr

    colours, best = field.colours, (int(np.argmax(field.sharpness)),)
    grey = (field.pictures, best) if field.sharp is None else (field.sharp, ())
    channels = {"Y": _plane(*grey).through(np.nan_to_num)}
    if colours is not None:
        own = (colours.pictures, best) if colours.sharp is None else (colours.sharp, ())
        channels |= _rgb(colours, *own)
    depths = ("slope", "sigma", "distance", "distance_sigma")
    for name, values in _layers(field).items():
        whole = values if name in depths else np.nan_to_num(values)
        channels["Z" if name == "distance" else name] = _by_point(whole)
    for number in range(len(field.slopes)):
        if colours is None:
            layer = {"Y": _plane(field.pictures, (number,)).through(np.nan_to_num)}
        else:
            layer = _rgb(colours, colours.pictures, (number,))
        channels |= {f"plane{number:03d}.{name}": plane for name, plane in layer.items()}
    texts = {"slopes": " ".join(f"{s:.9g}" for s in field.slopes)}
    if field.distances is not None:
        texts["distances"] = " ".join(f"{d:.9g}" for d in field.distances)
    write_exr(path, channels, texts | provenance_texts(provenance), overwrite=overwrite)


def _plane(values: Any, lead: tuple[Any, ...]) -> Plane:
    """One picture, or its channels, of several."""
    return Plane(values.shape[-2:], lambda rows, columns: values[(*lead, rows, columns)])


def _rgb(colours: Colours, values: Any, lead: tuple[int, ...]) -> dict[str, Plane]:
    """Linear sRGB of a picture of several channels, 0 where it is not known."""

    def only(number: int) -> Plane:
        def one(part: np.ndarray) -> np.ndarray:
            return np.nan_to_num(colours.rgb(np.nan_to_num(part))[number])

        return _plane(values, (*lead, EVERYTHING)).through(one)

    return {name: only(number) for number, name in enumerate("RGB")}


def _by_point(values: np.ndarray) -> Plane:
    """A map of lenslets, each as often as it has points in a picture."""
    shape = STEP * values.shape[0], STEP * values.shape[1]

    def read(rows: slice, columns: slice) -> np.ndarray:
        places = (np.arange(*part.indices(n)) // STEP for part, n in zip((rows, columns), shape))
        return values[np.ix_(*places)]

    return Plane(shape, read)


def _colours(colours: Colours) -> dict[str, Any]:
    """The datasets of colours."""
    channels = colours.channels
    data = {
        "colour/value": colours.pictures,
        "colour/to_rgb": channels.to_rgb,
        "colour/weight": channels.weights,
        "colour/wavelength": channels.wavelengths,
    }
    if colours.sharp is not None:
        data["colour/picture"] = colours.sharp
    if colours.views is not None:
        data["colour/views"] = colours.views
    return data


def pupil_and_pitch(artefact: "Artefact") -> tuple[float, float]:
    """Width of the pupil's image and spacing of the lenslets, px, of a light field's artefact."""
    attrs = artefact.attrs.get("refocus", {})
    pitch = float(attrs.get("pitch") or 1.0)
    return float(attrs.get("pupil") or pitch), pitch


def lightfield_of(artefact: "Artefact") -> LightField:
    """The light field that an artefact holds."""
    data = artefact.data
    depth = (
        DepthMap(
            slope=data["depth/slope"],
            confidence=data["depth/confidence"],
            sigma=data.get("depth/sigma"),
            edge=data.get("depth/edge"),
            distance=data.get("depth/distance"),
            distance_sigma=data.get("depth/distance_sigma"),
        )
        if "depth/slope" in data
        else None
    )
    colours = None
    if "colour/value" in data:
        names = artefact.attrs.get("colour", {}).get("channels")
        channels = Channels(
            names=tuple(names or map(str, range(data["colour/value"].shape[1]))),
            to_rgb=data["colour/to_rgb"],
            weights=data["colour/weight"],
            wavelengths=data.get("colour/wavelength"),
        )
        colours = Colours(
            channels=channels,
            pictures=data["colour/value"],
            sharp=data.get("colour/picture"),
            views=data.get("colour/views"),
        )
    return LightField(
        pictures=data["refocus/value"],
        slopes=data["refocus/slope"],
        sharpness=data["refocus/sharpness"],
        distances=data.get("refocus/distance"),
        spacing=artefact.attrs.get("refocus", {}).get("spacing"),
        microscope=bool(artefact.attrs.get("refocus", {}).get("microscope")),
        depth=depth,
        sharp=data.get("depth/picture"),
        views=data.get("views/value"),
        colours=colours,
    )
