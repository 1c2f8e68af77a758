"""Pictures that wait in a nameless file: what is put in comes out, and a full disk is told."""

import os

import numpy as np
import pytest

from plenocli.base.errors import OutputError
from plenocli.files import scratch
from plenocli.files.scratch import Scratch


def test_rows_put_in_any_order_come_out_as_an_array_has_them(monkeypatch, tmp_path):
    monkeypatch.setattr(scratch, "BAND", 24)
    rng, room = np.random.default_rng(5), Scratch(tmp_path / "out.h5")
    first, second = room((3, 2, 11, 6)), room((7, 5))
    one, other = np.zeros((3, 2, 11, 6), np.float32), np.zeros((7, 5), np.float32)
    for rows in (slice(8, 11), slice(0, 5), slice(5, 8)):
        for plane in (2, 0, 1):
            one[plane, :, rows] = first[plane, :, rows] = rng.normal(
                size=(2, rows.stop - rows.start, 6)
            )
    for rows in (slice(3, 7), slice(0, 3)):
        other[rows] = second[rows] = rng.normal(size=(rows.stop - rows.start, 5))
    np.testing.assert_array_equal(first.whole(), one)
    np.testing.assert_array_equal(second.whole(), other)
    assert not list(tmp_path.iterdir())


def test_parts_of_rows_are_put_and_added_to_as_in_an_array(tmp_path):
    """Windows that overlap, of which some places are never put."""
    rng, room = np.random.default_rng(6), Scratch(tmp_path / "out.h5")
    room((2, 3))
    kept, array = room((4, 3, 9, 8)), np.zeros((4, 3, 9, 8), np.float32)
    windows = [
        (slice(None), slice(None), slice(2, 7), slice(1, 5)),
        (slice(1, 3), slice(0, 2), slice(0, 4), slice(3, 8)),
        (3, slice(None), slice(6, 9), slice(0, 8)),
        (2, 1, slice(1, 9)),
    ]
    for window in windows:
        values = rng.normal(size=array[window].shape).astype(np.float32)
        array[window] += values
        kept[window] += values
        np.testing.assert_array_equal(kept[window], array[window])
    np.testing.assert_array_equal(kept.whole(), array)


def test_a_file_that_cannot_be_made_or_written_is_an_output_error(monkeypatch, tmp_path):
    with pytest.raises(OutputError, match="its pictures cannot be kept beside it"):
        Scratch(tmp_path / "gone" / "out.h5")((2, 4, 4))
    room = Scratch(tmp_path / "out.h5")((2, 4, 4))

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(OutputError, match=r"kept beside it \(No space left"):
        room[1, slice(0, 2)] = np.ones((2, 4))
