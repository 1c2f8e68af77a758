"""Score documents read back: what score writes, what is missing, and nonsense."""

import copy
import json

import numpy as np
import pytest

from plenocli.base.errors import InputError
from plenocli.evaluation.metrics.figures import figures
from plenocli.evaluation.metrics.quality import score_picture
from plenocli.evaluation.scores import InputFile, PatchScore, ResultScore, ScoreDocument
from plenocli.files.results.scores import json_pieces, read_scores
from plenocli.files.seal import publish_sealed
from plenocli.stages.evaluation.report import run_report

PATCH = PatchScore(
    label=19,
    name="white",
    lenslets=4,
    mean=[0.8, 0.9],
    std=[0.01, 0.02],
    truth=[0.8, 0.8],
    one_of_six=True,
)
DOCUMENT = ScoreDocument(
    results=(
        ResultScore(
            name="a.h5",
            label="a",
            kind="spectra",
            method="pinv",
            wavelengths_nm=(450.0, 550.0),
            figures={"rmse": 0.1, "rmse_per_band": [0.1, None], "snr_target": "white target"},
            patches=(PATCH,),
        ),
        ResultScore(name="b.h5", label="b", error="is damaged"),
    ),
    definitions={"rmse": "mean"},
    command="plenocli score a.h5 b.h5",
    inputs={"result 1": InputFile("a.h5", "ab" * 32)},
)


def put(path, document):
    """A document in a file, with a seal that holds where it says that it is ours."""
    if "command" in document:
        publish_sealed(path, json_pieces(document), overwrite=True)
    else:
        path.write_text(json.dumps(document))
    return path


def test_what_is_written_is_read(tmp_path):
    assert read_scores(put(tmp_path / "s.json", DOCUMENT.as_json())) == DOCUMENT


def test_what_is_missing_is_left_out(tmp_path):
    bare = read_scores(
        put(tmp_path / "s.json", {"results": [{"name": "x.h5", "metrics": {"psnr_db": None}}]})
    )
    one = bare.results[0]
    assert one.label == "x" and one.number("psnr_db") is None and "psnr_db" in one.figures
    assert bare.command == "" and not bare.inputs and one.patches is None
    assert read_scores(put(tmp_path / "t.json", {"bands_nm": [450]})) is None
    assert read_scores(put(tmp_path / "u.json", [1, 2])) is None


def replaced(path, value):
    """The document with one part of its first result replaced."""
    document = copy.deepcopy(DOCUMENT.as_json())
    place = document["results"][0]
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = value
    return document


@pytest.mark.parametrize(
    "path, value",
    [
        (["metrics"], 3),
        (["name"], None),
        (["wavelengths_nm"], 450),
        (["wavelengths_nm"], [450, None]),
        (["wavelengths_nm"], ["blue", "green"]),
        (["metrics", "rmse"], {"value": 0.1}),
        (["metrics", "rmse"], True),
        (["metrics", "rmse"], 10**400),
        (["metrics", "rmse_per_band"], [0.1]),
        (["metrics", "rmse_per_band"], [0.1, "much"]),
        (["patches"], {"white": 1}),
        (["patches", 0], 5),
        (["patches", 0, "label"], 25),
        (["patches", 0, "label"], "19"),
        (["patches", 0, "mean"], [0.8]),
        (["patches", 0, "std"], None),
        (["patches", 0, "truth"], "0.8"),
    ],
)
def test_nonsense_is_refused_and_does_not_end_the_report(tmp_path, path, value):
    document = replaced(path, value)
    with pytest.raises(InputError, match="is not a score document"):
        read_scores(put(tmp_path / "score-bad.json", document))
    put(tmp_path / "score-good.json", DOCUMENT.as_json())
    made = run_report(tmp_path, tmp_path / "r.html")
    assert made.unreadable == ["score-bad.json"] and made.sections == ["Spectral"]
    assert "score-bad.json could not be read" in (tmp_path / "r.html").read_text()


@pytest.mark.parametrize("key", ["definitions", "inputs"])
def test_tables_that_are_none_are_refused(tmp_path, key):
    with pytest.raises(InputError, match=f"{key} is no table"):
        read_scores(put(tmp_path / "s.json", DOCUMENT.as_json() | {key: [1]}))


def test_figures_leave_out_what_is_unknown_and_null_what_does_not_apply():
    truth = np.random.default_rng(0).random((12, 12))
    told = figures(score_picture(truth, truth, (4, 4)))
    assert told["psnr_db"] is None and told["rmse"] == 0  # infinite
    assert list(figures(score_picture(truth, truth))) == [
        "psnr_db",
        "psnr_clipped_db",
        "rmse",
        "ssim",
    ]
