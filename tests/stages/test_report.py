import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import InputError, UsageError
from plenocli.cli.main import run
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance, describe_inputs
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.images.exr import write_exr
from plenocli.files.results.run_folder import RunFolder
from plenocli.forward.scene.chart import chart_scene
from plenocli.stages.evaluation.report import run_report
from plenocli.stages.evaluation.score.run import run_score
from tests.reference import browser

BANDS = np.array([450e-9, 540e-9, 570e-9, 650e-9])
ROOT = Path(__file__).resolve().parents[2]


PLAN = {
    "asked": 1e-3,
    "asked_by": "request",
    "by_source": {"model": 0.0, "sampling": 3e-4, "neighbourhood": 6e-4},
    "estimated": 6.7e-4,
    "left_out": ["lenslets beyond 1 ring(s)"],
    "model": "fresnel",
    "model_error": 0.0277,
    "reasons": ["superpixels 3x3 as asked"],
    "rung": "fresnel, low rank",
}


def put(path, kind, data, attrs=None, inputs=None, command=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    provenance = Provenance(
        command=command or f"plenocli made {path.name}",
        inputs=describe_inputs(inputs or {}),
        seed=1,
        config="# camera\n",
        accuracy=PLAN if kind == "pif" else {},
    )
    write_artefact(path, Artefact(kind, data, attrs or {}, provenance), overwrite=True)
    return path


def spatial(root, rng):
    offsets = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), -1).reshape(-1, 2)
    system = rng.random((1, 9, 30, 16)).astype("f4") / 300
    pif = put(
        root / "pif.h5",
        "pif",
        {
            "pif/A": system,
            "pif/wavelength": np.array([550e-9]),
            "pif/lenslet_offset": offsets,
            "pif/pixel_shape": np.array([5, 6]),
            "pif/object_shape": np.array([4, 4]),
            "pif/column_energy": system.sum(axis=(1, 2)),
            "pif/singular_values": np.linspace(1, 0.01, 16)[None],
        },
        {"pif": {"rank": [16], "condition": [100.0], "symmetry_defect": [0.2], "kappa": 1.5}},
    )
    scene = rng.random((1, 20, 20)).astype("f4")
    capture = put(
        root / "same" / "capture.h5",
        "capture",
        {
            "capture/mosaic": rng.random((25, 30)).astype("f4"),
            "capture/cfa": "mono",
            "capture/scene": scene,
            "capture/wavelength": np.array([550e-9]),
        },
        {
            "capture": {
                "units": "electron",
                "black": 0.0,
                "lenslet_count": [5, 5],
                "superpixel_shape": [5, 6],
                "noise_sigma": 0.1,
            }
        },
        {"pif": pif},
    )
    results = [
        put(
            root / "same" / f"{name}.h5",
            "image",
            {
                "image/value": np.clip(
                    scene[0] + error * rng.standard_normal((20, 20)), 0, None
                ).astype("f4")
            },
            {"image": {"method": name}},
            {"capture": capture, "pif": pif},
        )
        for name, error in (("tikhonov", 0.1), ("lmmse", 0.05))
    ]
    put(
        root / "dictionary.h5",
        "dictionary",
        {
            "dictionary/atoms": rng.standard_normal((16, 20)),
            "dictionary/history/psnr_db": np.linspace(10, 12, 5),
        },
        {"dictionary": {"object_shape": [4, 4], "delta": 0.1}},
        {"pif": pif},
    )
    run_score(
        results,
        root / "score-same.json",
        truth=capture,
        command="plenocli score tikhonov.h5 lmmse.h5",
    )


def spectral(root, rng):
    root.mkdir(parents=True, exist_ok=True)
    truth = chart_scene(12, 18, BANDS)[0].astype(float)
    white = put(
        root / "white.h5",
        "capture",
        {"capture/mosaic": rng.random((96, 144)).astype("f4"), "capture/cfa": "mono"},
        {"capture": {"units": "DN"}},
    )
    rows, cols = np.mgrid[0:12, 0:18]
    calibration = put(
        root / "calibration.h5",
        "calibration",
        {
            "grid/centre": np.stack([rows * 8 + 3.5, cols * 8 + 3.5], -1),
            "grid/valid": np.ones((12, 18), bool),
            "grid/residual": rng.random((12, 18)),
            "white/flat": rng.random((96, 144)),
            "response/F": rng.random((12, 18, 64, 4)),
            "response/window": np.array([8, 8]),
            "response/wavelength": BANDS,
            "response/origin": np.stack([rows * 8, cols * 8], -1),
        },
        {
            "grid": {
                "lattice": "square",
                "pitch": [8.0, 8.0],
                "angle": 0.0,
                "rms": 0.01,
                "lenslets": 216,
            },
            "response": {"condition": 1.3, "units": "DN"},
        },
        {"white": white},
    )
    for method, error in (("pinv", 0.005), ("single-pixel", 0.02)):
        result = put(
            root / f"chart-{method}.h5",
            "spectra",
            {
                "spectra/value": truth + error * rng.standard_normal(truth.shape),
                "spectra/wavelength": BANDS,
                "spectra/sigma": np.full(truth.shape, error),
            },
            {"spectra": {"quantity": "reflectance", "method": method}},
            {"capture": white, "calibration": calibration},
        )
        run_score([result], root / f"score-{method}.json", truth="colorchecker")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("run")
    rng = np.random.default_rng(0)
    spatial(root / "spatial", rng)
    spectral(root / "spectral", rng)
    return root


@pytest.fixture(scope="module")
def small(folder, tmp_path_factory):
    """A folder of spectra by one method, their score, calibration and white image."""
    root = tmp_path_factory.mktemp("small") / "run"
    shutil.copytree(folder / "spectral", root, ignore=shutil.ignore_patterns("*single-pixel*"))
    return root


@pytest.fixture(scope="module")
def page(folder, tmp_path_factory):
    made = tmp_path_factory.mktemp("page") / "report.html"
    run_report(folder, made)
    return made


def test_the_page_shows_both_chains(folder, tmp_path):
    summary = run_report(folder, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert (
        summary.sections == ["Spatial", "Spectral"]
        and summary.unreadable == []
        and summary.scores == 3
    )
    # results, close-up, capture, PIF, A, matrix, atoms, history; bars, patches, 2 x bands, grid,
    # response, capture
    assert page.count("<figure>") == 15
    for word in (
        "score-same",
        "lmmse",
        "PSNR [dB]",
        "RMSE over the six patches, 450 nm",
        "symmetry defect",
        "chart-single-pixel",
        "plenocli made pif.h5",
        "# camera",
        "0.001 (request)",
        "0.00067: neighbourhood 0.0006, sampling 0.0003",
        "fresnel, low rank",
        "0.0277",
        "superpixels 3x3 as asked",
        "left out: lenslets beyond 1 ring(s)",
    ):
        assert word in page
    assert str(folder) not in page


def test_the_same_folder_gives_the_same_bytes(small, tmp_path):
    for name in ("a.html", "b.html"):
        run_report(small, tmp_path / name, title="x")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_a_torn_file_is_named_and_the_rest_is_shown(small, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(small, copy, ignore=shutil.ignore_patterns("calibration.h5"))
    (copy / "torn.h5").write_bytes((copy / "white.h5").read_bytes()[:-50])
    (copy / "notes.json").write_text("[1, 2]")
    (copy / "score-bad.json").write_text('{"results": [{"metrics": 3}]}')
    (copy / "broken.json").write_text('{"results": ')
    summary = run_report(copy, tmp_path / "r.html")
    assert summary.unreadable == ["broken.json", "score-bad.json", "torn.h5"]
    assert "torn.h5 could not be read" in (
        tmp_path / "r.html"
    ).read_text() and summary.sections == ["Spectral"]


def test_results_without_scores_are_shown_alone(tmp_path):
    put(
        tmp_path / "run" / "letters.h5",
        "image",
        {"image/value": np.random.default_rng(1).random((30, 40)).astype("f4")},
        {"image": {"method": "block-mean"}},
    )
    write_exr(tmp_path / "run" / "more.exr", {"Y": np.ones((8, 8), "f4")})
    summary = run_report(tmp_path / "run", tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert (
        summary.sections == ["Spatial"]
        and page.count("<figure>") == 2
        and "no truth to compare with" in page
    )


def test_lineage_follows_digests(folder):
    run_folder = RunFolder(folder)
    capture = next(f for f in run_folder.files if f.name == "spatial/same/capture.h5")
    assert {f.name for f in run_folder.users(capture)} == {
        "spatial/same/tikhonov.h5",
        "spatial/same/lmmse.h5",
        "spatial/score-same.json",
    }
    assert run_folder.by_digest(capture.sources["pif"]).name == "spatial/pif.h5"


def test_nothing_to_show(tmp_path):
    with pytest.raises(InputError, match="no result"):
        run_report(tmp_path, tmp_path / "r.html")
    with pytest.raises(InputError, match="no folder"):
        run_report(tmp_path / "absent", tmp_path / "r.html")
    assert not (tmp_path / "r.html").exists()


def test_score_writes_its_own_page(folder, tmp_path, capsys):
    results = [str(folder / "spatial" / "same" / f"{name}.h5") for name in ("tikhonov", "lmmse")]
    truth = str(folder / "spatial" / "same" / "capture.h5")
    assert (
        run(
            [
                "score",
                *results,
                "--truth",
                truth,
                "-o",
                str(tmp_path / "s.json"),
                "--report",
                str(tmp_path / "s.html"),
            ]
        )
        == 0
    )
    page = (tmp_path / "s.html").read_text()
    assert page.count("<figure>") == 2 and "tikhonov" in page and "class=best" in page
    assert (
        run(
            [
                "score",
                str(folder / "spectral" / "chart-pinv.h5"),
                "--truth",
                "colorchecker",
                "-o",
                str(tmp_path / "c.json"),
                "--report",
                str(tmp_path / "c.html"),
            ]
        )
        == 0
    )
    assert (tmp_path / "c.html").read_text().count("<figure>") == 3
    pif = ["--pif", str(folder / "spatial" / "pif.h5")]
    assert (
        run(
            [
                "score",
                str(folder / "spatial" / "dictionary.h5"),
                *pif,
                "-o",
                str(tmp_path / "d.json"),
                "--report",
                str(tmp_path / "d.html"),
            ]
        )
        == 0
    )
    assert (tmp_path / "d.html").read_text().count("<figure>") == 1


def test_command_line(folder, tmp_path, capsys):
    (tmp_path / "run").mkdir()
    shutil.copy(folder / "spatial" / "same" / "lmmse.h5", tmp_path / "run")
    arguments = ["report", str(tmp_path / "run"), "-o", str(tmp_path / "r.html")]
    assert run([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sections"] == ["Spatial"]
    assert run(arguments) == 2
    assert run(["report", str(tmp_path / "none"), "-o", str(tmp_path / "q.html")]) == 3


def test_responses_are_compared_and_the_filters_of_a_described_camera_drawn(tmp_path):
    rng = np.random.default_rng(2)
    root = tmp_path / "run"
    text = (ROOT / "sample_configs" / "demo_spectral.toml").read_text()
    rows, cols = np.mgrid[0:4, 0:5]
    measured = rng.random((4, 5, 64, 4))
    for name, response, config in (
        ("measured", measured, ""),
        ("predicted", measured.mean(axis=(0, 1)) * 1.1, text),
    ):
        data = {
            "grid/centre": np.stack([rows * 8 + 3.5, cols * 8 + 3.5], -1),
            "grid/valid": np.ones((4, 5), bool),
            "response/F": response,
            "response/window": np.array([8, 8]),
            "response/wavelength": BANDS,
            "response/origin": np.stack([rows * 8, cols * 8], -1),
        }
        attrs = {"grid": {"lattice": "square"}, "response": {"condition": 1.3, "units": "DN"}}
        root.mkdir(exist_ok=True)
        write_artefact(
            root / f"{name}.h5",
            Artefact(
                "calibration",
                data,
                attrs,
                Provenance(command="made here", inputs={}, seed=None, config=config),
            ),
        )
    run_score([root / "predicted.h5"], root / "score-response.json", truth=root / "measured.h5")
    run_report(root, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert (
        "Responses compared" in page
        and "error of the response, 450 nm" in page
        and "predicted.h5 less measured.h5" in page
    )
    # difference; grid and response of either; filters of the one that is described
    assert page.count("<figure>") == 1 + 2 + 3
    # caption and description of one picture
    assert page.count("Filters in the pupil of the main lens, seen") == 2


@pytest.mark.skipif(browser.CHROMIUM is None, reason="no Chromium here to open the page in")
@pytest.mark.parametrize("width, height", [(1280, 900), (390, 844)], ids=["desktop", "phone"])
def test_a_browser_shows_the_page_without_a_network(page, tmp_path, width, height):
    import io

    from PIL import Image

    (tmp_path / "profile").mkdir()
    pictures = (
        "Promise.all([...document.images].map(i => i.decode())).then(() => "
        "[...document.images].map(i => [i.naturalWidth, i.getBoundingClientRect().width]))"
    )
    seen = browser.look_at(
        page,
        width,
        height,
        (
            f"{pictures}.then(p => ({{pictures: p, best: [...document.querySelectorAll('table')]"
            ".filter(t => t.querySelector('.best')).map(t => Math.min(...[...t.querySelectorAll("
            "'.best')].map(b => b.getBoundingClientRect().right))), words: "
            "[...document.querySelectorAll('.scroll:has(.text)')].map(s => "
            "s.scrollWidth - s.clientWidth), needs: "
            "document.documentElement.scrollWidth, has: innerWidth}))"
        ),
        tmp_path / "profile",
    )
    assert seen["messages"] == []
    assert [address for address in seen["requests"] if not address.startswith("data:")] == [
        page.resolve().as_uri()
    ]
    assert len(seen["value"]["pictures"]) == 15 and all(
        natural > 300 and shown > 250 for natural, shown in seen["value"]["pictures"]
    )
    assert seen["value"]["needs"] <= seen["value"]["has"] == width, "the page scrolls sideways"
    best, words = seen["value"]["best"], seen["value"]["words"]
    assert best and max(best) <= width and words and max(words) == 0
    shot = np.asarray(Image.open(io.BytesIO(seen["png"])).convert("L"))
    assert shot.shape[1] == width and shot.shape[0] > 4 * height
    dark = (shot < 128).reshape(len(shot), -1).any(axis=1)
    assert (
        np.ptp(shot) > 200 and dark.mean() > 0.3 and np.flatnonzero(dark)[-1] > 0.9 * len(shot)
    ), "pictures and text from top to bottom"


def test_many_captures_are_counted_and_the_others_named(tmp_path):
    """Forty captures of one long command and a grid alone: no row repeats the command, the rest of
    the captures is named, and the grid does not stand under filters.
    """
    rng = np.random.default_rng(11)
    names = [f"night-{i:02}.h5" for i in range(40)]
    command = f"plenocli capture-sim {' '.join(names)} --seed 1 -o night"
    for name in names:
        data = {"capture/mosaic": rng.random((20, 20)).astype("f4"), "capture/cfa": "mono"}
        put(tmp_path / name, "capture", data, {"capture": {"units": "DN"}}, command=command)
    centres = np.stack(np.meshgrid(*2 * [np.arange(4.0) * 5 + 2], indexing="ij"), -1)
    grid = {"grid/centre": centres, "grid/valid": np.ones((4, 4), bool)}
    attrs = {"grid": {"lattice": "square", "pitch": [5.0, 5.0], "angle": 0.0}}
    put(tmp_path / "grid.h5", "calibration", grid, attrs, {"white": tmp_path / names[0]})
    made = run_report(tmp_path, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert "Lenslets" in made.sections and "Filters in the pupil" not in page
    assert "Captures: 3 of 39" in page and "36 more: plenocli view FILE" in page
    assert page.count(" ".join(names[15:25])) == 1, "the long command in full, once"
    assert f"plenocli capture-sim {names[0]}" in page and "--seed 1 -o night" in page
    assert len(page) < 1e6


def test_the_report_links_to_the_views_of_its_files(folder, tmp_path):
    there = tmp_path / "a page"
    there.mkdir()
    made = run_report(folder, tmp_path / "r.html", view=there / "view.html")
    page, views = (tmp_path / "r.html").read_text(), (there / "view.html").read_text()
    content = json.loads(views.split('id="content">')[1].split("</script>")[0])
    titles = [panel["title"] for panel in content]
    assert made.view == str(there / "view.html")
    assert any("lmmse.h5" in t and "tikhonov.h5" in t for t in titles), "one truth, one panel"
    for word in ("capture.h5", "pif.h5", "dictionary.h5", "chart-pinv.h5", "calibration.h5"):
        assert any(word in title for title in titles), word
    for number, title in enumerate(titles):
        assert f'<a href="a%20page/view.html#p{number}">{title}</a>' in page
    with pytest.raises(UsageError):
        run_report(folder, tmp_path / "r.html", view=tmp_path / "r.html", overwrite=True)
