"""Results of one command appear together or not at all; links, owners and permissions are kept."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import OutputError, UsageError
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.atomic import check_output, publish, settle, staged_path, together
from tests.faults.harness import is_clean_refusal, tree

OLD = b"what was there before"


@pytest.fixture
def folder(stages, tmp_path):
    """A folder of copies of all samples."""
    for path in stages[0].iterdir():
        if path.is_file():
            shutil.copy(path, tmp_path)
    empty(tmp_path / "out")
    return tmp_path


def empty(out):
    shutil.rmtree(out, ignore_errors=True)
    for name in ("x", "y"):
        (out / name).mkdir(parents=True)


SEVERAL = {
    "capture-sim": (
        "capture-sim camera.toml --pif pif.h5 --scene photo.png -o out/q.h5 --scene-out out/s.h5"
    ),
    "score": "score image.h5 --truth capture.h5 -o out/s.json --report out/s.html",
    "folders": (
        "capture-sim camera.toml --pif pif.h5 --scene photo.png -o out/x/q.h5 "
        "--scene-out out/y/s.h5"
    ),
    "sweep": "sweep designs.toml -o out/w.h5",
    "planes": (
        "simulate-pif camera.toml --scene near.toml --accuracy 0.05 --superpixels 1x1 "
        "--coherent-ring 0 -o out/p.h5"
    ),
}


@pytest.mark.parametrize(
    "call, command",
    [
        pytest.param(
            call,
            command,
            id=f"{call}-{name}",
            # the slowest, which go the way of the others; score calls no pwrite
            marks=pytest.mark.slow
            if call in ("pwrite", "fsync") and name in ("score", "sweep")
            else (),
        )
        for call in ("write", "pwrite", "fsync", "replace")
        for name, command in SEVERAL.items()
    ],
)
def test_of_a_failure_all_results_stay_as_they_were(runner, folder, campaign, command, call):
    """Old files before, or none: every place where a call may fail, until none is left to fail;
    by default a few of them, in turn.
    """
    words = [*command.split(), "--overwrite"]
    assert runner.run(words, folder).code == 0
    whole = _results(folder)
    assert len(whole) >= 2
    for had, places in campaign(
        ((True, (4,)), (False, (2,))), ((True, range(1, 200)), (False, range(1, 200)))
    ):
        old = dict.fromkeys(whole, OLD) if had else {}
        for nth in places:
            empty(folder / "out")
            for name, content in old.items():
                (folder / "out" / name).write_bytes(content)
            outcome = runner.run(
                words, folder, fault={"call": call, "nth": nth, "error": "ENOSPC", "lasting": True}
            )
            if not outcome.fired:
                break
            there = _results(folder)
            if outcome.code:
                assert is_clean_refusal(outcome, 4, "space") and there == old, (nth, outcome)
            else:
                assert there == whole, nth


@pytest.mark.parametrize("command", SEVERAL.values(), ids=SEVERAL)
@pytest.mark.parametrize(
    "call",
    [
        "replace",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("fsync", "unlink", "link", "open", "write", "pwrite")
        ),
    ],
)
def test_a_kill_at_any_call_leaves_all_old_or_all_new(
    runner, folder, campaign, count, command, call
):
    """Once plenocli has looked at one of them, whichever that is."""
    words, kills = [*command.split(), "--overwrite"], 0
    assert runner.run(words, folder).code == 0
    whole = _results(folder)
    for old in (dict.fromkeys(whole, OLD), {}):
        for nth in range(1, campaign(4, 200)):
            empty(folder / "out")
            for name, content in old.items():
                (folder / "out" / name).write_bytes(content)
            outcome = runner.run(
                words, folder, fault={"call": call, "nth": nth, "error": "KILL", "lasting": False}
            )
            if not outcome.fired:
                break
            kills += 1
            settle(folder / "out" / sorted(whole)[nth % len(whole)])
            there = {n: b for n, b in _results(folder).items() if not Path(n).name.startswith(".")}
            assert there in (old, whole), (nth, sorted(there))
        assert runner.run(words, folder).code == 0 and _results(folder) == whole
    count("kill -9 at each call", killed=kills, mixed=0)


def test_what_is_said_in_one_folder_moves_no_file_of_another(tmp_path):
    """Nor does nonsense stop anybody from reading."""
    files = {n: tmp_path / n for n in ("a/f", "b/f", "b/.f.partial")}
    for name, path in files.items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(name)
    about = os.stat(files["b/.f.partial"])
    names = ["f", "../b/f", str(files["b/f"])]
    texts = [json.dumps([[n, about.st_size, about.st_mtime_ns] for n in names[i:]]) for i in (0, 1)]
    for text in (*texts, "[" * 100_000, "5", '[["/"]]', "[[1, 2, 3]]", "\udcff"):
        (tmp_path / "a" / ".f.together").write_bytes(os.fsencode(text))
        settle(files["a/f"])
        assert {n: p.read_text() for n, p in files.items()} == {n: n for n in files}, text


def _results(folder):
    return {n: b for n, b in tree(folder / "out").items() if ".parts" not in n}


@pytest.mark.parametrize(
    "command",
    [
        "capture-sim camera.toml --pif pif.h5 --scene photo.png -o q.h5 --scene-out q.h5",
        "capture-sim camera.toml --pif pif.h5 --scene photo.png -o q.h5 --scene-out out/../q.h5",
        "capture-sim camera.toml --pif pif.h5 --scene photo.png -o q.h5 --scene-out link.h5",
        "capture-sim camera.toml --pif pif.h5 --scene photo.png -o q.h5 --scene-out hard.h5",
        "learn-dict photo.png --pif pif.h5 -o q.h5 --checkpoint link.h5",
        "sweep designs.toml -o q.h5 --plot link.png",
    ],
)
def test_two_results_of_one_name_are_refused_before_any_work(runner, folder, command):
    (folder / "q.h5").write_bytes(OLD)
    (folder / "link.h5").symlink_to("q.h5")
    (folder / "link.png").symlink_to("q.h5")
    os.link(folder / "q.h5", folder / "hard.h5")
    before = tree(folder)
    outcome = runner.run([*command.split(), "--overwrite"], folder)
    assert is_clean_refusal(outcome, 2, "another output of this command"), outcome
    assert tree(folder) == before


def test_a_finished_dictionary_is_no_checkpoint(runner, folder):
    shutil.copy(folder / "dictionary.h5", folder / "finished.h5")
    learn = "learn-dict photo.png --pif pif.h5 --atoms 80 --batch 64 --iterations 2".split()
    before = tree(folder)
    outcome = runner.run([*learn, "--checkpoint", "finished.h5", "-o", "new.h5"], folder)
    assert is_clean_refusal(outcome, 3, "finished.h5", "'checkpoint' is due"), outcome
    assert tree(folder) == before


def test_an_interrupted_run_leaves_a_checkpoint_from_which_the_next_goes_on(runner, folder):
    learn = "learn-dict photo.png --pif pif.h5 --atoms 80 --batch 64 --iterations 2".split()
    learn += ["--checkpoint", "kept.h5", "-o", "new.h5"]
    runner.run(learn, folder, fault={"call": "replace", "nth": 2, "lasting": True})
    assert read_artefact(folder / "kept.h5").kind == "checkpoint"
    assert not (folder / "new.h5").exists()
    assert runner.run(learn, folder).code == 0
    found, whole = (read_artefact(folder / name) for name in ("new.h5", "dictionary.h5"))
    assert found.kind == "dictionary" and all(
        found.data[name].tobytes() == values.tobytes() for name, values in whole.data.items()
    )
    assert not (folder / "kept.h5").exists()


@pytest.mark.parametrize("suffix", [".h5", ".exr"])
def test_a_link_is_written_through(runner, folder, suffix):
    command = "reconstruct capture.h5 --pif pif.h5 --method tikhonov -o".split()
    (folder / "elsewhere").mkdir()
    target, link = folder / "elsewhere" / f"real{suffix}", folder / f"link{suffix}"
    link.symlink_to(f"elsewhere/real{suffix}")
    for _ in range(2):  # a link that leads to nothing yet, then to a file
        assert runner.run([*command, link.name, "--overwrite"], folder).code == 0
        assert link.is_symlink() and os.readlink(link) == f"elsewhere/real{suffix}"
        assert target.read_bytes() == (folder / f"image{suffix}").read_bytes()
        assert os.listdir(target.parent) == [target.name]
    refused = runner.run([*command, link.name], folder)
    assert is_clean_refusal(refused, 2, "--overwrite")
    loop = folder / f"loop{suffix}"
    loop.symlink_to(loop.name)
    assert is_clean_refusal(runner.run([*command, loop.name], folder), 4, "leads nowhere")
    assert loop.is_symlink()


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444, 0o664])
def test_overwriting_keeps_the_permissions(tmp_path, mode):
    publish(tmp_path / "a", b"old")
    (tmp_path / "a").chmod(mode)
    publish(tmp_path / "a", b"new", overwrite=True)
    assert (tmp_path / "a").read_bytes() == b"new"
    assert (tmp_path / "a").stat().st_mode & 0o7777 == mode


def test_what_replaces_a_private_file_is_private_while_it_is_written(tmp_path):
    from plenocli.files.atomic import replacement

    publish(tmp_path / "a", b"old")
    (tmp_path / "a").chmod(0o600)
    with replacement(tmp_path / "a", overwrite=True) as (partial, _):
        assert partial.stat().st_mode & 0o077 == 0


def test_a_file_that_failed_is_not_committed_with_the_others(tmp_path):
    with together():
        publish(tmp_path / "a", b"a")
        with pytest.raises(TypeError):
            publish(tmp_path / "b", [b"b", None])
        publish(tmp_path / "c", b"c")
        assert staged_path(tmp_path / "c").read_bytes() == b"c"
        assert not (tmp_path / "a").exists()
    assert tree(tmp_path) == {"a": b"a", "c": b"c"}


def test_a_name_taken_meanwhile_stops_all(tmp_path):
    with pytest.raises(UsageError, match="appeared while"):
        with together():
            publish(tmp_path / "a", b"a")
            publish(tmp_path / "b", b"b")
            (tmp_path / "b").write_bytes(b"theirs")
    assert tree(tmp_path) == {"b": b"theirs"}


def test_one_name_cannot_be_written_twice_at_once(tmp_path):
    with pytest.raises(OutputError):
        with together():
            publish(tmp_path / "a", b"a")
            publish(tmp_path / "a", b"b")
    assert tree(tmp_path) == {}


def test_outputs_are_compared_by_what_they_lead_to(tmp_path):
    (tmp_path / "link").symlink_to("new")
    with pytest.raises(UsageError, match="another output"):
        check_output(tmp_path / "link", others=[None, tmp_path / "new"])
    check_output(tmp_path / "link", others=[tmp_path / "old"])


def test_shards_of_an_older_matrix_are_not_mixed_with_new_ones(folder, monkeypatch):
    """The index and its files are one transaction: of a failure in the last the first stay."""
    from plenocli.files.artefacts import shards
    from tests.faults.conftest import write_shards

    names = ["shards.h5", "shards.000.h5", "shards.001.h5"]
    before = {name: (folder / name).read_bytes() for name in names}
    for name in names:
        (folder / name).chmod(0o644)

    def failing(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shards, "write_artefact", failing)
    whole = read_artefact(folder / "pif-3x3.h5")
    whole.data["pif/A"] = np.asarray(whole.data["pif/A"]) / 2
    whole.data["pif/column_energy"] = whole.data["pif/column_energy"] / 2
    write_artefact(folder / "pif-3x3.h5", whole, overwrite=True)
    with pytest.raises(OSError):
        write_shards(folder, "shards.h5", (tuple(range(5)), tuple(range(5, 9))), overwrite=True)
    assert {name: (folder / name).read_bytes() for name in names} == before
