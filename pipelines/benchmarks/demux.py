"""How long demux takes for a 24-megapixel Bayer DNG, beside LibRaw's decoding of the same file, and
what a batch costs.

RUN gets the captures of a DSLR with a lenslet array (sample_configs/dslr.toml: 52-pixel
superpixels, four bands, 6000 x 4000 pixels) and their calibrations, made once. Then, in a child
process for each kind of calibration, LibRaw's decoding, the product's reading, demultiplexing and
writing are timed apart, rounds interleaved; and a batch of files with one worker and with two. CPU
seconds (user + system) of single-threaded BLAS; wall seconds stand beside them and mean something
only on an idle machine. Run from the project's root: python pipelines/benchmarks/demux.py --help.
"""

import argparse
import copy
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

from plenocli.files import outside  # noqa: E402

SIZE = (4000, 6000)
EXPOSURE = 0.01
SHIFT = (0.3, -0.2)  # px, of the capture called moved
BANDS = ("450nm", "540nm", "570nm", "650nm")
KINDS = {"shared": "one F for all lenslets", "each": "an F for every lenslet"}


def main():
    """Parse, make what is missing, measure, print and keep RUN/demux.json."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "run", type=Path, help="folder for captures, calibrations and results (about 1.5 GB)"
    )
    parser.add_argument("--rounds", type=int, default=6, help="interleaved rounds (default 6)")
    parser.add_argument(
        "--files", type=int, default=20, help="captures of the batch (default 20; 0: no batch)"
    )
    parser.add_argument("--child", choices=KINDS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(measure(options.run, options.child, options.rounds)))
        return
    options.run.mkdir(parents=True, exist_ok=True)
    make(options.run)
    found = {}
    for kind in KINDS:
        command = [
            sys.executable,
            __file__,
            str(options.run),
            "--child",
            kind,
            "--rounds",
            str(options.rounds),
        ]
        found[kind] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
        show(kind, found[kind])
    if options.files:
        found["batch"] = {kind: batch(options.run, kind, options.files) for kind in KINDS}
    (options.run / "demux.json").write_text(json.dumps(found, indent=1))


# --- captures -------------------------------------------------------------------------------------


def make(run):
    """The captures and both calibrations, if they are not there."""
    if not (run / "moved.dng").exists():
        captures(run)
    for kind in KINDS:
        target = run / f"{kind}.h5"
        if not target.exists():
            words = [f"--band={b}={run / f'band-{b}.dng'}" for b in BANDS] + [
                f"--response={'shared' if kind == 'shared' else 'own'}"
            ]
            plenocli(
                "calibrate",
                f"--white={run / 'white.dng'}",
                f"--dark={run / 'dark.dng'}",
                *words,
                "-o",
                str(target),
                "--overwrite",
            )


def captures(run):
    """White, dark, narrow-band and scene captures: predicted superpixels on a sensor of SIZE,
    with the sensor's noise.
    """
    from plenocli.files.config.camera_file import load_camera
    from plenocli.files.images.dng import write_dng
    from plenocli.forward.scene.tables import surfaces
    from plenocli.forward.sensor.detector import SensorModel

    camera = load_camera(ROOT / "sample_configs" / "dslr.toml").replace(
        **{"lenslet_array.count": (2, 2)}
    )
    light, moved = (
        np.stack(part) for part in zip(*(superpixel(camera, f"mono:{band}") for band in BANDS))
    )
    shape = light.shape[1:]
    count = [n // p for n, p in zip(SIZE, shape)]
    light, moved = (
        part * 0.8 * camera.sensor.full_well / light.sum(axis=0).max() for part in (light, moved)
    )
    model, rng = SensorModel.from_camera(camera), np.random.default_rng(0)
    reflectance = surfaces(np.array([float(b[:-2]) * 1e-9 for b in BANDS]))
    patches = reflectance[
        rng.integers(len(reflectance), size=(count[0] // 8 + 1, count[1] // 8 + 1))
    ]
    scene = patches.repeat(8, axis=0).repeat(8, axis=1)[: count[0], : count[1]]
    shots = {
        "white": np.ones(4),
        "dark": np.zeros(4),
        **{f"band-{b}": np.eye(4)[k] for k, b in enumerate(BANDS)},
        "shot": scene,
        "moved": scene,
    }
    for name, radiance in shots.items():
        if (run / f"{name}.dng").exists():
            continue
        electrons = np.zeros(SIZE)
        top, left = ((n - c * p) // 4 * 2 for n, c, p in zip(SIZE, count, shape))
        picture = np.einsum(
            "rcb,byx->rycx",
            np.broadcast_to(radiance, (*count, 4)),
            moved if name == "moved" else light,
            optimize=True,
        )
        electrons[top : top + count[0] * shape[0], left : left + count[1] * shape[1]] = (
            picture.reshape(count[0] * shape[0], -1)
        )
        levels = dict(
            cfa=camera.sensor.cfa,
            black=camera.sensor.black_level,
            white=model.white_level,
            exposure_s=EXPOSURE,
        )
        write_dng(
            run / f"{name}.dng",
            model.expose(electrons, rng),
            **levels,
            xmp_json={"gain_e_per_dn": 1 / camera.sensor.gain},
            overwrite=True,
        )


def superpixel(camera, target):
    """Light (rows, columns) of one superpixel on the mosaic for a uniform object, as capture-sim
    carries it, and moved by SHIFT.
    """
    from scipy.ndimage import shift

    from plenocli.forward.sensor.cfa import cfa_map
    from plenocli.forward.sensor.exposure.carried_light import carry_light
    from plenocli.stages.forward.capture_sim import Settings, _source

    settings = Settings(target=target, superpixels=(3, 3), model="fresnel", accuracy=1e-3)
    light = carry_light(camera, *_source(camera, settings, None), settings.options, None)
    shape = camera.sensor.pixels_per_lenslet
    where = cfa_map(shape, camera.sensor.cfa)
    planes = [plane.reshape(shape) for plane in light.white]
    moved = [np.maximum(shift(plane, SHIFT, order=5), 0) for plane in planes]
    return tuple(
        sum(np.where(where == letter, plane, 0.0) for letter, plane in zip(light.colours, part))
        for part in (planes, moved)
    )


# --- measurements ---------------------------------------------------------------------------------


class Clock:
    """CPU and wall seconds by name, this process and its children."""

    def __init__(self):
        self.cpu, self.wall = {}, {}

    def time(self, name, work):
        """What `work()` returns, its time noted."""
        before, start = _cpu(), time.perf_counter()
        result = work()
        self.wall.setdefault(name, []).append(time.perf_counter() - start)
        self.cpu.setdefault(name, []).append(_cpu() - before)
        return result

    def medians(self):
        """Name -> [CPU, wall], medians, s."""
        return {
            name: [float(np.median(self.cpu[name])), float(np.median(self.wall[name]))]
            for name in self.cpu
        }


def _cpu():
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    # the clock of another process, as clock_getcpuclockid(3) names it: children that wait for the
    # next file are not counted before they end
    waiting = sum(time.clock_gettime((~child.pid << 3) | 2) for child in outside._idle)
    return sum(u.ru_utime + u.ru_stime for u in used) + waiting


def measure(run, kind, rounds):
    """Seconds of every part, and peak memory, of demultiplexing one capture with one
    kind of calibration.
    """
    import rawpy

    from plenocli.files.artefacts.provenance import describe_inputs
    from plenocli.files.images.mosaic import read_capture
    from plenocli.stages.inverse.demux import CaptureDemultiplexer, Settings

    clock, shot = Clock(), run / "shot.dng"

    def decode():
        with rawpy.imread(str(shot)) as raw:
            return raw.raw_image_visible.copy()

    worker = clock.time(
        "prepare", lambda: CaptureDemultiplexer(run / f"{kind}.h5", Settings(), {}, True, "")
    )
    exposure = read_capture(shot, cfa=worker.solver.responses.cfa)
    # and what it leaves for the others
    clock.time("first", lambda: worker.solver.estimate(exposure, shot))
    plain = unregistered(worker.solver)
    for _ in range(rounds):
        clock.time("decode", decode)
        exposure = clock.time("read", lambda: read_capture(shot, cfa=worker.solver.responses.cfa))
        found = clock.time("demux", lambda: worker.solver.estimate(exposure, shot))
        clock.time("demux, not registered", lambda: plain.estimate(exposure, shot))
        clock.time(
            "write",
            lambda: worker.write(
                (found, describe_inputs({"capture": shot})), shot, run / "shot.exr"
            ),
        )
    elsewhere = read_capture(run / "moved.dng", cfa=worker.solver.responses.cfa)
    for _ in range(2):
        away = clock.time(
            "demux, moved", lambda: worker.solver.estimate(elsewhere, run / "moved.dng")
        )
    parts = clock.medians()
    ratio = sorted(d / max(e, 1e-9) for d, e in zip(clock.cpu["demux"], clock.cpu["decode"]))
    return {
        "seconds": parts,
        "ratio": float(np.median(ratio)),
        "ratios": ratio,
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "method": found.method,
        "corrected": list(away.trace.registration.corrected),
        "shift": away.trace.registration.motion.shift.tolist(),
        "load": os.getloadavg()[0],
    }


def unregistered(solver):
    """A Demultiplexer that shares everything with another but does not look for motion."""
    other = copy.copy(solver)
    other.register = "off"
    return other


def show(kind, found):
    """A few lines for a person."""
    print(f"{KINDS[kind]} (method {found['method']}, load {found['load']:.1f}):")
    for name, (cpu, wall) in found["seconds"].items():
        print(f"  {name:22s} {cpu:7.3f} s CPU {wall:7.3f} s wall")
    print(
        f"  the moved capture: corrected {', '.join(found['corrected'])}, by "
        f"{found['shift'][0]:.4f} and {found['shift'][1]:.4f} px for {SHIFT}"
    )
    print(
        f"  demux / decode {found['ratio']:.2f} (rounds "
        f"{', '.join(f'{r:.2f}' for r in found['ratios'])}); peak {found['peak_mib']:.0f} MiB"
    )


def batch(run, kind, files):
    """CPU and wall seconds of one command for `files` captures, with one and with two workers."""
    shots = run / "shots"
    shots.mkdir(exist_ok=True)
    for number in range(files):
        link = shots / f"shot{number:02d}.dng"
        if not link.exists():
            os.link(run / "shot.dng", link)
    found = {}
    for workers in (1, 2):
        out = run / f"out{workers}"
        shutil.rmtree(out, ignore_errors=True)
        before, start = _cpu(), time.perf_counter()
        plenocli(
            "demux",
            *(str(shots / f"shot{n:02d}.dng") for n in range(files)),
            f"--calibration={run / f'{kind}.h5'}",
            f"--workers={workers}",
            "-o",
            str(out),
        )
        found[workers] = [_cpu() - before, time.perf_counter() - start]
    (one, one_wall), (two, two_wall) = found[1], found[2]
    print(
        (
            f"{files} files, {KINDS[kind]}: 1 worker {one:.1f} s CPU {one_wall:.1f} s wall, 2 "
            f"workers {two:.1f} s CPU {two_wall:.1f} s wall: wall ratio {one_wall / two_wall:.2f}, "
            f"load {os.getloadavg()[0]:.1f}"
        ),
        flush=True,
    )
    return {"1": found[1], "2": found[2]}


def plenocli(*words):
    """Run the command line in a process of its own."""
    subprocess.run(
        [sys.executable, "-m", "plenocli", *words], check=True, cwd=ROOT, stdout=subprocess.DEVNULL
    )


if __name__ == "__main__":
    main()
