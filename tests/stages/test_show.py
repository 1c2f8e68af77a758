"""show: every kind of file makes a picture in which its own values can be found again;
refusals leave nothing.
"""

import io

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import label

from plenocli.cli.main import run
from plenocli.files.images.exr import write_exr
from plenocli.report.drawing import stacked
from plenocli.report.pictures import pif_columns
from plenocli.report.spectral_pictures import lenslet_spectra
from plenocli.stages.evaluation.show import run_show
from tests.stages.test_report import spatial, spectral


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root, rng = tmp_path_factory.mktemp("show"), np.random.default_rng(4)
    spatial(root / "a", rng)
    spectral(root / "b", rng)
    return root


def size(path):
    with Image.open(path) as image:
        assert image.format == "PNG" and np.ptp(np.asarray(image.convert("L"))) > 100
        return image.size


@pytest.mark.parametrize(
    "names, kinds, figures",
    [
        (["a/pif.h5"], ["pif"], 3),
        (["a/same/capture.h5"], ["capture"], 1),
        (["b/calibration.h5"], ["calibration"], 2),
        (["b/chart-pinv.h5"], ["spectra"], 2),
        (["a/dictionary.h5", "a/pif.h5"], ["dictionary", "pif"], 5),
        (["a/same/lmmse.h5"], ["image"], 1),
    ],
)
def test_every_kind_is_drawn(folder, tmp_path, names, kinds, figures):
    made = run_show([folder / n for n in names], tmp_path / "p.png")
    assert made.kinds == kinds and len(made.captions) == figures
    width, height = size(tmp_path / "p.png")
    assert width > 500 and height > 280 * figures


def test_an_exr_a_default_name_and_the_same_bytes(folder, tmp_path, monkeypatch, capsys):
    write_exr(tmp_path / "flat.exr", {"Y": np.linspace(0, 1, 64, dtype="f4").reshape(8, 8)})
    monkeypatch.chdir(tmp_path)
    assert run(["show", "flat.exr"]) == 0 and "flat.png: image" in capsys.readouterr().out
    first = (tmp_path / "flat.png").read_bytes()
    assert run(["show", "flat.exr"]) == 2 and "--overwrite" in capsys.readouterr().err
    assert (
        run(["show", "flat.exr", "--overwrite"]) == 0
        and (tmp_path / "flat.png").read_bytes() == first
    )


def test_results_beside_their_truth(folder, tmp_path):
    files = [folder / "a" / "same" / f"{n}.h5" for n in ("tikhonov", "lmmse")]
    made = run_show(files, tmp_path / "p.png", truth=folder / "a" / "same" / "capture.h5")
    # errors below, then the close-up
    assert len(made.captions) == 2 and size(tmp_path / "p.png")[1] > 900


def test_chosen_points_and_lenslets(folder, tmp_path):
    """A bright pixel of the chosen column is where the picture is bright."""
    matrix = np.zeros((1, 16, 9))
    matrix[0, 6, 5] = 1.0  # pixel (1, 2) of point (1, 2)
    image = np.asarray(
        Image.open(
            io.BytesIO(pif_columns(matrix, (4, 4), (3, 3), [(0, 0)], points=[(1, 2)]))
        ).convert("L"),
        float,
    )
    dark, _ = label(image < 30)  # where nothing falls is black; the panel is its largest piece
    panel = np.argwhere(dark == np.bincount(dark.ravel())[1:].argmax() + 1)
    (top, left), (bottom, right) = panel.min(axis=0), panel.max(axis=0)
    bright = np.argwhere(image[top:bottom, left:right] > 200).mean(axis=0) / (
        bottom - top,
        right - left,
    )
    np.testing.assert_allclose(bright, [1.5 / 4, 2.5 / 4], atol=0.03)
    assert run_show([folder / "a" / "pif.h5"], tmp_path / "p.png", points=((0, 3), (3, 3))).captions
    one, two = (
        lenslet_spectra(np.ones((2, 3, 3)), None, np.array([5e-7, 6e-7]), lenslets=chosen)
        for chosen in ([(0, 0)], [(2, 2)])
    )
    assert one != two


def test_stacking_keeps_every_picture():
    def png(value, width, height):
        buffer = io.BytesIO()
        Image.new("RGB", (width, height), (value,) * 3).save(buffer, "png")
        return buffer.getvalue()

    sheet = np.asarray(
        Image.open(io.BytesIO(stacked([(png(10, 200, 30), "the first"), (png(90, 300, 20), "")])))
    )[..., 0]
    (top, left), (bottom, right) = (
        np.argwhere(sheet == 10).min(axis=0),
        np.argwhere(sheet == 10).max(axis=0),
    )
    assert (
        (bottom - top + 1, right - left + 1) == (30, 200)
        and left == 50
        and (sheet[top : bottom + 1, left : right + 1] == 10).all()
    )
    assert (
        sheet.shape[1] == 300
        and (sheet[-20:] == 90).all()
        and (sheet[bottom + 1 : -20] == 255).all()
    )
    assert 0 < (sheet[:top] < 200).mean() < 0.2, "the caption, above its picture"


@pytest.mark.parametrize(
    "arguments, code, message",
    [
        (["a/pif.h5", "--point", "9,0"], 2, "outside 4 x 4 object points"),
        (["b/chart-pinv.h5", "--lenslet", "0,18"], 2, "outside"),
        (["absent.h5"], 3, "does not exist"),
        (["a/pif.h5", "--truth", "a/same/capture.h5"], 2, "only pictures"),
        (["a/same/lmmse.h5", "--truth", "b/calibration.h5"], 3, "calibration.h5"),
        (["a/pif.h5", "--point", "x"], 2, "no row and column"),
    ],
)
def test_refusals(folder, tmp_path, monkeypatch, capfd, arguments, code, message):
    monkeypatch.chdir(folder)
    assert run(["show", *arguments, "-o", str(tmp_path / "p.png")]) == code
    assert message in capfd.readouterr().err and not (tmp_path / "p.png").exists()


def test_a_sheet_of_many_pictures_is_about_as_wide_as_high():
    buffer = io.BytesIO()
    Image.new("RGB", (1326, 740), "#204060").save(buffer, "png")
    figures = [(buffer.getvalue(), f"capture number {i}") for i in range(48)]
    with Image.open(io.BytesIO(stacked(figures))) as sheet:
        assert max(sheet.size) < 5000 and 0.5 < sheet.width / sheet.height < 2
        blue = (np.asarray(sheet) == (0x20, 0x40, 0x60)).all(axis=-1)
    assert label(blue)[1] == 48
    with Image.open(io.BytesIO(stacked(figures[:3]))) as sheet:
        assert sheet.width == 1326 and sheet.height > 3 * 740
