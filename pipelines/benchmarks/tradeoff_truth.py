"""The cameras of the measured trade of accuracy against time, and three of their columns by brute
force, kept as files.

The columns are those of the points at the corner, at the middle of an edge and at the centre of a
lenslet. Paraxial sums take every pixel of up to sixteen superpixels. Exact ones, in which every
node of the lenslets sends its wave to every node of the sensor (summed as matrix products,
rayleigh.rayleigh_products), take as many pixels of the own superpixel, spread over it, as they can
afford. Nothing here shares code with plenocli.forward.
"""

import hashlib
import json
import math
import sys
from functools import cached_property
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from plenocli.files.config.camera_file import load_camera, to_toml  # noqa: E402
from tests.reference import rayleigh  # noqa: E402
from tests.reference.fresnel import sensor_nodes  # noqa: E402
from tests.reference.window import _Rule, energies  # noqa: E402

WAVES, FLOPS = 6e8, 2e10
"""Values of the exact kernel (as summed by rayleigh.rayleigh_products), and operations in products,
a second of one core: to say beforehand how long the sums take.
"""
AFFORDED = 5e9, 4e10
"""Values of the exact kernel that a camera's columns may take: of isolated lenslets, and with
neighbours (for each row of superpixels that the light is spread over).
"""
FEW, MANY = 12, 100
"""Pixels that an exact column is compared on at the least: where its light stays in one
superpixel, and where it is spread over several.
"""
FINE = 3e-7
"""Accuracy of paraxial columns from which on fringes of lenslets far apart count."""
SMALL = {"object.samples_per_lenslet": (16, 16)}
CAMERAS = {
    "seed_spatial": ("seed_spatial", {}),
    "f/2.2": (
        "seed_spatial_250um",
        SMALL
        | {
            "main_lens.aperture_diameter": 50e-3,
            "lenslet_array.focal_length": 0.55e-3,
            "sensor.distance": 0.55e-3,
            "lenslet_array.pitch": 249.6e-6 / (1 + 0.55 / 110),
        },
    ),
    "f/4.4": ("seed_spatial_250um", {}),
    "f/22": (
        "seed_spatial_250um",
        SMALL
        | {
            "main_lens.aperture_diameter": 5e-3,
            "lenslet_array.focal_length": 5.5e-3,
            "sensor.distance": 5.5e-3,
            "lenslet_array.pitch": 249.6e-6 / (1 + 5.5 / 110),
        },
    ),
    "400 nm": (
        "seed_spatial_250um",
        SMALL | {"light.wavelengths": (400e-9,), "light.design_wavelength": 400e-9},
    ),
    "10 um LWIR": (
        "seed_spatial_250um",
        SMALL | {"light.wavelengths": (10e-6,), "light.design_wavelength": 10e-6},
    ),
    "3-pixel lenslets": (
        "seed_spatial_250um",
        SMALL
        | {
            "lenslet_array.pitch": 14.4e-6 / (1 + 63.36e-6 / 110e-3),
            "lenslet_array.focal_length": 63.36e-6,
            "sensor.distance": 63.36e-6,
            "sensor.pixels_per_lenslet": (3, 3),
        },
    ),
    "20 um pixels": (
        "seed_spatial_250um",
        SMALL | {"sensor.pixel_pitch": 20.8e-6, "sensor.pixels_per_lenslet": (12, 12)},
    ),
    "defocus 1 pitch": ("seed_spatial", SMALL | {"blur": 1}),
    "defocus 5 pitches": (
        "seed_spatial",
        SMALL | {"blur": 5, "object.samples_per_lenslet": (10, 10)},
    ),
}
"""Name: (sample configuration, keys changed to SI values; `blur` is the geometric blur
in lenslet pitches).
"""


def camera_of(name):
    """The camera of a row of the table."""
    sample, changes = CAMERAS[name]
    camera, changes = load_camera(ROOT / "sample_configs" / f"{sample}.toml"), dict(changes)
    blur = changes.pop("blur", None)
    if blur:
        lens, array = camera.main_lens, camera.lenslet_array
        eps = blur * array.pitch / (lens.aperture_diameter * array.distance)
        changes["object.distance"] = 1 / (1 / lens.focal_length - 1 / array.distance + eps)
    return camera.replace(**changes)


def places(camera):
    """Flat indices of the points compared: corner, middle, centre."""
    rows, columns = camera.object.samples_per_lenslet
    return [0, int(rows * 0.08) * columns + int(columns * 0.43), rows // 2 * columns + columns // 2]


def cells(camera):
    """Diffraction cells of a lenslet: its pitch over wavelength times F-number."""
    return (
        camera.lenslet_array.pitch
        * camera.main_lens.aperture_diameter
        / (camera.light.wavelengths[0] * camera.lenslet_array.distance)
    )


def blur(camera):
    """Geometric blur of a point in lenslet pitches."""
    defocus = abs(
        1 / camera.object.distance
        + 1 / camera.lenslet_array.distance
        - 1 / camera.main_lens.focal_length
    )
    return (
        defocus
        * camera.main_lens.aperture_diameter
        * camera.lenslet_array.distance
        / camera.lenslet_array.pitch
    )


def wide_window(camera, fine=False):
    """Lenslets either side of the object's own that count as all there are: what is beyond
    changes columns by about 1e-6, or by less if `fine`.
    """
    count = cells(camera)
    return (
        math.ceil(blur(camera) / 2)
        + (3 if count > 150 else 4 if count > 110 else 6 if count > 60 else 10)
        + 2 * fine
    )


class Truth:
    """Columns by brute force of one camera: `columns()` and `change()`, how far they are from those
    with every lenslet there is.

    model: fresnel or exact;
    window: lenslets either side whose fields add, or None for isolated lenslets;
    superpixels: list of (row, column), of which the exact model has those that the
        geometric blur lights;
    folder: where results are kept, by `key`;
    fine: every fringe is resolved, as accuracies below FINE need.
    """

    def __init__(self, camera, model, window, superpixels, folder, fine=False):
        self.camera, self.model, self.window, self.folder, self.fine = (
            camera,
            model,
            window,
            folder,
            fine,
        )
        # superpixels either side of the own one that are lit, and among the given ones
        self.spread = (
            0
            if window is None
            else min(round(blur(camera) / 2), max(abs(n) for place in superpixels for n in place))
        )
        side = range(-self.spread, self.spread + 1)
        self.lit = [(r, c) for r in side for c in side]
        self.superpixels = self.lit if model == "exact" else self._compared(superpixels)
        self.counts = self._counts()
        parts = [to_toml(camera), model, window, self.superpixels, 3 if window is None else 4, fine]
        if model == "exact":
            # which pixels of many superpixels these are follows from the paraxial columns
            parts.append(
                self.counts if self.spread else [chosen.tolist() for chosen in self.pixels[0]]
            )
        self.key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:20]

    def pick(self, blocks, reach):
        """What of a matrix's columns, (point, superpixel, pixel) with superpixels `reach`, is
        compared: (point, number).
        """
        blocks = np.stack([blocks[:, reach.index(place)] for place in self.superpixels], axis=1)
        if self.model == "exact":
            (rows, columns), roots = self.pixels
            blocks = self._patch(blocks)[:, rows][:, :, columns] * roots
        return blocks.reshape(len(blocks), -1)

    def _compared(self, superpixels):
        """Those of a matrix's superpixels that paraxial columns are compared on."""
        return _some(superpixels, 200 if self.fine else cells(self.camera))

    @property
    def path(self):
        return self.folder / f"{self.key}.npz"

    def affordable(self):
        """Whether at least a few pixels can be summed."""
        return self.model == "fresnel" or math.prod(self.counts) >= min(
            FEW if self.spread == 0 else MANY, math.prod(self.camera.sensor.pixels_per_lenslet)
        )

    def seconds(self):
        """Seconds of one core that `columns` and `change` will take, 0 for kept ones."""
        if self.path.exists():
            return 0.0
        if self.model == "exact":
            return (
                5
                + self._values_per_pixel() * math.prod(self.counts) / WAVES
                + sum(other.seconds() for other in self._others())
            )
        camera, reach = self.camera, {place[0] for place in self.superpixels}
        rule = _Rule(
            camera,
            camera.light.wavelengths[0],
            self.window,
            self.superpixels,
            self._pixel_nodes(),
            1.0,
        )
        lines, lit = (
            camera.sensor.pixels_per_lenslet[0] * self._pixel_nodes(),
            1 if self.window is None else 2 * self.window + 1,
        )
        lenslet = rule.count(
            rule.half
            * rule.k
            * ((2 * (self.window or 0) + 1) * rule.D2 / rule.z3 + rule.radius / rule.z2)
        )
        products = (
            8
            * lines
            * rule.pupil
            * (len(reach) * (lit * lenslet + 3 * rule.pupil) + 3 * len(self.superpixels) * lines)
        )
        return 1 + products / FLOPS + sum(other.seconds() for other in self._others())

    def columns(self):
        """(point, number): energies in the order of `pick`."""
        if not self.path.exists():
            found = self._exact() if self.model == "exact" else self._fresnel()
            self.folder.mkdir(parents=True, exist_ok=True)
            np.savez(self.path, columns=found, change=self._measured_change(found))
        with np.load(self.path) as kept:
            return kept["columns"].reshape(3, -1)

    def change(self):
        """Relative change of the worst column when the window grows."""
        self.columns()
        with np.load(self.path) as kept:
            return float(kept["change"])

    def _measured_change(self, found):
        if self.window is None:
            return 0.0
        # the exact sum affords few lenslets: what those further out do is taken from
        # the paraxial model
        near, *far = (truth.columns() for truth in self._others())
        far = far[0] if far else found[:, self.superpixels.index((0, 0))].reshape(3, -1)
        return _change(far, near)

    def _others(self):
        """The same with fewer lenslets, on the own superpixel (for the exact model on all that are
        lit, and with all lenslets): the difference is the change.
        """
        if self.window is None:
            return []
        if self.model == "exact":
            return [
                Plain(self.camera, "fresnel", window, self.lit, self.folder)
                for window in (self.window, wide_window(self.camera))
            ]
        return [Plain(self.camera, "fresnel", self.window - 2, [(0, 0)], self.folder, self.fine)]

    def _pixel_nodes(self):
        """Nodes per pixel for fringes from opposite ends of the coherent window (or of one
        lenslet), to 1e-10; where lenslets hold many diffraction cells, of lenslets up to five
        apart: those further apart make too little of them (1e-7 of a column; from three apart less
        than 1e-5, which does for the few accuracies that exact sums of many cells
        are affordable at).
        """
        camera, sensor = self.camera, self.camera.sensor
        cell = (
            camera.lenslet_array.pitch
            * sensor.pixel_pitch
            / (camera.light.wavelengths[0] * sensor.distance)
        )
        if self.window is None:
            return math.ceil(1.7 * cell + 9)
        across = 2 * self.window + 1
        most = (
            across
            if self.fine or cells(camera) < 15
            else 3
            if self.model == "exact" and cells(camera) > 50
            else 5
        )
        return math.ceil(1.7 * cell * min(across, most) + 5)

    def _image_points(self):
        rows, columns = self.camera.object.samples_per_lenslet
        pitch = self.camera.lenslet_array.pitch
        return [
            (
                (q // columns - (rows - 1) / 2) * pitch / rows,
                (q % columns - (columns - 1) / 2) * pitch / columns,
            )
            for q in places(self.camera)
        ]

    # paraxial

    def _fresnel(self):
        found = energies(
            self.camera,
            self.camera.light.wavelengths[0],
            self._image_points(),
            self.window,
            self.superpixels,
            pixel_nodes=self._pixel_nodes(),
        )
        return np.array([[blocks[place] for place in self.superpixels] for blocks in found])

    # exact

    def _counts(self):
        """How many rows and columns of pixels exact columns are compared on."""
        if self.model != "exact":
            return None
        side, across = 2 * self.spread + 1, self.camera.sensor.pixels_per_lenslet[1]
        lines = 2 * side if self.spread else 3
        return lines, min(
            across, int(AFFORDED[self.window is not None] * side / self._values_per_pixel() / lines)
        )

    @cached_property
    def pixels(self):
        """((rows, columns) of the pixels that exact columns are compared on, counted over the
        superpixels that are lit; roots of their weights (row, column), which make sums over them
        those over all pixels).

        Evenly in one superpixel; of several, each lit on a small part, more often where there is
        light by the paraxial model.
        """
        side = 2 * self.spread + 1
        sizes = [n * side for n in self.camera.sensor.pixels_per_lenslet]
        if not self.spread:
            return [
                _evenly(np.ones(size), count, start)
                for size, count, start in zip(sizes, self.counts, (0.1, 0.5))
            ], 1.0
        paraxial = Plain(self.camera, "fresnel", wide_window(self.camera), self.lit, self.folder)
        power = self._patch(paraxial.columns().reshape(3, len(self.lit), -1)) ** 2
        power = (power / power.sum(axis=(1, 2), keepdims=True)).mean(axis=0)
        often = [0.8 * power.sum(axis=1 - axis) + 0.2 / size for axis, size in enumerate(sizes)]
        chosen = [_evenly(share, count, 0.5) for share, count in zip(often, self.counts)]
        return chosen, np.sqrt(1 / np.outer(often[0][chosen[0]], often[1][chosen[1]]))

    def _patch(self, blocks):
        """Superpixels (point, superpixel in the order of `lit`, pixel) side by side: (point,
        pixel row, pixel column).
        """
        (rows, columns), side = self.camera.sensor.pixels_per_lenslet, 2 * self.spread + 1
        return (
            blocks.reshape(-1, side, side, rows, columns)
            .transpose(0, 1, 3, 2, 4)
            .reshape(-1, side * rows, side * columns)
        )

    @property
    def far(self):
        """Lenslets either side of the middle one whose fields are summed exactly: the window of
        every superpixel that is lit.
        """
        return (self.window or 0) + self.spread

    def _values_per_pixel(self):
        """Values of the kernel that one pixel takes, all lenslets together."""
        far = self.far
        own = [len(self._lenslet_nodes(m)[0]) for m in range(-far, far + 1)]
        return self._pixel_nodes() ** 2 * sum(own) ** 2

    def _lenslet_nodes(self, m):
        """Positions from the middle of the lenslet m off the axis, and weights, that resolve
        lens, pupil and way to the superpixel.
        """
        camera, array = self.camera, self.camera.lenslet_array
        half, reach = (
            array.pitch * array.fill_factor / 2,
            (self.spread + 0.5) * camera.sensor.pixel_pitch * max(camera.sensor.pixels_per_lenslet),
        )
        edge = np.linspace(-half, half, 41)
        d = edge - np.array([[-reach], [reach]]) + m * array.pitch
        bend = (
            edge / array.focal_length
            if array.profile == "parabolic"
            else edge / np.hypot(edge, array.focal_length)
        )
        ways = np.abs(d / np.hypot(d, camera.sensor.distance) - bend).max()
        k = 2 * np.pi / camera.light.wavelengths[0]
        return rayleigh.nodes(
            -half,
            half,
            k * (1.1 * ways + camera.main_lens.aperture_diameter / (2 * array.distance)),
        )

    def _exact(self):
        camera, array, sensor = self.camera, self.camera.lenslet_array, self.camera.sensor
        k, nodes = 2 * np.pi / camera.light.wavelengths[0], self._pixel_nodes()
        pitch = array.pitch * (1 + sensor.distance / array.distance)
        patch = [
            sensor_nodes(
                (s * pitch, s * pitch),
                sensor.pixels_per_lenslet,
                sensor.pixel_pitch,
                sensor.pixel_pitch * math.sqrt(sensor.pixel_fill_factor),
                nodes,
            )
            for s in range(-self.spread, self.spread + 1)
        ]
        # of each axis, nodes and weights of all superpixels in a row; of these the chosen pixels
        (v, wv), (u, wu) = (
            [
                np.concatenate([one[axis][i] for one in patch]).reshape(-1, nodes)[chosen].ravel()
                for i in (0, 1)
            ]
            for axis, chosen in enumerate(self.pixels[0])
        )
        far, total = self.far, 0
        wave = rayleigh.main_lens_field(camera, (far + 1.5) * array.pitch)
        for row in range(-far, far + 1):
            for column in range(-far, far + 1):
                (y, wy), (x, wx) = self._lenslet_nodes(row), self._lenslet_nodes(column)
                lens = (
                    rayleigh.lens_phase(array.profile, array.focal_length, y, x, k)
                    * wy[:, None]
                    * wx
                )
                y, x = y + row * array.pitch, x + column * array.pitch
                fields = np.array([wave(point, y, x) for point in self._image_points()])
                # rows of pixels by themselves: the shorter the intervals, the fewer products
                sums = [
                    rayleigh.rayleigh_products(fields * lens, y, x, line, u, sensor.distance, k)
                    for line in np.split(v, self.counts[0])
                ]
                total = total + np.concatenate(sums, axis=1)
        energy = np.abs(total) ** 2 * wv[:, None] * wu
        return (
            energy.reshape(3, self.counts[0], nodes, self.counts[1], nodes).sum(axis=(2, 4))
            * self.pixels[1]
        )


def _evenly(share, count, start):
    """`count` different indices, as often as their `share` has it, the first one `start` of a
    step from the beginning.
    """
    places = np.cumsum(share) / np.sum(share)
    chosen = sorted(
        {int(np.searchsorted(places, (i + start) / count, side="right")) for i in range(count)}
    )
    rest = [i for i in np.argsort(-share, kind="stable").tolist() if i not in chosen]
    return np.array(sorted([*chosen, *rest[: count - len(chosen)]]))


def _some(superpixels, count):
    """Those of a block of superpixels that are compared: all of nine, four where lenslets have
    many cells, sixteen of more.
    """
    side = max(abs(n) for place in superpixels for n in place)
    if side == 0 or (side == 1 and count < 110):
        return superpixels
    kept = (-1, 0) if side == 1 else (-side, -1, 0, side - 1)
    return [place for place in superpixels if place[0] in kept and place[1] in kept]


class Plain(Truth):
    """A Truth on all of its superpixels, whose own change is not asked for."""

    def _compared(self, superpixels):
        return superpixels

    def _others(self):
        return []

    def _measured_change(self, found):
        return 0.0


def _change(columns, others):
    """Relative difference of the worst column."""
    return float(max(np.linalg.norm(a - b) / np.linalg.norm(a) for a, b in zip(columns, others)))


def truth_for(camera, model, neighbours, superpixels, accuracy, folder, kept_only=False):
    """The Truth against which a matrix of `accuracy`, of isolated lenslets or with coherent
    `neighbours`, is held.

    Paraxial: every lenslet there is. Exact: the fewest lenslets that leave out a tenth of the
    accuracy (as the paraxial model has it), or as many as can be afforded; None where not
    even the nearest can.
    kept_only: compute nothing, and None where something is not at hand.
    """
    if model == "fresnel" or not neighbours:
        fine = neighbours and accuracy < FINE
        return Truth(
            camera,
            model,
            wide_window(camera, fine) if neighbours else None,
            superpixels,
            folder,
            fine,
        )
    affordable = [
        t
        for t in (
            Truth(camera, model, w, superpixels, folder) for w in range(1, wide_window(camera) + 1)
        )
        if t.affordable()
    ]
    if not affordable:
        return None
    wide = Plain(camera, "fresnel", wide_window(camera), affordable[0].lit, folder)
    if kept_only and not wide.path.exists():
        return None
    for truth in affordable:
        near = Plain(camera, "fresnel", truth.window, truth.lit, folder)
        if kept_only and not near.path.exists():
            return None
        if _change(wide.columns(), near.columns()) < 0.1 * accuracy:
            return truth
    return affordable[-1]
