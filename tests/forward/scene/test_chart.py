import numpy as np
import pytest

from plenocli.forward.scene import chart, statistics, tables


def test_patches_fill_their_share_and_sit_where_they_should():
    labels = chart.chart_labels(400, 600, gap=0.2)
    counts = np.bincount(labels.ravel(), minlength=25)
    np.testing.assert_array_equal(counts[1:], 80 * 80)
    assert (
        labels[50, 50] == 1
        and labels[50, 550] == 6
        and labels[350, 50] == 19
        and labels[350, 550] == 24
    )
    assert not labels[0].any() and not labels[:, 100].any()


def test_without_gaps_the_whole_grid_is_chart():
    assert chart.chart_labels(8, 12, gap=0).min() == 1


def test_whole_cells_are_those_that_see_one_patch_only():
    fine = chart.chart_labels(1100, 1100, gap=0.15)
    blocks = fine.reshape(11, 100, 11, 100).transpose(0, 2, 1, 3).reshape(11, 11, -1)
    pure = np.where((blocks == blocks[..., :1]).all(-1), blocks[..., 0], 0)
    np.testing.assert_array_equal(chart.chart_labels(11, 11, gap=0.15, whole_cells=True), pure)
    assert (pure > 0).any() and (pure == 0).any()


def test_scene_carries_the_table():
    wavelengths = np.array([450e-9, 540e-9, 570e-9, 650e-9])
    cube, labels = chart.chart_scene(40, 60, wavelengths, gap=0.1)
    table = tables.colorchecker(wavelengths)[2]
    assert cube.shape == (4, 40, 60) and cube.dtype == np.float32
    for label in range(1, 25):
        np.testing.assert_allclose(
            cube[:, labels == label],
            np.repeat(table[label - 1][:, None], (labels == label).sum(), 1),
            rtol=1e-6,
        )
    np.testing.assert_allclose(cube[:, labels == 0], 0.03, rtol=1e-6)
    np.testing.assert_array_equal(labels[5::10, 5::10].ravel(), np.arange(1, 25))


def test_gap_is_checked():
    with pytest.raises(ValueError, match="share"):
        chart.chart_labels(4, 6, gap=1)


def test_radiance_statistics_are_those_of_the_radiances():
    reflectance = np.random.default_rng(4).random((200, 3))
    light = np.array([2.0, 5.0, 0.1])
    mean, covariance = statistics.radiance_statistics(
        *statistics.reflectance_statistics(reflectance), light
    )
    np.testing.assert_allclose(mean, (reflectance * light).mean(0))
    np.testing.assert_allclose(covariance, np.cov((reflectance * light).T, bias=True))
