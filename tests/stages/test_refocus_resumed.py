"""refocus of a large capture that was stopped: the bytes of a run that was not, with no plane made
twice.
"""

import shutil

import numpy as np
import pytest

from plenocli.cli.main import run
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.images.mosaic import write_capture
from plenocli.forward.sensor.capture import Capture, SuperpixelGrid
from plenocli.inverse.lightfield import depth, light_field
from plenocli.stages.inverse import refocus
from tests.stages.stopped import damage, interrupted, kept, killed

PLANES = 5
MANY = {
    "plenocli.stages.inverse.refocus:LARGE": 1,
    "plenocli.inverse.lightfield.depth:TOGETHER": (1, 1),
}


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """A capture of a pattern at slope 0.4, in grey and in colour."""
    folder = tmp_path_factory.mktemp("shots")
    rng = np.random.default_rng(8)
    pattern = rng.uniform(100, 900, (40, 44)).repeat(4, 0).repeat(4, 1)
    for name, cfa in (("grey", "mono"), ("colour", "RGGB")):
        grid = SuperpixelGrid.tiled((16, 17), (10, 10))
        shot = Capture(mosaic=pattern[:160, :170], cfa=cfa, grid=grid)
        write_capture(folder / f"{name}.h5", shot, Provenance(command="test"))
    return folder


@pytest.fixture
def made(monkeypatch):
    """What was made of which plane, as it is kept, one plane after the other."""
    found = []

    def counting(module, name, what):
        make = getattr(module, name)

        def counted(stream, slope, *more):
            found.append(f"{what} {float(slope)!r}")
            return make(stream, slope, *more)

        monkeypatch.setattr(module, name, counted)

    counting(depth, "_disagreement", "disagreement")
    counting(light_field, "_plane", "plane")
    correction = depth._correction
    monkeypatch.setattr(
        depth, "_correction", lambda *given: (found.append("correction"), correction(*given))[1]
    )
    monkeypatch.setattr(refocus, "LARGE", 1)
    monkeypatch.setattr(depth, "TOGETHER", (1, 1))
    return found


def command(shots, output, *options, name="grey"):
    words = ["refocus", shots / f"{name}.h5", "--planes", PLANES, "--views", 2, "-o", output]
    return [str(word) for word in (*words, *options)]


def planes(shots, output, *options, name="grey"):
    """The bytes of a result."""
    done(command(shots, output, *options, "--overwrite", name=name))
    return output.read_bytes()


def done(words):
    """Run a command, which does not fail; KeyboardInterrupt where it was interrupted."""
    code = run(words)
    if code == 130:
        raise KeyboardInterrupt
    assert code == 0


def without_corrections(names):
    return [name for name in names if not name.startswith("correction")]


@pytest.mark.parametrize(
    "name, suffix, stop, how",
    [
        ("grey", ".h5", "disagreement", "cut"),
        ("grey", ".h5", "correction", "bit"),
        ("colour", ".h5", "plane", "bit"),
        ("colour", ".ome.tif", "plane", "cut"),
    ],
)
def test_a_run_that_was_stopped_makes_no_plane_twice(
    shots, tmp_path, made, name, suffix, stop, how
):
    """But that of a tile that is damaged."""
    output = tmp_path / f"o{suffix}"
    whole = planes(shots, output, name=name)
    every = list(made)
    assert [file.name for file in tmp_path.iterdir()] == [output.name]
    assert len(set(every)) == len(every) - depth.ROUNDS + 1 > 10
    output.unlink()
    made.clear()
    stop_at = 2 + next(n for n, one in enumerate(every) if one.startswith(stop))
    interrupted(lambda: planes(shots, output, name=name), stop_at)
    there = kept(output)
    assert len(there.keys() - {"pictures"}) == stop_at and made == every[:stop_at]
    lost = f"{stop} {1 if stop == 'correction' else made[stop_at - 1].split()[1]}"
    damage(there[lost], how)
    made.clear()
    assert planes(shots, output, name=name) == whole
    assert without_corrections(made) == without_corrections(
        [one for one in every if one not in there or one == lost]
    )
    corrections = sum(one.startswith("correction") for one in there.keys() - {lost})
    assert made.count("correction") == depth.ROUNDS - corrections
    assert [file.name for file in tmp_path.iterdir()] == [output.name]


@pytest.mark.parametrize("how", ["bit", "cut"])
def test_pictures_count_only_where_they_are_as_they_were(shots, tmp_path, made, how):
    output = tmp_path / "o.h5"
    whole = planes(shots, output, name="colour")
    every = list(made)
    interrupted(lambda: planes(shots, output, name="colour"), len(every))
    pictures = kept(output)["pictures"]
    if how == "cut":
        with open(pictures, "r+b") as file:
            file.truncate(4 * 64 * 68 * 2 + 8)  # two planes in grey
    else:
        with open(pictures, "r+b") as file:
            file.seek(4 * 64 * 68 * 2 + 8)
            file.write(b"\x55")
    made.clear()
    assert planes(shots, output, name="colour") == whole
    of_planes = [one for one in every if one.startswith("plane")]
    assert made == (of_planes[2:3] if how == "bit" else of_planes)


def test_what_is_finished_of_another_run_is_neither_taken_nor_left(shots, tmp_path, made):
    output = tmp_path / "o.h5"
    shutil.copytree(shots, tmp_path / "shots")
    planes(tmp_path / "shots", output, "--planes", "4")
    every = list(made)
    for options in (["--planes", "6"], ["--views", "0"], ["--slope", "0", "--slope", "1"]):
        interrupted(lambda options=options: planes(tmp_path / "shots", output, *options), 2)
        made.clear()
        planes(tmp_path / "shots", output, "--planes", "4")
        assert made == every and not kept(output)
    interrupted(lambda: planes(tmp_path / "shots", output), 4)
    shutil.copy(shots / "colour.h5", tmp_path / "shots" / "grey.h5")
    made.clear()
    planes(tmp_path / "shots", output)
    assert len(set(made)) > 10 and not kept(output)


def test_kill_9_loses_no_more_than_the_plane_under_way(shots, tmp_path, made):
    output = tmp_path / "o.h5"
    whole = planes(shots, output)
    every = list(made)
    output.unlink()
    for tiles in (3, 9):  # what the second run keeps comes on top of the first's
        killed(command(shots, output, "--overwrite"), tiles, MANY)
    there = kept(output)
    assert len(there.keys() - {"pictures"}) == 12 and not output.exists()
    made.clear()
    assert planes(shots, output) == whole
    assert made == every[12:]


def test_a_batch_goes_on_in_each_capture_and_small_ones_keep_nothing(shots, tmp_path, made):
    folder = tmp_path / "out"
    words = ["refocus", shots, "--planes", PLANES, "-o", folder, "--workers", 2]
    words = [str(word) for word in words]
    done(words)
    whole = {file.name: file.read_bytes() for file in folder.iterdir()}
    for file in folder.iterdir():
        file.unlink()
    interrupted(lambda: done([*words[:-1], "1"]), len(made) // 2 + 3)
    assert (folder / "colour.h5").exists() and kept(folder / "grey.h5")
    made.clear()
    done(words)
    assert len(made) < 12
    assert {file.name: file.read_bytes() for file in folder.glob("*.h5")} == {
        name: data for name, data in whole.items() if name.endswith(".h5")
    }
    (folder / "grey.h5").unlink()
    interrupted(lambda: done(words), 3)
    assert kept(folder / "grey.h5")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refocus, "LARGE", 64)
        done(words)
    assert sorted(f.name for f in folder.iterdir()) == sorted(whole)
