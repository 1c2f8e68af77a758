"""--mem-limit: a plan that needs more is refused with what would do, what it says it needs is what
it takes, and nobody takes more.

Memory is the most that a process of its own had resident, over what the same command takes on
the smallest camera.
"""

import json
import os
import re
import subprocess
import sys
import zlib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.memory import base_memory
from plenocli.base.tiling import InParts
from plenocli.cli.commands import COMMANDS, load_command
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.writing import write_artefact
from tests.faults.test_bombs import _png
from tests.peak import PEAK

ROOT = Path(__file__).resolve().parents[2]
TINY = (ROOT / "sample_configs" / "tiny.toml").read_text()
WATCHED = (
    "import sys; from plenocli.cli.main import run; code = run(sys.argv[1:])\n"
    f"peak = {PEAK}\n"
    "print(f'\\nend {code} {peak << 10}')"
)
SIZES = {
    "simulate-pif": (24, 28, 32),
    "capture-sim": (60, 90, 120),
    "refocus": (45, 60, 120),
    "reconstruct": (32, 36, 40),
    "learn-dict": (24, 28, 32),
}
CASES = [
    pytest.param(
        stage, size, marks=() if (stage, size) == ("capture-sim", 60) else pytest.mark.slow
    )
    for stage, sizes in SIZES.items()
    for size in sizes
]
BLOCKS = ("simulate-pif", "reconstruct", "learn-dict")
"""Stages whose memory goes by the size of a superpixel and of its object, not by the
number of lenslets.
"""


def watched(folder, *arguments):
    """(exit code, most bytes resident, stdout, stderr) of a command in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", WATCHED, *map(str, arguments)],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    said, _, end = done.stdout.rpartition("\nend ")
    code, peak = end.split()
    return int(code), int(peak), said, done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("memory")


def camera(folder, stage, size):
    """Name of a camera whose size grows with `size`: of the matrix for BLOCKS,
    else of the array.
    """
    pixels, count = (size, 9 if stage == "simulate-pif" else 5) if stage in BLOCKS else (16, size)
    name = f"{stage}-{size}.toml"
    (folder / name).write_text(
        TINY.replace("[8, 8]", f"[{pixels}, {pixels}]")
        .replace("[13, 13]", f"[{pixels}, {pixels}]")
        .replace("[5, 5]", f"[{count}, {count}]")
        .replace('pixel_pitch = "2 um"', f'pixel_pitch = "{26 / pixels} um"')
    )
    return name


def command(folder, stage, size):
    """Arguments of a stage on the camera of a size, its inputs made."""
    name = camera(folder, stage, size)
    if stage == "simulate-pif":
        return [
            "simulate-pif",
            name,
            "--superpixels",
            "5x5",
            "--coherent-ring",
            "0",
            "--model",
            "ray",
            "-o",
            "out.h5",
            "--overwrite",
        ]
    pif, capture = (f"{stage}-{size}-{what}.h5" for what in ("pif", "capture"))
    take = [
        "capture-sim",
        name,
        "--pif",
        pif,
        "--scene",
        "skimage:astronaut",
        "--snr",
        "50dB",
        "--overwrite",
    ]
    steps = [
        [
            "simulate-pif",
            name,
            "--superpixels",
            "1x1",
            "--coherent-ring",
            "0",
            *(["--model", "ray"] if stage in BLOCKS else []),
            "-o",
            pif,
        ],
        [*take, "-o", capture],
    ]
    for step in steps[: {"capture-sim": 1, "learn-dict": 1, "refocus": 2, "reconstruct": 2}[stage]]:
        if not (folder / step[-1]).exists():
            assert watched(folder, *step)[0] == 0
    return {
        "capture-sim": [*take, "-o", "out.h5"],
        "refocus": ["refocus", capture, "--planes", "3", "-o", "out.h5", "--overwrite"],
        "reconstruct": [
            "reconstruct",
            capture,
            "--pif",
            pif,
            "--method",
            "lmmse",
            "-o",
            "out.h5",
            "--overwrite",
        ],
        "learn-dict": [
            "learn-dict",
            "--pif",
            pif,
            "--lambda",
            "1e-5",
            "--iterations",
            "1",
            "--workers",
            "1",
            "-o",
            "out.h5",
            "--overwrite",
        ],
    }[stage]


@cache
def least(folder, stage):
    """What the smallest problem takes, bytes resident."""
    return watched(folder, *command(folder, stage, 5))[1]


def in_bytes(text):
    number, unit = re.fullmatch(r"([\d.]+)(MiB|GiB)", text).groups()
    return float(number) * {"MiB": 2**20, "GiB": 2**30}[unit]


@pytest.mark.parametrize("stage, size", CASES)
def test_what_is_needed_is_what_is_said_and_less_is_refused(folder, count, stage, size):
    arguments = command(folder, stage, size)
    # with the limit below, inputs can be read, so that the plan is made
    code, peak, said, error = watched(
        folder,
        *arguments,
        "--mem-limit",
        {"simulate-pif": "1MiB", "reconstruct": "40MiB"}.get(stage, "26MiB"),
    )
    assert code == 5 and peak < least(folder, stage) + (100 << 20), error
    # a limit that holds a part of the matrix, as the refusal says it: it is written in pieces
    if stage == "simulate-pif":
        pieces = int(in_bytes(re.search(r"raise --mem-limit to (\S+)", error)[1]))
        rest = [*arguments[:-3], "-o", "shards.h5", "--overwrite", "--mem-limit", f"{pieces}B"]
        code, peak, *_ = watched(folder, *rest)
        assert code == 0 and peak <= pieces + base_memory()
        assert peak - least(folder, stage) <= 1.2 * pieces
        needed = json.loads(watched(folder, *arguments[:-3], "--explain", "--json")[2])["memory"]
        assert pieces < 0.8 * needed
    else:
        needed = in_bytes(re.search(r"needs about (\S+),", error)[1])
        assert in_bytes(re.search(r"raise --mem-limit to (\S+)", error)[1]) == pytest.approx(
            1.05 * needed, rel=0.01
        )
        assert watched(folder, *arguments, "--mem-limit", f"{int(0.9 * needed)}B")[0] == 5
    limit = int(1.05 * needed)
    code, peak, *_ = watched(
        folder, *arguments, *(["--mem-limit", f"{limit}B"] if stage != "simulate-pif" else [])
    )
    assert code == 0 and peak <= limit + base_memory()
    taken = peak - least(folder, stage)
    assert 0.8 * needed <= taken <= 1.2 * needed, (needed, taken)
    count(
        "--mem-limit, the estimate against what was taken", sizes=1, off_by_more_than_20_percent=0
    )


def test_nobody_gets_more_than_the_limit_and_the_base():
    code = (
        "import resource, numpy\n"
        "from plenocli.base.memory import base_memory, hold, limits_restored\n"
        "with limits_restored():\n"
        "    hold(100 << 20)\n"
        "    few = numpy.ones(90 << 17)\n"
        "    try:\n"
        "        numpy.ones((100 << 20) + base_memory() >> 3)\n"
        "        raise SystemExit('more than the limit')\n"
        "    except MemoryError: pass\n"
        "numpy.ones((100 << 20) + base_memory() >> 3)\n"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": str(ROOT)}
        ).returncode
        == 0
    )


@pytest.mark.parametrize(
    "words",
    [
        ["inspect", "image.h5"],
        ["show", "image.h5", "-o", "a.png"],
        ["view", "image.h5", "-o", "a.html"],
        ["score", "image.h5", "--truth", "capture.h5", "-o", "a.json"],
        ["refocus", "capture.h5", "-o", "a.h5"],
        ["reconstruct", "capture.h5", "--pif", "pif.h5", "-o", "a.h5"],
        ["learn-dict", "photo.png", "--pif", "pif.h5", "-o", "a.h5"],
        ["capture-sim", "camera.toml", "--scene", "photo.png", "-o", "a.h5"],
        ["simulate-pif", "camera.toml", "-o", "a.h5"],
        ["simulate-response", "colour.toml", "--grid", "calibration.h5", "-o", "a.h5"],
        ["calibrate", "--white", "white.dng", "-o", "a.h5"],
        ["calibrate", "--white", "zeros.png", "-o", "a.h5"],
        ["demux", "colorchecker.dng", "--calibration", "calibration.h5", "-o", "a.h5"],
        ["report", ".", "-o", "a.html"],
        ["colorchecker", ".", "-o", "a.h5"],
        ["sweep", "designs.toml", "-o", "b.h5"],
    ],
    ids=lambda w: w[0],
)
def test_every_command_refuses_what_cannot_fit(runner, stages, tmp_path, words):
    source, _ = stages
    for path in source.iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / "zeros.png").write_bytes(png_of_zeros(3000))
    (tmp_path / "chart_550nm_25ms.png").symlink_to(source / "photo.png")
    outcome = runner.run([*words, "--mem-limit", "1KiB"], tmp_path)
    assert (
        outcome.code == 5
        and "raise --mem-limit" in outcome.text
        and not (tmp_path / "a.h5").exists()
    ), outcome
    assert outcome.cpu < 2


def test_every_command_has_the_option():
    for name in COMMANDS:
        found = load_command(name)
        for one in getattr(found, "commands", {"": found}).values():
            assert "--mem-limit" in {flag for p in one.params for flag in p.opts}, (name, one.name)


def png_of_zeros(size):
    """A whole PNG of (size, size) zeros of 16 bits, a thousandth of what it declares."""
    return _png(size, size, zlib.compress(bytes(size * (1 + 2 * size)), 9), bits=16, colours=0)


def test_a_small_file_of_a_huge_picture_is_refused_before_it_is_decoded(runner, tmp_path):
    """In calibrate it once took 18.7 GB."""
    content = png_of_zeros(8000)
    (tmp_path / "zeros.png").write_bytes(content)
    assert len(content) < 130_000
    arguments = ["calibrate", "--white", "zeros.png", "-o", "a.h5", "--mem-limit", "120MiB"]
    outcome = runner.run(arguments, tmp_path)
    assert outcome.code == 5 and outcome.grown < 20e6 and outcome.cpu < 1, outcome
    assert "zeros.png: needs about 130MiB to be read, more than the limit of 120MiB" in outcome.text
    outcome = runner.run([*arguments[:-1], "400MiB"], tmp_path)
    assert outcome.code == 5 and outcome.grown < 400e6, outcome
    assert "zeros.png: finding the lenslets needs about 1.44GiB, more than the" in outcome.text


def even_noise(side, level):
    """(side, side) up to a level, drawn row by row, in steps that compress fast."""

    def parts():
        rng = np.random.default_rng(3)
        yield from (level / 256 * rng.integers(0, 257, (1, side)) for _ in range(side))

    return InParts(shape=(side, side), dtype=np.float64, parts=parts)


def test_pictures_are_scored_and_drawn_in_the_memory_of_a_part_of_them(folder):
    """Five megapixels, 150 MB of values, take hardly more than one: no array of them all, 30 MB."""
    peaks = {}
    for side in (1100, 2200):
        true, value, sigma = (even_noise(side, level) for level in (1.0, 0.875, 0.125))
        scene = replace(true, shape=(1, side, side))
        data = {"capture/mosaic": true, "capture/scene": scene, "capture/cfa": "mono"}
        found = {"image/value": value, "image/sigma": sigma}
        for name, kind, values in (("truth", "capture", data), ("result", "image", found)):
            made = Artefact(kind, values, {}, Provenance(command="made up"))
            write_artefact(folder / f"{name}-{side}.h5", made)
        result, truth = f"result-{side}.h5", f"truth-{side}.h5"
        for number, arguments in enumerate(
            (
                ["score", result, "--truth", truth, "--block", "4x4", "-o", f"{side}.json"],
                ["show", result, "--truth", truth, "-o", f"beside-{side}.png"],
                ["show", truth, "-o", f"truth-{side}.png"],
            )
        ):
            code, peak, _, error = watched(folder, *arguments, "--mem-limit", "120MiB")
            assert code == 0, error
            peaks[number, side] = peak
        figures = json.loads((folder / f"{side}.json").read_text())["metrics"]
        assert figures["psnr_db"] == pytest.approx(10 * np.log10(64 * 3), abs=0.02)
    assert all(peaks[n, 2200] - peaks[n, 1100] < 20 << 20 for n in range(3))


@pytest.mark.parametrize("limit", [1, 10, 15])
def test_a_healthy_capture_is_told_what_it_needs_not_that_it_is_damaged(runner, tmp_path, limit):
    """HDF5 that gets no memory says that the file cannot be opened."""
    values = np.random.default_rng(0).random((1500, 1500))
    data = {"capture/mosaic": values, "capture/cfa": "mono"}
    write_artefact(
        tmp_path / "capture.h5", Artefact("capture", data, {}, Provenance(command="made up"))
    )
    outcome = runner.run(
        ["calibrate", "--white", "capture.h5", "-o", "a.h5", "--mem-limit", f"{limit}MiB"],
        tmp_path,
    )
    assert outcome.code == 5 and "capture.h5: needs about" in outcome.text, outcome
    assert "to be read, more than the limit of" in outcome.text


def test_hdf5_without_memory_is_no_damage(tmp_path):
    """Within the budget, but what else there is has taken the memory."""
    values = np.random.default_rng(0).random((2500, 2500))
    data = {"capture/mosaic": values, "capture/cfa": "mono"}
    write_artefact(
        tmp_path / "capture.h5", Artefact("capture", data, {}, Provenance(command="made up"))
    )
    code = (
        "import resource\n"
        "from plenocli.files.artefacts.reading import read_artefact\n"
        "used = int(open('/proc/self/statm').read().split()[5]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_DATA, (used + (30 << 20), used + (30 << 20)))\n"
        "try: read_artefact('capture.h5')\n"
        "except MemoryError: raise SystemExit(7)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 7
