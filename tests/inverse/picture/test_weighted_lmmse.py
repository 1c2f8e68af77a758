"""LMMSE with a weight for every pixel, against the dense solution over the ring; what is left out
is predicted; units do not matter.
"""

import numpy as np
import pytest

from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.hold_out import interpolated, judge
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels
from plenocli.inverse.picture.methods.registry import METHODS
from plenocli.inverse.picture.solvers import weighted_lmmse
from plenocli.inverse.picture.solvers.joint_lmmse import needed_reach
from plenocli.inverse.picture.solvers.weighted_lmmse import prepare_weighted

POINTS, PIXELS = (3, 3), (5, 4)
RING = np.array([[r, c] for r in (-1, 0, 1) for c in (-1, 0, 1)])
REACH = needed_reach(POINTS, RING)
LAGS = np.arange(-REACH, REACH + 1)
# proper: exp(-|r| - |c|) is a covariance, and separable, which the package's filters are not told
COVARIANCE = 0.05 * np.exp(-np.abs(LAGS)[:, None] / 3 - np.abs(LAGS)[None, :] / 3)


def camera(rng, tmp_path):
    blocks = rng.random((9, 20, 9)) * np.where(np.any(RING != 0, axis=1), 0.05, 1)[:, None, None]
    return LensletMatrix(
        path=tmp_path / "pif.h5",
        blocks=blocks,
        offsets=RING,
        pixel_shape=PIXELS,
        object_shape=POINTS,
    )


def dense(system, y, weight, level):
    """Estimate, its standard deviation and A x of the middle one of 3x3 lenslets, from objects of
    5x5 lenslets, point by point.
    """
    rows, columns = 5 * POINTS[0], 5 * POINTS[1]
    r, c = np.divmod(np.arange(rows * columns), columns)
    covariance = COVARIANCE[r[:, None] - r + REACH, c[:, None] - c + REACH]
    a = np.zeros((9, 20, rows * columns))
    for lenslet, (i, j) in enumerate(np.ndindex(3, 3)):
        for block, (dr, dc) in zip(system.blocks, RING):
            for point, (pr, pc) in enumerate(np.ndindex(*POINTS)):
                at = ((i + 1 - dr) * POINTS[0] + pr) * columns + (j + 1 - dc) * POINTS[1] + pc
                a[lenslet, :, at] += block[:, point]
    a, y, weight = a.reshape(180, -1), y.ravel(), weight.ravel()
    good = weight > 0
    seen = a[good]
    gain = (
        covariance @ seen.T @ np.linalg.inv(seen @ covariance @ seen.T + np.diag(1 / weight[good]))
    )
    x = level + gain @ (y[good] - level * seen.sum(axis=1))
    sd = np.sqrt(np.diag(covariance - gain @ seen @ covariance))
    own = (r // POINTS[0] == 2) & (c // POINTS[1] == 2)
    return x[own], sd[own], (a @ x).reshape(9, 20)[4]


def test_it_is_the_dense_solution_with_any_pixels_missing(tmp_path, monkeypatch):
    monkeypatch.setattr(weighted_lmmse, "FAINT", 0.0)
    rng = np.random.default_rng(3)
    system = camera(rng, tmp_path)
    y = rng.random((3, 3, 20)) + system.blocks.sum(axis=(0, 2)) * 0.4
    weight = rng.uniform(50, 2000, y.shape) * (rng.random(y.shape) > 0.3)
    weight[0, 1] = 0
    profile = 1 / np.sqrt(np.median(weight[weight.any(axis=2)], axis=0) + 1)
    solver = prepare_weighted(system, COVARIANCE, profile, np.eye(1), most=20)
    found = solver.apply(solver.coordinates(y, weight), np.ones((3, 3)))
    level = solver.coordinates(y, weight).around()[1, 1]
    x, sd, made = dense(system, y, weight, level)
    np.testing.assert_allclose(found.value[1, 1], x, atol=1e-8)
    np.testing.assert_allclose(found.sigma[1, 1], sd, rtol=1e-8)
    np.testing.assert_allclose(found.superpixels[1, 1], made, atol=1e-8)
    # the value of a missing pixel is nobody's business
    other = solver.apply(solver.coordinates(np.where(weight > 0, y, 1e3), weight), np.ones((3, 3)))
    np.testing.assert_array_equal(other.value, found.value)


def test_the_level_around_is_the_mean_of_those_that_are_there(tmp_path):
    rng = np.random.default_rng(5)
    system = camera(rng, tmp_path)
    level = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    y = level[..., None] * system.blocks.sum(axis=(0, 2))
    weight = np.ones(y.shape)
    weight[0, 0] = 0
    solver = prepare_weighted(system, COVARIANCE, np.ones(20), np.eye(1))
    found = solver.coordinates(y, weight)
    np.testing.assert_allclose(found.level[level > 1], level[level > 1])
    assert found.around()[0, 0] == pytest.approx((2 + 4 + 5) / 3)
    assert found.around()[0, 2] == pytest.approx((2 + 3 + 5 + 6) / 4)


def test_interpolation_bends_least():
    """A plane has no bending: missing pixels of it come back, over borders of superpixels too."""
    rows, columns = np.mgrid[:15, :12]
    plane = 2.0 + 0.3 * rows - 0.7 * columns
    y = plane.reshape(3, 5, 3, 4).swapaxes(1, 2).reshape(3, 3, 20)
    weight = np.ones(y.shape)
    weight[1, 1, 5:15] = 0
    weight[1, 2, [0, 4]] = 0
    spoilt = np.where(weight > 0, y, 1e6)
    np.testing.assert_allclose(interpolated(spoilt, weight, PIXELS), y, atol=1e-9)


def made(tmp_path, noise=0.01):
    """Estimators and a capture of a smooth scene with one dark bar; patches of it are not told by
    the pixels around, as superpixels are random."""
    rng = np.random.default_rng(8)
    system = camera(rng, tmp_path)
    count = (6, 7)
    rows, columns = np.mgrid[: count[0] * 3, : count[1] * 3]
    scene = 0.3 + 0.1 * np.sin(rows / 3) * np.cos(columns / 4) - 0.2 * (columns == 10)
    x = scene.reshape(count[0], 3, count[1], 3).swapaxes(1, 2).reshape(*count, 9)
    estimators = Estimators(
        system, Options(method="weighted", hold_out=0.1), lambda _: [("scene", scene)]
    )
    clean = estimators.sensor(count).forward(x)
    variance = noise**2 * np.broadcast_to(np.linspace(0.2, 5, 20), clean.shape)
    y = clean + np.sqrt(variance) * rng.standard_normal(clean.shape)
    return estimators, Superpixels(y=y, variance=variance), x


def test_the_method_weighs_pixels_and_judges_itself(tmp_path):
    estimators, data, truth = made(tmp_path)
    found = METHODS["weighted"].reconstruct(estimators, data)
    inner = np.s_[1:-1, 1:-1]
    error = np.sqrt(np.mean((found.value - truth)[inner] ** 2))
    even = Superpixels(y=data.y, variance=np.full(data.y.shape, data.variance.mean()))
    other = METHODS["weighted"].reconstruct(estimators, even)
    assert error < np.sqrt(np.mean((other.value - truth)[inner] ** 2)) < 0.2
    assert 0.5 < np.sqrt(np.mean(((found.value - truth) / found.sigma)[inner] ** 2)) < 1.6
    for one in found.stats.held_out:
        assert one.model < 1.5 * one.noise and one.model < min(one.block_mean, one.neighbours)
        assert one.as_json()["pixels"] > 0 and "left out" in one.sentence
    assert found.as_json()["held_out"][0]["patch"] == 1


@pytest.mark.parametrize("factor", [1e-20, 1e12])
def test_units_change_nothing_but_units(tmp_path, factor):
    estimators, data, _ = made(tmp_path)
    one = METHODS["weighted"].reconstruct(estimators, data)
    scaled = Superpixels(y=data.y * factor, variance=data.variance * factor**2)
    other = METHODS["weighted"].reconstruct(estimators, scaled)
    np.testing.assert_allclose(other.value / factor, one.value, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(other.sigma / factor, one.sigma, rtol=1e-6)


def test_a_judgement_leaves_out_what_it_says(tmp_path):
    """The prediction never sees the pixels that are judged; a perfect one has no error, and the
    noise is that of the pixels.
    """
    rng = np.random.default_rng(1)
    system = camera(rng, tmp_path)
    level = 0.5 + 0.1 * rng.random((5, 5, 1))
    y = level * system.blocks.sum(axis=(0, 2)) * (1 + 0.2 * rng.standard_normal((5, 5, 20)))
    weight = np.full(y.shape, 400.0)
    shares = []

    def predict(kept):
        shares.append(np.mean(kept == 0))
        return np.where(kept > 0, 1e9, y)

    found = judge(system, y, weight, predict, 0.2, np.random.default_rng(2), patches=(1, 2))
    assert all(0.1 < share < 0.35 for share in shares) and len(found) == 4
    peak = system.blocks.sum(axis=(0, 2)).max()
    for one in found:
        assert one.model == 0 and one.noise == pytest.approx(0.05 / peak)
        assert one.block_mean > 0.01 and one.neighbours > 0.01
