"""A chart seen at an angle under uneven light, painted from closed forms."""

import numpy as np
import pytest

from plenocli.base.errors import NumericsError
from plenocli.forward.scene.target import (
    find_chart,
    outside,
    paper_field,
    patch_cores,
    project,
    upright,
)
from tests.reference.chart import CHART, SHAPE, label_map, light, place


def test_the_chart_is_found_from_its_patches():
    found = find_chart(label_map())
    corners = np.array([[0, 0], [0, 6], [4, 0], [4, 6], [2, 3]], float)
    truth = np.concatenate([corners, np.ones((5, 1))], axis=1) @ CHART.T
    # centroids of patches in perspective
    np.testing.assert_allclose(project(found, corners), truth[:, :2] / truth[:, 2:], atol=0.5)
    np.testing.assert_allclose(
        project(np.linalg.inv(found), project(found, corners)), corners, atol=1e-9
    )


def test_a_chart_needs_patches_that_are_not_in_a_line():
    labels = label_map()
    with pytest.raises(NumericsError, match="3 patches"):
        find_chart(np.where(labels <= 3, labels, 0))
    with pytest.raises(NumericsError, match="line"):
        find_chart(np.diag(np.arange(7)))


def test_cores_lose_their_edges():
    labels = np.zeros((30, 30), int)
    labels[5:25, 5:25] = 7
    np.testing.assert_array_equal(
        np.argwhere(patch_cores(labels, 4) == 7), np.argwhere(np.pad(np.ones((12, 12)), 9))
    )


@pytest.mark.parametrize("mosaic", ["all", "quarter", "chequered"])
def test_upright_shows_a_slope_of_the_chart_as_it_is(mosaic):
    at = place()
    sites = {
        "all": np.ones(SHAPE, bool),
        "quarter": np.zeros(SHAPE, bool),
        "chequered": np.add.outer(*(np.arange(n) for n in SHAPE)) % 2 == 0,
    }[mosaic]
    sites[1::2, ::2] |= mosaic == "quarter"
    picture = np.where(sites, 1 + 0.2 * at[..., 0] + 0.1 * at[..., 1], 1e6)
    picture[sites & (np.arange(sites.size).reshape(SHAPE) % 97 == 0)] = np.nan
    found = upright(picture, sites, CHART, (16, 24))
    y, x = np.meshgrid((np.arange(16) + 0.5) / 4, (np.arange(24) + 0.5) / 4, indexing="ij")
    np.testing.assert_allclose(found, 1 + 0.2 * y + 0.1 * x, atol=0.004)


def test_the_light_on_the_chart_is_told_by_printed_paper_around_it():
    truth = np.array(
        [
            light(np.array(k))
            for k in ([-0.1, -0.4, -0.05, 0.03, -0.1], [0.1, -0.2, 0.02, -0.05, -0.2])
        ]
    )
    rng = np.random.default_rng(2)
    where = outside(CHART, SHAPE)
    paper = np.where(rng.uniform(size=SHAPE) < 0.25, 0.2, 0.85)  # printed dots
    paper[:40, 200:] = 0.1  # something dark lies on it
    pictures = truth * np.where(where, paper, 0.3) * rng.normal(1, 0.01, (2, *SHAPE))
    sites = np.broadcast_to(np.add.outer(*(np.arange(n) for n in SHAPE)) % 2 == 0, pictures.shape)
    field, blocks = paper_field(pictures, sites, where)
    ratio = (field / truth)[:, ~where]
    assert (ratio.std(axis=1) / ratio.mean(axis=1) < 0.01).all() and blocks > 40
    with pytest.raises(NumericsError, match="blocks"):
        paper_field(pictures, sites, where & (np.arange(SHAPE[1]) < 30))


def test_outside_leaves_a_frame():
    y, x = np.moveaxis(place(), -1, 0)
    truth = (y < -0.35) | (y > 4.35) | (x < -0.35) | (x > 6.35)
    assert (outside(CHART, SHAPE) != truth).mean() < 1e-3
