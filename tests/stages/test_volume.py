"""Volumes through their files: kernels, captures, OME-TIFF."""

import csv
import xml.etree.ElementTree as tree
from dataclasses import is_dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from PIL import Image

from plenocli.base.errors import ConfigError, InputError, NumericsError, OutputError, UsageError
from plenocli.base.progress import collected_notes
from plenocli.cli.sections import read_options
from plenocli.files import scratch
from plenocli.files.artefacts import reading
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.bench import Bench
from plenocli.files.images.mosaic import read_capture
from plenocli.files.images.tiff_stack import read_tiff_volume, write_volume_tiff
from plenocli.files.results.stacks import read_stack
from plenocli.files.results.volumes import read_volume
from plenocli.inverse.volume import measurement, superpixels, tiles
from plenocli.inverse.volume.superpixels import white_superpixel
from plenocli.inverse.volume.tiles import Tiles
from plenocli.inverse.volume.volume import HeldOut, Likeness, Prior, Trial, Volume
from plenocli.stages.evaluation.score.run import run_score
from plenocli.stages.forward.capture_settings import Settings as Capture
from plenocli.stages.forward.capture_sim import run_capture_sim
from plenocli.stages.forward.simulate_pif import Settings, run_simulate_pif
from plenocli.stages.forward.simulate_stack import StackSummary
from plenocli.stages.inverse.kept_windows import kept_part
from plenocli.stages.inverse.refocus import Settings as Refocus
from plenocli.stages.inverse.refocus import run_refocus
from plenocli.stages.inverse.volume import run_volume
from plenocli.stages.sweep.sweep import run_sweep

MICROSCOPE = """
[objective]
magnification = 20
numerical_aperture = 0.5
medium_index = 1.33
[object]
planes = "-4 um to 4 um step 4 um"
samples_per_lenslet = [2, 2]
[lenslet_array]
pitch = "30 um"
focal_length = "500 um"
count = [7, 6]
[sensor]
distance = "500 um"
pixel_pitch = "4.2857143 um"
pixels_per_lenslet = [7, 7]
[light]
wavelengths = ["500 nm"]
"""


@pytest.fixture(scope="module")
def camera(tmp_path_factory):
    path = tmp_path_factory.mktemp("volume") / "microscope.toml"
    path.write_text(MICROSCOPE)
    return path


def test_the_kernels_of_a_microscope_are_read_as_they_were_written(camera, tmp_path):
    report = run_simulate_pif(camera, tmp_path / "stack.h5", Settings(accuracy=2e-2))
    assert isinstance(report, StackSummary)
    stack = read_stack(tmp_path / "stack.h5")
    assert stack.A.shape[1:] == (49, 4) and stack.pixel_shape == (7, 7)
    assert np.allclose(stack.depth, [-4e-6, 0, 4e-6], atol=1e-15) and stack.depth[1] == 0
    assert np.allclose(stack.spacing, 30e-6 / 20 / 2)
    assert stack.accuracy.estimated <= 2e-2
    whole = [kernels.sum((0, 1)) for kernels, _ in stack.parts()]
    assert np.allclose(whole, stack.column_energy, rtol=1e-5)


def test_a_plan_of_a_volume_writes_nothing(camera, tmp_path):
    report = run_simulate_pif(camera, None, Settings(), explain=True)
    assert report.output is None and "waves" in report.line() and report.plan.seconds > 0
    assert "halfway between planes" in report.line()


@pytest.mark.parametrize(
    "settings",
    [Settings(superpixels=(3, 3)), Settings(wavelengths=(5e-7,)), Settings(model="exact")],
)
def test_what_volumes_do_not_have_is_refused(camera, tmp_path, settings):
    with pytest.raises(UsageError):
        run_simulate_pif(camera, tmp_path / "stack.h5", settings)
    assert not list(tmp_path.iterdir())


def test_a_capture_of_a_volume_and_its_truth_are_written_together(camera, tmp_path):
    settings = Capture(snr_db=40, refine=2, accuracy=2e-2, seed=4)
    run_capture_sim(
        camera,
        tmp_path / "capture.h5",
        settings,
        volume="phantom:beads",
        scene_out=tmp_path / "truth.h5",
    )
    capture, truth = read_capture(tmp_path / "capture.h5"), read_volume(tmp_path / "truth.h5")
    assert capture.shape == (49, 42) and capture.grid.shape == (7, 7)
    assert truth.value.shape == (3, 14, 12) and truth.value.max() > 0.05
    # as much light as the truth has, but for what leaves the lenslets
    light = capture.mosaic.sum() / truth.value.sum()
    assert 0.7 < light < 1.0


def test_a_capture_of_a_file_is_that_of_the_same_volume(camera, tmp_path):
    """The truth of a phantom, recorded again: the same but for what is finer than its voxels."""
    for suffix in (".h5", ".ome.tif"):
        settings = Capture(noise="none", accuracy=2e-2)
        run_capture_sim(
            camera,
            tmp_path / f"first{suffix}.h5",
            settings,
            volume="phantom:shells",
            scene_out=tmp_path / f"truth{suffix}",
        )
        run_capture_sim(
            camera,
            tmp_path / f"again{suffix}.h5",
            settings,
            volume=str(tmp_path / f"truth{suffix}"),
        )
        first, again = (
            read_capture(tmp_path / f"{n}{suffix}.h5").mosaic for n in ("first", "again")
        )
        assert np.abs(first - again).max() < 1e-4 * first.max()


def test_digits_of_a_sensor_come_from_a_volume_too(camera, tmp_path):
    run_capture_sim(camera, tmp_path / "a.dng", Capture(accuracy=2e-2), volume="phantom:filaments")
    capture = read_capture(tmp_path / "a.dng")
    assert capture.units == "DN" and 2000 < capture.mosaic.max() < 4096


@pytest.mark.parametrize(
    ("volume", "settings", "others"),
    [
        (None, Capture(), {}),
        ("phantom:ghosts", Capture(), {}),
        ("phantom:beads", Capture(target="white"), {}),
        ("phantom:beads", Capture(), {"scene": "skimage:astronaut"}),
    ],
)
def test_captures_that_cannot_be_are_refused(camera, tmp_path, volume, settings, others):
    with pytest.raises(UsageError):
        run_capture_sim(camera, tmp_path / "a.h5", settings, volume=volume, **others)
    assert not list(tmp_path.iterdir())


def test_a_photographic_camera_has_no_volume(tmp_path):
    with pytest.raises(UsageError, match="no \\[objective\\]"):
        run_capture_sim(
            "sample_configs/tiny.toml", tmp_path / "a.h5", Capture(), volume="phantom:beads"
        )


@pytest.fixture(scope="module")
def seen(camera, tmp_path_factory):
    """Folder with kernels, a capture simulated twice finer, and its truth."""
    folder = tmp_path_factory.mktemp("seen")
    run_simulate_pif(camera, folder / "stack.h5", Settings(accuracy=2e-2))
    run_capture_sim(
        camera,
        folder / "capture.h5",
        Capture(snr_db=40, refine=2, accuracy=2e-2, seed=4),
        volume="phantom:beads",
        scene_out=folder / "truth.h5",
    )
    return folder


@pytest.mark.parametrize("method", ["auto", "rl", "lmmse", "tv", "tikhonov"])
def test_a_specimen_comes_back_and_says_how_well(seen, tmp_path, method):
    report = run_volume(seen / "capture.h5", tmp_path / "v.h5", seen / "stack.h5", method=method)
    score = run_score([tmp_path / "v.h5"], tmp_path / "s.json", truth=seen / "truth.h5").results[0]
    assert report.shape == [3, 14, 12] and score.kind == "volume"
    assert score.figures["volume_correlation"] > 0.75 and score.figures["volume_snr_db"] > 3
    assert score.figures["held_out_db"] == pytest.approx(report.explained_db)
    assert report.explained_db > 8
    again = run_volume(seen / "capture.h5", tmp_path / "w.h5", seen / "stack.h5", method=method)
    assert again.explained_db == report.explained_db
    found, same = (read_volume(tmp_path / f"{n}.h5") for n in "vw")
    assert np.array_equal(found.value, same.value)
    if method == "auto":
        assert {what for what, _ in report.tried} >= {"rl", "lmmse", "tv"}


def test_a_noisy_colour_is_tied_to_a_clear_one(camera, seen, tmp_path):
    """By the kernels of its own wavelength; through files, and the file says how much it is tied.
    What it is tied to, if that is less clear, is told.
    """
    red = tmp_path / "red.toml"
    red.write_text(MICROSCOPE.replace("500 nm", "600 nm"))
    run_capture_sim(
        red,
        tmp_path / "red.h5",
        Capture(snr_db=20, refine=2, accuracy=2e-2, seed=5),
        volume=str(seen / "truth.h5"),
    )
    run_simulate_pif(red, tmp_path / "kernels.h5", Settings(accuracy=2e-2))
    run_volume(seen / "capture.h5", tmp_path / "clear.h5", seen / "stack.h5", method="tv")
    found = {}
    for name, like in {"alone": None, "tied": tmp_path / "clear.h5"}.items():
        with collected_notes() as notes:
            report = run_volume(
                tmp_path / "red.h5",
                tmp_path / f"{name}.h5",
                tmp_path / "kernels.h5",
                method="auto" if like else "tv",
                like=like,
            )
        assert not any("tie that volume" in note for note in notes)
        found[name] = (
            run_score(
                [tmp_path / f"{name}.h5"],
                tmp_path / "s.json",
                truth=seen / "truth.h5",
                overwrite=True,
            )
            .results[0]
            .figures["volume_snr_db"]
        )
    assert found["tied"] > found["alone"] + 0.3
    facts = read_volume(tmp_path / "tied.h5").facts
    assert facts["like_factor"] == report.like_factor > 0.3 and facts["method"] == "tv"
    assert facts["like_share"] == report.like_share > 0.1
    assert "of the other volume is" in report.line()
    assert "like_factor" not in read_volume(tmp_path / "alone.h5").facts
    with collected_notes() as notes:
        run_volume(
            seen / "capture.h5", tmp_path / "c.h5", seen / "stack.h5", like=tmp_path / "alone.h5"
        )
    assert any("tie that volume to this one" in note for note in notes)


@pytest.fixture(scope="module")
def clear(seen, tmp_path_factory):
    path = tmp_path_factory.mktemp("clear") / "clear.h5"
    run_volume(seen / "capture.h5", path, seen / "stack.h5", method="tv")
    return path


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"value": lambda v: v[:, :-2]}, "is not on those of the kernels"),
        ({"value": lambda v: v[1:], "depth": lambda d: d[1:]}, "is not on those of the kernels"),
        ({"depth": lambda d: d + 1e-6}, "is not on those of the kernels"),
        ({"spacing": lambda s: 1.1 * s}, "of another size"),
    ],
)
def test_a_volume_of_other_voxels_ties_nothing(seen, clear, tmp_path, change, said):
    made = read_artefact(clear, "volume")
    for name in ("value", "spacing", "depth"):
        made.data[f"volume/{name}"] = change.get(name, lambda v: v)(made.data[f"volume/{name}"])
    if "depth" in change and "value" in change:
        made.data["volume/spacing"] = made.data["volume/spacing"][1:]
    write_artefact(tmp_path / "other.h5", made)
    with pytest.raises(InputError, match=said):
        run_volume(
            seen / "capture.h5", tmp_path / "v.h5", seen / "stack.h5", like=tmp_path / "other.h5"
        )
    assert not (tmp_path / "v.h5").exists()


def test_what_ties_no_volumes_is_refused(seen, clear, tmp_path):
    for error, method, like, output in (
        (UsageError, "rl", clear, "v.h5"),
        (InputError, "tv", seen / "capture.h5", "v.h5"),
        (InputError, "tv", seen / "none.h5", "v.h5"),
        (OutputError, "tv", tmp_path / "own.h5", "own.h5"),
    ):
        (tmp_path / "own.h5").write_bytes(clear.read_bytes())
        with pytest.raises(error):
            run_volume(
                seen / "capture.h5",
                tmp_path / output,
                seen / "stack.h5",
                method=method,
                like=like,
                overwrite=True,
            )
        assert (tmp_path / "own.h5").read_bytes() == clear.read_bytes()
        assert not (tmp_path / "v.h5").exists()


def test_kernels_that_do_not_explain_a_capture_are_told(camera, seen, tmp_path):
    """Planes 4 um apart for a specimen between them, at a noise that shows it; and their own."""
    run_capture_sim(
        camera,
        tmp_path / "finer.h5",
        Capture(snr_db=60, refine=2, accuracy=2e-2),
        volume="phantom:shells",
    )
    run_capture_sim(
        camera, tmp_path / "own.h5", Capture(snr_db=30, accuracy=2e-2), volume="phantom:shells"
    )
    for name, told in (("finer", True), ("own", False)):
        with collected_notes() as notes:
            run_volume(
                tmp_path / f"{name}.h5",
                tmp_path / f"{name}-v.h5",
                seen / "stack.h5",
                method="lmmse",
                background=0.0,
            )
        assert any("times the noise: planes are too far apart" in n for n in notes) == told


def test_a_volume_for_fiji_has_its_errors_beside_it(seen, tmp_path):
    run_volume(seen / "capture.h5", tmp_path / "v.ome.tif", seen / "stack.h5", method="lmmse")
    run_volume(seen / "capture.h5", tmp_path / "v.h5", seen / "stack.h5", method="lmmse")
    stored, stack = read_volume(tmp_path / "v.h5"), read_tiff_volume(tmp_path / "v.ome.tif")
    assert np.array_equal(stack.value, stored.value) and stack.step == pytest.approx(4e-6)
    with tifffile.TiffFile(tmp_path / "v.ome.tif") as file:
        assert file.series[0].axes == "ZCYX"
        assert np.array_equal(file.asarray()[:, 1], stored.sigma)


def six_windows(self, count):
    """Lenslets (rows, columns) of a window, of which there are three rows of two."""
    halo = tiles._halo(self.stack)
    rows, columns = (-(-(n - 2 * halo) // m) + 2 * halo for n, m in zip(count, (3, 2)))
    return rows, columns


@pytest.mark.parametrize("method", ["lmmse", "tv"])
def test_a_volume_whose_parts_stay_in_files_is_that_of_all_in_memory(
    seen, tmp_path, method, monkeypatch
):
    """The same windows; a few pixels at a time, the capture and what it is like in their files."""
    run_volume(seen / "capture.h5", tmp_path / "like.h5", seen / "stack.h5", method="rl")
    more = {"like": tmp_path / "like.h5"} if method == "tv" else {}
    monkeypatch.setattr(Tiles, "_side", six_windows)

    def made(name):
        path = tmp_path / name
        run_volume(seen / "capture.h5", path, seen / "stack.h5", method=method, **more)
        return path

    whole = read_artefact(made("whole.h5"), "volume")
    monkeypatch.setattr(reading, "SHARE", 1 << 40)
    for module in (measurement, superpixels):
        monkeypatch.setattr(module, "AT_ONCE", 700)
    monkeypatch.setattr(scratch, "BAND", 30)
    parts = read_artefact(made("parts.h5"), "volume")
    assert len(whole.attrs["volume"]["trace"]) > 1
    assert whole.data.keys() == parts.data.keys()
    for name, values in whole.data.items():
        np.testing.assert_allclose(parts.data[name], values, rtol=1e-4, atol=1e-5 * values.max())
    stack = read_tiff_volume(made("v.ome.tif"))
    assert np.array_equal(stack.value, parts.data["volume/value"])


@pytest.mark.parametrize("method, done", [("rl", 4), ("tikhonov", 6)])
def test_a_volume_that_was_stopped_goes_on_from_its_windows(
    seen, tmp_path, method, done, monkeypatch
):
    """The bytes of a run that was not stopped, with no window made twice; other settings, and a
    window that is damaged, begin anew.
    """
    monkeypatch.setattr(Tiles, "_side", six_windows)
    solved, looked_at = [], Tiles.problem
    put, left = Bench.put, [done]

    def stopped(self, number, arrays):
        put(self, number, arrays)
        left[0] -= 1
        if not left[0]:
            raise KeyboardInterrupt

    def counted(self, window):
        solved.append(window)
        return looked_at(self, window)

    monkeypatch.setattr(Tiles, "problem", counted)

    def run(name="v.h5", seed=0):
        solved.clear()
        run_volume(
            seen / "capture.h5",
            tmp_path / name,
            seen / "stack.h5",
            method=method,
            background=0.0,
            seed=seed,
        )
        return (tmp_path / name).read_bytes()

    whole = run()
    assert len(solved) == 6 and [path.name for path in tmp_path.iterdir()] == ["v.h5"]
    (tmp_path / "v.h5").unlink()
    with monkeypatch.context() as patch:
        patch.setattr(Bench, "put", stopped)
        with pytest.raises(KeyboardInterrupt):
            run()
    (folder,) = tmp_path.iterdir()
    parts = sorted(folder.iterdir())
    assert len(parts) == done
    if done == 4:
        parts[0].write_bytes(parts[0].read_bytes()[:-9])
    assert run() == whole and len(solved) == 6 - done + (done == 4)
    assert [path.name for path in tmp_path.iterdir()] == ["v.h5"]
    (tmp_path / "v.h5").unlink()
    left[0] = done
    with monkeypatch.context() as patch:
        patch.setattr(Bench, "put", stopped)
        with pytest.raises(KeyboardInterrupt):
            run()
    run(seed=1)
    assert len(solved) == 6 and [path.name for path in tmp_path.iterdir()] == ["v.h5"]


def test_what_is_kept_of_a_window_is_all_of_it(tmp_path):
    rng = np.random.default_rng(3)
    index, more = rng.integers(0, 9, (5, 3), np.int32), rng.normal(size=(3, 5)).astype(np.float32)
    whole = Volume(
        value=rng.normal(size=(2, 3, 4)).astype(np.float32),
        sigma=rng.normal(size=(2, 3, 4)).astype(np.float32),
        method="tv",
        trace=(Trial("1/3 of the limit", 1 / 3), Trial("none", float("nan"))),
        background=0.1,
        prior=Prior(correlation_length=1e-6, variance=2.0, noise_variance=0.3, mean=0.7),
        held_out=HeldOut(index=index, measured=more[0], predicted=more[1], sigma=more[2]),
        margin=2,
        likeness=Likeness(0.5, 0.25),
    )
    bench = Bench.beside(tmp_path / "v.h5", "settings")
    bare = replace(whole, sigma=None, prior=None, held_out=None, likeness=None)
    for number, volume in enumerate((whole, bare)):
        kept_part(bench, number, lambda volume=volume: volume)
        again = kept_part(bench, number, lambda: pytest.fail("it was kept"))
        same(again, volume)


def same(found, wanted):
    """Numbers, types and all; NaN is NaN."""
    if isinstance(wanted, np.ndarray):
        assert found.dtype == wanted.dtype and np.array_equal(found, wanted)
    elif is_dataclass(wanted):
        assert type(found) is type(wanted)
        for name, value in vars(wanted).items():
            same(getattr(found, name), value)
    else:
        assert repr(found) == repr(wanted)


def test_a_capture_of_another_camera_is_refused(seen, tmp_path):
    with pytest.raises(InputError, match="lenslets"):
        Image.fromarray(np.full((40, 40), 9, np.uint8)).save(tmp_path / "a.png")
        run_volume(tmp_path / "a.png", tmp_path / "v.h5", seen / "stack.h5")
    assert not (tmp_path / "v.h5").exists()


def test_another_lattice_than_that_of_the_kernels_is_refused():
    grid = SimpleNamespace(lattice="hexagonal", pitch=(13.0, 15.0))
    grid.centres, grid.valid = np.full((2, 2, 2), 20.0), np.ones((2, 2), bool)
    known = SimpleNamespace(grid=grid, white=SimpleNamespace(flat=np.ones((40, 40))))
    with pytest.raises(InputError, match="hexagonal lattice"):
        white_superpixel(known, (13, 15))


def test_a_photographic_camera_with_planes_has_kernels(tmp_path):
    """The plane in focus lights its own superpixel; planes away from it light several."""
    text = Path("sample_configs/tiny.toml").read_text()
    text = text.replace('distance = "550 mm"', 'distance = "550 mm"\nplanes = ["450 mm", "550 mm"]')
    text = text.replace("samples_per_lenslet = [8, 8]", "samples_per_lenslet = [2, 2]")
    (tmp_path / "camera.toml").write_text(text)
    run_simulate_pif(tmp_path / "camera.toml", tmp_path / "stack.h5", Settings(accuracy=2e-2))
    stack = read_stack(tmp_path / "stack.h5")
    own = [
        kernels[(offsets == 0).all(1)].sum() / kernels.sum() for kernels, offsets in stack.parts()
    ]
    assert own[1] > 0.6 > 0.2 > own[0]
    assert np.allclose(stack.depth, [0.45, 0.55])
    assert stack.spacing[1, 0] / stack.spacing[0, 0] == pytest.approx(0.55 / 0.45)


HEXAGONAL = (
    MICROSCOPE.replace("[lenslet_array]", '[lenslet_array]\nlattice = "hexagonal"')
    .replace("[7, 7]", "[6, 7]")
    .replace("[7, 6]", "[7, 7]")
)


def test_a_hexagonal_lattice_gives_a_specimen_back(tmp_path):
    path = tmp_path / "hexagonal.toml"
    path.write_text(HEXAGONAL)
    with pytest.raises(ConfigError, match="half of 7 pixels aside"):
        run_capture_sim(path, tmp_path / "seen.h5", Capture(), volume="phantom:beads")
    path.write_text(HEXAGONAL.replace("[6, 7]", "[6, 8]").replace("4.2857143", "4"))
    run_capture_sim(
        path,
        tmp_path / "seen.h5",
        Capture(refine=2, snr_db=40, accuracy=2e-2),
        volume="phantom:beads",
        scene_out=tmp_path / "truth.h5",
    )
    shot = read_capture(tmp_path / "seen.h5")
    # every other row stands half a superpixel aside, in the dark of the others
    assert shot.shape == (7 * 6, 7 * 8 + 4)
    assert abs(shot.mosaic[6:12, :4]).max() < 0.2 * abs(shot.mosaic).max()
    run_simulate_pif(path, tmp_path / "stack.h5", Settings(accuracy=2e-2))
    stack = read_stack(tmp_path / "stack.h5")
    assert stack.lattice == "hexagonal" and stack.pixel_shape == (12, 8)
    assert np.allclose(stack.spacing[0], np.array([np.sqrt(0.75), 1]) * 30e-6 / 20 / 2)
    with collected_notes() as notes:
        run_volume(tmp_path / "seen.h5", tmp_path / "volume.h5", tmp_path / "stack.h5", method="tv")
    assert any("8 x 7 lenslets, 3 planes of 2 x 2 voxels a lenslet" in note for note in notes)
    found, truth = (read_volume(tmp_path / f"{name}.h5") for name in ("volume", "truth"))
    assert found.value.shape == truth.value.shape == (3, 16, 14)
    inner = (slice(None), slice(3, -3), slice(3, -3))
    alike = np.corrcoef(found.value[inner].ravel(), truth.value[inner].ravel())[0, 1]
    turned = np.corrcoef(found.value[inner].ravel(), truth.value[inner][:, ::-1].ravel())[0, 1]
    assert alike > 0.8 and turned < 0.5


def test_ome_tiff_is_what_another_reader_reads(tmp_path):
    """Pixels by OpenImageIO, sizes from the XML by hand."""
    rng = np.random.default_rng(1)
    value, sigma = rng.random((2, 4, 9, 7)).astype(np.float32)
    depth = np.array([-3, -1, 1, 3]) * 1e-6
    write_volume_tiff(tmp_path / "v.ome.tif", value, sigma, depth, (0.5e-6, 0.25e-6))
    planes, number = [], 0
    while True:
        source = oiio.ImageInput.open(str(tmp_path / "v.ome.tif"))
        if not source.seek_subimage(number, 0):
            break
        planes.append(source.read_image("float").reshape(9, 7))
        description = source.spec().getattribute("ImageDescription") or ""
        if number == 0:
            pixels = tree.fromstring(description).find(".//{*}Pixels")
        number += 1
        source.close()
    # channels vary before planes do, and the XML says so
    assert pixels.attrib["DimensionOrder"] == "XYCZT"
    both = np.stack([value, sigma], axis=1)
    assert np.array_equal(np.array(planes).reshape(4, 2, 9, 7), both)
    sizes = {k: float(v) for k, v in pixels.attrib.items() if k in ("SizeZ", "SizeC")}
    assert sizes == {"SizeZ": 4, "SizeC": 2}
    found = [float(pixels.attrib[f"PhysicalSize{axis}"]) for axis in "XYZ"]
    assert np.allclose(found, [0.25, 0.5, 2.0])
    again = read_tiff_volume(tmp_path / "v.ome.tif")
    assert np.array_equal(again.value, value)
    assert np.allclose((again.step, *again.spacing), (2e-6, 0.5e-6, 0.25e-6))


@pytest.mark.parametrize("content", [b"", b"II*\0 no tiff", b"\x89PNG"])
def test_what_is_no_tiff_is_told(tmp_path, content):
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(InputError):
        read_tiff_volume(tmp_path / "a.tif")


def test_lenslets_of_a_microscope_are_judged_by_the_volume_that_comes_back(tmp_path):
    (tmp_path / "camera.toml").write_text(MICROSCOPE)
    (tmp_path / "sweep.toml").write_text(
        'camera = "camera.toml"\n'
        '[vary]\n"lenslet_array.focal_length" = ["500 um", "400 um"]\n'
        '"volume.method" = ["rl", "lmmse"]\n'
        '[follow]\n"sensor.distance" = "lenslet_array.focal_length"\n'
        "[simulate-pif]\naccuracy = 5e-2\n"
        '[capture-sim]\nsnr = "40 dB"\naccuracy = 5e-2\n'
    )
    summary = run_sweep(tmp_path / "sweep.toml", tmp_path / "s.h5", read_options=read_options)
    assert summary.objectives == {"volume_snr_db": "max", "object_points": "max"}
    with (tmp_path / "s.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["0"] * 4
    assert {float(row["object_points"]) for row in rows} == {7 * 6 * 4 * 3}
    assert all(float(row["lenslet_field_m"]) == pytest.approx(1.5e-6) for row in rows)
    # the same by hand: captured twice finer than it is inverted
    run_simulate_pif(tmp_path / "camera.toml", tmp_path / "k.h5", Settings(accuracy=5e-2))
    run_capture_sim(
        tmp_path / "camera.toml",
        tmp_path / "c.h5",
        Capture(snr_db=40, accuracy=5e-2, refine=2),
        volume="phantom:beads",
        scene_out=tmp_path / "t.h5",
    )
    for row, method in zip(rows[:2], ("rl", "lmmse")):
        made = tmp_path / f"{method}.h5"
        run_volume(tmp_path / "c.h5", made, tmp_path / "k.h5", method=method)
        figures = run_score([made], tmp_path / "f.json", truth=tmp_path / "t.h5", overwrite=True)
        assert float(row["volume_snr_db"]) == pytest.approx(figures.figures["volume_snr_db"])
    assert float(rows[0]["volume_snr_db"]) != float(rows[2]["volume_snr_db"])


def test_a_microscope_goes_through_no_other_chain(tmp_path):
    (tmp_path / "camera.toml").write_text(MICROSCOPE)
    text = 'camera = "camera.toml"\nchain = "spatial"\n[vary]\n"light.wavelengths" = [["500 nm"]]\n'
    (tmp_path / "sweep.toml").write_text(text)
    with pytest.raises(ConfigError, match="an \\[objective\\]"):
        run_sweep(tmp_path / "sweep.toml", tmp_path / "s.h5", read_options=read_options)
    other = text.replace("spatial", "volume").replace(
        "camera.toml", str(Path("sample_configs/tiny.toml").resolve())
    )
    (tmp_path / "sweep.toml").write_text(other)
    with pytest.raises(ConfigError, match="no \\[objective\\]"):
        run_sweep(tmp_path / "sweep.toml", tmp_path / "s.h5", read_options=read_options)


CAMERA = """
[main_lens]
focal_length = "50 mm"
f_number = 8
aperture_shape = "circle"
[object]
distance = "550 mm"
planes = ["480 mm", "640 mm"]
samples_per_lenslet = [2, 2]
[lenslet_array]
distance = "55 mm"
superpixel_pitch = "100 um"
focal_length = "0.8 mm"
count = [24, 22]
[sensor]
distance = "0.8 mm"
pixel_pitch = "11.11111 um"
pixels_per_lenslet = [9, 9]
[light]
wavelengths = ["550 nm"]
"""


def test_planes_that_coarse_voxels_do_not_tell_apart_are_named(tmp_path, capsys):
    """Light of f/8 upon lenslets 98.57 um apart: the finest period is 4.4 um, and discs of things
    at 450 and 540 mm, 1.25 and 0.1 mm behind and before the lenslets, are 156 and 13 um.
    """
    text = CAMERA.replace('["480 mm", "640 mm"]', '["450 mm", "540 mm"]')
    path = tmp_path / "camera.toml"
    path.write_text(text)
    run_simulate_pif(path, None, Settings(model="ray", accuracy=1.0), explain=True)
    told = capsys.readouterr().err
    assert "what is at 540 mm will" in told and "voxels of 49.3 um" in told
    assert "resolves 4.4 um; samples_per_lenslet = [23, 23]" in told
    path.write_text(text.replace("samples_per_lenslet = [2, 2]", "samples_per_lenslet = [23, 23]"))
    run_simulate_pif(path, None, Settings(model="ray", accuracy=1.0), explain=True)
    assert "too coarse" not in capsys.readouterr().err


@pytest.fixture(scope="module")
def sheets(tmp_path_factory):
    """Folder with a camera, a sheet with a rim of nothing, and one behind it."""
    folder = tmp_path_factory.mktemp("sheets")
    (folder / "camera.toml").write_text(CAMERA)
    texture = np.random.default_rng(2).random((2, 12, 11)).repeat(20, 1).repeat(20, 2)
    near, far = (255 * texture).astype(np.uint8)
    alpha = np.zeros_like(near)
    alpha[:, :110] = 255
    Image.fromarray(np.dstack([near, near, near, alpha])).save(folder / "near.png")
    Image.fromarray(far).save(folder / "far.png")
    return folder


def test_the_depth_of_two_opaque_layers_is_found_and_their_volume_shows_both(sheets, tmp_path):
    run_capture_sim(
        sheets / "camera.toml",
        tmp_path / "capture.h5",
        Capture(snr_db=40, refine=2, model="ray"),
        layers=[f"{sheets}/far.png@640mm", f"{sheets}/near.png@480mm"],
        scene_out=tmp_path / "truth.h5",
    )
    truth = read_volume(tmp_path / "truth.h5")
    assert np.allclose(truth.depth, [0.48, 0.64]) and truth.opacity.shape == (2, 48, 44)
    assert truth.opacity[0, :, :20].min() == 1 and truth.opacity[0, :, 24:].max() == 0
    assert not truth.value[1, :, :18].any() and truth.value[1, :, 26:].any()
    run_refocus(
        [tmp_path / "capture.h5"], tmp_path / "planes.h5", Refocus(camera=sheets / "camera.toml")
    )
    figures = (
        run_score([tmp_path / "planes.h5"], tmp_path / "d.json", truth=tmp_path / "truth.h5")
        .results[0]
        .figures
    )
    assert max(figures["depth_layer_errors"]) < 0.2 and figures["depth_sure_share"] > 0.8
    run_simulate_pif(sheets / "camera.toml", tmp_path / "k.h5", Settings(model="ray"))
    run_volume(tmp_path / "capture.h5", tmp_path / "v.h5", tmp_path / "k.h5", method="rl")
    found = read_volume(tmp_path / "v.h5").value
    sides = (slice(None), slice(2, 18)), (slice(None), slice(26, 42))
    for plane, (own, other) in enumerate([sides, sides[::-1]]):
        shown = np.corrcoef(found[plane][own].ravel(), truth.value[plane][own].ravel())[0, 1]
        assert shown > 0.7 and found[plane][own].mean() > 2 * found[plane][other].mean()


@pytest.mark.parametrize(
    ("layers", "others", "match"),
    [
        (["near.png"], {}, "does not say where"),
        (["near.png@-3mm"], {}, "no picture before"),
        (["near.png@48cm", "far.png@480mm"], {}, "one distance"),
        (["near.png@480mm"], {"scene": "skimage:coins"}, "--layer"),
        (["near.png@480mm"], {"volume": "phantom:beads"}, "no \\[objective\\]"),
    ],
)
def test_layers_that_cannot_be_are_refused(sheets, tmp_path, layers, others, match):
    layers = [f"{sheets}/{layer}" for layer in layers]
    with pytest.raises(UsageError, match=match):
        run_capture_sim(
            sheets / "camera.toml", tmp_path / "a.h5", Capture(), layers=layers, **others
        )
    assert not list(tmp_path.iterdir())


def test_layers_and_truths_that_files_do_not_hold_are_refused(sheets, tmp_path):
    layer = f"{sheets}/near.png@480mm"
    given = {"layers": [layer], "scene_out": tmp_path / "truth.exr"}
    with pytest.raises(UsageError, match="exr"):
        run_capture_sim(sheets / "camera.toml", tmp_path / "a.h5", Capture(), **given)
    # inside the focal length light comes down everywhere
    with pytest.raises(NumericsError, match="superpixels"):
        given = {"layers": [layer.replace("480mm", "5mm")]}
        run_capture_sim(sheets / "camera.toml", tmp_path / "a.h5", Capture(), **given)
    assert not list(tmp_path.iterdir())


def test_a_microscope_takes_no_layers(camera, sheets, tmp_path):
    with pytest.raises(UsageError, match="objective"):
        run_capture_sim(camera, tmp_path / "a.h5", Capture(), layers=[f"{sheets}/near.png@480mm"])
