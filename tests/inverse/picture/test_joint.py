"""The joint estimate of several bands: brightnesses of lenslets are free."""

from types import SimpleNamespace

import numpy as np

from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.picture.joint import _even_light
from plenocli.inverse.picture.lenslet_model import Superpixels


def test_brightnesses_are_free_where_bands_are_told_apart():
    """Sums over mirrored neighbours written out; random brightnesses, which no photograph has."""
    rng = np.random.default_rng(4)
    offsets = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    blocks = 0.1 * rng.uniform(0, 1, (9, 40, 2))
    blocks[4] += rng.uniform(0, 1, (40, 2))
    truth = rng.uniform(0.05, 0.9, (6, 7, 2))
    wide = np.pad(truth, [(1, 1), (1, 1), (0, 0)], mode="symmetric")
    y = sum(wide[1 - r : 7 - r, 1 - c : 8 - c] @ f.T for (r, c), f in zip(offsets, blocks))
    system = SimpleNamespace(even_blocks=blocks, offsets=offsets, bands=(5e-7, 6e-7))
    prior = SimpleNamespace(bands=lambda: np.array([[1.0, 0.9], [0.9, 1.0]]))
    data = Superpixels(y=y, noise=Noise(white=1e-6))
    found, seen = _even_light(SimpleNamespace(system=system, prior=prior), data, 0.4)
    np.testing.assert_allclose(found + 0.4, truth, atol=5e-3)  # the corners last
    np.testing.assert_allclose(seen, y - 0.4 * blocks.sum(axis=(0, 2)), atol=1e-2)
