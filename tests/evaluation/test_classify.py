"""Classification of patches against Bayes' rate for two Gaussian classes, and its corner cases."""

from math import erf, sqrt

import numpy as np
import pytest

from plenocli.evaluation.metrics.classify import cross_validated, nearest_known, samples


def two_classes(distance, count=3000, seed=0):
    """Spectra of two patches that differ by `distance` standard deviations along one direction
    of equal, correlated noise.
    """
    rng = np.random.default_rng(seed)
    mixing = np.array([[0.01, 0, 0], [0.02, 0.05, 0], [0, 0.03, 0.2]])
    labels = np.repeat([3, 9], count)
    step = mixing @ np.array([0.6, 0.0, 0.8]) * distance
    return 0.4 + rng.normal(size=(2 * count, 3)) @ mixing.T + (labels == 9)[:, None] * step, labels


@pytest.mark.parametrize("distance", [1.0, 3.0])
def test_two_gaussian_patches_are_told_apart_as_often_as_can_be(distance):
    pytest.importorskip("sklearn")
    best = 0.5 * (1 + erf(distance / 2 / sqrt(2)))
    spectra, labels = two_classes(distance)
    # 6 000 draws tell 0.006
    assert cross_validated(spectra, labels) == pytest.approx(best, abs=0.02)
    known = {3: np.full(3, 0.4), 9: spectra[labels == 9].mean(axis=0)}
    assert nearest_known(spectra, labels, known) < best  # blind to how noise is correlated


def test_training_lenslets_do_not_judge_themselves():
    pytest.importorskip("sklearn")
    rng = np.random.default_rng(1)
    # chance is 1 in 24
    assert cross_validated(rng.normal(size=(240, 12)), np.arange(240) % 24) < 0.15


def test_lonely_patches_are_left_out():
    pytest.importorskip("sklearn")
    spectra, labels = two_classes(8.0, 10)
    assert cross_validated(np.vstack([spectra, [[9, 9, 9]]]), np.append(labels, 5)) == 1.0
    assert np.isnan(cross_validated(spectra[:11], labels[:11]))


def test_samples_are_labelled_and_finite():
    cube = np.arange(12.0).reshape(2, 2, 3)
    cube[1, 0, 0] = np.nan
    spectra, labels = samples(cube, np.array([[4, 0, 5], [0, 6, 0]]))
    np.testing.assert_array_equal(spectra, [[2, 8], [4, 10]])
    np.testing.assert_array_equal(labels, [5, 6])
    assert nearest_known(spectra, labels, {5: [2, 8], 6: [5, 10]}) == 1.0
    assert nearest_known(spectra, labels, {5: [4, 10], 6: [2, 8]}) == 0.0
