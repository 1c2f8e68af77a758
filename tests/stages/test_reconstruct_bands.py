"""Demultiplexing and reconstruction in one linear model: a camera with filters in its pupil,
simulated finer than it is inverted.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from plenocli.cli.main import run
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.images.spectral_exr import read_spectral_exr
from plenocli.forward.scene.sample import block_mean

SEED = Path(__file__).resolve().parents[2] / "sample_configs" / "seed_spectral.toml"
BANDS = np.array([450e-9, 540e-9, 570e-9, 650e-9])
COUNT, POINTS = 5, 12
MODEL = ["--model", "fresnel", "--accuracy", "1e-2", "--superpixels", "1x1", "--coherent-ring", "0"]
STEP = ["--spectral-step", "15nm"]


def rms(difference):
    return np.sqrt(np.mean(np.square(difference), axis=(1, 2)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """camera.toml; pif.h5 (every wavelength), narrow.h5 (one a filter); capture.h5
    of twice the points.
    """
    folder = tmp_path_factory.mktemp("bands")
    text = SEED.read_text()
    for key, value in (
        ("count", f"[{COUNT}, {COUNT}]"),
        ("pixel_pitch", '"4 um"'),
        ("pixels_per_lenslet", "[26, 26]"),
    ):
        text = re.sub(rf"^{key} = .*$", f"{key} = {value}", text, flags=re.M)
    (folder / "camera.toml").write_text(text)
    camera = str(folder / "camera.toml")
    assert run(["simulate-pif", camera, *MODEL, *STEP, "-o", str(folder / "pif.h5")]) == 0
    assert run(["simulate-pif", camera, *MODEL, "-o", str(folder / "narrow.h5")]) == 0
    assert (
        run(
            [
                "capture-sim",
                camera,
                *MODEL,
                *STEP,
                "--scene",
                "skimage:astronaut",
                "--refine",
                "2",
                "--snr",
                "50dB",
                "--seed",
                "1",
                "-o",
                str(folder / "capture.h5"),
            ]
        )
        == 0
    )
    return folder


def reconstruct(folder, *options, pif="pif.h5", output="out.h5"):
    assert (
        run(
            [
                "reconstruct",
                str(folder / "capture.h5"),
                "--pif",
                str(folder / pif),
                "-o",
                str(folder / output),
                "--overwrite",
                *options,
            ]
        )
        == 0
    )
    return read_artefact(folder / output, "image") if output.endswith(".h5") else None


@pytest.mark.parametrize("pif", ["pif.h5", "narrow.h5"])
def test_every_band_is_a_picture(folder, pif):
    truth = read_artefact(folder / "capture.h5", "capture").data["capture/scene"].astype(float)
    images = {
        m: reconstruct(folder, "--method", m, pif=pif)
        for m in ("block-mean", "tikhonov", "lmmse", "pnp")
    }
    errors = {}
    for method, image in images.items():
        value = image.data["image/value"]
        assert value.shape == truth.shape == (4, COUNT * POINTS, COUNT * POINTS)
        np.testing.assert_allclose(image.data["image/wavelength"], BANDS)
        errors[method] = rms(value - truth)
        even = np.stack([block_mean(plane, (POINTS, POINTS)) for plane in value - truth])
        # brightness of each band: demultiplexing alone
        assert rms(even).max() < (0.02 if pif == "pif.h5" else 0.03), method
    assert np.mean(errors["lmmse"]) < 0.75 * np.mean(errors["block-mean"]) and np.mean(
        errors["tikhonov"]
    ) < 0.8 * np.mean(errors["block-mean"]), errors
    assert np.mean(errors["pnp"]) < 1.02 * np.mean(errors["lmmse"]), errors
    lmmse = images["lmmse"].data["image/value"]
    for k in (0, 3):  # blue and red are told apart (540 and 570 nm are nearly one picture)
        assert rms(lmmse - truth[k])[k] < 0.8 * rms(lmmse[k] - truth)[3 - k]
    sigma = images["lmmse"].data["image/sigma"]
    assert (
        sigma.shape == truth.shape
        and 0.5 < np.sqrt(np.mean(sigma**2)) / np.sqrt(np.mean(errors["lmmse"] ** 2)) < 2
    )


def test_bands_go_to_a_spectral_exr_and_to_score(folder, capsys):
    image = reconstruct(folder)
    parameters = image.attrs["image"]["parameters"]
    assert image.attrs["image"]["method"] in ("lmmse", "pnp") and set(parameters["trial_db"]) == {
        "lmmse",
        "pnp",
    }
    assert len(parameters["seen"]["bands"]) == 4 and image.data["image/seen"].shape == (
        POINTS,
        POINTS,
    )
    reconstruct(folder, output="out.exr")
    cube = read_spectral_exr(folder / "out.exr")
    np.testing.assert_allclose(cube.wavelengths, BANDS, rtol=1e-9)
    np.testing.assert_allclose(cube.values, image.data["image/value"], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(cube.sigma, image.data["image/sigma"], rtol=1e-5, atol=1e-6)
    capsys.readouterr()
    assert (
        run(
            [
                "score",
                str(folder / "out.h5"),
                str(folder / "out.exr"),
                "--truth",
                str(folder / "capture.h5"),
                "-o",
                str(folder / "score.json"),
                "--overwrite",
            ]
        )
        == 0
    )
    entries = json.loads((folder / "score.json").read_text())["results"]
    truth = read_artefact(folder / "capture.h5", "capture").data["capture/scene"]
    expected = -10 * np.log10(np.mean((image.data["image/value"] - truth) ** 2))
    assert (
        entries[0]["metrics"]["psnr_db"] == pytest.approx(expected, abs=1e-3) and len(entries) == 2
    )


def test_bands_are_drawn_and_not_compared_as_one_picture(folder, tmp_path, capsys):
    reconstruct(folder, "--method", "block-mean", output="even.h5")
    assert (
        run(["show", str(folder / "even.h5"), "-o", str(tmp_path / "bands.png")]) == 0
        and (tmp_path / "bands.png").stat().st_size > 5000
    )
    capsys.readouterr()
    assert (
        run(
            [
                "show",
                str(folder / "even.h5"),
                "--truth",
                str(folder / "capture.h5"),
                "-o",
                str(tmp_path / "never.png"),
            ]
        )
        == 2
    )
    assert "score --report" in capsys.readouterr().err


def test_the_truth_in_hindsight_has_bands_too(folder):
    truth = read_artefact(folder / "capture.h5", "capture").data["capture/scene"]
    error = {
        hint: rms(reconstruct(folder, "--method", "tikhonov", *options).data["image/value"] - truth)
        for hint, options in (("none", []), ("truth", ["--truth", str(folder / "capture.h5")]))
    }
    assert np.sum(error["truth"] ** 2) <= np.sum(error["none"] ** 2) * (1 + 1e-9)


def test_another_light_is_told(folder, tmp_path, capsys):
    capture = read_artefact(folder / "capture.h5", "capture")
    capture.attrs["capture"]["illuminant"] = "A"
    from plenocli.files.artefacts.writing import write_artefact

    write_artefact(tmp_path / "lamp.h5", capture)
    assert (
        run(
            [
                "reconstruct",
                str(tmp_path / "lamp.h5"),
                "--pif",
                str(folder / "pif.h5"),
                "--method",
                "block-mean",
                "-o",
                str(tmp_path / "out.h5"),
            ]
        )
        == 0
    )
    assert "was lit by A" in capsys.readouterr().err


@pytest.mark.slow
def test_bands_with_the_neighbours_light(folder, tmp_path):
    """By the exact model, and at a noise that hides what four bands in place of 21 are off by
    (0.9 %): of a matrix that is not believed, Tikhonov's detail is drawn back to the means.
    """
    camera, joined = (
        str(folder / "camera.toml"),
        [
            "--model",
            "exact",
            "--accuracy",
            "1e-2",
            "--superpixels",
            "3x3",
            "--coherent-ring",
            "1",
        ],
    )
    assert run(["simulate-pif", camera, *joined, "-o", str(tmp_path / "pif.h5")]) == 0
    assert (
        run(
            [
                "capture-sim",
                camera,
                *joined,
                *STEP,
                "--scene",
                "skimage:astronaut",
                "--snr",
                "40dB",
                "--seed",
                "1",
                "-o",
                str(tmp_path / "capture.h5"),
            ]
        )
        == 0
    )
    truth = read_artefact(tmp_path / "capture.h5", "capture").data["capture/scene"]
    error = {}
    for name, options in (
        ("joint", ["lmmse"]),
        ("alone", ["lmmse", "--overlap", "1"]),
        ("tikhonov", ["tikhonov"]),
        ("pnp", ["pnp"]),
    ):
        image = reconstruct(tmp_path, "--method", *options)
        error[name] = np.sqrt(np.mean(rms(image.data["image/value"] - truth) ** 2))
        if name == "joint":
            assert 0.6 < np.sqrt(np.mean(image.data["image/sigma"] ** 2)) / error[name] < 1.6
    # alone, the neighbours' light is taken for noise
    assert (
        error["joint"] < 0.66 * error["alone"]
        and error["joint"] < 0.13
        and error["tikhonov"] < 1.15 * error["joint"]
        and error["pnp"] < error["joint"]
    ), error
