"""The search: the same points from the same seed however it is run, results that are kept, and
better than chance.
"""

from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import ConfigError, UsageError
from plenocli.cli.main import run
from plenocli.files.artefacts.reading import read_artefact
from plenocli.stages.sweep import optimise
from plenocli.stages.sweep import store as sweep_store
from plenocli.stages.sweep.task import PointResult

pytest.importorskip("optuna")
ROOT = Path(__file__).resolve().parents[2]

SPACE = """
camera = "camera.toml"
[vary]
"main_lens.f_number" = { from = 4.0, to = 12.0 }
"sensor.pixels_per_lenslet" = [[5, 5], [7, 7], [9, 9]]
"sensor.pixel_fill_factor" = { from = 0.5, to = 1.0, steps = 3 }
"reconstruct.method" = ["tikhonov", "block-mean"]
[follow]
"lenslet_array.superpixel_pitch" = "sensor.pixels_per_lenslet.0 * sensor.pixel_pitch"
[simulate-pif]
model = "fresnel"
accuracy = 1e-2
superpixels = "1x1"
[capture-sim]
scene = "skimage:coins"
snr = "50 dB"
[front]
psnr_db = "max"
"""


@pytest.fixture
def space(tmp_path):
    text = (ROOT / "sample_configs" / "tiny.toml").read_text()
    for old, new in [
        ("[8, 8]", "[4, 4]"),
        ("[13, 13]", "[9, 9]"),
        ('"26 um"', '"18 um"'),
        ('"208 um"', '"144 um"'),
        ("[5, 5]", "[3, 3]"),
    ]:
        text = text.replace(old, new)
    (tmp_path / "camera.toml").write_text(text)
    (tmp_path / "space.toml").write_text(SPACE)
    return tmp_path / "space.toml"


def table(path):
    return read_artefact(path, "sweep")


def test_the_same_seed_tries_the_same_points_stopped_or_not(space, tmp_path):
    arguments = ["optimise", str(space), "--seed", "5"]
    assert run([*arguments, "--trials", "14", "-o", str(tmp_path / "whole.h5")]) == 0
    # stopped after eight trials and asked for more: those are taken from the journal
    assert run([*arguments, "--trials", "8", "-o", str(tmp_path / "part.h5")]) == 0
    first = table(tmp_path / "part.h5")
    assert run([*arguments, "--trials", "14", "--overwrite", "-o", str(tmp_path / "part.h5")]) == 0
    whole = table(tmp_path / "whole.h5")
    assert (tmp_path / "part.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
    assert (
        whole.data["sweep/key"][: len(first.data["sweep/key"])].tolist()
        == first.data["sweep/key"].tolist()
    )
    f = whole.data["sweep/parameter"][:, 0]
    assert 4 <= f.min() < f.max() <= 12 and set(whole.data["sweep/parameter"][:, 2]) <= {
        0.5,
        0.75,
        1.0,
    }
    names = [m["name"] for m in whole.attrs["sweep"]["metrics"]]
    psnr = whole.data["sweep/metric"][:, names.index("psnr_db")]
    assert (
        np.flatnonzero(whole.data["sweep/front"]).tolist()
        == np.flatnonzero(psnr == psnr.max()).tolist()
    )


def test_the_search_finds_what_chance_does_not(space, tmp_path, monkeypatch):
    """On a function with a known best, the points tried last lie nearer to it
    than the first ones.
    """

    def figures(store, points, *surroundings, **options):
        for point in points:
            f, choice = point.values["main_lens.f_number"], point.values["reconstruct.method"]
            quality = -abs(f - 7) - (choice == "block-mean")
            point.result = PointResult(metrics={"psnr_db": quality})
        return len(points)

    monkeypatch.setattr(sweep_store.Store, "evaluate", figures)
    assert run(["optimise", str(space), "--trials", "80", "-o", str(tmp_path / "best.h5")]) == 0
    values = table(tmp_path / "best.h5").data["sweep/parameter"]
    assert np.abs(values[-30:, 0] - 7).mean() < 0.6 * np.abs(values[:10, 0] - 7).mean()
    assert (
        values[-30:, 3]
        == table(tmp_path / "best.h5").attrs["sweep"]["parameters"][3]["choices"].index("tikhonov")
    ).mean() > 0.7


def test_refused_points_are_heard_as_failures(space, tmp_path):
    space.write_text(SPACE.replace("from = 4.0, to = 12.0", 'from = 4.0, to = 1e5, scale = "log"'))
    assert run(["optimise", str(space), "--trials", "8", "-o", str(tmp_path / "out.h5")]) == 0
    status = table(tmp_path / "out.h5").data["sweep/status"]
    assert 0 < (status == 2).sum() < len(status)


def test_the_search_keeps_away_from_what_is_refused(space, tmp_path, monkeypatch):
    """Chance would have half of the points refused, those of one method."""

    def figures(self, points, pool, files=(), label=""):
        for point in points:
            refused = point.values["reconstruct.method"] == "block-mean"
            point.result = PointResult(
                status=5 if refused else 0,
                metrics={}
                if refused
                else {"psnr_db": -abs(point.values["main_lens.f_number"] - 7)},
            )
        return len(points)

    monkeypatch.setattr(sweep_store.Store, "evaluate", figures)
    assert run(["optimise", str(space), "--trials", "60", "-o", str(tmp_path / "out.h5")]) == 0
    assert (table(tmp_path / "out.h5").data["sweep/status"][-30:] == 5).mean() < 0.2


def test_what_cannot_be_searched_is_said(space, tmp_path, monkeypatch):
    def attempt(text):
        space.write_text(text)
        optimise.run_optimise(space, tmp_path / "out.h5", read_options=lambda stage, values: {})

    with pytest.raises(ConfigError, match="nothing to search"):
        attempt('camera = "camera.toml"\ndesign = "list"\n[[point]]\n"main_lens.f_number" = 6\n')
    monkeypatch.setitem(__import__("sys").modules, "optuna", None)
    with pytest.raises(UsageError, match="pip install .optuna>="):
        attempt(SPACE)
