"""colorchecker: band reflectances of a real chart from exposure brackets, against a spectrometer;
the chart as a scene.
"""

from dataclasses import dataclass
from pathlib import Path

from plenocli.base.errors import InputError, NumericsError
from plenocli.evaluation.chart_score import ChartDocument, band_rates, denser, measure_chart
from plenocli.evaluation.scores import InputFile
from plenocli.files.read.chart_folder import read_chart_folder


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How a chart is measured.

    cfa: of the mosaics.
    flatten: "paper" or "none", which reflectances make the scene.
    grid: (rows, columns) of the scene.
    labels, spectra: files instead of those in the folder.
    """

    cfa: str = "mono"
    flatten: str = "paper"
    grid: tuple[int, int] = (96, 144)
    labels: Path | None = None
    spectra: Path | None = None


def run_colorchecker(
    folder: Path | str,
    output: Path | str,
    settings: Settings = Settings(),
    *,
    measures: Path | str | None = None,
    overwrite: bool = False,
    command: str = "",
) -> ChartDocument:
    """Measure the chart in a folder and write it upright as an image artefact (reflectance by
    wavelength).

    folder: with captures, dark frames, label map and the spectrometer's table.
    measures: JSON, where the numbers are wanted too.

    Raises InputError for the folder, NumericsError where a band shows no white patch or the paper
    does not tell the light, UsageError, OutputError.
    """
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.artefacts.writing import write_artefact
    from plenocli.files.atomic import check_output, together
    from plenocli.files.results.scores import json_pieces
    from plenocli.files.seal import publish_sealed

    found = read_chart_folder(
        folder, cfa=settings.cfa, labels=settings.labels, spectra=settings.spectra
    )
    inputs = found.files.paths()
    check_output(output, overwrite=overwrite, inputs=inputs, suffixes=(".h5",))
    if measures is not None:
        check_output(
            measures, overwrite=overwrite, inputs=inputs, others=[output], suffixes=(".json",)
        )
    try:
        rates = band_rates(found.data)
        measured = measure_chart(found.data, rates, settings.flatten == "paper", settings.grid)
    except (InputError, NumericsError) as error:
        raise error.at(folder) from None
    described = describe_inputs(found.files.by_role())
    document = ChartDocument(
        measures=measured,
        linearity=rates.linearity,
        command=command,
        inputs={role: InputFile(**about) for role, about in described.items()},
    )
    notes = {"flatten": settings.flatten, "patches": "colorchecker"}
    wavelengths, values = denser(found.data.bands, measured.cube)
    chart = Artefact(
        "image",
        {"image/wavelength": wavelengths, "image/value": values},
        {"image": {"method": "measured", "notes": notes}},
        Provenance(command=command, inputs=described),
    )
    with together():
        write_artefact(output, chart, overwrite=overwrite)
        if measures is not None:
            publish_sealed(measures, json_pieces(document.as_json()), overwrite=overwrite)
    return document


def table(document: ChartDocument) -> str:
    """The measures as text: errors by band and method, linearity, then every patch by band."""
    from plenocli.report.tables import chart_table

    return chart_table(document)
