"""Volumes of phantoms before a microscope's lenslets: processor's seconds and those on the clock,
memory and error of every solver, and of its bars: writes RUN/volume.md.

Run from the project's root: python pipelines/benchmarks/volume.py --run runs/volume
"""

import argparse
import math
import os
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np  # noqa: E402

from plenocli.base.budget import budget, set_budget  # noqa: E402
from plenocli.forward.volume.optics import VolumeOptics  # noqa: E402
from plenocli.forward.volume.phantoms import Region, phantom  # noqa: E402
from plenocli.forward.volume.plan import plan_volume  # noqa: E402
from plenocli.forward.volume.recording import finer, record  # noqa: E402
from plenocli.forward.volume.stack import build_stack  # noqa: E402
from plenocli.inverse.volume.choose import SOLVERS  # noqa: E402
from plenocli.inverse.volume.lattice import map_of, voxels_of  # noqa: E402
from plenocli.inverse.volume.measurement import Measurement, Problem  # noqa: E402

PHANTOMS = "beads", "shells", "filaments"
METHODS = "rl", "lmmse", "tv", "tikhonov"
REFINE = 2
"""Times finer than it is inverted a phantom is simulated, in all directions."""
OBJECT = 0.1
"""Share of the brightest voxel from which on a voxel belongs to the specimen."""
INNER = 5
"""Lenslets along the border that are not judged."""


def optics(pixels, planes):
    """A 60x/1.2 water objective before lenslets of 100 um: planes 1 um apart."""
    depths = tuple((np.arange(planes) - (planes - 1) / 2) * 1e-6)
    return VolumeOptics(
        wavelength=593e-9,
        aperture=1.2,
        index=1.35,
        magnification=60,
        pitch=100e-6,
        open_width=100e-6,
        focal_length=2.5e-3,
        sensor_distance=2.5e-3,
        pupil_distance=math.inf,
        pixels=(pixels, pixels),
        pixel_width=1.0,
        depths=depths,
        places=depths,
        scales=(1.0,) * planes,
        apodised=True,
    )


def recorded(camera, name, samples, lenslets, accuracy):
    """A phantom's light and its voxels, simulated finer."""
    half = (camera.depths[-1] - camera.depths[0]) / 2, *[19 / 2 * camera.object_pitch] * 2
    region = Region(half=half, middle=0.0, unit=camera.object_pitch)
    fine, plan = finer(camera, (samples, samples), REFINE, accuracy, "fresnel")
    return record(fine, plan, (lenslets, lenslets), phantom(name, region), REFINE)


def judged(volume, truth, samples):
    """Correlation and signal to noise (dB) after one scale, and the share that 95 % bars hold, of
    all voxels and of the specimen's.
    """
    inner = slice(INNER * samples, -INNER * samples)
    value, truth = (v[:, inner, inner].astype(float) for v in (volume.value, truth))
    positive = np.maximum(value, 0)
    scale = np.sum(positive * truth) / np.sum(positive**2)
    snr = 10 * np.log10(np.sum(truth**2) / np.sum((scale * positive - truth) ** 2))
    held = "", ""
    if volume.sigma is not None:
        within = np.abs(value - truth) < 1.96 * volume.sigma[:, inner, inner]
        held = tuple(
            f"{np.mean(within[at]):.0%}" for at in (truth == truth, truth > OBJECT * truth.max())
        )
    return np.corrcoef(positive.ravel(), truth.ravel())[0, 1], snr, *held


class Watch:
    """Seconds since it was made: of the processor, on the clock."""

    def __init__(self):
        self.start = time.process_time(), time.perf_counter()

    def read(self, parts=1):
        """The text of both, of one of some equal parts."""
        spent, passed = time.process_time() - self.start[0], time.perf_counter() - self.start[1]
        digits = 1 if parts == 1 else 3
        return f"{spent / parts:.{digits}f} / {passed / parts:.{digits}f}"


def rows(options):
    """Lines of the table."""
    camera, samples = optics(options.pixels, options.planes), 3
    count = options.lenslets, options.lenslets
    watch = Watch()
    plan = plan_volume(camera, (samples, samples), accuracy=options.accuracy, model="fresnel")
    stack = build_stack(camera, plan)
    yield f"kernels within {plan.error:.1e} | | {watch.read()} | | | | | |"
    watch = Watch()
    op = map_of(stack, count)
    size = f"torus {op.torus[0]}x{op.torus[1]}, {op.spectrum.nbytes / 2**20:.0f} MiB"
    yield f"spectrum, {size} | | {watch.read()} | | | | | |"
    voxels = voxels_of(stack)
    del stack  # what is left is as much as a reader of its file would keep
    rng = np.random.default_rng(1)
    for name in options.phantom or PHANTOMS:
        seen = recorded(camera, name, samples, options.lenslets, options.accuracy)
        sigma = np.sqrt(np.mean(seen.light**2)) * 10 ** (-options.snr / 20)
        signal = seen.light + sigma * rng.standard_normal(seen.light.shape)
        problem = Problem(op, Measurement(signal=signal, read_variance=float(sigma**2)), voxels)
        for method in options.method or METHODS:
            watch = Watch()
            volume = SOLVERS[method](problem)
            seconds, each = watch.read(), watch.read(len(volume.trace))
            correlation, snr, held, held_on = judged(volume, seen.volume, samples)
            each = f" ({each} a step)" if method == "rl" else ""
            yield (
                f"{name} | {method} | {seconds}{each} | {correlation:.3f} | {snr:.1f} | "
                f"{volume.held_out.explained_db:.1f} | {held} | {held_on} |"
            )


def main():
    """Make the table, print it and keep it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, default=Path("runs/volume"))
    parser.add_argument("--lenslets", type=int, default=29)
    parser.add_argument("--pixels", type=int, default=16)
    parser.add_argument("--planes", type=int, default=25)
    parser.add_argument("--snr", type=float, default=40.0)
    parser.add_argument("--accuracy", type=float, default=5e-3)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--phantom", action="append", choices=PHANTOMS)
    parser.add_argument("--method", action="append", choices=METHODS)
    options = parser.parse_args()
    set_budget(replace(budget(), threads=options.threads))
    head = (
        f"{options.lenslets}x{options.lenslets} lenslets of {options.pixels}x{options.pixels} "
        f"pixels, {options.planes} planes 1 um apart, 3x3 voxels a lenslet, {options.snr:g} dB, "
        f"simulated {REFINE} times finer; seconds of the processor / on the clock, "
        f"{options.threads} threads.\n\n"
        "| phantom | method | seconds | correlation | SNR dB | held-out dB | in 95 % bars | "
        "of the specimen |\n|---|---|---|---|---|---|---|---|\n"
    )
    print(head, end="", flush=True)
    lines = []
    for row in rows(options):
        lines.append(f"| {row}")
        print(lines[-1], flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    last = f"\nMost memory: {peak:.2f} GiB.\n"
    print(last)
    options.run.mkdir(parents=True, exist_ok=True)
    (options.run / "volume.md").write_text(head + "\n".join(lines) + "\n" + last)


if __name__ == "__main__":
    main()
