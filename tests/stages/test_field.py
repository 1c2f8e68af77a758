"""Whole arrays whose lenslets see different pupils: simulate-pif, capture-sim, reconstruct."""

import math

import numpy as np
import pytest

from plenocli.base.errors import InputError, NumericsError
from plenocli.base.tiling import to_blocks
from plenocli.cli.main import run
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.shards import read_field, read_pif
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.config.camera_file import to_toml
from plenocli.inverse.picture import tiles
from plenocli.stages.inverse.reconstruct import field_classes
from tests.forward.propagation.cameras import small_camera

COUNT = 13


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A camera whose corner sees 0.6 of the pupil and 0.3 waves of coma; its matrices and a
    capture.
    """
    where = tmp_path_factory.mktemp("field")
    probe = small_camera(lenslet_array__count=(COUNT, COUNT))
    corner = math.sqrt(2) * (COUNT - 1) / 2 * probe.lenslet_array.pitch
    terms = [{"noll": 8, "coefficient": 150e-9}]
    rows = [
        {"height": 0.0},
        {"height": corner * 1.001, "transmission": 0.6, "aberrations": terms},
    ]
    camera = small_camera(lenslet_array__count=(COUNT, COUNT), main_lens__field=rows)
    (where / "camera.toml").write_text(to_toml(camera))
    isolated = ["--superpixels", "1x1", "--coherent-ring", "0", "--accuracy", "1e-2"]
    isolated += ["--model", "fresnel"]
    simulate = ["simulate-pif", str(where / "camera.toml"), *isolated]
    assert run([*simulate, "-o", str(where / "one.h5")]) == 0
    assert run([*simulate, "--field-nodes", "auto", "-o", str(where / "field.h5")]) == 0
    capture = ["capture-sim", str(where / "camera.toml"), "--scene", "skimage:camera"]
    capture += ["--snr", "50dB", "-o", str(where / "capture.h5"), *isolated]
    assert run([*capture, "--field-nodes", "9"]) == 0
    return where


def place_of(nodes, lenslet, count):
    pitch = (nodes.rows[-1] - nodes.rows[0]) / (count - 1)
    return tuple(float((n - (count - 1) / 2) * pitch) for n in lenslet)


def test_every_lenslet_of_a_capture_has_its_own_matrix(folder):
    """Without noise the superpixel of a lenslet is its interpolated matrix times its object."""
    capture = folder / "exact.h5"
    words = ["--scene", "skimage:camera", "--noise", "none", "--pif", str(folder / "field.h5")]
    assert run(["capture-sim", str(folder / "camera.toml"), *words, "-o", str(capture)]) == 0
    made, (nodes, _) = read_artefact(capture, "capture"), read_field(folder / "field.h5")
    y = to_blocks(made.data["capture/mosaic"], (13, 13))
    x = to_blocks(np.squeeze(made.data["capture/scene"]).astype(float), (8, 8))
    for lenslet in ((0, 0), (0, 12), (6, 6), (11, 3)):
        place = place_of(nodes, lenslet, COUNT)
        A = read_pif(folder / "field.h5", place=place).data["pif/A"][0, 0]
        # what polynomials make negative is cut off in a matrix by itself
        assert np.allclose(y[lenslet], A @ x[lenslet], atol=1e-3 * y[lenslet].max())
    corner, axis = (
        read_pif(folder / "field.h5", place=p).data["pif/A"].sum() for p in (place, (0.0, 0.0))
    )
    assert corner < axis


def test_the_index_says_what_it_was_made_to_hold(folder):
    nodes, parts = read_field(folder / "field.h5")
    assert nodes.error < 0.5e-2 and len(parts) == len(nodes.numbers) < nodes.file.size
    record = parts[0].provenance.accuracy
    assert record["by_source"]["field"] == pytest.approx(nodes.error)
    assert record["field_error"] == 0
    one = read_artefact(folder / "one.h5", "pif").provenance.accuracy
    assert one["field_error"] > 0.3


def test_classes_of_lenslets_see_more_than_one_matrix(folder):
    truth = np.squeeze(read_artefact(folder / "capture.h5").data["capture/scene"]).astype(float)
    rms = {}
    for name in ("one", "field"):
        out = folder / f"picture-{name}.h5"
        words = ["--pif", str(folder / f"{name}.h5"), "--method", "lmmse", "-o", str(out)]
        assert run(["reconstruct", str(folder / "capture.h5"), *words]) == 0
        rms[name] = np.sqrt(np.mean((read_artefact(out).data["image/value"] - truth) ** 2))
    assert rms["field"] < 0.93 * rms["one"]


@pytest.mark.parametrize(
    "words, message",
    [
        (["simulate-pif", "C", "--lenslet", "0,0", "--field-nodes", "3"], "exclude each other"),
        (["simulate-pif", "C", "--field-nodes", "4"], "not auto or an odd number"),
        (["capture-sim", "C", "--scene", "skimage:camera", "--pif", "F", "--field-nodes", "3"],
         "--field-nodes computes its own"),
        (["reconstruct", "capture.h5", "--pif", "F", "--fit"], "not by those of a whole array"),
        (["learn-dict", "x.png", "--pif", "F"], "places of the field, of which one is due"),
        (["show", "F"], "places of the field, of which one is due"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(folder, capsys, words, message):
    names = {"C": "camera.toml", "F": "field.h5", "capture.h5": "capture.h5"}
    words = [str(folder / names[w]) if w in names else w for w in words]
    out = "out.png" if words[0] == "show" else "out.h5"
    assert run([*words, "-o", str(folder / out)]) in (2, 3)
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (folder / "out.h5").exists()


def test_files_that_were_changed_are_told(folder, tmp_path):
    for file in folder.glob("field*.h5"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "field.001.h5").write_bytes((tmp_path / "field.000.h5").read_bytes())
    with pytest.raises(InputError, match="is not the file that field.h5 was written with"):
        read_field(tmp_path / "field.h5")


def lmmse(folder, out, *more):
    """Words of a command, and what its file holds once it ran."""
    words = ["reconstruct", str(folder / "capture.h5"), "--pif", str(folder / "field.h5")]
    assert run([*words, "--method", "lmmse", *more, "-o", str(out)]) == 0
    return read_artefact(out, "image")


@pytest.mark.slow
def test_classes_are_no_larger_than_a_tile_and_go_on_from_those_that_are_finished(
    folder, tmp_path, monkeypatch
):
    """By two workers the same, and as good as larger ones."""
    truth = np.squeeze(read_artefact(folder / "capture.h5").data["capture/scene"]).astype(float)
    large = lmmse(folder, tmp_path / "large.h5")
    monkeypatch.setattr(tiles, "AT_ONCE", 9 * (13**2 + 8**2 + tiles.FURTHER))
    one, two = (lmmse(folder, tmp_path / f"{n}.h5", "--workers", n) for n in "12")
    for name, values in one.data.items():
        np.testing.assert_array_equal(two.data[name], values)
    off = [np.sqrt(np.mean((p.data["image/value"] - truth) ** 2)) for p in (large, one)]
    assert off[1] == pytest.approx(off[0], rel=0.02)
    solved, solve = [], field_classes._ClassTask.__call__

    def counted(self, job):
        if len(solved) == 5 and not resumed:
            raise NumericsError("the power went off")
        solved.append(job[0])
        return solve(self, job)

    monkeypatch.setattr(field_classes._ClassTask, "__call__", counted)
    resumed = False
    with pytest.raises(AssertionError):
        lmmse(folder, tmp_path / "out.h5")
    assert len(list(tmp_path.glob(".out.h5.*.tiles/*"))) == 6  # that in the middle comes first
    resumed = True
    again = lmmse(folder, tmp_path / "out.h5")
    middle = set(range(25)) - set(solved)
    assert middle == {12} and len(solved) == 24
    for name, values in one.data.items():
        np.testing.assert_array_equal(again.data[name], values)


def test_what_is_found_in_any_class_is_counted(folder, tmp_path, capsys):
    made = read_artefact(folder / "capture.h5")
    mosaic = made.data["capture/mosaic"].copy()
    mosaic[[7, 80, 160], [5, 84, 150]] *= 3
    data = made.data | {"capture/mosaic": mosaic}
    hot = Artefact(made.kind, data, made.attrs, made.provenance)
    write_artefact(tmp_path / "capture.h5", hot)
    words = ["reconstruct", str(tmp_path / "capture.h5"), "--pif", str(folder / "field.h5")]
    assert run([*words, "--method", "lmmse", "-o", str(tmp_path / "out.h5")]) == 0
    told = read_artefact(tmp_path / "out.h5").attrs["image"]["parameters"]["defects"]
    assert told["bright"] == 3 and told["pixels"] == mosaic.size
    assert "3 of" in capsys.readouterr().err
