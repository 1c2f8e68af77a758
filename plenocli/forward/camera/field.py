"""The main lens as one lenslet sees it: at its wavelength, and at its place in the field.

A lens that is symmetric about the axis looks the same from all lenslets at one height but for its
azimuth. Here a is the pupil coordinate towards the lenslet and b the one across; W has cosine terms
of the angle from a only, and what rims leave open is the part of the pupil within discs whose
centres lie on the axis of a. docs/model.md, "Fields that change over the field".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import ConfigError, NumericsError
from plenocli.base.units import format_length
from plenocli.forward.camera.pupil import RIM, aperture_picture, unit_radius
from plenocli.forward.camera.pupil import wavefront as wavefront_error
from plenocli.forward.camera.sections.main_lens import noll_indices

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.camera.sections.main_lens import FieldRow, MainLens

ON_AXIS: tuple[float, float] = (0.0, 0.0)
CHANGE_NODES = 64
"""Points of the pupil along an axis that tell how much it changes."""


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """What a height adds to the lens, for a lenslet in the direction of a.

    focal_length: m;
    terms: ((Noll index, coefficient in m), ...);
    rims: ((centre along a, radius), ...), m.
    """

    focal_length: float
    terms: tuple[tuple[int, float], ...] = ()
    rims: tuple[tuple[float, float], ...] = ()


def at_field(camera: Camera, wavelength: float, chief: tuple[float, float] = ON_AXIS) -> Camera:
    """A camera whose main lens is the one that a lenslet sees at one wavelength.

    A thin main lens takes the place of a prescription and of the rows of `field`: of the traced
    focal length, with the aberrations of all of them and the rims that cut its pupil. A camera that
    has neither is returned as it is, so doing it twice does no harm.

    wavelength: m;
    chief: (rows, columns) m from the optical axis to the lenslet, as chief_ray gives it.

    Raises ConfigError where main_lens.focal_length is not the prescription's, the lens cannot be
    used so (see camera_lens), or rims and aperture image meet; NumericsError where no light gets to
    the lenslet.
    """
    thin = camera.main_lens
    if thin.prescription is None and not thin.field:
        return camera
    height, unit = math.hypot(*chief), unit_radius(thin)
    seen = _of_rows(thin.field, height, unit, thin.focal_length)
    if thin.prescription is not None:
        from plenocli.forward.camera.lens import traced_lens

        focal_length, terms, rims = traced_lens(
            thin.samples("prescription"),
            camera.object.distance,
            2 * unit,
            camera.light.design_wavelength,
            wavelength,
            thin.focal_length,
            height / camera.lenslet_array.distance,
        )
        seen = _Seen(focal_length=focal_length, terms=seen.terms + terms, rims=seen.rims + rims)
    if seen.rims and thin.aperture_shape == "image":
        raise ConfigError(
            "rims cut the pupil off the axis, which an aperture image cannot have",
            "main_lens.aperture_image",
            "put what the rims leave into the image, or name an aperture_shape",
        )
    return camera.model_copy(update={"main_lens": _turned(thin, seen, chief)})


def _turned(thin: MainLens, seen: _Seen, chief: tuple[float, float]) -> MainLens:
    """The thin lens with what is seen from a lenslet, turned to its azimuth."""
    from plenocli.forward.camera.sections.main_lens import Aberration

    height = math.hypot(*chief)
    down, right = (c / height for c in chief) if height else (0.0, 1.0)
    azimuth = math.atan2(down, right)
    terms = [
        Aberration.model_construct(noll=j, coefficient=c)
        for term in seen.terms
        for j, c in turned_term(*term, azimuth)
        if c
    ]
    changed = thin.model_copy(
        update={
            "focal_length": seen.focal_length,
            "aberrations": (*thin.aberrations, *terms),
            "prescription": None,
            "field": (),
        }
    )
    changed._rims = tuple((a * down, a * right, radius) for a, radius in seen.rims)
    return changed


def turned_term(noll: int, coefficient: float, azimuth: float) -> list[tuple[int, float]]:
    """A cosine term of W, given for the direction of +x, turned to an azimuth.

    noll, coefficient: Noll index and m;
    azimuth: rad from +x to +y.

    Returns [(Noll index, coefficient)] of the cosine term and, where it has one, its sine.
    """
    n, m = noll_indices(noll)
    if m == 0:
        return [(noll, coefficient)]
    sine = next(j for j in (noll - 1, noll + 1) if noll_indices(j) == (n, -m))
    parts = ((noll, math.cos(m * azimuth)), (sine, math.sin(m * azimuth)))
    # at right angles rounding must not break the symmetry
    return [(j, coefficient * (0.0 if abs(part) < 1e-15 * m else part)) for j, part in parts]


def pupil_change(camera: Camera, wavelength: float, chief: tuple[float, float]) -> float:
    """Estimated relative L2 difference of the worst column, by its pupil alone, of a lenslet off
    the axis from that of the lenslet on it.

    Pixels that see what a rim cuts off are dark: the root of the share that is lost. A wavefront
    changes what a point on the border of two lenslets sends through each: k times the root mean
    square of the difference.

    wavelength: m;
    chief: as for at_field.

    Returns a number, 1 at the most.
    """
    here = at_field(camera, wavelength).main_lens
    try:
        there = at_field(camera, wavelength, chief).main_lens
    except NumericsError:  # no light, which is no reason to know nothing of the axis
        return 1.0
    if here is there:
        return 0.0
    axis = np.linspace(-0.5, 0.5, 2 * CHANGE_NODES + 1)[1::2] * here.aperture_diameter
    y, x = axis[:, None], axis[None, :]
    whole, left = (aperture_picture(lens, y, x) for lens in (here, there))
    error = (wavefront_error(there, y, x) - wavefront_error(here, y, x))[left > 0]
    lost = 1 - left.sum() / whole.sum()
    return min(1.0, math.hypot(math.sqrt(lost), 2 * math.pi / wavelength * float(error.std())))


# rows of a description


def _of_rows(rows: Sequence[FieldRow], height: float, unit: float, focal_length: float) -> _Seen:
    """What the rows of a description say at a height (m). Near the axis a term of angular order m
    goes with the m-th power of the height times an even function: odd orders and the rim's shift
    are linear in the height between rows, even ones in its square.
    """
    if not rows:
        return _Seen(focal_length=focal_length)
    heights = [row.height for row in rows]
    if height > heights[-1] * (1 + 1e-9):
        raise ConfigError(
            f"the rows end at {format_length(heights[-1])} from the axis, a lenslet stands at "
            f"{format_length(height)}",
            "main_lens.field",
            "add a row for the corner of the array",
        )
    terms = []
    for j in sorted({term.noll for row in rows for term in row.aberrations}):
        power = 1 if noll_indices(j)[1] % 2 else 2
        values = [row.coefficient(j) for row in rows]
        terms.append((j, float(np.interp(height**power, np.power(heights, power), values))))
    shift = float(np.interp(height, heights, [shift_of(row.transmission) for row in rows]))
    return _Seen(
        focal_length=focal_length,
        terms=tuple((j, c) for j, c in terms if c),
        rims=((-shift * unit, unit),) if shift > RIM else (),
    )


def shift_of(share: float) -> float:
    """How far apart two discs of radius 1 stand that overlap in `share` of their area."""
    from scipy.optimize import brentq

    return float(brentq(lambda shift: overlap(shift) - share, 0.0, 2.0, xtol=1e-14))


def overlap(shift: float) -> float:
    """Share of its area in which a disc of radius 1 overlaps one that stands `shift` aside."""
    half = shift / 2
    return 2 / math.pi * (math.acos(half) - half * math.sqrt(1 - half * half))
