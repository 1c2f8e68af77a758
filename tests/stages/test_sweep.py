"""Sweeps: the table against the stages run by hand, the front against its definition, kills,
workers, bad cameras, resuming.
"""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.budget import Budget, within
from plenocli.base.errors import ConfigError, InputError, OutputError, PlenoError, UsageError
from plenocli.cli.sections import read_options
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.config.sweep_file import number
from plenocli.stages.sweep import task as chain
from plenocli.stages.sweep.point import run_point
from plenocli.stages.sweep.space import open_space
from plenocli.stages.sweep.sweep import run_sweep
from plenocli.stages.sweep.table import MOST_SHOWN, SweepSummary, lines, objectives_of

ROOT = Path(__file__).resolve().parents[2]

SMALL = """
camera = "camera.toml"
[vary]
"main_lens.f_number" = [6, 8]
"sensor.pixels_per_lenslet" = [[7, 7], [9, 9]]
"capture-sim.snr" = ["30 dB", "50 dB"]
[follow]
"lenslet_array.superpixel_pitch" = "sensor.pixels_per_lenslet.0 * sensor.pixel_pitch"
[simulate-pif]
model = "fresnel"
superpixels = "1x1"
coherent-ring = 0
accuracy = 1e-2
[capture-sim]
scene = "skimage:coins"
[reconstruct]
method = "tikhonov"
[front]
psnr_db = "max"
sensor_pixels = "min"
"""


def camera_text():
    """A camera smaller than tiny.toml."""
    text = (ROOT / "sample_configs" / "tiny.toml").read_text()
    for old, new in [
        ("[8, 8]", "[4, 4]"),
        ("[13, 13]", "[9, 9]"),
        ('"26 um"', '"18 um"'),
        ('"208 um"', '"144 um"'),
        ("[5, 5]", "[3, 3]"),
    ]:
        assert old in text
        text = text.replace(old, new)
    return text


def described(folder, text=SMALL):
    (folder / "camera.toml").write_text(camera_text())
    (folder / "sweep.toml").write_text(text)
    return folder / "sweep.toml"


def sweep(path, output, **options):
    return run_sweep(path, output, read_options=read_options, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """(sweep file, table, summary) of a sweep that nobody interrupted, in one process."""
    folder = tmp_path_factory.mktemp("sweep")
    path = described(folder)
    return path, folder / "whole.h5", sweep(path, folder / "whole.h5")


def same(table, other):
    return (
        table.read_bytes() == other.read_bytes()
        and table.with_suffix(".csv").read_bytes() == other.with_suffix(".csv").read_bytes()
    )


def journal(table):
    return [
        json.loads(line.split(" ", 1)[1])
        for line in (table.with_suffix(".parts") / "points.jsonl").read_text().splitlines()
    ]


def test_the_table_holds_what_the_stages_say_by_hand(whole, tmp_path):
    """One point of it, through the command line's own stages with files between them."""
    from plenocli.cli.main import run

    path, table, _ = whole
    artefact = read_artefact(table, "sweep")
    attrs, data = artefact.attrs["sweep"], artefact.data
    text = (
        camera_text()
        .replace("f_number = 8", "f_number = 6")
        .replace("[9, 9]", "[7, 7]")
        .replace('"18 um"', '"14 um"')
    )
    (tmp_path / "c.toml").write_text(text)
    pif, capture, image, score = (
        str(tmp_path / name) for name in ("pif.h5", "capture.h5", "image.h5", "score.json")
    )
    assert (
        run(
            [
                "simulate-pif",
                str(tmp_path / "c.toml"),
                "--model",
                "fresnel",
                "--superpixels",
                "1x1",
                "--coherent-ring",
                "0",
                "--accuracy",
                "1e-2",
                "-o",
                pif,
            ]
        )
        == 0
    )
    assert (
        run(
            [
                "capture-sim",
                str(tmp_path / "c.toml"),
                "--pif",
                pif,
                "--scene",
                "skimage:coins",
                "--snr",
                "50dB",
                "-o",
                capture,
            ]
        )
        == 0
    )
    assert run(["reconstruct", capture, "--pif", pif, "--method", "tikhonov", "-o", image]) == 0
    assert run(["score", image, "--truth", capture, "-o", score]) == 0
    metrics = json.loads(Path(score).read_text())["metrics"]
    names = [m["name"] for m in attrs["metrics"]]
    row = next(i for i in range(8) if data["sweep/parameter"][i].tolist() == [6.0, 0.0, 50.0])
    assert attrs["parameters"] == [
        {"key": "main_lens.f_number", "unit": ""},
        {"key": "sensor.pixels_per_lenslet", "unit": "", "choices": [[7, 7], [9, 9]]},
        {"key": "capture-sim.snr", "unit": "dB"},
    ]
    for name in ("psnr_db", "ssim", "rmse"):
        assert data["sweep/metric"][row, names.index(name)] == metrics[name]
    assert data["sweep/metric"][row, names.index("sensor_pixels")] == 9 * 49
    assert data["sweep/metric"][row, names.index("matrix_bytes")] == 49 * 16 * 4
    assert data["sweep/metric"][row, names.index("lenslet_field_m")] == pytest.approx(
        14e-6 / (1 + 144e-6 / 55e-3) * 10, rel=1e-6
    )


def test_the_front_is_what_brute_force_finds(whole):
    path, table, report = whole
    with open(table.with_suffix(".csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    figures = [(float(r["psnr_db"]), -float(r["sensor_pixels"])) for r in rows]
    expected = [
        i
        for i, a in enumerate(figures)
        if not any(all(x >= y for x, y in zip(b, a)) and b != a for b in figures)
    ]
    assert [i for i, r in enumerate(rows) if r["front"] == "1"] == expected
    assert sorted(entry["point"] for entry in report.front) == expected and 0 < len(expected) < len(
        rows
    )
    assert np.flatnonzero(read_artefact(table, "sweep").data["sweep/front"]).tolist() == expected
    assert f"{len(expected)} on the front of psnr_db max, sensor_pixels min" in lines(report)


def test_the_front_is_shown_within_a_line_of_a_terminal():
    """Number and objectives, then what fits; the rest is counted, and stands in the .csv."""
    keys = [f"filter_array.filters.{n}.center" for n in range(16)] + ["sensor.exposure"]
    front = [
        {"point": n, "class_accuracy_expected": n / 7, **dict.fromkeys(keys, f"{n} ms")}
        for n in range(MOST_SHOWN + 3)
    ]
    aims = {"class_accuracy_expected": "max", "sensor.exposure": "min"}
    report = SweepSummary(
        output="runs/a.h5",
        points=99,
        computed=99,
        refused=0,
        with_remarks=0,
        first_reason="",
        first_remark="",
        objectives=aims,
        front=front,
        cpu_seconds=1.0,
    )
    _, head, *rows, more = lines(report).splitlines()
    assert head.split()[:3] == ["point", *aims] and len(rows) == MOST_SHOWN
    assert 60 < max(map(len, [head, *rows])) <= 100
    hidden = len(keys) + 2 - len(head.split())
    assert more == f"  {hidden} columns and 3 rows more in runs/a.csv"


def test_what_is_shared_is_computed_once(whole, tmp_path, monkeypatch):
    from plenocli.stages.forward import simulate_pif

    calls = []
    real = simulate_pif.run_simulate_pif
    monkeypatch.setattr(
        simulate_pif, "run_simulate_pif", lambda *a, **k: calls.append(1) or real(*a, **k)
    )
    report = sweep(described(tmp_path), tmp_path / "out.h5")
    # two signal-to-noise ratios share each camera's matrix
    assert report.computed == 8 and len(calls) == 4
    assert same(tmp_path / "out.h5", whole[1])
    assert not list((tmp_path / "out.parts").rglob("*.h5")), "matrices go when they have served"
    # more values: only those are computed; a finished sweep again: nothing
    described(tmp_path, SMALL.replace('"50 dB"', '"50 dB", "60 dB"'))
    assert sweep(tmp_path / "sweep.toml", tmp_path / "out.h5", overwrite=True).computed == 4
    assert sweep(described(tmp_path), tmp_path / "out.h5", overwrite=True).computed == 0
    assert same(tmp_path / "out.h5", whole[1])


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in range(1, 6))]
)
def test_a_sweep_that_is_killed_goes_on_where_it_was(whole, tmp_path, seed):
    path, table, _ = whole
    out, rng = tmp_path / "whole.h5", np.random.default_rng(seed)
    command = [
        sys.executable,
        "-m",
        "plenocli",
        "sweep",
        str(path),
        "-o",
        str(out),
        "--workers",
        str(1 + seed % 2),
    ]
    child = subprocess.Popen(
        command,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )
    kept, wanted, deadline = (
        tmp_path / "whole.parts" / "points.jsonl",
        int(rng.integers(2, 8)),
        time.monotonic() + 300,
    )
    while (
        child.poll() is None
        and time.monotonic() < deadline
        and (not kept.exists() or kept.read_bytes().count(b"\n") < wanted)
    ):
        time.sleep(0.002)
    os.killpg(child.pid, signal.SIGKILL)
    assert child.wait() == -signal.SIGKILL and not out.exists()
    with open(kept, "ab") as file:
        file.write(b"0123456789abcdef {torn")
    before = len({key for key, record in journal_lines(kept) if "status" in record})
    assert sweep(path, out).computed == 8 - before
    assert same(out, table)
    left = {p.name for p in (tmp_path / "whole.parts").iterdir()}
    assert left == {"points.jsonl", "measured.csv"}


@pytest.mark.slow
def test_an_interrupt_ends_everything_with_one_line(whole, tmp_path):
    command = [
        sys.executable,
        "-m",
        "plenocli",
        "sweep",
        str(whole[0]),
        "-o",
        str(tmp_path / "out.h5"),
        "--workers",
        "2",
    ]
    child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    kept, deadline = tmp_path / "out.parts" / "points.jsonl", time.monotonic() + 300
    while (
        child.poll() is None
        and time.monotonic() < deadline
        and (not kept.exists() or b'"status"' not in kept.read_bytes())
    ):
        time.sleep(0.02)
    os.killpg(child.pid, signal.SIGINT)
    assert (
        child.communicate(timeout=60)[1].split() == ["plenocli:", "error:", "interrupted"]
        and child.returncode == 130
    )


def journal_lines(path):
    return [
        json.loads(line.split(" ", 1)[1])
        for line in path.read_text().splitlines()
        if line.endswith("]")
    ]


def test_two_processes_give_the_same_bytes(whole, tmp_path):
    report = sweep(whole[0], tmp_path / "two.h5", workers=2)
    assert report.computed == 8 and same(tmp_path / "two.h5", whole[1])


def test_cameras_that_are_refused_are_rows_with_the_reason(tmp_path):
    text = (
        SMALL.replace('"main_lens.f_number" = [6, 8]', '"main_lens.f_number" = [6, 8000]')
        .replace("[7, 7], [9, 9]", "[9, 9], [9, 10]")
        .replace('["30 dB", "50 dB"]', '["50 dB"]')
    )
    report = sweep(described(tmp_path, text), tmp_path / "out.h5")
    artefact = read_artefact(tmp_path / "out.h5", "sweep")
    reasons = artefact.attrs["sweep"]["reasons"]
    assert artefact.data["sweep/status"].tolist() == [0, 2, 2, 2] and report.refused == 3
    assert (
        "f_number" in reasons["2"]
        and "superpixel pitch is 9.0000 pixels, not 9 x 10" in reasons["1"]
        and str(tmp_path) not in str(reasons)
    )
    metric = artefact.data["sweep/metric"]
    assert (
        np.isfinite(metric[0]).all()
        and np.isnan(metric[1:]).all()
        and artefact.data["sweep/front"].tolist() == [True, False, False, False]
    )
    again = tmp_path / "again.h5"
    sweep(tmp_path / "sweep.toml", again, workers=2)
    assert same(again, tmp_path / "out.h5")


def test_a_matrix_that_is_refused_refuses_its_points(tmp_path):
    report_text = SMALL.replace("accuracy = 1e-2", "accuracy = 1e-12").replace("[6, 8]", "[6]")
    with pytest.raises(PlenoError, match="none of 4 points could be computed") as caught:
        sweep(described(tmp_path, report_text), tmp_path / "out.h5", plot=tmp_path / "front.png")
    assert caught.value.exit_code == 5
    assert not (tmp_path / "front.png").exists()
    artefact = read_artefact(tmp_path / "out.h5", "sweep")
    assert (
        artefact.data["sweep/status"].tolist() == [5] * 4
        and "1e-12" in artefact.attrs["sweep"]["reasons"]["3"]
    )


@pytest.mark.parametrize(
    ("old", "new", "error", "said"),
    [
        (
            'method = "tikhonov"',
            'methd = "tikhonov"',
            UsageError,
            "reconstruct.methd: unknown option; did you mean method?",
        ),
        ('method = "tikhonov"', 'method = "tikhonof"', UsageError, "reconstruct.method"),
        ("coherent-ring = 0", "coherent-ring = true", UsageError, "simulate-pif.coherent-ring"),
        ('"50 dB"', '"50"', UsageError, "capture-sim.snr"),
        (
            '[reconstruct]\nmethod = "tikhonov"',
            '[demux]\nmethod = "pinv"',
            ConfigError,
            "demux is no stage of the spatial chain",
        ),
        ('psnr_db = "max"', 'psnr = "max"', ConfigError, "did you mean psnr_db?"),
        ('camera = "camera.toml"', 'camera = "nowhere.toml"', InputError, "nowhere.toml"),
    ],
)
def test_mistakes_in_the_file_end_the_run_before_any_work(tmp_path, old, new, error, said):
    assert old in SMALL
    with pytest.raises(error) as caught:
        sweep(described(tmp_path, SMALL.replace(old, new)), tmp_path / "out.h5")
    assert said in str(caught.value) and not list(tmp_path.glob("out*"))


def test_outputs_are_guarded(whole, tmp_path, monkeypatch):
    path, table, _ = whole
    with monkeypatch.context() as without:
        without.setattr("plenocli.stages.sweep.store.find_spec", lambda name: None)
        with pytest.raises(UsageError, match="matplotlib"):
            sweep(path, tmp_path / "out.h5", plot=tmp_path / "front.png")
    with pytest.raises(UsageError, match="exists already"):
        sweep(path, table)
    (tmp_path / "mine.csv").write_text("precious")
    with pytest.raises(UsageError, match="exists already"):
        sweep(path, tmp_path / "mine.h5")
    assert (tmp_path / "mine.csv").read_text() == "precious"
    with pytest.raises(OutputError):
        sweep(path, tmp_path / "no" / "where.h5")
    with pytest.raises(OutputError, match="another run"):
        from plenocli.execution.journal import Journal

        (tmp_path / "held.parts").mkdir()
        held = Journal(tmp_path / "held.parts" / "points.jsonl")
        try:
            sweep(path, tmp_path / "held.h5")
        finally:
            held.close()


def test_damaged_lines_of_the_journal_are_computed_again(whole, tmp_path):
    path, table, _ = whole
    parts = tmp_path / "whole.parts"
    parts.mkdir()
    content = (table.with_suffix(".parts") / "points.jsonl").read_bytes().splitlines(keepends=True)
    points = [i for i, line in enumerate(content) if b'"status"' in line]
    content[points[2]] = content[points[2]].replace(b'"psnr_db": ', b'"psnr_db": 9', 1)
    (parts / "points.jsonl").write_bytes(b"".join(content))
    assert sweep(path, tmp_path / "whole.h5").computed == 1 and same(tmp_path / "whole.h5", table)


def test_keys_follow_what_figures_depend_on_and_nothing_else(tmp_path):
    from plenocli.files.config.camera_file import parse_camera

    camera = parse_camera(camera_text())
    task = chain.task_of("spatial", camera, {"capture-sim": {"snr_db": 50.0}}, 0)
    key = chain.point_key(task, {})

    def matrix(c, options=None):
        return chain.matrix_key(
            chain.task_of("spatial", c, {"simulate-pif": options or {}}, 0), c, {}
        )

    for change in (
        {"sensor.full_well": 9000.0},
        {"sensor.bits": 10},
        {"lenslet_array.count": (4, 3)},
        {"object.distance": 0.6},
    ):
        assert (
            chain.point_key(
                chain.task_of(
                    "spatial", camera.replace(**change), {"capture-sim": {"snr_db": 50.0}}, 0
                ),
                {},
            )
            != key
        )
    assert (
        chain.point_key(chain.task_of("spatial", camera, {"capture-sim": {"snr_db": 50.0}}, 1), {})
        != key
    )
    assert matrix(camera.replace(**{"sensor.bits": 10, "lenslet_array.count": (4, 3)})) == matrix(
        camera
    )
    assert matrix(camera.replace(**{"sensor.full_well": 9000.0})) != matrix(camera), (
        "noise decides how exact is exact enough"
    )
    asked = {"accuracy": 1e-2}
    assert (
        matrix(camera.replace(**{"sensor.full_well": 9000.0}), asked)
        == matrix(camera, asked)
        != matrix(camera)
    )
    assert matrix(camera.replace(**{"object.distance": 0.6})) != matrix(camera)


def test_files_count_by_what_they_hold_not_by_where_they_lie(tmp_path):
    import OpenImageIO as oiio

    def run(folder, level, text=SMALL):
        folder.mkdir()
        picture = np.tile(np.linspace(0, level, 24, dtype=np.float32), (24, 1))
        image = oiio.ImageBuf(oiio.ImageSpec(24, 24, 1, "uint8"))
        image.set_pixels(oiio.ROI(0, 24, 0, 24), picture[..., None])
        assert image.write(str(folder / "scene.png"))
        text = (
            text.replace('"skimage:coins"', '"scene.png"')
            .replace("[6, 8]", "[6]")
            .replace("[[7, 7], [9, 9]]", "[[7, 7]]")
            .replace('["30 dB", "50 dB"]', '["50 dB"]')
        )
        sweep(described(folder, text), folder / "out.h5")
        return read_artefact(folder / "out.h5", "sweep").data["sweep/key"].tolist()

    first = run(tmp_path / "a", 1.0)
    assert run(tmp_path / "b", 1.0) == first and run(tmp_path / "c", 0.5) != first


def test_memory_that_does_not_suffice_is_no_verdict_for_good(tmp_path):
    path = described(
        tmp_path, SMALL.replace("[6, 8]", "[6]").replace("[[7, 7], [9, 9]]", "[[7, 7]]")
    )
    with within(Budget(1000)), pytest.raises(PlenoError, match="none of 2 points") as caught:
        sweep(path, tmp_path / "out.h5")
    assert caught.value.exit_code == 5
    report = sweep(path, tmp_path / "out.h5", overwrite=True)
    assert report.computed == 2 and report.refused == 0


def test_files_that_a_worker_does_not_see_are_no_verdict_on_the_design(tmp_path):
    from plenocli.files.config.camera_file import parse_camera

    task = chain.task_of("spatial", parse_camera(camera_text()), {}, 0)
    cost = chain.MatrixCost(matrix_seconds=1.0, matrix_bytes=1)
    for job in (
        chain.Job(task=task, matrix=chain.SharedMatrix(str(tmp_path / "gone.h5"), cost)),
        chain.Job(task=task, files=(str(tmp_path / "gone.png"),)),
    ):
        with pytest.raises(OutputError, match="does not see this file"):
            run_point(job)


def test_show_and_report_draw_the_front(whole, tmp_path):
    import shutil

    from plenocli.stages.evaluation.report import run_report
    from plenocli.stages.evaluation.show import run_show

    ahead = int(read_artefact(whole[1], "sweep").data["sweep/front"].sum())
    assert (
        f"8 designs, 0 of them refused; {ahead} that no other beats"
        in run_show([whole[1]], tmp_path / "front.png").captions[0]
    )
    assert (tmp_path / "front.png").read_bytes().startswith(b"\x89PNG")
    (tmp_path / "run").mkdir()
    shutil.copy(whole[1], tmp_path / "run" / "lenslets.h5")
    assert run_report(tmp_path / "run", tmp_path / "r.html").sections == ["Design space"]
    page = (tmp_path / "r.html").read_text()
    with open(whole[1].with_suffix(".csv"), newline="") as file:
        best = [r for r in csv.DictReader(file) if r["front"] == "1"]
    assert all(
        f"<td>{r['point']}</td>" in page and f"{float(r['psnr_db']):.6g}" in page for r in best
    )


@pytest.mark.slow
def test_a_spectral_sweep_with_predicted_and_with_measured_responses(tmp_path):
    text = (
        (ROOT / "sample_configs" / "demo_spectral.toml").read_text().replace("[20, 30]", "[12, 18]")
    )
    (tmp_path / "camera.toml").write_text(text)
    body = (
        'camera = "camera.toml"\n'
        "[vary]\n"
        '"filter_array.filters.*.fwhm" = ["40 nm", "60 nm"]\n'
        "[simulate-pif]\n"
        'model = "fresnel"\n'
        "accuracy = 1e-2\n"
        "[front]\n"
        'six_patch_rmse = "min"\n'
        'spectral_angle_deg = "min"\n'
    )
    found = {}
    for name, section in (("predicted", ""), ("measured", "[calibrate]\nresponse = 'shared'\n")):
        (tmp_path / "sweep.toml").write_text(body + section)
        sweep(tmp_path / "sweep.toml", tmp_path / f"{name}.h5")
        artefact = read_artefact(tmp_path / f"{name}.h5", "sweep")
        column = [m["name"] for m in artefact.attrs["sweep"]["metrics"]].index("six_patch_rmse")
        assert not artefact.data["sweep/status"].any()
        found[name] = artefact.data["sweep/metric"][:, column]
    assert (
        (found["measured"] < 0.05).all()
        and (found["predicted"] < 0.05).all()
        and not np.array_equal(found["measured"], found["predicted"])
    )


PAINTS = "nm,rust,moss,rust,moss\n400,0.06,0.05,0.08,0.06\n500,0.1,0.15,0.12,0.13\n" + (
    "600,0.4,0.1,0.44,0.09\n700,0.6,0.2,0.64,0.22\n"
)


def test_a_joint_point_has_picture_spectra_classes_cost_and_light(tmp_path):
    """All figures of one camera in one row, each what the stages say by hand; light halves."""
    from plenocli.stages.evaluation.score.run import run_score
    from plenocli.stages.forward import capture_sim, simulate_pif, simulate_response
    from plenocli.stages.inverse import demux

    text = (
        (ROOT / "sample_configs" / "demo_spectral.toml")
        .read_text()
        .replace("[20, 30]", "[12, 18]")
        .replace("[20, 20]", "[12, 12]")
        .replace('"80 um"', '"48 um"')
        .replace('"640 um"', '"384 um"')
        .replace("[light]", '[light]\nilluminance = "2 klx"')
    )
    (tmp_path / "camera.toml").write_text(text)
    (tmp_path / "paints.csv").write_text(PAINTS)
    (tmp_path / "sweep.toml").write_text(
        'camera = "camera.toml"\nchain = "joint"\n'
        '[vary]\n"sensor.exposure" = ["10 ms", "20 ms"]\n'
        '[simulate-pif]\nmodel = "ray"\naccuracy = 1e-2\nsuperpixels = "3x3"\n'
        '[demux]\nmethod = "pinv"\n'
        '[score]\nclasses = "paints.csv"\ndetect = "rust"\n'
        '[front]\npsnr_db = "max"\nclass_accuracy = "max"\nexposure_s = "min"\n'
    )
    sweep(tmp_path / "sweep.toml", tmp_path / "s.h5")
    with (tmp_path / "s.csv").open() as file:
        rows = list(csv.DictReader(file))
    for name in (
        "psnr_db spectral_angle_deg six_patch_rmse snr_predicted_mean_db class_accuracy "
        "class_accuracy_low class_delta_e_2000 detection_auc target_contrast matrix_seconds "
        "matrix_bytes electrons_per_pixel exposure_s"
    ).split():
        assert all(row[name] != "" for row in rows), name
    light = [float(row["electrons_per_pixel"]) for row in rows]
    assert light[1] == pytest.approx(2 * light[0], rel=0.01)
    (tmp_path / "hand.toml").write_text(text.replace("[sensor]", '[sensor]\nexposure = "10 ms"'))
    camera, options = tmp_path / "hand.toml", {"model": "ray", "accuracy": 1e-2}
    simulate_pif.run_simulate_pif(
        camera,
        tmp_path / "pif.h5",
        simulate_pif.Settings(superpixels=(3, 3), spectral_step="auto", **options),
    )
    for name, seed, settings, scene in (
        ("white", 1_000_001, {"target": "white"}, None),
        ("shown", 2_000_001, {}, tmp_path / "paints.csv"),
    ):
        capture_sim.run_capture_sim(
            camera,
            tmp_path / f"{name}.h5",
            capture_sim.Settings(seed=seed, **settings),
            scene=scene,
            pif=tmp_path / "pif.h5",
        )
    simulate_response.run_simulate_response(
        camera, tmp_path / "response.h5", simulate_response.Settings()
    )
    demux.run_demux(
        [tmp_path / "shown.h5"],
        tmp_path / "told.h5",
        calibration=tmp_path / "response.h5",
        settings=demux.Settings(method="pinv", reference=tmp_path / "white.h5"),
        suffix=".h5",
    )
    figures = run_score(
        [tmp_path / "told.h5"],
        tmp_path / "told.json",
        truth=tmp_path / "paints.csv",
        camera=camera,
        classes=tmp_path / "paints.csv",
        detect="rust",
    ).figures
    for name in ("class_accuracy", "class_distance", "detection_auc", "target_contrast"):
        assert float(rows[0][name]) == pytest.approx(figures[name], rel=1e-9)
    assert float(rows[0]["class_rmse"]) == pytest.approx(figures["rmse"], rel=1e-9)


@pytest.mark.parametrize(
    "path", sorted((ROOT / "sample_configs" / "sweeps").glob("*.toml")), ids=lambda path: path.stem
)
def test_the_sweeps_that_come_along_describe_cameras(path):
    """All figures of their fronts are known, and their points are cameras."""
    space = open_space(path, read_options)
    some = [
        space.point(number, {key: axis.at(share) for key, axis in space.axes.items()})
        for number, share in enumerate((0.0, 0.5))
    ]
    assert all(point.task is not None for point in some), [point.result for point in some]
    objectives_of(space, some)


def test_a_camera_is_expected_to_tell_classes_without_a_capture(tmp_path):
    """Longer exposures and processing that was taught by the camera tell more."""
    examples = ROOT / "sample_configs"
    (tmp_path / "sweep.toml").write_text(
        f'camera = "{examples}/codesign.toml"\nchain = "expected"\n'
        '[set]\n"lenslet_array.count" = [4, 4]\n"sensor.pixels_per_lenslet" = [8, 8]\n'
        '"sensor.pixel_pitch" = "12 um"\n"filter_array.layout" = [2, 2]\n'
        '"filter_array.filters.*.fwhm" = "80 nm"\n'
        '[vary]\n"sensor.exposure" = ["0.5 ms", "5 ms"]\n"score.learnt" = [false, true]\n'
        f'[score]\nclasses = "{examples}/classes/leaves.csv"\n'
        '[demux]\nmethod = "pinv"\n'
    )
    summary = sweep(tmp_path / "sweep.toml", tmp_path / "s.h5")
    assert summary.objectives == {"class_accuracy_expected": "max", "rmse_expected": "min"}
    with (tmp_path / "s.csv").open() as file:
        rows = list(csv.DictReader(file))
    short, taught, long, both = (float(row["class_accuracy_expected"]) for row in rows)
    assert short < taught < both and short < long < both
    light = [float(row["electrons_per_pixel"]) for row in rows]
    assert light[2] == pytest.approx(10 * light[0]) and float(rows[2]["exposure_s"]) == 5e-3
    ideal = [float(row["class_accuracy_ideal"]) for row in rows]
    assert taught <= ideal[0] == ideal[1] and both <= ideal[2] == ideal[3]


@pytest.mark.parametrize(
    "table, detect, message",
    [
        ("nm,a,b\n400,25,30\n700,30,40\n", "a", "write 0.25 for 25 %"),
        ("nm,a,b\n400,.25,.3\n700,.3,.4\n", "rust", "rust is no class of"),
        (None, "a", "cannot be read"),
    ],
)
def test_classes_that_no_point_could_be_scored_by_end_a_sweep_before_it_starts(
    tmp_path, table, detect, message
):
    if table:
        (tmp_path / "paints.csv").write_text(table)
    (tmp_path / "sweep.toml").write_text(
        f'camera = "{ROOT}/sample_configs/codesign.toml"\nchain = "expected"\n'
        '[vary]\n"sensor.exposure" = ["0.5 ms", "5 ms"]\n'
        f'[score]\nclasses = "paints.csv"\ndetect = "{detect}"\n'
    )
    with pytest.raises(PlenoError, match=message):
        sweep(tmp_path / "sweep.toml", tmp_path / "s.h5")
    assert not list(tmp_path.glob("s.*"))


def test_values_are_written_as_given_and_read_as_numbers(whole):
    with open(whole[1].with_suffix(".csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    assert {r["capture-sim.snr"] for r in rows} == {"30 dB", "50 dB"} and {
        r["sensor.pixels_per_lenslet"] for r in rows
    } == {"[7, 7]", "[9, 9]"}
    values = read_artefact(whole[1], "sweep").data["sweep/parameter"]
    assert [number(r["capture-sim.snr"]) for r in rows] == values[:, 2].tolist()


def test_points_of_a_lost_worker_are_told_and_the_others_kept(tmp_path):
    from plenocli.execution.pool import Lost
    from plenocli.stages.sweep.space import DesignPoint
    from plenocli.stages.sweep.store import open_store

    class Pool:
        far, room, asked = False, True, []

        def submit(self, token, function, task):
            self.asked.append(token)

        def next(self):
            self.room = bool(self.asked)
            return self.asked.pop(), Lost("the worker died")

    with (
        open_store(tmp_path / "out.h5", None, False, []) as store,
        pytest.raises(
            OutputError,
            match="1 of 1 points have no result: the worker died.*run the command again",
        ),
    ):
        task = chain.Task(chain="spatial", camera="", settings={})
        store.evaluate([DesignPoint(number=0, values={}, task=task, key="a", matrix="m")], Pool())


FOREIGN = (
    SMALL.replace("[vary]\n", '[vary]\n"reconstruct.method" = ["tikhonov", "lmmse"]\n')
    .replace('"main_lens.f_number" = [6, 8]\n', '"simulate-pif.accuracy" = [1e-1, 1e-2]\n')
    .replace('"sensor.pixels_per_lenslet" = [[7, 7], [9, 9]]\n', "")
    .replace("accuracy = 1e-2\n[cap", "[cap")
    .replace('["30 dB", "50 dB"]', '["50 dB"]')
    .replace('"skimage:coins"', '"skimage:coins"\nmodel = "exact"\nrefine = 2\naccuracy = 1e-3')
)
"""One capture by the exact model, finer than it is inverted; two matrices; two methods."""


def test_a_capture_by_another_matrix_is_made_once_and_inverted_in_many_ways(tmp_path, monkeypatch):
    """Against the stages run by hand, one of the four points; the bytes do not depend on sharing,
    nor on how many work.
    """
    from plenocli.cli.main import run
    from plenocli.stages.forward import capture_sim

    calls = []
    real = capture_sim.run_capture_sim
    monkeypatch.setattr(
        capture_sim, "run_capture_sim", lambda *a, **k: calls.append(1) or real(*a, **k)
    )
    path = described(tmp_path, FOREIGN)
    report = sweep(path, tmp_path / "one.h5")
    assert report.computed == 4 and report.refused == 0 and len(calls) == 1
    assert not list((tmp_path / "one.parts").rglob("*.h5")), "captures go when they have served"
    sweep(path, tmp_path / "two.h5", workers=2)
    assert same(tmp_path / "one.h5", tmp_path / "two.h5")
    by_hand = [
        "simulate-pif camera.toml --model fresnel --superpixels 1x1 --coherent-ring 0 "
        "--accuracy 1e-2 -o pif.h5",
        "capture-sim camera.toml --scene skimage:coins --snr 50dB --model exact --refine 2 "
        "--accuracy 1e-3 -o capture.h5",
        "reconstruct capture.h5 --pif pif.h5 --method lmmse -o image.h5",
        "score image.h5 --truth capture.h5 -o score.json",
    ]
    monkeypatch.chdir(tmp_path)
    assert not any(run(["--quiet", *line.split()]) for line in by_hand)
    score = json.loads((tmp_path / "score.json").read_text())["results"][0]["metrics"]
    with open(tmp_path / "one.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    row = next(
        r
        for r in rows
        if r["reconstruct.method"] == "lmmse" and float(r["simulate-pif.accuracy"]) == 1e-2
    )
    assert float(row["psnr_db"]) == pytest.approx(score["psnr_db"], abs=1e-9)


def test_a_foreign_capture_that_is_refused_refuses_its_points(tmp_path):
    text = FOREIGN.replace('"skimage:coins"', '"nowhere.png"')
    with pytest.raises(InputError, match=r"none of 4 points could be computed"):
        sweep(described(tmp_path, text), tmp_path / "out.h5")
    assert read_artefact(tmp_path / "out.h5", "sweep").data["sweep/status"].tolist() == [3] * 4


def test_seconds_are_measured_for_every_stage_and_stand_beside_the_table(whole, tmp_path):
    from plenocli.files.results.measured_seconds import inversion_seconds, read_measured

    measured = read_measured(whole[1], 8)
    assert set(measured) == {
        f"{stage} cpu_s" for stage in ("simulate-pif", "capture-sim", "reconstruct", "score")
    }
    assert all((seconds > 0).all() for seconds in measured.values())
    np.testing.assert_allclose(
        inversion_seconds(measured), measured["simulate-pif cpu_s"] + measured["reconstruct cpu_s"]
    )
    with pytest.raises(InputError, match="not of this table"):
        read_measured(whole[1], 7)


def test_depth_is_told_of_a_plane_that_was_captured_by_waves(tmp_path):
    text = """
camera = "camera.toml"
chain = "depth"
[set]
"lenslet_array.count" = [15, 15]
[vary]
"object.distance" = ["530 mm", "550 mm"]
"refocus.planes" = [5, 13]
[capture-sim]
scene = "skimage:coins"
snr = "40 dB"
model = "fresnel"
accuracy = 1e-1
"""
    sweep(described(tmp_path, text), tmp_path / "out.h5")
    with open(tmp_path / "out.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [r["status"] for r in rows] == ["0"] * 4
    # thin lens at 50 mm, lenslets at 55 mm: that they see 550 mm sharply needs no program
    focused = [abs(float(r["depth_slope"])) for r in rows if r["object.distance"] == "550 mm"]
    assert max(focused) < 1e-6
    assert all(float(r["depth_slope_error"]) < 1 for r in rows), "within the geometric limit"
