"""Camera descriptions: read exactly, resolved once, refused with every violation named."""

import os
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import ConfigError, InputError
from plenocli.files.config.camera_file import load_camera, parse_camera, to_toml
from plenocli.forward.camera.model import Camera

SAMPLES = Path(__file__).resolve().parents[3] / "sample_configs"
TINY = (SAMPLES / "tiny.toml").read_text()


CAMERAS = sorted(path for path in SAMPLES.glob("*.toml") if path.stem != "microscope")


@pytest.mark.parametrize("path", CAMERAS, ids=lambda p: p.stem)
def test_every_sample_reads_and_survives_its_own_text(path):
    camera = load_camera(path)
    assert parse_camera(to_toml(camera)) == camera
    assert to_toml(parse_camera(to_toml(camera))) == to_toml(camera)
    if camera.lenslet_array.lattice == "square":
        assert max(abs(m) for m in camera.pixel_mismatch) < 1e-9, (
            "superpixels of the samples tile whole pixels"
        )


def test_alternatives_are_resolved():
    camera = parse_camera(TINY)
    assert camera.main_lens.aperture_diameter == pytest.approx(0.055 / 8, rel=1e-15)
    assert camera.lenslet_array.pitch == pytest.approx(26e-6 / (1 + 208e-6 / 0.055), rel=1e-15)
    assert camera.superpixel_pitch == pytest.approx(26e-6, rel=1e-15)
    assert camera.light.design_wavelength == 550e-9


def test_replace_checks_again():
    camera = parse_camera(TINY)
    finer = camera.replace(**{"object.samples_per_lenslet": (24, 24)})
    assert (
        finer.object.samples_per_lenslet == (24, 24) and finer.lenslet_array == camera.lenslet_array
    )
    with pytest.raises(ConfigError, match="object.distance"):
        camera.replace(**{"object.distance": -1.0})


@pytest.mark.parametrize(
    "old, new, message",
    [
        (
            'focal_length = "50 mm"',
            'focal_lenght = "50 mm"',
            r"main_lens.focal_lenght: unknown key; did you mean focal_length\?",
        ),
        (
            'focal_length = "50 mm"',
            "focal_length = 50",
            "main_lens.focal_length: 50 needs its unit",
        ),
        ('"2 um"', '"2 kg"', "sensor.pixel_pitch: '2 kg' is no length"),
        ('"2 um"', '"-2 um"', "sensor.pixel_pitch: '-2 um' is outside"),
        ('"2 um"', '"nan um"', "sensor.pixel_pitch"),
        ("f_number = 8", "f_number = nan", "main_lens.f_number"),
        ("[8, 8]", "[8, 0]", "object.samples_per_lenslet.1"),
        ("[8, 8]", "[8, 99999999]", "object.samples_per_lenslet.1"),
        ('["550 nm"]', "[]", "light.wavelengths"),
        ('["550 nm"]', '["550 nm", "540 nm"]', "light: wavelengths must ascend"),
        ('["550 nm"]', '["550 mm"]', "light.wavelengths.0: '550 mm' is outside 100 nm ... 100 um"),
        (
            "f_number = 8",
            'f_number = 8\naperture_diameter = "5 mm"',
            "main_lens: give exactly one of aperture_diameter and f_number",
        ),
        (
            "count = [5, 5]",
            'count = [5, 5]\npitch = "26 um"',
            "lenslet_array: give exactly one of pitch",
        ),
        ("[sensor]", '[sensor]\ncfa = "RGGB"', 'sensor: cfa = "RGGB" needs camera'),
        ("[light]", "[lights]", "lights: unknown key; did you mean light"),
    ],
)
def test_violations_are_named(old, new, message):
    assert old in TINY
    with pytest.raises(ConfigError, match=message):
        parse_camera(TINY.replace(old, new))


def test_all_violations_come_together():
    with pytest.raises(ConfigError) as caught:
        parse_camera(
            TINY.replace('"50 mm"', "50")
            .replace('"2 um"', '"2 kg"')
            .replace("count = [5, 5]", "cuont = [5, 5]"),
            "mine.toml",
        )
    assert str(caught.value).startswith("mine.toml: 3 violations")
    assert "did you mean count?" in str(caught.value) and caught.value.exit_code == 2


def test_files_that_are_no_description(tmp_path):
    for name, content in {
        "binary.toml": b"\xff\xfe\x00",
        "huge.toml": b"#" * (1 << 20) + b"#",
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name):
            load_camera(tmp_path / name)
    with pytest.raises(InputError, match="cannot be read"):
        load_camera(tmp_path / "absent.toml")
    with pytest.raises(InputError):
        load_camera(tmp_path)
    os.mkfifo(tmp_path / "pipe.toml")  # must be refused, not waited for
    with pytest.raises(InputError, match="no ordinary file"):
        load_camera(tmp_path / "pipe.toml")
    (tmp_path / "half.toml").write_text('[main_lens]\nfocal_length = "50 m')
    with pytest.raises(ConfigError, match="is not TOML: .*(line 2|end of document)"):
        load_camera(tmp_path / "half.toml")


def test_schema_names_every_section():
    assert {"main_lens", "object", "lenslet_array", "sensor", "light", "filter_array"} <= set(
        Camera.model_json_schema()["properties"]
    )


@pytest.mark.parametrize("shape", ["", ', shape = "box"'])
def test_a_band_of_light_instead_of_lines(shape):
    text = TINY.replace(
        'wavelengths = ["550 nm"]', f'band = {{ center = "550 nm", fwhm = "10 nm"{shape} }}'
    )
    camera = parse_camera(text)
    assert (
        camera.light.wavelengths == (550e-9,)
        and camera.light.band.fwhm == 10e-9
        and camera.light.design_wavelength == 550e-9
    )
    assert camera.light.band.shape == ("box" if shape else "gaussian")
    assert parse_camera(to_toml(camera)) == camera


@pytest.mark.parametrize(
    "light, words",
    [
        (
            'wavelengths = ["540 nm"]\nband = { center = "550 nm", fwhm = "10 nm" }',
            "exactly one of wavelengths and band",
        ),
        ('illuminant = "D65"', "exactly one of wavelengths and band"),
        ('band = { center = "550 nm", fwhm = "300 nm" }', "more than a third of the centre"),
    ],
)
def test_bands_that_cannot_be(light, words):
    with pytest.raises(ConfigError, match=words):
        parse_camera(TINY.replace('wavelengths = ["550 nm"]', light))


def test_values_without_a_file_in_the_description_are_refused():
    with pytest.raises(ConfigError, match="main_lens.wavefront: names no file"):
        parse_camera(TINY).attach(wavefront=np.zeros((8, 8)))
