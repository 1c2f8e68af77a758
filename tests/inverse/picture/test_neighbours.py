"""What neighbouring lenslets tell of each other where there is much noise: a picture without the
chessboard that lenslets by themselves leave. Captured by a camera whose lenslets and pixels are a
thousandth larger than assumed, of photographs that no training sees.
"""

import numpy as np
import pytest

import plenocli as pc

POINTS = (16, 16)


@pytest.fixture(scope="module")
def cameras():
    assumed = pc.read_camera(pc.sample("demo_spatial.toml"))
    assumed = assumed.replace(**{"lenslet_array.count": (6, 6)})
    other = assumed.replace(
        **{
            "lenslet_array.pitch": assumed.lenslet_array.pitch * 1.001,
            "sensor.pixel_pitch": assumed.sensor.pixel_pitch * 1.001,
        }
    )
    return tuple(
        pc.system_matrix(c, superpixels=(1, 1), coherent_ring=0, accuracy=1e-4, model="fresnel")
        for c in (assumed, other)
    ), other


def jumps(picture):
    """Mean square step across the borders of lenslets."""
    rows, columns = (np.arange(n, size, n) for n, size in zip(POINTS, picture.shape))
    across = picture[rows] - picture[rows - 1], picture[:, columns] - picture[:, columns - 1]
    return float(np.mean([np.mean(step**2) for step in across]))


@pytest.mark.parametrize("scene", ["astronaut", "coffee"])
def test_neighbours_take_the_chessboard_away(cameras, scene):
    (assumed, right), other = cameras
    capture = pc.simulate_capture(other, f"skimage:{scene}", matrix=right, snr_db=20, seed=3)
    alone, wide, auto = (
        pc.reconstruct(capture, assumed, method=method, overlap=overlap)
        for method, overlap in (("pnp", 1), ("pnp", None), ("auto", None))
    )
    truth = capture.scene[0]
    quality = [pc.score(found, capture.scene).psnr_db for found in (alone, wide, auto)]
    assert quality[1] > quality[0] + 0.1 and quality[2] > max(quality) - 0.1, quality
    steps = [jumps(found.value) for found in (alone, wide)]
    assert steps[1] < steps[0] and steps[1] < 1.5 * jumps(truth), (steps, jumps(truth))
    assert "3x3" in wide.as_json()["start"] and "3x3" not in alone.as_json()["start"]


def test_with_little_noise_a_lenslet_tells_all_by_itself(cameras):
    (assumed, right), other = cameras
    capture = pc.simulate_capture(other, "skimage:coffee", matrix=right, snr_db=90, seed=3)
    found = pc.reconstruct(capture, assumed, method="pnp", noise_sigma=1e-6)
    assert "3x3" not in found.as_json()["start"]


def test_light_from_two_lenslets_away_speaks_against_no_matrix():
    """Blur over 5x5 superpixels, the capture by the very matrix that inverts it: light from beyond
    the array, of which nothing is known, was taken for an error of the matrix (noise raised
    twofold, 0.4 to 0.9 dB lost).
    """
    camera = pc.read_camera(pc.sample("tiny.toml")).replace(
        **{
            "object.distance": 0.556,
            "lenslet_array.count": (10, 10),
            "main_lens.aperture_shape": "square",
        }
    )
    matrix = pc.system_matrix(camera, accuracy=1e-2, superpixels=(5, 5))
    for scene, least in (("coins", 24.1), ("camera", 24.9)):
        capture = pc.simulate_capture(camera, f"skimage:{scene}", matrix=matrix, snr_db=40, seed=1)
        found = pc.reconstruct(capture, matrix, method="lmmse")
        told = found.as_json()
        assert told["matrix_believed"] and told["noise_raised"] == 1
        assert told["defects"]["dark"] + told["defects"]["bright"] == 0
        assert pc.score(found, capture.scene).psnr_db > least
