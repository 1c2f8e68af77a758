"""Bars that nobody sees go over what they are given all the same."""

import numpy as np
import pytest

from plenocli.base.budget import Budget, spread, within
from plenocli.base.progress import bar, collected_notes, note, repeats_counted
from plenocli.cli.main import run


def test_a_silent_bar_takes_arrays_and_nothing():
    with collected_notes():
        assert list(bar(np.array([4e-7, 5e-7]))) == [4e-7, 5e-7]
        assert list(bar([])) == [] and list(bar(None, 3)) == []


@pytest.mark.parametrize("command, code", [(["schema", "camera"], 0), (["inspect", "none.h5"], 3)])
def test_silence_ends_with_the_command(command, code, capsys):
    assert run(["--quiet", *command]) == code
    note("told afterwards")
    assert capsys.readouterr().err.endswith("plenocli: told afterwards\n")


def test_notes_that_repeat_are_counted(capsys):
    with repeats_counted():
        for number in range(45):
            note(f"a{number}.nef: {number} of 90 lenslets lie partly off the sensor")
        note("another thing")
    note("a1.nef: 1 of 90 lenslets lie partly off the sensor")
    told = capsys.readouterr().err.splitlines()
    assert told[0] == "plenocli: a0.nef: 0 of 90 lenslets lie partly off the sensor"
    assert told[1] == "plenocli: another thing"
    assert told[2].startswith("plenocli: 45 times in all") and told[2].endswith(told[0][10:])
    assert len(told) == 4


def test_notes_of_threads_are_those_of_whoever_asked(capsys):
    with within(Budget(1 << 30, threads=3)), collected_notes() as said:
        spread([(str(number),) for number in range(5)], note)
    assert sorted(said) == ["0", "1", "2", "3", "4"] and not capsys.readouterr().err
