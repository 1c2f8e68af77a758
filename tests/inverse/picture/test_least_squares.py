"""Tikhonov, truncation, noise estimate and LMMSE against their definitions, and 3x3 LMMSE
against the full covariance.
"""

import numpy as np
import pytest

from plenocli.base.errors import NumericsError
from plenocli.base.linear_maps import BlockToeplitz
from plenocli.inverse.picture.solvers import joint_lmmse, lmmse
from plenocli.inverse.picture.solvers import least_squares as linear
from plenocli.inverse.prior import natural_images as natural


@pytest.fixture(scope="module")
def system():
    """A (60, 36) with singular values over five decades, 200 signals, noise 1e-3."""
    rng = np.random.default_rng(0)
    u, v = (np.linalg.qr(rng.standard_normal((n, 36)))[0] for n in (60, 36))
    a = (u * np.logspace(0, -5, 36)) @ v.T
    x = rng.standard_normal((36, 200))
    return a, x, a @ x + 1e-3 * rng.standard_normal((60, 200))


def test_tikhonov_is_its_normal_equations(system):
    a, _, y = system
    svd = linear.decompose(a)
    x = linear.tikhonov(svd, svd.compress(y), 1e-4)
    np.testing.assert_allclose(
        x, np.linalg.solve(a.T @ a + 1e-4 * np.eye(36), a.T @ y), rtol=1e-8, atol=1e-10
    )


def test_truncation_is_the_pseudo_inverse(system):
    a, _, y = system
    svd = linear.decompose(a)
    cut = (svd.s[9] + svd.s[10]) / 2 / svd.s[0]
    np.testing.assert_allclose(
        linear.truncated(svd, svd.compress(y), 10),
        np.linalg.pinv(a, rcond=cut) @ y,
        rtol=1e-8,
        atol=1e-9,
    )


def test_discrepancy_leaves_the_noise(system):
    a, _, y = system
    svd = linear.decompose(a)
    z = svd.compress(y)
    alpha = linear.discrepancy_alpha(svd, linear.power_of(z), 1e-3)
    left = z - svd.s[:, None] * (svd.vt @ linear.tikhonov(svd, z, alpha))
    assert np.sum(left**2) == pytest.approx(z.size * 1e-6, rel=1e-6)


def test_oracles_are_the_best(system):
    a, x, y = system
    svd = linear.decompose(a)
    z = svd.compress(y)
    error = lambda estimate: np.sum((estimate - x) ** 2)
    known = linear.power_of(z), linear.shared_with(svd, z, x)
    best = error(linear.tikhonov(svd, z, linear.oracle_alpha(svd, *known)))
    assert best <= min(
        error(linear.tikhonov(svd, z, alpha)) for alpha in np.logspace(-10, 0, 41)
    ) * (1 + 1e-6)
    ranks = [error(linear.truncated(svd, z, k)) for k in range(1, 37)]
    assert linear.oracle_rank(svd, *known) == int(np.argmin(ranks)) + 1
    assert (
        abs(linear.best_rank(svd, linear.power_of(z), 1e-3) - linear.oracle_rank(svd, *known)) <= 1
    )


def test_noise_is_estimated_from_what_a_cannot_make(system):
    a, _, y = system
    assert linear.estimate_noise(linear.decompose(a), y) == pytest.approx(1e-3, rel=0.05)
    with pytest.raises(NumericsError, match="noise-sigma"):
        linear.estimate_noise(linear.decompose(np.eye(5)), np.ones((5, 2)))


def test_useless_matrices_are_refused():
    for bad in (np.zeros((3, 2)), np.full((3, 2), np.nan)):
        with pytest.raises(NumericsError):
            linear.decompose(bad)


@pytest.mark.parametrize("scale", [1.0, 0.02, np.linspace(0.1, 2, 200)])
def test_lmmse_is_the_textbook_formula(system, scale):
    a, _, y = system
    root = np.random.default_rng(1).standard_normal((36, 36)) / 6
    c, mean = root @ root.T, np.linspace(0, 1, 36)
    estimator = lmmse.prepare(linear.decompose(a), mean, c, 1e-3)
    found = estimator.apply(y, scale)
    for k in (0, 77, 199):
        # a brightness about which nothing is known
        loose = np.broadcast_to(scale, 200)[k] * c + 1e6
        gain = loose @ a.T @ np.linalg.inv(a @ loose @ a.T + 1e-6 * np.eye(60))
        np.testing.assert_allclose(found[:, k], mean + gain @ (y[:, k] - a @ mean), atol=5e-3)


def test_lmmse_at_another_noise_keeps_what_both_have(system):
    """From one power of two to the next nothing is worked out anew, and nothing differs."""
    a, _, y = system
    root = np.random.default_rng(1).standard_normal((36, 36)) / 6
    c, mean, held = root @ root.T, np.linspace(0, 1, 36), {}

    def keep(name, inputs, make):
        key = name, tuple(values.tobytes() for values in inputs)
        if key not in held:
            held[key] = make()
        return held[key]

    svd = linear.decompose(a)
    for sigma, kept in ((1.0e-3, 1), (1.9e-3, 1), (0.98e-3, 1), (0.97e-3, 2)):
        found = lmmse.prepare(svd, mean, c, sigma, matrix=[a], keep=keep)
        assert len(held) == kept and (found.power > 1e-4 * sigma**2).all()
        alone = lmmse.prepare(svd, mean, c, sigma)
        np.testing.assert_array_equal(found.apply(y, 1.0), alone.apply(y, 1.0))


BANDS = np.array([[1.0, 0.5, 0.1], [0.5, 1.2, 0.3], [0.1, 0.3, 0.8]])


@pytest.mark.parametrize("told_apart", [True, False])
def test_lmmse_of_several_bands_is_one_linear_model(told_apart):
    rng = np.random.default_rng(4)
    a = rng.random((40, 3, 12)) * (1 + np.kron(np.eye(3), np.ones((14, 1)))[:40, :, None])
    if not told_apart:
        # the last two bands make the same superpixel
        a[:, 2] = a[:, 1] * (1 + 1e-6 * rng.random((40, 12)))
    a = a.reshape(40, 36)
    root = rng.standard_normal((12, 12)) / 4
    c, mean, sigma = root @ root.T, np.full(12, 0.4), 1e-3
    estimator = lmmse.prepare(linear.decompose(a), mean, c, sigma, BANDS)
    even = np.kron(np.eye(3), np.ones((12, 1)))
    y = a @ (
        np.repeat(rng.random((3, 5)), 12, axis=0) + 0.3 * rng.standard_normal((36, 5))
    ) + sigma * rng.standard_normal((40, 5))
    found, spread, scale = estimator.adaptive(y)
    if told_apart:
        for k in range(5):
            # brightnesses about which nothing is known
            prior = scale[k] * np.kron(BANDS, c) + 1e3 * even @ even.T
            gain = np.linalg.solve(a @ prior @ a.T + sigma**2 * np.eye(40), a @ prior).T
            expected = np.tile(mean, 3) + gain @ (y[:, k] - a @ np.tile(mean, 3))
            np.testing.assert_allclose(found[:, k], expected, atol=1e-6)
            np.testing.assert_allclose(
                spread[:, k], np.sqrt(np.diag(prior - gain @ a @ prior)), rtol=1e-3
            )
    assert (
        estimator.levels.shape == (3 if told_apart else 2, 40)
        and np.abs(found).max() < 5
        and np.isfinite(spread).all()
    )
    np.testing.assert_allclose(a @ found, y, atol=0.2)


def test_lmmse_finds_the_contrast_of_each_signal(system):
    a, x, _ = system
    rng = np.random.default_rng(6)
    scale = 10 ** rng.uniform(-2, 1, 200)
    x = x * np.sqrt(scale) + rng.random(200)
    y = a @ x + 1e-3 * rng.standard_normal((60, 200))
    estimator = lmmse.prepare(linear.decompose(a), np.zeros(36), np.eye(36), 1e-3)
    found, sigma, scales = estimator.adaptive(y)
    error = lambda e: np.sqrt(np.mean((e - x) ** 2 / scale))
    # 20 coordinates know a variance to 0.32
    assert np.sqrt(np.mean(np.log(scales / scale) ** 2)) < 0.45
    assert error(found) < 1.01 * error(estimator.apply(y, scale)) and error(found) < 0.98 * error(
        estimator.apply(y)
    )
    assert np.sqrt(np.mean(sigma**2 / scale)) == pytest.approx(error(found), rel=0.08)
    assert estimator.common_scale(a @ x[:, :1] + 0 * y) == pytest.approx(scale[0], rel=1.0)
    assert estimator.common_scale(y / 3) == pytest.approx(estimator.common_scale(y) / 9, rel=0.3)
    dark = estimator.adaptive(np.zeros((60, 3)))[0]
    np.testing.assert_allclose(dark, 0, atol=1e-12)


def test_lmmse_needs_noise(system):
    a, _, _ = system
    with pytest.raises(NumericsError, match="noise"):
        lmmse.prepare(linear.decompose(a), np.zeros(36), np.eye(36), 0.0)


N = 4
RING = np.array([[r, c] for r in (-1, 0, 1) for c in (-1, 0, 1)])


def neighbours(coupled):
    blocks = (
        np.random.default_rng(2).random((9, 9, N * N))
        * np.where(np.any(RING != 0, axis=1), 0.03 if coupled else 0, 1)[:, None, None]
    )
    return (blocks, RING) if coupled else (blocks[4:5], RING[4:5])


def test_joint_lmmse_needs_noise():
    with pytest.raises(NumericsError, match="positive noise level, not 0"):
        joint_lmmse.prepare_joint(np.eye(9), *neighbours(True), (N, N), 0.4, None, 0)


@pytest.mark.parametrize(
    ("coupled", "bands"), [(False, np.eye(1)), (True, np.eye(1)), (True, BANDS[1:, 1:])]
)
def test_joint_lmmse_is_the_full_covariance(coupled, bands, monkeypatch):
    monkeypatch.setattr(joint_lmmse, "CONTRASTS", np.ones(1))
    blocks, offsets = neighbours(coupled)
    rng, count, sigma, n = np.random.default_rng(3), 3, 1e-2, len(bands)
    if n > 1:
        blocks = np.concatenate([blocks, blocks[:, ::-1] * np.linspace(0.5, 1, 9)[:, None]], axis=2)
    reach = joint_lmmse.needed_reach((N, N), offsets)
    lag = np.arange(-reach, reach + 1)
    covariance_map = 0.05 * np.exp(-np.hypot(lag[:, None], lag[None, :]) / 6)
    joint = joint_lmmse.prepare_joint(
        linear.decompose(blocks[len(blocks) // 2]).u,
        blocks,
        offsets,
        (N, N),
        0.4,
        covariance_map,
        sigma,
        bands,
    )
    side = count + 2  # light from one lenslet outside counts, with the scene's statistics
    op = BlockToeplitz(blocks, offsets, (side, side))
    index = np.arange((side * N) ** 2).reshape(side, N, side, N).transpose(0, 2, 1, 3).ravel()
    r, c = np.divmod(index, side * N)
    full_map = 0.05 * np.exp(
        -np.hypot(
            *(
                np.arange(-side * N, side * N + 1)[s]
                for s in ((slice(None), None), (None, slice(None)))
            )
        )
        / 6
    )
    cover = full_map[
        r[:, None] - r[None, :] + side * N, c[:, None] - c[None, :] + side * N
    ].reshape(side**2, N * N, side**2, N * N)
    # points of one band after the other
    cover = np.einsum("ab,lpmq->lapmbq", bands, cover).reshape(op.domain.size, op.domain.size)
    identity = np.eye(op.domain.size).reshape(-1, *op.domain.shape)
    matrix = np.stack([op.forward(e)[1:-1, 1:-1].ravel() for e in identity], axis=1)
    y = rng.random((count, count, 9)) + matrix.sum(axis=1).reshape(count, count, 9) * 0.4
    data = matrix @ cover @ matrix.T + sigma**2 * np.eye(len(matrix))
    cross = cover @ matrix.T
    estimate = 0.4 + (cross @ np.linalg.solve(data, y.ravel() - 0.4 * matrix.sum(axis=1))).reshape(
        op.domain.shape
    )
    error = np.sqrt(
        np.diag(cover) - np.einsum("ij,ji->i", cross, np.linalg.solve(data, cross.T))
    ).reshape(op.domain.shape)
    x, spread, _ = joint.apply(y)
    # the middle lenslet of 3x3 sees everything there is
    np.testing.assert_allclose(x[1, 1], estimate[2, 2], atol=1e-8)
    np.testing.assert_allclose(spread[1, 1], error[2, 2], atol=1e-8)


def test_autocovariance_of_known_fields():
    rng = np.random.default_rng(5)
    mean, white = natural.autocovariance([0.5 + 0.1 * rng.standard_normal((200, 220))], 3)
    assert mean == pytest.approx(0.5, abs=2e-3)
    assert white[3, 3] == pytest.approx(0.01, rel=0.02)
    assert np.abs(np.delete(white.ravel(), 24)).max() < 2e-4
    # -1.5 -.5 .5 1.5: lag 1 is (.75 -.25 .75) / 3
    _, lags = natural.autocovariance([np.arange(4.0)[None, :] * np.ones((4, 1))], 1)
    np.testing.assert_allclose(lags[1], [1.25 / 3, 1.25, 1.25 / 3])


def test_patches_come_from_the_pictures():
    picture = np.arange(30.0).reshape(5, 6)
    patches = natural.draw_patches([picture], (5, 6), 20, np.random.default_rng(0))
    shapes = {p.tobytes() for p in patches.T}
    assert shapes == {picture[::a, ::b].tobytes() for a in (1, -1) for b in (1, -1)}
    with pytest.raises(ValueError, match="at least"):
        natural.draw_patches([picture], (6, 6), 1, np.random.default_rng(0))
