"""Files that are wrong in one way each, made beside the good ones of `make_all`, for the
transcript of refusals.
"""

import dataclasses
import hashlib
import os
import shutil
from pathlib import Path
from unittest import mock

import h5py
import numpy as np

from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.images import dng
from tests.faults import test_bombs as bombs
from tests.faults.conftest import SAMPLES, SWEEP, write_shards
from tests.reference import chart

TINY = (SAMPLES / "tiny.toml").read_text()
CAMERAS = {
    "wrong": ('distance = "550 mm"', 'distance = "-550 mm"'),
    "unknown": ("f_number = 8", "f_number = 8\nf_numbr = 8"),
    "nounit": ('"550 mm"', "550"),
    "nothing": (TINY, ""),
    "near": ('distance = "550 mm"', 'distance = "49 mm"'),
    "aperture": (
        "f_number = 8",
        'f_number = 8\naperture_shape = "image"\naperture_image = "photo.png"',
    ),
    "wavefront": ("f_number = 8", 'f_number = 8\nwavefront = "capture.h5"'),
    "wavefront-toml": ("f_number = 8", 'f_number = 8\nwavefront = "scene.toml"'),
    "no-aperture": (
        "f_number = 8",
        'f_number = 8\naperture_shape = "image"\naperture_image = "none.png"',
    ),
    "other": ('"26 um"', '"25 um"'),
    "blue": ('"550 nm"', '"450 nm"'),
    "hexagonal": ("count = [5, 5]", 'count = [5, 5]\nlattice = "hexagonal"'),
    "drift": ('superpixel_pitch = "26 um"', 'pitch = "26 um"'),
    "latin": ("[main_lens]", '[main_lens]\nname = "\udce9"'),
    "other2": ('distance = "55 mm"', 'distance = "56 mm"'),
    "bayer": ("[sensor]", '[sensor]\ncfa = "RGGB"'),
    "lens": ("f_number = 8", 'f_number = 8\nprescription = "triplet.toml"'),
    "wide-lens": ("f_number = 8", 'f_number = 1\nprescription = "triplet.toml"'),
    "one": ("count = [5, 5]", "count = [1, 1]"),
    **{
        f"wavefront-{name}": ("f_number = 8", f'f_number = 8\nwavefront = "wave-{name}.h5"')
        for name in ("none", "whole", "text", "inches", "cut", "tall", "good")
    },
    "wavefront-big": ("f_number = 8", 'f_number = 8\nwavefront = "big.zmx"'),
    "aperture-garbage": (
        "f_number = 8",
        'f_number = 8\naperture_shape = "image"\naperture_image = "garbage.png"',
    ),
    "aperture-tall": (
        "f_number = 8",
        'f_number = 8\naperture_shape = "image"\naperture_image = "small.png"',
    ),
    "aperture-text": (
        "f_number = 8",
        'f_number = 8\naperture_shape = "image"\naperture_image = "scene.toml"',
    ),
    "lens-near": (
        'distance = "550 mm"',
        'distance = "40 mm"',
        "f_number = 8",
        'f_number = 20\nprescription = "triplet.toml"',
    ),
    "lens-long": (
        'focal_length = "50 mm"',
        'focal_length = "60 mm"\nprescription = "triplet.toml"',
    ),
    "infrared": (
        "[sensor]",
        '[sensor]\ncfa = "RGGB"\ncamera = "Sigma SDMerill (NPL)"',
        '"550 nm"',
        '"750 nm"',
    ),
    "stranger": ("[sensor]", '[sensor]\ncfa = "RGGB"\ncamera = "Nobody"'),
    "coarse": ('"26 um"', '"2.6 mm"', '"208 um"', '"20.8 mm"', '"2 um"', '"200 um"'),
    "band": ('wavelengths = ["550 nm"]', 'band = { center = "550 nm", fwhm = "100 nm" }'),
    "aperture-channels": (
        "f_number = 8",
        'f_number = 8\naperture_shape = "image"\naperture_image = "odd.exr"',
    ),
}
SURFACE = '[[surface]]\nradius = "{}"\nthickness = "{}"\n'
LENSES = {
    "afocal": '[lens]\nstop = 1\nstop_diameter = "5 mm"\n'
    + SURFACE.format("20 mm", "0 mm")
    + 'glass = "N-BK7"\n'
    + SURFACE.format("20 mm", "50 mm"),
    "plate": '[lens]\nstop = 1\nstop_diameter = "5 mm"\n'
    + SURFACE.format("flat", "2 mm")
    + 'glass = "N-BK7"\n'
    + SURFACE.format("flat", "50 mm"),
    "strange-glass": '[lens]\nstop = 1\nstop_diameter = "5 mm"\n'
    + SURFACE.format("20 mm", "2 mm")
    + 'glass = "own"\n'
    + SURFACE.format("flat", "50 mm")
    + '[glass.own]\nsellmeier = [[-5, 0.01]]\nrange = ["300 nm", "1 um"]\n',
}
HOSTILE = (
    "external_link",
    "soft_link",
    "twice",
    "external_storage",
    "virtual",
    "objects",
    "compound",
    "bomb",
    "filter",
    "named_type",
    "null",
    "attribute_object",
    "unknown_dataset",
    "unknown_attribute",
    "newer",
    "other_kind",
    "no_command",
    "wrong_shape",
    "infinite",
)
"""Of tests/files/test_container.py: what HDF5 allows and plenocli does not."""
SWEEPS = {
    "bad": SWEEP.replace("f_number", "f_numbr"),
    "huge": SWEEP.replace(
        "[7, 8]",
        '{ from = 1, to = 9, steps = 9000 }\n"sensor.bits" = { from = 8, to = 9, steps = 9000 }',
    ),
    "stage": SWEEP.replace("[reconstruct]", "[demux]"),
    "option": SWEEP.replace("method =", "methd ="),
    "value": SWEEP.replace('"block-mean"', '"best"'),
    "front": SWEEP + '[front]\nbeauty = "max"\n',
    "follow": SWEEP + '[follow]\n"sensor.distance" = "lenslet_array.focal_length + 1"\n',
    "power": SWEEP
    + '[follow]\n"sensor.distance" = "lenslet_array.focal_length * lenslet_array.focal_length"\n',
    "index": SWEEP.replace("main_lens.f_number", "sensor.pixels_per_lenslet.5"),
    "steps": SWEEP.replace("[7, 8]", "{ from = 7, to = 8 }"),
    "list": 'camera = "camera.toml"\ndesign = "list"\n[[point]]\n"main_lens.f_number" = 7\n',
    "toml": SWEEP + "[vary\n",
    **{
        name: SWEEP.replace('method = "block-mean"', text)
        for name, text in {
            "flag": 'method = "block-mean"\nclip = "yes"',
            "truth": "method = true",
            "several": 'method = ["lmmse"]',
            "table": "method = { a = 1 }",
        }.items()
    },
    **{
        name: SWEEP + f'[follow]\n"sensor.distance" = "{text}"\n'
        for name, text in {
            "empty": "",
            "sum": "lenslet_array.focal_length - main_lens.f_number",
            "double": "lenslet_array.focal_length ** 2",
            "array": "light.wavelengths * 2",
            "decibel": "sensor.exposure * 2",
            "zero": "lenslet_array.focal_length / 0",
            "text": "sensor.cfa * 2",
            "plain": "2 * 3",
            "nobody": "lens.nothing * 2",
        }.items()
    },
    "camera": SWEEP.replace("camera.toml", "broken.toml"),
    "seconds": SWEEP + '[follow]\n"sensor.distance" = "10 ms * 2"\n',
    "part": SWEEP.replace("main_lens.f_number", "lenslet_array.pitch.0"),
}


def make_wrong_files(folder):
    """Put them all into a folder that holds the good ones."""
    for name, words in CAMERAS.items():
        text = TINY
        for old, new in zip(words[::2], words[1::2]):
            text = text.replace(old, new)
        (folder / f"{name}.toml").write_bytes(text.encode("utf-8", "surrogateescape"))
    for name, text in SWEEPS.items():
        (folder / f"{name}-sweep.toml").write_text(text)
    for name, text in {
        "broken": "[main_lens\n",
        "keys": ".".join("a" * 30) + " = 1",
        "deep": "a = " + "[" * 3000,
        "big": "#" * 10_000_000,
        "bad.zmx": "nonsense",
        "big.zmx": "#" * 80_000_000,
    }.items():
        (folder / (name if "." in name else f"{name}.toml")).write_text(text)
    (folder / "triplet.toml").write_text((SAMPLES / "lenses" / "triplet.toml").read_text())
    (folder / "glass.toml").write_text(
        (SAMPLES / "lenses" / "triplet.toml").read_text().replace("N-SK16", "N-SK17")
    )
    for name, text in LENSES.items():
        (folder / f"{name}.toml").write_text(text)
    (folder / "folder").mkdir()
    (folder / "folder" / "notes.txt").write_text("nothing here")
    for name, text in {"text": "nonsense", "list": '{"results": [], "inputs": []}'}.items():
        (folder / f"{name}-score").mkdir()
        (folder / f"{name}-score" / "score.json").write_text(text)
    (folder / "broken-score").mkdir()
    (folder / "broken-score" / "score.json").write_text('{"results": [{"name": 3}]}')
    (folder / "device.h5").symlink_to("/dev/null")
    _pictures(folder)
    _raws(folder)
    _charts(folder)
    _wavefronts(folder)
    _old_and_hostile(folder)
    _artefacts(folder)


def picture(path, values, names=None, parts=1, **attributes):
    import OpenImageIO as oiio

    values = np.atleast_3d(values)
    spec = oiio.ImageSpec(
        values.shape[1],
        values.shape[0],
        values.shape[2],
        {"uint32": "uint", "float32": "float"}.get(str(values.dtype), str(values.dtype)),
    )
    spec.channelnames = names or spec.channelnames
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    out = oiio.ImageOutput.create(str(path))
    out.open(str(path), spec if parts == 1 else (spec,) * parts)
    for part in range(parts):
        if part:
            out.open(str(path), spec, "AppendSubimage")
        out.write_image(values)
    out.close()


def _pictures(folder):
    rng = np.random.default_rng(6)
    picture(folder / "small.png", np.full((5, 4), 100, np.uint8))
    picture(folder / "flat.png", np.full((60, 60), 100, np.uint8))
    picture(folder / "noise.png", rng.integers(0, 255, (80, 80)).astype(np.uint8))
    picture(folder / "clipped.png", np.where(rng.random((80, 80)) < 0.9, 255, 10).astype(np.uint8))
    picture(folder / "half.exr", np.full((8, 8, 4), 0.5, np.float32))
    picture(folder / "odd.exr", np.full((8, 8, 5), 0.5, np.float32))
    picture(
        folder / "nan.exr",
        np.where(np.arange(64).reshape(8, 8) == 5, np.nan, 0.5).astype(np.float32),
    )
    picture(folder / "negative.exr", np.full((8, 8), -0.5, np.float32))
    picture(folder / "whole.exr", np.full((8, 8), 3, np.uint32))
    picture(folder / "two.tif", np.full((8, 8, 2), 9, np.uint8))
    picture(folder / "long.tif", np.full((8, 8), 9, np.uint32))
    picture(folder / "signed.tif", np.full((30, 30), 9, np.int16))
    picture(folder / "nine.tif", np.full((8, 8, 9), 9, np.uint8))
    picture(folder / "parts.exr", np.full((30, 30), 0.5, np.float32), parts=2)
    picture(folder / "strange.exr", np.full((8, 8, 2), 0.5, np.float32), ("P", "Q"))
    grey = np.full((65, 65), 0.5, np.float32)
    for name, said in {
        "notes": "nonsense",
        "levels": '{"black": "dark"}',
        "letters": '{"cfa": "CMYG"}',
        "nowhere": '{"units": "relative"}',
        "electrons": '{"units": "electron"}',
    }.items():
        picture(folder / f"{name}.exr", grey, ("Y",), plenocli__capture=said)
    band, other = "T.450,000000nm", "S0.450,000000nm"
    for name, channels in {
        "double": (band, "T.450nm"),
        "both": (band, other),
        "radiance": (other, "S0.500,000000nm"),
    }.items():
        picture(folder / f"{name}.exr", np.full((6, 7, 2), 0.5, np.float32), channels)
    _deep(folder / "deep.exr")
    (folder / "garbage.exr").write_bytes(b"\x76\x2f\x31\x01" + bytes(60))
    (folder / "garbage.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(60))
    (folder / "many.exr").write_bytes(bombs._exr(8, 8, [f"c{n:05d}" for n in range(2100)]))
    (folder / "empty.exr").write_bytes(bombs._exr(8, 8))
    (folder / "latin.exr").write_bytes(
        (folder / "strange.exr").read_bytes().replace(b"\0Q\0", b"\0\xe9\0")
    )
    picture(folder / "labels.png", np.full((6, 7), 99, np.uint8))
    (folder / "photo.exr").write_bytes((folder / "photo.png").read_bytes())
    (folder / "cut.png").write_bytes((folder / "photo.png").read_bytes()[:900])
    (folder / "words.tif").write_text("light\n")
    (folder / "empty.dng").touch()
    white = (folder / "white.dng").read_bytes()
    (folder / "cut.dng").write_bytes(white[:9000])
    for name, at in (("damaged.dng", -1000), ("damaged.exr", -100), ("damaged.h5", -1000)):
        good = bytearray(
            (
                folder
                / {".dng": "white.dng", ".exr": "capture.exr", ".h5": "pif.h5"}[Path(name).suffix]
            ).read_bytes()
        )
        good[at] ^= 64
        (folder / name).write_bytes(good)


def _deep(path):
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(4, 4, 1, "float")
    spec.channelnames, spec.deep = ("Z",), True
    deep = oiio.DeepData()
    deep.init(spec)
    out = oiio.ImageOutput.create(str(path))
    out.open(str(path), spec)
    out.write_deep_image(deep)
    out.close()


def _raws(folder):
    """Mosaics that open without an error and cannot be: as of any camera, without the
    digest that ours have.
    """
    rng = np.random.default_rng(7)
    noise = rng.integers(1000, 3000, (40, 40)).astype(np.uint16)

    def camera(name, values, black=0, white=4095, tags=None, change=(b"plenocli", b"plenoclx")):
        real = dng._tags
        with mock.patch.object(
            dng,
            "_tags",
            lambda *all: sorted(
                [tag for tag in real(*all) if tag[0] not in (tags or {})]
                + [dng._packed(*tag) for tag in (tags or {}).values()]
            ),
        ):
            dng.write_dng(
                folder / name, values.astype(np.uint16), cfa="RGGB", black=black, white=white
            )
        (folder / name).write_bytes((folder / name).read_bytes().replace(*change))

    camera("zeros.dng", noise * 0)
    camera("one.dng", noise * 0 + 300)
    camera("levels.dng", noise, black=5000)
    camera("over.dng", noise, white=900)
    camera("below.dng", noise // 100, black=2048)
    camera(
        "six.dng",
        noise,
        tags={
            33421: (33421, dng._SHORT, [6, 6]),
            33422: (33422, dng._BYTE, [0, 1, 2, 0, 1, 1] * 6),
        },
    )
    camera("green.dng", noise, tags={33422: (33422, dng._BYTE, [1, 1, 1, 1])})
    camera("no-white.dng", noise, change=(b'"white"', b'"whitf"'))


def _charts(folder):
    """Folders of colorchecker's captures: a good one, and copies with one thing wrong."""
    base = folder / "chart"
    base.mkdir()
    chart.paint_folder(base)
    labels, shape = chart.label_map(), chart.SHAPE
    shots = sorted(path.name for path in (base / "captures").iterdir())

    def save(path, values):
        path.unlink(missing_ok=True)  # a hard link of the good one
        chart.save(path, values)

    def like(name, change):
        shutil.copytree(base, folder / name, copy_function=os.link)
        change(folder / name)

    def burn(where, names=shots):
        return lambda made: [
            save(made / "captures" / name, np.where(where, 255, 40)) for name in names
        ]

    like("chart-sizes", lambda made: save(made / "captures" / shots[1], np.zeros((30, 30))))
    like("chart-unlabelled", lambda made: (made / "labels.png").unlink())
    like("chart-untold", lambda made: (made / "spectra.csv").unlink())
    like(
        "chart-violet",
        lambda made: [
            path.rename(path.with_name(path.name.replace("450nm", "400nm")))
            if "450nm" in path.name
            else path.unlink()
            for path in (made / "captures").iterdir()
        ],
    )
    like(
        "chart-dark",
        lambda made: [save(made / f"dark_{time}.tif", np.full(shape, 254)) for time in chart.TIMES],
    )
    like("chart-burnt", burn(labels >= 0))
    like("chart-glare", burn(labels == 1))
    like("chart-alone", burn(labels == 0))
    across = np.arange(shape[1]) // 10 + 1
    chart.save(folder / "line.png", np.broadcast_to(np.where(across < 25, across, 0), shape))
    chart.save(
        folder / "pieces.png", np.where((labels == 24) & (np.arange(shape[1]) % 2 == 0), 0, labels)
    )
    table = (base / "spectra.csv").read_text()
    for name, text in {
        "words": "a,b\nc,d\n",
        "nameless": table.replace("dark skin", "skin"),
        "down": "\n".join([table.splitlines()[0], *table.splitlines()[:0:-1]]),
    }.items():
        (folder / f"{name}.csv").write_text(text)


def _wavefronts(folder):
    for name, dataset, values, units in (
        ("none", "W", np.zeros((8, 8)), "m"),
        ("whole", "wavefront", np.zeros((8, 8, 2)), "m"),
        ("text", "wavefront", np.zeros((8, 8)), "m"),
        ("inches", "wavefront", np.zeros((8, 8)), "in"),
    ):
        with h5py.File(folder / f"wave-{name}.h5", "w") as file:
            file[dataset] = values
            file[dataset].attrs["units"] = units if name == "text" else np.bytes_(units)
    (folder / "wave-cut.h5").write_bytes((folder / "wave-inches.h5").read_bytes()[:1500])
    with h5py.File(folder / "wave-tall.h5", "w") as file:
        file["wavefront"] = np.zeros((8, 4))
    with h5py.File(folder / "wave-good.h5", "w") as file:
        file["wavefront"] = np.zeros((8, 8))


def _old_and_hostile(folder):
    from tests.files import test_container as container

    for name in HOSTILE:
        container.hostile(folder / f"{name.replace('_', '-')}.h5", getattr(container, f"_{name}"))
    for make in (_empty_group, _latin_name, _latin_text):
        container.hostile(folder / f"{make.__name__[1:].replace('_', '-')}.h5", make)
    with h5py.File(folder / "long.plain", "w", libver="latest") as file:
        file.attrs["notes"] = np.zeros((1 << 20) + 9)
    (folder / "long-text.h5").write_bytes(container.signed((folder / "long.plain").read_bytes()))
    (folder / "nonsense.h5").write_bytes(container.signed(b"nonsense" * 99))
    container.hostile(folder / "older.h5", lambda file: file.attrs.__setitem__("schema_version", 0))


def _empty_group(file):
    file.create_group("spectra/nothing")


def _latin_name(file):
    file.create_dataset(b"spectra/caf\xe9", data=np.zeros(3))


def _latin_text(file):
    file.attrs["command"] = np.bytes_(b"caf\xe9")


def configured(artefact, text):
    """Give an artefact another camera's description."""
    artefact.provenance = dataclasses.replace(artefact.provenance, config=text)


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
    changed(
        "lonely.h5",
        "pif.h5",
        lambda a: a.data.update({"pif/lenslet_offset": a.data["pif/lenslet_offset"] + 3}),
    )
    changed(
        "grid.h5",
        "calibration.h5",
        lambda a: [
            a.attrs.pop("response"),
            *(a.data.pop(k) for k in list(a.data) if k.startswith("response/")),
        ],
    )
    changed(
        "other-pif.h5",
        "pif.h5",
        lambda a: a.data.update(
            {
                "pif/A": a.data["pif/A"][:, :, :, :49],
                "pif/column_energy": a.data["pif/column_energy"][:, :49],
                "pif/object_shape": np.array([7, 7], np.int32),
            }
        ),
    )
    changed(
        "sceneless.h5",
        "capture.h5",
        lambda a: [a.data.pop(k) for k in ("capture/scene", "capture/wavelength") if k in a.data],
    )
    changed("hexagonal-pif.h5", "pif.h5", lambda a: a.attrs["pif"].update(lattice="hexagonal"))
    changed("colours.h5", "capture.h5", lambda a: a.data.update({"capture/cfa": "RGGB"}))
    changed("stateless.h5", "dictionary.h5", lambda a: a.data.pop("dictionary/state/iteration"))
    changed(
        "cropped.h5",
        "image.h5",
        lambda a: a.data.update(
            {k: v[:16, :16] for k, v in a.data.items() if k in ("image/value", "image/sigma")}
        ),
    )
    changed(
        "bands.h5",
        "image.h5",
        lambda a: [
            a.data.pop("image/sigma", None),
            a.data.update(
                {
                    "image/value": np.stack([a.data["image/value"]] * 2),
                    "image/wavelength": np.array([5e-7, 6e-7]),
                }
            ),
        ],
    )
    changed("noiseless.h5", "capture.h5", lambda a: a.attrs["capture"].pop("noise_sigma", None))
    changed("windowless.h5", "calibration.h5", lambda a: a.data.pop("response/white"))
    changed(
        "shifted.h5",
        "calibration.h5",
        lambda a: a.data.update({"response/wavelength": a.data["response/wavelength"] * 1.3}),
    )
    changed(
        "dim.h5",
        "calibration.h5",
        lambda a: a.data.update({"response/F": a.data["response/F"] * 0}),
    )
    changed(
        "flat-pif.h5",
        "pif.h5",
        lambda a: a.data.update({"pif/object_shape": np.array([4, 16], np.int32)}),
    )
    from plenocli.files.images.mosaic import read_capture

    for name in ("white", "dark", "450nm"):
        picture(
            folder / f"{name}.tif", read_capture(folder / f"{name}.dng").mosaic.astype(np.uint16)
        )
    white = read_capture(folder / "white.dng").mosaic.astype(np.uint16)
    y, x = np.mgrid[:120, :140]
    lit = (np.indices(white.shape) % 2).any(axis=0)
    flicker = np.kron(np.random.default_rng(8).uniform(0.6, 1, (6, 7)), np.ones((20, 20)))
    for name, values in {
        "redless": white * lit,
        "flicker": white * flicker,
        "oblong": 2000 * (2 + np.cos(y * np.pi / 5) + np.cos(x * np.pi / 9)),
    }.items():
        picture(folder / f"{name}.tif", values.astype(np.uint16))
    picture(folder / "little.tif", white[:50, :50].copy())
    picture(folder / "burnt.tif", np.full((120, 140), 65535, np.uint16))
    picture(folder / "sixty.exr", np.full((60, 60), 0.5, np.float32), ("Y",))
    (folder / "pieces").mkdir()
    for name in ("shards.h5", "shards.000.h5"):
        shutil.copy(folder / name, folder / "pieces")
    shutil.copy(folder / "shards.000.h5", folder / "pieces" / "shards.001.h5")
    changed(
        "blank.h5",
        "spectra.h5",
        lambda a: a.data.update({"spectra/value": a.data["spectra/value"] * np.nan}),
    )
    for method in ("pinv", "wls", "nnls"):
        changed(f"{method}.h5", "spectra.h5", lambda a: a.attrs["spectra"].update(method=method))
    changed(
        "few.h5",
        "pinv.h5",
        lambda a: a.data.update({k: v[..., :4] for k, v in a.data.items() if v.ndim > 1}),
    )
    changed(
        "red.h5",
        "spectra.h5",
        lambda a: a.data.update({"spectra/wavelength": a.data["spectra/wavelength"] * 1.3}),
    )
    changed(
        "silent.h5",
        "calibration.h5",
        lambda a: [a.attrs["response"].pop(k, None) for k in ("exposure_s", "gain_e_per_dn")],
    )
    changed("relative.h5", "calibration.h5", lambda a: a.attrs["response"].update(units="relative"))
    changed("colour-grid.h5", "calibration.h5", lambda a: a.attrs["white"].update(cfa="RGGB"))
    per_lenslet = ("response/F", "response/covariance", "response/white")
    changed(
        "own.h5",
        "calibration.h5",
        lambda a: a.data.update(
            {k: np.broadcast_to(a.data[k], (6, 7, *a.data[k].shape)).copy() for k in per_lenslet}
        ),
    )
    changed(
        "rows.h5",
        "own.h5",
        lambda a: a.data.update({k: v[:5] for k, v in a.data.items() if v.shape[:2] == (6, 7)}),
    )
    changed(
        "narrow.h5",
        "calibration.h5",
        lambda a: a.data.update({"response/window": a.data["response/window"] - 1}),
    )
    changed(
        "depth.h5",
        "planes.h5",
        lambda a: a.data.update(
            {
                "depth/distance": a.data["depth/slope"] * 0 + 0.5,
                "refocus/distance": np.array([0.6, 0.55, 0.5]),
            }
        ),
    )
    changed(
        "one-plane.h5",
        "depth.h5",
        lambda a: a.data.update({"refocus/distance": np.array([0.6, np.nan, np.nan])}),
    )
    changed("anonymous.h5", "capture.h5", lambda a: configured(a, ""))
    changed(
        "torn-pif.h5",
        "pif.h5",
        lambda a: a.data.update({"pif/object_shape": np.array([4, 8], np.int32)}),
    )
    changed(
        "wave-pif.h5",
        "pif.h5",
        lambda a: configured(a, (folder / "wavefront-good.toml").read_text()),
    )
    changed(
        "bare-sweep.h5",
        "sweep.h5",
        lambda a: a.data.update({k: v * np.nan for k, v in a.data.items() if v.dtype.kind == "f"}),
    )
    write_shards(folder, "ninths.h5", [(lenslet,) for lenslet in range(9)])
    changed(
        "moved.000.h5",
        "shards.000.h5",
        lambda a: a.data.update({"pif/lenslet_offset": a.data["pif/lenslet_offset"] + 5}),
    )
    moved = hashlib.sha256((folder / "moved.000.h5").read_bytes()).hexdigest()
    changed(
        "moved.h5",
        "shards.h5",
        lambda a: a.attrs["pif"]["shards"].__setitem__(
            0, {"name": "moved.000.h5", "sha256": moved}
        ),
    )
    changed(
        "index.h5",
        "shards.h5",
        lambda a: a.attrs["pif"].update({"shards": [{"name": "../x.h5", "sha256": "0" * 64}]}),
    )
