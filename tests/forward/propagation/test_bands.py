"""Bands of light as sums over wavelengths: the rule for their number, and the sums themselves."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from plenocli.base.errors import NumericsError
from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.camera.sections.light import Band
from plenocli.forward.propagation.bands import (
    band_fields,
    node_count,
    rule_error,
    spectral_error,
    spectral_nodes,
)
from plenocli.forward.propagation.models import model_named
from plenocli.forward.propagation.sampling import size_band
from plenocli.forward.propagation.system_matrix import PifBuilder
from tests.forward.propagation.cameras import small_camera
from tests.reference.window import column_energies


def band(fwhm, shape="gaussian", center=550e-9):
    return Band.model_validate(dict(center=center, fwhm=fwhm, shape=shape), context={"si": True})


def banded(fwhm, shape="gaussian", **changes):
    return small_camera(light={"band": dict(center=550e-9, fwhm=fwhm, shape=shape)}, **changes)


@pytest.mark.parametrize("shape", ["gaussian", "box"])
def test_nodes_have_the_mean_and_the_width_of_the_band(shape):
    wavelengths, shares = spectral_nodes(band(10e-9, shape), 7)
    assert (
        shares.sum() == pytest.approx(1)
        and np.all(np.diff(wavelengths) > 0)
        and shares @ wavelengths == pytest.approx(550e-9)
    )
    assert np.all(np.abs(wavelengths - 550e-9) < (15e-9 if shape == "gaussian" else 5e-9))
    # the tails that are cut off beyond 3.5 standard deviations hold 6e-3 of a Gaussian's variance
    variance, off = {"gaussian": (10e-9**2 / (8 * np.log(2)), 8e-3), "box": (10e-9**2 / 12, 1e-9)}[
        shape
    ]
    assert shares @ (wavelengths - 550e-9) ** 2 == pytest.approx(variance, rel=off)


@pytest.mark.parametrize("shape", ["gaussian", "box"])
def test_error_of_the_rule_is_that_of_integrals(shape):
    x, w = spectral_nodes(band(2.0e-9, shape), 3)
    phases = np.linspace(0, 3, 65)
    density = (
        (lambda t: np.exp(-np.log(2) * t * t))
        if shape == "gaussian"
        else (lambda t: float(abs(t) <= 1))
    )
    reach = 3 if shape == "gaussian" else 1
    whole = quad(density, -reach, reach)[0]
    worst = max(
        abs(
            np.cos(p * (x - 550e-9) / 1e-9) @ w
            - quad(lambda t: np.cos(p * t) * density(t), -reach, reach)[0] / whole
        )
        for p in phases
    )
    assert rule_error(shape, 3, 3.0) == pytest.approx(worst, rel=1e-6)


def brute(camera, count, window, point=(-9.7e-6, 3.2e-6)):
    nodes = spectral_nodes(camera.light.band, count)
    return sum(
        s * column_energies(camera, w, point, window, [(0, 0)], pixel_nodes=7)[0, 0]
        for w, s in zip(*nodes)
    )


@pytest.mark.parametrize("shape", ["gaussian", "box"])
@pytest.mark.parametrize(
    "fwhm, change, window",
    [(10e-9, {}, None), (60e-9, {}, None), (60e-9, {"object__distance": 0.52}, 1), (100e-9, {}, 1)],
)
def test_as_many_wavelengths_as_the_rule_says_keep_the_accuracy(fwhm, change, window, shape):
    """Doubled nodes change a column by no more than asked; the estimate is not wasteful either."""
    camera = banded(fwhm, shape, **change)
    view = geometry(camera, 550e-9)
    for accuracy in (1e-2, 1e-3, 1e-4):
        count = node_count(view, camera.light.band, accuracy, window)
        finer = brute(camera, 2 * count + 2, window)
        error = np.linalg.norm(brute(camera, count, window) - finer) / np.linalg.norm(finer)
        assert error < accuracy
        assert spectral_error(view, camera.light.band, count, window) < 300 * error


def test_bands_too_wide_are_refused():
    view = replace(geometry(small_camera(), 550e-9), D2=4e-3)
    with pytest.raises(NumericsError, match="wavelengths"):
        node_count(view, band(180e-9), 1e-9)


def planned(camera, nodes):
    shortest = geometry(camera, spectral_nodes(camera.light.band, nodes)[0][0])
    plan = plan_pif(camera, accuracy=1e-4, model="fresnel", superpixels=(3, 3), coherent_ring=1)
    sized = size_band(
        camera, shortest, plan.superpixels, plan.coherent_ring, 1e-4, plan.bands[0].spread_cut
    )
    return replace(plan, bands=(replace(sized, wavelength=550e-9),))


def band_matrix(camera, plan, nodes):
    """A (superpixel, pixel, point) summed wavelength by wavelength."""
    total = 0.0
    for wavelength, weight in zip(*spectral_nodes(camera.light.band, nodes)):
        line = replace(plan.bands[0], wavelength=float(wavelength))
        plan_of_line = replace(plan, band_nodes=0, bands=(line,))
        builder = PifBuilder(camera, float(wavelength), plan_of_line, dtype=plan.dtype)
        matrix = np.empty((*builder.shape, builder.points), plan.dtype)
        builder.fill(matrix)
        total = total + matrix * weight
    return total


def test_fields_of_a_band_are_the_weighted_sum_of_matrices():
    camera = banded(20e-9)
    plan = replace(planned(camera, 3), band_nodes=3)
    total = band_matrix(camera, plan, 3)
    maker = band_fields(
        model_named(plan.rung), camera, geometry(camera, 550e-9), plan, plan.bands[0]
    )
    points = np.array([0, 11, 36])
    out = np.empty((3, 3, 3, 13, 13), np.float32)
    maker.columns(points // 8, points % 8, out)
    assert maker.symmetry[:2] == (True, True) and maker.notes.band_nodes == 3
    expected = total[:, :, points].transpose(2, 0, 1).reshape(out.shape)
    assert np.abs(out - expected).max() < 1e-6 * expected.max()
    assert np.all(out.sum((1, 2, 3, 4)) <= maker.incident(points // 8, points % 8) + 1e-5)
    single = np.empty((3, 13, 13), np.float32)
    maker.on_superpixel(0, 2)(points // 8, points % 8, single)
    assert np.abs(single - out[:, 0, 2]).max() < 1e-6 * expected.max()


def test_a_line_is_a_band_without_width():
    camera = banded(1e-9)
    plan = planned(camera, 1)
    here = PifBuilder(camera, 550e-9, plan, dtype=np.float32)
    line = np.empty((*here.shape, here.points), np.float32)
    here.fill(line)
    assert np.array_equal(band_matrix(camera, plan, 1), line)
    wide = band_matrix(camera, planned(camera, 3), 3)
    assert 0 < np.linalg.norm(wide - line) < 1e-3 * np.linalg.norm(line)
