"""kill -9 at any time: a target is absent or whole, the same command run again gives the same
bytes, and nothing is left beside it.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from plenocli.files.artefacts.container import read_artefact
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
    while killed < int(os.environ.get("KILLS", campaign(4, 200))):
        outcome = runner.run(command, tmp_path, kill_after=rng.uniform(0, usual))
        if outcome.code == 0:
            finished += 1
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
    """The tiny pipeline, all of its processes killed at once at random times,
    until it gets through.
    """
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT),
    }

    def make(run):
        command = [
            "make",
            "-f",
            "pipelines/spatial.mk",
            f"RUN={run}",
            "CONFIG=sample_configs/tiny.toml",
            "ITERATIONS=2",
            "BATCH=64",
            "-j2",
        ]
        return subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    start = time.monotonic()
    assert make(tmp_path / "whole" / "run").wait() == 0
    usual, rng, killed = time.monotonic() - start, np.random.default_rng(8), 0
    for _ in range(int(os.environ.get("KILLS", campaign(3, 20)))):
        child = make(tmp_path / "killed" / "run")
        try:
            assert child.wait(timeout=rng.uniform(0.02, 0.3) * usual) == 0
            break
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
            killed += 1
    assert make(tmp_path / "killed" / "run").wait() == 0
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")
    count("kill -9 of make with all that runs", killed=killed, other_files_than_uninterrupted=0)


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
