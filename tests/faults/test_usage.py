"""Every option of every command with values that make no sense: exit 2, the option and a valid
example named, no file touched.
"""

import click
import pytest

from plenocli.cli import options
from plenocli.cli.commands import COMMANDS, load_command
from plenocli.cli.main import run

QUANTITIES = {
    "length": (
        "",
        "abc",
        "5",
        "5kg",
        "-5nm",
        "0nm",
        "nan",
        "nanm",
        "inf",
        "1e999m",
        "1e-999nm",
        "5 nm nm",
    ),
    "duration": ("", "abc", "5", "5nm", "-5ms", "0ms", "nan", "nans", "1e999s"),
    "decibel": ("", "abc", "60nm", "nan", "nandB", "inf", "1e999dB"),
    "bytes": ("", "abc", "5nm", "-5GiB", "0", "nan", "1e999GiB"),
    "number": ("", "abc", "5nm", "-1", "nan", "inf", "1e999"),
}


def leaves(command, words):
    """(words of the command line, command) for a command and all below it."""
    if isinstance(command, click.Group):
        return [
            leaf
            for name in command.list_commands(None)
            for leaf in leaves(command.get_command(None, name), (*words, name))
        ]
    return [(words, command)]


COMMANDS_AND_OPTIONS = [
    (words, option)
    for name in COMMANDS
    for words, command in leaves(load_command(name), (name,))
    for option in command.params
    if isinstance(option, click.Option) and not option.is_flag
]


def senseless(kind):
    """Values that this type of option must refuse."""
    if isinstance(kind, options._Quantity):
        return QUANTITIES[kind.name] + (("0",) if kind.name == "number" and kind._exclusive else ())
    if isinstance(kind, click.Choice):
        return ("", "nonsense", "nan", "-1", kind.choices[0] + "x")
    if isinstance(kind, options.Grid):
        return ("", "abc", "3", "0x3", "-1x3", "3x", "nanx3", "99999999x9", "1.5x2")
    if isinstance(kind, options.Nodes):
        return ("", "abc", "4", "1", "35", "-3", "1.5", "nan", "9" * 30)
    if isinstance(kind, options.Place):
        return ("", "abc", "3", "-1,0", "1.5,2", "nan,0", "9" * 30 + ",0")
    if isinstance(kind, options.Pair):
        return (
            "",
            "abc",
            "450=x",
            "450nm",
            "450nm=",
            "=x",
            "0nm=x",
            "-450nm=x",
            "nan=x",
            "450kg=x",
        )
    if isinstance(kind, options.Ring):
        return ("", "abc", "-1", "1.5", "nan", "9" * 30)
    if isinstance(kind, (click.IntRange, click.types.IntParamType)):
        low = kind.min - 1 if getattr(kind, "min", None) is not None else "abc"
        high = (9 * 10**30,) if getattr(kind, "max", None) is not None else ()
        return ("", "abc", "1.5", "nan", "inf", "5nm", low, *high)
    if type(kind).__name__ == "Lambda":
        return ("", "abc", "-1", "0", "nan", "inf", "5nm")
    if type(kind).__name__ == "_Slope":
        return ("", "abc", "nan", "inf", "1e9", "5nm")
    if type(kind).__name__ == "_Distance":
        return tuple(
            value for value in QUANTITIES["length"] if value not in ("-5nm", "0nm", "1e-999nm")
        )
    if type(kind).__name__ == "_Background":
        return ("", "abc", "-1", "nan", "inf", "5nm")
    if kind.name == "angle":
        return ("", "abc", "5", "5nm", "nan", "nandeg", "1e999deg")
    if isinstance(kind, options.File):
        return ("",)
    return ()


@pytest.mark.parametrize(
    "words, option",
    COMMANDS_AND_OPTIONS,
    ids=lambda v: " ".join(v) if isinstance(v, tuple) else v.opts[-1],
)
def test_senseless_values_are_refused_by_name_with_an_example(
    capfd, tmp_path, monkeypatch, count, words, option
):
    monkeypatch.chdir(tmp_path)
    flag, several = option.opts[-1], option.nargs
    assert run([*words, flag]) == 2 and flag in capfd.readouterr().err
    kind = option.type.types[0] if isinstance(option.type, click.Tuple) else option.type
    for value in senseless(kind):
        assert run([*words, flag, *[str(value)] * several]) == 2, value
        said = capfd.readouterr().err
        assert flag in said and "Traceback" not in said, (value, said)
        assert gives_an_example(said, kind), (value, said)
    assert not list(tmp_path.iterdir())
    count(
        "options with senseless values",
        options=1,
        values=1 + len(senseless(kind)),
        refused=1 + len(senseless(kind)),
    )


def gives_an_example(said, kind):
    """Whether a message shows something that may be written, or the range of what may."""
    if isinstance(kind, options.File):
        return "empty" in said
    return any(
        word in said
        for word in (
            "such as",
            "for example",
            "one of",
            "range",
            "is not in",
            "at least",
            "above",
            "outside",
        )
    )


def test_every_option_has_a_type_that_refuses_something():
    """Free text is only what names a scene, a target, a method of grouping or a title."""
    free = {
        option.opts[-1]
        for _, option in COMMANDS_AND_OPTIONS
        if not senseless(
            option.type.types[0] if isinstance(option.type, click.Tuple) else option.type
        )
    }
    assert free <= {
        "--scheduler",
        "--volume",
        "--layer",
        "--polarisation",
        "--fix",
        "--detect",
        "--patches",
        "--illuminant",
        "--scene",
        "--target",
        "--training",
        "--truth",
        "--title",
        "--spectral-step",
        "--reference",
        "--observer",
    }, free
