"""Streams that are closed or full, names that are no text, folders that cannot be written, caches
and cluster files that are damaged: no result is lost and nothing is taken for a bug.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults.harness import is_clean_refusal

ROOT = Path(__file__).resolve().parents[2]
PICTURE = "reconstruct capture.h5 --pif pif.h5 --method tikhonov -o out.h5".split()
LEARN = "learn-dict photo.png --pif pif.h5 --atoms 80 --batch 64 --iterations 2 -o out.h5".split()


@pytest.fixture
def folder(stages, tmp_path):
    """A folder of copies of all samples."""
    for path in stages[0].iterdir():
        if path.is_file():
            shutil.copy(path, tmp_path)
    return tmp_path


def shell(command, cwd, **environment):
    """(exit code, stdout, stderr), bytes, of a bash line in which "plenocli" is the program."""
    kept = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | environment
    kept = {k: v for k, v in kept.items() if v is not None}
    line = f'set -o pipefail; plenocli() {{ "{sys.executable}" -m plenocli "$@"; }}; {command}'
    done = subprocess.run(
        [b"bash", b"-c", os.fsencode(line)], cwd=cwd, env=kept, capture_output=True, timeout=120
    )
    return done.returncode, done.stdout, done.stderr


# --- streams --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "redirected, codes",
    [
        pytest.param(">&-", (0,), marks=pytest.mark.slow),
        pytest.param("2>&-", (0,), marks=pytest.mark.slow),
        (">&- 2>&-", (0,)),
        ("| true", (0,)),
        ("2> /dev/full", (0,)),
        ("> /dev/full", (4,)),
        pytest.param("> /dev/full 2> /dev/full", (4,), marks=pytest.mark.slow),
        ("1< /dev/null", (4,)),
        pytest.param("< /dev/null", (0,), marks=pytest.mark.slow),
        ("<&-", (0,)),
    ],
)
def test_a_result_does_not_depend_on_who_reads_the_summary(folder, redirected, codes):
    command = f"plenocli -v {' '.join(PICTURE)} --json {redirected}"
    code, said, error = shell(command, folder)
    assert code in codes, (code, said, error)
    assert b"Traceback" not in error and b"internal error" not in error
    assert b"Exception ignored" not in error
    assert code == 0 or not error or b"standard output: cannot be written" in error
    assert (folder / "out.h5").read_bytes() == (folder / "image.h5").read_bytes()


@pytest.mark.parametrize("command", ["--help", "inspect image.h5", "schema camera", "demux --help"])
@pytest.mark.parametrize(
    "redirected, code", [("| true", 0), ("> /dev/full", 4), (">&-", 0), ("2>&-", 0)]
)
def test_what_is_only_printed(folder, command, redirected, code):
    found, _, error = shell(f"plenocli {command} {redirected}", folder)
    assert found == code and b"Traceback" not in error and b"internal error" not in error, error


@pytest.mark.parametrize("redirected", ["2>&-", "2> /dev/full"])
def test_a_refusal_keeps_its_exit_code_where_nobody_reads_it(folder, redirected):
    assert shell(f"plenocli inspect nothing.h5 {redirected}", folder)[0] == 3
    assert shell(f"plenocli inspect {redirected}", folder)[0] == 2


# --- names ----------------------------------------------------------------------------------------

NAMES = {
    "latin-1": b"caf\xe9",
    "escape": b"a\x1b[31mb\x1b]0;owned\x07c",
    "line": b"a\nb",
    "all": b"caf\xe9\x1b[31mb\x1b]0;owned\x07c\nb",
}
USES = {
    "simulate-pif camera.toml -o X.h5": "camera.toml",
    "capture-sim camera.toml --pif pif.h5 --scene photo.png -o X.h5": "photo.png",
    "capture-sim camera.toml --pif pif.h5 --scene photo.png -o X.exr": "photo.png",
    "capture-sim colour.toml --model ray --superpixels 1x1 --target white -o X.dng": "colour.toml",
    "demux colorchecker.dng --calibration calibration.h5 -o X.exr": "colorchecker.dng",
    "reconstruct capture.h5 --pif pif.h5 --method tikhonov -o X.h5": "capture.h5",
    "reconstruct capture.exr --pif pif.h5 --method tikhonov -o X.exr": "capture.exr",
    "score image.exr --truth capture.h5 -o X.json --report X.html": "image.exr",
    "score image.h5 --truth capture.h5 -o X.json --report X.html": "image.h5",
    "show image.h5 -o X.png": "image.h5",
    "inspect capture.exr": "capture.exr",
    "inspect --json spectra.h5": "spectra.h5",
    "inspect --json colorchecker.dng": "colorchecker.dng",
    "sweep designs.toml -o X.h5": "designs.toml",
    "learn-dict photo.tif --pif pif.h5 --atoms 80 --batch 64 --iterations 1 -o X.h5": "photo.tif",
    "report run -o X.html": "run",
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, id=what, marks=() if what == "all" else pytest.mark.slow)
        for what, name in NAMES.items()
    ],
)
@pytest.mark.parametrize("command, given", USES.items(), ids=[c.split(" -")[0] for c in USES])
def test_any_name_works_and_reaches_terminal_and_files_as_text(
    runner, folder, command, given, name
):
    """Inputs and outputs of names that are no UTF-8 or hold what controls a terminal."""
    (folder / "run").mkdir()
    shutil.copy(folder / "image.h5", folder / "run")
    shutil.copy(folder / "image.h5", os.fsencode(folder) + b"/run/" + name + b".h5")
    odd = os.fsdecode(name + os.path.splitext(given)[1].encode())
    os.rename(folder / given, folder / odd)
    words = [
        odd if w == given else w.replace("X", "o" + os.fsdecode(name)) for w in command.split()
    ]
    before = set(os.listdir(os.fsencode(folder)))
    outcome = runner.run(words, folder, limit=100)
    assert outcome.code == 0 and "Traceback" not in outcome.text, outcome
    said = outcome.text.encode("utf-8", "surrogateescape")
    made = [f for f in set(os.listdir(os.fsencode(folder))) - before if b".parts" not in f]
    assert len(made) == sum(w in ("-o", "--report") for w in words) + (words[0] == "sweep")
    contents = [(Path(os.fsdecode(os.fsencode(folder) + b"/" + f))).read_bytes() for f in made]
    for text in (said, *(c for f, c in zip(made, contents) if f.endswith((b"json", b"html")))):
        assert not set(range(32)) & (set(text) - {10}), text
        text.decode("utf-8")
    # a wrong use is refused with the name as text too
    refused = runner.run(["demux", odd, "--calibration", odd, "-o", odd], folder)
    assert refused.code in (2, 3, 4) and "internal error" not in refused.text, refused
    assert "\x1b" not in refused.text and "\x07" not in refused.text


# --- folders and caches ---------------------------------------------------------------------------


COMPILED = """
import sys, tempfile
real = tempfile.TemporaryFile
def refused(*arguments, **named):
    if named.get("dir") and "unwritable" in sys.argv:
        raise PermissionError(13, "Permission denied", named["dir"])
    return real(*arguments, **named)
tempfile.TemporaryFile = refused  # as numba asks whether a folder can be written; root always may
from plenocli.inverse.compiled import compiled
@compiled()
def plus(a, b):
    return a + b
print(plus(2, 3), *plus.stats.cache_hits.values())
"""


@pytest.fixture
def compiled(tmp_path):
    """compiled(*words): what a process prints that adds 2 and 3 by a compiled function, and how
    often its cache served.
    """
    pytest.importorskip("numba")
    (tmp_path / "plus.py").write_text(COMPILED)

    def run(*words):
        code, said, error = shell(
            f'"{sys.executable}" plus.py {" ".join(words)}', tmp_path, NUMBA_CACHE_DIR="cache"
        )
        assert code == 0, error
        return said.decode().split()

    return run


def test_where_no_cache_can_be_kept_functions_are_compiled_each_time(compiled):
    assert compiled("unwritable")[0] == "5"


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(b"", marks=pytest.mark.slow),
        pytest.param(b"\x80\x04noise", marks=pytest.mark.slow),
        None,
    ],
    ids=["empty", "noise", "cut"],
)
def test_a_damaged_cache_of_compiled_functions_is_made_anew(compiled, tmp_path, damage):
    assert [compiled(), compiled()] == [["5"], ["5", "1"]]
    (index,) = tmp_path.glob("cache/**/*.nbi")
    content = index.read_bytes()
    index.write_bytes(content[: len(content) // 2] if damage is None else damage)
    assert [compiled(), compiled()] == [["5"], ["5", "1"]]
    (data,) = tmp_path.glob("cache/**/*.nbc")
    data.write_bytes(b"" if damage is None else damage)
    assert compiled() == ["5"]


@pytest.mark.parametrize(
    "environment",
    [
        {"LANG": "C", "LC_ALL": "C"},
        {"TMPDIR": "/nowhere"},
        pytest.param({"HOME": "/nowhere"}, marks=pytest.mark.slow),
        {"HOME": None},
    ],
    ids=str,
)
def test_poor_environments(folder, environment):
    code, _, error = shell(f"plenocli {' '.join(PICTURE)}", folder, **environment)
    assert code == 0, error
    assert (folder / "out.h5").read_bytes() == (folder / "image.h5").read_bytes()


@pytest.mark.parametrize(
    "limit, code", [("-n 12", 0), ("-f 8", 4), ("-s 128", 0), ("-d 100000", 5), ("-c 0", 0)]
)
def test_limits_of_the_shell(folder, limit, code):
    """Files open, file size, stack, memory: done as always, or one message. (With a stack of 64 KiB
    Python itself ends in a segmentation fault before it reads a line of any program.)
    """
    found, _, error = shell(f"ulimit {limit}; plenocli {' '.join(PICTURE)}", folder)
    assert found == code and b"Traceback" not in error and b"internal error" not in error, error
    done = (folder / "out.h5").exists()
    assert done == (code == 0)
    assert not done or (folder / "out.h5").read_bytes() == (folder / "image.h5").read_bytes()


@pytest.mark.parametrize(
    "content", [b"", b'{"type": "Scheduler", "addr', b"{}", b"[1]", b'{"address": 3}', b"\xff\xfe"]
)
def test_a_half_written_file_of_a_dask_scheduler(runner, folder, content):
    pytest.importorskip("distributed")
    (folder / "scheduler.json").write_bytes(content)
    outcome = runner.run(
        ["sweep", "designs.toml", "--scheduler", "scheduler.json", "-o", "s.h5"], folder
    )
    assert is_clean_refusal(outcome, 2, "--scheduler", "scheduler.json", "no whole file"), outcome


GONE = """
import shutil, sys
from plenocli.stages.sweep import store
real, done = store.Store.evaluate, []
def removing(self, *arguments, **named):
    shutil.rmtree({folder!r})
    return real(self, *arguments, **named)
store.Store.evaluate = removing
from plenocli.cli.main import main
main(["sweep", "designs.toml", "-o", "s.h5", *sys.argv[1:]])
"""


@pytest.mark.parametrize("workers", [[], ["--workers", "2"]])
def test_a_working_directory_that_is_removed_during_a_sweep(folder, tmp_path_factory, workers):
    place = tmp_path_factory.mktemp("gone") / "here"
    shutil.copytree(folder, place)
    script = tmp_path_factory.mktemp("script") / "gone.py"
    script.write_text(GONE.format(folder=str(place)))
    code, said, error = shell(f'"{sys.executable}" {script} {" ".join(workers)}', place)
    assert code in (3, 4) and b"Traceback" not in error and b"internal error" not in error, error
    place.mkdir()
    (place / "x").mkdir()
    code, said, error = shell("rmdir ../x; plenocli inspect a.h5", place / "x")
    assert code == 3 and b"internal" not in error, error
