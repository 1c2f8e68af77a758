"""colorchecker on a folder that the test paints (known reflectances, light, camera) and on real
captures of a chart.
"""

import json

import numpy as np
import pytest

from plenocli.cli.main import run
from plenocli.files.artefacts.reading import read_artefact
from plenocli.forward.scene.tables import colorchecker
from plenocli.stages.evaluation.colorchecker import Settings, run_colorchecker, table
from tests.reference.chart import paint_folder

pytest.importorskip("PIL.Image")
BANDS = [450, 550, 650]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return paint_folder(tmp_path_factory.mktemp("chart"))


def test_a_painted_chart_is_measured_to_what_its_digits_allow(folder, tmp_path):
    document = run_colorchecker(
        folder, tmp_path / "chart.h5", Settings(cfa="GBRG"), measures=tmp_path / "chart.json"
    )
    plain, flat = (method.score for method in document.measures.methods)
    assert (
        plain.rmse_24 > 0.05
        and flat.rmse_24 < 0.006
        and flat.rmse_six < 0.005
        and flat.spectral_angle_deg < 0.6
    )
    # digits are cut off
    assert all(v.median == pytest.approx(1.01, abs=0.015) for v in document.linearity.values())
    stored = json.loads((tmp_path / "chart.json").read_text())
    assert stored.pop("seal").startswith("plenocli sha256 ") and stored == document.as_json()
    text = table(document)
    assert all(name in text for name in colorchecker()[0]) and "450" in text
    cube = read_artefact(tmp_path / "chart.h5", "image")
    np.testing.assert_allclose(cube.data["image/wavelength"], np.arange(450, 651, 10) * 1e-9)
    assert (cube.data["image/value"] >= 0).all()
    value = (
        cube.data["image/value"][::10]
        .reshape(3, 4, 24, 6, 24)[:, :, 8:16, :, 8:16]
        .mean(axis=(2, 4))
    )
    np.testing.assert_allclose(
        value.reshape(3, 24).T, colorchecker(np.array(BANDS) * 1e-9)[2], atol=0.015
    )


def test_the_command_prints_the_table_and_the_scene_serves_capture_sim(folder, tmp_path, capsys):
    assert (
        run(
            [
                "colorchecker",
                str(folder),
                "--cfa",
                "GBRG",
                "--flatten",
                "none",
                "--grid",
                "16x24",
                "-o",
                str(tmp_path / "chart.h5"),
            ]
        )
        == 0
    )
    out = capsys.readouterr().out
    assert "bluish green" in out and "paper field" not in out
    from plenocli.files.read.scenes import read_scene

    scene = read_scene(tmp_path / "chart.h5", spectral=True)
    # white and black
    assert scene.spectral and scene.at(550e-9, 8, 12)[7, 1] > 3 * scene.at(550e-9, 8, 12)[7, 11]


@pytest.mark.parametrize(
    "lost, words",
    [
        ("captures", "no capture"),
        ("labels.png", "label map"),
        ("spectra.csv", "table of the patches"),
    ],
)
def test_what_a_folder_lacks_is_said(folder, tmp_path, lost, words, capsys):
    (tmp_path / "folder").mkdir()
    for path in folder.iterdir():
        if path.name != lost:
            (tmp_path / "folder" / path.name).symlink_to(path)
    if lost != "captures":
        (tmp_path / "folder" / "captures").unlink()
        (tmp_path / "folder" / "captures").mkdir()
        for path in (folder / "captures").iterdir():
            (tmp_path / "folder" / "captures" / path.name).symlink_to(path)
    assert (
        run(
            [
                "colorchecker",
                str(tmp_path / "folder"),
                "--cfa",
                "GBRG",
                "-o",
                str(tmp_path / "x.h5"),
            ]
        )
        == 3
    )
    assert words in capsys.readouterr().err and not (tmp_path / "x.h5").exists()


def test_a_real_chart_is_measured_as_well_as_its_data_allow(shared_data, tmp_path):
    """Captures of a ColorChecker by Llanos and Yang (2019) under seven filters, against
    their spectrometer.
    """
    folder = shared_data / "spectra" / "colorchecker_filtered"
    document = run_colorchecker(folder, tmp_path / "chart.h5", Settings(cfa="GBRG"))
    white, flat = (method.score for method in document.measures.methods)
    inner = slice(1, 6)
    assert white.rmse_six <= 0.020 and max(white.rmse_six_per_band[inner]) <= 0.030
    assert flat.rmse_six <= 0.018 and max(flat.rmse_six_per_band[inner]) <= 0.028
    assert (
        flat.rmse_24 <= 0.028
        and max(flat.rmse_24_per_band[inner]) <= 0.040
        and white.rmse_24 >= 2.5 * flat.rmse_24
    )
    assert flat.spectral_angle_deg <= 2.5
    assert (
        all(abs(v.median - 1) <= 0.015 for v in document.linearity.values())
        and len(document.linearity) >= 6
    )
