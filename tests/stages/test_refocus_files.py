"""refocus to OME-TIFF and EXR, of several captures, of colours and of microscopes: what other
programs read is what the artefact holds.
"""

import json

import numpy as np
import pytest
import tifffile

from plenocli.cli.main import run
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.images.exr import read_exr
from plenocli.files.images.mosaic import write_capture
from plenocli.files.images.tiff_stack import write_volume_tiff
from plenocli.forward.sensor.capture import Capture, SuperpixelGrid
from plenocli.inverse.lightfield.refocus import STEP

CAMERA = """
[main_lens]
focal_length = "50 mm"
f_number = 8
aperture_shape = "square"
[object]
distance = "550 mm"
samples_per_lenslet = [6, 6]
[lenslet_array]
distance = "55 mm"
superpixel_pitch = "40 um"
focal_length = "320 um"
count = [8, 9]
[sensor]
distance = "320 um"
pixel_pitch = "4 um"
pixels_per_lenslet = [10, 10]
[light]
wavelengths = ["550 nm"]
"""
MICROSCOPE = """
[objective]
magnification = 20
numerical_aperture = 0.5
medium_index = 1.33
[object]
planes = "-4 um to 4 um step 4 um"
samples_per_lenslet = [3, 3]
[lenslet_array]
pitch = "30 um"
focal_length = "500 um"
count = [15, 15]
[sensor]
distance = "500 um"
pixel_pitch = "4.2857143 um"
pixels_per_lenslet = [7, 7]
[light]
wavelengths = ["500 nm"]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two captures in colour, their planes as HDF5, and the camera."""
    root = tmp_path_factory.mktemp("files")
    (root / "camera.toml").write_text(CAMERA)
    (root / "shots").mkdir()
    rng = np.random.default_rng(4)
    for name in ("a", "b"):
        mosaic = np.kron(rng.uniform(200, 800, (8, 9)), np.ones((10, 10)))
        grid = SuperpixelGrid.tiled((8, 9), (10, 10))
        shot = Capture(mosaic=mosaic + rng.normal(0, 2, mosaic.shape), cfa="RGGB", grid=grid)
        write_capture(root / "shots" / f"{name}.h5", shot, Provenance(command="test"))
    words = ["refocus", str(root / "shots/a.h5"), "--camera", str(root / "camera.toml")]
    assert run([*words, "-o", str(root / "planes.h5")]) == 0
    return root


def test_ome_tiff_holds_planes_depth_and_views_with_sizes(folder, tmp_path):
    words = ["refocus", str(folder / "shots/a.h5"), "--camera", str(folder / "camera.toml")]
    assert run([*words, "-o", str(tmp_path / "a.ome.tif")]) == 0
    data = read_artefact(folder / "planes.h5", "lightfield").data
    with tifffile.TiffFile(tmp_path / "a.ome.tif") as file:
        found = {series.name: series for series in file.series}
        about = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]
        planes = found["planes"]
        assert planes.axes == "ZCYX" and np.array_equal(planes.asarray(), data["colour/value"])
        assert np.array_equal(found["everything in focus"].asarray(), data["colour/picture"])
        assert found["views"].axes == "TCYX"
        assert np.array_equal(
            found["views"].asarray(), data["colour/views"].reshape(9, 3, 8, 9), equal_nan=True
        )
        depth = found["depth"].asarray()
        assert np.allclose(depth[0], data["depth/slope"], equal_nan=True)
    pixels = about[0]["Pixels"]
    assert [c["Name"] for c in pixels["Channel"]] == ["R", "G", "B"]
    # lenslets of 39.8 um, seen ten times larger at 550 mm from a lens 55 mm before the array
    pitch = 40 / (1 + 320e-6 / 55e-3)
    assert float(pixels["PhysicalSizeX"]) == pytest.approx(10 * pitch / STEP, rel=1e-6)
    where = [float(p["PositionZ"]) for p in pixels["Plane"]][::3]
    assert np.allclose(where, 1e6 * data["refocus/distance"])
    names = [c["Name"] for c in about[2]["Pixels"]["Channel"]]
    assert names[:3] == ["slope", "confidence", "sigma"] and names[4] == "distance (µm)"
    first = (tmp_path / "a.ome.tif").read_bytes()
    assert run([*words, "-o", str(tmp_path / "a.ome.tif"), "--overwrite"]) == 0
    assert (tmp_path / "a.ome.tif").read_bytes() == first


def test_exr_holds_the_picture_in_focus_its_depth_and_every_plane(folder, tmp_path):
    words = ["refocus", str(folder / "shots/a.h5"), "--camera", str(folder / "camera.toml")]
    assert run([*words, "-o", str(tmp_path / "a.exr")]) == 0
    data = read_artefact(folder / "planes.h5", "lightfield").data
    channels, attrs = read_exr(tmp_path / "a.exr")
    assert np.allclose(channels["Y"], np.nan_to_num(data["depth/picture"]))
    assert np.allclose(channels["Z"][2::STEP, 3::STEP], data["depth/distance"], equal_nan=True)
    red = np.tensordot(data["colour/to_rgb"], np.nan_to_num(data["colour/value"][4]), axes=1)[0]
    assert np.allclose(channels["plane004.R"], red, atol=1e-6)
    assert np.allclose([float(s) for s in attrs["slopes"].split()], data["refocus/slope"])
    assert run(["show", str(tmp_path / "a.exr"), "-o", str(tmp_path / "a.png")]) == 0


def test_a_folder_of_captures_is_refocused_once_and_bad_ones_do_not_stop_it(folder, capsys):
    out = folder / "stacks"
    (folder / "shots/c.h5").write_bytes(b"no capture")
    words = ["refocus", str(folder / "shots"), "--camera", str(folder / "camera.toml")]
    words += ["--slope", "0", "--views", "0", "--format", "tif", "--workers", "2"]
    assert run([*words, "-o", str(out), "--json"]) == 3
    told = json.loads(capsys.readouterr().out)
    assert told["done"] == 2 and [one["capture"][-4:] for one in told["failed"]] == ["c.h5"]
    names = ["a.tif", "b.tif", "summary.csv", "summary.json"]
    assert sorted(path.name for path in out.iterdir()) == names
    before = (out / "a.tif").stat().st_mtime_ns
    (folder / "shots/c.h5").unlink()
    assert run([*words, "-o", str(out)]) == 0
    assert "0 refocused, 2 were finished before" in capsys.readouterr().out
    assert (out / "a.tif").stat().st_mtime_ns == before


@pytest.mark.parametrize("plane, depth", [(2, 4.0), (0, -4.0)])
def test_a_sheet_before_an_objective_is_found_in_micrometres(tmp_path, plane, depth):
    """By wave optics, finer than it is refocused; beyond the lenslets' diffraction (two pixels of
    seven) the pupil's rim is blurred, which draws depths to the focused plane by a quarter.
    """
    from scipy.ndimage import gaussian_filter

    (tmp_path / "m.toml").write_text(MICROSCOPE)
    sheet = gaussian_filter(np.random.default_rng(1).normal(size=(45, 45)), 1.8)
    volume = np.zeros((3, 45, 45))
    volume[plane] = (sheet - sheet.min()) / np.ptp(sheet)
    specimen, shot, out = (str(tmp_path / name) for name in ("s.ome.tif", "c.h5", "p.h5"))
    write_volume_tiff(specimen, volume, None, np.array([-4e-6, 0, 4e-6]), (0.5e-6, 0.5e-6))
    camera = str(tmp_path / "m.toml")
    words = ["capture-sim", camera, "--volume", specimen, "--snr", "45dB", "--accuracy", "2e-2"]
    assert run([*words, "-o", shot]) == 0
    assert run(["refocus", shot, "--camera", camera, "-o", out]) == 0
    artefact = read_artefact(out, "lightfield")
    found = 1e6 * artefact.data["depth/distance"][3:-3, 3:-3]
    assert np.isfinite(found).mean() > 0.8
    assert 0.6 * abs(depth) < np.nanmedian(found) * np.sign(depth) < 1.1 * abs(depth)
    assert artefact.attrs["refocus"]["spacing"] == pytest.approx(1.5e-6)
    planes = ["--distance", "-4um", "--distance", "0um", "--distance", "4um"]
    stack = str(tmp_path / "p.tif")
    assert run(["refocus", shot, "--camera", camera, *planes, "-o", stack]) == 0
    with tifffile.TiffFile(stack) as file:
        pixels = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"][0]["Pixels"]
    assert float(pixels["PhysicalSizeZ"]) == pytest.approx(4.0)
    assert float(pixels["PhysicalSizeX"]) == pytest.approx(1.5 / STEP)


def test_wrong_planes_and_suffixes_are_refused(folder, capsys):
    camera, shot = str(folder / "camera.toml"), str(folder / "shots/a.h5")
    never = str(folder / "never.tif")
    assert run(["refocus", shot, "--camera", camera, "--distance", "-5mm", "-o", never]) == 2
    assert "farther than 0" in capsys.readouterr().err
    assert run(["refocus", shot, "-o", str(folder / "never.png")]) == 2
    assert ".h5, .tif, .tiff or .exr" in capsys.readouterr().err
