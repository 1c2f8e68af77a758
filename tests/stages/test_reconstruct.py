"""reconstruct and learn-dict through the command line, on a small camera written down here."""

import json
import sys

import numpy as np
import pytest

from plenocli.base.device import CPU, Device
from plenocli.base.linear_maps import BlockToeplitz
from plenocli.base.tiling import to_blocks, to_plane
from plenocli.cli.main import run
from plenocli.evaluation.metrics.quality import psnr
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.read.scenes import embedded_photograph
from plenocli.forward.scene.sample import luminance, sample_picture
from plenocli.stages.inverse.reconstruct import recipe

N, PIXELS, COUNT = 6, 9, 8


def matrices(coupled):
    """Blocks (offset, pixel, point): each pixel sees a blurred, slightly shifted part of the
    block, separably; and a little of the next.
    """
    row = np.exp(
        -(
            ((np.arange(PIXELS)[:, None] + 0.5) * 1.1 * N / PIXELS - 0.4 - np.arange(N)[None, :])
            ** 2
        )
        / 4
    )
    own = np.kron(row, row)
    own /= 1.2 * own.sum(axis=0).max()
    if not coupled:
        return own[None], np.zeros((1, 2), int)
    ring = np.array([[r, c] for r in (-1, 0, 1) for c in (-1, 0, 1)])
    return np.stack(
        [
            own
            if not o.any()
            else 0.02
            / np.abs(o).sum()
            * np.roll(own, 2 * o[0] * PIXELS + 2 * o[1], axis=0)[:, ::-1]
            for o in ring
        ]
    ), ring


def make_files(folder, coupled=False, noise=60.0, stray=1.0, beyond=0, **attrs):
    """pif.h5 and capture.h5 (of the astronaut) in `folder`; returns the true picture.

    stray: neighbours' light in the capture, over that of the pif;
    beyond: lenslets by which the scene goes on outside the array.
    """
    blocks, offsets = matrices(coupled)
    data = {
        "pif/A": blocks[None],
        "pif/wavelength": np.array([550e-9]),
        "pif/lenslet_offset": offsets,
        "pif/pixel_shape": np.array([PIXELS] * 2),
        "pif/object_shape": np.array([N] * 2),
        "pif/column_energy": blocks.sum(axis=(0, 1))[None],
    }
    write_artefact(
        folder / "pif.h5",
        Artefact(
            "pif",
            data,
            {},
            Provenance(command="test", accuracy={"estimated": 1e-6, "model": "fresnel"}),
        ),
        overwrite=True,
    )
    side, inside = COUNT + 2 * beyond, slice(beyond, beyond + COUNT)
    picture = np.asarray(
        sample_picture(luminance(embedded_photograph("astronaut")), side * N, side * N), float
    )
    y = BlockToeplitz(
        blocks * np.where(offsets.any(axis=1), stray, 1)[:, None, None], offsets, (side, side)
    ).forward(to_blocks(picture, (N, N)))[inside, inside]
    picture = picture[beyond * N : (beyond + COUNT) * N, beyond * N : (beyond + COUNT) * N]
    sigma = np.sqrt(np.mean(y**2) * 10 ** (-noise / 10))
    y = y + sigma * np.random.default_rng(0).standard_normal(y.shape)
    about = (
        dict(
            units="relative",
            black=0.0,
            noise_sigma=float(sigma),
            superpixel_shape=[PIXELS] * 2,
            lenslet_count=[COUNT] * 2,
            target="skimage:astronaut",
        )
        | attrs
    )
    mosaic = {
        "capture/mosaic": to_plane(y, (PIXELS, PIXELS)),
        "capture/cfa": "mono",
        "capture/scene": picture[None].astype(np.float32),
        "capture/wavelength": np.array([550e-9]),
    }
    write_artefact(
        folder / "capture.h5",
        Artefact(
            "capture",
            mosaic,
            {"capture": {k: v for k, v in about.items() if v is not None}},
            Provenance(command="test"),
        ),
        overwrite=True,
    )
    return picture


def reconstruct(folder, *options, output="out.h5"):
    assert (
        run(
            [
                "reconstruct",
                str(folder / "capture.h5"),
                "--pif",
                str(folder / "pif.h5"),
                "-o",
                str(folder / output),
                "--overwrite",
                *options,
            ]
        )
        == 0
    )
    return read_artefact(folder / output, "image")


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    folder = tmp_path_factory.mktemp("single")
    return folder, make_files(folder)


def test_methods_order_as_they_should(single):
    folder, truth = single
    quality = {}
    for method in ("block-mean", "tikhonov", "tsvd", "nnls", "lmmse"):
        image = reconstruct(folder, "--method", method)
        assert image.attrs["image"]["method"] == method
        quality[method] = psnr(image.data["image/value"], truth)
    assert quality["tikhonov"] > quality["block-mean"] + 3
    assert quality["tsvd"] > quality["block-mean"] + 2
    # a picture shrunk tenfold is no match for the statistics of photographs
    assert quality["lmmse"] > quality["block-mean"] + 3
    assert (
        psnr(
            reconstruct(folder, "--method", "tikhonov", "--truth", str(folder / "capture.h5")).data[
                "image/value"
            ],
            truth,
        )
        >= quality["tikhonov"] - 1e-6
    )


def test_block_mean_is_the_mean_of_each_block(single):
    folder, truth = single
    from plenocli.forward.scene.sample import block_mean

    image = reconstruct(folder, "--method", "block-mean").data["image/value"]
    np.testing.assert_allclose(block_mean(image, (N, N)), block_mean(truth, (N, N)), atol=0.08)
    assert np.ptp(image[:N, :N]) == 0


def test_orientation_is_kept(tmp_path):
    picture = make_files(tmp_path, noise=90.0)
    image = reconstruct(tmp_path, "--method", "tikhonov").data["image/value"]
    assert all(
        psnr(image, picture) > psnr(image, turned) + 5
        for turned in (picture[::-1], picture[:, ::-1], picture.T)
    )


def test_lmmse_says_how_sure_it_is(single):
    folder, truth = single
    image = reconstruct(folder, "--method", "lmmse")
    error = np.sqrt(np.mean((image.data["image/value"] - truth) ** 2))
    assert 0.3 < np.sqrt(np.mean(image.data["image/sigma"] ** 2)) / error < 3
    parameters = image.attrs["image"]["parameters"]
    assert parameters["noise_source"] == "from the capture"


def test_what_cannot_be_seen_is_told(single, tmp_path, capsys):
    folder, truth = single
    image = reconstruct(folder, "--method", "tikhonov", output="seen.h5")
    seen, told = image.data["image/seen"], image.attrs["image"]["parameters"]["seen"]
    a, noise = matrices(False)[0][0], image.attrs["image"]["parameters"]["noise_sigma"]
    # half the brightness of the picture is the contrast of photographs
    bright = reconstruct(folder, "--method", "block-mean", output="mean.h5").data["image/value"]
    ratio = (noise / (0.5 * np.sqrt(np.mean(bright**2)))) ** 2
    expected = np.diag(np.linalg.solve(a.T @ a + ratio * np.eye(N * N), a.T @ a))
    np.testing.assert_allclose(seen, expected.reshape(N, N), atol=1e-6)
    assert (
        told["share"] == pytest.approx(expected.mean(), abs=1e-6)
        and 0 < told["degrees_of_freedom"] <= N * N
        and "symmetric" not in told
    )
    louder = tmp_path / "louder"
    louder.mkdir()
    make_files(louder, noise=30.0)
    assert (
        reconstruct(louder, "--method", "tikhonov").data["image/seen"].mean() < seen.mean() - 0.05
    )
    a = a + a[:, ::-1]  # an object and itself turned by 180 degrees look alike
    pif = read_artefact(folder / "pif.h5", "pif")
    pif.data["pif/A"] = a[None, None]
    write_artefact(louder / "pif.h5", pif, overwrite=True)
    image = reconstruct(louder, "--method", "tikhonov")
    assert (
        image.attrs["image"]["parameters"]["seen"]["symmetric"]
        and image.data["image/seen"].mean() <= 0.5
        and "half of the object" in capsys.readouterr().err
    )


@pytest.mark.parametrize("noise", [60.0, 20.0])
def test_auto_tries_and_tells(tmp_path, noise):
    truth = make_files(tmp_path, noise=noise)
    images = {m: reconstruct(tmp_path, "--method", m) for m in ("auto", "lmmse", "pnp", "tv")}
    quality = {m: psnr(i.data["image/value"], truth) for m, i in images.items()}
    parameters = images["auto"].attrs["image"]["parameters"]
    assert (
        set(parameters["trial_db"]) == {"lmmse", "pnp"}
        and "photographs at this noise" in parameters["reason"]
    )
    assert quality["auto"] >= quality["lmmse"] - 0.05 and quality["auto"] in (
        quality["lmmse"],
        quality["pnp"],
    ), quality
    assert quality["pnp"] > quality["lmmse"] - 0.3 and quality["tv"] > quality["lmmse"] - 1.5, (
        quality
    )


def test_unknown_noise_is_estimated_and_said(tmp_path, capsys):
    make_files(tmp_path, noise_sigma=None)
    parameters = reconstruct(tmp_path, "--method", "tikhonov").attrs["image"]["parameters"]
    assert (
        "estimated" in parameters["noise_source"]
        and "does not say one noise" in capsys.readouterr().err
    )
    make_files(tmp_path)
    known = reconstruct(tmp_path, "--method", "tikhonov").attrs["image"]["parameters"][
        "noise_sigma"
    ]
    assert parameters["noise_sigma"] == pytest.approx(known, rel=0.1)


def test_neighbours_light_is_noticed_and_taken_away(tmp_path, capsys):
    truth = make_files(tmp_path, coupled=True)
    quality = {}
    for method in ("tikhonov", "lmmse", "tsvd", "pnp"):
        alone = reconstruct(tmp_path, "--method", method, "--overlap", "1")
        said = capsys.readouterr().err
        assert "3x3" in said and "which the pif knows, stays in the superpixels" in said
        joint = reconstruct(tmp_path, "--method", method)
        assert "stays in the superpixels" not in capsys.readouterr().err
        quality[method] = [psnr(i.data["image/value"], truth) for i in (alone, joint)]
        assert quality[method][1] > quality[method][0] + 1, quality
    # the border's lenslets are those of lmmse
    assert quality["pnp"][1] > quality["lmmse"][1] + 0.1, quality


def border(picture):
    return np.concatenate(
        [
            picture[:N].ravel(),
            picture[-N:].ravel(),
            picture[N:-N, :N].ravel(),
            picture[N:-N, -N:].ravel(),
        ]
    )


def test_the_border_is_that_of_the_joint_estimate(tmp_path):
    make_files(tmp_path, coupled=True, beyond=1)
    joint, whole, single = (
        reconstruct(tmp_path, "--method", m) for m in ("lmmse", "pnp", "tikhonov")
    )
    for image in (whole, single):
        np.testing.assert_allclose(
            border(image.data["image/value"]), border(joint.data["image/value"]), atol=1e-12
        )
        assert "beyond the array" in image.attrs["image"]["parameters"]["border"]


def test_light_that_the_matrix_lacks_does_not_pass_for_contrast(tmp_path):
    truth = make_files(tmp_path, coupled=True, stray=3.0)
    image = reconstruct(tmp_path, "--method", "lmmse")
    # with the likeliest, 30 for all lenslets, the picture has 12.6 dB
    assert image.attrs["image"]["parameters"]["scale"] < 3
    assert psnr(image.data["image/value"], truth) > 19


@pytest.mark.parametrize("stray, gain", [(1.0, 3), (3.0, 1), (10.0, -0.2)])
def test_light_that_the_matrix_lacks_is_not_amplified(tmp_path, stray, gain, capsys):
    """A matrix without neighbours takes their light for contrast; believed, it would cost up to
    6 dB more than the mean of each block.
    """
    truth = make_files(tmp_path, coupled=True, stray=stray)
    floor = psnr(reconstruct(tmp_path, "--method", "block-mean").data["image/value"], truth)
    capsys.readouterr()
    for method, less in (("lmmse", 0), ("pnp", 2), ("tv", 0), ("tikhonov", 2), ("tsvd", 2)):
        image = reconstruct(tmp_path, "--method", method, "--overlap", "1")
        # light of the neighbours is as continuous as they are, and Tikhonov knows no photographs
        least = max(gain - less, -0.2 if method != "tikhonov" else -0.6)
        assert psnr(image.data["image/value"], truth) > floor + least, method
        parameters = image.attrs["image"]["parameters"]
        assert not parameters["matrix_believed"] and parameters["noise_raised"] > 5
        assert "is not quite this camera's" in capsys.readouterr().err


@pytest.mark.parametrize("stray, lost", [(1.2, 2), (1.5, 8)])
def test_some_light_that_the_matrix_lacks_costs_little(tmp_path, stray, lost):
    faultless = make_files(tmp_path, coupled=True)
    image = reconstruct(tmp_path, "--method", "lmmse")
    assert image.attrs["image"]["parameters"]["matrix_believed"]
    best = psnr(image.data["image/value"], faultless)
    truth = make_files(tmp_path, coupled=True, stray=stray)
    for method in ("lmmse", "tikhonov", "tv", "pnp"):
        image = reconstruct(tmp_path, "--method", method)
        assert image.attrs["image"]["parameters"]["matrix_believed"] == (stray == 1.2), method
        assert psnr(image.data["image/value"], truth) > best - lost, method


def test_dictionary_chain(single, tmp_path, capsys):
    folder, truth = single
    learn = [
        "learn-dict",
        "skimage:camera",
        "skimage:coffee",
        "skimage:coins",
        "--pif",
        str(folder / "pif.h5"),
        "--batch",
        "150",
        "--lambda",
        "1e-6",
    ]
    for name, iterations, more in (
        ("a", 2, []),
        ("b", 4, ["--resume", str(folder / "a.h5")]),
        ("c", 4, []),
    ):
        assert (
            run(
                [
                    *learn,
                    "--iterations",
                    str(iterations),
                    *more,
                    "-o",
                    str(folder / f"{name}.h5"),
                    "--json",
                ]
            )
            == 0
        )
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (
        report["iterations"] == 4
        and report["beats_lmmse"] in (True, False)
        and 0 < report["coherence"]["coherence_effective"] <= 1
    )
    resumed, whole = (read_artefact(folder / f"{name}.h5", "dictionary") for name in "bc")
    for key in whole.data:
        assert resumed.data[key].tobytes() == whole.data[key].tobytes(), key
    assert (
        whole.data["dictionary/atoms"].shape == (N * N, N * N)
        and len(whole.data["dictionary/history/objective"]) == 4
    )
    image = reconstruct(folder, "--method", "dictionary", "--dictionary", str(folder / "c.h5"))
    floor = psnr(reconstruct(folder, "--method", "block-mean").data["image/value"], truth)
    assert psnr(image.data["image/value"], truth) > floor + 2
    assert image.attrs["image"]["parameters"]["worst_gap"] <= 1e-6
    assert "less noise" not in capsys.readouterr().err
    noisy = make_files(tmp_path, noise=20.0)  # lambda must follow, or the code paints noise: 11 dB
    quality = {
        m: psnr(reconstruct(tmp_path, "--method", m, *more).data["image/value"], noisy)
        for m, more in (("lmmse", ()), ("dictionary", ("--dictionary", str(folder / "c.h5"))))
    }
    assert quality["dictionary"] > quality["lmmse"] - 1.5, quality
    assert "less noise than this capture has" in capsys.readouterr().err
    given = ["--method", "auto", "--dictionary", str(folder / "c.h5")]
    assert set(reconstruct(folder, *given).attrs["image"]["parameters"]["trial_db"]) == {
        "lmmse",
        "pnp",
        "dictionary",
    }
    capsys.readouterr()
    # what it was learnt from would flatter it
    known = reconstruct(
        folder, *given, "--training", "skimage:camera", "--training", "skimage:coffee"
    )
    assert (
        set(known.attrs["image"]["parameters"]["trial_db"]) == {"lmmse", "pnp"}
        and "does not try the dictionary" in capsys.readouterr().err
    )


def test_several_captures_go_to_a_folder(single, tmp_path, capsys):
    folder, _ = single
    copies = [tmp_path / f"{n}.h5" for n in "ab"]
    for copy in copies:
        copy.write_bytes((folder / "capture.h5").read_bytes())
    (tmp_path / "bad.h5").write_bytes(b"nothing")
    arguments = [
        "reconstruct",
        *map(str, copies),
        str(tmp_path / "bad.h5"),
        "--pif",
        str(folder / "pif.h5"),
        "--method",
        "tikhonov",
        "-o",
        str(tmp_path / "out"),
    ]
    assert run(arguments) == 3
    assert sorted(p.name for p in (tmp_path / "out").glob("*.h5")) == ["a.h5", "b.h5"]
    (tmp_path / "bad.h5").unlink()
    assert run([*arguments[:3], *arguments[4:], "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["skipped"] == 2


def test_exr_and_determinism(single):
    folder, _ = single
    one = reconstruct(folder, output="one.h5")
    assert (
        one.data["image/value"].tobytes()
        == reconstruct(folder, output="two.h5").data["image/value"].tobytes()
    )
    assert (folder / "one.h5").read_bytes() == (folder / "two.h5").read_bytes()
    from plenocli.files.images.exr import read_exr

    assert (
        run(
            [
                "reconstruct",
                str(folder / "capture.h5"),
                "--pif",
                str(folder / "pif.h5"),
                "-o",
                str(folder / "one.exr"),
            ]
        )
        == 0
    )
    np.testing.assert_allclose(
        read_exr(folder / "one.exr")[0]["Y"], one.data["image/value"], rtol=1e-6, atol=1e-7
    )


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        ([], 2, "--pif"),
        (["--pif", "PIF", "--method", "dictionary"], 2, "learn-dict"),
        (["--pif", "PIF", "--method", "lmmse", "--truth", "CAPTURE"], 2, "hindsight"),
        (["--pif", "PIF", "--method", "lmmse", "--rank", "3"], 2, "--rank"),
        (["--pif", "CAPTURE"], 3, "pif"),
        (["--pif", "PIF", "--training", "skimage:astronaut"], 3, "flatter"),
    ],
)
def test_refusals(single, capsys, options, code, words):
    folder, _ = single
    names = {"PIF": str(folder / "pif.h5"), "CAPTURE": str(folder / "capture.h5")}
    assert (
        run(
            [
                "reconstruct",
                names["CAPTURE"],
                "-o",
                str(folder / "never.h5"),
                *[names.get(o, o) for o in options],
            ]
        )
        == code
    )
    assert words in capsys.readouterr().err and not (folder / "never.h5").exists()


@pytest.mark.parametrize("more", [[], ["--overwrite"]])
def test_a_folder_of_captures_is_never_written_over_them(single, tmp_path, capsys, more):
    folder, _ = single
    copies = [tmp_path / f"{n}.h5" for n in "ab"]
    for copy in copies:
        copy.write_bytes((folder / "capture.h5").read_bytes())
    assert (
        run(
            [
                "reconstruct",
                *map(str, copies),
                "--pif",
                str(folder / "pif.h5"),
                "--method",
                "tikhonov",
                "-o",
                str(tmp_path),
                *more,
            ]
        )
        == 4
    )
    assert "also an input" in capsys.readouterr().err and read_artefact(copies[0]).kind == "capture"


def test_an_impossible_output_name_is_an_output_error(single):
    folder, _ = single
    assert (
        run(
            [
                "reconstruct",
                str(folder / "capture.h5"),
                "--pif",
                str(folder / "pif.h5"),
                "-o",
                str(folder / ("y" * 300 + ".h5")),
            ]
        )
        == 4
    )


def test_plug_and_play_by_another_library_is_told(single, monkeypatch):
    folder, _ = single
    here = reconstruct(folder, "--method", "pnp")
    library = pytest.importorskip("array_api_strict")
    another = lambda name: Device("another", library) if name == "cuda" else CPU
    monkeypatch.setattr(recipe, "device_of", another)
    there = reconstruct(folder, "--method", "pnp", "--device", "cuda")
    one, two = (found.data["image/value"] for found in (here, there))
    assert np.sqrt(np.mean((one - two) ** 2)) < 1e-5
    told = [found.attrs["image"]["parameters"].get("device") for found in (here, there)]
    assert told == [None, "another"]


def test_a_graphics_card_is_for_what_can_use_it(single, capsys, monkeypatch):
    folder, _ = single
    monkeypatch.setitem(sys.modules, "torch", None)  # not installed
    for method, said in (("lmmse", "use --method pnp"), ("pnp", "PyTorch"), ("auto", "PyTorch")):
        paths = folder / "capture.h5", "--pif", folder / "pif.h5", "-o", folder / "none.h5"
        command = ["reconstruct", *map(str, paths), "--method", method, "--device", "cuda"]
        assert run(command) == 2 and said in capsys.readouterr().err
    assert not (folder / "none.h5").exists()
