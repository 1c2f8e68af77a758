"""Demultiplexing where neighbouring lenslets differ: captures of the spectral cameras with 20x20
pixels behind 12x16 lenslets, scenes of random reflectances (CIE 224 surfaces of random brightness),
errors of `demux --method auto` and of the pseudo-inverse against the reflectance that the filters
let through and against the answer for an even object, with the stated errors; and the time of one
solution for 10,000 lenslets. Captures come from the exact model over --superpixels and --samples
points, the neighbours' light from the description (12 points), with the sensor 1 % further away and
the filters 1 % larger where --wrong says so.

    python pipelines/benchmarks/neighbours.py four
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
        size, off = SCENES[self.kind]
        i, j = (
            np.floor(((np.arange(n) + 0.5) / n * count + off) / size).astype(int)
            for n, count in zip((rows, columns), COUNT)
        )
        values = np.array([np.interp(wavelength, self.own, one) for one in self.spectra])
        return values[self.order[(i[:, None] * 37 + j[None]) % 4000]].astype(np.float32)


class Bench:
    """One camera, its captures and its calibration."""

    def __init__(self, name, superpixels, samples):
        from plenocli.files.read.cameras import read_camera
        from plenocli.forward.accuracy.dial import pif_builder
        from plenocli.forward.scene.light import broadband
        from plenocli.forward.scene.tables import illuminant
        from plenocli.forward.sensor.exposure import StoredMatrix

        self.described = read_camera(ROOT / "sample_configs" / CAMERAS[name]).replace(
            **{
                "lenslet_array.count": COUNT,
                "sensor.pixels_per_lenslet": (20, 20),
                "sensor.pixel_pitch": 5.2e-6,
            }
        )
        self.samples = samples
        self.camera = self.described.replace(**{"object.samples_per_lenslet": (samples, samples)})
        self.light = broadband(self.camera, lambda w: illuminant("D65", w), None)
        self.matrices = {}
        for w in {*map(float, self.light.wavelengths), *self.camera.light.wavelengths}:
            builder = pif_builder(self.camera, w, superpixels=(superpixels, superpixels))
            matrix = np.concatenate([block for _, block in builder.blocks()], axis=2)
            self.matrices[w] = StoredMatrix(matrix, builder.offsets)
        self.calibration, white = self._calibrated()
        from plenocli.inverse.spectra.demultiplexer import Demultiplexer

        alone = Demultiplexer(self.calibration, method="pinv", ratio=True)
        self.white = np.median(alone.estimate(white, "white").value, axis=(1, 2), keepdims=True)

    def shoot(self, scene, seed, exposure=1.0, light=None):
        """One capture."""
        from plenocli.forward.sensor.exposure import ExposureOptions, simulate_capture

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
        from plenocli.forward.camera.pupil import filter_transmittance

        back = np.linalg.pinv(np.asarray(self.calibration.response.matrix, float))
        filters = self.camera.filter_array.filters
        through, even = [], []
        for photons, w in zip(self.light.photons, self.light.wavelengths):
            through.append([photons * filter_transmittance(f, w) for f in filters])
            light = self.matrices[float(w)].matrix.sum(axis=(0, 2), dtype=float)
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


def speed(bench):
    """CPU seconds of both solutions for 100 x 100 lenslets of 400 pixels."""
    from plenocli.inverse.spectra.coupled import coupled, fine
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
        fine(large, first)
        end = time.process_time()
        print(
            f"10,000 lenslets of 400 pixels, {len(light.offsets)} superpixels a lenslet: coupled "
            f"{middle - start:.2f} s ({'with' if fit else 'without'} its fit), fine after it "
            f"{end - middle:.2f} s of CPU"
        )


def main():
    """Parse, make the captures, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("camera", choices=CAMERAS)
    parser.add_argument("--superpixels", type=int, default=3, help="a side, of the captures")
    parser.add_argument("--samples", type=int, default=12, help="points a side, of the captures")
    parser.add_argument("--wrong", action="store_true", help="distance and filters 1 % off")
    parser.add_argument("--seeds", type=int, nargs="+", default=[21])
    options = parser.parse_args()
    bench = Bench(options.camera, options.superpixels, options.samples)
    table(bench, options.wrong, options.seeds)
    speed(bench)


if __name__ == "__main__":
    main()
