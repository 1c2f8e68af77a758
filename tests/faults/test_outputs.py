"""Output that fails: exit 4 with the reason, the old file byte for byte as it was, nothing left beside it.

Every stage, every call by which it writes, failing at the first, second, ... call until none is left to fail.
"""

import os
import shutil
import subprocess

import numpy as np
import pytest

from tests.faults.harness import is_clean_refusal, tree

QUICK = ("simulate-pif 3x3", "capture-sim", "white", "reconstruct", "reconstruct exr", "refocus", "score")
LONG = ("simulate-pif", "capture-sim exr", "simulate-response", "calibrate", "demux", "demux exr", "learn-dict", "show")
STAGES = (*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in LONG))
CALLS = ("write", "pwrite", "pread", "fsync", "ftruncate", "replace", "open")
OLD = b"what was there before"


@pytest.fixture
def workshop(stages, tmp_path):
    """A folder with links to every input and, made at the first call of `ready(name)`, an old result to overwrite."""
    source, steps = stages
    for path in source.iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / "out").mkdir()

    def ready(name):
        arguments, result = steps[name]
        target = tmp_path / "out" / f"new{os.path.splitext(result)[1]}"
        shutil.rmtree(tmp_path / "out")
        (tmp_path / "out").mkdir()
        target.write_bytes(OLD)
        return [*arguments, "-o", target.relative_to(tmp_path), "--overwrite"], target, (source / result).read_bytes()

    return tmp_path, ready


def check(outcome, target, whole):
    """What must hold after any fault: the old file or, where only the last step failed, the whole new one; nothing else."""
    assert is_clean_refusal(outcome, 4), outcome
    assert tree(target.parent) in ({target.name: OLD}, {target.name: whole})


@pytest.mark.parametrize("name", STAGES)
def test_any_call_may_fail(runner, workshop, campaign, name):
    folder, ready = workshop
    rng, points = np.random.default_rng(list(name.encode())), 0
    for call in CALLS:
        for nth in range(1, campaign(2, 400)):
            command, target, whole = ready(name)
            error = "ENOSPC" if call in ("write", "pwrite", "ftruncate") else "EIO"
            outcome = runner.run(command, folder, fault={"call": call, "nth": nth, "error": error, "lasting": bool(rng.integers(2))})
            if not outcome.fired:
                assert outcome.code == 0 and tree(target.parent) == {target.name: whole}, outcome
                break
            points += 1
            if outcome.code == 0:  # a courtesy may fail unseen, such as telling the disk of the new name
                assert tree(target.parent) == {target.name: whole}
            elif call in ("pread", "open") and outcome.code == 3:
                assert is_clean_refusal(outcome, 3) and tree(target.parent) == {target.name: OLD}, outcome
            else:
                check(outcome, target, whole)
    assert points >= 2


@pytest.mark.parametrize("name", STAGES)
def test_a_disk_may_be_full_at_any_byte(runner, workshop, campaign, name):
    folder, ready = workshop
    size = len(ready(name)[2])
    places = [0, 1, size - 1, *range(4096, size, 4096)]
    most = campaign(2, 80)
    if len(places) > most:
        places = sorted({0, size - 1, *np.random.default_rng(5).choice(places, most, replace=False).tolist()})
    for room in places:
        command, target, whole = ready(name)
        # OpenEXR writes by itself: there a limit of the file's size takes the place of the disk's
        outcome = runner.run(command, folder, fault={"call": "filesize" if target.suffix == ".exr" else "bytes", "nth": room})
        assert outcome.fired
        check(outcome, target, whole)
        assert "space" in outcome.text


@pytest.mark.parametrize("name", ["simulate-pif 3x3", "white", "reconstruct", "score"])
def test_short_writes_give_the_same_bytes(runner, workshop, name):
    folder, ready = workshop
    command, target, whole = ready(name)
    outcome = runner.run(command, folder, fault={"call": "short"})
    assert outcome.code == 0 and outcome.fired and target.read_bytes() == whole


@pytest.mark.parametrize("name", STAGES)
def test_places_where_nothing_can_be_written(runner, workshop, name):
    folder, ready = workshop
    command, target, _ = ready(name)
    place = command.index("-o") + 1
    (folder / "a-folder").mkdir()
    for where in ("missing/new" + target.suffix, "camera.toml/new" + target.suffix, "x" * 250 + target.suffix):
        outcome = runner.run([*command[:place], where, *command[place + 1:]], folder)
        assert is_clean_refusal(outcome, 4, where), outcome
    if command[0] not in ("demux", "reconstruct"):  # which put their result into a folder
        outcome = runner.run([*command[:place], "a-folder", *command[place + 1:]], folder)
        assert is_clean_refusal(outcome, (2, 4), "a-folder") and not list((folder / "a-folder").iterdir()), outcome
    source = next(word for word in command[1:] if (folder / word).is_file())
    before = (folder / source).read_bytes()
    outcome = runner.run([*command[:place], source, *command[place + 1:]], folder)
    assert is_clean_refusal(outcome, (2, 4), source) and (folder / source).read_bytes() == before, outcome
    refused = runner.run(command[:-1], folder)
    assert is_clean_refusal(refused, 2, "--overwrite") and target.read_bytes() == OLD


def test_a_real_full_disk(runner, workshop, campaign):
    """A tmpfs of 64 KiB, where the system allows to make one."""
    folder, ready = workshop
    disk = folder / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)], capture_output=True).returncode:
        pytest.skip("no permission to mount a small disk")
    try:
        for name in campaign(QUICK[::2], (*QUICK, *LONG)):
            command, target, whole = ready(name)
            if len(whole) < 70_000:
                continue
            small = disk / target.name
            small.write_bytes(OLD)
            outcome = runner.run([small if word == target.relative_to(folder) else word for word in command], folder)
            assert is_clean_refusal(outcome, 4, "space"), outcome
            assert tree(disk) == {small.name: OLD}
            small.unlink()
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder(runner, workshop):
    folder, ready = workshop
    for name in (*QUICK, *LONG):
        command, target, _ = ready(name)
        target.parent.chmod(0o555)
        try:
            outcome = runner.run(command, folder)
            assert is_clean_refusal(outcome, 4) and target.read_bytes() == OLD
        finally:
            target.parent.chmod(0o755)
