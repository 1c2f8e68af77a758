"""Lengths in a wrong unit: refused with the one that is wrong, wherever a camera comes from."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import ConfigError, UsageError
from plenocli.base.units import format_length
from plenocli.files.config.camera_file import parse_camera
from plenocli.files.read.cameras import read_camera
from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.camera.plausible import UNITS
from tests.forward.propagation.cameras import small_camera

SAMPLES = Path(__file__).parents[3] / "sample_configs"
LENGTH = re.compile(r'^(focal_length|distance|superpixel_pitch|pixel_pitch|size) = "([^"]+)"', re.M)
FAR_OBJECT = "object.distance"
"""An object may be as far as one likes."""


def slips():
    """(sample, section.key, text of the length, factor) of every length of every sample."""
    for path in sorted(SAMPLES.glob("*.toml")):
        if path.stem == "microscope":
            continue
        text = path.read_text()
        for match in LENGTH.finditer(text):
            section = re.findall(r"^\[(\w+)\]", text[: match.start()], re.M)[-1]
            for factor in UNITS:
                if f"{section}.{match[1]}" != FAR_OBJECT or factor < 1:
                    yield path, f"{section}.{match[1]}", match, factor


def test_every_length_in_a_wrong_unit_is_refused_and_named():
    tried = 0
    for path, key, match, factor in slips():
        text = path.read_text()
        meant = parse_camera(text)  # the sample itself is a camera
        section, name = key.split(".")
        value = getattr(getattr(meant, section), name) or meant.superpixel_pitch
        wrong = f'{match[1]} = "{value * factor!r} m"'
        with pytest.raises(ConfigError) as refused:
            parse_camera(text[: match.start()] + wrong + text[match.end() :])
        message = str(refused.value)
        assert key in message
        if "outside" not in message:  # of what any length may be
            asked = format_length(float(f"{value:.4g}"))
            assert message.endswith(f"was {asked} meant?"), (path.name, key, factor, message)
        tried += 1
    assert tried > 200


def test_usual_cameras_are_none_of_its_business():
    """Cameras of f/1 to f/64, lenslets of 5 um to 1 mm, in and out of focus."""
    rng = np.random.default_rng(4)
    for _ in range(200):
        f, pitch, f1 = np.exp(rng.uniform(np.log([1, 5e-6, 5e-3]), np.log([64, 1e-3, 0.5])))
        z1 = f1 * np.exp(rng.uniform(np.log(1.5), np.log(1e4)))
        z2 = 1 / (1 / f1 - 1 / z1)
        z3 = f * pitch
        camera = small_camera(
            main_lens__focal_length=f1,
            main_lens__aperture_diameter=z2 / f,
            object__distance=z1 * rng.uniform(0.95, 1.05),
            lenslet_array__distance=z2,
            lenslet_array__pitch=pitch,
            lenslet_array__focal_length=z3 * rng.uniform(0.8, 1.2),
            sensor__distance=z3,
            sensor__pixel_pitch=pitch / 13,
        )
        assert camera.lenslet_array.pitch == pitch


def test_wavelengths_wider_than_lenslets_are_refused():
    with pytest.raises(UsageError, match="longer than lenslets are wide"):
        plan_pif(small_camera(), wavelengths=(90e-6,))


@pytest.mark.parametrize("name", sorted(p.name for p in SAMPLES.glob("*.toml")))
def test_lengths_in_a_wrong_unit_throughout_are_asked_about(name, tmp_path, capsys):
    """Ratios are those of a camera; sizes are not. The samples themselves are usual."""
    text = (SAMPLES / name).read_text()
    if "[objective]" in text:
        return
    assert read_camera(SAMPLES / name).unusual_lengths() is None
    shutil.copytree(SAMPLES, tmp_path, dirs_exist_ok=True)  # files that it names
    (tmp_path / name).write_text(text.replace(' um"', ' mm"'))
    try:
        camera = read_camera(tmp_path / name)
    except ConfigError as error:
        assert "meant?" in str(error) or "units of its lengths" in str(error)
        return
    assert f"{name}: " in capsys.readouterr().err
    pixel = 1e6 * read_camera(SAMPLES / name).sensor.pixel_pitch
    assert f"sensor.pixel_pitch is {pixel:.4g} mm: did you mean {pixel:.4g} um?" in str(
        camera.unusual_lengths()
    )
