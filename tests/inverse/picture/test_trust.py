"""Whether a capture is believed to be A x and noise: cameras that differ from the one assumed,
brightnesses and units, and the pieces that decide.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from plenocli import api
from plenocli.base.progress import collected_notes
from plenocli.base.tiling import to_blocks
from plenocli.files.read.scenes import embedded_photograph
from plenocli.files.read.training import read_training
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.picture.estimate import estimate
from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels
from plenocli.inverse.picture.methods.registry import METHODS
from plenocli.inverse.picture.solvers.least_squares import decompose
from plenocli.inverse.picture.trust import believe
from plenocli.inverse.picture.trust.continuity import Jumps, group_factors, jumps
from plenocli.inverse.picture.trust.excess import even_light, with_excess
from plenocli.inverse.picture.trust.moved_light import (
    _deviations,
    _within,
    motions,
    moved_even_light,
    moved_light,
)
from plenocli.inverse.picture.trust.rough_scene import spoilt_by_matrix
from plenocli.inverse.sparse.dictionary import Dictionary, Learner, Settings
from tests.reference.scenes import scenes

SHAPE, COUNT = (20, 20), 5
HALF = (("[40, 40]", "[20, 20]"), ("[52, 52]", "[26, 26]"), ('"2 um"', '"4 um"'))


@cache
def matrix(*changes, model="fresnel"):
    """(pixel, point) of the half-sized seed camera with texts of its description replaced."""
    text = api.sample("seed_spatial.toml").read_text()
    for old, new in (*HALF, *changes):
        assert old in text
        text = text.replace(old, new)
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        (path := Path(folder) / "camera.toml").write_text(text)
        camera = api.read_camera(path)
    found = api.system_matrix(
        camera, superpixels=(1, 1), coherent_ring=0, accuracy=1e-5, model=model
    )
    return np.asarray(found.A, float)[0, 0]


@cache
def pictures():
    return read_training((), SHAPE, not_scene="astronaut")


def estimators(**options):
    system = LensletMatrix(
        path=Path("pif.h5"),
        blocks=matrix()[None],
        offsets=np.zeros((1, 2), int),
        pixel_shape=(26, 26),
        object_shape=SHAPE,
    )
    return Estimators(system, Options(**options), lambda scene: pictures(), threads=1)


@cache
def scene():
    """(lenslet_row, lenslet_column, point) of a photograph that training leaves out."""
    from skimage.color import rgb2gray
    from skimage.transform import resize

    grey = rgb2gray(np.asarray(embedded_photograph("astronaut"), float))
    return to_blocks(resize(grey, (COUNT * 20, COUNT * 20), anti_aliasing=True), SHAPE)


def captured(a, snr_db=60, seed=0):
    y = scene() @ a.T
    sigma = np.sqrt(np.mean(y**2)) * 10 ** (-snr_db / 20)
    noise = sigma * np.random.default_rng(seed).standard_normal(y.shape)
    return Superpixels(y=y + noise, noise=Noise.of_sigma(sigma))


def made(method, data, assumed=None, **options):
    with collected_notes():
        found, _ = estimate(assumed or estimators(**options), METHODS[method], data)
    return found


def psnr(found):
    return -10 * np.log10(np.mean((found.value - scene()) ** 2))


DISTURBED = {
    "focus": (('distance = "550 mm"', 'distance = "556 mm"'),),
    "wavelength": (("550 nm", "560 nm"),),
    "sensor": (('distance = "832 um"', 'distance = "836.16 um"'),),
    "lenslets": (('focal_length = "832 um"', 'focal_length = "836.16 um"'),),
    "pitch": (('"104 um"', '"104.104 um"'), ('"4 um"', '"4.004 um"')),
}


@pytest.mark.parametrize("snr_db", [60, 40])
@pytest.mark.parametrize("name", DISTURBED)
def test_a_wrong_matrix_is_never_worse_than_the_mean_of_each_lenslet(name, snr_db):
    data = captured(matrix(*DISTURBED[name]), snr_db)
    shared, floor = estimators(), psnr(made("block-mean", data))
    for method in ("lmmse", "tikhonov", "tsvd", "tv"):
        assert psnr(made(method, data, shared)) > floor - 0.2, method


def test_a_shift_is_never_worse_than_the_mean_of_each_lenslet():
    spectrum = np.fft.fft(matrix().reshape(26, 26, -1), axis=0)
    turn = np.exp(-2j * np.pi * np.fft.fftfreq(26) * 0.1)[:, None, None]
    data = captured(np.fft.ifft(spectrum * turn, axis=0).real.reshape(matrix().shape))
    shared, floor = estimators(), psnr(made("block-mean", data))
    for method in ("lmmse", "tikhonov", "tsvd", "tv", "pnp"):
        assert psnr(made(method, data, shared)) > floor - 0.2, method


@pytest.mark.parametrize("snr_db", [40, 20])
def test_amplified_noise_is_not_given_by_the_right_matrix_either(snr_db):
    """Non-negative least squares of a photograph is further from it than no detail is."""
    data = captured(matrix(), snr_db)
    assert psnr(made("nnls", data)) > psnr(made("block-mean", data))


def test_stars_that_least_squares_finds_are_kept():
    """Few points on black are told by their sign, though no photograph is like that."""
    rng = np.random.default_rng(5)
    x = np.where(rng.random((3, 3, 400)) < 0.01, rng.random((3, 3, 400)), 0)
    y = x @ matrix().T
    sigma = np.sqrt(np.mean(y**2)) / 1000
    noise = sigma * rng.standard_normal(y.shape)
    found = made("nnls", Superpixels(y=y + noise, noise=Noise.of_sigma(sigma)))
    assert np.mean((found.value - x) ** 2) < 0.01 * np.mean(x**2)


@pytest.mark.parametrize("snr_db", [60, 40, 20])
def test_the_right_matrix_is_believed(snr_db):
    found = made("lmmse", captured(matrix(), snr_db))
    told = found.as_json()
    assert told["matrix_believed"] and told["noise_raised"] == 1 and told["detail_kept"] == 1
    assert told["continuity"] > 0.6
    assert found.noise.sigma == pytest.approx(captured(matrix(), snr_db).sigma, rel=1e-12)


ROUGH = (
    "chessboard, squares of 4",
    "chessboard, squares of 7",
    "chessboard, squares of 10",
    "turned chessboard",
    "stripes of 1 lenslets",
    "saw of a lenslet",
    "letters",
    "Siemens star",
    "black and white noise",
    "half black within lenslets",
)


@pytest.mark.parametrize("snr_db", [60, 30])
def test_scenes_that_are_no_photographs_are_believed_by_the_right_matrix(snr_db):
    """They jump at the borders of lenslets as photographs do by a wrong matrix."""
    shared = estimators()
    for name in ROUGH:
        x = to_blocks(scenes(20, COUNT)[name], SHAPE)
        y = x @ matrix().T
        sigma = np.sqrt(np.mean(y**2)) * 10 ** (-snr_db / 20)
        y = y + sigma * np.random.default_rng(11).standard_normal(y.shape)
        data = Superpixels(y=y, noise=Noise.of_sigma(sigma))

        def error(found, x=x):
            return 10 * np.log10(np.mean((found.value - x) ** 2))

        believed = METHODS["lmmse"].reconstruct(shared, data)
        assert error(made("lmmse", data, shared)) < error(believed) + 0.1, name


def test_motions_are_derivatives_of_the_light_field():
    """Of a spot whose place in the superpixel goes with the point, in closed form."""
    rows, columns = np.mgrid[:26, :26] - 12.5
    p, q = (axis.ravel() for axis in np.mgrid[:20, :20] - 9.5)
    down, right = rows.ravel()[:, None] - 0.4 * p, columns.ravel()[:, None] - 0.3 * q
    spots = np.exp(-(down**2 + right**2) / (2 * 4**2))
    system = replace(estimators().system, blocks=spots[None])
    x = np.zeros((400, 1))
    away = np.hypot(p - 3, q + 2)
    x[away < 6, 0] = np.cos(np.pi * away[away < 6] / 12) ** 4
    along, across = -down / 16 * spots, -right / 16 * spots  # by the pixel's place
    g, h = rows.ravel()[:, None], columns.ravel()[:, None]
    lower, righter = 0.4 * along, 0.3 * across  # by the point's, turned over
    wanted = (
        along,
        across,
        g * along + h * across,
        g * across - h * along,
        g * lower + h * righter,
        g * lower - h * righter,
        g * righter + h * lower,
        along * p + across * q,
        (3 * g**2 + h**2) * lower + 2 * g * h * righter,
        2 * g * h * lower + (g**2 + 3 * h**2) * righter,
    )
    for found, exact in zip(motions(system, x), wanted, strict=True):
        exact = exact @ x
        assert np.linalg.norm(found - exact) < 0.1 * np.linalg.norm(exact)


@pytest.mark.parametrize("snr_db", [pytest.param(60, marks=pytest.mark.slow), 30])
def test_noise_moves_nothing_whatever_the_scene_and_wherever_it_is_larger(snr_db):
    shared, rng, found = estimators(), np.random.default_rng(snr_db), []
    for picture in scenes(20, COUNT).values():
        y = to_blocks(picture, SHAPE).reshape(COUNT**2, -1) @ matrix().T
        sigma = np.sqrt(np.mean(y**2)) * 10 ** (-snr_db / 20)
        uneven = np.sqrt(0.25 + y / y.mean()) if rng.random() < 0.5 else 1.0
        noise = sigma * uneven * rng.standard_normal(y.shape)
        lmmse = shared.prior.lmmse(sigma, None)
        found.append(moved_light(shared.system, shared.svd, lmmse, (y + noise).T, sigma))
    assert max(found) < 3 and np.mean(np.square(found)) < 2


@pytest.mark.parametrize("name, snr_db", [("shift", 25), ("focus", 30), ("pitch", 30)])
def test_moved_light_is_found_far_below_the_noise(name, snr_db):
    """Where the sum of squares has nothing to say."""
    spectrum = np.fft.fft(matrix().reshape(26, 26, -1), axis=0)
    turn = np.exp(-2j * np.pi * np.fft.fftfreq(26) * 0.1)[:, None, None]
    off = np.fft.ifft(spectrum * turn, axis=0).real.reshape(matrix().shape)
    true = off if name == "shift" else matrix(*DISTURBED[name])
    data, shared = captured(true, snr_db), estimators()
    y = data.y.reshape(COUNT**2, -1).T
    lmmse = shared.prior.lmmse(data.sigma, None)
    assert moved_light(shared.system, shared.svd, lmmse, y, data.sigma) > 3
    assert psnr(made("lmmse", data, shared)) > psnr(made("block-mean", data)) - 0.2


def test_what_moves_within_the_reach_of_the_matrix_is_told_from_unusual_scenes():
    """Circular lenslets whose focus is 0.2 % off show nothing outside the reach at 40 dB."""
    circles = ('aperture_shape = "square"', 'aperture_shape = "circle"')
    own = matrix(circles)
    system = replace(estimators().system, blocks=own[None])
    shared = Estimators(system, Options(), lambda scene: pictures(), threads=1)

    def found(a, x, seed):
        y = x.reshape(-1, 400) @ a.T
        sigma = np.sqrt(np.mean(y**2)) / 100
        y = y + sigma * np.random.default_rng(seed).standard_normal(y.shape)
        return _deviations(*_within(system, shared.prior.lmmse(sigma, None), y.T))

    off = matrix(circles, ('distance = "550 mm"', 'distance = "551.1 mm"'))
    assert found(off, scene(), 1) > 4 > 2.5 > found(own, scene(), 1)
    others = ("stars", "five stars", "saw of a lenslet", "stripes of 0.5 lenslets", "gradient")
    for name in (*others, "chessboard, squares of 10", "half black within lenslets"):
        assert found(own, to_blocks(scenes(20, COUNT)[name], SHAPE), 2) < 2.5, name


@pytest.mark.parametrize("snr_db", [20, 30])
def test_a_small_shift_hidden_in_noise_costs_half_a_decibel_at_most(snr_db):
    """Nothing outside the range tells a shift of 0.05 px at 20 dB: even light that moved does."""
    spectrum = np.fft.fft2(matrix().reshape(26, 26, -1), axes=(0, 1))
    f = np.fft.fftfreq(26)
    turn = np.exp(-2j * np.pi * 0.05 * (f[:, None] - f))[:, :, None]
    off = np.fft.ifft2(spectrum * turn, axes=(0, 1)).real.reshape(matrix().shape)
    shared, smooth = estimators(), np.linspace(0.2, 0.8, 20 * COUNT)
    picture = np.sqrt(np.outer(smooth, 1 + 0.3 * np.sin(7 * smooth)))
    for blocks in (scene(), to_blocks(picture, SHAPE)):
        error, found = [], []
        for y in (blocks @ off.T, blocks @ matrix().T):
            sigma = np.sqrt(np.mean(y**2)) * 10 ** (-snr_db / 20)
            y = y + sigma * np.random.default_rng(3).standard_normal(y.shape)
            data = Superpixels(y=y, noise=Noise.of_sigma(sigma))
            lmmse, flat = shared.prior.lmmse(sigma, None), y.reshape(COUNT**2, -1).T
            found.append(moved_even_light(shared.system, lmmse, flat)[1])
            error.append(np.mean((made("lmmse", data, shared).value - blocks) ** 2))
        assert found[0] > 6 and found[1] < 3
        assert error[0] < 10**0.05 * error[1]


def test_a_scene_in_step_with_the_lenslets_is_no_light_that_moved():
    shared = estimators()
    for name in ("stripes of 0.5 lenslets", "stripes of 1 lenslets", "sine of a lenslet"):
        y = to_blocks(scenes(20, COUNT)[name], SHAPE).reshape(COUNT**2, -1) @ matrix().T
        sigma = np.sqrt(np.mean(y**2)) / 10
        y = y + sigma * np.random.default_rng(2).standard_normal(y.shape)
        pattern, found = moved_even_light(shared.system, shared.prior.lmmse(sigma, None), y.T)
        assert found == 0 and not pattern.any(), name


def test_what_a_matrix_spoils_is_told_from_what_a_scene_shows():
    """A pattern as bright as its lenslet and negative light are the matrix's; the same pattern in
    every lenslet may be the scene's.
    """
    rng, shared = np.random.default_rng(13), estimators()
    lmmse = shared.prior.lmmse(1e-4, None)
    bright = rng.uniform(0.05, 0.5, COUNT**2)
    wave = 0.9 * np.sin(2 * np.pi * np.arange(400) / 20)
    own = rng.permuted(np.tile(np.repeat([-0.9, 0.9], 200), (COUNT**2, 1)), axis=1)

    def spoilt(x):
        return spoilt_by_matrix(lmmse, matrix() @ x.T)

    assert spoilt(bright[:, None] * (1 + wave))
    assert not spoilt(0.25 * np.ones((COUNT**2, 1)) * (1 + wave))
    assert not spoilt(bright[:, None] * (1 + own))
    assert spoilt(0.25 * (1 + 6 * np.where(rng.random((COUNT**2, 1)) < 0.5, -1, 1) * wave))


def test_light_that_goes_with_brightness_is_taken_out_and_costs_no_detail():
    """A pitch off by a thousandth at 40 dB: hidden in the noise, but not in its sum."""
    data, shared = captured(matrix(*DISTURBED["pitch"]), 40), estimators()
    found = made("lmmse", data, shared)
    told = found.as_json()
    assert not told["matrix_believed"] and told["noise_raised"] < 1.1
    assert psnr(found) > psnr(METHODS["lmmse"].reconstruct(shared, data)) + 0.3


def test_the_noise_of_a_wrong_matrix_says_how_wrong_it_is():
    """Between the error in all pixels, spread evenly, and what falls upon single coordinates."""
    told = made("lmmse", captured(matrix(*DISTURBED["pitch"]))).as_json()
    assert not told["matrix_believed"] and told["noise_raised"] > 2
    assert told["excess"] > told["noise_sigma"]


def test_a_pitch_that_is_off_breaks_the_picture_by_even_light_that_it_displaces(monkeypatch):
    """Without that the picture goes on across borders, and the rest of the error is told by what
    the matrix cannot produce alone; a wrong focus breaks it all the same.
    """
    pitch = captured(matrix(*DISTURBED["pitch"]))
    assert made("lmmse", pitch).as_json()["continuity"] > 0.9
    assert made("lmmse", captured(matrix(*DISTURBED["focus"]))).as_json()["continuity"] < 0.1
    monkeypatch.setattr(believe, "moved_even_light", lambda *_: (None, 0.0))
    assert made("lmmse", pitch).as_json()["continuity"] < 0.6


CIRCULAR = ('aperture_shape = "square"', 'aperture_shape = "circle"')
FAST = ("f_number = 8", "f_number = 4.4")


def coma(waves):
    """Change of a camera's description."""
    terms = "".join(
        f'[[main_lens.aberrations]]\nnoll = {noll}\ncoefficient = "{550 * waves} nm"\n'
        for noll in (7, 8)
    )
    return "[object]", f"{terms}\n[object]"


def estimators_of(a):
    system = replace(estimators().system, blocks=a[None])
    return Estimators(system, Options(), lambda scene: pictures(), threads=1)


@pytest.mark.parametrize("snr_db, seed", [(20, 0), (20, 1), (30, 3)])
def test_an_error_of_a_fast_camera_is_no_veil(snr_db, seed):
    """Even light is known to 5 % of the mean at 20 dB there, and found to be half of it."""
    data = captured(matrix(FAST, coma(0.07)), snr_db, seed)
    shared = estimators_of(matrix(FAST))
    floor = psnr(made("block-mean", data, shared))
    assert psnr(made("lmmse", data, shared)) > floor - 0.1


def test_what_displaces_even_light_is_not_put_down_to_a_scene_that_jumps(monkeypatch):
    data, shared = captured(matrix(CIRCULAR, coma(0.07)), 40), estimators_of(matrix(CIRCULAR))
    monkeypatch.setattr(believe, "_scene_jumps", lambda *_: True)
    told = made("lmmse", data, shared).as_json()
    assert told["continuity"] < 0.5 and not told["matrix_believed"]


@cache
def dictionary():
    """Patches of the training pictures, as learn-dict starts from them."""
    images = [picture for _, picture in pictures()]
    settings = Settings(atoms=400, batch=400, lam=1e-4, delta=1e-3, snr_db=60)
    learner = Learner(decompose(matrix()), SHAPE, images, images, settings, workers=1)
    atoms = learner.start().atoms
    return Dictionary(
        atoms=atoms,
        synthesis=atoms,
        lam=settings.lam,
        sigma=learner.sigma,
        directions=len(learner.seen),
        training=(),
    )


@pytest.mark.slow
def test_what_the_model_is_off_by_is_noise_to_weighted_pixels():
    """Of a capture by the exact model, by the paraxial matrix and what its record says."""
    data, shared = captured(matrix(model="exact")), estimators()
    with collected_notes():
        bare, told = (
            estimate(shared, METHODS["weighted"], data, model_error=off)[0] for off in (0.0, 0.028)
        )
    inside = [np.mean(np.abs(f.value - scene()) < 1.96 * f.sigma) for f in (bare, told)]
    assert psnr(told) > psnr(bare) + 1
    assert inside[1] > inside[0] + 0.05


@pytest.mark.parametrize("method", [name for name in METHODS if name != "auto"])
def test_units_and_brightness_change_nothing_but_units(method):
    """By powers of two to the bit; else to what the method makes of the rounding of the data."""
    data, shared = captured(matrix(), 20 if method == "weighted" else 60), estimators()
    shared.read_dictionary = dictionary
    one = made(method, data, shared)
    for factor in (1e-30, 1e-4, 1.7e30, 2.0**-100):
        scaled = replace(data, y=data.y * factor, noise=data.noise.scaled(factor))
        other = made(method, scaled, shared)
        bound = 0 if np.log2(factor) % 1 == 0 else 1e-11
        assert np.abs(other.value / factor - one.value).max() <= bound, factor
        assert other.method == one.method
        if one.sigma is not None:
            assert np.abs(other.sigma / factor / one.sigma - 1).max() <= 10 * bound, factor


def test_given_weights_are_in_the_unit_of_the_capture():
    data = captured(matrix())
    sigma = data.sigma
    one = made("lmmse", replace(data, noise=None), noise_sigma=sigma)
    other = made("lmmse", data)
    np.testing.assert_allclose(one.value, other.value, atol=1e-9)
    assert one.noise.sigma == pytest.approx(sigma, rel=1e-12)


def test_the_least_jumps_by_brute_force():
    rng = np.random.default_rng(3)
    x = rng.random((3, 4, 2 * 6))  # two bands of 2x3 points
    mean = x.mean(axis=2, keepdims=True) + 0 * x
    found = Jumps(level=jumps(mean, (2, 3)), detail=jumps(x - mean, (2, 3))[:, None])
    assert found.level.size == 2 * (3 * 3 * 2 + 2 * 4 * 3)
    picture = x.reshape(3, 4, 2, 2, 3)

    def energy(factor):
        total, p = (
            0.0,
            mean.reshape(picture.shape) + factor * (picture - mean.reshape(picture.shape)),
        )
        for r in range(3):
            for c in range(4):
                total += ((p[r, c, :, :, -1] - p[r, c + 1, :, :, 0]) ** 2).sum() if c < 3 else 0
                total += ((p[r, c, :, -1] - p[r + 1, c, :, 0]) ** 2).sum() if r < 2 else 0
        return total

    assert found.factor == pytest.approx(minimize_scalar(energy).x, abs=1e-6)


def test_detail_with_independent_error_is_shrunk_as_wiener_would():
    """A smooth scene, whose adjacent points are equal; error as strong as the detail."""
    rng = np.random.default_rng(4)
    n, count = 24, 40
    axis = np.arange(n * count) / (n * count)
    plane = sum(
        np.cos(2 * np.pi * (a * axis[:, None] + b * axis[None, :]) + c)
        for a, b, c in zip(rng.uniform(10, 30, 9), rng.uniform(10, 30, 9), rng.uniform(0, 6, 9))
    )
    x = to_blocks(plane, (n, n))
    mean = x.mean(axis=2, keepdims=True) + 0 * x
    detail = jumps(x - mean, (n, n))
    error = rng.standard_normal(x.shape) * np.sqrt(np.mean(detail**2) / 2)
    level = jumps(mean, (n, n))
    for share in (0.0, 0.5, 1.0, 2.0):
        noisy = detail + share * jumps(error, (n, n))
        found = Jumps(level=level, detail=noisy[:, None])
        assert found.factor == pytest.approx(1 / (1 + share**2), abs=0.08)
    wrong = Jumps(level=level, detail=np.stack([detail, 2 * jumps(error, (n, n))], axis=1))
    right = Jumps(level=level, detail=np.stack([detail, detail], axis=1) / 2)
    factors = group_factors(wrong, right)
    assert factors[1] < 0.3 < factors[0]


def test_excess_is_found_where_it_is():
    rng, shared = np.random.default_rng(5), estimators()
    data = captured(matrix())
    lmmse = shared.prior.lmmse(data.sigma, None)
    stacked = data.y.reshape(COUNT**2, -1).T
    quiet = with_excess(lmmse, stacked, data.sigma**2)
    assert np.mean(quiet == data.sigma**2) > 0.9
    weak = np.argsort(-lmmse.power)[100:130]
    added = 100 * data.sigma
    spoilt = stacked + lmmse.analysis[weak].T @ (added * rng.standard_normal((30, COUNT**2)))
    noise = with_excess(lmmse, spoilt, data.sigma**2)
    assert np.all(noise[weak[6:-6]] > 0.2 * added**2)
    assert np.all(noise[weak[6:-6]] < 5 * added**2)
    far = np.setdiff1d(np.argsort(-lmmse.power), np.argsort(-lmmse.power)[90:140])
    assert np.mean(noise[far] == data.sigma**2) > 0.9


def test_what_even_light_makes_beside_the_matrix_is_found():
    """A pattern in proportion to each lenslet's brightness, against the photographs' own detail."""
    rng, shared = np.random.default_rng(8), estimators()
    data = captured(matrix())
    lmmse = shared.prior.lmmse(data.sigma, None)
    stacked = data.y.reshape(COUNT**2, -1).T
    weak = np.argsort(-lmmse.power)[60:160]
    added = lmmse.analysis[weak].T @ (30 * data.sigma * rng.standard_normal(100))
    bright = lmmse.brightness(stacked)
    found = even_light(lmmse, stacked + np.outer(added, bright))
    clear = even_light(lmmse, stacked)
    assert np.linalg.norm(found - clear - added) < 0.1 * np.linalg.norm(added)
    kept = lmmse.analysis[weak] @ clear
    assert np.linalg.norm(kept) < 0.1 * np.linalg.norm(added)


def test_looking_through_whitened_rows_is_lmmse_with_that_noise():
    """The same estimate by another way: a matrix whose noise is white again."""
    data, shared = captured(matrix()), estimators()
    lmmse = shared.prior.lmmse(data.sigma, None)
    rng = np.random.default_rng(6)
    raised = replace(lmmse, noise=lmmse.noise * 10 ** rng.uniform(0, 4, lmmse.noise.shape))
    rows = raised.whitening()
    y = data.y.reshape(COUNT**2, -1).T
    other = shared.seen_through(rows).prior.lmmse(data.sigma, None)
    for scale in (0.1, 1.0, 3.0):
        one, two = raised.apply(y, scale), other.apply(rows @ y, scale)
        # coordinates below a hundredth of the noise are left out once more
        assert np.abs(one - two).max() < 2e-3 * np.abs(one).max()


def test_light_of_neighbours_that_the_matrix_knows_is_no_veil():
    """Taken away by block means only, it looked like an even light of 5 %, which cost 8 dB."""
    text = api.sample("demo_spatial.toml").read_text()
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        (path := Path(folder) / "camera.toml").write_text(text)
        camera = api.read_camera(path)
    near = {"superpixels": (3, 3), "coherent_ring": 1, "accuracy": 1e-3, "model": "fresnel"}
    wide = api.system_matrix(camera, **near)
    capture = api.simulate_capture(camera, "skimage:astronaut", matrix=wide, snr_db=60)
    with collected_notes() as notes:
        found = api.reconstruct(capture, wide, method="lmmse")
        mean = api.reconstruct(capture, wide, method="block-mean")
    assert not notes and found.as_json()["matrix_believed"]
    truth = np.asarray(capture.scene).reshape(found.value.shape)

    def psnr(picture):
        return -10 * np.log10(np.mean((picture.value - truth) ** 2))

    assert psnr(found) > psnr(mean) + 7
