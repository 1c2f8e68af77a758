"""Solvers at the edges of arithmetic: any condition, deficient matrices, any scale, sizes from
one, nothing but zeros.
"""

import warnings

import numpy as np
import pytest

from plenocli.base.errors import NumericsError
from plenocli.inverse.picture.solvers import least_squares as linear
from plenocli.inverse.picture.solvers import lmmse, nnls
from plenocli.inverse.sparse.l1.solve import sparse_code
from plenocli.inverse.spectra import demultiplex as spectral
from tests.reference import extremes
from tests.reference.extremes import CONDITIONS, KINDS, SIZES

MOST = 30
"""LAPACK's own bound for its tests, in units of rounding errors."""


def data(a, count=3, noise=1e-3):
    rng = np.random.default_rng(a.shape)
    return a @ rng.random((a.shape[1], count)) + noise * rng.normal(size=(a.shape[0], count))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_answers_solve_their_equations_as_well_as_arithmetic_allows(count, kind, dtype):
    answers = refused = 0
    for shape in SIZES:
        for condition in CONDITIONS if kind in ("spread", "step") else CONDITIONS[:2]:
            a = extremes.matrix(kind, shape, condition, dtype).astype(float)
            if not a.any():
                continue
            y = data(a)
            for relative in (1e-16, 1e-12, 1e-4, 1e4):
                assert extremes.tikhonov(a, y, relative) < MOST, (shape, condition, relative)
            assert extremes.truncated(a, y) < MOST, (shape, condition)
            for found in (
                extremes.nonnegative(a, y),
                extremes.demultiplexed(a, y, "pinv"),
                extremes.demultiplexed(a, y, "wls"),
            ):
                assert found is None or found < MOST, (shape, condition)
                refused, answers = refused + (found is None), answers + 1
            for relative in (1e-12, 1e-6, 1e-2, 1.0, 1e6):
                gap, excess = extremes.coded(a, y, relative)
                assert excess < 1e-3 and (gap <= 1e-6 or relative < 1e-8), (
                    shape,
                    condition,
                    relative,
                    gap,
                    excess,
                )
    assert answers > 20 and refused < answers
    count(
        "solvers x matrices, residuals of their equations in rounding errors",
        answers=answers - refused,
        refused=refused,
        above_30=0,
    )


def test_the_report_has_a_row_for_each_condition():
    small = extremes.table(conditions=(1.0, 1e16), sizes=((3, 2),)).splitlines()
    assert len(small) == 4 and small[2].startswith("| 1e+00 | ") and small[3].count("refused") >= 2


@pytest.mark.parametrize("scale", [2.0**-99, 1e-30, 1e30, 2.0**99])
def test_data_times_s_give_results_times_s(scale):
    a = extremes.matrix("spread", (11, 7), 1e4)
    y = data(a)
    svd = linear.decompose(a)
    alpha = linear.discrepancy_alpha(svd, linear.power_of(svd.compress(y)), 1e-3)
    scaled = linear.discrepancy_alpha(svd, linear.power_of(svd.compress(scale * y)), scale * 1e-3)
    assert scaled == pytest.approx(alpha, rel=1e-9)
    assert linear.best_rank(
        svd, linear.power_of(svd.compress(scale * y)), scale * 1e-3
    ) == linear.best_rank(svd, linear.power_of(svd.compress(y)), 1e-3)
    assert linear.estimate_noise(svd, scale * y) == pytest.approx(
        scale * linear.estimate_noise(svd, y), rel=1e-9
    )
    assert nnls.converged(a, scale * y).x == pytest.approx(
        scale * nnls.converged(a, y).x, rel=1e-6, abs=1e-9 * scale
    )
    for method in ("pinv", "wls", "nnls"):
        found, sigma = spectral.demultiplex(a, scale * y.T, method, variance=1e-6 * scale**2)
        expected, spread = spectral.demultiplex(a, y.T, method, variance=1e-6)
        assert found == pytest.approx(
            scale * expected, rel=1e-8, abs=1e-12 * scale
        ) and sigma == pytest.approx(scale * spread, rel=1e-9)
    lam = 0.05 * 2 * np.abs(a.T @ y).max()
    assert sparse_code(a, scale * y, scale * lam, workers=1).c == pytest.approx(
        scale * sparse_code(a, y, lam, workers=1).c, rel=1e-5, abs=1e-9 * scale
    )
    for factor in (scale, 1 / scale):  # the matrix in other units, the object in theirs
        other = linear.decompose(a * factor)
        assert linear.tikhonov(other, other.compress(y), alpha * factor**2) == pytest.approx(
            linear.tikhonov(svd, svd.compress(y), alpha) / factor, rel=1e-8
        )
    points, covariance = np.full(7, 0.4), 0.05 * np.eye(7)
    found = lmmse.prepare(svd, scale * points, scale**2 * covariance, scale * 1e-2).adaptive(
        scale * y
    )
    expected = lmmse.prepare(svd, points, covariance, 1e-2).adaptive(y)
    assert (
        found[0] == pytest.approx(scale * expected[0], rel=1e-8)
        and found[1] == pytest.approx(scale * expected[1], rel=1e-8)
        and found[2] == pytest.approx(expected[2], rel=1e-8)
    )


@pytest.mark.parametrize("values", [0.0, 1.0, 5e-324, 1e-310, 1e-160, 1e150], ids=str)
def test_constant_zero_and_denormal_data_give_finite_answers(values):
    a = extremes.matrix("spread", (9, 6), 1e3)
    y = np.full((9, 2), values)
    svd = linear.decompose(a)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        answers = [
            linear.tikhonov(svd, svd.compress(y), 1e-6),
            linear.truncated(svd, svd.compress(y), 4),
            nnls.projected_gradient(a, y, 20).x,
            spectral.demultiplex(a, y.T, "pinv")[0],
            sparse_code(a, y, 1e-3, workers=1).c,
            *lmmse.prepare(svd, np.full(6, 0.4), 0.05 * np.eye(6), 1e-3).adaptive(y)[:2],
        ]
    assert all(np.isfinite(x).all() for x in answers)
    if values == 0:
        assert all(not x.any() for x in answers[:5])


@pytest.mark.parametrize("noise_db", range(-20, 141, 20))
def test_any_noise_from_overwhelming_to_none(noise_db):
    a = extremes.matrix("spread", (40, 25), 1e6)
    truth = np.random.default_rng(3).random((25, 4))
    clean = a @ truth
    sigma = float(np.sqrt(np.mean(clean**2)) * 10 ** (-noise_db / 20))
    y = clean + sigma * np.random.default_rng(4).normal(size=clean.shape)
    svd = linear.decompose(a)
    z = svd.compress(y)
    alpha = linear.discrepancy_alpha(svd, linear.power_of(z), sigma)
    estimate, spread, _ = extremes.wiener(a, y, sigma)
    level = np.linalg.norm(truth)
    assert (
        np.linalg.norm(linear.tikhonov(svd, z, alpha) - truth) < 1.5 * level
        and 1 <= linear.best_rank(svd, linear.power_of(z), sigma) <= 25
    )
    assert (
        np.isfinite(spread).all()
        and np.linalg.norm(estimate - truth) < (40 if noise_db < 0 else 1.5) * level
    )


def test_without_light_or_with_wrong_numbers_there_is_a_named_refusal():
    for bad in (np.zeros((4, 3)), np.full((4, 3), np.nan), np.full((4, 3), np.inf)):
        with pytest.raises(NumericsError):
            linear.decompose(bad)
    good = linear.decompose(np.eye(3))
    with pytest.raises(NumericsError, match="noise"):
        linear.estimate_noise(good, np.ones((3, 2)))
    with pytest.raises(NumericsError, match="noise"):
        lmmse.prepare(good, np.zeros(3), np.eye(3), 0.0)
    assert np.isnan(spectral.demultiplex(np.ones((5, 2)), np.ones((3, 5)), "pinv")[0]).all()


@pytest.mark.slow
def test_a_real_matrix_of_condition_1e12_and_captures_at_the_extremes():
    """2704 pixels, 1600 points: equations are solved as well as arithmetic allows, and estimates of
    what a capture may hold at worst are finite.
    """
    a = extremes.real_matrix()
    assert 1e11 < np.linalg.cond(a) < 1e13
    for name, y in extremes.captures(a).items():
        for found in (extremes.tikhonov(a, y, 1e-12), extremes.truncated(a, y)):
            assert found < MOST, name
        scale = max(np.abs(y).max(), 1e-300)
        for x in (nnls.projected_gradient(a, y, 5).x, extremes.wiener(a, y, 1e-3 * scale)[0]):
            assert np.isfinite(x).all(), name


def test_captures_of_any_unit_are_reconstructed():
    """Whose squares overflow, and with noise that the values do not show."""
    import dataclasses

    import plenocli as pc

    camera = pc.read_camera(pc.sample("tiny.toml"))
    matrix = pc.system_matrix(camera, accuracy=1e-2)
    shot = pc.simulate_capture(camera, "skimage:coffee", matrix=matrix, snr_db=40)
    loud = np.asarray(shot.capture.mosaic, float) * 1e300 / np.max(shot.capture.mosaic)
    shot = dataclasses.replace(shot, capture=dataclasses.replace(shot.capture, mosaic=loud))
    for method in ("tikhonov", "lmmse"):
        found = pc.reconstruct(shot, matrix, method=method).value
        assert np.isfinite(found).all() and 1e299 < np.mean(found) < 1e301
