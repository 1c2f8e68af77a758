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
    "wide-lens": ("f_number = 8", 'f_number = 1\nprescription = "triplet.toml"'), "one": ("count = [5, 5]", "count = [1, 1]"),
    **{f"wavefront-{name}": ("f_number = 8", f'f_number = 8\nwavefront = "wave-{name}.h5"') for name in ("none", "whole", "text", "inches")},
    "aperture-text": ("f_number = 8", 'f_number = 8\naperture_shape = "image"\naperture_image = "scene.toml"'),
    "aperture-channels": ("f_number = 8", 'f_number = 8\naperture_shape = "image"\naperture_image = "odd.exr"'),
}
HOSTILE = ("external_link", "soft_link", "twice", "loop", "external_storage", "virtual", "objects", "ragged", "compound", "reference", "bomb", "filter", "named_type", "null",
           "attribute_object", "unknown_dataset", "unknown_attribute", "newer", "other_kind", "no_command", "wrong_shape", "infinite")
"""Of tests/artefacts/test_container.py: what HDF5 allows and plenocli does not."""
SWEEPS = {
    "bad": SWEEP.replace("f_number", "f_numbr"), "huge": SWEEP.replace("[7, 8]", "{ from = 1, to = 9, steps = 9000 }\n\"sensor.bits\" = { from = 8, to = 9, steps = 9000 }"),
    "stage": SWEEP.replace("[reconstruct]", "[demux]"), "option": SWEEP.replace("method =", "methd ="), "value": SWEEP.replace('"block-mean"', '"best"'),
    "front": SWEEP + '[front]\nbeauty = "max"\n', "follow": SWEEP + '[follow]\n"sensor.distance" = "lenslet_array.focal_length + 1"\n',
    "power": SWEEP + '[follow]\n"sensor.distance" = "lenslet_array.focal_length * lenslet_array.focal_length"\n', "index": SWEEP.replace("main_lens.f_number", "sensor.pixels_per_lenslet.5"),
    "steps": SWEEP.replace("[7, 8]", "{ from = 7, to = 8 }"), "list": 'camera = "camera.toml"\ndesign = "list"\n[[point]]\n"main_lens.f_number" = 7\n', "toml": SWEEP + "[vary\n",
    **{name: SWEEP.replace('method = "block-mean"', text) for name, text in
       {"flag": 'method = "block-mean"\nclip = "yes"', "truth": "method = true", "several": 'method = ["lmmse"]', "table": "method = { a = 1 }"}.items()},
    **{name: SWEEP + f'[follow]\n"sensor.distance" = "{text}"\n' for name, text in
       {"empty": "", "sum": "lenslet_array.focal_length - main_lens.f_number", "double": "lenslet_array.focal_length ** 2", "array": "light.wavelengths * 2", "decibel": "sensor.exposure * 2", "zero": "lenslet_array.focal_length / 0", "text": "sensor.cfa * 2", "plain": "2 * 3", "nobody": "lens.nothing * 2"}.items()},
    "part": SWEEP.replace("main_lens.f_number", "lenslet_array.pitch.0"),
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
    _wavefronts(folder)
    _old_and_hostile(folder)
    _artefacts(folder)
    return folder


def _pictures(folder):
    rng = np.random.default_rng(6)
    picture(folder / "small.png", np.full((5, 4), 100, np.uint8))
    picture(folder / "flat.png", np.full((60, 60), 100, np.uint8))
    picture(folder / "noise.png", rng.integers(0, 255, (80, 80)).astype(np.uint8))
    picture(folder / "clipped.png", np.where(rng.random((80, 80)) < 0.9, 255, 10).astype(np.uint8))
    picture(folder / "half.exr", np.full((8, 8, 4), 0.5, np.float32))
    picture(folder / "odd.exr", np.full((8, 8, 5), 0.5, np.float32))
    picture(folder / "nan.exr", np.where(np.arange(64).reshape(8, 8) == 5, np.nan, 0.5).astype(np.float32))
    picture(folder / "negative.exr", np.full((8, 8), -0.5, np.float32))
    picture(folder / "whole.exr", np.full((8, 8), 3, np.uint32))
    picture(folder / "two.tif", np.full((8, 8, 2), 9, np.uint8))
    picture(folder / "long.tif", np.full((8, 8), 9, np.uint32))
    picture(folder / "labels.png", np.full((6, 7), 99, np.uint8))
    (folder / "photo.exr").write_bytes((folder / "photo.png").read_bytes())
    (folder / "cut.png").write_bytes((folder / "photo.png").read_bytes()[:900])
    (folder / "empty.dng").touch()
    white = (folder / "white.dng").read_bytes()
    (folder / "cut.dng").write_bytes(white[:9000])
    for name, at in (("damaged.dng", -1000), ("damaged.exr", -100), ("damaged.h5", -1000)):
        good = bytearray((folder / {".dng": "white.dng", ".exr": "capture.exr", ".h5": "pif.h5"}[Path(name).suffix]).read_bytes())
        good[at] ^= 64
        (folder / name).write_bytes(good)


def _wavefronts(folder):
    for name, dataset, values, units in (("none", "W", np.zeros((8, 8)), "m"), ("whole", "wavefront", np.zeros((8, 8, 2)), "m"), ("text", "wavefront", np.zeros((8, 8)), "m"), ("inches", "wavefront", np.zeros((8, 8)), "in")):
        with h5py.File(folder / f"wave-{name}.h5", "w") as file:
            file[dataset] = values
            file[dataset].attrs["units"] = units if name == "text" else np.bytes_(units)


def _old_and_hostile(folder):
    from tests.artefacts import test_container as container

    for name in HOSTILE:
        container.hostile(folder / f"{name.replace('_', '-')}.h5", getattr(container, f"_{name}"))
    container.hostile(folder / "older.h5", lambda file: file.attrs.__setitem__("schema_version", 0))


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
    changed("hexagonal-pif.h5", "pif.h5", lambda a: a.attrs["pif"].update(lattice="hexagonal"))
    changed("colours.h5", "capture.h5", lambda a: a.data.update({"capture/cfa": "RGGB"}))
    changed("stateless.h5", "dictionary.h5", lambda a: a.data.pop("dictionary/state/iteration"))
    changed("cropped.h5", "image.h5", lambda a: a.data.update({k: v[:16, :16] for k, v in a.data.items() if k in ("image/value", "image/sigma")}))
    changed("noiseless.h5", "capture.h5", lambda a: a.attrs["capture"].pop("noise_sigma", None))
    changed("windowless.h5", "calibration.h5", lambda a: a.data.pop("response/white"))
    changed("shifted.h5", "calibration.h5", lambda a: a.data.update({"response/wavelength": a.data["response/wavelength"] * 1.3}))
    changed("dim.h5", "calibration.h5", lambda a: a.data.update({"response/F": a.data["response/F"] * 0}))
    changed("flat-pif.h5", "pif.h5", lambda a: a.data.update({"pif/object_shape": np.array([4, 16], np.int32)}))
    (folder / "pieces").mkdir()
    for name in ("shards.h5", "shards.000.h5"):
        shutil.copy(folder / name, folder / "pieces")
    shutil.copy(folder / "shards.000.h5", folder / "pieces" / "shards.001.h5")
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
