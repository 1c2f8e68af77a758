"""The parts of a page that show a score document, and the page of one score alone."""

from plenocli.report.page import Page
from plenocli.report.tables import LABELS, metric_rows

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
_MOST = 11  # results drawn in one picture


def score_page(document, pictures):
    """A page (HTML text) for one score document; `pictures` as run_score collects
    them, one a result.
    """
    page = Page("plenocli score", document.get("command", ""))
    page.section("Numbers")
    add_table(page, document)
    page.section("Pictures")
    add_pictures(page, document, pictures)
    page.section("Files")
    add_inputs(page, document)
    return page.render()


def add_table(page, document, caption=""):
    """The table of all results with the best of each row in bold, failed results,
    and the definitions.
    """
    header, rows = metric_rows(document)
    page.table(header, rows, caption, _best(document, rows))
    for entry in document["results"]:
        if "error" in entry:
            page.warning(f"{entry['name']} could not be scored: {entry['error']}")
    page.definitions(
        {LABELS.get(name, (name,))[0]: text for name, text in document["definitions"].items()}
    )


def _best(document, rows):
    """Row number -> columns that hold the best value of a metric where more or less is better."""
    if len(document["results"]) < 2:
        return {}
    best = {}
    labels = {LABELS[name][0]: min for name in LOWER} | {LABELS[name][0]: max for name in HIGHER}
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


def _is_number(cell):
    try:
        float(cell)
    except ValueError:
        return False
    return cell != "none"


def add_pictures(page, document, pictures):
    """Pictures of results beside their truth; entries and pictures go together,
    pictures may hold None.
    """
    from plenocli.report.figures import dictionary_figures

    pairs = [
        (entry, picture)
        for entry, picture in zip(document["results"], pictures, strict=True)
        if picture is not None
    ]
    flat = [(e, p) for e, p in pairs if "truth" in p and p["result"].wavelengths is None]
    for shape in dict.fromkeys(p["truth"].shape for _, p in flat):
        add_reconstructions(page, [(e, p) for e, p in flat if p["truth"].shape == shape])
    add_spectra(page, document, [(e, p) for e, p in pairs if p["result"].wavelengths is not None])
    for entry, picture in pairs:
        if picture["result"].kind == "dictionary":
            for drawn, caption in dictionary_figures(picture["result"], entry["label"]):
                page.figure(drawn, caption)


def add_reconstructions(page, pairs):
    """Truth, results and errors of pictures on one grid, and a close-up where the
    lenslets' blocks are known.
    """
    from plenocli.report.pictures import close_ups, reconstructions

    pairs = pairs[:_MOST]
    if not pairs:
        return
    truth = pairs[0][1]["truth"]
    entries = [(e["label"], p["result"].values, _caption(e["metrics"])) for e, p in pairs]
    page.figure(
        reconstructions(entries, truth),
        (
            "Each result above its error. Linear values, encoded for the screen as sRGB is; one "
            "error scale for all."
        ),
    )
    block = next((p["block"] for _, p in pairs if p.get("block")), None)
    if block is not None and min(truth.shape[0] // block[0], truth.shape[1] // block[1]) >= 2:
        page.figure(
            close_ups(entries, truth, block),
            (
                "Close-up of the fields of the middle lenslets; lines are the "
                "borders between lenslets."
            ),
        )


def _caption(metrics):
    parts = []
    if metrics.get("psnr_db") is not None:
        parts.append(f"{metrics['psnr_db']:.2f} dB")
    if metrics.get("ssim") is not None:
        parts.append(f"SSIM {metrics['ssim']:.3f}")
    return ", ".join(parts)


def add_spectra(page, document, pairs):
    """Bars per band, spectra of patches and the bands as pictures of spectral results."""
    from plenocli.report.spectral_pictures import (
        accuracy_bars,
        band_pictures,
        patch_errors,
        patch_spectra,
    )

    entries = [
        e
        for e in document["results"]
        if e.get("wavelengths_nm") and "rmse_per_band" in e["metrics"]
    ]
    same = [e for e in entries if e["wavelengths_nm"] == entries[0]["wavelengths_nm"]]
    if same:
        page.figure(
            accuracy_bars(same),
            "Error and signal-to-noise ratio by band, as in the paper's Fig. 7.",
        )
        chart = [(e["label"], e["patches"]) for e in same if e.get("patches")][:6]
        if chart:
            bands = same[0]["wavelengths_nm"]
            page.figure(
                patch_errors(chart, bands),
                (
                    "Error of the six patches of the paper, with one standard deviation "
                    "of a single lenslet."
                ),
            )
            page.figure(
                patch_spectra(chart, bands),
                (
                    "Mean over the lenslets that see one patch alone, with one standard deviation. "
                    "Grey: the chart's full spectrum."
                ),
            )
    for entry, picture in pairs[:4]:
        result = picture["result"]
        page.figure(
            band_pictures(result.values, result.wavelengths, result.quantity or "value"),
            f"{entry['label']}: one value a lenslet and band, and the colour they make together.",
        )


def add_inputs(page, document):
    """Files by role, name and digest."""
    rows = [
        [role, about["name"], about["sha256"][:16]]
        for role, about in document.get("inputs", {}).items()
    ]
    page.table(["role", "file", "SHA-256 begins"], rows, text=True)
