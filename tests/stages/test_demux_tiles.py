"""demux tile by tile, from files of which a part is in memory at a time: what comes out is what
comes out of one piece.
"""

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
from plenocli.stages.inverse.demux import Settings, run_demux
from tests.reference.calibrations import lenslet_grid

SIDE, ROWS, COLUMNS, FRAME = 16, 9, 7, 18
SHAPE = (ROWS * SIDE + 2 * FRAME, COLUMNS * SIDE + 2 * FRAME)
DEAD = (4, 2)
CORNERS = FRAME + SIDE * np.stack(np.indices((ROWS, COLUMNS)), axis=-1)
CENTRES = CORNERS + (SIDE - 1) / 2


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
    monkeypatch.setattr(factored, "BLOCK_NUMBERS", (5 * SIDE**2,) * 2)
    monkeypatch.setattr(factored, "TILE_NUMBERS", 10 * SIDE**2)
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
