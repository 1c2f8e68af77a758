"""demux as a batch: folders, reruns, bad files, workers, formats."""

import json
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import InputError, NumericsError, UsageError
from plenocli.cli.main import run
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.images.spectral_exr import read_spectral_exr
from plenocli.stages.inverse.calibrate import run_calibrate
from plenocli.stages.inverse.demux import Settings, run_demux

PITCH, COUNT, BANDS = 12, 7, (480e-9, 620e-9)


def capture(path, radiance, seed=0, **attrs):
    """A lenslet image with a left and a right half, one band each with 3 % leak; 2 DN white
    noise on 100 DN black.
    """
    y, x = np.indices((PITCH, PITCH)) - (PITCH - 1) / 2
    edge = np.clip((5.2 - np.abs(y)) / 1.5, 0, 1) * np.clip((5.2 - np.abs(x)) / 1.5, 0, 1)
    response = (
        1000 * edge[..., None] * np.where((x > 0)[..., None] == (np.arange(2) == 1), 0.97, 0.03)
    )
    radiance = np.broadcast_to(radiance, (COUNT, COUNT, 2))
    image = np.einsum("rcb,yxb->rycx", radiance, response).reshape(COUNT * PITCH, -1)
    values = 100 + image + np.random.default_rng(seed).normal(0, 2.0, image.shape)
    known = dict(units="DN", black=100.0, white=4095.0, exposure_s=0.1) | attrs
    data = {
        "capture/mosaic": np.rint(values).clip(0, 4095).astype(np.uint16),
        "capture/cfa": "mono",
    }
    write_artefact(
        path,
        Artefact("capture", data, {"capture": {k: v for k, v in known.items() if v is not None}}),
        overwrite=True,
    )
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demux")
    white = capture(folder / "white.h5", 1.0, 1)
    bands = [(w, capture(folder / f"b{k}.h5", np.eye(2)[k], 2 + k)) for k, w in enumerate(BANDS)]
    calibration = folder / "c.h5"
    run_calibrate(calibration, whites=[white], bands=bands)
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.1, 0.9, (4, COUNT, COUNT, 2))
    shots = [capture(folder / f"shot{i}.h5", truth[i], 10 + i) for i in range(4)]
    return dict(white=white, calibration=calibration, shots=shots, truth=truth)


def test_a_folder_of_captures_with_a_bad_one_and_a_rerun(files, tmp_path, capsys):
    bad = tmp_path / "bad.h5"
    bad.write_bytes(files["shots"][0].read_bytes()[:3000])
    out = tmp_path / "spectra"
    arguments = [
        "demux",
        str(files["shots"][0]),
        str(bad),
        *map(str, files["shots"][1:]),
        "--calibration",
        str(files["calibration"]),
        "--format",
        "h5",
        "-o",
        str(out),
    ]
    assert run(arguments) == 3
    err = capsys.readouterr().err
    assert "bad.h5" in err and "1 of 5 captures failed" in err and "Traceback" not in err
    assert sorted(p.name for p in out.glob("*.h5")) == [f"shot{i}.h5" for i in range(4)]
    for i in range(4):
        value = np.moveaxis(
            read_artefact(out / f"shot{i}.h5", "spectra").data["spectra/value"], 0, -1
        )
        np.testing.assert_allclose(value, files["truth"][i], atol=0.01)
    before = {p: p.stat().st_mtime_ns for p in out.glob("*.h5")}
    (out / "shot2.h5").unlink()
    assert run([a for a in arguments if a != str(bad)] + ["--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["done"], report["skipped"]) == (1, 3)
    assert all(p.stat().st_mtime_ns == before[p] for p in out.glob("*.h5") if p.name != "shot2.h5")


def test_workers_write_the_same_bytes(files, tmp_path):
    for name, workers in (("one", 1), ("two", 2)):
        run_demux(
            files["shots"],
            tmp_path / name,
            calibration=files["calibration"],
            suffix=".h5",
            workers=workers,
        )
    for path in (tmp_path / "one").glob("shot*"):
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


def test_exr_holds_value_and_preview(files, tmp_path):
    report = run_demux(
        [files["shots"][1]],
        tmp_path / "s.exr",
        calibration=files["calibration"],
        settings=Settings(method="pinv", reference=files["white"]),
    )
    found = read_spectral_exr(tmp_path / "s.exr")
    assert report.captures[0].quantity == "reflectance"
    np.testing.assert_allclose(found.wavelengths, BANDS, rtol=1e-9)
    cube = found.values if hasattr(found, "values") else found.cube
    np.testing.assert_allclose(
        np.moveaxis(np.asarray(cube), 0, -1), 0.99 * files["truth"][1], atol=0.012
    )


def test_both_files_hold_the_same_and_others_read_them(files, tmp_path):
    """HDF5 by h5py alone and as NXdata, EXR by the OpenEXR package: value, sigma and
    bands, nothing lost.
    """
    import h5py

    OpenEXR = pytest.importorskip("OpenEXR")
    for name in ("s.h5", "s.exr"):
        run_demux([files["shots"][1]], tmp_path / name, calibration=files["calibration"])
    with (
        h5py.File(tmp_path / "s.h5") as file,
        OpenEXR.File(str(tmp_path / "s.exr"), separate_channels=True) as picture,
    ):
        group, channels, header = file["spectra"], picture.channels(), picture.header()
        assert file.attrs["default"] == b"spectra" and group.attrs["NX_class"] == b"NXdata"
        assert group.attrs["signal"] == b"value" and list(group.attrs["axes"]) == [
            b"wavelength",
            b".",
            b".",
        ]
        for k, wavelength in enumerate(group["wavelength"]):
            label = f"{wavelength * 1e9:.6f}nm".replace(".", ",")
            np.testing.assert_array_equal(channels[f"S0.{label}"].pixels, group["value"][k])
            np.testing.assert_array_equal(channels[f"sigma.{label}"].pixels, group["sigma"][k])
        preview = np.stack([channels[c].pixels for c in "RGB"])
        assert np.isfinite(preview).all() and preview.max() > 0.1
        assert header["spectralLayoutVersion"] == "1.0" and header["emissiveUnits"] == "relative"
        assert json.loads(header["parameters"]) == json.loads(group.attrs["parameters"])
    nxdata = pytest.importorskip("silx.io.nxdata")
    with h5py.File(tmp_path / "s.h5") as file:
        plot = nxdata.get_default(file)
        assert (
            plot.is_valid and plot.signal_name == "value" and plot.axes_names[0] == "wavelength (m)"
        )


def test_noise_unknown_is_taken_from_the_residual_and_weights_are_refused(files, tmp_path):
    summary = run_demux([files["shots"][0]], tmp_path / "s.h5", calibration=files["calibration"])
    report = summary.captures[0]
    assert report.method == "pinv" and "not known" in report.reason
    data = read_artefact(tmp_path / "s.h5", "spectra").data
    error = np.moveaxis(data["spectra/value"], 0, -1) - files["truth"][0]
    assert (error / np.moveaxis(data["spectra/sigma"], 0, -1)).std() == pytest.approx(1, abs=0.25)
    with pytest.raises(NumericsError, match="noise, which is not known"):
        run_demux(
            [files["shots"][0]],
            tmp_path / "w.h5",
            calibration=files["calibration"],
            settings=Settings(method="wls"),
        )


def test_a_band_without_values_is_counted_where_it_is(files, tmp_path, capsys):
    """A white reference that is dark in one band tells no reflectance there, and of the others all
    is said.
    """
    dark = capture(tmp_path / "dark.h5", [1.0, 0.0], 30)
    out = tmp_path / "s.h5"
    words = ["--calibration", str(files["calibration"]), "--reference", str(dark), "-o", str(out)]
    assert run(["demux", str(files["shots"][0]), *words]) == 0
    value = read_artefact(out, "spectra").data["spectra/value"]
    known = np.isfinite(value).sum(axis=(1, 2))
    assert known[0] == COUNT**2 > known[1]
    line = capsys.readouterr().out
    assert f"lenslets with a value: 480 nm {known[0]}, 620 nm {known[1]}" in line
    assert f"behind {np.isfinite(value).all(axis=0).sum()} lenslets" in line


def test_lmmse_without_known_light_is_refused(files, tmp_path):
    """The calibration's white is dark in one band."""
    found = read_artefact(files["calibration"], "calibration")
    response, white = found.data["response/F"], found.data["response/white"]
    less = response[..., 0] - 0.01 * response[..., 1]
    found.data["response/white"] = np.broadcast_to(less, white.shape).copy()
    write_artefact(tmp_path / "c.h5", found)
    words = ["--calibration", str(tmp_path / "c.h5"), "--method", "lmmse"]
    with pytest.raises(NumericsError, match="does not tell"):
        run_demux(
            [files["shots"][0]],
            tmp_path / "s.h5",
            calibration=tmp_path / "c.h5",
            settings=Settings(method="lmmse"),
        )
    assert run(["demux", str(files["shots"][0]), *words, "-o", str(tmp_path / "s.h5")]) == 5


def test_captures_of_another_kind_are_refused(files, tmp_path):
    def attempt(path, match):
        with pytest.raises(InputError, match=match):
            run_demux([path], tmp_path / "o.h5", calibration=files["calibration"])

    attempt(capture(tmp_path / "a.h5", 0.5, exposure_s=None), "exposure time")
    attempt(capture(tmp_path / "b.h5", 0.5, units="electron"), "is in electron")
    attempt(tmp_path / "missing.h5", "missing.h5")
    attempt(files["calibration"], "c.h5")
    big = tmp_path / "big.h5"
    write_artefact(
        big,
        Artefact(
            "capture",
            {"capture/mosaic": np.full((90, 90), 120, np.uint16), "capture/cfa": "mono"},
            {"capture": dict(units="DN", exposure_s=0.1)},
        ),
    )
    attempt(big, "90 x 90 px, the calibration 84 x 84")
    assert not (tmp_path / "o.h5").exists()


@pytest.mark.filterwarnings("error")
def test_light_beyond_any_sensor_is_refused_alone(files, tmp_path, capsys):
    known = dict(units="DN", black=100.0, exposure_s=0.1)  # no level of saturation
    white = capture(tmp_path / "white.h5", 1.0, white=None)
    bands = [
        (w, capture(tmp_path / f"{w}.h5", np.eye(2)[k], white=None)) for k, w in enumerate(BANDS)
    ]
    run_calibrate(tmp_path / "c.h5", whites=[white], bands=bands)
    shot = read_artefact(files["shots"][0]).data["capture/mosaic"].astype(np.float32)
    spike = shot.copy()
    spike[40, 40] = -1e30

    def demux(name, mosaic, **also):
        data = {"capture/mosaic": mosaic, "capture/cfa": "mono"}
        write_artefact(tmp_path / name, Artefact("capture", data, {"capture": known | also}))
        words = ["demux", str(tmp_path / name), "--calibration", str(tmp_path / "c.h5")]
        return run([*words, "-o", str(tmp_path / "o.h5"), "--overwrite"]), capsys.readouterr().err

    for name, mosaic in (("all.h5", shot * np.float32(1e30)), ("one.h5", spike)):
        code, said = demux(name, mosaic)
        assert code == 3 and "times the light of white" in said
        assert said.count("\n") == 1 and not (tmp_path / "o.h5").exists()
    loud = [(w, tmp_path / "all.h5") for w in BANDS]
    with pytest.raises(InputError, match="times the light of white"):
        run_calibrate(tmp_path / "loud.h5", whites=[white], bands=loud)
    code, said = demux("near.h5", shot * np.float32(1e9))
    assert code == 0 and "no description of the camera" in said


def test_names_that_would_collide_and_wrong_suffixes_are_usage_errors(files, tmp_path):
    (tmp_path / "x").mkdir()
    twin = tmp_path / "x" / "shot0.h5"
    twin.write_bytes(files["shots"][0].read_bytes())
    with pytest.raises(UsageError, match="would all become"):
        run_demux([files["shots"][0], twin], tmp_path / "o", calibration=files["calibration"])
    with pytest.raises(UsageError, match=".exr or .h5"):
        run_demux([twin], tmp_path / "o.png", calibration=files["calibration"])


def test_a_lenslet_cut_by_the_frame_is_masked(files, tmp_path):
    """The lit array ends at the sensor's edge on all sides here; a grid shifted by half a
    cell has cut lenslets.
    """

    def shifted(path, radiance, seed):
        whole = read_artefact(capture(path, radiance, seed)).data["capture/mosaic"]
        cut = np.roll(whole, -6, axis=0)[:-12]
        attrs = dict(units="DN", black=100.0, white=4095.0, exposure_s=0.1)
        write_artefact(
            path,
            Artefact("capture", {"capture/mosaic": cut, "capture/cfa": "mono"}, {"capture": attrs}),
            overwrite=True,
        )
        return path

    white = shifted(tmp_path / "w.h5", 1.0, 1)
    bands = [(w, shifted(tmp_path / f"b{k}.h5", np.eye(2)[k], 5 + k)) for k, w in enumerate(BANDS)]
    run_calibrate(tmp_path / "c.h5", whites=[white], bands=bands)
    run_demux([white], tmp_path / "o.h5", calibration=tmp_path / "c.h5")
    valid = read_artefact(tmp_path / "c.h5", "calibration").data["grid/valid"]
    value = read_artefact(tmp_path / "o.h5", "spectra").data["spectra/value"]
    assert valid.sum() == (COUNT - 2) * COUNT
    np.testing.assert_array_equal(np.isfinite(value).all(axis=0), valid)
    np.testing.assert_allclose(value[:, valid], 1.0, atol=0.02)


def test_a_saturated_capture_and_bands_that_do_not_differ_are_said(files, tmp_path, capsys):
    white = capture(tmp_path / "white.h5", 1.0, 1, gain_e_per_dn=2.0)
    bands = [
        capture(tmp_path / f"b{k}.h5", np.eye(2)[k], 2 + k, gain_e_per_dn=2.0) for k in range(2)
    ]
    good, twins, over = tmp_path / "good.h5", tmp_path / "twins.h5", tmp_path / "over.h5"
    run_calibrate(good, whites=[white], bands=list(zip(BANDS, bands)))
    run_calibrate(twins, whites=[white], bands=[(w, bands[0]) for w in BANDS])
    data = {"capture/mosaic": np.full((COUNT * PITCH,) * 2, 4095, np.uint16), "capture/cfa": "mono"}
    write_artefact(
        over,
        Artefact(
            "capture",
            data,
            {
                "capture": dict(
                    units="DN", black=100.0, white=4095.0, exposure_s=0.1, gain_e_per_dn=2.0
                )
            },
        ),
    )
    for shot, calibration in ((over, good), (files["shots"][0], twins)):
        assert (
            run(
                [
                    "demux",
                    str(shot),
                    "--calibration",
                    str(calibration),
                    "-o",
                    str(tmp_path / "never.h5"),
                ]
            )
            == 5
        )
        assert (
            "no lenslet could be demultiplexed" in capsys.readouterr().err
            and not (tmp_path / "never.h5").exists()
        )


WARM = """dark_current = "20000 e/s"
dsnu = "150 e"
hot_pixels = 0.01
hot_pixel_current = "200000 e/s"
black_level = 200
[light]
white_exposure = "40 ms"
"""


def test_a_dark_frame_takes_off_what_the_sensor_makes_without_light(tmp_path, monkeypatch):
    """Dark current, its fixed pattern and hot pixels, in every frame: with a dark frame spectra are
    those of a sensor without them, but for the dark current's shot noise; without one they are
    not.
    """
    monkeypatch.setenv("PLENOCLI_CACHE", str(tmp_path / "cache"))  # matrices once a camera
    text = (
        Path(__file__).resolve().parents[2] / "sample_configs" / "demo_spectral.toml"
    ).read_text()
    for old, new in {
        "count = [20, 30]": "count = [6, 6]",
        "[20, 20]": "[12, 12]",
        '"80 um"': '"48 um"',
        '"640 um"': '"384 um"',
        "[10, 10]": "[1, 1]",
        "black_level = 64\n": "",
    }.items():
        assert old in text
        text = text.replace(old, new)
    fast = ["--model", "fresnel", "--accuracy", "1e-2", "--superpixels", "1x1", "--overwrite"]

    def spectra(light, dark):
        (tmp_path / "camera.toml").write_text(text.replace("[light]", light))
        names = {"white": "white", "dark": "dark", "shot": "colorchecker"}
        names |= {f"b{nm}": f"mono:{nm}nm" for nm in (450, 540, 570, 650)}
        for seed, (name, target) in enumerate(names.items()):
            made = str(tmp_path / f"{name}.h5")
            camera = str(tmp_path / "camera.toml")
            asked = ["capture-sim", camera, "--target", target, "--seed", str(seed), "-o", made]
            assert run([*asked, *fast]) == 0
        run_calibrate(
            tmp_path / "c.h5",
            whites=[tmp_path / "white.h5"],
            darks=[tmp_path / "dark.h5"] if dark else [],
            bands=[(nm * 1e-9, tmp_path / f"b{nm}.h5") for nm in (450, 540, 570, 650)],
            overwrite=True,
        )
        settings = Settings(method="pinv", register="off")
        run_demux(
            [tmp_path / "shot.h5"],
            tmp_path / "s.h5",
            calibration=tmp_path / "c.h5",
            settings=settings,
            suffix=".h5",
        )
        found = read_artefact(tmp_path / "s.h5", "spectra").data["spectra/value"]
        (tmp_path / "s.h5").unlink()
        return found

    ideal = spectra('black_level = 200\n[light]\nwhite_exposure = "40 ms"', True)
    off = {dark: np.sqrt(np.mean((spectra(WARM, dark) - ideal) ** 2)) for dark in (True, False)}
    assert off[True] < 0.006 * np.abs(ideal).max()
    assert off[False] > 5 * off[True]
