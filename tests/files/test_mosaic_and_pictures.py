"""Mosaics and photographs from PNG, TIFF, JPEG, EXR and artefacts."""

import numpy as np
import OpenImageIO as oiio
import pytest

from plenocli.base.budget import Budget, within
from plenocli.base.errors import InputError, NumericsError
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.images.exr import write_exr
from plenocli.files.images.mosaic import read_capture, write_capture
from plenocli.files.images.pictures import read_picture, srgb_to_linear
from plenocli.forward.sensor.capture import Capture, CaptureMetadata, Levels
from plenocli.forward.sensor.noise import Noise


def save(path, values, **attributes):
    """Write an integer or float array (row, column[, channel]) with OpenImageIO as it is."""
    values = np.ascontiguousarray(values if values.ndim == 3 else values[..., None])
    spec = oiio.ImageSpec(
        values.shape[1], values.shape[0], values.shape[2], str(values.dtype).replace("32", "")
    )
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(values) and output.close()
    return path


def numbers(shape, dtype, seed=0):
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max + 1, shape).astype(dtype)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("dtype,white", [(np.uint8, 255), (np.uint16, 65535)])
def test_mosaic_of_an_image_is_untouched(tmp_path, suffix, dtype, white):
    values = numbers((9, 13), dtype)
    back = read_capture(save(tmp_path / f"x{suffix}", values), cfa="GBRG")
    np.testing.assert_array_equal(back.mosaic, values)
    assert back.mosaic.dtype == dtype and (back.cfa, back.levels.white, back.metadata.source) == (
        "GBRG",
        white,
        "image",
    )


def test_twelve_bit_tiff_is_not_scaled(tmp_path):
    values = numbers((8, 8), np.uint16) >> 4
    full = (values << 4) | (values >> 8)
    path = save(tmp_path / "x.tif", full, oiio__BitsPerSample=12)
    back = read_capture(path)
    np.testing.assert_array_equal(back.mosaic, values)
    assert back.levels.white == 4095


def test_colour_pictures_are_no_mosaics_unless_their_channels_agree(tmp_path):
    grey = numbers((6, 7), np.uint8)
    same = read_capture(save(tmp_path / "same.png", np.repeat(grey[..., None], 3, axis=2)))
    np.testing.assert_array_equal(same.mosaic, grey)
    assert "identical" in same.metadata.details["note"]
    colour = save(tmp_path / "colour.png", numbers((6, 7, 3), np.uint8))
    with pytest.raises(InputError, match="3 different channels"):
        read_capture(colour)
    jpeg = save(tmp_path / "x.jpg", numbers((16, 16, 3), np.uint8))
    with pytest.raises(InputError, match="JPEG"):
        read_capture(jpeg)


@pytest.mark.parametrize("name,kind", [("a.png", "PNG"), ("a.TIF", "TIFF"), ("a.h5", "HDF5")])
def test_a_file_that_is_not_what_its_name_says_is_no_raw_file(tmp_path, name, kind):
    (tmp_path / name).write_text("hello\n")
    with pytest.raises(InputError, match=f"begins as no {kind} file"):
        read_capture(tmp_path / name)


@pytest.mark.parametrize("name", ["a.png", "a.exr", "a.JPG"])
def test_a_tiff_of_another_name_is_no_raw_file(tmp_path, name):
    """Nor a picture: a camera's RAW is a TIFF, too, whose first picture is a thumbnail."""
    save(tmp_path / "a.tif", numbers((16, 16), np.uint16)).rename(tmp_path / name)
    with pytest.raises(InputError, match="file does, but as a TIFF; name it .tif"):
        read_capture(tmp_path / name)


def test_capture_as_artefact_and_as_exr_says_the_same(tmp_path):
    values = numbers((6, 8), np.uint16)
    capture = Capture(
        mosaic=values,
        cfa="RGGB",
        levels=Levels(black=np.full((2, 2), 64.0), white=4095.0, gain=0.5),
        exposure_s=0.01,
        noise=Noise.of_sigma(0.5),
        metadata=CaptureMetadata(band_m=450e-9),
    )
    for suffix in ("h5", "exr"):
        write_capture(tmp_path / f"c.{suffix}", capture, Provenance(command="by hand"))
    for path, source in ((tmp_path / "c.h5", "capture"), (tmp_path / "c.exr", "exr")):
        back = read_capture(path)
        np.testing.assert_array_equal(back.mosaic, values)
        assert (
            back.cfa,
            back.levels.white,
            back.levels.gain,
            back.exposure_s,
            back.units,
            back.metadata.band_m,
            back.metadata.source,
        ) == ("RGGB", 4095, 0.5, 0.01, "DN", 450e-9, source)
        assert (back.levels.black == 64).all() and back.noise == Noise.of_sigma(0.5)
    with pytest.raises(InputError, match="RGGB, not mono"):
        read_capture(tmp_path / "c.h5", cfa="mono")
    write_exr(tmp_path / "nan.exr", {"Y": np.full((3, 3), np.nan)})
    with pytest.raises(InputError, match="NaN"):
        read_capture(tmp_path / "nan.exr")
    write_exr(tmp_path / "rgb.exr", dict.fromkeys("RGB", np.ones((3, 3))))
    with pytest.raises(InputError, match="3 channels"):
        read_capture(tmp_path / "rgb.exr")


def test_real_plenoptic_and_colour_filter_images(shared_data):
    folder = shared_data / "plenoptic"
    for name, shape, dtype in (
        ("letters/letters_ULF_M1_white.png", (960, 1280), np.uint8),
        ("letters/letters_ULF_M1_dark.png", (960, 1280), np.uint8),
        ("lfm_guv/Radiometry_GUVExperim1.tif", (436, 436), np.uint16),
        ("lfm_antleg/radiometry_frame.png", (2160, 2592), np.uint16),
    ):
        back = read_capture(folder / name)
        assert back.mosaic.shape == shape and back.mosaic.dtype == dtype and back.cfa == "mono"
    name = next(
        (
            shared_data
            / "spectra/colorchecker_filtered/captured_images/images_filtered_light/color_checker"
        ).glob("*550nm_100ms*.tif")
    )
    assert read_capture(name, cfa="GBRG").mosaic.shape == (342, 408)


# --- photographs ----------------------------------------------------------------------------------


def test_srgb_decoding_at_the_points_of_the_standard():
    np.testing.assert_allclose(
        srgb_to_linear([0, 0.04045, 0.5, 1]), [0, 0.0031308, 0.21404114, 1], rtol=2e-5
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3])
def test_photographs_become_linear(tmp_path, dtype, channels):
    values = numbers((5, 6, channels), dtype)
    back = read_picture(save(tmp_path / "x.png", values))
    assert (
        back.values.dtype == np.float32
        and back.values.shape == values.shape
        and not back.is_spectral
    )
    np.testing.assert_allclose(
        back.values, srgb_to_linear(values / np.iinfo(dtype).max), rtol=1e-6, atol=1e-9
    )


def test_alpha_is_dropped_without_touching_the_colours(tmp_path):
    from PIL import Image

    values = numbers((5, 6, 4), np.uint8)
    values[..., 3] = 7
    Image.fromarray(values, "RGBA" if values.shape[2] == 4 else None).save(tmp_path / "x.png")
    np.testing.assert_allclose(
        read_picture(tmp_path / "x.png").values, srgb_to_linear(values[..., :3] / 255), rtol=1e-6
    )


def test_jpeg_float_tiff_and_exr(tmp_path):
    flat = np.full((16, 16, 3), 188, np.uint8)
    np.testing.assert_allclose(
        read_picture(save(tmp_path / "x.jpg", flat)).values, srgb_to_linear(188 / 255), atol=0.01
    )
    values = np.random.default_rng(1).random((4, 5, 3), dtype=np.float32)
    np.testing.assert_array_equal(read_picture(save(tmp_path / "x.tif", values)).values, values)
    write_exr(tmp_path / "x.exr", dict(zip("RGBA", [*np.moveaxis(values, -1, 0), np.ones((4, 5))])))
    np.testing.assert_array_equal(read_picture(tmp_path / "x.exr").values, values)
    write_exr(tmp_path / "y.exr", {"Y": values[..., 0]})
    np.testing.assert_array_equal(read_picture(tmp_path / "y.exr").values[..., 0], values[..., 0])


def test_pictures_that_cannot_be_used_say_why(tmp_path):
    (tmp_path / "t.png").write_text("text")
    good = save(tmp_path / "good.png", numbers((64, 64, 3), np.uint8)).read_bytes()
    (tmp_path / "cut.png").write_bytes(good[: len(good) // 2])
    (tmp_path / "cut.tif").write_bytes(
        save(tmp_path / "good.tif", numbers((64, 64), np.uint16), compression="zip").read_bytes()[
            :2000
        ]
    )
    write_exr(tmp_path / "odd.exr", {"depth": np.ones((2, 2)), "id": np.ones((2, 2))})
    write_exr(tmp_path / "inf.exr", {"Y": np.full((2, 2), np.inf)})
    for name, words in {
        "none.png": "does not exist",
        "t.png": "no PNG, JPEG, TIFF or EXR",
        "cut.png": "damaged|no readable",
        "cut.tif": "damaged|no readable",
        "odd.exr": "neither Y nor",
        "inf.exr": "NaN or infinite",
        "": "is a folder",
    }.items():
        with pytest.raises(InputError, match=words) as caught:
            read_picture(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)
    with within(Budget(1000)), pytest.raises(NumericsError, match="to be read"):
        read_picture(tmp_path / "good.png")


def test_a_sensors_mosaic_is_no_picture(tmp_path):
    path = save(tmp_path / "x.tif", numbers((6, 7), np.uint16)).rename(tmp_path / "x.dng")
    with pytest.raises(InputError, match="mosaic of a sensor"):
        read_picture(path)
