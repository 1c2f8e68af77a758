"""Overlapping filters: superpixels of even objects in the light of many wavelengths, against the
mean of reflectance over what each filter passes.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import plenocli.api as pc
from plenocli.files.results.truths import through_filters
from plenocli.forward.propagation.response import uniform_response
from plenocli.forward.scene.light import broadband
from plenocli.forward.scene.tables import illuminant
from plenocli.forward.sensor.frames import Dark
from plenocli.inverse.spectra.bands import by_filter
from plenocli.inverse.spectra.demultiplexer import Demultiplexer
from plenocli.inverse.spectra.neighbours import MovingResponse, neighbour_light
from plenocli.inverse.spectra.responses import LensletResponses
from tests.reference.calibrations import lenslet_responses

SAMPLES = Path(__file__).resolve().parents[3] / "sample_configs"
SHAPE = (2, 3)
LAMPS = np.array([0.4, 1.7, 0.9, 2.5])
"""Strengths of the lamps of the narrow bands."""


def reflectance(wavelengths):
    """Smooth steps (object, wavelength), as many as lenslets."""
    rng = np.random.default_rng(6)
    middle, width = rng.uniform(430e-9, 670e-9, (6, 1)), rng.uniform(8e-9, 40e-9, (6, 1))
    steps = 1 / (1 + np.exp((middle - np.asarray(wavelengths)) / width))
    return 0.1 + 0.8 * np.where(np.arange(6)[:, None] % 2, steps, 1 - steps)


@cache
def seen(fwhm, blocking=1e-3):
    """(camera, calibration in narrow bands, superpixels of the objects) of four filters."""
    camera = pc.read_camera(SAMPLES / "seed_spectral.toml")
    known = {"fwhm": fwhm, "blocking": blocking}
    filters = [one.model_copy(update=known) for one in camera.filter_array.filters]
    camera = camera.replace(
        **{
            "filter_array.filters": filters,
            "lenslet_array.count": SHAPE,
            "sensor.pixels_per_lenslet": (20, 20),
            "sensor.pixel_pitch": 5.2e-6,
        }
    )
    light = broadband(camera, lambda w: illuminant("D65", w), 4e-9)
    columns = np.array([uniform_response(camera, w, "fresnel")[0] for w in light.wavelengths])
    shots = (reflectance(light.wavelengths) * light.photons) @ columns
    bands = np.array(camera.light.wavelengths)
    f = np.stack([uniform_response(camera, w, "fresnel")[0] for w in bands], axis=1) * LAMPS
    calibration = lenslet_responses(
        f,
        bands,
        np.ones(SHAPE, bool),
        dark=Dark(mean=np.zeros((40, 60)), black=np.zeros((2, 2)), exposure=None, sigma=0.1),
        centres=20 * np.stack(np.indices(SHAPE), axis=-1) + 9.5,
        white=np.broadcast_to(light.photons @ columns, (*SHAPE, 400)),
        origin=20 * np.stack(np.indices(SHAPE), axis=-1),
        window=(20, 20),
    ).calibration
    return camera, calibration, shots


def answers(calibration, shots):
    """Reflectance (object, band) by least squares, of the white one."""
    back = np.linalg.pinv(calibration.response.matrix)
    return (shots @ back.T) / (back @ calibration.white.superpixels[0, 0])


@pytest.mark.parametrize("fwhm", [35e-9, 45e-9])
def test_bands_are_what_filters_let_through(fwhm):
    camera, calibration, shots = seen(fwhm)
    bands = calibration.response.wavelengths
    truth = through_filters(lambda w: reflectance([w]).T, camera, bands)[:, 0].T
    found = by_filter(calibration, camera)
    error, before = (np.abs(answers(one, shots) - truth) for one in (found, calibration))
    assert before.max() > 0.02 and error.max() < before.max() / 20 and error.max() < 0.002
    # a column has the light of its own filter, a quarter of the superpixel
    dark = np.sort(found.response.matrix, axis=0)[:250]
    assert np.abs(dark).max() < 0.03 * found.response.matrix.max()
    # in lenslets of their own, too
    each = np.broadcast_to(calibration.response.matrix, (*SHAPE, 400, 4))
    own = by_filter(
        replace(calibration, response=replace(calibration.response, matrix=each)), camera
    )
    np.testing.assert_allclose(own.response.matrix[1, 2], found.response.matrix, atol=1e-8)


def test_bands_stay_where_filters_do_not_overlap_or_are_not_theirs():
    camera, calibration, _ = seen(8e-9, 0.0)
    broad, overlapping, _ = seen(45e-9)
    assert by_filter(calibration, camera) is calibration
    assert by_filter(overlapping, None) is overlapping
    clear = broad.replace(
        **{"filter_array.filters": [*broad.filter_array.filters[:3], {"transmittance": 1.0}]}
    )
    assert by_filter(overlapping, clear) is overlapping
    moved = replace(
        overlapping.response, wavelengths=overlapping.response.wavelengths + [0, 0, 0, 60e-9]
    )
    others = replace(overlapping, response=moved)
    assert by_filter(others, broad) is others
    for ratio in (True, False):
        solver = Demultiplexer(overlapping, method="pinv", camera=broad, ratio=ratio)
        assert (solver.responses.calibration.response.mixture is not None) == ratio


def test_neighbours_light_and_moved_responses_are_by_filter():
    """As of bands: their sums are what lenslets of the same filters make."""
    camera, calibration, _ = seen(45e-9)
    mixed = by_filter(calibration, camera)
    f = LensletResponses.of(mixed).common
    moving, plain = (MovingResponse(camera, one) for one in (mixed, calibration))
    np.testing.assert_allclose(moving.at(np.zeros(2)), f, atol=1e-4 * f.max())
    shift = np.array([0.3, -0.2])
    expected = plain.at(shift) @ mixed.response.mixture
    np.testing.assert_allclose(moving.at(shift), expected, atol=1e-4 * f.max())
    light = neighbour_light(camera, mixed)
    total = np.einsum("opmk,m->pk", light.light, light.modes.even)
    assert np.linalg.norm(total - f) < 0.05 * np.linalg.norm(f)
    assert (0.01 < light.share).all() and (light.share < 0.2).all()
