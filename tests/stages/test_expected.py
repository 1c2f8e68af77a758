"""What statistics carried through a camera predict, against captures that were simulated pixel by
pixel, with noise drawn, and demultiplexed.
"""

from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import InputError, UsageError
from plenocli.evaluation.metrics import classes
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.config.camera_file import load_camera
from plenocli.files.images.mosaic import read_capture
from plenocli.files.read.class_table import read_labelled
from plenocli.files.results.truths import through_filters
from plenocli.forward.scene.labelled import SpectraChart
from plenocli.stages.evaluation.score.run import run_score
from plenocli.stages.forward import capture_sim, simulate_pif, simulate_response
from plenocli.stages.inverse import demux

ROOT = Path(__file__).resolve().parents[2]
METHODS = ("pinv", "wls", "lmmse", "single-pixel")


@pytest.fixture(scope="module")
def dim(tmp_path_factory):
    """A folder with a camera in dim light, two classes of two spectra, response and captures."""
    folder = tmp_path_factory.mktemp("dim")
    text = (ROOT / "sample_configs" / "demo_spectral.toml").read_text()
    for old, new in [
        ("[10, 10]", "[9, 9]"),
        ("[20, 30]", "[24, 24]"),
        ("[20, 20]", "[12, 12]"),
        ('"80 um"', '"48 um"'),
        ('"640 um"', '"384 um"'),
        ("[light]", '[light]\nilluminance = "700 lx"'),
        ("[sensor]", '[sensor]\nexposure = "10 ms"'),
        ('fwhm = "15 nm"', 'fwhm = "40 nm"'),
    ]:
        assert old in text
        text = text.replace(old, new)
    (folder / "camera.toml").write_text(text)
    (folder / "paints.csv").write_text(
        "nm,rust,rust,moss,moss\n400,.2,.22,.21,.23\n500,.25,.27,.27,.3\n600,.35,.38,.33,.36\n"
        "700,.45,.48,.42,.45\n"
    )
    camera = folder / "camera.toml"
    optics = simulate_pif.Settings(
        model="fresnel", accuracy=1e-2, superpixels=(3, 3), spectral_step="auto"
    )
    simulate_pif.run_simulate_pif(camera, folder / "pif.h5", optics)
    simulate_response.run_simulate_response(
        camera, folder / "response.h5", simulate_response.Settings()
    )
    for name, seed, target, scene in (
        ("white", 1, "white", None),
        ("shown", 2, None, folder / "paints.csv"),
    ):
        capture_sim.run_capture_sim(
            camera,
            folder / f"{name}.h5",
            capture_sim.Settings(seed=seed, target=target),
            scene=scene,
            pif=folder / "pif.h5",
        )
    return folder


def expected(folder, method, **options):
    return run_score(
        [folder / "response.h5"],
        folder / "expected.json",
        classes=folder / "paints.csv",
        method=method,
        overwrite=True,
        **options,
    ).figures


def drawn(folder, method, prior=None):
    """(estimates, truth (spectrum, lenslet, band), sigma (band,)) inside the patches."""
    demux.run_demux(
        [folder / "shown.h5"],
        folder / f"{method}.h5",
        calibration=folder / "response.h5",
        settings=demux.Settings(
            method=method, reference=folder / "white.h5", register="off", prior=prior
        ),
        suffix=".h5",
        overwrite=True,
    )
    value = read_artefact(folder / f"{method}.h5", "spectra").data["spectra/value"]
    camera = load_camera(folder / "camera.toml")
    bands = np.array(camera.light.wavelengths)
    known = read_labelled(folder / "paints.csv")
    truth = through_filters(lambda w: known.at(w).T, camera, bands)[:, 0].T
    chart = SpectraChart(known)
    assert (chart.rows, chart.columns) == (2, 2)
    blocks = value.reshape(len(bands), 2, 12, 2, 12)[:, :, 2:-2, :, 2:-2]  # none at an edge
    found = blocks.transpose(1, 3, 2, 4, 0).reshape(4, -1, len(bands))
    return found, truth


def drawn_white(folder, method):
    """Radiances of the white reference as captures are divided by them."""
    white = folder / "white.h5"
    settings = demux.Settings(method=method, reference=white, register="off")
    return demux.CaptureDemultiplexer(
        folder / "response.h5", settings, {}, overwrite=False, command=""
    ).reference.value


@pytest.mark.parametrize("method", METHODS)
def test_errors_and_separability_are_those_of_captures(dim, method):
    """Root mean square error in every band, and shares told rightly, by draws."""
    prior = dim / "paints.csv" if method == "lmmse" else None
    said = expected(dim, method, detect="rust", prior=prior)
    found, truth = drawn(dim, method, prior)
    rmse = np.sqrt(np.mean((found - truth[:, None]) ** 2, axis=(0, 1)))
    # of 256 draws a deviation is known to 4.4 %
    np.testing.assert_allclose(said["rmse_expected_per_band"], rmse, rtol=0.15)
    assert said["rmse_expected"] == pytest.approx(rmse.mean(), rel=0.08)
    noise = np.sqrt(np.mean(found.var(axis=1, ddof=1), axis=0))
    np.testing.assert_allclose(said["noise_expected_per_band"], noise, rtol=0.15)
    own = {"lmmse": "wls"}.get(method, method)  # a reference is demultiplexed without a prior
    white = drawn_white(dim, own)[:, 2:-2, 2:-2]
    ratio = white.mean(axis=(1, 2)) / white.std(axis=(1, 2), ddof=1)
    assert said["reference_snr_expected_db"] == pytest.approx(20 * np.log10(ratio.min()), abs=1)
    known = classes.Classes.of_spectra(("rust", "rust", "moss", "moss"), truth)
    spread = known.covariance + np.diag(np.square(said["noise_expected_per_band"]))
    told = classes.assigned(found.reshape(-1, 4), known.means, spread).reshape(4, -1)
    right = told == np.array([0, 0, 1, 1])[:, None]
    low, high = classes.wilson(right.mean(), right.size)
    assert low - 0.02 < said["class_accuracy_expected"] < high + 0.02
    assert 0.6 < right.mean() < 0.98  # neither chance nor certainty, of which nothing is learnt
    lenslets = found.transpose(1, 0, 2).reshape(-1, 4)
    label = np.tile([0, 0, 1, 1], found.shape[1])
    # as who knows these spectra tells them: others of a class of two say too little
    taught = classes.learnt_classes(lenslets, label, np.arange(len(label)) % 5) == label
    low, high = classes.wilson(taught.mean(), taught.size)
    said_taught = expected(dim, method, prior=prior, learnt=True)["class_accuracy_expected"]
    assert low - 0.02 < said_taught < high + 0.02
    member = np.repeat([0, 1], 2 * found.shape[1])
    target = classes.Filter.of(known, "rust", spread)
    area = classes.score_detection(
        found.reshape(-1, 4), np.arange(len(member)), member, target, known, spread
    )
    assert area.detection_auc_low - 0.02 < said["detection_auc_expected"]
    assert said["detection_auc_expected"] < area.detection_auc_high + 0.02


def test_no_processing_beats_the_pixels_themselves(dim):
    """And auto takes the method of least expected error."""
    each = {method: expected(dim, method) for method in METHODS}
    for figures in each.values():
        assert figures["class_accuracy_expected"] <= figures["class_accuracy_ideal"] + 1e-9
    best = min(each.values(), key=lambda figures: figures["rmse_expected"])
    assert expected(dim, "auto")["rmse_expected"] == best["rmse_expected"]


def test_what_cannot_be_expected_is_said(dim, tmp_path):
    with pytest.raises(UsageError, match="sand is no class"):
        expected(dim, "pinv", detect="sand")
    with pytest.raises(UsageError, match="the truth is missing"):
        run_score([dim / "response.h5"], tmp_path / "x.json")
    with pytest.raises(InputError, match="there is a band at 450 nm"):
        (tmp_path / "short.csv").write_text("nm,a,b\n500,1,1\n700,1,1\n")
        run_score([dim / "response.h5"], tmp_path / "x.json", classes=tmp_path / "short.csv")
    assert not (tmp_path / "x.json").exists()


def test_the_white_of_a_predicted_response_is_as_bright_as_the_captured_one(dim):
    """In light of known strength too, where every object point counts; 3x3 superpixels leave out
    3.4 % of the light.
    """
    captured = read_capture(dim / "white.h5").signal().reshape(24, 12, 24, 12)[2:-2, :, 2:-2]
    white = read_artefact(dim / "response.h5", "calibration").data["response/white"]
    np.testing.assert_allclose(captured.mean(), np.mean(white) * 0.966, rtol=0.01)
