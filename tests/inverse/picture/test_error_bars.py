"""Error bars against Monte Carlo, dense linear algebra and photographs whose truth is known."""

import numpy as np
import pytest

from plenocli.base.tiling import to_blocks
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.picture import error_bars
from plenocli.inverse.picture.estimate import estimate
from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels
from plenocli.inverse.picture.methods.registry import METHODS
from plenocli.inverse.picture.solvers import least_squares as linear
from plenocli.inverse.picture.solvers import lmmse as solver

N, SIGMA = 36, 1e-2


@pytest.fixture(scope="module")
def lens():
    """(A, LMMSE) of a lenslet whose directions fade like a camera's, for fields without mean."""
    rng = np.random.default_rng(0)
    a = rng.random((60, N)) @ np.diag(np.logspace(0, -2.5, N)) @ rng.standard_normal((N, N)) / 6
    covariance = np.exp(-np.abs(np.subtract.outer(np.arange(N), np.arange(N))) / 4) / 10
    return a, solver.prepare(linear.decompose(a), np.zeros(N), covariance, SIGMA), covariance


def drawn(lens, scale, count, seed):
    """(x, y) of `count` fields with a contrast each and any brightness."""
    a, _, covariance = lens
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(covariance)
    x = root @ rng.standard_normal((N, count)) * np.sqrt(scale) + rng.random(count)
    return x, a @ x + SIGMA * rng.standard_normal((60, count))


@pytest.mark.parametrize("distance", [0.0, 0.3, 1.0, 2.5, 9.0])
def test_about_holds_95_percent_of_a_normal_variable(distance):
    z = 0.2 * np.random.default_rng(1).standard_normal(200_000)
    radius = 1.96 * error_bars.about(np.array([-0.2 * distance]), np.array([0.2]))
    assert np.mean(np.abs(z - 0.2 * distance) < radius) == pytest.approx(0.95, abs=2e-3)


def test_a_contrast_that_is_sure_leaves_what_linear_algebra_leaves(lens):
    a, lmmse, covariance = lens
    _, y = drawn(lens, 1.0, 4, 2)
    sure = np.zeros((len(solver.SCALES), 4))
    sure[[20, 30, 40, 50], range(4)] = 1
    found = error_bars.spread(lmmse, lmmse.coordinates(y), sure)
    for k, scale in enumerate(solver.SCALES[[20, 30, 40, 50]]):
        prior = scale * covariance + 1e4  # and a brightness about which nothing is known
        gain = np.linalg.solve(a @ prior @ a.T + SIGMA**2 * np.eye(60), a @ prior).T
        left = np.sqrt(np.diag(prior - gain @ a @ prior))
        np.testing.assert_allclose(found[:, k], left, rtol=5e-3)


def test_a_doubtful_contrast_adds_what_the_estimate_moves_with_it(lens):
    _, lmmse, _ = lens
    _, y = drawn(lens, 1.0, 50, 3)
    pair = np.array([35, 36])
    even = np.zeros((len(solver.SCALES), 50))
    even[pair] = 0.5
    estimates = np.stack([lmmse.apply(y, solver.SCALES[k]) for k in pair])
    lefts = [
        error_bars.spread(lmmse, lmmse.coordinates(y), np.eye(len(even))[:, [k] * 50]) ** 2
        for k in pair
    ]
    expected = np.mean(lefts, axis=0) + estimates.var(axis=0)
    np.testing.assert_allclose(
        error_bars.spread(lmmse, lmmse.coordinates(y), even) ** 2, expected, rtol=2e-3
    )


def test_fields_of_the_prior_are_held_by_their_intervals(lens):
    """Monte Carlo with a contrast of its own for every field; that of the mean alone is not
    enough where noise is strong.
    """
    _, lmmse, _ = lens
    scale = np.exp(np.random.default_rng(4).standard_normal(1500))
    x, y = drawn(lens, scale, 1500, 5)
    contrast = lmmse.contrast(lmmse.coordinates(y))
    z = (lmmse.apply(y, np.exp(np.log(solver.SCALES) @ contrast)) - x) / error_bars.spread(
        lmmse, lmmse.coordinates(y), contrast
    )
    assert np.mean(np.abs(z) < 1.96) == pytest.approx(0.95, abs=0.01)
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("power", [1 / 3, 1.0, 4.0])
def test_weak_directions_tell_their_power(lens, power):
    _, lmmse, _ = lens
    expected, rng = lmmse.power / SIGMA**2, np.random.default_rng(6)
    factor = np.where(expected <= error_bars.HARDLY, power, 1.0)
    w = SIGMA * np.sqrt(1 + factor * expected)[:, None] * rng.standard_normal((len(expected), 900))
    y = np.linalg.pinv(lmmse.analysis) @ (w + lmmse.offset[:, None])
    np.testing.assert_allclose(lmmse.coordinates(y), w, atol=1e-8)
    found = error_bars.weak_power(lmmse, lmmse.coordinates(y), np.ones(900))
    assert found == pytest.approx(np.log(power), abs=0.2)


def test_borders_disagree_by_the_steps_across_them():
    blocks = np.zeros((2, 3, 12))
    blocks[:, 1] = 0.3
    sigma = np.full(blocks.shape, 0.1)
    # of 2x3 blocks of 4x3 points, 32 pairs lie across columns and 9 across rows
    assert error_bars.disagreement(blocks, sigma, (4, 3)) == pytest.approx(np.log(9), abs=1e-3)
    alone = error_bars.disagreement(blocks[:1, :1], sigma[:1, :1], (4, 3))
    assert alone == error_bars.USUAL_BORDER


def test_degrees_of_freedom_are_the_trace_of_the_influence(lens):
    """Against the dense matrix, and the divergence of the estimate by random probes."""
    a, lmmse, covariance = lens
    _, y = drawn(lens, 0.7, 30, 7)
    scale, rng = lmmse.scales(y), np.random.default_rng(8)
    traces = [
        np.trace(
            np.linalg.solve(
                a @ (k * covariance + 1e4) @ a.T + SIGMA**2 * np.eye(60),
                a @ (k * covariance + 1e4) @ a.T,
            )
        )
        for k in scale
    ]
    assert lmmse.degrees(y) == pytest.approx(np.mean(traces), abs=0.05)
    probes = rng.choice([-1.0, 1.0], (200, 60))
    moved = [
        p @ a @ (lmmse.apply(y + 1e-3 * p[:, None], scale) - lmmse.apply(y, scale)) / 1e-3
        for p in probes
    ]
    assert lmmse.degrees(y) == pytest.approx(np.mean(moved), rel=0.05)


@pytest.fixture(scope="module")
def photographed():
    """(matrix of a lenslet, photograph as blocks, training pictures): 12x12 points that a smooth
    kernel mixes and turns over.
    """
    from plenocli.files.read.scenes import embedded_photograph
    from plenocli.files.read.training import read_training
    from plenocli.forward.scene.sample import luminance, sample_picture

    points, pixels = np.arange(12) / 11, np.arange(16) / 15
    kernel = np.exp(-(((pixels[:, None] - points[::-1]) / 0.13) ** 2))
    kernel += 0.2 * np.exp(-(((pixels[:, None] - points[::-1] - 0.2) / 0.05) ** 2))
    kernel /= kernel.sum(axis=0)
    picture = np.asarray(sample_picture(luminance(embedded_photograph("astronaut")), 216, 216))
    truth = to_blocks(picture[36:132, 60:156].astype(float), (12, 12))
    training = read_training(("skimage:camera", "skimage:coffee", "skimage:chelsea"), (12, 12))
    return np.kron(kernel, kernel), truth, training


@pytest.mark.parametrize("snr_db", [50, 30])
def test_a_photograph_lies_in_the_intervals_of_every_method(photographed, snr_db):
    own, truth, training = photographed
    rng = np.random.default_rng(snr_db)
    y = truth @ own.T
    sigma = float(np.sqrt(np.mean(y**2)) * 10 ** (-snr_db / 20))
    data = Superpixels(
        y=y + sigma * rng.standard_normal(y.shape), noise=Noise.of_sigma(sigma), scene="astronaut"
    )
    system = LensletMatrix(
        path="lens",
        blocks=own[None],
        offsets=np.zeros((1, 2), int),
        pixel_shape=(16, 16),
        object_shape=(12, 12),
    )
    first = Estimators(system, Options(), lambda scene: training)
    for name, overlap in (("lmmse", 1), ("lmmse", 3), ("pnp", 1), ("tv", 1), ("tsvd", 1)) + (
        ("tikhonov", 1),
        ("nnls", 1),
    ):
        steps = 200 if name == "nnls" else None
        one = Estimators(
            system,
            Options(method=name, overlap=overlap, nnls_iterations=steps),
            lambda scene: training,
        )
        one.svd, one.prior = first.svd, first.prior
        found = METHODS[name].reconstruct(one, data)
        held = np.mean(np.abs(found.value - truth) < 1.96 * found.sigma)
        assert 0.90 < held < 0.99, (name, overlap, held)


def test_a_picture_drawn_back_is_held_by_its_distance_from_lmmse(photographed):
    """Stopped late, non-negative least squares paints noise, of which little is kept."""
    own, truth, training = photographed
    y = truth @ own.T
    sigma = float(np.sqrt(np.mean(y**2)) * 0.1)
    y = y + sigma * np.random.default_rng(3).standard_normal(y.shape)
    data = Superpixels(y=y, noise=Noise.of_sigma(sigma), scene="astronaut")
    system = LensletMatrix(
        path="lens",
        blocks=own[None],
        offsets=np.zeros((1, 2), int),
        pixel_shape=(16, 16),
        object_shape=(12, 12),
    )
    estimators = Estimators(system, Options(nnls_iterations=1000), lambda scene: training)
    found, _ = estimate(estimators, METHODS["nnls"], data)
    told, z = found.as_json(), np.abs(found.value - truth) / found.sigma
    assert told["matrix_believed"] and told["detail_kept"] < 0.7
    assert 0.90 < np.mean(z < 1.96) < 0.985


def test_detail_that_is_given_up_is_in_the_error_bars(lens):
    """Drawn halfway to the mean of each field, as the guard does, the intervals still hold."""
    _, lmmse, _ = lens
    x, y = drawn(lens, 1.0, 1500, 9)
    contrast = lmmse.contrast(lmmse.coordinates(y))
    found = lmmse.apply(y, lmmse.scales(y))
    drawn_back = 0.5 * (found - found.mean(axis=0)) + found.mean(axis=0)
    left = error_bars.about(
        drawn_back - found, error_bars.spread(lmmse, lmmse.coordinates(y), contrast)
    )
    assert np.mean(np.abs(drawn_back - x) < 1.96 * left) == pytest.approx(0.95, abs=0.01)
