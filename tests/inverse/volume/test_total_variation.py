"""Least total variation against a primal-dual solver of the same problem in dense matrices."""

import tracemalloc

import numpy as np
import pytest

from plenocli.base.budget import Budget, within
from plenocli.base.errors import NumericsError
from plenocli.base.linear_maps import BlockCirculant
from plenocli.inverse.volume.measurement import Measurement, Problem, Voxels
from plenocli.inverse.volume.total_variation import (
    Surfaces,
    _one_way,
    back_differences,
    differences,
    least_variation,
    memory,
    shrunk,
    surfaces_of,
    total_variation,
)
from tests.reference import volumes

VOXELS = Voxels((2, 2), 1e-6, (-1e-6, 1e-6))
ALONG = np.array([0.5])
"""Pitch of the voxels over the distance of the planes."""
COUNT, TORUS = (3, 4), (4, 5)


def box(count=COUNT, torus=TORUS, noise=0.03, hold_out=0.0, dtype=float, pixels=9):
    """A specimen of even parts, and what is seen of it."""
    rng = np.random.default_rng(0)
    parts = [(b.astype(dtype), o) for b, o in volumes.kernels(2, 4, pixels)]
    op = BlockCirculant(parts, count, torus)
    truth = np.zeros((2, torus[0] * 2, torus[1] * 2), dtype)
    truth[0, 2:5, 3:7], truth[1, 1:4, 1:3] = 1, 0.7
    light = op.forward(VOXELS.lenslets(truth))
    signal = light + noise * rng.standard_normal(light.shape)
    usable = rng.random(light.shape) > 0.1
    measurement = Measurement(signal=np.where(usable, signal, np.nan), read_variance=noise**2)
    return Problem(op, measurement, VOXELS, hold_out=hold_out), truth


def gradients():
    """(plane, row, column differences) as dense matrices of the map's unknowns."""
    count = int(np.prod(TORUS)) * 8
    columns = [differences(VOXELS.picture(one.reshape(*TORUS, 8)), ALONG) for one in np.eye(count)]
    return [np.array([c[axis].ravel() for c in columns]).T for axis in range(3)]


def dense_terms(problem, strength):
    a = volumes.matrix(volumes.kernels(2, 4, 9), COUNT, TORUS)
    everywhere = volumes.matrix(volumes.kernels(2, 4, 9), TORUS, TORUS)
    unit = np.sqrt(np.mean(np.sum(everywhere**2, axis=0)))
    at = problem.counts.ravel()
    y = problem.signal.ravel()[at]
    return a[at] / unit, y / unit, strength * np.sqrt(np.mean(y**2)) / unit


def lengths(v):
    deep, down, right = v
    square = down**2 + right**2
    square[: len(deep)] += deep**2
    return np.sqrt(square)


def isotropic(monkeypatch):
    """No surfaces are seen: the problem is that of the primal-dual solver."""
    nowhere = lambda x, along, down: Surfaces((x, x, x), np.zeros_like(x))
    monkeypatch.setattr("plenocli.inverse.volume.total_variation.surfaces_of", nowhere)


def cost(x, a, y, weight, steps, others=(0, 0, 0)):
    varies = [d @ x - o for d, o in zip(steps, others)]
    return 0.5 * np.sum((a @ x - y) ** 2) + weight * lengths(varies).sum()


def primal_dual(a, y, weight, steps, others=None, rounds=5000):
    """Chambolle and Pock 2011; others: differences that count for none."""
    d = np.concatenate(steps)
    shift = np.zeros(len(d)) if others is None else np.concatenate(others)
    norm = np.linalg.norm(np.concatenate([a, d]), 2)
    tau = sigma = 0.99 / norm
    x = ahead = np.zeros(a.shape[1])
    p, q = np.zeros(len(y)), np.zeros(len(d))
    splits = np.cumsum([len(s) for s in steps])[:-1]
    for _ in range(rounds):
        p = (p + sigma * (a @ ahead - y)) / (1 + sigma)
        q = q + sigma * (d @ ahead - shift)
        parts = np.split(q, splits)
        long = np.maximum(lengths(parts) / weight, 1)
        q = np.concatenate([parts[0] / long[: len(parts[0])], parts[1] / long, parts[2] / long])
        new = np.maximum(x - tau * (a.T @ p + d.T @ q), 0)
        x, ahead = new, 2 * new - x
    return x


@pytest.mark.parametrize("strength", [0.02, 0.2])
def test_it_is_the_least(strength, monkeypatch):
    isotropic(monkeypatch)
    problem, _ = box()
    volume = total_variation(problem, (strength,), 600)
    terms = (*dense_terms(problem, strength), gradients())
    expected = primal_dual(*terms)
    inner = problem.inside(expected.reshape(problem.op.domain.shape))
    least = cost(expected, *terms)
    assert cost(1.02 * expected, *terms) > least < cost(0.98 * expected, *terms)
    np.testing.assert_allclose(volume.value, inner, atol=5e-3 * inner.max())
    assert np.all(volume.value >= 0) and volume.method == "tv"


def differences_of(picture, inside):
    """Between voxels that are both among the first rows and columns `inside`, one by one, in the
    order of `gradients`; 0 elsewhere.
    """
    planes, rows, columns = picture.shape
    found = [np.zeros((planes - 1, rows, columns)), *np.zeros((2, *picture.shape))]
    for plane, row, column in np.ndindex(planes, *inside):
        here = picture[plane, row, column]
        if plane + 1 < planes:
            found[0][plane, row, column] = ALONG[plane] * (picture[plane + 1, row, column] - here)
        if row + 1 < inside[0]:
            found[1][plane, row, column] = picture[plane, row + 1, column] - here
        if column + 1 < inside[1]:
            found[2][plane, row, column] = picture[plane, row, column + 1] - here
    return [part.ravel() for part in found]


def test_it_is_the_least_beside_another_volume(monkeypatch):
    """What is not f times the other varies least, over f as well, at a strength as much higher as
    what was found without it varied less; the other is known before the lenslets alone.
    """
    isotropic(monkeypatch)
    problem, truth = box()
    like = truth[:, :6, :8] + 0.02 * np.random.default_rng(6).random((2, 6, 8))
    alone = total_variation(problem, (0.1,), 600)
    share = least_variation(alone.value, like, ALONG, 1.0)[1]
    assert 0.2 < share < 0.95
    volume = total_variation(problem, (0.1,), 600, like=like)
    factor = volume.likeness.factor
    terms = (*dense_terms(problem, 0.1 / (1 - share)), gradients())
    others = differences_of(np.pad(like, ((0, 0), (0, 2), (0, 2))), (6, 8))
    expected = primal_dual(*terms, [factor * o for o in others])
    inner = problem.inside(expected.reshape(problem.op.domain.shape))
    np.testing.assert_allclose(volume.value, inner, atol=5e-3 * inner.max())

    def least(f):
        f_others = [f * o for o in others]
        return cost(primal_dual(*terms, f_others), *terms, f_others)

    assert least(1.1 * factor) > least(factor) < least(0.9 * factor)


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
def test_the_factor_is_that_of_the_least_variation(scale):
    """Against all factors in turn, whatever the other's unit."""
    rng = np.random.default_rng(7)
    other = rng.random((3, 8, 9)) > 0.7
    x = 0.8 * other + 0.3 * (rng.random((3, 8, 9)) > 0.8)
    along = np.array([0.5, 1.0])

    def variation(f):
        deep, down, right = (np.diff(x - f * other, axis=axis) for axis in range(3))
        square = np.zeros(x.shape)
        square[:-1] += (along[:, None, None] * deep) ** 2
        square[:, :-1] += down**2
        square[:, :, :-1] += right**2
        return np.sqrt(square).sum()

    tried = np.linspace(0, 2, 4001)
    all_of_them = [variation(f) for f in tried]
    factor, share = least_variation(x, scale * other, along, 1.0)
    assert scale * factor == pytest.approx(tried[np.argmin(all_of_them)], abs=2e-3)
    assert share == pytest.approx(1 - min(all_of_them) / variation(0), abs=1e-4)
    for nothing in (np.zeros_like(x), np.ones_like(x)):
        assert least_variation(x, nothing, along, 1.0) == (0, 0)
        assert least_variation(nothing, x, along, 1.0) == (0, 0)


def test_differences_and_their_adjoint():
    rng = np.random.default_rng(1)
    x = rng.standard_normal((3, 6, 8))
    along = np.array([0.3, 2.0])
    v = tuple(rng.standard_normal(part.shape) for part in differences(x, along))
    forward = sum(np.sum(a * b) for a, b in zip(differences(x, along), v))
    assert forward == pytest.approx(np.sum(x * back_differences(v, along)), rel=1e-12)


def test_shrinking_takes_the_same_length_off_everywhere():
    v = differences(np.random.default_rng(2).standard_normal((3, 6, 8)), np.ones(2))
    before, after = lengths(v), lengths(shrunk(v, np.float64(0.5)))
    np.testing.assert_allclose(after, np.maximum(before - 0.5, 0), atol=1e-12)


def test_across_a_surface_less_is_taken_off_and_along_it_more():
    """Against vectors turned so that the first axis is the normal, one voxel at a time."""
    rng = np.random.default_rng(3)
    v = differences(rng.standard_normal((3, 6, 8)), np.ones(2))
    normal = rng.standard_normal((3, 3, 6, 8))
    normal /= np.linalg.norm(normal, axis=0)
    free = rng.choice([0, 0.4, 1], (3, 6, 8))
    found = shrunk(v, np.float64(0.5), Surfaces(tuple(normal), free))
    for place in np.ndindex(2, 6, 8):
        vector, n, f = np.array([part[place] for part in v]), normal[(..., *place)], free[place]
        frame = np.linalg.svd(n[None])[2]
        across, *along = frame @ vector
        across *= max(1 - 0.5 * (1 - f) / abs(across), 0)
        along = np.array(along) * max(1 - 0.5 * (1 + f) / np.linalg.norm(along), 0)
        even = vector * max(1 - 0.5 / np.linalg.norm(vector), 0)
        expected = f * (frame.T @ [across, *along]) + (1 - f) * even
        np.testing.assert_allclose([part[place] for part in found], expected, atol=1e-12)


@pytest.mark.parametrize("spacing", [1.0, 2.0])
def test_surfaces_are_where_a_volume_changes_one_way(spacing):
    """An edge aslant has its own normal and is free, a bead is not; planes may lie further apart
    than voxels.
    """
    deep, down, right = np.indices((15, 24, 24)) - np.array([7, 12, 12])[:, None, None, None]
    deep = deep * spacing
    normal = np.array([0.4, 0.6, np.sqrt(1 - 0.52)])
    along, middle = np.full(14, 1 / spacing), (slice(5, 10), slice(9, 16), slice(9, 16))
    edge = np.tanh(normal[0] * deep + normal[1] * down + normal[2] * right)
    seen = surfaces_of(edge, along, 1.0)
    cosine = np.abs(np.tensordot(normal, np.array(seen.normal), 1))[middle]
    assert cosine.min() > 0.98 and seen.free[middle].min() > 0.9
    bead = np.exp(-(deep**2 + down**2 + right**2) / 8)
    assert surfaces_of(bead, along, 1.0).free[7, 12, 12] < 0.3


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_the_greatest_eigenvector_is_that_of_lapack(scale):
    """Of random matrices, of rank one or nearly, of equal eigenvalues, diagonal, and of nothing."""
    rng = np.random.default_rng(11)
    vectors = np.linalg.qr(rng.standard_normal((4000, 3, 3)))[0]
    values = rng.random((4000, 3)) ** rng.choice([1, 4, 30], (4000, 1))
    values[:200, 1:] = 0
    values[200:400, 1] = values[200:400, 0]
    values[400:500] = 0.3
    vectors[500:700] = np.eye(3)[rng.permutation(3)]
    values[700] = 0
    matrices = scale * np.einsum("nij,nj,nkj->nik", vectors, values, vectors)
    upper = {(i, j): matrices[:, i, j] for i, j in zip(*np.triu_indices(3))}
    normal, free = _one_way(upper)
    expected, axes = np.linalg.eigh(matrices / scale)
    ratio = np.maximum(expected[:, 1], 0) / np.maximum(expected[:, 2], 1e-300)
    np.testing.assert_allclose(free[:700], np.maximum(1 - 2 * ratio, 0)[:700], atol=1e-7)
    matters = free > 1e-3
    matters[700] = False
    cosine = np.abs(np.sum(normal.T * axes[:, :, 2], axis=1))
    assert matters.sum() > 1500 and cosine[matters].min() > 1 - 1e-12
    assert np.isfinite(normal).all() and np.isfinite(free).all()


def test_a_sheet_aslant_is_found_better(monkeypatch):
    """A sheet through both planes, with and without surfaces."""
    rng = np.random.default_rng(5)
    parts = [(b, o) for b, o in volumes.kernels(2, 4, 25)]
    op = BlockCirculant(parts, (8, 8), (10, 10))
    down, right = np.indices((20, 20))
    sheet = np.abs(0.6 * down + 0.8 * right - 14) < 3
    truth = np.array([sheet, np.roll(sheet, 2, axis=1)], float)
    light = op.forward(VOXELS.lenslets(truth))
    measurement = Measurement(
        signal=light + 0.05 * rng.standard_normal(light.shape), read_variance=0.0025
    )
    problem = Problem(op, measurement, VOXELS, hold_out=0.1)

    def error():
        found = total_variation(problem).value
        return np.linalg.norm(found - truth[:, :16, :16])

    steep = error()
    isotropic(monkeypatch)
    assert steep < 0.96 * error()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_strength_is_chosen_by_held_out_pixels(dtype):
    problem, truth = box((6, 6), (8, 8), noise=0.02, hold_out=0.1, dtype=dtype, pixels=25)
    volume = total_variation(problem)
    tried = [trial.misfit for trial in volume.trace[:-1]]
    assert np.all(np.diff(tried[:-1]) < 0) and tried[-1] > 0.99 * tried[-2]
    assert volume.trace[-1].what.startswith(volume.trace[-3].what)
    assert volume.value.dtype == dtype
    error = volume.value - truth[:, :12, :12]
    assert np.linalg.norm(error) < 0.3 * np.linalg.norm(truth)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("tied", [False, True])
def test_it_takes_the_memory_that_it_asks_for(dtype, tied):
    rng = np.random.default_rng(9)
    planes, count, torus = 6, (24, 24), (26, 26)
    kernels = rng.random((1, 40, 4 * planes)).astype(dtype)
    op = BlockCirculant([(kernels, np.zeros((1, 2), int))], count, torus)
    voxels = Voxels((2, 2), 1e-6, tuple(1e-6 * np.arange(planes)))
    measurement = Measurement(signal=rng.random((*count, 40)).astype(dtype), read_variance=1e-2)
    problem = Problem(op, measurement, voxels)
    like = total_variation(problem).value  # what is imported is not counted
    tracemalloc.start()
    total_variation(problem, like=like if tied else None)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    asked = memory(torus, 40, 4 * planes, np.dtype(dtype).itemsize)
    assert 0.7 * asked < peak < 1.1 * asked


def test_memory_is_asked_for():
    problem, _ = box()
    with within(Budget(1 << 10)), pytest.raises(NumericsError, match="mem-limit"):
        total_variation(problem)
