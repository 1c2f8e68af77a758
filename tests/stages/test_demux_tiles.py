"""demux tile by tile, from files of which a part is in memory at a time: what comes out is what
comes out of one piece, and a run that was stopped goes on from its tiles.
"""

import shutil

import numpy as np
import pytest

import plenocli.files.artefacts.reading as reading
import plenocli.forward.sensor.readout as readout
import plenocli.inverse.spectra.factored as factored
from plenocli.base.budget import Budget, within
from plenocli.base.errors import InputError, NumericsError
from plenocli.base.tiling import InParts
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.read.calibrations import read_described, write_calibration
from plenocli.forward.sensor.frames import Dark
from plenocli.inverse.calibration.calibration import Calibration, Response, Sensor, White, Windows
from plenocli.inverse.spectra.radiance import _Estimation
from plenocli.stages.inverse.demux import Settings, run_demux
from tests.reference.calibrations import lenslet_grid
from tests.stages.stopped import damage, interrupted, kept, killed

SIDE, ROWS, COLUMNS, FRAME = 16, 9, 7, 18
SHAPE = (ROWS * SIDE + 2 * FRAME, COLUMNS * SIDE + 2 * FRAME)
DEAD = (4, 2)
CORNERS = FRAME + SIDE * np.stack(np.indices((ROWS, COLUMNS)), axis=-1)
CENTRES = CORNERS + (SIDE - 1) / 2
TILES = {"BLOCK_NUMBERS": (5 * SIDE**2,) * 2, "TILE_NUMBERS": 10 * SIDE**2}


def superpixels(moved):
    """(lenslet_row, lenslet_column, SIDE, SIDE, 2): a left and a right half, one band each with a
    leak of 3 %, displaced by `moved` (lenslet_row, lenslet_column, 2) px.
    """
    y, x = (np.arange(SIDE) - (SIDE - 1) / 2 - moved[..., axis, None] for axis in (0, 1))
    edge = np.clip((6.2 - np.abs(y[..., :, None])) / 2, 0, 1)
    edge = edge * np.clip((6.2 - np.abs(x[..., None, :])) / 2, 0, 1)
    right = np.clip(0.5 + x[..., None, :] / 3, 0.03, 0.97)
    return 1000 * edge[..., None] * np.stack(np.broadcast_arrays(1 - right, right), axis=-1)


@pytest.fixture(scope="module", params=["own", "shared"])
def files(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiles")
    rng = np.random.default_rng(5)
    gain = 1 + 0.03 * rng.normal(size=(ROWS, COLUMNS, 1, 1, 1)) * (request.param == "own")
    pattern = rng.uniform(0, 3, SHAPE).astype(np.float32)
    flat = superpixels(np.zeros((ROWS, COLUMNS, 2)))
    f = (gain * flat).reshape(ROWS, COLUMNS, -1, 2).astype(np.float32)
    f[3, 5, 70] = np.nan
    grid = lenslet_grid(CENTRES, SIDE * np.eye(2))
    grid.valid[DEAD] = False
    calibration = Calibration(
        grid=grid,
        sensor=Sensor(white_level=4095.0, gain_e_per_dn=2.0, read_noise=2.0, exposure=0.1),
        windows=Windows(CORNERS, (SIDE, SIDE)),
        white=White(
            f.sum(axis=-1), np.ones((ROWS, COLUMNS), np.float32), np.ones(SHAPE, np.float32)
        ),
        dark=Dark(mean=100 + pattern, black=np.full((2, 2), 100.0), exposure=0.1, sigma=2.0),
        response=Response(
            matrix=f if request.param == "own" else f[0, 0],
            variance=np.full((SIDE**2, 2), 1.0),
            wavelengths=np.array([480e-9, 620e-9]),
        ),
    )
    write_calibration(folder / "c.h5", calibration, Provenance(command="test"))
    radiance = rng.uniform(0.2, 0.9, (ROWS, COLUMNS, 2))
    away = CENTRES - CENTRES.mean(axis=(0, 1))
    turn = np.array([[0.0, -4e-3], [4e-3, 0.0]])
    for name, moved in {"still": 0 * away, "moved": (0.4, -1.3) + away @ turn.T}.items():
        light = np.einsum("rcyxb,rcb->rycx", gain * superpixels(moved), radiance)
        image = np.pad(light.reshape(ROWS * SIDE, -1), FRAME) + 100 + pattern
        image = image + rng.normal(0, np.sqrt((image - 100).clip(0) / 2 + 4))
        image[CORNERS[6, 3][0] + 5, CORNERS[6, 3][1] + 5] = 4095
        write_artefact(
            folder / f"{name}.h5",
            Artefact(
                "capture",
                {
                    "capture/mosaic": np.rint(image).clip(0, 4095).astype(np.uint16),
                    "capture/cfa": "mono",
                },
                {"capture": dict(units="DN", black=100.0, white=4095.0, exposure_s=0.1)},
            ),
        )
    return folder, radiance


def spectra(files, tmp_path, shot, method):
    """(summary, datasets) of one capture."""
    done = run_demux(
        [files[0] / f"{shot}.h5"],
        tmp_path / "o.h5",
        calibration=files[0] / "c.h5",
        settings=Settings(method=method),
        overwrite=True,
    )
    return done.captures[0], read_artefact(tmp_path / "o.h5", "spectra").data


@pytest.mark.parametrize("method", ["pinv", "wls", "lmmse", "nnls", "single-pixel", "auto"])
@pytest.mark.parametrize("shot", ["still", "moved"])
def test_tiles_give_what_one_piece_gives(files, tmp_path, monkeypatch, shot, method):
    summary, whole = spectra(files, tmp_path, shot, method)
    assert ("motion" in summary.registration.corrected) == (shot == "moved")
    known = np.isfinite(whole["spectra/value"]).all(axis=0)
    assert not known[DEAD] and known.sum() == ROWS * COLUMNS - 1
    if method == "wls":
        error = whole["spectra/value"] - np.moveaxis(files[1], -1, 0)
        assert np.sqrt(np.nanmean(error**2)) < 0.01
    monkeypatch.setattr(reading, "SHARE", 1 << 40)
    for name, value in TILES.items():
        monkeypatch.setattr(factored, name, value)
    monkeypatch.setattr(readout, "BAND", 37 * SHAPE[1])
    calls = []
    read = reading.Stored.part
    monkeypatch.setattr(
        reading.Stored, "part", lambda self, *sides: calls.append(self.name) or read(self, *sides)
    )
    again, parts = spectra(files, tmp_path, shot, method)
    assert {"capture/mosaic", "dark/mean"} <= set(calls) and len(calls) > 20
    assert (again.method, again.reason) == (summary.method, summary.reason)
    for name, values in whole.items():
        np.testing.assert_allclose(parts[name], values, rtol=2e-5, atol=1e-9, err_msg=name)


def test_what_tiles_do_not_fit_is_refused_with_what_would_do(files, tmp_path):
    with (
        within(Budget(450 << 10)),
        pytest.raises(NumericsError, match="demultiplexing needs about .* raise --mem-limit to"),
    ):
        spectra(files, tmp_path, "moved", "pinv")
    assert not (tmp_path / "o.h5").exists()


def test_what_is_small_beside_the_memory_is_held_and_what_is_not_stays_in_the_file(files):
    needs = ("response", "windows", "white", "dark")
    size = 4 * SHAPE[0] * SHAPE[1]
    for memory, kind in ((size * reading.SHARE, np.ndarray), (size * reading.SHARE - 16, object)):
        with within(Budget(memory)):
            found, _ = read_described(files[0] / "c.h5", needs=needs, in_file=True)
        assert isinstance(found.dark.mean, np.ndarray) == (kind is np.ndarray)
    whole = read_described(files[0] / "c.h5", needs=needs)[0]
    with within(Budget(1 << 20)):
        found, _ = read_described(files[0] / "c.h5", needs=needs, in_file=True)
        if found.response.shared:
            return
        for places in (np.array([[3, 3, 8], [5, 6, 0]]), np.indices((4, COLUMNS)).reshape(2, -1)):
            np.testing.assert_array_equal(
                found.response.matrix[tuple(places)], whole.response.matrix[tuple(places)]
            )


def test_a_response_of_no_scale_is_refused_from_its_file_too(files, tmp_path):
    """Written in parts, of which no rule for whole datasets is asked."""
    stored = read_artefact(files[0] / "c.h5", "calibration")
    f = stored.data["response/F"]
    bands = (1e-35 * f).reshape(-1, *f.shape[-2:])
    stored.data["response/F"] = InParts(shape=f.shape, dtype=f.dtype, parts=lambda: iter(bands))
    write_artefact(tmp_path / "c.h5", stored)
    for memory in (1 << 20, 4 << 30):
        with within(Budget(memory)), pytest.raises(InputError, match="'response/F' has values up"):
            found, _ = read_described(tmp_path / "c.h5", needs=("response",), in_file=True)
            found.response.matrix[np.array([3, 3]), np.array([5, 6])]


def test_a_response_to_polarised_light_may_stay_in_its_file(files, tmp_path):
    stored = read_artefact(files[0] / "c.h5", "calibration")
    f = stored.data["response/polarised"] = stored.data["response/F"]
    if f.ndim == 2:
        pytest.skip("what is one for all lenslets is small beside any memory")
    write_artefact(tmp_path / "c.h5", stored)
    with within(Budget(16 * f.nbytes // 2)):
        found, _ = read_described(tmp_path / "c.h5", needs=("response",), in_file=True)
    np.testing.assert_array_equal(found.response.matrix, f)


@pytest.fixture
def made(monkeypatch):
    """Names of the tiles that were made, of which there are many."""
    answer, found = _Estimation._answer, []

    def counted(self, part, method):
        found.append(f"{self.keeper.prefix}{part.start}-{part.stop}")
        return answer(self, part, method)

    monkeypatch.setattr(_Estimation, "_answer", counted)
    for name, value in TILES.items():
        monkeypatch.setattr(factored, name, value)
    return found


def demux(folder, output, shot="moved", **settings):
    """The bytes of one result."""
    run_demux(
        [folder / f"{shot}.h5"],
        output,
        calibration=folder / "c.h5",
        settings=Settings(**settings),
        overwrite=True,
    )
    return output.read_bytes()


@pytest.mark.parametrize("tiles, how", [(5, "cut"), (15, "bit")])
def test_a_run_that_was_stopped_makes_no_tile_twice(files, tmp_path, made, tiles, how):
    """Looks at a capture that moved, and the others that are compared with it, each have theirs;
    a tile that is damaged is made again.
    """
    whole = demux(files[0], tmp_path / "o.h5")
    every = list(made)
    assert len(set(every)) == len(every) >= 20 and not kept(tmp_path / "o.h5")
    (tmp_path / "o.h5").unlink()
    made.clear()
    interrupted(lambda: demux(files[0], tmp_path / "o.h5"), tiles)
    there = kept(tmp_path / "o.h5")
    assert len(there) == tiles and {"prior", "capture.auto.errors"} < there.keys()
    assert made == [name for name in every if name in there] and len(made) > 1
    lost = made[1]
    damage(there[lost], how)
    made.clear()
    assert demux(files[0], tmp_path / "o.h5") == whole
    assert made == [name for name in every if name not in there or name == lost]
    assert [file.name for file in tmp_path.iterdir()] == ["o.h5"]


@pytest.mark.parametrize("files", ["own"], indirect=True)
def test_tiles_of_another_run_are_neither_taken_nor_left(files, tmp_path, made):
    folder, output = tmp_path / "files", tmp_path / "o.h5"
    shutil.copytree(files[0], folder)
    demux(folder, output, method="lmmse", register="off")
    every = list(made)
    for other in ({"method": "wls"}, {"shot": "still"}, {"register": "auto"}):
        interrupted(lambda other=other: demux(folder, output, **other), 6)
        made.clear()
        demux(folder, output, method="lmmse", register="off")
        assert made == every and not kept(output)
    interrupted(lambda: demux(folder, output), 6)
    (folder / "still.h5").rename(folder / "moved.h5")  # other pixels by the same name
    made.clear()
    demux(folder, output)
    assert len(made) == len(every) and not kept(output)


@pytest.mark.parametrize("files", ["own"], indirect=True)
def test_a_white_reference_has_tiles_of_its_own(files, tmp_path, made):
    folder, output = files[0], tmp_path / "o.h5"
    settings = {"reference": folder / "still.h5", "method": "pinv"}
    whole = demux(folder, output, **settings)
    every = list(made)
    interrupted(lambda: demux(folder, output, **settings), len(every) - 5)
    there = kept(output)
    done = [name for name in every if name in there]
    assert len(done) > 13 and len({name.split(".")[0] for name in done}) == 2
    made.clear()
    assert demux(folder, output, **settings) == whole
    assert made == [name for name in every if name not in done]


@pytest.mark.parametrize("files", ["own"], indirect=True)
def test_kill_9_loses_no_more_than_the_tile_under_way(files, tmp_path, made):
    folder, output = files[0], tmp_path / "o.h5"
    whole = demux(folder, output)
    every = list(made)
    output.unlink()
    patched = {f"plenocli.inverse.spectra.factored:{name}": value for name, value in TILES.items()}
    words = ["demux", folder / "moved.h5", "--calibration", folder / "c.h5", "-o", output]
    killed(words, 12, patched)
    there = kept(output)
    assert len(there) == 12 and not output.exists()
    made.clear()
    assert demux(folder, output) == whole
    assert made == [name for name in every if name not in there] and len(made) < len(every) - 8


@pytest.mark.parametrize("files", ["own"], indirect=True)
def test_a_small_capture_keeps_nothing_and_clears_what_is_left(files, tmp_path, made, monkeypatch):
    interrupted(lambda: demux(files[0], tmp_path / "o.h5"), 5)
    assert kept(tmp_path / "o.h5")
    monkeypatch.undo()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("plenocli.files.bench.Bench.put", lambda *_: pytest.fail("it was kept"))
        demux(files[0], tmp_path / "o.h5")
    assert [file.name for file in tmp_path.iterdir()] == ["o.h5"]
