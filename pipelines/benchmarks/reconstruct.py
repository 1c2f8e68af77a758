"""Quality and processor time of every method of reconstruct at several noise levels, with square
and with circular lenslets.

Each scene is captured and inverted with the same matrix of isolated lenslets, as section 3-2 of the
paper does (its inverse crime; `make spatial` has captures made three times finer, with neighbours'
light, beside it). Scenes are left out of the statistics and the trial that methods learn from;
"tikhonov, oracle" and "tsvd, oracle" choose their weight with the truth, and bound what these
methods can do. Times are process time on one thread for one capture, the set-up of the method
included, the singular value decomposition and the reading of training pictures,
which all share, not.

Writes RUN/reconstruct.json and RUN/reconstruct.md. Run from the project's root: python
pipelines/benchmarks/reconstruct.py --help.
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

SCENES = ("skimage:coffee", "skimage:chelsea", "skimage:camera", "skimage:rocket")
METHODS = {
    "block mean": {"method": "block-mean"},
    "tikhonov": {"method": "tikhonov"},
    "tikhonov, oracle": {"method": "tikhonov", "oracle": True},
    "tsvd": {"method": "tsvd"},
    "tsvd, oracle": {"method": "tsvd", "oracle": True},
    "nnls, 300 steps": {"method": "nnls", "nnls_iterations": 300},
    "nnls, converged": {"method": "nnls"},
    "lmmse": {"method": "lmmse"},
    "lmmse 3x3": {"method": "lmmse", "overlap": 3},
    "dictionary": {"method": "dictionary"},
    "tv": {"method": "tv"},
    "pnp": {"method": "pnp"},
    "auto": {"method": "auto"},
}


def system_of(config, shape):
    """stages.systems.System of one isolated lenslet of a configuration, square or circular."""
    from plenocli.files.config.camera_file import load_camera
    from plenocli.forward.accuracy.dial import plan_pif
    from plenocli.forward.propagation.system_matrix import build_pif
    from plenocli.inverse.picture.lenslet_model import LensletMatrix

    camera = load_camera(config)
    camera = camera.model_copy(
        update={"lenslet_array": camera.lenslet_array.model_copy(update={"aperture_shape": shape})}
    )
    matrix = (
        build_pif(
            camera,
            plan_pif(camera, model="fresnel", superpixels=(1, 1), coherent_ring=0, accuracy=1e-5),
        )
        .A[0, :1]
        .astype(float)
    )
    return LensletMatrix(
        path=Path(config),
        blocks=matrix,
        offsets=np.zeros((1, 2), int),
        pixel_shape=camera.sensor.pixels_per_lenslet,
        object_shape=camera.object.samples_per_lenslet,
    ), camera.lenslet_array.count


def capture(system, count, scene, snr, seed):
    """(Superpixels, true blocks) of a scene at `snr` dB of white noise, over the mean
    square of the capture.

    count: (rows, columns) of the camera's lenslets, of the whole scene; and of those in its middle,
        which are captured.
    """
    from plenocli.base.tiling import to_blocks
    from plenocli.files.read.training import linear_values
    from plenocli.forward.scene.sample import luminance, sample_picture
    from plenocli.forward.sensor.noise import Noise
    from plenocli.inverse.picture.lenslet_model import Superpixels

    whole, kept = count
    rows, columns = (int(n) * m for n, m in zip(whole, system.object_shape))
    truth = to_blocks(
        np.asarray(sample_picture(luminance(linear_values(scene)), rows, columns), float),
        system.object_shape,
    )
    truth = truth[tuple(slice((n - k) // 2, (n - k) // 2 + k) for n, k in zip(whole, kept))]
    y = truth @ system.own.T
    sigma = float(np.sqrt(np.mean(y**2)) * 10 ** (-snr / 20))
    return Superpixels(
        y=y + sigma * np.random.default_rng(seed).standard_normal(y.shape),
        noise=Noise.of_sigma(sigma),
        scene=scene,
    ), truth


def measure(estimators, data, truth, options):
    """{"psnr_db", "ssim", "seconds", "took"} of one method on one capture."""
    from plenocli.base.tiling import to_plane
    from plenocli.evaluation.metrics.quality import psnr, ssim
    from plenocli.inverse.picture.methods.registry import METHODS as BY_NAME

    shape = estimators.system.object_shape
    began = time.process_time()
    method = BY_NAME[estimators.options.method]
    found = method.reconstruct(estimators, data, truth if options.get("oracle") else None)
    seconds = time.process_time() - began
    x, truth = to_plane(found.value, shape), to_plane(truth, shape)
    return {
        "psnr_db": psnr(x, truth),
        "ssim": ssim(x, truth),
        "seconds": seconds,
        "took": found.method,
    }


def estimators_of(system, settings):
    """Estimators that train on the default pictures."""
    from plenocli.files.read.dictionaries import read_dictionary
    from plenocli.files.read.training import read_training
    from plenocli.inverse.picture.estimators import Estimators

    return Estimators(
        system,
        settings.options,
        lambda scene: read_training((), system.object_shape, not_scene=scene),
        settings.dictionary and (lambda: read_dictionary(settings.dictionary, system)),
    )


def compare(args):
    """[{"lenslets", "scene", "snr_db", "seed", "method", ...}], one a run."""
    from plenocli.stages.inverse.reconstruct.recipe import Settings

    rows = []
    dictionaries = dict(zip(args.lenslets, args.dictionary or []))
    for lenslets in args.lenslets:
        system, count = system_of(args.config, lenslets)
        first = estimators_of(system, Settings())
        _ = first.svd
        for scene in args.scene:
            first.prior.pictures(scene)
            for snr in args.snr:
                for seed in range(args.seeds):
                    data, truth = capture(system, (count, args.count or count), scene, snr, seed)
                    for method in args.methods:
                        options = METHODS[method]
                        if options["method"] == "dictionary" and lenslets not in dictionaries:
                            continue
                        settings = {k: v for k, v in options.items() if k != "oracle"}
                        if options["method"] in ("dictionary", "auto") and lenslets in dictionaries:
                            settings["dictionary"] = Path(dictionaries[lenslets])
                        one = estimators_of(replace(system), Settings(seed=seed, **settings))
                        one.svd, one.prior.pictures_of[scene] = (
                            first.svd,
                            first.prior.pictures_of[scene],
                        )
                        found = measure(one, data, truth, options)
                        rows.append(
                            {
                                "lenslets": lenslets,
                                "scene": scene,
                                "snr_db": snr,
                                "seed": seed,
                                "method": method,
                            }
                            | found
                        )
                        print(
                            (
                                f"{lenslets} {scene} {snr:g} dB, {method}: {found['psnr_db']:.2f} "
                                f"dB, SSIM {found['ssim']:.3f}, {found['seconds']:.1f} "
                                f"s ({found['took']})"
                            ),
                            flush=True,
                        )
    return rows


def table(rows):
    """Means over scenes and seeds as markdown: PSNR / SSIM, a column a noise level,
    and the mean time.
    """
    out = []
    for lenslets in dict.fromkeys(r["lenslets"] for r in rows):
        here = [r for r in rows if r["lenslets"] == lenslets]
        levels = sorted({r["snr_db"] for r in here}, reverse=True)
        out += [
            f"**{lenslets} lenslets**, mean of {len({r['scene'] for r in here})} scenes",
            "",
            "| | " + " | ".join(f"{level:g} dB" for level in levels) + " | CPU s |",
            "|---|" + "---|" * (len(levels) + 1),
        ]
        for method in dict.fromkeys(r["method"] for r in here):
            mine = [r for r in here if r["method"] == method]
            cells = []
            for level in levels:
                group = [r for r in mine if r["snr_db"] == level]
                cells.append(
                    (
                        f"{np.mean([r['psnr_db'] for r in group]):.2f} / "
                        f"{np.mean([r['ssim'] for r in group]):.3f}"
                    )
                    if group
                    else ""
                )
            out.append(
                f"| {method} | "
                + " | ".join(cells)
                + f" | {np.mean([r['seconds'] for r in mine]):.1f} |"
            )
        out.append("")
    return "\n".join(out)


def main():
    """Parse, measure, print the tables and keep them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--run", type=Path, default=Path("runs/bench-reconstruct"), help="folder for the results"
    )
    parser.add_argument(
        "--config", default=str(ROOT / "sample_configs" / "seed_spatial.toml"), help="camera"
    )
    parser.add_argument(
        "--lenslets",
        nargs="+",
        default=["square", "circle"],
        choices=["square", "circle"],
        help="shapes of the lenslets",
    )
    parser.add_argument(
        "--count",
        nargs=2,
        type=int,
        help="rows and columns of lenslets, in the middle of the camera's, instead of all",
    )
    parser.add_argument(
        "--scene",
        nargs="+",
        default=SCENES,
        help="photographs or skimage:NAME; validation scenes by default",
    )
    parser.add_argument(
        "--snr", nargs="+", type=float, default=[60, 40, 30, 20], help="noise levels in dB"
    )
    parser.add_argument("--seeds", type=int, default=1, help="noise draws of each capture")
    parser.add_argument(
        "--methods",
        nargs="+",
        choices=METHODS,
        default=[m for m in METHODS if m != "nnls, converged"],
        help="converged nnls takes minutes a capture",
    )
    parser.add_argument(
        "--dictionary",
        nargs="+",
        help=(
            "a dictionary for each of --lenslets, for auto too; without it that method is left out"
        ),
    )
    args = parser.parse_args()
    rows = compare(args)
    args.run.mkdir(parents=True, exist_ok=True)
    (args.run / "reconstruct.json").write_text(json.dumps(rows, indent=1))
    (args.run / "reconstruct.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
