"""Volumes through their files: kernels, captures, OME-TIFF."""

import xml.etree.ElementTree as tree

import numpy as np
import OpenImageIO as oiio
import pytest

from plenocli.base.errors import InputError, UsageError
from plenocli.files.images.mosaic import read_capture
from plenocli.files.images.tiff_stack import read_tiff_volume, write_ome_tiff
from plenocli.files.results.stacks import read_stack
from plenocli.files.results.volumes import read_volume
from plenocli.stages.forward.capture_settings import Settings as Capture
from plenocli.stages.forward.capture_sim import run_capture_sim
from plenocli.stages.forward.simulate_pif import Settings, run_simulate_pif
from plenocli.stages.forward.simulate_stack import StackSummary

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
    assert report.output is None and "waves" in report.line() and report.seconds > 0


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


def test_ome_tiff_is_what_another_reader_reads(tmp_path):
    """Pixels by OpenImageIO, sizes from the XML by hand."""
    rng = np.random.default_rng(1)
    value, sigma = rng.random((2, 4, 9, 7)).astype(np.float32)
    depth = np.array([-3, -1, 1, 3]) * 1e-6
    write_ome_tiff(tmp_path / "v.ome.tif", value, sigma, depth, (0.5e-6, 0.25e-6))
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
    assert np.array_equal(np.array(planes).reshape(2, 4, 9, 7), np.stack([value, sigma]))
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
