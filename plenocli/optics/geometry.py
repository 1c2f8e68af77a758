"""First-order geometry of a plenoptic camera at one wavelength.

Planes: object --z1--> main lens (f1, diameter D1) --z2--> lenslet array (pitch D2, f2) --z3--> sensor.
Transverse coordinates are (row, column) = (y down, x right), in metres, the same sense in every plane.
"""

import math
from dataclasses import dataclass

from plenocli.errors import ConfigError
from plenocli.optics.glass import focal_length


@dataclass(frozen=True)
class Geometry:
    """Distances (m) and derived constants of a camera at `wavelength` (m); Berkner et al. 2013, section 2-3-1."""

    wavelength: float
    z1: float
    z2: float
    z3: float
    f1: float
    f2: float
    D1: float
    D2: float
    lenslet_width: float
    pixel_pitch: float
    pixel_active: float
    pixel_shape: tuple
    object_shape: tuple

    @property
    def k(self):
        """Wave number 2 pi / wavelength, 1/m."""
        return 2 * math.pi / self.wavelength

    @property
    def eps(self):
        """Defocus of the main lens at the array, 1/m: 1/z1 + 1/z2 - 1/f1; 0 when the object is imaged onto the array."""
        return 1 / self.z1 + 1 / self.z2 - 1 / self.f1

    @property
    def kappa(self):
        """Curvature left on a lenslet, 1/m: 1/z2 + 1/z3 - 1/f2; 0 when the lenslets image the pupil onto the sensor."""
        return 1 / self.z2 + 1 / self.z3 - 1 / self.f2

    @property
    def magnification(self):
        """Size of the image on the array over that of the object, z2/z1; the image is inverted."""
        return self.z2 / self.z1

    @property
    def superpixel_pitch(self):
        """Spacing of superpixel centres on the sensor, m: D2 (1 + z3/z2), because chief rays come from the pupil's centre."""
        return self.D2 * (1 + self.z3 / self.z2)

    @property
    def blur(self):
        """Width of the geometric blur of an object point on the array, m: D1 z2 |eps|."""
        return self.D1 * self.z2 * abs(self.eps)

    @property
    def diffraction_cells(self):
        """Lenslet pitch in units of wavelength times image-side F-number: the space-bandwidth number per axis."""
        return self.D2 * self.D1 / (self.wavelength * self.z2)

    @property
    def quartic_phase(self):
        """Phase (rad) that the paraxial model drops between a lenslet's edge and its axis on the sensor: k (D2/2)^4/(8 z3^3).
        Above about 0.1 rad the difference from exact propagation shows in the fringes."""
        return self.k * (self.D2 / 2)**4 / (8 * self.z3**3)

    def points(self, axis):
        """Centres (m, on the array) of the images of the object points along `axis` (0 rows, 1 columns)."""
        n = self.object_shape[axis]
        return _steps(n) * self.D2 / n

    def pixels(self, axis):
        """Pixel centres (m) along `axis` from the centre of a superpixel."""
        return _steps(self.pixel_shape[axis]) * self.pixel_pitch


def _steps(n):
    import numpy as np

    return np.arange(n) - (n - 1) / 2


def geometry(camera, wavelength):
    """The Geometry of `camera` (plenocli.config.Camera) at `wavelength` (m), with the focal lengths of its glasses there."""
    lens, array, sensor = camera.main_lens, camera.lenslet_array, camera.sensor
    if array.lattice != "square":
        raise ConfigError("the wave model knows square lattices only", "lenslet_array.lattice", 'use lattice = "square"')
    if array.aperture_shape == "hexagon" or lens.aperture_shape == "image" or lens.wavefront:
        raise ConfigError("hexagonal lenslets and pupils given as files are not computed yet", "camera", "use other shapes")
    design = camera.light.design_wavelength or wavelength
    return Geometry(
        wavelength=wavelength,
        z1=camera.object.distance,
        z2=array.distance,
        z3=sensor.distance,
        f1=focal_length(lens.focal_length, lens.glass, design, wavelength),
        f2=focal_length(array.focal_length, array.glass, design, wavelength),
        D1=lens.aperture_diameter,
        D2=array.pitch,
        lenslet_width=array.pitch * array.fill_factor,
        pixel_pitch=sensor.pixel_pitch,
        pixel_active=sensor.pixel_pitch * math.sqrt(sensor.pixel_fill_factor),
        pixel_shape=tuple(sensor.pixels_per_lenslet),
        object_shape=tuple(camera.object.samples_per_lenslet),
    )
