"""Figures of volumes against volumes whose figures are known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from plenocli.base.errors import InputError
from plenocli.evaluation.metrics.volume import score_volume

SPACING = (1e-6, 0.5e-6, 0.5e-6)


@pytest.fixture(scope="module")
def truth():
    return np.random.default_rng(2).random((16, 32, 30))


def test_a_volume_that_is_right_but_for_its_scale_is_right(truth):
    score = score_volume(7 * truth, truth, SPACING)
    assert score.volume_correlation == pytest.approx(1)
    assert score.volume_snr_db > 200
    # down to what the voxels can show
    assert score.lateral_resolution_m == pytest.approx(1e-6)
    assert score.axial_resolution_m == pytest.approx(2e-6)
    assert score.bars is None and score.held_out_db is None


def test_noise_gives_the_snr_that_it_has(truth):
    """One scale makes the best of it: 1/(1 + 1/s), s the power over that of the noise."""
    noise = np.random.default_rng(3).normal(0, 0.1, truth.shape)
    score = score_volume(truth + noise, truth, SPACING)
    power = (truth**2).mean() / 0.1**2
    assert score.volume_snr_db == pytest.approx(10 * np.log10(power + 1), abs=0.1)


def test_resolution_is_where_a_band_ends(truth):
    """What is kept of the truth's transform below a frequency, and foreign above it."""
    other = np.random.default_rng(4).random(truth.shape)
    kz, ky, kx = np.meshgrid(
        *(np.fft.fftfreq(n, d) for n, d in zip(truth.shape, SPACING)), indexing="ij"
    )
    for inside, across in ((np.hypot(ky, kx) < 0.5e6, True), (np.abs(kz) < 0.25e6, False)):
        mixed = np.where(inside, np.fft.fftn(truth), np.fft.fftn(other))
        score = score_volume(np.fft.ifftn(mixed).real, truth, SPACING)
        if across:
            assert score.lateral_resolution_m == pytest.approx(2e-6, rel=0.15)
        else:
            assert score.axial_resolution_m == pytest.approx(4e-6, rel=0.2)


def test_bars_hold_what_normal_errors_make_them(truth):
    rng = np.random.default_rng(5)
    sigma = 0.05 + 0.1 * rng.random(truth.shape)
    score = score_volume(truth + sigma * rng.normal(size=truth.shape), truth, SPACING, sigma=sigma)
    assert score.bars.volume_z_rms == pytest.approx(1, abs=0.02)
    assert score.bars.volume_coverage == pytest.approx(0.95, abs=0.006)
    small = score_volume(
        truth + sigma * rng.normal(size=truth.shape), truth, SPACING, sigma=sigma / 2
    )
    assert small.bars.volume_coverage < 0.75


def test_a_blurred_volume_is_told_from_a_sharp_one(truth):
    blurred = score_volume(gaussian_filter(truth, 1.5), truth, SPACING)
    assert blurred.volume_correlation < 0.5
    # nothing of it falls to half of what it is at the truth's brightest places
    assert np.isnan(blurred.beads.bead_width_m)


@pytest.mark.parametrize("other", [np.ones((16, 32, 30)), np.zeros((2, 2, 2))])
def test_what_cannot_be_compared_is_refused(truth, other):
    with pytest.raises(InputError):
        score_volume(other, truth, SPACING)


def test_beads_are_as_wide_as_their_blur_is():
    """Gaussians: 2.3548 standard deviations wide at half their height."""
    places = np.zeros((32, 60, 60))
    places[[8, 16, 24], [12, 30, 45], [40, 15, 44]] = 1
    truth = gaussian_filter(places, 1.0)
    score = score_volume(gaussian_filter(places, (3.0, 2.0, 2.0)), truth, SPACING)
    assert score.beads.bead_depth_m == pytest.approx(2.3548 * 3e-6, rel=0.02)
    assert score.beads.bead_width_m == pytest.approx(2.3548 * 2 * 0.5e-6, rel=0.02)
    sheet = np.zeros_like(places)
    sheet[16] = 1
    assert (
        score_volume(gaussian_filter(sheet, 1.0), gaussian_filter(sheet, 1.0), SPACING).beads
        is None
    )
