"""Artefacts with a seal that holds and content that cannot be: whoever computes the digest anew
must meet the tables too. Refused by name, exit 3; nothing is taken for a bug.
"""

import hashlib
import io
import shutil

import h5py
import numpy as np
import pytest

from tests.faults.harness import is_clean_refusal

MAGIC = b"plenocli artefact 1\n"
DEMUX = "demux colorchecker.dng --calibration X --reference white.dng -o o.h5"
RECONSTRUCT = "reconstruct X --pif pif.h5 --method tikhonov -o o.h5"
BY_DICTIONARY = "reconstruct capture.h5 --pif pif.h5 --method dictionary --dictionary X -o o.h5"
SIMULATE = "capture-sim camera.toml --pif X --scene photo.png -o o.h5"
RESUME = "learn-dict photo.png --pif pif.h5 --resume X --iterations 3 -o o.h5"
VOLUME = "volume volume-capture.h5 --pif X -o o.h5"
TIED = "volume volume-capture.h5 --pif kernels.h5 --like X -o o.h5"
AXES = {"CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST"}
SCORE = "score X --truth capture.h5 -o o.json"


def resealed(content, edit):
    """An artefact whose HDF5 part was edited, with a digest block that is true of it."""
    stream = io.BytesIO(content[512:])
    with h5py.File(stream, "r+") as file:
        edit(file)
    image = stream.getvalue()
    said = f"sha256 {hashlib.sha256(image).hexdigest()}\nbytes {len(image)}\n".encode()
    return (MAGIC + said).ljust(512, b"\0") + image


def attribute(where, name, value):
    """An edit: another value of an attribute, text or numbers."""

    def edit(file):
        if isinstance(value, str):
            kind = h5py.string_dtype("utf-8", max(len(value.encode()), 1))
            file[where].attrs.create(name, np.array(value.encode(), dtype=kind), dtype=kind)
        else:
            file[where].attrs[name] = value

    return edit


def values(where, change):
    """An edit: other values of a dataset."""

    def edit(file):
        with np.errstate(all="ignore"):
            stored = file[where][()]
            file[where][...] = np.asarray(change(stored)).astype(stored.dtype)

    return edit


def other(where, change):
    """An edit: a dataset of another shape or type in the place of one."""

    def edit(file):
        stored, attributes = file[where][()], dict(file[where].attrs)
        del file[where]
        file[where] = change(stored)
        for name in attributes.keys() - AXES:
            file[where].attrs[name] = attributes[name]

    return edit


def without(where):
    def edit(file):
        del file[where]

    return edit


IMPOSSIBLE = [
    *(
        (name, command, attribute("/", field, text))
        for name, command in (("pif.h5", SIMULATE), ("capture.h5", RECONSTRUCT))
        for field, text in (
            ("accuracy", "null"),
            ("accuracy", "[]"),
            ("inputs", "null"),
            ("inputs", "3"),
            ("inputs", '{"a": null}'),
            ("inputs", "{"),
            ("seed", "many"),
        )
    ),
    ("capture.h5", RECONSTRUCT, attribute("capture", "noise_sigma", -1.0)),
    ("capture.h5", RECONSTRUCT, attribute("capture", "noise_sigma", 1e300)),
    ("capture.h5", RECONSTRUCT, attribute("capture", "noise_sigma", [0.1, 0.1])),
    ("capture.h5", RECONSTRUCT, attribute("capture", "superpixel_shape", [0, 0])),
    ("capture.h5", RECONSTRUCT, attribute("capture", "superpixel_shape", [13, 13, 13])),
    ("capture.h5", RECONSTRUCT, attribute("capture", "lenslet_count", [-3, 3])),
    ("capture.h5", RECONSTRUCT, attribute("capture", "scene_shape", 0)),
    ("capture.h5", RECONSTRUCT, values("capture/mosaic", lambda v: v * 1e300)),
    ("calibration.h5", DEMUX, values("response/F", lambda v: v.astype(float) * 1e300)),
    ("calibration.h5", DEMUX, values("response/F", lambda v: v * 0)),
    ("calibration.h5", DEMUX, values("response/F", lambda v: v * np.float32(1e20))),
    ("calibration.h5", DEMUX, values("response/F", lambda v: v * 1e-40)),
    ("calibration.h5", DEMUX, values("response/F", lambda v: v * np.nan)),
    ("calibration.h5", DEMUX, values("response/wavelength", lambda v: v * 1e300)),
    ("calibration.h5", DEMUX, values("response/wavelength", lambda v: v[::-1])),
    ("calibration.h5", DEMUX, values("response/window", lambda v: v + 1)),
    ("calibration.h5", DEMUX, values("grid/valid", lambda v: v & False)),
    ("calibration.h5", DEMUX, values("grid/centre", lambda v: v * np.nan)),
    ("calibration.h5", DEMUX, without("response/window")),
    ("calibration.h5", DEMUX, without("response/origin")),
    ("calibration.h5", DEMUX, without("response/wavelength")),
    ("calibration.h5", DEMUX, without("response/white")),
    ("calibration.h5", DEMUX, attribute("response", "cfa", '{"a": null}')),
    ("calibration.h5", DEMUX, attribute("response", "gain_e_per_dn", 0.0)),
    ("calibration.h5", DEMUX, attribute("response", "exposure_s", -1.0)),
    ("pif.h5", SIMULATE, values("pif/wavelength", lambda v: v * 1e300)),
    ("pif.h5", SIMULATE, values("pif/A", lambda v: v * np.float32(1e30))),
    ("pif.h5", SIMULATE, values("pif/column_energy", lambda v: v * 1e30)),
    ("dictionary.h5", BY_DICTIONARY, attribute("dictionary", "parameters", "{}")),
    ("dictionary.h5", BY_DICTIONARY, attribute("dictionary", "parameters", "[]")),
    ("dictionary.h5", BY_DICTIONARY, values("dictionary/atoms", lambda v: v * 0 + 1e300)),
    ("dictionary.h5", BY_DICTIONARY, values("dictionary/atoms", lambda v: v * 0)),
    ("dictionary.h5", BY_DICTIONARY, attribute("dictionary", "lambda", -1.0)),
    ("dictionary.h5", BY_DICTIONARY, other("dictionary/atoms", lambda v: v[:, :1])),
    ("image.h5", SCORE, values("image/value", lambda v: v * 0 + 1e300)),
    ("capture.h5", "view X -o o.html", other("capture/mosaic", lambda v: v[:, :5])),
    ("pif.h5", SIMULATE, values("pif/pixel_shape", lambda v: v * 0 + 1)),
    ("pif.h5", "show X -o o.png", values("pif/pixel_shape", lambda v: v * 0 + 1)),
    ("dictionary.h5", RESUME, other("dictionary/state/atoms", lambda v: v[:, :1])),
    (
        "dictionary.h5",
        RESUME,
        other("dictionary/state/history_step_residual", lambda v: v[:, None]),
    ),
    ("calibration.h5", DEMUX, values("response/wavelength", lambda v: v * 1e-10)),
    ("stack.h5", SIMULATE, values("planes/distance", lambda v: v - v[0])),
    ("kernels.h5", VOLUME, values("stack/lenslet_offset", lambda v: v * 0 + 1)),
    ("kernels.h5", VOLUME, values("stack/A", lambda v: v * np.float32(1e30))),
    ("kernels.h5", VOLUME, values("stack/spacing", lambda v: v * 0 + 1e-300)),
    ("kernels.h5", VOLUME, values("stack/lenslet_offset", lambda v: np.full_like(v, -(2**31)))),
    (
        "kernels.h5",
        "show X -o o.png",
        values("stack/lenslet_offset", lambda v: np.full_like(v, -(2**31))),
    ),
    ("volume.h5", TIED, values("volume/depth", lambda v: v * 1e-300)),
    ("volume.h5", TIED, values("volume/spacing", lambda v: v * 3)),
    ("volume.h5", TIED, other("volume/value", lambda v: v[:, :1])),
    ("dictionary.h5", RESUME, other("dictionary/state/iteration", lambda v: np.zeros(0))),
    ("dictionary.h5", RESUME, values("dictionary/state/iteration", lambda v: v * 0 - 1)),
    ("fit.h5", "show X -o o.png", values("fit/tolerance", lambda v: v * 0)),
]


@pytest.mark.parametrize("number", range(len(IMPOSSIBLE)))
def test_content_that_cannot_be_is_refused(runner, stages, tmp_path, number):
    name, command, edit = IMPOSSIBLE[number]
    for path in stages[0].iterdir():
        if path.is_file():
            (tmp_path / path.name).symlink_to(path)
    (tmp_path / "x.h5").write_bytes(resealed((stages[0] / name).read_bytes(), edit))
    outcome = runner.run(["x.h5" if w == "X" else w for w in command.split()], tmp_path)
    assert is_clean_refusal(outcome, 3, "x.h5"), outcome
    assert not (tmp_path / "o.h5").exists() and not (tmp_path / "o.json").exists()
    assert runner.run(["inspect", "x.h5"], tmp_path).code in (0, 3)


@pytest.mark.parametrize("name", ["pif.h5", "capture.h5", "calibration.h5", "dictionary.h5"])
def test_an_edit_that_changes_nothing_is_read(runner, stages, tmp_path, name):
    shutil.copy(stages[0] / name, tmp_path)
    content = resealed((stages[0] / name).read_bytes(), lambda file: None)
    (tmp_path / "x.h5").write_bytes(content)
    assert runner.run(["inspect", "x.h5"], tmp_path).code == 0


def test_names_of_datasets_reach_the_terminal_as_text(runner, stages, tmp_path):
    def edit(file):
        file["dictionary/history/a\x1b]0;owned\x07b"] = np.arange(3.0)
        file["dictionary/odd\x1b[31m"] = np.arange(3.0)

    content = resealed((stages[0] / "dictionary.h5").read_bytes(), edit)
    (tmp_path / "x.h5").write_bytes(content)
    for words in (["inspect", "x.h5"], ["inspect", "--json", "x.h5"], ["show", "x.h5"]):
        outcome = runner.run(words, tmp_path)
        assert outcome.code in (0, 3) and "internal error" not in outcome.text
        assert "\x1b" not in outcome.text and "\x07" not in outcome.text
