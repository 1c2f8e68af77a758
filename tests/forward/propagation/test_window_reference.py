"""The faster brute-force reference against the plainer one."""

import numpy as np
import pytest

from tests.forward.propagation.cameras import WAVELENGTH, small_camera
from tests.reference.fresnel import disc_nodes, pixel_energies
from tests.reference.window import column_energies


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"main_lens__aperture_shape": "square"},
        {"main_lens__aperture_shape": "annulus", "main_lens__obscuration": 0.4},
        {
            "object__distance": 0.53,
            "sensor__distance": 225e-6,
            "lenslet_array__fill_factor": 0.9,
            "sensor__pixel_fill_factor": 0.7,
        },
    ],
    ids=str,
)
def test_both_references_agree(change):
    camera = small_camera(**change)
    radius = camera.main_lens.aperture_diameter / 2
    pupil = (
        disc_nodes(radius, 40, 128, inner=0.4 * radius)
        if "main_lens__obscuration" in change
        else None
    )
    point = (-9e-6, 3e-6)
    lenslets = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1)]
    found = column_energies(camera, WAVELENGTH, point, 1, [(0, 0), (0, 1)], pixel_nodes=7)
    for (row, column), energy in found.items():
        centre = (row * camera.superpixel_pitch, column * camera.superpixel_pitch)
        truth = pixel_energies(
            camera,
            WAVELENGTH,
            point,
            lenslets,
            centre,
            pupil=pupil,
            pupil_nodes=(40, 128),
            lenslet_nodes=60,
            pixel_nodes=7,
        )
        assert np.linalg.norm(energy - truth) < 1e-10 * np.linalg.norm(truth)
    alone = column_energies(camera, WAVELENGTH, point, None, [(0, 0)], pixel_nodes=7)[0, 0]
    truth = pixel_energies(
        camera,
        WAVELENGTH,
        point,
        [(0, 0)],
        (0, 0),
        pupil=pupil,
        pupil_nodes=(40, 128),
        lenslet_nodes=60,
        pixel_nodes=7,
    )
    assert np.linalg.norm(alone - truth) < 1e-10 * np.linalg.norm(truth)
