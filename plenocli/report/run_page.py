"""The page about everything that lies in a run folder."""

from collections.abc import Sequence

from plenocli.files.results.design_tables import designs_of
from plenocli.files.results.lightfields import lightfield_of
from plenocli.files.results.run_folder import RunFile, RunFolder
from plenocli.report.page import Page
from plenocli.report.run_spatial import add_spatial, of_pictures
from plenocli.report.run_spectral import add_grids, add_spectral, of_bands
from plenocli.report.score_page import add_table


def run_page(
    run: RunFolder, title: str, closer: Sequence[tuple[str, str]] = ()
) -> tuple[Page, list[str]]:
    """The page about a run folder, and the names of its sections that show something.

    closer: (text, address) of views of its files.
    """
    page = Page(
        title,
        (
            "A plenoptic camera modelled end to end: what it captured, what was recovered, "
            "and how good that is."
        ),
    )
    scores = run.of_kind("score")
    spatial = [file for file in scores if file.scores and of_pictures(file.scores)]
    spectral = [file for file in scores if file.scores and of_bands(file.scores)]
    page.cards([*_best_pictures(spatial), *_best_spectra(spectral)])
    if closer:
        page.section("Look closer", "Pages in which these files are refocused, compared and read.")
        page.links(closer)
    for name, problem in run.unreadable:
        page.warning(f"{name} could not be read: it {problem}.")
    sections = [
        add_spatial(page, run, spatial),
        add_spectral(page, run, spectral),
        add_grids(page, run),
        _add_refocused(page, run, scores),
        _add_designs(page, run),
    ]
    _add_files(page, run)
    return page, [name for name in sections if name]


def _best_pictures(files: Sequence[RunFile]) -> list[tuple[str, str]]:
    """The best PSNR of each score document."""
    cards = []
    for file in files:
        ratios = [
            (ratio, one)
            for one in (file.scores.results if file.scores else ())
            if (ratio := one.number("psnr_db")) is not None
        ]
        if ratios:
            value, one = max(ratios, key=lambda pair: pair[0])
            cards.append((f"{value:.2f} dB", f"best PSNR, {one.label} ({file.path.stem})"))
    return cards


def _best_spectra(files: Sequence[RunFile]) -> list[tuple[str, str]]:
    """The least error and the best SNR of all score documents of spectra."""
    results = [one for file in files for one in (file.scores.results if file.scores else ())]
    errors = [
        (value, one)
        for one in results
        if (value := one.number("six_patch_rmse" if "six_patch_rmse" in one.figures else "rmse"))
        is not None
    ]
    ratios = [
        (value, one) for one in results if (value := one.number("snr_capture_mean_db")) is not None
    ]
    cards = []
    if errors:
        value, one = min(errors, key=lambda pair: pair[0])
        cards.append((f"{value:.4f}", f"least RMSE in reflectance, {one.label}"))
    if ratios:
        value, one = max(ratios, key=lambda pair: pair[0])
        cards.append((f"{value:.1f} dB", f"best capture SNR, mean of bands, {one.label}"))
    return cards


def _add_refocused(page: Page, run: RunFolder, scores: Sequence[RunFile]) -> str | None:
    """The section about refocused captures; returns its name, or None where there are none."""
    from plenocli.report.depth.planes import lightfield_figures

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
        if file.scores and any(one.kind == "lightfield" for one in file.scores.results):
            page.heading(file.name.removesuffix(".json"), file.made_by)
            add_table(page, file.scores)
    for file in found:
        page.heading(file.name.removesuffix(".h5"), file.made_by)
        page.figures(lightfield_figures(lightfield_of(file.artefact())))
    return "Depth"


def _add_designs(page: Page, run: RunFolder) -> str | None:
    """The section about sweeps; returns its name, or None where there are none."""
    from plenocli.files.results.measured_seconds import read_measured
    from plenocli.report.front import COSTS, cost_figures, cost_rows, front_figures, front_rows

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
        page.heading(file.name.removesuffix(".h5"), file.made_by)
        table = designs_of(file.artefact())
        if table.ahead.any():
            page.figures(front_figures(table))
            page.table(*front_rows(table), text=True)
            measured = read_measured(file.path, len(table.status))
            if measured is not None:
                page.figures(cost_figures(table, measured))
                page.table(*cost_rows(table, measured), caption=COSTS, text=True)
        else:
            page.warning(
                f"{file.name}: no design has all figures of the front; `plenocli "
                "inspect` shows the reasons."
            )
    return "Design space"


def _add_files(page: Page, run: RunFolder) -> None:
    """Every file with the command that made it, and the configurations."""
    page.section(
        "Files and provenance",
        (
            "Artefacts carry the SHA-256 of their inputs; every one listed here was verified "
            "when this page was made."
        ),
    )
    rows = [[file.name, file.kind, file.digest[:12], file.made_by] for file in run.files]
    page.table(["file", "kind", "SHA-256", "made by"], rows, text=True)
    long = dict.fromkeys(file.command for file in run.files if file.made_by != file.command)
    if long:
        page.code("\n\n".join(long), "Long commands in full")
    configs: dict[str, list[str]] = {}
    for file in run.files:
        if file.config:
            configs.setdefault(file.config, []).append(file.name)
    for config, names in configs.items():
        page.code(
            config, f"Camera of {', '.join(names[:4])}{' and others' if len(names) > 4 else ''}"
        )
