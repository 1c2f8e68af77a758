"""kill -9 at any time: a target is absent or whole, the same command run again gives the same
bytes, and nothing is left beside it.

With test_transactions.py and test_cluster_kills.py, `make faults` kills 400 of each kind: commands
with one result (14), with several, a sweep, learning with a checkpoint, make with all that it runs,
and client, workers and scheduler of Dask; forked from a warm process, else a start of Python would
be most of each.
"""

import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from plenocli.files.artefacts.reading import read_artefact
from tests.faults.forked import Forks
from tests.faults.harness import results, tree

ROOT = Path(__file__).resolve().parents[2]
QUICK = ("simulate-pif", "capture-sim", "white", "reconstruct", "refocus", "score", "sweep")
LONG = (
    "simulate-pif 3x3",
    "simulate-response",
    "calibrate",
    "demux",
    "demux exr",
    "learn-dict",
    "reconstruct exr",
    "show",
)


@pytest.mark.parametrize(
    "name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in LONG)]
)
def test_a_killed_stage_leaves_nothing_half_done(runner, stages, tmp_path, campaign, count, name):
    source, steps = stages
    arguments, result = steps[name]
    for path in source.iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / "out").mkdir()
    target = tmp_path / "out" / f"new{os.path.splitext(result)[1]}"
    whole = results(source / result, target.name)
    command = [*arguments, "-o", target, "--overwrite"]
    usual = runner.run(command, tmp_path).seconds
    assert tree(target.parent) == whole
    empty(target.parent)
    rng, killed, finished = np.random.default_rng(list(name.encode())), 0, 0
    while killed < campaign(4, 400 if name == "sweep" else 29):
        outcome = runner.run(command, tmp_path, kill_after=rng.uniform(0, usual))
        if outcome.code == 0:
            # the first run may have been slow for reasons of its own
            finished, usual = finished + 1, min(usual, outcome.seconds)
        else:
            assert outcome.code == -signal.SIGKILL, outcome
            killed += 1
        left = tree(target.parent)
        # absent or whole
        assert all(left.get(file, content) == content for file, content in whole.items())
        if whole.keys() <= left.keys():
            empty(target.parent)
        assert finished < 1000
    assert runner.run(command, tmp_path).code == 0
    assert tree(target.parent) == whole
    count("kill -9 of a stage", killed=killed, finished_before=finished, partial_files=0)


def empty(folder):
    shutil.rmtree(folder)
    folder.mkdir()


@pytest.mark.slow
def test_make_after_a_kill_gives_the_tree_of_an_uninterrupted_run(tmp_path, campaign, count):
    """A short pipeline, make and all that it runs killed at once at random times, until it gets
    through; then from the start again.
    """
    pytest.importorskip("distributed")
    words = ["-f", "pipelines/spatial.mk", "CONFIG=sample_configs/tiny.toml", "EXPERIMENTS=paper"]
    words += ["METHODS=block-mean tikhonov", "-j2"]
    rng, killed, through, wanted = np.random.default_rng(8), 0, 0, campaign(6, 400)
    folders = [tmp_path / name for name in ("bin", "whole", "killed")]
    for folder in folders:
        folder.mkdir()
    with Forks(tmp_path) as forks:
        forks.shim(folders[0])

        def make(folder):
            return forks.make([*words, f"RUN={folder / 'run'}"], ROOT, folders[0])

        assert make(folders[1]).code(300) == 0
        start, whole = time.monotonic(), tree(folders[1])
        empty(folders[1])
        assert make(folders[1]).code(300) == 0 and tree(folders[1]) == whole
        usual = time.monotonic() - start
        while killed < wanted:
            process = make(folders[2])
            if process.ended(rng.uniform() ** 3 * usual):
                assert process.code(0) == 0 and tree(folders[2]) == whole
                empty(folders[2])
                through += 1
                continue
            process.kill()
            killed += 1
            left = tree(folders[2])
            assert all(left.get(name, data) == data for name, data in whole.items())
            assert through < wanted
        assert make(folders[2]).code(300) == 0 and tree(folders[2]) == whole
    count("kill -9 of make with all that runs", killed=killed, other_files_than_uninterrupted=0)


@pytest.mark.slow
def test_killed_learning_goes_on_from_its_checkpoint(runner, stages, tmp_path, campaign, count):
    for name in ("photo.png", "pif.h5"):
        (tmp_path / name).symlink_to(stages[0] / name)
    command = "learn-dict photo.png --pif pif.h5 --atoms 80 --batch 64 --iterations 6".split()
    command += ["--checkpoint", "kept.h5", "-o", "new.h5"]
    usual = runner.run(command, tmp_path).seconds
    whole, rng, killed = read_artefact(tmp_path / "new.h5").data, np.random.default_rng(6), 0
    (tmp_path / "new.h5").unlink()
    while killed < (wanted := campaign(4, 400)) or not (tmp_path / "new.h5").exists():
        after = rng.uniform() ** 2 * usual if killed < wanted else None
        outcome = runner.run(command, tmp_path, kill_after=after)
        killed += outcome.code == -signal.SIGKILL
        assert outcome.code in (0, -signal.SIGKILL), outcome
        if (tmp_path / "kept.h5").exists():
            assert read_artefact(tmp_path / "kept.h5").kind == "checkpoint"
        if (tmp_path / "new.h5").exists():
            found = read_artefact(tmp_path / "new.h5").data
            assert {k: v.tobytes() for k, v in found.items()} == {
                k: v.tobytes() for k, v in whole.items()
            }
            if killed < wanted:
                (tmp_path / "new.h5").unlink()
    assert sorted(tree(tmp_path)) == ["new.h5", "photo.png", "pif.h5"]
    count("kill -9 of learning with a checkpoint", killed=killed, other_dictionaries=0)


@pytest.mark.slow
def test_learning_interrupted_at_every_iteration_resumes_to_the_same_dictionary(
    runner, stages, tmp_path, campaign, count
):
    source, steps = stages
    most = campaign(4, 20)
    for name in ("photo.png", "pif.h5"):
        (tmp_path / name).symlink_to(source / name)
    start = [word for word in steps["learn-dict"][0] if word not in ("--iterations", "2")]
    assert (
        runner.run([*start, "--iterations", most, "-o", "whole.h5"], tmp_path, limit=600).code == 0
    )
    assert runner.run([*start, "--iterations", 1, "-o", "part.h5"], tmp_path, limit=600).code == 0
    for stop in range(2, most + 1):
        outcome = runner.run(
            [
                "learn-dict",
                "photo.png",
                "--pif",
                "pif.h5",
                "--resume",
                "part.h5",
                "--iterations",
                stop,
                "-o",
                "part.h5",
                "--overwrite",
            ],
            tmp_path,
            limit=600,
        )
        assert outcome.code == 0, outcome
    whole, part = (
        read_artefact(tmp_path / name, "dictionary").data for name in ("whole.h5", "part.h5")
    )
    assert set(whole) == set(part) and all(
        whole[key].tobytes() == part[key].tobytes() for key in whole
    )
    count("learn-dict interrupted and resumed", interruptions=most - 1, other_dictionaries=0)
