"""Whether the chain that `plan` chooses keeps its promise, against all chains run by brute force.

Cameras are drawn at random, small enough that a chain takes a second, with lenslets enough that
what `reconstruct` finds does not hang on the draw of the noise. Each captures a photograph
once, by the exact model, three times as fine as it is inverted, and every chain that `plan`
considers inverts it. Judged are: the loss of the chosen chain against the best one, and its cost
against the cheapest chain that meets the loss; costs are processor seconds, measured, from the
camera's description to the matrix and from there to the picture, without start and files.

Cameras and scenes of --fit (coefficients of the law of costs; the spread of what rehearsals miss)
are others than those of the judgement. Every case is kept in RUN, so that a run goes on where it
was. Run from the project's root: python pipelines/benchmarks/plan.py --help.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# ruff: isort: split
import numpy as np
from scipy.optimize import nnls

from plenocli.base.budget import one_thread
from plenocli.base.errors import NumericsError
from plenocli.base.progress import collected_notes
from plenocli.base.tiling import to_blocks
from plenocli.files.read.cameras import read_camera
from plenocli.files.read.scenes import read_scene
from plenocli.files.read.training import read_training
from plenocli.forward.accuracy.limiting_error import what_limits
from plenocli.forward.propagation.diagnosis import describe
from plenocli.forward.propagation.system_matrix import build_pif
from plenocli.forward.scene.light import Quadrature
from plenocli.forward.sensor.exposure.options import ExposureOptions
from plenocli.forward.sensor.exposure.simulate import simulate_capture
from plenocli.inverse.chain import costs
from plenocli.inverse.chain.chains import INVERSIONS, chains_of, matrix_options
from plenocli.inverse.chain.choose import PROBE, choose
from plenocli.inverse.chain.rehearsal import Rehearsal
from plenocli.inverse.picture.estimate import estimate
from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.lenslet_model import LensletMatrix, gathered
from plenocli.inverse.picture.methods.registry import METHODS
from plenocli.inverse.picture.superpixels import superpixels

TINY = Path(__file__).resolve().parents[2] / "sample_configs" / "tiny.toml"
SCENES = {
    "fit": ("camera", "coins", "moon", "grass"),
    "judge": ("astronaut", "coffee", "chelsea", "rocket", "retina", "ihc", "motorcycle_left"),
}
SIZED = (
    ("demo_spatial.toml", (12, 12), (16, 16)),
    ("demo_spatial.toml", (40, 40), (16, 16)),
    ("tiny.toml", (60, 60), (8, 8)),
    ("seed_spatial.toml", (11, 11), (40, 40)),
    ("seed_spatial.toml", (16, 16), (28, 28)),
)
"""Cameras, with lenslets and points a lenslet, by which --fit sees how costs grow."""
FIRST = {"fit": 0, "judge": 300}
"""Number of the first case: those of the judgement below were looked at while `plan` was made."""
ALLOWED = (0.1, 0.3, 1.0)
"""dB of --quality-loss that are judged."""
HOPELESS = 4.0
"""dB that a matrix without neighbours loses by the probe's method, from which on no other method is
run with it, none making up for so much; from half of that on that a method loses with the finest
matrix it is not run with others.
"""


def case_of(kind, number):
    """(camera, scene, SNR in dB) of a case, drawn by its number."""
    rng = np.random.default_rng([number, *kind.encode()])
    pixels, pitch = int(rng.integers(9, 13)), float(rng.uniform(1.6e-6, 3e-6))
    points, f_number = pixels - int(rng.integers(0, 3)), float(rng.uniform(5, 11))
    lenslets = [int(n) for n in rng.integers(14, 19, 2)]
    camera = read_camera(TINY)
    focal = f_number * pixels * pitch
    changes = {
        "main_lens.aperture_diameter": camera.lenslet_array.distance / f_number,
        "main_lens.aperture_shape": str(rng.choice(["circle", "square"])),
        "object.distance": float(rng.uniform(0.547, 0.553)),
        "object.samples_per_lenslet": (points, points),
        "lenslet_array.pitch": pixels * pitch / (1 + focal / camera.lenslet_array.distance),
        "lenslet_array.focal_length": focal,
        "lenslet_array.count": tuple(lenslets),
        "sensor.distance": focal,
        "sensor.pixel_pitch": pitch,
        "sensor.pixels_per_lenslet": (pixels, pixels),
        "light.wavelengths": (float(rng.uniform(450e-9, 650e-9)),),
    }
    snr = float(np.round(rng.uniform(25, 45)))
    return camera.replace(**changes), SCENES[kind][number % len(SCENES[kind])], snr


class Brute:
    """All chains of a case, run one by one."""

    def __init__(self, camera, scene, snr):
        self.camera, self.scene = camera, f"skimage:{scene}"
        wavelengths = np.array(camera.light.wavelengths)
        self.source = Quadrature(wavelengths, np.ones(1))
        self.picture = read_scene(self.scene)
        self.exposure = ExposureOptions(snr_db=snr)
        shape = camera.object.samples_per_lenslet
        start = time.process_time()
        self.pictures = read_training((), shape, not_scene=self.scene)
        self.reading = time.process_time() - start

    def read_pictures(self, scene):
        return self.pictures

    def capture(self, finest, superpixels_):
        """The capture by the exact model, and its truth."""
        for accuracy in (finest / 3, finest, 3 * finest):
            options = ExposureOptions(
                snr_db=self.exposure.snr_db,
                refine=3,
                model="exact",
                accuracy=max(accuracy, 1e-7),
                superpixels=superpixels_,
                seed=0,
            )
            try:
                return simulate_capture(
                    self.camera, self.source, self.picture, options, name=self.scene
                )
            except NumericsError:
                continue
        raise NumericsError("no capture by the exact model")

    def matrix(self, option):
        """(matrix, seconds): as simulate-pif makes it, the diagnosis included."""
        start = time.process_time()
        made = build_pif(self.camera, option.plan)
        describe(made)
        system = LensletMatrix(
            path=Path("case"),
            blocks=gathered(made.A),
            offsets=np.asarray(made.lenslet_offset, int),
            pixel_shape=made.pixel_shape,
            object_shape=made.object_shape,
            accuracy=option.plan.accuracy_record(),
        )
        return system, time.process_time() - start

    def invert(self, system, method, data, truth):
        """(PSNR in dB, seconds) of a method, everything made anew."""
        start = time.process_time()
        options = Options(method=method)
        estimators = Estimators(system, options, self.read_pictures)
        loud = float(np.sqrt(np.mean(np.square(data.y))))
        limits = what_limits(data.sigma / loud, system.accuracy)
        off = 0.0 if limits is None or limits.limited_by == "noise" else limits.model_error
        found, _ = estimate(estimators, METHODS[method], data, model_error=off)
        spent = time.process_time() - start
        spent += self.reading if estimators.prior.pictures_of else 0.0
        error = np.mean(np.square(found.value.reshape(truth.shape) - truth))
        return -10 * float(np.log10(error)), spent


def run_sized(name, lenslets, points):
    """Costs of every method on a sample camera, with and without neighbours: how they grow."""
    camera = read_camera(TINY.with_name(name)).replace(
        **{"lenslet_array.count": lenslets, "object.samples_per_lenslet": points}
    )
    brute, rows = Brute(camera, "camera", 40.0), []
    options = [m for m in matrix_options(camera, 1e-2) if m.accuracy == 1e-2]
    for option in {m.superpixels: m for m in options}.values():
        system, making = brute.matrix(option)
        coarse = ExposureOptions(
            snr_db=40.0, model="fresnel", accuracy=1e-2, superpixels=option.superpixels
        )
        capture = simulate_capture(camera, brute.source, brute.picture, coarse, name=brute.scene)
        data = superpixels(capture.capture, system)
        truth = to_blocks(np.asarray(capture.scene[0], float), system.object_shape)
        for method in INVERSIONS:
            db, spent = brute.invert(system, method, data, truth)
            rows.append(row_of(camera, option, method, db, making, spent))
    return {"case": f"{name} {lenslets} {points}", "rows": rows, "plans": []}


def row_of(camera, option, method, db, making, spent):
    """What a chain gave and took, with what its costs are counted by."""
    lenslets = int(np.prod(camera.lenslet_array.count))
    return {
        "chain": name_of(option, method),
        "psnr": db,
        "making": making,
        "inverting": spent,
        "method": method,
        "features": costs.Effort.of(option.plan, lenslets).features(),
        "matrix features": costs.matrix_features(option.plan),
    }


def run_case(kind, number):
    """Everything that a case gives, JSON-able."""
    camera, scene, snr = case_of(kind, number)
    brute, rows = Brute(camera, scene, snr), []
    matrices = matrix_options(camera, 10 ** (-snr / 20))
    wide = max(m.superpixels for m in matrices)
    finest = [m for m in matrices if m.superpixels == wide][-1]
    capture = brute.capture(finest.accuracy, wide)
    probes, by_method = {}, {}

    def hopeless(option, method):
        """Whether a chain need not be run, as its matrix or its method loses too much."""
        if method == PROBE or wide == (1, 1) or option is finest:
            return False
        if option.own_only and probes[option] < max(probes.values()) - HOPELESS:
            return True
        best = max(by_method.values())
        return by_method.get(method, best) < best - HOPELESS / 2

    for option in sorted(matrices, key=lambda m: (-m.superpixels[0], m is not finest)):
        system, making = brute.matrix(option)
        data = superpixels(capture.capture, system)
        truth = to_blocks(np.asarray(capture.scene[0], float), system.object_shape)
        for method in sorted(INVERSIONS, key=lambda i: i != PROBE):
            if method == "block-mean" and not option.own_only and wide != (1, 1):
                continue
            if hopeless(option, method):
                continue
            db, spent = brute.invert(system, method, data, truth)
            if method == PROBE:
                probes[option] = db
            if option is finest:
                by_method[method] = db
            rows.append(row_of(camera, option, method, db, making, spent))
    start = time.process_time()
    rehearsal = Rehearsal(
        camera,
        brute.source,
        brute.picture,
        brute.exposure,
        brute.read_pictures,
        finest,
        name=brute.scene,
        seed=1,
    )
    plans = [choose(chains_of(camera, matrices), rehearsal, allowed) for allowed in ALLOWED]
    return {
        "case": f"{kind} {number}",
        "scene": scene,
        "snr": snr,
        "pixels": camera.sensor.pixels_per_lenslet[0],
        "points": camera.object.samples_per_lenslet[0],
        "planning": time.process_time() - start,
        "rows": rows,
        "plans": [
            {
                "allowed": plan.allowed,
                "chosen": name_of(plan.chosen.chain.matrix, plan.chosen.chain.method),
                "runs": plan.runs,
                "predicted": {
                    name_of(w.chain.matrix, w.chain.method): [w.loss, w.rehearsed]
                    for w in plan.weighed
                },
            }
            for plan in plans
        ],
    }


def name_of(option, method):
    """A chain in words, the same in all records."""
    rows, columns = option.superpixels
    return f"{option.model} {option.accuracy:g} {rows}x{columns} {method}"


def judged(record, plan):
    """What came of one plan: (loss in dB, seconds, least seconds of a chain that meets it)."""
    by_name = {row["chain"]: row for row in record["rows"]}
    top = max(row["psnr"] for row in record["rows"])
    cost = {name: row["making"] + row["inverting"] for name, row in by_name.items()}
    meeting = [cost[name] for name, row in by_name.items() if top - row["psnr"] <= plan["allowed"]]
    chosen = plan["chosen"]
    lost = top - by_name[chosen]["psnr"] if chosen in by_name else np.inf
    return lost, cost.get(chosen, np.inf), min(meeting)


def table(records):
    """The judgement in Markdown."""
    lines = [
        "| allowed | chains | met | worst loss | cost within 1.5 of the cheapest that meets it | "
        "median of the ratio | the best chain's ratio |",
        "|---|---|---|---|---|---|---|",
    ]
    for k, allowed in enumerate(ALLOWED):
        found = [judged(record, record["plans"][k]) for record in records]
        ratio = np.array([cost / least for _, cost, least in found])
        met = np.array([lost <= allowed for lost, _, _ in found])
        best = []
        for record, (_, _, least) in zip(records, found):
            row = max(record["rows"], key=lambda row: row["psnr"])
            best.append((row["making"] + row["inverting"]) / least)
        lines.append(
            f"| {allowed} dB | {len(found)} | {met.mean():.1%} | {max(f[0] for f in found):.2f} dB "
            f"| {np.mean(ratio <= 1.5):.1%} | {np.median(ratio):.2f} | {np.median(best):.2f} |"
        )
    planning = np.median([record["planning"] for record in records])
    chain = np.median(
        [judged(record, record["plans"][0])[1] for record in records],
    )
    lines += ["", f"Planning took {planning:.1f} CPU s, the chosen chain {chain:.2f} (medians)."]
    return "\n".join(lines)


def fitted(records):
    """The law of costs, TOML text: no coefficient below zero, least relative errors."""
    groups = {}
    for record in records:
        for row in record["rows"]:
            groups.setdefault(row["method"], []).append((row["features"], row["inverting"]))
            groups.setdefault("simulate-pif", []).append((row["matrix features"], row["making"]))
    text = ["# By pipelines/benchmarks/plan.py --fit: seconds of one core for one of each feature."]
    for name, found in groups.items():
        features = list(found[0][0])
        counts = np.array([[f[key] for key in features] for f, _ in found])
        seconds = np.array([s for _, s in found])
        scale = np.maximum(counts.max(axis=0), 1e-300)
        weights, _ = nnls(counts / scale / seconds[:, None], np.ones(len(seconds)))
        off = counts / scale @ weights / seconds
        text += [
            "",
            f"[{name}.fit]",
            f"cases = {len(found)}",
            f"within_1_5 = {np.mean(np.abs(np.log(off)) < np.log(1.5)):.3f}",
            "",
            f"[{name}.seconds]",
            *(f'"{key}" = {w:.3e}' for key, w in zip(features, weights / scale)),
        ]
    return "\n".join(text) + "\n"


def missed(records):
    """dB by which losses of chains that were rehearsed differ from those measured, of chains that
    lose less than 1.5 dB.
    """
    found = []
    for record in records:
        top = max(row["psnr"] for row in record["rows"])
        lost = {row["chain"]: top - row["psnr"] for row in record["rows"]}
        for name, (loss, rehearsed) in record["plans"][0]["predicted"].items():
            if rehearsed and name in lost and lost[name] < 1.5:
                found.append(lost[name] - loss)
    return np.array(found)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--run", type=Path, default=Path("runs/plan"))
    parser.add_argument("--fit", action="store_true", help="fit the law of costs, judge nothing")
    parser.add_argument("--cases", type=int, default=40)
    args = parser.parse_args()
    kind = "fit" if args.fit else "judge"
    args.run.mkdir(parents=True, exist_ok=True)
    records = []
    for number in range(FIRST[kind], FIRST[kind] + args.cases):
        path = args.run / f"{kind}-{number}.json"
        if not path.is_file():
            with one_thread(), collected_notes():
                path.write_text(json.dumps(run_case(kind, number)))
        records.append(json.loads(path.read_text()))
    off = missed(records)
    print(
        f"rehearsed losses miss by {np.mean(off):+.3f} dB, standard deviation {np.std(off):.3f}, "
        f"95th percentile of the amount {np.quantile(np.abs(off), 0.95):.3f} ({len(off)} chains)"
    )
    if args.fit:
        for number, sized in enumerate(SIZED):
            path = args.run / f"sized-{number}.json"
            if not path.is_file():
                with one_thread(), collected_notes():
                    path.write_text(json.dumps(run_sized(*sized)))
            records.append(json.loads(path.read_text()))
        costs.FITTED.write_text(fitted(records))
        print(f"{costs.FITTED} written")
    else:
        print(table(records))
        (args.run / "plan.md").write_text(table(records) + "\n")


if __name__ == "__main__":
    main()
