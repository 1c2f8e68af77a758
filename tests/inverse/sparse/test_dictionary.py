"""Dictionary learning: the closed-form step, resuming, and that it learns."""

import numpy as np
import pytest
from scipy.linalg import solve_sylvester

from plenocli.inverse.picture.solvers import least_squares as linear
from plenocli.inverse.prior.natural_images import draw_patches
from plenocli.inverse.sparse import dictionary
from plenocli.inverse.sparse import dictionary_step as refit
from plenocli.inverse.sparse.coherence import column_coherence
from plenocli.inverse.sparse.learning import advance, learner_for

SHAPE = (5, 6)


@pytest.fixture(scope="module")
def setting():
    """A blurring A (42, 30) and pictures of oriented waves, which are sparse in few atoms."""
    rng = np.random.default_rng(0)
    position, point = np.arange(42) * 29 / 41, np.arange(30)
    a = np.exp(-((position[:, None] - point[None, :]) ** 2) / 2)
    r, c = np.mgrid[:40, :44]
    pictures = [
        0.5 + 0.4 * np.sin(0.9 * r * np.sin(k) + 0.9 * c * np.cos(k) + k) * rng.uniform(0.6, 1)
        for k in range(4)
    ]
    return linear.decompose(a), pictures


def learner(setting, **changes):
    svd, pictures = setting
    options = (
        dict(atoms=40, batch=120, lam=1e-4, delta=1e-3, snr_db=50.0, seed=3, validation=60)
        | changes
    )
    return dictionary.Learner(
        svd, SHAPE, pictures[:3], pictures[3:], dictionary.Settings(**options)
    )


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
    atoms, residual = refit.dictionary_step(energy, basis, gram, right, delta)
    ridge = 1e-6 * np.trace(gram) / 8
    np.testing.assert_allclose(
        atoms,
        solve_sylvester(delta * a.T @ a, gram + ridge * np.eye(8), right),
        rtol=1e-7,
        atol=1e-10,
    )
    assert residual < 1e-10


def test_directions_without_energy_may_be_left_out():
    rng = np.random.default_rng(1)
    a, c, x = rng.random((5, 12)), rng.standard_normal((8, 50)), rng.standard_normal((12, 50))
    gram, right = c @ c.T / 50, x @ c.T / 50
    strength, basis = np.linalg.svd(a, full_matrices=False)[1:]
    atoms, residual = refit.dictionary_step(strength**2, basis.T, gram, right, 0.1)
    np.testing.assert_allclose(
        atoms,
        solve_sylvester(0.1 * a.T @ a, gram + 1e-6 * np.trace(gram) / 8 * np.eye(8), right),
        rtol=1e-7,
        atol=1e-10,
    )
    assert residual < 1e-10


@pytest.mark.parametrize("delta", [0.0, 0.1])
def test_gradient_steps_approach_the_closed_form(delta):
    rng = np.random.default_rng(2)
    a, c, x = rng.random((20, 12)), rng.standard_normal((8, 50)), rng.standard_normal((12, 50))
    energy, basis = np.linalg.eigh(a.T @ a)
    system = energy, basis, c @ c.T / 50, x @ c.T / 50, delta
    exact, start = refit.dictionary_step(*system)[0], rng.standard_normal((12, 8))
    found = [refit.gradient_step(*system, start, steps) for steps in (10, 100, 1000)]
    away = [np.linalg.norm(atoms - exact) for atoms, _ in found]
    assert away[0] > away[1] > away[2] and away[2] < 1e-6 * np.linalg.norm(exact)
    assert found[0][1] > found[1][1] > found[2][1]


def test_one_gradient_step_goes_down_the_slope():
    rng = np.random.default_rng(3)
    a, c, x, phi = (
        rng.random((20, 12)),
        rng.standard_normal((8, 50)),
        rng.standard_normal((12, 50)),
        rng.standard_normal((12, 8)),
    )

    def objective(phi):
        return (
            np.sum((x - phi @ c) ** 2) / 50
            + 0.1 * np.sum((a @ phi) ** 2)
            + 1e-6 * np.trace(c @ c.T / 50) / 8 * np.sum(phi**2)
        )

    slope = np.empty_like(phi)
    for place in np.ndindex(phi.shape):
        nudge = np.zeros_like(phi)
        nudge[place] = 1e-4
        slope[place] = (objective(phi + nudge) - objective(phi - nudge)) / 2e-4
    moved = (
        refit.gradient_step(*np.linalg.eigh(a.T @ a), c @ c.T / 50, x @ c.T / 50, 0.1, phi, 1)[0]
        - phi
    )
    length = -np.sum(moved * slope) / np.sum(slope**2)
    np.testing.assert_allclose(moved, -length * slope, atol=1e-6 * np.abs(moved).max())
    assert objective(phi + moved) < objective(phi)


def test_step_lowers_its_objective():
    rng = np.random.default_rng(2)
    a, c, x = rng.random((20, 12)), rng.standard_normal((8, 50)), rng.standard_normal((12, 50))

    def objective(phi):
        return np.sum((x - phi @ c) ** 2) / 50 + 0.1 * np.sum((a @ phi) ** 2)

    atoms, _ = refit.dictionary_step(*np.linalg.eigh(a.T @ a), c @ c.T / 50, x @ c.T / 50, 0.1)
    for _ in range(20):
        assert objective(atoms + 1e-2 * rng.standard_normal(atoms.shape)) > objective(atoms)


def test_the_past_of_atoms_counts_as_so_many_batches():
    """What the step makes least has the distance to the atoms before, weighed by the median
    coefficient; without a batch's word on an atom it stays.
    """
    rng = np.random.default_rng(2)
    a, c, x = rng.random((20, 12)), rng.standard_normal((8, 50)), rng.standard_normal((12, 50))
    c[5] = 0.0
    before = rng.standard_normal((12, 8))
    weight = 3.0 * np.median(np.mean(c**2, axis=1))

    def objective(phi):
        fit = np.sum((x - phi @ c) ** 2) / 50 + weight * np.sum((phi - before) ** 2)
        return fit + 0.1 * np.sum((a @ phi) ** 2)

    gram, right = refit.pulled(c @ c.T / 50, x @ c.T / 50, before, 3.0)
    atoms, _ = refit.dictionary_step(*np.linalg.eigh(a.T @ a), gram, right, 0.1)
    for size in (1e-2, 1e-1):
        for _ in range(20):
            assert objective(atoms + size * rng.standard_normal(atoms.shape)) > objective(atoms)
    alone, _ = refit.dictionary_step(np.zeros(12), np.eye(12), gram, right, 0.0)
    np.testing.assert_allclose(alone[:, 5], before[:, 5], rtol=1e-4)


@pytest.mark.parametrize("share", [0.01, 0.3, 1.0])
def test_atoms_that_look_alike_are_drawn_apart(share):
    rng = np.random.default_rng(5)
    a = rng.standard_normal((9, 20)) @ np.diag(np.logspace(0, -3, 20))
    atoms = rng.standard_normal((20, 30)) * rng.uniform(0.1, 3, 30)
    atoms[:, 7] = np.linalg.svd(a)[2][-1]  # which a does not see

    def cosines(phi):
        seen = a @ np.delete(phi, 7, axis=1)
        unit = seen / np.linalg.norm(seen, axis=0)
        return np.sum((unit.T @ unit) ** 2)

    apart = refit.decorrelated(a, atoms, share)
    assert cosines(apart) < cosines(atoms)
    np.testing.assert_array_equal(apart[:, 7], atoms[:, 7])
    assert np.linalg.matrix_rank(np.hstack([atoms, apart])) == np.linalg.matrix_rank(atoms)


def test_a_small_step_apart_goes_down_the_gradient_of_the_columns():
    """Against the slope by differences, of unit columns moved within their sphere."""
    rng = np.random.default_rng(6)
    seen = rng.standard_normal((6, 10))
    seen /= np.linalg.norm(seen, axis=0)

    def cosines(u):
        u = u / np.linalg.norm(u, axis=0)
        return np.sum((u.T @ u) ** 2)

    moved = refit.decorrelated(np.eye(6), seen, 1e-4) - seen
    slope = np.zeros_like(seen)
    for index in np.ndindex(*seen.shape):
        step = np.zeros_like(seen)
        step[index] = 1e-6
        slope[index] = (cosines(seen + step) - cosines(seen - step)) / 2e-6
    tangent = moved - seen * np.sum(seen * moved, axis=0)
    cosine = np.sum(tangent * slope) / np.linalg.norm(tangent) / np.linalg.norm(slope)
    assert cosine == pytest.approx(-1, abs=1e-6)


def test_unused_atoms_do_not_break_the_step():
    c = np.zeros((8, 50))
    c[:3] = np.random.default_rng(0).standard_normal((3, 50))
    atoms, _ = refit.dictionary_step(
        np.zeros(12), np.eye(12), c @ c.T / 50, np.ones((12, 50)) @ c.T / 50, 0.0
    )
    assert np.all(np.isfinite(atoms)) and not np.any(np.abs(atoms[:, 3:]) > 1e-9)


@pytest.mark.parametrize("how", [{}, dict(pull=8.0, incoherence=0.05)])
def test_resumed_run_equals_an_uninterrupted_one_bit_for_bit(setting, how):
    whole = run(learner(setting, **how), learner(setting).start(), 4)
    half = run(learner(setting, **how), learner(setting).start(), 2)
    rest = run(learner(setting, **how), dictionary.State.load(half.save()), 2)
    assert rest.atoms.tobytes() == whole.atoms.tobytes()
    assert rest.history == whole.history and rest.iteration == 4


def test_atoms_keep_their_form(setting):
    state = run(learner(setting), learner(setting).start(), 3)
    np.testing.assert_allclose(np.linalg.norm(state.atoms, axis=0), 1)
    np.testing.assert_allclose(state.atoms[:, 0], 1 / np.sqrt(30))
    assert np.abs(state.atoms[:, 1:].mean(axis=0)).max() < 1e-12
    assert all(
        len(values) == 3 and np.all(np.isfinite(values))
        for values in map(state.column, dictionary.HISTORY)
    )
    assert max(state.column("worst_gap")) <= 1e-3 and max(state.column("step_residual")) < 1e-10


def test_gradient_steps_learn_too_and_say_how_far_they_got(setting):
    exact, rough = (
        run(learner(setting, gradient_steps=n), learner(setting).start(), 2) for n in (0, 30)
    )
    assert rough.history[0].step_residual > 1e-6 > exact.history[0].step_residual
    assert (
        rough.history[-1].validation_psnr
        > learner(setting).validate(learner(setting).start().atoms).psnr - 1
    )


def test_directions_below_the_noise_are_left_out(setting):
    quiet, loud = learner(setting, snr_db=60.0), learner(setting, snr_db=20.0)
    assert 1 < len(loud.seen) < len(quiet.seen) < 42
    patches = quiet.validation
    power = np.mean((quiet.svd.s[:, None] / quiet.scale * (quiet.svd.vt @ patches)) ** 2, axis=1)
    # what is left out is faint on other patches too
    assert power[len(loud.seen) :].max() < 0.05 * loud.sigma**2


def test_synthesis_is_the_regression_of_patches_on_their_codes(setting):
    machine = learner(setting, batch=200)
    state = run(machine, machine.start(), 2)
    paint = machine.synthesis(state, batches=2)
    rng, patches, codes = np.random.default_rng([3, dictionary._DRAW_SYNTHESIS, 2]), [], []
    for _ in range(2):
        patches.append(draw_patches(machine.training, SHAPE, 200, rng))
        codes.append(machine.code(state.atoms, machine.measure(patches[-1], rng)[0]).c)
    x, c = np.concatenate(patches, axis=1), np.concatenate(codes, axis=1)
    pull = 4 * 40 * np.median(np.sum(c[1:] ** 2, axis=1)) / 400  # of all 400 patches together
    stacked = (
        np.concatenate([c, np.sqrt(pull) * np.eye(40)], axis=1),
        np.concatenate([x, np.sqrt(pull) * state.atoms], axis=1),
    )
    np.testing.assert_allclose(
        paint, np.linalg.lstsq(stacked[0].T, stacked[1].T, rcond=None)[0].T, atol=1e-8
    )
    assert np.sum((x - paint @ c) ** 2) < np.sum((x - state.atoms @ c) ** 2)


def test_path_of_lambda_is_what_single_values_give(setting):
    machine = learner(setting, tol=1e-8)
    atoms = machine.start().atoms
    for lam, quality, nonzeros in machine.validate_path(atoms, [1e-5, 1e-3]):
        one = learner(setting, tol=1e-8, lam=lam).validate(atoms)
        assert one.psnr == pytest.approx(quality, abs=1e-3)
        assert one.nonzeros == pytest.approx(nonzeros, rel=0.02)


def test_learning_beats_its_random_start(setting):
    machine = learner(setting, initial="random")
    start = machine.start()
    before, after = (
        machine.validate(start.atoms).psnr,
        run(machine, start, 6).history[-1].validation_psnr,
    )
    assert after > before + 3


@pytest.mark.parametrize("initial", ["patches", "random"])
def test_starts_are_seeded_and_differ(setting, initial):
    one, same, other = (
        learner(setting, initial=initial).start(),
        learner(setting, initial=initial).start(),
        learner(setting, initial=initial, seed=4).start(),
    )
    assert one.atoms.tobytes() == same.atoms.tobytes() != other.atoms.tobytes()


def test_scale_of_the_matrix_does_not_matter(setting):
    svd, pictures = setting
    # a power of two, so that rounding is the same too
    louder = linear.Svd(svd.u, 1024 * svd.s, svd.vt)
    one, other = (
        learner((s, pictures), tol=1e-8)
        .step(learner((s, pictures)).start())
        .history[0]
        .validation_psnr
        for s in (svd, louder)
    )
    assert one == pytest.approx(other, abs=1e-3)


@pytest.mark.parametrize("shape, count", [((5, 6), 4), ((4, 4), 8)])
def test_mirror_images_are_the_symmetries_of_the_object(shape, count):
    images = dictionary.mirror_images(shape)
    assert len({i.tobytes() for i in images}) == len(images) == count
    rows, columns = np.divmod(np.arange(np.prod(shape)), shape[1])
    near = (rows[:, None] - rows) ** 2 + (columns[:, None] - columns) ** 2
    for image in images:  # neighbours stay neighbours, and nothing else does that
        np.testing.assert_array_equal(near[np.ix_(image, image)], near)


def test_average_is_that_of_dictionaries_mirrored_one_by_one(setting):
    machine = learner(setting)
    state = run(machine, machine.start(), 2)
    found = dictionary.averaged(machine.seen, state.atoms, machine.measured, 1e-4, SHAPE, tol=1e-9)
    grid, expected, count = state.atoms.reshape(*SHAPE, -1), [], []
    for axes in ((), (0,), (1,), (0, 1)):
        atoms = np.flip(grid, axes).reshape(30, -1)
        c = dictionary.sparse_code(
            machine.seen @ atoms, machine.measured, 1e-4, free=[0], tol=1e-9
        ).c
        expected.append(atoms @ c)
        count.append(np.count_nonzero(c[1:]) / c.shape[1])
    np.testing.assert_allclose(found.x, np.mean(expected, axis=0), atol=1e-6)
    assert found.worst_gap <= 1e-8
    assert found.nonzeros == pytest.approx(np.mean(count), rel=0.01)


def test_average_beats_the_typical_single_estimate(setting):
    """The error of a mean of equally good estimates is below their mean error."""
    machine = learner(setting)
    state = run(machine, machine.start(), 2)
    single = [
        dictionary.psnr(
            state.atoms[i]
            @ dictionary.sparse_code(
                machine.seen @ state.atoms[i], machine.measured, 1e-4, free=[0]
            ).c,
            machine.validation,
        )
        for i in dictionary.mirror_images(SHAPE)
    ]
    mean = dictionary.averaged(machine.seen, state.atoms, machine.measured, 1e-4, SHAPE).x
    assert dictionary.psnr(mean, machine.validation) > np.mean(single) + 0.1


@pytest.fixture(scope="module")
def photographs():
    """A blurring A of 8x8 points and photographs, the last of which judge."""
    import skimage.data

    place = np.arange(12) * 7 / 11
    blur = np.exp(-((place[:, None] - np.arange(8)) ** 2) / 1.5)
    names = ("camera", "coins", "page", "moon", "text", "brick", "grass", "gravel", "clock")
    pictures = [getattr(skimage.data, name)().astype(float) / 255 for name in names]
    return linear.decompose(np.kron(blur, blur)), pictures


def test_learning_gains_on_held_out_pictures_and_learns_no_noise(photographs):
    """More than 0.3 dB over its start with the defaults; atoms as smooth as photographs, and less
    alike to the sensor than they were. Without a past the batches' noise is learnt.
    """
    svd, pictures = photographs

    def learnt(initial, **how):
        settings = dictionary.Settings(
            atoms=64, batch=256, lam=np.nan, delta=1e-3, snr_db=50.0, seed=1, initial=initial, **how
        )
        machine = learner_for(svd, (8, 8), settings, pictures[:-2], pictures[-2:], workers=1)
        begun = state = machine.start()
        for _ in range(10):
            machine, state = advance(machine, state)
        return machine, begun, state

    def rough(state):
        """Share of atoms whose neighbouring points have little in common."""
        atoms = state.atoms[:, 1:].reshape(8, 8, -1)
        rows = np.sum(atoms[1:] * atoms[:-1], axis=(0, 1))
        columns = np.sum(atoms[:, 1:] * atoms[:, :-1], axis=(0, 1))
        return float(np.mean((rows + columns) / 2 < 0.3))

    ours = dict(pull=dictionary.PULL, incoherence=dictionary.INCOHERENCE, lam_rule="validation")
    machine, begun, state = learnt("patches", **ours)
    gain = machine.validate(state.atoms).psnr - machine.validate(begun.atoms).psnr
    assert gain > 0.3
    assert rough(state) < 0.25
    first, last = (column_coherence(machine.seen @ one.atoms[:, 1:])[1] for one in (begun, state))
    assert last < 0.9 * first
    assert rough(learnt("patches", lam_rule="validation")[2]) > rough(state) + 0.1
    machine, begun, state = learnt("random", **ours)
    assert machine.validate(state.atoms).psnr > machine.validate(begun.atoms).psnr + 3
