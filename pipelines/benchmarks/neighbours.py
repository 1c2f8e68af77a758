"""Demultiplexing where neighbouring lenslets differ: captures of the spectral cameras with 20x20
pixels behind 12x16 lenslets, scenes of random reflectances (CIE 224 surfaces of random brightness),
errors of `demux --method auto` and of the pseudo-inverse against the reflectance that the filters
let through and against the answer for an even object, with the stated errors; and the time of one
solution for 10,000 lenslets. `choice` compares what `auto` takes with every method on cameras of
random filters, charts and exposures. Captures come from the exact model over --superpixels and
--samples points a side (as many as a field has diffraction cells, as objects have no points), the
neighbours' light from the description, with the sensor 1 % further away and the filters 1 % larger
where --wrong says so.

    python pipelines/benchmarks/neighbours.py four
    python pipelines/benchmarks/neighbours.py singlet --joint
    python pipelines/benchmarks/neighbours.py choice --cases 40
"""

import argparse
import os
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

CAMERAS = {"four": "seed_spectral.toml", "singlet": "seed_spectral_singlet.toml"}
COUNT = (12, 16)
SCENES = {"checkerboard": (1, 0), "patches": (4, 0), "edges": (4, 0.37), "squares": (4 / 3, 0.1)}
"""Lenslets of a patch, and by how many its edges are off the lenslets' borders."""
OTHERS = {
    "twos": (2, 0),
    "chart": ((4, 3.75), 0),
    "strips": ((1, 2.2), 0),
    "oblongs": ((3, 2), (0.5, 0)),
}
"""The same of `choice`, down and across."""


class Patches:
    """A scene of patches, each another reflectance."""

    spectral = True

    def __init__(self, kind, seed):
        from plenocli.forward.scene.tables import surfaces

        rng = np.random.default_rng(seed)
        self.kind, self.own = kind, np.arange(380, 785, 5) * 1e-9
        known = surfaces(self.own)
        some = known[rng.integers(len(known), size=4000)] * rng.uniform(0.5, 1.15, (4000, 1))
        self.spectra, self.order = np.clip(some, 0.005, 0.98), rng.permutation(4000)

    def at(self, wavelength, rows, columns):
        """Reflectance on rows x columns points."""
        sizes, offs = (np.broadcast_to(one, 2) for one in (SCENES | OTHERS)[self.kind])
        i, j = (
            np.floor(((np.arange(n) + 0.5) / n * count + off) / size).astype(int)
            for n, count, size, off in zip((rows, columns), COUNT, sizes, offs)
        )
        values = np.array([np.interp(wavelength, self.own, one) for one in self.spectra])
        return values[self.order[(i[:, None] * 37 + j[None]) % 4000]].astype(np.float32)


class Spots:
    """A scene that shares nothing with Patches: discs of a few pigments, each a product of smooth
    steps in wavelength, on a ground that changes slowly.
    """

    spectral = True

    def __init__(self, seed):
        rng = np.random.default_rng([seed, 77])
        self.steps = rng.uniform(400e-9, 690e-9, (12, 2)), rng.uniform(8e-9, 60e-9, (12, 2))
        self.ends = rng.uniform(0.03, 0.95, (12, 3))
        self.discs = rng.uniform(0, 1, (int(rng.integers(6, 90)), 2))
        self.sizes = rng.uniform(0.02, 0.35, len(self.discs)) * np.sqrt(6 / len(self.discs))
        self.tilt = rng.uniform(-0.5, 0.5, 2)

    def at(self, wavelength, rows, columns):
        """Reflectance on rows x columns points."""
        rise = 1 / (1 + np.exp((self.steps[0] - wavelength) / self.steps[1] * 4))
        ends = self.ends
        pigments = ends[:, 0] + ((ends[:, 1:] - ends[:, :1]) * rise).mean(axis=1)
        y, x = np.meshgrid(*((np.arange(n) + 0.5) / n for n in (rows, columns)), indexing="ij")
        out = pigments[0] * (1 + self.tilt[0] * (y - 0.5) + self.tilt[1] * (x - 0.5))
        for k, ((cy, cx), size) in enumerate(zip(self.discs, self.sizes)):
            out[np.hypot(y - cy, (x - cx) * 4 / 3) < size] = pigments[1 + k % 11]
        return np.clip(out, 0.01, 0.98).astype(np.float32)


def drawn(seed):
    """A camera of random filters in front of a random lens."""
    from plenocli.forward.camera.model import Camera

    rng = np.random.default_rng([seed, 5])
    layout = [(1, 2), (2, 2), (2, 2), (2, 3), (3, 3)][int(rng.integers(5))]
    count = layout[0] * layout[1]
    width = rng.uniform(12e-9, 45e-9)
    centres = np.linspace(430e-9, 670e-9, count) + rng.uniform(-8e-9, 8e-9, count)
    data = camera_of("four" if rng.uniform() < 0.7 else "singlet").model_dump()
    data["light"] |= {"wavelengths": tuple(sorted(centres))}
    data["filter_array"] = {
        "layout": layout,
        "gap": rng.uniform(0, 0.3e-3),
        "size": rng.uniform(5.6e-3, 6.6e-3),
        "filters": [
            {"center": c, "fwhm": width * rng.uniform(0.8, 1.2), "peak": rng.uniform(0.4, 0.9)}
            for c in rng.permutation(centres)
        ],
    }
    well = rng.uniform(5e3, 5e4)
    data["sensor"] |= {"read_noise": rng.uniform(1, 12), "full_well": well, "gain": 3600 / well}
    return Camera.model_validate(data, context={"si": True})


def camera_of(name):
    """A spectral camera of the samples with 20x20 pixels behind 12x16 lenslets."""
    from plenocli.files.read.cameras import read_camera

    small = {"sensor.pixels_per_lenslet": (20, 20), "sensor.pixel_pitch": 5.2e-6}
    described = read_camera(ROOT / "sample_configs" / CAMERAS[name])
    return described.replace(**{"lenslet_array.count": COUNT}, **small)


class Bench:
    """One camera, its captures and its calibration."""

    def __init__(self, described, superpixels, samples, lines=False, quick=False):
        from plenocli.forward.scene.light import Quadrature, broadband
        from plenocli.forward.scene.tables import illuminant

        self.described, self.samples = described, samples
        self.camera = self.described.replace(**{"object.samples_per_lenslet": (samples, samples)})
        self.light = broadband(self.camera, lambda w: illuminant("D65", w), None)
        if lines:
            bands = np.array(self.camera.light.wavelengths)
            self.light = Quadrature(bands, np.full(len(bands), 1 / len(bands)))
        if quick:
            through = [self._through(w).max() for w in self.light.wavelengths]
            passed, light = np.array(through) > 3e-3, self.light
            photons = light.photons[passed]
            self.light = Quadrature(light.wavelengths[passed], photons / photons.sum(), light.width)
        self.model, self.superpixels = "fresnel" if lines or quick else "auto", superpixels
        self.matrices = self.still = self._seen_by(self.camera)
        self.calibration, white = self._calibrated()
        from plenocli.inverse.spectra.demultiplexer import Demultiplexer

        alone = Demultiplexer(self.calibration, method="pinv", ratio=True)
        self.white = np.median(alone.estimate(white, "white").value, axis=(1, 2), keepdims=True)

    def _through(self, wavelength):
        """Transmittance of the filters, by their wavelengths."""
        from plenocli.forward.camera.pupil import filter_transmittance

        filters = sorted(self.camera.filter_array.filters, key=lambda one: one.center)
        return np.array([filter_transmittance(f, wavelength) for f in filters])

    def _seen_by(self, camera):
        from plenocli.forward.accuracy.dial import pif_builder
        from plenocli.forward.sensor.exposure.matrices import StoredMatrix

        found, sides = {}, (self.superpixels, self.superpixels)
        for w in {*map(float, self.light.wavelengths), *camera.light.wavelengths}:
            builder = pif_builder(camera, w, superpixels=sides, model=self.model)
            found[w] = StoredMatrix(builder.whole(), builder.offsets)
        return found

    def move(self, shift):
        """From now on captures are of pixels displaced by (rows, columns) px."""
        self.matrices = self._seen_by(self.camera.with_fit(tuple(shift), 0.0))

    def shoot(self, scene, seed, exposure=1.0, light=None):
        """One capture."""
        from plenocli.forward.sensor.exposure.options import ExposureOptions
        from plenocli.forward.sensor.exposure.simulate import simulate_capture

        options = ExposureOptions(seed=seed, exposure=exposure * self.camera.light.white_exposure)
        return simulate_capture(
            self.camera, light or self.light, scene, options, matrices=self.matrices
        ).capture

    def _calibrated(self):
        from plenocli.forward.scene.light import narrow_band
        from plenocli.forward.scene.scenes import Uniform
        from plenocli.inverse.calibration.measure import NarrowBands, calibrate

        even, bands = Uniform(0.99), self.camera.light.wavelengths
        white = self.shoot(even, 100)
        shots = {
            w: [self.shoot(even, 102 + 10 * k + n, light=narrow_band(w, 0.0)) for n in range(4)]
            for k, w in enumerate(bands)
        }
        narrow = NarrowBands(wavelengths=bands, captures=lambda w: shots[w])
        darks = [self.shoot(Uniform(0.0), 101)]
        found = calibrate([white], darks=darks, bands=narrow, camera=self.described)
        return found.calibration, white

    def truths(self, scene):
        """(filter-weighted, for an even object), each (band, row, column)."""
        back = np.linalg.pinv(np.asarray(self.calibration.response.matrix, float))
        through, even = [], []
        for photons, w in zip(self.light.photons, self.light.wavelengths):
            through.append(photons * self._through(w))
            light = self.still[float(w)].matrix.sum(axis=(0, 2), dtype=float)
            even.append(photons * (back @ light))
        n = self.samples
        pictures = [
            scene.at(w, COUNT[0] * n, COUNT[1] * n)
            .reshape(COUNT[0], n, COUNT[1], n)
            .mean(axis=(1, 3))
            for w in self.light.wavelengths
        ]
        weights = (np.array(one) / np.sum(one, axis=0) for one in (through, even))
        return [np.einsum("wk,wrc->krc", one, pictures) for one in weights]


def table(bench, wrong, seeds):
    """Print a row for each scene and exposure: errors and rms z."""
    from plenocli.inverse.spectra.demultiplexer import Demultiplexer

    camera = bench.described
    if wrong:
        camera = camera.replace(
            **{
                "sensor.distance": camera.sensor.distance * 1.01,
                "filter_array.size": camera.filter_array.size * 1.01,
            }
        )
    solver = Demultiplexer(bench.calibration, camera=camera, ratio=True)
    print("| scene, seed, exposure | pinv | auto | against filters (z) | against even object (z) |")
    for kind in SCENES:
        for seed in seeds:
            scene = Patches(kind, seed)
            truths = bench.truths(scene)
            for exposure in (1.0, 1 / 64):
                shot = bench.shoot(scene, 7, exposure)
                found, plain = solver.estimate(shot, "shot"), solver.estimate(shot, "shot", "pinv")
                cells = [f"{rms(plain.value, plain.sigma, truths[0], bench.white)[0]:.5f}"]
                cells.append(found.method)
                for truth in truths:
                    error, z = rms(found.value, found.sigma, truth, bench.white)
                    cells.append(f"{error:.5f} ({z:.2f})")
                print(f"| {kind}, {seed}, {exposure:.3g} | " + " | ".join(cells) + " |", flush=True)


def rms(value, sigma, truth, white):
    """(rms error of reflectance, that over the stated one), border lenslets left out."""
    inner = (slice(None), slice(1, -1), slice(1, -1))
    error = (0.99 * value / white - truth)[inner]
    return np.sqrt(np.mean(error**2)), np.sqrt(
        np.mean((error / (0.99 * sigma / white)[inner]) ** 2)
    )


def choice(cases, first, superpixels, samples, quick):
    """Print what auto takes in random cases, beside the best method; how often it is within 5 %."""
    from plenocli.inverse.spectra.demultiplexer import Demultiplexer

    print("| case | bands | scene | exposure | auto took | error | best | its error | ratio |")
    ratios, stated = [], []
    for number in range(cases):
        seed = first + number
        rng = np.random.default_rng([seed, 9])
        if number % 4 == 0:
            bench = Bench(drawn(seed), superpixels, samples, quick=quick)
            solver = Demultiplexer(bench.calibration, camera=bench.described, ratio=True)
        kinds = ["spots", "spots", *SCENES, *OTHERS]
        kind = kinds[int(rng.integers(len(kinds)))]
        scene = Spots(seed) if kind == "spots" else Patches(kind, seed)
        exposure = float(2 ** -rng.uniform(0, 7))
        truth, shot = bench.truths(scene)[0], bench.shoot(scene, seed, exposure)
        errors, zs, took = {}, {}, ""
        for method in ("auto", "single-pixel", "pinv", "wls", "lmmse", "coupled", "fine"):
            found = solver.estimate(shot, "shot", method)
            errors[method], zs[method] = rms(found.value, found.sigma, truth, bench.white)
            took = took or found.method
        best = min((m for m in errors if m != "auto"), key=errors.__getitem__)
        ratios.append(errors["auto"] / errors[best])
        stated.append(zs["auto"])
        print(
            f"| {seed} | {len(truth)} | {kind} | {exposure:.3f} | {took} (z {zs['auto']:.2f}) | "
            f"{errors['auto']:.5f} | {best} | {errors[best]:.5f} | {ratios[-1]:.3f} | "
            + " ".join(f"{m} {e:.4f}" for m, e in errors.items()),
            flush=True,
        )
    within = np.mean(np.array(ratios) <= 1.05)
    print(
        f"within 5 % of the best method in {within:.0%} of {cases}; worst {max(ratios):.2f} times; "
        f"rms z {min(stated):.2f} to {max(stated):.2f}"
    )


def joint(name, seeds):
    """Print what LMMSE of the joint estimate over 3x3 lenslets makes of the lenslets' means beside
    demux, one factor a band left free: one matrix of 12 points a side, 45 dB.
    """
    import plenocli.api as pc
    from plenocli.forward.sensor.exposure.options import ExposureOptions
    from plenocli.forward.sensor.exposure.simulate import simulate_capture
    from plenocli.inverse.spectra.demultiplexer import Demultiplexer

    camera = camera_of(name).replace(**{"object.samples_per_lenslet": (12, 12)})
    bench = Bench(camera, 3, 12, True)
    bands = sorted(map(float, bench.light.wavelengths))
    matrix = pc.system_matrix(camera, wavelengths=bands, superpixels=(3, 3), model="fresnel")
    solver = Demultiplexer(bench.calibration, camera=camera, ratio=True)
    print("| scene, seed | pinv | auto | joint LMMSE |")
    for kind in SCENES:
        for seed in seeds:
            scene = Patches(kind, seed)
            truth, shot = bench.truths(scene)[0], bench.shoot(scene, 7)
            told = ExposureOptions(seed=7, snr_db=45.0)
            seen = simulate_capture(
                bench.camera, bench.light, scene, told, matrices=bench.matrices
            ).capture
            picture = np.asarray(
                pc.reconstruct(seen, matrix, camera=camera, method="lmmse").value, float
            )
            blocks = picture.reshape(len(bands), COUNT[0], 12, COUNT[1], 12)
            found = [solver.estimate(shot, "shot", m).value for m in ("pinv", "auto")]
            cells = []
            for value in (*found, blocks.mean(axis=(2, 4))):
                v, t = (one[:, 1:-1, 1:-1].reshape(len(bands), -1) for one in (value, truth))
                factor = (v * t).sum(axis=1) / (v * v).sum(axis=1)
                cells.append(f"{np.sqrt(np.mean((factor[:, None] * v - t) ** 2)):.5f}")
            print(f"| {kind}, {seed} | " + " | ".join(cells) + " |", flush=True)


def speed(bench):
    """CPU seconds of both solutions for 100 x 100 lenslets of 400 pixels."""
    from plenocli.inverse.spectra.coupled import coupled, fine, likeliest
    from plenocli.inverse.spectra.crosstalk import Crosstalk, windows_of
    from plenocli.inverse.spectra.neighbours import neighbour_light
    from plenocli.inverse.spectra.radiance import readout
    from plenocli.inverse.spectra.responses import LensletResponses

    c = LensletResponses.of(bench.calibration)
    signal, noise = readout(bench.shoot(Patches("edges", 21), 7), c, "shot")
    light = neighbour_light(bench.described, bench.calibration)
    small = Crosstalk(c, light, windows_of(c, signal), noise, ratio=True).capture
    from dataclasses import replace

    def tiled(x):
        return np.tile(x, (9, 7, 1))[:100, :100]

    large = replace(small, values=tiled(small.values), start=tiled(small.start))
    for fit in (False, True):
        start = time.process_time()
        first = coupled(large, light, fit)
        middle = time.process_time()
        fine(large, first, light, (0.0, 0.0))
        end = time.process_time()
        likeliest(large, first, light)
        asked = time.process_time() - end
        print(
            f"10,000 lenslets of 400 pixels, {len(light.offsets)} superpixels a lenslet: coupled "
            f"{middle - start:.2f} s ({'with' if fit else 'without'} its fit), fine after it "
            f"{end - middle:.2f} s, what is alike {asked:.2f} s of CPU"
        )


def main():
    """Parse, make the captures, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("camera", choices=[*CAMERAS, "choice"])
    parser.add_argument(
        "--joint", action="store_true", help="the joint estimate of reconstruct beside demux"
    )
    parser.add_argument("--cases", type=int, default=40, help="of choice")
    parser.add_argument("--first", type=int, default=9000, help="seed of the first case of choice")
    parser.add_argument("--superpixels", type=int, default=3, help="a side, of the captures")
    parser.add_argument("--samples", type=int, default=24, help="points a side, of the captures")
    parser.add_argument(
        "--lines",
        action="store_true",
        help="light of four lines, by the paraxial model: nothing but neighbours, in minutes",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="of choice: the paraxial model, at wavelengths that a filter passes",
    )
    parser.add_argument("--wrong", action="store_true", help="distance and filters 1 % off")
    parser.add_argument(
        "--moved", type=float, nargs=2, help="px, rows and columns, after calibration"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[21])
    options = parser.parse_args()
    if options.camera == "choice":
        choice(options.cases, options.first, options.superpixels, options.samples, options.quick)
        return
    if options.joint:
        joint(options.camera, options.seeds)
        return
    described = camera_of(options.camera)
    bench = Bench(described, options.superpixels, options.samples, options.lines)
    if options.moved:
        bench.move(options.moved)
    table(bench, options.wrong, options.seeds)
    speed(bench)


if __name__ == "__main__":
    main()
