"""The front against its definition, pair by pair."""

import numpy as np
import pytest

from plenocli.evaluation.metrics.pareto import front


def brute_force(values, signs):
    """By the definition: nobody is at least as good everywhere and better somewhere."""

    def beats(a, b):
        better = [s * x > s * y for x, y, s in zip(a, b, signs)]
        worse = [s * x < s * y for x, y, s in zip(a, b, signs)]
        return any(better) and not any(worse)

    whole = [not any(v != v for v in row) for row in values]
    return [
        w and not any(beats(other, row) for other, o in zip(values, whole) if o)
        for row, w in zip(values, whole)
    ]


@pytest.mark.parametrize("seed", range(12))
def test_the_front_is_what_the_definition_says(seed):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(60, 1 + seed % 4))
    if seed % 3:
        values = np.round(values * seed / 3)  # many ties and equals
    values[rng.random(values.shape) < 0.05] = np.nan
    values[rng.random(values.shape) < 0.02] = np.inf
    signs = rng.choice([-1, 1], size=values.shape[1])
    found = front(values, signs)
    assert found.tolist() == brute_force(values.tolist(), signs.tolist())
    assert found.any()


def test_equals_stand_together_and_order_does_not_matter():
    values = np.array([[1.0, 2.0], [2.0, 1.0], [1.0, 2.0], [0.0, 2.0], [np.nan, 9.0]])
    assert front(values, [1, 1]).tolist() == [True, True, True, False, False]
    shuffled = np.random.default_rng(0).permutation(5)
    assert front(values[shuffled], [1, 1]).tolist() == front(values, [1, 1])[shuffled].tolist()


def test_nothing_to_compare():
    assert front(np.zeros((3, 0)), []).tolist() == [False] * 3
    assert front(np.full((2, 2), np.nan), [1, 1]).tolist() == [False] * 2
    assert front(np.zeros((0, 2)), [1, 1]).tolist() == []
