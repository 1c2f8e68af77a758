import json

import numpy as np
import pytest
from PIL import Image

from plenocli.base import progress
from plenocli.base.errors import InputError, UsageError
from plenocli.cli.main import run
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.writing import write_artefact
from plenocli.forward.scene.chart import chart_labels, chart_scene
from plenocli.stages.evaluation.score.run import run_score, table

BANDS = np.array([450e-9, 540e-9, 570e-9, 650e-9])


def put(path, kind, data, **attrs):
    write_artefact(
        path,
        Artefact(kind, data, {kind: attrs} if attrs else {}, Provenance(command="test")),
        overwrite=True,
    )
    return path


@pytest.fixture
def picture(tmp_path):
    """A capture that holds its scene 3 times finer (36 x 36), and two results of 12 x 12
    points, 3 x 3 lenslets.
    """
    scene = np.random.default_rng(0).random((1, 36, 36)).astype("f4")
    capture = put(
        tmp_path / "capture.h5",
        "capture",
        {
            "capture/mosaic": np.full((15, 15), 2.0, "f4"),
            "capture/cfa": "mono",
            "capture/scene": scene,
            "capture/wavelength": np.array([550e-9]),
        },
        units="electron",
        black=0.0,
        lenslet_count=[3, 3],
        noise_sigma=0.002,
    )
    truth = scene[0].reshape(12, 3, 12, 3).mean(axis=(1, 3))
    good = put(
        tmp_path / "good.h5", "image", {"image/value": (truth + 0.01).astype("f4")}, method="lmmse"
    )
    poor = put(
        tmp_path / "poor.h5",
        "image",
        {"image/value": (truth + 0.1).astype("f4")},
        method="block-mean",
    )
    return tmp_path, capture, good, poor, truth


def test_pictures_side_by_side(picture):
    folder, capture, good, poor, truth = picture
    document = run_score([good, poor], folder / "score.json", truth=capture, capture=capture)
    stored = json.loads((folder / "score.json").read_text())
    assert stored.pop("seal").startswith("plenocli sha256 ") and stored == document.as_json()
    first, second = (entry.figures for entry in document.results)
    assert document.figures == first
    assert first["psnr_db"] == pytest.approx(40, abs=1e-4) and second["psnr_db"] == pytest.approx(
        20, abs=1e-4
    )
    assert first["psnr_inner_db"] == pytest.approx(40, abs=1e-4)
    blocks = truth.reshape(3, 4, 3, 4).transpose(0, 2, 1, 3).reshape(9, 16)
    assert first["block_mean_psnr_db"] == pytest.approx(
        -10 * np.log10(blocks.var(axis=1).mean()), abs=1e-4
    )
    assert first["snr_sensor_db"] == pytest.approx(60, abs=1e-4)
    assert set(first) <= set(document.definitions)
    lines = table(document).splitlines()
    assert lines[0].split() == ["good", "poor"] and "40.00" in lines[2] and "20.00" in lines[2]


def test_a_perfect_result_gives_null_and_not_infinity(picture):
    folder, capture, _, _, truth = picture
    result = put(folder / "perfect.h5", "image", {"image/value": np.full((12, 12), 0.5, "f8")})
    same = put(folder / "same.h5", "image", {"image/value": np.full((12, 12), 0.5, "f8")})
    document = run_score([result], folder / "p.json", truth=same)
    assert document.figures["psnr_db"] is None and document.figures["rmse"] == 0
    assert "Infinity" not in (folder / "p.json").read_text()


@pytest.mark.parametrize("level, side", [(0.0, 12), (0.5, 12), (1.0, 1)])
def test_a_truth_without_detail_is_told(picture, capsys, level, side):
    """A photograph of one pixel is as even as a black one of the result's size."""
    folder, _, good, *_ = picture
    Image.fromarray(np.full((side, side), 255 * level, "u1")).save(folder / "even.png")
    run_score([good], folder / "s.json", truth=folder / "even.png")
    told = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert len(told) == 1 and "even.png" in told[0] and "everywhere" in told[0]


def test_only_the_metrics_asked_for(picture):
    folder, capture, good, *_ = picture
    document = run_score([good], folder / "s.json", truth=capture, metrics=("ssim",))
    assert set(document.figures) == {"ssim"} == set(document.definitions)
    with pytest.raises(UsageError, match="--white"):
        run_score([good], folder / "t.json", truth=capture, metrics=("snr",))
    assert not (folder / "t.json").exists()


@pytest.mark.parametrize(
    "option", [{"classes": "no-table"}, {"detect": "rust"}, {"learnt": True}, {"prior": "paints"}]
)
def test_what_means_nothing_to_any_result_is_refused(picture, option):
    """It would stand among the inputs of figures that it has no part in."""
    folder, capture, good, *_ = picture
    (name,) = option
    with pytest.raises(UsageError, match=f"--{name}: means nothing to a result that is image"):
        run_score([good], folder / "t.json", truth=capture, **option)
    assert not (folder / "t.json").exists()


def test_one_bad_result_does_not_stop_the_others(picture, capfd, monkeypatch):
    folder, capture, good, *_ = picture
    (folder / "torn.h5").write_bytes((folder / "poor.h5").read_bytes()[:-100])
    with pytest.raises(InputError, match="1 of 2 results failed: torn.h5; the others are scored"):
        run_score([folder / "torn.h5", good], folder / "s.json", truth=capture)
    document = json.loads((folder / "s.json").read_text())
    assert "error" in document["results"][0] and str(folder) not in document["results"][0]["error"]
    assert document["metrics"]["psnr_db"] == pytest.approx(40, abs=1e-4)
    capfd.readouterr()
    monkeypatch.setattr(progress, "quiet", True)  # which errors do not heed
    with pytest.raises(
        InputError, match="2 of 2 results failed: torn.h5, none.h5; nothing is written"
    ):
        run_score([folder / "torn.h5", folder / "none.h5"], folder / "never.json", truth=capture)
    assert capfd.readouterr().err.count("error: ") == 2 and not (folder / "never.json").exists()


def test_another_grid_is_refused(picture):
    folder, capture, *_ = picture
    odd = put(folder / "odd.h5", "image", {"image/value": np.zeros((12, 18), "f4")})
    with pytest.raises(InputError, match="36 x 36"):
        run_score([odd], folder / "s.json", truth=capture)


@pytest.fixture
def chart(tmp_path):
    """Spectra of a chart over 24 x 36 lenslets with known errors, and two frames
    of a white target.
    """
    rng = np.random.default_rng(1)
    fine = chart_scene(480, 720, BANDS)[0].astype("f8")
    truth = fine.reshape(4, 24, 20, 36, 20).mean(axis=(2, 4))
    sigma = np.full(truth.shape, 0.01)
    result = put(
        tmp_path / "chart.h5",
        "spectra",
        {
            "spectra/value": truth + np.array([0.0, 0.01, 0.02, 0.03])[:, None, None],
            "spectra/wavelength": BANDS,
            "spectra/sigma": sigma,
        },
        quantity="reflectance",
        method="pinv",
    )
    whites = [
        put(
            tmp_path / f"white{i}.h5",
            "spectra",
            {
                "spectra/value": 1 + 0.01 * rng.standard_normal(truth.shape),
                "spectra/wavelength": BANDS,
                "spectra/sigma": sigma,
            },
            quantity="reflectance",
        )
        for i in range(2)
    ]
    return tmp_path, result, whites, truth


def test_spectra_against_the_chart(chart):
    folder, result, whites, _ = chart
    document = run_score([result], folder / "s.json", truth="colorchecker", whites=whites)
    scores = document.figures
    np.testing.assert_allclose(scores["rmse_per_band"], [0, 0.01, 0.02, 0.03], atol=1e-6)
    np.testing.assert_allclose(scores["six_patch_rmse_per_band"], [0, 0.01, 0.02, 0.03], atol=1e-6)
    assert scores["patches"] == 24 and scores["six_patches_seen"] == 6
    np.testing.assert_allclose(scores["snr_capture_db"], 40, atol=0.5)
    np.testing.assert_allclose(scores["snr_predicted_db"], 40, atol=0.1)
    assert "over time" in scores["snr_target"]
    assert scores["delta_e_2000"] > 0 and scores["spectral_angle_deg"] > 0
    white = document.results[0].patches[18]
    assert white.name.startswith("white") and white.one_of_six
    assert white.mean[3] - white.truth[3] == pytest.approx(0.03, abs=1e-6)
    assert "RMSE over the six patches, 650 nm" in table(document)


def test_truth_as_spectral_cube_finer_in_space_and_wavelength(chart):
    folder, result, _, _ = chart
    fine = np.sort(np.append(np.arange(400, 701, 10) * 1e-9, []))
    cube = chart_scene(240, 360, fine)[0]
    scene = put(folder / "scene.h5", "image", {"image/value": cube, "image/wavelength": fine})
    document = run_score([result], folder / "s.json", truth=scene, patches="colorchecker")
    np.testing.assert_allclose(
        document.figures["six_patch_rmse_per_band"], [0, 0.01, 0.02, 0.03], atol=2e-4
    )


def test_radiance_is_divided_by_the_white_target(chart):
    folder, _, _, truth = chart
    light = np.array([2.0, 3.0, 0.5, 7.0])[:, None, None] * np.linspace(0.5, 1, 36)
    data = {"spectra/wavelength": BANDS}
    result = put(
        folder / "radiance.h5",
        "spectra",
        data | {"spectra/value": truth * light},
        quantity="radiance",
    )
    white = put(
        folder / "white.h5",
        "spectra",
        data | {"spectra/value": 0.99 * light * np.ones(truth.shape)},
        quantity="radiance",
    )
    with pytest.raises(UsageError, match="--white"):
        run_score([result], folder / "s.json", truth="colorchecker")
    document = run_score([result], folder / "s.json", truth="colorchecker", whites=[white])
    assert max(document.figures["rmse_per_band"]) < 1e-6


def test_label_map_from_a_file(chart):
    from PIL import Image

    folder, result, _, _ = chart
    Image.fromarray(chart_labels(48, 72)).save(folder / "map.png")
    document = run_score(
        [result], folder / "s.json", truth="colorchecker", patches=folder / "map.png"
    )
    assert document.figures["patches"] == 24
    Image.fromarray(chart_labels(25, 36)).save(folder / "bad.png")
    with pytest.raises(InputError, match="24 x 36"):
        run_score([result], folder / "t.json", truth="colorchecker", patches=folder / "bad.png")


def test_dictionary_needs_its_matrix(tmp_path):
    rng = np.random.default_rng(2)
    system = rng.random((1, 1, 25, 16)).astype("f4")
    pif = put(
        tmp_path / "pif.h5",
        "pif",
        {
            "pif/A": system,
            "pif/wavelength": np.array([550e-9]),
            "pif/lenslet_offset": np.zeros((1, 2), int),
            "pif/pixel_shape": np.array([5, 5]),
            "pif/object_shape": np.array([4, 4]),
            "pif/column_energy": system.sum(axis=(1, 2)),
        },
    )
    dictionary = put(tmp_path / "d.h5", "dictionary", {"dictionary/atoms": np.eye(16, dtype="f4")})
    with pytest.raises(UsageError, match="--pif"):
        run_score([dictionary], tmp_path / "s.json")
    document = run_score([dictionary], tmp_path / "s.json", pif=pif)
    unit = system[0, 0] / np.linalg.norm(system[0, 0], axis=0)
    assert document.figures["coherence_effective"] == pytest.approx(
        np.abs(unit.T @ unit - np.eye(16)).max(), rel=1e-4
    )
    assert document.figures["coherence_raw"] == pytest.approx(system.max(), rel=1e-5)


def test_exr_results(picture):
    from plenocli.files.images.exr import write_exr

    folder, capture, _, _, truth = picture
    write_exr(folder / "good.exr", {"Y": (truth + 0.01).astype("f4")}, {}, overwrite=False)
    document = run_score([folder / "good.exr"], folder / "s.json", truth=capture)
    assert document.figures["psnr_db"] == pytest.approx(40, abs=1e-4)


def test_spectral_exr_results(chart):
    from plenocli.files.images.spectral_exr import write_spectral_exr

    folder, _, _, truth = chart
    write_spectral_exr(
        folder / "c.exr", BANDS, (truth + 0.02).astype("f4"), "reflectance", overwrite=False
    )
    document = run_score([folder / "c.exr"], folder / "s.json", truth="colorchecker")
    np.testing.assert_allclose(document.figures["rmse_per_band"], 0.02, atol=1e-6)


def test_command_line(picture, capsys):
    folder, capture, good, poor, _ = picture
    arguments = [
        "score",
        str(good),
        str(poor),
        "--truth",
        str(capture),
        "-o",
        str(folder / "s.json"),
    ]
    assert run(arguments) == 0
    assert "PSNR [dB]" in capsys.readouterr().out
    assert run(arguments) == 2 and "--overwrite" in capsys.readouterr().err
    assert run([*arguments, "--overwrite", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["metrics"]["psnr_db"] == pytest.approx(40, abs=1e-4)
    assert run(["score", str(good), "-o", str(folder / "t.json")]) == 2
    assert (
        run(
            [
                "score",
                str(folder / "absent.h5"),
                "--truth",
                str(capture),
                "-o",
                str(folder / "t.json"),
            ]
        )
        == 3
    )
    assert (
        run(["score", str(good), "--truth", str(capture), "-o", str(folder / "no" / "t.json")]) == 4
    )


def test_a_picture_is_no_white_target(tmp_path):
    from plenocli.files.images.exr import write_exr
    from plenocli.files.results.results import read_result

    write_exr(tmp_path / "grey.exr", {"Y": np.ones((4, 4), np.float32)}, {})
    assert read_result(tmp_path / "grey.exr").kind == "image"
    with pytest.raises(InputError, match="spectra are due"):
        read_result(tmp_path / "grey.exr", ("spectra",))


def test_a_dash_prints_the_document_and_writes_nothing(tmp_path, capsys):
    values = np.random.default_rng(1).random((12, 12)).astype(np.float32)
    for name in ("a.h5", "b.h5"):
        made = Artefact("image", {"image/value": values}, {}, Provenance(command="test"))
        write_artefact(tmp_path / name, made)
    words = ["score", str(tmp_path / "*.h5"), "--truth", str(tmp_path / "a.h5"), "-o", "-"]
    assert run(words) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in printed["results"]] == ["a.h5", "b.h5"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.h5", "b.h5"]
