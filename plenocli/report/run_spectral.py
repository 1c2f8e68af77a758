"""The section of a run's page about spectra: scores, responses, bands, calibrations, captures."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import PlenoError
from plenocli.evaluation.metrics.response import response_error
from plenocli.evaluation.response_score import paired_responses
from plenocli.evaluation.results import Result
from plenocli.evaluation.scores import ScoreDocument
from plenocli.files.results.results import read_response, read_result
from plenocli.files.results.run_folder import RunFile, RunFolder
from plenocli.report.drawing import Figures
from plenocli.report.page import Page
from plenocli.report.run_spatial import add_captures, is_grid
from plenocli.report.score_page import add_spectra, add_table
from plenocli.report.tables import cell_text

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact

MOST_SPECTRA = 4
"""Results whose bands are drawn; the rest are listed."""


def of_bands(document: ScoreDocument) -> bool:
    """Whether a score document compares spectra or responses."""
    return any(one.wavelengths_nm for one in document.results)


def add_grids(page: Page, run: RunFolder) -> str | None:
    """The section about lenslet grids; returns its name, or None where there are none."""
    grids = [file for file in run.of_kind("calibration") if is_grid(file)]
    if not grids:
        return None
    page.section("Lenslets", "Where the lenslets stand on the sensor, as a white image shows them.")
    described: set[str] = set()
    for file in grids:
        _add_calibration(page, file, described)
    sources = {digest for file in grids for digest in file.sources.values()}
    add_captures(page, run, [f for f in run.of_kind("capture") if f.digest in sources])
    return "Lenslets"


def _of_responses(document: ScoreDocument) -> bool:
    return all(one.kind == "calibration" for one in document.results if not one.error)


def add_spectral(page: Page, run: RunFolder, scores: Sequence[RunFile]) -> str | None:
    """The section about spectra.

    scores: score documents of spectra and responses.

    Returns its name, None where there is nothing to show.
    """
    every, spectra = run.of_kind("calibration"), run.of_kind("spectra")
    calibrations = [file for file in every if not is_grid(file)]
    if not (scores or calibrations or spectra):
        return None
    page.section(
        "Spectral",
        (
            "Filters in the pupil of the main lens send each band to its own pixels behind a "
            "lenslet. The response F, measured under narrow-band light, is "
            "inverted for every lenslet."
        ),
    )
    responses = [file for file in scores if file.scores and _of_responses(file.scores)]
    groups: dict[Any, list[RunFile]] = {}
    for file in scores:
        if file not in responses:
            result = run.by_digest(file.sources.get("result 1"))
            groups.setdefault(file.folder if result is None else result.folder, []).append(file)
    for folder, files in groups.items():
        if len(groups) > 1:
            page.heading(f"Results in {folder.relative_to(run.root).as_posix()}")
        _add_merged_scores(page, run, files)
    for file in responses:
        _add_agreement(page, run, file)
    scored = {digest for file in scores for digest in file.sources.values()}
    _add_bands_alone(
        page, [file for file in spectra if file.digest not in scored and not _is_white(run, file)]
    )
    described: set[str] = set()
    for file in calibrations:
        _add_calibration(page, file, described)
    _add_captures(page, run, (*calibrations, *spectra))
    return "Spectral"


def _add_captures(page: Page, run: RunFolder, users: Sequence[RunFile]) -> None:
    """Captures that these files were made from: one of each sort before a second of any."""
    sources = {digest for file in users for digest in file.sources.values()}
    captures = [f for f in run.of_kind("capture") if f.digest in sources]
    # the pipelines name files by what they show
    sorts = [
        next((f for f in captures if word in f.path.name), None)
        for word in ("chart", "white", "band")
    ]
    by_digest = {f.digest: f for f in [*sorts, *captures] if f}
    add_captures(page, run, list(by_digest.values()))


def _add_merged_scores(page: Page, run: RunFolder, files: Sequence[RunFile]) -> None:
    """All score documents of one folder in one table and one set of bars."""
    documents = [(file, file.scores) for file in files if file.scores is not None]
    found = [
        (one, file.sources.get(f"result {number}"))
        for file, document in documents
        for number, one in enumerate(document.results, start=1)
        if one.wavelengths_nm
    ]
    merged = ScoreDocument(
        results=tuple(one for one, _ in found),
        definitions={
            name: text for _, document in documents for name, text in document.definitions.items()
        },
    )
    add_table(page, merged)
    drawn: list[tuple[str, Result]] = []
    for one, digest in found:
        file = run.by_digest(digest)
        if file is not None and len(drawn) < MOST_SPECTRA:
            drawn.append((one.label, read_result(file.path)))
    add_spectra(page, merged, drawn)


def _add_agreement(page: Page, run: RunFolder, file: RunFile) -> None:
    """Responses beside the one that was measured, band by band, and where in the superpixel the
    first one differs.
    """
    from plenocli.report.spectral_pictures import response_errors

    page.heading("Responses compared", file.made_by)
    if file.scores is not None:
        add_table(page, file.scores)
    first, truth = (run.by_digest(file.sources.get(role)) for role in ("result 1", "truth"))
    if first is None or truth is None:
        return
    pair = paired_responses(read_response(first.path), read_response(truth.path))
    error, _, mean = response_error(pair.first, pair.second)
    page.figure(
        response_errors(error, np.nanmax(mean, axis=0), pair.window, pair.wavelengths),
        f"{first.name} less {truth.name}, after a gain for each band.",
    )


def _is_white(run: RunFolder, file: RunFile) -> bool:
    return any(
        role.startswith("white") and digest == file.digest
        for user in run.users(file)
        for role, digest in user.sources.items()
    )


def _add_bands_alone(page: Page, files: Sequence[RunFile]) -> None:
    from plenocli.report.spectral_pictures import band_pictures

    if len(files) > MOST_SPECTRA:
        page.heading(f"Spectra without a score: {MOST_SPECTRA} of {len(files)}")
        page.others([file.name for file in files[MOST_SPECTRA:]])
    for file in files[:MOST_SPECTRA]:
        result = read_result(file.path)
        page.figure(
            band_pictures(result.values, result.bands, result.quantity or "value"),
            f"{file.name}: one value a lenslet and band; not scored.",
        )


def _add_calibration(page: Page, file: RunFile, described: set[str]) -> None:
    """One calibration; `described` holds the cameras whose filters are on the page already."""
    from plenocli.files.read.calibrations import calibration_of
    from plenocli.report.figures import calibration_figures

    artefact = file.artefact()
    attrs = artefact.attrs
    page.heading(f"Calibration {file.name.removesuffix('.h5')}", file.made_by)
    grid, response = attrs.get("grid", {}), attrs.get("response", {})
    rows = [
        [label, _listed(of.get(name))]
        for of, name, label in (
            (grid, "lattice", "lattice"),
            (grid, "pitch", "pitch, rows and columns [px]"),
            (grid, "angle", "rotation [deg]"),
            (grid, "rms", "rms distance from the lattice [px]"),
            (grid, "lenslets", "lenslets"),
            (response, "condition", "median condition number of F"),
        )
        if name in of
    ]
    page.table(["", ""], rows, text=True)
    if artefact.provenance.config not in described:
        described.add(artefact.provenance.config)
        page.figures(_filters(artefact))
    page.figures(calibration_figures(calibration_of(artefact)))


def _filters(artefact: "Artefact") -> Figures:
    """The filter array of the camera that a calibration was made for, where it is described."""
    from plenocli.files.config.camera_file import parse_camera
    from plenocli.report.spectral_pictures import filters_picture

    try:
        camera = parse_camera(artefact.provenance.config)
    except PlenoError:  # measured, or made by a program that describes cameras otherwise
        return []
    return (
        [
            (
                filters_picture(camera),
                (
                    "Filters in the pupil of the main lens, seen along the light, and "
                    "their transmittance."
                ),
            )
        ]
        if camera.filter_array
        else []
    )


def _listed(value: Any) -> str:
    return (
        " x ".join(f"{v:.5g}" for v in np.ravel(value))
        if not isinstance(value, (str, int, float))
        else cell_text(value)
    )
