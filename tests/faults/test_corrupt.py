"""Damaged files of every kind that a command reads: a message and exit 3, never a traceback, a
crash, a hang or a result.

What has a digest (our artefacts, EXR and DNG) is never read wrongly; for other people's formats
damage to values may go unseen, and the file says so ("verified": false).
"""

import json

import numpy as np
import pytest

from tests.faults.harness import is_clean_refusal, mutants

CONFIGS = {
    "camera.toml": ["simulate-pif", "X", "--explain"],
    "colour.toml": ["simulate-response", "X", "--model", "ray", "-o", "out.h5"],
    "scene.toml": ["simulate-pif", "camera.toml", "--explain", "--scene", "X"],
}
STORED = {
    "pif.h5": ["capture-sim", "camera.toml", "--scene", "photo.png", "--pif", "X", "-o", "out.h5"],
    "shards.h5": ["reconstruct", "capture.h5", "--pif", "X", "-o", "out.h5"],
    "shards.000.h5": ["reconstruct", "capture.h5", "--pif", "shards.h5", "-o", "out.h5"],
    "capture.h5": ["reconstruct", "X", "--pif", "pif.h5", "-o", "out.h5"],
    "calibration.h5": ["demux", "colorchecker.dng", "--calibration", "X", "-o", "out.exr"],
    "spectra.h5": ["score", "X", "--truth", "colorchecker", "-o", "out.json"],
    "dictionary.h5": [
        "reconstruct",
        "capture.h5",
        "--pif",
        "pif.h5",
        "--method",
        "dictionary",
        "--dictionary",
        "X",
        "-o",
        "out.h5",
    ],
    "planes.h5": ["show", "X", "-o", "out.png"],
    "image.h5": ["score", "X", "--truth", "capture.h5", "-o", "out.json"],
}
SIGNED = {
    "capture.exr": ["reconstruct", "X", "--pif", "pif.h5", "-o", "out.h5"],
    "spectra.exr": ["score", "X", "--truth", "colorchecker", "-o", "out.json"],
    "white.dng": ["calibrate", "--white", "X", "-o", "out.h5"],
}
FOREIGN = {
    name: ["capture-sim", "camera.toml", "--scene", "X", "--pif", "pif.h5", "-o", "out.h5"]
    for name in ("photo.png", "photo.tif", "photo.jpg")
}


class Bench:
    """A folder in which one file is replaced by its mutants."""

    def __init__(self, runner, stages, tmp_path, name):
        source, _ = stages
        self.runner, self.folder, self.name, self.good = (
            runner,
            tmp_path,
            name,
            (source / name).read_bytes(),
        )
        for path in source.iterdir():
            if path.name != name:
                (tmp_path / path.name).symlink_to(path)
        self.before = {p.name for p in tmp_path.iterdir()} | {name}

    def run(self, content, command):
        (self.folder / self.name).write_bytes(content)
        outcome = self.runner.run(
            [self.name if word == "X" else word for word in command], self.folder, limit=10
        )
        assert (
            outcome.code >= 0
            and not outcome.hung
            and "Traceback" not in outcome.text
            and "internal error" not in outcome.text
        ), (self.name, command[0], outcome)
        left = {p.name for p in self.folder.iterdir()} - self.before
        for name in left:
            (self.folder / name).unlink()
        assert outcome.code == 0 or not left, (left, outcome)
        return outcome


def tell(count, tried, refused):
    count(
        "damaged files",
        files=tried,
        refused=refused,
        crashes=0,
        hangs=0,
        results_left=0,
        silent_wrong_reads_of_artefacts=0,
    )


def seed_of(name):
    return np.random.default_rng(list(name.encode()))


@pytest.mark.parametrize("name", STORED)
def test_no_damaged_artefact_is_read(runner, stages, tmp_path, campaign, count, name):
    bench, tried = Bench(runner, stages, tmp_path, name), 0
    for number, bad in enumerate(mutants(bench.good, campaign(8, 450), seed_of(name))):
        command = STORED[name] if number % 4 == 0 else ["inspect", "X"]
        assert is_clean_refusal(bench.run(bad, command), 3, name), number
        tried += 1
    tell(count, tried, tried)


@pytest.mark.parametrize("name", SIGNED)
def test_a_digest_in_the_file_finds_every_change_of_values(
    runner, stages, tmp_path, campaign, count, name
):
    bench, refused = Bench(runner, stages, tmp_path, name), 0
    intact = json.loads(bench.run(bench.good, ["inspect", "X", "--json"]).text)
    assert intact["verified"]
    for number, bad in enumerate(mutants(bench.good, campaign(12, 600), seed_of(name))):
        outcome = bench.run(bad, ["inspect", "X", "--json"])
        if outcome.code == 0:
            found = json.loads(outcome.text)
            same = all(
                found.get(key) == intact[key]
                for key in ("channels", "positions", "rows", "columns")
                if key in intact
            )
            assert same or not found["verified"], number
        else:
            assert is_clean_refusal(outcome, 3, name), (number, outcome)
            refused += 1
            bench.run(bad, SIGNED[name])
    assert refused > 0
    tell(count, number + 1, refused)


@pytest.mark.parametrize("name", FOREIGN)
def test_damaged_photographs_are_refused_or_read(runner, stages, tmp_path, campaign, count, name):
    bench, refused = Bench(runner, stages, tmp_path, name), 0
    for number, bad in enumerate(mutants(bench.good, campaign(12, 500), seed_of(name))):
        outcome = bench.run(bad, FOREIGN[name] if number % 4 == 0 else ["inspect", "X"])
        assert outcome.code == 0 or is_clean_refusal(outcome, 3, name), (number, outcome)
        refused += outcome.code == 3
    assert refused > 0
    tell(count, number + 1, refused)


@pytest.mark.parametrize("name", CONFIGS)
def test_damaged_descriptions_are_refused_with_their_name_or_are_other_cameras(
    runner, stages, tmp_path, campaign, count, name
):
    bench, refused = Bench(runner, stages, tmp_path, name), 0
    for number, bad in enumerate(mutants(bench.good, campaign(18, 600), seed_of(name))):
        outcome = bench.run(bad, CONFIGS[name])
        assert outcome.code in (0, 5) or is_clean_refusal(outcome, (2, 3), name), (number, outcome)
        refused += outcome.code in (2, 3)
    assert refused > 0
    tell(count, number + 1, refused)


def test_damaged_files_of_real_cameras_are_refused_or_read(
    runner, stages, tmp_path, campaign, count, shared_data
):
    real = [
        p
        for p in (shared_data / "raw").rglob("*")
        if p.suffix.lower() == ".nef" and runner.run(["inspect", p], tmp_path).code == 0
    ]
    if not real:
        pytest.skip("no NEF among the real data")
    refused = 0
    good, rng = min(real, key=lambda p: p.stat().st_size).read_bytes(), seed_of("NEF")
    for number, bad in enumerate(mutants(good, campaign(4, 400), rng)):
        # most of a RAW file is pixels: half of the mutants are hit in its tags
        if number % 2:
            bad = next(mutants(good[:20_000], 1, rng), good) + good[20_000:]
        (tmp_path / "real.NEF").write_bytes(bad)
        outcome = runner.run(["inspect", "real.NEF"], tmp_path, limit=20)
        assert not outcome.hung and (
            outcome.code == 0 or is_clean_refusal(outcome, 3, "real.NEF")
        ), (number, outcome)
        refused += outcome.code == 3
    tell(count, number + 1, refused)
