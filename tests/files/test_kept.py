import os

import numpy as np
import pytest

from plenocli.files import kept as module
from plenocli.files.kept import folder, kept
from plenocli.inverse.picture.solvers.least_squares import Svd

RNG = np.random.default_rng(4)
MATRIX, OTHER = RNG.normal(size=(2, 9, 6))


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("PLENOCLI_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def decomposed(matrix, made):
    def make():
        made.append(1)
        return np.linalg.svd(matrix, full_matrices=False)

    return kept("svd", [matrix], make)


def same(found, wanted):
    return all(a.tobytes() == b.tobytes() for a, b in zip(found, wanted, strict=True))


def test_what_is_kept_is_what_was_made_and_is_made_once(place):
    made = []
    first, again = decomposed(MATRIX, made), decomposed(MATRIX, made)
    assert len(made) == 1 and same(first, again)
    assert same(again, np.linalg.svd(MATRIX, full_matrices=False))
    decomposed(OTHER, made)
    decomposed(MATRIX.T, made)
    assert len(made) == 3 and len(list(place.iterdir())) == 3


@pytest.mark.parametrize("damage", ["cut", "longer", "bit", "foreign", "empty", "folder"])
def test_damaged_files_are_made_again(place, damage):
    made = []
    wanted = decomposed(MATRIX, made)
    (path,) = place.iterdir()
    data = path.read_bytes()
    flipped = data[:-5] + bytes([data[-5] ^ 1]) + data[-4:]
    foreign = b'{"a": [[1]]}\n' + data
    if damage == "folder":
        path.unlink()
        path.mkdir()
    else:
        path.write_bytes(
            {
                "cut": data[:-8],
                "longer": data + b"1",
                "bit": flipped,
                "foreign": foreign,
                "empty": b"",
            }[damage]
        )
    assert same(decomposed(MATRIX, made), wanted) and len(made) == 2
    decomposed(MATRIX, made)
    assert len(made) == (3 if damage == "folder" else 2)


def test_nothing_is_kept_where_that_is_switched_off_or_impossible(tmp_path, monkeypatch):
    monkeypatch.setenv("PLENOCLI_CACHE", "off")
    made = []
    wanted = decomposed(MATRIX, made)
    assert folder() is None
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("PLENOCLI_CACHE", str(tmp_path / "file"))
    assert same(decomposed(MATRIX, made), wanted)
    decomposed(MATRIX, made)
    assert len(made) == 3 and (tmp_path / "file").read_text() == "no folder"


def test_what_was_not_used_for_longest_makes_room(place, monkeypatch):
    made = []
    decomposed(MATRIX, made)
    (oldest,) = place.iterdir()
    os.utime(oldest, (1, 1))
    size = oldest.stat().st_size
    monkeypatch.setattr(module, "LARGEST", int(2.5 * size))
    decomposed(OTHER, made)
    decomposed(MATRIX, made)  # read, which makes it the younger one
    os.utime(next(f for f in place.iterdir() if f != oldest), (2, 2))
    decomposed(MATRIX + OTHER, made)
    assert len(made) == 3 and len(list(place.iterdir())) == 2 and oldest.exists()
    monkeypatch.setattr(module, "LARGEST", size // 4)
    decomposed(MATRIX - OTHER, made)
    assert len(list(place.iterdir())) == 2


def test_a_second_run_measures_no_photographs_and_has_the_same_bytes(place, monkeypatch):
    """Statistics depend on the pictures, the size of an object and the seed, and on no more."""
    from plenocli.inverse.picture.lenslet_model import LensletMatrix
    from plenocli.inverse.prior import natural_images
    from plenocli.inverse.prior.scene_prior import ScenePrior

    measured, of = [], natural_images.mean_covariance
    monkeypatch.setattr(
        natural_images, "mean_covariance", lambda patches: measured.append(1) or of(patches)
    )
    pictures = [("one", RNG.random((40, 30))), ("two", RNG.random((25, 50)))]
    system = LensletMatrix(
        path=place,
        blocks=RNG.random((1, 16, 9)),
        offsets=np.zeros((1, 2), int),
        object_shape=(3, 3),
        pixel_shape=(4, 4),
        bands=(5.5e-7,),
    )

    def statistics(training, seed, **options):
        svd = Svd(*np.linalg.svd(system.own, full_matrices=False))
        prior = ScenePrior(system, lambda: svd, lambda scene: training, seed, **options)
        prior.lmmse(0.1, None)
        return prior.statistics[None]

    told = statistics(pictures, 1)
    first, again = (statistics(pictures, 1, keep=kept) for _ in range(2))
    assert len(measured) == 2 and same(first, told) and same(again, told)
    other = [pictures[0], ("two", pictures[1][1] * 0.999)]
    assert not same(statistics(pictures, 2**70, keep=kept), told)
    assert not same(statistics(other, 1, keep=kept), told)
    assert len(measured) == 4


def test_what_was_kept_of_another_matrix_or_by_another_user_is_made_again(place, monkeypatch):
    made = []
    wanted = decomposed(MATRIX, made)
    (mine,) = place.iterdir()
    decomposed(OTHER, made)
    (other,) = set(place.iterdir()) - {mine}
    mine.write_bytes(other.read_bytes())
    assert same(decomposed(MATRIX, made), wanted) and len(made) == 3
    monkeypatch.setattr(os, "geteuid", lambda: mine.stat().st_uid + 1)
    assert same(decomposed(MATRIX, made), wanted) and len(made) == 4


def test_a_second_run_decomposes_nothing_whatever_the_noise(place, monkeypatch):
    """Two captures of unlike noise share what superpixels show of photographs."""
    from plenocli.inverse.picture.lenslet_model import LensletMatrix
    from plenocli.inverse.picture.solvers import joint_lmmse
    from plenocli.inverse.prior.scene_prior import ScenePrior

    made = []
    for name in ("shown_directions", "ring_covariances"):
        of = getattr(joint_lmmse, name)
        monkeypatch.setattr(
            joint_lmmse, name, lambda *a, of=of, name=name: made.append(name) or of(*a)
        )
    offsets = np.array([[r, c] for r in (-1, 0, 1) for c in (-1, 0, 1)])
    weight = np.where(offsets.any(axis=1), 0.05, 1)[:, None, None]
    system = LensletMatrix(
        path=place,
        blocks=RNG.random((9, 16, 9)) * weight,
        offsets=offsets,
        object_shape=(3, 3),
        pixel_shape=(4, 4),
    )
    pictures = [("one", RNG.random((40, 45)))]

    def joint(sigma, **options):
        svd = Svd(*np.linalg.svd(system.own, full_matrices=False))
        prior = ScenePrior(system, lambda: svd, lambda scene: pictures, 1, **options)
        found = prior.joint(sigma, None)
        return found.analysis, found.offset, found.cross, found.data, found.variance

    first, again, louder = (joint(s, keep=kept) for s in (0.01, 0.01, 0.02))
    assert made == ["shown_directions", "ring_covariances"]
    assert same(first, again) and same(first, joint(0.01))
    for one, other, power in zip(first, louder, (1, 1, 1, 2, 0), strict=True):
        np.testing.assert_allclose(other * 2**power, one, rtol=1e-7, atol=1e-9 * abs(one).max())
