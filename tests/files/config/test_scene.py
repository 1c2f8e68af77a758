"""Scene descriptions, and what the dial takes from them and from pictures."""

import numpy as np
import pytest

from plenocli.base.errors import ConfigError, InputError
from plenocli.cli.main import run
from plenocli.files.config.scene_file import load_scene
from plenocli.files.images.exr import write_exr
from plenocli.files.images.spectral_exr import write_spectral_exr
from plenocli.files.read.scene_needs import read_needs
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
    assert needs.spectrum == pytest.approx((500e-9, 600e-9)) and needs.lenslets == (3, 2)
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
