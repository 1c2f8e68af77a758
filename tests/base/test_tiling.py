"""The tiling of a plane by lenslets."""

import weakref

import numpy as np
import pytest

from plenocli.base import tiling
from plenocli.base.tiling import (
    InParts,
    Plane,
    bands,
    mirrored,
    shared,
    to_blocks,
    to_plane,
    widened,
    windows,
)


def test_blocks_are_what_stands_in_the_plane_and_go_back():
    plane = np.arange(6 * 20).reshape(6, 20)
    blocks = to_blocks(plane, (2, 5))
    assert blocks.shape == (3, 4, 10)
    for row in range(3):
        for column in range(4):
            assert (
                blocks[row, column].tolist()
                == plane[2 * row : 2 * row + 2, 5 * column : 5 * column + 5].ravel().tolist()
            )
    assert (to_plane(blocks, (2, 5)) == plane).all()
    assert (to_plane(blocks.reshape(3, 4, 2, 5), (2, 5)) == plane).all()


def test_bands_stand_one_after_the_other():
    cube = np.arange(3 * 6 * 20).reshape(3, 6, 20)
    blocks = to_blocks(cube, (2, 5))
    assert blocks.shape == (3, 4, 30) and (blocks[..., 10:20] == to_blocks(cube[1], (2, 5))).all()
    assert (to_plane(blocks, (2, 5)) == cube).all()


def test_bands_cover_all_rows_once_and_mirrored_rows_are_those_of_a_padded_plane():
    for count, most, reach in ((11, 4, 2), (6, 6, 1), (3, 1, 3), (5, 0, 0)):
        found = bands(count, most)
        assert [n for part in found for n in range(count)[part]] == list(range(count))
        padded = np.pad(np.arange(count), reach, mode="symmetric")
        for part in found:
            around = padded[part.start : part.stop + 2 * reach]
            assert mirrored(part, reach, count).tolist() == around.tolist()


def test_an_array_in_parts_is_put_together_plane_by_plane():
    cube = np.random.default_rng(1).random((2, 7, 3))
    parts = [plane[part] for plane in cube for part in bands(7, 3)]
    whole = InParts(shape=cube.shape, dtype=np.float32, parts=lambda: parts).whole()
    assert whole.dtype == np.float32 and (whole == cube.astype(np.float32)).all()


@pytest.mark.parametrize("shape, multiple", [((97, 40), 1), ((96, 40), 12), ((3, 50, 7), 5)])
def test_bands_of_a_plane_cover_it_and_are_never_thin(monkeypatch, shape, multiple):
    monkeypatch.setattr(tiling, "BAND", 400)
    values = np.random.default_rng(2).random(shape)
    plane = Plane.of(values)
    found = plane.in_bands(multiple)
    assert len(found) > 1
    assert (np.concatenate([plane.window(rows) for rows in found], axis=-2) == values).all()
    assert all(rows.start % multiple == 0 for rows in found)
    assert min(rows.stop - rows.start for rows in found) >= min(tiling.LEAST, multiple)
    doubled = plane.through(lambda part: 2 * part)
    assert (doubled.window(slice(3, 9), slice(1, 4)) == 2 * values[..., 3:9, 1:4]).all()


@pytest.mark.parametrize("seed", range(5))
def test_windows_of_blocks_are_rows_of_the_whole_and_shared_ones_are_let_go(seed):
    rng = np.random.default_rng(seed)
    whole = rng.normal(size=(2, 40, 3))
    ends = np.sort(rng.choice(np.arange(1, 40), 6, replace=False))
    alive = []

    def blocks():
        for block in np.split(whole, ends, axis=1):
            made = block.copy()
            alive.append(weakref.ref(made))
            yield made

    own = bands(40, 4)
    several = [
        zip(own, windows(part, [widened(rows, reach, 40) for rows in own]))
        for reach, part in zip((0, 2, 5), shared(blocks(), 3))
    ]
    for each in zip(*several):
        for reach, (rows, found) in zip((0, 2, 5), each):
            around = slice(max(rows.start - reach, 0), min(rows.stop + reach, 40))
            np.testing.assert_array_equal(found, whole[:, around])
        # what lies behind is let go while the rest is worked on
        passed = int(np.searchsorted(ends, rows.start - 9, "right"))
        assert not any(one() is not None for one in alive[:passed])
    assert len(alive) == len(ends) + 1
