"""Cells of a filter array: clear, neutral, measured, and bands that move with the angle."""

import numpy as np
import pytest

from plenocli.base.errors import ConfigError, InputError
from plenocli.base.units import parse_length
from plenocli.files.config.camera_file import load_camera, parse_camera, to_toml
from plenocli.files.config.curve_file import read_curve
from plenocli.forward.camera.pupil import filter_cells, filter_transmittance
from plenocli.forward.propagation.response import uniform_response
from plenocli.forward.scene.light import band_weights, broadband

CAMERA = """
[main_lens]
focal_length = "50 mm"
f_number = 4
aperture_shape = "square"
[object]
distance = "550 mm"
samples_per_lenslet = [2, 2]
[lenslet_array]
distance = "55 mm"
superpixel_pitch = "104 um"
focal_length = "416 um"
count = [2, 2]
[sensor]
distance = "416 um"
pixel_pitch = "4 um"
pixels_per_lenslet = [26, 26]
[light]
wavelengths = ["450 nm", "540 nm", "650 nm"]
[filter_array]
layout = [1, 2]
SIDE
filters = [ONE, TWO]
"""
BAND = '{ center = "540 nm", fwhm = "30 nm" }'


def described(one, two=BAND, side=""):
    """The text of a camera of two cells."""
    return CAMERA.replace("ONE", one).replace("TWO", two).replace("SIDE", side)


def even(*_):
    return np.ones(np.shape(_[-1]))


def shares(camera, wavelength):
    return [share for _, share in filter_cells(camera, wavelength)]


def test_clear_and_neutral_cells_let_all_wavelengths_through_alike():
    camera = parse_camera(described("{ transmittance = 1 }", "{ transmittance = 0.1 }"))
    for wavelength in (410e-9, 550e-9, 690e-9):
        assert shares(camera, wavelength) == [1.0, 0.1]
    # what one cell sends to the other's half by diffraction is in both cameras
    light, dark = (
        uniform_response(parse_camera(described(one, two)), 550e-9, "fresnel", np.zeros((1, 2)))[0]
        for one, two in (
            ("{ transmittance = 1 }", "{ transmittance = 1 }"),
            ("{ transmittance = 0.1 }", "{ transmittance = 0.1 }"),
        )
    )
    np.testing.assert_allclose(dark, 0.1 * light, rtol=1e-9)
    assert np.diff(broadband(camera, even).wavelengths)[0] == pytest.approx(10e-9)


def test_a_curve_stands_between_its_points_and_is_in_the_description(tmp_path):
    wavelength = np.arange(400, 701, 7)
    values = np.random.default_rng(0).uniform(0.1, 0.9, len(wavelength))
    rows = [f"{w};{100 * t}" for w, t in zip(wavelength, values)]
    (tmp_path / "f.csv").write_text("Wavelength [nm];T (%)\n" + "\n".join(reversed(rows)))
    (tmp_path / "camera.toml").write_text(described('{ curve = "f.csv" }'))
    camera = load_camera(tmp_path / "camera.toml")
    for nm in (400, 433.3, 551, 697):
        found = filter_transmittance(camera.filter_array.filters[0], nm * 1e-9)
        assert found == pytest.approx(np.interp(nm, wavelength, values))
    assert parse_camera(to_toml(camera)) == camera


def test_a_measured_band_is_the_band_that_was_measured(tmp_path):
    """Width, step of the quadrature and light through it, against the formula."""
    nm = np.arange(400, 701)
    text = "\n".join(f"{w} {0.8 * np.exp(-4 * np.log(2) * ((w - 540) / 30) ** 2):.9f}" for w in nm)
    (tmp_path / "f.txt").write_text(f"# nm, transmittance\n{text}\n")
    (tmp_path / "camera.toml").write_text(described('{ curve = "f.txt" }'))
    camera = load_camera(tmp_path / "camera.toml")
    measured, formula = camera.filter_array.filters
    assert measured.middle == pytest.approx(540e-9, abs=1e-11)
    assert measured.width == pytest.approx(30e-9 * np.sqrt(np.pi / np.log(16)), rel=1e-3)
    assert measured.detail == pytest.approx(30e-9, rel=0.01)
    light = broadband(camera, even)
    through = [
        sum(n * filter_transmittance(f, w) for w, n in zip(light.wavelengths, light.photons))
        for f in (measured, formula)
    ]
    assert through[0] == pytest.approx(through[1], rel=1e-3)


@pytest.mark.parametrize("side, distance", [("object", 0.55), ("image", 0.055)])
def test_bands_move_with_the_angle_of_the_light(side, distance):
    """The mean over a cell, by brute force; the shift is that of the interference's path."""
    camera = parse_camera(
        described('{ center = "540 nm", fwhm = "10 nm", index = 1.6 }', side=f'side = "{side}"')
    )
    (y0, y1, x0, x1), _ = filter_cells(camera, 540e-9)[0]
    y, x = (low + (np.arange(400) + 0.5) * (high - low) / 400 for low, high in ((y0, y1), (x0, x1)))
    tangent = np.hypot(y[:, None], x[None, :]) / distance
    inside = np.arcsin(np.sin(np.arctan(tangent)) / 1.6)  # Snell
    for nm in (530, 538, 540, 546):
        peak = 540 * np.cos(inside)
        expected = np.mean(0.8 * np.exp(-4 * np.log(2) * ((nm / peak * 540 - 540) / 10) ** 2))
        assert shares(camera, nm * 1e-9)[0] == pytest.approx(expected, rel=2e-4, abs=1e-9)


@pytest.mark.parametrize(
    "one, words",
    [
        ("{ }", "give exactly one of center and fwhm"),
        ('{ center = "540 nm" }', "a band has center and fwhm"),
        ('{ center = "540 nm", fwhm = "10 nm", transmittance = 0.5 }', "give exactly one of"),
        ("{ transmittance = 0.5, blocking = 0.1 }", "peak and blocking go with"),
        ("{ transmittance = 0.5, index = 1.5 }", "index goes with a band or a curve"),
        ("{ transmittance = 1.5 }", "less than or equal to 1"),
        (
            '{ curve = { wavelength = ["500 nm", "400 nm"], transmittance = [0, 1] } }',
            "wavelengths must ascend",
        ),
        (
            '{ curve = { wavelength = ["400 nm", "500 nm"], transmittance = [0, 0] } }',
            "lets no light through",
        ),
    ],
)
def test_what_is_no_filter_is_refused(one, words):
    with pytest.raises(ConfigError, match=words):
        parse_camera(described(one))


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "holds 0 rows"),
        ("nm,T\n500,0.5", "holds 1 rows"),
        ("nm,T\n500,0.5\n510,high", "line 3 is no wavelength"),
        ("nm,T\n500,0.5\n510,nan", "line 3 is no wavelength"),
        ("nm,T\n500,50\n510,90", "say % in its header"),
        ("nm,T\n500,-0.5\n510,0.9", "from -0.5 to 0.9"),
        ("500,0.5\n500,0.6", "has 500 nm twice"),
        ("PK\x03\x04", "holds 0 rows"),
        ("4O0,0.1\n410,0.2\n420,0.3", "line 1 is no wavelength"),
        ("nm,450 nm,540 nm\n400,0.1,0.2\n410,0.2,0.3", "line 2 is no wavelength"),
        ("nm;T\n400,5;0,9\n410,5;0,8", "line 2 is no wavelength"),
    ],
)
def test_files_that_hold_no_curve_are_refused(tmp_path, text, words):
    (tmp_path / "f.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        read_curve(tmp_path / "f.csv")
    with pytest.raises(InputError, match="two columns"):
        read_curve(tmp_path / "missing.csv")


def test_units_of_a_header_count_and_noise_about_nothing_is_cut(tmp_path):
    (tmp_path / "f.csv").write_text("wavelength (um)\ttransmittance\n0.5\t-0.001\n0.55\t0.9\n")
    found = read_curve(tmp_path / "f.csv")
    assert [parse_length(w) for w in found["wavelength"]] == [500e-9, 550e-9]
    assert found["transmittance"] == [0.0, 0.9]


def test_a_byte_order_mark_is_no_header(tmp_path):
    """Spreadsheets put one before what they save as UTF-8."""
    (tmp_path / "f.csv").write_text("400,0.1\n410,0.2\n", encoding="utf-8-sig")
    found = read_curve(tmp_path / "f.csv")
    assert [parse_length(w) for w in found["wavelength"]] == [400e-9, 410e-9]


def test_single_wavelengths_do_not_stand_for_bands_behind_a_clear_cell():
    camera = parse_camera(described("{ transmittance = 1 }"))
    with pytest.raises(Exception, match="--spectral-step auto"):
        band_weights(camera, [450e-9, 540e-9], even)
    fine = broadband(camera, even)
    bands, weights = band_weights(camera, fine.wavelengths, even)
    assert bands.tolist() == [450e-9, 540e-9, 650e-9]
    np.testing.assert_allclose(weights.sum(axis=0), fine.photons)


def placed(rest):
    """The camera with another place for its filters, by what takes the place of the layout."""
    return described(BAND, BAND.replace("540", "650")).replace("layout = [1, 2]", rest)


def sector(first, last, count=40):
    """Corners of a sector that reaches beyond the pupil, as text."""
    angles = np.linspace(first, last, count)
    corners = [(0.0, 0.0), *((10 * np.sin(t), 10 * np.cos(t)) for t in angles)]
    return "[" + ", ".join(f'["{y:.6f} mm", "{x:.6f} mm"]' for y, x in corners) + "]"


def outlined(*polygons):
    filters = [
        f'{{ center = "{nm} nm", fwhm = "30 nm", polygon = {polygon} }}'
        for nm, polygon in zip((450, 540, 650), polygons)
    ]
    text = described("A", "B").replace("layout = [1, 2]\n", "").replace('"square"', '"circle"')
    return text.replace("[A, B]", "[" + ",\n".join(filters) + "]")


def test_a_drawing_is_the_layout_that_it_draws(tmp_path):
    from PIL import Image

    cells = filter_cells(parse_camera(placed("layout = [1, 2]")), 540e-9)
    drawn = parse_camera(placed('drawing = ["1122", "1122", "1122"]'))
    np.testing.assert_allclose([c for c, _ in filter_cells(drawn, 540e-9)], [c for c, _ in cells])
    assert parse_camera(to_toml(drawn)) == drawn
    picture = np.repeat([[90, 90, 0, 255]], 4, axis=0).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "cells.png")
    (tmp_path / "camera.toml").write_text(placed('drawing = "cells.png"'))
    assert load_camera(tmp_path / "camera.toml").filter_array.drawing == ("11.2",) * 4
    # places of one filter need not hang together, and none is counted twice
    ring = parse_camera(placed('drawing = ["1111", "1221", "12.1", "1111"]'))
    area = sum((y1 - y0) * (x1 - x0) for (y0, y1, x0, x1), _ in filter_cells(ring, 540e-9))
    assert area == pytest.approx(ring.filter_array.size**2 * 15 / 16)


def test_light_through_sectors_is_their_share_of_the_pupil():
    thirds = [sector(2 * np.pi * k / 3, 2 * np.pi * (k + 1) / 3) for k in range(3)]
    camera = parse_camera(
        outlined(*thirds).replace("[26, 26]", "[13, 13]").replace('"4 um"', '"8 um"')
    )
    clear = camera.model_copy(update={"filter_array": None})
    whole = uniform_response(clear, 540e-9, "ray", np.zeros((1, 2)))[0]
    lights = {
        nm: uniform_response(camera, nm * 1e-9, "ray", np.zeros((1, 2)))[0]
        for nm in (450, 540, 650)
    }
    for light in lights.values():
        assert light.sum() == pytest.approx(0.8 * whole.sum() / 3, rel=2e-3)
    # and it comes out on its own side: the second sector is to the left of the pupil, its light
    # right of the superpixel's middle, as the lenslet turns its picture around
    light = lights[540].reshape(13, 13)
    column = (light.sum(axis=0) @ np.arange(13)) / light.sum()
    assert column > 6 + 1.5


@pytest.mark.parametrize(
    "text, said",
    [
        (placed(""), "exactly one of layout, drawing and a polygon"),
        (placed('layout = [1, 2]\ndrawing = ["12"]'), "exactly one of"),
        (placed('drawing = ["12", "1"]'), "not of one length"),
        (placed('drawing = ["11"]'), "'2' is not in both"),
        (placed('drawing = ["123"]'), "'3' is not in both"),
        (placed('gap = "0.1 mm"\ndrawing = ["12"]'), "gap goes with layout"),
        (outlined(sector(0, 2), sector(1.5, 3)), "overlap"),
        (described("{ transmittance = 1, leak = 0.1 }"), "leak goes with polariser"),
    ],
)
def test_places_that_are_not_are_refused(text, said):
    with pytest.raises(ConfigError, match=said):
        filter_cells(parse_camera(text), 540e-9)


def test_polarisers_pass_their_state_and_leak_the_other():
    camera = parse_camera(
        described(
            '{ transmittance = 0.5, polariser = "0 deg", leak = 0.1 }',
            '{ transmittance = 1, polariser = "90 deg" }',
        )
    )
    assert shares(camera, 550e-9) == [0.5 * 1.1 / 2, 0.5]
    for state, seen in (("0 deg", [0.5, 0.0]), ("90 deg", [0.05, 1.0])):
        assert shares(camera.replace(**{"light.polarisation": state}), 550e-9) == seen
