"""A capture by itself: its signal, and which noise of it is the same for every signal."""

import numpy as np

from plenocli.forward.sensor.capture import Capture, Levels
from plenocli.forward.sensor.noise import Noise

BLACK = np.array([[64.0, 65.0], [66.0, 67.0]])


def test_signal_is_what_lies_above_the_black_level_of_each_position():
    light = np.arange(15.0).reshape(3, 5)
    levels = np.tile(BLACK, (2, 3))[:3, :5]
    mosaic = (light + levels).astype(np.uint16)
    capture = Capture(mosaic=mosaic, levels=Levels(black=BLACK, white=4095.0))
    np.testing.assert_array_equal(capture.signal(), light)
    assert capture.signal().dtype == np.float64 and capture.shape == (3, 5)


def test_masked_pixels_have_no_signal_and_leave_the_mosaic_as_it_is():
    mask = np.zeros((2, 4), bool)
    mask[1, 2] = True
    capture = Capture(mosaic=np.full((2, 4), 7, np.uint16), mask=mask)
    np.testing.assert_array_equal(np.isnan(capture.signal()), mask)
    assert (capture.mosaic == 7).all()


def test_white_noise_is_known_only_where_it_does_not_depend_on_the_signal():
    mosaic = np.zeros((2, 2))
    assert Capture(mosaic=mosaic).white_noise is None
    assert Capture(mosaic=mosaic, noise=Noise(gain=0.25)).white_noise is None
    assert Capture(mosaic=mosaic, noise=Noise.of_sigma(0.5)).white_noise == Noise(white=0.25)
    assert Capture(mosaic=mosaic, noise=Noise()).white_noise == Noise()
