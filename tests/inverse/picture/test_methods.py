"""The methods of reconstruct as objects: what they say of themselves, and the account of a
picture.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plenocli.cli.inverse.reconstruct import METHODS as OFFERED
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.joint import estimate_jointly, own_light
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels, Whole
from plenocli.inverse.picture.methods.registry import METHODS, takers
from plenocli.inverse.picture.reconstruction import Choice, ContrastScale, Reconstruction
from plenocli.inverse.picture.trust.noise_level import NoiseLevel

POINTS, PIXELS, SIGMA = (3, 3), (4, 4), 1e-3
RING = np.array([[r, c] for r in (-1, 0, 1) for c in (-1, 0, 1)])


def made(coupled, **options):
    """(Estimators, capture, true blocks) of a small random camera."""
    rng = np.random.default_rng(0)
    offsets = RING if coupled else np.zeros((1, 2), int)
    blocks = rng.random((len(offsets), 16, 9)) / 16
    blocks *= np.where(offsets.any(axis=1), 0.03, 1)[:, None, None]
    system = LensletMatrix(
        path=Path("pif.h5"),
        blocks=blocks,
        offsets=offsets,
        pixel_shape=PIXELS,
        object_shape=POINTS,
    )
    pictures = [("noise", rng.random((40, 44)))]
    estimators = Estimators(system, Options(**options), lambda scene: pictures)
    x = rng.random((4, 4, 9))
    y = estimators.sensor((4, 4)).forward(x)
    y = y + SIGMA * rng.standard_normal(y.shape)
    return estimators, Superpixels(y=y, noise=Noise.of_sigma(SIGMA)), x


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_own_light_is_what_the_array_leaves_of_its_neighbours(kind):
    """Whose matrix may be in single precision; beyond the array objects go on mirrored."""
    estimators, data, x = made(True)
    system = replace(estimators.system, blocks=estimators.system.blocks.astype(kind))
    alone = x @ system.own.T
    wide = np.pad(x.reshape(4, 4, *POINTS).swapaxes(1, 2).reshape(12, 12), 3, mode="symmetric")
    wide = wide.reshape(6, 3, 6, 3).swapaxes(1, 2).reshape(6, 6, 9)
    seen = sum(
        wide[1 - r : 5 - r, 1 - c : 5 - c] @ block.T.astype(float)
        for block, (r, c) in zip(system.blocks, RING)
    )
    found = own_light(estimators.with_matrix(system), seen, x)
    np.testing.assert_allclose(found, alone, rtol=0, atol=2e-7 if kind is np.float32 else 1e-13)
    joint = estimate_jointly(estimators, data)
    assert np.array_equal(joint.own, own_light(estimators, data.y, joint.value))


def test_the_command_offers_what_there_is():
    assert set(OFFERED) == set(METHODS)
    assert takers("lam") == ("dictionary",) and takers("dictionary") == ("auto", "dictionary")
    assert {name for name, m in METHODS.items() if not m.needs_pif} == {"auto", "block-mean"}
    assert {name for name, m in METHODS.items() if m.hindsight} == {"tikhonov", "tsvd"}
    assert {name for name, m in METHODS.items() if m.in_batches} == {"nnls", "dictionary"}


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("name", [n for n in METHODS if n != "dictionary"])
def test_every_method_gives_a_picture_and_its_account(name, coupled):
    estimators, data, truth = made(coupled, method=name)
    method = METHODS[name]
    found = method.reconstruct(estimators, data)
    assert found.value.shape == truth.shape
    assert np.sqrt(np.mean((found.value - truth) ** 2)) < 0.5
    assert (found.sigma is None) == (found.method == "block-mean")
    assert found.sigma is None or (found.sigma.shape == truth.shape and found.sigma.min() > 0)
    assert found.overlap == (3 if coupled else 1)
    told = json.loads(json.dumps(found.as_json()))
    assert told["method"] == found.method and told["reason"] == found.reason
    assert found.account.as_json() == found.as_json()
    assert method.makes_joint_estimate(estimators) == (
        coupled and name not in ("block-mean", "weighted")
    )
    if found.noise is not None:
        assert told["noise_sigma"] == found.noise.sigma
        assert told["noise_sigma"] == pytest.approx(SIGMA, rel=0.6)
    if name == "auto":
        assert set(told["trial_db"]) == {"lmmse", "pnp"} and found.method in told["trial_db"]


@pytest.mark.parametrize("name, given", [("tikhonov", 1e-3), ("tikhonov", 1e9), ("tsvd", 4)])
def test_regularised_least_squares_are_about_the_mean_of_each_lenslet(name, given):
    """By stacked least squares and by a pseudo-inverse of numpy; a black lenslet stays black."""
    estimators, data, _ = made(
        False, method=name, **{"alpha" if name == "tikhonov" else "rank": given}
    )
    a, y = estimators.system.own, np.array(data.y)
    y[0, 0] = 0
    even = a.sum(axis=1)
    means = (y @ even / (even @ even))[..., None] * np.ones(9)
    left = y - means @ a.T
    if name == "tsvd":
        s = np.linalg.svd(a, compute_uv=False)
        inverse = np.linalg.pinv(a, rcond=(s[3] + s[4]) / 2 / s[0])
    else:
        rows = np.concatenate([a, np.sqrt(given) * np.eye(9)])
        inverse = np.linalg.lstsq(rows, np.eye(25)[:, :16], rcond=None)[0]
    found = METHODS[name].reconstruct(estimators, replace(data, y=y))
    np.testing.assert_allclose(found.value, means + left @ inverse.T, rtol=0, atol=1e-9)
    assert not found.value[0, 0].any()


def test_an_estimate_leaves_nothing_behind():
    """The same capture twice: nothing that the first found is in the second's account."""
    estimators, data, _ = made(True, method="tikhonov")
    one, other = (METHODS["tikhonov"].reconstruct(estimators, data) for _ in range(2))
    assert one.as_json() == other.as_json() and one.value.tobytes() == other.value.tobytes()
    assert [type(entry) for entry in one.trace] == [type(entry) for entry in other.trace]


def test_later_findings_overrule_earlier_ones():
    found = Reconstruction(
        value=np.zeros((1, 1, 9)),
        method="lmmse",
        trace=(
            Choice(method="lmmse", reason="asked for"),
            NoiseLevel(sigma=1.0, source="from the capture", found=1.25),
            ContrastScale(0.5),
            NoiseLevel(sigma=2.0, source="given"),
        ),
    )
    told = found.as_json()
    assert told["noise_sigma"] == 2.0 and told["excess"] == 0.75 and told["scale"] == 0.5
    assert found.as_picture(POINTS).value.shape == POINTS and found.sigma is None


def test_a_tile_takes_over_what_its_whole_knows():
    def piece(values, whole):
        common = Superpixels(y=np.zeros((1, 1, 1)), whole=whole).common
        level = common("power", lambda: np.mean(values), "a")
        return level, common("noise", lambda: max(values)), common("power", lambda: len(values))

    whole = Whole({"unit": {None: 7}})
    assert piece([1, 3], None) == piece([1, 3], whole) == (2, 3, 2)
    beside = whole.for_means()
    assert piece([5, 5, 8], beside) == (6, 3, 3)
    assert whole.closed_with([]).found == whole.found
    tile = whole.closed_with([beside, Whole({})])
    assert piece([0], tile) == (6, 3, 3) and whole.found["power"] == {"a": 2, None: 2}
    # asked more often than there, and not asked there
    assert tile.value("noise", lambda: 0, "again") == 3 and tile.value("kept", lambda: 9, None) == 9
    assert "kept" not in tile.found
