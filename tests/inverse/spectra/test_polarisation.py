"""Scenes whose light is polarised in part, seen through filters that polarise."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import plenocli.api as pc
from plenocli.base.errors import UsageError
from plenocli.forward.camera.pupil import polarisations
from plenocli.forward.propagation.response import uniform_response
from plenocli.forward.scene.light import Quadrature, narrow_band
from plenocli.forward.scene.scenes import Polarised, Uniform
from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE
from plenocli.forward.sensor.exposure.matrices import StoredMatrix
from plenocli.forward.sensor.exposure.options import ExposureOptions
from plenocli.forward.sensor.exposure.simulate import simulate_capture
from plenocli.inverse.calibration.measure import NarrowBands, calibrate
from plenocli.inverse.spectra.bands import by_state, stokes
from plenocli.inverse.spectra.demultiplexer import Demultiplexer

SAMPLES = Path(__file__).resolve().parents[3] / "sample_configs"
COUNT = (8, 9)
LEVEL = 0.55


class Grey:
    """The same reflectance everywhere, as a picture."""

    spectral = False

    def at(self, wavelength, rows, columns, part=slice(None)):
        return np.full((rows, columns), LEVEL, np.float32)[part]


@pytest.fixture(scope="module")
def camera():
    # at half the aperture there are half as many diffraction cells to sample
    found = pc.read_camera(SAMPLES / "polarised.toml").replace(
        **{
            "lenslet_array.count": COUNT,
            "main_lens.aperture_diameter": 55e-3 / 16,
            "filter_array.size": 3e-3,
            "filter_array.gap": 0.1e-3,
            "lenslet_array.focal_length": 1664e-6,
            "lenslet_array.superpixel_pitch": None,
            "sensor.distance": 1664e-6,
        }
    )
    pitch = 104e-6 / (1 + found.sensor.distance / found.lenslet_array.distance)
    return found.replace(**{"lenslet_array.pitch": pitch})


@pytest.fixture(scope="module")
def shoot(camera):
    """shoot(scene, source, seed, exposure): by a camera of finer fields whose filters are a little
    larger than described.
    """
    real = camera.replace(
        **{
            "object.samples_per_lenslet": (18, 18),
            "filter_array.size": camera.filter_array.size * 1.003,
        }
    )
    light = Quadrature(np.array(real.light.wavelengths), np.ones(len(real.light.wavelengths)))

    def shot(scene, source=light, seed=0, exposure=1.0):
        options = ExposureOptions(
            model="fresnel",
            superpixels=(3, 3),
            seed=seed,
            exposure=exposure * camera.light.white_exposure,
        )
        return simulate_capture(real, source, scene, options).capture

    return shot


@pytest.fixture(scope="module")
def calibration(camera, shoot):
    """Measured under light of either polarisation."""

    def lit(degree):
        return lambda w: [
            shoot(
                Polarised(Uniform(REFERENCE_REFLECTANCE), np.array([[degree]]), "fit"),
                narrow_band(w, 0.0),
                round(w * 1e9) + n,
                0.5,
            )
            for n in range(3)
        ]

    return calibrate(
        [shoot(Uniform(REFERENCE_REFLECTANCE), seed=1)],
        darks=[shoot(Uniform(0.0), seed=2)],
        bands=NarrowBands(
            wavelengths=camera.light.wavelengths, captures=lit(1.0), across=lit(-1.0)
        ),
        camera=camera,
    ).calibration


@pytest.fixture(scope="module")
def solver(camera, calibration):
    return Demultiplexer(calibration, camera=camera, ratio=True)


@pytest.fixture(scope="module")
def white(solver, shoot):
    return solver.estimate(shoot(Uniform(REFERENCE_REFLECTANCE), seed=3), "white", "pinv")


def board(seed):
    """A degree of polarisation for every lenslet, (row, column, 1)."""
    return np.random.default_rng(seed).uniform(-0.9, 0.9, (*COUNT, 1))


@pytest.mark.parametrize("method", ["auto", "pinv"])
def test_every_lenslets_polarisation_is_found(camera, solver, white, shoot, method):
    degree = board(4)
    found = solver.estimate(shoot(Polarised(Grey(), degree, "fit"), seed=5), "shot", method)
    found = stokes(found.relative_to(white, REFERENCE_REFLECTANCE))
    inner = (slice(None), slice(1, -1), slice(1, -1))
    s0 = found.value[inner] - LEVEL
    s1 = found.s1[inner] - LEVEL * np.moveaxis(degree, 2, 0)[inner]
    assert found.states is None and list(found.wavelength) == list(camera.light.wavelengths)
    assert np.sqrt((s0**2).mean()) < (0.006 if method == "auto" else 0.03)
    assert np.sqrt((s1**2).mean()) < (0.006 if method == "auto" else 0.03)
    if method == "auto":
        z = s1 / found.s1_sigma[inner]
        assert 0.4 < np.sqrt((z**2).mean()) < 2


def test_light_without_polarisation_has_none(solver, white, shoot):
    found = solver.estimate(shoot(Grey(), seed=6), "shot", "pinv").relative_to(
        white, REFERENCE_REFLECTANCE
    )
    found = stokes(found)
    assert np.abs(found.s1 / found.s1_sigma).mean() < 1.5 and np.abs(found.s1).max() < 0.01


def test_the_predicted_response_is_the_measured_one(camera, calibration):
    along, across = polarisations(camera)
    measured = by_state(calibration).response
    assert list(measured.states) == [0, 0, 90, 90]
    for column, (seen, w) in enumerate(
        [(one, w) for one in (along, across) for w in camera.light.wavelengths]
    ):
        f, g = uniform_response(seen, w, "fresnel")[0], measured.matrix[:, column]
        assert f @ g / np.linalg.norm(f) / np.linalg.norm(g) > 0.999


def test_a_band_that_no_polariser_tells_apart_is_one_of_all_light(camera, calibration):
    response = calibration.response
    same = np.zeros_like(response.polarised)
    same[:, 1] = response.polarised[:, 1]
    mixed = by_state(replace(calibration, response=replace(response, polarised=same))).response
    assert list(mixed.states[:2]) == [0, 90] and np.isnan(mixed.states[2])
    assert np.allclose(mixed.matrix[:, 2], response.matrix[:, 0])
    assert np.allclose(mixed.wavelengths, np.array(camera.light.wavelengths)[[1, 1, 0]])


def test_unpolarised_light_is_the_mean_of_both_and_stored_matrices_are_refused(camera, shoot):
    whole, *parts = (
        pc.system_matrix(one, model="fresnel", wavelengths=[450e-9], superpixels=(1, 1)).A
        for one in (camera, *polarisations(camera))
    )
    assert np.allclose(whole, (parts[0] + parts[1]) / 2, atol=1e-6 * whole.max())
    # crossed cells stay dark but for the leak
    assert (parts[0] * parts[1]).sum() < 0.2 * (parts[0] ** 2).sum()
    scene = Polarised(Grey(), np.array([[0.5]]), "fit")
    stored = {450e-9: StoredMatrix(whole[0], np.zeros((1, 2), int))}
    with pytest.raises(UsageError, match="not polarised"):
        simulate_capture(camera, narrow_band(450e-9), scene, ExposureOptions(), matrices=stored)
