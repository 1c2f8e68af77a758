"""The pipelines through make: every stage runs, a second run does nothing, a change reruns what
depends on it and no more.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def make(pipeline, *variables, check=True):
    """Run a pipeline with the plenocli of this Python; returns the lines that make printed."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MAKE")} | {
        "PATH": path,
        "OMP_NUM_THREADS": "1",
    }
    done = subprocess.run(
        ["make", "-j2", "-f", f"pipelines/{pipeline}.mk", *variables],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert not check or done.returncode == 0, done.stdout + done.stderr
    return done.stdout.splitlines()


def stages(lines):
    return [line.split()[1] for line in lines if line.startswith("plenocli ")]


@pytest.fixture(scope="module")
def spatial(tmp_path_factory):
    """(variables of a run on a camera smaller than tiny.toml, its camera file, its folder,
    what make printed).
    """
    folder = tmp_path_factory.mktemp("spatial")
    text = (ROOT / "sample_configs" / "tiny.toml").read_text()
    for old, new in [
        ("[8, 8]", "[4, 4]"),
        ("[13, 13]", "[9, 9]"),
        ('"26 um"', '"18 um"'),
        ('"208 um"', '"144 um"'),
        ("[5, 5]", "[4, 4]"),
    ]:
        assert old in text
        text = text.replace(old, new)
    (folder / "camera.toml").write_text(text)
    variables = [
        f"RUN={folder}/run",
        f"CONFIG={folder}/camera.toml",
        "ITERATIONS=2",
        "BATCH=64",
        "METHODS=block-mean lmmse dictionary",
    ]
    return variables, folder / "camera.toml", folder / "run", make("spatial", *variables)


def test_every_stage_of_the_spatial_experiment_runs(spatial):
    _, _, run, lines = spatial
    assert {"simulate-pif", "capture-sim", "learn-dict", "reconstruct", "score", "report"} == set(
        stages(lines)
    )
    paper = {
        r["label"]: r["metrics"]
        for r in json.loads((run / "score-paper.json").read_text())["results"]
    }
    assert paper["lmmse"]["psnr_db"] > paper["block-mean"]["psnr_db"] + 2
    stray = {
        r["label"]: r["metrics"]
        for r in json.loads((run / "score-stray.json").read_text())["results"]
    }
    inner = {label: metrics["psnr_inner_db"] for label, metrics in stray.items()}
    assert inner["lmmse"] > inner["lmmse-no-neighbours"] + 2, (
        "the neighbours' light matters and is modelled"
    )
    assert "data:image/webp" in (run / "report.html").read_text()


def test_a_second_run_does_nothing_and_a_change_reruns_what_depends_on_it(spatial):
    variables, _, run, first = spatial
    assert stages(make("spatial", *variables)) == []
    os.utime(run / "stray" / "capture.h5")
    again = stages(make("spatial", *variables, "-n"))
    assert "learn-dict" not in again and "simulate-pif" not in again and again.count("score") == 1
    assert 0 < again.count("reconstruct") < stages(first).count("reconstruct")
    lost = [run / "score-stray.json", run / "paper" / "lmmse.h5"]
    for file in lost:
        file.rename(f"{file}.gone")
    assert {"score", "reconstruct"} < set(stages(make("spatial", *variables, "-n"))), (
        "what is missing is made again"
    )
    for file in lost:
        Path(f"{file}.gone").rename(file)


@pytest.mark.slow
@pytest.mark.parametrize("only", ["EXPERIMENTS=stray", ""])
def test_the_same_run_gives_the_same_bytes(spatial, tmp_path, only):
    """By the experiment of most options, whose report has not what that of all has; and by all."""
    variables, _, run, _ = spatial
    make("spatial", *variables[1:], f"RUN={tmp_path}/run", *filter(None, [only]))
    made = tmp_path / "run"
    files = {p.relative_to(made) for p in made.rglob("*") if p.is_file()}
    files -= {Path("report.html"), Path("SHA256SUMS")} if only else set()
    assert len(files) > (9 if only else 12)
    assert [p for p in sorted(files) if (run / p).read_bytes() != (made / p).read_bytes()] == []


def test_a_broken_camera_leaves_nothing_behind(tmp_path):
    (tmp_path / "camera.toml").write_text("[main_lens]\n")
    lines = make("spatial", f"RUN={tmp_path}/run", f"CONFIG={tmp_path}/camera.toml", check=False)
    assert stages(lines) and not list((tmp_path / "run").rglob("*.h5"))


@pytest.mark.slow
@pytest.mark.parametrize("glass", ["none", "N-BK7"])
def test_demultiplexing_beats_single_pixel_by_the_measured_and_by_the_predicted_response(
    tmp_path, glass
):
    text = (ROOT / "sample_configs" / "demo_spectral.toml").read_text()
    (tmp_path / "camera.toml").write_text(
        text.replace('glass = "none" ', f'glass = "{glass}" ').replace("[10, 10]", "[12, 12]")
    )
    variables = [
        f"RUN={tmp_path}/run",
        f"CONFIG={tmp_path}/camera.toml",
        "METHODS=pinv single-pixel",
    ]
    lines = make("spectral", *variables)
    assert {
        "simulate-pif",
        "simulate-response",
        "capture-sim",
        "calibrate",
        "demux",
        "score",
        "report",
    } == set(stages(lines))
    for response in ("measured", "predicted"):
        for exposure in ("long", "short"):
            found, single = (
                r["metrics"]
                for r in json.loads(
                    (tmp_path / "run" / f"score-{response}-{exposure}.json").read_text()
                )["results"]
            )
            assert all(
                a < 0.5 * b
                for a, b in zip(
                    found["six_patch_rmse_per_band"], single["six_patch_rmse_per_band"], strict=True
                )
            )
            assert found["snr_over_single_pixel_db"] > 12
    waves, rays = (
        r["metrics"]
        for r in json.loads((tmp_path / "run" / "score-response.json").read_text())["results"]
    )
    assert max(waves["response_error_per_band"]) < 0.04 < min(rays["response_error_per_band"])
    assert not (tmp_path / "run" / "pif.h5").exists() and stages(make("spectral", *variables)) == []


@pytest.mark.slow
# an achromat, and a singlet with 2 % of chromatic focal shift
@pytest.mark.parametrize("glass", ["none", "N-BK7"])
def test_a_chart_is_measured_and_seen_through_the_camera(tmp_path, glass):
    from tests.reference.chart import paint_folder

    (tmp_path / "data").mkdir()
    text = (ROOT / "sample_configs" / "demo_spectral.toml").read_text()
    (tmp_path / "camera.toml").write_text(text.replace('glass = "none" ', f'glass = "{glass}" '))
    variables = [
        f"RUN={tmp_path}/run",
        f"DATA={paint_folder(tmp_path / 'data')}",
        f"CONFIG={tmp_path}/camera.toml",
        "METHODS=pinv single-pixel",
    ]
    lines = make("colorchecker", *variables)
    assert {
        "colorchecker",
        "simulate-pif",
        "capture-sim",
        "calibrate",
        "demux",
        "score",
        "report",
    } == set(stages(lines))
    found, single = (
        r["metrics"]
        for r in json.loads((tmp_path / "run" / "score-long.json").read_text())["results"]
    )
    assert (
        found["six_patch_rmse"] < 0.5 * single["six_patch_rmse"]
        and found["snr_over_single_pixel_db"] > 10
    )
    assert all(
        a < b
        for a, b in zip(
            found["six_patch_rmse_per_band"], single["six_patch_rmse_per_band"], strict=True
        )
    )
    assert stages(make("colorchecker", *variables)) == []


def test_the_chart_pipeline_asks_for_its_captures():
    assert make("colorchecker", check=False) == []


def test_a_sweep_is_made_once_and_again_where_its_file_changed(tmp_path):
    (tmp_path / "camera.toml").write_text(
        (ROOT / "sample_configs" / "tiny.toml").read_text().replace("[5, 5]", "[2, 2]")
    )
    text = (
        'camera = "camera.toml"\n'
        "[vary]\n"
        '"capture-sim.snr" = ["40 dB"]\n'
        "[simulate-pif]\n"
        'model = "fresnel"\n'
        'superpixels = "1x1"\n'
        "accuracy = 1e-2\n"
        "[reconstruct]\n"
        'method = "tikhonov"\n'
    )
    (tmp_path / "small.toml").write_text(text)
    variables = [f"RUN={tmp_path}/run", f"SWEEPS={tmp_path}/small.toml"]
    assert (
        stages(make("sweep", *variables)) == ["sweep"] and stages(make("sweep", *variables)) == []
    )
    assert {p.name for p in (tmp_path / "run").iterdir()} == {
        "small.h5",
        "SHA256SUMS",
        "small.csv",
        "small.png",
        "small.parts",
    }
    (tmp_path / "small.toml").write_text(text.replace('"40 dB"', '"40 dB", "50 dB"'))
    os.utime(tmp_path / "small.toml", (4e9, 4e9))
    assert "2 points, 1 computed now" in "\n".join(make("sweep", *variables))
