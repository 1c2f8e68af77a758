"""What mismatch.mk disturbs: cameras and captures that are not quite as described, and the table.

python pipelines/mismatch.py camera ROW CONFIG -o camera.toml
python pipelines/mismatch.py shift finer.h5 nominal.h5 -o pif.h5
python pipelines/mismatch.py capture ROW capture.h5 -o capture.h5
python pipelines/mismatch.py report RUN -o report.html
"""

import argparse
import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import file_digest
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.shards import read_pif
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.atomic import publish
from plenocli.files.config.camera_file import to_toml
from plenocli.files.read.cameras import read_camera
from plenocli.files.results.scores import read_scores
from plenocli.report.page import Page

ROWS = {
    "none": "nothing: captured and inverted with the same matrix",
    "exact": "exact model, inverted paraxially",
    "exact-fast": "the same at f/4.4",
    "focus": "object at 556 mm instead of 550",
    "veil-1": "veil of 1 % of the mean light",
    "veil-5": "veil of 5 %",
    "pitch": "lenslets and pixels 0.1 % larger",
    "wavelength": "560 nm instead of 550",
    "shift": "sensor off by 0.1 pixel in both directions",
    "lenslet-focus": "lenslets' focal length +0.5 %",
    "sensor-distance": "sensor distance +0.5 %, lenslets registered",
    "dead": "0.5 % of the pixels dead",
    "hot": "0.05 % of the pixels hot",
    "clipped": "clipped at 60 % of the brightest pixel",
    "dim-100": "a hundredth of the light, same SNR",
    "dim-1000": "a thousandth of the light, same SNR",
}
"""Row -> what is disturbed."""
SAID = ("lost", "noise", "kept")
"""What the second table has of each method."""
FINER = 3
"""Pixels of the matrix that the shifted one is put together from, a side of each pixel."""
SHIFT = 0.1
"""Of the sensor, pixels."""


# --- cameras --------------------------------------------------------------------------------------


def camera(row, config, size, count):
    """The camera of a row, TOML text.

    size: "half" or "full".
    count: most lenslets a side.
    """
    found = read_camera(config)
    if size == "half":
        found = _halved(found)
    lenslets = tuple(min(n, count) for n in found.lenslet_array.count)
    found = found.replace(**{"lenslet_array.count": lenslets})
    if row.endswith("-fast"):
        found = _at_f_number(found, 4.4)
    return to_toml(CAMERAS.get(row, lambda nominal: nominal)(found))


def _halved(camera):
    """Half as many points and pixels, lenslets of half the width and the same f-number."""
    pixels, points = camera.sensor.pixels_per_lenslet, camera.object.samples_per_lenslet
    return _registered(
        camera,
        camera.sensor.distance / 2,
        camera.superpixel_pitch / 2,
        {
            "lenslet_array.focal_length": camera.lenslet_array.focal_length / 2,
            "sensor.pixels_per_lenslet": tuple(n // 2 for n in pixels),
            "object.samples_per_lenslet": tuple(n // 2 for n in points),
        },
    )


def _at_f_number(camera, f_number):
    """The camera with another aperture, whose image behind a lenslet stays as wide."""
    array, lens = camera.lenslet_array, camera.main_lens
    closer = f_number * lens.aperture_diameter / array.distance
    return _registered(
        camera,
        camera.sensor.distance * closer,
        camera.superpixel_pitch,
        {
            "main_lens.aperture_diameter": array.distance / f_number,
            "lenslet_array.focal_length": array.focal_length * closer,
        },
    )


def _registered(camera, distance, pitch, changes):
    """The camera with its sensor at `distance` (m), the lenslets' images `pitch` (m) apart."""
    spacing = pitch / (1 + distance / camera.lenslet_array.distance)
    return camera.replace(
        **changes, **{"sensor.distance": distance, "lenslet_array.pitch": spacing}
    )


def _finer(camera):
    """Pixels of a third, of which the shifted ones are made."""
    pixels = camera.sensor.pixels_per_lenslet
    return camera.replace(
        **{
            "sensor.pixel_pitch": camera.sensor.pixel_pitch / FINER,
            "sensor.pixels_per_lenslet": tuple(n * FINER for n in pixels),
        }
    )


def _larger(camera):
    """Lenslets and pixels 0.1 % larger: superpixels stay whole pixels."""
    pitches = {
        "lenslet_array.pitch": camera.lenslet_array.pitch * 1.001,
        "sensor.pixel_pitch": camera.sensor.pixel_pitch * 1.001,
    }
    return camera.replace(**pitches)


CAMERAS = {
    "focus": lambda c: c.replace(**{"object.distance": c.object.distance * 556 / 550}),
    "pitch": _larger,
    "wavelength": lambda c: c.replace(
        **{"light.wavelengths": tuple(w * 560 / 550 for w in c.light.wavelengths)}
    ),
    "finer": _finer,
    "lenslet-focus": lambda c: c.replace(
        **{"lenslet_array.focal_length": c.lenslet_array.focal_length * 1.005}
    ),
    "sensor-distance": lambda c: _registered(c, c.sensor.distance * 1.005, c.superpixel_pitch, {}),
}
"""Row -> the camera that is disturbed so, of that as described."""


# --- matrices and captures ------------------------------------------------------------------------


def shifted(finer, nominal):
    """The pif `nominal` with a sensor off by SHIFT: sums of the light on finer pixels,
    interpolated.
    """
    from scipy.interpolate import CubicSpline

    fine, told = read_pif(finer), read_pif(nominal)
    rows, columns = (int(n) for n in told.data["pif/pixel_shape"])
    light = fine.data["pif/A"].astype(float)
    light = light.reshape(*light.shape[:2], rows * FINER, columns * FINER, -1)
    for axis, pixels in ((2, rows), (3, columns)):
        sums = np.concatenate(
            [np.zeros_like(light.take([0], axis)), np.cumsum(light, axis)], axis=axis
        )
        edges = np.clip(np.arange(pixels + 1) + SHIFT, 0, pixels) * FINER
        spline = CubicSpline(np.arange(pixels * FINER + 1), sums, axis=axis)
        light = np.diff(spline(edges), axis=axis)
    matrix = told.data["pif/A"]
    matrix = np.maximum(light, 0).reshape(matrix.shape).astype(matrix.dtype)
    energy = matrix.sum(axis=(1, 2), dtype=float)
    data = told.data | {"pif/A": matrix, "pif/column_energy": energy}
    return Artefact("pif", data, told.attrs, told.provenance)


def disturbed(row, capture):
    """The capture artefact of a row, of one without a disturbance."""
    found = read_artefact(capture, "capture")
    mosaic, rng = found.data["capture/mosaic"].copy(), np.random.default_rng(5)
    said, scene = dict(found.attrs["capture"]), found.data["capture/scene"]
    draws = rng.random(mosaic.shape)
    kind, _, amount = row.partition("-")
    if kind == "veil":
        mosaic += mosaic.mean() * int(amount) / 100
    elif kind == "dead":
        mosaic[draws < 0.005] = 0
    elif kind == "hot":
        mosaic[draws < 0.0005] = mosaic.max()
    elif kind == "clipped":
        said["white"] = 0.6 * float(mosaic.max())
        mosaic = np.minimum(mosaic, said["white"])
    elif kind == "dim":
        mosaic, scene = mosaic / int(amount), scene / int(amount)
        said["noise_sigma"] = said["noise_sigma"] / int(amount)
    else:
        raise SystemExit(f"no capture is disturbed by {row!r}")
    data = found.data | {"capture/mosaic": mosaic, "capture/scene": scene.astype(np.float32)}
    return replace(found, data=data, attrs={"capture": said})


# --- the table ------------------------------------------------------------------------------------


def report(run, output):
    """Tables beside `output` (.csv, .md) and a page.

    PSNR is relative to the white of the scene, dim ones too. Each row is a mean over the scenes.
    """
    run, output = Path(run), Path(output)
    files = sorted((run / "scores").glob("*.json"))
    scenes = sorted({f.stem.split("--")[0] for f in files})
    found, said = _figures(files)
    for scene, row, method in {(s, r, m) for s, _, x, m in found if x == "right" for r in ROWS}:
        # a matrix that is right all along does as well as it can without the disturbance
        found.setdefault((scene, row, "right", method), found[scene, "none", "nominal", method])
    columns = _columns(found)
    page = Page(
        "A matrix that is not this camera's",
        f"PSNR (dB), mean of {', '.join(scenes)}: captures that are disturbed, inverted by the "
        "matrix of the camera as described (nominal), with its parameters fitted (fit) and by the "
        "matrix that made the capture (right); where that is the nominal one, as it would be "
        "without the disturbance.",
    )
    page.section("All methods")
    header = ["disturbance", *(f"{method}, {matrix}" for matrix, method in columns)]
    rows = [
        [ROWS[row], *(_cell([found.get((s, row, *c)) for s in scenes]) for c in columns)]
        for row in ROWS
    ]
    page.table(header, rows)
    told = [
        "disturbance",
        *(f"{m}: {what}" for m in _told(found, said) for what in SAID),
    ]
    claims = [[ROWS[row], *_claims(found, said, scenes, row)] for row in ROWS]
    page.section(
        "What is said of it",
        "dB lost to the disturbance with the nominal matrix, and what the picture says of it: how "
        "many times its noise the capture seems to have, and the share of detail that was kept "
        "(the worst scene of each).",
    )
    page.table(told, claims)
    publish(output, page.render().encode(), overwrite=True)
    publish(output.with_name("table.md"), _markdown(header, rows).encode(), overwrite=True)
    with open(output.with_name("table.csv"), "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["scene", "row", "matrix", "method", "psnr_db", "noise_raised", "kept"])
        for key, value in found.items():
            writer.writerow([*key, f"{value:.3f}", *said.get(key, ())])
    print(_markdown(header, rows))


def _figures(files):
    """{(scene, row, matrix, method): PSNR} and what the pictures say, {the same: (noise over the
    capture's, share of detail kept)}.
    """
    found, said = {}, {}
    # a document tells a result by its name, which it has in every folder, and its digest
    folders = {
        file_digest(path): (path.parent.parent.name, path.parent.name)
        for matrix in ("nominal", "fit", "right")
        for path in (files[0].parent.parent / matrix).glob("*/*.h5")
    }
    for file in files:
        scene, _, row = file.stem.partition("--")
        brighter = 20 * math.log10(int(row[4:])) if row.startswith("dim-") else 0.0
        document = read_scores(file)
        for number, one in enumerate(document.results, start=1):
            key = scene, row, *folders[document.inputs[f"result {number}"].sha256]
            found[key] = one.number("psnr_db") - brighter
            if one.number("noise_raised") is not None:
                said[key] = one.number("noise_raised"), one.number("detail_kept")
    return found, said


def _columns(found):
    order = {matrix: number for number, matrix in enumerate(("nominal", "fit", "right"))}
    pairs = list(dict.fromkeys((matrix, method) for _, _, matrix, method in found))
    return sorted(pairs, key=lambda pair: order.get(pair[0], 9))


def _cell(values):
    known = [v for v in values if v is not None]
    return f"{np.mean(known):.1f}" if known else ""


def _told(found, said):
    """Methods whose loss is known, and about which something is said."""
    known = {method for _, _, matrix, method in found if matrix == "right"}
    return sorted(known & {key[3] for key in said if key[2] == "nominal"})


def _claims(found, said, scenes, row):
    cells = []
    for method in _told(found, said):
        lost, raised, kept = [], [], []
        for scene in scenes:
            key = scene, row, "nominal", method
            if key in found:
                lost.append(found[scene, row, "right", method] - found[key])
            if key in said:
                raised.append(said[key][0])
                kept.append(said[key][1])
        cells.append(f"{max(lost):.1f}" if lost else "")
        cells += [f"{max(raised):.3g}", f"{min(kept):.2f}"] if raised else ["nothing", ""]
    return cells


def _markdown(header, rows):
    lines = [header, ["---"] + ["---:"] * (len(header) - 1), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


# --- the command ----------------------------------------------------------------------------------


def main():
    """One of the four jobs of the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    jobs = parser.add_subparsers(dest="job", required=True)
    for job, names in (
        ("camera", ("row", "config")),
        ("shift", ("finer", "nominal")),
        ("capture", ("row", "capture")),
        ("report", ("run",)),
    ):
        made = jobs.add_parser(job)
        for name in names:
            made.add_argument(name)
        made.add_argument("-o", "--output", type=Path, required=True)
        if job == "camera":
            made.add_argument("--size", choices=["half", "full"], default="half")
            made.add_argument("--count", type=int, default=6)
    said = parser.parse_args()
    if said.job == "camera":
        text = camera(said.row, said.config, said.size, said.count)
        publish(said.output, text.encode(), overwrite=True)
    elif said.job == "shift":
        write_artefact(said.output, shifted(said.finer, said.nominal), overwrite=True)
    elif said.job == "capture":
        write_artefact(said.output, disturbed(said.row, said.capture), overwrite=True)
    else:
        report(said.run, said.output)


if __name__ == "__main__":
    main()
