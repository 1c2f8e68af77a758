"""Mosaics come from their decoders in bands of rows, and lie in a file where they are large beside
the memory: what is read there is what the file holds, and damage is told as ever.
"""

import os
import re
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile

from plenocli.base.budget import Budget, within
from plenocli.base.errors import InputError, NumericsError, OutputError
from plenocli.base.tiling import Plane
from plenocli.files.images.dng import write_dng
from plenocli.files.images.exr import write_exr
from plenocli.files.images.in_bands import put_together, whole_bands
from plenocli.files.images.mosaic import capture_in_file, read_capture, stored_capture
from plenocli.files.outside import outside, outside_in_parts
from plenocli.files.scratch import Scratch
from tests.peak import PEAK

ROOT = Path(__file__).resolve().parents[2]
SHAPE = (1111, 743)
LITTLE = Budget(5 << 20)
"""Of which one part in 16 is less than any mosaic here; a decoder gets along with it."""


def numbers(dtype, seed=1):
    drawn = np.random.default_rng(seed).integers(0, 4000, SHAPE)
    return drawn.astype(dtype)


def by_oiio(path, values, **said):
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], 1, "uint16")
    for name, value in said.items():
        spec.attribute(name, value)
    spec.tile_width = spec.tile_height = 64 if said.get("tiled") else 0
    output = oiio.ImageOutput.create(str(path))
    written = output.write_image
    assert output.open(str(path), spec) and written(values[..., None]) and output.close()


WRITERS = {
    "x.png": lambda path, values: by_oiio(path, values),
    "strips.tif": lambda path, values: tifffile.imwrite(path, values),
    "one-strip.tif": lambda path, values: tifffile.imwrite(
        path, values, rowsperstrip=len(values), compression="zlib"
    ),
    "tiles.tif": lambda path, values: by_oiio(path, values, tiled=1, compression="lzw"),
    "float.tif": lambda path, values: tifffile.imwrite(path, values.astype(np.float32) / 7),
    "three.tif": lambda path, values: tifffile.imwrite(path, np.stack([values] * 3, axis=-1)),
    "x.dng": lambda path, values: write_dng(path, values, cfa="GBRG", black=0, white=4095),
    "x.exr": lambda path, values: write_exr(path, {"Y": values.astype(np.float32)}),
}


def kept(path, folder, memory=LITTLE, **how):
    """The capture of a file whose mosaic has no room in memory."""
    with within(memory):
        return capture_in_file(path, room=Scratch(folder / "out.h5"), **how)


@pytest.mark.parametrize("name", WRITERS)
def test_what_stays_in_a_file_is_what_was_written(tmp_path, name):
    values = numbers(np.uint16)
    WRITERS[name](tmp_path / name, values)
    true = values.astype(np.float32) / 7 if name == "float.tif" else values
    found, whole = kept(tmp_path / name, tmp_path), read_capture(tmp_path / name)
    assert isinstance(found.mosaic, Plane) and isinstance(whole.mosaic, np.ndarray)
    assert found.shape == SHAPE and sorted(p.name for p in tmp_path.iterdir()) == [name]
    np.testing.assert_array_equal(whole.mosaic, true)
    for rows, columns in (
        (slice(0, 1111), slice(0, 743)),
        (slice(3, 4), slice(700, 743)),
        (slice(640, 1111), slice(0, 1)),
    ):
        part = found.mosaic.read(rows, columns)
        np.testing.assert_array_equal(part, true[rows, columns])
        assert part.dtype == whole.mosaic.dtype
    assert found.levels.white == whole.levels.white and found.cfa == whole.cfa
    assert found.metadata == whole.metadata and found.exposure_s == whole.exposure_s


@pytest.mark.parametrize(
    "how", [{}, {"compression": "zlib", "rowsperstrip": 50}, {"byteorder": ">", "tile": (64, 64)}]
)
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_pages_of_a_stack_are_averaged_one_by_one(tmp_path, how, dtype):
    pages = np.stack([numbers(dtype, seed) for seed in range(5)])
    if dtype == np.float32:
        pages /= 7
    said = {"photometric": "minisblack", "metadata": {"axes": "IYX"}}
    tifffile.imwrite(tmp_path / "x.tif", pages, **said, **how)
    found = kept(tmp_path / "x.tif", tmp_path, Budget(8 << 20))  # a page twice
    whole = read_capture(tmp_path / "x.tif").mosaic
    assert isinstance(found.mosaic, Plane)
    part = found.mosaic.read(slice(0, 1111), slice(0, 743))
    for mean in (part, whole):
        assert mean.dtype == pages.mean(axis=0).dtype
        np.testing.assert_array_equal(mean, pages.mean(axis=0))
    content = (tmp_path / "x.tif").read_bytes()
    (tmp_path / "x.tif").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError):
        kept(tmp_path / "x.tif", tmp_path, Budget(8 << 20))


def interlaced(path, values):
    """A PNG of 16 bits in the seven passes of Adam7, as its specification has them."""
    firsts, steps = [(0, 0), (0, 4), (4, 0), (0, 2), (2, 0), (0, 1), (1, 0)], [8, 8, 4, 4, 2, 2, 1]
    passes = [
        values[row :: max(step, 2 * row), column :: max(step, 2 * column)]
        for (row, column), step in zip(firsts, steps)
    ]
    lines = [b"\0" + line.astype(">u2").tobytes() for part in passes for line in part]
    sides = b"".join(n.to_bytes(4, "big") for n in values.shape[::-1])
    chunks = [(b"IHDR", sides + bytes([16, 0, 0, 0, 1])), (b"IDAT", zlib.compress(b"".join(lines)))]
    with open(path, "wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for name, content in (*chunks, (b"IEND", b"")):
            file.write(len(content).to_bytes(4, "big") + name + content)
            file.write(zlib.crc32(name + content).to_bytes(4, "big"))


def test_an_interlaced_png_counts_whole(tmp_path):
    values = numbers(np.uint16)
    interlaced(tmp_path / "x.png", values)
    part = kept(tmp_path / "x.png", tmp_path).mosaic.read(slice(0, 1111), slice(0, 743))
    np.testing.assert_array_equal(part, values)
    with within(Budget(3 << 19)), pytest.raises(NumericsError, match="holds an interlaced PNG"):
        capture_in_file(tmp_path / "x.png", room=Scratch(tmp_path / "out.h5"))
    WRITERS["x.png"](tmp_path / "plain.png", values)
    with within(Budget(3 << 19)):
        capture_in_file(tmp_path / "plain.png", room=Scratch(tmp_path / "out.h5"))


def test_what_is_small_beside_the_memory_is_held(tmp_path):
    WRITERS["x.png"](tmp_path / "x.png", numbers(np.uint16))
    with within(Budget(16 * 2 * SHAPE[0] * SHAPE[1])):
        held = capture_in_file(tmp_path / "x.png", room=Scratch(tmp_path / "out.h5"))
    assert isinstance(held.mosaic, np.ndarray)


def test_stored_windows_of_any_file_are_parts_of_the_whole(tmp_path):
    """Levels go by the position of a pixel on the sensor."""
    values = numbers(np.uint16)
    levels = np.array([[3.0, 5.0], [7.0, 11.0]])
    write_dng(tmp_path / "x.dng", values, cfa="GBRG", black=levels, white=4095)
    with within(LITTLE), stored_capture(tmp_path / "x.dng", room=Scratch(tmp_path / "o")) as found:
        assert (found.shape, found.dtype.itemsize) == (SHAPE, 2)
        part = found.window(slice(5, 1000), slice(8, 12))
    np.testing.assert_array_equal(part.mosaic, values[5:1000, 8:12])
    np.testing.assert_array_equal(part.levels.black, levels[::-1])


@pytest.mark.parametrize("name", ["x.png", "strips.tif", "one-strip.tif", "x.dng"])
@pytest.mark.parametrize("share", [0.5, 0.97])
def test_a_file_that_ends_early_is_damaged_however_it_is_read(tmp_path, name, share):
    WRITERS[name](tmp_path / name, numbers(np.uint16))
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[: int(share * len(content))])
    said = []
    for read in (lambda: read_capture(tmp_path / name), lambda: kept(tmp_path / name, tmp_path)):
        with pytest.raises(InputError) as error:
            read()
        said.append(str(error.value))
    whole, parts = (re.sub(r"TIFFReadRawStrip [^:]*: ", "", text) for text in said)
    assert whole == parts and list(tmp_path.iterdir()) == [tmp_path / name]


def test_values_of_no_sensor_are_told_behind_the_last_band(tmp_path):
    values = numbers(np.float32)
    values[[2, 800, 1110], [3, 4, 742]] = np.nan, np.inf, -np.inf
    tifffile.imwrite(tmp_path / "x.tif", values)
    with pytest.raises(InputError, match="holds 3 values that are NaN or infinite"):
        kept(tmp_path / "x.tif", tmp_path)
    coloured = np.stack([numbers(np.uint16)] * 3, axis=-1)
    coloured[1100, 700, 2] += 1
    tifffile.imwrite(tmp_path / "x.tif", coloured)
    with pytest.raises(InputError, match="is a picture with 3 different channels"):
        kept(tmp_path / "x.tif", tmp_path)


def test_a_folder_that_is_full_is_told_and_the_decoder_goes_on_with_the_next(tmp_path, monkeypatch):
    values = numbers(np.uint16)
    WRITERS["x.png"](tmp_path / "x.png", values)
    with monkeypatch.context() as patched:

        def full(*arguments):
            raise OSError(28, "No space left on device")

        patched.setattr(os, "pwrite", full)
        with pytest.raises(OutputError, match=r"kept beside it \(No space left on device\)"):
            kept(tmp_path / "x.png", tmp_path)
    np.testing.assert_array_equal(read_capture(tmp_path / "x.png").mosaic, values)


def test_a_raw_decoder_holds_its_picture_and_says_so(tmp_path):
    WRITERS["x.dng"](tmp_path / "x.dng", numbers(np.uint16))
    with within(Budget(3 << 20)), pytest.raises(NumericsError, match="LibRaw holds the whole"):
        capture_in_file(tmp_path / "x.dng", room=Scratch(tmp_path / "out.h5"))


def test_a_picture_has_the_rows_that_its_head_told():
    def bands(*counts):
        return whole_bands("x", [np.ones((n, 4)) for n in counts], (7, 4))

    np.testing.assert_array_equal(put_together(bands(3, 4), (7, 4)), np.ones((7, 4)))
    for wrong in ((3, 3), (3, 5), (7, 0), ()):
        with pytest.raises(InputError, match="came back incomplete"):
            list(bands(*wrong))
    with pytest.raises(InputError, match="came back incomplete"):
        list(whole_bands("x", [np.ones((7, 3))], (7, 4)))


# --- what a decoder sends in parts; both run outside ----------------------------------------------


def counted(_, parts, fails):
    """`parts` arrays of 8 MB."""
    for number in range(parts):
        if number == fails:
            raise InputError("is damaged there", "a file", "mend it")
        yield {"number": number, "values": np.full(1 << 20, float(number))}


def test_parts_come_in_order_and_an_error_among_them_is_raised(tmp_path):
    found = outside_in_parts(counted, tmp_path / "x", 5, -1)
    assert [(p["number"], p["values"].mean()) for p in found] == [(n, n) for n in range(5)]
    told = outside_in_parts(counted, tmp_path / "x", 5, 2)
    assert [next(told)["number"], next(told)["number"]] == [0, 1]
    with pytest.raises(InputError, match="is damaged there"):
        next(told)
    abandoned = outside_in_parts(counted, tmp_path / "x", 5, -1)
    next(abandoned)
    abandoned.close()
    assert len(list(outside_in_parts(counted, tmp_path / "x", 3, -1))) == 3
    with pytest.raises(InputError, match="came back garbled"):
        outside(counted, tmp_path / "x", 3, -1)


# --- memory ---------------------------------------------------------------------------------------

READ = f"""
import sys, resource
from pathlib import Path
import numpy as np
from plenocli.base.budget import Budget, set_budget
from plenocli.base.tiling import Plane
from plenocli.files import outside
from plenocli.files.images.mosaic import capture_in_file
from plenocli.files.scratch import Scratch
set_budget(Budget(256 << 20))
path = Path(sys.argv[1])
shot = capture_in_file(path, room=Scratch(path.with_name("out.h5")))
seen = Plane.of(shot.mosaic)
total = sum(int(seen.read(slice(a, a + 500), slice(0, None)).sum(dtype=np.int64))
            for a in range(0, shot.shape[0], 500))
outside.close()
peak = {PEAK}
print(total, peak, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_neither_process_holds_a_large_mosaic(tmp_path, suffix):
    """97 megapixels, 186 MiB: each of two processes took that once."""
    values = np.broadcast_to(np.arange(9000, dtype=np.uint16) // 64, (10800, 9000))
    peaks = {}
    for name, part in (("small", values[:100]), ("large", values)):
        path = tmp_path / f"{name}{suffix}"
        by_oiio(path, np.ascontiguousarray(part), **{"png:compressionLevel": 1})
        done = subprocess.run(
            [sys.executable, "-c", READ, str(path)],
            env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=True,
        )
        total, *peaks[name] = map(int, done.stdout.split())
        assert total == int(part.sum(dtype=np.int64))
    grown = [(b - a) / 1024 for a, b in zip(peaks["small"], peaks["large"])]
    assert max(grown) < 48, grown  # MiB
