"""What lenslets see of lenses that come with optiland, against rays that optiland traces: its
surfaces, glasses and paths, one ray after another from the object point on. First order, spheres
and pupil coordinates are laid here anew; nothing of plenocli's tracer takes part.
"""

import math
import warnings

import numpy as np
import pytest
from scipy.optimize import brentq

from plenocli.files.config.prescription_file import import_lens
from plenocli.forward.camera.field import at_field
from plenocli.forward.camera.lens import chief_height, first_order, paraxial_image
from plenocli.forward.camera.pupil import aperture_picture
from plenocli.forward.camera.pupil import wavefront as of_pupil
from tests.forward.propagation.cameras import small_camera

AWAY = 10
"""The object's distance over the image's."""


class _Theirs:
    """A lens of optiland's (mm) and a point beside the axis at (0, height)."""

    def __init__(self, optic, f_number):
        self.surfaces = list(optic.surfaces)
        self.stop, self.last = optic.surfaces.stop_index, len(self.surfaces) - 2
        self.z = [float(np.ravel(s.geometry.cs.z)[0]) for s in self.surfaces]
        self.design, self.rims = float(optic.primary_wavelength), {}
        (a, _), (c, d) = self.paraxial(self.design)
        self.focal, self.rear, self.front = -1 / c, (1 - a) / c, (d - 1) / c
        self.z1, self.z2 = (self.focal * (1 + m) for m in (AWAY, 1 / AWAY))
        self.distance, self.radius = self.z1 - self.front, self.focal / f_number / 2
        (_, b), (_, d) = self.paraxial(self.design, self.stop)
        self.exit = -b / d
        # the ray that comes to the image on the axis as the thin lens's rim does, at the stop
        sine = self.radius / math.hypot(self.radius, self.z2)
        y = self.axial(lambda cosine, _: cosine - sine, self.design)
        self.stop_radius = self.wave(0, [0], [y], self.design, 0)[2][1, 0]

    def index(self, i, wavelength):
        return float(np.ravel(self.surfaces[i].material_post.n(wavelength))[0]) if i else 1.0

    def paraxial(self, wavelength, first=1):
        """(2, 2) matrix of (y, u), from the medium before a surface to behind the last."""
        matrix = np.eye(2)
        for i in range(first, self.last + 1):
            gap = self.z[i] - self.z[i - 1] if i > first else 0.0
            before, behind = self.index(i - 1, wavelength), self.index(i, wavelength)
            power = (behind - before) / float(np.ravel(self.surfaces[i].geometry.radius)[0])
            matrix = [[1, 0], [-power / behind, before / behind]] @ np.array(
                [[1, gap], [0, 1]]) @ matrix  # fmt: skip
        return matrix

    def image(self, wavelength):
        """mm from the last vertex."""
        (a, b), (c, d) = self.paraxial(wavelength)
        return -(a * self.distance + b) / (c * self.distance + d)

    def trace(self, height, x, y, wavelength):
        """Rays through (x, y) of the first vertex plane: places on the plane of the paraxial image,
        directions, paths, places at the stop, largest square over a rim's.
        """
        from optiland.rays import RealRays

        x, y = np.asarray(x, float), np.asarray(y, float)
        way = np.stack([x, y - height, 0 * x + self.distance])
        way /= np.linalg.norm(way, axis=0)
        rays = RealRays(0 * x, 0 * x + height, 0 * x - self.distance, *way, 0 * x + 1, wavelength)
        square = 0 * x
        for i in range(1, self.last + 1):
            self.surfaces[i].trace(rays)
            if i == self.stop:
                stop = np.stack([rays.x, rays.y])
            if i in self.rims:
                square = np.maximum(square, (rays.x**2 + rays.y**2) / self.rims[i] ** 2)
        t = (self.z[self.last] + self.image(wavelength) - rays.z) / rays.N
        direction = np.stack([rays.L, rays.M, rays.N])
        place = np.stack([rays.x, rays.y]) + t * direction[:2]
        return place, direction, np.asarray(rays.opd) + t, stop, square

    def wave(self, height, x, y, wavelength, chief):
        """Paths to the sphere about the chief ray's place, through the exit pupil's centre, less
        that ray's; direction cosines from there beside its own; places at the stop; squares.
        """
        place, direction, path, stop, square = self.trace(
            height, np.append(0, x), np.append(chief, y), wavelength
        )
        offset = place - place[:, :1]
        along = (offset * direction[:2]).sum(axis=0)
        aside = (offset**2).sum(axis=0) - along**2
        radius = math.hypot(self.image(self.design) - self.exit, place[1, 0])
        back = along - aside / (radius + np.sqrt(radius**2 - aside))
        cosines = ((radius + back) * direction[:2] - offset) / radius
        path = path - back
        return (path - path[0])[1:], (cosines - cosines[:, :1])[:, 1:], stop[:, 1:], square[1:]

    def axial(self, miss, wavelength):
        """Height (mm) at the first vertex at which `miss` (sine at the image, stop) is none."""
        guess = self.radius * self.distance / self.z1

        def of(y):
            _, cosines, stop, _ = self.wave(0, [0], [y], wavelength, 0)
            return miss(abs(cosines[1, 0]), abs(stop[1, 0]))

        return brentq(of, 0.7 * guess, 1.3 * guess, xtol=1e-13)

    def chief(self, height, wavelength):
        """Height (mm) at the first vertex plane of the ray through the stop's centre."""
        low, high = 0.0, -1e-3 * height
        miss = [self.trace(height, [0], [y], wavelength)[3][1, 0] for y in (low, high)]
        for _ in range(30):
            step = miss[1] * (high - low) / (miss[1] - miss[0])
            low, high = high, high - step
            miss = [miss[1], self.trace(height, [0], [high], wavelength)[3][1, 0]]
            if abs(miss[1]) < 1e-11:
                return high
        raise AssertionError("no ray through the stop's centre")

    def lenslet(self, slope, wavelength):
        """(object height, chief ray's height) of the point whose chief ray comes to slope * z2 on
        the image plane of the design wavelength.
        """
        if slope == 0:
            return 0.0, 0.0
        ahead = self.image(self.design) - self.image(wavelength)

        def miss(height):
            chief = self.chief(height, wavelength)
            place, direction, *_ = self.trace(height, [0], [chief], wavelength)
            return place[1, 0] + ahead * direction[1, 0] / direction[2, 0] - slope * self.z2

        height = brentq(miss, *(-slope * self.z1 * s for s in (0.7, 1.3)), xtol=1e-10)
        return height, self.chief(height, wavelength)

    def pupil(self, cosines, slope, wavelength):
        """Where rays go through the thin lens's pupil, over its radius: towards the lenslet and
        across. The rim on the axis is the pupil's at every wavelength.
        """
        y = self.axial(lambda _, stop: stop - self.stop_radius, wavelength)
        rim = abs(self.wave(0, [0], [y], wavelength, 0)[1][1, 0])
        across, along = cosines * self.radius / math.hypot(self.radius, self.z2) / rim
        along = along + slope / math.hypot(1, slope)
        steep = np.sqrt(1 - along**2 - across**2)
        return self.z2 / self.radius * np.stack([slope - along / steep, -across / steep])


@pytest.mark.parametrize(
    "name, f_number, degrees, waves",
    [
        ("DoubleGauss", 5.6, 7, 1e-6),
        ("TessarLens", 5, 20, 1e-5),
        ("Telephoto", 7, 8, 3e-5),
        ("PetzvalLens", 2, 5, 3e-4),
    ],
)
def test_lenslets_see_what_optiland_s_rays_say(tmp_path, name, f_number, degrees, waves):
    """Focal lengths and principal planes to rounding, W on the axis and off it at three
    wavelengths, and which rays get past rims of 1.15 times the beam on the axis at both ends.
    """
    pytest.importorskip("optiland", reason="needs the extra [lens]")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from optiland.fileio import save_optiland_file
        from optiland.physical_apertures import RadialAperture
        from optiland.samples import objectives

        optic = getattr(objectives, name)()
        theirs = _Theirs(optic, f_number)
        rim = theirs.axial(lambda _, stop: stop - theirs.stop_radius, theirs.design)
        sizes = {}
        for i in (1, theirs.last):
            theirs.rims = {i: 1.0}
            sizes[i] = 1.15 * math.sqrt(theirs.wave(0, [0], [rim], theirs.design, 0)[3][0])
            optic.surfaces[i].aperture = RadialAperture(sizes[i])
        theirs.rims = sizes
        save_optiland_file(optic, str(tmp_path / "lens.json"))
        lens, _ = import_lens(tmp_path / "lens.json")
        camera = small_camera(
            main_lens__focal_length=theirs.focal / 1e3,
            main_lens__aperture_diameter=2e-3 * theirs.radius,
            main_lens__prescription="lens.toml",
            object__distance=theirs.z1 / 1e3,
            lenslet_array__distance=theirs.z2 / 1e3,
            light__design_wavelength=theirs.design / 1e6,
        ).attach(prescription=lens)
        first = first_order(lens, theirs.design / 1e6)
        found = (first.focal_length, first.front_principal, first.rear_principal)
        expected = (theirs.focal, theirs.front, theirs.rear)
        assert np.multiply(found, 1e3) == pytest.approx(expected, rel=1e-12)
        for slope in (0.0, math.tan(math.radians(degrees))):
            for microns in (0.45, 0.55, 0.65):
                _compare(theirs, camera, slope, microns, waves)


@pytest.mark.parametrize(
    "name, degrees, low, high",
    [
        ("WideAngle170FOV", 80, -3.9, -3.7),
        ("WideAngle170FOV", 85, -6.22, -6.02),
        ("ProjectionLens160FOV", 49, -3.6, -2.9),
    ],
)
def test_chief_rays_of_very_wide_lenses_are_found(tmp_path, name, degrees, low, high):
    """From heights (mm) at the first vertex between which the one ray lies that gets through the
    stop's centre and the lens, at the wavelength of the F line.
    """
    pytest.importorskip("optiland", reason="needs the extra [lens]")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from optiland.fileio import save_optiland_file
        from optiland.rays import RealRays
        from optiland.samples import objectives

        optic = getattr(objectives, name)()
        save_optiland_file(optic, str(tmp_path / "lens.json"))
        lens, _ = import_lens(tmp_path / "lens.json")
        surfaces, plane = list(optic.surfaces), 1e3 * paraxial_image(lens, 486.1e-9)
        climb, ahead = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))

        def height(y, index):
            rays = RealRays(0.0, y - 5 * climb, -5 * ahead, 0.0, climb, ahead, 1.0, 0.4861)
            for surface in surfaces[1 : index + 1]:
                surface.trace(rays)
            return rays

        stop = optic.surfaces.stop_index
        y = brentq(lambda y: float(height(y, stop).y[0]), low, high, xtol=1e-13)
        last = height(y, len(surfaces) - 2)
        z = float(np.ravel(surfaces[-2].geometry.cs.z)[0]) + plane
        found = float((last.y + (z - last.z) / last.N * last.M)[0])
    angle = math.radians(degrees)
    seen = chief_height(lens, 486.1e-9, angle, image_distance=plane / 1e3)
    assert 1e3 * seen == pytest.approx(found, rel=1e-7)


def _compare(theirs, camera, slope, microns, waves):
    height, chief = theirs.lenslet(slope, microns)
    wide = 1.3 * theirs.radius * theirs.distance / theirs.z1
    grid = np.linspace(-wide, wide, 41)
    x, y = (v.ravel() for v in np.meshgrid(grid, chief + grid))
    path, cosines, stop, square = theirs.wave(height, x, y, microns, chief)
    along, across = place = theirs.pupil(cosines, slope, microns)
    seen = at_field(camera, microns / 1e6, (0.0, slope * theirs.z2 / 1e3)).main_lens
    z = theirs.image(microns) - theirs.rear
    assert seen.focal_length * 1e3 == pytest.approx(1 / (1 / theirs.z1 + 1 / z), rel=1e-9)
    y, x = across * theirs.radius / 1e3, along * theirs.radius / 1e3
    # rays that meet the far side of a strong surface come back to the stop by some other way
    through = (np.hypot(*stop) < theirs.stop_radius) & (np.hypot(*place) < 1) & (abs(path) < 0.1)
    W = of_pupil(seen, y, x)[through] - path[through] / 1e3
    assert np.std(W) < waves * microns / 1e6, (slope, microns)
    assert np.std(path[through]) > 1e3 * waves * microns / 1e3
    lit = through & (square < 1)
    wrong = lit != (aperture_picture(seen, y, x) > 0)
    assert wrong[np.hypot(*place) < 1].sum() < 0.006 * through.sum()
    assert slope == 0 or lit.sum() < 0.9 * through.sum()
