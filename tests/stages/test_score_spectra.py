"""score's measures of spectra beside single pixel, through a camera's filters, and how often
lenslets tell their patch.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import InputError, UsageError
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.config.camera_file import load_camera
from plenocli.forward.scene.chart import chart_scene
from plenocli.forward.scene.tables import colorchecker, illuminant
from plenocli.stages.evaluation.score.run import run_score, table

BANDS = np.array([450e-9, 540e-9, 570e-9, 650e-9])
CAMERA = Path(__file__).resolve().parents[2] / "sample_configs" / "demo_spectral.toml"
TRUTH = chart_scene(480, 720, BANDS)[0].astype("f8").reshape(4, 24, 20, 36, 20).mean(axis=(2, 4))


def put(path, value, **attrs):
    data = {"spectra/value": value, "spectra/wavelength": BANDS}
    write_artefact(
        path,
        Artefact(
            "spectra",
            data,
            {"spectra": {"quantity": "reflectance"} | attrs},
            Provenance(command="test"),
        ),
        overwrite=True,
    )
    return path


@pytest.fixture
def methods(tmp_path):
    """Results of two methods, the second three times worse; a white target by each."""
    rng = np.random.default_rng(3)
    noise, white = rng.normal(size=(2, *TRUTH.shape))
    results, whites = [], []
    for name, spread in (("pinv", 0.01), ("single-pixel", 0.03)):
        results.append(put(tmp_path / f"{name}.h5", TRUTH + spread * noise, method=name))
        whites.append(put(tmp_path / f"white-{name}.h5", 1 + spread * white, method=name))
    return tmp_path, results, whites


def test_every_method_is_set_against_single_pixel_with_its_own_white(methods):
    folder, results, whites = methods
    document = run_score(results, folder / "s.json", truth="colorchecker", whites=whites)
    own, single = (entry.figures for entry in document.results)
    assert own["snr_over_single_pixel_db"] == pytest.approx(20 * np.log10(3), abs=0.01)
    assert own["rmse_over_single_pixel"] == pytest.approx(1 / 3, rel=1e-3) and own[
        "six_patch_rmse_over_single_pixel"
    ] == pytest.approx(1 / 3, rel=0.01)
    assert 0.2 < own["delta_e_over_single_pixel"] < 0.5
    assert not any("over_single" in name for name in single)
    assert {name for name in own if "single" in name or "accuracy" in name} <= set(
        document.definitions
    )
    assert "capture SNR above single pixel's" in table(document)
    only = run_score(
        results, folder / "t.json", truth="colorchecker", whites=whites, metrics=("rmse",)
    )
    assert set(only.figures) == {"rmse", "rmse_per_band"}


def test_a_white_of_another_method_serves_only_where_it_is_the_only_one(methods):
    folder, results, whites = methods
    other = put(folder / "wls.h5", TRUTH, method="wls")
    assert run_score([other], folder / "s.json", truth="colorchecker", whites=whites[:1]).figures[
        "snr_capture_mean_db"
    ] == pytest.approx(40, abs=0.3)
    with pytest.raises(UsageError, match="made by wls"):
        run_score([other], folder / "t.json", truth="colorchecker", whites=whites)


def test_lenslets_tell_their_patch_the_better_the_less_noise(methods, monkeypatch):
    folder, results, _ = methods
    noisy = put(
        folder / "noisy.h5",
        TRUTH + 0.1 * np.random.default_rng(0).normal(size=TRUTH.shape),
        method="wls",
    )
    document = run_score(
        [*results, noisy], folder / "s.json", truth="colorchecker", metrics=("classification",)
    )
    nearest = [entry.figures["nearest_patch_accuracy"] for entry in document.results]
    assert nearest[0] > 0.97 and nearest[0] > nearest[1] > nearest[2] > 3 / 24
    monkeypatch.setitem(sys.modules, "sklearn.discriminant_analysis", None)
    without = run_score([noisy], folder / "t.json", truth="colorchecker").figures
    assert (
        "classification_accuracy" not in without and without["nearest_patch_accuracy"] == nearest[2]
    )


def test_a_trained_classifier_agrees(methods):
    pytest.importorskip("sklearn")
    folder, results, _ = methods
    document = run_score(results, folder / "s.json", truth="colorchecker")
    trained = [entry.figures["classification_accuracy"] for entry in document.results]
    assert trained[0] > 0.95 and trained[0] > trained[1] > 0.5


def test_the_truth_through_filters_is_the_integral_over_light_and_filter(tmp_path):
    camera = load_camera(CAMERA)
    l = np.arange(400, 700.01, 0.5) * 1e-9
    weight = np.where((l == l[0]) | (l == l[-1]), 0.5, 1.0) * illuminant("D65", l) * l
    passed = np.array([0.8 * np.exp(-4 * np.log(2) * ((l - b) / 15e-9) ** 2) + 1e-3 for b in BANDS])
    spectra = colorchecker(l)[2]
    expected = (spectra[:, None] * weight * passed).sum(axis=-1) / (weight * passed).sum(axis=-1)
    labels = chart_scene(24, 36, BANDS, gap=0.1)[1]
    truth = np.zeros((4, 24, 36))
    for k in range(1, 25):
        truth[:, labels == k] = expected[k - 1][:, None]
    result = put(tmp_path / "seen.h5", truth, method="pinv")
    assert camera.filter_array.filters[0].fwhm == pytest.approx(15e-9)
    plain = run_score([result], tmp_path / "p.json", truth="colorchecker").figures
    through = run_score([result], tmp_path / "t.json", truth="colorchecker", camera=CAMERA).figures
    # nodes are 7.5 nm apart, spectra 5
    assert plain["six_patch_rmse"] > 2e-3 > 3e-4 > through["six_patch_rmse"]


def test_filters_need_a_camera_with_them_and_a_scene_between_bands(tmp_path):
    result = put(tmp_path / "seen.h5", TRUTH, method="pinv")
    with pytest.raises(UsageError, match="filter_array"):
        run_score(
            [result],
            tmp_path / "s.json",
            truth="colorchecker",
            camera=CAMERA.with_name("tiny.toml"),
        )
    with pytest.raises(InputError, match="filters"):
        run_score([result], tmp_path / "s.json", truth=result, camera=CAMERA)
