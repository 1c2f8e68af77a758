"""Cameras that nobody tuned anything on, and how far what is computed of them is off.

Drawn at random: lattices, shapes of lenslets, gaps, pupils, aberrations, focus, distances, windows,
pixels, neighbours. Judged by tests/reference/tensor.py, which imports nothing of plenocli.forward.
"""

import math
from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.camera.geometry import lenslet_shift
from plenocli.forward.propagation.system_matrix import build_pif
from tests.forward.propagation.cameras import small_camera
from tests.reference import tensor
from tests.reference.oblique import oblique_columns

AFFORDED, KERNEL_VALUES, RINGED = 3e10, 3e9, 3e9
"""Multiplications of the paraxial oracle, values of the exact one's kernel, and multiplications for
a point with many neighbours, beyond which a case is left out.
"""
WIDEST = math.sqrt(0.75)
"""Opening over pitch from which squares on a hexagonal lattice, or hexagons on a square one, would
overlap.
"""
OBLIQUE_SHAPES = "square", "circle", "hexagon"


@dataclass(frozen=True, kw_only=True)
class Case:
    """One question and its answer.

    number: which of a seed's cases, drawn again by `case`;
    asked, said: the accuracy;
    true: relative L2 error of the worst column; None where it was refused;
    refused: the words;
    light: share of the brightest point's light that the dimmest has;
    excess: the largest column's energy;
    gaps: whether lenslets leave any;
    slow: whether main lens and lenslets are slower than f/2.
    """

    number: int
    model: str
    rung: str = ""
    asked: float
    said: float = math.nan
    true: float | None = None
    refused: str = ""
    light: float = 1.0
    excess: float = 0.0
    gaps: bool
    slow: bool
    what: str = ""

    @property
    def ratio(self):
        """Error over what was asked."""
        return math.nan if self.true is None else self.true / self.asked

    @property
    def told(self):
        """Whether the stated error is within a factor of ten of the true one."""
        return 0.1 <= self.said / max(self.true, 1e-300) <= 10


def random_camera(rng):
    """A camera of any proportions."""

    def log(low, high):
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    def one(*values):
        return values[int(rng.integers(len(values)))]

    lattice = one("square", "square", "hexagonal")
    shape = one("square", "circle", "hexagon")
    fill = float(rng.uniform(0.15, 1.0)) if rng.uniform() < 0.7 else 1.0
    if (lattice, shape) in (("square", "hexagon"), ("hexagonal", "square")):
        fill *= 0.999 * WIDEST
    f_number, wavelength = log(1.5, 22), log(0.4e-6, 1e-6) if rng.uniform() < 0.9 else 10e-6
    z2 = one(20e-3, 55e-3, 120e-3)
    cells = log(1.5, 120)
    pitch = cells * wavelength * f_number
    focal = pitch * f_number * float(rng.uniform(0.7, 1.4) if rng.uniform() < 0.3 else 1.0)
    # in the lenslets' focus, where they show the pupil, or anywhere near
    conjugate = 1 / (1 - min(focal / z2, 0.5))
    distance = focal * float(one(1.0, 1.0, conjugate, rng.uniform(0.85, 1.15)))
    pupil = one("circle", "circle", "square", "annulus")
    terms = []
    if rng.uniform() < 0.5:
        for noll in rng.choice(np.arange(4, 12), int(rng.integers(1, 3)), replace=False):
            terms.append({"noll": int(noll), "coefficient": wavelength * rng.normal() / 2})
    blur = float(rng.uniform(-2.5, 2.5)) if rng.uniform() < 0.35 else 0.0
    f1 = z2 / 1.1
    # the object stays before the lens, and not farther than 1 km
    eps = max(blur * pitch * f_number / z2**2, 1e-3 - 0.1 / z2)
    on_sensor = pitch * (1 + distance / z2)
    across = int(rng.integers(2, 32))
    pixel = on_sensor / across
    # windows end within their superpixels, or where these do
    rows = WIDEST * across if lattice == "hexagonal" else across
    narrow = rng.uniform(0.6, 1.0, 2) if rng.uniform() < 0.3 else (1.0, 1.0)
    pixels = [max(1, math.floor(n * share + 1e-6)) for n, share in zip((rows, across), narrow)]
    return small_camera(
        main_lens__focal_length=f1,
        main_lens__aperture_diameter=z2 / f_number,
        main_lens__aperture_shape=pupil,
        main_lens__obscuration=float(rng.uniform(0.1, 0.6)) if pupil == "annulus" else 0.0,
        main_lens__aberrations=tuple(terms),
        object__distance=1 / (1 / f1 - 1 / z2 + eps),
        object__samples_per_lenslet=tuple(int(n) for n in rng.integers(1, 9, 2)),
        lenslet_array__distance=z2,
        lenslet_array__pitch=pitch,
        lenslet_array__focal_length=focal,
        lenslet_array__lattice=lattice,
        lenslet_array__aperture_shape=shape,
        lenslet_array__fill_factor=fill,
        lenslet_array__profile=one("hyperbolic", "parabolic"),
        sensor__distance=distance,
        sensor__pixel_pitch=pixel,
        sensor__pixels_per_lenslet=tuple(pixels),
        sensor__pixel_fill_factor=float(one(1.0, 1.0, rng.uniform(0.4, 1))),
        light__wavelengths=(wavelength,),
        light__design_wavelength=wavelength,
    )


def case(seed, number, model=None, finer=(1, 7)):
    """The case of so many of a seed, asked for 10^-finer: (camera, request)."""
    rng = np.random.default_rng((seed, number))
    camera = random_camera(rng)
    kind = rng.uniform()
    grid, ring = (
        ((1, 1), 0) if kind < 0.6 else ((1, 1), 1) if kind < 0.75 else ((3, 3), int(kind > 0.9))
    )
    return camera, {
        "model": model or str(rng.choice(["fresnel", "fresnel", "auto"])),
        "superpixels": grid,
        "coherent_ring": ring,
        "accuracy": float(10.0 ** -rng.uniform(*finer)),
    }


def oblique_case(seed, number):
    """A case of a lenslet up to 20 degrees off the axis: (camera, request)."""
    rng = np.random.default_rng((seed, number, 1))
    camera = random_camera(rng)
    array, turn = camera.lenslet_array, rng.uniform(0, math.pi / 2)
    away = array.distance * math.tan(math.radians(rng.uniform(0.5, 20))) / array.pitch
    away = min(away, 2000.0)
    row, column = round(away * math.sin(turn)), round(away * math.cos(turn))
    column = column or int(row == 0)  # on the axis the main lens has no spheres
    camera = camera.replace(
        **{
            "lenslet_array.lattice": "square",
            "lenslet_array.aperture_shape": OBLIQUE_SHAPES[number % 3],
            "lenslet_array.fill_factor": min(
                array.fill_factor, 0.999 * WIDEST if number % 3 == 2 else 1.0
            ),
            "lenslet_array.count": (2 * row + 1, 2 * column + 1),
            "main_lens.aberrations": (),
        }
    )
    return camera, {
        "model": "auto",
        "superpixels": (1, 1),
        "coherent_ring": 0,
        "accuracy": float(10.0 ** -rng.uniform(0.5, 5)),
        "lenslet": (2 * row, 2 * column),
    }


def ringed_case(seed, number):
    """A case of paraxial neighbours: rings that the dial takes by itself, or 2 to 6 of them;
    (camera, request), None where lenslets have so many cells that more would tell little.
    """
    rng = np.random.default_rng((seed, number, 9))
    camera = random_camera(rng)
    if cells_of(camera) > 12:
        return None
    accuracy, across = float(10.0 ** -rng.uniform(0.7, 4)), 3 if rng.uniform() < 0.25 else 1
    return camera, {
        "model": "fresnel",
        "superpixels": (across, across),
        "coherent_ring": "auto" if rng.uniform() < 0.75 else int(rng.integers(2, 7)),
        "accuracy": accuracy,
    }


def cells_of(camera):
    """Diffraction cells of a lenslet."""
    lens, array = camera.main_lens, camera.lenslet_array
    (wavelength,) = camera.light.wavelengths
    return array.pitch * lens.aperture_diameter / wavelength / array.distance


def is_centred(seed, number):
    """Whether the case of auto is one of harmonics: isolated, round or hexagonal, on the axis."""
    camera, request = case(seed, number, "auto")
    lens = camera.main_lens
    return (
        request["coherent_ring"] == 0
        and request["superpixels"] == (1, 1)
        and camera.lenslet_array.aperture_shape != "square"
        and lens.aperture_shape != "square"
        and all(term.noll in (4, 11) for term in lens.aberrations)
    )


def lenslets_of(camera, window):
    """(row, column) of the lenslets whose fields add, axial numbers on a hexagonal lattice."""
    if camera.lenslet_array.lattice == "square":
        far = range(-window, window + 1)
        return [(r, c) for r in far for c in far]
    # whole rows up to those that end half a pitch beyond the window, as wide as that; a row ends a
    # third of their distance from its middle
    reach, found = window + 0.5, []
    for r in range(-2 * window - 2, 2 * window + 3):
        if (abs(r) - 1) * WIDEST + WIDEST / 3 < reach - 1e-9 and window or r == 0:
            found += [
                (r, c)
                for c in range(-3 * window - 3, 3 * window + 4)
                if abs(c + r / 2) <= window + (r % 2) / 2
            ]
    return found


def points_of(camera):
    """Image points of the object points, m on the array."""
    rows, columns = camera.object.samples_per_lenslet
    pitch = camera.lenslet_array.pitch
    high = pitch * camera.lenslet_array.row_spacing
    return [
        ((i - (rows - 1) / 2) * high / rows, (j - (columns - 1) / 2) * pitch / columns)
        for i in range(rows)
        for j in range(columns)
    ]


def few_points(camera):
    """Which of points_of a sum over many lenslets looks at: a corner's, an edge's, one within."""
    rows, columns = camera.object.samples_per_lenslet
    return sorted({0, columns // 2, rows * columns // 2})


def superpixels_of(plan):
    """(row, column) of the superpixels kept, from the middle."""
    down, across = (range(-(n // 2), n // 2 + 1) for n in plan.superpixels)
    return [(r, c) for r in down for c in across]


def answer(seed, number, model=None, finer=(1, 7), most=KERNEL_VALUES):
    """The Case, None where the exact oracle would take more than `most` values, or the paraxial one
    too long.
    """
    camera, request = case(seed, number, model, finer)

    def truth(plan):
        window, superpixels = plan.bands[0].window, superpixels_of(plan)
        lenslets = None if window is None else lenslets_of(camera, window)
        if request["model"] == "fresnel":
            dear, oracle = _work(camera, plan) > AFFORDED, tensor.paraxial
        else:
            dear = tensor.kernel_values(camera, lenslets, superpixels) > most
            oracle = tensor.exact
        return None if dear else oracle(camera, points_of(camera), lenslets, superpixels)

    return _judged(number, camera, request, truth)


def oblique_answer(seed, number):
    """As `answer`, of a lenslet off the axis: its corner points, or all of few."""
    camera, request = oblique_case(seed, number)
    array, (row, column) = camera.lenslet_array, request["lenslet"]
    place = row / 2 * array.pitch, column / 2 * array.pitch
    rows, columns = camera.object.samples_per_lenslet
    some = sorted({0, columns - 1, (rows - 1) * columns, rows * columns - 1})

    def truth(plan):
        cells = cells_of(camera)
        if plan.rung == "rays" or cells > 40 or cells * max(camera.sensor.pixels_per_lenslet) > 400:
            return None
        return oblique_columns(
            camera,
            camera.light.wavelengths[0],
            place,
            [points_of(camera)[n] for n in some],
            shift=lenslet_shift(camera, row, column)[2],
            pixel_nodes=plan.bands[0].pixel_nodes + 8,
        )

    return _judged(number, camera, request, truth, some)


def ringed_answer(seed, number):
    """As `answer`, of a ringed_case: three points at most; two rings more than the dial takes stand
    for all lenslets.
    """
    found = ringed_case(seed, number)
    if found is None:
        return None
    camera, request = found
    points, some = points_of(camera), few_points(camera)

    def truth(plan):
        window, superpixels = plan.bands[0].window, superpixels_of(plan)
        lenslets = lenslets_of(camera, window + 2 * (request["coherent_ring"] == "auto"))
        if tensor.paraxial_products(camera, lenslets, superpixels) > RINGED:
            return None
        return tensor.paraxial(camera, [points[n] for n in some], lenslets, superpixels)

    return _judged(number, camera, request, truth, some)


def _judged(number, camera, request, truth, points=slice(None)):
    """The Case of a request, judged by truth(plan), whose columns are of `points`; None where that
    is None.
    """
    array, lens = camera.lenslet_array, camera.main_lens
    slow = lens.aperture_diameter * 2 <= array.distance and array.pitch * 2 <= array.focal_length
    told = dict(
        number=number,
        model=request["model"],
        asked=request["accuracy"],
        gaps=array.fill_factor < 0.99,
        slow=slow,
        what=describe(camera, request),
    )
    try:
        plan = plan_pif(
            camera, dtype=np.float64 if request["accuracy"] < 1e-6 else "auto", **request
        )
        true = truth(plan)
        if true is None:
            return None
        matrix = build_pif(camera, plan)
    except NumericsError as error:
        return Case(refused=str(error), **told)
    true = true.reshape(len(true), -1)
    found = matrix.A[0].reshape(true.shape[1], -1).T[points]
    size = np.linalg.norm(true, axis=1)
    errors = np.linalg.norm(found - true, axis=1) / size
    energy = true.sum(axis=1)
    return Case(
        rung=plan.rung,
        said=plan.estimated,
        true=float(errors.max()),
        light=float(energy.min() / energy.max()),
        excess=float(found.sum(axis=1).max()),
        **told,
    )


def describe(camera, request):
    """One line about a case."""
    lens, array, sensor = camera.main_lens, camera.lenslet_array, camera.sensor
    eps = 1 / camera.object.distance + 1 / array.distance - 1 / lens.focal_length
    return (
        f"{array.aperture_shape}/{array.lattice} fill {array.fill_factor:.2f}, "
        f"{lens.aperture_shape} f/{array.distance / lens.aperture_diameter:.1f} lenslet f/"
        f"{array.focal_length / array.pitch:.1f}, {cells_of(camera):.0f} cells, blur "
        f"{eps * lens.aperture_diameter * array.distance / array.pitch:.1f}, terms "
        f"{[t.noll for t in lens.aberrations or ()]}, pixels {sensor.pixels_per_lenslet}, "
        f"{request['superpixels']} ring {request['coherent_ring']} "
        f"lenslet {request.get('lenslet', 'on the axis')}"
    )


def _work(camera, plan):
    """Multiplications of the paraxial oracle, roughly."""
    band, shape = plan.bands[0], plan.shape
    lenslets = 1 if band.window is None else (2 * band.window + 1) ** 2
    n, p = 2 * band.lenslet_nodes + 20, band.psf_nodes + 20
    v = max(camera.sensor.pixels_per_lenslet) * (2 * band.pixel_nodes + 5)
    return 4.0 * lenslets * shape[1] * shape[3] * (n * p * p + n * n * (p + v) + n * v * v)
