"""`plenocli refocus`: captures of cameras out of focus, the letters of a real
camera, wrong requests.
"""

import json
import shutil

import numpy as np
import pytest

from plenocli.cli.main import run
from plenocli.files.artefacts.reading import read_artefact
from plenocli.inverse.lightfield.planes import distance_of, slope_of
from plenocli.inverse.lightfield.refocus import STEP, sharpness

CAMERA = """
[main_lens]
focal_length = "50 mm"
f_number = 8
aperture_shape = "square"
[object]
distance = "{distance}"
samples_per_lenslet = [6, 6]
[lenslet_array]
distance = "55 mm"
superpixel_pitch = "44 um"
focal_length = "352 um"
count = [15, 15]
[sensor]
distance = "352 um"
pixel_pitch = "4 um"
pixels_per_lenslet = [11, 11]
[light]
wavelengths = ["550 nm"]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("refocus")


def planes_at(folder, distance, superpixels):
    """The capture at `distance` mm, its camera and its planes: made where no test has made them."""
    camera, capture, out = (folder / f"{distance}{end}" for end in (".toml", ".h5", "-planes.h5"))
    if not out.exists():
        camera.write_text(CAMERA.format(distance=f"{distance} mm"))
        model = ["--model", "ray", "--superpixels", superpixels, "--coherent-ring", "0"]
        options = ["--scene", "skimage:camera", *model, "--noise", "none", "-o", str(capture)]
        assert run(["capture-sim", str(camera), *options]) == 0
        assert run(["refocus", str(capture), "--camera", str(camera), "-o", str(out)]) == 0
    return capture, out


@pytest.fixture
def at_550(folder):
    """The folder with 550.toml, 550.h5 and 550-planes.h5, whichever test runs first."""
    planes_at(folder, 550, "1x1")
    return folder


@pytest.mark.parametrize("distance, superpixels", [(550, "1x1"), (500, "3x3"), (620, "3x3")])
def test_a_simulated_scene_out_of_focus_is_found_at_its_distance(folder, distance, superpixels):
    """capture-sim works with system matrices of waves and knows nothing of slopes."""
    capture, out = planes_at(folder, distance, superpixels)
    data = read_artefact(out, "lightfield").data
    true = slope_of(distance * 1e-3, 0.05, 0.055, 352e-6)
    sure = data["depth/confidence"][3:-3, 3:-3] > 0.4
    assert sure.sum() > 10
    assert np.median(data["depth/slope"][3:-3, 3:-3][sure]) == pytest.approx(true, abs=0.25)
    assert abs(data["refocus/slope"][np.argmax(data["refocus/sharpness"])] - true) <= 0.5
    # told, or what the capture says of its camera
    for number, truth in enumerate((f"{distance}mm", str(capture))):
        assert (
            run(
                [
                    "score",
                    str(out),
                    "--truth",
                    truth,
                    "-o",
                    str(folder / f"{distance}-{number}.json"),
                ]
            )
            == 0
        )
    told, known = (
        json.loads((folder / f"{distance}-{number}.json").read_text())["metrics"]
        for number in (0, 1)
    )
    assert told == known
    assert (
        told["depth_slope"] == pytest.approx(true, abs=1e-6)
        and told["depth_slope_error"] < 0.15
        and told["depth_sure_share"] > 0.8
        and abs(told["sharpest_slope_error"]) < 0.05
    )
    near = distance_of(true + np.array([-0.5, 0.5]), 0.05, 0.055, 352e-6)
    assert (
        told["depth_limit_m"] == pytest.approx(abs(near[1] - near[0]), rel=0.01)
        and told["depth_distance_error_m"] < 0.15 * told["depth_limit_m"]
    )


def test_the_letters_stand_at_two_depths(folder, shared_data, capsys):
    """The white sheet with the t at the left is farther away than the grey one with a and b, and
    each is sharpest at its own slope.
    """
    real, cal, out = (
        shared_data / "plenoptic" / "letters",
        folder / "letters-cal.h5",
        folder / "letters.h5",
    )
    assert (
        run(
            [
                "calibrate",
                "--white",
                str(real / "letters_ULF_M1_white.png"),
                "--dark",
                str(real / "letters_ULF_M1_dark.png"),
                "-o",
                str(cal),
            ]
        )
        == 0
    )
    slopes = [w for s in np.linspace(-1.5, 2, 15) for w in ("--slope", f"{s:.3f}")]
    assert (
        run(
            [
                "refocus",
                str(real / "letters_ULF_M1.png"),
                "--calibration",
                str(cal),
                *slopes,
                "-o",
                str(out),
            ]
        )
        == 0
    )
    data = read_artefact(out, "lightfield").data
    step = STEP

    def sharpest(columns):
        part = data["refocus/value"][:, 2 * step : 18 * step, columns[0] * step : columns[1] * step]
        return data["refocus/slope"][np.argmax([sharpness(p) for p in part])]

    t, ab = sharpest((4, 7)), sharpest((9, 16))
    assert t < ab - 0.2 and abs(t) < 0.6 and 0.2 < ab < 1.2
    depth = data["depth/slope"]
    assert np.median(depth[4:16, 4:7]) < 0.2 < np.median(depth[4:16, 9:16])


@pytest.mark.parametrize(
    "arguments, code, words",
    [
        (["--distance", "500mm"], 2, "--camera"),
        (["--distance", "500mm", "--slope", "1", "--camera", "550.toml"], 2, "not both"),
        (["--slope", "nan"], 2, "0.5"),
        (["--calibration", "550.h5"], 3, "capture"),
        (["--camera", "none.toml"], 3, "none.toml"),
    ],
)
def test_wrong_requests_have_one_message(at_550, capfd, monkeypatch, arguments, code, words):
    monkeypatch.chdir(at_550)
    assert run(["refocus", "550.h5", *arguments, "-o", "never.h5"]) == code
    assert words in capfd.readouterr().err and not (at_550 / "never.h5").exists()


def test_a_picture_without_a_grid_is_refused_with_what_to_do(folder, capfd):
    import OpenImageIO as oiio

    path = folder / "photo.png"
    out = oiio.ImageOutput.create(str(path))
    out.open(str(path), oiio.ImageSpec(40, 40, 1, "uint8"))
    out.write_image(np.random.default_rng(0).integers(0, 200, (40, 40, 1)).astype(np.uint8))
    out.close()
    assert run(["refocus", str(path), "-o", str(folder / "never.h5")]) == 3
    assert "--calibration" in capfd.readouterr().err


def test_a_report_shows_planes_and_how_good_they_are(at_550):
    (at_550 / "run").mkdir()
    shutil.copy(at_550 / "550-planes.h5", at_550 / "run")
    assert (
        run(
            [
                "score",
                str(at_550 / "run" / "550-planes.h5"),
                "--truth",
                "550mm",
                "-o",
                str(at_550 / "run" / "depth.json"),
            ]
        )
        == 0
    )
    assert run(["report", str(at_550 / "run"), "-o", str(at_550 / "run.html")]) == 0
    page = (at_550 / "run.html").read_text()
    assert (
        page.count("<figure>") == 5
        and ">Depth</h2>" in page
        and "error of the slope over the geometric limit, median" in page
    )


def test_show_draws_it(at_550):
    assert run(["show", str(at_550 / "550-planes.h5"), "-o", str(at_550 / "550.png")]) == 0
    assert (at_550 / "550.png").stat().st_size > 20_000


@pytest.mark.parametrize(
    "arguments, code, words",
    [
        ([], 2, "--truth 620mm"),
        (["--truth", "far"], 2, "620mm"),
        (["--truth", "550mm"], 3, "--camera"),
        (["--truth", "550mm", "--metric", "psnr"], 3, "--camera"),
    ],
)
def test_depth_is_not_scored_without_distances(at_550, capfd, monkeypatch, arguments, code, words):
    monkeypatch.chdir(at_550)
    if not (at_550 / "plain.h5").exists():
        assert run(["refocus", "550.h5", "-o", "plain.h5"]) == 0
    assert (
        run(
            [
                "score",
                "plain.h5" if len(arguments) > 1 and "mm" in arguments[1] else "550-planes.h5",
                *arguments,
                "-o",
                "never.json",
            ]
        )
        == code
    )
    assert words in capfd.readouterr().err and not (at_550 / "never.json").exists()
