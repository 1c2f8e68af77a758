"""Superpixels with factors and nodes of their own, against the whole factors on one finer rule."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plenocli.files.config.camera_file import load_camera
from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.propagation.system_matrix import PifBuilder

CONFIGS = Path(__file__).resolve().parents[3] / "sample_configs"


@pytest.mark.parametrize(
    "config, superpixels, changes, accuracy",
    [
        # few points, 26 nodes in a pixel
        (
            "seed_spatial_250um",
            3,
            {"sensor.pixel_pitch": 20.8e-6, "sensor.pixels_per_lenslet": (12, 12)},
            3e-4,
        ),
        ("seed_spatial", 3, {}, 1e-4),
        # a blur of five lenslets: each of 49 superpixels may lose little
        ("seed_spatial", 7, {"object.distance": 0.3152}, 5e-4),
    ],
)
def test_columns_hold_beside_the_whole_factors(config, superpixels, changes, accuracy):
    camera = load_camera(CONFIGS / f"{config}.toml").replace(
        **{"object.samples_per_lenslet": (5, 5)} | changes
    )
    plan = plan_pif(
        camera, accuracy=accuracy, model="fresnel", superpixels=(superpixels, superpixels)
    )
    band = plan.bands[0]
    assert superpixels > 3 or band.beside and band.beside[0] < band.pixel_nodes
    fine = replace(
        plan,
        bands=(
            replace(
                band,
                pixel_nodes=band.pixel_nodes + 3,
                pixel_rule=0,
                beside=None,
                spread_cut=band.spread_cut / 10,
            ),
        ),
    )
    found = []
    for each in (plan, fine):
        builder = PifBuilder(camera, band.wavelength, each)
        assert builder.lenslets._cut is not None
        if each is fine:
            builder.lenslets._cut = None
        found.append(np.empty(each.shape[1:]))
        builder.fill(found[-1])
    errors = np.linalg.norm(found[0] - found[1], axis=(0, 1)) / np.linalg.norm(
        found[1], axis=(0, 1)
    )
    assert errors.max() < accuracy
