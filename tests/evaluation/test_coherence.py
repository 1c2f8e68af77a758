import numpy as np
import pytest
from scipy.linalg import hadamard

from plenocli.evaluation.metrics.coherence import (
    coherence,
    dictionary_coherence,
    exact_recovery_sparsity,
    welch_bound,
)
from plenocli.inverse.sparse.coherence import column_coherence


def test_spikes_and_hadamard_are_maximally_incoherent():
    n = 64
    found = coherence(np.eye(n), hadamard(n) / np.sqrt(n))
    assert found.coherence_candes_romberg == pytest.approx(1)
    assert found.coherence_raw == pytest.approx(1 / 8)
    assert found.coherence_effective == pytest.approx(0, abs=1e-12)
    assert found.welch_bound == 0


def test_a_basis_with_itself_is_maximally_coherent():
    assert coherence(np.eye(16), np.eye(16)).coherence_candes_romberg == pytest.approx(4)


def test_two_orthobases_reach_their_known_coherence():
    n = 16
    found = coherence(np.eye(n), np.hstack([np.eye(n), hadamard(n) / np.sqrt(n)]))
    assert found.coherence_effective == pytest.approx(1 / 4)
    assert found.coherence_effective_mean == pytest.approx((n * n / 4) / (n * (2 * n - 1)))
    assert found.exact_recovery_sparsity == 2  # k < (1 + 4)/2
    assert found.welch_bound == pytest.approx(np.sqrt(16 / (16 * 31)))


def test_the_simplex_meets_the_welch_bound():
    n = 5
    # n + 1 vectors in n dimensions
    simplex = np.linalg.svd(np.eye(n + 1) - 1 / (n + 1))[0][:, :n].T
    found = coherence(np.eye(n), simplex)
    assert found.coherence_effective == pytest.approx(welch_bound(n + 1, n)) == pytest.approx(1 / n)


def test_scales_change_only_the_raw_measure():
    rng = np.random.default_rng(0)
    system, atoms = rng.standard_normal((20, 12)), rng.standard_normal((12, 30))
    plain, scaled = (
        coherence(system, atoms),
        coherence(100 * system, atoms * rng.uniform(0.5, 2, 30)),
    )
    for key in ("coherence_candes_romberg", "coherence_effective", "coherence_effective_mean"):
        assert getattr(scaled, key) == pytest.approx(getattr(plain, key))
    assert scaled.coherence_raw > 10 * plain.coherence_raw


def test_blocks_do_not_change_the_answer():
    rng = np.random.default_rng(1)
    system, atoms = rng.standard_normal((20, 12)), rng.standard_normal((12, 37))
    whole, blocks = coherence(system, atoms, block=1000), coherence(system, atoms, block=5)
    assert whole == pytest.approx(blocks)
    gram = (system @ atoms).T @ (system @ atoms)
    gram /= np.sqrt(np.outer(gram.diagonal(), gram.diagonal()))
    assert blocks.coherence_effective == pytest.approx(np.abs(gram - np.eye(37)).max())


def test_dead_and_invisible_atoms_are_counted_and_harmless():
    system = np.diag([1.0, 1.0, 0.0])
    atoms = np.array([[1.0, 0, 0, 0.6], [0, 1, 0, 0.8], [0, 0, 1, 0]])
    atoms = np.hstack([atoms, np.zeros((3, 1))])
    found = coherence(system, atoms)
    assert found.dead_atoms == 1 and found.invisible_atoms == 1
    assert found.coherence_effective == pytest.approx(0.8)
    assert np.isnan(coherence(system, np.zeros((3, 2))).coherence_effective)


@pytest.mark.parametrize("mu, k", [(1.0, 0), (0.5, 1), (1 / 3, 1), (0.3, 2), (0.2, 2), (0.19, 3)])
def test_sparsity_limit_is_strict(mu, k):
    assert exact_recovery_sparsity(mu) == k


def test_single_precision_is_kept():
    rng = np.random.default_rng(3)
    system, atoms = (rng.standard_normal(s).astype(np.float32) for s in ((8, 6), (6, 9)))
    assert coherence(system, atoms).coherence_effective == pytest.approx(
        coherence(system.astype(float), atoms.astype(float)).coherence_effective, rel=1e-5
    )


def test_column_coherence_by_hand():
    d = np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 1.0, 2.0, 0.0]])
    largest, mean, visible = column_coherence(d)
    assert largest == pytest.approx(np.sqrt(0.5)) and mean == pytest.approx(2 * np.sqrt(0.5) / 3)
    assert visible.tolist() == [True, True, True, False]
    assert column_coherence(d[:, 3:])[:2] == (None, None)


def test_constant_atoms_do_not_count_and_random_ones_stand_beside():
    """A that adds up everything sees a constant atom best of all."""
    rng = np.random.default_rng(4)
    system = 1 + 0.1 * rng.random((20, 16))
    atoms = np.linalg.qr(np.hstack([np.ones((16, 1)), rng.standard_normal((16, 15))]))[0]
    whole, varying = coherence(system, atoms), dictionary_coherence(system, atoms)
    assert whole.mutual > 0.99 and varying.atoms == 15
    assert varying.mutual == pytest.approx(coherence(system, atoms[:, 1:]).mutual)
    assert varying.mutual < 0.2
    draws = rng.standard_normal((200, 16, 15))
    draws -= draws.mean(axis=1, keepdims=True)
    draws /= np.linalg.norm(draws, axis=1, keepdims=True)
    usual = [coherence(system, draw).mutual for draw in draws]
    assert min(usual) <= varying.random_mutual <= max(usual)
