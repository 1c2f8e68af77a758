"""Output that fails: exit 4 with the reason, the old file byte for byte as it was,
nothing left beside it.

Every stage, every call by which it writes, failing at the first, second, ... call until
none is left to fail.
"""

import os
import shutil
import subprocess

import numpy as np
import pytest

from tests.faults.harness import is_clean_refusal, results, tree

QUICK = (
    "simulate-pif 3x3",
    "capture-sim",
    "white",
    "reconstruct",
    "reconstruct exr",
    "refocus",
    "score",
    "sweep",
)
LONG = (
    "simulate-pif",
    "capture-sim exr",
    "simulate-response",
    "calibrate",
    "demux",
    "demux exr",
    "learn-dict",
    "show",
)
STAGES = (*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in LONG))
CALLS = ("write", "pwrite", "pread", "fsync", "ftruncate", "replace", "open", "mkdir")
OLD = b"what was there before"


@pytest.fixture
def workshop(stages, tmp_path):
    """A folder with links to every input and, made at the first call of `ready(name)`, an old
    result to overwrite.
    """
    source, steps = stages
    for path in source.iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / "out").mkdir()

    def ready(name):
        arguments, result = steps[name]
        target = tmp_path / "out" / f"new{os.path.splitext(result)[1]}"
        shutil.rmtree(tmp_path / "out")
        (tmp_path / "out").mkdir()
        whole = results(source / result, target.name)
        for file in whole:
            (target.parent / file).write_bytes(OLD)
        return [*arguments, "-o", target.relative_to(tmp_path), "--overwrite"], target, whole

    return tmp_path, ready


def check(outcome, target, whole):
    """What must hold after any fault: the old file or, where only the last step failed, the
    whole new one; nothing else.
    """
    assert is_clean_refusal(outcome, 4), outcome
    assert is_old_or_new(target, whole), sorted(tree(target.parent))


def is_old_or_new(target, whole):
    """Whether all files of a result are as they were or as they should become, with nothing beside
    but what a sweep could not clean in the folder that is its own, where every call fails from some
    time on; the next run does.
    """
    there = {
        name: content
        for name, content in tree(target.parent).items()
        if ".parts/scratch/" not in name
    }
    return there in (whole, dict.fromkeys(whole, OLD))


@pytest.mark.parametrize("name", STAGES)
def test_any_call_may_fail(runner, workshop, campaign, count, name):
    folder, ready = workshop
    rng, points = np.random.default_rng(list(name.encode())), 0
    for call in CALLS:
        for nth in range(1, campaign(2, 400)):
            command, target, whole = ready(name)
            error = "ENOSPC" if call in ("write", "pwrite", "ftruncate") else "EIO"
            outcome = runner.run(
                command,
                folder,
                fault={"call": call, "nth": nth, "error": error, "lasting": bool(rng.integers(2))},
            )
            if not outcome.fired:
                assert outcome.code == 0 and tree(target.parent) == whole, outcome
                break
            points += 1
            # a courtesy may fail unseen, such as telling the disk of the new name
            if outcome.code == 0:
                assert tree(target.parent) == whole
            elif call in ("pread", "open") and outcome.code == 3:
                assert is_clean_refusal(outcome, 3) and set(tree(target.parent).values()) == {
                    OLD
                }, outcome
            else:
                check(outcome, target, whole)
    assert points >= 2
    count(
        "the n-th write, read, fsync, rename ... failing",
        points=points,
        signals=0,
        old_files_lost=0,
    )


@pytest.mark.parametrize("name", STAGES)
def test_a_disk_may_be_full_at_any_byte(runner, workshop, campaign, count, name):
    folder, ready = workshop
    _, target, whole = ready(name)
    size = len(whole[target.name])
    places = [0, 1, size - 1, *range(4096, size, 4096)]
    most = campaign(2, 10_000)
    if len(places) > most:
        places = sorted(
            {0, size - 1, *np.random.default_rng(5).choice(places, most, replace=False).tolist()}
        )
    for room in places:
        command, target, whole = ready(name)
        # OpenEXR and a sweep's journal write by themselves: there a limit of the file's size takes
        # the place of the disk's
        outcome = runner.run(
            command,
            folder,
            fault={
                "call": "filesize" if target.suffix == ".exr" or name == "sweep" else "bytes",
                "nth": room,
            },
        )
        assert outcome.fired
        check(outcome, target, whole)
        assert "space" in outcome.text
    count(
        "a disk full at byte 0, each 4 KiB and the last",
        points=len(places),
        signals=0,
        old_files_lost=0,
    )


@pytest.mark.parametrize("name", STAGES)
def test_any_array_may_find_no_memory(runner, workshop, campaign, count, name):
    """The first 30 arrays one by one, then ever farther apart, until none is left:
    once or from there on.
    """
    folder, ready = workshop
    nth, points = 1, 0
    while True:
        command, target, whole = ready(name)
        outcome = runner.run(
            command, folder, fault={"call": "array", "nth": nth, "lasting": points % 2}
        )
        if not outcome.fired:
            assert outcome.code == 0 and tree(target.parent) == whole, outcome
            break
        points += 1
        assert (
            outcome.code == 0
            and tree(target.parent) == whole
            or is_clean_refusal(outcome, (4, 5), "memory")
            and is_old_or_new(target, whole)
        ), (nth, outcome)
        nth = max(nth + 1, int(nth * campaign(3, 1.1 if nth > 30 else 1)))
    assert points >= 3
    count("allocation failing, n-th array", points=points, signals=0, old_files_lost=0)


@pytest.mark.parametrize("name", STAGES)
def test_any_limit_of_memory(runner, workshop, campaign, count, name):
    """A shell's or a queue's limit, from nothing more than what is in use up to enough."""
    folder, ready = workshop
    limits = campaign(
        (0, 10**6, 260 << 20),
        (0, *(int(3000 * 3.5**step) for step in range(9)), 257 << 20, 300 << 20, 400 << 20),
    )
    for room in limits:
        command, target, whole = ready(name)
        outcome = runner.run(command, folder, fault={"call": "memory", "nth": room})
        assert (
            outcome.code == 0
            and tree(target.parent) == whole
            or is_clean_refusal(outcome, 5, "memory")
            and is_old_or_new(target, whole)
        ), (room, outcome)
        assert outcome.code == 0 or room < 300 << 20
    count("allocation failing, limits of memory", points=len(limits), signals=0, old_files_lost=0)


@pytest.mark.parametrize("name", ["simulate-pif 3x3", "white", "reconstruct", "score"])
def test_short_writes_give_the_same_bytes(runner, workshop, name):
    folder, ready = workshop
    command, target, whole = ready(name)
    outcome = runner.run(command, folder, fault={"call": "short"})
    assert outcome.code == 0 and outcome.fired and tree(target.parent) == whole


@pytest.mark.parametrize("name", STAGES)
def test_places_where_nothing_can_be_written(runner, workshop, name):
    folder, ready = workshop
    command, target, _ = ready(name)
    place = command.index("-o") + 1
    (folder / "a-folder").mkdir()
    for where in (
        "missing/new" + target.suffix,
        "camera.toml/new" + target.suffix,
        "x" * 250 + target.suffix,
    ):
        outcome = runner.run([*command[:place], where, *command[place + 1 :]], folder)
        assert is_clean_refusal(outcome, 4, where), outcome
    if command[0] not in ("demux", "reconstruct", "refocus"):  # which put results into a folder
        outcome = runner.run([*command[:place], "a-folder", *command[place + 1 :]], folder)
        assert is_clean_refusal(outcome, (2, 4), "a-folder") and not list(
            (folder / "a-folder").iterdir()
        ), outcome
    source = next(word for word in command[1:] if (folder / word).is_file())
    before = (folder / source).read_bytes()
    outcome = runner.run([*command[:place], source, *command[place + 1 :]], folder)
    assert is_clean_refusal(outcome, (2, 4), source) and (folder / source).read_bytes() == before, (
        outcome
    )
    refused = runner.run(command[:-1], folder)
    assert is_clean_refusal(refused, 2, "--overwrite") and target.read_bytes() == OLD


def test_a_real_full_disk(runner, workshop, campaign):
    """A tmpfs of 64 KiB, where the system allows to make one."""
    folder, ready = workshop
    disk = folder / "disk"
    disk.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)], capture_output=True
    ).returncode:
        pytest.skip("no permission to mount a small disk")
    try:
        for name in campaign(QUICK[::2], (*QUICK, *LONG)):
            command, target, whole = ready(name)
            if len(whole[target.name]) < 70_000:
                continue
            small = disk / target.name
            small.write_bytes(OLD)
            outcome = runner.run(
                [small if word == target.relative_to(folder) else word for word in command], folder
            )
            assert is_clean_refusal(outcome, 4, "space"), outcome
            assert tree(disk) == {small.name: OLD}
            small.unlink()
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_read_only_folder(runner, workshop, tmp_path):
    (tmp_path / "probe").mkdir(0o555)
    if os.access(tmp_path / "probe", os.W_OK):
        pytest.skip("root may write anywhere; setpriv --bounding-set=-dac_override takes that away")
    folder, ready = workshop
    for name in (*QUICK, *LONG):
        command, target, _ = ready(name)
        target.parent.chmod(0o555)
        try:
            outcome = runner.run(command, folder)
            assert is_clean_refusal(outcome, 4) and target.read_bytes() == OLD
        finally:
            target.parent.chmod(0o755)
