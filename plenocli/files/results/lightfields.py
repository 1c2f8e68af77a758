"""Planes of refocus, into their artefact and out of it."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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

    field: its pictures may be InParts where it becomes an artefact.
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

    def every(pitch: float) -> tuple[float, float] | None:
        return None if spacing is None or not np.isfinite(spacing) else (spacing / pitch,) * 2

    def one(name: str, values: np.ndarray, pitch: float, **more: Any) -> "Series":
        return Series(name=name, values=values, channels=names, spacing=every(pitch), **more)

    planes = field.pictures[:, None] if colours is None else colours.pictures
    yield one("planes", planes, STEP, positions=field.distances)
    if field.sharp is not None:
        sharp = field.sharp[None] if colours is None or colours.sharp is None else colours.sharp
        yield one("everything in focus", sharp[None], STEP)
    maps = _layers(field)
    if maps:
        scaled = [1e6 * v if n.startswith("distance") else v for n, v in maps.items()]
        units = [f"{n} (µm)" if n.startswith("distance") else n for n in maps]
        yield Series(
            name="depth", values=np.stack(scaled)[None], channels=units, spacing=every(1.0)
        )
    if field.views is not None:
        views = field.views[:, :, None] if colours is None else colours.views
        assert views is not None  # kept in colour where they are kept in grey
        yield one("views", views.reshape(-1, *views.shape[2:]), 1.0, along="T")


def _write_exr(path: Path, field: LightField, provenance: "Provenance", overwrite: bool) -> None:
    """The picture with everything in focus, or the sharpest plane, as Y and in colour as R, G, B;
    depth as Z (m) where it is known, every plane as a layer; NaN where nothing is known of depth.
    """
    from plenocli.files.artefacts.provenance import provenance_texts
    from plenocli.files.images.exr import write_exr

    colours, best = field.colours, int(np.argmax(field.sharpness))
    channels = {"Y": field.pictures[best] if field.sharp is None else field.sharp}
    if colours is not None:
        own = colours.pictures[best] if colours.sharp is None else colours.sharp
        channels |= dict(zip("RGB", colours.rgb(np.nan_to_num(own))))
    for name, values in _layers(field).items():
        channels["Z" if name == "distance" else name] = np.kron(values, np.ones((STEP, STEP)))
    for number, picture in enumerate(field.pictures):
        layer = f"plane{number:03d}"
        if colours is None:
            channels[f"{layer}.Y"] = picture
        else:
            rgb = colours.rgb(np.nan_to_num(colours.pictures[number]))
            channels |= {f"{layer}.{name}": values for name, values in zip("RGB", rgb)}
    depths = ("Z", "slope", "sigma", "distance_sigma")
    whole = {n: v if n in depths else np.nan_to_num(v) for n, v in channels.items()}
    texts = {"slopes": " ".join(f"{s:.9g}" for s in field.slopes)}
    if field.distances is not None:
        texts["distances"] = " ".join(f"{d:.9g}" for d in field.distances)
    write_exr(path, whole, texts | provenance_texts(provenance), overwrite=overwrite)


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
