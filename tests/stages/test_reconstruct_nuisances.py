"""reconstruct of captures with a veil, defective and saturated pixels, through the command line."""

from dataclasses import replace

import numpy as np
import pytest

import plenocli as pc
from plenocli.evaluation.metrics.quality import psnr
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from tests.stages.test_reconstruct import make_files, reconstruct

SOME = ("lmmse", "tikhonov")


def disturb(folder, change):
    """Change the mosaic and the attributes of folder/capture.h5."""
    capture = read_artefact(folder / "capture.h5", "capture")
    mosaic = np.array(capture.data["capture/mosaic"], float)
    mosaic, about = change(mosaic, np.random.default_rng(8))
    capture.data["capture/mosaic"] = mosaic
    capture.attrs["capture"].update(about)
    write_artefact(folder / "capture.h5", capture, overwrite=True)


def veil(mosaic, rng):
    return mosaic + 0.05 * mosaic.mean(), {}


def dead(mosaic, rng):
    return np.where(rng.random(mosaic.shape) < 0.005, 0, mosaic), {}


def hot(mosaic, rng):
    return np.where(rng.random(mosaic.shape) < 0.002, 2 * mosaic.max(), mosaic), {}


def clipped(mosaic, rng):
    level = 0.8 * mosaic.max()
    return np.minimum(mosaic, level), {"white": float(level)}


def clipped_in_silence(mosaic, rng):
    return np.minimum(mosaic, 0.8 * mosaic.max()), {}


@pytest.mark.parametrize(
    "change, coupled, name, words",
    [
        (veil, False, "veil", "an even light of"),
        (veil, True, "veil", "an even light of"),
        (dead, True, "defects", "too dark"),
        (hot, False, "defects", "too bright"),
        (clipped, False, "saturated", "are saturated: they"),
        (clipped_in_silence, True, "saturated", "pile-up"),
    ],
)
def test_a_disturbed_capture_gives_the_picture_of_an_undisturbed_one(
    tmp_path, capsys, change, coupled, name, words
):
    truth = make_files(tmp_path, coupled)
    good = {m: psnr(reconstruct(tmp_path, "--method", m).data["image/value"], truth) for m in SOME}
    assert "even light" not in (said := capsys.readouterr().err) and "defective" not in said
    disturb(tmp_path, change)
    for method, least in good.items():
        image = reconstruct(tmp_path, "--method", method)
        assert psnr(image.data["image/value"], truth) > least - 0.3
        assert words in capsys.readouterr().err
        assert name in image.attrs["image"]["parameters"]


def test_the_white_image_undoes_vignetting_and_knows_dead_pixels(tmp_path):
    """A camera of small superpixels whose lenslets and pixels differ, seen by its white image."""
    text = pc.sample("seed_spatial.toml").read_text()
    for old, new in (
        ("= [40, 40]", "= [10, 10]"),
        ("= [52, 52]", "= [13, 13]"),
        ("= [11, 11]", "= [6, 6]"),
        ('= "2 um"', '= "8 um"'),
    ):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "camera.toml").write_text(text)
    camera = pc.read_camera(tmp_path / "camera.toml")
    matrix = pc.system_matrix(camera, superpixels=(1, 1), accuracy=1e-2)
    scene = pc.simulate_capture(camera, "skimage:astronaut", matrix=matrix, snr_db=50, seed=2)
    white = pc.simulate_capture(camera, np.ones((60, 60)), matrix=matrix, snr_db=50, seed=1)
    rng = np.random.default_rng(3)
    lenslet, pixel = np.divmod(np.arange(78), 13)
    place, corner = (pixel - 6) / 6, (lenslet - 2.5) / 2.5
    edge = (place - 0.3 * corner) ** 2
    gain = 1 - 0.1 * (edge[:, None] + edge)
    gain *= np.kron(rng.uniform(0.97, 1.03, (6, 6)), np.ones((13, 13)))
    gain *= rng.random(gain.shape) > 0.003

    def quality(factor):
        seen = [replace(one.capture, mosaic=one.capture.mosaic * factor) for one in (white, scene)]
        found = pc.reconstruct(seen[1], matrix, method="lmmse", calibration=pc.calibrate(seen[0]))
        return psnr(found.value, scene.scene[0])

    assert quality(gain) > quality(np.ones(gain.shape)) - 0.3


def test_the_white_image_of_lenslets_that_exchange_light_changes_nothing(tmp_path):
    """Neighbours' light belongs to the white that the matrix expects: the picture with a white
    image is that without one where there is nothing to undo.
    """
    camera = pc.read_camera(pc.sample("tiny.toml"))
    shot = pc.simulate_capture(camera, "skimage:astronaut", refine=2)
    white = pc.simulate_capture(camera, np.ones((40, 40)), refine=2, seed=4)
    matrix = pc.system_matrix(camera, superpixels=(3, 3), accuracy=1e-2)
    evened = pc.reconstruct(
        shot, matrix, method="lmmse", calibration=pc.calibrate(white.capture, camera=camera)
    )
    plain = pc.reconstruct(shot, matrix, method="lmmse")
    truth = shot.scene[0]
    assert psnr(evened.value, truth) > psnr(plain.value, truth) - 0.2
