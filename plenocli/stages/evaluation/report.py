"""report: one page about everything that lies in a run folder."""

import numpy as np

from plenocli.base.errors import InputError, PlenoError
from plenocli.files.read.results import block_of, read_result, read_truth
from plenocli.files.read.run_folder import RunFolder
from plenocli.report.page import Page
from plenocli.report.score_page import add_reconstructions, add_spectra, add_table

_CAPTURES = 3  # drawn in a section; the rest are listed
_SPECTRA = 4


def run_report(folder, output, *, title=None, overwrite=False):
    """Write one self-contained page about a run folder; returns a summary dict.

    InputError where the folder holds nothing to show. Files that cannot be read are named on the
    page and in the summary.
    """
    from plenocli.files.atomic import check_output, publish

    check_output(output, overwrite=overwrite, suffixes=(".html",))
    run = RunFolder(folder)
    page = Page(
        title or f"plenocli report: {run.root.resolve().name}",
        (
            "A plenoptic camera modelled end to end: what it captured, what was recovered, "
            "and how good that is."
        ),
    )
    scores = run.of_kind("score")
    spatial = [file for file in scores if _of_pictures(file)]
    spectral = [file for file in scores if _of_bands(file)]
    page.cards(_headlines(spatial, spectral))
    for name, problem in run.unreadable:
        page.warning(f"{name} could not be read: it {problem}.")
    sections = [
        _spatial(page, run, spatial),
        _spectral(page, run, spectral),
        _refocused(page, run, scores),
        _designs(page, run),
    ]
    _files(page, run)
    publish(output, page.render().encode(), overwrite=overwrite)
    return {
        "output": str(output),
        "files": len(run.files),
        "unreadable": [name for name, _ in run.unreadable],
        "scores": len(scores),
        "sections": [name for name in sections if name],
    }


def _of_pictures(file):
    return any(
        "psnr_db" in entry["metrics"] and not entry.get("wavelengths_nm")
        for entry in file.content["results"]
    )


def _of_bands(file):
    return any(entry.get("wavelengths_nm") for entry in file.content["results"])


def _headlines(spatial, spectral):
    """The best number of each experiment."""
    cards = []
    for file in spatial:
        best = max(
            (e for e in file.content["results"] if e["metrics"].get("psnr_db") is not None),
            key=lambda e: e["metrics"]["psnr_db"],
            default=None,
        )
        if best:
            cards.append(
                (
                    f"{best['metrics']['psnr_db']:.2f} dB",
                    f"best PSNR, {best['label']} ({file.path.stem})",
                )
            )
    entries = [e for file in spectral for e in file.content["results"]]
    errors = [(e["metrics"].get("six_patch_rmse", e["metrics"].get("rmse")), e) for e in entries]
    errors = [(value, e) for value, e in errors if value is not None]
    if errors:
        value, entry = min(errors, key=lambda pair: pair[0])
        cards.append((f"{value:.4f}", f"least RMSE in reflectance, {entry['label']}"))
    ratios = [
        (e["metrics"]["snr_capture_mean_db"], e)
        for e in entries
        if e["metrics"].get("snr_capture_mean_db") is not None
    ]
    if ratios:
        value, entry = max(ratios, key=lambda pair: pair[0])
        cards.append((f"{value:.1f} dB", f"best capture SNR, mean of bands, {entry['label']}"))
    return cards


# --- spatial --------------------------------------------------------------------------------------


def _spatial(page, run, scores):
    """The section about pictures; returns its name, or None where there is nothing to show."""
    from plenocli.report.pictures import method_bars

    images = [
        file
        for file in run.of_kind("image")
        if not any(user.kind == "capture" for user in run.users(file))
    ]
    # What an image came from directly is a picture's matrix or capture; without images, whatever
    # no calibration used.
    direct = {
        digest for file in (*images, *run.of_kind("dictionary")) for digest in file.sources.values()
    }
    calibrated = {
        digest
        for file in (*run.of_kind("calibration"), *run.of_kind("spectra"))
        for digest in file.sources.values()
    }
    homes = {file.folder for file in run.of_kind("calibration")}

    # a DNG does not say what it was for: what lies with a calibration belongs to it
    def here(file):
        return file.digest in direct or not (
            file.digest in calibrated or homes & {file.folder, *file.folder.parents}
        )

    matrices, captures = (
        filter(here, run.of_kind("pif")),
        list(filter(here, run.of_kind("capture"))),
    )
    matrices = sorted(matrices, key=lambda file: file.digest not in direct)
    if not (scores or images or matrices or run.of_kind("dictionary") or captures):
        return None
    page.section(
        "Spatial",
        (
            "Wave optics carries each object point through main lens and lenslet to the pixels "
            "behind it: one column of the system matrix A. Inverting A gives more object points "
            "than there are lenslets."
        ),
    )
    if scores:
        page.figure(
            method_bars(
                [
                    (
                        file.path.stem,
                        [
                            e
                            for e in file.content["results"]
                            if e["metrics"].get("psnr_db") is not None
                        ],
                    )
                    for file in scores
                ]
            ),
            "Quality of every method; the dashed line is the PSNR of one value a lenslet.",
        )
    for file in scores:
        page.heading(file.name.removesuffix(".json"), file.command)
        add_table(page, file.content)
        _drawn_results(page, run, file)
    scored = {digest for file in scores for digest in file.sources.values()}
    _alone(page, [file for file in images if file.digest not in scored])
    if captures:
        page.heading("Captures")
    for file in captures[:_CAPTURES]:
        _capture(page, run, file)
    for file in matrices[:2]:
        _matrix(page, file)
    for file in run.of_kind("dictionary"):
        _dictionary(page, run, file)
    return "Spatial"


def _drawn_results(page, run, file):
    """Pictures of the results of a score document, as far as they still lie in the folder."""
    truth = run.by_digest(file.sources.get("truth"))
    digests = [
        file.sources.get(f"result {number}")
        for number in range(1, len(file.content["results"]) + 1)
    ]
    pairs = []
    for entry, digest in zip(file.content["results"], digests, strict=True):
        found = run.by_digest(digest)
        if found is None or truth is None or found.kind != "image":
            continue
        try:
            result = read_result(found.path)
            if result.wavelengths is None:
                pairs.append(
                    (
                        entry,
                        {
                            "result": result,
                            "truth": read_truth(truth.path, result),
                            "block": block_of(result, truth.path),
                        },
                    )
                )
        except PlenoError as error:
            page.warning(str(error))
    for shape in dict.fromkeys(pair[1]["truth"].shape for pair in pairs):
        add_reconstructions(page, [pair for pair in pairs if pair[1]["truth"].shape == shape])


def _alone(page, files):
    """Reconstructions that nobody scored, real captures' for instance."""
    from plenocli.report.figures import image_figures

    for file in files[:6]:
        result = read_result(file.path)
        if result.wavelengths is None:
            _add(page, image_figures(result, file.name))


def _capture(page, run, file):
    """One capture with its lenslet grid."""
    from plenocli.files.images.mosaic import read_capture
    from plenocli.report.figures import capture_figures

    try:
        shot = read_capture(file.path)
    except InputError as error:
        page.warning(str(error))
        return
    centres = None
    if file.kind == "capture" and file.path.suffix == ".h5":
        centres = file.artefact().data.get("capture/lenslet_centre")
    calibration = next((u for u in run.users(file) if u.kind == "calibration"), None) or next(
        (
            run.by_digest(d)
            for u in run.users(file)
            for d in u.sources.values()
            if run.by_digest(d) and run.by_digest(d).kind == "calibration"
        ),
        None,
    )
    if centres is None and calibration is not None:
        centres = calibration.artefact().data["grid/centre"]
    _add(page, capture_figures(shot, file.name, centres))


def _refocused(page, run, scores):
    """The section about refocused captures; returns its name, or None where there are none."""
    from plenocli.report.planes import lightfield_figures

    found = run.of_kind("lightfield")
    if not found:
        return None
    page.section(
        "Depth",
        (
            "One capture focused on other planes. A slope is what a plane's picture moves for each "
            "pixel of view: 0 is focused on the lenslets, and one of parallax across the pupil is "
            "what geometry can tell."
        ),
    )
    for file in scores:
        if any(entry.get("kind") == "lightfield" for entry in file.content["results"]):
            page.heading(file.name.removesuffix(".json"), file.command)
            add_table(page, file.content)
    for file in found:
        page.heading(file.name.removesuffix(".h5"), file.command)
        _add(page, lightfield_figures(file.artefact()))
    return "Depth"


def _designs(page, run):
    """The section about sweeps; returns its name, or None where there are none."""
    from plenocli.report.front import front_figures, front_rows

    found = run.of_kind("sweep")
    if not found:
        return None
    page.section(
        "Design space",
        (
            "Many cameras carried through the stages. A design is on the front if no other is at "
            "least as good in everything that was asked for, and better in one."
        ),
    )
    for file in found:
        page.heading(file.name.removesuffix(".h5"), file.command)
        artefact = file.artefact()
        if artefact.data["sweep/front"].any():
            _add(page, front_figures(artefact))
            page.table(*front_rows(artefact), text=True)
        else:
            page.warning(
                f"{file.name}: no design has all figures of the front; `plenocli "
                "inspect` shows the reasons."
            )
    return "Design space"


def _add(page, figures):
    for picture, caption in figures:
        page.figure(picture, caption)


def _matrix(page, file):
    from plenocli.report.figures import matrix_figures

    artefact = file.artefact()
    data, attrs = artefact.data, artefact.attrs.get("pif", {})
    page.heading(f"System matrix {file.name.removesuffix('.h5')}", file.command)
    bands, lenslets, pixels, points = data["pif/A"].shape
    facts = [
        (
            "bands x superpixels x pixels x object points",
            f"{bands} x {lenslets} x {pixels} x {points}",
        )
    ]
    facts += [
        (label, _text(attrs[name]))
        for name, label in (
            ("rank", "numerical rank"),
            ("condition", "condition number"),
            ("symmetry_defect", "symmetry defect (0: half of the object is invisible)"),
            ("coherent_ring", "rings of neighbours added coherently"),
            ("kappa", "kappa [1/m]"),
            ("model", "propagation"),
        )
        if name in attrs
    ]
    page.table(
        ["", ""], [list(fact) for fact in [*facts, *_plan(artefact.provenance.accuracy)]], text=True
    )
    why = [
        *artefact.provenance.accuracy.get("reasons", ()),
        *(f"left out: {text}" for text in artefact.provenance.accuracy.get("left_out", ())),
    ]
    if why:
        page.code("\n".join(map(str, why)), "Why: the accuracy plan")
    _add(page, matrix_figures(artefact))


def _plan(record):
    """(label, text) of what simulate-pif planned: the accuracy asked for, what it expects, and
    where that comes from.
    """
    parts = ", ".join(
        f"{name} {_text(error)}"
        for name, error in sorted(record.get("by_source", {}).items(), key=lambda item: -item[1])
        if error
    )
    texts = {
        "accuracy asked for": f"{_text(record['asked'])} ({record.get('asked_by', 'request')})"
        if "asked" in record
        else None,
        "error expected": f"{_text(record['estimated'])}" + (f": {parts}" if parts else "")
        if "estimated" in record
        else None,
        "computed by": record.get("rung"),
        "error of that model itself": _text(record["model_error"])
        if record.get("model_error") is not None
        else None,
    }
    return [(label, text) for label, text in texts.items() if text is not None]


def _text(value):
    if isinstance(value, (list, tuple, np.ndarray)):
        values = np.ravel(value)
        return (
            _text(values[0])
            if values.size == 1
            else f"{_text(values.min())} to {_text(values.max())}"
        )
    return f"{value:.4g}" if isinstance(value, (float, np.floating)) else str(value)


def _dictionary(page, run, file):
    from plenocli.report.figures import dictionary_figures, learning, own_matrix

    artefact = file.artefact()
    page.heading(f"Dictionary {file.name.removesuffix('.h5')}", file.command)
    attrs = artefact.attrs.get("dictionary", {})
    rows = [
        [name.replace("_", " "), _text(value)]
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
    matrix = next(
        (
            run.by_digest(d)
            for d in file.sources.values()
            if run.by_digest(d) and run.by_digest(d).kind == "pif"
        ),
        None,
    )
    system = None if matrix is None else own_matrix(matrix.artefact())
    _add(page, dictionary_figures(read_result(file.path), file.name, learning(artefact), system))


# --- spectral -------------------------------------------------------------------------------------


def _spectral(page, run, scores):
    """The section about spectra; returns its name, or None where there is nothing to show."""
    calibrations, spectra = run.of_kind("calibration"), run.of_kind("spectra")
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
    responses = [
        file
        for file in scores
        if all(
            entry.get("kind") == "calibration"
            for entry in file.content["results"]
            if "error" not in entry
        )
    ]
    groups = {}
    for file in scores:
        if file not in responses:
            result = run.by_digest(file.sources.get("result 1"))
            groups.setdefault(file.folder if result is None else result.folder, []).append(file)
    for folder, files in groups.items():
        if len(groups) > 1:
            page.heading(f"Results in {folder.relative_to(run.root).as_posix()}")
        _merged_scores(page, run, files)
    for file in responses:
        _agreement(page, run, file)
    scored = {digest for file in scores for digest in file.sources.values()}
    _bands_alone(
        page, [file for file in spectra if file.digest not in scored and not _is_white(run, file)]
    )
    described = set()
    for file in calibrations:
        _calibration(page, file, described)
    sources = {digest for file in (*calibrations, *spectra) for digest in file.sources.values()}
    captures = [f for f in run.of_kind("capture") if f.digest in sources]
    # one of each sort before a second of any: the pipelines name files by what they show
    sorts = [
        next((f for f in captures if word in f.path.name), None)
        for word in ("chart", "white", "band")
    ]
    captures = list(dict.fromkeys(f.digest for f in [*sorts, *captures] if f))
    if captures:
        page.heading("Captures")
    for file in map(run.by_digest, captures[:_CAPTURES]):
        _capture(page, run, file)
    return "Spectral"


def _merged_scores(page, run, files):
    """All score documents of one folder in one table and one set of bars."""
    results = [
        entry for file in files for entry in file.content["results"] if entry.get("wavelengths_nm")
    ]
    document = {
        "results": results,
        "definitions": {
            name: text for file in files for name, text in file.content["definitions"].items()
        },
    }
    add_table(page, document)
    digests = [
        file.sources.get(f"result {number}")
        for file in files
        for number, entry in enumerate(file.content["results"], start=1)
        if entry.get("wavelengths_nm")
    ]
    pairs = []
    for entry, digest in zip(results, digests, strict=True):
        found = run.by_digest(digest)
        if found is not None and len(pairs) < _SPECTRA:
            pairs.append((entry, {"result": read_result(found.path)}))
    add_spectra(page, document, pairs)


def _agreement(page, run, file):
    """Responses beside the one that was measured, band by band, and where in the superpixel the
    first one differs.
    """
    from plenocli.evaluation.metrics.response import response_error
    from plenocli.evaluation.response_score import paired_responses
    from plenocli.report.spectral_pictures import response_errors

    page.heading("Responses compared", file.command)
    add_table(page, file.content)
    first, truth = (run.by_digest(file.sources.get(role)) for role in ("result 1", "truth"))
    if first is None or truth is None:
        return
    response, other, wavelengths, window = paired_responses(first.path, truth.path)
    error, _, mean = response_error(response, other)
    page.figure(
        response_errors(error, np.nanmax(mean, axis=0), window, wavelengths),
        f"{first.name} less {truth.name}, after a gain for each band.",
    )


def _is_white(run, file):
    return any(
        role.startswith("white") and digest == file.digest
        for user in run.users(file)
        for role, digest in user.sources.items()
    )


def _bands_alone(page, files):
    from plenocli.report.spectral_pictures import band_pictures

    for file in files[:_SPECTRA]:
        result = read_result(file.path)
        page.figure(
            band_pictures(result.values, result.wavelengths, result.quantity or "value"),
            f"{file.name}: one value a lenslet and band; not scored.",
        )


def _calibration(page, file, described):
    """One calibration; `described` holds the cameras whose filters are on the page already."""
    from plenocli.report.figures import calibration_figures

    artefact = file.artefact()
    attrs = artefact.attrs
    page.heading(f"Calibration {file.name.removesuffix('.h5')}", file.command)
    grid, response = attrs.get("grid", {}), attrs.get("response", {})
    rows = [
        [label, _listed(of[name])]
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
        _add(page, _filters(artefact))
    _add(page, calibration_figures(artefact))


def _filters(artefact):
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


def _listed(value):
    return (
        " x ".join(f"{v:.5g}" for v in np.ravel(value))
        if not isinstance(value, (str, int, float))
        else _text(value)
    )


# --- files ----------------------------------------------------------------------------------------


def _files(page, run):
    """Every file with the command that made it, and the configurations."""
    page.section(
        "Files and provenance",
        (
            "Artefacts carry the SHA-256 of their inputs; every one listed here was verified "
            "when this page was made."
        ),
    )
    rows = [[file.name, file.kind, file.digest[:12], file.command] for file in run.files]
    page.table(["file", "kind", "SHA-256", "made by"], rows, text=True)
    configs = {}
    for file in run.files:
        if file.config:
            configs.setdefault(file.config, []).append(file.name)
    for config, names in configs.items():
        page.code(
            config, f"Camera of {', '.join(names[:4])}{' and others' if len(names) > 4 else ''}"
        )
