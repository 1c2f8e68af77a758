import numpy as np
import pytest

from pipelines.make_tables import collect
from plenocli.base.errors import ConfigError
from plenocli.forward.scene import tables


def test_the_frozen_file_equals_colour_science():
    live, frozen = collect(), tables._tables()
    assert list(live) == list(frozen)
    for key, value in live.items():
        np.testing.assert_array_equal(frozen[key], value, err_msg=key)


def test_the_chart_has_the_patches_everyone_knows():
    names, wavelengths, reflectance = tables.colorchecker()
    assert len(names) == 24 and reflectance.shape == (24, wavelengths.size)
    assert wavelengths[0] == pytest.approx(380e-9) and wavelengths[-1] == pytest.approx(780e-9)
    at = {w: tables.colorchecker([w * 1e-9])[2][:, 0] for w in (450, 550, 650)}
    white, red, blue = (tables.patch_index(n) for n in ("white", "red", "blue"))
    assert 0.85 < at[550][white] < 0.95 and at[550][tables.patch_index("black")] < 0.04
    assert at[650][red] > 10 * at[450][red] and at[450][blue] > 5 * at[550][blue]
    assert [tables.patch_index(n) for n in tables.SIX_PATCHES] == [18, 23, 14, 6, 13, 12]


def test_interpolation_is_linear_and_ends_hold():
    _, own, table = tables.colorchecker()
    middle = tables.colorchecker((own[:-1] + own[1:]) / 2)[2]
    np.testing.assert_allclose(middle, (table[:, :-1] + table[:, 1:]) / 2, rtol=1e-12)
    np.testing.assert_array_equal(tables.colorchecker([300e-9, 900e-9])[2], table[:, [0, -1]])


def test_the_table_cannot_be_changed_by_a_caller():
    tables.colorchecker()[2][:] = 0
    tables.observer()[1][:] = 0
    assert tables.colorchecker()[2].max() > 0.8 and tables.observer()[1].max() > 1


def test_illuminant_a_is_a_blackbody_of_2856_kelvin():
    # CIE 15: A = 100 (560/l)^5 expm1(1.435e7/(2848 x 560)) / expm1(1.435e7/(2848 l)), l in nm
    l = np.arange(400, 781, 20.0)
    cie = (560 / l) ** 5 * np.expm1(1.435e7 / (2848 * 560)) / np.expm1(1.435e7 / (2848 * l))
    np.testing.assert_allclose(tables.illuminant("A", l * 1e-9), cie, rtol=2e-5)
    np.testing.assert_allclose(tables.illuminant("2855.5 K", l * 1e-9), cie, rtol=1e-3)


def test_blackbody_follows_wien():
    wavelengths = np.linspace(400e-9, 1500e-9, 11001)
    peak = wavelengths[np.argmax(tables.blackbody(3200, wavelengths))]
    assert peak == pytest.approx(2.897771955e-3 / 3200, abs=1e-10)


@pytest.mark.parametrize("name", ["A", "D50", "D65", "E", "3200 K", "3200K"])
def test_relative_power_is_one_at_560_nm(name):
    assert tables.illuminant(name, [560e-9])[0] == pytest.approx(1, abs=1e-15)


def test_sensitivities_peak_in_their_colour_and_vanish_outside():
    wavelengths = np.arange(300, 1001) * 1e-9
    for name in tables.camera_names():
        curves = tables.camera_sensitivity(name, wavelengths)
        assert set(curves) == set("RGB")
        blue, green, red = (wavelengths[curves[letter].argmax()] for letter in "BGR")
        assert blue < 500e-9 < green < red < 680e-9
        for curve in curves.values():
            assert curve.min() == 0 and curve.max() == pytest.approx(1)
            assert not curve[wavelengths < 379e-9].any() and not curve[wavelengths > 781e-9].any()


@pytest.mark.parametrize(
    "call, said",
    [
        (lambda: tables.illuminant("D56", [550e-9]), "D50"),
        (lambda: tables.illuminant("3 K", [550e-9]), "3200 K"),
        (lambda: tables.camera_sensitivity("Nikon", [550e-9]), "Nikon 5100 (NPL)"),
        (lambda: tables.patch_index("mauve"), "magenta"),
    ],
)
def test_unknown_names_are_answered_with_the_known_ones(call, said):
    with pytest.raises(ConfigError) as error:
        call()
    assert said in str(error.value)


def test_nanometres_are_refused():
    with pytest.raises(ValueError, match="metres"):
        tables.illuminant("D65", [550.0])
