"""The power goes at any moment: what a disk then holds is played through, cut by cut, from a record
of what a command did to its folder. Every cut leaves the old files or the new ones.

What counts as safe is what POSIX promises: the bytes of a file that was fsynced, names in a folder
that was fsynced. Other bytes may be there, be missing or be zeros; of other names, renames and
removals those up to any moment may be there (file systems with a journal keep their order).
"""

import itertools
import os
import shutil
from dataclasses import dataclass

import pytest

from plenocli.base.errors import OutputError
from plenocli.cli.main import run
from plenocli.execution.journal import Journal
from plenocli.files.atomic import publish, settle, together
from tests.faults.harness import tree

CALLS = (
    "open",
    "write",
    "pwrite",
    "ftruncate",
    "posix_fallocate",
    "fsync",
    "replace",
    "rename",
    "link",
    "unlink",
    "close",
)


@dataclass
class Moment:
    """After a call: names -> file number; file number -> bytes, when they were written, and what
    of them is safe.

    histories: of each folder, names as they were after each call since it was last fsynced.
    """

    call: str
    names: dict
    bytes: dict
    times: dict
    safe: dict
    histories: dict


class Record:
    """All moments of a folder, and those in it, while calls of `os` pass through."""

    def __init__(self, folder, monkeypatch):
        self.folder, self.moments, self._safe = folder, [], {}
        names, content, _ = self._look()
        self._safe = dict(content)
        self._histories = {place: [inside] for place, inside in names.items()}
        self._inside = False
        for name in CALLS:
            monkeypatch.setattr(os, name, self._passing(name, getattr(os, name)))

    def _look(self):
        names, content, times = {}, {}, {}
        for place in (self.folder, *sorted(p for p in self.folder.iterdir() if p.is_dir())):
            names[os.stat(place).st_ino] = inside = {}
            for entry in filter(os.DirEntry.is_file, os.scandir(place)):
                inside[os.path.relpath(entry.path, self.folder)] = entry.inode()
                times[entry.inode()] = entry.stat().st_mtime_ns
                if entry.inode() not in content:
                    with open(entry.path, "rb") as file:
                        content[entry.inode()] = file.read()
        return names, content, times

    def _passing(self, name, real):
        def call(*arguments, **named):
            if self._inside:
                return real(*arguments, **named)
            about = os.fstat(arguments[0]) if name == "fsync" else None
            result = real(*arguments, **named)
            self._inside = True
            try:
                self._note(name, about)
            finally:
                self._inside = False
            return result

        return call

    def _note(self, call, about):
        names, content, times = self._look()
        for place, inside in names.items():
            if inside != self._histories.setdefault(place, [{}])[-1]:
                self._histories[place] = [*self._histories[place], inside]
        if about is not None and about.st_ino in content:
            self._safe[about.st_ino] = content[about.st_ino]
        elif about is not None and about.st_ino in names:
            self._histories[about.st_ino] = [names[about.st_ino]]
        self.moments.append(
            Moment(call, names, content, times, dict(self._safe), dict(self._histories))
        )

    def disks(self):
        """What `cuts` gives, each once."""
        return map(dict, {tuple(sorted(view.items())) for _, view in self.cuts()})

    def cuts(self):
        """(number of the moment, name -> bytes and time) of everything that may be on the disk."""
        known, times = {}, {}
        for number, moment in enumerate(self.moments):
            known |= moment.bytes
            times |= moment.times
            for chosen in itertools.product(*moment.histories.values()):
                names = {name: file for inside in chosen for name, file in inside.items()}
                variants = []
                for file in dict.fromkeys(names.values()):
                    now, safe = known[file], moment.safe.get(file, b"")
                    kept = (len(os.path.commonprefix([now, safe])) + len(now)) // 2
                    torn = now[:kept] + bytes(len(now) - kept)
                    same = file in moment.safe and now == safe
                    variants.append([(file, v) for v in ([now] if same else {now, safe, torn})])
                for chosen_bytes in itertools.product(*variants):
                    content = dict(chosen_bytes)
                    yield (
                        number,
                        {name: (content[file], times[file]) for name, file in names.items()},
                    )


OLD = {"a": b"old a", "b": b"old b"}


def make(folder, files):
    for name, content in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        content, when = content if isinstance(content, tuple) else (content, None)
        (folder / name).write_bytes(content)
        if when is not None:
            os.utime(folder / name, ns=(when, when))


def after_the_cut(folder, view, looked_at=()):
    """Files of a folder where the power came back and each was looked at by plenocli."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    make(folder, view)
    for name in (*view, *looked_at):
        if not os.path.basename(name).startswith("."):
            settle(folder / name)
    return {n: b for n, b in tree(folder).items() if not os.path.basename(n).startswith(".")}


@pytest.fixture
def places(tmp_path):
    (tmp_path / "out").mkdir()
    return tmp_path / "out", tmp_path / "later"


@pytest.mark.parametrize("replaced", [False, True], ids=["new", "replaced"])
@pytest.mark.parametrize("names", ["a", "a b", "x/a y/a"], ids=["rename", "transaction", "folders"])
def test_every_cut_leaves_old_or_new(places, monkeypatch, replaced, names):
    folder, later = places
    new = {name: b"new " + name.encode() * 99 for name in names.split()}
    for name in new:
        (folder / name).parent.mkdir(exist_ok=True)
    before = {name: b"old " + name.encode() for name in new} if replaced else {}
    make(folder, before)
    with monkeypatch.context() as patch:
        record = Record(folder, patch)
        with together():
            for name, content in new.items():
                publish(folder / name, [content[:9], content[9:]], overwrite=True)
    found = [after_the_cut(later, view) for view in record.disks()]
    assert len(found) > 8 and new in found and before in found
    assert [files for files in found if files not in (before, new)] == []
    assert tree(folder) == new


@pytest.mark.parametrize("links", [True, False], ids=["links", "no links"])
@pytest.mark.parametrize("replaced", [False, True], ids=["new", "replaced"])
@pytest.mark.parametrize("names", ["a b", "x/a y/a"], ids=["transaction", "folders"])
def test_every_cut_of_the_way_back_leaves_old_or_new(places, monkeypatch, replaced, names, links):
    """The second file cannot take its place: once, then for all renames that follow."""
    folder, later = places
    new = {name: b"new " + name.encode() * 99 for name in names.split()}
    before = {name: b"old " + name.encode() for name in new} if replaced else {}

    def failing(*_):
        raise OSError(5, "Input/output error")

    for lasting in (False, True):
        shutil.rmtree(folder)
        for name in new:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
        make(folder, before)
        with monkeypatch.context() as patch:
            if not links:
                patch.setattr(os, "link", failing)
            record, left = Record(folder, patch), 1
            noted = os.replace

            def replace(*arguments):
                nonlocal left
                left -= 1
                if left >= 0:
                    return noted(*arguments)
                if lasting:
                    patch.setattr(os, "rename", failing)
                return failing()

            patch.setattr(os, "replace", replace)
            with pytest.raises(OutputError, match="Input/output error"):
                with together():
                    for name, content in new.items():
                        publish(folder / name, content, overwrite=True)
            if lasting:  # neither way is open: that is said, not a mixture read
                with pytest.raises(OutputError, match="cut off halfway"):
                    settle(folder / max(new))
        found = [after_the_cut(later, view, new) for view in record.disks()]
        assert len(found) > 8 and (new if lasting else before) in found
        assert [files for files in found if files not in (before, new)] == []
        assert lasting or tree(folder) == before


@pytest.mark.parametrize("forgotten", ["file", "folder"])
def test_the_replay_sees_what_is_not_made_safe(places, monkeypatch, forgotten):
    folder, later = places
    make(folder, OLD)
    with monkeypatch.context() as patch:
        record = Record(folder, patch)
        noted = os.fsync
        patch.setattr(
            os,
            "fsync",
            lambda d: (
                noted(d) if os.path.isdir(f"/proc/self/fd/{d}") != (forgotten == "folder") else None
            ),
        )
        publish(folder / "a", b"new" * 100, overwrite=True)
    found = [after_the_cut(later, view) for _, view in record.cuts()]
    if forgotten == "file":
        assert any(files["a"] not in (OLD["a"], b"new" * 100) for files in found)
    else:  # what has returned is not yet for good
        last = [after_the_cut(later, v) for n, v in record.cuts() if n == len(record.moments) - 1]
        assert any(files["a"] == OLD["a"] for files in last)


def test_a_journal_keeps_what_add_has_returned_for(places, monkeypatch):
    folder, later = places
    done = {}  # moment -> records that are for good
    with monkeypatch.context() as patch:
        record = Record(folder, patch)
        journal = Journal(folder / "points.jsonl")
        for number in range(4):
            journal.add(f"key {number}", {"value": number})
            done[len(record.moments)] = number + 1
        journal.close()
    seen = 0
    for moment, view in record.cuts():
        kept = max((n for at, n in done.items() if at <= moment + 1), default=0)
        shutil.rmtree(later, ignore_errors=True)
        later.mkdir()
        make(later, view)
        again = Journal(later / "points.jsonl")
        records = again.records
        again.add("next", 1)
        again.close()
        again = Journal(later / "points.jsonl")
        assert again.records == records | {"next": 1}
        again.close()
        records.pop("next", None)
        assert all(records[f"key {n}"] == {"value": n} for n in range(kept)), (moment, view)
        assert all(value == {"value": int(key[4:])} for key, value in records.items())
        seen += 1
    assert seen > 10


COMMANDS = {
    "artefact": "reconstruct capture.h5 --pif pif.h5 --method tikhonov -o out/a.h5",
    "EXR": "reconstruct capture.h5 --pif pif.h5 --method tikhonov -o out/a.exr",
    "DNG": ("capture-sim colour.toml --model ray --superpixels 1x1 --target white -o out/a.dng"),
    "report": "score image.h5 --truth capture.h5 -o out/a.json --report out/b.html",
    "scene": (
        "capture-sim camera.toml --pif pif.h5 --scene photo.png -o out/q.h5 --scene-out out/s.h5"
    ),
    "sweep": "sweep designs.toml -o out/w.h5",
}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_cut_of_a_command_leaves_old_or_new(
    stages, places, monkeypatch, campaign, count, name
):
    folder, later = places
    source = stages[0]
    for path in source.iterdir():
        (folder.parent / path.name).symlink_to(path)
    monkeypatch.chdir(folder.parent)
    words = [*COMMANDS[name].split(), "--overwrite"]
    assert run(words) == 0
    new = _results(folder)
    shutil.rmtree(folder)
    folder.mkdir()
    before = {file: b"what was there before" for file in new}
    make(folder, before)
    with monkeypatch.context() as patch:
        record = Record(folder, patch)
        assert run(words) == 0
    assert _results(folder) == new
    tried, known = 0, set()
    for _, view in record.cuts():
        view = {n: b for n, b in view.items() if n not in ("points.jsonl", "measured.csv")}
        key = tuple(sorted(view.items()))
        if key in known:
            continue
        known.add(key)
        found = after_the_cut(later, view)
        found = {n: b for n, b in found.items() if n in new}
        assert found in (before, new), {n: len(b) for n, b in found.items()}
        tried += 1
    assert tried > 3
    count("power cuts of a command", moments=len(record.moments), disks=tried, mixed=0)


def _results(folder):
    return {n: b for n, b in tree(folder).items() if ".parts/" not in n}
