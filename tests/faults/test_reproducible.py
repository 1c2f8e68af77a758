"""The same inputs give the same bytes: again, in another folder, time zone, locale and hash seed,
and with two workers; threads of the linear algebra change the last digits at most.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from plenocli.files.artefacts.reading import read_artefact
from tests.faults.harness import results

ROOT = Path(__file__).resolve().parents[2]
QUICK = ("simulate-pif 3x3", "capture-sim", "white", "reconstruct", "refocus", "score", "sweep")
LONG = (
    "simulate-pif",
    "capture-sim exr",
    "simulate-response",
    "calibrate",
    "demux",
    "demux exr",
    "learn-dict",
    "reconstruct exr",
    "show",
)
STRANGE = {
    "TZ": "Pacific/Kiritimati",
    "LC_ALL": "C",
    "LANG": "C",
    "PYTHONHASHSEED": "77",
    "COLUMNS": "50",
    "OMP_NUM_THREADS": "1",
}


def copy_inputs(source, folder, result):
    """Copy all files of a folder but a stage's result; the copies."""
    made = results(source / result, result)
    return [
        Path(shutil.copy(path, folder))
        for path in source.iterdir()
        if path.is_file() and path.name not in made
    ]


@pytest.mark.parametrize(
    "name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in LONG)]
)
def test_stages_repeat_their_bytes_anywhere(stages, tmp_path, campaign, count, name):
    source, steps = stages
    arguments, result = steps[name]
    runs = campaign(1, 5)
    for number in range(runs):
        folder = tmp_path / ("another folder " * (number + 1)).strip()
        folder.mkdir()
        for path in copy_inputs(source, folder, result):
            os.utime(path, (1e9, 1e9 + number))
        environment = (
            os.environ | STRANGE | {"PYTHONPATH": str(ROOT), "PYTHONHASHSEED": str(77 + number)}
        )
        done = subprocess.run(
            [sys.executable, "-m", "plenocli", *arguments, "-o", result],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        assert results(folder / result, result) == results(source / result, result), number
    count("stages run again elsewhere", runs=runs, other_bytes=0)


@pytest.mark.slow
def test_the_run_that_compiles_gives_the_bytes_of_all_later_ones(tmp_path, count):
    """Compiled code comes from a cache but for the first time, where all that was compiled on
    the way is in memory beside it.
    """
    pytest.importorskip("numba")
    code = (
        "import sys, numpy as np\n"
        "from plenocli.inverse.sparse.l1.solve import sparse_code\n"
        "rng = np.random.default_rng(1)\n"
        "fall = np.logspace(0, -4, 30)[:, None]\n"
        "D, Y = rng.standard_normal((30, 80)) * fall, rng.standard_normal((30, 64)) * fall\n"
        "sys.stdout.write(sparse_code(D, Y, 1e-4, free=[0], workers=1).c.tobytes().hex())\n"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path)}
    first, later = (
        subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for _ in range(2)
    )
    assert first == later and any(tmp_path.rglob("*.nbc"))
    count("compiled and cached code", programs=1, other_bytes=0)


THREADS = 1e-12
"""Largest difference between results of one and of two threads of the linear algebra, relative
to the largest value of a dataset.
"""
OTHER_UNITS = {
    "grid/centre": 2e-6,
    "grid/residual": 2e-6,
    "worst_gap": 1e-11,
    "step_residual": 1e-11,
}
"""Largest difference of other kind, by the end of a dataset's name: places of superpixels, px, are
found in single precision; a gap and a residual are differences of what is nearly equal, relative to
it, and have its rounding.
"""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == "simulate-response" else pytest.mark.slow)
        for name in (*QUICK, *LONG)
    ],
)
def test_threads_of_the_linear_algebra_change_the_last_digits_at_most(
    stages, tmp_path, count, name
):
    source, steps = stages
    arguments, result = steps[name]
    copy_inputs(source, tmp_path, result)
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "2",
        "OPENBLAS_NUM_THREADS": "2",
    }
    done = subprocess.run(
        [sys.executable, "-m", "plenocli", *arguments, "-o", result],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    one, two = source / result, tmp_path / result
    worst = 0.0 if one.read_bytes() == two.read_bytes() else largest_difference(one, two)
    assert worst <= 1
    count(
        "stages with one and two threads of linear algebra",
        stages=1,
        other_bytes=int(worst > 0),
        beyond_the_bound=0,
    )


def largest_difference(one, two):
    """Of two artefacts of one stage, over what it may be; infinite where anything but numbers
    differs.
    """
    one, two = (read_artefact(path).data for path in (one, two))
    if one.keys() != two.keys():
        return np.inf
    found = [0.0]
    for name, values in one.items():
        if values.dtype.kind != "f":
            found.append(0.0 if np.array_equal(values, two[name]) else np.inf)
        elif values.size and not np.array_equal(values, two[name], equal_nan=True):
            other = [most for end, most in OTHER_UNITS.items() if name.endswith(end)]
            allowed = other[0] if other else THREADS * np.nanmax(np.abs(values))
            found.append(
                float(np.nanmax(np.abs(values - two[name])) / allowed)
                if np.array_equal(np.isnan(values), np.isnan(two[name]))
                else np.inf
            )
    return max(found)


@pytest.mark.parametrize(
    "name", ["sweep", "simulate-pif 3x3", pytest.param("learn-dict", marks=pytest.mark.slow)]
)
def test_workers_of_one_result_change_nothing(runner, stages, tmp_path, count, name):
    source, steps = stages
    arguments, result = steps[name]
    copy_inputs(source, tmp_path, result)
    outcome = runner.run([*arguments, "--workers", 2, "-o", result], tmp_path, limit=240)
    assert outcome.code == 0 and results(tmp_path / result, result) == results(
        source / result, result
    ), outcome
    count("stages with two workers", stages=1, other_bytes=0)


@pytest.mark.parametrize("name", [pytest.param("demux", marks=pytest.mark.slow), "reconstruct"])
def test_workers_of_a_batch_change_nothing(runner, stages, tmp_path, count, name):
    source, steps = stages
    arguments, _ = steps[name]
    for path in filter(Path.is_file, source.iterdir()):
        shutil.copy(path, tmp_path)
    suffix = Path(arguments[1]).suffix
    for copy in ("a", "b", "c"):
        shutil.copy(source / arguments[1], tmp_path / f"{copy}{suffix}")
    found = []
    for workers in (1, 2):
        outcome = runner.run(
            [
                arguments[0],
                *(f"{c}{suffix}" for c in "abc"),
                *arguments[2:],
                "--workers",
                workers,
                "-o",
                f"out{workers}",
            ],
            tmp_path,
            limit=240,
        )
        assert outcome.code == 0, outcome
        found.append(
            {
                p.name: p.read_bytes().replace(f"out{workers}".encode(), b"out")
                for p in sorted((tmp_path / f"out{workers}").iterdir())
                if p.is_file()
            }
        )
    assert found[0] == found[1] and len(found[0]) >= 3
    count("stages with two workers", stages=1, other_bytes=0)
