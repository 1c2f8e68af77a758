"""Shared options: units, grids, pairs, and the command line that goes into an artefact."""

import click
import pytest
from click.testing import CliRunner

from plenocli.cli import options


@click.command("probe")
@options.input_path("files", nargs=-1)
@click.option("--wavelength", "wavelengths", multiple=True, type=options.LENGTH)
@click.option("--exposure", type=options.DURATION)
@click.option("--grid", type=options.Grid("auto"), default="auto")
@click.option("--band", "bands", multiple=True, type=options.Pair("FILE", options.Path))
@click.option("--snr", "snr_db", type=options.DECIBEL)
@options.seed
@options.overwrite
@click.pass_context
def probe(ctx, **_):
    click.echo(options.command_line(ctx))


def line(*arguments):
    result = CliRunner().invoke(probe, arguments)
    assert result.exit_code == 0, result.output
    return result.output.strip()


def test_the_recorded_command_can_be_typed_again():
    typed = [
        "a/b.h5",
        "c.h5",
        "--wavelength",
        "0.55um",
        "--wavelength",
        "650 nm",
        "--exposure",
        "0.0025s",
        "--grid",
        "3x5",
        "--band",
        "450nm=x/y.dng",
        "--snr",
        "60 dB",
        "--seed",
        "7",
        "--overwrite",
    ]
    recorded = line(*typed)
    assert recorded == (
        "plenocli probe b.h5 c.h5 --wavelength 550nm --wavelength 650nm --exposure 2.5ms "
        "--grid 3x5 --band 450nm=y.dng --snr 60dB --seed 7"
    )
    assert line(*recorded.split()[2:]) == recorded
    assert line() == "plenocli probe"


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--wavelength", "550"], "has no unit"),
        (["--wavelength", "-550nm"], "above 0"),
        (["--wavelength", "0nm"], "above 0"),
        (["--exposure", "5m"], "such as '10 ms'"),
        (["--grid", "3"], "3x3"),
        (["--grid", "0x3"], "not a grid"),
        (["--band", "450nm"], "450nm=band450.dng"),
        (["--band", "450=a"], "has no unit"),
        (["--snr", "nan"], "60dB"),
        (["--seed", "-1"], "-1"),
    ],
)
def test_wrong_values_are_refused_with_an_example(arguments, message):
    result = CliRunner().invoke(probe, arguments)
    assert result.exit_code == 2 and message in result.output


def test_json_has_no_nan_and_no_arrays(capsys):
    import numpy as np

    options.summary(
        {"a": np.float64("nan"), "b": np.arange(2), "c": (1.5, None), "d": options.Path("x")},
        True,
        "",
    )
    assert capsys.readouterr().out == '{"a": null, "b": [0, 1], "c": [1.5, null], "d": "x"}\n'


@pytest.mark.parametrize(
    "kind, value",
    [
        (options.WAVELENGTH, "1e-308nm"),
        (options.WAVELENGTH, "1m"),
        (options.LENGTH, "1e308nm"),
        (options.DURATION, "1e308ms"),
        (options.DECIBEL, "1e308dB"),
        (options.POSITIVE, "1e-308"),
        (options.NON_NEGATIVE, "1e300"),
        (options.Pair("NUMBER", options.positive), "450nm=inf"),
        (options.Pair("NUMBER", options.positive), "450nm=0"),
        (options.FILE, ""),
        (options.FILE, "-"),
    ],
)
def test_values_that_would_overflow_later_are_refused(kind, value):
    with pytest.raises(click.BadParameter):
        kind.convert(value, None, None)
    assert options.NON_NEGATIVE.convert("0", None, None) == 0
