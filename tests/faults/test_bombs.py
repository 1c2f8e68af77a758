"""Small files that declare or hide something huge, or point elsewhere: refused within a second
of processor time and 200 MB, with their name.
"""

import hashlib
import struct
import zlib

import h5py
import numpy as np
import pytest

from tests.faults.harness import is_clean_refusal
from tests.faults.test_resealed import resealed
from tests.files import test_container as hdf5


def _chunks_of_zeros(file):
    file.create_dataset(
        "spectra/leak",
        (40_000, 40_000),
        "f8",
        chunks=(5000, 5000),
        compression="gzip",
        fillvalue=0.0,
    )


def _long_attribute(file):
    file["spectra"].attrs.create("notes", np.zeros(8000, dtype="f8"))


def _many_groups(file):
    for number in range(3000):
        file.create_group(f"spectra/g{number}")


def _deep_groups(file):
    file.create_group("/".join(["g"] * 800))


def _wide_text(file):
    file.create_dataset("spectra/leak", (1,), dtype="S2000000000", chunks=(1,), compression="gzip")


HDF5 = [
    hdf5._external_link,
    hdf5._soft_link,
    hdf5._loop,
    hdf5._external_storage,
    hdf5._virtual,
    hdf5._objects,
    hdf5._ragged,
    hdf5._reference,
    hdf5._bomb,
    hdf5._overflowing_bomb,
    hdf5._filter,
    hdf5._attribute_object,
    _chunks_of_zeros,
    _long_attribute,
    _many_groups,
    _deep_groups,
    _wide_text,
]


@pytest.mark.parametrize("make", HDF5, ids=lambda make: make.__name__.strip("_"))
def test_hdf5_with_a_valid_digest(runner, tmp_path, count, make):
    hdf5.hostile(tmp_path / "bomb.h5", make)
    outcome = runner.run(["inspect", "bomb.h5"], tmp_path, limit=10)
    assert is_cheap_refusal(outcome), outcome
    count("bombs", refused=1)


def test_text_and_numbers_that_their_table_allows_are_held_by_the_limit_of_memory(
    runner, stages, tmp_path
):
    """What is legal of any length, and packs well, is read within --mem-limit or not at all."""

    def longer(file):
        for name, entry in file["sweep"].items():
            if entry.shape and name in ("key", "status"):
                kind = "S64" if name == "key" else entry.dtype
                del file["sweep"][name]
                file["sweep"].create_dataset(
                    name, (4_000_000,), kind, chunks=(65536,), compression="gzip"
                )

    (tmp_path / "bomb.h5").write_bytes(resealed((stages[0] / "sweep.h5").read_bytes(), longer))
    outcome = runner.run(["inspect", "bomb.h5", "--mem-limit", "64MiB"], tmp_path, limit=10)
    assert is_clean_refusal(outcome, (3, 5), "bomb") and outcome.grown < 200e6, outcome


def test_superblocks_that_declare_a_huge_file(runner, stages, tmp_path):
    """Sizes and addresses that HDF5 believes before anybody can look at an object;
    found by the fuzzer.
    """
    whole = (stages[0] / "image.h5").read_bytes()
    for place in range(8, 48, 4):
        image = bytearray(whole[512:])
        image[place : place + 8] = (2**60 + 2**33).to_bytes(8, "little")
        head = (
            (
                "plenocli artefact 1\n"
                f"sha256 {hashlib.sha256(image).hexdigest()}\n"
                f"bytes {len(image)}\n"
            )
            .encode()
            .ljust(512, b"\0")
        )
        (tmp_path / "bomb.h5").write_bytes(head + image)
        outcome = runner.run(["inspect", "bomb.h5"], tmp_path, limit=10)
        assert outcome.code == 0 or is_cheap_refusal(outcome), (place, outcome)


def test_a_plain_hdf5_bomb_is_not_opened_at_all(runner, tmp_path):
    with h5py.File(tmp_path / "bomb.h5", "w") as file:
        hdf5._bomb(file)
    outcome = runner.run(["inspect", "bomb.h5"], tmp_path, limit=10)
    assert is_cheap_refusal(outcome), outcome


def is_cheap_refusal(outcome):
    return is_clean_refusal(outcome, 3, "bomb") and outcome.cpu < 1 and outcome.grown < 200e6


def _exr(width, height, channels=("Y",), tail=b""):
    """An EXR file whose header is all there is."""
    names = (
        b"".join(c.encode() + b"\0" + struct.pack("<iB3xii", 2, 0, 1, 1) for c in channels) + b"\0"
    )
    window = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    fields = [
        (b"channels", b"chlist", names),
        (b"compression", b"compression", b"\3"),
        (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window),
        (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1)),
        (b"screenWindowCenter", b"v2f", bytes(8)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1)),
    ]
    return (
        b"\x76\x2f\x31\x01\x02\0\0\0"
        + b"".join(n + b"\0" + t + b"\0" + struct.pack("<i", len(v)) + v for n, t, v in fields)
        + b"\0"
        + tail
    )


def _png(width, height, data=b"", bits=8, colours=2):
    def chunk(kind, content):
        return (
            struct.pack(">I", len(content))
            + kind
            + content
            + struct.pack(">I", zlib.crc32(kind + content))
        )

    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colours, 0, 0, 0))
        + chunk(b"IDAT", data)
        + chunk(b"IEND", b"")
    )


def _tiff(tags):
    """A little-endian TIFF with one directory of LONG tags."""
    entries = b"".join(
        struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(tags.items())
    )
    return b"II*\0\x08\0\0\0" + struct.pack("<H", len(tags)) + entries + bytes(4) + bytes(64)


RASTER = {
    256: 4_000_000,
    257: 4_000_000,
    258: 8,
    259: 1,
    262: 1,
    273: 8,
    277: 1,
    278: 4_000_000,
    279: 1,
}
RAW = {**RASTER, 50706: 0x00000401, 262: 32803, 258: 16, 33421: 0x00020002, 33422: 0x02010100}
FILES = {
    "wide.exr": _exr(2**30, 2**30),
    "tall.exr": _exr(1, 2**31 - 1),
    "many.exr": _exr(8, 8, [f"c{n:05d}" for n in range(9000)]),
    "empty.exr": _exr(8, 8),
    "backwards.exr": _exr(-5, -5),
    "big.png": _png(2**31 - 1, 2**31 - 1),
    "squeezed.png": _png(60_000, 60_000, zlib.compress(bytes(50_000_000))),
    "big.tif": _tiff(RASTER),
    "big.dng": _tiff(RAW),
    "loop.tif": b"II*\0\x08\0\0\0\x01\0"
    + struct.pack("<HHII", 256, 4, 1, 9)
    + struct.pack("<I", 8),
}


@pytest.mark.parametrize("name", FILES)
def test_pictures_and_raw_files(runner, tmp_path, count, name):
    (tmp_path / f"bomb-{name}").write_bytes(FILES[name])
    outcome = runner.run(["inspect", f"bomb-{name}"], tmp_path, limit=10)
    assert is_cheap_refusal(outcome), outcome
    count("bombs", refused=1)


CONFIGS = {
    "deep": "a = " + "[" * 100_000,
    "deep tables": "[" + ".".join("a" * 50_000) + "]",
    "long": "x = 1\n" * 2_000_000,
    "number": "[sensor]\nbits = " + "9" * 100_000,
    "binary": "\0" * 5000,
    "long word": '[main_lens]\nfocal_length = "' + "5" * 1_000_000 + ' mm"',
}


@pytest.mark.parametrize("name", CONFIGS)
def test_descriptions(runner, tmp_path, count, name):
    (tmp_path / "bomb.toml").write_text(CONFIGS[name])
    outcome = runner.run(["simulate-pif", "bomb.toml", "--explain"], tmp_path, limit=10)
    assert (
        is_clean_refusal(outcome, (2, 3), "bomb.toml")
        and outcome.cpu < 2
        and outcome.grown < 200e6
        and len(outcome.text) < 5000
    ), (outcome.code, outcome.text[:2000], outcome.grown)
    count("bombs", refused=1)
