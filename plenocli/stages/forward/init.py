"""init: the sample configurations and their Makefile, written into a folder to start from."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

from plenocli.base.errors import InputError, OutputError
from plenocli.base.text import Record

RUNS_THE_CHAIN = "Makefile"


@dataclass(frozen=True, kw_only=True)
class Sample:
    """A file that comes with plenocli: its name, "/" between folders, and what it holds."""

    name: str
    content: bytes


@dataclass(frozen=True, kw_only=True)
class InitSummary(Record):
    """What was written: the folder and the names in it, the Makefile last."""

    folder: str
    files: list[str]


def run_init(folder: Path, *, overwrite: bool = False) -> InitSummary:
    """Write the samples into a folder.

    folder: where to; made where it is missing, its parent must be there.
    overwrite: replace files of the same names; else nothing is written where there is one.

    Raises UsageError where a file exists, OutputError where one cannot be written.
    """
    from plenocli.files.atomic import check_output, publish, together

    found = samples()
    targets = {sample.name: folder / sample.name for sample in found}
    inside = dict.fromkeys(target.parent for target in targets.values())
    for place in (folder, *inside):
        if os.path.lexists(place) and not os.path.isdir(place):
            raise OutputError("is not a folder", place, "choose another folder")
    for target in targets.values():
        if os.path.isdir(target.parent):
            check_output(target, overwrite=overwrite)
    for place in (folder, *inside):
        try:
            place.mkdir(exist_ok=True)
        except OSError as error:
            fix = "check its name, and that the folder around it is there and writable"
            raise OutputError(f"the folder cannot be made ({error.strerror})", place, fix) from None
    with together():
        for sample in found:
            publish(targets[sample.name], sample.content, overwrite=overwrite)
    return InitSummary(folder=str(folder), files=[sample.name for sample in found])


def samples() -> list[Sample]:
    """The sample configurations by name, and last the Makefile: where it is, all are.

    Returns what the installed package, or the checkout that it runs from, holds.
    Raises InputError where the installation has lost them.
    """
    home = files("plenocli") / "samples"
    if not home.is_dir():
        raise InputError("is missing in this installation", home, "install plenocli again")
    made = (home / RUNS_THE_CHAIN).read_bytes()
    return [*_descriptions(home, ""), Sample(name=RUNS_THE_CHAIN, content=made)]


def _descriptions(home: Traversable, within: str) -> Iterator[Sample]:
    """Every .toml and .csv in `home`, and one folder down: results beside them are deeper."""
    for entry in sorted(home.iterdir(), key=lambda e: e.name):
        if entry.name.endswith((".toml", ".csv")):
            yield Sample(name=within + entry.name, content=entry.read_bytes())
        elif not within and entry.is_dir():
            yield from _descriptions(entry, f"{entry.name}/")
