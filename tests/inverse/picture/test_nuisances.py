"""What is taken out of a capture before any method, against dense normal distributions that know
nothing of the factored ones.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from plenocli.base.progress import collected_notes
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels
from plenocli.inverse.picture.methods.registry import METHODS
from plenocli.inverse.picture.nuisances.clean import clean
from plenocli.inverse.picture.nuisances.defects import find_defects
from plenocli.inverse.picture.nuisances.pixel_model import PixelModel
from plenocli.inverse.picture.nuisances.saturation import censored, piled_up
from plenocli.inverse.picture.nuisances.veil import find_veil
from plenocli.inverse.picture.nuisances.vignetting import falloff
from plenocli.inverse.picture.solvers.least_squares import decompose
from plenocli.inverse.picture.solvers.lmmse import SCALES, prepare

N, PIXELS, SIGMA = 5, 9, 2e-4
EVEN = np.ones(N * N)


def blurred(shift=0.0, fade=4.0):
    """A matrix (pixel, point) with spots of light that overlap and fade towards the corners."""
    at = (np.arange(PIXELS) + 0.5) * N / PIXELS + shift
    row = np.exp(-((at[:, None] - 0.5 - np.arange(N)) ** 2) / 2)
    fades = np.exp(-(((np.arange(PIXELS) - 4) / fade) ** 2))
    matrix = np.kron(fades[:, None] * row, fades[:, None] * row)
    return matrix / matrix.sum(axis=0).max()


def statistics():
    """(mean, covariance) of fields that are alike nearby."""
    at = np.stack(np.meshgrid(np.arange(N), np.arange(N), indexing="ij"), -1).reshape(-1, 2)
    far = np.linalg.norm(at[:, None] - at[None], axis=2)
    return 0.05 * np.sin(at.sum(axis=1) / 3), 0.03 * np.exp(-far / 3)


def drawn(count, rng, matrix=None, scale=1.0):
    """(true fields (point, signal), no darker than light can be; superpixels without noise (pixel,
    signal)).
    """
    mean, covariance = statistics()
    field = np.sqrt(scale) * np.linalg.cholesky(covariance) @ rng.standard_normal((N * N, count))
    x = np.maximum(mean[:, None] + field + rng.uniform(0.2, 0.9, count), 0.0)
    return x, (blurred() if matrix is None else matrix) @ x


def model_and_lmmse(veiled=True, sigma=SIGMA):
    mean, covariance = statistics()
    lmmse = prepare(decompose(blurred()), mean, covariance, sigma)
    return PixelModel.of(lmmse, sigma, veiled=veiled), lmmse


def dense(scale, *, veil=0.0, sigma=SIGMA, free=1e4):
    """(mean, covariance) of the pixels; the variance `free` stands for any brightness."""
    mean, covariance = statistics()
    signal = scale * covariance + free * np.outer(EVEN, EVEN)
    matrix = blurred()
    whole = matrix @ signal @ matrix.T + sigma**2 * np.eye(len(matrix))
    return matrix @ mean, whole + veil * np.ones_like(whole)


def told_by_others(mean, covariance, y, lost):
    """(conditional mean, standard deviation) of the lost pixels."""
    kept = ~lost
    weight = np.linalg.solve(covariance[np.ix_(kept, kept)], covariance[np.ix_(kept, lost)]).T
    rest = covariance[np.ix_(lost, lost)] - weight @ covariance[np.ix_(kept, lost)]
    return mean[lost] + weight @ (y[kept] - mean[kept]), np.sqrt(np.diag(rest))


@pytest.mark.parametrize("veiled", [False, True])
@pytest.mark.parametrize("share", [0.05, 0.6])
def test_lost_pixels_are_what_a_dense_normal_distribution_says(veiled, share):
    rng = np.random.default_rng(3)
    model, _ = model_and_lmmse(veiled)
    _, y = drawn(4, rng)
    y = y + SIGMA * rng.standard_normal(y.shape) + (0.01 if veiled else 0.0)
    lost = rng.random(y.shape) < share
    found = model.impute(y, lost)
    sigma = model.uncertainty(found, lost)
    for k, scale in enumerate(SCALES[model.rest(found).scale]):
        mean, covariance = dense(scale, veil=1e4 * veiled)
        expected, spread = told_by_others(mean, covariance, y[:, k], lost[:, k])
        assert np.abs(found[lost[:, k], k] - expected).max() < 0.03 * spread.min()
        assert sigma[lost[:, k], k] == pytest.approx(spread, rel=0.02)
    assert np.array_equal(found[~lost], y[~lost]) and not sigma[~lost].any()


def test_lmmse_of_imputed_pixels_is_lmmse_without_them():
    rng = np.random.default_rng(5)
    model, lmmse = model_and_lmmse(veiled=False)
    _, y = drawn(1, rng)
    y = y + SIGMA * rng.standard_normal(y.shape)
    lost = rng.random(len(y)) < 0.2
    imputed = model.impute(y, lost[:, None])
    scale = SCALES[model.rest(imputed).scale[0]]
    mean, covariance = statistics()
    matrix, kept = blurred()[~lost], y[~lost, 0]
    signal = scale * covariance + 1e4 * np.outer(EVEN, EVEN)
    whole = matrix @ signal @ matrix.T + SIGMA**2 * np.eye(len(matrix))
    expected = mean + signal @ matrix.T @ np.linalg.solve(whole, kept - matrix @ mean)
    assert lmmse.apply(imputed, scale)[:, 0] == pytest.approx(expected, abs=2e-4)


def test_an_even_light_is_what_generalised_least_squares_says():
    rng = np.random.default_rng(7)
    model, _ = model_and_lmmse()
    _, y = drawn(5, rng)
    y = y + SIGMA * rng.standard_normal(y.shape) + 0.003
    rest = model.rest(y)
    even = np.ones(len(y))
    for k, scale in enumerate(SCALES[rest.scale]):
        mean, covariance = dense(scale)
        weight = np.linalg.solve(covariance, even)
        assert rest.offset[k] == pytest.approx(
            weight @ (y[:, k] - mean) / weight.sum(), abs=0.02 / np.sqrt(weight.sum())
        )
        assert rest.offset_variance[k] == pytest.approx(1 / weight.sum(), rel=0.02)


@pytest.mark.parametrize("light", [0.0, 0.001, 0.01])
def test_a_veil_is_found_and_none_where_there_is_none(light):
    model, _ = model_and_lmmse()
    for seed in range(10):
        rng = np.random.default_rng(seed)
        _, y = drawn(49, rng)
        found, own = find_veil(model, y + SIGMA * rng.standard_normal(y.shape) + light)
        assert found.removed == found.found == (light > 0)
        assert found.level == pytest.approx(light, abs=4.5 * found.sigma)
        assert np.abs(own - light).max() <= 5 * found.sigma + 1e-12
        assert found.as_json()["veil"]["share"] == pytest.approx(
            found.level / y.mean(), rel=0.02, abs=1e-4
        )
        assert f"{found.as_json()['veil']['share']:.2%}" in found.sentence


def test_offsets_of_their_own_are_told_apart():
    model, _ = model_and_lmmse()
    rng = np.random.default_rng(1)
    _, y = drawn(64, rng)
    light = 0.004 + 0.002 * rng.standard_normal(64)
    found, own = find_veil(model, y + SIGMA * rng.standard_normal(y.shape) + light)
    assert found.spread == pytest.approx(0.002, rel=0.3)
    assert np.std(own - light) < 0.1 * np.std(light)


def test_an_error_of_the_matrix_is_not_taken_for_a_veil():
    """Corners that are brighter than they should be: what they feign goes with the brightness."""
    model, _ = model_and_lmmse()
    for seed in range(5):
        rng = np.random.default_rng(seed)
        _, y = drawn(64, rng, blurred(fade=4.1))
        y = y + SIGMA * rng.standard_normal(y.shape)
        feigned = model.rest(y).offset
        found, own = find_veil(model, y)
        assert np.abs(np.median(feigned)) > 2 * SIGMA
        assert not found.removed and not own.any()


def test_a_veil_is_no_brighter_than_the_darkest_pixels_and_negative_only_where_pixels_are():
    """Lenslets that are all alike, so that an error of the matrix does not show by its going with
    their brightness: what it feigns is below zero, and no pixel is. A black level that is too high
    leaves pixels there, and is one.
    """
    model, _ = model_and_lmmse()
    rng = np.random.default_rng(3)
    x = 0.5 + 0.02 * rng.standard_normal((N * N, 64))
    noise = SIGMA * rng.standard_normal((PIXELS**2, 64))
    feigned, own = find_veil(model, blurred(fade=3.7) @ x + noise)
    assert feigned.level < -10 * feigned.sigma and not feigned.removed and not own.any()
    found, own = find_veil(model, blurred() @ x + noise - 0.02)
    assert found.removed and np.abs(own + 0.02).max() < 0.001
    veiled = blurred() @ x + noise + 0.02
    assert find_veil(model, veiled)[0].removed
    shadows = np.where(rng.random(veiled.shape) < 0.02, noise, veiled)
    assert not find_veil(model, shadows)[0].removed


@pytest.mark.parametrize("shift", [0.0, 0.08])
def test_defects_are_found_and_nothing_else(shift):
    """Also where the matrix is wrong by many times the noise."""
    rng = np.random.default_rng(11)
    model, _ = model_and_lmmse()
    _, y = drawn(400, rng, blurred(shift))
    y = y + SIGMA * rng.standard_normal(y.shape)
    nothing = np.zeros(y.shape, bool)
    sign, clean_y = find_defects(model, y, nothing, (PIXELS, PIXELS))
    assert np.count_nonzero(sign) <= 1e-4 * sign.size
    assert np.array_equal(clean_y[sign == 0], y[sign == 0])
    kind = rng.random(y.shape)
    dead, hot = kind < 0.005, kind > 0.9995
    disturbed = np.where(dead, 0.0, np.where(hot, 1.5 * y.max(), y))
    sign, clean_y = find_defects(model, disturbed, nothing, (PIXELS, PIXELS))
    loud = np.abs(y) > (100 if shift else 30) * SIGMA
    assert (sign[dead & loud] == -1).mean() > 0.97 and (sign[hot] == 1).all()
    assert np.count_nonzero(sign[~dead & ~hot]) <= 1e-3 * sign.size
    if not shift:
        assert np.abs(clean_y - y)[sign != 0].max() < 8 * SIGMA


def test_censored_pixels_are_the_most_likely_ones_above_the_level():
    rng = np.random.default_rng(13)
    model, _ = model_and_lmmse(veiled=False)
    _, y = drawn(1, rng, scale=3.0)
    y = (y + SIGMA * rng.standard_normal(y.shape))[:, 0]
    level = np.quantile(y, 0.6)
    clipped, lost = y > level, np.zeros(len(y), bool)
    lost[3] = True
    shown = np.where(lost, 0.0, np.minimum(y, level))
    found = censored(model, shown, clipped, lost)
    scale = SCALES[model.rest(found[:, None]).scale[0]]
    mean, covariance = dense(scale, free=10.0)
    root = np.linalg.cholesky(np.linalg.inv(covariance)).T
    free = clipped | lost
    bounds = np.where(clipped, level, -np.inf)[free]
    expected = lsq_linear(
        root[:, free],
        root @ mean - root[:, ~free] @ shown[~free],
        (bounds, np.full(len(bounds), np.inf)),
        tol=1e-14,
    ).x
    assert found[free] == pytest.approx(expected, abs=0.2 * SIGMA)
    assert np.array_equal(found[~free], shown[~free])
    assert np.abs(found - y)[clipped].max() < 0.1 * np.abs(shown - y)[clipped].max()


def test_a_pile_of_largest_values_is_a_clipped_one():
    rng = np.random.default_rng(0)
    y = rng.random(4000)
    assert piled_up(y) is None
    clipped = np.minimum(y, 0.9)
    assert piled_up(clipped) == 0.9
    whole = np.rint(100 * rng.random(4000))  # a converter's numbers repeat without any clipping
    assert piled_up(whole) is None
    assert piled_up(np.full(100, np.nan)) is None


def camera(y, **more):
    """(Estimators, capture) of superpixels y (pixel, signal), 7x7 lenslets."""
    rng = np.random.default_rng(0)
    system = LensletMatrix(
        path=Path("pif.h5"),
        blocks=blurred()[None],
        offsets=np.zeros((1, 2), int),
        pixel_shape=(PIXELS, PIXELS),
        object_shape=(N, N),
    )
    smooth = rng.standard_normal((120, 120)).cumsum(0).cumsum(1)
    smooth = (smooth - smooth.min()) / np.ptp(smooth)
    estimators = Estimators(system, Options(method="lmmse"), lambda scene: [("walk", smooth)])
    data = Superpixels(y=y.T.reshape(7, 7, -1), noise=Noise.of_sigma(SIGMA), **more)
    return estimators, data


def all_at_once(rng):
    """(true fields, undisturbed, disturbed superpixels, saturated) with a veil, dead pixels, hot
    ones and a white level.
    """
    x, y = drawn(49, rng)
    y = y + SIGMA * rng.standard_normal(y.shape)
    level = 0.8 * y.max()
    kind = rng.random(y.shape)
    spoilt = np.where(kind < 0.005, 0.0, y + 0.02 * y.mean())
    spoilt = np.where(kind > 0.999, y.max(), spoilt)
    return x, y, np.minimum(spoilt, level), spoilt >= level


@pytest.mark.parametrize("declared", [True, False])
def test_all_nuisances_at_once_cost_little(declared):
    x, y, spoilt, above = all_at_once(np.random.default_rng(2))
    saturated = above.T.reshape(7, 7, -1) if declared else None
    estimators, data = camera(spoilt, saturated=saturated)
    _, undisturbed = camera(y)
    cleaned = clean(estimators, data)
    truth = x.T.reshape(7, 7, -1)

    def error(found):
        with collected_notes():
            value = METHODS["lmmse"].reconstruct(estimators, found).value
        return np.sqrt(np.mean((value - truth) ** 2))

    assert error(cleaned.data) < 1.06 * error(undisturbed)
    assert error(data) > 2 * error(undisturbed)
    told = {}
    for finding in cleaned.findings:
        assert finding.found and finding.sentence
        told |= finding.as_json()
    assert set(told) == {"defects", "veil", "saturated"}
    assert told["defects"]["bright"] >= 1 and told["defects"]["dark"] >= 5
    assert told["veil"]["share"] == pytest.approx(0.02, rel=0.05)
    assert told["saturated"]["declared"] == declared


def test_nothing_is_done_to_a_good_capture():
    rng = np.random.default_rng(4)
    _, y = drawn(49, rng)
    estimators, data = camera(y + SIGMA * rng.standard_normal(y.shape))
    cleaned = clean(estimators, data)
    assert np.array_equal(cleaned.data.y, data.y)
    assert not any(finding.found for finding in cleaned.findings)


def test_pixels_that_are_known_to_be_bad_count_for_nothing():
    rng = np.random.default_rng(6)
    _, y = drawn(49, rng)
    y = y + SIGMA * rng.standard_normal(y.shape)
    gone = rng.random(y.shape) < 0.01
    gone[:, 5] = True
    estimators, data = camera(np.where(gone, np.nan, y))
    cleaned = clean(estimators, data)
    found = cleaned.data.y.reshape(49, -1).T
    some = gone & (np.arange(49) != 5)
    assert np.abs(found - y)[some].max() < 10 * SIGMA and not found[:, 5].any()
    assert cleaned.findings[0].known == np.count_nonzero(some)
    unlooked = clean(estimators, data, look=False)
    roughly = unlooked.data.y
    assert np.isfinite(roughly).all() and not roughly[0, 5].any()
    for findings in (cleaned.findings, unlooked.findings):
        told = json.loads(json.dumps([finding.as_json() for finding in findings]))
        assert told[0]["defects"]["known"] == np.count_nonzero(some)


def test_vignetting_is_what_the_white_has_over_even_light():
    """A quadratic of each lenslet's own and a pattern of all, from whites with noise."""
    rng = np.random.default_rng(9)
    even = blurred().sum(axis=1)
    at = np.linspace(-1, 1, PIXELS)
    rows, columns = (axis.ravel() for axis in np.meshgrid(at, at, indexing="ij"))
    tilt = rng.uniform(-0.1, 0.1, (60, 2))
    own = 1 - 0.2 * (rows**2 + columns**2) + tilt[:, :1] * rows + tilt[:, 1:] * columns
    common = 1 + 0.03 * rng.standard_normal(even.size)
    white = even * own * common * (1 + 0.002 * rng.standard_normal(own.shape))
    white[rng.random(white.shape) < 0.01] = np.nan
    found = falloff(white, even, (PIXELS, PIXELS))
    bright = even > 0.15 * even.max()
    relative = (found / (own * common))[:, bright]
    assert np.abs(relative / relative.mean(axis=1, keepdims=True) - 1).max() < 0.01
    noise = even * (1 + 0.002 * rng.standard_normal(own.shape))
    assert np.abs(falloff(noise, even, (PIXELS, PIXELS)) - 1).max() < 0.001
    assert (falloff(np.full((2, even.size), np.nan), even, (PIXELS, PIXELS)) == 1).all()


def test_a_method_that_does_not_look_says_what_is_saturated():
    _, _, spoilt, above = all_at_once(np.random.default_rng(2))
    estimators, data = camera(spoilt, saturated=above.T.reshape(7, 7, -1))
    found = clean(estimators, data, look=False)
    assert np.array_equal(found.data.y, data.y)
    assert "the picture is too dark there" in found.findings[0].sentence
    assert found.findings[0].pixels == np.count_nonzero(above)


def test_bands_that_light_does_not_tell_apart_end_in_no_error():
    """Every lenslet another even patch in each band, and a quarter of the light beside; one pixel
    is dead.
    """
    rng = np.random.default_rng(8)
    own = np.tile(blurred(-1.5), 2)
    offsets = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    far = [np.roll(own.reshape(PIXELS, PIXELS, -1), 3 * o, (0, 1)) for o in offsets]
    blocks = np.array([0.03 * part.reshape(own.shape) for part in far])
    blocks[4] = own
    system = LensletMatrix(
        path=Path("pif.h5"),
        blocks=blocks,
        offsets=offsets,
        pixel_shape=(PIXELS, PIXELS),
        object_shape=(N, N),
        bands=(5e-7, 6e-7),
    )
    smooth = rng.standard_normal((120, 120)).cumsum(0).cumsum(1)
    smooth = (smooth - smooth.min()) / np.ptp(smooth)
    estimators = Estimators(system, Options(method="lmmse"), lambda scene: [("walk", smooth)])
    x = np.repeat(rng.uniform(0.02, 0.98, (9, 9, 2)), N * N, axis=2)
    y = sum(x[1 - r : 8 - r, 1 - c : 8 - c] @ b.T for (r, c), b in zip(offsets, blocks))
    y = y + SIGMA * rng.standard_normal(y.shape)
    y[3, 3, 40] = 0.0
    cleaned = clean(estimators, Superpixels(y=y, noise=Noise.of_sigma(SIGMA)))
    told = {}
    for finding in cleaned.findings:
        told |= finding.as_json()
    assert told["defects"]["dark"] + told["defects"]["bright"] == 1
