"""Captures that stay in their files are refocused as those in memory, however many samples are
worked on together.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import plenocli.inverse.lightfield.depth as depth
import plenocli.inverse.lightfield.gather as gather
import plenocli.inverse.lightfield.samples as samples
from plenocli.base.budget import Budget, within
from plenocli.base.errors import NumericsError
from plenocli.base.tiling import Plane
from plenocli.files.scratch import Scratch
from plenocli.forward.sensor.capture import Capture, Levels, SuperpixelGrid
from plenocli.inverse.calibration.calibration import Calibration, Sensor, White
from plenocli.inverse.lightfield.light_field import refocused
from tests.reference.calibrations import drawn_calibration, lenslet_grid

PITCH, ROWS, COLUMNS = 9, 11, 7
TURN = np.array([[0.998, -0.06], [0.06, 0.998]])


def exposed(shape, centres, rng):
    """(white image, its light of a scene) (row, column): a disc behind every lenslet, of a random
    texture on the plane of slope 0.5.
    """
    offset = np.indices(shape)[:, None] - centres.reshape(-1, 2).T[..., None, None]
    distance = np.hypot(*offset)
    own = distance.argmin(axis=0)
    q = np.take_along_axis(offset, own[None, None], axis=1)[:, 0]
    where = centres.reshape(-1, 2)[own].transpose(2, 0, 1) + 0.5 * q
    texture = rng.uniform(0.2, 1.0, [n // 14 + 4 for n in shape])
    white = np.clip(PITCH / 2 - distance.min(axis=0), 0.01, 1.0)
    return white, white * map_coordinates(texture, where / 14 + 1, order=1)


def scene(kind, cfa, rng):
    """(capture, calibration or None): along tiles, or the grid of a rotated calibration with a dead
    lenslet, without light in one pixel in a hundred.
    """
    index = np.stack(np.indices((ROWS, COLUMNS)), axis=-1)
    if kind == "tiles":
        shape, centres = (ROWS * PITCH, COLUMNS * PITCH), index * PITCH + (PITCH - 1) / 2
    else:
        centres = (index * PITCH) @ TURN.T + (12.3, 17.1)
        shape = tuple(int(n) for n in np.ceil(centres.max(axis=(0, 1))) + 14)
    white, light = exposed(shape, centres, rng)
    black = np.array([[64.0, 65.0], [66.0, 67.0]])
    level = np.tile(black, (shape[0] // 2 + 1, shape[1] // 2 + 1))[: shape[0], : shape[1]]
    mosaic = np.rint(level * (kind == "tiles") + 4000 * light).astype(np.uint16)
    shot = Capture(
        mosaic=mosaic,
        cfa=cfa,
        levels=Levels(black=black),
        grid=SuperpixelGrid(shape=(PITCH, PITCH)) if kind == "tiles" else None,
    )
    if kind == "tiles":
        return shot, None
    known = drawn_calibration(lenslet_grid(centres, PITCH * TURN), 4000 * white, cfa)
    known.grid.valid[5, 3] = False
    flat = known.white.flat.copy()
    flat[rng.uniform(size=shape) < 0.01] = np.nan
    return shot, replace(known, white=replace(known.white, flat=flat))


@pytest.mark.parametrize("kind", ["tiles", "grid"])
@pytest.mark.parametrize("cfa", ["mono", "GRBG"])
def test_bands_give_what_one_piece_gives(monkeypatch, tmp_path, kind, cfa):
    shot, calibration = scene(kind, cfa, np.random.default_rng(3))
    slopes = np.linspace(-1.5, 1.5, 7)
    whole = refocused(gather.bands_of(shot, calibration), slopes, views=2)
    read = []

    def window(rows, columns):
        part = shot.mosaic[rows, columns]
        read.append(len(part))
        return part

    monkeypatch.setattr(depth, "TOGETHER", (1, 1))
    for module in (gather, samples):
        monkeypatch.setattr(module, "AT_ONCE", 3 * PITCH**2 * COLUMNS // 2)
    stored = replace(shot, mosaic=Plane(shot.shape, window))
    source = gather.bands_of(stored, calibration)
    parts = refocused(source, slopes, views=2, room=Scratch(tmp_path / "out.h5"))
    assert not list(tmp_path.iterdir())
    assert len(source.rows) > ROWS / 2 and len(read) > ROWS and min(read) < 5 * PITCH
    assert np.nanmedian(parts.depth.slope) == pytest.approx(0.5, abs=0.15)
    for ours, theirs in (
        (parts.pictures.whole(), whole.pictures),
        (parts.sharpness, whole.sharpness),
        (parts.views.whole(), whole.views),
        (parts.sharp.whole(), whole.sharp),
        (parts.depth.slope, whole.depth.slope),
        (parts.depth.confidence, whole.depth.confidence),
        (parts.depth.sigma, whole.depth.sigma),
        (parts.depth.edge, whole.depth.edge),
        *(
            (getattr(parts.colours, name).whole(), getattr(whole.colours, name))
            for name in ("pictures", "sharp", "views")
            if cfa != "mono"
        ),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "in_file, words", [(True, "cut the capture"), (False, "take fewer planes")]
)
def test_what_does_not_fit_is_refused_before_a_pixel_is_read(tmp_path, in_file, words):
    """A sensor of a million lenslets: in a file its pictures need a fraction of what they hold."""
    shape = 2400, 2400

    def unread(rows, columns):
        raise AssertionError("a pixel was asked for")

    centres = np.stack(np.meshgrid(*2 * [np.arange(600) * 4 + 1.5], indexing="ij"), axis=-1)
    white = Plane(shape, unread)
    calibration = Calibration(
        grid=lenslet_grid(centres, 4 * np.eye(2)),
        sensor=Sensor(cfa="mono"),
        white=White(level=None, flat=white),
    )
    source = gather.bands_of(Capture(mosaic=Plane(shape, unread)), calibration)
    room = {"room": Scratch(tmp_path / "out.h5")} if in_file else {}
    with (
        within(Budget(30 << 20 if in_file else 300 << 20)),
        pytest.raises(NumericsError, match=f"refocusing needs about .*{words}"),
    ):
        refocused(source, np.linspace(-3, 3, 13), **room)
    with within(Budget(300 << 20)), pytest.raises(AssertionError, match="asked for"):
        refocused(source, np.linspace(-3, 3, 13), room=Scratch(tmp_path / "out.h5"))
