"""Prolate functions against scipy's, the equation that defines them, and the waves
they are to carry.
"""

import numpy as np
import pytest
from scipy.special import pro_ang1, roots_legendre

from plenocli.forward.propagation.exact.prolate import prolate, prolate_count


@pytest.mark.parametrize("c", [0.1, 3.0, 20.0])
def test_functions_are_scipys(c):
    t = np.linspace(-0.99, 0.99, 41)
    found = prolate(t, c, 6)
    for n in range(6):
        theirs = np.array([pro_ang1(0, n, c, x)[0] for x in t])
        ours = (
            found[:, n]
            * np.sign(found[:, n] @ theirs)
            * np.linalg.norm(theirs)
            / np.linalg.norm(found[:, n])
        )
        assert np.abs(ours - theirs).max() < 1e-6 * np.abs(theirs).max()


@pytest.mark.parametrize(
    "c, count", [(0.01, 1), (0.01, 2), (8.0, 21), (60.0, 70), (169.0, 121), (700.0, 480)]
)
def test_they_are_orthonormal_eigenfunctions_of_band_limiting(c, count):
    t, w = roots_legendre(int(c) + count + 60)
    values = prolate(t, c, count)
    # the rule's own weights at 1240 nodes
    assert np.abs(values.T @ (w[:, None] * values) - np.eye(count)).max() < 1e-9
    limited = (c / np.pi * np.sinc(c / np.pi * (t[:, None] - t))) @ (w[:, None] * values)
    shares = np.einsum("ij,i,ij->j", values, w, limited)
    assert np.abs(limited - shares * values).max() < 1e-9 * np.abs(values).max()
    assert (np.diff(shares) < 1e-12).all() and shares[0] <= 1 + 1e-12


@pytest.mark.parametrize("error", [1e-2, 1e-4, 1e-6, 1e-9])
@pytest.mark.parametrize("c", [0.02, 1.0, 9.0, 40.0, 169.0, 800.0])
def test_so_many_carry_waves_of_all_directions(c, error):
    count = prolate_count(c, error)
    t, w = roots_legendre(int(c) + count + 60)
    root = np.sqrt(w / 2)[:, None]
    waves = root * np.exp(1j * c * t[:, None] * roots_legendre(int(c) + 40)[0])
    values = prolate(t, c, count) * np.sqrt(w)[:, None]

    def left(number):
        some = values[:, :number]
        return np.linalg.norm(waves - some @ (some.T @ waves)) / np.sqrt(waves.shape[1])

    assert left(count) < 2 * error
    assert left(max(1, count - 8)) > error or count <= 16, "fewer would do"
