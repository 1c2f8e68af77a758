"""Cameras that are not as described, drawn at random, and what `reconstruct --fit` makes of their
captures.

seed_spatial (40x40 points, 52x52 pixels a lenslet) or the same half as fine, 6x6 isolated lenslets.
Of each draw all twelve parameters, or one alone, are somewhere within a share of full: focus 2 %,
pitch 0.2 %, sensor distance and lenslet focal length 0.5 %, wavelength 10 nm, shift 0.3 px,
astigmatism and coma 0.1, spherical aberration 0.05 waves. That camera captures a part of a
photograph, another one for each draw, with points twice as fine as they are inverted; the
description knows nothing of it. (Half-sized points are coarser than what the optics show: with
finer ones no camera explains a capture at 60 dB, so `--size half` goes with `--finer 1`.)
Statistics are from the photographs of scikit-image.

Appends a line to RUN/fit_draws.jsonl for each draw, leaves out those that stand there already, and
writes a table of all to RUN/fit_draws.md. Run from the project's root:
python pipelines/benchmarks/fit_draws.py FOLDER --size full --far 0.1 --snr 60 40 30 --draws 40
"""

import argparse
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

COUNT, ACROSS = 6, 11
"""Lenslets a side, lenslets over which a photograph is spread."""
ACCURACY = 1e-4
"""Of the matrices that capture, and of the right ones."""
HALF = {
    "object.samples_per_lenslet": (20, 20),
    "sensor.pixels_per_lenslet": (26, 26),
    "sensor.pixel_pitch": 4e-6,
}
GOALS = "lost at most 0.5 dB"


def described(size):
    """The camera as described, "full" or "half"."""
    from plenocli import api

    camera = api.read_camera(api.sample("seed_spatial.toml"))
    return camera.replace(**HALF) if size == "half" else camera


def built(family, values, model, finer=1):
    """(matrix (pixel, point), its AccuracyRecord) of the camera with parameters at `values`."""
    from plenocli.forward.accuracy.dial import plan_pif
    from plenocli.forward.propagation.system_matrix import build_pif

    camera = family.camera_at(values)
    points = tuple(finer * n for n in camera.object.samples_per_lenslet)
    camera = camera.replace(**{"object.samples_per_lenslet": points})
    plan = plan_pif(camera, model=model, superpixels=(1, 1), coherent_ring=0, accuracy=ACCURACY)
    shift = family.geometry_at(values).pixel_shift
    plan = replace(plan, pixel_shift=shift if shift and any(shift) else None)
    return np.asarray(build_pif(camera, plan).A[0, 0], float), plan.accuracy_record()


def drawn(family, far, which, number):
    """(parameter,) values of a draw: all within `far` of full, or one alone at `far`."""
    rng = np.random.default_rng([number, round(1000 * far)])
    names = [p.name for p in family.parameters]
    if which == "all":
        x = rng.uniform(-far, far, len(names))
    else:
        x = np.zeros(len(names))
        x[names.index(which)] = far * (-1) ** number
    return family.start + x * family.tolerance


def photograph(path, shape, number, finer):
    """(lenslet_row, lenslet_column, point) of a part of a photograph, `finer` points (a side) for
    each of the picture.
    """
    from plenocli.base.tiling import to_blocks
    from plenocli.files.read.training import linear_values
    from plenocli.forward.scene.sample import luminance, sample_picture

    fine = [finer * n for n in shape]
    picture = sample_picture(luminance(linear_values(path)), *(ACROSS * n for n in fine))
    first = np.random.default_rng([number, 1]).integers(0, ACROSS - COUNT + 1, 2)
    r, c = (slice(int(k) * n, (int(k) + COUNT) * n) for k, n in zip(first, fine))
    return to_blocks(np.asarray(picture, float)[r, c], fine)


def coarse(x, shape, finer):
    """Blocks (.., fine point) with the mean of finer x finer points for each."""
    parts = x.reshape(*x.shape[:2], shape[0], finer, shape[1], finer)
    return parts.mean(axis=(3, 5)).reshape(*x.shape[:2], -1)


def estimators(camera, matrix, record, pictures):
    """Of a matrix of isolated lenslets, made for a camera."""
    from plenocli.inverse.picture.estimators import Estimators, Options
    from plenocli.inverse.picture.lenslet_model import LensletMatrix, MatrixOrigin

    system = LensletMatrix(
        path=Path("pif.h5"),
        blocks=matrix[None],
        offsets=np.zeros((1, 2), int),
        pixel_shape=camera.sensor.pixels_per_lenslet,
        object_shape=camera.object.samples_per_lenslet,
        accuracy=record,
        origin=MatrixOrigin(camera=camera, wavelengths=camera.light.wavelengths),
    )
    return Estimators(system, Options(), pictures, threads=1)


class Draws:
    """Draws of one camera; what they share is made once.

    size: "full" or "half"; model: that captures, and that the fit is told of;
    finer: points (a side) that capture for each of the picture.
    """

    def __init__(self, size, model, finer, files):
        from plenocli.files.read.training import read_training
        from plenocli.inverse.fit.problem import camera_family

        self.model, self.finer, self.files = model, finer, files
        self.camera = described(size)
        self.shape = self.camera.object.samples_per_lenslet
        self.family = camera_family(self.camera)
        told, record = built(self.family, self.family.start, "fresnel")
        self.told = estimators(
            self.camera, told, record, lambda scene: read_training((), self.shape, not_scene=scene)
        )

    def captured(self, far, which, number):
        """(true values, right matrix, its record, true objects, capture without noise)."""
        values = drawn(self.family, far, which, number)
        path = self.files[number % len(self.files)]
        x = photograph(path, self.shape, number, self.finer)
        fine, _ = built(self.family, values, self.model, self.finer)
        right, record = built(self.family, values, self.model)
        return values, right, record, coarse(x, self.shape, self.finer), x @ fine.T / self.finer**2

    def judged(self, captured, snr_db, number):
        """What a fit makes of a capture, and what pictures lose."""
        from plenocli.base.progress import collected_notes
        from plenocli.forward.accuracy.limiting_error import what_limits
        from plenocli.forward.sensor.noise import Noise
        from plenocli.inverse.picture.estimate import estimate
        from plenocli.inverse.picture.lenslet_model import Superpixels
        from plenocli.inverse.picture.methods.registry import METHODS
        from plenocli.stages.inverse.reconstruct.fitted_matrix import with_fitted_camera

        values, right, record, truth, y = captured
        sigma = float(np.sqrt(np.mean(y**2)) * 10 ** (-snr_db / 20))
        noise = np.random.default_rng([number, int(snr_db)]).standard_normal(y.shape)
        data = Superpixels(y=y + sigma * noise, noise=Noise.of_sigma(sigma), accuracy=record)

        def psnr(of, method="lmmse", off=0.0):
            found, _ = estimate(of, METHODS[method], data, model_error=off)
            told = found.as_json() if method == "lmmse" else {}
            return float(-10 * np.log10(np.mean((found.value - truth) ** 2))), told

        with collected_notes():
            begun = time.process_time()
            fitted, fit = with_fitted_camera(self.told, data, "capture")
            seconds = time.process_time() - begun
            best, _ = psnr(self.told.with_matrix(replace(self.told.system, blocks=right[None])))
            relative = 10 ** (-snr_db / 20)
            limits = what_limits(relative, fitted.system.accuracy, record)
            decides = limits is not None and limits.limited_by != "noise"
            found, told = psnr(fitted, off=limits.model_error if decides else 0.0)
            floor, _ = psnr(self.told, "block-mean")
        error = np.linalg.norm(fit.matrix - right)
        turned = np.linalg.norm(fit.matrix[:, ::-1] - right)
        return {
            "right_db": best,
            "fitted_db": found,
            "block_mean_db": floor,
            "accepted": fit.accepted,
            "doubted": not told["matrix_believed"],
            "noise_ratio": fit.noise_ratio,
            "noise_ratio_before": fit.noise_ratio_before,
            "turned": fit.turned,
            "twin_told_apart": bool(error <= turned),
            "matrix_error": float(error / np.linalg.norm(right)),
            "model_error": fit.model_error,
            "off": {
                p.name: float((v - p.described) / p.tolerance)
                for p, v in zip(fit.parameters, values)
            },
            "z": {p.name: float((p.value - v) / p.sigma) for p, v in zip(fit.parameters, values)},
            "sigma": {p.name: float(p.sigma / p.tolerance) for p in fit.parameters},
            "cpu_s": seconds,
        }


def table(rows):
    """A line for each size, model, range and noise."""
    lines = [
        "| size | model | finer | drawn | SNR, dB | draws | "
        f"{GOALS} | mean loss, dB | most | below the block mean | accepted | accepted, more lost "
        "| doubted | twin wrong | all within 3 sd, of accepted | z, rms | CPU s, median | most |",
        "|" + "---|" * 18,
    ]
    keys = ("size", "model", "finer", "far", "which", "snr_db")
    groups = {}
    for row in rows:
        key = tuple("one alone" if k == "which" and row[k] != "all" else row[k] for k in keys)
        groups.setdefault(key, []).append(row)
    for (size, model, finer, far, which, snr_db), group in sorted(groups.items()):
        loss = np.array([r["right_db"] - r["fitted_db"] for r in group])
        above = np.array([r["fitted_db"] - r["block_mean_db"] for r in group])
        accepted = np.array([r["accepted"] for r in group])
        z = np.array([list(r["z"].values()) for r in group if r["accepted"]])
        within = np.mean(np.all(np.abs(z) <= 3, axis=1)) if len(z) else np.nan
        seconds = [r["cpu_s"] for r in group]
        cells = [
            size,
            model,
            finer,
            f"{which} within {far:g}" if which == "all" else f"{which} at {far:g}",
            f"{snr_db:g}",
            len(group),
            f"{np.mean(loss <= 0.5):.0%}",
            f"{loss.mean():.2f}",
            f"{loss.max():.2f}",
            f"{np.sum(above < 0)} (least {above.min():+.2f} dB)",
            f"{accepted.mean():.0%}",
            int(np.sum(accepted & (loss > 0.5))),
            sum(r["doubted"] for r in group),
            sum(r["accepted"] and not r["twin_told_apart"] for r in group),
            f"{within:.0%}",
            f"{np.sqrt(np.mean(z**2)) if len(z) else np.nan:.2f}",
            f"{np.median(seconds):.0f}",
            f"{max(seconds):.0f}",
        ]
        lines.append("| " + " | ".join(str(c) for c in cells) + " |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="photographs, here and below")
    parser.add_argument("--run", type=Path, default=Path("runs/fit_draws"))
    parser.add_argument("--size", choices=("full", "half"), default="full")
    parser.add_argument("--model", choices=("fresnel", "exact"), default="fresnel")
    parser.add_argument("--finer", type=int, default=2, help="points of captures, a side")
    parser.add_argument("--far", nargs="+", type=float, default=[0.1], help="shares of full")
    parser.add_argument("--alone", action="store_true", help="one parameter after the other")
    parser.add_argument("--snr", nargs="+", type=float, default=[60, 40, 30], help="dB")
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="number of the first draw")
    asked = parser.parse_args()
    files = sorted(p for p in asked.folder.rglob("*") if p.suffix in (".png", ".jpg", ".exr"))
    asked.run.mkdir(parents=True, exist_ok=True)
    store = asked.run / "fit_draws.jsonl"
    rows = [json.loads(s) for s in store.read_text().splitlines()] if store.exists() else []
    keys = ("size", "model", "finer", "far", "which", "snr_db", "draw")
    done = {tuple(row[k] for k in keys) for row in rows}
    setup = asked.size, asked.model, asked.finer
    draws = Draws(*setup, files)
    names = [p.name for p in draws.family.parameters] if asked.alone else ["all"]
    for number in range(asked.first, asked.first + asked.draws):
        for far in asked.far:
            for which in names:
                made = [(*setup, far, which, snr_db, number) for snr_db in asked.snr]
                left = [key for key in made if key not in done]
                captured = draws.captured(far, which, number) if left else None
                for key in left:
                    row = dict(zip(keys, key)) | draws.judged(captured, key[5], number)
                    rows.append(row)
                    with store.open("a") as out:
                        out.write(json.dumps(row) + "\n")
                    print(
                        *key,
                        f"lost {row['right_db'] - row['fitted_db']:.2f} dB",
                        "accepted" if row["accepted"] else "not accepted",
                        f"{row['noise_ratio']:.3f}",
                        f"{row['cpu_s']:.1f} s",
                        flush=True,
                    )
    (asked.run / "fit_draws.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
