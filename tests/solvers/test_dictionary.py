"""Dictionary learning: the closed-form step, resuming, and that it learns."""

import numpy as np
import pytest
from scipy.linalg import solve_sylvester

from plenocli.solvers import dictionary, linear

SHAPE = (5, 6)


@pytest.fixture(scope="module")
def setting():
    """A blurring A (42, 30) and pictures of oriented waves, which are sparse in few atoms."""
    rng = np.random.default_rng(0)
    position, point = np.arange(42) * 29 / 41, np.arange(30)
    a = np.exp(-((position[:, None] - point[None, :]) ** 2) / 2)
    r, c = np.mgrid[:40, :44]
    pictures = [0.5 + 0.4 * np.sin(0.9 * r * np.sin(k) + 0.9 * c * np.cos(k) + k) * rng.uniform(0.6, 1) for k in range(4)]
    return linear.decompose(a), pictures


def learner(setting, **changes):
    svd, pictures = setting
    options = dict(atoms=40, batch=120, lam=1e-4, delta=1e-3, snr_db=50.0, seed=3, validation=60) | changes
    return dictionary.Learner(svd, SHAPE, pictures[:3], pictures[3:], dictionary.Settings(**options))


def run(machine, state, iterations):
    for _ in range(iterations):
        state = machine.step(state)
    return state


@pytest.mark.parametrize("delta", [0.0, 1e-3, 10.0])
def test_step_solves_the_sylvester_equation(delta):
    rng = np.random.default_rng(1)
    a, c, x = rng.random((20, 12)), rng.standard_normal((8, 50)), rng.standard_normal((12, 50))
    energy, basis = np.linalg.eigh(a.T @ a)
    gram, right = c @ c.T / 50, x @ c.T / 50
    atoms, residual = dictionary.dictionary_step(energy, basis, gram, right, delta)
    ridge = 1e-6 * np.trace(gram) / 8
    np.testing.assert_allclose(atoms, solve_sylvester(delta * a.T @ a, gram + ridge * np.eye(8), right), rtol=1e-7, atol=1e-10)
    assert residual < 1e-10


def test_step_lowers_its_objective():
    rng = np.random.default_rng(2)
    a, c, x = rng.random((20, 12)), rng.standard_normal((8, 50)), rng.standard_normal((12, 50))

    def objective(phi):
        return np.sum((x - phi @ c) ** 2) / 50 + 0.1 * np.sum((a @ phi) ** 2)

    atoms, _ = dictionary.dictionary_step(*np.linalg.eigh(a.T @ a), c @ c.T / 50, x @ c.T / 50, 0.1)
    for _ in range(20):
        assert objective(atoms + 1e-2 * rng.standard_normal(atoms.shape)) > objective(atoms)


def test_unused_atoms_do_not_break_the_step():
    c = np.zeros((8, 50))
    c[:3] = np.random.default_rng(0).standard_normal((3, 50))
    atoms, _ = dictionary.dictionary_step(np.zeros(12), np.eye(12), c @ c.T / 50, np.ones((12, 50)) @ c.T / 50, 0.0)
    assert np.all(np.isfinite(atoms)) and not np.any(np.abs(atoms[:, 3:]) > 1e-9)


def test_resumed_run_equals_an_uninterrupted_one_bit_for_bit(setting):
    whole = run(learner(setting), learner(setting).start(), 4)
    half = run(learner(setting), learner(setting).start(), 2)
    rest = run(learner(setting), dictionary.State.load(half.save()), 2)
    assert rest.atoms.tobytes() == whole.atoms.tobytes()
    assert rest.history == whole.history and rest.iteration == 4


def test_atoms_keep_their_form(setting):
    state = run(learner(setting), learner(setting).start(), 3)
    np.testing.assert_allclose(np.linalg.norm(state.atoms, axis=0), 1)
    np.testing.assert_allclose(state.atoms[:, 0], 1 / np.sqrt(30))
    assert np.abs(state.atoms[:, 1:].mean(axis=0)).max() < 1e-12
    assert all(len(values) == 3 and np.all(np.isfinite(values)) for values in state.history.values())
    assert max(state.history["worst_gap"]) <= 1e-3 and max(state.history["step_residual"]) < 1e-10


def test_learning_beats_its_random_start(setting):
    machine = learner(setting, initial="random")
    start = machine.start()
    before, after = machine.validate(start.atoms)[1], run(machine, start, 6).history["validation_psnr"][-1]
    assert after > before + 3


@pytest.mark.parametrize("initial", ["patches", "pca", "random"])
def test_starts_are_seeded_and_differ(setting, initial):
    one, same, other = learner(setting, initial=initial).start(), learner(setting, initial=initial).start(), learner(setting, initial=initial, seed=4).start()
    assert one.atoms.tobytes() == same.atoms.tobytes() != other.atoms.tobytes()


def test_scale_of_the_matrix_does_not_matter(setting):
    svd, pictures = setting
    louder = linear.Svd(svd.u, 1000 * svd.s, svd.vt)
    one, other = (learner((s, pictures)).step(learner((s, pictures)).start()).history["validation_psnr"][0] for s in (svd, louder))
    assert one == pytest.approx(other, abs=0.05)
