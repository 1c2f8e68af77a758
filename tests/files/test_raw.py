"""RAW and DNG: mosaics bit by bit, levels by position, and a reason for every
file that is refused.
"""

import struct

import numpy as np
import pytest

from plenocli.base.budget import Budget, within
from plenocli.base.errors import InputError, NumericsError, OutputError
from plenocli.files.images.dng import read_notes, write_dng
from plenocli.files.images.mosaic import read_capture


def mosaic(shape, seed=0, top=16384):
    return np.random.default_rng(seed).integers(0, top, shape).astype(np.uint16)


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG", "mono"])
@pytest.mark.parametrize("shape", [(22, 22), (64, 50), (33, 47), (256, 377)])
def test_rawpy_reads_the_numbers_we_wrote(tmp_path, cfa, shape):
    import rawpy

    values, black = mosaic(shape), np.array([[512, 513], [514, 515]])
    write_dng(
        tmp_path / "x.dng",
        values,
        cfa=cfa,
        black=black if cfa != "mono" else 512,
        white=16383,
        exposure_s=1 / 60,
        iso=200,
    )
    with rawpy.imread(str(tmp_path / "x.dng")) as file:
        np.testing.assert_array_equal(file.raw_image, values)
        assert file.white_level == 16383 and file.other.iso_speed == 200
        assert file.other.shutter_speed == pytest.approx(1 / 60, rel=1e-6)
        if cfa == "mono":
            assert file.num_colors == 1 and file.black_level_per_channel[0] == 512
        else:
            letters = "".join(file.color_desc.decode()[i] for i in file.raw_pattern.ravel())
            assert letters == cfa
            np.testing.assert_array_equal(
                np.array(file.black_level_per_channel)[file.raw_pattern], black
            )


@pytest.mark.parametrize("cfa", ["RGGB", "GBRG", "mono"])
def test_our_reader_gives_back_everything(tmp_path, cfa):
    values = mosaic((40, 30))
    notes = {"gain_e_per_dn": 4.0, "band_m": 450e-9, "target": '<µ & "quotes">'}
    write_dng(
        tmp_path / "x.dng",
        values,
        cfa=cfa,
        black=[[64.5, 65], [66, 67]],
        white=16000,
        exposure_s=0.0125,
        xmp_json=notes,
    )
    back = read_capture(tmp_path / "x.dng")
    np.testing.assert_array_equal(back.mosaic, values)
    assert (
        back.cfa,
        back.levels.white,
        back.levels.gain,
        back.metadata.band_m,
        back.metadata.source,
        back.units,
    ) == (
        cfa,
        16000,
        0.25,
        450e-9,
        "dng",
        "DN",
    )
    np.testing.assert_array_equal(back.levels.black, [[64.5, 65], [66, 67]])
    assert back.exposure_s == pytest.approx(0.0125, rel=1e-6)
    assert back.metadata.details["target"] == notes["target"] and back.metadata.details["verified"]


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_levels_of_a_dng_without_our_notes_are_put_in_their_positions(tmp_path, cfa):
    write_dng(
        tmp_path / "x.dng",
        mosaic((40, 30)),
        cfa=cfa,
        black=[[512, 513], [514, 515]],
        white=16383,
        exposure_s=1 / 250,
    )
    content = (tmp_path / "x.dng").read_bytes().replace(b"plenocli", b"plenoclx")
    (tmp_path / "x.dng").write_bytes(content)
    back = read_capture(tmp_path / "x.dng")
    assert (
        back.cfa == cfa
        and not back.metadata.details["verified"]
        and back.exposure_s == pytest.approx(0.004, rel=1e-6)
    )
    np.testing.assert_array_equal(back.levels.black, [[512, 513], [514, 515]])


def test_independent_tiff_reader_agrees(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    values = mosaic((31, 45))
    write_dng(tmp_path / "x.dng", values, cfa="RGGB", black=0, white=16383, exposure_s=2.0)
    with tifffile.TiffFile(tmp_path / "x.dng") as file:
        page = file.pages[0]
        np.testing.assert_array_equal(page.asarray(), values)
        assert (
            page.tags[33422].value == b"\x00\x01\x01\x02"
            and page.tags[50706].value == b"\x01\x04\x00\x00"
        )
        assert page.tags[34665].value["ExposureTime"] == (2, 1)


def test_same_input_same_bytes(tmp_path):
    for name in "ab":
        write_dng(
            tmp_path / f"{name}.dng",
            mosaic((30, 30)),
            cfa="mono",
            black=3,
            white=4095,
            exposure_s=0.1,
            xmp_json={"b": 1, "a": 2},
        )
    assert (tmp_path / "a.dng").read_bytes() == (tmp_path / "b.dng").read_bytes()


def test_a_dark_frame_of_zeros_that_we_wrote_is_believed(tmp_path):
    write_dng(tmp_path / "x.dng", np.zeros((30, 30), np.uint16), cfa="mono", black=0, white=4095)
    assert read_capture(tmp_path / "x.dng").mosaic.max() == 0


def test_a_changed_pixel_of_ours_is_found(tmp_path):
    write_dng(tmp_path / "x.dng", mosaic((30, 30)), cfa="RGGB", black=0, white=16383)
    content = bytearray((tmp_path / "x.dng").read_bytes())
    content[-7] ^= 1
    (tmp_path / "x.dng").write_bytes(content)
    with pytest.raises(InputError, match="not sealed as it stands"):
        read_capture(tmp_path / "x.dng")


def unsigned(path):
    """Take our digest away, so that the file counts as anybody's."""
    path.write_bytes(path.read_bytes().replace(b"plenocli", b"plenoclx"))
    return path


@pytest.mark.parametrize(
    "values,black,white,words",
    [
        (np.zeros((40, 40)), 0, 4095, "100.0% zeros"),
        (np.where(np.arange(4000).reshape(50, 80) % 200 == 7, 900, 0), 0, 4095, "99.5% zeros"),
        (np.full((40, 40), 300), 0, 4095, "one single value"),
        (mosaic((40, 40)), 0, 255, "above its white level"),
        (mosaic((40, 40), top=100), 2048, 4095, "far below its black level"),
        (mosaic((40, 40)), 5000, 4095, "not above its black level"),
    ],
)
def test_implausible_mosaics_are_refused_with_the_reason(tmp_path, values, black, white, words):
    write_dng(tmp_path / "x.dng", values.astype(np.uint16), cfa="RGGB", black=black, white=white)
    with pytest.raises(InputError, match=words):
        read_capture(unsigned(tmp_path / "x.dng"))


def test_wrong_numbers_are_refused_by_the_writer(tmp_path):
    good = dict(cfa="RGGB", black=0, white=4095)
    for values, settings in (
        (np.zeros((30, 30)), good),
        (np.full((30, 30), 70000), good),
        (np.zeros((3, 30, 30), int), good),
        (mosaic((30, 30)), good | {"cfa": "CMYG"}),
        (mosaic((30, 30)), good | {"white": 0}),
    ):
        with pytest.raises(ValueError):
            write_dng(tmp_path / "x.dng", values, **settings)
    with pytest.raises(OutputError, match="too few for a DNG"):
        write_dng(tmp_path / "x.dng", mosaic((21, 40)), **good)
    assert not list(tmp_path.iterdir())


def test_no_mutant_of_a_dng_ends_otherwise_than_whole_or_refused(tmp_path):
    values, rng = mosaic((24, 24)), np.random.default_rng(2)
    write_dng(tmp_path / "x.dng", values, cfa="RGGB", black=0, white=16383)
    good = (tmp_path / "x.dng").read_bytes()
    start = len(good) - values.nbytes
    for number in range(24):
        bad = bytearray(good)
        at = int(rng.integers(start if number % 2 else len(good)))
        bad[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "x.dng").write_bytes(bad[:at] if number % 6 == 5 else bad)
        try:
            np.testing.assert_array_equal(read_capture(tmp_path / "x.dng").mosaic, values)
        except InputError:
            pass


def test_a_mosaic_that_does_not_fit_is_told_what_it_needs_before_it_is_unpacked(tmp_path):
    values = mosaic((300, 400))
    write_dng(tmp_path / "x.dng", values, cfa="RGGB", black=0, white=16383)
    with within(Budget(2 * values.nbytes)):
        told = "needs about 704KiB to be read, more than the limit of 469KiB: LibRaw holds"
        with pytest.raises(NumericsError, match=told):
            read_capture(tmp_path / "x.dng")
    with within(Budget(5 * values.nbytes)):
        np.testing.assert_array_equal(read_capture(tmp_path / "x.dng").mosaic, values)


def test_notes_of_other_files_are_empty(tmp_path):
    (tmp_path / "x").write_bytes(struct.pack("<4sI", b"II*\0", 8) + b"\0" * 40)
    assert read_notes(tmp_path / "x") == {}


# --- real files -----------------------------------------------------------------------------------

REAL = {
    "nikon_d1.NEF": ((1324, 2012), "BGGR", 0, 4095, 1 / 250, "NIKON D1"),
    "kodak_dc50.KDC": ((512, 768), "GRBG", 0, 16383, 0.00435, "DC50"),
    "blackmagic_cinemadng.dng": ((2176, 4128), "RGGB", 512, 65535, None, None),
}


@pytest.mark.parametrize("name", REAL)
def test_real_camera_files(shared_data, name):
    import rawpy

    shape, cfa, black, white, exposure, model = REAL[name]
    back = read_capture(shared_data / "raw" / name)
    assert (
        back.mosaic.shape == shape
        and back.cfa == cfa
        and (back.levels.black == black).all()
        and back.levels.white == white
    )
    assert back.exposure_s == (exposure and pytest.approx(exposure, rel=1e-3))
    assert model is None or model in back.metadata.details["model"]
    with rawpy.imread(str(shared_data / "raw" / name)) as file:
        np.testing.assert_array_equal(back.mosaic, file.raw_image_visible)
        assert [file.color_desc.decode()[i] for i in file.raw_pattern.ravel()] == list(cfa)


BROKEN = {
    "corrupt_exiv2_issue_857_poc.raf": "not a RAW file",
    "derived_empty.NEF": "0 bytes",
    "derived_truncated_nikon_d1.NEF": "ends before",
    "trunc_exiftool_CanonRaw.cr2": "not a RAW file",
    "trunc_exiftool_CanonRaw.cr3": "ends before",
    "trunc_exiftool_FujiFilm.raf": "ends before",
    "trunc_exiftool_Nikon.nef": "corrupt image data",
    "trunc_exiftool_Panasonic.rw2": "99.8% zeros",
    "trunc_exiftool_SigmaDP2.x3f": "too big",
}


def test_every_broken_or_mosaicless_file_says_why(shared_data):
    files = sorted((shared_data / "raw" / "broken").iterdir()) + sorted(
        (shared_data / "raw" / "no_cfa").iterdir()
    )
    assert len(files) >= 12
    for path in files:
        with pytest.raises(
            InputError, match=BROKEN.get(path.name, "values a pixel, not a colour filter mosaic")
        ) as caught:
            read_capture(path)
        assert str(path) in str(caught.value) and caught.value.fix
