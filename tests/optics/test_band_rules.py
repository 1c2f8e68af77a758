"""Rules for pixels: they integrate a band of frequencies better than Gauss and Legendre's of as many nodes, and constants exactly."""

from dataclasses import replace

import numpy as np
import pytest

from plenocli.accuracy import plan_pif
from plenocli.errors import NumericsError
from plenocli.optics.pif import PifBuilder
from plenocli.optics.plan import pixel_error, pixel_nodes
from plenocli.optics.quadrature import RULE_STEP, band_rule, gauss
from tests.optics.cameras import small_camera


def worst(rule, cycles):
    """Largest error of the mean of cos(pi c t), whose value is sinc(c)."""
    nodes, weights = rule
    return np.abs(np.cos(np.pi * np.outer(cycles, nodes)) @ weights / 2 - np.sinc(cycles)).max()


@pytest.mark.parametrize("count, step, gain", [(3, 4, 3), (4, 4, 5), (5, 3, 10), (6, 5, 8), (7, 5, 9), (9, 6, 5), (12, 6, 10)])
def test_rules_of_a_band_beat_gauss_legendre_on_it(count, step, gain):
    cycles = np.linspace(0, RULE_STEP * step * count, 400)
    rule = band_rule(count, step)
    assert gain * worst(rule, cycles) < worst(gauss(count), cycles)
    nodes, weights = rule
    assert weights.sum() == pytest.approx(2, abs=1e-13) and weights.min() > 0 and np.abs(nodes).max() < 1
    assert nodes == pytest.approx(-nodes[::-1], abs=1e-15) and (np.diff(nodes) > 0).all()


def test_the_narrowest_band_is_gauss_legendre():
    assert band_rule(6) is gauss(6)


@pytest.mark.parametrize("own, joint, cells", [(1.96, 1.96, 102), (0.45, 2.2, 24), (8.5, 8.5, 102), (2, 10, 6)])
@pytest.mark.parametrize("accuracy", [1e-2, 1e-4, 1e-7])
def test_as_few_nodes_as_serve_are_taken(own, joint, cells, accuracy):
    light = own, joint, cells, 0.0
    count, rule = pixel_nodes(accuracy, *light)
    assert pixel_error(count, rule, *light) <= accuracy / 1.5
    assert count == 2 or pixel_error(count - 1, 0, *light) > accuracy / 1.5
    assert pixel_nodes(accuracy / 10, *light)[0] >= count


def test_pixels_of_too_many_fringes_are_refused():
    with pytest.raises(NumericsError, match="cannot be integrated"):
        pixel_nodes(1e-3, 300.0, 900.0, 50, 0.0)


@pytest.mark.parametrize("cells, pixels, blur, pupil, superpixels, ring, accuracy", [
    (280, 7, 0, "circle", 1, 0, 1e-2), (173, 12, 0, "square", 1, 0, 1e-3), (58, 1, 0, "circle", 3, 1, 1e-2), (112, 7, 0, "circle", 3, 1, 1e-2),
    (57, 3, 5, "circle", 7, 0, 1e-3), (20, 1, 1, "square", 3, 0, 1e-3), (13, 1, 3, "square", 5, 0, 1e-1), (34, 20, 3, "circle", 5, 0, 1e-4)])
def test_pixels_of_many_fringes_hold(cells, pixels, blur, pupil, superpixels, ring, accuracy):
    """Against rules that resolve every fringe: light much narrower than its lenslet's pixels, with sharp edges in them."""
    pitch, z2, f_number = 200e-6, 55e-3, 4.0
    focal = pitch * f_number
    distance = 1 / (1 / 50e-3 - 1 / z2 + blur * pitch / (z2 / f_number * z2))
    wavelength = pitch / (cells * f_number)
    camera = small_camera(main_lens__aperture_diameter=z2 / f_number, main_lens__aperture_shape=pupil, object__distance=distance, object__samples_per_lenslet=(5, 5),
                          lenslet_array__pitch=pitch / (1 + focal / z2), lenslet_array__focal_length=focal, sensor__distance=focal, sensor__pixel_pitch=pitch / pixels,
                          sensor__pixels_per_lenslet=(pixels, pixels), light__wavelengths=(wavelength,), light__design_wavelength=wavelength)
    plan = plan_pif(camera, model="fresnel", superpixels=(superpixels, superpixels), coherent_ring=ring, accuracy=accuracy)
    band, found = plan.bands[0], []
    assert band.pixel_nodes < 2 * cells / pixels + 30
    many = max(band.pixel_nodes + 4, int(2 * cells / pixels + 10))
    for each in (plan, replace(plan, tolerance=plan.tolerance / 10, bands=(replace(band, pixel_nodes=many, pixel_rule=0, beside=None),))):
        found.append(np.empty(plan.shape[1:]))
        PifBuilder(camera, wavelength, each).fill(found[-1])
    errors = np.linalg.norm(found[0] - found[1], axis=(0, 1)) / np.linalg.norm(found[1], axis=(0, 1))
    assert errors.max() < accuracy
