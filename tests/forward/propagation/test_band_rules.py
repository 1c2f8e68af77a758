"""Rules for pixels: they integrate a band of frequencies better than Gauss and Legendre's of as
many nodes, and constants exactly.
"""

import numpy as np
import pytest

from plenocli.base.errors import NumericsError
from plenocli.forward.camera.quadrature import RULE_STEP, band_rule, gauss
from plenocli.forward.propagation.sampling import pixel_error, pixel_nodes


def worst(rule, cycles):
    """Largest error of the mean of cos(pi c t), whose value is sinc(c)."""
    nodes, weights = rule
    return np.abs(np.cos(np.pi * np.outer(cycles, nodes)) @ weights / 2 - np.sinc(cycles)).max()


@pytest.mark.parametrize(
    "count, step, gain",
    [(3, 4, 3), (4, 4, 5), (5, 3, 10), (6, 5, 8), (7, 5, 9), (9, 6, 5), (12, 6, 10)],
)
def test_rules_of_a_band_beat_gauss_legendre_on_it(count, step, gain):
    cycles = np.linspace(0, RULE_STEP * step * count, 400)
    rule = band_rule(count, step)
    assert gain * worst(rule, cycles) < worst(gauss(count), cycles)
    nodes, weights = rule
    assert (
        weights.sum() == pytest.approx(2, abs=1e-13)
        and weights.min() > 0
        and np.abs(nodes).max() < 1
    )
    assert nodes == pytest.approx(-nodes[::-1], abs=1e-15) and (np.diff(nodes) > 0).all()


def test_the_narrowest_band_is_gauss_legendre():
    assert band_rule(6) is gauss(6)


@pytest.mark.parametrize(
    "own, joint, cells", [(1.96, 1.96, 102), (0.45, 2.2, 24), (8.5, 8.5, 102), (2, 10, 6)]
)
@pytest.mark.parametrize("accuracy", [1e-2, 1e-4, 1e-7])
def test_as_few_nodes_as_serve_are_taken(own, joint, cells, accuracy):
    light = own, joint, cells, 0.0
    count, rule = pixel_nodes(accuracy, *light)
    assert pixel_error(count, rule, *light) <= accuracy / 1.5
    assert count == 2 or pixel_error(count - 1, 0, *light) > accuracy / 1.5
    assert pixel_nodes(accuracy / 10, *light)[0] >= count


def test_pixels_of_too_many_fringes_are_refused():
    with pytest.raises(NumericsError, match="cannot be integrated"):
        pixel_nodes(1e-3, 300.0, 900.0, 50, 0.0)
