"""The likelihood of captures against the formula with whole covariances."""

import numpy as np
from scipy.special import logsumexp

from plenocli.inverse.fit.evidence import VEIL, Evidence, Lenslets
from plenocli.inverse.fit.prior import CONTRASTS, photograph_prior

RANDOM = np.random.default_rng(4)
PICTURE = np.cumsum(np.cumsum(RANDOM.standard_normal((60, 60)), 0), 1) / 60
PRIOR = photograph_prior([0.5 + 0.1 * PICTURE], (4, 4))
A = RANDOM.random((30, 16))
CAPTURES = [
    Lenslets(A @ RANDOM.random((16, 7)), 0.05),
    Lenslets(1.3 * A @ RANDOM.random((16, 3)), 0.1),
]
EVIDENCE = Evidence(CAPTURES, PRIOR)


def covariances(matrix, capture, factor):
    veil = (VEIL * capture.y.mean()) ** 2
    seen = [matrix @ PRIOR.patterns * PRIOR.scales(k) for k in CONTRASTS]
    noise = (factor * capture.sigma) ** 2 * np.eye(len(matrix))
    return [s @ s.T + veil + noise for s in seen]


def likelihoods(matrix, capture, factor):
    found = []
    for covariance in covariances(matrix, capture, factor):
        log = np.linalg.slogdet(covariance)[1]
        found.append(-0.5 * (log + np.sum(capture.y * np.linalg.solve(covariance, capture.y), 0)))
    return np.array(found)


def whole(matrix, factor):
    each = [logsumexp(likelihoods(matrix, c, factor), axis=0) - np.log(5) for c in CAPTURES]
    return float(sum(e.sum() for e in each))


def test_the_evidence_is_that_of_whole_covariances():
    for factor in (1.0, 4.0):
        assert abs(EVIDENCE.at(A).value(factor) - whole(A, factor)) < 1e-7
    found = EVIDENCE.at(A).noise_factor()
    values = [whole(A, f) for f in (found / 1.01, found, found * 1.01)]
    assert values[1] > max(values[0], values[2])


def test_its_derivatives_by_the_matrix():
    found = EVIDENCE.at(A).by_matrix(1.3)
    for _ in range(3):
        way = RANDOM.standard_normal(A.shape)
        rise = (whole(A + 1e-5 * way, 1.3) - whole(A - 1e-5 * way, 1.3)) / 2e-5
        assert abs(np.vdot(found, way) - rise) < 1e-5 * np.linalg.norm(found)


def test_its_curvature_is_that_of_what_objects_make_of_whole_covariances():
    slopes = [RANDOM.standard_normal(A.shape) for _ in range(3)]
    at, told = EVIDENCE.at(A), np.zeros((3, 3))
    light = [np.array([d @ at.objects(k, 1.3) for d in slopes]) for k in range(len(CAPTURES))]
    for capture, rises in zip(CAPTURES, light):
        likeliest = likelihoods(A, capture, 1.3).argmax(axis=0)
        whole = covariances(A, capture, 1.3)
        for lenslet, contrast in enumerate(likeliest):
            left = rises[:, :, lenslet]
            told += left @ np.linalg.solve(whole[contrast], left.T)
    found = at.curvature(light, 1.3)
    assert np.allclose(found, told, rtol=1e-6, atol=1e-6 * np.abs(told).max())


def test_the_curvature_foretells_how_the_slopes_fall():
    """Of captures that the matrix explains: within a few percent along the slopes of a camera."""
    rng = np.random.default_rng(7)
    x = PRIOR.patterns @ rng.standard_normal((PRIOR.patterns.shape[1], 400))
    capture = Lenslets(A @ x + 1e-3 * rng.standard_normal((30, 400)), 1e-3)
    evidence, way = Evidence([capture], PRIOR), rng.standard_normal(A.shape)
    at = evidence.at(A)
    told = at.curvature([(way @ at.objects(0, 1.0))[None]], 1.0)[0, 0]
    step = 0.1 / told**0.5
    ahead, behind = (np.vdot(evidence.at(A + s * way).by_matrix(1.0), way) for s in (step, -step))
    assert abs((behind - ahead) / (2 * step) / told - 1) < 0.1


def test_patterns_that_noise_hides_are_left_out():
    energy = np.mean((A @ PRIOR.patterns[:, :-1]) ** 2, axis=0)
    sigma = 1.01 * energy[3:].sum() ** 0.5
    few = PRIOR.seen(A, sigma)
    assert np.array_equal(few.patterns, PRIOR.patterns[:, [0, 1, 2, -1]])
