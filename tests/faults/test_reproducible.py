"""The same inputs give the same bytes: again, in another folder, time zone, locale and hash seed, and with two workers."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
QUICK = ("simulate-pif 3x3", "capture-sim", "white", "reconstruct", "score")
LONG = ("simulate-pif", "capture-sim exr", "simulate-response", "calibrate", "demux", "demux exr", "learn-dict", "reconstruct exr", "show")
STRANGE = {"TZ": "Pacific/Kiritimati", "LC_ALL": "C", "LANG": "C", "PYTHONHASHSEED": "77", "COLUMNS": "50", "OMP_NUM_THREADS": "1"}


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in LONG)])
def test_stages_repeat_their_bytes_anywhere(stages, tmp_path, campaign, name):
    source, steps = stages
    arguments, result = steps[name]
    whole = (source / result).read_bytes()
    for number in range(campaign(1, 5)):
        folder = tmp_path / ("another folder " * (number + 1)).strip()
        folder.mkdir()
        for path in source.iterdir():
            if path.is_file() and path.name != result:
                shutil.copy(path, folder)
                os.utime(folder / path.name, (1e9, 1e9 + number))
        environment = os.environ | STRANGE | {"PYTHONPATH": str(ROOT), "PYTHONHASHSEED": str(77 + number)}
        done = subprocess.run([sys.executable, "-m", "plenocli", *arguments, "-o", result], cwd=folder, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert (folder / result).read_bytes() == whole, number


@pytest.mark.parametrize("name", [pytest.param("demux", marks=pytest.mark.slow), "reconstruct"])
def test_workers_change_nothing(runner, stages, tmp_path, name):
    source, steps = stages
    arguments, _ = steps[name]
    for path in filter(Path.is_file, source.iterdir()):
        shutil.copy(path, tmp_path)
    suffix = Path(arguments[1]).suffix
    for copy in ("a", "b", "c"):
        shutil.copy(source / arguments[1], tmp_path / f"{copy}{suffix}")
    found = []
    for workers in (1, 2):
        outcome = runner.run([arguments[0], *(f"{c}{suffix}" for c in "abc"), *arguments[2:], "--workers", workers, "-o", f"out{workers}"], tmp_path, limit=240)
        assert outcome.code == 0, outcome
        found.append({p.name: p.read_bytes() for p in sorted((tmp_path / f"out{workers}").iterdir()) if p.is_file()})
    assert found[0] == found[1] and len(found[0]) >= 3
