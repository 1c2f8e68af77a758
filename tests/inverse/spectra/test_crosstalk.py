"""Checkerboards of spectra through a simulated camera, demultiplexed with a description that is not
quite its own.
"""

import functools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import plenocli.api as pc
from plenocli.base.budget import Budget, within
from plenocli.base.errors import ConfigError, NumericsError, UsageError
from plenocli.forward.accuracy.dial import pif_builder
from plenocli.forward.scene.light import Quadrature, narrow_band
from plenocli.forward.scene.scenes import Uniform
from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE
from plenocli.forward.sensor.exposure.matrices import StoredMatrix
from plenocli.forward.sensor.exposure.options import ExposureOptions
from plenocli.forward.sensor.exposure.simulate import simulate_capture
from plenocli.inverse.calibration.measure import NarrowBands, calibrate
from plenocli.inverse.spectra import neighbours
from plenocli.inverse.spectra.bands import by_filter
from plenocli.inverse.spectra.crosstalk import METHODS, Crosstalk, windows_of
from plenocli.inverse.spectra.demultiplexer import Demultiplexer
from plenocli.inverse.spectra.neighbours import POINTS
from plenocli.inverse.spectra.radiance import readout
from plenocli.inverse.spectra.responses import LensletResponses

SAMPLES = Path(__file__).resolve().parents[3] / "sample_configs"
COUNT = (10, 12)


class Mosaic:
    """Every lenslet another reflectance in each band; `offset` lenslets moves its edges."""

    spectral = True

    def __init__(self, bands, seed, offset=0.0):
        self.bands, self.offset = list(bands), offset
        size = (len(self.bands), COUNT[0] + 1, COUNT[1] + 1)
        self.values = np.random.default_rng(seed).uniform(0.05, 0.9, size)

    def at(self, wavelength, rows, columns, part=slice(None)):
        i, j = (
            np.floor((np.arange(n) + 0.5) / n * count + self.offset).astype(int)
            for n, count in zip((rows, columns), COUNT)
        )
        return self.values[self.bands.index(wavelength)][i[part]][:, j].astype(np.float32)

    def truth(self):
        fine = 30
        pictures = [self.at(w, COUNT[0] * fine, COUNT[1] * fine) for w in self.bands]
        return np.array(
            [one.reshape(COUNT[0], fine, COUNT[1], fine).mean((1, 3)) for one in pictures]
        )


@pytest.fixture(scope="module")
def bench():
    """(camera, calibration, white, shoot): a real camera, its fields sampled finely, filters 0.5
    % larger and the sensor 0.5 % further away than its description says.
    """
    described = pc.read_camera(SAMPLES / "seed_spectral.toml").replace(
        **{
            "lenslet_array.count": COUNT,
            "sensor.pixels_per_lenslet": (20, 20),
            "sensor.pixel_pitch": 5.2e-6,
        }
    )
    camera = described.replace(
        **{
            "object.samples_per_lenslet": (30, 30),
            "sensor.distance": described.sensor.distance * 1.005,
            "filter_array.size": described.filter_array.size * 1.005,
        }
    )
    bands = camera.light.wavelengths
    light = Quadrature(wavelengths=np.array(bands), photons=np.ones(len(bands)))

    @functools.cache
    def matrices(shift):
        moved = camera.with_fit(shift, 0.0)
        builders = {w: pif_builder(moved, w, superpixels=(3, 3), model="fresnel") for w in bands}
        return {w: StoredMatrix(one.whole(), one.offsets) for w, one in builders.items()}

    def shoot(scene, source=light, seed=0, exposure=1.0, shift=(0.0, 0.0)):
        options = ExposureOptions(seed=seed, exposure=exposure * camera.light.white_exposure)
        return simulate_capture(camera, source, scene, options, matrices=matrices(shift)).capture

    white = shoot(Uniform(REFERENCE_REFLECTANCE), seed=1)
    narrow = {
        w: [shoot(Uniform(REFERENCE_REFLECTANCE), narrow_band(w, 0.0), 10 * k + n) for n in (2, 3)]
        for k, w in enumerate(bands)
    }
    calibration = calibrate(
        [white],
        darks=[shoot(Uniform(0.0), seed=99)],
        bands=NarrowBands(wavelengths=bands, captures=lambda w: narrow[w]),
        camera=described,
    ).calibration
    return described, calibration, white, shoot


@pytest.fixture(scope="module", autouse=True)
def predicted_once():
    """Neighbours' light, which takes longest by far, once for each camera and response: what is
    said beside these, noise figures and notes, it does not depend on.
    """
    predict, found = neighbours.neighbour_light, {}

    @functools.wraps(predict)
    def known(camera, calibration):
        response = calibration.response
        matrix = getattr(response.matrix, "values", response.matrix)
        asked = (camera, *(v.tobytes() for v in (matrix, response.wavelengths)))
        if asked not in found:
            found[asked] = predict(camera, calibration)
        return found[asked]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(neighbours, "neighbour_light", known)
        yield


@pytest.fixture(scope="module")
def solve(bench):
    """solve(shot, method): reflectances, by one prediction for all, once for each."""
    camera, calibration, white, _ = bench
    solver = Demultiplexer(calibration, camera=camera, ratio=True)
    reference = solver.estimate(white, "white", "pinv")

    found = {}

    def solved(shot, method="auto"):
        asked = id(shot), method
        if asked not in found:  # beside its capture, so that no other one is there
            spectra = solver.estimate(shot, "x", method)
            found[asked] = spectra.relative_to(reference, REFERENCE_REFLECTANCE), shot
        return found[asked][0]

    return solved


@pytest.fixture(scope="module")
def checkerboard(bench):
    camera, _, _, shoot = bench
    scene = Mosaic(camera.light.wavelengths, 5)
    return scene.truth(), shoot(scene, seed=7)


def errors(found, truth):
    """(root mean square error, that over the stated one) of lenslets that are not at the border."""
    inner = (slice(None), slice(1, -1), slice(1, -1))
    error = (found.value - truth)[inner]
    return np.sqrt((error**2).mean()), np.sqrt(((error / found.sigma[inner]) ** 2).mean())


def test_a_checkerboard_is_five_times_better_and_says_how_good(solve, checkerboard):
    truth, shot = checkerboard
    plain, found = solve(shot, "pinv"), solve(shot)
    worse, z_worse = errors(plain, truth)
    error, z = errors(found, truth)
    assert found.method == "coupled" and "single-pixel" in found.trace.reason
    assert error < worse / 5 and error < 0.004
    assert 0.6 < z < 2.5 < z_worse


def test_the_rehearsal_knows_the_error_of_other_methods(solve, bench, checkerboard):
    truth, shot = checkerboard
    reason = solve(shot).trace.reason
    told = {name: float(reason.split(name + " ")[1].split(",")[0]) for name in ("pinv", "coupled")}
    ratio = errors(solve(shot, "pinv"), truth)[0] / errors(solve(shot, "coupled"), truth)[0]
    assert told["pinv"] / told["coupled"] == pytest.approx(ratio, rel=0.8)


def test_edges_inside_fields_are_told(bench, solve):
    camera, _, _, shoot = bench
    scene = Mosaic(camera.light.wavelengths, 6, offset=0.4)
    shot = shoot(scene, seed=8)
    found = {method: solve(shot, method) for method in ("auto", "pinv", "coupled")}
    rms = {method: errors(one, scene.truth())[0] for method, one in found.items()}
    assert found["auto"].method == "fine"
    assert rms["auto"] < 0.95 * min(rms["pinv"], rms["coupled"])
    assert errors(found["auto"], scene.truth())[1] < 1.6


def test_fine_is_left_out_where_the_response_is_predicted(bench):
    camera, calibration, _, shoot = bench
    shot = shoot(Mosaic(camera.light.wavelengths, 6, offset=0.4), seed=8)
    response = replace(calibration.response, notes={"source": "predicted"})
    for one, taken in ((response, "coupled"), (calibration.response, "fine")):
        solver = Demultiplexer(replace(calibration, response=one), camera=camera, ratio=True)
        assert solver.estimate(shot, "x").method == taken


class Notebook:
    """A Keeper; it stops whoever asks it to keep more than `most` solutions."""

    def __init__(self, known, most=10**6, prefix=""):
        self.known, self.most, self.prefix = known, most, prefix

    def get(self, tile):
        return self.known.get(self.prefix + tile)

    def put(self, tile, arrays):
        if len(self.known) == self.most:
            raise KeyboardInterrupt
        self.known[self.prefix + tile] = [np.array(one, float) for one in arrays]

    def under(self, name):
        return Notebook(self.known, self.most, f"{self.prefix}{name}.")


@pytest.mark.parametrize("own", [pytest.param(False, marks=pytest.mark.slow), True])
def test_solutions_that_an_earlier_run_left_give_the_same_bytes(bench, checkerboard, own):
    """Of a capture that moved, whichever solution was the last."""
    camera, calibration, _, shoot = bench
    shot = shoot(Mosaic(camera.light.wavelengths, 5), seed=7, shift=(0.3, -0.2))
    if own:
        calibration = with_own(calibration)
    solver = Demultiplexer(calibration, camera=camera, ratio=True)
    kept = {}
    whole = solver.estimate(shot, "x", "fine", Notebook(kept))
    names = list(kept)
    assert len(names) > 8 and len({name.split(".")[0] for name in names}) > 1
    for most in (len(names) - 2,) if own else (1, len(names) - 2):
        known = {}
        with pytest.raises(KeyboardInterrupt):
            solver.estimate(shot, "x", "fine", Notebook(known, most))
        assert list(known) == names[:most]
        found = solver.estimate(shot, "x", "fine", Notebook(known))
        assert list(known) == names
        for part in ("value", "sigma", "residual"):
            assert getattr(found, part).tobytes() == getattr(whole, part).tobytes()
        assert repr(found.trace) == repr(whole.trace)


def with_own(calibration):
    """A calibration in which every lenslet has a response of its own, 1 % brighter or darker."""
    valid = calibration.grid.valid
    gains = 1 + 0.01 * np.random.default_rng(3).normal(size=(*valid.shape, 1, 1))
    matrix = (gains * calibration.response.matrix).astype(np.float32)
    white = (gains[..., 0] * calibration.white.superpixels).astype(np.float32)
    return replace(
        calibration,
        response=replace(calibration.response, matrix=matrix),
        white=replace(calibration.white, superpixels=white),
    )


class ByLenslet:
    """Responses that stay in their file; plenocli.inverse.calibration.MadeResponses."""

    def __init__(self, values):
        self.values, self.shape, self.ndim = values, values.shape, values.ndim

    def __getitem__(self, places):
        assert isinstance(places, slice) or len(places) == 2
        return self.values[places]


@pytest.mark.slow
def test_responses_that_stay_in_their_file_give_the_same(bench, checkerboard):
    camera, calibration, _, _ = bench
    held = with_own(calibration)
    made = replace(held, response=replace(held.response, matrix=ByLenslet(held.response.matrix)))
    light = [neighbours.neighbour_light.__wrapped__(camera, one).light for one in (held, made)]
    np.testing.assert_array_equal(*light)
    whole, found = (
        Demultiplexer(one, register="off", camera=camera, several=False).estimate(
            checkerboard[1], "x", "coupled"
        )
        for one in (held, made)
    )
    np.testing.assert_array_equal(found.value, whole.value)


def test_neighbours_light_comes_from_their_near_edges(bench):
    """Of parts of a field, whatever order the prediction works its points out in."""
    camera, calibration, _, _ = bench
    calibration = by_filter(calibration, camera)
    found = neighbours.neighbour_light(camera, calibration)
    for step in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        which = np.flatnonzero((found.offsets == step).all(axis=1))[0]
        modes, light = found.modes, found.light[which].sum(axis=0)
        across = modes.kept[:, 1 if step[0] else 0] == 0
        along = modes.kept[across, 0 if step[0] else 1]
        weights = modes.weights[along] * modes.weights[0].sum()
        # what the points of a line tell of the modes, by what neighbours see of these
        lines = (weights.T @ light[across]).reshape(3, POINTS // 3, -1).sum(axis=1)[:: sum(step)]
        assert (lines[-1] > 5 * lines[1]).all() and (lines[-1] > 5 * lines[0]).all()


def test_lost_lenslets_and_saturated_pixels_stay_where_they_are(solve, checkerboard):
    _, shot = checkerboard
    mosaic = np.array(shot.mosaic)
    mosaic[60:80, 80:100] = shot.levels.white  # a lenslet
    mosaic[123, 45] = shot.levels.white
    whole, found = (solve(one, "coupled") for one in (shot, replace(shot, mosaic=mosaic)))
    assert np.isnan(found.value[:, 3, 4]).all() and np.isfinite(found.value[:, 0]).all()
    apart = np.abs(found.value - whole.value) / whole.sigma
    apart[:, 2:5, 3:6] = 0
    assert np.nanmax(apart) < 1.0


def test_own_responses_of_lenslets_give_what_a_shared_one_does(bench, solve, checkerboard):
    """Lenslets whose gains differ by 3 %, and a calibration that knows."""
    camera, calibration, _, _ = bench
    calibration = by_filter(calibration, camera)
    _, shot = checkerboard
    gain = np.random.default_rng(1).uniform(0.97, 1.03, (*COUNT, 1, 1))
    own = replace(
        calibration,
        response=replace(calibration.response, matrix=calibration.response.matrix * gain),
    )
    one, many = LensletResponses.of(calibration), LensletResponses.of(own)
    light = neighbours.neighbour_light(camera, calibration)
    signal, noise = readout(shot, one, "x")
    values = windows_of(one, signal)
    shared = Crosstalk(one, light, values, noise).first.value
    each = Crosstalk(many, light, values * gain[..., 0], noise).first.value
    assert np.abs(each - shared).max() < 0.01 * shared.max()
    wrong = Crosstalk(one, light, values * gain[..., 0], noise).first.value
    assert np.abs(wrong - shared).max() > 0.02 * shared.max()


def test_a_look_that_leaves_pixels_out_explains_no_more(bench):
    """Edges inside fields show most at the rims of superpixels."""
    camera, calibration, _, shoot = bench
    calibration = by_filter(calibration, camera)
    c = LensletResponses.of(calibration)
    signal, noise = readout(shoot(Mosaic(camera.light.wavelengths, 6, offset=0.4), seed=8), c, "x")
    whole = windows_of(c, signal)
    values = whole.copy()
    values.reshape(*COUNT, 20, 20)[..., [0, 1, -2, -1], :] = np.nan
    light = neighbours.neighbour_light(camera, calibration)
    every, some = (Crosstalk(c, light, one, noise) for one in (whole, values))
    assert np.nanmean(some.first.residual) < 0.95 * np.nanmean(every.first.residual)
    assert not some.explains_more_than(every)


@pytest.mark.parametrize(
    "shift", [pytest.param((0.4, -0.25), marks=pytest.mark.slow), (0.5, -0.25)]
)
def test_parts_of_a_pixel_cost_little(bench, solve, checkerboard, shift):
    """Light of the neighbours' own superpixels enters through the rim."""
    camera, _, _, shoot = bench
    truth, shot = checkerboard
    moved = shoot(Mosaic(camera.light.wavelengths, 5), seed=7, shift=shift)
    still, found = solve(shot), solve(moved)
    assert found.method == "coupled"
    assert errors(found, truth)[0] < 1.5 * errors(still, truth)[0]


def test_what_cannot_be_predicted_is_said(bench, capsys):
    camera, calibration, _, shoot = bench
    for method in METHODS:
        with pytest.raises(UsageError, match="camera's description"):
            Demultiplexer(calibration, method=method)
    other = camera.replace(**{"sensor.pixels_per_lenslet": (26, 26), "sensor.pixel_pitch": 4e-6})
    with pytest.raises(ConfigError, match="26 x 26 px"):
        Demultiplexer(calibration, method="fine", camera=other)
    Demultiplexer(calibration, camera=other)
    assert "one by one" in capsys.readouterr().err
    turned = camera.replace(**{"filter_array.filters": camera.filter_array.filters[::-1]})
    with pytest.raises(ConfigError, match="differs by"):
        neighbours.neighbour_light(turned, calibration)
    near = camera.replace(**{"object.distance": 1.5 * camera.main_lens.focal_length})
    with pytest.raises(ConfigError, match="lenslets in a row, of which 5 are followed"):
        neighbours.neighbour_light(near, calibration)


def test_without_noise_figures_pixels_are_not_weighed(bench, checkerboard):
    camera, calibration, _, _ = bench
    _, shot = checkerboard
    blind = replace(calibration, sensor=replace(calibration.sensor, gain_e_per_dn=None))
    shot = replace(shot, noise=None, levels=replace(shot.levels, gain=None))
    with pytest.raises(NumericsError, match="not known"):
        Demultiplexer(blind, method="coupled", camera=camera, ratio=True).estimate(shot, "x")


def test_all_lenslets_together_are_refused_where_they_do_not_fit(bench, checkerboard):
    camera, calibration, _, _ = bench
    pixels = math.prod(calibration.response.matrix.shape[-2:-1]) * calibration.grid.valid.size
    for planes, refused in ((2, True), (40, False)):
        solver = Demultiplexer(calibration, method="coupled", camera=camera, ratio=True)
        with within(Budget(4 * planes * pixels)):
            if not refused:
                assert solver.estimate(checkerboard[1], "x").method == "coupled"
                continue
            with pytest.raises(NumericsError, match="all lenslets together.*--method pinv"):
                solver.estimate(checkerboard[1], "x")


@pytest.mark.slow
def test_light_that_moved_by_more_than_half_a_pixel_goes_on_as_below_it(bench):
    """By a camera whose own pixels are shifted, which says no more than half a pixel."""
    camera, calibration, _, _ = bench
    calibration = by_filter(calibration, camera)
    found = neighbours.neighbour_light(camera, calibration)
    shifted = replace(found, camera=camera.with_fit((0.4, -0.45), 0.0))
    below, above, further = (
        shifted.moved(np.array([0.4 - down, down - 0.45]), calibration).light
        for down in (0.48, 0.52, 0.56)
    )
    step, next_step = (
        np.abs(b - a).sum(axis=(1, 2, 3)) for a, b in ((below, above), (above, further))
    )
    assert (step < 1.3 * next_step).all() and (next_step < 1.3 * step).all()
