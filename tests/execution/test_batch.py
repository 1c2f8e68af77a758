"""Batches of captures: killed without warning and run again, bad files among good ones,
threads, one writer.
"""

import csv
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import InputError, PlenoError
from plenocli.cli.main import run
from plenocli.execution.batch import outcomes, plan_batch, summarise
from plenocli.execution.pool import open_pool
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.read.captures import named_captures
from plenocli.stages.inverse.calibrate import run_calibrate
from plenocli.stages.inverse.demux import Settings, run_demux

PITCH, COUNT, FILES = 12, 9, 14


def capture(path, radiance, seed):
    """Lenslets with two bands, one a half, and noise."""
    y, x = np.indices((PITCH, PITCH)) - (PITCH - 1) / 2
    edge = np.clip((5.2 - np.abs(y)) / 1.5, 0, 1) * np.clip((5.2 - np.abs(x)) / 1.5, 0, 1)
    response = (
        1000 * edge[..., None] * np.where((x > 0)[..., None] == (np.arange(2) == 1), 0.97, 0.03)
    )
    image = np.einsum(
        "rcb,yxb->rycx", np.broadcast_to(radiance, (COUNT, COUNT, 2)), response
    ).reshape(COUNT * PITCH, -1)
    values = np.rint(100 + image + np.random.default_rng(seed).normal(0, 2.0, image.shape)).astype(
        np.uint16
    )
    attrs = dict(units="DN", black=100.0, white=4095.0, exposure_s=0.1, gain_e_per_dn=4.0)
    write_artefact(
        path,
        Artefact("capture", {"capture/mosaic": values, "capture/cfa": "mono"}, {"capture": attrs}),
    )
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Captures, a calibration, and the results of a run that nobody interrupted, in `whole`."""
    folder = tmp_path_factory.mktemp("batch")
    bands = [
        (w, capture(folder / f"b{k}.h5", np.eye(2)[k], k)) for k, w in enumerate((480e-9, 620e-9))
    ]
    run_calibrate(folder / "c.h5", whites=[capture(folder / "white.h5", 1.0, 5)], bands=bands)
    rng = np.random.default_rng(1)
    shots = [
        capture(folder / f"shot{i:02d}.h5", rng.uniform(0.1, 0.9, (COUNT, COUNT, 2)), 10 + i)
        for i in range(FILES)
    ]
    run_demux(shots, folder / "whole", calibration=folder / "c.h5", suffix=".exr")
    return folder


def shots(folder):
    return sorted(folder.glob("shot*.h5"))


def results(folder):
    """What came of the captures, beside the summary."""
    assert {p.name for p in folder.glob("summary.*")} == {"summary.csv", "summary.json"}
    return sorted(p for p in folder.iterdir() if p.stem != "summary")


@pytest.mark.parametrize("seed", range(4))
def test_a_run_that_is_killed_loses_nothing_and_repeats_nothing(folder, tmp_path, seed):
    """Killed at a random moment after a random number of results, then run again: the same
    bytes, finished files untouched.
    """
    rng, out = np.random.default_rng(seed), tmp_path / "out"
    code = (
        "from pathlib import Path; from plenocli.stages.inverse.demux import Settings, run_demux; "
        f"f = Path({str(folder)!r}); run_demux(sorted(f.glob('shot*.h5')), Path({str(out)!r}), "
        f"calibration=f / 'c.h5', suffix='.exr', workers={1 + seed % 2})"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", code],
        stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )
    wanted, deadline = int(rng.integers(1, FILES - 3)), time.monotonic() + 300
    while (
        child.poll() is None
        and time.monotonic() < deadline
        and len(list(out.glob("*.exr"))) < wanted
    ):
        time.sleep(0.001)
    time.sleep(rng.uniform(0, 0.05))
    os.killpg(child.pid, signal.SIGKILL)
    assert child.wait() == -signal.SIGKILL
    before = {p.name: p.stat().st_mtime_ns for p in out.glob("shot*.exr")}
    assert wanted <= len(before) < FILES
    for name in before:
        assert (out / name).read_bytes() == (folder / "whole" / name).read_bytes()
    report = run_demux(shots(folder), out, calibration=folder / "c.h5", suffix=".exr", workers=2)
    assert (report.done, report.skipped) == (FILES - len(before), len(before))
    assert all((out / name).stat().st_mtime_ns == stamp for name, stamp in before.items())
    # nothing half-written is left
    assert [p.name for p in results(out)] == [p.name for p in results(folder / "whole")]
    for path in results(out):
        assert path.read_bytes() == (folder / "whole" / path.name).read_bytes()


@pytest.mark.parametrize("suffix", [".exr", ".h5"])
def test_finished_results_of_another_recipe_stay_and_are_named(folder, tmp_path, suffix, capsys):
    def rerun(**settings):
        report = run_demux(
            shots(folder)[:3],
            tmp_path / "out",
            calibration=folder / "c.h5",
            suffix=suffix,
            settings=Settings(**settings),
        )
        return report.done, report.skipped, capsys.readouterr().err

    assert rerun()[:2] == (3, 0)
    assert rerun() == (0, 3, "")
    for other in (dict(method="pinv"), dict(register="off"), dict(reference=folder / "white.h5")):
        done, skipped, said = rerun(**other)
        assert (
            (done, skipped) == (0, 3)
            and "3 of 3 finished results" in said
            and "--overwrite" in said
        )
    (tmp_path / "out" / f"shot01{suffix}").write_bytes(b"torn")
    assert "1 of 3 finished results" in rerun()[2]


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_a_bad_file_stops_no_other(folder, tmp_path, workers, capsys):
    bad = tmp_path / "bad.h5"
    bad.write_bytes(shots(folder)[0].read_bytes()[:-40])
    files = [*shots(folder)[:3], bad, tmp_path / "missing.h5", *shots(folder)[3:6]]
    with pytest.raises(InputError, match="2 of 8 captures failed: bad.h5, missing.h5"):
        run_demux(
            files, tmp_path / "out", calibration=folder / "c.h5", suffix=".h5", workers=workers
        )
    assert [p.name for p in results(tmp_path / "out")] == [p.name for p in shots(folder)[:6]]
    err = capsys.readouterr().err
    assert str(bad) in err and "missing.h5" in err


def test_a_folder_is_the_captures_in_it(folder, tmp_path):
    """The calibration, a JPEG, notes, hidden files and folders among them are none."""
    for path in [*shots(folder)[:3], folder / "c.h5"]:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    for name in ("shot00.JPG", "notes.txt", ".hidden.h5"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "older.h5").mkdir()
    calibration, names = tmp_path / "c.h5", ["shot00.h5", "shot01.h5", "shot02.h5"]
    done = run_demux([tmp_path], tmp_path / "out", calibration=calibration)
    assert [Path(one.capture).name for one in done.captures] == names
    assert [path.stem for path in results(tmp_path / "out")] == [n[:-3] for n in names]
    again = run_demux([tmp_path], tmp_path / "out", calibration=calibration)
    assert (again.done, again.skipped) == (0, 3)
    pattern = [tmp_path / "shot0[12].h5", tmp_path / "shot01.h5"]
    assert [path.name for path in named_captures(pattern)] == names[1:]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="without captures"):
        run_demux([tmp_path / "empty"], tmp_path / "o", calibration=calibration)
    assert not (tmp_path / "o").exists()


def test_pictures_and_pages_take_folders_and_patterns(folder, tmp_path, capsys):
    shown = tmp_path / "s"
    shown.mkdir()
    for path in shots(folder)[:2]:
        (shown / path.name).write_bytes(path.read_bytes())
    for command, names, out in (("show", shown, "a.png"), ("view", shown / "shot*.h5", "a.html")):
        assert run([command, str(names), "-o", str(tmp_path / out), "--json"]) == 0
        made = json.loads(capsys.readouterr().out)
        assert [Path(file).name for file in made["files"]] == ["shot00.h5", "shot01.h5"]


def test_a_batch_that_fails_in_part_tells_one_document(folder, tmp_path, capsys):
    bad = tmp_path / "bad.h5"
    bad.write_bytes(shots(folder)[0].read_bytes()[:-40])
    asked = [*map(str, shots(folder)[:2]), str(bad), "--calibration", str(folder / "c.h5")]
    assert run(["demux", *asked, "-o", str(tmp_path / "out"), "--json"]) == 3
    told = json.loads(capsys.readouterr().out)
    assert (told["done"], told["skipped"]) == (2, 0)
    assert [one["capture"] for one in told["captures"]] == [p.name for p in shots(folder)[:2]]
    assert [one["capture"] for one in told["failed"]] == [str(bad)]
    assert str(bad) in told["failed"][0]["error"]


def test_a_summary_has_a_row_for_every_capture(folder, tmp_path):
    """Of runs that fail in part and of those that find most done, too."""
    bad, out = tmp_path / "bad.h5", tmp_path / "out"
    bad.write_bytes(shots(folder)[0].read_bytes()[:-40])

    def rows(count):
        with pytest.raises(InputError, match=f"1 of {count + 1} captures failed"):
            run_demux([*shots(folder)[:count], bad], out, calibration=folder / "c.h5")
        with open(out / "summary.csv", newline="") as stream:
            table = list(csv.DictReader(stream))
        found = json.loads((out / "summary.json").read_text())["captures"]
        assert [row["capture"] for row in table] == [row["capture"] for row in found]
        return found

    first, again = rows(2), rows(3)
    assert [row["state"] for row in first] == ["done", "done", "failed"]
    assert [row["state"] for row in again] == ["finished before"] * 2 + ["done", "failed"]
    assert again[0]["mean"] == first[0]["mean"] and str(bad) in again[-1]["error"]


@dataclass
class Number:
    """A report."""

    value: int

    def as_json(self):
        return {"value": self.value}


def test_work_overlaps_writing_does_not_and_few_results_wait(tmp_path):
    """Work of several captures at the same time, in other threads; writing in this one, and
    reports in the order of captures.
    """
    captures = [tmp_path / f"{i:02d}.x" for i in range(12)]
    batch = plan_batch(
        captures, tmp_path / "out", ".h5", "numbers are", overwrite=False, inputs=captures
    )
    both, held, most = threading.Barrier(2), [], [0]

    def work(capture):
        both.wait(10)  # passes only if two work at the same time
        held.append(capture)
        if capture.stem == "07":
            raise InputError("is bad", capture)
        return threading.get_ident()

    def write(thread, capture, target):
        assert (
            thread != threading.get_ident()
            and threading.current_thread() is threading.main_thread()
        )
        most[0] = max(most[0], len(held))
        held.remove(capture)
        return Number(int(capture.stem))

    with open_pool(2, threads=True) as pool:
        ended = list(outcomes(batch, pool, work, write))
    assert len(ended) == 12 and most[0] <= 4
    with pytest.raises(PlenoError, match="1 of 12 captures failed: 07.x"):
        summarise(batch, ended)
    good = [pair for pair in ended if pair[0].stem != "07"]
    told = summarise(batch, reversed(good)).reports
    assert [one.value for one in told] == [i for i in range(12) if i != 7]


def test_a_fault_of_ours_ends_the_batch_with_its_traceback(tmp_path):
    captures = [tmp_path / f"{i}.x" for i in range(4)]
    batch = plan_batch(
        captures, tmp_path / "out", ".h5", "numbers are", overwrite=False, inputs=captures
    )
    with pytest.raises(ZeroDivisionError), open_pool(2, threads=True) as pool:
        list(outcomes(batch, pool, lambda capture: 1 / 0, lambda *_: None))
