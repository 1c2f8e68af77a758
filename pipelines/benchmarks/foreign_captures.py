"""Random cameras from end to end: what every method of reconstruct makes of their captures, over
the mean of each lenslet.

Pupils, lenslets, pixels, points, wavelengths and aberrations are drawn at random, and for each
camera a photograph and a noise. It is captured with points twice as fine as it is inverted, to 1e-4
(isolated lenslets) or 1e-2 (with neighbours' light), by the camera as described (right) or by
another one: out of focus by 0.2 to 2 %, with the sensor 0.1 to 1 % too far or too near, with pixels
up to 0.3 aside, or with neighbours' light that the matrix lacks (leak). Everything goes through the
commands.

Appends a line to RUN/foreign_captures.jsonl for each camera, leaves out those that stand there
already, and writes a table of all to RUN/foreign_captures.md. Run from the project's root:
python pipelines/benchmarks/foreign_captures.py FOLDER/*.png --cameras 100
"""

import argparse
import contextlib
import io
import json
import os
import random
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

METHODS = ("block-mean", "lmmse", "pnp", "tv", "tikhonov", "auto")
KINDS = ("right", "right", "focus", "shift", "sensor", "leak")
ALONE = ("--superpixels", "1x1", "--coherent-ring", "0", "--accuracy", "1e-4")
BESIDE = ("--accuracy", "1e-2")
LOST = 0.2
"""dB below the mean of each lenslet from which on a picture counts as worse than none."""


def drawn(rng):
    """(values of a description, whether it has aberrations)."""
    pixels, f_number = rng.choice([10, 12, 14, 16, 20]), rng.choice([2.8, 4, 4.4, 5.6, 8, 11, 16])
    pixel = rng.uniform(1.5, 5)
    focal = rng.uniform(20, 80)
    far = focal * rng.uniform(4, 30)
    values = {
        "f": focal,
        "f_number": f_number,
        "far": far,
        "image": 1 / (1 / focal - 1 / far),
        "object": far * rng.choice([1, 1, rng.uniform(0.97, 1.03)]),
        "points": rng.choice([8, 10, 12, 14, 16, 20]),
        "pixels": pixels,
        "pixel": pixel,
        "pitch": pixels * pixel,
        "lenslet": pixels * pixel * f_number * rng.uniform(0.95, 1.05),
        "shape": rng.choice(["square", "square", "circle"]),
        "fill": rng.choice([1, 1, 1, round(rng.uniform(0.7, 0.95), 2)]),
        "wavelength": rng.choice([450, 550, 650]),
        "terms": [],
    }
    if rng.random() < 0.4:
        values["terms"] = [(j, rng.gauss(0, 40)) for j in rng.sample([4, 5, 6, 7, 8, 11], 2)]
    return values


def described(v, focus=1.0, sensor=1.0, shift=None):
    """Text of a description; focus, sensor: factors of its distances; shift: px, or None."""
    terms = ", ".join(f'{{ noll = {j}, coefficient = "{c:.4g} nm" }}' for j, c in v["terms"])
    return f"""[main_lens]
focal_length = "{v["f"]:.8g} mm"
f_number = {v["f_number"]}
aberrations = [{terms}]

[object]
distance = "{v["object"] * focus:.8g} mm"
samples_per_lenslet = [{v["points"]}, {v["points"]}]

[lenslet_array]
distance = "{v["image"]:.8g} mm"
superpixel_pitch = "{v["pitch"]:.8g} um"
focal_length = "{v["lenslet"]:.8g} um"
aperture_shape = "{v["shape"]}"
fill_factor = {v["fill"]}
count = [7, 7]

[sensor]
distance = "{v["lenslet"] * sensor:.8g} um"
pixel_pitch = "{v["pixel"]:.8g} um"
pixels_per_lenslet = [{v["pixels"]}, {v["pixels"]}]

[light]
wavelengths = ["{v["wavelength"]} nm"]
""" + ("" if shift is None else f"\n[fitted]\npixel_shift = [{shift[0]:.3f}, {shift[1]:.3f}]\n")


def call(*words):
    """What a command says; RuntimeError where it fails."""
    from plenocli.cli.main import run

    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = run([str(word) for word in words])
    if code:
        raise RuntimeError(f"{words[0]}: exit {code}: {said.getvalue()[-300:]}")
    return said.getvalue()


def judged(seed, scenes, folder):
    """The line of one camera."""
    rng = random.Random(seed)
    values, kind = drawn(rng), rng.choice(KINDS)
    snr, scene = rng.choice([60, 40, 30, 20]), rng.choice(scenes)
    # waves of round lenslets with neighbours, and of aberrations, take minutes
    plain = values["shape"] == "square" and not values["terms"]
    kind = kind if plain or kind != "leak" else "right"
    beside = plain and (kind == "leak" or rng.random() < 0.4)
    off = {
        "focus": {"focus": 1 + rng.choice([-1, 1]) * rng.uniform(0.002, 0.02)},
        "sensor": {"sensor": 1 + rng.choice([-1, 1]) * rng.uniform(0.001, 0.01)},
        "shift": {"shift": (rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3))},
    }.get(kind, {})
    told, real, pif, capture = (folder / n for n in ("c.toml", "real.toml", "p.h5", "y.h5"))
    told.write_text(described(values))
    real.write_text(described(values, **off))
    matrix = BESIDE if beside and kind != "leak" else ALONE
    call("simulate-pif", told, *matrix, "-o", pif, "--overwrite")
    made = ("capture-sim", real, "--scene", scene, "--snr", f"{snr}dB", "--refine", 2)
    call(*made, "--seed", seed, *(BESIDE if beside else ALONE), "-o", capture, "--overwrite")
    found = {}
    for method in METHODS:
        picture, score = folder / "x.h5", folder / "s.json"
        asked = ("reconstruct", capture, "--pif", pif, "--method", method)
        call(*asked, "-o", picture, "--overwrite")
        call("score", picture, "--truth", capture, "-o", score, "--overwrite")
        found[method] = json.loads(score.read_text())["results"][0]["metrics"]["psnr_db"]
    about = {"seed": seed, "kind": kind, "beside": beside, "snr_db": snr, "scene": Path(scene).name}
    return about | {k: values[k] for k in ("f_number", "shape", "points", "pixels")} | {"db": found}


def table(rows):
    """Markdown: dB over the mean of each lenslet, and how many are worse than it."""
    import numpy as np

    lines = ["| captured by | cameras | " + " | ".join(METHODS[1:]) + " |"]
    lines += ["|" + "---|" * (len(METHODS) + 1)]
    for kind in dict.fromkeys(KINDS):
        own = [row["db"] for row in rows if row["kind"] == kind]
        cells = []
        for method in METHODS[1:] if own else ():
            gain = np.array([db[method] - db["block-mean"] for db in own])
            worse = np.count_nonzero(gain < -LOST)
            cells.append(f"{gain.min():.1f}, {np.median(gain):.1f}, {gain.max():.1f}; {worse}")
        lines += [f"| {kind} | {len(own)} | " + " | ".join(cells) + " |"] if own else []
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("scenes", nargs="+", help="photographs, or skimage:NAME")
    parser.add_argument("--cameras", type=int, default=20, help="how many")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument(
        "--run", type=Path, default=Path("runs/bench-foreign"), help="folder for the results"
    )
    args = parser.parse_args()
    args.run.mkdir(parents=True, exist_ok=True)
    kept = args.run / "foreign_captures.jsonl"
    rows = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    known = {row["seed"] for row in rows}
    for seed in range(args.first, args.first + args.cameras):
        if seed in known:
            continue
        with tempfile.TemporaryDirectory() as folder:
            rows.append(judged(seed, args.scenes, Path(folder)))
        with kept.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        print(json.dumps(rows[-1]), flush=True)
        (args.run / "foreign_captures.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
