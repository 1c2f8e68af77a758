"""Whether a shared response errs less than own ones, as told from noisy ones alone, against the
errors that truth shows.
"""

import numpy as np
import pytest

from plenocli.inverse.calibration.sharing import differences
from plenocli.inverse.spectra.demultiplex import demultiplex
from tests.reference.prototype import superpixels

COUNT, PIXELS = 60, 20
SIZE = dict(pixels=PIXELS, side=17.0, gap=1.0, blur=0.8, fall=0.2)
GAIN, READ, FULL = 0.25, 4.0, 10000


def lenslets(kind, size, rng):
    """True responses (lenslet, pixel, 4), DN, that differ by `size` in one way."""
    shift = size * rng.standard_normal((COUNT, 2)) if kind == "places" else np.zeros((COUNT, 2))
    true = superpixels(shift, **SIZE)
    if kind == "gains":
        true = true * (1 + size * rng.standard_normal((COUNT, 1, 1)))
    if kind == "bands":
        true = true * (1 + size * rng.standard_normal((COUNT, 1, 4)))
    if kind == "pixels":
        true = true * (1 + size * rng.standard_normal((COUNT, PIXELS**2, 1)))
    if kind == "one":
        true[7] *= 1 + size
    return true * GAIN * FULL


@pytest.mark.parametrize(
    "kind, sizes",
    [
        ("gains", (0, 0.0007, 0.0015, 0.003)),
        ("bands", (0.001, 0.002)),
        ("pixels", (0.003, 0.008, 0.02)),
        ("places", (0.005, 0.02)),
        ("one", (0.01, 0.03)),
    ],
)
def test_the_error_told_is_the_error_made(kind, sizes):
    rng = np.random.default_rng(3)
    radiance = np.ones((COUNT, 4))
    for size in sizes:
        told, made = [], []
        for _ in range(3):
            true = lenslets(kind, size, rng)
            variance = GAIN * true.mean(axis=0) + (GAIN * READ) ** 2
            seen = (true + np.sqrt(variance) * rng.standard_normal(true.shape)).astype(np.float32)
            found = differences(seen, seen.mean(axis=0), variance)
            values = (true @ radiance[..., None])[..., 0]
            error = [
                np.sqrt(np.mean((demultiplex(f, values)[0] - radiance) ** 2))
                for f in (seen, seen.mean(axis=0))
            ]
            told.append(found.error)
            made.append(error[1] / error[0])
            assert [error[0], error[1]][int(found.error < 1)] < 1.05 * min(
                error
            ) or 0.9 < found.error < 1.1
        assert np.mean(told) == pytest.approx(np.mean(made), rel=0.2, abs=0.15), (kind, size)


def test_what_stands_out_of_the_noise_is_named():
    rng = np.random.default_rng(4)
    true = lenslets("one", 0.05, rng)
    # one pixel that differs from lenslet to lenslet
    true[:, 100] *= 1 + 0.3 * rng.standard_normal((COUNT, 1))
    variance = GAIN * true.mean(axis=0) + (GAIN * READ) ** 2
    seen = (true + np.sqrt(variance) * rng.standard_normal(true.shape)).astype(np.float32)
    seen[3, 5] = np.nan
    found = differences(seen, np.nanmean(seen, axis=0), variance)
    assert found.number == 7 and found.worst > 20 and found.error > 1
    expected = true[:, 100].var(axis=0, ddof=1)
    assert found.spread[100, 0] == pytest.approx(expected[0], rel=0.15)
    rest = np.delete(found.spread, 100, axis=0)
    assert (rest == 0).mean() > 0.99


def test_noise_alone_is_no_difference():
    rng = np.random.default_rng(5)
    true = lenslets("gains", 0.0, rng)
    variance = GAIN * true.mean(axis=0) + (GAIN * READ) ** 2
    found = [
        differences(f, f.mean(axis=0), variance)
        for f in (true + np.sqrt(variance) * rng.standard_normal((6, *true.shape)))
    ]
    assert np.mean([one.excess for one in found]) == pytest.approx(1, abs=0.05)
    assert np.mean([one.error for one in found]) == pytest.approx(1 / np.sqrt(COUNT), rel=0.5)
