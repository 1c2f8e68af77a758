"""What the light behind one lenslet depends on, in numbers without a unit of length where there is
one: lengths on the array count in lenslet pitches, so that nothing but phases depends on a camera.

With x, p on the array in pitches D2, v on the sensor and (eta, xi) in the pupil, the phases in
turns are

    pupil     -beta (eta d_y + xi d_x),  d = x - p,   beta = D2/(lambda z2)
    defocus   delta (eta^2 + xi^2)/2,                 delta = eps/lambda
    wavefront W0/lambda + sum_j omega_j Z_j,          omega_j = c_j/lambda
    lenslet   mu x^2/2 - nu x v,                      mu = kappa D2^2/lambda, nu = D2/(lambda z3)

and the field has the amplitude beta nu over the root of the aperture's area. docs/model.md, "From
a point to the lenslet array" and "From the array to the sensor".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import UsageError
from plenocli.forward.camera.glass import focal_length
from plenocli.forward.camera.pupil import unit_radius

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera

PUPIL, DEFOCUS, WAVES, CURVATURE, RELAY, DOWN, RIGHT = range(7)
"""Places in a vector of optics: beta, delta, 1/lambda, mu, nu, the shift of the pixels along rows
and columns (m); omega_j follow, in the order of the Zernike terms.
"""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One thing about a camera that a fit may change.

    name: as a person says it;
    unit: of `tolerance`, "m", or "px" of the sensor;
    tolerance: standard deviation of what is believed of it before the fit;
    key: dotted key of the camera, or "" for a shift or a Zernike term;
    noll: index of the Zernike term, 0 for another parameter.
    """

    name: str
    unit: str
    tolerance: float
    key: str = ""
    noll: int = 0


ZERNIKES = {
    5: ("astigmatism, oblique", 0.1),
    6: ("astigmatism, vertical", 0.1),
    7: ("coma, vertical", 0.1),
    8: ("coma, horizontal", 0.1),
    11: ("spherical aberration", 0.05),
}
"""Noll index -> (name, tolerance in waves) of the terms that are fitted."""


def all_parameters(camera: Camera) -> tuple[Parameter, ...]:
    """The parameters that a fit knows, with tolerances of a camera put together with care.

    camera: as described.
    """
    array, sensor = camera.lenslet_array, camera.sensor
    wavelength = camera.light.wavelengths[0]
    by_key = [
        ("focus", "object.distance", 0.02 * camera.object.distance),
        ("pitch", "lenslet_array.pitch", 0.002 * array.pitch),
        ("sensor distance", "sensor.distance", 0.005 * sensor.distance),
        ("lenslet focal length", "lenslet_array.focal_length", 0.005 * array.focal_length),
        ("wavelength", "light.wavelengths", 10e-9),
    ]
    return (
        *(Parameter(name=n, unit="m", tolerance=t, key=k) for n, k, t in by_key),
        Parameter(name="shift, rows", unit="px", tolerance=0.3),
        Parameter(name="shift, columns", unit="px", tolerance=0.3),
        *(
            Parameter(name=name, unit="m", tolerance=waves * wavelength, noll=noll)
            for noll, (name, waves) in ZERNIKES.items()
        ),
    )


def parameters_without(camera: Camera, fixed: Sequence[str]) -> tuple[Parameter, ...]:
    """The parameters of a fit without those that stay as described.

    fixed: their names.

    Raises UsageError for a name that there is not, or where none is left.
    """
    known = all_parameters(camera)
    unknown = sorted(set(fixed) - {p.name for p in known})
    if unknown:
        raise UsageError(
            f"there is no parameter {unknown[0]!r}",
            "--fix",
            f"known: {', '.join(repr(p.name) for p in known)}",
        )
    left = tuple(p for p in known if p.name not in fixed)
    if not left:
        raise UsageError("nothing is left to fit", "--fix", "leave some out")
    return left


class CameraFamily:
    """Cameras around a described one, by the values of parameters.

    camera: as described;
    geometry: its Geometry;
    parameters: that may change;
    start: (parameter,) their values as described;
    tolerance: (parameter,) of what is believed of them.
    """

    def __init__(
        self, camera: Camera, geometry: Geometry, parameters: tuple[Parameter, ...]
    ) -> None:
        self.camera, self.geometry, self.parameters = camera, geometry, parameters
        self.nolls = tuple(p.noll for p in parameters if p.noll)
        self.start = np.array([self._described(p) for p in parameters])
        self.tolerance = np.array([p.tolerance for p in parameters])
        self._place = {p.name: i for i, p in enumerate(parameters)}

    def _described(self, parameter: Parameter) -> float:
        if parameter.noll:
            return sum(
                a.coefficient for a in self.camera.main_lens.aberrations if a.noll == parameter.noll
            )
        if parameter.name.startswith("shift"):
            axis = 0 if parameter.name.endswith("rows") else 1
            return (self.geometry.pixel_shift or (0.0, 0.0))[axis]
        if parameter.key == "light.wavelengths":
            return self.geometry.wavelength
        section, key = parameter.key.split(".")
        return float(getattr(getattr(self.camera, section), key))

    def value(self, values: np.ndarray, name: str, otherwise: float) -> float:
        """The value of the parameter `name` in `values` (parameter,), or what is described."""
        return float(values[self._place[name]]) if name in self._place else otherwise

    def has(self, name: str) -> bool:
        """Whether the parameter `name` may change."""
        return name in self._place

    def place(self, name: str) -> int:
        """Where the parameter `name` stands among the parameters."""
        return self._place[name]

    def geometry_at(self, values: np.ndarray) -> Geometry:
        """The Geometry with the parameters at `values` (parameter,); ray_reach as described."""
        g, camera = self.geometry, self.camera
        lens, array = camera.main_lens, camera.lenslet_array
        wavelength = self.value(values, "wavelength", g.wavelength)
        design = camera.light.design_wavelength
        pitch = self.value(values, "pitch", g.D2)
        shift = g.pixel_shift or (0.0, 0.0)
        return replace(
            g,
            wavelength=wavelength,
            z1=self.value(values, "focus", g.z1),
            z3=self.value(values, "sensor distance", g.z3),
            f1=focal_length(lens.focal_length, lens.glass, design, wavelength),
            f2=focal_length(
                self.value(values, "lenslet focal length", array.focal_length),
                array.glass,
                design,
                wavelength,
            ),
            D2=pitch,
            lenslet_width=g.lenslet_width / g.D2 * pitch,
            pixel_shift=(
                self.value(values, "shift, rows", shift[0]),
                self.value(values, "shift, columns", shift[1]),
            ),
        )

    def optics(self, values: np.ndarray) -> np.ndarray:
        """The vector of optics at `values` (parameter,)."""
        g = self.geometry_at(values)
        shift = g.pixel_shift or (0.0, 0.0)
        terms = [v for v, p in zip(values, self.parameters) if p.noll]
        per = 1 / g.wavelength
        return np.array(
            [
                g.D2 * per / g.z2,
                g.eps * per,
                per,
                g.kappa * g.D2**2 * per,
                g.D2 * per / g.z3,
                shift[0] * g.pixel_pitch,
                shift[1] * g.pixel_pitch,
                *(c * per for c in terms),
            ]
        )

    def jacobian(self, values: np.ndarray) -> np.ndarray:
        """Derivatives of the optics (optics, parameter), by central differences of closed forms."""
        steps = 1e-4 * self.tolerance
        columns = []
        for i, step in enumerate(steps):
            ahead, behind = values.copy(), values.copy()
            ahead[i] += step
            behind[i] -= step
            columns.append((self.optics(ahead) - self.optics(behind)) / (2 * step))
        return np.array(columns).T

    def camera_at(self, values: np.ndarray) -> Camera:
        """The Camera with the parameters at `values` (parameter,), its shift apart; ConfigError
        where it cannot be.
        """
        changes: dict[str, object] = {
            p.key: (float(v),) if p.key == "light.wavelengths" else float(v)
            for p, v in zip(self.parameters, values)
            if p.key
        }
        if self.nolls:
            others = [
                {"noll": a.noll, "coefficient": a.coefficient}
                for a in self.camera.main_lens.aberrations
                if a.noll not in self.nolls
            ]
            fitted = [
                {"noll": p.noll, "coefficient": float(v)}
                for p, v in zip(self.parameters, values)
                if p.noll
            ]
            changes["main_lens.aberrations"] = tuple(others + fitted)
        return self.camera.replace(**changes)

    def mirrored(self, values: np.ndarray) -> np.ndarray | None:
        """The values (parameter,) of the camera that makes the same captures of objects that are
        turned by 180 degrees in every lenslet: defocus, curvature and all aberrations change sign.
        None where the parameters cannot express it.
        """
        if {"focus", "lenslet focal length"} - set(self._place):
            return None
        g, out = self.geometry_at(values), values.copy()
        out[self._place["focus"]] = self._in_focus_by(g, -g.eps)
        relay = 1 / g.z2 + 1 / g.z3
        f2 = 1 / (2 * relay - 1 / g.f2)
        place = self._place["lenslet focal length"]
        out[place] = values[place] * f2 / g.f2
        for i, parameter in enumerate(self.parameters):
            if parameter.noll:
                out[i] = -values[i]
        return out

    def half_mirrored(self, values: np.ndarray) -> list[np.ndarray]:
        """The values (parameter,) of cameras that are mirrored along rows or columns alone, so that
        they blur as much both ways: defocus and vertical astigmatism have changed places, with
        either sign. Empty where the parameters cannot express it.
        """
        name = ZERNIKES[6][0]
        if not (self.has("focus") and self.has(name)):
            return []
        g, place, found = self.geometry_at(values), self._place[name], []
        # the wavefront is eps r^2/2 + c sqrt(6) cos(2 phi) r^2/R^2
        per = 2 * np.sqrt(6) / unit_radius(self.camera.main_lens) ** 2
        for side in (1, -1):
            out = values.copy()
            out[place] = side * g.eps / per
            out[self._place["focus"]] = self._in_focus_by(g, side * values[place] * per)
            found.append(out)
        return found

    def _in_focus_by(self, g: Geometry, eps: float) -> float:
        """The distance z1 at which objects have a defocus eps, 1/m."""
        return 1 / (eps + 1 / g.f1 - 1 / g.z2)


def require_fittable(camera: Camera) -> None:
    """UsageError where a fit of this kind of camera is not offered."""
    array, lens = camera.lenslet_array, camera.main_lens
    trouble = None
    if array.lattice != "square" or array.aperture_shape != "square":
        trouble = "its lenslets are not square"
    elif lens.prescription is not None:
        trouble = "its main lens is a prescription"
    elif lens.field:
        trouble = "its main lens changes over the field"
    elif len(camera.light.wavelengths) > 1 or camera.light.band is not None:
        trouble = "it has more than one wavelength"
    if trouble:
        raise UsageError(
            f"a camera cannot be fitted where {trouble}",
            "camera",
            "fit a camera of square lenslets in light of one wavelength",
        )
