"""One small file of every kind, made by the commands themselves, and the size of the campaigns.

By default each test does a seeded share of its campaign; `pytest --campaign` (make
faults) does all of it.
"""

import fcntl
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from tests.faults.harness import Runner

SAMPLES = Path(__file__).resolve().parents[2] / "sample_configs"
SWEEP = """
camera = "camera.toml"
[vary]
"main_lens.f_number" = [7, 8]
[simulate-pif]
superpixels = "1x1"
coherent-ring = 0
[reconstruct]
method = "block-mean"
"""


@pytest.fixture(scope="session")
def campaign(request):
    """campaign(share, full): how many cases to run."""
    return lambda share, full: full if request.config.getoption("--campaign") else share


@pytest.fixture(scope="session")
def runner(campaign):
    """A Runner for all tests of this process. In a campaign every command imports what draws by
    itself, and faults reach that, too.
    """
    with Runner(campaign(("matplotlib.figure", "matplotlib.backends.backend_agg"), ())) as made:
        yield made


@pytest.fixture(scope="session")
def stages(tmp_path_factory, runner):
    """(folder, stages): a folder with one file of each kind, and for each command the arguments
    that make its result again.

    stages: name -> (arguments without -o, name of the result). The processes of a parallel run
    share one folder: look, never touch.
    """
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = base / "faults"
    with open(base / "faults.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "done").exists():
            make_all(folder, runner)
    return folder, _steps()


def make_all(folder, runner):
    """Make the files of all stages in a new folder."""
    folder.mkdir()
    (folder / "camera.toml").write_text((SAMPLES / "tiny.toml").read_text())
    (folder / "colour.toml").write_text(_spectral_camera())
    (folder / "scene.toml").write_text((SAMPLES / "scenes" / "shallow.toml").read_text())
    (folder / "designs.toml").write_text(SWEEP)
    _write_pictures(folder)
    for name, (arguments, result) in _steps().items():
        outcome = runner.run([*arguments, "-o", result], folder, limit=120)
        assert outcome.code == 0, (name, outcome.text)
    fit = ["fit-camera", "capture.h5", "--camera", "camera.toml", "--details", "fit.h5"]
    outcome = runner.run([*fit, "-o", "fitted.toml"], folder, limit=120)
    assert outcome.code == 0, outcome.text
    (folder / "near.toml").write_text('depth = ["545 mm", "555 mm"]\n')
    pif = ["simulate-pif", "camera.toml", "--scene", "near.toml", "--accuracy", "0.05"]
    pif += ["--superpixels", "1x1", "--coherent-ring", "0"]
    outcome = runner.run([*pif, "-o", "stack.h5"], folder, limit=120)
    assert outcome.code == 0, outcome.text
    field = ["simulate-pif", "camera.toml", "--field-nodes", "3", "--accuracy", "0.1"]
    field += ["--superpixels", "1x1", "--coherent-ring", "0", "-o", "field.h5"]
    outcome = runner.run(field, folder, limit=120)
    assert outcome.code == 0, outcome.text
    (folder / "microscope.toml").write_text(_microscope())
    for arguments in (
        ["simulate-pif", "microscope.toml", "--model", "ray", "-o", "kernels.h5"],
        ["capture-sim", "microscope.toml", "--model", "ray", "--volume", "phantom:beads"]
        + ["--scene-out", "volume.h5", "-o", "volume-capture.h5"],
    ):
        outcome = runner.run(arguments, folder, limit=120)
        assert outcome.code == 0, outcome.text
    write_shards(folder, "shards.h5", (tuple(range(5)), tuple(range(5, 9))))
    learnt = read_artefact(folder / "dictionary.h5")
    write_artefact(folder / "unfinished.h5", replace(learnt, kind="checkpoint"))
    (folder / "done").touch()


def write_shards(folder, name, groups, overwrite=False):
    """The 3x3 matrix in a file for each group of its lenslets, and their index: cameras for
    which the stage does so are too large for these tests.
    """
    from plenocli.files.artefacts.shards import read_pif, writing_pif

    whole = read_pif(folder / "pif-3x3.h5")
    A = whole.data["pif/A"]
    with writing_pif(folder / name, A.shape, A.dtype, groups=groups, overwrite=overwrite) as writer:
        for band in range(A.shape[0]):
            for lenslet in range(9):
                writer.put(band, lenslet, A[band, lenslet])
        whole.data["pif/A"] = None
        writer.close(whole)


def _spectral_camera():
    """The demo's camera with few lenslets and two colours."""
    text = (
        (SAMPLES / "demo_spectral.toml")
        .read_text()
        .replace("count = [20, 30]", "count = [6, 7]")
        .replace("samples_per_lenslet = [10, 10]", "samples_per_lenslet = [2, 2]")
    )
    assert "[6, 7]" in text and "[2, 2]" in text
    return text


def _microscope():
    """The sample's microscope with few planes, pixels and lenslets."""
    text = (
        (SAMPLES / "microscope.toml")
        .read_text()
        .replace('"-12 um to 12 um step 1 um"', '["-2 um", "1 um"]')
        .replace("count = [29, 29]", "count = [5, 6]")
        .replace('pixel_pitch = "6.6666667 um"', 'pixel_pitch = "20 um"')
        .replace("pixels_per_lenslet = [15, 15]", "pixels_per_lenslet = [5, 5]")
        .replace("samples_per_lenslet = [3, 3]", "samples_per_lenslet = [2, 2]")
    )
    assert "[5, 6]" in text and "-2 um" in text and '"20 um"' in text
    return text


def _write_pictures(folder):
    import OpenImageIO as oiio

    values = np.random.default_rng(4).integers(20, 230, (48, 56, 3)).astype(np.uint8)
    for name in ("photo.png", "photo.tif", "photo.jpg"):
        out = oiio.ImageOutput.create(str(folder / name))
        out.open(str(folder / name), oiio.ImageSpec(56, 48, 3, "uint8"))
        out.write_image(values)
        out.close()


def _steps():
    quick = ["--model", "ray", "--superpixels", "1x1"]
    bands = [f"{nm}nm" for nm in (450, 540, 570, 650)]
    take = {
        f"band-{b}": (
            ["capture-sim", "colour.toml", *quick, "--target", f"mono:{b}", "--seed", "3"],
            f"{b}.dng",
        )
        for b in bands
    }
    take |= {
        t: (["capture-sim", "colour.toml", *quick, "--target", t, "--seed", "4"], f"{t}.dng")
        for t in ("white", "dark", "colorchecker")
    }
    return {
        "simulate-pif": (
            ["simulate-pif", "camera.toml", "--superpixels", "1x1", "--coherent-ring", "0"],
            "pif.h5",
        ),
        "simulate-pif 3x3": (
            ["simulate-pif", "camera.toml", "--superpixels", "3x3", "--coherent-ring", "1"],
            "pif-3x3.h5",
        ),
        "capture-sim": (
            [
                "capture-sim",
                "camera.toml",
                "--pif",
                "pif.h5",
                "--scene",
                "photo.png",
                "--snr",
                "50dB",
            ],
            "capture.h5",
        ),
        "capture-sim exr": (
            [
                "capture-sim",
                "camera.toml",
                "--pif",
                "pif.h5",
                "--scene",
                "photo.png",
                "--snr",
                "50dB",
            ],
            "capture.exr",
        ),
        **take,
        "simulate-response": (
            ["simulate-response", "colour.toml", "--model", "ray"],
            "predicted.h5",
        ),
        "calibrate": (
            [
                "calibrate",
                "--white",
                "white.dng",
                "--dark",
                "dark.dng",
                *(w for b in bands for w in ("--band", f"{b}={b}.dng")),
            ],
            "calibration.h5",
        ),
        "demux": (
            [
                "demux",
                "colorchecker.dng",
                "--calibration",
                "calibration.h5",
                "--reference",
                "white.dng",
            ],
            "spectra.h5",
        ),
        "demux exr": (
            [
                "demux",
                "colorchecker.dng",
                "--calibration",
                "calibration.h5",
                "--reference",
                "white.dng",
            ],
            "spectra.exr",
        ),
        "learn-dict": (
            [
                "learn-dict",
                "photo.png",
                "--pif",
                "pif.h5",
                "--atoms",
                "80",
                "--batch",
                "64",
                "--iterations",
                "2",
            ],
            "dictionary.h5",
        ),
        "reconstruct": (
            ["reconstruct", "capture.h5", "--pif", "pif.h5", "--method", "tikhonov"],
            "image.h5",
        ),
        "reconstruct exr": (
            ["reconstruct", "capture.h5", "--pif", "pif.h5", "--method", "tikhonov"],
            "image.exr",
        ),
        "refocus": (["refocus", "capture.h5", "--planes", "3"], "planes.h5"),
        "score": (["score", "image.h5", "--truth", "capture.h5"], "score.json"),
        "show": (["show", "image.h5"], "image.png"),
        "sweep": (["sweep", "designs.toml"], "sweep.h5"),
    }
