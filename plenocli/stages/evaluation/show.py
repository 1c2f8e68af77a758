"""show: one picture of a file, or of several: artefacts, EXR, RAW and photographs."""

import io
import textwrap
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.text import by

CAPTION, LINE = 16, 24
"""Height of a letter and of a line of a caption, pixels."""


def run_show(
    files,
    output=None,
    *,
    truth=None,
    calibration=None,
    points=(),
    lenslets=(),
    overwrite=False,
):
    """Draw `files` into one PNG and return {"output", "files", "kinds", "captions"}.

    output: default the first file's name with .png, in the current folder.
    truth: what pictures are compared with, as in score.
    calibration: its lenslet grid is drawn over captures.
    points: (row, column) object points whose columns of A are shown;
    lenslets: whose spectra.
    InputError for a file that no stage would read, UsageError where points lie outside.
    """
    from plenocli.files.atomic import check_output, publish

    output = Path(output) if output is not None else Path(f"{Path(files[0]).stem}.png")
    check_output(output, overwrite=overwrite, suffixes=(".png",))
    centres = None if calibration is None else _centres(calibration)
    found = [opened(file) for file in files]
    kinds = [kind for kind, _ in found]
    if truth is not None:
        if set(kinds) != {"image"}:
            raise UsageError(
                "only pictures are compared with a truth",
                "--truth",
                "give image files, or leave the option out",
            )
        figures = _compared(files, truth)
    else:
        choice = _Choice(
            centres,
            points or None,
            lenslets or None,
            next((a for kind, a in found if kind == "pif"), None),
        )
        figures = [
            figure
            for file, (kind, artefact) in zip(files, found)
            for figure in _FIGURES[kind](Path(file), artefact, choice)
        ]
    publish(output, stacked(figures), overwrite=overwrite)
    return {
        "output": str(output),
        "files": [str(f) for f in files],
        "kinds": kinds,
        "captions": [caption for _, caption in figures],
    }


@dataclass(frozen=True)
class _Choice:
    """What of a file is drawn: lenslet centres over captures, points of A, lenslets of spectra,
    the pif whose sensor sees a dictionary.
    """

    centres: np.ndarray | None
    points: tuple | None
    lenslets: tuple | None
    pif: object


def opened(file):
    """(kind, verified artefact or None) of a file: pif, capture, calibration, dictionary,
    spectra or image; InputError where it is none.
    """
    from plenocli.files.artefacts.container import read_artefact
    from plenocli.files.artefacts.provenance import require_file
    from plenocli.files.artefacts.shards import read_pif
    from plenocli.files.images.exr import read_exr
    from plenocli.files.images.mosaic import CAPTURE, is_hdf5
    from plenocli.files.images.pictures import file_type
    from plenocli.files.images.spectral_exr import is_spectral

    path = Path(file)
    require_file(path)
    if is_hdf5(path):
        artefact = read_artefact(path)
        return (
            ("pif", read_pif(path)) if artefact.kind == "pif-index" else (artefact.kind, artefact)
        )
    if file_type(path) == "exr":
        return "spectra" if is_spectral(path) else "capture" if CAPTURE in read_exr(path)[
            1
        ] else "image", None
    return "capture", None


def _centres(path):
    from plenocli.files.artefacts.container import read_artefact

    return read_artefact(path, "calibration").data["grid/centre"]


def _pif(path, artefact, choice):
    from plenocli.report.figures import matrix_figures

    _inside(
        choice.points,
        tuple(int(n) for n in artefact.data["pif/object_shape"]),
        "--point",
        "object points",
    )
    return matrix_figures(artefact, choice.points)


def _inside(places, shape, option, what):
    for row, column in places or ():
        if not (row < shape[0] and column < shape[1]):
            raise UsageError(
                f"{row},{column} is outside {shape[0]} x {shape[1]} {what}", option, "count from 0"
            )


def _capture(path, artefact, choice):
    from plenocli.files.images.mosaic import read_capture
    from plenocli.report.figures import capture_figures

    centres = (
        choice.centres
        if choice.centres is not None or artefact is None
        else artefact.data.get("capture/lenslet_centre")
    )
    return capture_figures(read_capture(path), path.name, centres)


def _calibration(path, artefact, choice):
    from plenocli.report.figures import calibration_figures

    return calibration_figures(artefact)


def _dictionary(path, artefact, choice):
    from plenocli.files.read.results import read_result
    from plenocli.report.figures import dictionary_figures, learning, own_matrix

    system = None if choice.pif is None else own_matrix(choice.pif)
    return dictionary_figures(read_result(path), path.name, learning(artefact), system)


def _spectra(path, artefact, choice):
    from plenocli.files.read.results import read_result
    from plenocli.report.figures import spectra_figures

    result = read_result(path)
    _inside(choice.lenslets, result.grid, "--lenslet", "lenslets")
    return spectra_figures(result, path.name, choice.lenslets)


def _image(path, artefact, choice):
    from plenocli.files.read.results import read_result
    from plenocli.report.figures import image_figures, spectra_figures

    result = read_result(path)
    if result.wavelengths is not None:
        return spectra_figures(result, path.name)[:1]
    return image_figures(
        result, path.name, None if artefact is None else artefact.data.get("image/seen")
    )


def _sweep(path, artefact, choice):
    from plenocli.report.front import front_figures

    return front_figures(artefact)


def _lightfield(path, artefact, choice):
    from plenocli.report.planes import lightfield_figures

    return lightfield_figures(artefact)


_FIGURES = {
    "pif": _pif,
    "capture": _capture,
    "calibration": _calibration,
    "dictionary": _dictionary,
    "spectra": _spectra,
    "image": _image,
    "sweep": _sweep,
    "lightfield": _lightfield,
}


def _compared(files, truth):
    from plenocli.evaluation.metrics.quality import psnr
    from plenocli.files.read.results import block_of, read_result, read_truth
    from plenocli.report.pictures import close_ups, reconstructions

    results = [read_result(file, ("image",)) for file in files]
    several = [file for file, result in zip(files, results) if result.wavelengths is not None]
    if several:
        raise UsageError(
            "has several bands, and pictures of one are compared",
            several[0],
            "score --report draws bands beside their truth",
        )
    true = read_truth(truth, results[0])
    for file, result in zip(files, results):
        if result.values.shape != true.shape:
            raise InputError(
                f"is a picture of {by(result.values.shape)}, the first of {by(true.shape)}",
                file,
                "compare pictures of one size",
            )
    entries = [(r.method or r.name, r.values, f"{psnr(r.values, true):.2f} dB") for r in results]
    figures = [(reconstructions(entries, true), "Each result above its error.")]
    block = block_of(results[0], truth)
    if block is not None and min(np.floor_divide(true.shape, block)) >= 2:
        figures.append((close_ups(entries, true, block), "Close-up of the middle lenslets."))
    return figures


def stacked(figures):
    """One PNG of several (PNG, caption), below each other on white, each under its caption."""
    from matplotlib.font_manager import findfont
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.truetype(findfont("DejaVu Sans"), CAPTION)
    images = [Image.open(io.BytesIO(png)).convert("RGB") for png, _ in figures]
    width = max(image.width for image in images)
    captions = [
        textwrap.wrap(caption, max(20, int(width / (0.56 * CAPTION)))) for _, caption in figures
    ]
    heights = [len(lines) * LINE + LINE // 2 for lines in captions]
    sheet = Image.new(
        "RGB",
        (width, sum(i.height for i in images) + sum(heights) + LINE * (len(images) - 1)),
        "white",
    )
    pen, top = ImageDraw.Draw(sheet), 0
    for image, lines, height in zip(images, captions, heights):
        for number, line in enumerate(lines):
            pen.text((10, top + 6 + number * LINE), line, fill="#5b6670", font=font)
        sheet.paste(image, ((width - image.width) // 2, top + height))
        top += height + image.height + LINE
    buffer = io.BytesIO()
    sheet.save(buffer, "png")
    return buffer.getvalue()
