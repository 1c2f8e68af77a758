"""The section of a run's page about pictures: scores, reconstructions, captures, matrices and
dictionaries.
"""

from collections.abc import Sequence

import numpy as np

from plenocli.base.errors import InputError, PlenoError
from plenocli.evaluation.scores import ScoreDocument
from plenocli.files.results.matrices import matrix_of
from plenocli.files.results.results import read_block, read_result, result_of
from plenocli.files.results.run_folder import RunFile, RunFolder
from plenocli.files.results.truths import read_truth
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.report.page import Page
from plenocli.report.score_page import Compared, add_reconstructions, add_table
from plenocli.report.tables import cell_text

MOST_CAPTURES = 3
"""Drawn in a section; the rest are listed."""


MOST_MATRICES = 2
"""System matrices that are drawn."""
MOST_ALONE = 6
"""Results without a score that are drawn."""


def of_pictures(document: ScoreDocument) -> bool:
    """Whether a score document compares pictures."""
    return any("psnr_db" in one.figures and not one.wavelengths_nm for one in document.results)


def is_grid(file: RunFile) -> bool:
    """Whether a calibration holds the lenslets alone, of a camera that has no filters to tell."""
    return "response/F" not in file.artefact().data


def add_spatial(page: Page, run: RunFolder, scores: Sequence[RunFile]) -> str | None:
    """The section about pictures.

    scores: score documents of pictures.

    Returns its name, None where there is nothing to show.
    """
    images = [
        file
        for file in run.of_kind("image")
        if not any(user.kind == "capture" for user in run.users(file))
    ]
    matrices, captures = _of_pictures(run, images)
    dictionaries = run.of_kind("dictionary")
    if not (scores or images or matrices or dictionaries or captures):
        return None
    page.section(
        "Spatial",
        (
            "Wave optics carries each object point through main lens and lenslet to the pixels "
            "behind it: one column of the system matrix A. Inverting A gives more object points "
            "than there are lenslets."
        ),
    )
    for file in scores:
        document = file.scores
        if document is None:
            continue
        page.heading(file.name.removesuffix(".json"), file.made_by)
        add_table(page, document)
        _add_drawn_results(page, run, file, document)
    scored = {digest for file in scores for digest in file.sources.values()}
    _add_alone(page, [file for file in images if file.digest not in scored])
    add_captures(page, run, captures)
    for file in matrices[:MOST_MATRICES]:
        _add_matrix(page, file)
    page.others([file.name for file in matrices[MOST_MATRICES:]])
    for file in dictionaries:
        _add_dictionary(page, run, file)
    return "Spatial"


def _of_pictures(run: RunFolder, images: Sequence[RunFile]) -> tuple[list[RunFile], list[RunFile]]:
    """(matrices, captures) that belong to pictures: what an image came from directly; without
    images, whatever no calibration used.
    """
    direct = {
        digest for file in (*images, *run.of_kind("dictionary")) for digest in file.sources.values()
    }
    calibrated = {
        digest
        for file in (*run.of_kind("calibration"), *run.of_kind("spectra"))
        for digest in file.sources.values()
    }
    homes = {file.folder for file in run.of_kind("calibration") if not is_grid(file)}

    def belongs(file: RunFile) -> bool:
        # a DNG does not say what it was for: what lies with a calibration belongs to it
        beside = homes & {file.folder, *file.folder.parents}
        return file.digest in direct or not (file.digest in calibrated or beside)

    matrices = sorted(
        filter(belongs, run.of_kind("pif")), key=lambda file: file.digest not in direct
    )
    return matrices, list(filter(belongs, run.of_kind("capture")))


def _add_drawn_results(page: Page, run: RunFolder, file: RunFile, document: ScoreDocument) -> None:
    """Pictures of the results of a score document, as far as they still lie in the folder."""
    truth = run.by_digest(file.sources.get("truth"))
    pairs = []
    for number, one in enumerate(document.results, start=1):
        found = run.by_digest(file.sources.get(f"result {number}"))
        if found is None or truth is None or found.kind != "image":
            continue
        try:
            result = read_result(found.path)
            if result.wavelengths is None:
                compared = Compared(
                    result=result,
                    truth=read_truth(truth.path, result),
                    block=read_block(result, truth.path),
                )
                pairs.append((one, compared))
        except PlenoError as error:
            page.warning(str(error))
    add_reconstructions(page, pairs)


def _add_alone(page: Page, files: Sequence[RunFile]) -> None:
    """Reconstructions that nobody scored, real captures' for instance."""
    from plenocli.report.figures import image_figures

    alone = [file for file in files if file.kind == "image"]
    if len(alone) > MOST_ALONE:
        page.heading(f"Pictures without a score: {MOST_ALONE} of {len(alone)}")
        page.others([file.name for file in alone[MOST_ALONE:]])
    for file in alone[:MOST_ALONE]:
        result = read_result(file.path)
        if result.wavelengths is None:
            page.figures(image_figures(result, file.name))


def add_captures(page: Page, run: RunFolder, files: Sequence[RunFile]) -> None:
    """Some captures as pictures, how many there are, and the names of the others."""
    shown, others = files[:MOST_CAPTURES], files[MOST_CAPTURES:]
    if shown:
        page.heading(f"Captures: {len(shown)} of {len(files)}" if others else "Captures")
    for file in shown:
        add_capture(page, run, file)
    page.others([file.name for file in others])


def add_capture(page: Page, run: RunFolder, file: RunFile) -> None:
    """One capture with its lenslet grid: its own, or that of a calibration which it was made for or
    made with.
    """
    from plenocli.files.images.mosaic import read_capture
    from plenocli.files.read.calibrations import calibration_of
    from plenocli.report.figures import capture_figures

    try:
        capture = read_capture(file.path)
    except InputError as error:
        page.warning(str(error))
        return
    centres = None
    if file.kind == "capture" and file.path.suffix == ".h5":
        centres = file.artefact().data.get("capture/lenslet_centre")
    users = run.users(file)
    made = (user for user in users if user.kind == "calibration")
    beside = (run.source_of_kind(user, "calibration") for user in users)
    calibration = next(made, None) or next((one for one in beside if one), None)
    if centres is None and calibration is not None:
        centres = calibration_of(calibration.artefact()).grid.centres
    page.figures(capture_figures(capture, file.name, centres))


FACTS = (
    ("symmetry_defect", "symmetry defect (0: half of the object is invisible)"),
    ("coherent_ring", "rings of neighbours added coherently"),
    ("kappa", "kappa [1/m]"),
    ("model", "propagation"),
)
"""What is told of a system matrix, and in what words."""


def _add_matrix(page: Page, file: RunFile) -> None:
    from plenocli.report.figures import matrix_figures

    matrix = matrix_of(file.artefact(), file.path)
    page.heading(f"System matrix {file.name.removesuffix('.h5')}", file.made_by)
    facts = [
        (
            "bands x superpixels x pixels x object points",
            " x ".join(str(n) for n in matrix.blocks.shape),
        ),
        ("what is told apart", "; ".join(dict.fromkeys(matrix.told_apart()))),
    ]
    facts += [
        (label, cell_text(matrix.facts.get(name))) for name, label in FACTS if name in matrix.facts
    ]
    record = matrix.accuracy or AccuracyRecord()
    page.table(["", ""], [list(fact) for fact in [*facts, *_plan(record)]], text=True)
    why = [*(record.reasons or ()), *(f"left out: {text}" for text in record.left_out or ())]
    if why:
        page.code("\n".join(map(str, why)), "Why: the accuracy plan")
    page.figures(matrix_figures(matrix))


def _plan(record: AccuracyRecord) -> list[tuple[str, str]]:
    """What simulate-pif planned: the accuracy asked for, what it expects, and where that comes
    from.
    """
    by_source = sorted((record.by_source or {}).items(), key=lambda item: -item[1])
    parts = ", ".join(f"{name} {cell_text(error)}" for name, error in by_source if error)
    told = []
    if record.asked is not None:
        told.append(
            (
                "accuracy asked for",
                f"{cell_text(record.asked)} ({record.asked_by or 'request'})",
            )
        )
    if record.estimated is not None:
        expected = cell_text(record.estimated)
        told.append(("error expected", f"{expected}: {parts}" if parts else expected))
    if record.rung is not None:
        told.append(("computed by", record.rung))
    if record.model_error is not None:
        told.append(("error of that model itself", cell_text(record.model_error)))
    return told


def _add_dictionary(page: Page, run: RunFolder, file: RunFile) -> None:
    from plenocli.report.figures import dictionary_figures

    artefact = file.artefact()
    page.heading(f"Dictionary {file.name.removesuffix('.h5')}", file.made_by)
    attrs = artefact.attrs.get("dictionary", {})
    rows = [
        [name.replace("_", " "), cell_text(value)]
        for name, value in attrs.items()
        if isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    ]
    page.table(["", ""], rows, text=True)
    notes = attrs.get("notes")
    if isinstance(notes, dict) and notes.get("beats_lmmse") is False:
        page.warning(
            "This dictionary does not beat LMMSE on held-out pictures "
            f"({notes.get('averaged_psnr_db', notes.get('validation_psnr_db', 0)):.2f} against "
            f"{notes.get('lmmse_psnr_db', 0):.2f} dB): reconstruct with LMMSE instead."
        )
    source = run.source_of_kind(file, "pif")
    matrix = None if source is None else matrix_of(source.artefact(), source.path)
    page.figures(dictionary_figures(result_of(artefact, file.path), file.name, matrix))
