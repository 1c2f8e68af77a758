"""The predicted response beside the measured one: captures by wave optics point by point,
calibrated, against the closed form.
"""

import json

import numpy as np
import pytest

from plenocli.base.errors import ConfigError, InputError, UsageError
from plenocli.cli.main import run
from plenocli.files.artefacts.reading import read_artefact
from plenocli.forward.scene.tables import camera_sensitivity
from plenocli.forward.sensor.cfa import cfa_map
from plenocli.stages.evaluation.score.run import run_score
from plenocli.stages.forward.capture_sim import Settings as Capture
from plenocli.stages.forward.capture_sim import run_capture_sim
from plenocli.stages.forward.simulate_response import Settings, run_simulate_response
from plenocli.stages.inverse.calibrate import run_calibrate
from plenocli.stages.inverse.demux import Settings as Demux
from plenocli.stages.inverse.demux import run_demux

BANDS = (450e-9, 540e-9, 570e-9, 650e-9)
TEXT = """
[main_lens]
focal_length = "50 mm"
f_number = 8
aperture_shape = "square"
glass = "N-BK7"
[object]
distance = "550 mm"
samples_per_lenslet = [15, 15]
[lenslet_array]
distance = "55 mm"
superpixel_pitch = "60 um"
focal_length = "480 um"
glass = "fused silica"
count = [5, 7]
[sensor]
distance = "480 um"
pixel_pitch = "4 um"
pixels_per_lenslet = [15, 15]
quantum_efficiency = 0.55
black_level = 64
[light]
wavelengths = ["450 nm", "540 nm", "570 nm", "650 nm"]
design_wavelength = "550 nm"
[filter_array]
layout = [2, 2]
size = "6 mm"
gap = "0.3 mm"
filters = [ { center = "450 nm", fwhm = "40 nm", blocking = 1e-2 },
            { center = "540 nm", fwhm = "40 nm", blocking = 1e-2 },
            { center = "570 nm", fwhm = "40 nm", blocking = 1e-2 },
            { center = "650 nm", fwhm = "40 nm", blocking = 1e-2 } ]
"""
FINE = dict(spectral_step=75e-9, model="fresnel", accuracy=1e-3, superpixels=(3, 3))


def camera(folder, *changes, name="camera.toml"):
    text = TEXT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / name).write_text(text)
    return folder / name


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A camera, its captures under white and narrow-band light, the calibration they make and
    the one predicted.
    """
    folder = tmp_path_factory.mktemp("response")
    toml = camera(folder)
    targets = ["white", *(f"mono:{round(w * 1e9)}nm" for w in BANDS)]
    for seed, target in enumerate(targets):
        run_capture_sim(
            toml,
            folder / f"{target.replace(':', '-')}.h5",
            Capture(target=target, seed=seed, **FINE),
        )
    run_calibrate(
        folder / "measured.h5",
        whites=[folder / "white.h5"],
        bands=[(w, folder / f"mono-{round(w * 1e9)}nm.h5") for w in BANDS],
    )
    report = run_simulate_response(toml, folder / "predicted.h5", Settings(spectral_step=75e-9))
    return folder, toml, report


def test_prediction_and_calibration_agree_pixel_by_pixel(bench):
    folder, toml, report = bench
    assert report.notes.model == "fresnel" and report.notes.closed_form
    run_simulate_response(toml, folder / "rays.h5", Settings(model="ray"))
    document = run_score(
        [folder / "predicted.h5", folder / "rays.h5"],
        folder / "agreement.json",
        truth=folder / "measured.h5",
    ).as_json()
    waves, rays = (entry["metrics"] for entry in document["results"])
    # what is left of the waves is light from beyond the 3 x 3 superpixels that
    # the captures followed
    assert max(waves["response_error_per_band"]) < 0.035 and waves["response_leak"] < 0.005
    assert max(waves["response_error_lenslet_per_band"]) < 0.045
    np.testing.assert_allclose(waves["response_gain_per_band"], 1, atol=0.03)
    assert min(rays["response_error_per_band"]) > 2 * max(waves["response_error_per_band"])
    # the singlet blurs 450 nm over lenslets: the response does not change, where its
    # light comes from does
    own = dict(zip(BANDS, report.notes.own_light))
    assert own[450e-9] < 0.5 < 0.8 < own[540e-9]


def test_demux_takes_a_prediction_as_it_stands(bench):
    folder, _, _ = bench
    for k, wavelength in enumerate(BANDS):
        found = {}
        for name in ("measured", "predicted"):
            run_demux(
                [folder / f"mono-{round(wavelength * 1e9)}nm.h5"],
                folder / "radiance.h5",
                calibration=folder / f"{name}.h5",
                settings=Demux(method="wls"),
                overwrite=True,
            )
            found[name] = (
                read_artefact(folder / "radiance.h5", "spectra")
                .data["spectra/value"][:, 1:-1, 1:-1]
                .mean(axis=(1, 2))
            )
        np.testing.assert_allclose(found["predicted"], np.eye(4)[k], atol=0.03)
        np.testing.assert_allclose(found["predicted"], found["measured"], atol=0.03)
    for method in ("lmmse", "auto", "single-pixel", "nnls"):
        report = run_demux(
            [folder / "white.h5"],
            folder / "white-spectra.h5",
            calibration=folder / "predicted.h5",
            settings=Demux(method=method, reference=folder / "white.h5"),
            overwrite=True,
        )
        # within what the prediction is said to be known to, and its errors in shape are not
        # passed off as light
        assert (
            report.captures[0].warning is None and report.captures[0].registration.corrected == ()
        )
        assert read_artefact(folder / "white-spectra.h5", "spectra").data[
            "spectra/value"
        ] == pytest.approx(0.99, abs=0.02), method


def test_a_prediction_goes_where_the_lenslets_of_a_real_camera_are(bench):
    folder, toml, _ = bench
    run_calibrate(folder / "grid.h5", whites=[folder / "white.h5"])
    found = read_artefact(folder / "grid.h5", "calibration").data
    # filters pass light of unlike strength, which must not draw the grid
    np.testing.assert_allclose(
        (found["grid/centre"] - found["response/origin"]).mean(axis=(0, 1)), 7.0, atol=0.03
    )
    run_simulate_response(toml, folder / "placed.h5", Settings(), grid=folder / "grid.h5")
    placed, grid = (
        read_artefact(folder / name, "calibration") for name in ("placed.h5", "grid.h5")
    )
    for name in ("grid/centre", "response/origin", "response/white", "dark/mean", "white/flat"):
        np.testing.assert_array_equal(placed.data[name], grid.data[name])
    assert (
        placed.attrs["response"]["gain_e_per_dn"] == grid.attrs["white"]["gain_e_per_dn"]
        and "grid" in placed.provenance.inputs
    )
    document = run_score(
        [folder / "placed.h5"], folder / "placed.json", truth=folder / "measured.h5"
    ).as_json()
    assert max(document["metrics"]["response_error_per_band"]) < 0.035
    bayer = camera(
        folder,
        ("quantum_efficiency = 0.55", 'cfa = "RGGB"\ncamera = "Nikon 5100 (NPL)"'),
        name="bayer.toml",
    )
    with pytest.raises(InputError, match="colour filter array mono, the camera RGGB"):
        run_simulate_response(bayer, folder / "never.h5", Settings(), grid=folder / "grid.h5")
    with pytest.raises(InputError, match="calibration"):
        run_simulate_response(toml, folder / "never.h5", Settings(), grid=folder / "white.h5")


def test_colour_filters_of_the_sensor_are_part_of_the_response(bench, tmp_path):
    folder, _, _ = bench
    plain = read_artefact(folder / "predicted.h5", "calibration").data["response/F"]
    bayer = camera(
        tmp_path, ("quantum_efficiency = 0.55", 'cfa = "RGGB"\ncamera = "Nikon 5100 (NPL)"')
    )
    report = run_simulate_response(bayer, tmp_path / "bayer.h5", Settings(spectral_step=75e-9))
    data = read_artefact(tmp_path / "bayer.h5", "calibration").data
    # 15 is odd: windows begin on all four colours
    assert report.kinds == 4 and data["response/F"].shape == (5, 7, 225, 4)
    curves = camera_sensitivity("Nikon 5100 (NPL)", np.array(BANDS))
    for row, column in ((0, 0), (0, 1), (3, 2), (4, 5)):
        letters = cfa_map((15, 15), "RGGB", data["response/origin"][row, column]).ravel()
        for k in range(4):
            ratio = data["response/F"][row, column, :, k] / plain[:, k]
            expected = np.array([curves[letter][k] for letter in letters])
            np.testing.assert_allclose(ratio / ratio.max(), expected / expected.max(), rtol=1e-4)


def test_lenslets_off_the_raster_have_a_response_each(tmp_path):
    toml = camera(tmp_path, ('superpixel_pitch = "60 um"', 'superpixel_pitch = "61 um"'))
    report = run_simulate_response(toml, tmp_path / "off.h5", Settings(spectral_step=75e-9))
    data = read_artefact(tmp_path / "off.h5", "calibration").data
    # some windows reach over the edge
    assert report.kinds > 8 and data["grid/valid"].sum() == report.lenslets < 35
    response = data["response/F"].reshape(5, 7, 15, 15, 4)
    offsets = []
    for row, column in np.argwhere(data["grid/valid"]):
        light = response[row, column].sum(axis=-1)
        middle = np.array(
            [(light.sum(axis=1 - axis) * np.arange(15)).sum() / light.sum() for axis in (0, 1)]
        )
        offsets.append(
            middle + data["response/origin"][row, column] - data["grid/centre"][row, column]
        )
    # the picture of the pupil stands still about its centre, but for light cut off by the window
    assert np.ptp(offsets, axis=0).max() < 0.15
    assert np.ptp(data["grid/centre"] - data["response/origin"], axis=(0, 1)).max() > 0.5
    with pytest.raises(ConfigError, match="different places within their pixels"):
        run_simulate_response(toml, tmp_path / "never.h5", Settings(model="exact"))


@pytest.fixture
def focused(tmp_path):
    """A camera in focus, its options for a quick white, and its response in closed form."""
    toml, options = (
        camera(tmp_path, ('glass = "N-BK7"\n', "")),
        dict(wavelengths=(550e-9,), spectral_step=150e-9),
    )
    run_simulate_response(toml, tmp_path / "closed.h5", Settings(**options))
    return toml, options | dict(superpixels=(3, 3), accuracy=1e-2)


def error(folder, name):
    return run_score(
        [folder / name], folder / "agreement.json", truth=folder / "closed.h5", overwrite=True
    ).as_json()["metrics"]["response_error_per_band"][0]


def test_light_of_the_own_field_alone_is_the_block_of_the_system_matrix(focused, tmp_path):
    toml, options = focused
    own = run_simulate_response(
        toml, tmp_path / "own.h5", Settings(model="fresnel", own_field=True, **options)
    )
    assert own.notes.own_field and not own.notes.closed_form and own.notes.own_light == [1.0]
    # in focus the neighbours' points give a lenslet what diffraction takes from its own
    assert 0.04 < error(tmp_path, "own.h5") < 0.2


@pytest.mark.slow
def test_the_exact_model_gives_the_same(focused, tmp_path):
    toml, options = focused
    report = run_simulate_response(toml, tmp_path / "exact.h5", Settings(model="exact", **options))
    closed, summed = (
        read_artefact(tmp_path / f"{name}.h5", "calibration") for name in ("closed", "exact")
    )
    assert (
        report.notes.model == "exact"
        and summed.provenance.accuracy["model"] == "exact"
        and closed.provenance.accuracy["model"] == "fresnel"
    )
    assert error(tmp_path, "exact.h5") < 0.035


def test_the_command_tells_what_it_found_and_what_it_cannot_do(bench, capsys):
    folder, toml, _ = bench
    assert (
        run(
            [
                "simulate-response",
                str(toml),
                "-o",
                str(folder / "cli.h5"),
                "--spectral-step",
                "75nm",
                "--json",
            ]
        )
        == 0
    )
    found = json.loads(capsys.readouterr().out)
    assert (
        found["bands_nm"] == [450, 540, 570, 650]
        and found["condition"] > 1
        and len(found["rays_against_waves"]) == 4
    )
    # the command is on record
    assert (folder / "cli.h5").read_bytes() != (folder / "predicted.h5").read_bytes()
    assert (
        run(
            [
                "simulate-response",
                str(toml),
                "-o",
                str(folder / "again.h5"),
                "--spectral-step",
                "75nm",
            ]
        )
        == 0
    )
    assert (folder / "again.h5").read_bytes() == (folder / "cli.h5").read_bytes()
    assert "light from a lenslet's own field" in capsys.readouterr().out
    assert run(["simulate-response", str(toml), "-o", str(folder / "cli.h5")]) == 2
    with pytest.raises(UsageError, match="--accuracy is of the sum over a system matrix"):
        run_simulate_response(toml, folder / "never.h5", Settings(accuracy=1e-3))
    with pytest.raises(ConfigError, match="no light of 1200 nm"):
        dark = camera(folder, (", blocking = 1e-2", ""), name="dark.toml")
        run_simulate_response(dark, folder / "never.h5", Settings(wavelengths=(1200e-9,)))


def test_calibrations_that_cannot_be_compared_are_refused(bench, tmp_path):
    folder, toml, _ = bench
    with pytest.raises(UsageError, match="truth is missing"):
        run_score([folder / "predicted.h5"], tmp_path / "s.json")
    run_simulate_response(
        toml, tmp_path / "other.h5", Settings(wavelengths=(600e-9,), spectral_step=75e-9)
    )
    with pytest.raises(InputError, match="no band of the other"):
        run_score([tmp_path / "other.h5"], tmp_path / "s.json", truth=folder / "measured.h5")
    large = camera(
        tmp_path,
        ('superpixel_pitch = "60 um"', 'superpixel_pitch = "64 um"'),
        ("[15, 15]", "[16, 16]"),
    )
    run_simulate_response(large, tmp_path / "large.h5", Settings(spectral_step=75e-9))
    with pytest.raises(InputError, match="windows of 16 x 16"):
        run_score([tmp_path / "large.h5"], tmp_path / "s.json", truth=folder / "measured.h5")
    document = run_score(
        [folder / "measured.h5"], tmp_path / "same.json", truth=folder / "measured.h5"
    ).as_json()
    assert (
        max(document["metrics"]["response_error_lenslet_per_band"]) == 0
        and document["metrics"]["response_leak"] < 1e-9
    )
