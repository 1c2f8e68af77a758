"""Block matching against a plain loop, another library's denoiser, and what must not change."""

import numpy as np
import pytest
from scipy.fft import dctn, idctn
from scipy.linalg import hadamard

from plenocli.base.budget import on_threads
from plenocli.evaluation.metrics.quality import psnr
from plenocli.files.read.scenes import embedded_photograph
from plenocli.forward.scene.sample import luminance, sample_picture
from plenocli.inverse.picture.solvers import block_matching as denoise


@pytest.fixture(autouse=True, params=["in arrays", "compiled"])
def way(request, monkeypatch):
    """Either way for pictures of any size."""
    if request.param == "compiled":
        pytest.importorskip("numba")
    monkeypatch.setattr(denoise, "LARGE", 0 if request.param == "compiled" else np.inf)


@pytest.fixture(scope="module")
def noisy():
    truth = np.asarray(sample_picture(luminance(embedded_photograph("coffee")), 96, 96), float)
    return truth, truth + 0.05 * np.random.default_rng(0).standard_normal(truth.shape)


def by_loops(picture, sigma):
    """The definition, patch by patch, with scipy's transforms."""
    p, k = denoise.PATCH, denoise.STACK
    corners = [sorted({*range(0, n - p + 1, denoise.STEP), n - p}) for n in picture.shape]
    total, weights = np.zeros(picture.shape), np.zeros(picture.shape)
    window = np.outer(np.kaiser(p, 2.0), np.kaiser(p, 2.0))
    for r in corners[0]:
        for c in corners[1]:
            near = [
                (a, b)
                for a in range(
                    max(0, r - denoise.SEARCH), min(picture.shape[0] - p, r + denoise.SEARCH) + 1
                )
                for b in range(
                    max(0, c - denoise.SEARCH), min(picture.shape[1] - p, c + denoise.SEARCH) + 1
                )
            ]
            far = {
                (a, b): -1.0
                if (a, b) == (r, c)
                else np.sum((picture[a : a + p, b : b + p] - picture[r : r + p, c : c + p]) ** 2)
                for a, b in near
            }
            near = sorted(near, key=far.get)[:k]
            transform = lambda x: np.tensordot(
                hadamard(k) / np.sqrt(k),
                np.stack([dctn(x[a : a + p, b : b + p], norm="ortho") for a, b in near]),
                1,
            )
            z = transform(picture)
            keep = np.abs(z) > denoise.THRESHOLD * sigma
            keep[0, 0, 0] = True
            z, weight = z * keep, 1 / keep.sum()
            for (a, b), patch in zip(near, np.tensordot(hadamard(k) / np.sqrt(k), z, 1)):
                total[a : a + p, b : b + p] += weight * window * idctn(patch, norm="ortho")
                weights[a : a + p, b : b + p] += weight * window
    return total / weights


def test_it_is_the_plain_loop(noisy):
    picture = noisy[1][:22, :25]
    np.testing.assert_allclose(
        denoise.block_matching(picture, 0.05), by_loops(picture, 0.05), atol=2e-5
    )


def test_what_was_found_alike_serves_the_next_picture(noisy):
    known = {}
    first = denoise.block_matching(noisy[1], 0.05, known)
    np.testing.assert_array_equal(denoise.block_matching(noisy[1], 0.05, known), first)
    own, alike = (denoise.block_matching(noisy[0], 0.05, known) for known in (None, known))
    assert 50 > psnr(alike, own) > 35
    known.clear()
    np.testing.assert_array_equal(denoise.block_matching(noisy[0], 0.05, known), own)


def test_both_ways_are_the_same(noisy, monkeypatch):
    found = []
    for large in (0, np.inf):
        monkeypatch.setattr(denoise, "LARGE", large)
        found.append(denoise.block_matching(noisy[1][:, :90], 0.05))
    np.testing.assert_allclose(*found, atol=1e-6)


def test_it_beats_total_variation(noisy):
    from skimage.restoration import denoise_tv_chambolle

    truth, picture = noisy
    plain = denoise.block_matching(picture, 0.05)
    tv = max(psnr(denoise_tv_chambolle(picture, weight=w), truth) for w in (0.03, 0.05, 0.08, 0.12))
    assert psnr(plain, truth) > tv + 0.2 and psnr(plain, truth) > psnr(picture, truth) + 5


def test_strips_change_nothing(noisy, monkeypatch):
    whole = denoise.block_matching(noisy[1], 0.05)
    monkeypatch.setattr(denoise, "TOGETHER", 60)
    np.testing.assert_allclose(denoise.block_matching(noisy[1], 0.05), whole, atol=1e-6)


@pytest.mark.parametrize("threads", [2, 5])
def test_threads_change_no_bit(noisy, monkeypatch, threads):
    monkeypatch.setattr(denoise, "TOGETHER", 60)
    known = [{}, {}]
    with on_threads(1):
        alone = denoise.block_matching(noisy[1], 0.05, known[0])
    with on_threads(threads):
        found = denoise.block_matching(noisy[1], 0.05, known[1])
    np.testing.assert_array_equal(found, alone)
    assert len(known[0]) > 5 and known[0].keys() == known[1].keys()
    for strip, alike in known[0].items():
        np.testing.assert_array_equal(known[1][strip], alike)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (8, 8), (9, 30), (33, 10)])
def test_any_shape_and_level(shape):
    level = denoise.block_matching(np.full(shape, 0.3), 0.1)
    np.testing.assert_allclose(level, 0.3, rtol=1e-6)
    picture = np.random.default_rng(0).random(shape)
    np.testing.assert_allclose(denoise.block_matching(picture, 0.0), picture, atol=1e-6)


@pytest.mark.parametrize("unit", [1e-30, 2.0**90])
def test_the_unit_of_the_picture_does_not_matter(unit):
    rng = np.random.default_rng(6)
    picture = rng.random((20, 24))
    assert denoise.block_matching(unit * picture, unit * 0.1) == pytest.approx(
        unit * denoise.block_matching(picture, 0.1), rel=1e-4
    )
    assert not denoise.block_matching(np.zeros((9, 9)), 0.1).any()
