"""Superpixels of real captures: sensors whose lenslets lie between the pixels and move, drawn here
by formula; and a public capture of two printed sheets.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import plenocli as pc
from plenocli.base.errors import InputError
from plenocli.base.tiling import Plane
from plenocli.files.images.mosaic import read_capture
from plenocli.files.scratch import Scratch
from plenocli.forward.sensor.capture import Capture, Levels
from plenocli.inverse.calibration.measure import calibrate
from plenocli.inverse.picture import hold_out, real_light
from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.lenslet_model import LensletMatrix
from plenocli.inverse.picture.methods.registry import METHODS
from plenocli.inverse.picture.real_light import (
    EachPixel,
    in_common,
    noise_of_parts,
    sampled,
    typical_white,
)
from plenocli.inverse.picture.superpixels import superpixels
from plenocli.inverse.picture.tiles import EVERY
from tests.reference.calibrations import drawn_calibration, lenslet_grid

PITCH, COUNT, WINDOW = 12.31, (9, 10), 12
MOVED = np.array([0.23, -0.31])


def lenslets():
    rows, columns = np.indices(COUNT)
    centres = 10.2 + PITCH * np.stack([rows + 0.004 * columns, columns - 0.004 * rows], axis=-1)
    shape = (int(centres[..., 0].max() + 12), int(centres[..., 1].max() + 12))
    return centres, shape


def drawn(centres, shape, values, tilt=None):
    """An image whose lenslets show a disc with soft borders, some 3 px wide, times a value that
    may rise across the disc: finer than a pixel nowhere.
    """
    rows, columns = np.indices(shape)
    image = np.zeros(shape)
    for at in np.ndindex(*COUNT):
        r, c = rows - centres[at][0], columns - centres[at][1]
        light = 1 / (1 + np.exp((np.hypot(r, c) - 4.6) / 0.55))
        image += light * values[at] * (1 if tilt is None else 1 + tilt[at] * c / 6)
    return image


@pytest.fixture
def camera(tmp_path):
    """Calibration of the drawn array, and a matrix whose even superpixel is the disc."""
    centres, shape = lenslets()
    white = 200.0 * drawn(centres, shape, np.ones(COUNT))
    calibration = drawn_calibration(lenslet_grid(centres, np.eye(2) * PITCH), white)
    assert calibration.windows.shape == (WINDOW, WINDOW)
    offset = np.arange(WINDOW) - (WINDOW - 1) / 2
    even = 1 / (1 + np.exp((np.hypot(offset[:, None], offset) - 4.6) / 0.55))
    blocks = np.repeat(even.reshape(1, -1, 1), 4, axis=2) / 4
    system = LensletMatrix(
        path=tmp_path / "pif.h5",
        blocks=blocks,
        offsets=np.zeros((1, 2), int),
        pixel_shape=(WINDOW, WINDOW),
        object_shape=(2, 2),
    )
    return calibration, system, even


def test_superpixels_are_taken_where_the_lenslets_are(camera):
    calibration, system, even = camera
    centres, shape = lenslets()
    rng = np.random.default_rng(4)
    values, tilt = rng.uniform(0.2, 1, COUNT), np.zeros(COUNT)
    tilt[2:4, 3:6] = rng.uniform(-0.5, 0.5, (2, 3))
    capture = Capture(mosaic=200.0 * drawn(centres + MOVED, shape, values, tilt))
    found = EachPixel(capture, system, calibration, None).cut(*EVERY)
    seen = np.isfinite(found.y)
    offset = np.arange(WINDOW) - (WINDOW - 1) / 2
    true = values[..., None] * (1 + tilt[..., None] * np.tile(offset, WINDOW) / 6) * even.ravel()
    bright = seen & (even.ravel() > 0.5)
    assert bright.mean() > 0.3
    error = np.sqrt(np.mean((found.y - true)[bright] ** 2))
    assert error < 0.005
    # whole windows, as block means take them, are off by their place between pixels
    windows = calibration.windows
    view = np.lib.stride_tricks.sliding_window_view(capture.mosaic / 200, windows.shape)
    cut = view[tuple(windows.origin.reshape(-1, 2).T)].reshape(*COUNT, -1)
    assert np.sqrt(np.mean((cut - true)[bright] ** 2)) > 10 * error
    assert np.all(np.isinf(found.variance) == ~seen)


@pytest.mark.parametrize("lenslet_rows", [1, 2])
def test_bands_in_a_file_are_those_of_one_piece(camera, tmp_path, monkeypatch, lenslet_rows):
    calibration, system, _ = camera
    centres, shape = lenslets()
    rng = np.random.default_rng(6)
    values = rng.uniform(0.2, 1, COUNT)
    values[2, 4] = 3.0
    mosaic = 200.0 * drawn(centres + MOVED, shape, values) + rng.standard_normal(shape)
    capture = Capture(mosaic=mosaic, levels=Levels(white=400.0))
    whole = EachPixel(capture, system, calibration, None).cut(*EVERY)
    monkeypatch.setattr(real_light, "AT_ONCE", lenslet_rows * COUNT[1] * WINDOW**2)
    monkeypatch.setattr(real_light, "MARGIN", 40)
    most = []

    def read(rows, columns):
        most.append(rows.indices(shape[0])[1] - rows.indices(shape[0])[0])
        return mosaic[rows, columns]

    stays = replace(capture, mosaic=Plane(shape, read))
    parts = EachPixel(stays, system, calibration, None, Scratch(tmp_path / "out.h5"))
    assert parts.count == COUNT and max(most) < shape[0]
    for rows, columns in (EVERY, (slice(2, 5), slice(3, 9)), (slice(8, 9), slice(0, 1))):
        cut = parts.cut(rows, columns, (slice(0, 1), slice(0, 1)))
        for one, other in ((cut.y, whole.y), (cut.variance, whole.variance)):
            np.testing.assert_allclose(one, other[rows, columns], rtol=1e-9, atol=1e-12)
        assert cut.own == (slice(0, 1), slice(0, 1))


def test_what_counts_for_nothing_is_said(camera):
    """Masked pixels, saturated ones and dust on white."""
    calibration, system, _ = camera
    centres, shape = lenslets()
    mosaic = 200.0 * drawn(centres, shape, np.full(COUNT, 0.5))
    mask = np.zeros(shape, bool)
    at = np.rint(centres).astype(int)
    mask[tuple(at[2, 2])] = True
    mosaic[tuple(at[4, 4])] = 255.0
    capture = Capture(mosaic=mosaic, mask=mask, levels=Levels(white=255.0))
    found = EachPixel(capture, system, calibration, None).cut(*EVERY)
    middle = np.isfinite(found.y).reshape(*COUNT, WINDOW, WINDOW)[:, :, 5:7, 5:7].all(axis=(2, 3))
    assert not middle[2, 2] and not middle[4, 4] and middle[6, 6]
    white = np.ones((5, 5, 200)) * np.linspace(1, 2, 25).reshape(5, 5, 1)
    white = white * (1 + 0.01 * np.random.default_rng(0).standard_normal(white.shape))
    white[1, 1, 3] = 0.3
    white[3, 2, 5] = 1.2 * white[3, 2, 6]
    found = in_common(np.moveaxis(white, 2, 0), np.ones((5, 5), bool))
    own, dusty = typical_white(white, found)
    assert dusty[1, 1, 3] and dusty.sum() == 1 and own[3, 2, 5] == white[3, 2, 5]
    noise = np.std(own / own.mean(axis=2, keepdims=True), axis=(0, 1))
    assert np.median(noise) < 0.004


def test_other_windows_are_refused(camera):
    calibration, system, _ = camera
    with pytest.raises(InputError, match="no whole part"):
        EachPixel(
            Capture(mosaic=np.zeros(lenslets()[1])),
            replace(system, pixel_shape=(5, 5)),
            calibration,
            None,
        )


def test_matrices_of_a_whole_part_of_the_pixels_are_for_weighted(camera):
    calibration, system, _ = camera
    capture = Capture(mosaic=np.zeros(lenslets()[1]))
    for side, named in ((WINDOW // 2, True), (5, False)):
        binned = replace(
            system, pixel_shape=(side, side), blocks=np.ones((1, side**2, 4)) / side**2
        )
        with pytest.raises(InputError, match="as measured") as refused:
            superpixels(capture, binned, calibration)
        assert ("--method weighted" in str(refused.value)) == named


def test_splines_reach_between_pixels():
    rows, columns = np.indices((40, 50))
    wave = np.sin(2 * np.pi * rows / 7) * np.cos(2 * np.pi * columns / 9)
    found = sampled(wave, np.array([[20.3, 25.7]]), (6, 8)).reshape(6, 8)
    r, c = 20.3 + np.arange(6) - 2.5, 25.7 + np.arange(8) - 3.5
    expected = np.sin(2 * np.pi * r[:, None] / 7) * np.cos(2 * np.pi * c / 9)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    wave[20, 25] = np.nan
    assert np.isnan(sampled(wave, np.array([[20.3, 25.7]]), (6, 8))).sum() in range(4, 13)


def test_the_noise_is_that_of_the_photons():
    rng = np.random.default_rng(2)
    white = np.full((6, 6, 400), 200.0)
    level = np.repeat(rng.uniform(20, 200, (6, 6, 1)), 400, axis=2)
    cut = 0.02 * rng.poisson(level / 0.02)
    calibration = SimpleNamespace(
        windows=SimpleNamespace(shape=(20, 20)), sensor=SimpleNamespace(read_variance=0.0)
    )
    parts = [
        (cut[rows], white[rows], np.ones(white[rows].shape, bool))
        for rows in (slice(3), slice(3, 6))
    ]
    found = noise_of_parts(SimpleNamespace(cfa="mono"), calibration, parts)
    assert found.gain == pytest.approx(0.02, rel=0.06)


def test_a_real_capture_is_predicted_where_it_was_left_out(shared_data, tmp_path, monkeypatch):
    """Two printed sheets (cicwi/plenoptomos): part of the near one, a matrix of lenslets of 0.3 mm
    on 18.6 mm, pupil and distance as fitted.
    """
    monkeypatch.setattr(hold_out, "PATCHES", (2,))
    folder = shared_data / "plenoptic" / "letters"
    white, dark, capture = (
        read_capture(folder / f"letters_ULF_M1{name}.png") for name in ("_white", "_dark", "")
    )
    calibration = calibrate([white], darks=[dark]).calibration
    path = Path(tmp_path / "near.toml")
    path.write_text(NEAR)
    matrix = pc.system_matrix(
        pc.read_camera(path), superpixels=(3, 3), coherent_ring=1, accuracy=1e-2, model="fresnel"
    )
    system = LensletMatrix(
        path=path,
        blocks=np.asarray(matrix.A, float).mean(axis=0),
        offsets=matrix.lenslet_offset,
        pixel_shape=(12, 12),
        object_shape=(12, 12),
    )
    data = EachPixel(capture, system, calibration, None).cut(*EVERY)
    part = np.s_[2:8, 9:15]
    data = replace(data, y=np.nan_to_num(data.y[part]), variance=data.variance[part])
    estimators = Estimators(
        system, Options(method="weighted", hold_out=0.1), lambda _: [("page", page())], threads=1
    )
    found = METHODS["weighted"].reconstruct(estimators, data)
    last = next(one for one in found.stats.held_out if one.structured)
    assert last.both < last.model < 0.8 * last.neighbours_over_white < 0.3 * last.neighbours
    assert last.model < 0.2 * last.block_mean


def page():
    """Black strokes on grey paper, for the statistics."""
    rng = np.random.default_rng(0)
    picture = np.full((144, 144), 0.3)
    for _ in range(12):
        r, c = rng.integers(0, 130, 2)
        height, width = rng.permutation([9, 45])
        picture[r : r + height, c : c + width] = 0.05
    return picture


NEAR = """
[main_lens]
focal_length = "251 mm"
aperture_diameter = "7.64 mm"
aperture_shape = "circle"

[object]
distance = "496.7 mm"
samples_per_lenslet = [12, 12]

[lenslet_array]
distance = "502 mm"
superpixel_pitch = "311.112 um"
focal_length = "18.6 mm"
aperture_shape = "square"
fill_factor = 0.98
count = [18, 25]

[sensor]
distance = "18.6 mm"
pixel_pitch = "25.8 um"
pixels_per_lenslet = [12, 12]

[light]
wavelengths = ["500 nm", "600 nm"]
"""
