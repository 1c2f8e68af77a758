"""A lens as its maker describes it: surfaces in order of the light, plain data in SI units.

The axis is z, light runs towards +z, the first surface's vertex is the origin. A surface is the
conic of curvature c and conic constant k plus an even polynomial,

    z(r) = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + a_1 r^2 + a_2 r^4 + ...,

c > 0 where its centre lies behind it (Welford 1986, chapter 4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from plenocli.forward.camera.glass import AIR, Medium


@dataclass(frozen=True, kw_only=True)
class Surface:
    """One refracting surface and the space behind it.

    curvature: 1/m, 0 for a plane;
    thickness: m along the axis to the next surface, for the last one to the image plane;
    medium: what lies behind;
    conic: k (0 sphere, -1 paraboloid);
    asphere: (a_1, a_2, ...), a_i in m^(1 - 2i);
    semi_diameter: m, rays that meet the surface further out are lost.
    """

    curvature: float = 0.0
    thickness: float = 0.0
    medium: Medium = AIR
    conic: float = 0.0
    asphere: tuple[float, ...] = ()
    semi_diameter: float = math.inf

    @property
    def vertex_curvature(self) -> float:
        """Curvature (1/m) at the vertex, where the r^2 term counts: what paraxial rays see."""
        return self.curvature + (2 * self.asphere[0] if self.asphere else 0.0)

    def scaled(self, factor: float) -> Surface:
        """The same surface with every length multiplied by `factor`."""
        asphere = tuple(a * factor ** (1 - 2 * i) for i, a in enumerate(self.asphere, 1))
        return replace(
            self,
            curvature=self.curvature / factor,
            thickness=self.thickness * factor,
            asphere=asphere,
            semi_diameter=self.semi_diameter * factor,
        )


@dataclass(frozen=True, kw_only=True)
class Prescription:
    """A rotationally symmetric lens in air: its surfaces, which of them is the stop, and how far
    the stop is open.

    surfaces: in order of the light;
    stop: index into `surfaces`;
    stop_radius: m;
    design_wavelength: m, at which pupils, image plane and reference sphere are laid;
    object_distance: m from the first vertex, the conjugate for which it was made; infinite for a
        camera lens;
    name: for people.
    """

    surfaces: tuple[Surface, ...]
    stop: int
    stop_radius: float
    design_wavelength: float = 587.5618e-9
    object_distance: float = math.inf
    name: str = ""

    def scaled(self, factor: float) -> Prescription:
        """The same lens with every length but the wavelength multiplied by `factor`."""
        return replace(
            self,
            surfaces=tuple(s.scaled(factor) for s in self.surfaces),
            stop_radius=self.stop_radius * factor,
            object_distance=self.object_distance * factor,
        )

    def reversed(self) -> Prescription:
        """The lens turned round: the light meets its last surface first.

        The image distance is left open (0).
        """
        media = [AIR] + [s.medium for s in self.surfaces]
        gaps = [s.thickness for s in self.surfaces[:-1]]
        turned = [
            replace(
                s,
                curvature=-s.curvature,
                asphere=tuple(-a for a in s.asphere),
                medium=media[i],
                thickness=gaps[i - 1] if i else 0.0,
            )
            for i, s in enumerate(self.surfaces)
        ]
        return replace(self, surfaces=tuple(turned[::-1]), stop=len(turned) - 1 - self.stop)

    @property
    def image_distance(self) -> float:
        """Distance (m) from the last vertex to the image plane as the description gives it; 0
        where it leaves it open.
        """
        return self.surfaces[-1].thickness
