"""Volumes of phantoms beside pyolaf's (0.2.1, of PyPI, in an environment of its own): error of a
point's column, and of volumes by Richardson-Lucy from the same captures: writes RUN/volume_peer.md.

Run from the project's root, PEER a Python that has pyolaf:
    python pipelines/benchmarks/volume_peer.py --peer PEER --run runs/volume
"""

import argparse
import os
import subprocess
import sys
import tempfile
from itertools import product
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
SAMPLES, PIXELS, INNER = 3, 15, 3
"""Voxels and pixels of a lenslet along an axis; lenslets along the border that are not judged."""


def peer(given, made):
    """In the peer's environment: its columns of a point on the axis, and its volumes."""
    import yaml
    from pyolaf.geometry import LFM_computeGeometryParameters, LFM_setCameraParams
    from pyolaf.lf import LFM_computeLFMatrixOperators
    from pyolaf.project import LFM_backwardProject, LFM_forwardProject

    captures = np.load(given)
    depths, iterations = captures["depths"] * 1e6, int(captures["iterations"])
    camera = {
        "gridType": "reg",
        "focus": "single",
        "plenoptic": 1,
        "uLensMask": 1,
        "M": 60,
        "NA": 1.2,
        "ftl": 200e3,
        "fm": 2500,
        "lensPitch": 100,
        "pixelPitch": 100 / PIXELS,
        "WaveLength": 0.593,
        "n": 1.35,
        "tube2mla": 0,
        "mla2sensor": 0,
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "camera.yaml"
        path.write_text(yaml.safe_dump(camera))
        camera = LFM_setCameraParams(str(path), PIXELS)
    first = next(captures[name] for name in captures.files if name.startswith("capture"))
    size = np.array(first.shape)
    ends, step = [float(depths[0]), float(depths[-1])], float(np.diff(depths)[0])
    lenslets, resolution, _, _ = LFM_computeGeometryParameters(
        camera, np.array([]), ends, step, SAMPLES, False, size
    )
    h, ht = LFM_computeLFMatrixOperators(camera, resolution, lenslets)
    middle = tuple(n // 2 for n in h.shape[:2])
    found = {}
    for z in range(h.shape[2]):
        # of a quarter of the voxels, by symmetry, the last is the one on the axis
        column = h[(h.shape[0] - 1, h.shape[1] - 1, z) if h.shape[0] < SAMPLES else (*middle, z)]
        dense = column.todense() if hasattr(column, "todense") else column
        found[f"column {z}"] = np.asarray(dense)
    texture = np.ceil(size * resolution["texScaleFactor"]).astype(int)
    texture += 1 - texture % 2
    shape, reach = (*texture, h.shape[2]), camera["range"]

    def forward(x):
        return LFM_forwardProject(h, x, lenslets, resolution, size, reach)

    def back(y):
        return LFM_backwardProject(ht, y, lenslets, resolution, texture, reach)

    ones = forward(np.ones(shape, np.float32))
    seen = back(ones)
    for name in captures.files:
        if not name.startswith("capture"):
            continue
        y = np.maximum(captures[name], 0).astype(np.float32)
        y /= y.max()
        x = np.ones(shape, np.float32)
        for _ in range(iterations):
            guess = forward(x)
            ratio = np.nan_to_num(y / guess * ones, posinf=0, neginf=0)
            x = np.nan_to_num(x * back(ratio) / seen, posinf=0, neginf=0)
        found[name.replace("capture", "volume")] = x.transpose(2, 0, 1)
    np.savez(made, **found)


def best(value, truth):
    """SNR (dB) after one scale, at the turn and shift of `value` that serve it best."""
    inner, found = slice(INNER * SAMPLES, -INNER * SAMPLES), -np.inf
    known = truth[:, inner, inner].astype(float)
    size = truth.shape
    for turned, z, y, x in product((False, True), (1, -1), (1, -1), (1, -1)):
        one = value.transpose(0, 2, 1) if turned else value
        one = one[::z, ::y, ::x]
        for shift in product((-1, 0, 1), range(-3, 4), range(-3, 4)):
            moved = np.roll(one, shift, (0, 1, 2))[: size[0], : size[1], : size[2]]
            seen = np.maximum(moved[:, inner, inner], 0).astype(float)
            if seen.shape != known.shape or not seen.any():
                continue
            scale = np.sum(seen * known) / np.sum(seen**2)
            error = np.sum((scale * seen - known) ** 2)
            found = max(found, 10 * np.log10(np.sum(known**2) / error))
    return found


def elsewhere(column, truth):
    """Share of a column's light that is elsewhere, both of light 1 where both are known."""
    half = min(column.shape[0], truth.shape[0]) // 2

    def cut(a):
        middle = a.shape[0] // 2
        part = a[middle - half : middle + half + 1, middle - half : middle + half + 1].astype(float)
        return part / part.sum()

    return 0.5 * np.abs(cut(column) - cut(truth)).sum()


def rows(options):
    """Lines of the table."""
    sys.path[:0] = [str(ROOT), str(ROOT / "pipelines" / "benchmarks")]
    from volume import PHANTOMS, optics, recorded

    from plenocli.base.tiling import to_plane
    from plenocli.forward.volume.lenslets import terms_for
    from plenocli.forward.volume.plan import FINEST, plan_volume
    from plenocli.forward.volume.stack import build_stack
    from plenocli.forward.volume.waves import WavePlane, WaveSettings
    from plenocli.inverse.volume.choose import SOLVERS
    from plenocli.inverse.volume.lattice import map_of, voxels_of
    from plenocli.inverse.volume.measurement import Measurement, Problem

    camera = optics(PIXELS, options.planes)
    count = options.lenslets, options.lenslets
    plan = plan_volume(camera, (SAMPLES, SAMPLES), accuracy=options.accuracy, model="fresnel")
    stack = build_stack(camera, plan)
    op, voxels = map_of(stack, count), voxels_of(stack)
    rng, seen, captures = np.random.default_rng(1), {}, {}
    for name in PHANTOMS:
        seen[name] = recorded(camera, name, SAMPLES, options.lenslets, options.accuracy)
        light = seen[name].light
        sigma = np.sqrt(np.mean(light**2)) * 10 ** (-options.snr / 20)
        captures[name] = light + sigma * rng.standard_normal(light.shape), float(sigma**2)
    with tempfile.TemporaryDirectory() as folder:
        given, made = (str(Path(folder) / name) for name in ("given.npz", "made.npz"))
        planes = {
            f"capture {name}": to_plane(signal, (PIXELS, PIXELS))
            for name, (signal, _) in captures.items()
        }
        np.savez(given, depths=camera.depths, iterations=options.iterations, **planes)
        line = [options.peer, __file__, "--as-peer", given, made]
        done = subprocess.run(line, capture_output=True, text=True)
        if done.returncode:
            sys.exit(done.stderr)
        theirs = dict(np.load(made))
    for z in sorted({0, options.planes // 2, options.planes - 1}):
        reach = plan.reach[z]
        settings = WaveSettings(
            neighbours=FINEST[0],
            pixel_nodes=FINEST[1],
            terms=terms_for(camera, 1e-5),
            reach=reach,
        )
        fine = WavePlane(camera, camera.depths[z], settings)
        side = (2 * reach + 1) * PIXELS
        truth = fine.column(0.0, 0.0)[0].reshape(side, side)
        own = plan.plane(camera, z).column(0.0, 0.0)[0].reshape(side, side)
        # whichever way its depth runs
        both = [theirs[f"column {n}"] for n in (z, options.planes - 1 - z)]
        other = min(elsewhere(column, truth) for column in both)
        yield (
            f"column at {camera.depths[z] * 1e6:+.0f} um, light elsewhere | "
            f"{elsewhere(own, truth):.1e} | | {other:.2f} |"
        )
    for name, (signal, variance) in captures.items():
        problem = Problem(op, Measurement(signal=signal, read_variance=variance), voxels)
        ours = [best(SOLVERS[m](problem).value, seen[name].volume) for m in ("rl", "tv")]
        other = best(theirs[f"volume {name}"], seen[name].volume)
        yield f"{name}, dB | {ours[0]:.1f} | {ours[1]:.1f} | {other:.1f} |"


def main():
    """Make the table, print it and keep it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--as-peer", nargs=2, metavar=("GIVEN", "MADE"), help=argparse.SUPPRESS)
    parser.add_argument("--peer", default=sys.executable)
    parser.add_argument("--run", type=Path, default=Path("runs/volume"))
    parser.add_argument("--lenslets", type=int, default=15)
    parser.add_argument("--planes", type=int, default=9)
    parser.add_argument("--iterations", type=int, default=30)
    parser.add_argument("--snr", type=float, default=40.0)
    parser.add_argument("--accuracy", type=float, default=5e-3)
    options = parser.parse_args()
    if options.as_peer:
        peer(*options.as_peer)
        return
    head = (
        f"{options.lenslets}x{options.lenslets} lenslets of {PIXELS}x{PIXELS} pixels, "
        f"{options.planes} planes 1 um apart, 60x/1.2, {options.snr:g} dB, simulated twice finer; "
        f"pyolaf 0.2.1 with {options.iterations} iterations, turned and shifted as serves it best."
        "\n\n| | Richardson-Lucy | total variation | pyolaf |\n|---|---|---|---|\n"
    )
    print(head, end="", flush=True)
    lines = []
    for row in rows(options):
        lines.append(f"| {row}")
        print(lines[-1], flush=True)
    options.run.mkdir(parents=True, exist_ok=True)
    (options.run / "volume_peer.md").write_text(head + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
