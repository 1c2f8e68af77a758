"""Captures larger than a tile: the same pictures as in one piece, whatever works on them."""

import json
import os
import shutil
import subprocess
import sys
import time
from contextlib import nullcontext

import numpy as np
import pytest

from plenocli.base.budget import Budget, budget, within
from plenocli.base.errors import NumericsError
from plenocli.cli.main import run
from plenocli.evaluation.metrics.quality import psnr
from plenocli.execution.pool import InProcess
from plenocli.files.artefacts.reading import Stored, read_artefact
from plenocli.files.read import captures
from plenocli.inverse.picture import tiles
from plenocli.inverse.picture.estimate import estimate
from plenocli.inverse.picture.solvers import block_matching
from plenocli.stages.inverse.reconstruct import in_tiles, one_capture
from plenocli.stages.inverse.reconstruct import run as stage
from plenocli.stages.inverse.reconstruct.recipe import Settings, recipe_of
from tests.stages import test_reconstruct
from tests.stages.test_reconstruct import N, make_files

COUNT, SIDE = 24, 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Captures of 24 x 24 lenslets, alone and with neighbours' light, and their truths."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(test_reconstruct, "COUNT", COUNT)
        made = tmp_path_factory.mktemp("tiles")
        truths = {}
        for name, coupled in (("alone", False), ("coupled", True)):
            (made / name).mkdir()
            truths[name] = make_files(made / name, coupled=coupled, noise=40.0)
    return made, truths


@pytest.fixture
def small_tiles(monkeypatch):
    """Tiles of 12 x 12 lenslets, for these captures."""
    monkeypatch.setattr(tiles, "AT_ONCE", SIDE**2 * (81 + 36 + tiles.FURTHER))


def picture(folder, output, *options, method):
    command = ["reconstruct", str(folder / "capture.h5"), "--pif", str(folder / "pif.h5")]
    assert run([*command, "--method", method, "-o", str(output), "--overwrite", *options]) == 0
    return read_artefact(output, "image")


def jumps(error, at):
    """Mean difference of the error across the borders of lenslets `at`, rows and columns."""
    across = [np.abs(e[at] - e[at - 1]).mean(axis=1) for e in (error, error.T)]
    return float(np.mean(across))


@pytest.mark.parametrize(
    "name, method",
    [
        ("alone", "block-mean"),
        ("alone", "tikhonov"),
        ("alone", "lmmse"),
        ("coupled", "tsvd"),
        ("coupled", "lmmse"),
        ("alone", "weighted"),
        pytest.param("coupled", "weighted", marks=pytest.mark.slow),
        pytest.param("alone", "pnp", marks=pytest.mark.slow),
        pytest.param("coupled", "tv", marks=pytest.mark.slow),
        pytest.param("coupled", "pnp", marks=pytest.mark.slow),
        pytest.param("alone", "auto", marks=pytest.mark.slow),
    ],
)
def test_tiles_give_the_picture_of_the_whole(folder, tmp_path, monkeypatch, name, method):
    made, truths = folder
    whole = picture(made / name, tmp_path / "whole.h5", method=method)
    monkeypatch.setattr(tiles, "AT_ONCE", SIDE**2 * (81 + 36 + tiles.FURTHER))
    tiled = picture(made / name, tmp_path / "tiled.h5", method=method)
    one, two = (found.data["image/value"] for found in (whole, tiled))
    truth = truths[name]
    assert two.shape == one.shape == truth.shape
    # the veil that this camera seems to have, by chance, may be told less of by 144 lenslets
    assert psnr(two, truth) > psnr(one, truth) - 0.1
    assert np.mean((two - one) ** 2) < 0.25 * np.mean((one - truth) ** 2)
    borders = np.arange(1, COUNT) * N
    at = borders[borders % (SIDE * N) == 0]
    near = np.array([b for b in borders if b not in at and min(abs(b - at)) <= 3 * N])
    seam = [jumps(p - truth, at) / jumps(p - truth, near) for p in (one, two)]
    assert seam[1] < 1.1 * seam[0]
    if "image/sigma" in whole.data:
        ratio = np.mean(tiled.data["image/sigma"]) / np.mean(whole.data["image/sigma"])
        assert 0.8 < ratio < 1.25
    told = tiled.attrs["image"]["parameters"]
    veil = {"veil"}  # of this camera it is a matter of chance
    assert told.keys() - veil == whole.attrs["image"]["parameters"].keys() - veil
    if method in ("tv", "pnp"):  # nine squares told it to a tenth
        one, two = (
            float(f.attrs["image"]["parameters"]["start"].split()[-1]) for f in (whole, tiled)
        )
        assert two == pytest.approx(one, rel=0.02)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["tiled.h5", "whole.h5"]


@pytest.mark.parametrize("method", ["tikhonov", "tsvd"])
def test_hindsight_is_that_of_the_whole(folder, tmp_path, monkeypatch, method):
    """Weights by the error of all tiles together."""
    made, truths = folder
    truth = "--truth", str(made / "coupled/capture.h5")
    whole = picture(made / "coupled", tmp_path / "whole.h5", *truth, method=method)
    monkeypatch.setattr(tiles, "AT_ONCE", SIDE**2 * (81 + 36 + tiles.FURTHER))
    tiled = picture(made / "coupled", tmp_path / "tiled.h5", *truth, method=method)
    told = [f.attrs["image"]["parameters"] for f in (whole, tiled)]
    name = "alpha" if method == "tikhonov" else "rank"
    assert told[0]["rule"] == told[1]["rule"] and "oracle" in told[0]["rule"]
    assert told[1][name] == pytest.approx(told[0][name], rel=0.02)
    one, two = (psnr(f.data["image/value"], truths["coupled"]) for f in (whole, tiled))
    assert two == pytest.approx(one, abs=0.1)


@pytest.mark.parametrize(
    ("kind", "method"),
    [("coupled", "lmmse"), ("alone", "lmmse"), ("alone", "tv"), ("alone", "weighted")],
)
def test_results_do_not_depend_on_workers(folder, tmp_path, small_tiles, kind, method):
    # threads of lmmse, processes of the others
    made, _ = folder
    for workers in ("1", "2"):
        found = picture(
            made / kind, tmp_path / f"{workers}.h5", "--workers", workers, method=method
        )
        assert found.data["image/value"].shape == (COUNT * N, COUNT * N)
    assert (tmp_path / "1.h5").read_bytes() == (tmp_path / "2.h5").read_bytes()


@pytest.mark.parametrize("method", ["lmmse", "pnp"])
def test_workers_of_a_single_tile_change_no_byte(folder, tmp_path, monkeypatch, method):
    made, threads = folder[0], []

    def watched(*arguments, **options):
        threads.append(budget().threads)
        return estimate(*arguments, **options)

    monkeypatch.setattr(block_matching, "TOGETHER", 60)
    monkeypatch.setattr(one_capture, "estimate", watched)
    for workers in ("1", "2"):
        name = tmp_path / f"{workers}.h5"
        picture(made / "coupled", name, "--workers", workers, method=method)
    assert threads == [1, 2]
    assert (tmp_path / "1.h5").read_bytes() == (tmp_path / "2.h5").read_bytes()


def test_threads_are_as_many_as_the_memory_holds(folder, monkeypatch, tmp_path, small_tiles):
    made, _ = folder
    recipe = recipe_of(
        Settings(method="lmmse", workers=4), made / "coupled/pif.h5", None, True, elsewhere=False
    )
    found = []
    for kibibytes in np.geomspace(1 << 8, 1 << 17, 60):
        with within(Budget(int(kibibytes * 1024))):
            found.append(in_tiles.tiles_at_once(recipe))
    assert found == sorted(found) and set(found) == {1, 2, 3, 4}
    running, most, solve = [], [], in_tiles._TileTask.__call__

    def watched(self, job):
        running.append(job[0])
        most.append(len(running))
        done = solve(self, job)
        running.remove(job[0])
        return done

    monkeypatch.setattr(in_tiles._TileTask, "__call__", watched)
    monkeypatch.setattr(stage, "tiles_at_once", lambda recipe: 2)
    picture(made / "coupled", tmp_path / "two.h5", "--workers", "4", method="lmmse")
    assert max(most) == 2


def test_a_result_in_one_piece_leaves_no_tiles_of_earlier_runs(folder, tmp_path):
    made, _ = folder
    left, other = (tmp_path / f".{name}.{'0f' * 8}.tiles" for name in ("out.h5", "out.h5.h5"))
    for path in (left, other):
        path.mkdir()
        (path / "000000").write_text("a tile")
    picture(made / "alone", tmp_path / "out.h5", method="tikhonov")
    assert not left.exists() and other.exists()


def test_a_run_that_ended_goes_on_from_its_tiles(folder, tmp_path, small_tiles, monkeypatch):
    made, _ = folder
    picture(made / "alone", tmp_path / "right.h5", method="lmmse")
    solved, solve = [], in_tiles._TileTask.__call__

    def counted(self, job):
        if len(solved) == 3 and not resumed:
            raise NumericsError("the power went off")
        solved.append(job[0])
        return solve(self, job)

    monkeypatch.setattr(in_tiles._TileTask, "__call__", counted)
    command = ["reconstruct", str(made / "alone/capture.h5"), "--pif", str(made / "alone/pif.h5")]
    command += ["--method", "lmmse", "-o", str(tmp_path / "out.h5")]
    resumed = False
    assert run(command) == 5
    assert not (tmp_path / "out.h5").exists()
    assert len(list(tmp_path.glob(".out.h5.*.tiles/*"))) == 3
    damaged = next(tmp_path.glob(".out.h5.*.tiles/000001"))
    damaged.write_bytes(damaged.read_bytes()[:-8])
    resumed = True
    assert run(command) == 0
    assert solved == [0, 1, 2, 1, 3]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.h5", "right.h5"]
    one, two = (read_artefact(tmp_path / name, "image") for name in ("right.h5", "out.h5"))
    for name, values in one.data.items():
        np.testing.assert_array_equal(two.data[name], values)


ELSEWHERE = """
import sys
from plenocli.cli.main import run
from plenocli.inverse.picture import tiles
if __name__ == "__main__":
    tiles.AT_ONCE = int(sys.argv[1])
    sys.exit(run(sys.argv[2:]))
"""


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "method"), [("1", "lmmse"), ("2", "lmmse"), ("1", "weighted")])
def test_kill_9_loses_no_more_than_the_tiles_under_way(
    folder, tmp_path, monkeypatch, workers, method
):
    made, at_once = folder[0] / "alone", (SIDE // 2) ** 2 * (81 + 36 + tiles.FURTHER)
    monkeypatch.setattr(tiles, "AT_ONCE", at_once)
    picture(made, tmp_path / "right.h5", method=method)
    (tmp_path / "elsewhere.py").write_text(ELSEWHERE)
    command = ["reconstruct", str(made / "capture.h5"), "--pif", str(made / "pif.h5")]
    command += ["--method", method, "-o", str(tmp_path / "out.h5")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    program = [sys.executable, str(tmp_path / "elsewhere.py"), str(at_once), *command]

    def finished():
        return {p.name: p.read_bytes() for p in tmp_path.glob(".out.h5.*.tiles/0*[0-9]")}

    kept = {}
    for _ in range(2):
        process = subprocess.Popen([*program, "--workers", workers], env=environment)
        while len(finished()) < len(kept) + 2 and process.poll() is None:
            time.sleep(0.002)
        process.kill()
        assert process.wait() == -9
        known = finished()
        # what was whole before the kill is what it was, and tiles are there whole or not at all
        assert kept.items() <= known.items() and len(known) > len(kept)
        kept = known
    solved, solve = [], in_tiles._TileTask.__call__

    def counted(self, job):
        solved.append(job[0])
        return solve(self, job)

    monkeypatch.setattr(in_tiles._TileTask, "__call__", counted)
    assert run(command) == 0
    assert len(solved) == 16 - len(kept) and not {f"{n:06d}" for n in solved} & kept.keys()
    left = sorted(p.name for p in tmp_path.iterdir())
    assert left == ["elsewhere.py", "out.h5", "right.h5"]
    one, two = (read_artefact(tmp_path / name, "image") for name in ("right.h5", "out.h5"))
    for name, values in one.data.items():
        np.testing.assert_array_equal(two.data[name], values)


def test_other_outputs_of_tiles(folder, tmp_path, small_tiles, capsys):
    made, truths = folder
    command = ["reconstruct", str(made / "alone/capture.h5"), "--pif", str(made / "alone/pif.h5")]
    command += ["--method", "tikhonov", "--clip"]
    assert run([*command, "-o", str(tmp_path / "p.exr"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["captures"][0]
    assert (said["rows"], said["columns"]) == truths["alone"].shape
    assert run([*command, "-o", str(tmp_path / "p.h5")]) == 0
    value = read_artefact(tmp_path / "p.h5", "image").data["image/value"]
    assert value.min() == 0 and 0 < said["negative_share"] < 1
    assert run([*command, str(made / "coupled/capture.h5"), "-o", str(tmp_path / "many")]) in (0, 2)


def test_tiles_side_by_side_unpack_their_rows_once(folder, small_tiles, tmp_path, monkeypatch):
    """The same picture as where nothing may be kept; another capture of that name is read anew."""
    made, _ = folder
    read = []
    monkeypatch.setattr(
        Stored,
        "window",
        lambda self, *part, own=Stored.window: read.append(part) or own(self, *part),
    )
    kept = picture(made / "alone", tmp_path / "kept.h5", method="block-mean")
    known = len(read)
    monkeypatch.setattr(captures, "KEPT_SHARE", 0)
    plain = picture(made / "alone", tmp_path / "plain.h5", method="block-mean")
    assert len(read) - known >= known + 2  # two tiles in each of two rows
    np.testing.assert_array_equal(kept.data["image/value"], plain.data["image/value"])
    monkeypatch.undo()
    shutil.copytree(made / "alone", tmp_path / "alone")
    first = picture(tmp_path / "alone", tmp_path / "first.h5", method="block-mean")
    shutil.copy(made / "coupled" / "capture.h5", tmp_path / "alone" / "capture.h5")
    other = picture(tmp_path / "alone", tmp_path / "other.h5", method="block-mean")
    np.testing.assert_array_equal(first.data["image/value"], kept.data["image/value"])
    assert np.abs(other.data["image/value"] - first.data["image/value"]).max() > 0.01


@pytest.mark.parametrize(("several", "threads"), [(False, 3), (True, 1)])
def test_workers_of_several_captures_take_one_thread_each(
    folder, small_tiles, tmp_path, monkeypatch, several, threads
):
    made, seen = folder[0] / "alone", []
    names = [str(made / "capture.h5"), str(shutil.copy(made / "capture.h5", tmp_path / "b.h5"))]
    survey = in_tiles.survey
    monkeypatch.setattr(
        in_tiles, "survey", lambda *task: seen.append(budget().threads) or survey(*task)
    )
    # tasks run here, whatever the pool
    monkeypatch.setattr(stage, "open_pool", lambda *_, **__: nullcontext(InProcess()))
    command = ["reconstruct", *names[: 1 + several], "--pif", str(made / "pif.h5")]
    command += ["--method", "lmmse", "--workers", "3", "-o"]
    assert run([*command, str(tmp_path / ("out" if several else "out.h5"))]) == 0
    assert seen == [threads] * (1 + several)
