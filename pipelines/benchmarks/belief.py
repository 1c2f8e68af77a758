"""What cameras that are not as described cost, photograph by photograph: dB over the mean of each
lenslet with the matrix as described, believed and doubted, and with the right one.

The half-sized seed camera (20x20 points, 26x26 pixels, 6x6 lenslets), captured by matrices that
differ from the one it is inverted with. Quantiles over all photographs of a folder. Statistics are
from other photographs (those of scikit-image).

With --scenes instead of a folder: scenes that are no photographs, by the right matrix, with square
and circular lenslets and at f/4.4: what is lost against the same method with the matrix believed.

python pipelines/benchmarks/belief.py FOLDER [--method lmmse ...] [--snr 60 40 20]
python pipelines/benchmarks/belief.py --scenes [--method lmmse ...] [--snr 60 40 20]
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

SHAPE, COUNT, PIXELS = (20, 20), 6, 26
HALF = (("[40, 40]", "[20, 20]"), ("[52, 52]", "[26, 26]"), ('"2 um"', '"4 um"'))
ROWS = {
    "nothing": (),
    "exact model": (),
    "focus 556 for 550 mm": (('"550 mm"', '"556 mm"'),),
    "pitch and pixels +0.1 %": (('"104 um"', '"104.104 um"'), ('"4 um"', '"4.004 um"')),
    "560 for 550 nm": (('"550 nm"', '"560 nm"'),),
    "shift of 0.1 px": (),
    "lenslets' focus +0.5 %": (('focal_length = "832 um"', 'focal_length = "836.16 um"'),),
    "sensor distance +0.5 %": (('distance = "832 um"', 'distance = "836.16 um"'),),
    "exact model, f/4.4": (("f_number = 8", "f_number = 4.4"),),
}
CAMERAS = {
    "square lenslets": (),
    "circular lenslets": (('aperture_shape = "square"', 'aperture_shape = "circle"'),),
    "f/4.4": (("f_number = 8", "f_number = 4.4"),),
}
LOST = 0.1
"""dB that a right matrix may lose."""


def matrix(changes, model="fresnel"):
    """(pixel, point) of the seed camera, half as fine, with texts of its description replaced."""
    from plenocli import api

    text = api.sample("seed_spatial.toml").read_text()
    for old, new in (*HALF, *changes):
        text = text.replace(old, new)
    with tempfile.TemporaryDirectory() as folder:
        (path := Path(folder) / "camera.toml").write_text(text)
        camera = api.read_camera(path)
    made = api.system_matrix(
        camera, superpixels=(1, 1), coherent_ring=0, accuracy=1e-5, model=model
    )
    return np.asarray(made.A, float)[0, 0]


def pair(row):
    """(assumed, true) matrix of a row."""
    changes = ROWS[row]
    if row.startswith("exact"):
        return matrix(changes), matrix(changes, "exact")
    if row.startswith("shift"):
        a = matrix(()).reshape(PIXELS, PIXELS, -1)
        turn = np.exp(-2j * np.pi * np.fft.fftfreq(PIXELS) * 0.1)[:, None, None]
        return matrix(()), np.fft.ifft(np.fft.fft(a, axis=0) * turn, axis=0).real.reshape(
            PIXELS**2, -1
        )
    return matrix(()), matrix(changes)


def blocks(path):
    """(lenslet_row, lenslet_column, point) of the middle of a photograph."""
    from skimage.transform import resize

    from plenocli.base.tiling import to_blocks
    from plenocli.files.images.pictures import read_picture
    from plenocli.forward.scene.sample import luminance

    picture = luminance(np.asarray(read_picture(path).values, float))
    side = min(picture.shape)
    top, left = ((n - side) // 2 for n in picture.shape)
    middle = picture[top : top + side, left : left + side]
    return to_blocks(resize(middle, [COUNT * n for n in SHAPE], anti_aliasing=True), SHAPE)


def estimators(a):
    """Of a matrix of isolated lenslets."""
    from plenocli.files.read.training import read_training
    from plenocli.inverse.picture.estimators import Estimators, Options
    from plenocli.inverse.picture.lenslet_model import LensletMatrix

    system = LensletMatrix(
        path=Path("pif.h5"),
        blocks=a[None],
        offsets=np.zeros((1, 2), int),
        pixel_shape=(PIXELS, PIXELS),
        object_shape=SHAPE,
    )
    return Estimators(
        system, Options(), lambda scene: read_training((), SHAPE, not_scene=scene), threads=1
    )


def gains(row, files, snr_db, method):
    """(photograph, 4) dB over the block mean: believed, doubted, by the right matrix; doubt."""
    from plenocli.base.progress import collected_notes
    from plenocli.forward.sensor.noise import Noise
    from plenocli.inverse.picture.estimate import estimate
    from plenocli.inverse.picture.lenslet_model import Superpixels
    from plenocli.inverse.picture.methods.registry import METHODS

    assumed, true = pair(row)
    wrong, right = estimators(assumed), estimators(true)
    rows = []
    for number, path in enumerate(files):
        x = blocks(path)
        y = x @ true.T
        sigma = float(np.sqrt(np.mean(y**2)) * 10 ** (-snr_db / 20))
        y = y + sigma * np.random.default_rng(number).standard_normal(y.shape)
        data = Superpixels(y=y, noise=Noise.of_sigma(sigma))

        def psnr(value, x=x):
            return -10 * np.log10(np.mean((value - x) ** 2))

        with collected_notes():
            floor = psnr(estimate(wrong, METHODS["block-mean"], data)[0].value)
            plain = METHODS[method].reconstruct(wrong, data)
            found, _ = estimate(wrong, METHODS[method], data)
            best, _ = estimate(right, METHODS[method], data)
        told = found.as_json()
        rows.append(
            [
                psnr(plain.value) - floor,
                psnr(found.value) - floor,
                psnr(best.value) - floor,
                not told["matrix_believed"],
            ]
        )
    return np.array(rows)


def losses(camera, snr_db, method):
    """Scene -> dB lost by not believing the right matrix."""
    from unittest.mock import patch

    from plenocli.base.progress import collected_notes
    from plenocli.base.tiling import to_blocks
    from plenocli.forward.sensor.noise import Noise
    from plenocli.inverse.picture import estimate as module
    from plenocli.inverse.picture.lenslet_model import Superpixels
    from plenocli.inverse.picture.methods.registry import METHODS
    from plenocli.inverse.picture.trust.believe import Belief
    from tests.reference.scenes import scenes

    def believing(estimators, y, level, scene, **rest):
        return Belief(level=level, lmmse=estimators.prior.lmmse(level.sigma, scene), right=True)

    a = matrix(CAMERAS[camera])
    right, lost = estimators(a), {}
    for number, (name, picture) in enumerate(scenes(SHAPE[0], COUNT).items()):
        x = to_blocks(picture, SHAPE)
        y = x @ a.T
        sigma = float(np.sqrt(np.mean(y**2)) * 10 ** (-snr_db / 20))
        y = y + sigma * np.random.default_rng(number).standard_normal(y.shape)
        data = Superpixels(y=y, noise=Noise.of_sigma(sigma))
        with collected_notes():
            found = module.estimate(right, METHODS[method], data)[0].value
            with patch.object(module, "believe", believing):
                believed = module.estimate(right, METHODS[method], data)[0].value
        ratio = np.mean((found - x) ** 2) / np.mean((believed - x) ** 2)
        lost[name] = 10 * np.log10(ratio)
    return lost


def main_scenes(methods, levels):
    """The table of scenes that are no photographs."""
    print("| SNR | method | camera | scenes | lost more than 0.1 dB |")
    print("|---|---|---|---|---|")
    for snr_db in levels:
        for method in methods:
            for camera in CAMERAS:
                lost = losses(camera, snr_db, method)
                told = ", ".join(f"{n} {v:.1f}" for n, v in lost.items() if v > LOST)
                print(f"| {snr_db:.0f} | {method} | {camera} | {len(lost)} | {told or 'none'} |")
                sys.stdout.flush()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("folder", type=Path, nargs="?")
    which.add_argument("--scenes", action="store_true")
    parser.add_argument("--method", nargs="+", default=["lmmse"])
    parser.add_argument("--snr", nargs="+", type=float, default=[60, 40, 20])
    asked = parser.parse_args()
    if asked.scenes:
        main_scenes(asked.method, asked.snr)
        return
    files = sorted(p for p in asked.folder.rglob("*") if p.suffix in (".png", ".jpg", ".exr"))
    print(f"{len(files)} photographs; dB over the mean of each lenslet: least, median, most")
    print("| SNR | method | disturbed | as described | doubted | right matrix | doubt |")
    print("|---|---|---|---|---|---|---|")
    for snr_db in asked.snr:
        for method in asked.method:
            for row in ROWS:
                found = gains(row, files, snr_db, method)
                cells = [
                    " ".join(f"{v:.1f}" for v in np.quantile(found[:, k], (0, 0.5, 1)))
                    for k in range(3)
                ]
                doubt = f"{found[:, 3].mean():.0%}"
                print(f"| {snr_db:.0f} | {method} | {row} |", " | ".join(cells), f"| {doubt} |")
                sys.stdout.flush()


if __name__ == "__main__":
    main()
