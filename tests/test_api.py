"""The functions of a notebook: lazy, the commands' numbers, and the tutorial as it stands."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import plenocli as pc
from plenocli.base.errors import NumericsError, UsageError
from plenocli.cli.main import run
from plenocli.files.artefacts.reading import read_artefact

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def bench():
    camera = pc.read_camera(pc.sample("tiny.toml"))
    matrix = pc.system_matrix(camera, accuracy=1e-3)
    return (
        camera,
        matrix,
        pc.simulate_capture(camera, "skimage:astronaut", snr_db=60, matrix=matrix),
    )


def test_the_package_imports_nothing_heavy():
    code = (
        "import sys, plenocli\n"
        "print([m for m in ('numpy', 'scipy', 'h5py', 'pydantic', 'click') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_there_and_no_other():
    for name in ("reconstruct", "Capture", "SystemMatrix", "Budget"):
        assert name in dir(pc) and getattr(pc, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'reconstrict'"):
        pc.reconstrict  # noqa: B018


def test_the_numbers_are_those_of_the_commands(bench, tmp_path, monkeypatch):
    camera, matrix, capture = bench
    monkeypatch.chdir(tmp_path)
    tiny = str(pc.sample("tiny.toml"))
    scene = ["--scene", "skimage:astronaut", "--snr", "60dB", "--pif", "pif.h5"]
    assert run(["simulate-pif", tiny, "--accuracy", "1e-3", "-o", "pif.h5"]) == 0
    assert run(["capture-sim", tiny, *scene, "-o", "capture.h5"]) == 0
    assert np.array_equal(read_artefact("pif.h5").data["pif/A"], matrix.A)
    assert np.array_equal(
        read_artefact("capture.h5").data["capture/mosaic"], capture.capture.mosaic
    )
    for method in ("tikhonov", "lmmse"):
        made = ["reconstruct", "capture.h5", "--pif", "pif.h5", "--method", method]
        assert run([*made, "-o", f"{method}.h5"]) == 0
        image = pc.reconstruct(capture, matrix, method=method)
        assert np.array_equal(read_artefact(f"{method}.h5").data["image/value"], image.value)
        assert image.method == method and image.noise is not None
    assert run(["score", "lmmse.h5", "--truth", "capture.h5", "-o", "score.json"]) == 0
    told = json.loads(Path("score.json").read_text())["metrics"]["psnr_db"]
    assert pc.score(image, capture.scene).psnr_db == pytest.approx(told, rel=1e-12)


def test_spectra_are_those_of_the_commands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    demo = str(pc.sample("demo_spectral.toml"))
    fast = ["--spectral-step", "20nm", "--accuracy", "0.05"]
    for target in ("white", "mono:450nm", "mono:540nm", "mono:570nm", "mono:650nm", "colorchecker"):
        name = target.replace(":", "-")
        assert run(["capture-sim", demo, "--target", target, *fast, "-o", f"{name}.h5"]) == 0
    bands = [450, 540, 570, 650]
    pairs = [part for b in bands for part in ("--band", f"{b}nm=mono-{b}nm.h5")]
    assert run(["calibrate", "--white", "white.h5", *pairs, "-o", "cal.h5"]) == 0
    made = ["demux", "colorchecker.h5", "--calibration", "cal.h5", "--method", "wls"]
    assert run([*made, "-o", "spectra.h5"]) == 0
    calibration = pc.calibrate(
        pc.read_capture("white.h5"),
        bands={b * 1e-9: pc.read_capture(f"mono-{b}nm.h5") for b in bands},
    )
    found = pc.demultiplex(pc.read_capture("colorchecker.h5"), calibration, method="wls")
    stored = read_artefact("spectra.h5").data
    np.testing.assert_allclose(found.value, stored["spectra/value"], rtol=1e-6)
    np.testing.assert_allclose(found.sigma, stored["spectra/sigma"], rtol=1e-6)
    again = pc.demultiplex(
        pc.read_capture("colorchecker.h5"), pc.read_calibration("cal.h5"), method="wls"
    )
    np.testing.assert_allclose(again.value, found.value, rtol=1e-6)


def white_image():
    """Lenslets 20 px apart."""
    bright = np.sin(np.pi * np.arange(240) / 20) ** 2
    return 500 + 3000 * np.outer(bright, bright)


def test_what_cannot_be_is_told(bench):
    camera, matrix, capture = bench
    with pytest.raises(UsageError, match="known: .*lmmse"):
        pc.reconstruct(capture, matrix, method="magic")
    with pytest.raises(UsageError, match="learn_dictionary"):
        pc.reconstruct(capture, matrix, method="dictionary")
    with pytest.raises(UsageError, match="camera"):
        pc.refocus(capture, distances=[0.5])
    grid = pc.calibrate(pc.Capture(mosaic=white_image()))
    with pytest.raises(UsageError, match="response"):
        pc.demultiplex(pc.Capture(mosaic=white_image()), grid)
    with pytest.raises(UsageError, match="tiny.toml"):
        pc.sample("huge.toml")
    with pytest.raises(UsageError, match="truth"):
        pc.score(np.ones((3, 3)), np.ones((4, 4)))
    with pytest.raises(UsageError, match="finer"):
        pc.simulate_capture(camera, np.ones((9, 9)), matrix=matrix, refine=2)
    with pytest.raises(UsageError, match="wavelength 500 nm"):
        other = camera.replace(**{"light.wavelengths": (500e-9,)})
        pc.simulate_capture(other, np.ones((9, 9)), matrix=matrix)
    with pytest.raises(NumericsError, match="limit"), pc.within(pc.Budget(memory=1 << 10)):
        pc.simulate_capture(camera, np.ones((9, 9)), snr_db=40)


def test_the_tutorial_runs(tmp_path):
    blocks = re.findall(
        r"^```python\n(.*?)^```", (ROOT / "docs" / "api.md").read_text(), re.S | re.M
    )
    assert len(blocks) >= 6
    script = tmp_path / "tutorial.py"
    script.write_text("\n".join(blocks))
    command = [sys.executable, "-W", "error", script]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.iterdir()) == [script], "no file is needed, and none is made"
    assert "block-mean" in done.stdout and "square" in done.stdout
