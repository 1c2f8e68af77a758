"""The pictures of Berkner et al. 2013 (Figs. 3 and 5 to 10) made anew, each beside what the paper
says of it, on one page.

python pipelines/paper.py SPATIAL_RUN SPECTRAL_RUN PAGE.html: from the folders that spatial.mk and
spectral.mk leave.
"""

import sys
from pathlib import Path

import numpy as np

from plenocli.files.artefacts.container import read_artefact
from plenocli.files.artefacts.shards import read_pif
from plenocli.files.atomic import publish
from plenocli.files.config.camera_file import parse_camera
from plenocli.files.images.mosaic import read_capture
from plenocli.files.results.matrices import matrix_of
from plenocli.files.results.results import read_block, read_result
from plenocli.files.results.scores import read_scores
from plenocli.files.results.truths import read_truth
from plenocli.report import figures, pictures, spectral_pictures
from plenocli.report.drawing import drawing, show_picture
from plenocli.report.page import Page

SAYS = {
    "Fig. 3": (
        "The pupil image function varies strongly under one lenslet: of a point on the axis, and "
        "of points a little off it, the sensor sees quite different patterns, which no "
        "geometric model gives."
    ),
    "Fig. 5": (
        "A prototype with four narrow-band filters (450, 540, 570, 650 nm) in the main lens; "
        "colour checker and captured sensor data."
    ),
    "Fig. 6": (
        "Calibration data under narrow-band light of 540 and 650 nm: which pixels of a "
        "superpixel answer to a band."
    ),
    "Fig. 7": (
        "Over white, black, red, orange, green and blue patches, demultiplexing is comparable to "
        "single-pixel extraction in error, and has a much higher SNR on white at two exposures."
    ),
    "Fig. 8": "An image at 650 nm: single pixel left, demultiplexed right.",
    "Fig. 9": (
        "An example of the system matrix, atoms learnt for it in object space, and what the "
        "sensor sees of them."
    ),
    "Fig. 10": (
        "A planar object through 11 x 11 lenslets at 60 dB: non-linear least squares 22.5 dB, the "
        "learnt dictionary 26.1 dB, on a picture (the doll) that is not public; blocking could be "
        "removed by averaging over 3 x 3 lenslets."
    ),
}


def main(spatial, spectral, output):
    """Write the page; files that are missing are an error of the run before."""
    spatial, spectral = Path(spatial), Path(spectral)
    page = Page(
        "The paper's pictures, computed",
        (
            "K. Berkner, L. Meng, S. A. Shroff, I. Tosic, End-to-end System Model for Plenoptic "
            "Cameras (2013): what it shows and says, and what plenocli gives."
        ),
    )
    parts = {
        "Fig. 3": (_columns, spatial),
        "Fig. 5": (_prototype, spectral),
        "Fig. 6": (_bands, spectral),
        "Fig. 7": (_errors, spectral),
        "Fig. 8": (_photograph, spectral),
        "Fig. 9": (_learnt, spatial),
        "Fig. 10": (_reconstructed, spatial),
    }
    for name, (draw, run) in parts.items():
        page.section(name, f"The paper: {SAYS[name]}")
        for png, caption in draw(run):
            page.figure(png, caption)
    publish(Path(output), page.render().encode(), overwrite=True)


def _columns(run):
    artefact = read_pif(run / "pif.h5")
    rows, columns = (int(n) for n in artefact.data["pif/object_shape"])
    points = [(rows // 2, columns // 2), (rows // 2, columns - 2), (1, columns - 2)]
    return figures.matrix_figures(matrix_of(artefact), points)[:1]


def _prototype(run):
    config = parse_camera(read_artefact(run / "measured.h5").provenance.config or _config(run))
    chart = read_capture(run / "raw" / "chart-long.dng")
    centres = read_artefact(run / "measured.h5").data["grid/centre"]
    return [
        (
            spectral_pictures.filters_picture(config),
            "Filters in the pupil and their transmittance.",
        ),
        *figures.capture_figures(chart, "chart-long.dng", centres),
    ]


def _config(run):
    return read_artefact(run / "predicted.h5").provenance.config


def _bands(run):
    centres = read_artefact(run / "measured.h5").data["grid/centre"]
    return [
        figure
        for nm in (540, 650)
        for figure in figures.capture_figures(
            read_capture(run / "raw" / f"band-{nm}nm.dng"), f"band-{nm}nm.dng", centres
        )
    ]


def _errors(run):
    entries = []
    for exposure in ("long", "short"):
        document = read_scores(run / f"score-measured-{exposure}.json")
        entries += [
            one
            for one in document.results
            if Path(one.name).stem.endswith(("pinv", "single-pixel"))
        ]
    return [
        (
            spectral_pictures.accuracy_bars(entries),
            "Error over the six patches and SNR on white, by band, at both exposures.",
        )
    ]


def _photograph(run):
    with drawing(9.6, 3.6) as made:
        for axes, (method, name) in zip(
            made.figure.subplots(1, 2),
            (("single-pixel", "single pixel"), ("pinv", "demultiplexed")),
            strict=True,
        ):
            result = read_result(run / "spectra" / "measured" / f"photo-{method}.h5")
            band = int(np.argmin(np.abs(result.wavelengths - 650e-9)))
            show_picture(
                axes,
                result.values[band] / np.nanpercentile(result.values[band], 99.5),
                f"{name}, {result.wavelengths[band] * 1e9:.0f} nm",
            )
    return [(made.png, "A photograph at the short exposure, one value a lenslet.")]


def _learnt(run):
    matrix = matrix_of(read_pif(run / "pif.h5"))
    atoms = figures.dictionary_figures(read_result(run / "dictionary.h5"), "dictionary.h5", matrix)
    return [*figures.matrix_figures(matrix)[1:], *atoms]


def _reconstructed(run):
    truth = run / "paper" / "capture.h5"
    names = [
        n
        for n in ("nnls-300", "tikhonov", "lmmse", "pnp", "dictionary")
        if (run / "paper" / f"{n}.h5").exists()
    ]
    scores = {
        Path(one.name).stem: one.number("psnr_db")
        for one in read_scores(run / "score-paper.json").results
    }
    results = [read_result(run / "paper" / f"{n}.h5") for n in names]
    true = read_truth(truth, results[0])
    entries = [(n, r.values, f"{scores[n]:.2f} dB") for n, r in zip(names, results)]
    return [
        (
            pictures.reconstructions(entries, true),
            "The astronaut in the doll's place; each result above its error.",
        ),
        (
            pictures.close_ups(entries, true, read_block(results[0], truth)),
            "Close-up of the middle lenslets.",
        ),
    ]


if __name__ == "__main__":
    main(*sys.argv[1:4])
