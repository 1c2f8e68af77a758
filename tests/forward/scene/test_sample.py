import numpy as np
import pytest

from plenocli.base.errors import InputError
from plenocli.forward.scene import sample


def brute(values, count, start, stop):
    """Area average by overlap lengths, one pair at a time."""
    width = (stop - start) / count
    out = np.zeros((count, *values.shape[1:]))
    for i in range(count):
        low, high = start + i * width, start + (i + 1) * width
        for k in range(values.shape[0]):
            out[i] += values[k] * max(0.0, min(high, k + 1) - max(low, k)) / width
    return out


@pytest.mark.parametrize(
    "count, start, stop",
    [(3, 0, 7), (7, 0, 7), (20, 0, 7), (1, 0, 7), (5, 0.3, 6.1), (2, 2.25, 2.5)],
)
def test_area_average_is_the_overlap_sum(count, start, stop):
    values = np.random.default_rng(1).random((7, 2))
    np.testing.assert_allclose(
        sample.area_average(values, count, 0, start, stop),
        brute(values, count, start, stop),
        atol=1e-13,
    )


def test_sampling_keeps_the_mean_of_the_part_it_took():
    picture = np.random.default_rng(2).random((60, 90)).astype(np.float32)
    sampled = sample.sample_picture(picture, 20, 20)
    assert sampled.shape == (20, 20) and sampled.dtype == np.float32
    assert sampled.mean() == pytest.approx(picture[:, 15:75].mean(), rel=1e-6)


def test_sampling_is_centred_and_upright():
    rows, cols = np.mgrid[0:64, 0:64] / 63.0
    sampled = sample.sample_picture(np.stack([rows, cols, 1 - rows], -1), 10, 10)
    assert (np.diff(sampled[:, 0, 0]) > 0).all() and (np.diff(sampled[0, :, 1]) > 0).all()
    np.testing.assert_allclose(sampled + sampled[::-1, ::-1], 1.0, atol=1e-6)


def test_crop_takes_native_pixels():
    picture = np.arange(512 * 512.0).reshape(512, 512)
    np.testing.assert_array_equal(
        sample.sample_picture(picture, 440, 440, "crop"), picture[36:476, 36:476]
    )
    with pytest.raises(InputError, match="smaller"):
        sample.sample_picture(picture, 600, 440, "crop")


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (37, 23), (440, 440)])
def test_a_flat_picture_stays_flat_on_any_grid(shape):
    for rows, cols in [(1, 1), (3, 5), (40, 40), (101, 7)]:
        assert np.allclose(sample.sample_picture(np.full(shape, 0.37), rows, cols), 0.37)


def test_luminance_weights():
    picture = np.zeros((2, 2, 4))
    picture[..., :3] = [1, 0.5, 0.25]
    np.testing.assert_allclose(sample.luminance(picture), 0.2126 + 0.5 * 0.7152 + 0.25 * 0.0722)
    np.testing.assert_array_equal(sample.luminance(picture[..., :1]), picture[..., 0])


def test_block_mean():
    values = np.arange(24.0).reshape(4, 6)
    np.testing.assert_array_equal(sample.block_mean(values, (2, 3)), [[4, 7], [16, 19]])
    with pytest.raises(ValueError, match="whole number"):
        sample.block_mean(values, (3, 3))


def test_a_picture_without_pixels_is_refused():
    with pytest.raises(InputError, match="has no pixels"):
        sample.sample_picture(np.zeros((0, 5)), 2, 2)
