import warnings

import numpy as np
import pytest

from plenocli.forward.scene import colour
from plenocli.forward.scene.tables import colorchecker


@pytest.fixture(scope="module")
def reference():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour as library
    return library


@pytest.mark.parametrize("light", ["D65", "A", "D50"])
def test_white_points_are_the_published_ones(light):
    # ASTM E308
    published = {
        "D65": (0.95047, 1, 1.08883),
        "A": (1.09850, 1, 0.35585),
        "D50": (0.96422, 1, 0.82521),
    }
    np.testing.assert_allclose(colour.white_point(light), published[light], atol=3e-4)


def test_xyz_of_the_chart_agrees_with_colour_science(reference):
    names, wavelengths, reflectance = colorchecker()
    ours = colour.xyz(wavelengths, reflectance, "D65")
    for name, value in zip(names, ours, strict=True):
        sd = reference.SDS_COLOURCHECKERS["ColorChecker N Ohta"][name]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it says that it aligns its tables
            theirs = reference.sd_to_XYZ(sd, illuminant=reference.SDS_ILLUMINANTS["D65"]) / 100
        np.testing.assert_allclose(value, theirs, atol=5e-4)


def test_flat_surfaces_are_grey_for_any_number_of_bands():
    for bands in ([550], [450, 650], [450, 540, 570, 650], range(400, 701, 10)):
        cube = np.full((len(bands), 2, 3), 0.4)
        for light in ("A", "D65", "3200 K"):
            np.testing.assert_allclose(
                colour.preview_rgb(np.array(bands) * 1e-9, cube, light), 0.4, rtol=1e-5
            )


def test_four_bands_show_the_chart_in_recognisable_colours():
    wavelengths = np.array([450, 540, 570, 650]) * 1e-9
    names, _, coarse = colorchecker(wavelengths)
    _, own, fine = colorchecker()
    white = colour.white_point("D65")
    error = colour.delta_e_2000(
        colour.lab(colour.xyz(wavelengths, coarse), white), colour.lab(colour.xyz(own, fine), white)
    )
    assert np.median(error) < 6 and error.max() < 20
    rgb = dict(
        zip(names, colour.preview_rgb(wavelengths, coarse.T[:, :, None])[..., 0].T, strict=True)
    )
    assert [int(np.argmax(rgb[n])) for n in ("red", "green", "blue")] == [0, 1, 2]


def test_adaptation_moves_white_to_white():
    a, d65 = colour.white_point("A"), colour.white_point("D65")
    np.testing.assert_allclose(colour.adapt(a, a, d65), d65, rtol=1e-12)
    np.testing.assert_allclose(colour.linear_srgb(a, a), 1, rtol=1e-12)


def test_linear_srgb_agrees_with_colour_science(reference):
    values = np.random.default_rng(5).random((50, 3)) * 0.8
    theirs = reference.XYZ_to_sRGB(values, apply_cctf_encoding=False)
    np.testing.assert_allclose(colour.linear_srgb(values), theirs, atol=2e-3)
    ramp = np.linspace(0, 1, 101)
    np.testing.assert_allclose(
        colour.encode_srgb(ramp), reference.models.eotf_inverse_sRGB(ramp), atol=1e-6
    )


def test_lab_agrees_with_colour_science(reference):
    values = np.vstack([np.random.default_rng(6).random((50, 3)), [[1e-4, 2e-4, 0]]])
    xy = np.array([0.3127, 0.3290])
    white = np.array([xy[0] / xy[1], 1, (1 - xy.sum()) / xy[1]])
    np.testing.assert_allclose(
        colour.lab(values, white), reference.XYZ_to_Lab(values, xy), atol=1e-9
    )


def test_delta_e_gives_the_published_test_pairs():
    # Sharma, Wu and Dalal 2005, table 1 (pairs 1, 4, 7, 9, 10, 11, 16, 17, 21, 25, 34)
    pairs = [
        (50, 2.6772, -79.7751, 50, 0, -82.7485, 2.0425),
        (50, -1.3802, -84.2814, 50, 0, -82.7485, 1.0000),
        (50, 0, 0, 50, -1, 2, 2.3669),
        (50, 2.49, -0.001, 50, -2.49, 0.0009, 7.1792),
        (50, 2.49, -0.001, 50, -2.49, 0.0010, 7.1792),
        (50, 2.49, -0.001, 50, -2.49, 0.0011, 7.2195),
        (50, 2.5, 0, 50, 0, -2.5, 4.3065),
        (50, 2.5, 0, 73, 25, -18, 27.1492),
        (50, 2.5, 0, 50, 3.1736, 0.5854, 1.0000),
        (60.2574, -34.0099, 36.2677, 60.4626, -34.1751, 39.4387, 1.2644),
        (2.0776, 0.0795, -1.1350, 0.9033, -0.0636, -0.5514, 0.9082),
    ]
    table = np.array(pairs)
    np.testing.assert_allclose(
        colour.delta_e_2000(table[:, :3], table[:, 3:6]), table[:, 6], atol=1e-4
    )
    np.testing.assert_allclose(
        colour.delta_e_2000(table[:, 3:6], table[:, :3]), table[:, 6], atol=1e-4
    )


def test_delta_e_agrees_with_colour_science(reference):
    rng = np.random.default_rng(7)
    first, second = ((rng.random((2000, 3)) * [100, 160, 160]) - [0, 80, 80] for _ in range(2))
    np.testing.assert_allclose(
        colour.delta_e_2000(first, second), reference.delta_E(first, second, "CIE 2000"), atol=1e-9
    )
