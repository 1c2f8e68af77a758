"""Captures from containers of others: pages of TIFF, Lytro's containers packed here bit by bit,
and what bioio finds.
"""

import hashlib
import json
import sys
import types

import numpy as np
import pytest
import tifffile

from plenocli.base.errors import InputError
from plenocli.files.images import containers
from plenocli.files.images.mosaic import read_capture


@pytest.fixture
def frames():
    return np.random.default_rng(1).integers(0, 4096, (4, 24, 30)).astype(np.uint16)


def test_one_exposure_in_an_ome_tiff_is_read(tmp_path, frames):
    path = tmp_path / "one.ome.tif"
    tifffile.imwrite(path, frames[0][None, None, None], metadata={"axes": "TCZYX"}, ome=True)
    found = read_capture(path)
    assert np.array_equal(found.mosaic, frames[0]) and found.levels.white == 65535


def test_pages_without_a_meaning_are_averaged_and_a_note_says_so(tmp_path, frames, capsys):
    path = tmp_path / "pages.tif"
    with tifffile.TiffWriter(path) as file:
        for frame in frames:
            file.write(frame, contiguous=False)
    found = read_capture(path, cfa="RGGB")
    assert np.allclose(found.mosaic, frames.astype(float).mean(axis=0))
    assert found.cfa == "RGGB" and found.levels.white == 65535
    assert "4 pages are averaged" in capsys.readouterr().err


@pytest.mark.parametrize("axes, word", [("TYX", "4 times"), ("ZYX", "4 planes"), ("CYX", "4 chan")])
def test_a_movie_a_stack_and_channels_are_no_capture(tmp_path, frames, axes, word):
    path = tmp_path / "many.ome.tif"
    tifffile.imwrite(path, frames, metadata={"axes": axes}, ome=True, photometric="minisblack")
    with pytest.raises(InputError, match=f"{word}.*one exposure"):
        read_capture(path)


def test_a_cut_off_stack_is_refused(tmp_path, frames):
    path = tmp_path / "cut.tif"
    tifffile.imwrite(path, frames, photometric="minisblack")
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(InputError):
        read_capture(path)


def chunk(kind, content):
    """A chunk of Lytro's container: head, size, digest, padding to 80 bytes, content, to 16."""
    name = f"sha1-{hashlib.sha1(content).hexdigest()}"
    head = b"\x89" + kind + b"\r\n\x1a\n" + (0).to_bytes(4, "big") + len(content).to_bytes(4, "big")
    body = head + name.encode() + bytes(35) + content
    return name, body + bytes(-len(body) % 16 or 16)


def container(path, packed, about, count=3):
    """A file as the camera writes it; `count` chunks beside the table of contents, whose length is
    such that 5 zeros follow it, on which imageio counts.
    """
    parts = [chunk(b"LFC", content) for content in (packed, about, b'{"serial": "none"}')]
    refs = dict(zip(("imageRef", "metadataRef", "privateMetadataRef"), (n for n, _ in parts)))
    if path.suffix == ".lfp":
        contents = {"picture": {"frameArray": [{"frame": refs}]}}
    else:
        contents = {"frames": [{"frame": refs}]}
        parts += [chunk(b"LFC", b"%d" % k) for k in range(count - 3)]
    text = json.dumps(contents).encode()
    table = chunk(b"LFM", text + b" " * ((11 - len(text)) % 16))[1]
    head = b"\x89LFP\r\n\x1a\n" + (1).to_bytes(4, "big") + bytes(4)
    body = b"".join(part for _, part in parts)
    order = table + body if path.suffix == ".lfp" else body + table
    path.write_bytes(head + order + b"\x01")


def of_twelve(values):
    left, right = values[:, 0::2].ravel(), values[:, 1::2].ravel()
    packed = np.stack([left >> 4, (left & 15) << 4 | right >> 8, right & 255], axis=1)
    return packed.astype(np.uint8).tobytes()


def of_ten(values):
    four = values.reshape(-1, 4)
    low = (four & 3) << np.array([0, 2, 4, 6])
    packed = np.concatenate([four >> 2, low.sum(axis=1, keepdims=True)], axis=1)
    return packed.astype(np.uint8).tobytes()


BLACK = {"r": 168, "gr": 169, "gb": 170, "b": 171}
MATRIX = [3.0, -1.5, -0.5, -0.7, 2.5, -0.8, -0.1, -1.2, 2.3]


def first_camera(shape):
    raw = {
        "pixelFormat": {"black": BLACK, "white": {"gr": 4095}},
        "pixelPacking": {"bitsPerPixel": 12},
        "mosaic": {"tile": "r,gr:gb,b", "upperLeftPixel": "b"},
    }
    colour = {"ccmRgbToSrgbArray": MATRIX}
    colour["whiteBalanceGain"] = {"r": 1.25, "gr": 1.0, "gb": 1.0, "b": 1.5}
    image = {"height": shape[0], "width": shape[1], "rawDetails": raw, "color": colour}
    about = {"camera": {"make": "Lytro, Inc.", "model": "F"}, "image": image}
    return about | {"devices": {"shutter": {"pixelExposureDuration": 0.004}}}


def test_the_first_lytro_s_container(tmp_path):
    values = np.random.default_rng(2).integers(100, 4096, (40, 60)).astype(np.uint16)
    path = tmp_path / "shot.lfp"
    container(path, of_twelve(values), json.dumps(first_camera(values.shape)).encode())
    found = read_capture(path)
    assert np.array_equal(found.mosaic, values) and found.cfa == "BGGR"
    assert found.levels.black.tolist() == [[171, 170], [169, 168]]
    assert found.exposure_s == 0.004 and found.metadata.camera == "Lytro, Inc. F"
    assert np.allclose(found.profile.to_rgb, np.reshape(MATRIX, (3, 3)))
    assert np.allclose(found.profile.neutral, [0.8, 1, 2 / 3])


def test_the_illum_s_container_and_damaged_ones(tmp_path):
    values = np.random.default_rng(3).integers(60, 1024, (24, 40)).astype(np.uint16)
    image = {"height": 24, "width": 40, "pixelPacking": {"bitsPerPixel": 10}}
    image |= {"pixelFormat": {"black": {"gr": 64}}, "mosaic": {"upperLeftPixel": "gr"}}
    path = tmp_path / "shot.lfr"
    container(path, of_ten(values), json.dumps({"image": image}).encode(), 11)
    found = read_capture(path)
    assert np.array_equal(found.mosaic, values) and found.cfa == "GRBG"
    assert found.levels.white == 1023 and found.levels.black.tolist() == [[64, 0], [0, 0]]
    whole = path.read_bytes()
    for size in (20, 100, 700, len(whole) // 2, len(whole) - 120):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError):
            read_capture(path)
    container(path, of_ten(values)[:50], json.dumps({"image": image}).encode(), 11)
    with pytest.raises(InputError, match="are not 24 x 40 values"):
        read_capture(path)
    image |= {"height": 10**7, "width": 10**7}
    container(path, of_ten(values), json.dumps({"image": image}).encode(), 11)
    with pytest.raises(InputError):
        read_capture(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["shot.lfp", "shot.lfr"])
def test_imageio_reads_the_same_of_whole_sensors(tmp_path, name):
    from imageio import v2

    path, rng = tmp_path / name, np.random.default_rng(3)
    if name == "shot.lfp":
        values = rng.integers(60, 4096, (3280, 3280)).astype(np.uint16)
        container(path, of_twelve(values), json.dumps(first_camera(values.shape)).encode())
        theirs = 4095 * v2.imread(path, format="LYTRO-LFP")
    else:
        values = rng.integers(60, 1024, (5368, 7728)).astype(np.uint16)
        image = {"height": 5368, "width": 7728, "pixelPacking": {"bitsPerPixel": 10}}
        container(path, of_ten(values), json.dumps({"image": image}).encode(), 11)
        theirs = 1023 * v2.imread(path, format="LYTRO-LFR", include_thumbnail=False)
    assert np.array_equal(read_capture(path).mosaic, values)
    assert np.abs(theirs - values).max() < 1e-6


def test_microscopes_files_need_bioio_and_one_exposure(tmp_path, monkeypatch, frames):
    path = tmp_path / "shot.czi"
    path.write_bytes(b"ZISRAWFILE" + bytes(200))
    monkeypatch.setitem(sys.modules, "bioio", None)
    with pytest.raises(InputError, match="needs bioio"):
        read_capture(path)

    class Image:
        def __init__(self, _):
            self.data, self.shape = data, data.shape
            self.dims = types.SimpleNamespace(order="TCZYX")

    monkeypatch.setitem(sys.modules, "bioio", types.SimpleNamespace(BioImage=Image))
    data = frames[:1, None, None]
    assert np.array_equal(read_capture(path).mosaic, frames[0])
    data = frames[:, None, None]
    with pytest.raises(InputError, match="4 times"):
        read_capture(path)


def test_a_container_without_a_capture_is_refused(tmp_path):
    path = tmp_path / "shot.bin"
    path.write_bytes(containers.LYTRO + bytes(100))
    with pytest.raises(InputError, match="no capture of a Lytro"):
        read_capture(path)
