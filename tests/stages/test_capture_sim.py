"""capture-sim: the light path against explicit sums, the detector against its law, and refusals."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from plenocli.cli.main import run
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.config.camera_file import load_camera, parse_camera
from plenocli.files.images.mosaic import read_capture
from plenocli.forward.accuracy.dial import system_matrix
from plenocli.forward.sensor.exposure import simulate
from plenocli.stages.forward import capture_sim

TINY = Path(__file__).resolve().parents[2] / "sample_configs" / "tiny.toml"
FILTERS = """
[filter_array]
layout = [1, 2]
filters = [{ center = "460 nm", fwhm = "40 nm" }, { center = "620 nm", fwhm = "40 nm" }]
"""


@pytest.fixture
def camera(tmp_path):
    """A camera of 3 x 4 lenslets, 4 x 4 points and 9 x 9 pixels."""
    text = TINY.read_text()
    for old, new in [
        ("[8, 8]", "[4, 4]"),
        ("[13, 13]", "[9, 9]"),
        ('"26 um"', '"18 um"'),
        ('"208 um"', '"144 um"'),
        ("[5, 5]", "[3, 4]"),
    ]:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "camera.toml"
    path.write_text(text)
    return path


@pytest.fixture
def scene(tmp_path):
    values = np.random.default_rng(3).uniform(size=(12, 16)).astype(np.float32)
    write_artefact(
        tmp_path / "scene.h5",
        Artefact("image", {"image/value": values}, {}, Provenance(command="test")),
    )
    return tmp_path / "scene.h5", values


def capture(*arguments):
    """Run capture-sim and read what it wrote (the argument after -o)."""
    arguments = [str(a) for a in arguments]
    assert run(["capture-sim", *arguments]) == 0
    return read_artefact(arguments[arguments.index("-o") + 1], "capture")


def test_the_mosaic_is_the_sum_over_points_and_neighbours(camera, scene, tmp_path):
    path, x = scene
    got = capture(
        camera,
        "--scene",
        path,
        "--noise",
        "none",
        "--superpixels",
        "3x3",
        "--coherent-ring",
        "1",
        "--accuracy",
        "1e-5",
        "--model",
        "fresnel",
        "-o",
        tmp_path / "c.h5",
    ).data["capture/mosaic"]
    pif = system_matrix(
        load_camera(camera),
        superpixels=(3, 3),
        coherent_ring=1,
        accuracy=1e-5,
        dtype=np.float64,
        model="fresnel",
    )
    expected = np.zeros((27, 36))
    mirrored = [3, 2, 1, 0, *range(12), 11, 10, 9, 8], [3, 2, 1, 0, *range(16), 15, 14, 13, 12]
    wide = x[np.ix_(*mirrored)]  # the scene goes on mirrored for one lenslet
    for row in range(-4, 16):
        for column in range(-4, 20):
            home, point = (row // 4, column // 4), (row % 4) * 4 + column % 4
            for block, (down, right) in enumerate(pif.lenslet_offset):
                r, c = home[0] + down, home[1] + right
                if 0 <= r < 3 and 0 <= c < 4:
                    expected[9 * r : 9 * r + 9, 9 * c : 9 * c + 9] += wide[
                        row + 4, column + 4
                    ] * pif.A[0, block, :, point].reshape(9, 9)
    assert np.abs(got - expected).max() < 1e-5 * expected.max()


def test_white_noise_has_the_sigma_that_is_promised(camera, scene, tmp_path):
    # by itself the dial computes no finer than each capture's own noise
    same = ("--scene", scene[0], "--accuracy", "1e-3")
    clean = capture(camera, *same, "--noise", "none", "-o", tmp_path / "a.h5").data[
        "capture/mosaic"
    ]
    noisy = capture(camera, *same, "--snr", "30dB", "-o", tmp_path / "b.h5")
    sigma = noisy.attrs["capture"]["noise_sigma"]
    assert sigma == pytest.approx(np.sqrt(np.mean(clean**2) * 1e-3), rel=1e-6)
    assert np.std(noisy.data["capture/mosaic"] - clean) == pytest.approx(
        sigma, rel=4 / np.sqrt(2 * clean.size)
    )


def test_the_truth_is_kept_and_averaged(camera, scene, tmp_path):
    fine = capture(
        camera,
        "--scene",
        scene[0],
        "--refine",
        2,
        "--noise",
        "none",
        "--scene-out",
        tmp_path / "truth.h5",
        "-o",
        tmp_path / "c.h5",
    )
    assert fine.data["capture/scene"].shape == (1, 12, 16)
    np.testing.assert_allclose(fine.data["capture/scene"][0], scene[1], atol=1e-6)
    np.testing.assert_array_equal(
        read_artefact(tmp_path / "truth.h5", "image").data["image/value"],
        fine.data["capture/scene"][0],
    )


def test_finer_points_bring_the_same_light(camera, tmp_path):
    light = [
        capture(
            camera,
            "--target",
            "white",
            "--noise",
            "none",
            "--refine",
            n,
            "--superpixels",
            "3x3",
            "-o",
            tmp_path / f"{n}.h5",
        )
        .data["capture/mosaic"]
        .sum()
        for n in (1, 3)
    ]
    assert light[1] == pytest.approx(light[0], rel=0.01)
    # the lenslets are 4 Airy cells wide: their neighbours beyond 3x3 hold a few percent
    assert 0.93 * 0.99 < light[0] / 16 / 12 < 0.99


def test_detector_follows_emva_1288(camera, tmp_path, monkeypatch):
    monkeypatch.setenv("PLENOCLI_CACHE", str(tmp_path / "cache"))  # one matrix for all
    frames = [
        capture(camera, "--target", "white", "--seed", s, "-o", tmp_path / f"{s}.h5")
        .data["capture/mosaic"]
        .astype(float)
        for s in range(20)
    ]
    sensor = load_camera(camera).sensor
    mean, variance = np.mean(frames, axis=0), np.var(frames, axis=0, ddof=1)
    # photon transfer: variance over mean is the gain, once read and quantisation
    # noise are taken off
    dark = sensor.gain**2 * sensor.read_noise**2 + 1 / 12
    assert np.sum(variance - dark) / np.sum(mean) == pytest.approx(sensor.gain, rel=0.02)
    assert mean.max() == pytest.approx(0.99 * 0.8 * sensor.full_well * sensor.gain, rel=0.01), (
        "white fills 80 % of full well"
    )


def test_exposure_scales_electrons(camera, tmp_path):
    long = capture(camera, "--target", "white", "-o", tmp_path / "l.h5")
    short = capture(camera, "--target", "white", "--exposure", "2.5ms", "-o", tmp_path / "s.h5")
    assert short.attrs["capture"]["exposure_s"] == 0.0025
    assert long.data["capture/mosaic"].mean() / short.data[
        "capture/mosaic"
    ].mean() == pytest.approx(4, rel=0.01)


LIT = """
bits = 16
gain = "1 DN/e"
full_well = "60000 e"
quantum_efficiency = 0.5
{exposure}
[light]
illuminance = "{lux} lx"
"""


def lit(camera, f_number, lux=1000, exposure="40 ms"):
    """The same camera under a light of known strength, its lenslets' field kept."""
    text = camera.read_text()
    for old, new in [
        ("f_number = 8", f"f_number = {f_number}"),
        ("[light]\n", LIT.format(lux=lux, exposure=f'exposure = "{exposure}"' * bool(exposure))),
    ]:
        assert old in text
        text = text.replace(old, new)
    path = camera.with_name(f"lit-{f_number}-{lux}.toml")
    path.write_text(text)
    return path


@pytest.mark.parametrize("f_number", [5.6, 8])
def test_photons_agree_with_a_hand_calculation_on_the_image_side(camera, tmp_path, f_number):
    """Irradiance pi L sin^2 u' behind the lens, over one lenslet: what the simulation takes from
    the object's side.
    """
    found = capture(
        lit(camera, f_number),
        "--target",
        "white",
        "--superpixels",
        "5x5",
        "-o",
        tmp_path / "white.h5",
    )
    luminance = 1000 / np.pi * 0.99
    eye = 0.99495  # V(550 nm)
    photons = luminance / (683 * eye) * 550e-9 / (6.62607015e-34 * 299792458.0)
    pitch = 18e-6 / (1 + 144e-6 / 55e-3)
    half = np.arctan(1 / (2 * f_number))
    electrons = photons * np.pi * np.sin(half) ** 2 * pitch**2 * 0.5 * 0.04
    assert found.data["capture/mosaic"].sum(dtype=float) / 12 == pytest.approx(electrons, rel=0.02)


def test_without_a_time_light_of_known_strength_is_exposed_until_white_is_bright(
    camera, tmp_path, capsys
):
    """A quarter of the light takes four times as long, and says so."""
    times = []
    for lux in (1000, 250):
        target = tmp_path / f"{lux}.h5"
        found = capture(lit(camera, 8, lux, None), "--target", "white", "-o", target)
        times.append(found.attrs["capture"]["exposure_s"])
        assert found.data["capture/mosaic"].max() == pytest.approx(0.8 * 60000 * 0.99, rel=0.02)
    assert times[1] == pytest.approx(4 * times[0])
    assert f"exposed for {times[1] * 1e3:.3g} ms" in capsys.readouterr().err


@pytest.mark.parametrize(
    "options, exposure", [([], 0.01), (["--noise", "none"], None), (["--exposure", "3ms"], 0.003)]
)
def test_a_dark_frame_needs_no_optics(camera, tmp_path, monkeypatch, options, exposure):
    """It is what a scene without light gives through the optics."""
    black = np.zeros((12, 16), np.float32)
    write_artefact(
        tmp_path / "black.h5",
        Artefact("image", {"image/value": black}, {}, Provenance(command="test")),
    )
    scene = capture(camera, "--scene", tmp_path / "black.h5", *options, "-o", tmp_path / "s.h5")
    for name in ("planned_accuracy", "simulate_capture"):
        monkeypatch.setattr(capture_sim, name, None)
    dark = capture(camera, "--target", "dark", *options, "-o", tmp_path / "d.h5")
    assert dark.data.keys() == scene.data.keys()
    for name, values in scene.data.items():
        assert dark.data[name].tobytes() == values.tobytes()
    times = [found.attrs["capture"].get("exposure_s") for found in (dark, scene)]
    assert times == [exposure, exposure]


def test_a_dark_frame_lasts_as_long_as_white_where_the_light_decides(camera, tmp_path):
    described = lit(camera, 8, 1000, None)
    found = {
        target: capture(described, "--target", target, "-o", tmp_path / f"{target}.h5")
        for target in ("dark", "white")
    }
    dark, white = (found[name].attrs["capture"]["exposure_s"] for name in ("dark", "white"))
    assert dark == white > 0


def test_same_seed_same_bytes_other_seed_other_noise(camera, tmp_path):
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        capture(camera, "--target", "white", "--seed", seed, "-o", tmp_path / f"{name}.h5")
    a, b, c = ((tmp_path / f"{n}.h5").read_bytes() for n in "abc")
    assert a == b and a != c


def test_filters_part_the_superpixel_by_wavelength(camera, tmp_path):
    camera.write_text(camera.read_text().replace('["550 nm"]', '["460 nm", "620 nm"]') + FILTERS)
    blue, red = (
        capture(camera, "--target", f"mono:{w}nm", "--noise", "none", "-o", tmp_path / f"{w}.h5")
        for w in (460, 620)
    )
    halves = [
        np.array(
            [
                m.data["capture/mosaic"][9:18, 9:13].sum(),
                m.data["capture/mosaic"][9:18, 14:18].sum(),
            ]
        )
        for m in (blue, red)
    ]
    # the pupil stands on its head in a superpixel: the left filter lights the right half
    assert halves[0][1] > 5 * halves[0][0] and halves[1][0] > 5 * halves[1][1]
    assert blue.attrs["capture"]["band_m"] == 460e-9


def test_colour_filters_of_the_sensor_are_in_the_mosaic(camera, tmp_path):
    camera.write_text(
        camera.read_text().replace("[light]", 'cfa = "RGGB"\ncamera = "Nikon 5100 (NPL)"\n[light]')
    )
    m = capture(camera, "--target", "mono:450nm", "--noise", "none", "-o", tmp_path / "m.h5").data[
        "capture/mosaic"
    ]
    assert m[1::2, 1::2].mean() > 3 * m[::2, ::2].mean()


def test_raw_file_brings_back_every_pixel_and_setting(camera, tmp_path):
    inside = capture(camera, "--target", "white", "--seed", 2, "-o", tmp_path / "w.h5")
    assert (
        run(
            [
                "capture-sim",
                str(camera),
                "--target",
                "white",
                "--seed",
                "2",
                "-o",
                str(tmp_path / "w.dng"),
            ]
        )
        == 0
    )
    outside = read_capture(tmp_path / "w.dng")
    np.testing.assert_array_equal(outside.mosaic, inside.data["capture/mosaic"])
    assert outside.cfa == "mono" and outside.exposure_s == 0.01 and outside.levels.gain == 0.25


@pytest.mark.parametrize("cfa", ["mono", "GRBG"])
def test_libraw_and_exiftool_take_the_dng_for_what_it_is(camera, tmp_path, cfa):
    """Bit by bit in LibRaw; exiftool finds nothing wrong but, at most, the padding of rows."""
    import rawpy

    if cfa != "mono":
        camera.write_text(
            camera.read_text().replace(
                "[light]", f'cfa = "{cfa}"\ncamera = "Nikon 5100 (NPL)"\n[light]'
            )
        )
    arguments = [
        str(camera),
        "--target",
        "mono:550nm",
        "--model",
        "fresnel",
        "--accuracy",
        "1e-2",
        "--seed",
        "2",
        "-o",
    ]
    inside = capture(*arguments, tmp_path / "w.h5")
    assert run(["capture-sim", *arguments, str(tmp_path / "w.dng")]) == 0
    with rawpy.imread(str(tmp_path / "w.dng")) as file:
        np.testing.assert_array_equal(file.raw_image, inside.data["capture/mosaic"])
        assert (
            file.num_colors == (1 if cfa == "mono" else 3)
            and file.white_level == inside.attrs["capture"]["white"]
        )
    if not shutil.which("exiftool"):
        pytest.skip("exiftool is not installed: the tags are checked by LibRaw alone")
    said = subprocess.run(
        ["exiftool", "-validate", "-warning", "-a", "-s", str(tmp_path / "w.dng")],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    assert said[0].startswith("Validate") and all("padding" in line for line in said[1:]), said


def test_exr_holds_the_mosaic(camera, tmp_path):
    inside = capture(camera, "--target", "white", "--seed", 2, "-o", tmp_path / "w.h5")
    assert (
        run(
            [
                "capture-sim",
                str(camera),
                "--target",
                "white",
                "--seed",
                "2",
                "-o",
                str(tmp_path / "w.exr"),
            ]
        )
        == 0
    )
    np.testing.assert_array_equal(
        read_capture(tmp_path / "w.exr").mosaic, inside.data["capture/mosaic"]
    )


def test_a_matrix_from_disk_gives_the_same_and_another_cameras_is_refused(
    camera, scene, tmp_path, capfd
):
    assert (
        run(
            [
                "simulate-pif",
                str(camera),
                "--superpixels",
                "1x1",
                "--coherent-ring",
                "0",
                "--model",
                "fresnel",
                "--accuracy",
                "1e-5",
                "-o",
                str(tmp_path / "pif.h5"),
            ]
        )
        == 0
    )
    direct = capture(
        camera,
        "--scene",
        scene[0],
        "--noise",
        "none",
        "--superpixels",
        "1x1",
        "--coherent-ring",
        0,
        "--accuracy",
        "1e-5",
        "--model",
        "fresnel",
        "-o",
        tmp_path / "a.h5",
    )
    stored = capture(
        camera,
        "--scene",
        scene[0],
        "--noise",
        "none",
        "--pif",
        tmp_path / "pif.h5",
        "-o",
        tmp_path / "b.h5",
    )
    np.testing.assert_allclose(
        stored.data["capture/mosaic"], direct.data["capture/mosaic"], rtol=1e-4, atol=1e-7
    )
    other = tmp_path / "other.toml"
    other.write_text(camera.read_text().replace("f_number = 8", "f_number = 9"))
    assert (
        run(
            [
                "capture-sim",
                str(other),
                "--scene",
                str(scene[0]),
                "--pif",
                str(tmp_path / "pif.h5"),
                "-o",
                str(tmp_path / "c.h5"),
            ]
        )
        == 3
    )
    assert "[main_lens] differs" in capfd.readouterr().err


@pytest.mark.parametrize(
    "change, arguments, code, message",
    [
        (None, [], 2, "exactly one of --scene and --target"),
        (None, ["--target", "grey"], 2, "unknown target"),
        (None, ["--target", "mono:450"], 2, "has no unit"),
        (None, ["--target", "white", "--snr", "60"], 2, "has no unit"),
        (None, ["--target", "white", "--exposure", "0s"], 2, "above 0"),
        (None, ["--target", "dark", "--snr", "60dB"], 5, "dark image"),
        (None, ["--scene", "absent.png"], 3, "absent.png"),
        (None, ["--scene", "skimage:nobody"], 2, "astronaut"),
        (("[3, 4]", '[3, 4]\nlattice = "hexagonal"'), ["--target", "white"], 2, "hexagonal"),
        (
            ('wavelengths = ["550 nm"]', 'band = { center = "550 nm", fwhm = "20 nm" }'),
            ["--target", "white", "--bandwidth", "10nm"],
            2,
            "a band already",
        ),
        (
            ('superpixel_pitch = "18 um"', 'pitch = "18 um"'),
            ["--target", "white"],
            None,
            "pixels off",
        ),
    ],
)
def test_refusals(camera, tmp_path, capfd, change, arguments, code, message):
    if change:
        text = camera.read_text()
        assert change[0] in text
        text = text.replace(*change)
        camera.write_text(text.replace("[3, 4]", "[30, 40]") if code is None else text)
    assert run(["capture-sim", str(camera), *arguments, "-o", str(tmp_path / "out.h5")]) == (
        code or 2
    )
    assert message in capfd.readouterr().err
    assert not (tmp_path / "out.h5").exists()


def test_raw_cannot_hold_real_numbers_and_results_are_not_replaced(camera, tmp_path, capfd):
    assert (
        run(
            [
                "capture-sim",
                str(camera),
                "--target",
                "white",
                "--snr",
                "60dB",
                "-o",
                str(tmp_path / "a.dng"),
            ]
        )
        == 2
    )
    assert (
        run(["capture-sim", str(camera), "--target", "white", "-o", str(tmp_path / "a.png")]) == 2
    )
    (tmp_path / "a.h5").write_text("mine")
    assert run(["capture-sim", str(camera), "--target", "white", "-o", str(tmp_path / "a.h5")]) == 2
    assert (tmp_path / "a.h5").read_text() == "mine" and "--overwrite" in capfd.readouterr().err


def test_the_description_of_a_camera_is_in_the_file(camera, tmp_path):
    made = capture(camera, "--target", "white", "-o", tmp_path / "w.h5")
    assert parse_camera(made.provenance.config) == load_camera(camera)
    assert made.provenance.command == "plenocli capture-sim camera.toml --target white"
    assert str(tmp_path) not in str(made.provenance)


def test_light_below_zero_is_refused_by_a_sensor(camera, tmp_path, capsys):
    from plenocli.files.images.exr import write_exr

    write_exr(tmp_path / "negative.exr", {"Y": np.full((20, 20), -1, np.float32)}, {})
    arguments = [
        "capture-sim",
        str(camera),
        "--scene",
        str(tmp_path / "negative.exr"),
        "--superpixels",
        "1x1",
        "--coherent-ring",
        "0",
        "-o",
        str(tmp_path / "out.h5"),
    ]
    assert (
        run(arguments) == 3
        and "below 0" in capsys.readouterr().err
        and not (tmp_path / "out.h5").exists()
    )


def test_more_memory_than_granted_is_refused_before_it_is_taken(camera, tmp_path, capsys):
    camera.write_text(camera.read_text().replace("count = [3, 4]", "count = [4096, 4096]"))
    assert (
        run(["capture-sim", str(camera), "--target", "white", "-o", str(tmp_path / "out.exr")]) == 5
    )
    assert "--mem-limit" in capsys.readouterr().err


def in_bands(monkeypatch, rows, columns=4, pixels=81):
    """From now on sensors are exposed in bands of so many rows of lenslets."""
    monkeypatch.setattr(simulate, "BAND", rows * columns * pixels)


@pytest.mark.parametrize("rows", [1, 2])
def test_light_does_not_depend_on_bands(camera, scene, tmp_path, monkeypatch, rows):
    options = [camera, "--scene", scene[0], "--noise", "none", "--refine", 2]
    whole = capture(*options, "-o", tmp_path / "whole.h5")
    in_bands(monkeypatch, rows)
    bands = capture(*options, "-o", tmp_path / "bands.h5")
    light = whole.data["capture/mosaic"]
    np.testing.assert_allclose(bands.data["capture/mosaic"], light, atol=2e-6 * light.max())
    np.testing.assert_array_equal(bands.data["capture/scene"], whole.data["capture/scene"])
    assert bands.attrs["capture"].keys() == whole.attrs["capture"].keys()
    # of an EXR all is in memory
    assert run(["capture-sim", *map(str, options), "-o", str(tmp_path / "bands.exr")]) == 0
    np.testing.assert_allclose(
        read_capture(tmp_path / "bands.exr").mosaic, light, atol=2e-6 * light.max()
    )


def test_crosstalk_does_not_see_bands(camera, scene, tmp_path, monkeypatch):
    text = camera.read_text()
    text = text.replace("[sensor]", "[sensor]\ncrosstalk = 0.2")
    camera.write_text(text)
    assert "crosstalk" in text

    def frame(seed):
        options = [camera, "--scene", scene[0], "--seed", seed, "-o", tmp_path / f"{seed}.h5"]
        return capture(*options).data["capture/mosaic"].astype(float)

    whole = frame(4)
    in_bands(monkeypatch, 1)
    bands = [frame(seed) for seed in (5, 6, 7)]
    # what differs is noise, as much at the borders of bands (9 pixels) as elsewhere; one seed would
    # give whole and bands part of their noise alike
    difference, noise = bands[0] - whole, bands[1] - bands[2]
    at = np.zeros(len(whole), bool)
    at[[8, 9, 17, 18]] = True
    for where in (at, ~at):
        ratio = difference[where].std() / noise[where].std()
        assert 0.75 < ratio < 1.33
        assert abs(difference[where].mean()) < 5 * noise[where].std() / np.sqrt(
            difference[where].size
        )


def test_noise_of_bands_is_that_of_the_whole(camera, tmp_path, monkeypatch):
    in_bands(monkeypatch, 1)
    clear = capture(camera, "--target", "white", "--noise", "none", "-o", tmp_path / "a.h5")
    noisy = capture(camera, "--target", "white", "--snr", "20dB", "-o", tmp_path / "b.h5")
    rest = noisy.data["capture/mosaic"] - clear.data["capture/mosaic"]
    power = np.mean(clear.data["capture/mosaic"] ** 2)
    sigma = noisy.attrs["capture"]["noise_sigma"]
    assert sigma == pytest.approx(0.1 * np.sqrt(power), rel=0.01)
    assert rest.std() == pytest.approx(sigma, rel=0.1)
    bands = rest.reshape(3, -1)
    assert np.abs(np.corrcoef(bands) - np.eye(3)).max() < 0.2  # no band has another's noise


def test_targets_before_one_camera_share_its_matrix(camera, scene, tmp_path, monkeypatch, capsys):
    """Kept by all that it depends on, in the cache folder; bytes are those of no cache."""
    from plenocli.stages.forward import kept_matrices

    asked = [("--target", "white"), ("--target", "mono:550nm"), ("--scene", str(scene[0]))]

    def shots(folder):
        (tmp_path / folder).mkdir()
        for number, words in enumerate(asked):
            capture(camera, *words, "-o", tmp_path / folder / f"{number}.h5")
        return [path.read_bytes() for path in sorted((tmp_path / folder).iterdir())]

    alone, made = shots("alone"), []
    monkeypatch.setenv("PLENOCLI_CACHE", str(tmp_path / "cache"))
    build = kept_matrices.build_matrix
    monkeypatch.setattr(kept_matrices, "build_matrix", lambda *a: made.append(a) or build(*a))
    assert shots("together") == alone and len(made) == 1
    camera.write_text(camera.read_text().replace('"550 mm"', '"500 mm"'))
    capture(camera, *asked[0], "-o", tmp_path / "other.h5")
    capture(camera, *asked[0], "--accuracy", "0.02", "-o", tmp_path / "exact.h5")
    assert len(made) == 3
