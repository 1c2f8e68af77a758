"""EXR: bit-exact by name, attributes kept or refused, same bytes, damage found, other
people's readers agree.
"""

import os
import time
import warnings

import numpy as np
import pytest

from plenocli.base.budget import Budget, within
from plenocli.base.errors import InputError, NumericsError, OutputError, UsageError
from plenocli.files.images.exr import read_exr, read_header, stored_channel, write_exr
from plenocli.files.images.pictures import read_picture
from plenocli.files.images.spectral_exr import (
    is_spectral,
    preview,
    read_spectral_exr,
    write_spectral_exr,
)

WAVELENGTHS = np.arange(400, 701, 10) * 1e-9


def cube(seed=0, bands=31, shape=(5, 7)):
    return np.random.default_rng(seed).random((bands, *shape), dtype=np.float32)


@pytest.mark.parametrize("compression", ["none", "zip", "zips", "rle", "piz", "zstd"])
def test_channels_and_attributes_come_back_by_name(tmp_path, compression):
    channels = {
        name: plane for name, plane in zip(("Z last", "T.700", "T.400", "a", "Y", "B"), cube(1, 6))
    }
    channels["a"][0, :4] = [np.nan, np.inf, -0.0, 1e-42]
    attrs = {"plenocli": '{"µ": 1}' * 20_000, "1: EV illuminant": "x"}
    write_exr(tmp_path / "x.exr", channels, attrs, compression=compression)
    back, texts = read_exr(tmp_path / "x.exr")
    assert (
        set(back) == set(channels)
        and attrs.items() <= texts.items()
        and texts["compression"] == compression
    )
    for name, plane in channels.items():
        np.testing.assert_array_equal(back[name].view("u4"), plane.view("u4"))


def test_fortran_ordered_and_reversed_arrays_are_written_as_they_read(tmp_path):
    values = cube(2, 1)[0]
    write_exr(
        tmp_path / "x.exr",
        {"f": np.asfortranarray(values), "r": values[::-1, ::-1], "d": values.astype(np.float64)},
    )
    back, _ = read_exr(tmp_path / "x.exr")
    for name, due in {"f": values, "r": values[::-1, ::-1], "d": values}.items():
        np.testing.assert_array_equal(back[name], due)


def test_bytes_do_not_depend_on_the_clock(tmp_path):
    write_exr(tmp_path / "a.exr", {"Y": cube()[0]}, {"k": "v"})
    time.sleep(1.1)
    write_exr(tmp_path / "b.exr", {"Y": cube()[0]}, {"k": "v"})
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["a.exr", "b.exr"]


def test_what_exr_would_change_in_silence_is_refused(tmp_path):
    plane = cube()[0]
    for channels, attrs, settings in (
        ({}, {}, {}),
        ({"": plane}, {}, {}),
        ({"Y": plane, "y": plane}, {}, {}),
        ({"Y": plane, "Z": plane[1:]}, {}, {}),
        ({"Y": plane[None]}, {}, {}),
        ({"Y": plane}, {"n": 3}, {}),
        ({"Y": plane}, {}, {"compression": "htj2k"}),
        ({"Y": plane}, {}, {"compression": "dwaa"}),
    ):
        with pytest.raises(ValueError):
            write_exr(tmp_path / "x.exr", channels, attrs, **settings)
    with pytest.raises(OutputError, match="does not keep"):
        write_exr(tmp_path / "x.exr", {"Y": plane}, {"DateTime": "not a date of ours"})
    assert os.listdir(tmp_path) == []
    write_exr(tmp_path / "x.exr", {"Y": plane})
    with pytest.raises(UsageError, match="--overwrite"):
        write_exr(tmp_path / "x.exr", {"Y": plane})


def test_no_damage_to_our_exr_is_read_as_data(tmp_path):
    write_spectral_exr(
        tmp_path / "x.exr", WAVELENGTHS[:4], cube(3, 4), attrs={"plenocli": "p" * 100}
    )
    good, rng, kept = (tmp_path / "x.exr").read_bytes(), np.random.default_rng(5), 0
    truth = read_exr(tmp_path / "x.exr")
    for number in range(300):
        bad = bytearray(good)
        at = int(rng.integers(len(bad)))
        if number % 3 == 0:
            del bad[at:]
        elif number % 3 == 1:
            bad[at] ^= 1 << int(rng.integers(8))
        else:
            bad[at : at + 4] = b"\xff\xff\xff\x7f"[: len(bad[at : at + 4])]
        (tmp_path / "x.exr").write_bytes(bad)
        try:
            channels, attrs = read_exr(tmp_path / "x.exr")
        except InputError as error:
            assert str(tmp_path) in str(error)
            continue
        kept += 1
        # what the digest covers is intact: only the housekeeping of EXR itself may differ
        assert attrs["plenocli"] == truth[1]["plenocli"]
        assert all(np.array_equal(channels[name], plane) for name, plane in truth[0].items())
    assert kept < 40


def test_header_that_declares_too_much_is_refused_before_reading(tmp_path):
    write_exr(tmp_path / "x.exr", {"Y": np.zeros((1000, 1000))})
    with within(Budget(1_000_000)), pytest.raises(NumericsError, match="needs about .* to be read"):
        read_exr(tmp_path / "x.exr")
    with pytest.raises(InputError, match="more than 1e\\+06|more than 977KiB"):
        read_exr(tmp_path / "x.exr", most=1_000_000)


def test_lines_of_a_channel_that_stays_in_its_file_are_those_of_the_whole(tmp_path):
    values = np.random.default_rng(8).random((70, 31)).astype(np.float32)
    write_exr(tmp_path / "x.exr", {"Y": values, "Z": -values}, {"k": "v"})
    header = read_header(tmp_path / "x.exr")
    assert (header.names, header.shape, header.by_lines) == (["Y", "Z"], (70, 31), True)
    assert header.attrs == read_exr(tmp_path / "x.exr")[1]
    plane = stored_channel(tmp_path / "x.exr", header, "Z")
    for rows, columns in ((slice(0, 70), slice(None)), (slice(15, 17), slice(3, 30))):
        np.testing.assert_array_equal(plane.read(rows, columns), -values[rows, columns])
    with within(Budget(8 * 31 * 4)):
        plane.read(slice(5, 9), slice(None))
        with pytest.raises(NumericsError, match="to be read"):
            plane.read(slice(5, 10), slice(None))
    good = (tmp_path / "x.exr").read_bytes()
    (tmp_path / "x.exr").write_bytes(good[:-40])
    with pytest.raises(InputError):
        read_header(tmp_path / "x.exr")


def test_missing_empty_foreign_and_folder(tmp_path):
    (tmp_path / "e.exr").touch()
    (tmp_path / "t.exr").write_bytes(b"no exr at all")
    (tmp_path / "m.exr").write_bytes(b"\x76\x2f\x31\x01" + b"\0" * 50)
    for name, words in {
        "none.exr": "does not exist",
        "": "is a folder",
        "e.exr": "0 bytes",
        "t.exr": "not an EXR",
        "m.exr": "no readable EXR",
    }.items():
        with pytest.raises(InputError, match=words):
            read_exr(tmp_path / name)


# --- the spectral layout --------------------------------------------------------------------------


@pytest.mark.parametrize("quantity", ["reflectance", "radiance"])
def test_spectral_round_trip_with_sigma(tmp_path, quantity):
    values, sigma = cube(7), cube(8)
    write_spectral_exr(
        tmp_path / "x.exr", WAVELENGTHS, values, quantity, sigma=sigma, attrs={"method": "pinv"}
    )
    back = read_spectral_exr(tmp_path / "x.exr")
    np.testing.assert_array_equal(back.values, values)
    np.testing.assert_array_equal(back.sigma, sigma)
    np.testing.assert_allclose(back.wavelengths, WAVELENGTHS, rtol=0, atol=1e-15)
    assert (
        back.quantity == quantity
        and back.attrs["method"] == "pinv"
        and is_spectral(tmp_path / "x.exr")
    )
    with pytest.raises(InputError, match="holds"):
        read_spectral_exr(
            tmp_path / "x.exr", "radiance" if quantity == "reflectance" else "reflectance"
        )


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("quantity,component", [("reflectance", "T"), ("radiance", "S0")])
def test_colour_science_reads_our_layout_without_loss(tmp_path, quantity, component):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    values = cube(9)
    write_spectral_exr(tmp_path / "x.exr", WAVELENGTHS, values, quantity, sigma=values / 9)
    components, extra = colour.read_spectral_image_Fichet2021(
        str(tmp_path / "x.exr"), additional_data=True
    )
    assert list(components) == [component] and extra.is_emissive == (quantity == "radiance")
    wavelengths, planes = components[component]
    np.testing.assert_allclose(wavelengths, WAVELENGTHS * 1e9, rtol=1e-12)
    np.testing.assert_array_equal(planes, np.moveaxis(values, 0, -1))


def test_openexr_package_reads_our_layout_without_loss(tmp_path):
    OpenEXR = pytest.importorskip("OpenEXR")
    values = cube(10, 3)
    write_spectral_exr(tmp_path / "x.exr", [450e-9, 540.25e-9, 650e-9], values, "radiance")
    with OpenEXR.File(str(tmp_path / "x.exr"), separate_channels=True) as file:
        channels, header = file.channels(), file.header()
        for name, plane in zip(("S0.450,000000nm", "S0.540,250000nm", "S0.650,000000nm"), values):
            np.testing.assert_array_equal(channels[name].pixels, plane)
        assert (
            header["spectralLayoutVersion"] == "1.0" and header["emissiveUnits"] == "W.m^-2.sr^-1"
        )
        assert {"R", "G", "B"} <= set(channels)


def test_spellings_of_the_layout_are_understood(tmp_path):
    planes = cube(11, 5)
    names = ["T.4,5e2nm", "T.0,55um", "T.500THz", "T.,7um", "T.400nm.500nm"]
    write_exr(tmp_path / "x.exr", dict(zip(names, planes)))
    back = read_spectral_exr(tmp_path / "x.exr")
    np.testing.assert_allclose(
        back.wavelengths, [450e-9, 550e-9, 299_792_458 / 500e12, 700e-9], atol=1e-15
    )
    np.testing.assert_array_equal(back.values, planes[:4])


def test_both_quantities_and_double_bands_are_ambiguous(tmp_path):
    write_exr(tmp_path / "x.exr", {"T.450nm": cube()[0], "S0.450nm": cube()[1]})
    with pytest.raises(InputError, match="both radiance and reflectance"):
        read_spectral_exr(tmp_path / "x.exr")
    assert read_spectral_exr(tmp_path / "x.exr", "radiance").values[0, 0, 0] == cube()[1][0, 0]
    write_exr(tmp_path / "y.exr", {"T.450nm": cube()[0], "T.0,45um": cube()[1]})
    with pytest.raises(InputError, match="two 'T' channels"):
        read_spectral_exr(tmp_path / "y.exr")
    write_exr(tmp_path / "z.exr", {"Y": cube()[0]})
    with pytest.raises(InputError, match="no spectral channels"):
        read_spectral_exr(tmp_path / "z.exr")


def test_reference_file_of_the_layouts_authors(shared_data):
    spectral = read_spectral_exr(shared_data / "hyperspectral" / "spectral_exr_Macbeth.exr")
    assert spectral.values.shape == (36, 400, 600) and spectral.quantity == "reflectance"
    np.testing.assert_allclose(spectral.wavelengths, np.arange(380, 731, 10) * 1e-9, atol=1e-15)
    picture = read_picture(shared_data / "hyperspectral" / "spectral_exr_Macbeth.exr")
    assert picture.is_spectral and picture.values.shape == (400, 600, 36)
    # the chart's red patch (third row, third column) reflects long waves, its blue one
    # (first) short ones
    red, blue = spectral.values[:, 250, 250], spectral.values[:, 250, 50]
    assert red[30:].mean() > 5 * red[:15].mean() and blue[5:10].mean() > 2 * blue[25:30].mean()


def test_preview_shows_white_as_white_and_bands_in_their_colour():
    flat = preview(WAVELENGTHS, np.ones((31, 1, 1)))
    np.testing.assert_allclose(flat[:, 0, 0], 1.0)
    peak = {
        name: np.argmax(
            preview(WAVELENGTHS, np.exp(-(((WAVELENGTHS - at) / 15e-9) ** 2))[:, None, None])[
                :, 0, 0
            ]
        )
        for name, at in {"red": 630e-9, "green": 535e-9, "blue": 450e-9}.items()
    }
    assert peak == {"red": 0, "green": 1, "blue": 2}
    np.testing.assert_allclose(preview([550e-9], 3 * np.ones((1, 2, 2))), 3.0)


class Library:
    """OpenImageIO's readers and writers, one of which has a fault."""

    def __init__(self, monkeypatch, kind, name, made):
        import OpenImageIO as oiio

        monkeypatch.setattr(
            oiio,
            kind,
            type(kind, (), {name: staticmethod(made(getattr(getattr(oiio, kind), name)))}),
        )


def _other_values(real):
    def opened(path):
        source = real(path)
        fake = type(
            "Reader",
            (),
            {
                "__getattr__": lambda self, name: getattr(source, name),
                "read_scanlines": lambda self, *which: source.read_scanlines(*which) + 1,
            },
        )
        return fake()

    return opened


@pytest.mark.parametrize(
    "kind, name, made, words",
    [
        ("ImageOutput", "create", lambda real: lambda kind: None, "cannot write it"),
        ("ImageInput", "open", lambda real: lambda path: None, "cannot be read back"),
        ("ImageInput", "open", _other_values, "does not hold what was written"),
    ],
)
def test_a_library_that_fails_leaves_no_file(tmp_path, monkeypatch, kind, name, made, words):
    Library(monkeypatch, kind, name, made)
    with pytest.raises(OutputError, match=words):
        write_exr(tmp_path / "x.exr", {"Y": cube()[0]})
    assert os.listdir(tmp_path) == []
