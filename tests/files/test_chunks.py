"""Chunks that we pack ourselves against HDF5, which packs and unpacks them without us."""

import zlib

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plenocli.base.tiling import InParts
from plenocli.files.artefacts import writing
from plenocli.files.artefacts.chunks import FILTERS, fletcher32, write_chunks
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact


@pytest.fixture
def file():
    with h5py.File("chunks", "w", driver="core", backing_store=False) as opened:
        yield opened


@pytest.mark.parametrize("kind", ["?", "u1", "i2", "f4", "f8", "c16", "S5"])
@pytest.mark.parametrize("shape, sides", [((7,), (3,)), ((10, 9), (4, 9)), ((3, 5, 8), (1, 2, 3))])
def test_hdf5_unpacks_what_was_packed(file, kind, shape, sides):
    values = np.random.default_rng(3).integers(0, 200, shape).astype(kind)
    made = file.create_dataset("a", shape, kind, chunks=sides, **FILTERS)
    write_chunks(made, [((0,) * len(shape), values)])
    assert np.array_equal(made[()], values)
    made.id.write_direct_chunk(
        (0,) * len(shape), _flipped(made.id.read_direct_chunk((0,) * len(shape))[1])
    )
    with pytest.raises(OSError):  # the checksum is looked at
        made[()]


def _flipped(packed: bytes) -> bytes:
    return packed[:-5] + bytes([packed[-5] ^ 1]) + packed[-4:]


def test_bytes_before_deflate_are_those_of_hdf5(file):
    """Padding of the last chunk included."""
    values = np.random.default_rng(4).normal(size=(10, 9))
    for name in ("ours", "hdf5"):
        file.create_dataset(name, values.shape, "f8", chunks=(4, 6), **FILTERS)
    write_chunks(file["ours"], [((0, 0), values)])
    file["hdf5"][:] = values
    for corner in [(0, 0), (8, 6), (4, 6)]:
        found = [file[name].id.read_direct_chunk(corner) for name in ("ours", "hdf5")]
        assert found[0][0] == found[1][0] == 0
        assert zlib.decompress(found[0][1][:-4]) == zlib.decompress(found[1][1][:-4])


@pytest.mark.parametrize(
    "content",
    [b"\0" * 64, b"\xff" * 64, b"\xff\xff\0\0", b"abc", b"\0\xff\xff\0\1", b"\xff" * 3_000_001]
    + [np.random.default_rng(5).bytes(n) for n in (2, 719, 720, 721, 100_001, 2_500_000)],
)
def test_the_checksum_is_that_of_hdf5(file, content):
    made = file.create_dataset("a", len(content), "u1", chunks=(len(content),), fletcher32=True)
    made[:] = np.frombuffer(content, "u1")
    stored = made.id.read_direct_chunk((0,))[1]
    assert stored[: len(content)] == content
    assert fletcher32(content) == int.from_bytes(stored[len(content) :], "little")


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_parts_of_any_size_make_the_bytes_of_the_whole(tmp_path_factory, data):
    """However the rows come, and whether chunks hold rows, planes or more."""
    shape = (
        data.draw(st.integers(1, 4)),
        data.draw(st.integers(1, 9)),
        data.draw(st.integers(1, 9)),
    )
    values = np.random.default_rng(6).random(shape)
    cuts = data.draw(st.lists(st.integers(1, 9), min_size=1, max_size=5))

    def parts():
        turn = 0
        for plane in values:
            at = 0
            while at < len(plane):
                step = cuts[turn % len(cuts)]
                yield plane[at : at + step]
                at, turn = at + step, turn + 1

    whole = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writing, "_CHUNK_BYTES", data.draw(st.integers(8, 3000)))
        for name, image in (
            ("array.h5", values),
            ("parts.h5", InParts(shape=shape, dtype=np.float64, parts=parts)),
        ):
            write_artefact(whole / name, Artefact("image", {"image/value": image}))
    assert (whole / "array.h5").read_bytes() == (whole / "parts.h5").read_bytes()
    assert np.array_equal(read_artefact(whole / "parts.h5").data["image/value"], values)
