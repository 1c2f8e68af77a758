"""Planes of refocus, into their artefact and out of it."""

from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.inverse.lightfield.planes import Colours, DepthMap, LightField
from plenocli.inverse.lightfield.refocus import STEP
from plenocli.inverse.lightfield.samples import Channels, Samples

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.provenance import Provenance


def lightfield_artefact(
    field: LightField, samples: Samples, provenance: "Provenance"
) -> "Artefact":
    """The artefact of a light field; `samples`: what it was made from."""
    from plenocli.files.artefacts.container import Artefact

    data = {
        "refocus/value": field.pictures.astype(np.float32),
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
        data |= {"depth/picture": field.sharp.astype(np.float32)}
    if field.views is not None:
        data |= {"views/value": field.views.astype(np.float32)}
    if field.colours is not None:
        data |= _colours(field.colours)
    attrs: dict[str, dict] = {
        "refocus": {
            "pitch": samples.pitch,
            "step": STEP,
            "pupil": 2 * samples.reach(),
            "spacing": field.spacing,
            "microscope": field.microscope or None,
        }
    }
    if field.colours is not None:
        attrs["colour"] = {"channels": list(field.colours.channels.names)}
    return Artefact("lightfield", data, attrs, provenance)


def _colours(colours: Colours) -> dict[str, Any]:
    """The datasets of colours."""
    channels = colours.channels
    data = {
        "colour/value": colours.pictures.astype(np.float32),
        "colour/to_rgb": channels.to_rgb,
        "colour/weight": channels.weights,
        "colour/wavelength": channels.wavelengths,
    }
    if colours.sharp is not None:
        data["colour/picture"] = colours.sharp.astype(np.float32)
    if colours.views is not None:
        data["colour/views"] = colours.views.astype(np.float32)
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
