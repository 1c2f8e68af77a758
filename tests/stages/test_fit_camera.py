"""fit-camera: from a capture of a camera that is not quite the described one to a description that
explains it, and to the matrix made from that.
"""

import json

import numpy as np
import pytest
from skimage import data

from plenocli.base.tiling import to_blocks
from plenocli.cli.main import run
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.config.camera_file import load_camera, to_toml
from plenocli.files.read.system_matrices import read_lenslet_matrix
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.picture import tiles
from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.lenslet_model import Superpixels
from plenocli.stages.inverse.reconstruct import fitted_matrix
from plenocli.stages.inverse.reconstruct.fitted_matrix import camera_fit
from tests.forward.propagation.cameras import small_camera

KEYS = {
    "object__samples_per_lenslet": (10, 10),
    "sensor__pixels_per_lenslet": (16, 16),
    "sensor__distance": 256e-6,
    "lenslet_array__focal_length": 256e-6,
    "lenslet_array__pitch": 32e-6 / (1 + 256e-6 / 55e-3),
    "lenslet_array__count": (6, 6),
}
DISTANCE = 256.6e-6
REAL = KEYS | {
    "sensor__distance": DISTANCE,
    "lenslet_array__pitch": 32e-6 / (1 + DISTANCE / 55e-3),
    "object__distance": 0.553,
    "main_lens__aberrations": ({"noll": 7, "coefficient": 2e-8},),
}
ALONE = ("--superpixels", "1x1", "--coherent-ring", "0", "--model", "fresnel")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A description, the real camera and its capture."""
    folder = tmp_path_factory.mktemp("fit")
    (folder / "camera.toml").write_text(to_toml(small_camera(**KEYS)))
    (folder / "real.toml").write_text(to_toml(small_camera(**REAL)))
    place = str(folder)
    assert run(["simulate-pif", f"{place}/real.toml", *ALONE, "-o", f"{place}/real.h5"]) == 0
    made = ["capture-sim", f"{place}/real.toml", "--pif", f"{place}/real.h5", "--snr", "50dB"]
    assert run([*made, "--scene", "skimage:astronaut", "-o", f"{place}/capture.h5"]) == 0
    return folder


@pytest.fixture(scope="module")
def fitted(folder):
    command = ["fit-camera", "capture.h5", "--camera", "camera.toml", "-o", "fitted.toml"]
    command = [str(folder / word) if "." in word else word for word in command]
    assert run([*command, "--details", str(folder / "fit.h5")]) == 0
    return folder


def test_the_fitted_description_explains_the_capture(fitted):
    camera = load_camera(fitted / "fitted.toml")
    assert abs(camera.object.distance - 0.553) < 3e-4
    assert abs(camera.sensor.distance - DISTANCE) < 3e-7
    coma = {a.noll: a.coefficient for a in camera.main_lens.aberrations}[7]
    assert abs(coma - 2e-8) < 2e-9
    text = (fitted / "fitted.toml").read_text()
    assert "# camera.toml, fitted to capture.h5" in text
    assert "#   focus: 55" in text and "+-" in text and "(described 550" in text
    assert "not measured" in text


def test_what_is_left_open_goes_into_the_matrix(fitted):
    pif = ["simulate-pif", str(fitted / "fitted.toml"), *ALONE, "-o", str(fitted / "pif.h5")]
    assert run(pif) == 0
    found, right = (read_lenslet_matrix(fitted / name) for name in ("pif.h5", "real.h5"))
    error = np.linalg.norm(found.own - right.own) / np.linalg.norm(right.own)
    told = load_camera(fitted / "fitted.toml").fitted.model_error
    assert found.accuracy.model_error > told > 0
    assert error < 2 * told < 0.05
    values, attrs = (
        getattr(read_artefact(fitted / "fit.h5", "fit"), part) for part in ("data", "attrs")
    )
    names = attrs["fit"]["names"]
    place = names.index("sensor distance")
    assert abs(values["fit/value"][place] - DISTANCE) < 4 * values["fit/sigma"][place]
    assert np.allclose(np.diag(values["fit/correlation"]), 1)
    assert attrs["fit"]["model_error"] == told


def test_a_fit_that_did_not_converge_writes_nothing(folder, capsys):
    out = folder / "none.toml"
    base = ["fit-camera", str(folder / "capture.h5"), "--camera", str(folder / "camera.toml")]
    fixed = [
        word
        for name in ("focus", "sensor distance", "coma, vertical", "lenslet focal length")
        for word in ("--fix", name)
    ]
    few = [*fixed, "--fix", "spherical aberration", "--fix", "astigmatism, vertical"]
    assert run([*base, *few, "--fix", "wavelength", "-o", str(out), "--json"]) == 5
    said = capsys.readouterr()
    assert "no camera near the described one explains the captures" in said.err
    assert said.out == "" and not out.exists()


def test_points_that_are_too_coarse_are_told_from_a_camera_that_is_another(folder, capsys):
    """By the fit and by the picture; the camera is the right one."""
    coarse, pif, output = folder / "coarse.toml", folder / "coarse.h5", folder / "never.toml"
    coarse.write_text(to_toml(small_camera(**KEYS | {"object__samples_per_lenslet": (4, 4)})))
    capture = folder / "fine.h5"
    made = ["capture-sim", str(coarse), *ALONE, "--refine", "3", "--snr", "50dB"]
    assert run([*made, "--scene", "skimage:astronaut", "-o", str(capture)]) == 0
    assert run(["simulate-pif", str(coarse), *ALONE, "-o", str(pif)]) == 0
    capsys.readouterr()
    assert run(["fit-camera", str(capture), "--camera", str(coarse), "-o", str(output)]) == 5
    assert "finer than 4 x 4 points" in capsys.readouterr().err and not output.exists()
    asked = ["reconstruct", str(capture), "--pif", str(pif), "--method", "lmmse"]
    assert run([*asked, "-o", str(folder / "coarse-picture.h5")]) == 0
    assert "finer than 4 x 4 points a lenslet" in capsys.readouterr().err


def test_light_of_the_neighbours_is_told_from_a_camera_that_is_another(folder, capsys):
    """By the fit, and by a picture of a matrix that knows none."""
    capture, pif = folder / "with-neighbours.h5", folder / "alone.h5"
    made = ["capture-sim", str(folder / "camera.toml"), "--accuracy", "2e-2", "--snr", "45dB"]
    assert run([*made, "--scene", "skimage:astronaut", "-o", str(capture)]) == 0
    assert run(["simulate-pif", str(folder / "camera.toml"), *ALONE, "-o", str(pif)]) == 0
    capsys.readouterr()
    asked = ["fit-camera", str(capture), "--camera", str(folder / "camera.toml")]
    assert run([*asked, "-o", str(folder / "never.toml")]) == 5
    said = "light of the neighbouring lenslets explains most"
    assert said in capsys.readouterr().err
    asked = ["reconstruct", str(capture), "--pif", str(pif), "--method", "lmmse"]
    assert run([*asked, "-o", str(folder / "n.h5")]) == 0
    assert said in capsys.readouterr().err


def test_the_summary_as_json(folder, capsys):
    command = ["fit-camera", str(folder / "capture.h5"), "--camera", str(folder / "real.toml")]
    fixed = ["focus", "pitch", "wavelength", "lenslet focal length"]
    command += [word for name in fixed for word in ("--fix", name)]
    assert run([*command, "-o", str(folder / "same.toml"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["accepted"] and told["captures"] == 1 and told["lenslets"] == 36
    assert not set(fixed) & set(told["parameters"])
    assert abs(told["parameters"]["shift, rows"]["value"]) < 0.01


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--fix", "colour"], 2, "there is no parameter 'colour'"),
        (["--camera", "round.toml"], 2, "its lenslets are not square"),
        (["-o", "fitted.h5"], 2, "is written as .toml"),
        (["--details", "fit.toml"], 2, "is written as .h5"),
        (["--camera", "large.toml"], 3, "superpixels"),
    ],
)
def test_refusals(folder, monkeypatch, capsys, words, code, said):
    monkeypatch.chdir(folder)
    round_one = small_camera(**KEYS, lenslet_array__aperture_shape="circle")
    (folder / "round.toml").write_text(to_toml(round_one))
    large = small_camera(**KEYS | {"sensor__pixels_per_lenslet": (14, 14)})
    (folder / "large.toml").write_text(to_toml(large))
    command = ["fit-camera", "capture.h5", "--camera", "camera.toml", "-o", "refused.toml", *words]
    assert run(command) == code
    assert said in capsys.readouterr().err
    assert not (folder / "refused.toml").exists()


def test_reconstruct_fits_the_camera_first(folder, capsys):
    """By the pif of the camera as described: told what is wrong, and with --fit as by the right
    one.
    """
    described = ["simulate-pif", str(folder / "camera.toml"), *ALONE]
    assert run([*described, "-o", str(folder / "described.h5")]) == 0

    def psnr(pif, *options):
        out, capture = str(folder / "picture.h5"), str(folder / "capture.h5")
        command = ["reconstruct", capture, "--pif", str(folder / pif), *options]
        assert run([*command, "-o", out, "--overwrite"]) == 0
        found = read_artefact(folder / "picture.h5", "image").data["image/value"]
        truth = read_artefact(folder / "capture.h5", "capture").data["capture/scene"][0]
        return -10 * np.log10(np.mean((found - truth) ** 2))

    floor, right = psnr("real.h5", "--method", "block-mean"), psnr("real.h5", "--method", "lmmse")
    capsys.readouterr()
    doubted = psnr("described.h5", "--method", "lmmse")
    said = capsys.readouterr().err
    assert "is not quite this camera's" in said and "alone explains most" in said
    assert doubted > floor - 0.2
    fitted = psnr("described.h5", "--method", "lmmse", "--fit")
    assert "--fit: explains the captures" in capsys.readouterr().err
    assert fitted > max(right - 0.5, doubted + 1)


def test_tiles_are_solved_by_the_camera_that_fits_the_middle(folder, monkeypatch):
    """18 x 18 lenslets: the fit looks at 16 x 16 of them, in tiles as in one piece."""
    large = to_toml(small_camera(**REAL | {"lenslet_array__count": (18, 18)}))
    (folder / "large.toml").write_text(large)
    capture, pif = folder / "many.h5", folder / "plain.h5"
    made = ["capture-sim", str(folder / "large.toml"), "--pif", str(folder / "real.h5")]
    made += ["--snr", "50dB", "--scene", "skimage:astronaut", "-o", str(capture)]
    plain = ["simulate-pif", str(folder / "camera.toml"), *ALONE, "-o", str(pif)]
    assert run(made) == 0 and run(plain) == 0
    looked, found = [], {}
    monkeypatch.setattr(
        fitted_matrix,
        "camera_fit",
        lambda estimators, data, where: (
            looked.append(data.y) or camera_fit(estimators, data, where)
        ),
    )
    at_once = 9**2 * (256 + 100 + tiles.FURTHER)
    for name, most in (("whole", tiles.AT_ONCE), ("tiled", at_once), ("again", at_once)):
        monkeypatch.setattr(tiles, "AT_ONCE", most)
        command = ["reconstruct", str(capture), "--pif", str(pif), "--method", "lmmse", "--fit"]
        workers = ["--workers", "2"] if name == "again" else []
        assert run([*command, *workers, "-o", str(folder / f"{name}.h5")]) == 0
        found[name] = read_artefact(folder / f"{name}.h5", "image").data["image/value"]
    assert [y.shape[:2] for y in looked] == [(16, 16)] * 3
    for y in looked[1:]:
        np.testing.assert_array_equal(y, looked[0])
    truth = read_artefact(capture, "capture").data["capture/scene"][0]
    error = {name: np.mean((value - truth) ** 2) for name, value in found.items()}
    assert error["tiled"] == pytest.approx(error["whole"], rel=0.03)
    assert (folder / "tiled.h5").read_bytes() == (folder / "again.h5").read_bytes()


def test_a_fit_needs_a_matrix(folder, capsys):
    command = ["reconstruct", str(folder / "capture.h5"), "--pif", str(folder / "real.h5")]
    command += ["--method", "block-mean", "--fit", "-o", str(folder / "no.h5")]
    assert run(command) == 2 and "--fit" in capsys.readouterr().err
    assert not (folder / "no.h5").exists()


@pytest.mark.parametrize(
    ("sigma", "said"), [("1e-4", "such captures are not fitted"), ("1", "the noise hides")]
)
def test_neighbours_light_is_told_against_the_noise(folder, capsys, sigma, said):
    pif = folder / "three.h5"
    if not pif.exists():
        made = ["simulate-pif", str(folder / "camera.toml"), "--superpixels", "3x3"]
        assert run([*made, "--model", "fresnel", "-o", str(pif)]) == 0
    command = ["reconstruct", str(folder / "capture.h5"), "--pif", str(pif), "--fit"]
    command += ["--noise-sigma", sigma, "-o", str(folder / "no.h5")]
    assert run(command) == 2
    told = capsys.readouterr().err
    assert "neighbours' light" in told and "times the noise here" in told and said in told
    assert not (folder / "no.h5").exists()


def test_pixels_that_are_missing_do_not_matter_to_a_fit(folder):
    """NaN in a quarter of the lenslets, then in nearly all of them."""
    system = read_lenslet_matrix(folder / "real.h5")
    pictures = [
        (name, np.asarray(getattr(data, name)(), float) / 255) for name in ("moon", "brick")
    ]
    estimators = Estimators(system, Options(), lambda scene: pictures, threads=1)
    picture = np.asarray(data.camera(), float)[100:160, 100:160] / 255
    y = to_blocks(picture, (10, 10)) @ system.own.T
    sigma = float(np.sqrt(np.mean(y**2))) / 300
    y += sigma * np.random.default_rng(4).standard_normal(y.shape)
    y[::2, ::2, 17] = np.nan
    seen = Superpixels(y=y, noise=Noise.of_sigma(sigma), accuracy=system.accuracy)
    fit, _ = camera_fit(estimators, seen, "capture")
    assert fit.accepted and fit.lenslets == 36
    y[:, ::2, 17] = np.nan
    y[1::2, 1::2, 30] = np.nan
    again, _ = camera_fit(estimators, seen, "capture")
    assert again.accepted and again.lenslets == 36
    for one, other in zip(fit.parameters, again.parameters):
        assert abs(one.value - other.value) < 0.5 * one.sigma
