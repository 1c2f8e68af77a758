"""reconstruct of captures with a veil, defective and saturated pixels, through the command line."""

import numpy as np
import pytest

from plenocli.evaluation.metrics.quality import psnr
from plenocli.files.artefacts.container import read_artefact, write_artefact
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
        (veil, False, "veil", "an even light of 4."),
        (veil, True, "veil", "an even light of 5."),
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
