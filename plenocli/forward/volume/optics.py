"""What the light of a point at some depth meets on its way to the pixels, of a microscope and of a
photographic camera alike.

Positions on the lenslet array are divided by the magnification, so that a point's image stands
where the point does; directions are those before the objective, s = n sin t. Depth z is measured
from the plane that is focused on the array, away from the objective. docs/model.md, "Volumes".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from plenocli.forward.camera.quadrature import gauss
from plenocli.forward.camera.sections.lenslet_array import ROW_SPACING

PUPIL_TERMS = 1e-7
"""Share of the largest angular harmonic of a pupil below which others are left out."""
AZIMUTHS = 64
"""Angles at which a pupil that is not round in phase is sampled."""


@dataclass(frozen=True, kw_only=True)
class Term:
    """One Zernike term of the pupil's phase: Noll's number, metres of path."""

    noll: int
    coefficient: float


@dataclass(frozen=True, kw_only=True)
class VolumeOptics:
    """Objective, lenslets and pixels, at one wavelength or over a band of them.

    wavelength: m, in vacuum.
    band: wavelengths of a broad light, m, each of the same strength; empty for the one alone.
    aperture: largest direction s of the light that is used.
    index: refractive index of the specimen; infinite paraxially, where depth bends phases by s^2/2.
    magnification: from the specimen to the lenslet array.
    pitch, open_width: of lenslets, m, the latter across flat sides.
    lattice: "square" or "hexagonal", with close-packed rows along x.
    opening: of lenslets, "square", "circle" or "hexagon", with two flat sides facing +-x.
    focal_length: of lenslets, m.
    sensor_distance: from lenslets to pixels, m.
    pupil_distance: from the exit pupil to lenslets, m; infinite where chief rays are parallel.
    pixels: (rows, columns) of a superpixel, which is as high as rows of lenslets are apart.
    pixel_width: share of the pixel pitch that senses light, along an axis.
    depths: (plane,) m, effective: phases are k depth (sqrt(index^2 - s^2) - index).
    places: (plane,) m as they are named: the depths, or distances from a main lens.
    scales: (plane,) size of a lenslet's image there over that in the focused plane.
    apodised: whether the amplitude rises as a lens with Abbe's sine condition makes it.
    rings: intensity over the pupil at equal steps of s from its middle to its edge, relative; empty
        where it follows `apodised`.
    mismatch: (design index, depth in m at which the specimen's index takes over) of the objective.
    terms: of the pupil's phase.
    """

    wavelength: float
    aperture: float
    index: float
    magnification: float
    pitch: float
    open_width: float
    focal_length: float
    sensor_distance: float
    pupil_distance: float
    pixels: tuple[int, int]
    pixel_width: float
    depths: tuple[float, ...]
    places: tuple[float, ...]
    scales: tuple[float, ...]
    apodised: bool
    rings: tuple[float, ...] = ()
    mismatch: tuple[float, float] | None = None
    band: tuple[float, ...] = ()
    terms: tuple[Term, ...] = ()
    lattice: str = "square"
    opening: str = "square"

    @property
    def lines(self) -> tuple[VolumeOptics, ...]:
        """The same at each wavelength of the band."""
        if not self.band:
            return (self,)
        return tuple(replace(self, wavelength=wavelength, band=()) for wavelength in self.band)

    @property
    def k(self) -> float:
        """Wave number in vacuum, 1/m."""
        return 2 * math.pi / self.wavelength

    @property
    def widening(self) -> float:
        """Spacing of superpixels over that of lenslets: 1 + d/z2."""
        return 1 + self.sensor_distance / self.pupil_distance

    @property
    def object_pitch(self) -> float:
        """Of the lenslets' images in the focused plane, m."""
        return self.pitch / self.magnification

    @property
    def resolved(self) -> float:
        """Finest period that the pupil lets through in the focused plane, m."""
        return self.wavelength / (2 * self.aperture)

    @property
    def row_spacing(self) -> float:
        """Of lenslets, pitches."""
        return ROW_SPACING if self.lattice == "hexagonal" else 1.0

    @property
    def sites(self) -> tuple[tuple[float, float], ...]:
        """Lenslets of one cell, the part of the array that repeats along rows and columns: (row,
        column) from its middle, pitches. Two rows of a hexagonal lattice make one of cells.
        """
        if self.lattice == "square":
            return ((0.0, 0.0),)
        return ((-ROW_SPACING / 2, -0.25), (ROW_SPACING / 2, 0.25))

    @property
    def cell_pixels(self) -> tuple[int, int]:
        """Pixels (rows, columns) of a cell: those of its lenslets, one below the other."""
        return len(self.sites) * self.pixels[0], self.pixels[1]

    @property
    def object_cell(self) -> tuple[float, float]:
        """Height and width (m) of a cell's image in the focused plane."""
        return len(self.sites) * self.row_spacing * self.object_pitch, self.object_pitch

    @property
    def separable(self) -> bool:
        """Whether lenslets do the same to all rows of a field: squares on a square lattice."""
        return (self.lattice, self.opening) == ("square", "square")

    @property
    def turnable(self) -> bool:
        """Whether rows and columns of the array may change places."""
        square = self.lattice == "square" and self.opening != "hexagon"
        return square and self.pixels[0] == self.pixels[1]

    @property
    def gapless(self) -> bool:
        """Whether all light on the array enters lenslets."""
        fills = {"square": "square", "hexagonal": "hexagon"}[self.lattice]
        return self.opening == fills and self.open_width == self.pitch

    @property
    def round(self) -> bool:
        """Whether the field of a point depends on the distance from its image alone."""
        from plenocli.forward.camera.sections.main_lens import noll_indices

        return all(noll_indices(term.noll)[1] == 0 for term in self.terms)

    def path(self, s: np.ndarray, depth: float) -> np.ndarray:
        """Path (m) by which light in directions s is ahead of that along the axis, for a point at
        `depth`; any shape.
        """
        if math.isinf(self.index):
            return -depth * s**2 / 2
        # a difference of nearly equal roots, without the loss of digits
        path = -depth * s**2 / (np.sqrt(self.index**2 - s**2) + self.index)
        if self.mismatch is not None:
            design, below = self.mismatch
            specimen = -(s**2) / (np.sqrt(self.index**2 - s**2) + self.index)
            path = path + below * (specimen + s**2 / (np.sqrt(design**2 - s**2) + design))
        return path

    def amplitude(self, s: np.ndarray) -> np.ndarray:
        """Amplitude over the pupil before it is normalised, any shape."""
        if self.rings:
            radii = np.linspace(0, self.aperture, len(self.rings))
            return np.sqrt(np.interp(s, radii, self.rings))
        if not self.apodised:
            return np.ones_like(s)
        design = self.index if self.mismatch is None else self.mismatch[0]
        return (1 - (s / design) ** 2) ** -0.25

    def nodes(self, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Directions s and weights ds over the pupil's radius that resolve the field of all planes.

        reach: largest distance (m) from the image at which the field is asked for.
        """
        edge = np.array([self.aperture])
        turns = self.k * self.aperture * reach
        turns += self.k * max(abs(float(self.path(edge, z)[0])) for z in self.depths)
        turns += sum(self.k * abs(term.coefficient) * 8 for term in self.terms)
        count = int(turns / 2) + 40 + 4 * len(self.rings)
        # nodes in the angle, which spreads them where aplanatic amplitudes grow
        top = 1.0 if math.isinf(self.index) else self.index
        high = math.asin(min(self.aperture / top, 1.0))
        x, w = gauss(count)
        angle = (x + 1) * high / 2
        return top * np.sin(angle), w * high / 2 * top * np.cos(angle)

    def pupil(self, s: np.ndarray, depth: float) -> dict[int, np.ndarray]:
        """Angular harmonics of the pupil's wave for a point at `depth`: m -> P_m(s), with
        P(s, theta) = sum_m P_m(s) exp(i m theta). Not normalised.
        """
        wave = self.amplitude(s) * np.exp(1j * self.k * self.path(s, depth))
        if not self.terms:
            return {0: wave}
        from plenocli.forward.camera.pupil import zernike

        theta = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
        rho = s[:, None] / self.aperture
        y, x = rho * np.sin(theta), rho * np.cos(theta)
        bent = sum(term.coefficient * zernike(term.noll, y, x) for term in self.terms)
        found = np.fft.fft(np.exp(1j * self.k * bent), axis=1) / AZIMUTHS
        peak = np.abs(found).max()
        return {
            (m if m < AZIMUTHS // 2 else m - AZIMUTHS): wave * found[:, m]
            for m in range(AZIMUTHS)
            if np.abs(found[:, m]).max() > PUPIL_TERMS * peak
        }

    def norm(self, s: np.ndarray, weight: np.ndarray) -> float:
        """Light through the pupil: integral of |P|^2 over it."""
        return float(2 * np.pi * np.sum(weight * s * self.amplitude(s) ** 2))

    def pixel_nodes(self, count: int, axis: int) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (pixel, node) from a superpixel's middle, m, and weights of one pixel.

        count: of nodes a pixel; axis: 0 rows, 1 columns.
        """
        size = self.pitch * self.widening / self.pixels[axis]
        size *= self.row_spacing if axis == 0 else 1.0
        centre = (np.arange(self.pixels[axis]) - (self.pixels[axis] - 1) / 2) * size
        x, w = gauss(count)
        half = size * self.pixel_width / 2
        return centre[:, None] + half * x, half * w
