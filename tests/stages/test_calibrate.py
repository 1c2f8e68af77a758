"""calibrate and demux together, on captures painted here: known response, known radiances,
sensor noise of EMVA 1288.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import InputError, NumericsError, OutputError, UsageError
from plenocli.cli.main import run
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.forward.sensor.detector import SensorModel
from plenocli.stages.inverse.calibrate import run_calibrate
from plenocli.stages.inverse.demux import Settings, run_demux

ROOT = Path(__file__).resolve().parents[2]

PITCH, ROWS, COLUMNS, BORDER = 16, 9, 11, 5
BANDS = [450e-9, 540e-9, 570e-9, 650e-9]
SENSOR = SensorModel(gain=0.25, read_noise=4.0, full_well=15000, bits=12, black_level=64)
EXPOSURE = 0.01


def cell(leak=0.05):
    """Response of one superpixel (pixel row, pixel column, band), electrons at unit radiance and
    EXPOSURE: four quadrants, dark border.
    """
    y, x = np.indices((PITCH, PITCH)) - (PITCH - 1) / 2
    edge = np.clip((7.0 - np.abs(y)) / 2, 0, 1) * np.clip((7.0 - np.abs(x)) / 2, 0, 1)
    quadrant = 2 * (y > 0) + (x > 0)
    own = (quadrant[..., None] == np.arange(4)).astype(float)
    return 10000 * edge[..., None] * ((1 - 3 * leak) * own + leak * (1 - own))


def electrons(radiance, gains=1.0):
    """Mean electrons of the whole sensor (a dark frame of BORDER px around) for radiances (ROWS,
    COLUMNS, band) or (band,) behind lenslets of transmission `gains` (ROWS, COLUMNS, 1).
    """
    radiance = gains * np.broadcast_to(radiance, (ROWS, COLUMNS, 4))
    tiles = np.einsum("rcb,yxb->rycx", radiance, cell()).reshape(ROWS * PITCH, COLUMNS * PITCH)
    return np.pad(tiles, BORDER)


def save(path, mean, seed, seconds=EXPOSURE, cfa="mono", **attrs):
    values = SENSOR.expose(mean * seconds / EXPOSURE, np.random.default_rng(seed))
    known = (
        dict(units="DN", black=64.0, white=4095.0, gain_e_per_dn=4.0, exposure_s=seconds) | attrs
    )
    write_artefact(
        path,
        Artefact("capture", {"capture/mosaic": values, "capture/cfa": cfa}, {"capture": known}),
        overwrite=True,
    )
    return path


def narrow(k, radiance=1.0):
    out = np.zeros(4)
    out[k] = radiance
    return out


LIGHT = np.array([0.3, 0.34, 0.34, 0.3])


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """White, two darks, two frames a band (the 540 nm source half as bright and exposed for
    twice as long), a scene.
    """
    folder = tmp_path_factory.mktemp("captures")
    out = {
        "white": [save(folder / f"white{i}.h5", electrons(LIGHT), 10 + i) for i in range(2)],
        "dark": [save(folder / f"dark{i}.h5", electrons(0.0), 20 + i) for i in range(2)],
        "bands": [],
        "folder": folder,
    }
    for k, wavelength in enumerate(BANDS):
        level, seconds = (0.5, 2 * EXPOSURE) if k == 1 else (1.0, EXPOSURE)
        for i in range(2):
            out["bands"].append(
                (
                    wavelength,
                    save(
                        folder / f"band{k}{i}.h5",
                        electrons(narrow(k, level)),
                        30 + 2 * k + i,
                        seconds,
                    ),
                )
            )
    rng = np.random.default_rng(7)
    out["reflectance"] = rng.uniform(0.05, 0.9, (ROWS, COLUMNS, 4))
    out["scene"] = save(folder / "scene.h5", electrons(LIGHT * out["reflectance"]), 50)
    out["short"] = save(
        folder / "short.h5", electrons(LIGHT * out["reflectance"]), 51, EXPOSURE / 4
    )
    return out


@pytest.fixture(scope="module")
def calibration(files):
    path = files["folder"] / "calibration.h5"
    report = run_calibrate(
        path,
        whites=files["white"],
        darks=files["dark"],
        bands=files["bands"],
        radiances=[(540e-9, 0.5)],
        response="own",
    )
    return path, report


def test_grid_and_windows_sit_where_the_superpixels_are(calibration):
    path, report = calibration
    data = read_artefact(path, "calibration").data
    assert (
        report.lattice == "square"
        and report.lenslets == ROWS * COLUMNS
        and report.window == [PITCH, PITCH]
    )
    np.testing.assert_allclose(report.pitch_px, PITCH, rtol=2e-4)
    index = np.stack(np.meshgrid(np.arange(ROWS), np.arange(COLUMNS), indexing="ij"), axis=-1)
    first = np.argwhere(data["grid/valid"])[0]
    valid = data["grid/valid"]
    np.testing.assert_array_equal(
        data["response/origin"][valid].reshape(ROWS, COLUMNS, 2), BORDER + PITCH * index
    )
    np.testing.assert_allclose(
        data["grid/centre"][tuple(first)], BORDER + (PITCH - 1) / 2, atol=0.1
    )


def test_response_is_the_painted_one_within_its_own_variance(calibration):
    path, report = calibration
    artefact = read_artefact(path, "calibration")
    data = artefact.data
    found = data["response/F"][data["grid/valid"]]
    truth = 0.25 * cell().reshape(-1, 4)
    sigma = np.sqrt(data["response/covariance"])
    error = found - truth
    # unbiased: exposure, radiance and dark all divided out
    assert np.abs(error.mean(axis=0) / sigma * np.sqrt(len(found))).max() < 6
    np.testing.assert_allclose(error.std(axis=0) / sigma, 1, atol=0.35)
    assert (error.std(axis=0) / sigma).mean() == pytest.approx(1, abs=0.05)
    assert report.response.condition == pytest.approx(np.linalg.cond(truth), rel=0.02)
    np.testing.assert_allclose(data["response/wavelength"], BANDS)
    assert (
        artefact.attrs["response"]["exposure_s"] == EXPOSURE
        and artefact.attrs["response"]["gain_e_per_dn"] == 4.0
    )
    assert artefact.attrs["dark"]["sigma"] == pytest.approx(np.sqrt(1 + 1 / 12), rel=0.05)
    assert "/" not in json.dumps(artefact.provenance.inputs)


def test_flat_field_peaks_at_one_and_white_is_kept(calibration):
    data = read_artefact(calibration[0], "calibration").data
    valid = data["grid/valid"]
    assert np.nanmax(data["white/flat"]) == pytest.approx(1, abs=0.1) and np.isnan(
        data["white/flat"][0, 0]
    )
    np.testing.assert_allclose(
        data["response/white"][valid].mean(axis=0), 0.25 * cell().reshape(-1, 4) @ LIGHT, atol=5.0
    )


def test_shared_response_is_the_mean_and_better_known(files, calibration):
    path = files["folder"] / "shared.h5"
    run_calibrate(
        path,
        whites=files["white"],
        darks=files["dark"],
        bands=files["bands"],
        radiances=[(540e-9, 0.5)],
        response="shared",
    )
    one, own = (
        read_artefact(path, "calibration").data,
        read_artefact(calibration[0], "calibration").data,
    )
    assert one["response/F"].shape == (PITCH * PITCH, 4)
    np.testing.assert_allclose(
        one["response/F"], own["response/F"][own["grid/valid"]].mean(axis=0), rtol=1e-5, atol=1e-3
    )
    np.testing.assert_allclose(
        one["response/covariance"] * ROWS * COLUMNS, own["response/covariance"], rtol=1e-5
    )


@pytest.mark.parametrize("spread, kind", [(0.0005, "shared"), (0.01, "own")])
def test_lenslets_share_a_response_where_one_noisy_capture_a_band_cannot_tell_them_apart(
    files, tmp_path, capsys, spread, kind
):
    gains = 1 + spread * np.random.default_rng(11).standard_normal((ROWS, COLUMNS, 1))
    shots = [
        (w, save(tmp_path / f"b{k}.h5", electrons(narrow(k), gains), 60 + k))
        for k, w in enumerate(BANDS)
    ]
    captures = [
        save(tmp_path / f"s{i}.h5", electrons(LIGHT * files["reflectance"], gains), 70 + i)
        for i in range(4)
    ]
    error, found = {}, {}
    for how in ("auto", "shared", "own"):
        line = [
            "calibrate",
            *(f"--white={p}" for p in files["white"]),
            *(f"--dark={p}" for p in files["dark"]),
            *(f"--band={w * 1e9:g}nm={p}" for w, p in shots),
        ]
        assert (
            run(
                [
                    *line,
                    "-o",
                    str(tmp_path / f"{how}.h5"),
                    *([f"--response={how}"] if how != "auto" else []),
                ]
            )
            == 0
        )
        capsys.readouterr()
        found[how] = read_artefact(tmp_path / f"{how}.h5", "calibration")
        values = [
            next(
                demux(
                    p, tmp_path / f"{how}.h5", tmp_path / f"{how}-{p.name}", "wls", register="off"
                )
            )
            for p in captures
        ]
        # four captures: what F costs is left
        error[how] = np.sqrt(np.mean((np.mean(values, axis=0) - LIGHT * files["reflectance"]) ** 2))
    notes = found["auto"].attrs["response"]["notes"]
    assert notes["response"] == kind and found["auto"].data["response/F"].ndim == (
        2 if kind == "shared" else 4
    )
    assert (
        "one F for 99 lenslets" if kind == "shared" else "F of its own for each of 99"
    ) in found["auto"].attrs["response"]["notes"]["text"]
    assert f"{notes['excess']:.3g} times what noise explains" in notes["text"]
    assert error["auto"] < 1.05 * min(error.values()) and max(error.values()) > 1.3 * error["auto"]


def demux(path, calibration, target, method, **settings):
    run_demux([path], target, calibration=calibration, settings=Settings(method=method, **settings))
    data = read_artefact(target, "spectra").data
    value, sigma = data["spectra/value"], data["spectra/sigma"]
    good = np.isfinite(value).all(axis=0)
    return (np.moveaxis(a, 0, -1)[good].reshape(ROWS, COLUMNS, 4) for a in (value, sigma))


@pytest.mark.parametrize("method", ["pinv", "wls", "lmmse", "nnls", "auto"])
@pytest.mark.parametrize("which", ["scene", "short"])
def test_radiances_come_back_with_honest_errors(files, calibration, tmp_path, method, which):
    value, sigma = demux(files[which], calibration[0], tmp_path / "s.h5", method)
    error = value - LIGHT * files["reflectance"]
    assert np.abs(error).max() < 6 * sigma.max()
    pull = error / sigma
    assert abs(pull.mean()) < 0.25
    assert pull.std() == pytest.approx(1, abs=0.2)


def test_reflectance_by_the_white_reference_and_single_pixel_is_worse(files, calibration, tmp_path):
    truth = files["reflectance"] * 0.99
    out = {
        m: demux(
            files["scene"], calibration[0], tmp_path / f"{m}.h5", m, reference=files["white"][0]
        )
        for m in ("pinv", "wls", "single-pixel")
    }
    rms = {}
    for method, (value, sigma) in out.items():
        rms[method] = np.sqrt(((value - truth) ** 2).mean())
        if method != "single-pixel":
            assert ((value - truth) / sigma).std() == pytest.approx(1, abs=0.25)
    assert rms["pinv"] < 0.006 and rms["wls"] < 0.006
    assert rms["single-pixel"] > 5 * rms["pinv"]


def test_saturated_and_dead_pixels_cost_precision_not_truth(files, calibration, tmp_path):
    mean = electrons(LIGHT * files["reflectance"])
    values = SENSOR.expose(mean, np.random.default_rng(3))
    values[BORDER : BORDER + 4, BORDER : BORDER + 60] = 4095
    attrs = dict(units="DN", black=64.0, white=4095.0, gain_e_per_dn=4.0, exposure_s=EXPOSURE)
    write_artefact(
        tmp_path / "hot.h5",
        Artefact("capture", {"capture/mosaic": values, "capture/cfa": "mono"}, {"capture": attrs}),
    )
    value, sigma = demux(tmp_path / "hot.h5", calibration[0], tmp_path / "s.h5", "wls")
    assert np.abs((value - LIGHT * files["reflectance"]) / sigma).max() < 6


def test_bayer_mosaic_is_part_of_the_response(tmp_path, capsys):
    """Odd pitch in a 2x2 mosaic: each lenslet starts on another colour, so that F differs
    between neighbours.
    """
    gains = np.tile([[0.25, 0.9], [0.9, 0.4]], (200, 200))

    def paint(name, radiance, seed, cfa="RGGB"):
        response = cell()[:15, :15]
        radiance = np.broadcast_to(radiance, (9, 9, 4))
        tiles = np.einsum("rcb,yxb->rycx", radiance, response).reshape(135, 135)
        mean = np.pad(tiles, 6) * gains[:147, :147]
        return save(tmp_path / name, mean, seed, cfa=cfa)

    truth = np.random.default_rng(1).uniform(0.1, 0.8, (9, 9, 4)) * LIGHT
    white, dark, scene = paint("w.h5", LIGHT, 1), paint("d.h5", 0.0, 2), paint("s.h5", truth, 9)
    bands = [(w, paint(f"b{k}.h5", narrow(k), 3 + k)) for k, w in enumerate(BANDS)]
    report = run_calibrate(tmp_path / "c.h5", whites=[white], darks=[dark], bands=bands)
    assert report.window == [15, 15] and report.lenslets == 81
    assert "diagonal" not in capsys.readouterr().err
    run_calibrate(tmp_path / "g.h5", whites=[paint("wrong.h5", LIGHT, 1, cfa="GRBG")])
    assert "as pixels of BGGR or RGGB do and those of GRBG do not" in capsys.readouterr().err
    run_demux(
        [scene], tmp_path / "o.h5", calibration=tmp_path / "c.h5", settings=Settings(method="wls")
    )
    data = read_artefact(tmp_path / "o.h5", "spectra").data
    error = np.moveaxis(data["spectra/value"], 0, -1) - truth
    assert np.sqrt((error**2).mean()) < 0.004 and (
        error / np.moveaxis(data["spectra/sigma"], 0, -1)
    ).std() == pytest.approx(1, abs=0.2)
    with pytest.raises(NumericsError, match="no F serves them all"):
        run_calibrate(
            tmp_path / "x.h5", whites=[white], darks=[dark], bands=bands, response="shared"
        )


def test_white_alone_gives_a_grid(files, tmp_path, capsys):
    assert (
        run(
            ["calibrate", "--white", str(files["white"][0]), "-o", str(tmp_path / "g.h5"), "--json"]
        )
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    assert report["lattice"] == "square" and report["lenslets"] == ROWS * COLUMNS
    with pytest.raises(InputError, match="no response F"):
        run_demux([files["scene"]], tmp_path / "o.h5", calibration=tmp_path / "g.h5")


def test_light_that_jumps_from_lenslet_to_lenslet_is_said_to_be_a_scene(tmp_path, capsys):
    """Folders stand for the captures in them; dim edges and dead lenslets pass for white."""
    fall = 1 - 0.6 * np.hypot(*np.indices((ROWS, COLUMNS)) / COLUMNS)[..., None]
    dead = np.where(np.random.default_rng(1).random((ROWS, COLUMNS, 1)) < 0.02, 0.5, fall)
    printed = 0.4 + 0.6 * (np.random.default_rng(2).random((ROWS, COLUMNS, 1)) < 0.7)
    for name, gains in (("white", dead), ("scene", printed)):
        (tmp_path / name).mkdir()
        save(tmp_path / name / "a.h5", electrons(1.0, gains), 3)
        words = ["calibrate", "--white", str(tmp_path / name), "-o", str(tmp_path / f"{name}.h5")]
        assert run(words) == 0
        assert ("--scene finds the grid" in capsys.readouterr().err) == (name == "scene")


def test_the_time_of_a_capture_goes_into_finished_exr_and_the_summary(tmp_path):
    import csv

    import OpenEXR
    import tifffile

    names = [str(tmp_path / name) for name in ("white.tif", "a.tif", "b.tif")]
    for number, name in enumerate(names):
        values = SENSOR.expose(electrons(1.0 - 0.2 * number), np.random.default_rng(number))
        tifffile.imwrite(name, values, datetime=f"2024:05:06 07:08:0{number}")
    grid, out = str(tmp_path / "g.h5"), tmp_path / "out"
    assert run(["calibrate", "--white", names[0], "-o", grid]) == 0
    words = ["reconstruct", *names[1:], "--method", "block-mean", "--calibration", grid]
    assert run([*words, "--format", "exr", "-o", str(out)]) == 0
    found = [OpenEXR.File(str(out / f"{name}.exr")).header()["capDate"] for name in "ab"]
    assert found == ["2024:05:06 07:08:01", "2024:05:06 07:08:02"]
    rows = list(csv.DictReader((out / "summary.csv").read_text().splitlines()))
    assert [row["captured"] for row in rows] == ["2024-05-06T07:08:01", "2024-05-06T07:08:02"]


def test_the_same_inputs_give_the_same_bytes(files, tmp_path):
    for name in ("a.h5", "b.h5"):
        run_calibrate(
            tmp_path / name, whites=files["white"], darks=files["dark"], bands=files["bands"]
        )
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_refusals_say_what_is_wrong(files, calibration, tmp_path):
    small = tmp_path / "small.h5"
    attrs = dict(units="DN", black=64.0, white=4095.0, exposure_s=EXPOSURE)
    write_artefact(
        small,
        Artefact(
            "capture",
            {"capture/mosaic": np.full((50, 50), 70, np.uint16), "capture/cfa": "mono"},
            {"capture": attrs},
        ),
    )
    with pytest.raises(InputError, match="another size"):
        run_calibrate(tmp_path / "o.h5", whites=files["white"], darks=[small])
    with pytest.raises(NumericsError, match="small.h5: no lenslet lattice.*every pixel"):
        run_calibrate(tmp_path / "o.h5", whites=[small])
    with pytest.raises(NumericsError, match="450 nm hold no light"):
        run_calibrate(
            tmp_path / "o.h5",
            whites=files["white"],
            darks=[files["dark"][0]],
            bands=[(450e-9, save(tmp_path / "d.h5", electrons(0.0), 1))],
        )
    with pytest.raises(UsageError, match="no --band"):
        run_calibrate(
            tmp_path / "o.h5",
            whites=files["white"],
            bands=files["bands"],
            radiances=[(500e-9, 1.0)],
        )
    with pytest.raises(InputError, match="saturated"):
        run_calibrate(
            tmp_path / "o.h5",
            whites=[
                save(tmp_path / "w.h5", 10 * electrons(LIGHT), 1, white=float(SENSOR.white_level))
            ],
        )
    with pytest.raises((UsageError, OutputError)):
        run_calibrate(calibration[0], whites=files["white"])
    assert not (tmp_path / "o.h5").exists()


def test_a_sensor_smaller_than_a_lenslet_is_refused():
    from types import SimpleNamespace

    from plenocli.inverse.calibration.calibration import windows_on

    grid = SimpleNamespace(
        window_shape=lambda: (20, 20),
        centres=np.full((1, 1, 2), 4.5),
        valid=np.ones((1, 1), bool),
    )
    with pytest.raises(NumericsError, match="no lenslet lies wholly"):
        windows_on(grid, (10, 10))


def test_a_cell_that_is_much_brighter_does_not_pass_for_the_superpixel(tmp_path, capsys):
    """A clear cell beside three bands: the description says that superpixels have parts; without
    it the grid is drawn to the clear one, which is told.
    """
    text = (ROOT / "sample_configs" / "demo_spectral.toml").read_text()
    changes = {
        "count = [20, 30]": "count = [7, 8]",
        "samples_per_lenslet = [10, 10]": "samples_per_lenslet = [1, 1]",
    }
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    last = text.rindex("  { center")
    text = text[:last] + "  { transmittance = 1 },\n]\n"
    (tmp_path / "camera.toml").write_text(text)
    fast = ["--target", "white", "--model", "fresnel", "--accuracy", "1e-4", "--superpixels", "1x1"]
    white = str(tmp_path / "white.h5")
    assert run(["capture-sim", str(tmp_path / "camera.toml"), *fast, "-o", white]) == 0
    told = run_calibrate(tmp_path / "a.h5", whites=[white], camera=tmp_path / "camera.toml")
    assert told.array == [7, 8] and told.deviation_px < 0.05
    assert "warning" not in capsys.readouterr().err
    untold = run_calibrate(tmp_path / "b.h5", whites=[white])
    assert untold.deviation_px > 1 and "give --camera" in capsys.readouterr().err
