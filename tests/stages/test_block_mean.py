"""reconstruct --calibration --method block-mean, band of lenslets by band, from a capture that
stays in a file: every value is a lenslet's own sum over that of white.
"""

import math

import numpy as np
import pytest
import tifffile

import plenocli.stages.inverse.reconstruct.one_capture as one_capture
from plenocli.base.budget import Budget, within
from plenocli.base.tiling import Plane
from plenocli.cli.main import run
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.reading import Stored, read_artefact
from plenocli.files.images.dng import write_dng
from plenocli.files.images.mosaic import capture_in_file
from plenocli.files.read.calibrations import write_calibration
from plenocli.forward.sensor.frames import Dark
from plenocli.inverse.calibration.calibration import Calibration, Sensor, White, Windows
from plenocli.stages.inverse.reconstruct.run import run_reconstruct
from tests.reference.calibrations import lenslet_grid

SIDE, ROWS, COLUMNS, FRAME = 9, 24, 20, 11
SHAPE = (ROWS * SIDE + 2 * FRAME, COLUMNS * SIDE + 2 * FRAME)
OFF, DEAD = (0, 3), (4, 2)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder, numbers of the capture, dark, white, and corners: rows of lenslets go down to the
    right, one lenslet lies partly off the sensor.
    """
    folder, rng = tmp_path_factory.mktemp("block-mean"), np.random.default_rng(2)
    corners = FRAME + SIDE * np.stack(np.indices((ROWS, COLUMNS)), axis=-1)
    corners[..., 0] += np.arange(COLUMNS) // 4
    corners[OFF] = -2, 30
    dark = (100 + rng.uniform(0, 3, SHAPE)).astype(np.float32)
    white = rng.uniform(500, 900, (ROWS, COLUMNS, SIDE**2)).astype(np.float32)
    white[5, 6, 7] = np.nan
    grid = lenslet_grid(corners + (SIDE - 1) / 2, SIDE * np.eye(2))
    grid.valid[DEAD] = False
    values = rng.integers(90, 1500, SHAPE).astype(np.uint16)
    for cfa in ("mono", "GBRG"):
        calibration = Calibration(
            grid=grid,
            sensor=Sensor(cfa=cfa, white_level=4095.0),
            windows=Windows(corners, (SIDE, SIDE)),
            white=White(white, np.ones((ROWS, COLUMNS), np.float32), np.ones(SHAPE, np.float32)),
            dark=Dark(mean=dark, black=np.full((2, 2), 100.0), exposure=None, sigma=2.0),
        )
        write_calibration(folder / f"{cfa}.h5", calibration, Provenance(command="test"))
    tifffile.imwrite(folder / "mono.tif", values)
    write_dng(folder / "GBRG.dng", values, cfa="GBRG", black=100, white=4095)
    return folder, values, dark, white, corners


def expected(made, letter=None):
    """Lenslet by lenslet, pixel by pixel, in double precision."""
    _, values, dark, white, corners = made
    out = np.zeros((ROWS, COLUMNS))
    for row, column in np.ndindex(ROWS, COLUMNS):
        if (row, column) in (OFF, DEAD):
            continue
        light, full = 0.0, 0.0
        for k, (i, j) in enumerate(np.ndindex(SIDE, SIDE)):
            y, x = corners[row, column] + (i, j)
            counts = letter in (None, "GBRG"[2 * (y % 2) + x % 2])
            if counts and not math.isnan(white[row, column, k]):
                light += float(values[y, x]) - float(dark[y, x])
                full += float(white[row, column, k])
        out[row, column] = light / full
    return out


def reconstructed(made, shot, tmp_path, memory):
    folder = made[0]
    with within(Budget(memory)):
        run_reconstruct(
            [folder / shot],
            tmp_path / "o.h5",
            calibration=folder / f"{shot[:4]}.h5",
            settings=one_capture.Settings(method="block-mean"),
            overwrite=True,
        )
    return read_artefact(tmp_path / "o.h5", "image").data


@pytest.mark.parametrize("shot", ["mono.tif", "GBRG.dng"])
def test_bands_of_a_capture_in_a_file_give_each_lenslet_its_own_share(
    made, tmp_path, monkeypatch, shot
):
    """The bits of one piece, too."""
    whole = reconstructed(made, shot, tmp_path, 1 << 30)
    monkeypatch.setattr(one_capture, "BAND", 3 * COLUMNS * SIDE**2)
    memory, seen, read = 1 << 20, [], Stored.part
    monkeypatch.setattr(Stored, "part", lambda *a: seen.append(a[0].name) or read(*a))
    with within(Budget(memory)):
        held = capture_in_file(made[0] / shot, room=one_capture.room_beside(tmp_path / "o.h5"))
    assert isinstance(held.mosaic, Plane)
    parts = reconstructed(made, shot, tmp_path, memory)
    assert set(seen) == {"response/white", "dark/mean"}
    assert whole.keys() == parts.keys()
    for name, values in whole.items():
        assert values.dtype == parts[name].dtype
        np.testing.assert_array_equal(values, parts[name])
    np.testing.assert_allclose(whole["image/value"], expected(made), rtol=1e-5)
    if shot != "mono.tif":
        assert whole["image/rgb"].shape == (3, ROWS, COLUMNS)
        own = np.stack([expected(made, letter) for letter in "RGB"])
        rgb = np.tensordot(held.profile.to_rgb, own, axes=1)
        np.testing.assert_allclose(whole["image/rgb"], rgb, rtol=1e-5)
    assert [path.name for path in tmp_path.iterdir()] == ["o.h5"]


@pytest.mark.parametrize(
    "name, value, says",
    [("black", 100.0, "no light"), ("zero", 0, "no light"), ("burnt", 4095, "100.00% of the")],
)
def test_a_capture_that_shows_nothing_is_told_in_a_line(
    made, tmp_path, monkeypatch, capsys, name, value, says
):
    """By the picture of a calibrated camera, and by its planes."""
    monkeypatch.chdir(tmp_path)
    noise = np.random.default_rng(4).normal(0, 2, SHAPE)
    tifffile.imwrite("shot.tif", np.clip(value + noise, 0, 4095).astype(np.uint16))
    for command in (["reconstruct", "--method", "block-mean"], ["refocus"]):
        calibration = str(made[0] / "mono.h5")
        said = [*command, "shot.tif", "--calibration", calibration, "-o", f"{command[0]}.h5"]
        assert run(said) == 0
        told = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
        assert len(told) == 1 and says in told[0]
