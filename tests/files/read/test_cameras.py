"""Cameras with files: pupils as pictures and wavefronts as grids, read, checked, attached, and
named in the provenance.
"""

import hashlib
from pathlib import Path

import h5py
import numpy as np
import OpenImageIO as oiio
import pytest

from plenocli.base.errors import ConfigError, InputError
from plenocli.cli.main import run
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.config.camera_file import load_camera, to_toml
from plenocli.files.images.exr import write_exr
from plenocli.files.read.cameras import camera_files, read_camera

TINY = (Path(__file__).resolve().parents[3] / "sample_configs" / "tiny.toml").read_text()


def write_png(path, values):
    rows, columns, *channels = values.shape
    output = oiio.ImageOutput.create("png")
    assert output.open(
        str(path), oiio.ImageSpec(columns, rows, channels[0] if channels else 1, str(values.dtype))
    )
    assert (
        output.write_image(np.ascontiguousarray(values).reshape(rows, columns, -1))
        and output.close()
    )


def write_h5(path, values, units=None, name="wavefront"):
    with h5py.File(path, "w") as file:
        file[name] = values
        if units:
            file[name].attrs["units"] = np.bytes_(units)


def described(tmp_path, *lines):
    text = TINY.replace("[object]", "\n".join([*lines, "[object]"]))
    (tmp_path / "camera.toml").write_text(text)
    return tmp_path / "camera.toml"


@pytest.mark.parametrize("dtype, full", [(np.uint8, 255), (np.uint16, 65535)])
def test_a_png_is_transmittance_over_full_scale_and_not_srgb(tmp_path, dtype, full):
    values = np.random.default_rng(1).integers(0, full + 1, (6, 6)).astype(dtype)
    write_png(tmp_path / "pupil.png", values)
    camera = read_camera(described(tmp_path, 'aperture_image = "pupil.png"'))
    assert camera.main_lens.aperture_shape == "image"
    np.testing.assert_allclose(
        camera.main_lens.samples("aperture_image"), values / full, atol=1e-12
    )


def test_grey_pictures_of_three_channels_pass_and_colour_does_not(tmp_path):
    grey = np.full((4, 4, 3), 99, np.uint8)
    write_png(tmp_path / "pupil.png", grey)
    assert read_camera(described(tmp_path, 'aperture_image = "pupil.png"')).main_lens.samples(
        "aperture_image"
    )[0, 0] == pytest.approx(99 / 255)
    grey[1, 1, 2] = 98
    write_png(tmp_path / "pupil.png", grey)
    with pytest.raises(InputError, match="pupil.png: is a colour picture"):
        read_camera(tmp_path / "camera.toml")


def test_wavefronts_come_from_hdf5_and_exr_in_metres(tmp_path):
    values = np.random.default_rng(2).normal(0, 50e-9, (9, 9))
    write_h5(tmp_path / "w.h5", values, "m")
    write_exr(tmp_path / "w.exr", {"W": values})
    first, second = (
        read_camera(described(tmp_path, f'wavefront = "{name}"')).main_lens.samples("wavefront")
        for name in ("w.h5", "w.exr")
    )
    np.testing.assert_array_equal(first, values)
    np.testing.assert_allclose(second, values, rtol=1e-6)
    assert not first.flags.writeable


@pytest.mark.parametrize(
    "key, values, message",
    [
        ("aperture_image", np.zeros((4, 4)), "lets no light through"),
        ("aperture_image", np.full((4, 4), -0.1), "within 0 ... 1"),
        ("aperture_image", np.full((4, 4), 1.5), "within 0 ... 1"),
        ("aperture_image", np.full((4, 5), 0.5), "square grid"),
        ("aperture_image", np.full((4, 4), np.nan), "NaN"),
        ("wavefront", np.full((4, 4), np.inf), "NaN or infinite"),
        ("wavefront", np.zeros((3, 3)), "4 to 1024"),
        ("wavefront", np.full((5, 5), 2e-3), "at most 0.001 m"),
        ("wavefront", np.zeros((5, 6)), "square grid"),
    ],
)
def test_values_that_cannot_be_are_refused_with_the_file(tmp_path, key, values, message):
    write_exr(tmp_path / "map.exr", {"Y": values})
    with pytest.raises(InputError, match=f"map.exr: .*{message}.*main_lens. {key} in camera.toml"):
        read_camera(described(tmp_path, f'{key} = "map.exr"'))


def test_files_that_are_no_maps_are_refused(tmp_path):
    path = described(tmp_path, 'wavefront = "w.h5"')
    with pytest.raises(InputError, match="w.h5: does not exist"):
        read_camera(path)
    write_h5(tmp_path / "w.h5", np.zeros((5, 5)), name="other")
    with pytest.raises(InputError, match="no dataset wavefront, only other"):
        read_camera(path)
    write_h5(tmp_path / "w.h5", np.zeros((5, 5)), "nm")
    with pytest.raises(InputError, match="in 'nm'"):
        read_camera(path)
    whole = (tmp_path / "w.h5").read_bytes()
    (tmp_path / "w.h5").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="damaged"):
        read_camera(path)
    (tmp_path / "w.h5").write_text("0 1 2")
    with pytest.raises(InputError, match="neither HDF5 nor EXR"):
        read_camera(path)
    with h5py.File(tmp_path / "w.h5", "w") as file:
        file["wavefront"] = h5py.ExternalLink("elsewhere.h5", "/wavefront")
    with pytest.raises(InputError, match="external link"):
        read_camera(path)
    (tmp_path / "pupil.jpg").write_bytes(b"\xff\xd8\xff" + bytes(50))
    with pytest.raises(InputError, match="neither PNG nor EXR"):
        read_camera(described(tmp_path, 'aperture_image = "pupil.jpg"'))


def test_a_picture_is_the_whole_aperture():
    from plenocli.files.config.camera_file import parse_camera

    for line in ('aperture_shape = "image"', 'aperture_shape = "circle"\naperture_image = "a.png"'):
        with pytest.raises(ConfigError, match="main_lens: aperture_image is the whole aperture"):
            parse_camera(TINY.replace("[object]", line + "\n[object]"))


def test_values_stay_with_a_camera_that_changes_elsewhere(tmp_path):
    write_h5(tmp_path / "w.h5", np.eye(5) * 1e-9)
    path = described(tmp_path, 'wavefront = "w.h5"')
    camera = read_camera(path)
    finer = camera.replace(
        **{"object.samples_per_lenslet": (24, 24), "main_lens.focal_length": 0.051}
    )
    np.testing.assert_array_equal(finer.main_lens.samples("wavefront"), np.eye(5) * 1e-9)
    assert (
        camera == read_camera(path) and camera != finer and 'wavefront = "w.h5"' in to_toml(camera)
    )
    with pytest.raises(ConfigError, match="'w.h5' are missing"):
        load_camera(path).main_lens.samples("wavefront")
    write_h5(tmp_path / "w.h5", np.eye(5) * 2e-9)
    assert camera != read_camera(path)


def test_provenance_names_the_files_and_a_capture_refuses_a_matrix_of_others(tmp_path):
    write_png(tmp_path / "pupil.png", np.pad(np.full((4, 4), 255, np.uint8), 2))
    write_h5(tmp_path / "w.h5", np.random.default_rng(3).normal(0, 20e-9, (6, 6)))
    path = described(tmp_path, 'aperture_image = "pupil.png"', 'wavefront = "w.h5"')
    assert set(camera_files(path, read_camera(path))) == {"camera", "aperture image", "wavefront"}
    request = [
        "--superpixels",
        "1x1",
        "--coherent-ring",
        "0",
        "--accuracy",
        "1e-3",
        "--model",
        "fresnel",
    ]
    assert run(["simulate-pif", str(path), "-o", str(tmp_path / "pif.h5"), *request]) == 0
    inputs = read_artefact(tmp_path / "pif.h5", "pif").provenance.inputs
    for role, name in (("aperture image", "pupil.png"), ("wavefront", "w.h5")):
        assert inputs[role] == {
            "name": name,
            "sha256": hashlib.sha256((tmp_path / name).read_bytes()).hexdigest(),
        }
    capture = [
        "capture-sim",
        str(path),
        "--target",
        "white",
        "--pif",
        str(tmp_path / "pif.h5"),
        "-o",
    ]
    assert run([*capture, str(tmp_path / "one.h5")]) == 0
    write_h5(tmp_path / "w.h5", np.zeros((6, 6)))
    assert run([*capture, str(tmp_path / "two.h5")]) == 3
    assert not (tmp_path / "two.h5").exists()


def test_a_hexagonal_camera_has_a_matrix_but_no_captures_or_pictures_yet(tmp_path, capsys):
    text = TINY.replace("count = [5, 5]", 'count = [5, 5]\nlattice = "hexagonal"').replace(
        "pixels_per_lenslet = [13, 13]", "pixels_per_lenslet = [11, 13]"
    )
    (tmp_path / "camera.toml").write_text(text)
    request = [
        "--superpixels",
        "3x3",
        "--coherent-ring",
        "0",
        "--accuracy",
        "1e-2",
        "--model",
        "fresnel",
    ]
    assert (
        run(
            [
                "simulate-pif",
                str(tmp_path / "camera.toml"),
                "-o",
                str(tmp_path / "pif.h5"),
                *request,
            ]
        )
        == 0
    )
    pif = read_artefact(tmp_path / "pif.h5", "pif")
    assert pif.data["pif/lenslet_offset"].tolist() == [
        [r, c] for r in (-1, 0, 1) for c in (-1, 0, 1)
    ]
    assert 'aperture_shape = "hexagon"' in pif.provenance.config
    assert 0 < pif.data["pif/column_energy"].min() and pif.data["pif/column_energy"].max() < 1
    capsys.readouterr()
    assert (
        run(
            [
                "capture-sim",
                str(tmp_path / "camera.toml"),
                "--target",
                "white",
                "-o",
                str(tmp_path / "c.h5"),
            ]
        )
        == 2
    )
    assert "hexagonal" in capsys.readouterr().err
    assert (
        run(
            [
                "learn-dict",
                "skimage:camera",
                "--pif",
                str(tmp_path / "pif.h5"),
                "-o",
                str(tmp_path / "d.h5"),
            ]
        )
        == 3
    )
    assert "hexagonal lattice, whose object blocks do not tile" in capsys.readouterr().err
