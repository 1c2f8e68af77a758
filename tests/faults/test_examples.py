"""Every example of every --help: all are parsed, and run on small files of the names they have."""

import shlex
import shutil
from fnmatch import fnmatch
from pathlib import Path

import click
import h5py
import numpy as np
import pytest

from plenocli.cli.main import cli
from tests.faults.conftest import SAMPLES


def commands(group, context, words=()):
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, click.Group):
            yield from commands(command, context, (*words, name))
        else:
            yield (*words, name), command


def examples():
    """(command line's words, its command), one for each example."""
    for words, command in commands(cli, click.Context(cli)):
        text = (command.help or "").replace("\\\n", " ")
        for line in text.splitlines():
            if line.split()[: len(words) + 1] == ["plenocli", *words]:
                found = shlex.split(line.split(" > ")[0])
                yield found[1:], found[1 + len(words) :], command


EXAMPLES = list(examples())


def test_there_are_examples_of_nearly_all_commands():
    assert len(EXAMPLES) > 40


@pytest.mark.parametrize(("line", "arguments", "command"), EXAMPLES, ids=lambda v: None)
def test_an_example_is_parsed(line, arguments, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = [word.replace("*", "1") for word in arguments]
    for word in arguments:
        path = Path(word.split("=")[-1])
        if not word.startswith("-") and ":" not in word:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.suffix and not path.exists():
                path.touch()
            elif not path.suffix:
                path.mkdir(exist_ok=True)
    assert command.make_context(" ".join(line), arguments).params


GIVEN = {
    "": {
        "camera.toml": "camera.toml",
        "microscope.toml": "microscope.toml",
        "photo.png": "photo.png",
        "near.png": "photo.png",
        "far.png": "photo.png",
        "photos/1.png": "photo.png",
        "photos/2.png": "photo.png",
        "pif.h5": "pif.h5",
        "pif-3x3.h5": "pif-3x3.h5",
        "kernels.h5": "kernels.h5",
        "capture.h5": "capture.h5",
        "a.h5": "capture.h5",
        "b.h5": "capture.h5",
        "shots/1.h5": "capture.h5",
        "edited.h5": "edited.h5",
        "d.h5": "dictionary.h5",
        "dictionary.h5": "dictionary.h5",
        "lmmse.h5": "image.h5",
        "tikhonov.h5": "image.h5",
        "image.h5": "image.h5",
        "score.json": "score.json",
        "planes.h5": "planes.h5",
        "spectra.h5": "spectra.h5",
        "chart.exr": "spectra.exr",
        "white1.h5": "spectra.h5",
        "white2.h5": "spectra.h5",
        "calibration.h5": "calibration.h5",
        "cal.h5": "calibration.h5",
        "predicted.h5": "predicted.h5",
        "response.h5": "predicted.h5",
        "scene.toml": "scene.toml",
        "paints.csv": "paints.csv",
        "triplet.zmx": "triplet.zmx",
        "lens.toml": "lens.toml",
        "white.png": "white.png",
        "dark.png": "dark.png",
        "scene.png": "white.png",
        "capture.png": "colorchecker.png",
        "grid.h5": "grid.h5",
        "white-only.h5": "white-only.h5",
        "captures/1.dng": "colorchecker.dng",
        "captures/2.dng": "colorchecker.dng",
        **{f"{name}.NEF": "white.dng" for name in ("w", "w1", "w2", "white")},
        **{f"{name}.NEF": "colorchecker.dng" for name in ("chart", "IMG_0001", "shots/1")},
        "d.NEF": "dark.dng",
        "b450.NEF": "450nm.dng",
        "b540.NEF": "540nm.dng",
        "450.dng": "450nm.dng",
        "white.dng": "white.dng",
        "chart.dng": "colorchecker.dng",
    },
    "learn-dict --pif pif.h5 --resume": {"dictionary.h5": "learnt.h5"},
    "volume capture.h5": {"capture.h5": "volume-capture.h5"},
    "volume red.h5": {
        "red.h5": "volume-capture.h5",
        "kernels-red.h5": "kernels.h5",
        "green-volume.h5": "volume.h5",
    },
    "score spectra.h5": {"capture.h5": "shown.h5", "spectra.h5": "shown-spectra.h5"},
    "score shown.h5": {"camera.toml": "colour.toml", "shown.h5": "shown-spectra.h5"},
    "score planes.h5": {"planes.h5": "distances.h5"},
    "show pif.h5 --point": {"pif.h5": "pif-fine.h5"},
    "calibrate": {"camera.toml": "colour.toml"},
    "demux": {"camera.toml": "colour.toml"},
    "simulate-response": {"camera.toml": "colour.toml"},
    "capture-sim camera.toml --target": {"camera.toml": "colour.toml"},
}
"""Beginning of a line -> {name in an example: file of `kit`}."""
SEQ = """RDM;LEN
TITLE 'doublet'
EPD 10
DIM M
WL 587.6
REF 1
WTW 1
YAN 0 5
SO 0.0 1e13
S 62.5 6 N-BK7_SCHOTT
STO
S -45.5 2.5 N-SF2_SCHOTT
S -125 97
SI 0 0
GO
"""
MADE = {
    "grid.h5": "calibrate --white white.png --dark dark.png -o grid.h5",
    "white-only.h5": "calibrate --white white.dng --dark dark.dng -o white-only.h5",
    "pif-fine.h5": "simulate-pif fine.toml --superpixels 1x1 --coherent-ring 0 -o pif-fine.h5",
    "learnt.h5": "learn-dict --pif pif.h5 --iterations 1 -o learnt.h5",
    "distances.h5": "refocus capture.h5 --camera camera.toml --planes 3 -o distances.h5",
    "shown.h5": "capture-sim colour.toml --model ray --superpixels 1x1 --scene paints.csv"
    " -o shown.h5",
    "shown-spectra.h5": "demux shown.h5 --calibration predicted.h5 -o shown-spectra.h5",
}
"""Files of `kit` beside those of stages, made when an example wants them."""
FOLDERS = {
    "sample_configs/": "sample_configs",
    "colorchecker captures": "painted",
    "runs/demo": "runs",
}
"""Part of a line -> folder of `kit` that it needs as a whole."""
ELSEWHERE = {
    "--scheduler": "a Dask scheduler: tests/execution/test_cluster.py",
    "microscope.toml --calibration": "lenslets of a calibration: tests/stages/test_volume.py",
    "volume light_field.tif": "lenslets of a calibration: tests/stages/test_volume.py",
    "calibrate --scene": "more lenslets: tests/stages/test_calibrate.py",
    "reconstruct shot.png": "a calibrated camera: tests/stages/test_reconstruct_weighted.py",
    "--sign ~": "a key of the user's own: tests/stages/test_verify.py",
    "--signed-by": "a key of the user's own: tests/stages/test_verify.py",
}
CHEAP = ("init", "schema", "inspect", "verify", "lens show", "demux chart.dng", "score image.h5")
"""Beginnings of lines that run by default; the others repeat what stages' tests do."""


@pytest.fixture(scope="session")
def kit(stages, runner, tmp_path_factory):
    """A folder with the stages' files and what else examples name."""
    from tests.reference.chart import paint_folder
    from tests.stages.test_lens import ZMX

    folder = tmp_path_factory.mktemp("kit")
    shutil.copytree(stages[0], folder, dirs_exist_ok=True)
    (folder / "paints.csv").write_text("nm,rust,moss\n400,0.1,0.2\n700,0.6,0.3\n")
    (folder / "triplet.zmx").write_text(ZMX)
    shutil.copy(SAMPLES / "lenses" / "triplet.toml", folder / "lens.toml")
    for name in ("white", "dark", "colorchecker"):
        _save_png(folder / f"{name}.dng", folder / f"{name}.png")
    (folder / "painted").mkdir()
    paint_folder(folder / "painted")
    (folder / "fine.toml").write_text(
        (folder / "camera.toml").read_text().replace("8, 8", "24, 24")
    )
    (folder / "doublegauss.seq").write_text(SEQ)
    shutil.copy(folder / "capture.h5", folder / "edited.h5")
    with h5py.File(folder / "edited.h5", "r+") as edited:
        edited["capture/mosaic"][0, 0] *= 2
    (folder / "runs" / "demo").mkdir(parents=True)
    for name in ("image.h5", "capture.h5", "score.json"):
        shutil.copy(folder / name, folder / "runs" / "demo")
    _run(runner, "seal runs/demo", folder)
    sweeps = folder / "sample_configs" / "sweeps"
    sweeps.mkdir(parents=True)
    for name in ("lenslets", "filters"):
        shutil.copy(folder / "designs.toml", sweeps / f"{name}.toml")
    for name in ("camera.toml", "tiny.toml"):
        shutil.copy(folder / "camera.toml", sweeps / name)
        shutil.copy(folder / "camera.toml", folder / "sample_configs" / name)
    return folder


def _run(runner, line, folder):
    outcome = runner.run(line.split(), folder, limit=120)
    assert outcome.code == 0, outcome.text


def _provided(runner, kit, name):
    """A file of `kit`."""
    if name in MADE and not (kit / name).exists():
        for other in MADE[name].split()[:-1]:
            _provided(runner, kit, other)
        _run(runner, MADE[name], kit)
    return kit / name


def _named(line, name):
    """Whether an example's words name a file, alone, in a folder or by a pattern."""
    return any(
        name in word or fnmatch(name, word) or name.startswith(f"{word.rstrip('/')}/")
        for word in line
    )


def _save_png(source, target):
    """The pixels of a DNG as a picture of 16 bit."""
    import OpenImageIO as oiio

    from plenocli.files.images.mosaic import read_capture

    values = np.asarray(read_capture(source).mosaic)[..., None].astype(np.uint16)
    out = oiio.ImageOutput.create(str(target))
    out.open(str(target), oiio.ImageSpec(values.shape[1], values.shape[0], 1, "uint16"))
    out.write_image(values)
    out.close()


def _marked(line):
    text = " ".join(line)
    why = [reason for part, reason in ELSEWHERE.items() if part in text]
    marks = [pytest.mark.skip(reason=why[0])] if why else []
    return pytest.param(
        line, id=text, marks=marks if text.startswith(CHEAP) else [*marks, pytest.mark.slow]
    )


@pytest.mark.parametrize("line", [_marked(line) for line, *_ in EXAMPLES])
def test_an_example_runs(line, kit, runner, tmp_path):
    if line[:2] == ["lens", "import"]:
        pytest.importorskip("optiland")
    names = dict(GIVEN[""])
    for beginning, others in GIVEN.items():
        if " ".join(line).startswith(beginning):
            names |= others
    for name, source in names.items():
        if _named(line, name):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(_provided(runner, kit, source), tmp_path / name)
    written = line[line.index("-o") + 1] if "-o" in line else None
    if written and "--resume" not in line:
        (tmp_path / written).unlink(missing_ok=True)
    for part, folder in FOLDERS.items():
        if " ".join(line).startswith(part) or f" {part}" in " ".join(line):
            there = tmp_path / ("captures" if folder == "painted" else folder)
            shutil.rmtree(there, ignore_errors=True)
            shutil.copytree(kit / folder, there)
    found = [p for w in line for p in (sorted(tmp_path.glob(w)) if "*" in w else [w])]
    outcome = runner.run(found, tmp_path, limit=300)
    assert outcome.code == 0, outcome.text
    assert written in (None, "-") or (tmp_path / written).exists()
