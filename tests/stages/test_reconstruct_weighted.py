"""reconstruct --method weighted through the command line, and what it tells of pixels that were
left out.
"""

import json

import numpy as np

from plenocli.cli.main import run
from plenocli.files.artefacts.reading import read_artefact
from tests.stages.test_reconstruct import make_files


def test_pixels_are_left_out_and_told(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    truth = make_files(tmp_path, coupled=True, noise=40.0)
    command = ["reconstruct", "capture.h5", "--pif", "pif.h5"]
    sigma = ["--noise-sigma", "0.004"]
    weighted = [*command, "--method", "weighted", *sigma, "--hold-out", "0.2", "--json"]
    assert run([*weighted, "-o", "picture.h5"]) == 0
    told = json.loads(capsys.readouterr().out)["captures"][0]
    assert [one["patch"] for one in told["held_out"] if not one["structured"]] == [1, 2, 4]
    for one in told["held_out"]:
        assert one["model"] < min(one["neighbours"], one["neighbours_over_white"])
        assert one["model"] < one["block_mean"]
    # the line for a person has the widest patches alone
    widest = told["held_out"][-1]
    assert (
        "patches of 4 x 4 pixels left out of lenslets that show something, predicted within "
        in told["rule"]
    )
    assert f"{widest['model']:.2%} of white" in told["rule"] and len(told["rule"]) < 300
    data = read_artefact(tmp_path / "picture.h5", ("image",)).data
    assert run([*command, "--method", "block-mean", "-o", "block.h5"]) == 0
    block = read_artefact(tmp_path / "block.h5", ("image",)).data["image/value"]
    error = np.sqrt(np.mean((data["image/value"] - truth) ** 2))
    assert error < 0.8 * np.sqrt(np.mean((block - truth) ** 2)) and data["image/sigma"].min() > 0
    # the same seed leaves the same pixels out
    capsys.readouterr()
    assert run([*weighted, "-o", "again.h5"]) == 0
    again = json.loads(capsys.readouterr().out)["captures"][0]
    assert again["held_out"] == told["held_out"]


def test_only_weighted_leaves_pixels_out(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    make_files(tmp_path)
    command = ["reconstruct", "capture.h5", "--pif", "pif.h5", "--hold-out", "0.1", "-o", "a.h5"]
    assert run([*command, "--method", "lmmse"]) == 2
    said = capsys.readouterr().err
    assert "--hold-out means nothing to --method lmmse" in said and "--method weighted" in said
