"""calibrate --response low-rank: one dim capture a band, cleaned by the low rank of all
lenslets' responses, against many of them.
"""

import numpy as np
import pytest

from plenocli.base.errors import NumericsError
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.forward.sensor.detector import SensorModel
from plenocli.stages.inverse.calibrate import run_calibrate
from plenocli.stages.inverse.demux import Settings, run_demux
from tests.reference.prototype import superpixels

# a pitch of broken pixels: every lenslet lies elsewhere within its own
ROWS, COLUMNS, PITCH, FRAME, EXTRA = 9, 12, 24.3, 6, 30
SENSOR = SensorModel(gain=0.25, read_noise=4.0, full_well=15000, bits=12, black_level=64)
BANDS = np.array([450e-9, 540e-9, 570e-9, 650e-9])
LIGHT = np.array([0.9, 1.0, 0.95, 0.8])


def electrons(radiance):
    """Mean electrons of the sensor for radiances (ROWS, COLUMNS, band) or
    (band,), at full exposure.
    """
    radiance = np.broadcast_to(radiance, (ROWS, COLUMNS, 4))
    mean = np.zeros([int(np.ceil(n * PITCH)) + 2 * FRAME for n in (ROWS, COLUMNS)])
    for row, column in np.ndindex(ROWS, COLUMNS):
        centre = (np.array([row, column]) + 0.5) * PITCH + FRAME - 0.5
        first = np.rint(centre - (EXTRA - 1) / 2).astype(int)
        response = superpixels(
            centre - first - (EXTRA - 1) / 2,
            pixels=EXTRA,
            side=20.5,
            gap=1.5,
            pitch=PITCH,
            fall=0.2,
        )
        mean[first[0] : first[0] + EXTRA, first[1] : first[1] + EXTRA] += 12000 * (
            response @ radiance[row, column]
        ).reshape(EXTRA, EXTRA)
    return mean


def save(path, mean, seed, exposure=1.0):
    values = SENSOR.expose(mean * exposure, np.random.default_rng(seed))
    known = dict(
        units="DN", black=64.0, white=4095.0, gain_e_per_dn=4.0, exposure_s=0.016 * exposure
    )
    write_artefact(
        path,
        Artefact("capture", {"capture/mosaic": values, "capture/cfa": "mono"}, {"capture": known}),
        overwrite=True,
    )
    return path


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("denoise")
    narrow = [electrons(np.eye(4)[k]) for k in range(4)]
    files = dict(
        whites=[save(folder / f"white{i}.h5", electrons(LIGHT), i) for i in range(2)],
        darks=[save(folder / f"dark{i}.h5", 0 * narrow[0], 10 + i) for i in range(2)],
    )
    # narrow-band light is dim: 1/32 of the exposure
    shots = [
        [
            (w, save(folder / f"band{k}-{i}.h5", narrow[k], 100 * k + 20 + i, 1 / 32))
            for k, w in enumerate(BANDS)
        ]
        for i in range(4)
    ]
    run_calibrate(folder / "one.h5", bands=shots[0], **files)
    run_calibrate(folder / "four.h5", bands=[pair for shot in shots for pair in shot], **files)
    run_calibrate(folder / "clean.h5", bands=shots[0], response="low-rank", **files)
    return folder, files, shots


def test_one_shot_denoised_does_what_four_do(bench):
    folder, _, _ = bench
    rng = np.random.default_rng(7)
    truth = rng.uniform(0.1, 0.9, (ROWS, COLUMNS, 4))
    capture = save(folder / "scene.h5", electrons(LIGHT * truth), 500)
    error = {}
    for name in ("one", "four", "clean"):
        run_demux(
            [capture],
            folder / "out.h5",
            calibration=folder / f"{name}.h5",
            settings=Settings(method="pinv", register="off"),
            overwrite=True,
        )
        found = np.moveaxis(
            read_artefact(folder / "out.h5", "spectra").data["spectra/value"], 0, -1
        )
        valid = np.isfinite(found).all(axis=-1)
        error[name] = np.sqrt(np.mean((found[valid] - (LIGHT * truth)[valid]) ** 2))
    assert valid.sum() > 60
    assert error["clean"] < 0.6 * error["one"] and error["clean"] < 1.1 * error["four"]


def test_what_was_done_is_said_and_the_noise_that_is_left(bench):
    folder, _, _ = bench
    one, clean = (read_artefact(folder / f"{name}.h5", "calibration") for name in ("one", "clean"))
    assert (
        "denoised to rank" in clean.attrs["response"]["notes"]["text"]
        and one.attrs["response"]["notes"]["response"] == "own"
    )
    # the variance of one dim frame: shot noise of the few electrons, read noise once
    k, level = 1, 0.25 * 12000
    bright = np.nanmax(np.nanmean(one.data["response/F"][one.data["grid/valid"]], axis=0)[:, k])
    expected = 0.25 * bright * 32 + (1 + 1 / 12) * 32**2
    assert bright > 0.5 * level and np.nanmax(
        one.data["response/covariance"][:, k]
    ) == pytest.approx(expected, rel=0.15)
    share = clean.data["response/covariance"] / one.data["response/covariance"]
    assert np.nanmax(share) < 0.3
    assert max(map(abs, clean.attrs["response"]["bias"])) < 0.3 * max(
        map(abs, one.attrs["response"]["bias"])
    )


def test_what_cannot_be_denoised_is_said(bench):
    folder, files, shots = bench
    for path in [*files["whites"], *(path for _, path in shots[0])]:
        artefact = read_artefact(path)
        del artefact.attrs["capture"]["gain_e_per_dn"]
        write_artefact(path, artefact, overwrite=True)
    with pytest.raises(NumericsError, match="noise of the captures is not known"):
        run_calibrate(
            folder / "never.h5", whites=files["whites"][:1], bands=shots[0], response="low-rank"
        )
