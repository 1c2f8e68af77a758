"""First-order geometry of a plenoptic camera at one wavelength.

Planes: object --z1--> main lens (f1, diameter D1) --z2--> lenslet array (pitch D2, f2) --z3-->
sensor. Transverse coordinates are (row, column) = (y down, x right), in metres, the same
sense in every plane.

Lenslets are numbered (r, c). On a square lattice lenslet (r, c) stands at y = r p, x = c p (p the
pitch). On a hexagonal one (close-packed rows along x, two flat sides of each cell facing +-x,
corners up and down) these are axial coordinates: y = r p sqrt(3)/2, x = (c + r/2) p. The object's
field of one lenslet is the rectangle (row spacing) x p around its centre, which tiles either
lattice; on the hexagonal one its corners stick out of the hexagon into the next cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from plenocli.base.errors import ConfigError
from plenocli.forward.camera.field import at_field
from plenocli.forward.camera.pupil import aperture_area, ray_reach
from plenocli.forward.camera.sections.lenslet_array import ROW_SPACING

if TYPE_CHECKING:
    import numpy as np

    from plenocli.forward.camera.model import Camera
    from plenocli.forward.camera.sections.lenslet_array import LensletArray
    from plenocli.forward.camera.sections.main_lens import MainLens


TILED = 1e-4
"""Relative difference up to which a superpixel's pitch is a whole number of pixels."""


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """Distances (m) and derived constants of a camera at one wavelength.

    wavelength: m;
    z1, z2, z3: from object to main lens, to lenslet array, to sensor;
    f1, f2: focal lengths of main lens and lenslets;
    D1, D2: diameter of the main lens, pitch of the lenslets;
    lenslet_width: of a lenslet's opening across its flat sides;
    pixel_pitch, pixel_active: spacing of pixels, and side of what of them is sensitive;
    pixel_shape: (rows, columns) of the pixels of a superpixel;
    object_shape: (rows, columns) of the object points of a lenslet;
    lattice: "square" or "hexagonal";
    lenslet_shape: "square", "circle" or "hexagon";
    pixel_shift: None where the pixels of every superpixel are centred on its chief ray, else where
        the sensor's raster lies: (rows, columns) in pixels from a superpixel's centre to the
        middle of its window;
    ray_reach: farthest that a ray of an aberrated pupil lands on the array from the image point
        along either axis, None without wavefront error;
    chief: where the object's own lenslet stands from the optical axis, (rows, columns) m on the
        array;
    borders: how far (rows, columns; m) from a superpixel's centre its light ends, None where its
        pixels say so (`parted`).

    Berkner et al. 2013, section 2-3-1.
    """

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
    pixel_shape: tuple[int, int]
    object_shape: tuple[int, int]
    lattice: str = "square"
    lenslet_shape: str = "square"
    pixel_shift: tuple[float, float] | None = None
    ray_reach: float | None = None
    chief: tuple[float, float] = (0.0, 0.0)
    borders: tuple[float, float] | None = None

    @property
    def k(self) -> float:
        """Wave number 2 pi / wavelength, 1/m."""
        return 2 * math.pi / self.wavelength

    @property
    def eps(self) -> float:
        """Defocus of the main lens at the array, 1/m: 1/z1 + 1/z2 - 1/f1; 0 when the object is
        imaged onto the array.
        """
        return 1 / self.z1 + 1 / self.z2 - 1 / self.f1

    @property
    def kappa(self) -> float:
        """Curvature left on a lenslet, 1/m: 1/z2 + 1/z3 - 1/f2; 0 when the lenslets image the
        pupil onto the sensor.
        """
        return 1 / self.z2 + 1 / self.z3 - 1 / self.f2

    @property
    def magnification(self) -> float:
        """Size of the image on the array over that of the object, z2/z1; the image is inverted."""
        return self.z2 / self.z1

    @property
    def obliquity(self) -> float:
        """Angle (rad) at which the chief ray comes to the object's own lenslet."""
        return math.atan(math.hypot(*self.chief) / self.z2)

    @property
    def superpixel_pitch(self) -> float:
        """Spacing of superpixel centres on the sensor, m: D2 (1 + z3/z2), because chief rays
        come from the pupil's centre.
        """
        return self.D2 * (1 + self.z3 / self.z2)

    @property
    def blur(self) -> float:
        """Width of the geometric blur of an object point on the array, m: D1 z2 |eps|; with
        wavefront error twice the reach of its rays z2 (eps r + grad W).
        """
        return self.D1 * self.z2 * abs(self.eps) if self.ray_reach is None else 2 * self.ray_reach

    @property
    def opening_area(self) -> float:
        """Of a lenslet's opening, m^2."""
        share = {"square": 1.0, "circle": math.pi / 4, "hexagon": math.sqrt(3) / 2}
        return share[self.lenslet_shape] * self.lenslet_width**2

    @property
    def row_spacing(self) -> float:
        """Distance of neighbouring rows of lenslets, in pitches."""
        return ROW_SPACING if self.lattice == "hexagonal" else 1.0

    @property
    def lenslet_extent(self) -> tuple[float, float]:
        """Half height and half width (m) of one lenslet's opening."""
        half = self.lenslet_width / 2
        return (half / ROW_SPACING if self.lenslet_shape == "hexagon" else half), half

    @property
    def diffraction_cells(self) -> float:
        """Lenslet pitch in units of wavelength times image-side F-number: the
        space-bandwidth number per axis.
        """
        return self.D2 * self.D1 / (self.wavelength * self.z2)

    @property
    def quartic_phase(self) -> float:
        """Phase (rad) that the paraxial model drops between a lenslet's edge and its axis on the
        sensor: k (D2/2)^4/(8 z3^3). Above about 0.1 rad the difference from exact propagation
        shows in the fringes.
        """
        return self.k * (self.D2 / 2) ** 4 / (8 * self.z3**3)

    def points(self, axis: int) -> np.ndarray:
        """Centres of the images of the object points along `axis` (0 rows, 1 columns).

        Returns (point,) m, on the array.
        """
        n = self.object_shape[axis]
        return _steps(n) * self.D2 * (1.0 if axis else self.row_spacing) / n

    def pixels(self, axis: int) -> np.ndarray:
        """Pixel centres along `axis` (0 rows, 1 columns).

        Returns (pixel,) m from the middle of a superpixel's window.
        """
        return _steps(self.pixel_shape[axis]) * self.pixel_pitch

    def centre(self, r: int, c: int) -> tuple[float, float]:
        """Where lenslet (r, c) stands, in pitches: (row, column); on the sensor its superpixel
        does, in superpixel pitches.
        """
        return (r * ROW_SPACING, c + r / 2) if self.lattice == "hexagonal" else (float(r), float(c))

    def neighbourhood(self, window: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Lenslets up to `window` pitches away in rows and columns, mirror-symmetric.

        Returns products [(row positions, column positions)], in pitches. Square: one product,
        |r|, |c| <= window. Hexagonal: even rows and, half a pitch aside, odd rows.
        """
        import numpy as np

        if self.lattice == "square":
            far = np.arange(-window, window + 1.0)
            return [(far, far)]
        rows = np.arange(-hexagonal_rows(window), hexagonal_rows(window) + 1)
        odd = np.arange(-window - 0.5, window + 1)
        return [
            (rows[rows % 2 == 0] * ROW_SPACING, np.arange(-window, window + 1.0)),
            (rows[rows % 2 == 1] * ROW_SPACING, odd),
        ]

    def places(self, grid: tuple[int, int]) -> dict[tuple[float, float], tuple[int, int]]:
        """Where superpixels stand.

        grid: (rows, columns) of axial numbers, both odd.

        Returns {place in pitches: (row, column) in the grid}.
        """
        rows, columns = ((n - 1) // 2 for n in grid)
        return {
            self.centre(r, c): (r + rows, c + columns)
            for r in range(-rows, rows + 1)
            for c in range(-columns, columns + 1)
        }

    def lines(self, grid: tuple[int, int], axis: int) -> int:
        """How many different rows (axis 0) or columns (1) the superpixels of `grid` stand in."""
        aside = axis == 1 and self.lattice == "hexagonal" and grid[0] > 1  # every half pitch
        return 2 * grid[1] + grid[0] - 2 if aside else grid[axis]

    def reach(self, grid: tuple[int, int], window: int | None = None) -> tuple[float, ...]:
        """Farthest that a lenslet whose light counts stands from the object's own.

        grid: (rows, columns) of the superpixels kept;
        window: of the neighbourhood, whose lenslets count; None: those of the superpixels kept.

        Returns (rows, columns) in pitches.
        """
        if window is None:
            rows, columns = ((n - 1) // 2 for n in grid)
            return tuple(float(n) for n in self.centre(rows, columns))
        return tuple(
            max(
                float(product[axis].max())
                for product in self.neighbourhood(window)
                if product[axis].size
            )
            for axis in (0, 1)
        )

    def field_half(self, grid: tuple[int, int], window: int | None = None) -> float:
        """Half width (m) on which the main lens's spread function is needed: from an object point
        to a lenslet's far edge.

        grid, window: as in reach.
        """
        cell = self.row_spacing / 2, 0.5
        return max(
            (far + c) * self.D2 + e
            for far, c, e in zip(self.reach(grid, window), cell, self.lenslet_extent)
        )

    def parted(self, grid: tuple[int, int]) -> Geometry:
        """This geometry for superpixels of which each counts its own light only: where windows of
        neighbours overlap, they end at the border between the two superpixels.

        grid: (rows, columns) of the superpixels kept.
        """
        spacing = self.superpixel_pitch * self.row_spacing, self.superpixel_pitch
        borders = [
            half / 2 if n > 1 and count * self.pixel_pitch > half * (1 + 1e-9) else math.inf
            for half, n, count in zip(spacing, grid, self.pixel_shape)
        ]
        return self if min(borders) == math.inf else replace(self, borders=(borders[0], borders[1]))

    def pixel_spans(self, axis: int, n: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Where the sensitive parts of pixels begin and end, within a superpixel's borders.

        axis: 0 rows, 1 columns;
        n: where the superpixel stands along the axis, in superpixel pitches.

        Returns (low, high) (pixel,) m from the superpixel's centre; both are the border for pixels
        beyond it.
        """
        import numpy as np

        middle, half = self.pixels(axis) + self.window_shift(axis, n), self.pixel_active / 2
        border = math.inf if self.borders is None else self.borders[axis]
        return np.clip(middle - half, -border, border), np.clip(middle + half, -border, border)

    def window_shift(self, axis: int, n: float = 0.0) -> float:
        """From the centre of a superpixel to the middle of its window.

        axis: 0 rows, 1 columns;
        n: where the superpixel stands along the axis, in superpixel pitches.

        Returns m: zero where windows are centred on chief rays, on a sensor's raster at most half a
        pixel (and by how far superpixels of whole pixels are off that).
        """
        if self.pixel_shift is None:
            return 0.0
        steps, shift = n * self.superpixel_pitch / self.pixel_pitch, self.pixel_shift[axis]
        window, whole = round(steps - shift), round(steps)
        if abs(steps - whole) <= TILED * abs(whole):
            window = whole + round(-shift)  # all windows lie alike, at half a pixel, too
        return (window - (steps - shift)) * self.pixel_pitch

    def mirrors(self, grid: tuple[int, int]) -> tuple[bool, bool, bool]:
        """Which mirror images map lattice, lenslets and pixels of superpixels onto themselves.

        grid: (rows, columns) of the superpixels.

        Returns (flip rows, flip columns, transpose).
        """
        shift = self.pixel_shift or (0.0, 0.0)
        # a rhombus of axial coordinates is no mirror image of itself
        flips = self.lattice == "square" or tuple(grid) == (1, 1)
        turn = self.lattice == "square" and self.lenslet_shape != "hexagon" and shift[0] == shift[1]
        return flips and shift[0] == 0, flips and shift[1] == 0, turn


def _steps(n: int) -> np.ndarray:
    import numpy as np

    return np.arange(n) - (n - 1) / 2


def hexagonal_rows(window: int) -> int:
    """Rows of a hexagonal lattice, to either side, that cover `window` and a half pitches."""
    return math.ceil((window + 0.5 - ROW_SPACING / 3) / ROW_SPACING) if window else 0


def point_etendue(camera: Camera) -> float:
    """Etendue between one object point and the clear pupil, m^2 sr: light of radiance L sends L
    times that through the main lens.

    A point stands for its share of one lenslet's field; from it a circular pupil of area S at the
    distance z fills pi sin^2 = S/(z^2 + S/pi), which counts for pupils of other shapes too.
    docs/model.md, "From radiance to electrons".
    """
    array, z = camera.lenslet_array, camera.object.distance
    field = array.row_spacing * (array.pitch * z / array.distance) ** 2
    area = aperture_area(camera.main_lens)
    return field / math.prod(camera.object.samples_per_lenslet) * area / (z**2 + area / math.pi)


def geometry(
    camera: Camera,
    wavelength: float,
    pixel_shift: tuple[float, float] | None = None,
    chief: tuple[float, float] = (0.0, 0.0),
) -> Geometry:
    """The Geometry of a camera, with the focal lengths of its glasses at one wavelength.

    wavelength: m;
    pixel_shift: (rows, columns) as lenslet_shift gives it, for pixels on the sensor's own raster;
        None: centred on chief rays;
    chief: (rows, columns) m from the optical axis to the object's own lenslet, as chief_ray gives
        it.
    """
    camera = at_field(camera, wavelength, chief)
    lens, array, sensor = camera.main_lens, camera.lenslet_array, camera.sensor
    design = camera.light.design_wavelength or wavelength
    f1, z1, z2 = (
        _focal_length(lens, design, wavelength),
        camera.object.distance,
        array.distance,
    )
    return Geometry(
        wavelength=wavelength,
        z1=z1,
        z2=z2,
        z3=sensor.distance,
        f1=f1,
        f2=_focal_length(array, design, wavelength),
        D1=lens.aperture_diameter,
        D2=array.pitch,
        lenslet_width=array.pitch * array.fill_factor,
        pixel_pitch=sensor.pixel_pitch,
        pixel_active=sensor.pixel_pitch * math.sqrt(sensor.pixel_fill_factor),
        pixel_shape=sensor.pixels_per_lenslet,
        object_shape=camera.object.samples_per_lenslet,
        lattice=array.lattice,
        lenslet_shape=array.aperture_shape,
        pixel_shift=pixel_shift,
        ray_reach=ray_reach(lens, 1 / z1 + 1 / z2 - 1 / f1, z2),
        chief=chief,
    )


def _focal_length(lens: MainLens | LensletArray, design: float, wavelength: float) -> float:
    """Focal length (m) of the lens as a thin one of its glass."""
    if lens.glass.lower() == "none":
        return lens.focal_length
    from plenocli.forward.camera.glass import focal_length

    return focal_length(lens.focal_length, lens.glass, design, wavelength)


def array_position(camera: Camera, row: int, column: int) -> tuple[float, float]:
    """Where a lenslet of the array stands from the optical axis.

    row, column: counted from the array's first lenslet.

    Returns (y, x) in pitches. The axis meets the middle of a square array. Rows of a hexagonal one
    are upright, every odd one half a pitch to the right; the axis meets lenslet (rows // 2, columns
    // 2).
    Raises ConfigError outside of the array.
    """
    array = camera.lenslet_array
    if not all(0 <= n < count for n, count in zip((row, column), array.count)):
        raise ConfigError(
            f"there is no lenslet ({row}, {column})",
            "lenslet_array.count",
            f"it has {array.count[0]} x {array.count[1]}, counted from 0",
        )
    if array.lattice == "square":
        return row - (array.count[0] - 1) / 2, column - (array.count[1] - 1) / 2
    middle = array.count[0] // 2
    return (row - middle) * ROW_SPACING, column - array.count[1] // 2 + (row % 2 - middle % 2) / 2


def chief_ray(camera: Camera, row: int, column: int) -> tuple[float, float]:
    """Where the chief ray of a lenslet of the array meets it.

    row, column: counted from the array's first lenslet.

    Returns (rows, columns) m from the optical axis. Raises ConfigError outside of the array.
    """
    y, x = array_position(camera, row, column)
    return y * camera.lenslet_array.pitch, x * camera.lenslet_array.pitch


def corner_ray(camera: Camera) -> tuple[float, float]:
    """As chief_ray, of the lenslet that stands farthest from the axis."""
    rows, columns = (n - 1 for n in camera.lenslet_array.count)
    corners = [chief_ray(camera, r, c) for r in {0, rows} for c in {0, columns}]
    return max(corners, key=lambda at: (math.hypot(*at), at))


def lenslet_shift(camera: Camera, row: int, column: int) -> tuple[int, int, tuple[float, float]]:
    """The window of a lenslet of the array on the sensor's raster.

    row, column: counted from the array's first lenslet.

    Returns (first pixel row, first pixel column, pixel_shift). The raster is centred on the optical
    axis and holds pixels_per_lenslet times count pixels; the window, as many pixels as a
    superpixel, may reach beyond it. pixel_shift (rows, columns), at most half a pixel: from the
    superpixel's centre, where the chief ray lands, to the middle of the window. In the paraxial
    model an off-axis lenslet differs from the central one by this shift alone: where it is zero, A
    serves unchanged. What the angle changes beside is docs/model.md, "Exact propagation".
    Raises ConfigError outside of the array.
    """
    sensor, first, shift = camera.sensor, [], []
    for n, count, size in zip(
        array_position(camera, row, column), camera.lenslet_array.count, sensor.pixels_per_lenslet
    ):
        ideal = n * camera.superpixel_pitch / sensor.pixel_pitch + (count * size - size) / 2
        nearest = math.floor(ideal + 0.5)
        first.append(nearest)
        # a billionth of a pixel is rounding
        shift.append(0.0 if abs(nearest - ideal) < 1e-9 else nearest - ideal)
    return first[0], first[1], (shift[0], shift[1])


def finely_sampled(camera: Camera, wavelength: float) -> Camera:
    """The camera with as many object points behind a lenslet as its field has diffraction cells:
    fewer leave fringes that an even object has not.

    wavelength: m.
    """
    least = math.ceil(geometry(camera, wavelength).diffraction_cells) + 1
    samples = tuple(max(n, least) for n in camera.object.samples_per_lenslet)
    return camera.replace(**{"object.samples_per_lenslet": samples})
