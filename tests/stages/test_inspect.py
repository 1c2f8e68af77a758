"""inspect describes every kind of file, as text and as JSON, and refuses what a
stage would refuse.
"""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from plenocli.base.errors import InputError
from plenocli.cli.evaluation.inspect import command
from plenocli.cli.main import run
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.images.dng import write_dng
from plenocli.files.images.exr import write_exr
from plenocli.files.images.spectral_exr import write_spectral_exr
from plenocli.stages.evaluation.inspect import run_inspect


def inspect(path):
    """(dict from --json, text) of the command."""
    text = CliRunner().invoke(command, [str(path)], catch_exceptions=False)
    document = CliRunner().invoke(command, [str(path), "--json"], catch_exceptions=False)
    assert text.exit_code == document.exit_code == 0 and len(document.output.splitlines()) == 1
    return json.loads(document.output), text.output


ARTEFACTS = {
    "pif": {
        "pif/A": np.ones((1, 1, 4, 4)),
        "pif/wavelength": [5.5e-7],
        "pif/lenslet_offset": np.zeros((1, 2), int),
        "pif/pixel_shape": [2, 2],
        "pif/object_shape": [2, 2],
        "pif/column_energy": np.ones((1, 4)),
    },
    "capture": {
        "capture/mosaic": np.arange(6, dtype=np.uint16).reshape(2, 3),
        "capture/cfa": "GRBG",
    },
    "calibration": {
        "grid/centre": np.ones((2, 2, 2)),
        "grid/valid": np.ones((2, 2), bool),
    },
    "spectra": {"spectra/value": np.ones((2, 2, 2)), "spectra/wavelength": [4e-7, 5e-7]},
    "dictionary": {"dictionary/atoms": np.eye(3), "dictionary/history/objective": np.arange(3.0)},
    "image": {"image/value": np.ones((3, 3))},
}


@pytest.mark.parametrize("kind", ARTEFACTS)
def test_every_kind_of_artefact(tmp_path, kind):
    origin = Provenance(
        command="plenocli something",
        inputs={"in": {"name": "in.h5", "sha256": "ab" * 32}},
        seed=5,
        config="config",
        accuracy={"asked": 1e-3},
    )
    write_artefact(tmp_path / "x.h5", Artefact(kind, ARTEFACTS[kind], provenance=origin))
    document, text = inspect(tmp_path / "x.h5")
    assert (
        document["kind"] == kind
        and document["seed"] == 5
        and document["inputs"]["in"]["name"] == "in.h5"
        and document["verified"]
    )
    for name, values in ARTEFACTS[kind].items():
        assert f"/{name}" in text and name in document["datasets"]
        if not isinstance(values, str):
            assert document["datasets"][name]["shape"] == list(np.shape(values))


def test_dng_shows_size_filter_levels_and_exposure(tmp_path):
    values = np.random.default_rng(0).integers(100, 4000, (30, 24)).astype(np.uint16)
    write_dng(
        tmp_path / "x.dng",
        values,
        cfa="GRBG",
        black=[[64, 65], [66, 67]],
        white=4095,
        exposure_s=1 / 8,
        iso=100,
    )
    document, text = inspect(tmp_path / "x.dng")
    assert (
        document["rows"],
        document["columns"],
        document["cfa"],
        document["white"],
        document["iso"],
    ) == (30, 24, "GRBG", 4095, 100)
    assert document["black"] == [[64, 65], [66, 67]] and document["exposure_s"] == pytest.approx(
        0.125
    )
    assert document["positions"]["R (0, 1)"]["max"] == values[::2, 1::2].max()
    for fragment in ("30 x 24", "GRBG", "64 65 / 66 67", "4095 DN", "0.125 s"):
        assert fragment in text


def test_exr_spectral_exr_and_png(tmp_path):
    write_exr(tmp_path / "x.exr", {"Y": np.full((3, 4), 2.0)}, {"note": "hello"})
    document, text = inspect(tmp_path / "x.exr")
    assert (
        document["type"] == "exr" and document["channels"]["Y"]["mean"] == 2.0 and "hello" in text
    )
    write_spectral_exr(tmp_path / "s.exr", [4.5e-7, 6.5e-7], np.ones((2, 3, 4)))
    document, text = inspect(tmp_path / "s.exr")
    assert document["quantity"] == "reflectance" and "2 bands, 450 to 650 nm" in text


def test_nikon_d1(shared_data):
    document, text = inspect(shared_data / "raw" / "nikon_d1.NEF")
    assert (document["rows"], document["columns"], document["cfa"], document["white"]) == (
        1324,
        2012,
        "BGGR",
        4095,
    )
    assert document["exposure_s"] == pytest.approx(1 / 250) and "NIKON D1" in document["camera"]
    assert "no digest" in text


def test_pictures_and_refusals(shared_data, capsys):
    document, _ = inspect(shared_data / "plenoptic" / "letters" / "letters_ULF_M1_white.png")
    assert (
        document["type"] == "png"
        and document["bits"] == 8
        and document["channels"]["Y"]["max"] == 217
    )
    assert run(["inspect", str(shared_data / "raw" / "no_cfa" / "kodak_c330_yrgb.raw")]) == 3
    assert "not a colour filter mosaic" in capsys.readouterr().err


def test_a_file_that_is_nothing_known_is_refused(tmp_path):
    (tmp_path / "x.bin").write_bytes(b"anything" * 100)
    with pytest.raises(InputError, match="not a RAW file that LibRaw knows"):
        run_inspect(tmp_path / "x.bin")
