"""The description of a microscope: its own text, and what it refuses."""

from pathlib import Path

import pytest

from plenocli.base.errors import ConfigError
from plenocli.files.config.camera_file import describes_microscope
from plenocli.files.config.microscope_file import load_microscope, microscope_toml, parse_microscope

SAMPLES = Path(__file__).resolve().parents[3] / "sample_configs"
TEXT = (SAMPLES / "microscope.toml").read_text()


def test_the_sample_reads_and_survives_its_own_text():
    microscope = load_microscope(SAMPLES / "microscope.toml")
    text = microscope_toml(microscope)
    assert parse_microscope(text) == microscope
    assert microscope_toml(parse_microscope(text)) == text
    planes = microscope.object.planes
    assert len(planes) == 25 and planes[12] == 0 and planes[0] == pytest.approx(-12e-6)
    assert describes_microscope(SAMPLES / "microscope.toml")
    assert not describes_microscope(SAMPLES / "tiny.toml")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("numerical_aperture = 1.2", "numerical_aperture = 1.4", "not below the refractive index"),
        ('"-12 um to 12 um step 1 um"', '"-12 um to 12 um"', "no range of planes"),
        ('"-12 um to 12 um step 1 um"', '"12 um to -12 um step 1 um"', "rise"),
        ('"-12 um to 12 um step 1 um"', '["0 um", "0 um"]', "rise"),
        ('"-12 um to 12 um step 1 um"', '"-500 um to 500 um step 50 um"', "spread over"),
        ('"-12 um to 12 um step 1 um"', '"-1 um to 1 um step 1 nm"', "at most 1000"),
        ("pixels_per_lenslet = [15, 15]", "pixels_per_lenslet = [30, 30]", "fit under a"),
        ("medium_index = 1.35", "medium_index = 1.35\nspecimen_index = 1.33", "go together"),
        ("medium_index = 1.35", "medium_index = 1.35\nrings = [0.0, 0.0]", "rings"),
        ('pitch = "100 um"', 'pitch = "100"', "100"),
        ('focal_length = "2500 um"', 'focal_length = "2500 mm"', "did you mean 2.5 mm"),
        ('\ndistance = "2500 um"', '\ndistance = "2.5 um"', "did you mean 2.5 mm"),
        ('["593 nm"]', '["593 um"]', "1 violation\n.*outside 100 nm"),
    ],
)
def test_what_cannot_be_is_refused_with_its_path(old, new, said):
    assert old in TEXT
    with pytest.raises(ConfigError, match=said):
        parse_microscope(TEXT.replace(old, new))
