"""Descriptions in TOML: where a violation stands."""

import tomllib
from pathlib import Path

import pytest

from plenocli.base.errors import ConfigError
from plenocli.files.config.camera_file import parse_camera

SAMPLES = sorted((Path(__file__).resolve().parents[2] / "sample_configs").glob("seed_s*.toml"))


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_a_violation_names_the_line_it_stands_on(path):
    """Every key of a camera in turn is given a value that it cannot have."""
    lines, tried = path.read_text().splitlines(), 0
    for number, line in enumerate(lines, 1):
        if line.startswith(("#", "[")) or "=" not in line:
            continue
        key = line.split("=")[0]
        broken = [*lines[: number - 1], f"{key}= {{ nobody = 1 }}", *lines[number:]]
        try:
            tomllib.loads("\n".join(broken))
        except tomllib.TOMLDecodeError:
            continue  # a value of several lines
        with pytest.raises(ConfigError) as refused:
            parse_camera("\n".join(broken))
        assert f"{key.strip()}" in str(refused.value) and f"(line {number})" in str(refused.value)
        tried += 1
    assert tried > 8


def test_tables_of_an_array_are_told_apart_and_what_is_missing_has_no_line():
    text = SAMPLES[0].read_text().split("[filter_array]")[0]
    text += """
[filter_array]
layout = [1, 2]
[[filter_array.filters]]
center = "450 nm"
fwhm = "20 nm"
[[filter_array.filters]]  # the second
center = "blue"
fwhm = "20 nm"
"""
    with pytest.raises(ConfigError) as refused:
        parse_camera(text)
    line = 1 + text.splitlines().index('center = "blue"')
    assert f"(line {line})" in str(refused.value)
    with pytest.raises(ConfigError) as refused:
        parse_camera("[main_lens]\nf_number = 8\n")
    said = str(refused.value).splitlines()
    assert any("main_lens.focal_length: is missing (line 1)" in one for one in said)
    assert any(one.strip() == "sensor: is missing" for one in said)
