"""What a camera needs to know of a traced lens: first-order data, focal shift, lateral colour,
distortion, vignetting, W.

Lenses and rays as in plenocli.forward.camera.prescription and plenocli.forward.camera.raytrace;
fields are angles (rad) of the paraxial chief ray in object space, towards +y; image planes are
distances (m) from the last vertex. docs/model.md, "Real lenses".
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from plenocli.base.errors import ConfigError, NumericsError
from plenocli.forward.camera.prescription import Prescription
from plenocli.forward.camera.pupil import RIM, zernike
from plenocli.forward.camera.raytrace import (
    Pupil,
    Rays,
    aim,
    entrance_pupil,
    exit_pupil,
    paraxial_matrix,
    to_plane,
    trace,
)
from plenocli.forward.camera.sections.main_lens import noll_indices

# first order


@dataclass(frozen=True, kw_only=True)
class FirstOrder:
    """Paraxial data at one wavelength, m.

    focal_length: effective;
    back_focus: from the last vertex to the rear focus;
    front_principal, rear_principal: principal points, from the first and from the last vertex;
    entrance_pupil, exit_pupil: images of the stop;
    f_number: f/(2 entrance pupil radius), NaN where that pupil lies at infinity.
    """

    focal_length: float
    back_focus: float
    front_principal: float
    rear_principal: float
    entrance_pupil: Pupil
    exit_pupil: Pupil
    f_number: float


def first_order(lens: Prescription, wavelength: float) -> FirstOrder:
    """The FirstOrder of a lens.

    wavelength: m.

    Raises NumericsError for a lens without power.
    """
    (a, _), (c, d) = paraxial_matrix(lens.surfaces, wavelength)
    if abs(c) < 1e-9:
        raise NumericsError(
            "the lens has no power", "lens", "afocal systems form no image; check radii and glasses"
        )
    n = _last_index(lens, wavelength)
    entrance = entrance_pupil(lens, wavelength)
    known = math.isfinite(entrance.radius)
    return FirstOrder(
        focal_length=float(-n / c),
        back_focus=float(-n * a / c),
        front_principal=float((d - 1) / c),
        rear_principal=float(n * (1 - a) / c),
        entrance_pupil=entrance,
        exit_pupil=exit_pupil(lens, wavelength),
        f_number=float(abs(n / c) / (2 * entrance.radius)) if known else math.nan,
    )


def paraxial_image(
    lens: Prescription, wavelength: float, object_distance: float = math.inf
) -> float:
    """Distance from the last vertex to the paraxial image of an axial point.

    wavelength: m;
    object_distance: m before the first vertex.

    Returns m.
    """
    (a, b), (c, d) = paraxial_matrix(lens.surfaces, wavelength)
    top, bottom = (
        (a, c)
        if math.isinf(object_distance)
        else (a * object_distance + b, c * object_distance + d)
    )
    return float(-_last_index(lens, wavelength) * top / bottom) if bottom else math.inf


def focal_shift(
    lens: Prescription, wavelengths: Sequence[float], object_distance: float = math.inf
) -> np.ndarray:
    """Paraxial image distances minus that at the design wavelength.

    wavelengths: m;
    object_distance: m before the first vertex.

    Returns (wavelength,) m.
    """
    at_design = paraxial_image(lens, lens.design_wavelength, object_distance)
    return np.array([paraxial_image(lens, w, object_distance) - at_design for w in wavelengths])


def image_plane(lens: Prescription, object_distance: float = math.inf) -> float:
    """Where the sensor stands: the image distance that the description gives for its own object
    distance, or else the paraxial image at the design wavelength.

    object_distance: m before the first vertex.

    Returns m from the last vertex.
    """
    if lens.image_distance and object_distance == lens.object_distance:
        return lens.image_distance
    return paraxial_image(lens, lens.design_wavelength, object_distance)


def _last_index(lens: Prescription, wavelength: float) -> float:
    return lens.surfaces[-1].medium.index(wavelength)


# fields

_CENTRE = np.zeros((2, 1))


def chief_height(
    lens: Prescription,
    wavelength: float,
    angle: float,
    object_distance: float = math.inf,
    image_distance: float | None = None,
) -> float:
    """Height at which the ray through the stop's centre meets the image plane.

    wavelength: m;
    angle: of the field, rad;
    object_distance: m before the first vertex;
    image_distance: m from the last vertex, None: that of image_plane.

    Returns y, m.
    """
    distance = image_plane(lens, object_distance) if image_distance is None else image_distance
    rays = trace(
        lens.surfaces,
        aim(lens, wavelength, _CENTRE, angle=angle, object_distance=object_distance),
        wavelength,
    )
    return float(to_plane(rays, distance).position[1, 0])


def lateral_colour(
    lens: Prescription,
    wavelengths: Sequence[float],
    angle: float,
    object_distance: float = math.inf,
    image_distance: float | None = None,
) -> np.ndarray:
    """Chief-ray heights minus that at the design wavelength, on one image plane.

    The object point is the same for all: its angle is that of the paraxial chief ray at the design
    wavelength.

    wavelengths: m;
    angle: of the field, rad;
    object_distance: m before the first vertex;
    image_distance: m from the last vertex, None: that of image_plane.

    Returns (wavelength,) m.
    """
    heights = []
    for w in (lens.design_wavelength, *wavelengths):
        heights.append(
            chief_height(
                lens,
                w,
                _same_point(lens, w, angle, object_distance),
                object_distance,
                image_distance,
            )
        )
    return np.array(heights[1:]) - heights[0]


def _same_point(
    lens: Prescription, wavelength: float, angle: float, object_distance: float
) -> float:
    """The field angle at `wavelength` of the object point that has `angle` at the design
    wavelength: for a near object it changes with the entrance pupil's place.
    """
    if math.isinf(object_distance) or angle == 0:
        return angle
    here, there = (
        object_distance + entrance_pupil(lens, w).position
        for w in (lens.design_wavelength, wavelength)
    )
    return math.atan(math.tan(angle) * here / there)


def distortion(
    lens: Prescription,
    wavelength: float,
    angle: float,
    object_distance: float = math.inf,
    image_distance: float | None = None,
) -> float:
    """Relative excess of the chief ray's height over the paraxial one, (h - h_p)/h_p; h_p = f
    tan(angle) in the rear focal plane. Positive: pincushion.

    wavelength: m;
    angle: of the field, rad;
    object_distance: m before the first vertex;
    image_distance: m from the last vertex, None: that of image_plane.

    Raises NumericsError on the axis.
    """
    pupil = exit_pupil(lens, wavelength)
    entrance = entrance_pupil(lens, wavelength)
    distance = image_plane(lens, object_distance) if image_distance is None else image_distance
    ray = paraxial_matrix(lens.surfaces, wavelength) @ np.array(
        [-entrance.position * math.tan(angle), math.tan(angle)]
    )
    ideal = ray[0] + distance * ray[1] / _last_index(lens, wavelength)
    if ideal == 0 or not math.isfinite(pupil.magnification):
        raise NumericsError("distortion is defined off axis", "lens", "ask for a field above 0")
    return chief_height(lens, wavelength, angle, object_distance, distance) / ideal - 1


def transmitted(
    lens: Prescription,
    wavelength: float,
    angle: float,
    object_distance: float = math.inf,
    rings: int = 32,
) -> float:
    """Share of the stop's area through which light gets past every clear aperture, without cos^4.

    wavelength: m;
    angle: of the field, rad;
    object_distance: m before the first vertex;
    rings: of the rule by which the stop is sampled.

    Returns 0 to 1.
    """
    points, weights = disc_points(rings, 4 * rings)
    rays = trace(
        lens.surfaces,
        aim(lens, wavelength, points, angle=angle, object_distance=object_distance),
        wavelength,
        clip=True,
    )
    return float(weights[rays.alive].sum() / weights.sum())


def disc_points(rings: int, spokes: int) -> tuple[np.ndarray, np.ndarray]:
    """A rule for polynomials over the unit disc: Gauss-Legendre in rho^2 times equal angles.

    Returns points (2, n) and weights (n,).
    """
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    rho, theta = np.sqrt((nodes + 1) / 2), (np.arange(spokes) + 0.5) * (2 * math.pi / spokes)
    points = np.stack([np.outer(rho, np.cos(theta)).ravel(), np.outer(rho, np.sin(theta)).ravel()])
    return points, np.repeat(weights / 2 * math.pi / spokes, spokes)


# wavefront


@dataclass(frozen=True, kw_only=True)
class Wavefront:
    """The wavefront error of one field and wavelength on a sphere through the exit pupil's centre.

    points: (2, ray) x, y over the stop's radius;
    error: (ray,) W in m, optical path from the object to the sphere minus that of the chief ray;
        W > 0 is a later wave, a phase exp(+jkW); NaN where no light comes through;
    cosines: (2, ray) x, y of the unit vectors from the rays' places on the sphere to its centre;
        minus these, times the image distance, are pupil coordinates;
    centre: (3,) m, the chief ray's image, from the last vertex;
    radius: m, signed, positive where the exit pupil lies before the image.
    """

    points: np.ndarray
    error: np.ndarray
    cosines: np.ndarray
    centre: np.ndarray
    radius: float

    def rms(self, weights: np.ndarray | None = None) -> float:
        """Root mean square (m) of W about its mean over the points that light reaches.

        weights: (ray,) as of disc_points, None: all the same.
        """
        lit = np.isfinite(self.error)
        weights = None if weights is None else weights[lit]
        mean = np.average(self.error[lit], weights=weights)
        return float(np.sqrt(np.average((self.error[lit] - mean) ** 2, weights=weights)))


def wavefront(
    lens: Prescription,
    wavelength: float,
    points: np.ndarray,
    angle: float = 0.0,
    object_distance: float = math.inf,
    image_distance: float | None = None,
    clip: bool = True,
) -> Wavefront:
    """The Wavefront about the chief ray's own image on the image plane.

    Each wavelength has its own centre, so lateral colour is no part of W (see `lateral_colour`);
    the exit pupil is that of the design wavelength. Sphere and path in a form that does not cancel,
    valid for telecentric pupils too: with D the ray's direction, d its distance from the centre on
    the image plane and q = d^2 - (d.D)^2, the way back to the sphere is R + d.D -
    q/(R + sqrt(R^2 - q)).

    wavelength: m;
    points: (2, ray) of the stop, over its radius;
    angle: of the field, rad;
    object_distance: m before the first vertex;
    image_distance: m from the last vertex, None: that of image_plane;
    clip: whether light outside of clear apertures is lost.

    Raises NumericsError where the chief ray does not get through.
    """
    distance = image_plane(lens, object_distance) if image_distance is None else image_distance
    both = np.concatenate([_CENTRE, np.asarray(points, dtype=float)], axis=1)
    start = aim(lens, wavelength, both, angle=angle, object_distance=object_distance)
    n = _last_index(lens, wavelength)
    rays = to_plane(trace(lens.surfaces, start, wavelength), distance, n)
    if not rays.alive[0]:
        raise NumericsError(
            f"the chief ray at {math.degrees(angle):.4g} degrees does not get through",
            "lens",
            "use a smaller field",
        )
    centre = rays.position[:, :1]
    pupil = exit_pupil(lens, lens.design_wavelength).position
    gap = distance - pupil
    radius = (
        math.copysign(math.hypot(gap, float(centre[1, 0])), gap)
        if math.isfinite(pupil)
        else math.inf
    )
    error, cosines = _on_sphere(rays, centre, radius, n)
    error = error - error[0]
    if clip:
        error = np.where(trace(lens.surfaces, start, wavelength, clip=True).alive, error, np.nan)
    return Wavefront(
        points=both[:, 1:],
        error=error[1:],
        cosines=cosines[:, 1:] - cosines[:, :1],
        centre=np.array([*centre[:2, 0], distance]),
        radius=radius,
    )


def _on_sphere(
    rays: Rays, centre: np.ndarray, radius: float, n: float
) -> tuple[np.ndarray, np.ndarray]:
    """Paths (ray,) of rays in the image plane back to the sphere about `centre` (3, 1), less its
    radius, and x, y of the unit vectors (2, ray) from there to its centre.
    """
    offset = rays.position - centre
    along = (offset * rays.direction).sum(axis=0)
    square = (offset * offset).sum(axis=0) - along * along
    bent = (
        square / (radius + math.copysign(1.0, radius) * np.sqrt(radius * radius - square))
        if math.isfinite(radius)
        else 0.0
    )
    back = along - bent  # way back to the sphere, less its radius
    cosines = (
        rays.direction[:2]
        if math.isinf(radius)
        else ((radius + back) * rays.direction - offset)[:2] / radius
    )
    return rays.path - n * back, cosines


def noll_coefficients(
    lens: Prescription,
    wavelength: float,
    terms: int = 37,
    pupil: str = "stop",
    rings: int = 16,
    **field: Any,
) -> tuple[np.ndarray, float]:
    """Coefficients of Noll's Zernike polynomials in W.

    wavelength: m;
    terms: polynomials 1 ... `terms`;
    pupil: "stop" expands over the stop's coordinates, "exit" over direction cosines in image
        space, relative to the chief ray and in units of the largest; where the lens obeys the sine
        condition these are the same on axis;
    rings: of the rule by which the stop is sampled;
    field: as `wavefront`.

    Returns (terms,) m rms, and the rms (m) of what they leave.
    Raises NumericsError where too few rays get through.
    """
    points, weights = disc_points(rings, 4 * rings)
    if pupil == "exit":  # one more ring, the rim itself, to know the unit
        turn = np.arange(4 * rings) * (2 * math.pi / (4 * rings))
        points = np.concatenate([points, np.stack([np.cos(turn), np.sin(turn)])], axis=1)
    wave = wavefront(lens, wavelength, points, **field)
    at = wave.points
    if pupil == "exit":
        at = -wave.cosines / np.nanmax(np.hypot(*wave.cosines))
    count = weights.size
    good = np.isfinite(wave.error[:count])
    if good.sum() < 2 * terms:
        raise NumericsError(
            f"{int(good.sum())} rays get through, too few for {terms} Zernike terms",
            "lens",
            "ask for fewer terms or a smaller field",
        )
    root = np.sqrt(weights[good] / weights[good].sum())
    basis = np.stack(
        [zernike(j, at[1, :count][good], at[0, :count][good]) for j in range(1, terms + 1)], axis=1
    )
    values = wave.error[:count][good]
    found = np.linalg.lstsq(basis * root[:, None], values * root, rcond=None)[0]
    return found, float(np.sqrt(np.sum((root * (values - basis @ found)) ** 2)))


# in a camera

_STOP_STEPS = 20


@dataclass(frozen=True, kw_only=True)
class CameraLens:
    """A traced lens in the place of a camera's thin main lens, for one object distance and
    aperture.

    Its principal planes stand for the thin lens. It is stopped down until its rim is seen from the
    image on the axis as the thin lens's is, at the angle whose tangent is radius/z2.

    lens: stopped down;
    object_distance: m from the first vertex;
    z1: m from the object to the front principal plane;
    z2: m from the rear one to the image at the design wavelength;
    radius: of the thin lens's pupil, m.
    """

    lens: Prescription
    object_distance: float
    z1: float
    z2: float
    radius: float

    def focal_length(self, wavelength: float) -> float:
        """f1 (m) of the thin lens that focuses where this one does: 1/f1 = 1/z1 +
        1/(z2 + focal shift).

        wavelength: m.
        """
        shift = focal_shift(self.lens, [wavelength], self.object_distance)[0]
        return 1 / (1 / self.z1 + 1 / (self.z2 + shift))

    def pupil_places(
        self, cosines: np.ndarray, wavelength: float, slope: float = 0.0
    ) -> np.ndarray:
        """Where rays go through the thin lens's pupil: the points from which a lenslet sees them as
        far from its chief ray, in direction cosines and in units of the rim's on the axis.

        cosines: (2, ray) x, y beside the chief ray's, y towards the lenslet, as of a Wavefront;
        wavelength: m, whose rim is the pupil's;
        slope: of the lenslet's chief ray, tangent of the angle behind the rear principal point.

        Returns (2, ray) m, towards the lenslet and across.
        """
        upright = math.hypot(1, slope)
        scale = self.sine / _rim_sine(self.lens, wavelength, self.object_distance)
        across, along = cosines[0] * scale, slope / upright + cosines[1] * scale
        with np.errstate(invalid="ignore"):
            forward = np.sqrt(1 - along**2 - across**2)
        return self.z2 * np.stack([slope - along / forward, -across / forward])

    @property
    def sine(self) -> float:
        """Of the angle at which the rim comes to the image on the axis."""
        return self.radius / math.hypot(self.radius, self.z2)

    def aberrations(self, wavelength: float, order: int = 10) -> tuple[tuple[int, float], ...]:
        """Defocus and spherical terms of W on the axis about this wavelength's own paraxial image;
        the focal shift is in `focal_length`.

        wavelength: m;
        order: highest radial order.

        Returns ((Noll index, coefficient in m), ...).
        Raises NumericsError where rays at the rim do not get through.
        """
        radial = [n * (n + 1) // 2 + 1 for n in range(2, order + 1, 2)]
        points, weights = disc_points(32, 1)
        image = paraxial_image(self.lens, wavelength, self.object_distance)
        wave = wavefront(
            self.lens,
            wavelength,
            np.stack([np.zeros(32), np.hypot(*points)]),
            object_distance=self.object_distance,
            image_distance=image,
            clip=False,
        )
        rho = np.hypot(*self.pupil_places(wave.cosines, wavelength)) / self.radius
        if not np.isfinite(wave.error).all():
            raise _lost_rim()
        basis = np.stack([np.ones(32), *(zernike(j, rho, np.zeros(32)) for j in radial)], axis=1)
        root = np.sqrt(weights)
        found = np.linalg.lstsq(basis * root[:, None], wave.error * root, rcond=None)[0]
        return tuple((j, float(c)) for j, c in zip(radial, found[1:]))


def camera_lens(
    lens: Prescription, object_distance: float, aperture_diameter: float, design_wavelength: float
) -> CameraLens:
    """The CameraLens of a lens.

    object_distance: m before its front principal point;
    aperture_diameter: that it is stopped down to, m;
    design_wavelength: m.

    Raises ConfigError where the lens cannot be opened that far or forms no real image,
    NumericsError where rays at the rim do not get through.
    """
    lens = replace(lens, design_wavelength=design_wavelength)
    data = first_order(lens, design_wavelength)
    from_vertex = object_distance - data.front_principal
    image = paraxial_image(lens, design_wavelength, from_vertex)
    z2 = image - data.rear_principal
    if not (from_vertex > 0 and 0 < z2 < math.inf):
        raise ConfigError(
            (
                f"a lens of {data.focal_length * 1e3:.4g} mm forms no real image of an object "
                f"{object_distance * 1e3:.4g} mm away"
            ),
            "main_lens.prescription",
            "move the object away",
        )
    slope = data.entrance_pupil.radius / (from_vertex + data.entrance_pupil.position)
    widest = abs(slope) * object_distance * 2  # of the axial beam in the principal planes
    found = CameraLens(
        lens=lens,
        object_distance=from_vertex,
        z1=object_distance,
        z2=z2,
        radius=aperture_diameter / 2,
    )
    return _stopped(found, lens.stop_radius * aperture_diameter / widest)


def _stopped(inside: CameraLens, start: float) -> CameraLens:
    """The lens with its stop as wide as its pupil asks for, found from a radius `start` (m)."""
    lens, distance = inside.lens, inside.object_distance
    full = _rim_sine(lens, lens.design_wavelength, distance)
    if inside.sine > full * 1.0001:
        opens = 2 * inside.z2 * full / math.sqrt(1 - full * full)
        raise ConfigError(
            (
                f"the lens opens to {opens * 1e3:.5g} mm at most, not to "
                f"{2 * inside.radius * 1e3:.5g} mm"
            ),
            "main_lens.aperture_diameter",
            "stop it down",
        )
    radius = min(start, lens.stop_radius)
    for _ in range(_STOP_STEPS):
        lens = replace(lens, stop_radius=radius)
        ratio = inside.sine / _rim_sine(lens, lens.design_wavelength, distance)
        if not abs(ratio - 1) > 1e-12:
            break
        radius *= ratio
    if not math.isfinite(ratio):
        raise _lost_rim()
    return replace(inside, lens=lens)


@functools.lru_cache(maxsize=1024)
def _rim_sine(lens: Prescription, wavelength: float, object_distance: float) -> float:
    """Sine of the angle at which the ray through the stop's rim comes to the image on the axis,
    NaN where it does not.
    """
    wave = wavefront(
        lens,
        wavelength,
        np.array([[0.0], [1.0]]),
        object_distance=object_distance,
        image_distance=paraxial_image(lens, wavelength, object_distance),
        clip=False,
    )
    return float(np.hypot(*wave.cosines[:, 0]))


def _lost_rim() -> NumericsError:
    return NumericsError(
        "rays at the rim of the aperture do not get through the lens",
        "main_lens.prescription",
        "use a smaller aperture",
    )


# as one lenslet sees it: a is the pupil coordinate towards the lenslet and b the one across

Terms = tuple[tuple[int, float], ...]
"""(Noll index, coefficient in m) of each."""
Discs = tuple[tuple[float, float], ...]
"""(centre along a, radius) of each, m."""
OFF_AXIS_TERMS = 66
"""Noll terms, of which the cosine ones describe a traced wavefront off the axis."""


@functools.lru_cache(maxsize=1024)
def traced_lens(
    lens: Prescription,
    object_distance: float,
    aperture_diameter: float,
    design_wavelength: float,
    wavelength: float,
    nominal: float,
    slope: float,
) -> tuple[float, Terms, Discs]:
    """What a prescription is to a camera whose description gives it the focal length `nominal` (m).

    object_distance, aperture_diameter, design_wavelength: of the camera, m;
    wavelength: m;
    slope: of the lenslet's chief ray, tangent of the angle behind the rear principal point.

    Returns the focal length (m), Noll terms of the wavefront and the rims that cut the pupil.
    Raises ConfigError where `nominal` is not the prescription's, or the lens cannot be used so (see
    camera_lens), NumericsError where no light gets to the lenslet.
    """
    inside = camera_lens(lens, object_distance, aperture_diameter, design_wavelength)
    own = first_order(lens, design_wavelength).focal_length
    if abs(own / nominal - 1) > 0.02:
        raise ConfigError(
            (
                f"the lens file has a focal length of {own * 1e3:.5g} mm at "
                f"{design_wavelength * 1e9:.4g} nm, the camera says {nominal * 1e3:.5g} mm"
            ),
            "main_lens.focal_length",
            "write the lens's own, or scale the lens: plenocli lens import --focal-length",
        )
    focal_length = inside.focal_length(wavelength)
    terms, rims = _off_axis(inside, wavelength, slope)
    if slope == 0:
        terms = inside.aberrations(wavelength)
    return focal_length, terms, rims


def _off_axis(inside: CameraLens, wavelength: float, slope: float) -> tuple[Terms, Discs]:
    """(Noll terms, rims) of a traced lens off the axis; arguments as traced_lens, _field_angle."""
    points, weights = disc_points(24, 48)
    angle = _field_angle(inside, wavelength, slope)
    wave = wavefront(
        inside.lens,
        wavelength,
        points,
        angle,
        inside.object_distance,
        paraxial_image(inside.lens, wavelength, inside.object_distance),
        clip=False,
    )
    place, radius = inside.pupil_places(wave.cosines, wavelength, slope), inside.radius
    cosine = [j for j in range(2, OFF_AXIS_TERMS + 1) if noll_indices(j)[1] >= 0]
    lit = np.isfinite(wave.error)
    if lit.sum() < 4 * len(cosine):
        raise NumericsError(
            f"{int(lit.sum())} rays get through the lens {math.degrees(angle):.3g} degrees off the "
            "axis, too few to know its wavefront",
            "main_lens.prescription",
            "use a smaller array",
        )
    a, b = place[:, lit] / radius
    root = np.sqrt(weights[lit])
    basis = np.stack([np.ones(a.shape), *(zernike(j, b, a) for j in cosine)], axis=1)
    found = np.linalg.lstsq(basis * root[:, None], wave.error[lit] * root, rcond=1e-10)[0][1:]
    start = aim(
        inside.lens, wavelength, points, angle=angle, object_distance=inside.object_distance
    )
    rims = _rims(inside.lens, wavelength, start, points, place / radius, angle)
    terms = tuple((j, float(c)) for j, c in zip(cosine, found))
    return terms, tuple((centre * radius, size * radius) for centre, size in rims)


def _field_angle(inside: CameraLens, wavelength: float, slope: float) -> float:
    """The field angle (rad) whose chief ray meets the image plane where a straight line of that
    slope from the rear principal point does, distortion included.
    """
    lens = inside.lens
    before = inside.object_distance + entrance_pupil(lens, lens.design_wavelength).position
    tangent, height = slope * inside.z1 / before, slope * inside.z2
    image = paraxial_image(lens, lens.design_wavelength, inside.object_distance)
    for _ in range(8 if slope else 0):
        found = chief_height(lens, wavelength, math.atan(tangent), inside.object_distance, image)
        tangent *= height / found
        if abs(found / height - 1) < 1e-6:
            break
    return math.atan(tangent)


def _rims(
    lens: Prescription,
    wavelength: float,
    start: Rays,
    points: np.ndarray,
    place: np.ndarray,
    angle: float,
) -> list[tuple[float, float]]:
    """Discs (centre along a, radius) over the pupil's radius that the stop and the clear apertures
    leave open, those that cut nothing left out; NumericsError where they leave nothing.

    start: rays of a field;
    points: (2, ray) x, y where they meet the stop, over its radius;
    place: (2, ray) the same over the pupil's radius, along a and b;
    angle: of the field, rad.
    """
    squares = [(points**2).sum(axis=0)]
    for number, surface in enumerate(lens.surfaces):
        if math.isfinite(surface.semi_diameter):
            at = trace(lens.surfaces, start, wavelength, upto=number).position
            squares.append((at[0] ** 2 + at[1] ** 2) / surface.semi_diameter**2)
    if not (np.nan_to_num(squares, nan=2.0) <= 1).all(axis=0).any():
        raise NumericsError(
            f"the rims of the lens keep all light from a lenslet {math.degrees(angle):.3g} degrees "
            "off the axis",
            "main_lens.prescription",
            "use a smaller array, or mend the semi_diameters of the lens",
        )
    found = [_circle(square, place) for square in squares]
    return [disc for disc in found if disc and abs(disc[0]) + 1 > disc[1] + RIM]


def _circle(square: np.ndarray, place: np.ndarray) -> tuple[float, float] | None:
    """The disc (centre along a, radius) where `square` (ray,) is below 1, fitted where it is near
    to 1; None where it is nowhere.
    """
    near = np.isfinite(square) & np.isfinite(place[0]) & (np.abs(square - 1) < 0.3)
    if near.sum() < 12:
        return None
    a, b = place[:, near]
    basis = np.stack([a * a + b * b, a, np.ones(a.shape)], axis=1)
    curve, tilt, level = np.linalg.lstsq(basis, square[near], rcond=None)[0]
    centre = -tilt / (2 * curve)
    return float(centre), math.sqrt((1 - level) / curve + centre**2)
