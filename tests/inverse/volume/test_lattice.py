"""Light of a smooth specimen from the means over its voxels, against the integral."""

import math

import numpy as np
import pytest

from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.forward.volume.plan import BOX
from plenocli.forward.volume.stack import Stack
from plenocli.inverse.volume import lattice

POINTS, REACH, COUNT = 3, 3, (9, 9)
"""Voxels along a lenslet, which are its pixels as well; offsets kept; lenslets."""
BLUR, SIZE = 1.1, 1.3
"""Standard deviations of the kernels in focus and of the specimen, in voxels and planes."""
PLANES = np.arange(-6, 7)
MIDDLE = (0.3, 13.2, 13.6)
"""Of the specimen: plane, row, column."""


def blur(z):
    return BLUR + 0.12 * abs(z)


def gauss(x, width):
    return np.exp(-0.5 * (x / width) ** 2) / (width * math.sqrt(2 * math.pi))


def mean(low, high, width):
    """Of a Gaussian of height 1 about 0 between two places."""
    part = math.erf(high / width / math.sqrt(2)) - math.erf(low / width / math.sqrt(2))
    return width * math.sqrt(math.pi / 2) * part / (high - low)


def kernels(z):
    """(offset, pixel, point) and offsets: a Gaussian blur, the mean over BOX places of a voxel."""
    inside = (np.arange(BOX) + 0.5) / BOX - 0.5
    side = range(-REACH, REACH + 1)
    away = np.array(
        [
            [[o * POINTS + pixel - point for point in range(POINTS)] for pixel in range(POINTS)]
            for o in side
        ]
    )
    one = gauss(away[..., None] - inside, blur(z)).mean(axis=-1)
    both = np.einsum("aps,bqt->abpqst", one, one)
    offsets = np.array([[a, b] for a in side for b in side])
    return both.reshape(len(offsets), POINTS**2, POINTS**2), offsets


@pytest.fixture(scope="module")
def stack():
    parts = [kernels(z) for z in PLANES]
    return Stack(
        A=np.concatenate([blocks for blocks, _ in parts]),
        plane=np.repeat(np.arange(len(PLANES)), [len(blocks) for blocks, _ in parts]),
        lenslet_offset=np.concatenate([offsets for _, offsets in parts]),
        depth=PLANES * 1e-6,
        spacing=np.full((len(PLANES), 2), 1e-6),
        pixel_shape=(POINTS, POINTS),
        point_shape=(POINTS, POINTS),
        wavelength=5e-7,
        column_energy=np.ones((len(PLANES), POINTS**2)),
        accuracy=AccuracyRecord(asked=1e-3, estimated=1e-3, model="ray", rung="rays", by_source={}),
    )


def specimen(edge):
    """Means over voxels, (plane, row, column), of a Gaussian ball; `edge` half a voxel."""
    axes = [PLANES, *(np.arange(POINTS * n) for n in COUNT)]
    parts = [[mean(x - m - edge, x - m + edge, SIZE) for x in xs] for xs, m in zip(axes, MIDDLE)]
    return np.einsum("a,b,c->abc", *map(np.array, parts))


def true_light():
    """(row, column) of pixels: Gaussians convolved laterally, summed over 40 lines a plane."""
    fine = np.arange(PLANES[0] - 0.5 + 1 / 80, PLANES[-1] + 0.5, 1 / 40)
    pixels = np.arange(POINTS * COUNT[0])
    total = 0
    for z in fine:
        wide = math.hypot(SIZE, blur(z))
        row, column = (gauss(pixels - m, wide) * SIZE * math.sqrt(2 * math.pi) for m in MIDDLE[1:])
        total = total + math.exp(-0.5 * ((z - MIDDLE[0]) / SIZE) ** 2) / 40 * np.outer(row, column)
    return total


def error(op, voxels, volume):
    """Of the light on pixels, relative."""
    x = np.zeros(op.domain.shape)
    x[: COUNT[0], : COUNT[1]] = voxels.lenslets(volume)
    light = op.forward(x).reshape(*COUNT, POINTS, POINTS).transpose(0, 2, 1, 3)
    truth = true_light()
    return np.linalg.norm(light.reshape(truth.shape) - truth) / np.linalg.norm(truth)


def test_means_of_voxels_give_the_light_of_what_is_smooth(stack, monkeypatch):
    means = specimen(0.5)
    voxels = lattice.voxels_of(stack)
    mended = error(lattice.map_of(stack, COUNT), voxels, means)
    monkeypatch.setattr(lattice, "_smooth", lambda op, voxels: None)
    plain = error(lattice.map_of(stack, COUNT), voxels, means)
    assert plain > 0.02
    assert mended < plain / 8


def test_an_even_specimen_is_as_bright_as_before(stack, monkeypatch):
    op = lattice.map_of(stack, COUNT)
    monkeypatch.setattr(lattice, "_smooth", lambda op, voxels: None)
    before = lattice.map_of(stack, COUNT)
    ones = np.ones(op.domain.shape)
    np.testing.assert_allclose(op.forward(ones), before.forward(ones), rtol=1e-10)


def test_planes_at_uneven_distances_stay_apart(stack):
    some = stack.only([0, 1, 5])
    op, voxels = lattice.map_of(some, COUNT), lattice.voxels_of(some)
    single = lattice.map_of(stack.only([5]), COUNT)
    x = np.zeros(op.domain.shape)
    x[4, 4, 2 * POINTS**2 + 4] = 1
    alone = np.zeros(single.domain.shape)
    alone[4, 4, 4] = 1
    assert len(voxels.depths) == 3
    np.testing.assert_allclose(op.forward(x), single.forward(alone), atol=1e-12)
