"""Lenslets solved together, against dense least squares on small arrays and against statistics."""

import numpy as np
import pytest

from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.spectra import lattice_system
from plenocli.inverse.spectra.coupled import PART, STEPPED, LatticeCapture, coupled, fine, likeliest
from plenocli.inverse.spectra.field_modes import FieldModes, field_modes
from plenocli.inverse.spectra.lattice_system import UNTOLD, LatticeSystem, PointPrior
from plenocli.inverse.spectra.neighbours import NeighbourLight, _further

BANDS, SIDE, POINTS = 2, 6, 3
PIXELS = SIDE**2
NOISE = Noise(gain=0.4, read_variance=2.0)
ALL = FieldModes(
    weights=np.eye(POINTS), shapes=np.eye(POINTS), kept=np.array(list(np.ndindex(POINTS, POINTS)))
)
"""Every point a mode of its own."""
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
    return NeighbourLight(offsets=OFFSETS, light=light, changes=changes, modes=ALL, camera=None)


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


def dense(shape, blocks):
    """A on a periodic lattice, all lenslets' pixels by all lenslets' unknowns."""
    rows, columns = shape
    A = np.zeros((rows, columns, PIXELS, rows, columns, blocks.shape[-1]))
    for row in range(rows):
        for column in range(columns):
            for (down, across), block in zip(OFFSETS, blocks):
                A[row, column, :, (row - down) % rows, (column - across) % columns] += block
    return A.reshape(rows * columns * PIXELS, -1)


def along_the_ring(prior, shape):
    """Precision of all points of a periodic lattice: that of a first-order chain along each axis,
    whose bend is (1 + r r, -r)/(1 - r r).
    """
    axes = []
    for count in shape:
        r, size = prior.rho ** (1 / POINTS), count * POINTS
        chain = (1 + r * r) * np.eye(size)
        for k in range(size):
            chain[k, (k + 1) % size] -= r
            chain[(k + 1) % size, k] -= r
        axes.append(chain / (1 - r * r))
    down, across = (one.reshape(n, POINTS, n, POINTS) for one, n in zip(axes, shape))
    whole = np.einsum("aibj,ckdl,uv->acikubdjlv", down, across, prior.inverse)
    size = int(np.prod(shape)) * POINTS**2 * len(prior.mean)
    return whole.reshape(size, size)


@pytest.mark.parametrize("points", [1, POINTS])
def test_one_solve_a_frequency_is_the_dense_solution(points, monkeypatch):
    """On a ring of which all but two lenslets see nothing but the mean."""
    monkeypatch.setattr(lattice_system, "PAD", 4)
    light = lattice_light()
    blocks = light.light.sum(axis=2) if points == 1 else light.light.reshape(9, PIXELS, -1)
    variance = np.random.default_rng(5).uniform(200, 900, PIXELS)
    prior = PointPrior(mean=np.full(BANDS, 0.4), inverse=np.diag([30.0, 50.0]), rho=0.6, modes=ALL)
    system = LatticeSystem(blocks, OFFSETS, variance, (2, 1), None if points == 1 else prior)
    assert system.tile == (10, 9)
    A = dense(system.tile, blocks)
    weighted = A / np.tile(variance, 90)[:, None]
    normal = A.T @ weighted
    if points > 1:
        normal = normal + along_the_ring(prior, system.tile)
    values = np.random.default_rng(6).normal(0, 300, (2, 1, PIXELS))
    whole = np.zeros((*system.tile, PIXELS))
    whole[4:6, 4:5] = values
    expected = np.linalg.solve(normal, whole.ravel() @ weighted).reshape(*system.tile, -1)[4:6, 4:5]
    apart = np.abs(system.answered(values) - expected)
    faint = 2e-4 * np.abs(expected).max()
    # what tells next to nothing of the prior's spread is not looked at
    assert apart.max() < (faint if points == 1 else 3 * np.sqrt(UNTOLD) * prior.spread.max())


@pytest.mark.parametrize("shape", [(7, 5), (30, 9)])
def test_superpixels_come_back_to_the_border_whatever_the_tiles(shape, monkeypatch):
    """Of noiseless superpixels of mirrored lenslets, by a loop; tiles do not show."""
    light, rng = lattice_light(), np.random.default_rng(12)
    blocks = light.light.reshape(9, PIXELS, -1)
    points = rng.uniform(0.1, 0.8, (*shape, POINTS**2, BANDS))
    values, variance = seen(light, points), rng.uniform(200, 900, PIXELS)
    prior = PointPrior(mean=np.full(BANDS, 0.4), inverse=np.diag([30.0, 50.0]), rho=0.6, modes=ALL)
    system = LatticeSystem(blocks, OFFSETS, variance, shape, prior)
    np.testing.assert_allclose(system.forward(points.reshape(*shape, -1)), values, rtol=1e-5)
    first = np.full((*shape, POINTS**2 * BANDS), 0.4)
    found = system.solved(values, first)
    monkeypatch.setattr(lattice_system, "TILE", 8)
    tiled = LatticeSystem(blocks, OFFSETS, variance, shape, prior).solved(values, first)
    scale = np.sqrt(system.impulse[2])
    assert (np.abs(system.mean(tiled - found)) / scale).max() < 0.2
    left = (values - system.forward(found)) / np.sqrt(variance)
    away = (values - values.mean(axis=(0, 1))) / np.sqrt(variance)
    assert np.sqrt((away**2).mean()) > 9
    for part in (left, left[0], left[:, -1]):  # the prior pulls by less than the noise
        assert np.sqrt((part**2).mean()) < 0.5


def test_evidence_counts_the_distance_from_the_prior_of_mirrored_lenslets():
    """Against the precision of all points of a ring of the lenslets and their mirror images."""
    rows, columns = shape = (4, 3)
    prior = PointPrior(mean=np.full(BANDS, 0.4), inverse=np.diag([30.0, 50.0]), rho=0.6, modes=ALL)
    blocks = lattice_light().light.reshape(9, PIXELS, -1)
    system = LatticeSystem(blocks, OFFSETS, np.full(PIXELS, 400.0), shape, prior)
    points = np.random.default_rng(13).uniform(0.1, 0.8, (rows, columns, POINTS**2, BANDS))
    picture = points.reshape(rows, columns, POINTS, POINTS, BANDS).swapaxes(1, 2)
    picture = picture.reshape(rows * POINTS, columns * POINTS, BANDS) - 0.4
    for axis in (0, 1):
        picture = np.concatenate([picture, np.flip(picture, axis)], axis=axis)
    ring = picture.reshape(2 * rows, POINTS, 2 * columns, POINTS, BANDS).swapaxes(1, 2).ravel()
    expected = ring @ along_the_ring(prior, (2 * rows, 2 * columns)) @ ring / 4
    left, even = np.zeros((*shape, PIXELS)), np.full((*shape, POINTS**2 * BANDS), 0.4)
    found, none = (system.surprise(left, 1.0, b) for b in (points.reshape(*shape, -1), even))
    assert (found - none) * rows * columns == pytest.approx(expected, rel=1e-4)
    # and that of what is left over, of unit variance, is its count
    left = np.random.default_rng(14).normal(0, 3, (*shape, PIXELS))
    assert system.surprise(left, 3.0, even) - none == pytest.approx((left**2).sum() / 9 / 12)


def test_the_prior_is_an_exponential_correlation_of_points():
    """On a ring that is long beside it; the two forms of the precision agree."""
    prior = PointPrior(mean=np.zeros(1), inverse=np.array([[4.0]]), rho=0.5**3, modes=ALL)
    frequency = 2 * np.pi * np.fft.fftfreq(8)
    precision = prior.precision(frequency, frequency) * prior.inverse[0, 0]
    covariance = np.fft.ifft2(np.linalg.inv(precision)[..., 4], axes=(0, 1)).real
    middle = [
        [(3 * r + i - 1, 3 * c + j - 1) for i, j in np.ndindex(3, 3)]
        for r, c in [(0, 0), (0, 1), (1, 1)]
    ]
    for place, lags in zip([(0, 0), (0, 1), (1, 1)], middle):
        expected = [0.25 * 0.5 ** (abs(i) + abs(j)) for i, j in lags]
        np.testing.assert_allclose(covariance[place], expected, rtol=2e-3)


def test_what_steps_at_borders_is_even_within_fields_and_alike_beyond():
    """Along an axis of lenslets; across it points go on changing."""
    r = 0.4
    prior = PointPrior(
        mean=np.zeros(1), inverse=np.array([[1.0]]), rho=r, modes=ALL, stepped=(0.9, 0.0)
    )
    frequency = 2 * np.pi * np.fft.fftfreq(16)
    precision = prior.precision(frequency, frequency)
    covariance = np.fft.ifft2(np.linalg.inv(precision), axes=(0, 1)).real
    for lenslets in (0, 1, 2):
        for first, second in np.ndindex(POINTS, POINTS):
            down = covariance[lenslets, 0, first * POINTS, second * POINTS]
            apart = abs(lenslets + (first - second) / POINTS)
            assert down == pytest.approx(0.9 * r**lenslets + 0.1 * r**apart, rel=1e-3)
            across = covariance[0, lenslets, first, second]
            assert across == pytest.approx(r**apart, rel=1e-3)
    np.testing.assert_allclose(prior.spread, 1)


def edge_lit(side=9, pixels=12):
    """Light (superpixel, pixel, point, band) of which a rim of the field goes to the neighbour."""
    y, x = (np.indices((side, side)).reshape(2, -1) + 0.5) / side
    light = np.zeros((5, pixels, side**2, 1))
    light[0, :, :, 0] = 1.0
    for k, near in enumerate((y, 1 - y, x, 1 - x)):
        light[k + 1, : 3 + k, :, 0] = np.exp(-near / 0.06)
    return light


def test_modes_foretell_what_a_field_throws_where():
    """Of draws of points, against a singular value decomposition of what superpixels show."""
    light = edge_lit()
    modes, side = field_modes(light), 9
    place = np.arange(side) / side
    axis = 0.5 ** np.abs(place[:, None] - place)
    fields = np.linalg.cholesky(np.kron(axis, axis)) @ np.random.default_rng(4).normal(
        size=(side**2, 500)
    )
    down, across = modes.kept.T
    weights = np.einsum("mi,mj->mij", modes.weights[down], modes.weights[across])
    seen = light[..., 0] / np.sqrt(light.sum(axis=(0, 2, 3)))[:, None]
    seen = seen.reshape(-1, side**2)
    shown, known = seen @ fields, seen @ modes.basis
    left = shown - known @ np.linalg.lstsq(known, shown, rcond=None)[0]
    strengths = np.linalg.svd(shown, compute_uv=False) ** 2
    assert (left**2).sum() < 0.01 * strengths[1:].sum()
    np.testing.assert_allclose(modes.basis @ modes.even, 1, atol=1e-9)  # even fields stay even
    upside, _ = modes.mirrored
    flipped = fields.reshape(side, side, -1)[::-1].reshape(side**2, -1)
    amounts, turned = (weights.reshape(len(weights), -1) @ one for one in (fields, flipped))
    np.testing.assert_allclose(upside @ amounts, turned, atol=1e-8)


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


def test_errors_of_much_neighbours_light_are_not_in_its_proportion(monkeypatch):
    """Of light that is wrong in parts, each by itself, error power goes as the light."""
    truth, wrong = each_its_own((16, 16)), []
    for strength in (4.0, 16.0):
        light = lattice_light(strength)
        share = 1 - light.light[4].sum(axis=(0, 1)) / light.light.sum(axis=(0, 1, 2))
        assert (share > 0.1).all()
        shot = capture(light, truth)
        found = coupled(shot, light, fit=False)
        with monkeypatch.context() as known:
            known.setattr("plenocli.inverse.spectra.coupled.KNOWN_TO", 0.0)
            sure = coupled(shot, light, fit=False)
        changed = ((found.value - shot.start) ** 2).mean(axis=(0, 1))
        more = (found.sigma**2 - sure.sigma**2).mean(axis=(0, 1))
        wrong.append(more / changed * share)
    np.testing.assert_allclose(wrong[1], wrong[0], rtol=1e-6)


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


def squares(down, across, lenslets=24, seed=8):
    """Patches of 8 points a side, their edges by so many points off the lenslets' borders:
    (rows, columns, point, band).
    """
    patches = np.random.default_rng(seed).uniform(0.05, 0.9, (9, 9, BANDS))
    r, c = ((np.arange(lenslets * POINTS) + off) // size for off, size in (down, across))
    picture = patches[r % 9][:, c % 9].reshape(lenslets, POINTS, lenslets, POINTS, BANDS)
    return picture.swapaxes(1, 2).reshape(lenslets, lenslets, -1, BANDS)


@pytest.mark.parametrize("down", [(4, 8), (0, 6)])
@pytest.mark.parametrize("across", [(4, 8), (0, 6)])
def test_edges_inside_fields_are_told_by_points_and_by_the_evidence(down, across):
    """Down, across, both or neither."""
    light, truth = lattice_light(2.0), squares(down, across)
    shot = capture(light, truth)
    one = coupled(shot, light)
    found = likeliest(shot, one, light)
    assert found == tuple(STEPPED * (off == 0) for off, _ in (down, across))
    errors = {}
    for stepped in ((0.0, 0.0), (STEPPED, 0.0), (0.0, STEPPED), (STEPPED, STEPPED)):
        many = fine(shot, one, light, stepped)
        errors[stepped] = np.sqrt(((many.value - truth.mean(axis=2)) ** 2).mean())
        if stepped == found:
            z = (many.value - truth.mean(axis=2)) / many.sigma
            assert 0.6 < np.sqrt((z**2).mean()) < 1.3
    assert errors[found] < 1.02 * min(errors.values())
    assert errors[found] < 0.9 * errors[0.0, 0.0] or found == (0, 0)
    alone = np.sqrt(((one.value - truth.mean(axis=2)) ** 2).mean())
    assert errors[found] < (1.05 if all(found) else 0.9) * alone


def test_the_part_that_is_asked_is_where_lenslets_differ():
    """An even array with edges inside fields in one corner, and one of lenslets of their own."""
    light, truth = lattice_light(2.0), np.full((40, 36, POINTS**2, BANDS), 0.4)
    for corner, stepped in (
        (squares((4, 8), (4, 8), PART), 0.0),
        (each_its_own((PART, PART)), STEPPED),
    ):
        truth[-PART:, -PART:] = corner
        shot = capture(light, truth)
        assert likeliest(shot, coupled(shot, light), light) == (stepped, stepped)


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


@pytest.mark.parametrize("whole", [(0, 0), (1, 0), (0, -1), (-1, 1), (1, 1)])
def test_light_on_pixels_further_is_that_of_a_plane_cut_further(whole):
    """Windows tile a plane, beyond which is nothing; superpixels need not be in order."""
    rows, columns = 4, 5
    light = np.random.default_rng(7).random((9, rows * columns, 2, 3))
    order = np.random.default_rng(8).permutation(9)
    plane = np.zeros((5 * rows, 5 * columns, 2, 3))
    for (i, j), own in zip(OFFSETS, light):
        top, left = (2 + i) * rows, (2 + j) * columns
        plane[top : top + rows, left : left + columns] = own.reshape(rows, columns, 2, 3)
    found = _further(light[order], OFFSETS[order], whole, (rows, columns))
    for (i, j), own in zip(OFFSETS[order], found):
        top, left = (2 + i) * rows + whole[0], (2 + j) * columns + whole[1]
        wanted = plane[top : top + rows, left : left + columns]
        assert np.array_equal(own.reshape(rows, columns, 2, 3), wanted)
