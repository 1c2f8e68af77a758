"""Artefacts written in pieces: the same bytes as held in memory, whole or not at all; matrices
split into shards.
"""

import os
import subprocess
import sys

import numpy as np
import pytest

from plenocli.base.budget import Budget, within
from plenocli.base.errors import InputError, NumericsError, OutputError, UsageError
from plenocli.base.tiling import InParts
from plenocli.files import atomic
from plenocli.files.artefacts import sparse
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.reading import opened_artefact, read_artefact
from plenocli.files.artefacts.shards import pif_parts, read_pif, shard_path, writing_pif
from plenocli.files.artefacts.sparse import PAGE, SparseFile
from plenocli.files.artefacts.stream import streamed_artefact
from plenocli.files.artefacts.writing import write_artefact
from tests.peak import PEAK

SHAPE = (2, 3, 6, 4)


def pif(A, notes="short"):
    rng = np.random.default_rng(3)
    return Artefact(
        "pif",
        {
            "pif/A": A,
            "pif/wavelength": [5e-7, 6e-7],
            "pif/lenslet_offset": np.array([[0, -1], [0, 0], [0, 1]]),
            "pif/pixel_shape": [2, 3],
            "pif/object_shape": [2, 2],
            "pif/column_energy": rng.random((2, 4)),
            "pif/singular_values": np.ones((2, 4)),
        },
        {"pif": {"rank": [4, 4], "condition": np.inf, "kappa": -0.5, "notes": {"text": notes}}},
        Provenance(command="plenocli simulate-pif", config="# µm\n"),
    )


def matrix(dtype=np.float32):
    return np.random.default_rng(1).random(SHAPE).astype(dtype)


def write_streamed(path, A, notes="short", **options):
    with streamed_artefact(path, "pif", "pif/A", A.shape, A.dtype, **options) as stream:
        for band in (1, 0):
            for lenslet in (2, 0, 1):
                stream.put((band, lenslet), A[band, lenslet])
        stream.close(pif(None, notes))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("notes", ["short", "long " * 20_000], ids=["short", "long"])
def test_pieces_in_any_order_give_the_bytes_of_the_whole(tmp_path, dtype, notes):
    A = matrix(dtype)
    write_artefact(tmp_path / "whole.h5", pif(A, notes))
    write_streamed(tmp_path / "pieces.h5", A, notes)
    assert (tmp_path / "whole.h5").read_bytes() == (tmp_path / "pieces.h5").read_bytes()
    found = read_artefact(tmp_path / "pieces.h5", "pif")
    assert np.array_equal(found.data["pif/A"], A) and found.attrs["pif"]["notes"]["text"] == notes


@pytest.mark.parametrize("call", ["pwrite", "fsync", "replace", "ftruncate", "pread"])
def test_failing_the_nth_call_leaves_no_file(tmp_path, each_failure, call):
    for done in each_failure(call, lambda: write_streamed(tmp_path / "a.h5", matrix())):
        # the folder's own: the file is whole by then
        if done or (call == "fsync" and (tmp_path / "a.h5").exists()):
            read_artefact(tmp_path / "a.h5", "pif")
            (tmp_path / "a.h5").unlink()
        assert os.listdir(tmp_path) == []


def test_short_writes_are_continued(tmp_path, monkeypatch):
    real = os.pwrite
    write_streamed(tmp_path / "whole.h5", matrix())
    monkeypatch.setattr(
        atomic.os, "pwrite", lambda descriptor, view, offset: real(descriptor, view[:100], offset)
    )
    write_streamed(tmp_path / "short.h5", matrix())
    assert (tmp_path / "whole.h5").read_bytes() == (tmp_path / "short.h5").read_bytes()


def test_a_file_size_limit_is_an_output_error(tmp_path):
    code = (
        "import signal, sys, resource; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "import numpy as np; from plenocli.files.artefacts.stream import streamed_artefact; from "
        "plenocli.base.errors import OutputError\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, 1 << 16))\n"
        "try:\n"
        "    with streamed_artefact(sys.argv[1], 'pif', 'pif/A', (1, 1, 500, 100), 'f4') as s: "
        "s.put((0, 0), np.ones((500, 100)))\n"
        "except OutputError as e: print('refused', e)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.h5")], capture_output=True, text=True
    )
    assert done.returncode == 0 and "refused" in done.stdout and os.listdir(tmp_path) == []


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e-3])
def test_values_that_the_table_forbids_are_refused(tmp_path, value):
    A = matrix()
    A[1, 0, 2, 3] = value
    with pytest.raises(ValueError, match="holds values"):
        write_streamed(tmp_path / "a.h5", A)
    assert os.listdir(tmp_path) == []


def test_a_stream_that_is_not_complete_is_refused(tmp_path):
    with pytest.raises(ValueError, match="lacks 24 values"):
        with streamed_artefact(tmp_path / "a.h5", "pif", "pif/A", SHAPE, "f4") as stream:
            for index in np.ndindex(2, 3):
                if index != (1, 1):
                    stream.put(index, np.ones((6, 4)))
            stream.close(pif(None))
    with pytest.raises(ValueError, match="not closed"):
        with streamed_artefact(tmp_path / "a.h5", "pif", "pif/A", SHAPE, "f4"):
            pass
    with pytest.raises(ValueError, match="takes"):
        with streamed_artefact(tmp_path / "a.h5", "pif", "pif/A", SHAPE, "f4") as stream:
            stream.put((0, 0), np.ones((4, 6)))
    assert os.listdir(tmp_path) == []


def test_sparse_file_behaves_as_a_file():
    rng, sparse, plain = np.random.default_rng(5), SparseFile(), bytearray()
    for _ in range(200):
        offset, length = int(rng.integers(0, 5 * PAGE)), int(rng.integers(0, 2 * PAGE))
        data = rng.integers(0, 256, length, dtype=np.uint8).tobytes()
        sparse.seek(offset)
        assert sparse.write(data) == length
        if length:
            plain.extend(bytes(max(0, offset + length - len(plain))))
            plain[offset : offset + length] = data
        start, count = int(rng.integers(0, 8 * PAGE)), int(rng.integers(0, 3 * PAGE))
        sparse.seek(start)
        assert sparse.read(count) == bytes(plain[start : start + count])
    assert sparse.seek(0, os.SEEK_END) == len(plain)
    sparse.seek(10**15)
    sparse.write(b"far")
    assert len(sparse.pages) < 20


def write_shards(path, A, **options):
    with writing_pif(path, A.shape, A.dtype, groups=((0,), (1, 2)), **options) as writer:
        for band in range(2):
            for lenslet in (1, 0, 2):
                writer.put(band, lenslet, A[band, lenslet])
        writer.close(pif(None))


def test_shards_are_artefacts_and_come_back_together(tmp_path):
    A = matrix()
    write_shards(tmp_path / "pif.h5", A)
    assert sorted(os.listdir(tmp_path)) == ["pif.000.h5", "pif.001.h5", "pif.h5"]
    second = read_artefact(shard_path(tmp_path / "pif.h5", 1), "pif")
    assert np.array_equal(second.data["pif/A"], A[:, 1:]) and second.data[
        "pif/lenslet_offset"
    ].tolist() == [[0, 0], [0, 1]]
    assert second.data["pif/column_energy"] == pytest.approx(A[:, 1:].sum(axis=(1, 2)), rel=1e-6)
    whole = read_pif(tmp_path / "pif.h5")
    write_artefact(tmp_path / "whole.h5", pif(A))
    other = read_pif(tmp_path / "whole.h5")
    assert set(whole.data) == set(other.data) and all(
        np.array_equal(whole.data[k], other.data[k]) for k in other.data
    )
    assert repr(whole.attrs) == repr(other.attrs) and whole.kind == "pif"
    assert [lenslets.tolist() for lenslets, _ in pif_parts(tmp_path / "pif.h5")] == [[0], [1, 2]]
    with pytest.raises(UsageError):
        write_shards(tmp_path / "pif.h5", A)
    write_shards(tmp_path / "pif.h5", 2 * A, overwrite=True)
    assert np.array_equal(read_pif(tmp_path / "pif.h5").data["pif/A"], 2 * A)


def test_shards_that_do_not_belong_are_refused(tmp_path):
    A, index = matrix(), tmp_path / "pif.h5"
    write_shards(index, A)
    with within(Budget(500)), pytest.raises(NumericsError, match="to be read"):
        read_pif(index)
    good = shard_path(index, 0).read_bytes()
    write_shards(tmp_path / "other.h5", A + 1)
    shard_path(index, 0).write_bytes(shard_path(tmp_path / "other.h5", 0).read_bytes())
    with pytest.raises(InputError, match="not the file that pif.h5"):
        read_pif(index)
    shard_path(index, 0).write_bytes(good[:-1])
    with pytest.raises(InputError):
        read_pif(index)
    shard_path(index, 0).unlink()
    with pytest.raises(InputError, match="does not exist"):
        read_pif(index)


def test_an_index_cannot_point_elsewhere(tmp_path):
    write_shards(tmp_path / "pif.h5", matrix())
    found = read_artefact(tmp_path / "pif.h5", "pif-index")
    for name in ("../pif.000.h5", "/etc/passwd", "", 3):
        found.attrs["pif"]["shards"][0]["name"] = name
        write_artefact(tmp_path / "bad.h5", found, overwrite=True)
        with pytest.raises(InputError):
            read_pif(tmp_path / "bad.h5")


def test_failure_in_the_middle_leaves_no_shard(tmp_path):
    with pytest.raises(RuntimeError):
        with writing_pif(tmp_path / "pif.h5", SHAPE, "f4", groups=((0,), (1, 2))) as writer:
            writer.put(0, 0, np.ones((6, 4)))
            raise RuntimeError("stopped")
    assert os.listdir(tmp_path) == []


def test_streaming_holds_one_piece_in_memory(tmp_path):
    code = (
        "import sys, numpy as np; from plenocli.files.artefacts.stream import streamed_artefact; "
        "from plenocli.files.artefacts.container import Artefact; from "
        "plenocli.files.artefacts.provenance import Provenance\n"
        "shape = (1, 40, 1000, 1000); piece = np.full(shape[2:], 1e-6, 'f4')\n"
        f"before = {PEAK}\n"
        "with streamed_artefact(sys.argv[1], 'pif', 'pif/A', shape, 'f4') as s:\n"
        "    for l in range(40): s.put((0, l), piece)\n"
        "    s.close(Artefact('pif', {'pif/wavelength': [5e-7], 'pif/lenslet_offset': "
        "np.zeros((40, 2), int), 'pif/pixel_shape': [10, 100],\n"
        "        'pif/object_shape': [10, 100], 'pif/column_energy': np.ones((1, 1000))}, {}, "
        "Provenance(command='test')))\n"
        f"print({PEAK} - before)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.h5")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert os.path.getsize(tmp_path / "a.h5") > 160_000_000 and int(done.stdout) < 40_000  # KiB


def capture(step=None, rows=900, columns=1301):
    """A capture whose mosaic and scene are held in memory, or come in parts of `step` rows."""
    rng = np.random.default_rng(5)
    mosaic = rng.integers(0, 4096, (rows, columns)).astype(np.uint16)
    scene = rng.random((2, rows, columns)).astype(np.float32)
    large = {"capture/mosaic": mosaic, "capture/scene": scene}
    if step is not None:
        large = {
            name: InParts(
                shape=values.shape,
                dtype=values.dtype,
                parts=lambda v=values: (
                    plane[start : start + step]
                    for plane in v.reshape(-1, rows, columns)
                    for start in range(0, rows, step)
                ),
            )
            for name, values in large.items()
        }
    small = {"capture/cfa": "mono", "capture/wavelength": [5e-7, 6e-7]}
    return Artefact("capture", small | large, {"capture": {"units": "DN"}})


@pytest.mark.parametrize("step", [1, 77, 900])
def test_compressed_datasets_in_parts_give_the_same_bytes_as_whole_ones(tmp_path, step):
    write_artefact(tmp_path / "whole.h5", capture())
    write_artefact(tmp_path / "parts.h5", capture(step))
    assert (tmp_path / "whole.h5").read_bytes() == (tmp_path / "parts.h5").read_bytes()


def test_windows_of_a_stored_dataset_are_those_of_the_whole(tmp_path):
    write_artefact(tmp_path / "c.h5", capture(50))
    whole = read_artefact(tmp_path / "c.h5").data
    apart = ("capture/mosaic", "capture/scene", "capture/lenslet_centre")
    with opened_artefact(tmp_path / "c.h5", "capture", apart) as (artefact, stored):
        assert set(artefact.data) == {"capture/cfa", "capture/wavelength"}
        assert set(stored) == {"capture/mosaic", "capture/scene"}
        for name, values in stored.items():
            part = values.window(slice(100, 333), slice(7, 1200))
            assert values.shape == whole[name].shape
            np.testing.assert_array_equal(part, whole[name][..., 100:333, 7:1200])
    content = bytearray((tmp_path / "c.h5").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "c.h5").write_bytes(content)
    with (
        pytest.raises(InputError, match="damaged"),
        opened_artefact(tmp_path / "c.h5", "capture", apart),
    ):
        pass


def test_a_disk_that_is_full_amid_the_parts_leaves_the_old_file(tmp_path, monkeypatch):
    (tmp_path / "c.h5").write_bytes(b"old")

    def full(descriptor, offset, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(sparse, "write_at", full)
    with pytest.raises(OutputError, match="No space left"):
        write_artefact(tmp_path / "c.h5", capture(100), overwrite=True)
    assert (tmp_path / "c.h5").read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["c.h5"]


def test_parts_that_break_the_table_or_do_not_fill_it_are_refused(tmp_path):
    def mosaic(parts):
        return Artefact(
            "capture",
            {
                "capture/cfa": "mono",
                "capture/mosaic": InParts(shape=(6, 4), dtype=np.float64, parts=lambda: parts),
            },
            {"capture": {"units": "DN"}},
        )

    for parts, said in (
        ([np.ones((3, 4)), np.full((3, 4), np.nan)], "NaN"),
        ([np.ones((3, 4))], "lacks rows"),
    ):
        with pytest.raises(ValueError, match=said):
            write_artefact(tmp_path / "c.h5", mosaic(parts))
    assert not list(tmp_path.iterdir())
