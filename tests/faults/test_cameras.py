"""Cameras at the edges of physics: a matrix whose energy is sound, or a refusal with the number
that decided; never nonsense.
"""

import itertools

import numpy as np
import pytest

from plenocli.files.artefacts.reading import read_artefact
from tests.faults.harness import is_clean_refusal

CAMERA = """
[main_lens]
focal_length = "{focal} mm"
f_number = {f_number}

[object]
distance = "{distance}"
samples_per_lenslet = [{points}, {points}]

[lenslet_array]
distance = "{image} mm"
superpixel_pitch = "{pitch} um"
focal_length = "{lenslet} um"
count = [{count}, {count}]

[sensor]
distance = "{sensor} um"
pixel_pitch = "{pixel} um"
pixels_per_lenslet = [{pixels}, {pixels}]

[light]
wavelengths = ["{wavelength}"]
"""
FOCAL, IMAGE = 50.0, 55.0


def camera(f_number, wavelength, points, pixels, pitch, distance="550 mm", count=1, defocus=1.0):
    """TOML of a camera whose lenslets have the main lens's F-number on the image
    side, as they should.
    """
    lenslet = pitch * IMAGE * f_number / FOCAL
    return CAMERA.format(
        focal=FOCAL,
        f_number=f_number,
        distance=distance,
        points=points,
        image=IMAGE,
        pitch=pitch,
        lenslet=lenslet,
        count=count,
        sensor=lenslet * defocus,
        pixel=pitch / pixels,
        pixels=pixels,
        wavelength=wavelength,
    )


EDGES = [
    dict(f_number=f, wavelength=w, points=p, pixels=n, pitch=pitch)
    for f, w, p, n, pitch in itertools.product(
        (1, 2.8, 64), ("200 nm", "550 nm", "12 um"), (1, 2, 3), (1, 2, 3, 8), (5, 60)
    )
]
FAR = [
    dict(f_number=8, wavelength="550 nm", points=4, pixels=9, pitch=26, **more)
    for more in (
        {"distance": "1000 km"},
        {"distance": "51 mm"},
        {"distance": "5 m"},
        {"distance": "500 mm"},
        {"defocus": 0.01},
        {"defocus": 30},
        {"defocus": 1e-6},
        {"count": 300},
    )
]


def check(runner, folder, name, text):
    (folder / f"{name}.toml").write_text(text)
    command = [
        "simulate-pif",
        f"{name}.toml",
        "--superpixels",
        "1x1",
        "--coherent-ring",
        "0",
        "--accuracy",
        "0.02",
        "--mem-limit",
        "2GiB",
    ]
    planned = runner.run([*command, "--explain"], folder, limit=60)
    if planned.code != 0:
        assert is_clean_refusal(planned, (2, 5)) and any(c.isdigit() for c in planned.text), (
            text,
            planned,
        )
        return False
    done = runner.run([*command, "-o", f"{name}.h5"], folder, limit=300)
    if done.code != 0:
        assert is_clean_refusal(done, 5) and any(c.isdigit() for c in done.text), (text, done)
        return False
    A = read_artefact(folder / f"{name}.h5", "pif").data["pif/A"]
    assert np.isfinite(A).all() and A.min() >= 0 and 0 < A.sum(axis=-2).max() < 1.03, text
    return True


@pytest.mark.parametrize("places", ["apertures", "distances"])
def test_energy_is_sound_or_the_camera_is_refused(runner, tmp_path, campaign, count, places):
    cases = EDGES if places == "apertures" else FAR
    if places == "apertures":
        cases = [
            cases[i]
            for i in np.random.default_rng(2).permutation(len(cases))[: campaign(12, len(cases))]
        ]
    made = [
        check(runner, tmp_path, f"{places}{number}", camera(**case))
        for number, case in enumerate(cases)
    ]
    assert sum(made) >= len(made) // 4, f"{sum(made)} of {len(made)}"
    count(
        "cameras at the edges",
        computed_with_sound_energy=sum(made),
        refused_with_a_number=len(made) - sum(made),
    )


@pytest.mark.parametrize(
    "method",
    [
        "block-mean",
        # linear, as LMMSE is
        pytest.param("tikhonov", marks=pytest.mark.slow),
        pytest.param("tsvd", marks=pytest.mark.slow),
        "nnls",
        "lmmse",
        "auto",
    ],
)
def test_captures_of_nothing_of_one_value_and_of_saturation_give_numbers(
    runner, stages, tmp_path, count, method
):
    """All-zero, constant, and clipped captures: a picture without NaN, or a refusal."""
    from plenocli.files.artefacts.writing import write_artefact

    source, _ = stages
    (tmp_path / "pif.h5").symlink_to(source / "pif.h5")
    artefact = read_artefact(source / "capture.h5", "capture")
    values = artefact.data["capture/mosaic"]
    for name, changed in {
        "zero": values * 0,
        "constant": values * 0 + values.mean(),
        "clipped": np.minimum(values, 0.3 * values.max()),
        "tiny": values * 1e-30,
        "huge": values * 1e30,
        "largest": values.astype(float) / values.max() * 1e60,
        "hot": np.where(np.arange(values.size).reshape(values.shape) == 77, 1e6, 1) * values,
        "drowned": values
        + 100 * values.std() * np.random.default_rng(6).normal(size=values.shape),  # -40 dB
    }.items():
        artefact.data["capture/mosaic"] = changed.astype(
            float if name == "largest" else values.dtype
        )
        write_artefact(tmp_path / f"{name}.h5", artefact)
        outcome = runner.run(
            [
                "reconstruct",
                f"{name}.h5",
                "--pif",
                "pif.h5",
                "--method",
                method,
                "-o",
                f"{name}-out.h5",
            ],
            tmp_path,
            limit=120,
        )
        if outcome.code == 0:
            assert np.isfinite(
                read_artefact(tmp_path / f"{name}-out.h5", "image").data["image/value"]
            ).all()
        else:
            assert is_clean_refusal(outcome, (3, 5), name) or is_clean_refusal(outcome, 5), (
                name,
                outcome,
            )
        count(
            "captures at the edges, methods of reconstruct",
            pictures_without_nan=int(outcome.code == 0),
            refused=int(outcome.code != 0),
        )
