"""The parts of a page that show a score document, and the page of one score alone."""

from collections.abc import Sequence
from dataclasses import dataclass

from plenocli.base.tiling import Plane
from plenocli.evaluation.results import Result
from plenocli.evaluation.scores import ResultScore, ScoreDocument
from plenocli.report.page import Page
from plenocli.report.tables import label_of, metric_rows

HIGHER = ("psnr_db", "psnr_inner_db", "psnr_clipped_db", "ssim", "gain_over_block_mean_db")
LOWER = (
    "rmse",
    "rmse_per_band",
    "patch_rmse_per_band",
    "six_patch_rmse",
    "six_patch_rmse_per_band",
    "spectral_angle_deg",
    "delta_e_2000",
)
_MOST = 11
"""Results drawn in one picture."""


@dataclass(frozen=True, kw_only=True)
class Compared:
    """What a page draws of a result.

    truth: like its values, None for a dictionary.
    block: (rows, columns) of samples under a lenslet, or None.
    """

    result: Result
    truth: Plane | None = None
    block: tuple[int, int] | None = None


Pair = tuple[ResultScore, Compared]


def score_page(document: ScoreDocument, drawn: Sequence[Compared | None]) -> str:
    """A page (HTML text) for one score document.

    drawn: one a result, None where there is nothing to draw.
    """
    page = Page("plenocli score", document.command)
    page.section("Numbers")
    add_table(page, document)
    page.section("Pictures")
    add_pictures(page, document, drawn)
    page.section("Files")
    add_inputs(page, document)
    return page.render()


def add_table(page: Page, document: ScoreDocument, caption: str = "") -> None:
    """The table of all results with the best of each row in bold, the result with most of them
    first, failed results, and the definitions.
    """
    header, rows = metric_rows(document)
    best = [column for found in _best(document, rows).values() for column in found]
    order = [0, *sorted(range(1, len(header)), key=lambda column: -best.count(column))]
    rows = [[row[column] for column in order] for row in rows]
    page.table([header[column] for column in order], rows, caption, _best(document, rows))
    for one in document.results:
        if one.error:
            page.warning(f"{one.name} could not be scored: {one.error}")
    page.definitions({label_of(name): text for name, text in document.definitions.items()})


def _best(document: ScoreDocument, rows: list[list[str]]) -> dict[int, set[int]]:
    """Row number -> columns that hold the best value of a metric where more or less is better."""
    if len(document.results) < 2:
        return {}
    best = {}
    labels = {label_of(name): min for name in LOWER} | {label_of(name): max for name in HIGHER}
    for number, row in enumerate(rows):
        choose = labels.get(row[0].split(" [")[0]) or labels.get(row[0].split(",")[0])
        numbers = {
            column: float(cell) for column, cell in enumerate(row) if column and _is_number(cell)
        }
        if choose and len(numbers) > 1 and len(set(numbers.values())) > 1:
            best[number] = {
                column for column, value in numbers.items() if value == choose(numbers.values())
            }
    return best


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return cell != "none"


def add_pictures(page: Page, document: ScoreDocument, drawn: Sequence[Compared | None]) -> None:
    """Pictures of results beside their truth; results and what is drawn of them go together."""
    from plenocli.report.figures import dictionary_figures

    pairs = [
        (one, compared)
        for one, compared in zip(document.results, drawn, strict=True)
        if compared is not None
    ]
    add_reconstructions(page, [pair for pair in pairs if pair[1].result.wavelengths is None])
    bands = [compared for _, compared in pairs if compared.result.wavelengths is not None]
    labels = [one.label for one, compared in pairs if compared.result.wavelengths is not None]
    add_spectra(page, document, list(zip(labels, [c.result for c in bands], strict=True)))
    for one, compared in pairs:
        if compared.result.kind == "dictionary":
            for picture, caption in dictionary_figures(compared.result, one.label, history=False):
                page.figure(picture, caption)


def add_reconstructions(page: Page, pairs: Sequence[Pair]) -> None:
    """Truth, results and errors of pictures, those on one grid together."""
    grids: dict[tuple[int, ...], list[tuple[Pair, Plane]]] = {}
    for pair in pairs:
        truth = pair[1].truth
        if truth is not None:
            grids.setdefault(truth.shape, []).append((pair, truth))
    for found in grids.values():
        _add_one_grid(page, [pair for pair, _ in found][:_MOST], found[0][1])


def _add_one_grid(page: Page, pairs: Sequence[Pair], truth: Plane) -> None:
    """Pictures on one grid, and a close-up where the lenslets' blocks are known."""
    from plenocli.report.pictures import close_ups, reconstructions

    entries = [(one.label, compared.result.plane, _caption(one)) for one, compared in pairs]
    page.figure(
        reconstructions(entries, truth),
        (
            "Each result above its error. Linear values, encoded for the screen as sRGB is; one "
            "error scale for all."
        ),
    )
    block = next((compared.block for _, compared in pairs if compared.block), None)
    if block is not None and min(truth.shape[0] // block[0], truth.shape[1] // block[1]) >= 2:
        page.figure(
            close_ups(entries, truth, block),
            (
                "Close-up of the fields of the middle lenslets; lines are the "
                "borders between lenslets."
            ),
        )


def _caption(one: ResultScore) -> str:
    ratio, similarity = one.number("psnr_db"), one.number("ssim")
    parts = [] if ratio is None else [f"{ratio:.2f} dB"]
    return ", ".join(parts if similarity is None else [*parts, f"SSIM {similarity:.3f}"])


def add_spectra(page: Page, document: ScoreDocument, results: Sequence[tuple[str, Result]]) -> None:
    """Bars per band and spectra of patches of a document, and the bands of `results`, (label,
    spectra) each, as pictures.
    """
    from plenocli.report.spectral_pictures import accuracy_bars, band_pictures, patch_spectra

    entries = [
        one for one in document.results if one.wavelengths_nm and "rmse_per_band" in one.figures
    ]
    same = [one for one in entries if one.wavelengths_nm == entries[0].wavelengths_nm]
    if same:
        page.figure(
            accuracy_bars(same),
            "Error and signal-to-noise ratio by band, as in the paper's Fig. 7.",
        )
        chart = [(one.label, one.patches) for one in same if one.patches][:6]
        if chart:
            bands = same[0].wavelengths_nm
            page.figure(
                patch_spectra(chart, bands),
                (
                    "Mean over the lenslets that see one patch alone, with one standard deviation. "
                    "Grey: the chart's full spectrum."
                ),
            )
    for label, result in results[:4]:
        page.figure(
            band_pictures(result.values, result.bands, result.quantity or "value"),
            f"{label}: one value a lenslet and band, and the colour they make together.",
        )


def add_inputs(page: Page, document: ScoreDocument) -> None:
    """Files by role, name and digest."""
    rows = [[role, file.name, file.sha256[:16]] for role, file in document.inputs.items()]
    page.table(["role", "file", "SHA-256 begins"], rows, text=True)
