"""How often the 95 % intervals of reconstruct hold the truth, photograph by photograph.

seed_spatial at half its resolution (20x20 object points and 26x26 pixels a lenslet), isolated
lenslets, the middle of a photograph that no training saw. What inverts the capture is its own
matrix; with --finer the object is simulated with points three times finer, with --wrong the
lenslets' focal length of the matrix is off by so much: what is left then passes for noise as far as
reconstruct finds it. With --fitted the matrix is that of the camera fitted to each capture, from a
description that is off by --wrong (square lenslets). Photographs alternate between those that the
constants of the error bars were fitted on (--fit prints these constants) and those that judge; both
are told apart in the table.

Writes RUN/error_bars.json and RUN/error_bars.md. Run from the project's root:
python pipelines/benchmarks/error_bars.py --scene skimage:astronaut FOLDER/*.png
"""

import argparse
import json
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

METHODS = {
    "lmmse": {"method": "lmmse"},
    "lmmse 3x3": {"method": "lmmse", "overlap": 3},
    "pnp": {"method": "pnp"},
    "tv": {"method": "tv"},
    "tikhonov": {"method": "tikhonov"},
    "tsvd": {"method": "tsvd"},
    "nnls, 300 steps": {"method": "nnls", "nnls_iterations": 300},
    "dictionary": {"method": "dictionary"},
}
POINTS, PIXELS, FINER, ACROSS = 20, 26, 3, 22
"""Points and pixels of a lenslet (a side), points of the capture for each, lenslets over which a
photograph is spread.
"""


LEARNT = {"atoms": 400, "batch": 1600, "lam": 5.6e-7, "delta": 1e-3, "snr_db": 60, "seed": 3}
"""How the dictionary is learnt, in three iterations; lambda as learn-dict finds it."""


def camera_of(shape, points, focal=1.0):
    """seed_spatial at half its resolution, with square or circular lenslets.

    points: of the object, a side.
    focal: factor of the lenslets' focal length.
    """
    from plenocli.files.config.camera_file import load_camera

    camera = load_camera(ROOT / "sample_configs" / "seed_spatial.toml")
    lenslets, pitch = camera.lenslet_array, camera.sensor.pixel_pitch
    pitch *= camera.sensor.pixels_per_lenslet[0] / PIXELS
    return camera.model_copy(
        update={
            "lenslet_array": lenslets.model_copy(
                update={"aperture_shape": shape, "focal_length": focal * lenslets.focal_length}
            ),
            "object": camera.object.model_copy(update={"samples_per_lenslet": (points, points)}),
            "sensor": camera.sensor.model_copy(
                update={"pixels_per_lenslet": (PIXELS, PIXELS), "pixel_pitch": pitch}
            ),
        }
    )


def matrix(shape, points, focal=1.0):
    """(pixel, point) of an isolated lenslet of `camera_of`."""
    from plenocli.forward.accuracy.dial import plan_pif
    from plenocli.forward.propagation.system_matrix import build_pif

    camera = camera_of(shape, points, focal)
    plan = plan_pif(camera, model="fresnel", superpixels=(1, 1), coherent_ring=0, accuracy=1e-5)
    return build_pif(camera, plan).A[0, 0].astype(float)


def fitted_matrix(described, data, pictures):
    """(matrix (pixel, point), its model error) of a camera fitted to a capture."""
    from plenocli.inverse.fit.fit import CapturedLenslets, fit_camera

    found = fit_camera(described, [CapturedLenslets(data.y, data.sigma)], pictures, model="fresnel")
    return found.matrix, found.model_error if found.accepted else 0.0


def captured(scene, capturing, snr, count, seed):
    """(Superpixels, true blocks) of the middle `count` x `count` lenslets of a scene.

    capturing: matrix (pixel, point) that makes the capture, for points once or FINER times as fine.
    snr: of white noise, over the mean square of the capture, dB.
    """
    from plenocli.base.tiling import to_blocks
    from plenocli.files.read.training import linear_values
    from plenocli.forward.scene.sample import block_mean, luminance, sample_picture
    from plenocli.forward.sensor.noise import Noise
    from plenocli.inverse.picture.lenslet_model import Superpixels

    fine = int(np.sqrt(capturing.shape[1])) // POINTS
    side, first = fine * POINTS, (ACROSS - count) // 2
    middle = slice(first * side, (first + count) * side)
    picture = sample_picture(luminance(linear_values(scene)), ACROSS * side, ACROSS * side)
    picture = np.asarray(picture, float)[middle, middle]
    y = to_blocks(picture, (side, side)) @ capturing.T / fine**2
    sigma = float(np.sqrt(np.mean(y**2)) * 10 ** (-snr / 20))
    y = y + sigma * np.random.default_rng([seed, int(snr)]).standard_normal(y.shape)
    truth = to_blocks(block_mean(picture, (fine, fine)), (POINTS, POINTS))
    return Superpixels(y=y, noise=Noise.of_sigma(sigma), scene=scene), truth


def estimators_of(own, options, dictionary=None):
    """Estimators behind a matrix (pixel, point), trained on the photographs of scikit-image."""
    from plenocli.files.read.training import read_training
    from plenocli.inverse.picture.estimators import Estimators, Options
    from plenocli.inverse.picture.lenslet_model import LensletMatrix

    system = LensletMatrix(
        path=Path("seed_spatial.toml"),
        blocks=own[None],
        offsets=np.zeros((1, 2), int),
        pixel_shape=(PIXELS, PIXELS),
        object_shape=(POINTS, POINTS),
    )
    return Estimators(
        system,
        Options(**options),
        lambda scene: read_training((), system.object_shape, not_scene=scene),
        dictionary and (lambda: dictionary),
        threads=1,
    )


def learnt(estimators):
    """A dictionary for the matrix of `estimators`."""
    from plenocli.inverse.sparse.dictionary import Dictionary, Learner, Settings

    pictures = estimators.prior.pictures(None)
    learner = Learner(
        estimators.svd, (POINTS, POINTS), pictures, pictures, Settings(**LEARNT), workers=1
    )
    state = learner.start()
    for _ in range(3):
        state = learner.step(state)
    return Dictionary(
        atoms=state.atoms,
        synthesis=learner.synthesis(state),
        lam=LEARNT["lam"],
        sigma=learner.sigma,
        directions=len(learner.seen),
        training=(),
    )


def judged(args):
    """[{"lenslets", "scene", "fitted", "snr_db", "method", "coverage", "z_rms"}]."""
    from plenocli.inverse.picture.estimate import estimate
    from plenocli.inverse.picture.methods.registry import METHODS as BY_NAME

    rows = []
    for lenslets in args.lenslets:
        right = matrix(lenslets, POINTS)
        capturing = matrix(lenslets, FINER * POINTS) if args.finer else right
        own = matrix(lenslets, POINTS, 1 + args.wrong) if args.wrong else right
        described = camera_of(lenslets, POINTS, 1 + args.wrong)
        nominal = estimators_of(own, {})
        dictionary = learnt(nominal) if "dictionary" in args.methods else None
        for number, scene in enumerate(args.scene):
            for snr in args.snr:
                data, truth = captured(scene, capturing, snr, args.count, number)
                first, error = nominal, 0.0
                if args.fitted:
                    found, error = fitted_matrix(described, data, nominal.prior.pictures(None))
                    first = estimators_of(found, {})
                    first.prior.pictures_of = nominal.prior.pictures_of
                    first.prior.statistics = nominal.prior.statistics
                for method in args.methods:
                    one = estimators_of(first.system.own, METHODS[method], dictionary)
                    one.svd, one.prior = first.svd, first.prior
                    by_name = BY_NAME[METHODS[method]["method"]]
                    found = (
                        by_name.reconstruct(one, data)
                        if args.alone
                        else estimate(one, by_name, data, model_error=error)[0]
                    )
                    z = (found.value - truth) / found.sigma
                    rows.append(
                        {
                            "lenslets": lenslets,
                            "scene": scene,
                            "fitted": number % 2 == 1,
                            "snr_db": snr,
                            "method": method,
                            "coverage": float(np.mean(np.abs(z) < 1.96)),
                            "z_rms": float(np.sqrt(np.mean(z**2))),
                        }
                    )
            print(lenslets, scene, flush=True)
    return rows


def table(rows):
    """Coverage, and how many photographs are within the goals, a column a noise level."""
    out = []
    levels = sorted({r["snr_db"] for r in rows}, reverse=True)
    for lenslets in dict.fromkeys(r["lenslets"] for r in rows):
        for fitted in (False, True):
            here = [r for r in rows if r["lenslets"] == lenslets and r["fitted"] == fitted]
            if not here:
                continue
            who = "that the constants were fitted on" if fitted else "that judge"
            out += [
                f"**{lenslets} lenslets**, {len({r['scene'] for r in here})} photographs {who}",
                "",
                "| | " + " | ".join(f"{level:g} dB" for level in levels) + " |",
                "|---|" + "---|" * len(levels),
            ]
            for method in dict.fromkeys(r["method"] for r in here):
                cells = []
                for level in levels:
                    group = [r for r in here if r["method"] == method and r["snr_db"] == level]
                    c = 100 * np.array([r["coverage"] for r in group])
                    z = np.mean([r["z_rms"] for r in group])
                    cells.append(
                        f"{c.mean():.1f} ({c.min():.1f} to {c.max():.1f}); "
                        f"{np.sum((c >= 93) & (c <= 97))}, {np.sum((c >= 90) & (c <= 99))}; {z:.2f}"
                    )
                out.append(f"| {method} | " + " | ".join(cells) + " |")
            out.append("")
    return "\n".join(out)


def fitted(args):
    """Print BY_WEAK, BY_BORDER and a constant: least squares of the logarithm of the 95 % quantile
    of |error| over the posterior's deviation, LMMSE of the photographs that do not judge; noise
    levels count by what they scatter.
    """
    from plenocli.base.tiling import to_blocks, to_plane
    from plenocli.inverse.picture import error_bars
    from plenocli.inverse.picture.solvers.lmmse import SCALES

    shape, rows, target, level = (POINTS, POINTS), [], [], []
    for lenslets in args.lenslets:
        own = matrix(lenslets, POINTS)
        estimators = estimators_of(own, {})
        for number, scene in list(enumerate(args.scene))[1::2]:
            for snr in args.snr:
                data, truth = captured(scene, own, snr, ACROSS, number)
                whole = to_plane(truth, shape)
                lmmse = estimators.prior.lmmse(data.sigma, data.scene)
                size = ACROSS // 3
                for piece in np.ndindex(3, 3):
                    at = tuple(slice(k * size, (k + 1) * size) for k in piece)
                    points = tuple(slice(k * size * POINTS, (k + 1) * size * POINTS) for k in piece)
                    y = data.y[at]
                    signals = y.reshape(-1, y.shape[2]).T
                    w = lmmse.coordinates(signals)
                    contrast = lmmse.contrast(w)
                    scale = np.exp(np.log(SCALES) @ contrast)
                    x = lmmse.apply(signals, scale, w).T.reshape(*y.shape[:2], -1)
                    sigma = error_bars.spread(lmmse, w, contrast).T.reshape(x.shape)
                    z = np.abs(x - to_blocks(whole[points], shape)) / sigma
                    rows.append(
                        (
                            error_bars.weak_power(lmmse, w, scale),
                            error_bars.disagreement(x, sigma, shape),
                            1.0,
                        )
                    )
                    target.append(np.log(np.quantile(z, 0.95) / 1.96))
                    level.append(snr)
    rows, target, level = np.array(rows), np.array(target), np.array(level)
    weight = 1 / np.array([target[level == one].std() for one in level])
    found = np.linalg.lstsq(rows * weight[:, None], target * weight, rcond=None)[0]
    left = target - rows @ found
    print(
        f"weak {found[0]:.3f}, border {found[1]:.3f}, constant {found[2]:.3f}, usual border "
        f"{rows[:, 1].mean():.2f}; deviation {target.std():.3f}, left {left.std():.3f}"
    )


def main():
    """Parse, measure, print the tables and keep them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--run", type=Path, default=Path("runs/bench-error-bars"), help="folder for the results"
    )
    parser.add_argument(
        "--lenslets", nargs="+", default=["square", "circle"], choices=["square", "circle"]
    )
    parser.add_argument("--count", type=int, default=7, help="lenslets a side")
    parser.add_argument(
        "--scene", nargs="+", default=["skimage:astronaut"], help="photographs or skimage:NAME"
    )
    parser.add_argument("--snr", nargs="+", type=float, default=[60, 50, 40, 30, 20], help="dB")
    parser.add_argument(
        "--methods", nargs="+", choices=METHODS, default=[m for m in METHODS if m != "dictionary"]
    )
    parser.add_argument(
        "--fitted", action="store_true", help="by the camera fitted to each capture"
    )
    parser.add_argument("--finer", action="store_true", help="capture three times finer")
    parser.add_argument(
        "--wrong", type=float, default=0.0, help="relative error of the lenslets' focal length"
    )
    parser.add_argument(
        "--alone", action="store_true", help="the methods alone, which believe matrix and noise"
    )
    parser.add_argument("--fit", action="store_true", help="print the constants, judge nothing")
    args = parser.parse_args()
    if args.fit:
        fitted(args)
        return
    rows = judged(args)
    args.run.mkdir(parents=True, exist_ok=True)
    (args.run / "error_bars.json").write_text(json.dumps(rows, indent=1))
    (args.run / "error_bars.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
