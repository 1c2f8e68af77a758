"""Time, memory and bytes of whole sensors: capture-sim, reconstruct, demux and refocus against
lenslets, points, workers and device.

Cameras are seed_spatial with more lenslets (`seed`: 52x52 pixels and 40x40 points a lenslet, or
`small`: 15x15 and 12x12), the scene is the astronaut spread over all lenslets at 50 dB; methods are
those of reconstruct, and `refocus`. `spectral` is seed_spectral with 15x15 pixels a lenslet, which
is calibrated (a response of its own for every lenslet); methods are those of demux. `microscope`
is sample_configs/microscope with four planes of 2x2 voxels and 15x15 pixels a lenslet; its capture
is that of beads before 32x32 lenslets, side by side; methods are those of volume. Every
command is a process of its own, of one thread; its CPU seconds (user and system, workers
included), seconds by the clock, its highest resident memory and the bytes of its file are lines
of RUN/scale.jsonl. What stands there is not measured again. RUN/scale.md has the table, with the
exponents of time and memory by least squares of their logarithms from the second size on, and
what they say of 130,000 lenslets where that was not run. With an --old tree of the sources, that
is measured, too, in turn.

Run from the project's root:
python pipelines/benchmarks/scale.py RUN --kind small --lenslets 1024 4096 16384 65536 129960
python pipelines/benchmarks/scale.py RUN --kind spectral --methods pinv --mem-limit 512MiB \
    --lenslets 16384 65536 129960
python pipelines/benchmarks/scale.py RUN --kind microscope --methods rl lmmse --mem-limit 512MiB \
    --lenslets 1024 16384 65536 129960
"""

import argparse
import json
import math
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BESIDE = 32
"""Lenslets along each side of the capture that a microscope's captures are made of."""
VOLUME = {
    '"-12 um to 12 um step 1 um"': '["-6 um", "-3 um", "3 um", "6 um"]',
    "samples_per_lenslet = [3, 3]": "samples_per_lenslet = [2, 2]",
    "count = [29, 29]": f"count = [{BESIDE}, {BESIDE}]",
}
SMALL = {
    "samples_per_lenslet = [40, 40]": "samples_per_lenslet = [12, 12]",
    "samples_per_lenslet = [12, 12] ": "samples_per_lenslet = [6, 6] ",
    "pixels_per_lenslet = [52, 52]": "pixels_per_lenslet = [15, 15]",
    '"104 um"': '"30 um"',
    '"832 um"': '"240 um"',
}
BANDS = "450nm", "540nm", "570nm", "650nm"
WHOLE = 130_000
ON_DEVICE = "pnp", "auto"


def described(kind, lenslets):
    """The camera's description, TOML, and how many lenslets it has: as square as can be."""
    name = "seed_spectral" if kind == "spectral" else "seed_spatial"
    text = (ROOT / f"sample_configs/{name}.toml").read_text()
    for old, new in SMALL.items() if kind != "seed" else ():
        text = text.replace(old, new)
    rows = int(lenslets**0.5)
    columns = max(1, round(lenslets / rows))
    there = r"(?m)^count = \[\d+, \d+\]"
    return re.sub(there, f"count = [{rows}, {columns}]", text), rows * columns


def measured(tree, command):
    """(CPU s, clock s, KiB) of a command of the sources in `tree`; RuntimeError where it fails."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    environment = os.environ | threads | {"PYTHONPATH": str(tree)}
    program = [sys.executable, "-m", "plenocli", "--quiet", *map(str, command)]
    start = time.perf_counter()
    process = subprocess.Popen(program, env=environment, cwd="/", stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(f"{' '.join(map(str, command))} ended with {status}")
    return used.ru_utime + used.ru_stime, time.perf_counter() - start, used.ru_maxrss


def commands(run, kind, lenslets, chosen):
    """(name, command, its file) of one size; the matrix serves all sizes of a kind."""
    if kind in ("spectral", "microscope"):
        of_kind = spectral_commands if kind == "spectral" else volume_commands
        yield from of_kind(run, lenslets, chosen)
        return
    text, count = described(kind, lenslets)
    superpixels, limit = chosen.superpixels, chosen.mem_limit
    kind = f"{kind}-{superpixels}"
    camera, pif = run / f"{kind}-{count}.toml", run / f"{kind}-pif.h5"
    camera.write_text(text)
    if not pif.exists():
        measured(ROOT, ["simulate-pif", camera, "--superpixels", superpixels, "-o", pif])
    shot, limits = run / f"{kind}-{count}.h5", ["--mem-limit", limit, "--overwrite"]
    scene = ["--scene", "skimage:astronaut", "--pif", pif, "--snr", "50dB"]
    yield count, "capture-sim", ["capture-sim", camera, *scene, "-o", shot, *limits], shot
    for method in chosen.methods:
        out = run / f"{kind}-{count}-{method}.h5"
        options = ["--pif", pif, "--method", method]
        options += ["--device", chosen.device] if method in ON_DEVICE else []
        command = ["refocus", shot] if method == "refocus" else ["reconstruct", shot, *options]
        yield count, method, [*command, "-o", out, *limits], out


def spectral_commands(run, lenslets, chosen):
    """As commands, of demux; targets and calibration are made beside the capture."""
    text, count = described("spectral", lenslets)
    camera, limits = run / f"spectral-{count}.toml", ["--mem-limit", chosen.mem_limit]
    camera.write_text(text)

    def take(what, name):
        shot = run / f"spectral-{count}-{name}.h5"
        expose = ["capture-sim", camera, *what, "--superpixels", "1x1"]
        return [*expose, "-o", shot, "--overwrite"], shot

    command, shot = take(["--scene", "skimage:astronaut"], "shot")
    yield count, "capture-sim", [*command, *limits], shot
    calibration = run / f"spectral-{count}-calibration.h5"
    if not calibration.exists():
        of = {}
        for name in ("white", "dark", *BANDS):
            command, of[name] = take(["--target", f"mono:{name}" if name in BANDS else name], name)
            measured(ROOT, command)
        bands = [word for band in BANDS for word in ("--band", f"{band}={of[band]}")]
        frames = ["--white", of["white"], "--dark", of["dark"], *bands]
        measured(ROOT, ["calibrate", *frames, "--response", "own", "-o", calibration])
    for method in chosen.methods:
        out = run / f"spectral-{count}-{method}.h5"
        options = ["--calibration", calibration, "--method", method, "-o", out, "--overwrite"]
        yield count, f"demux {method}", ["demux", shot, *options, *limits], out


def volume_commands(run, lenslets, chosen):
    """As commands, of volume; kernels and a small capture are made once."""
    text = (ROOT / "sample_configs/microscope.toml").read_text()
    for old, new in VOLUME.items():
        text = text.replace(old, new)
    camera, pif, beads = (run / f"microscope{end}" for end in (".toml", "-pif.h5", "-beads.h5"))
    camera.write_text(text)
    if not beads.exists():
        measured(ROOT, ["simulate-pif", camera, "-o", pif, "--overwrite"])
        expose = ["capture-sim", camera, "--volume", "phantom:beads", "--snr", "40dB"]
        measured(ROOT, [*expose, "-o", beads])
    rows = int(lenslets**0.5)
    count = rows, round(lenslets / rows)
    lenslets = count[0] * count[1]
    shot = run / f"microscope-{lenslets}.h5"
    if not shot.exists():
        side_by_side(beads, count, shot)
    for method in chosen.methods:
        out = run / f"microscope-{lenslets}-{method}.h5"
        command = ["volume", shot, "--pif", pif, "--method", method, "-o", out, "--overwrite"]
        yield lenslets, f"volume {method}", [*command, "--mem-limit", chosen.mem_limit], out


def side_by_side(beads, count, path):
    """Write a capture of `count` (rows, columns) lenslets that repeats a small one."""
    import numpy as np

    sys.path.insert(0, str(ROOT))
    from plenocli.base.tiling import InParts
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.files.images.mosaic import read_capture, write_capture

    small = read_capture(beads)
    rows, columns = (n * s for n, s in zip(count, small.grid.shape))
    # in bands: what this process takes counts for those that it starts
    across = np.tile(small.mosaic, (1, -(-count[1] // BESIDE)))[:, :columns]
    whole = InParts(
        shape=(rows, columns),
        dtype=across.dtype,
        parts=lambda: (across[: rows - top] for top in range(0, rows, len(across))),
    )
    grid = replace(small.grid, count=count, centre=None)
    made = replace(small, mosaic=whole, grid=grid)
    write_capture(path, made, Provenance(command="side by side"))


def exponents(lines):
    """(of time, of memory) of lines of one command by lenslets, None for less than two sizes."""
    import numpy as np

    sizes = sorted({line["lenslets"] for line in lines})[1:]
    points = [line for line in lines if line["lenslets"] in sizes]
    if len(sizes) < 2:
        return None
    logs = np.log([line["lenslets"] for line in points])
    return [np.polyfit(logs, np.log([line[n] for line in points]), 1) for n in ("cpu", "kib")]


def table(lines):
    """Markdown of all lines."""
    names = "camera, code, command, lenslets, CPU s, clock s, peak MiB, file MiB".split(", ")
    rows = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    groups = {}
    for line in lines:
        groups.setdefault((line["kind"], line["code"], line["command"]), []).append(line)
    for key, group in sorted(groups.items()):
        for line in sorted(group, key=lambda one: one["lenslets"]):
            figures = line["cpu"], line["clock"], line["kib"] / 1024, line["bytes"] / 2**20
            told = " | ".join(f"{figure:.3g}" for figure in figures)
            rows.append(f"| {' | '.join(key)} | {line['lenslets']} | {told} |")
        fitted = exponents(group)
        if fitted is None:
            continue
        law = "CPU seconds grow as n^{:.2f}, memory as n^{:.2f}".format(*(e for e, _ in fitted))
        if max(line["lenslets"] for line in group) < 0.9 * WHOLE:
            seconds, kib = (math.exp(c) * WHOLE**e for e, c in fitted)
            law += f"; by that {WHOLE} lenslets take {seconds:.3g} s and {kib / 1024:.3g} MiB"
        rows.append(f"| {' | '.join(key)} | | {law} | | | |")
    return "\n".join(rows) + "\n"


def main():
    """Measure what is not measured yet, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("run", type=Path)
    kinds = ["seed", "small", "spectral", "microscope"]
    parser.add_argument("--kind", choices=kinds, default="small")
    parser.add_argument("--lenslets", type=int, nargs="+", default=[121, 1024, 4096])
    parser.add_argument("--methods", nargs="+", default=["lmmse"])
    parser.add_argument("--workers", type=int, nargs="+", default=[1])
    parser.add_argument("--superpixels", default="1x1", help="that the matrix knows")
    parser.add_argument("--mem-limit", default="2GiB")
    parser.add_argument("--device", default="cpu", help="of " + " and ".join(ON_DEVICE))
    parser.add_argument("--old", type=Path, help="sources to compare with")
    chosen = parser.parse_args()
    chosen.run.mkdir(parents=True, exist_ok=True)
    run = chosen.run.resolve()
    log = run / "scale.jsonl"
    lines = [json.loads(text) for text in log.read_text().splitlines()] if log.exists() else []
    trees = {"new": ROOT} | ({"old": chosen.old.resolve()} if chosen.old else {})
    kind = f"{chosen.kind} {chosen.superpixels}"
    if chosen.kind in ("spectral", "microscope"):
        kind = chosen.kind
    for lenslets in chosen.lenslets:
        jobs = commands(run, chosen.kind, lenslets, chosen)
        for count, name, command, file in jobs:
            for workers in chosen.workers if name != "capture-sim" else [1]:
                shared = [] if workers == 1 else ["--workers", workers]
                told = f"{name}, {workers} workers" if shared else name
                elsewhere = name in ON_DEVICE and chosen.device != "cpu"
                told = f"{told}, {chosen.device}" if elsewhere else told
                for code, tree in trees.items():
                    about = dict(kind=kind, code=code, command=told, lenslets=count)
                    if any(about.items() <= line.items() for line in lines) and file.exists():
                        continue
                    cpu, clock, kib = measured(tree, [*command, *shared])
                    size = file.stat().st_size
                    line = about | dict(cpu=cpu, clock=clock, kib=kib, bytes=size)
                    lines.append(line)
                    with log.open("a") as stream:
                        stream.write(json.dumps(line) + "\n")
                    print(line, flush=True)
    (run / "scale.md").write_text(table(lines))


if __name__ == "__main__":
    main()
