"""Scene descriptions, and what the dial takes from them and from pictures."""

import numpy as np
import pytest

from plenocli.base.errors import ConfigError, InputError
from plenocli.cli.main import run
from plenocli.files.config.scene_file import load_scene
from plenocli.files.images.exr import write_exr
from plenocli.files.images.spectral_exr import write_spectral_exr
from plenocli.files.read.scene_needs import read_needs
from plenocli.files.read.scenes import read_scene
from plenocli.forward.accuracy.dial import system_matrix
from plenocli.forward.scene.tables import illuminant
from tests.forward.propagation.cameras import small_camera


def write(path, text):
    path.write_text(text)
    return path


def test_a_scene_file_says_what_it_needs(tmp_path):
    path = write(
        tmp_path / "scene.toml",
        (
            'depth = ["500 mm", "0.6 m"]\n'
            'spectrum = ["450 nm", "650 nm"]\n'
            "lenslets = [3, 2]\n"
            'snr = "40 dB"\n'
        ),
    )
    needs = read_needs(path, small_camera())
    assert (
        needs.depth == pytest.approx((0.5, 0.6))
        and needs.spectrum == pytest.approx((450e-9, 650e-9))
        and needs.lenslets == (3, 2)
    )
    assert needs.noise == pytest.approx(1e-2) and needs.source == "scene.toml"


def test_pictures_say_their_extent_and_bands(tmp_path):
    camera = small_camera()
    picture = np.zeros((30, 30), np.float32)
    picture[12:18, 12:18] = 1.0
    write_exr(tmp_path / "spot.exr", {"Y": picture}, {})
    assert read_needs(tmp_path / "spot.exr", camera).lenslets == (1, 1)
    cube = np.zeros((3, 30, 30), np.float32)
    cube[1, :, :15] = 0.5
    write_spectral_exr(tmp_path / "half.exr", np.array([450e-9, 550e-9, 650e-9]), cube, "radiance")
    needs = read_needs(tmp_path / "half.exr", camera)
    wavelengths, light = needs.light
    assert wavelengths == pytest.approx((450e-9, 550e-9, 650e-9)) and needs.lenslets == (3, 2)
    assert light[0] == light[2] == 0 < light[1]
    scene = write(tmp_path / "scene.toml", 'picture = "spot.exr"\nsnr = "20 dB"\n')
    assert read_needs(scene, camera).lenslets == (1, 1) and read_needs(
        scene, camera
    ).noise == pytest.approx(0.1)


@pytest.mark.parametrize(
    "text, words",
    [
        ('depth = ["1 m", "500 mm"]', "smaller"),
        ("depth = [1, 2]", "unit"),
        ('snr = "40"', "snr"),
        ('spectrum = ["400 nm"]', "spectrum"),
        ("lenslets = [0, 1]", "lenslets"),
        ('dept = ["1 m", "2 m"]', "did you mean depth"),
        ("depth = ", "TOML"),
    ],
)
def test_bad_scenes_are_refused_with_the_path(tmp_path, text, words):
    with pytest.raises(ConfigError, match=words):
        load_scene(write(tmp_path / "scene.toml", text))


def test_missing_files_and_the_command(tmp_path, capsys):
    with pytest.raises(InputError):
        load_scene(tmp_path / "none.toml")
    from pathlib import Path

    tiny = Path(__file__).resolve().parents[3] / "sample_configs" / "tiny.toml"
    scene = write(tmp_path / "scene.toml", 'snr = "20 dB"\nlenslets = [1, 1]\n')
    assert run(["simulate-pif", str(tiny), "--scene", str(scene), "--explain"]) == 0
    out = capsys.readouterr().out
    assert "noise of the scene.toml" in out and "see no light" in out
    assert (
        run(["simulate-pif", str(tiny), "--scene", str(tmp_path / "none.toml"), "--explain"]) == 3
    )
    assert run(["schema", "scene"]) == 0 and '"spectrum"' in capsys.readouterr().out


@pytest.mark.parametrize("lamp", ["E", "A"])
def test_an_image_lacks_no_more_than_is_said_where_dim_wavelengths_are_left_out(tmp_path, lamp):
    """The images of spectral pictures by all matrices, at a hundredth of the error, and by those
    that are left, added over the wavelengths.
    """
    wavelengths = np.linspace(430e-9, 670e-9, 9)
    camera = small_camera(light__wavelengths=tuple(wavelengths), light__illuminant=lamp)
    rng, count = np.random.default_rng(8), camera.lenslet_array.count
    points = camera.object.samples_per_lenslet
    options = dict(superpixels=(1, 1), coherent_ring=0, model="fresnel")
    whole = system_matrix(camera, accuracy=1e-5, dtype=np.float64, **options)
    fewest = len(wavelengths)
    for number in range(6):
        picture = rng.random((9, 36, 36)) * 10.0 ** rng.uniform(-7, 0, (9, 1, 1))
        if number % 2:  # lines, dim ones of a single spot
            picture[1::2], picture[2, :30] = 0, 0
        path = tmp_path / f"{number}.exr"
        write_spectral_exr(path, wavelengths, picture.astype(np.float32), "radiance")
        needs, cube = read_needs(path, camera), read_scene(str(path), spectral=True)
        for accuracy in (3e-2, 1e-3):
            made = system_matrix(camera, accuracy=accuracy, needs=needs, **options)
            fewest = min(fewest, len(made.wavelengths))

            def image(matrix):
                total = 0.0
                for a, w in zip(matrix.A, matrix.wavelengths):
                    light = cube.at(float(w), *(n * m for n, m in zip(count, points)))
                    blocks = light.reshape(count[0], points[0], count[1], points[1])
                    blocks = blocks.transpose(0, 2, 1, 3).reshape(-1, points[0] * points[1])
                    total = total + illuminant(lamp, w) * blocks @ a.astype(float)[0].T
                return total

            full = image(whole)
            assert np.linalg.norm(image(made) - full) < accuracy * np.linalg.norm(full)
    assert fewest <= 4
