"""The simulated prototype: four bands in the quadrants of 52 px, 5 % crosstalk, 15 ke- full well, 4
e- read noise, 12 bit.

Six ColorChecker patches, calibrated from noisy frames and demultiplexed by every estimator at two
exposures; captures are painted in closed form (tests/reference/prototype.py), moved ones too.
"""

import numpy as np
import pytest

from plenocli.cli.main import run
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.forward.scene.tables import SIX_PATCHES, colorchecker, patch_index
from plenocli.forward.sensor.detector import SensorModel
from plenocli.inverse.spectra.radiance import estimate, light_prior
from plenocli.stages.inverse.calibrate import run_calibrate
from plenocli.stages.inverse.demux import Settings, run_demux
from tests.reference.calibrations import lenslet_responses
from tests.reference.prototype import superpixels

ROWS, COLUMNS, PITCH, FRAME = 6, 9, 52, 6
BANDS = np.array([450e-9, 540e-9, 570e-9, 650e-9])
SENSOR = SensorModel(gain=0.25, read_noise=4.0, full_well=15000, bits=12, black_level=64)
PATCHES = np.array([colorchecker(BANDS)[2][patch_index(name)] for name in SIX_PATCHES])
TRUTH = np.repeat(PATCHES[:, None], COLUMNS, axis=1)  # one patch a lenslet row
LIGHT = np.array([0.9, 1.0, 0.95, 0.8])
FULL, SECONDS = 12000, 0.016


COLOURS = {"R": [0.04, 0.1, 0.2, 1.0], "G": [0.4, 1.0, 0.9, 0.15], "B": [1.0, 0.3, 0.1, 0.05]}


def save(
    path,
    radiance,
    seed,
    *,
    exposure=1.0,
    shift=(0.0, 0.0),
    offset=0.0,
    black=64.0,
    cfa="mono",
    **kind,
):
    wide = PITCH + 2 * FRAME  # light that crosses into the neighbour's superpixel lands there
    response = superpixels(np.array(shift), pixels=wide, pitch=PITCH, fall=0.2, **kind)
    if cfa != "mono":  # windows begin on an even row and column
        tile = np.array([COLOURS[letter] for letter in cfa]).reshape(2, 2, 4)
        response = response * np.tile(tile, (wide // 2, wide // 2, 1)).reshape(-1, 4)
    mean = np.zeros((ROWS * PITCH + 2 * FRAME, COLUMNS * PITCH + 2 * FRAME))
    for row, column in np.ndindex(ROWS, COLUMNS):
        light = response @ np.broadcast_to(radiance, (ROWS, COLUMNS, 4))[row, column]
        mean[row * PITCH : row * PITCH + wide, column * PITCH : column * PITCH + wide] += (
            light.reshape(wide, wide) * FULL * exposure
        )
    values = SENSOR.expose(mean, np.random.default_rng(seed)) + np.uint16(offset)
    known = dict(
        units="DN", black=black, white=4095.0, gain_e_per_dn=4.0, exposure_s=SECONDS * exposure
    )
    write_artefact(
        path,
        Artefact("capture", {"capture/mosaic": values, "capture/cfa": cfa}, {"capture": known}),
        overwrite=True,
    )
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("prototype")
    calibrated(folder, "calibration.h5")
    return folder


def calibrated(folder, name, frames=6, response="auto", **kind):
    if (folder / name).exists():
        return folder / name
    whites = [save(folder / f"white{i}.h5", LIGHT, 10 + i, **kind) for i in range(2)]
    darks = [
        save(folder / f"dark{i}.h5", np.zeros(4), 20 + i, cfa=kind.get("cfa", "mono"))
        for i in range(4)
    ]
    bands = [
        (w, save(folder / f"band{k}{i}.h5", np.eye(4)[k], 30 + 10 * k + i, **kind))
        for k, w in enumerate(BANDS)
        for i in range(frames)
    ]
    run_calibrate(folder / name, whites=whites, darks=darks, bands=bands, response=response)
    return folder / name


def demultiplexed(folder, capture, method, reference, calibration="calibration.h5", **settings):
    """(reflectance (R, C, band), sigma, residual, parameters)."""
    report = run_demux(
        [capture],
        folder / "out.h5",
        calibration=folder / calibration,
        overwrite=True,
        settings=Settings(
            method=method, reference=reference, reference_reflectance=1.0, **settings
        ),
    )
    assert report.captures[0].quantity == "reflectance"
    out = read_artefact(folder / "out.h5", "spectra")
    parameters = out.attrs["spectra"]["parameters"]
    return (
        *(np.moveaxis(out.data[f"spectra/{name}"], 0, -1) for name in ("value", "sigma")),
        out.data["spectra/residual"],
        parameters,
    )


def rmse(value, truth=TRUTH):
    return np.sqrt(((value - truth) ** 2).mean(axis=(0, 1)))


def white_snr(value):
    return 20 * np.log10(value[0].mean(axis=0) / value[0].std(axis=0, ddof=1))


@pytest.mark.parametrize("exposure, bar", [(1.0, 0.001), (1 / 16, 0.003)])
def test_every_estimator_meets_its_bar_and_its_prediction(folder, exposure, bar):
    chart = save(folder / "chart.h5", LIGHT * TRUTH, 90, exposure=exposure)
    reference = save(folder / "reference.h5", LIGHT, 91)
    found = {
        m: demultiplexed(folder, chart, m, reference, register="off")
        for m in ("single-pixel", "pinv", "wls", "lmmse", "nnls", "auto")
    }
    error = {m: rmse(value[0]) for m, value in found.items()}
    single = error["single-pixel"]
    for method in ("pinv", "wls", "lmmse", "nnls", "auto"):
        assert error[method].mean() < bar and (error[method] < 0.5 * single).all(), method
    assert error["lmmse"].mean() < 1.1 * error["wls"].mean()
    gain = white_snr(found["pinv"][0]) - white_snr(found["single-pixel"][0])
    assert gain.mean() > 18
    for method in ("pinv", "wls"):
        value, sigma, residual, _ = found[method]
        # 54 lenslets x 4 bands, and F-hat's own noise
        assert np.sqrt((((value - TRUTH) / sigma) ** 2).mean()) == pytest.approx(1, abs=0.15)
        assert np.median(residual) == pytest.approx(1, abs=0.1)


def test_monte_carlo_errors_are_the_predicted_ones_with_everything_estimated(folder):
    """Predicted variance within 5 % of what 10 000 draws show; SNR gain over single pixel within 1
    dB of the predicted one.

    The covariances of known noise, off the diagonal too, are tested
    in tests/inverse/spectra/test_demultiplex.py.
    """
    response = 0.25 * FULL / 16 * superpixels(np.zeros(2), pixels=26, side=22.7, gap=0.75, fall=0.2)
    rng = np.random.default_rng(5)
    truth = np.array([0.6, 0.3, 0.5, 0.4])
    electrons = rng.poisson(4 * response @ truth, (100, 100, 26**2))
    values = np.rint(0.25 * (electrons + rng.normal(0, 4, electrons.shape))).astype(np.float32)
    c = ideal(response, (100, 100))
    noise = SENSOR.noise()
    snr = {}
    for method in ("pinv", "wls", "lmmse", "single-pixel"):
        found = estimate(c, values, noise, method, light_prior(c))
        value, sigma = (np.moveaxis(part, 0, -1) for part in (found.value, found.sigma))
        error = value - (value.mean(axis=(0, 1)) if method in ("single-pixel", "lmmse") else truth)
        measured, predicted = error.var(axis=(0, 1)), (sigma**2).mean(axis=(0, 1))
        # 10 000 draws tell 1.4 % at one sigma
        np.testing.assert_allclose(measured, predicted, rtol=0.05)
        snr[method] = truth / np.sqrt(measured), truth / np.sqrt(predicted)
    gains = [20 * np.log10(snr["wls"][k] / snr["single-pixel"][k]) for k in (0, 1)]
    np.testing.assert_allclose(gains[0], gains[1], atol=1.0)
    assert (gains[0] > 15).all()  # an average of 130 pixels a cell


def ideal(response, shape):
    """A calibration without error: every lenslet alike, a white under LIGHT."""
    return lenslet_responses(response, BANDS, np.ones(shape, bool), white=response @ LIGHT)


def test_when_starved_the_prior_pays_and_auto_takes_it():
    """One pixel a cell at 1/256 exposure: the weak spot of every unbiased estimator."""
    own = np.eye(4)
    response = 0.25 * FULL / 256 * (0.95 * own + 0.05 / 3 * (1 - own))
    rng = np.random.default_rng(3)
    truth = np.repeat(PATCHES[:, None], 400, axis=1)
    values = np.rint(
        0.25 * (rng.poisson(4 * truth * LIGHT @ response.T) + rng.normal(0, 4, (6, 400, 4)))
    )
    c, noise = ideal(response, (6, 400)), SENSOR.noise()
    error = {
        m: rmse(
            np.moveaxis(estimate(c, values, noise, m, light_prior(c)).value, 0, -1) / LIGHT, truth
        ).mean()
        for m in ("pinv", "wls", "lmmse")
    }
    assert error["lmmse"] < 0.95 * error["wls"]
    assert error["pinv"] == pytest.approx(error["wls"])  # as many pixels as bands: nothing to weigh
    found = estimate(c, values, noise, "auto", light_prior(c))
    assert found.method == "lmmse" and "wls" in found.trace.reason


@pytest.mark.parametrize("shift", [(0.5, 0.5), (1.0, -1.0)])
def test_lenslets_that_moved_since_the_calibration_cost_nothing_after_registration(folder, shift):
    reference = save(folder / "reference.h5", LIGHT, 91)
    still = save(folder / "still.h5", LIGHT * TRUTH, 95)
    moved = save(folder / "moved.h5", LIGHT * TRUTH, 95, shift=shift)
    for method in ("pinv", "wls"):
        before = rmse(demultiplexed(folder, still, method, reference)[0]).mean()
        naive, _, poor, parameters = demultiplexed(folder, moved, method, reference, register="off")
        value, _, residual, found = demultiplexed(folder, moved, method, reference)
        assert rmse(naive).mean() > 4 * before and rmse(value).mean() < 1.5 * before, method
        assert found["registration"]["corrected"] == ["motion"] and found["warning"] is None
        np.testing.assert_allclose(found["registration"]["shift_px"], shift, atol=0.01)
        assert np.median(poor) > 5 and np.median(residual) < 1.3
        assert parameters["registration"] is None and "not registered" in parameters["warning"]


@pytest.mark.parametrize(
    "cfa, shift", [("mono", (0.5, 0.5)), ("GRBG", (0.3, -0.2)), ("GRBG", (1.0, -0.7))]
)
def test_a_moved_capture_costs_nothing_with_a_response_of_each_lenslet_from_one_frame(
    folder, cfa, shift
):
    """Single responses are noisy, most of all where a colour is weak: that must not pass for a
    motion nor grow by one.
    """
    name = f"own-{cfa}.h5"
    calibrated(folder, name, frames=1, response="own", cfa=cfa)
    reference = save(folder / f"reference-{cfa}.h5", LIGHT, 91, cfa=cfa)
    still = save(folder / f"still-{cfa}.h5", LIGHT * TRUTH, 95, cfa=cfa)
    moved = save(folder / f"moved-{cfa}.h5", LIGHT * TRUTH, 95, shift=shift, cfa=cfa)
    before = rmse(demultiplexed(folder, still, "wls", reference, name)[0]).mean()
    naive = rmse(demultiplexed(folder, moved, "wls", reference, name, register="off")[0]).mean()
    value, _, residual, found = demultiplexed(folder, moved, "wls", reference, name)
    np.testing.assert_allclose(found["registration"]["shift_px"], shift, atol=0.004)
    assert (
        naive > 2.5 * before
        and rmse(value).mean() < 1.5 * before
        and np.median(residual) < 1.1
        and found["warning"] is None
    )


def test_an_offset_is_found_and_taken_off(folder):
    reference = save(folder / "reference.h5", LIGHT, 91)
    plain = save(folder / "plain.h5", LIGHT * TRUTH, 96, exposure=1 / 16)
    lifted = save(folder / "lifted.h5", LIGHT * TRUTH, 96, exposure=1 / 16, offset=2)
    before = rmse(demultiplexed(folder, plain, "wls", reference)[0]).mean()
    naive = rmse(demultiplexed(folder, lifted, "wls", reference, register="off")[0]).mean()
    value, _, _, found = demultiplexed(folder, lifted, "wls", reference)
    assert naive > 5 * before and rmse(value).mean() < 1.2 * before
    assert "offset" in found["registration"]["corrected"] and found["registration"][
        "offset"
    ] == pytest.approx(2 * 16, rel=0.05)


@pytest.mark.parametrize("leak", [0.03, 0.04, 0.07])
def test_a_diffuse_leak_that_changed_is_taken_apart(folder, leak, capsys):
    calibrated(folder, "diffuse.h5", kind="diffuse")
    reference = save(folder / "reference.h5", LIGHT, 91, kind="diffuse", leak=leak)
    same = save(folder / "same.h5", LIGHT * TRUTH, 97, kind="diffuse")
    other = save(folder / "other.h5", LIGHT * TRUTH, 97, kind="diffuse", leak=leak)
    white = save(folder / "white.h5", LIGHT, 91, kind="diffuse")
    before = rmse(demultiplexed(folder, same, "wls", white, "diffuse.h5")[0]).mean()
    naive, _, residual, parameters = demultiplexed(
        folder, other, "wls", reference, "diffuse.h5", register="off"
    )
    assert (
        rmse(naive).mean() > 4 * before
        and np.median(residual) > 1.5
        and "residuals have" in parameters["warning"]
    )
    assert "warning" in capsys.readouterr().err
    value, _, residual, found = demultiplexed(folder, other, "wls", reference, "diffuse.h5")
    assert (
        rmse(value).mean() < 2 * before
        and found["registration"]["corrected"] == ["stray light"]
        and np.median(residual) < 1.1
    )


def test_a_leak_within_the_cells_that_changed_shows_in_no_residual_and_costs_what_the_mixture_says(
    folder,
):
    """Bands mixed alike at every pixel span the same space: only new narrow-band captures tell
    them apart (docs/model.md).
    """
    leak = 0.07
    reference = save(folder / "reference.h5", LIGHT, 91, leak=leak)
    other = save(folder / "other.h5", LIGHT * TRUTH, 97, leak=leak)
    value, _, residual, found = demultiplexed(folder, other, "wls", reference)
    mixture = np.linalg.inv(mixed(0.05)) @ mixed(leak)
    expected = (LIGHT * PATCHES) @ mixture.T / (mixture @ LIGHT)
    assert np.median(residual) == pytest.approx(1, abs=0.05) and found["warning"] is None
    # slopes differ by band, which the mixture leaves out
    np.testing.assert_allclose(value.mean(axis=1), expected, atol=0.0015)
    assert 0.003 < rmse(value).mean() < 0.006


def mixed(leak):
    return (1 - leak) * np.eye(4) + leak / 3 * (1 - np.eye(4))


@pytest.mark.parametrize(
    "change, worse",
    [
        (dict(side=44.0), 1.1),
        (dict(blur=1.5), 1.1),
        (dict(gap=3.0), 1.1),
        (dict(shift=(8.0, 0.0)), 1.001),
    ],
)
def test_what_no_motion_explains_is_said_and_not_made_worse(folder, change, worse, capsys):
    """Superpixels of another size or focus, and an array that moved too far: residuals tell,
    nothing is invented.
    """
    reference = save(folder / "reference.h5", LIGHT, 91)
    other = save(folder / "strange.h5", LIGHT * TRUTH, 97, **change)
    naive = demultiplexed(folder, other, "wls", reference, register="off")[0]
    value, _, residual, found = demultiplexed(folder, other, "wls", reference)
    assert rmse(value).mean() < worse * rmse(naive).mean() and np.median(residual) > 10
    assert "residuals have" in found["warning"] and "calibrate again" in capsys.readouterr().err


def test_far_motion_ends_registration_on_demand(folder, capsys):
    far = save(folder / "far.h5", LIGHT * TRUTH, 98, shift=(8.0, 0.0))
    assert (
        run(
            [
                "demux",
                str(far),
                "--calibration",
                str(folder / "calibration.h5"),
                "--register",
                "on",
                "-o",
                str(folder / "never.h5"),
            ]
        )
        == 5
    )
    assert (
        "further than it can be followed" in capsys.readouterr().err
        and not (folder / "never.h5").exists()
    )


def test_registration_can_be_asked_for_and_needs_light(folder, capsys):
    dark = save(folder / "night.h5", np.zeros(4), 99)
    assert (
        run(
            [
                "demux",
                str(dark),
                "--calibration",
                str(folder / "calibration.h5"),
                "--register",
                "on",
                "-o",
                str(folder / "never.h5"),
            ]
        )
        == 5
    )
    assert "lenslets hold light" in capsys.readouterr().err and not (folder / "never.h5").exists()
