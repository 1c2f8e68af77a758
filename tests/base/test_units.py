"""Numbers with units: exact doubles, one clear message for everything else."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plenocli.base.units import (
    UnitError,
    format_duration,
    format_length,
    parse_bytes,
    parse_decibel,
    parse_duration,
    parse_length,
)


@pytest.mark.parametrize(
    "text, metres",
    [
        ("550nm", 550e-9),
        ("550 nm", 550e-9),
        ("250 um", 250e-6),
        ("250 µm", 250e-6),
        ("50mm", 0.05),
        ("1e-3 m", 1e-3),
        (" 2.5 mm ", 2.5e-3),
        ("1.1 m", 1.1),
        ("0.55um", 550e-9),
    ],
)
def test_lengths_are_the_nearest_doubles(text, metres):
    assert parse_length(text) == metres


@pytest.mark.parametrize(
    "text",
    [
        "250",
        "",
        "um",
        "5 kg",
        "5 um um",
        "1,5 mm",
        "nan um",
        "inf m",
        "--5 um",
        None,
        5,
        "1e999 m",
        "5e um",
    ],
)
def test_what_is_no_length_is_refused_with_an_example(text):
    with pytest.raises(UnitError, match="(such as '250 um')|too large"):
        parse_length(text)


def test_other_units():
    assert parse_bytes("4GiB") == 4 * 2**30 and parse_bytes("1.5 MiB") == 3 * 2**19
    assert parse_duration("2.5ms") == 2.5e-3 and parse_decibel("-20 dB") == -20
    for parse, text in ((parse_bytes, "4"), (parse_duration, "10"), (parse_decibel, "60")):
        with pytest.raises(UnitError, match="has no unit"):
            parse(text)


@given(st.floats(1e-12, 1e6, allow_nan=False))
def test_formatting_is_undone_by_parsing(value):
    assert parse_length(format_length(value)) == value
    assert parse_duration(format_duration(value)) == value


def test_formatting_is_what_a_person_would_write():
    assert [format_length(x) for x in (550e-9, 104e-6, 0.05, 1.1, 0)] == [
        "550 nm",
        "104 um",
        "50 mm",
        "1.1 m",
        "0 nm",
    ]
