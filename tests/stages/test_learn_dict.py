"""Training pictures: what is left out, how scenes are split, and what learn-dict refuses."""

import numpy as np
import pytest

from plenocli.base.errors import InputError
from plenocli.cli.main import run
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.read.training import DEFAULT, read_training
from plenocli.inverse.prior.natural_images import at_scales, split_by_scene


def test_the_test_picture_is_never_trained_on(capsys):
    assert not any("astronaut" in name for name in DEFAULT)
    left = [name for name, _ in read_training((), (8, 8), not_scene="skimage:coffee")]
    assert "skimage:coffee" not in left and len(left) == len(DEFAULT) - 1
    assert "leaves out skimage:coffee" in capsys.readouterr().err
    with pytest.raises(InputError, match="flatter"):
        read_training(("skimage:coffee",), (8, 8), not_scene="coffee.png")


def test_pictures_are_linear_and_in_range():
    for _, picture in read_training(("skimage:camera", "skimage:coffee"), (8, 8)):
        assert picture.ndim == 2 and picture.min() >= 0 and picture.max() <= 1
    camera = read_training(("skimage:camera",), (8, 8))[0][1]
    assert np.mean(camera) < 0.4  # its sRGB code values have the mean 0.51


def test_split_keeps_scenes_apart():
    pictures = [(str(k), np.zeros((2, 2))) for k in range(11)]
    training, held = split_by_scene(pictures)
    assert [n for n, _ in held] == ["2", "7"] and len(training) == 9
    assert [n for n, _ in split_by_scene(pictures[:2])[1]] == ["1"]


def test_scales_are_area_averages():
    picture = np.random.default_rng(0).random((33, 40))
    scaled = at_scales([("a", picture)], (8, 8))
    assert [p.shape for _, p in scaled] == [(33, 40), (16, 20)]
    assert scaled[1][1][0, 0] == pytest.approx(picture[:2, :2].mean())


@pytest.fixture
def pif(tmp_path):
    a = np.random.default_rng(0).random((1, 1, 16, 9)) / 16
    data = {
        "pif/A": a,
        "pif/wavelength": np.array([550e-9]),
        "pif/lenslet_offset": np.zeros((1, 2), int),
        "pif/pixel_shape": np.array([4, 4]),
        "pif/object_shape": np.array([3, 3]),
        "pif/column_energy": a.sum(axis=(1, 2)),
    }
    write_artefact(tmp_path / "pif.h5", Artefact("pif", data, {}, Provenance(command="test")))
    return tmp_path / "pif.h5"


def learn(pif, *options):
    return run(
        [
            "learn-dict",
            "skimage:camera",
            "skimage:coins",
            "--pif",
            str(pif),
            "--batch",
            "40",
            "--lambda",
            "1e-4",
            *map(str, options),
        ]
    )


def test_refusals(pif, tmp_path, capsys):
    first = tmp_path / "d.h5"
    assert learn(pif, "--iterations", 1, "-o", first) == 0
    assert learn(pif, "--iterations", 1, "-o", first) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (
        learn(pif, "--iterations", 2, "--resume", first, "--atoms", 5, "-o", tmp_path / "e.h5") == 2
    )
    assert learn(pif, "--iterations", 0, "--resume", first, "-o", tmp_path / "e.h5") == 2
    assert (
        run(
            [
                "learn-dict",
                "skimage:moon",
                "--pif",
                str(pif),
                "--resume",
                str(first),
                "-o",
                str(tmp_path / "e.h5"),
            ]
        )
        == 2
    )
    assert "same pictures" in capsys.readouterr().err
    assert learn(first, "-o", tmp_path / "e.h5") == 3
    assert not (tmp_path / "e.h5").exists()


def test_same_seed_same_bytes_and_resume_in_place(pif, tmp_path):
    for name in "ab":
        assert learn(pif, "--iterations", 2, "--seed", 5, "-o", tmp_path / f"{name}.h5") == 0
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert (
        learn(
            pif,
            "--iterations",
            3,
            "--seed",
            5,
            "--resume",
            tmp_path / "a.h5",
            "-o",
            tmp_path / "a.h5",
            "--overwrite",
        )
        == 0
    )


def test_interrupted_at_every_iteration_of_twenty_ends_with_the_same_dictionary(pif, tmp_path):
    from plenocli.files.artefacts.reading import read_artefact

    whole, part = tmp_path / "whole.h5", tmp_path / "part.h5"
    assert learn(pif, "--iterations", 20, "--synthesis", "-o", whole) == 0
    assert learn(pif, "--iterations", 1, "-o", part) == 0
    for done in range(2, 21):  # each goes on from what the one before left in the file
        assert (
            learn(
                pif,
                "--iterations",
                done,
                *(["--synthesis"] if done == 20 else []),
                "--resume",
                part,
                "-o",
                part,
                "--overwrite",
            )
            == 0
        )
    whole, part = (read_artefact(path, "dictionary").data for path in (whole, part))
    assert set(whole) == set(part) and all(
        whole[key].tobytes() == part[key].tobytes() for key in whole
    )


def test_a_run_that_breaks_off_goes_on_from_its_checkpoint(pif, tmp_path, monkeypatch, capsys):
    from plenocli.inverse.sparse.dictionary import Learner

    whole, rest, kept = tmp_path / "whole.h5", tmp_path / "rest" / "whole.h5", tmp_path / "kept.h5"
    rest.parent.mkdir()
    step, taken = Learner.step, []

    def breaking(self, state):
        taken.append(state.iteration)
        if len(taken) == 4:
            raise KeyboardInterrupt
        return step(self, state)

    assert learn(pif, "--iterations", 6, "-o", whole) == 0
    monkeypatch.setattr(Learner, "step", breaking)
    assert learn(pif, "--iterations", 6, "--checkpoint", kept, "-o", rest) != 0
    assert not rest.exists() and kept.exists()
    assert learn(pif, "--iterations", 6, "--checkpoint", kept, "--delta", 0, "-o", rest) == 2
    assert learn(pif, "--iterations", 6, "--checkpoint", kept, "--seed", 1, "-o", rest) == 2
    capsys.readouterr()
    assert learn(pif, "--iterations", 6, "--checkpoint", kept, "-o", rest) == 0
    assert taken == [0, 1, 2, 3, 3, 4, 5] and not kept.exists()
    from plenocli.files.artefacts.reading import read_artefact

    one, other = (read_artefact(path, "dictionary") for path in (whole, rest))
    assert set(one.data) == set(other.data) and all(
        one.data[key].tobytes() == other.data[key].tobytes() for key in one.data
    )
    for name in ("parameters", "notes", "coherence"):
        assert one.attrs["dictionary"][name] == other.attrs["dictionary"][name]


def test_a_checkpoint_with_other_defaults_is_not_taken(pif, tmp_path, monkeypatch):
    from plenocli.inverse.sparse.dictionary import Learner

    kept = tmp_path / "kept.h5"
    with monkeypatch.context() as patch:
        patch.setattr(Learner, "synthesis", lambda *_: 1 / 0)
        assert (
            learn(
                pif,
                "--iterations",
                1,
                "--delta",
                0,
                "--synthesis",
                "--checkpoint",
                kept,
                "-o",
                tmp_path / "d.h5",
            )
            != 0
        )
    assert kept.exists()
    # the default delta is another
    assert learn(pif, "--iterations", 1, "--checkpoint", kept, "-o", tmp_path / "d.h5") == 2
    assert learn(pif, "--iterations", 1, "--checkpoint", kept, "-o", kept) == 2
    assert learn(pif, "--iterations", 1, "--checkpoint", pif, "-o", tmp_path / "d.h5") == 4
    assert (
        learn(pif, "--iterations", 1, "--delta", 0, "--checkpoint", kept, "-o", tmp_path / "d.h5")
        == 0
    )


@pytest.mark.parametrize("level", [0.0, 1.0, -1.0])
def test_a_picture_without_structure_teaches_nothing(tmp_path, level):
    from plenocli.files.images.exr import write_exr

    write_exr(tmp_path / "flat.exr", {"Y": np.full((20, 20), level, np.float32)}, {})
    with pytest.raises(InputError, match="no structure"):
        read_training((str(tmp_path / "flat.exr"),), (8, 8))


def test_a_folder_stands_for_its_pictures(tmp_path, capsys):
    from plenocli.files.images.exr import write_exr

    rng = np.random.default_rng(0)
    (tmp_path / "more").mkdir()
    for name in ("b", "more/a"):
        write_exr(tmp_path / f"{name}.exr", {"Y": rng.random((20, 20), dtype=np.float32)}, {})
    write_exr(tmp_path / "c.exr", {"Y": np.zeros((20, 20), np.float32)}, {})
    (tmp_path / "broken.png").write_bytes(b"no picture")
    (tmp_path / "notes.txt").write_text("not looked at")
    found = read_training((str(tmp_path),), (8, 8))
    assert [name[len(str(tmp_path)) + 1 :] for name, _ in found] == ["b.exr", "more/a.exr"]
    told = capsys.readouterr().err
    assert "broken.png" in told and "c.exr" in told and "notes" not in told
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no pictures"):
        read_training((str(tmp_path / "empty"),), (8, 8))


def test_pictures_that_do_not_fit_lie_in_a_file():
    names = ("skimage:camera", "skimage:coins")
    held, spilled = (
        at_scales(read_training(names, (8, 8), limit=limit), (8, 8), limit=limit)
        for limit in (None, 300_000)
    )
    assert not any(isinstance(p, np.memmap) for _, p in held) and any(
        isinstance(p, np.memmap) for _, p in spilled
    )
    for (name, one), (other_name, other) in zip(held, spilled, strict=True):
        assert name == other_name
        np.testing.assert_array_equal(one, other)


def test_history_is_told_line_by_line(pif, tmp_path, capsys):
    assert (
        run(
            [
                "learn-dict",
                "skimage:camera",
                "skimage:coins",
                "--pif",
                str(pif),
                "--batch",
                "40",
                "--lambda",
                "1e-6",
                "--iterations",
                "2",
                "-o",
                str(tmp_path / "d.h5"),
            ]
        )
        == 0
    )
    told = capsys.readouterr().err
    assert "iteration 1: validation" in told and "iteration 2: validation" in told
    assert (
        run(
            [
                "learn-dict",
                "skimage:camera",
                "--pif",
                str(pif),
                "--lambda",
                "loud",
                "-o",
                str(tmp_path / "e.h5"),
            ]
        )
        == 2
    )


def test_atoms_that_paint_are_kept_beside_those_that_code(pif, tmp_path):
    from plenocli.files.artefacts.reading import read_artefact

    assert learn(pif, "--iterations", 1, "--synthesis", "-o", tmp_path / "a.h5") == 0
    assert learn(pif, "--iterations", 1, "-o", tmp_path / "b.h5") == 0
    one, other = (read_artefact(tmp_path / f"{n}.h5", "dictionary") for n in "ab")
    np.testing.assert_array_equal(one.data["dictionary/atoms"], other.data["dictionary/atoms"])
    assert (
        one.data["dictionary/synthesis"].shape == (9, 9)
        and "dictionary/synthesis" not in other.data
    )


def test_gradient_steps_are_part_of_what_a_resumed_run_keeps(pif, tmp_path, capsys):
    assert learn(pif, "--iterations", 1, "--gradient-steps", 5, "-o", tmp_path / "a.h5") == 0
    assert (
        learn(
            pif,
            "--iterations",
            2,
            "--gradient-steps",
            6,
            "--resume",
            tmp_path / "a.h5",
            "-o",
            tmp_path / "b.h5",
        )
        == 2
    )
    assert "gradient_steps = 5" in capsys.readouterr().err
    assert (
        learn(pif, "--iterations", 2, "--resume", tmp_path / "a.h5", "-o", tmp_path / "b.h5") == 0
    )


def test_quality_that_falls_is_told_with_what_to_do(pif, tmp_path, capsys):
    """Batches of as many patches as atoms, refitted afresh: what is learnt is their noise."""
    assert learn(pif, "--iterations", 6, "--pull", 0, "--batch", 12, "-o", tmp_path / "a.h5") == 0
    said = capsys.readouterr()
    assert "held-out patches had" in said.err and "a larger --batch or --pull" in said.err
    assert "before learning" in said.out and "random atoms" in said.out


def test_lambda_is_chosen_again_once_atoms_were_learnt(pif, tmp_path, capsys):
    """And a run that goes on keeps what was chosen: its bytes are those of one long run."""
    for name, *options in (
        ("long", "--iterations", 3),
        ("short", "--iterations", 1),
        ("on", "--iterations", 3, "--resume", tmp_path / "short.h5"),
    ):
        output = tmp_path / f"{name}.h5"
        known = ["skimage:camera", "skimage:coins", "--pif", str(pif), "--batch", "40"]
        asked = ["learn-dict", *known, "--init", "random", *map(str, options), "-o", str(output)]
        assert run(asked) == 0
        said = capsys.readouterr().err
        assert said.count("lambda =") == (0 if name == "on" else 2)
    from plenocli.files.artefacts.reading import read_artefact

    whole, resumed = (read_artefact(tmp_path / f"{n}.h5", "dictionary") for n in ("long", "on"))
    assert whole.attrs["dictionary"]["lambda"] == resumed.attrs["dictionary"]["lambda"]
    np.testing.assert_array_equal(whole.data["dictionary/atoms"], resumed.data["dictionary/atoms"])
