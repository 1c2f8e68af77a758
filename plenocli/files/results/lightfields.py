"""Planes of refocus, into their artefact and out of it."""

from typing import TYPE_CHECKING

import numpy as np

from plenocli.inverse.lightfield.planes import DepthMap, LightField
from plenocli.inverse.lightfield.refocus import STEP
from plenocli.inverse.lightfield.samples import Samples

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
            "depth/distance": field.depth.distance,
        }
    if field.sharp is not None:
        data |= {"depth/picture": field.sharp.astype(np.float32)}
    if field.views is not None:
        data |= {"views/value": field.views.astype(np.float32)}
    attrs = {"refocus": {"pitch": samples.pitch, "step": STEP, "pupil": 2 * samples.reach()}}
    return Artefact("lightfield", data, attrs, provenance)


def pupil_and_pitch(artefact: "Artefact") -> tuple[float, float]:
    """Width of the pupil's image and spacing of the lenslets, px, of a light field's artefact."""
    attrs = artefact.attrs.get("refocus", {})
    pitch = float(attrs.get("pitch") or 1.0)
    return float(attrs.get("pupil") or pitch), pitch


def lightfield_of(artefact: "Artefact") -> LightField:
    """The light field that an artefact holds."""
    data = artefact.data
    depth = (
        DepthMap(data["depth/slope"], data["depth/confidence"], data.get("depth/distance"))
        if "depth/slope" in data
        else None
    )
    return LightField(
        pictures=data["refocus/value"],
        slopes=data["refocus/slope"],
        sharpness=data["refocus/sharpness"],
        distances=data.get("refocus/distance"),
        depth=depth,
        sharp=data.get("depth/picture"),
        views=data.get("views/value"),
    )
