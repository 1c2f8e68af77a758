"""The system matrix beside optics libraries: processor time of the same 1600 columns, and the error
of each against one brute-force reference.

The camera is sample_configs/seed_spatial_250um.toml with isolated lenslets (f/4.4, 52 x 52 pixels,
40 x 40 points, 550 nm), the model paraxial. A library propagates one object point at a time from
the lenslet to the sensor. It is handed what it need not compute: the field on the array (tabulated
once, not timed), the lenslet's phase and its transfer function; timed are the product with the
lenslet, the propagation and the binning to pixels, a few columns of 1600. Ours is the whole matrix:
the set-up, every column, the guard and the order of the result in memory. All run in one process on
one thread, in turns; a time is the median of its turns (process time), times of loops are scaled to
1600 columns. Beside them stands the rate of this machine's complex products in single precision,
measured in the same turns. Libraries that are not installed are left out: `pip
install -e '.[bench]'`.

Writes RUN/pif.json and RUN/pif.md. Run from the project's root: python
pipelines/benchmarks/pif.py --help.
"""

import argparse
import json
import os
import sys
import time
import types
import warnings
from importlib.metadata import PackageNotFoundError, distribution, version
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np  # noqa: E402

CONFIG = ROOT / "sample_configs" / "seed_spatial_250um.toml"
POINTS = ((0, 0), (3, 17), (10, 12), (20, 20))
"""Object points whose columns are compared; the first is the corner."""
PER_PIXEL = 8
"""Samples a pixel of the libraries' grids."""
PAD = 2
"""The grid over the lenslet's width, against wrap-around."""


# what the libraries are handed


class Grid:
    """The lenslet sampled for a library: midpoints of `PER_PIXEL` cells a pixel over `PAD`
    lenslets, everything in metres.
    """

    def __init__(self, camera):
        self.camera, self.wavelength = camera, camera.light.wavelengths[0]
        self.pixels = camera.sensor.pixels_per_lenslet[0]
        self.dx, self.lit = camera.sensor.pixel_pitch / PER_PIXEL, self.pixels * PER_PIXEL
        self.count = PAD * self.lit
        self.x = (np.arange(self.count) - (self.count - 1) / 2) * self.dx
        half = camera.lenslet_array.pitch / 2
        # cells that the lenslet's edge cuts count by the part that is lit
        open_ = np.clip((half - np.abs(self.x)) / self.dx + 0.5, 0, 1)
        k, z2 = 2 * np.pi / self.wavelength, camera.lenslet_array.distance
        wave = (
            np.exp(0.5j * k * self.x**2 * (1 / z2 - 1 / camera.lenslet_array.focal_length)) * open_
        )
        self.lens = np.outer(wave, wave)
        # what is left of the lenslet's phase when the sensor's own transform is taken
        # out, on the lit part
        lit = self.inner(self.x)
        rest = np.exp(
            0.5j
            * k
            * lit**2
            * (1 / z2 + 1 / camera.sensor.distance - 1 / camera.lenslet_array.focal_length)
        ) * self.inner(open_)
        self.rest = np.outer(rest, rest)

    def inner(self, a):
        """The lenslet's own superpixel of a vector or of a square."""
        edge = (self.count - self.lit) // 2
        return a[(slice(edge, edge + self.lit),) * a.ndim]

    def field(self, point):
        """The in-focus main lens's field of an object point, without its spherical phase: a
        closed form (Airy), real.
        """
        from scipy.special import j1

        lens, array = self.camera.main_lens, self.camera.lenslet_array
        rows, columns = self.camera.object.samples_per_lenslet
        y, x = ((p - (n - 1) / 2) * array.pitch / n for p, n in zip(point, (rows, columns)))
        a, z = lens.aperture_diameter / 2, array.distance
        v = np.maximum(
            2 * np.pi * a / (self.wavelength * z) * np.hypot(self.x[:, None] - y, self.x - x), 1e-9
        )
        return np.sqrt(np.pi) * a / (self.wavelength * z) * 2 * j1(v) / v

    def binned(self, field):
        """Energy in each pixel from the field on the sensor, on the whole grid or on the
        superpixel's part of it.
        """
        inner = field if field.shape[0] == self.lit else self.inner(field)
        energy = (inner.real**2 + inner.imag**2) * self.dx**2
        return energy.reshape(self.pixels, PER_PIXEL, self.pixels, PER_PIXEL).sum(axis=(1, 3))


# the libraries: each takes the Grid and gives a function field -> pixel energies, or
# raises ImportError


def old_setuptools():
    """prysm asks pkg_resources, which setuptools has no more since 81, for its own version."""
    if "pkg_resources" not in sys.modules and not find_spec("pkg_resources"):
        sys.modules["pkg_resources"] = types.SimpleNamespace(get_distribution=distribution)


def prysm_spectrum(grid):
    """Angular spectrum with the transfer function kept; units mm and um."""
    old_setuptools()
    from prysm.propagation import angular_spectrum, angular_spectrum_transfer_function

    transfer = angular_spectrum_transfer_function(
        grid.count, grid.wavelength * 1e6, grid.dx * 1e3, grid.camera.sensor.distance * 1e3
    )
    return lambda field: grid.binned(
        angular_spectrum(field * grid.lens, grid.wavelength * 1e6, grid.dx * 1e3, 0, tf=transfer)
    )


def prysm_mdft(grid):
    """Matrix transform from the lenslet to 4 samples a pixel.

    Its output falls on whole steps from the axis: a tilt brings it to midpoints.
    """
    old_setuptools()
    from prysm.propagation import focus_fixed_sampling

    per, z3 = 4, grid.camera.sensor.distance
    step, size = grid.camera.sensor.pixel_pitch / per, per * grid.pixels
    x = grid.inner(grid.x)
    tilt = np.exp(-2j * np.pi / (grid.wavelength * z3) * x * step / 2)
    lens = grid.rest * np.outer(tilt, tilt)
    # energy of a transform that is scaled arbitrarily: by Parseval over one full
    # period of its output
    scale = [None]

    def column(field):
        out = focus_fixed_sampling(
            grid.inner(field) * lens,
            grid.dx * 1e3,
            z3 * 1e3,
            grid.wavelength * 1e6,
            step * 1e6,
            size,
        )
        if scale[0] is None:
            x_out = (np.arange(size) - (size - 1) / 2) * step
            near = size // 2
            direct = (
                (
                    grid.inner(field)
                    * grid.rest
                    * np.outer(_wave(grid, x, x_out[near]), _wave(grid, x, x_out[near]))
                ).sum()
                * grid.dx**2
                / (grid.wavelength * z3)
            )
            scale[0] = abs(direct) ** 2 / abs(out[near, near]) ** 2 * step**2
        energy = (out.real**2 + out.imag**2) * scale[0]
        return energy.reshape(grid.pixels, per, grid.pixels, per).sum(axis=(1, 3))

    return column


def _wave(grid, x, u):
    return np.exp(-2j * np.pi / (grid.wavelength * grid.camera.sensor.distance) * x * u)


def poppy_fresnel(grid):
    """FresnelWavefront from plane to plane."""
    import astropy.units as u
    import poppy

    z = grid.camera.sensor.distance * u.m

    def column(field):
        wave = poppy.FresnelWavefront(
            grid.lit * grid.dx / 2 * u.m,
            wavelength=grid.wavelength * u.m,
            npix=grid.lit,
            oversample=PAD,
        )
        wave.wavefront = field * grid.lens
        wave.propagate_fresnel(z)
        return grid.binned(wave.wavefront)

    return column


def hcipy_fresnel(grid):
    """FresnelPropagator on the lenslet's grid, padded by itself; its own supersampling of the
    kernel is switched off, which costs it accuracy.
    """
    import hcipy

    pupil = hcipy.make_pupil_grid(grid.lit, grid.lit * grid.dx)
    propagator = hcipy.FresnelPropagator(
        pupil, grid.camera.sensor.distance, num_oversampling=1, zero_padding=PAD
    )
    lens = grid.inner(grid.lens)

    def column(field):
        wave = hcipy.Wavefront(
            hcipy.Field((grid.inner(field) * lens).ravel(), pupil), grid.wavelength
        )
        return grid.binned(np.asarray(propagator(wave).electric_field).reshape(grid.lit, grid.lit))

    return column


def lightpipes_forvard(grid):
    """Forvard, its propagation by the spectrum of plane waves."""
    import LightPipes

    begin = LightPipes.Begin(grid.count * grid.dx, grid.wavelength, grid.count)

    def column(field):
        wave = LightPipes.Field.copy(begin)
        wave.field = field * grid.lens
        return grid.binned(LightPipes.Forvard(grid.camera.sensor.distance, wave).field)

    return column


LIBRARIES = {
    "prysm angular spectrum": ("prysm", prysm_spectrum),
    "prysm matrix transform": ("prysm", prysm_mdft),
    "poppy FresnelWavefront": ("poppy", poppy_fresnel),
    "hcipy FresnelPropagator": ("hcipy", hcipy_fresnel),
    "LightPipes Forvard": ("LightPipes", lightpipes_forvard),
}


# ours


def ours(camera, accuracy, rung, symmetric):
    """A function that computes the whole matrix: (A, seconds of the set-up, of the columns,
    separable terms, the BandPlan).
    """
    from plenocli.forward.accuracy import dial
    from plenocli.forward.accuracy.dial import plan_pif
    from plenocli.forward.propagation.system_matrix import PifBuilder

    kept, dial.MODELS = dial.MODELS, tuple(m for m in dial.MODELS if m.name == rung)
    try:
        plan = plan_pif(
            camera, model="fresnel", superpixels=(1, 1), coherent_ring=0, accuracy=accuracy
        )
    finally:
        dial.MODELS = kept
    band = plan.bands[0]

    def compute():
        start = time.process_time()
        builder = PifBuilder(camera, band.wavelength, plan, dtype=plan.dtype)
        if not symmetric:
            builder.symmetry = (False, False, False)
        ready = time.process_time()
        A = np.empty(plan.shape[1:], plan.dtype)
        builder.fill(A)
        return (
            A[0],
            ready - start,
            time.process_time() - ready,
            builder.notes.separable_terms,
            band,
        )

    return compute


def rate(dtype=np.complex64):
    """Real operations a second (8 for a complex multiply-add) of products of the kernel's shape,
    over as long as the kernel takes, or of large ones: whichever are faster.
    """
    return max(_rate(dtype, 260, 68, 260, 1600), _rate(dtype, 1024, 1024, 1024, 4))


def _rate(dtype, rows, inner, columns, times):
    a, b = np.ones((rows, inner), dtype), np.ones((inner, columns), dtype)
    out = np.empty((rows, columns), dtype)
    start = time.process_time()
    for _ in range(times):
        np.matmul(a, b, out=out)
    return 8.0 * rows * inner * columns * times / (time.process_time() - start)


# the measurement


def reference(camera):
    """The compared columns by brute force: (point, pixel row, pixel column)."""
    from tests.reference.window import column_energies

    rows, columns = camera.object.samples_per_lenslet
    pitch = camera.lenslet_array.pitch
    found = []
    for i, j in POINTS:
        image = ((i - (rows - 1) / 2) * pitch / rows, (j - (columns - 1) / 2) * pitch / columns)
        found.append(
            column_energies(
                camera, camera.light.wavelengths[0], image, None, [(0, 0)], pixel_nodes=12
            )[0, 0]
        )
    return np.array(found)


def errors(columns, truth):
    """(relative L2 error over all compared columns, of the corner's alone)."""
    difference = columns - truth
    return float(np.linalg.norm(difference) / np.linalg.norm(truth)), float(
        np.linalg.norm(difference[0]) / np.linalg.norm(truth[0])
    )


def measure(rounds, columns):
    """Every method in turns: the rows of the table, and the rates of this machine."""
    from threadpoolctl import threadpool_limits

    from plenocli.files.config.camera_file import load_camera

    camera = load_camera(CONFIG)
    grid, truth, (_, count) = Grid(camera), reference(camera), camera.object.samples_per_lenslet
    fields = [grid.field(p) for p in POINTS]
    flat = [i * count + j for i, j in POINTS]
    own = {
        f"plenocli {rung}, {accuracy}, {'with' if symmetric else 'without'} symmetry": ours(
            camera, float(accuracy), f"fresnel, {rung}", symmetric
        )
        for rung, accuracy in (
            ("low rank", "1e-4"),
            ("low rank", "1e-8"),
            ("triple product", "1e-4"),
        )
        for symmetric in (True, False)
    }
    libraries, missing = _available(grid)
    rows = {name: {"name": name, "turns": []} for name in (*own, *libraries)}
    rates = []
    with threadpool_limits(1):
        for turn in range(rounds + 1):
            for name, compute in own.items():
                A, setup, filled, terms, band = compute()
                if turn:  # the first turn warms up
                    rows[name]["turns"].append((setup, filled))
                else:
                    got = A[:, flat].T.reshape(truth.shape).astype(float)
                    rows[name] |= {
                        "errors": errors(got, truth),
                        "terms": terms,
                        "pixel_nodes": band.pixel_nodes,
                        "whole": True,
                    }
            rates.append(rate())
            for name, column in libraries.items():
                if not turn:
                    rows[name] |= {
                        "errors": errors(np.array([column(f) for f in fields]), truth),
                        "whole": False,
                    }
                    continue
                start = time.process_time()
                for i in range(columns):
                    column(fields[i % len(fields)])
                rows[name]["turns"].append((0.0, (time.process_time() - start) / columns * 1600))
    return _table(list(rows.values()), camera, rates), rates, missing


def _available(grid):
    """Libraries that import, as {name: function}, and those that do not, as {name: why}."""
    found, missing = {}, {}
    for name, (package, make) in LIBRARIES.items():
        try:
            found[f"{name} ({version(package)})"] = make(grid)
        except (ImportError, PackageNotFoundError) as error:
            missing[name] = str(error)
    return found, missing


def _table(rows, camera, rates):
    fine = camera.sensor.pixels_per_lenslet[0] ** 2
    for row in rows:
        turns = np.array(row.pop("turns"))
        row["setup_seconds"], row["column_seconds"] = np.median(turns, axis=0).tolist()
        row["seconds"] = float(np.median(turns.sum(axis=1)))
        row["spread"] = [float(turns.sum(axis=1).min()), float(turns.sum(axis=1).max())]
        if row["name"] == "plenocli low rank, 1e-4, without symmetry":
            # the best of the turns on both sides: neighbours on the machine slow
            # either down by chance
            row["rate"] = (
                8.0
                * fine
                * row["pixel_nodes"] ** 2
                * row["terms"]
                * 1600
                / float(turns[:, 1].min())
            )
            row["share_of_product_rate"] = row["rate"] / max(rates)
    loop = next((r["seconds"] for r in rows if r["name"].startswith("prysm angular")), None)
    for row in rows:
        row["times_less_than_prysm"] = loop / row["seconds"] if loop else None
    return rows


def markdown(rows, rates, missing):
    """The table as Markdown."""
    lines = [
        (
            "| method | CPU s for 1600 columns | prysm's loop over it | error, all "
            "compared | error, corner |"
        ),
        "|---|---|---|---|---|",
    ]
    for r in rows:
        ratio = f"{r['times_less_than_prysm']:.3g}" if r["times_less_than_prysm"] else "-"
        lines.append(
            f"| {r['name']} | {r['seconds']:.3g} | {ratio} | {r['errors'][0]:.1e} | "
            f"{r['errors'][1]:.1e} |"
        )
    lines.append(
        "\n"
        f"Complex products in single precision on this machine: {max(rates) / 1e9:.0f} GF/s at "
        f"best, {np.median(rates) / 1e9:.0f} in the median of the turns."
    )
    for r in rows:
        if "rate" in r:
            lines.append(
                f"Columns of `{r['name']}`: {r['rate'] / 1e9:.0f} GF/s, "
                f"{100 * r['share_of_product_rate']:.0f} % of that (best turns of both)."
            )
    lines += [f"Left out: {name} ({why})." for name, why in missing.items()]
    return "\n".join(lines) + "\n"


def main():
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--run", type=Path, default=Path("runs/bench-pif"), help="folder of the results"
    )
    parser.add_argument("--rounds", type=int, default=5, help="turns of every method (default 5)")
    parser.add_argument(
        "--columns",
        type=int,
        default=8,
        help="columns of a loop in one turn, scaled to 1600 (default 8)",
    )
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    rows, rates, missing = measure(options.rounds, options.columns)
    options.run.mkdir(parents=True, exist_ok=True)
    text = markdown(rows, rates, missing)
    (options.run / "pif.json").write_text(
        json.dumps(
            {"rows": rows, "product_rate": float(np.median(rates)), "missing": missing}, indent=1
        )
        + "\n"
    )
    (options.run / "pif.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
