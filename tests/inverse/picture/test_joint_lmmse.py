"""The joint LMMSE of picture.solvers.joint_lmmse with statistics that were measured, of pictures
that make poor ones, down to almost no noise.
"""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from plenocli.files.read.scenes import embedded_photograph
from plenocli.forward.scene.sample import luminance
from plenocli.inverse.picture.solvers import joint_lmmse, lmmse
from plenocli.inverse.picture.solvers import least_squares as linear
from plenocli.inverse.prior import natural_images as natural

POINTS, RING = (4, 3), np.array([[r, c] for r in (-1, 0, 1) for c in (-1, 0, 1)])
DRAWS = 5


def picture(name):
    y, x = np.mgrid[:60, :48]
    if name == "photograph":
        return np.asarray(luminance(embedded_photograph("chelsea")), float)[:60, :48]
    return {
        "ramp": y / 60,
        "disc": 0.1 + 0.8 * (np.hypot(y - 25, x - 20) < 12),
        "point": (x == 20) * (y == 30) * 1.0,
        "stripes": 0.5 + 0.5 * np.sign(np.sin(x)),
    }[name]


@pytest.mark.parametrize("name", ["photograph", "ramp", "disc", "point", "stripes"])
def test_what_is_measured_is_a_covariance(name):
    reach = 19
    raw = picture(name)
    mean, found = natural.autocovariance([raw], reach)
    assert mean == pytest.approx(raw.mean()) and found[reach, reach] == pytest.approx(
        raw.var(), rel=1e-9
    )
    np.testing.assert_allclose(found, found[::-1, ::-1], atol=1e-12 * found.max())
    r, c = np.divmod(np.arange(400), 20)  # any points with lags within reach
    cover = found[r[:, None] - r + reach, c[:, None] - c + reach]
    assert np.linalg.eigvalsh(cover)[0] > -1e-12 * np.trace(cover)


@pytest.mark.parametrize("snr_db", [20, 60, 120, 200])
@pytest.mark.parametrize("name", ["photograph", "ramp", "disc", "point"])
def test_joint_lmmse_with_measured_statistics_is_the_dense_one(name, snr_db, monkeypatch):
    """Matrices whose directions fade as those of cameras do, for one contrast; at 120 dB only what
    rounding leaves is known.
    """
    monkeypatch.setattr(joint_lmmse, "CONTRASTS", np.ones(1))
    rng = np.random.default_rng(6)
    blocks = (
        rng.random((9, 20, 12))
        * np.where(np.any(RING != 0, axis=1), 0.03, 1)[:, None, None]
        * np.logspace(0, -6, 20)[:, None]
    )
    mean, found = natural.autocovariance(
        [picture(name)], reach := joint_lmmse.needed_reach(POINTS, RING)
    )
    sigma = float(np.sqrt(np.mean((mean * blocks.sum(axis=(0, 2))) ** 2)) * 10 ** (-snr_db / 20))
    svd = linear.decompose(blocks[4])
    seen = svd.u[:, : svd.rank()]
    joint = joint_lmmse.prepare_joint(seen, blocks, RING, POINTS, mean, found, sigma)
    lenslet, (r, c) = (
        np.divmod(np.arange(25 * 12), 12)[0],
        np.divmod(np.arange(25 * 12) % 12, POINTS[1]),
    )
    r, c = r + lenslet // 5 * POINTS[0], c + lenslet % 5 * POINTS[1]
    cover = found[r[:, None] - r + reach, c[:, None] - c + reach]
    matrix = np.zeros((9, 20, 25, 12))  # what the 3x3 lenslets in the middle of 5x5 see
    for k, (dr, dc) in enumerate(RING):
        # the light of the object of lenslet i falls on superpixel i + offset
        for block, (er, ec) in zip(blocks, RING):
            matrix[k, :, (2 + dr - er) * 5 + 2 + dc - ec] += block
    matrix = matrix.reshape(180, 300)
    values, vectors = np.linalg.eigh(cover)
    x = mean + vectors @ (
        np.sqrt(np.maximum(values, 0))[:, None] * rng.standard_normal((300, DRAWS))
    )
    y = matrix @ x + sigma * rng.standard_normal((180, DRAWS))
    own = np.s_[12 * 12 : 13 * 12]
    error, expected = np.empty((2, DRAWS, 12))
    for k in range(DRAWS):
        estimate, spread, _ = joint.apply(y[:, k].reshape(3, 3, 20))
        error[k], expected[k] = estimate[1, 1] - x[own, k], spread[1, 1]
    assert (
        np.isfinite(error).all() and (expected <= np.sqrt(found[reach, reach]) * (1 + 1e-12)).all()
    )
    assert np.sqrt(np.mean(error**2)) < 2 * np.sqrt(np.mean(expected**2)) + 1e-6 * np.sqrt(
        found.max()
    )
    if snr_db <= 60:
        # light of the neighbours that the own block does not give is not looked at
        seen = np.kron(np.eye(9), joint.analysis)
        gain = np.linalg.solve(
            seen @ matrix @ cover @ (seen @ matrix).T + np.eye(len(seen)),  # of unit noise
            seen @ matrix @ cover[:, own],
        ).T
        np.testing.assert_allclose(
            error.T,
            mean + gain @ seen @ (y - matrix.sum(axis=1, keepdims=True) * mean) - x[own],
            atol=1e-6 * np.sqrt(found.max()),
        )


def test_a_mean_over_contrasts_is_that_of_dense_mixtures():
    """Each contrast with the dense covariance and density of the superpixels that there are; the
    distribution of contrasts fitted to all lenslets as the docstring says.
    """
    rng, own = np.random.default_rng(8), np.zeros((1, 2), int)
    block = rng.random((20, 12)) * np.logspace(0, -3, 20)[:, None]
    mean, found = natural.autocovariance(
        [picture("photograph")], reach := joint_lmmse.needed_reach(POINTS, own)
    )
    sigma = 0.05
    directions = linear.decompose(block).u
    joint = joint_lmmse.prepare_joint(directions, block[None], own, POINTS, mean, found, sigma)
    lenslet, point = np.divmod(np.arange(9 * 12), 12)
    r = lenslet // 3 * POINTS[0] + point // POINTS[1]
    c = lenslet % 3 * POINTS[1] + point % POINTS[1]
    cover = found[r[:, None] - r + reach, c[:, None] - c + reach]
    bright = np.linalg.cholesky(cover + 1e-9 * np.eye(len(cover))) @ rng.standard_normal(108)
    x = (mean + bright.reshape(9, 12) * np.geomspace(0.3, 3, 9)[:, None]).reshape(3, 3, 12)
    y = x @ block.T + sigma * rng.standard_normal((3, 3, 20))
    estimate, spread, contrast = joint.apply(y)

    scales, seen = joint_lmmse.CONTRASTS, joint.analysis
    z = (y - mean * block.sum(axis=1)) @ seen.T
    log, values, spreads = np.empty((len(scales), 9)), {}, {}
    for k, scale in enumerate(scales):
        for n in range(9):
            near = [m for m in range(9) if max(abs(m // 3 - n // 3), abs(m % 3 - n % 3)) <= 1]
            points = np.concatenate([np.arange(12) + 12 * m for m in near])
            matrix = np.kron(np.eye(len(near)), seen @ block)
            prior = scale * cover[np.ix_(points, points)]
            data = matrix @ prior @ matrix.T + np.eye(len(matrix))  # of unit noise
            told = z.reshape(9, -1)[near].ravel()
            log[k, n] = multivariate_normal(cov=data).logpdf(told)
            cross = scale * cover[12 * n : 12 * n + 12][:, points] @ matrix.T
            values[k, n] = mean + cross @ np.linalg.solve(data, told)
            spreads[k, n] = np.diag(
                scale * cover[12 * n : 12 * n + 12, 12 * n : 12 * n + 12]
                - cross @ np.linalg.solve(data, cross.T)
            )
    logs, prior = np.log(scales), np.full(len(scales), 1 / len(scales))
    for _ in range(lmmse.ROUNDS):
        share = np.exp(log - log.max(axis=0)) * prior[:, None]
        share /= share.sum(axis=0)
        middle = (weight := share.mean(axis=1)) @ logs
        width = max(np.sqrt(weight @ (logs - middle) ** 2), 0.5)
        prior = np.maximum(np.exp(-((logs - middle) ** 2) / 2 / width**2), 1e-30)
    np.testing.assert_allclose(contrast.ravel(), np.exp(logs @ share), rtol=1e-6)
    for n in range(9):
        expected = sum(share[k, n] * values[k, n] for k in range(len(scales)))
        variance = sum(
            share[k, n] * (spreads[k, n] + (values[k, n] - expected) ** 2)
            for k in range(len(scales))
        )
        np.testing.assert_allclose(estimate[n // 3, n % 3], expected, atol=1e-6)
        np.testing.assert_allclose(spread[n // 3, n % 3], np.sqrt(variance), rtol=1e-4)
