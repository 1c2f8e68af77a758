import re
from html.parser import HTMLParser

import numpy as np
import pytest

from plenocli.evaluation.scores import PatchScore, ResultScore
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.images.mosaic import read_capture, stored_capture, write_capture
from plenocli.forward.sensor.capture import Capture, Levels
from plenocli.report import pictures, spectral_pictures
from plenocli.report.drawing import overview
from plenocli.report.figures import capture_figures
from plenocli.report.page import Page

PNG = b"\x89PNG\r\n\x1a\n"
BANDS = np.array([450e-9, 540e-9, 570e-9, 650e-9])


def size(png):
    assert png.startswith(PNG)
    return tuple(int.from_bytes(png[at : at + 4], "big") for at in (16, 20))


def pixels(png):
    import io

    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image.convert("RGB")).astype(int)


class Balance(HTMLParser):
    """Fails on a tag that closes what is not open."""

    VOID = {"meta", "img", "br"}

    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, attrs):
        self.open += [] if tag in self.VOID else [tag]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_texts_are_escaped_and_tags_balance():
    evil = '<script>alert("x")</script> & more'
    page = Page(evil, evil)
    page.section(evil, evil)
    page.heading(evil)
    page.warning(evil)
    page.cards([(evil, evil)])
    page.table([evil, "a"], [[evil, evil]], evil)
    page.definitions({evil: evil})
    page.code(evil, evil)
    page.figure(pictures.picture(np.eye(4)), evil + "'\"")
    text = page.render()
    assert "<script" not in text
    balance = Balance()
    balance.feed(text)
    assert not balance.open


def test_the_page_needs_nothing_else():
    page = Page("t")
    page.section("one")
    page.section("two")
    page.figure(pictures.picture(np.eye(4)), "c")
    text = page.render()
    assert (
        not re.search(r'(src|href)="(?!data:|#)', text)
        and "@import" not in text
        and "url(" not in text
    )
    assert text == page.render()


def rng():
    return np.random.default_rng(0)


def patches(shift):
    return [
        PatchScore(
            label=n,
            name=f"patch {n}",
            mean=[0.2 + shift] * 4,
            std=[0.01] * 4,
            truth=[0.2] * 4,
            one_of_six=n in (7, 13),
        )
        for n in range(1, 25)
    ]


def entry(label, psnr=None, snr=None):
    return ResultScore(
        name=label,
        label=label,
        wavelengths_nm=(450, 540, 570, 650),
        figures={
            "psnr_db": psnr,
            "rmse_per_band": [0.01, 0.02, 0.03, None],
            "snr_capture_db": snr,
            "block_mean_psnr_db": 14.0,
        },
    )


DRAWN = {
    "capture": lambda: pictures.capture_picture(rng().random((60, 80)), "DN", pitch=(10, 10)),
    "capture without grid": lambda: pictures.capture_picture(rng().random((7, 9))),
    "black capture": lambda: pictures.capture_picture(
        np.zeros((30, 30)), "DN", centres=np.full((3, 3, 2), np.nan)
    ),
    "one lenslet": lambda: pictures.capture_picture(rng().random((10, 10)), "DN", pitch=(10, 10)),
    "pif": lambda: pictures.pif_columns(
        rng().random((9, 20, 6)),
        (5, 4),
        (2, 3),
        np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), -1).reshape(-1, 2),
    ),
    "pif of one point": lambda: pictures.pif_columns(
        np.ones((1, 20, 1)), (5, 4), (1, 1), np.zeros((1, 2), int)
    ),
    "matrix": lambda: pictures.matrix_summary(
        np.array([[1.0, 0.1, 0]]),
        np.ones((1, 6)),
        [550e-9],
        (2, 3),
        labels=["rank 2 of 6"],
        resolution=np.array([1e-9]),
    ),
    "matrix without singular values": lambda: pictures.matrix_summary(
        None, np.ones((2, 6)), [450e-9, 550e-9], (2, 3)
    ),
    "reconstructions": lambda: pictures.reconstructions(
        [(f"m{i}", rng().random((24, 30)), "20 dB") for i in range(5)], rng().random((24, 30))
    ),
    "a perfect reconstruction": lambda: pictures.reconstructions(
        [("m", np.ones((9, 9)), "")], np.ones((9, 9))
    ),
    "close-ups": lambda: pictures.close_ups(
        [("m", rng().random((24, 30)), "")], rng().random((24, 30)), (6, 6)
    ),
    "atoms": lambda: pictures.dictionary_atoms(
        rng().standard_normal((12, 7)), (3, 4), rng().random((20, 12)), (5, 4)
    ),
    "a zero atom": lambda: pictures.dictionary_atoms(np.zeros((12, 1)), (3, 4)),
    "history": lambda: pictures.learning_history(
        {"psnr": [1.0, np.nan, 3], "dead atoms": [0, 0, 1], "table": np.ones((2, 2))}
    ),
    "bands": lambda: spectral_pictures.band_pictures(rng().random((4, 6, 9)), BANDS, "reflectance"),
    "bands with gaps": lambda: spectral_pictures.band_pictures(
        np.where(rng().random((4, 6, 9)) < 0.2, np.nan, 0.5), BANDS, "radiance"
    ),
    "one band": lambda: spectral_pictures.band_pictures(rng().random((1, 6, 9)), BANDS[:1]),
    "31 bands": lambda: spectral_pictures.band_pictures(
        rng().random((31, 6, 9)), np.arange(400, 701, 10) * 1e-9
    ),
    "patches": lambda: spectral_pictures.patch_spectra(
        [("a", patches(0)), ("b", patches(0.1))], BANDS * 1e9
    ),
    "bars": lambda: spectral_pictures.accuracy_bars(
        [entry("a", snr=[40, 41, 42, None]), entry("b")]
    ),
    "calibration": lambda: spectral_pictures.calibration_picture(
        rng().random((60, 60)),
        pictures._tiling((60, 60), (10, 10)),
        np.ones((6, 6), bool),
        np.ones((6, 6)),
    ),
    "calibration without white": lambda: spectral_pictures.calibration_picture(
        None, pictures._tiling((60, 60), (10, 10)), np.ones((6, 6), bool)
    ),
    "response": lambda: spectral_pictures.response_picture(rng().random((30, 4)), (5, 6), BANDS),
}


@pytest.mark.parametrize("name", DRAWN)
def test_every_picture_is_drawn_on_ordinary_and_odd_data(name):
    png = DRAWN[name]()
    width, height = size(png)
    assert 300 < width < 1500 and 80 < height < 4000
    assert np.ptp(pixels(png)) > 100


def test_the_same_data_give_the_same_bytes():
    assert DRAWN["matrix"]() == DRAWN["matrix"]()


def test_no_history_gives_no_picture():
    assert pictures.learning_history({"x": np.array([np.nan])}) == b""


def test_the_grid_lies_between_superpixels():
    """Bright dots at the superpixels' corners must vanish under the lattice lines, dots in
    the middle must not.
    """
    centres = pictures._tiling((30, 30), (10, 10))
    np.testing.assert_allclose(centres[1, 2], [14.5, 24.5])
    between = (centres[1:] + centres[:-1]) / 2
    np.testing.assert_allclose(between[0, :, 0], 9.5)


def test_pif_columns_stand_where_their_superpixels_are():
    offsets = np.array([[-1, 0], [0, 0], [0, 1]])
    column = np.arange(12.0).reshape(3, 4)
    shown = pictures.on_superpixels(column, (2, 2), offsets)
    np.testing.assert_array_equal(shown, [[0, 1, 0, 0], [2, 3, 0, 0], [4, 5, 8, 9], [6, 7, 10, 11]])


def test_linear_light_is_encoded_for_the_screen():
    png = pixels(pictures.picture(np.array([[1.0, 0.2140], [0.2140, 1.0]])))
    values, counts = np.unique(png.reshape(-1, 3), axis=0, return_counts=True)
    common = values[np.argsort(counts)[-3:]]
    assert any(np.abs(value - 127).max() <= 2 for value in common)  # sRGB: linear 0.214 is mid-grey


def test_powers_of_ten_are_drawn_as_such_and_names_are_no_formulas():
    """A $ in the name of a file is text; the marks of a logarithmic axis are not, which were shown
    as "$\\mathdefault{10^{-2}}$".
    """
    from plenocli.report.drawing import drawing

    with drawing(4, 3) as made:
        axes = made.figure.subplots()
        axes.semilogy([1, 2, 3], [1, 1e-4, 1e-8])
        title = axes.set_title("$\\frac{1}{$.h5")
    made.figure.canvas.draw()
    marks = axes.yaxis.get_ticklabels(which="both")
    assert any(r"\mathdefault" in mark.get_text() for mark in marks)
    assert all(mark.get_parse_math() for mark in marks) and not title.get_parse_math()


def test_a_large_picture_is_drawn_from_averages_and_an_even_sample():
    values = np.random.default_rng(4).random((2, 1500, 2300))
    seen = overview(values)
    assert seen.step == 4 and seen.small.shape == (2, 375, 575)
    blocks = values.reshape(2, 375, 4, 575, 4)
    np.testing.assert_allclose(seen.small, blocks.mean(axis=(2, 4)), rtol=1e-12)
    every = int(np.ceil((values.size / 2**20) ** 0.5))
    assert sorted(seen.sample) == sorted(values[:, ::every, ::every].ravel())
    rest = overview(values[:, :1499, :2299])
    np.testing.assert_array_equal(rest.small, seen.small[:, :374, :574])
    small = overview(values[:, :600, :590])
    assert small.step == 1 and (small.small == values[:, :600, :590]).all()


def test_a_capture_that_stays_in_its_file_looks_as_one_in_memory(tmp_path):
    """In colour, with a black level for each place of the two by two."""
    mosaic = 20 + 100 * np.random.default_rng(5).random((90, 71))
    black = np.array([[10.0, 12.0], [14.0, 16.0]])
    shot = Capture(mosaic=mosaic, cfa="GRBG", levels=Levels(black=black, white=200.0))
    write_capture(tmp_path / "a.h5", shot, Provenance(command="made up"))
    with stored_capture(tmp_path / "a.h5") as stored:
        found = capture_figures(stored.about, "a.h5", None, stored)
    assert found == capture_figures(read_capture(tmp_path / "a.h5"), "a.h5")
