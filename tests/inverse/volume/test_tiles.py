"""Windows of lenslets give what all lenslets at once give, and are what the memory has room for."""

import math
from dataclasses import replace

import numpy as np
import pytest

from plenocli.base.budget import Budget, within
from plenocli.base.errors import NumericsError
from plenocli.files.scratch import Scratch
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.forward.volume.stack import Stack
from plenocli.inverse.volume import tiles
from plenocli.inverse.volume.choose import as_before, volume_of
from plenocli.inverse.volume.measurement import Measurement
from plenocli.inverse.volume.tiles import Tiles
from tests.reference import volumes

COUNT, MANY = (21, 26), (2, 3)


@pytest.fixture(scope="module")
def stack():
    parts = volumes.kernels(2, 4, 9)
    return Stack(
        A=np.concatenate([blocks for blocks, _ in parts]).astype(np.float32),
        plane=np.repeat([0, 1], [len(blocks) for blocks, _ in parts]),
        lenslet_offset=np.concatenate([offsets for _, offsets in parts]),
        depth=np.array([-1e-6, 1e-6]),
        spacing=np.full((2, 2), 1e-6),
        pixel_shape=(3, 3),
        point_shape=(2, 2),
        wavelength=5e-7,
        column_energy=np.ones((2, 4)),
        accuracy=AccuracyRecord(asked=1e-3, estimated=1e-3, model="ray", rung="rays", by_source={}),
    )


@pytest.fixture(scope="module")
def measurement(stack):
    rng = np.random.default_rng(4)
    whole = Tiles(
        stack,
        Measurement(signal=np.zeros((*COUNT, 9)), read_variance=1e-4),
        "rl",
        hold_out=0.1,
        seed=1,
    )
    op = whole._op
    light = op.forward(rng.random(op.domain.shape) ** 6)
    return Measurement(signal=light + 0.01 * rng.standard_normal(light.shape), read_variance=1e-4)


def tiled(stack, measurement, method, memory=1 << 40, like=None):
    with within(Budget(memory)):
        found = Tiles(stack, measurement, method, hold_out=0.1, seed=1, like=like)
        return found, found.volume()


def side_of(count, several, halo):
    """Lenslets (rows, columns) of the smallest windows of which `several` cover an array."""
    sides = (n if m == 1 else -(-(n - 2 * halo) // m) + 2 * halo for n, m in zip(count, several))
    return tuple(min(side, n) for side, n in zip(sides, count))


def memory_of(method, several, count=COUNT, halo=1):
    """Bytes with which windows as many as this fit, and no fewer."""
    size = side_of(count, several, halo)
    kernels = sum(4 * blocks.size for blocks, _ in volumes.kernels(2, 4, 9))
    kept = tiles.HELD_BYTES * 0.1 * np.prod(count) * 9 + kernels
    return math.ceil(tiles._needed(method, 9, 8, 2, tiles.torus_for(tuple(size), (1, 1))) + kept)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Chunks."""
    monkeypatch.setattr("plenocli.base.linear_maps.CHUNK", 1 << 10)


@pytest.mark.parametrize("method", ["rl", "lmmse", "tv"])
def test_windows_give_what_all_lenslets_at_once_give(stack, measurement, method):
    whole, expected = tiled(stack, measurement, method)
    parts, found = tiled(stack, measurement, method, memory_of(method, MANY))
    assert len(whole.windows) == 1 < len(parts.windows) <= 6
    rest = np.sqrt(np.mean((found.value - expected.value) ** 2) / np.var(expected.value))
    assert rest < {"rl": 0.25, "lmmse": 0.1, "tv": 0.15}[method]
    less = expected.held_out.explained_db - found.held_out.explained_db
    assert less < {"rl": 1.0, "lmmse": 0.3, "tv": 0.5}[method]
    assert np.array_equal(
        np.sort(np.ravel_multi_index(found.held_out.index.T, (*COUNT, 9))),
        np.sort(np.ravel_multi_index(expected.held_out.index.T, (*COUNT, 9))),
    )
    if expected.sigma is not None:
        assert np.allclose(found.sigma, expected.sigma, rtol=0.15)
    assert len(found.trace) == len(parts.windows)


def test_windows_are_tied_to_their_part_of_another_volume(stack, measurement):
    """To a volume of the same specimen, moved by nothing; and, to see that it matters, moved."""
    clear = tiled(stack, measurement, "tv")[1].value
    rng = np.random.default_rng(8)
    noisy = replace(
        measurement,
        signal=measurement.signal + 0.1 * rng.standard_normal(measurement.signal.shape),
        read_variance=1e-2,
    )
    errors = {}
    for name, like in {"alone": None, "own": clear, "moved": np.roll(clear, 10, axis=2)}.items():
        for memory in (1 << 40, memory_of("tv", MANY)):
            parts, found = tiled(stack, noisy, "tv", memory, like)
            errors[name, len(parts.windows)] = np.linalg.norm(found.value - clear)
            assert (found.likeness is None) == (like is None)
            assert like is None or (found.likeness.share > 0.1) == (name == "own")
    one, several = ({n: v for (n, w), v in errors.items() if (w == 1) == s} for s in (True, False))
    assert len(one) == len(several) == 3
    for found in (one, several):
        assert found["own"] < 0.8 * found["alone"] < 0.85 * found["moved"]


def test_a_pixel_is_put_aside_in_every_window_that_has_it(stack, measurement):
    parts, _ = tiled(stack, measurement, "rl", memory_of("rl", MANY))
    held = np.zeros((*COUNT, 9), int)
    seen = np.zeros_like(held)
    for window in parts.windows:
        problem = parts.problem(window)
        held[window.rows, window.columns] += problem.held
        seen[window.rows, window.columns] += problem.held | problem.counts
    assert seen.max() > 1
    assert np.all((held == 0) | (held == seen))


@pytest.mark.parametrize("count", [(5, 5), (21, 26), (40, 7)])
@pytest.mark.parametrize("several", [(1, 1), (2, 3), (5, 1), (4, 4)])
@pytest.mark.parametrize("halo", [0, 1, 3])
def test_windows_cover_the_array_and_overlap_by_two_halos(count, several, halo):
    windows = tiles._windows(count, side_of(count, several, halo), halo)
    assert len(windows) <= math.prod(several)
    weights, sizes = np.zeros(count), set()
    for window in windows:
        weights[window.rows, window.columns] += window.weight
        sizes.add(window.weight.shape)
        # what counts as more than a trace is a halo from where the window ends, or half of one
        fade = max(1, halo // 2)
        for part, weight, n in ((window.rows, window.row_weight, count[0]),):
            if part.start > 0 and halo > fade:
                assert weight[: halo - fade].max() < 1e-3
            assert 0 <= part.start < part.stop <= n
    assert len(sizes) == 1 and weights.min() > 0.1


@pytest.mark.parametrize("method", ["lmmse", "tv"])
def test_the_volume_of_all_windows_is_the_weighted_mean_of_theirs(
    stack, measurement, method, tmp_path
):
    """Voxel by voxel, from the volumes of the windows; in memory, and in a file."""
    memory = memory_of(method, MANY)
    with within(Budget(memory)):
        parts = Tiles(stack, measurement, method, hold_out=0.1, seed=1)
        first = volume_of(parts.problem(parts.brightest), method)
        again = as_before(first)
        sums, weights, held = np.zeros((3, 2, 42, 52)), np.zeros((42, 52)), {}
        for window in parts.windows:
            part = again(parts.problem(window), None)
            for row in range(42):
                for column in range(52):
                    i, j = row // 2 - window.rows.start, column // 2 - window.columns.start
                    if 0 <= i < len(window.row_weight) and 0 <= j < len(window.column_weight):
                        weight = window.row_weight[i] * window.column_weight[j]
                        at = slice(None), row - 2 * window.rows.start
                        at = *at, column - 2 * window.columns.start
                        weights[row, column] += weight
                        sums[0, :, row, column] += weight * part.value[at]
                        if part.sigma is not None:
                            sums[1, :, row, column] += weight * part.sigma[at]
            for (i, j, pixel), predicted in zip(part.held_out.index, part.held_out.predicted):
                place = i + window.rows.start, j + window.columns.start, pixel
                weight = window.row_weight[i] * window.column_weight[j]
                if weight > held.get(place, (0,))[0]:
                    held[place] = weight, predicted
        found = parts.volume()
        filed = Tiles(
            stack, measurement, method, hold_out=0.1, seed=1, room=Scratch(tmp_path / "v.h5")
        ).volume()
    assert len(parts.windows) > 1
    assert np.allclose(found.value, sums[0] / weights, atol=1e-5 * found.value.max())
    assert (found.sigma is None) == (method == "tv")
    if found.sigma is not None:
        assert np.allclose(found.sigma, sums[1] / weights, rtol=1e-5)
        np.testing.assert_allclose(filed.sigma.whole(), found.sigma, rtol=1e-5)
    np.testing.assert_allclose(filed.value.whole(), found.value, atol=1e-5 * found.value.max())
    told = {tuple(i): p for i, p in zip(found.held_out.index, found.held_out.predicted)}
    assert told.keys() == held.keys()
    assert all(told[i] == pytest.approx(held[i][1], abs=1e-5) for i in told)


def area(side):
    return math.prod(tiles.torus_for(tuple(side), (1, 1)))


def test_windows_fit_fill_the_memory_and_are_then_the_least_work(stack, measurement):
    """Against all sizes, one by one."""
    count = 60, 75
    whole = replace(measurement, signal=np.ones((*count, 9)))
    for share in (0.9, 0.6, 0.4, 0.2):
        memory = int(share * memory_of("rl", (1, 1), count))
        with within(Budget(memory)):
            found = Tiles(stack, whole, "rl", hold_out=0.1, seed=1).windows
        kept = memory_of("rl", (1, 1), count) - tiles._needed(
            "rl", 9, 8, 2, tiles.torus_for(count, (1, 1))
        )
        every = {}
        for side in np.ndindex(61, 76):
            if min(side) < 3:
                continue
            taken = kept + tiles._needed("rl", 9, 8, 2, tiles.torus_for(side, (1, 1)))
            if taken <= memory:
                step = [n if s == n else s - 2 for n, s in zip(count, side)]
                several = [1 if s == n else -(-(n - 2) // d) for n, s, d in zip(count, side, step)]
                every[side] = taken, math.prod(several) * area(side)
        most = max(taken for taken, _ in every.values())
        side = found[0].weight.shape
        full = min(work for taken, work in every.values() if taken >= tiles.FULL * most)
        least = min(work for _, work in every.values())
        dear = full > tiles.DEARER * least
        assert dear == (share == 0.9)
        assert len(found) * area(side) == (least if dear else full)
        assert dear or every[side][0] >= tiles.FULL * most


@pytest.mark.parametrize("method", ["rl", "lmmse"])
def test_windows_take_as_much_whatever_the_array(stack, measurement, method):
    """From the first array on that does not fit: its own share of what was put aside apart."""
    memory = memory_of(method, (1, 1), (40, 44))
    taken = []
    for rows, columns in ((64, 64), (90, 90), (100, 70), (128, 128), (181, 181), (256, 256)):
        values = np.broadcast_to(np.float32(1), (rows, columns, 9))
        with within(Budget(memory)):
            found = Tiles(
                stack, replace(measurement, signal=values), method, hold_out=1e-6, seed=1
            ).windows
        assert len(found) > 1
        torus = tiles.torus_for(found[0].weight.shape, (1, 1))
        taken.append(tiles._needed(method, 9, 8, 2, torus))
    assert max(taken) <= memory and max(taken) < 1.1 * min(taken)


def test_what_does_not_fit_even_so_is_refused(stack, measurement):
    with pytest.raises(NumericsError, match="lenslets"):
        tiled(stack, measurement, "lmmse", 3000)


def test_auto_takes_one_method_for_all_windows(stack, measurement):
    parts, found = tiled(stack, measurement, "auto", memory_of("auto", MANY))
    assert len(parts.windows) > 1 and found.method in ("rl", "lmmse", "tv")
    assert found.value.shape == (2, 42, 52) and np.isfinite(found.value).all()
