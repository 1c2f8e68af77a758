"""Lenslets solved together, against dense least squares on small arrays and against statistics."""

import numpy as np
import pytest

from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.spectra.coupled import LatticeCapture, coupled, fine, more_likely
from plenocli.inverse.spectra.lattice_system import PAD, LatticeSystem, PointPrior
from plenocli.inverse.spectra.neighbours import NeighbourLight

BANDS, SIDE, POINTS = 2, 6, 3
PIXELS = SIDE**2
NOISE = Noise(gain=0.4, read_variance=2.0)
OFFSETS = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])


def lattice_light(strength=1.0, seed=0):
    """Bands behind the upper and the lower half of a superpixel; neighbours' light comes from their
    near points and falls on the near pixels.
    """
    rng = np.random.default_rng(seed)
    y, x = (np.indices((SIDE, SIDE)).reshape(2, -1) + 0.5) / SIDE - 0.5
    py, px = (np.indices((POINTS, POINTS)).reshape(2, -1) + 0.5) / POINTS - 0.5
    light = np.zeros((len(OFFSETS), PIXELS, POINTS**2, BANDS))
    for k, (down, across) in enumerate(OFFSETS):
        for band in range(BANDS):
            cell = np.where((y > 0) == (band == 1), 1.0, 0.05)
            if down or across:
                far = np.exp(8 * (y * -down + x * -across))[:, None]
                near = np.exp(6 * (py * down + px * across))[None]
                part = (cell[:, None] + 0.3) * far * near
                share = strength * (0.002 if down and across else 0.02)
                light[k, :, :, band] = share * part * PIXELS * POINTS**2 / 2 / part.sum()
            else:
                light[k, :, :, band] = cell[:, None] * rng.uniform(0.8, 1.2, (1, POINTS**2))
    light *= 3000 / POINTS**2
    changes = np.where((OFFSETS != 0).any(axis=1)[:, None, None, None], 0.5 * light, 0)[None]
    return NeighbourLight(offsets=OFFSETS, light=light, changes=changes, camera=None)


def seen(light, points):
    """Superpixels by a loop over lenslets; points (rows, columns, point, band), mirrored beyond."""
    rows, columns = points.shape[:2]
    picture = points.reshape(rows, columns, POINTS, POINTS, BANDS).swapaxes(1, 2)
    picture = picture.reshape(rows * POINTS, columns * POINTS, BANDS)
    picture = np.pad(picture, [(POINTS, POINTS)] * 2 + [(0, 0)], mode="symmetric")
    out = np.zeros((rows, columns, PIXELS))
    for row in range(rows):
        for column in range(columns):
            for (down, across), block in zip(light.offsets, light.light):
                top, left = (row + 1 - down) * POINTS, (column + 1 - across) * POINTS
                part = picture[top : top + POINTS, left : left + POINTS].reshape(-1, BANDS)
                out[row, column] += np.einsum("pqk,qk->p", block, part)
    return out


def capture(light, points, seed=1, noise=True):
    response = light.light.sum(axis=(0, 2))
    mean = seen(light, points)
    rng = np.random.default_rng(seed)
    values = mean + noise * rng.normal(0, np.sqrt(NOISE.variance(mean)))
    start = values @ np.linalg.pinv(response).T
    return LatticeCapture(
        values=values.astype(np.float32),
        response=response,
        own=None,
        response_variance=None,
        noise=NOISE,
        start=start,
    )


def each_its_own(shape, seed=2):
    """Every lenslet another radiance, the same at all its points."""
    b = np.random.default_rng(seed).uniform(0.05, 0.9, (*shape, 1, BANDS))
    return np.repeat(b, POINTS**2, axis=2)


def dense(system, blocks):
    """A on the periodic padded lattice, all lenslets' pixels by all lenslets' unknowns."""
    rows, columns = system.padded
    A = np.zeros((rows, columns, PIXELS, rows, columns, blocks.shape[-1]))
    for row in range(rows):
        for column in range(columns):
            for (down, across), block in zip(OFFSETS, blocks):
                A[row, column, :, (row - down) % rows, (column - across) % columns] += block
    return A.reshape(rows * columns * PIXELS, -1)


@pytest.mark.parametrize("points", [1, POINTS])
def test_one_solve_a_frequency_is_the_dense_solution(points):
    light = lattice_light()
    blocks = light.light.sum(axis=2) if points == 1 else light.light.reshape(9, PIXELS, -1)
    variance = np.random.default_rng(5).uniform(200, 900, PIXELS)
    prior = PointPrior(mean=np.full(BANDS, 0.4), inverse=np.diag([30.0, 50.0]), rho=0.6, points=3)
    system = LatticeSystem(blocks, OFFSETS, variance, (2, 1), None if points == 1 else prior)
    A = dense(system, blocks)
    lenslets = int(np.prod(system.padded))
    weighted = A / np.tile(variance, lenslets)[:, None]
    normal = A.T @ weighted
    rng = np.random.default_rng(6)
    b = rng.uniform(0, 1, (*system.padded, blocks.shape[-1]))
    values = rng.normal(0, 300, (2, 1, PIXELS))
    whole = np.zeros((*system.padded, PIXELS))
    whole[PAD : PAD + 2, PAD : PAD + 1] = values
    right = (whole.ravel() @ weighted).reshape(b.shape)
    found, faint = system.back(system.directions(values)), 2e-4 * np.abs(right).max()
    np.testing.assert_allclose(found, right, rtol=1e-3, atol=faint)
    ours = (A @ b.ravel()).reshape(*system.padded, PIXELS)
    np.testing.assert_allclose(system.forward(b), system.inner(ours), rtol=1e-4)
    if points > 1:
        unit = np.eye(b.size).reshape(b.size, *b.shape)
        pulls = [prior.pull(one) - prior.pull(np.zeros(b.shape)) for one in unit]
        normal = normal - np.array(pulls).reshape(b.size, b.size).T
    expected = np.linalg.solve(normal, right.ravel()).reshape(b.shape)
    np.testing.assert_allclose(system.solve(right), expected, atol=2e-4 * np.abs(expected).max())


def test_the_prior_is_an_exponential_correlation_of_points():
    """On a ring that is long beside it; the two forms of the precision agree."""
    prior = PointPrior(mean=np.zeros(1), inverse=np.array([[4.0]]), rho=0.5, points=3)
    system = (8, 8)
    unit = np.zeros((*system, 9))
    unit[4, 4, 4] = 1
    frequency = 2 * np.pi * np.fft.fftfreq(8)
    precision = prior.precision(frequency, frequency)
    covariance = np.fft.ifft2(np.linalg.inv(precision)[..., 4], axes=(0, 1)).real
    middle = [
        [(3 * r + i - 1, 3 * c + j - 1) for i, j in np.ndindex(3, 3)]
        for r, c in [(0, 0), (0, 1), (1, 1)]
    ]
    for place, lags in zip([(0, 0), (0, 1), (1, 1)], middle):
        expected = [0.25 * 0.5 ** (abs(i) + abs(j)) for i, j in lags]
        np.testing.assert_allclose(covariance[place], expected, rtol=2e-3)
    applied = np.einsum("rcij,rcj->rci", precision, np.fft.fft2(unit, axes=(0, 1)))
    np.testing.assert_allclose(
        prior.pull(unit), -np.fft.ifft2(applied, axes=(0, 1)).real, atol=1e-5
    )


def test_coupled_recovers_what_neighbours_hide_and_states_its_errors():
    light, truth = lattice_light(), each_its_own((40, 40))
    shot = capture(light, truth)
    found = coupled(shot, light)
    error = found.value - truth[:, :, 0]
    alone = shot.start - truth[:, :, 0]
    assert np.sqrt((error**2).mean()) < 0.2 * np.sqrt((alone**2).mean())
    assert np.sqrt(((error / found.sigma) ** 2).mean()) == pytest.approx(1, abs=0.1)
    for k in range(BANDS):  # dark and bright fifths
        for part in np.array_split(np.argsort(truth[:, :, 0, k].ravel()), 5):
            z = (error / found.sigma)[..., k].ravel()[part]
            assert np.sqrt((z**2).mean()) == pytest.approx(1, abs=0.2)
    assert found.misfit == pytest.approx(1, abs=0.05)


def test_noiseless_values_come_back_to_the_border():
    light, truth = lattice_light(), each_its_own((5, 7))
    found = coupled(capture(light, truth, noise=False), light, fit=False)
    np.testing.assert_allclose(found.value, truth[:, :, 0], atol=1e-3)


@pytest.mark.parametrize("strength", [0.6, 1.3])
def test_the_size_of_neighbours_light_is_fitted(strength):
    truth, assumed = each_its_own((20, 20)), lattice_light()
    real = lattice_light(strength)
    shot = capture(real, truth)
    fitted, not_fitted = (coupled(shot, assumed, fit) for fit in (True, False))
    error, worse = ((one.value - truth[:, :, 0]).std() for one in (fitted, not_fitted))
    assert error < 0.5 * worse
    total = fitted.light.light[assumed.own != np.arange(9)].sum()
    assert total == pytest.approx(real.light[assumed.own != np.arange(9)].sum(), rel=0.05)


def test_edges_inside_fields_are_told_by_points_and_by_the_evidence():
    light, rng = lattice_light(2.0), np.random.default_rng(8)
    patches = rng.uniform(0.05, 0.9, (9, 9, BANDS))
    r, c = ((np.arange(24 * POINTS) + 4) // 8 for _ in range(2))
    picture = patches[r % 9][:, c % 9].reshape(24, POINTS, 24, POINTS, BANDS).swapaxes(1, 2)
    for truth, edges in (
        (picture.reshape(24, 24, -1, BANDS), True),
        (each_its_own((24, 24)), False),
    ):
        shot = capture(light, truth)
        one = coupled(shot, light)
        many = fine(shot, one)
        mean = truth.mean(axis=2)
        errors = [np.sqrt(((found.value - mean) ** 2).mean()) for found in (one, many)]
        assert more_likely(shot, one, many) == edges, errors
        assert (errors[1] < errors[0]) == edges, errors
        z = (many.value - mean) / many.sigma
        assert 0.5 < np.sqrt((z**2).mean()) < 1.5


def test_lost_pixels_take_nothing_from_the_others():
    light, truth = lattice_light(), each_its_own((12, 12))
    whole = capture(light, truth)
    values = whole.values.copy()
    rng = np.random.default_rng(9)
    values[rng.integers(12, size=40), rng.integers(12, size=40), rng.integers(36, size=40)] = np.nan
    broken = LatticeCapture(**{**vars(whole), "values": values})
    full, found = coupled(whole, light), coupled(broken, light)
    touched = np.isnan(values).any(axis=-1)
    apart = np.abs(found.value - full.value) / full.sigma
    assert np.isfinite(found.value).all() and apart[~touched].max() < 0.3
    assert apart[touched].max() < 2
    error = (found.value - truth[:, :, 0]) / found.sigma
    assert np.sqrt((error[touched] ** 2).mean()) < 1.4
    assert found.sigma[touched].mean() > full.sigma[touched].mean()


def test_blocks_keep_the_measured_sum():
    light = lattice_light()
    response = light.light.sum(axis=(0, 2)) * np.random.default_rng(3).uniform(0.8, 1.25, (36, 1))
    response[5] = np.nan
    np.testing.assert_allclose(
        light.coupled(response).sum(axis=0), np.nan_to_num(response), atol=1e-6
    )
    points = light.fine(response).sum(axis=(0, 2))
    known = np.isfinite(response).all(axis=1)
    np.testing.assert_allclose(points[known], response[known], rtol=1e-9)
    for change in light.coupled_changes():
        np.testing.assert_allclose(change.sum(axis=0), 0, atol=1e-9)
    assert light.moved(np.zeros(2), calibration=None) is light
