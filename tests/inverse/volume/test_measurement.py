"""What counts, what is put aside, where voxels are, and error bars of predictions."""

import numpy as np
import pytest
from scipy.optimize import nnls

from plenocli.base.errors import NumericsError
from plenocli.base.linear_maps import BlockCirculant
from plenocli.inverse.volume.measurement import Measurement, Problem, Voxels, put_aside
from plenocli.inverse.volume.volume import HeldOut, predictive_sigma, variance_law
from tests.reference import volumes

VOXELS = Voxels((2, 3), 1e-6, (-1e-6, 1e-6))


def small(usable=True, **options):
    op = BlockCirculant(volumes.kernels(2, 6, 8), (5, 6), (7, 8))
    signal = np.where(usable, np.random.default_rng(1).random(op.range.shape), np.nan)
    return Problem(op, Measurement(signal=signal, read_variance=1e-4, **options), VOXELS)


def test_voxels_stand_where_the_layout_says():
    x = np.zeros((4, 5, 12))
    x[2, 3, 1 * 6 + 1 * 3 + 2] = 1
    picture = VOXELS.picture(x)
    assert picture.shape == (2, 8, 15) and picture[1, 2 * 2 + 1, 3 * 3 + 2] == 1
    x = np.random.default_rng(0).random((4, 5, 12))
    np.testing.assert_array_equal(VOXELS.lenslets(VOXELS.picture(x)), x)


def test_a_share_of_the_pixels_is_put_aside_and_always_the_same():
    problem, again = small(), small()
    assert 0.02 < problem.held.mean() < 0.09
    np.testing.assert_array_equal(problem.held, again.held)
    assert not np.any(problem.held & problem.counts) and np.all(problem.held | problem.counts)


def test_a_window_puts_aside_the_pixels_that_the_whole_does():
    """The numbers of the whole draw, cut; the stream's first ones are those of NumPy."""
    rng = np.random.default_rng(np.random.SeedSequence([5, 0, *b"volume-hold-out"]))
    whole = rng.random((9, 11, 6)) < 0.2
    for rows, columns in ((slice(0, 9), slice(0, 11)), (slice(3, 8), slice(2, 7))):
        found = put_aside(0.2, 5, whole.shape, rows, columns)
        np.testing.assert_array_equal(found, whole[rows, columns])


def test_what_is_not_usable_is_neither_fitted_nor_put_aside():
    usable = np.random.default_rng(2).random((5, 6, 8)) > 0.3
    problem = small(usable=usable, background=0.5)
    assert not np.any((problem.held | problem.counts) & ~usable)
    assert np.all(problem.signal[~usable] == 0)
    np.testing.assert_array_equal(problem.signal[usable], problem.measurement.signal[usable] - 0.5)
    with pytest.raises(NumericsError, match="no pixel"):
        small(usable=np.zeros((5, 6, 8), bool))


def test_dark_pixels_of_a_superpixel_do_not_count():
    parts = [(blocks * (np.arange(8) != 3)[:, None], o) for blocks, o in volumes.kernels(2, 6, 8)]
    op = BlockCirculant(parts, (5, 6), (7, 8))
    problem = Problem(op, Measurement(signal=np.ones(op.range.shape), read_variance=1.0), VOXELS)
    assert not problem.counts[..., 3].any() and problem.counts[..., 4].any()


def test_light_that_leaves_the_array_is_known():
    problem = small()
    a = volumes.matrix(volumes.kernels(2, 6, 8), (5, 6), (7, 8))
    np.testing.assert_allclose(problem.seen.ravel(), a.sum(axis=0), atol=1e-12)
    assert problem.margin == 1
    assert (
        Problem(
            problem.op.on_torus(),
            Measurement(signal=np.ones((7, 8, 8)), read_variance=1.0),
            VOXELS,
        ).margin
        == 0
    )


def test_shapes_must_fit():
    op = BlockCirculant(volumes.kernels(2, 6, 8), (5, 6), (7, 8))
    with pytest.raises(ValueError, match="does not fit"):
        Problem(op, Measurement(signal=np.ones((5, 5, 8)), read_variance=1.0), VOXELS)


def test_bars_of_predictions_grow_with_brightness():
    rng = np.random.default_rng(3)
    predicted = rng.exponential(1.0, 20000)
    truth = np.sqrt(0.01 + 0.02 * predicted + 0.04 * predicted**2)
    measured = predicted + truth * rng.standard_normal(20000)
    sigma = predictive_sigma(measured, predicted)
    assert np.abs(sigma / truth - 1).mean() < 0.05
    held = HeldOut(
        index=np.zeros((20000, 3), int), measured=measured, predicted=predicted, sigma=sigma
    )
    assert all(0.93 < share < 0.97 for share in held.held_by_bars)
    assert all(0.95 < z < 1.05 for z in held.z_rms)
    assert held.explained_db == pytest.approx(
        10 * np.log10(np.var(measured) / np.mean(truth**2)), abs=0.3
    )


def test_a_law_of_variance_has_no_negative_part():
    level = np.linspace(0, 1, 500)
    law = np.stack([np.ones(500), level], axis=1)
    np.testing.assert_allclose(variance_law(law, 2 + 3 * level), [2, 3], rtol=1e-6)
    assert np.all(variance_law(law, 2 - level) >= 0)
    assert not variance_law(law, 0 * level).any()


def test_a_law_of_variance_is_that_of_weighted_least_squares(monkeypatch):
    """Against rounds over all pixels at once; here a few hundred at a time."""
    rng = np.random.default_rng(12)
    level = rng.exponential(3e-4, 4000)
    law = np.stack([np.ones(4000), level, level**2], axis=1)
    square = (1e-8 + 2e-5 * level) * rng.standard_normal(4000) ** 2
    variance = np.full(4000, square.mean())
    scale = law.max(axis=0)
    for _ in range(8):
        expected = nnls(law / scale / variance[:, None], square / variance)[0] / scale
        variance = np.maximum(law @ expected, 1e-3 * variance.mean())
    monkeypatch.setattr("plenocli.inverse.volume.volume.AT_ONCE", 300)
    np.testing.assert_allclose(variance_law(law, square), expected, rtol=1e-7, atol=1e-12)
