"""Every pair of options of every command, with values that each of them takes, on small files: done
or refused with a message, never a bug, a signal or a hang.

The pairs come from the parsers' own description; values by the type of each option.
"""

import itertools
import re
import shutil

import click
import numpy as np
import pytest

from plenocli.cli import options
from plenocli.cli.commands import load_command

SOUND = {
    "simulate-pif": "camera.toml --model ray --superpixels 1x1",
    "capture-sim": "camera.toml --pif pif.h5 --scene photo.png",
    "simulate-response": "colour.toml --model ray",
    "calibrate": "--white white.dng",
    "demux": "colorchecker.dng --calibration calibration.h5",
    "learn-dict": "photo.png --pif pif.h5 --atoms 80 --batch 64 --iterations 1",
    "reconstruct": "capture.h5 --pif pif.h5",
    "refocus": "capture.h5",
    "volume": "volume-capture.h5 --pif kernels.h5",
    "score": "image.h5 --truth capture.h5",
    "show": "image.h5",
    "inspect": "capture.h5",
    "sweep": "designs.toml",
    "fit-camera": "capture.h5 --camera camera.toml",
    "report": "mini",
}
FILES = ("camera.toml", "pif.h5", "capture.h5", "calibration.h5", "photo.png", "white.dng", "none")
QUANTITIES = {
    "length": ("540nm", "20um", "0.5mm"),
    "duration": ("10ms", "1s"),
    "decibel": ("20dB", "60dB"),
    "bytes": ("300MiB", "2GiB"),
    "number": ("1e-3", "0.5", "2", "100"),
}
NEVER = {"help", "output", "scheduler", "workers"}
"""Where it goes is said once; processes beside this one are looked at elsewhere."""


def sensible(option):
    """Values of an option, each a list of words."""
    names = [max(option.opts, key=len)]
    if option.is_flag:
        return [[name] for name in names + list(option.secondary_opts)]
    kind = option.type
    if isinstance(kind, click.Choice):
        found = kind.choices
    elif isinstance(kind, options._Quantity):
        found = QUANTITIES[kind.name]
    elif isinstance(kind, options.Grid):
        found = ("1x1", "2x3", "40x40")
    elif isinstance(kind, options.Nodes):
        found = ("3", "5")
    elif isinstance(kind, options.Place):
        found = ("0,0", "2,1", "900,900")
    elif isinstance(kind, options.Pair):
        found = ("450nm=450nm.dng", "650nm=white.dng")
    elif isinstance(kind, (options.Ring, click.IntRange, click.types.IntParamType)):
        found = ("0", "1", "3")
    elif isinstance(kind, options.File):
        found = FILES
    elif getattr(kind, "name", "") == "angle":
        found = ("0deg", "20deg")
    else:
        found = ("auto", "1", "white", "block-mean,tikhonov", "a=b")
    return [[names[0], str(value)] for value in found]


def pairs(name):
    """All pairs of a command's options."""
    known = [
        option
        for option in load_command(name).params
        if isinstance(option, click.Option) and option.name not in NEVER
    ]
    return list(itertools.combinations(known, 2))


@pytest.mark.parametrize("name", SOUND)
def test_a_pair_of_options_is_done_or_refused(runner, stages, tmp_path, campaign, count, name):
    for path in filter(lambda p: p.is_file(), stages[0].iterdir()):
        shutil.copy(path, tmp_path / path.name)
    (tmp_path / "mini").mkdir()
    for file in ("image.h5", "score.json"):
        shutil.copy(stages[0] / file, tmp_path / "mini")
    known, rng = pairs(name), np.random.default_rng(list(name.encode()))
    before, codes = set(tmp_path.iterdir()), []
    suffix = {"show": "png", "report": "html", "score": "json", "fit-camera": "toml"}
    for number in rng.permutation(len(known))[: campaign(1, None)]:
        words = [name, *SOUND[name].split()]
        for option in known[number]:
            values = sensible(option)
            words += values[rng.integers(len(values))]
        if name != "inspect":
            words += ["-o", f"out.{suffix.get(name, 'h5')}"]
        outcome = runner.run(words, tmp_path, limit=120)
        assert outcome.code in (0, 2, 3, 4, 5) and not outcome.hung, (words, outcome)
        assert "Traceback" not in outcome.text, words
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f]", outcome.text), words
        codes.append(outcome.code)
        for path in set(tmp_path.iterdir()) - before:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    count("pairs of options", pairs=len(known), done=codes.count(0), run=len(codes), bugs=0)
