"""Kernels on arrays of other libraries against NumPy's."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from plenocli.base.device import CPU, Device, device
from plenocli.base.errors import UsageError
from plenocli.base.linear_maps import BlockCirculant, times, times_adjoint
from plenocli.base.tiling import to_blocks
from plenocli.forward.propagation.exact.low_rank_product import Product
from plenocli.forward.propagation.fresnel.separable_fields import Factors
from plenocli.inverse.picture.solvers import block_matching, whole_sensor
from plenocli.inverse.picture.solvers.least_squares import decompose
from plenocli.inverse.volume.lmmse import lmmse
from plenocli.inverse.volume.measurement import Measurement, Problem, Voxels
from plenocli.inverse.volume.richardson_lucy import richardson_lucy
from plenocli.inverse.volume.total_variation import total_variation
from tests.reference import volumes

COUNT, TORUS = (6, 7), (8, 9)


@pytest.fixture(scope="module", params=["array_api_strict", "torch"])
def other(request):
    """A device that is none of NumPy's, in the processor."""
    library = pytest.importorskip(request.param)
    if request.param == "array_api_strict":
        pytest.importorskip("array_api_compat")
        return Device("another", library)
    return Device("another", pytest.importorskip("array_api_compat.torch"), "cpu")


@pytest.mark.parametrize("kind, within", [(np.float32, 1e-5), (float, 1e-13)])
def test_a_map_is_the_same_elsewhere(other, kind, within):
    parts = [(blocks.astype(kind), offsets) for blocks, offsets in volumes.kernels(2, 4, 9)]
    here, there = (BlockCirculant(parts, COUNT, TORUS, where) for where in (CPU, other))
    rng = np.random.default_rng(1)
    x, y = (rng.standard_normal(space.shape) for space in (here.domain, here.range))
    for one, two in ((here.forward(x), there.forward(x)), (here.adjoint(y), there.adjoint(y))):
        assert two.dtype == one.dtype == kind
        assert np.abs(one - two).max() <= within * np.abs(one).max()
    matrices = rng.standard_normal((3, 4, 5)) + 1j * rng.standard_normal((3, 4, 5))
    u, v = rng.standard_normal((3, 5)) + 0j, 1j * rng.standard_normal((3, 4))
    for product, of in ((times, u), (times_adjoint, v)):
        found = other.get(product(other.put(matrices), other.put(of)))
        np.testing.assert_allclose(found, product(matrices, of), atol=1e-13)


@pytest.mark.parametrize("method", [richardson_lucy, lmmse, total_variation])
def test_volumes_are_the_same_elsewhere(other, method):
    parts = [(b.astype(np.float32), o) for b, o in volumes.kernels(2, 4, 9)]
    truth = np.random.default_rng(2).gamma(1, 1, (*TORUS, 8)).astype(np.float32)
    light = BlockCirculant(parts, COUNT, TORUS).forward(truth)
    noise = 0.01 * np.random.default_rng(3).standard_normal(light.shape).astype(np.float32)
    measurement = Measurement(signal=light + noise, read_variance=1e-4)
    voxels = Voxels(point_shape=(2, 2), pitch=1e-6, depths=(0.0, 2e-6))
    one, two = (
        method(Problem(BlockCirculant(parts, COUNT, TORUS, where), measurement, voxels, 0.1)).value
        for where in (CPU, other)
    )
    assert np.abs(one - two).max() < 1e-4 * np.abs(one).max()


@pytest.mark.parametrize("symmetric", [False, True])
def test_a_product_is_compressed_elsewhere(other, symmetric):
    rng = np.random.default_rng(9)
    left, right = rng.normal(size=(2, 300, 90)) + 1j * rng.normal(size=(2, 300, 90))
    right = left if symmetric else right
    weights = np.exp(-0.3 * np.arange(90))
    full = left * weights @ right.T
    cut = 1e-3 * np.linalg.norm(full)
    rank = np.count_nonzero(np.cumsum(np.linalg.svd(full)[1][::-1] ** 2) > cut**2)
    sparse = csr_array(np.diag(weights).astype(complex))
    for coupling in (np.diag(weights).astype(complex), sparse):
        high = np.hstack([left, left])
        wide = high if symmetric else np.hstack([right, right])
        halves = {(0, 0): coupling / 2, (1, 1): coupling / 2}
        terms = [90, 90], [90, 90]
        one = Product(high, wide, halves, symmetric, other, terms)
        high, wide = one.factors(cut, 12)
        assert isinstance(high, np.ndarray) and high.shape[1] <= rank + 1
        assert np.linalg.norm(high @ wide.T - full) < 1.5 * cut
        x, y, core = one.narrowed(cut)
        assert np.linalg.norm(x @ core @ y.T - full) < 2.5 * cut and x.shape[1] < 90
        high, wide = one.spanned(cut, 60)
        assert isinstance(wide, np.ndarray) and high.shape[1] <= 1.35 * rank + 2
        assert np.linalg.norm(high @ wide.T - full) < 1.5 * cut


@pytest.mark.parametrize("signed", [False, True])
def test_pixel_energies_are_the_same_elsewhere(other, signed):
    rng = np.random.default_rng(10)
    high, wide = (
        (rng.normal(size=(2, 5, 3 * n, 7)) + 1j * rng.normal(size=(2, 5, 3 * n, 7))) for n in (4, 6)
    )
    signs = rng.choice([-1, 1], 7) if signed else None
    rows, columns = np.array([4, 0, 1, 2, 4]), np.array([1, 3, 1, 3, 0])
    found = np.empty((5, 4, 6))
    Factors(high, wide, (4, 6), 3, signs, device=other).superpixel(1, 0, rows, columns, found)
    for one, r, c in zip(found, rows, columns):
        field = (high[1, r] * (1 if signs is None else signs)) @ wide[0, c].T
        # nodes of a pixel run slowest
        parts = (np.abs(field) ** 2).reshape(3, 4, 3, 6)
        np.testing.assert_allclose(one, parts.sum(axis=(0, 2)), rtol=1e-12)
    if not signed:
        turned = np.empty((5, 6, 4))
        Factors(high, wide, (4, 6), 3, device=other).turned.superpixel(0, 1, columns, rows, turned)
        np.testing.assert_allclose(turned, found.transpose(0, 2, 1), rtol=1e-12)
        shown = rng.normal(size=(12, 12)), rng.normal(size=(18, 18))
        after, there = np.empty((5, 4, 6)), np.empty((5, 4, 6))
        Factors(high, wide, (4, 6), 3, None, shown, other).superpixel(1, 0, rows, columns, after)
        Factors(shown[0] @ high, shown[1] @ wide, (4, 6), 3).superpixel(1, 0, rows, columns, there)
        np.testing.assert_allclose(after, there, rtol=1e-12)


@pytest.mark.parametrize("bands", [1, 2])
def test_plug_and_play_is_the_same_elsewhere(other, bands, monkeypatch):
    """Two strips, the last patches not in step, and lenslets that stay as they are."""
    monkeypatch.setattr(block_matching, "TOGETHER_ELSEWHERE", 40)
    rng, shape = np.random.default_rng(4), (9, 7)
    truth = np.kron(rng.random((bands, 4, 5)), np.ones(shape))
    truth = truth + 0.01 * rng.standard_normal(truth.shape)
    truth = truth if bands > 1 else truth[0]
    matrix = rng.standard_normal((80, bands * 63))
    y = to_blocks(truth, shape) @ matrix.T
    held = rng.random(y.shape[:2]) < 0.2, to_blocks(truth, shape)
    term = whole_sensor.DataTerm(decompose(matrix), shape, y, 0.3, 1.0, held)
    start = truth + 0.2 * rng.standard_normal(truth.shape)
    found = []
    every_third = whole_sensor.schedule(0.2)[::3]  # the first and the last among them
    for where in (CPU, other):
        denoise = whole_sensor.denoiser(np.array([[1, 0.8], [0.8, 1]])[:bands, :bands])
        there = whole_sensor.plug_and_play(term.on(where), where.put(start), denoise, every_third)
        found.append(where.get(there))
    # a coefficient at the threshold may fall on either side
    difference = np.abs(found[1] - found[0])
    assert found[1].dtype == found[0].dtype and np.sqrt(np.mean(difference**2)) < 1e-5
    assert np.abs(found[0] - start).max() > 0.1


def test_a_graphics_card_that_is_not_there_is_refused():
    assert device("cpu") is CPU
    try:
        import torch
    except ImportError:
        said = "PyTorch, which is not installed"
    else:
        if torch.cuda.is_available():
            pytest.skip("there is one")
        said = "finds no graphics card"
    with pytest.raises(UsageError, match=said):
        device("cuda")
