"""What plenocli says when it refuses, word for word: transcript.txt holds commands, their exit codes and their messages.

`pytest tests/faults/test_transcript.py --new-transcript` writes the answers anew, for a person to read.
"""

import re
import shlex
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from plenocli.artefacts import read_artefact, write_artefact
from tests.faults.conftest import SAMPLES, SWEEP
from tests.messages import shown_places

TRANSCRIPT = Path(__file__).with_name("transcript.txt")
TINY = (SAMPLES / "tiny.toml").read_text()
COMMANDS = [line.removeprefix("$ plenocli").strip() for line in TRANSCRIPT.read_text().splitlines() if line.startswith("$ ")]
CAMERAS = {
    "wrong": ('distance = "550 mm"', 'distance = "-550 mm"'), "unknown": ("f_number = 8", "f_number = 8\nf_numbr = 8"), "nounit": ('"550 mm"', "550"), "nothing": (TINY, ""),
    "near": ('distance = "550 mm"', 'distance = "49 mm"'), "aperture": ("f_number = 8", 'f_number = 8\naperture_shape = "image"\naperture_image = "photo.png"'),
    "wavefront": ("f_number = 8", 'f_number = 8\nwavefront = "capture.h5"'), "wavefront-toml": ("f_number = 8", 'f_number = 8\nwavefront = "scene.toml"'),
    "no-aperture": ("f_number = 8", 'f_number = 8\naperture_shape = "image"\naperture_image = "none.png"'), "other": ('"26 um"', '"25 um"'), "blue": ('"550 nm"', '"450 nm"'),
    "hexagonal": ("count = [5, 5]", 'count = [5, 5]\nlattice = "hexagonal"'), "drift": ('superpixel_pitch = "26 um"', 'pitch = "26 um"'), "latin": ("[main_lens]", "[main_lens]\nname = \"\udce9\""),
    
    "other2": ('distance = "55 mm"', 'distance = "56 mm"'), "bayer": ("[sensor]", '[sensor]\ncfa = "RGGB"'), "lens": ("f_number = 8", 'f_number = 8\nprescription = "triplet.toml"'),
}
SWEEPS = {
    "bad": SWEEP.replace("f_number", "f_numbr"), "huge": SWEEP.replace("[7, 8]", "{ from = 1, to = 9, steps = 9000 }\n\"sensor.bits\" = { from = 8, to = 9, steps = 9000 }"),
    "stage": SWEEP.replace("[reconstruct]", "[demux]"), "option": SWEEP.replace("method =", "methd ="), "value": SWEEP.replace('"block-mean"', '"best"'),
    "front": SWEEP + '[front]\nbeauty = "max"\n', "follow": SWEEP + '[follow]\n"sensor.distance" = "lenslet_array.focal_length + 1"\n',
    "power": SWEEP + '[follow]\n"sensor.distance" = "lenslet_array.focal_length * lenslet_array.focal_length"\n', "index": SWEEP.replace("main_lens.f_number", "sensor.pixels_per_lenslet.5"),
    "steps": SWEEP.replace("[7, 8]", "{ from = 7, to = 8 }"), "list": 'camera = "camera.toml"\ndesign = "list"\n[[point]]\n"main_lens.f_number" = 7\n', "toml": SWEEP + "[vary\n",
}


def picture(path, values):
    import OpenImageIO as oiio

    values = np.atleast_3d(values)
    out = oiio.ImageOutput.create(str(path))
    out.open(str(path), oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], str(values.dtype)))
    out.write_image(values)
    out.close()


@pytest.fixture(scope="module")
def folder(stages, tmp_path_factory):
    """The small files of every kind, and beside them what is wrong in one way each."""
    source, _ = stages
    folder = tmp_path_factory.mktemp("transcript")
    for path in filter(Path.is_file, source.iterdir()):
        shutil.copy(path, folder)
    for name, (old, new) in CAMERAS.items():
        (folder / f"{name}.toml").write_bytes(TINY.replace(old, new).encode("utf-8", "surrogateescape"))
    for name, text in SWEEPS.items():
        (folder / f"{name}-sweep.toml").write_text(text)
    for name, text in {"broken": "[main_lens\n", "deep": "a = " + "[" * 3000, "big": "#" * 10_000_000, "bad.zmx": "nonsense", "big.zmx": "#" * 80_000_000}.items():
        (folder / (name if "." in name else f"{name}.toml")).write_text(text)
    (folder / "triplet.toml").write_text((SAMPLES / "lenses" / "triplet.toml").read_text())
    (folder / "glass.toml").write_text((SAMPLES / "lenses" / "triplet.toml").read_text().replace("N-SK16", "N-SK17"))
    (folder / "folder").mkdir()
    (folder / "folder" / "notes.txt").write_text("nothing here")
    (folder / "broken-score").mkdir()
    (folder / "broken-score" / "score.json").write_text('{"results": [{"name": 3}]}')
    (folder / "device.h5").symlink_to("/dev/null")
    _pictures(folder)
    _artefacts(folder)
    return folder


def _pictures(folder):
    rng = np.random.default_rng(6)
    picture(folder / "small.png", np.full((5, 4), 100, np.uint8))
    picture(folder / "flat.png", np.full((60, 60), 100, np.uint8))
    picture(folder / "noise.png", rng.integers(0, 255, (80, 80)).astype(np.uint8))
    picture(folder / "clipped.png", np.where(rng.random((80, 80)) < 0.9, 255, 10).astype(np.uint8))
    picture(folder / "half.exr", np.full((8, 8, 4), 0.5, np.float32))
    (folder / "empty.dng").touch()
    white = (folder / "white.dng").read_bytes()
    (folder / "cut.dng").write_bytes(white[:9000])
    for name, at in (("damaged.dng", -1000), ("damaged.exr", -100), ("damaged.h5", -1000)):
        good = bytearray((folder / {".dng": "white.dng", ".exr": "capture.exr", ".h5": "pif.h5"}[Path(name).suffix]).read_bytes())
        good[at] ^= 64
        (folder / name).write_bytes(good)


def _artefacts(folder):
    pif = (folder / "pif.h5").read_bytes()
    (folder / "cut.h5").write_bytes(pif[:-7])
    (folder / "header.h5").write_bytes(pif[:40] + b"?" + pif[41:])
    with h5py.File(folder / "plain.h5", "w") as file:
        file["A"] = np.ones(3)

    def changed(name, source, change):
        artefact = read_artefact(folder / source)
        change(artefact)
        write_artefact(folder / name, artefact)

    changed("zero.h5", "pif.h5", lambda a: a.data.update({"pif/A": a.data["pif/A"] * 0}))
    changed("lonely.h5", "pif.h5", lambda a: a.data.update({"pif/lenslet_offset": a.data["pif/lenslet_offset"] + 3}))
    changed("grid.h5", "calibration.h5", lambda a: [a.attrs.pop("response"), *(a.data.pop(k) for k in list(a.data) if k.startswith("response/"))])
    changed("other-pif.h5", "pif.h5", lambda a: a.data.update({"pif/A": a.data["pif/A"][:, :, :, :49], "pif/column_energy": a.data["pif/column_energy"][:, :49], "pif/object_shape": np.array([7, 7], np.int32)}))
    changed("sceneless.h5", "capture.h5", lambda a: [a.data.pop(k) for k in ("capture/scene", "capture/wavelength") if k in a.data])
    changed("index.h5", "shards.h5", lambda a: a.attrs["pif"].update({"shards": [{"name": "../x.h5", "sha256": "0" * 64}]}))


def answer(runner, folder, command):
    """(the answer as the transcript keeps it, where its message was made)."""
    before = set(folder.iterdir())
    outcome = runner.run(shlex.split(command), folder, limit=60, fault={"call": "places"})
    left = {p for p in set(folder.iterdir()) - before}
    for path in left:
        path.unlink() if path.is_file() else shutil.rmtree(path)
    text = re.sub(r"Usage: .*\nTry .*\n\n", "", outcome.text).replace(str(folder), "FOLDER")
    text = re.sub(r"[\d.]+(?=[KMG]iB)", "#", text)  # what is needed changes with the laws of cost
    return f"$ plenocli {command}\n[{outcome.code}] {text.rstrip()}\n", outcome.notes


def test_refusals_read_as_they_did(runner, folder, campaign, count, request):
    """By default every fourth."""
    anew = request.config.getoption("--new-transcript")
    answers, reached = {}, set()
    for command in COMMANDS if anew else COMMANDS[::campaign(4, 1)]:
        answers[command], notes = answer(runner, folder, command)
        reached.update(notes.split())
    request.node.user_properties.append(("places", " ".join(reached)))
    if anew:
        TRANSCRIPT.write_text("\n".join(answers.values()))
    expected = {part.partition("\n")[0].removeprefix("$ plenocli "): part.rstrip() for part in re.split(r"(?m)^(?=\$ )", TRANSCRIPT.read_text()) if part}
    assert {command: said.rstrip() for command, said in answers.items()} == {command: expected[command] for command in answers}
    assert not [said for said in answers.values() if not re.search(r"\n\[[2345]\] ", said) or "internal error" in said or "Traceback" in said]
    count("transcript of refusals", commands=len(answers), different_messages=len({a.partition("\n")[2] for a in answers.values()}), places_in_the_code=len(shown_places(reached)))
