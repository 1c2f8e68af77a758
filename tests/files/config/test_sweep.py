"""Sweep files: what they say becomes points, what they get wrong is said with its place."""

import itertools
import tomllib
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from plenocli.base.errors import ConfigError
from plenocli.files.config.camera_file import load_camera, parse_camera, to_toml
from plenocli.files.config.sweep_file import (
    changed,
    load_sweep,
    number,
    options_of,
    points,
    unit,
    unknown_key,
)
from plenocli.forward.camera.model import Camera

ROOT = Path(__file__).resolve().parents[3]
TINY = tomllib.loads((ROOT / "sample_configs" / "tiny.toml").read_text())


@pytest.fixture
def described(tmp_path):
    def write(text):
        (tmp_path / "sweep.toml").write_text('camera = "tiny.toml"\n' + text)
        return load_sweep(tmp_path / "sweep.toml")

    return write


def test_a_grid_is_every_combination_in_order_the_last_key_fastest(described):
    sweep, axes = described(
        "[vary]\n"
        '"main_lens.f_number" = [6, 8]\n'
        'sensor.pixel_pitch = { from = "1 um", to = "4 um", steps = 4 }\n'
        '"reconstruct.method" = ["lmmse", "tsvd"]\n'
    )
    found = points(sweep, axes)
    expected = itertools.product([6, 8], ["1 um", "2 um", "3 um", "4 um"], ["lmmse", "tsvd"])
    assert [tuple(p.values()) for p in found] == list(expected)
    assert list(found[0]) == ["main_lens.f_number", "sensor.pixel_pitch", "reconstruct.method"]


def test_steps_on_a_logarithmic_scale_have_equal_ratios_and_whole_numbers_are_whole(described):
    _, axes = described(
        '[vary]\n"object.distance" = { from = "100 mm", to = "1.6 m", steps = 5, scale = "log" }\n'
        '"sensor.bits" = { from = 8, to = 14, steps = 4, whole = true }\n'
    )
    lengths = np.array([number(v) for v in axes["object.distance"].levels()])
    assert np.allclose(lengths[1:] / lengths[:-1], 2, rtol=1e-9)
    bits = axes["sensor.bits"].levels()
    assert bits == [8, 10, 12, 14] and all(type(b) is int for b in bits)


@pytest.mark.parametrize("samples", [1, 7, 40])
def test_a_latin_hypercube_takes_each_part_of_every_axis_once(described, samples):
    sweep, axes = described(
        'design = "latin-hypercube"\n'
        f"samples = {samples}\n"
        "[vary]\n"
        '"main_lens.f_number" = { from = 2.0, to = 12.0 }\n'
        '"lenslet_array.focal_length" = { from = "100 um", to = "10 mm", scale = "log" }\n'
    )
    found = points(sweep, axes, seed=3)
    f = np.array([p["main_lens.f_number"] for p in found])
    z = np.log10([number(p["lenslet_array.focal_length"]) for p in found])
    for share in ((f - 2) / 10, (z + 4) / 2):
        assert sorted(np.floor(share * samples).astype(int)) == list(range(samples))
    assert points(sweep, axes, seed=3) == found and (
        samples == 1 or points(sweep, axes, seed=4) != found
    )


def test_a_list_is_taken_as_it_stands(described):
    sweep, axes = described(
        'design = "list"\n'
        "[[point]]\n"
        '"main_lens.f_number" = 6\n'
        "[[point]]\n"
        "main_lens.f_number = 9\n"
        '"sensor.bits" = 10\n'
    )
    assert points(sweep, axes) == [
        {"main_lens.f_number": 6},
        {"main_lens.f_number": 9, "sensor.bits": 10},
    ]
    assert sweep.varied == ["main_lens.f_number", "sensor.bits"]


def test_keys_are_set_alternatives_leave_and_other_keys_follow():
    values = {
        "lenslet_array.pitch": "30 um",
        "main_lens.aperture_diameter": "5 mm",
        "sensor.pixels_per_lenslet.1": 15,
        "reconstruct.method": "tsvd",
    }
    data = changed(
        TINY,
        values,
        {
            "lenslet_array.focal_length": "lenslet_array.pitch * 8",
            "sensor.distance": "lenslet_array.focal_length / 2 * 1.5",
            "sensor.pixel_fill_factor": "lenslet_array.pitch / main_lens.aperture_diameter",
        },
    )
    camera = Camera.model_validate(data)
    assert (
        camera.lenslet_array.pitch == 30e-6
        and camera.main_lens.aperture_diameter == 5e-3
        and camera.sensor.pixels_per_lenslet == (13, 15)
    )
    assert camera.lenslet_array.focal_length == pytest.approx(
        240e-6, rel=1e-9
    ) and camera.sensor.distance == pytest.approx(180e-6, rel=1e-9)
    assert camera.sensor.pixel_fill_factor == pytest.approx(0.006)
    assert TINY["sensor"]["pixels_per_lenslet"] == [13, 13], (
        "the camera that all points start from stays as it is"
    )


def test_every_filter_or_one_of_them():
    spectral = tomllib.loads((ROOT / "sample_configs" / "demo_spectral.toml").read_text())
    data = changed(
        spectral,
        {"filter_array.filters.*.fwhm": "30 nm", "filter_array.filters.1.center": "530 nm"},
        {"light.wavelengths.1": "filter_array.filters.1.center"},
    )
    camera = Camera.model_validate(data)
    assert {f.fwhm for f in camera.filter_array.filters} == {30e-9}
    assert (
        [f.center for f in camera.filter_array.filters]
        == list(camera.light.wavelengths)
        == [450e-9, 530e-9, 570e-9, 650e-9]
    )


def test_bands_that_nobody_names_are_those_of_the_filters_that_a_layout_has():
    """The camera names three bands of four filters; without them they follow what is changed."""
    spectral = tomllib.loads((ROOT / "sample_configs" / "demo_spectral.toml").read_text())
    del spectral["light"]["wavelengths"]
    assert Camera.model_validate(spectral).light.wavelengths == (450e-9, 540e-9, 570e-9, 650e-9)
    data = changed(
        spectral,
        {"filter_array.layout": [1, 3], "filter_array.filters.0.center": "620 nm"},
        {},
    )
    camera = Camera.model_validate(data)
    assert camera.light.wavelengths == (540e-9, 570e-9, 620e-9)
    assert [f.center for f in camera.filter_array.filters] == [620e-9, 540e-9, 570e-9]
    alike = changed(spectral, {"filter_array.filters.*.center": "550 nm"}, {})
    assert Camera.model_validate(alike).light.wavelengths == (550e-9,)
    too_many = changed(spectral, {"filter_array.layout": [3, 3]}, {})
    with pytest.raises(ValidationError, match="needs 9 filters"):
        Camera.model_validate(too_many)


def test_a_changed_camera_survives_its_own_text():
    data = changed(
        TINY,
        {"main_lens.f_number": 7.3, "sensor.pixel_pitch": "1.875 um"},
        {"lenslet_array.superpixel_pitch": "sensor.pixel_pitch * sensor.pixels_per_lenslet.0"},
    )
    camera = Camera.model_validate(data)
    assert parse_camera(to_toml(camera)) == camera
    assert changed(TINY, {}, {}) == TINY and Camera.model_validate(TINY) == load_camera(
        ROOT / "sample_configs" / "tiny.toml"
    )


def test_options_of_a_point_go_over_those_of_the_file(described):
    sweep, axes = described(
        "[vary]\n"
        '"capture-sim.snr" = ["40 dB"]\n'
        "[set]\n"
        '"reconstruct.rank" = 5\n'
        "[reconstruct]\n"
        "rank = 3\n"
        'method = "tsvd"\n'
    )
    assert options_of(sweep, points(sweep, axes)[0]) == {
        "reconstruct": {"rank": 5, "method": "tsvd"},
        "capture-sim": {"snr": "40 dB"},
    }
    assert (number("40 dB"), unit("40 dB"), number("lmmse"), number(True), number([1, 2])) == (
        40.0,
        "dB",
        None,
        None,
        None,
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[vary]\n"main_lens.f_numbr" = [6]\n', "did you mean main_lens.f_number"),
        ('[vary]\n"main_len.f_number" = [6]\n', "did you mean main_lens"),
        (
            '[vary]\n"filter_array.filters.0.centre" = ["450 nm"]\n',
            "did you mean filter_array.filters.0.center",
        ),
        ("[vary]\nf_number = [6]\n", "write section.key"),
        ('[vary]\n"main_lens.f_number" = { from = 4, to = 8, step = 3 }\n', "step"),
        (
            '[vary]\n"main_lens.f_number" = { from = 8, to = 4, steps = 3 }\n',
            "from the smaller to the larger",
        ),
        (
            '[vary]\n"sensor.pixel_pitch" = { from = "1 um", to = 4, steps = 3 }\n',
            "not of one kind",
        ),
        (
            '[vary]\n"sensor.pixel_pitch" = { from = "1 um", to = "4 um", steps = 1 }\n',
            "greater than or equal to 2",
        ),
        (
            '[vary]\n"main_lens.f_number" = { from = 0, to = 4, steps = 3, scale = "log" }\n',
            "above 0",
        ),
        ('[vary]\n"main_lens.f_number" = 6\n', "no list of values and no range"),
        ('[vary]\n"main_lens.f_number" = [6, 8, 6]\n', "stands twice"),
        ('[vary]\n"main_lens.f_number" = [6, nan]\n', "nan is not finite"),
        ('[vary]\n"main_lens.f_number" = [1e300, 6]\n', "no quantity"),
        ('[varies]\n"main_lens.f_number" = [6]\n', "did you mean vary"),
        (
            '[reconstruction]\nmethod = "lmmse"\n[vary]\n"main_lens.f_number" = [6]\n',
            "did you mean reconstruct",
        ),
        ('[front]\npsnr_db = "up"\n[vary]\n"main_lens.f_number" = [6]\n', "'min' or 'max'"),
        ('samples = 5\n[vary]\n"main_lens.f_number" = [6]\n', "latin-hypercube"),
        ('design = "list"\n', "[[point]]"),
        ("", "[vary] is missing"),
        (
            '[vary]\n"main_lens.f_number" = [6]\n[follow]\n"main_lens.f_number" = "2 * 3"\n',
            "both varies and follows",
        ),
        ("[vary\n", "is not TOML"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(described, tmp_path, text, said):
    with pytest.raises(ConfigError) as caught:
        described(text)
    assert said in str(caught.value) and str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(
    ("expression", "said"),
    [
        ("sensor.pixel_pich * 3", "did you mean sensor.pixel_pitch"),
        ("lenslet_array.pitch", "is not given"),
        ("sensor.pixel_pitch * sensor.pixel_pitch", "power of 2"),
        ("sensor.pixel_pitch ** 2", "no product"),
        ("3 + 4", "no number"),
        ("light.illuminant", "is not given"),
        ("sensor.pixel_pitch / 0", "divides by 0"),
        (5, "no product"),
        ("", "no product"),
    ],
)
def test_what_cannot_be_followed_is_said(expression, said):
    with pytest.raises(ConfigError, match="follow") as caught:
        changed(TINY, {}, {"lenslet_array.focal_length": expression})
    assert said in str(caught.value)


def test_parts_that_are_not_there_are_not_made_up():
    for key in ("filter_array.filters.0.center", "sensor.pixels_per_lenslet.2"):
        with pytest.raises(ConfigError):
            changed(TINY, {key: "500 nm"}, {})
    assert unknown_key("reconstruct.anything") is None and unknown_key("reconstruct.a.b")


def test_a_grid_needs_steps(described):
    with pytest.raises(ConfigError, match="vary.main_lens.f_number: a grid needs steps"):
        points(*described('[vary]\n"main_lens.f_number" = { from = 4, to = 8 }\n'))


def test_too_many_points_are_refused(described):
    sweep, axes = described(
        "[vary]\n"
        + "".join(
            f'"{key}" = {{ from = 1.0, to = 2.0, steps = 400 }}\n'
            for key in ("main_lens.f_number", "sensor.pixel_fill_factor")
        )
    )
    with pytest.raises(ConfigError, match="160000 points"):
        points(sweep, axes)
