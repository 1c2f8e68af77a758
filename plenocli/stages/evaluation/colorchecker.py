"""colorchecker: band reflectances of a real chart from exposure brackets, against a
spectrometer; the chart as a scene.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError, NumericsError
from plenocli.base.text import plain
from plenocli.files.read.chart_folder import read_chart_folder

COLOURS = ((490e-9, "B"), (590e-9, "G"), (np.inf, "R"))
"""Up to which wavelength which colour of a mosaic serves a band: its brightest one.
Others see leaked light.
"""
INNER = (450e-9, 650e-9)
"""Bands over which means are taken; a camera sees little beyond."""
WHITE = 18  # index of the white patch
STEP = 10e-9  # m between the bands of the scene
TOLD_APART = 12e-9  # m: a filter's label may differ this much from its captures' name


@dataclass(frozen=True)
class Settings:
    """cfa of the mosaics; flatten "paper" or "none": which reflectances make the scene;

    grid: (rows, columns) of the scene;
    labels, spectra: files instead of those in the folder.
    """

    cfa: str = "mono"
    flatten: str = "paper"
    grid: tuple = (96, 144)
    labels: Path | None = None
    spectra: Path | None = None


def run_colorchecker(
    folder, output, settings=Settings(), *, measures=None, overwrite=False, command=""
):
    """Measure the chart in `folder`, write it upright as an image artefact (reflectance by
    wavelength), perhaps the `measures` (JSON); returns them as a dict.

    Errors: InputError for the folder, NumericsError where a band shows no white patch or the paper
    does not tell the light.
    """
    from plenocli.files.artefacts.container import Artefact, write_artefact
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output, publish

    data = read_chart_folder(
        folder, cfa=settings.cfa, labels=settings.labels, spectra=settings.spectra
    )
    inputs = [
        *data.files["capture"],
        *data.files["dark"],
        data.files["labels"],
        data.files["spectra"],
    ]
    check_output(output, overwrite=overwrite, inputs=inputs, suffixes=(".h5",))
    if measures is not None:
        check_output(measures, overwrite=overwrite, inputs=inputs, suffixes=(".json",))
    rates, sites, linear = _rates(data, folder)
    document, cube = _measure(data, rates, sites, settings, folder)
    document |= {"linearity": linear, "command": command, "inputs": describe_inputs(data.files)}
    document = plain(document)
    attrs = {
        "method": "measured",
        "notes": {"flatten": settings.flatten, "patches": "colorchecker"},
    }
    content = dict(
        zip(("image/wavelength", "image/value"), _denser(np.array(list(data.captures)), cube))
    )
    write_artefact(
        output,
        Artefact(
            "image", content, {"image": attrs}, Provenance(command, describe_inputs(data.files))
        ),
        overwrite=overwrite,
    )
    if measures is not None:
        publish(
            measures,
            (json.dumps(document, indent=1, allow_nan=False) + "\n").encode(),
            overwrite=overwrite,
        )
    return document


def _rates(data, folder):
    """(rate (band, rows, columns) DN/s, sites (band, rows, columns) of the colour that serves a
    band, linearity by band).
    """
    from plenocli.forward.scene.target import patch_cores
    from plenocli.forward.sensor.bracket import linearity, merge_bracket
    from plenocli.forward.sensor.cfa import cfa_map

    where = cfa_map(data.labels.shape, data.cfa)
    cores = patch_cores(data.labels)
    rates, sites, linear = [], [], {}
    for band, shots in data.captures.items():
        colour = (
            where[0, 0]
            if data.cfa == "mono"
            else next(letter for limit, letter in COLOURS if band < limit)
        )
        seconds, frames = [s for s, _ in shots], [f for _, f in shots]
        darks = [_dark(data.darks, s) for s in seconds]
        rates.append(merge_bracket(frames, seconds, darks, data.white))
        sites.append(where == colour)
        ratios = np.array(
            [
                ratio
                for *_, ratio in linearity(
                    frames, seconds, darks, np.where(sites[-1], cores, 0), data.white
                )
            ]
        )
        if ratios.size:
            linear[f"{band * 1e9:.0f}"] = {
                "median": float(np.median(ratios)),
                "least": float(ratios.min()),
                "most": float(ratios.max()),
                "pairs": int(ratios.size),
            }
        if not np.isfinite(rates[-1][sites[-1] & (cores == WHITE + 1)]).any():
            raise NumericsError(
                f"the white patch is saturated in every exposure at {band * 1e9:.0f} nm",
                folder,
                "add a shorter exposure",
            )
    return np.array(rates), np.array(sites), linear


def _dark(darks, seconds):
    """Mean of the dark frames of this exposure time, 0 where there are none."""
    same = [values for time, values in darks if abs(time / seconds - 1) < 0.01]
    return np.mean(same, axis=0) if same else 0.0


def _measure(data, rates, sites, settings, folder):
    """(document, cube (band, *grid)): reflectances against the spectrometer with the white patch
    alone and flattened.
    """
    from plenocli.evaluation.metrics.chart import (
        against_white,
        compare_chart,
        lobe_reflectance,
        nominal_reflectance,
    )
    from plenocli.forward.scene.tables import SIX_PATCHES, colorchecker, patch_index
    from plenocli.forward.scene.target import find_chart, outside, paper_field, patch_cores, upright

    bands = np.array(list(data.captures))
    cores, chart = patch_cores(data.labels), find_chart(data.labels)
    inner = (bands > INNER[0] - 1e-9) & (bands < INNER[1] + 1e-9)
    truths = {"nominal": nominal_reflectance(data.wavelengths, bands, data.patches)}
    filters = [_filter(data.filters, band) for band in bands]
    if all(one is not None for one in filters):
        truths = {"lobe": lobe_reflectance(data.wavelengths, filters, bands, data.patches)} | truths
    if not inner.any():
        raise InputError("holds no band from 450 to 650 nm", folder, "add captures of such bands")
    fields = {"none": np.ones_like(rates)}
    blocks = None
    if settings.flatten == "paper":
        try:
            fields["paper"], blocks = paper_field(rates, sites, outside(chart, data.labels.shape))
        except NumericsError as error:
            raise error.at(folder) from None
    truth, six = next(iter(truths.values())), [patch_index(name) for name in SIX_PATCHES]
    names = colorchecker()[0]
    document = {
        "bands_nm": np.round(bands * 1e9, 6).tolist(),
        "patch_names": names,
        "six": six,
        "truth": truth,
        "target": next(iter(truths)),
        "paper_blocks": blocks,
        "methods": {},
    }
    for name, field in fields.items():
        values = np.array(
            [
                [_mean(rate / f, site & (cores == k)) for rate, site, f in zip(rates, sites, field)]
                for k in range(1, 25)
            ]
        )
        if not (values[WHITE] > 0).all():
            raise NumericsError(
                "the white patch shows no light", folder, "check the label map and the dark frames"
            )
        found = against_white(values, truth, WHITE)
        scores = compare_chart(found, truth, six, inner)
        scores |= {
            f"{other}_{key}": value
            for other, t in list(truths.items())[1:]
            for key, value in compare_chart(against_white(values, t, WHITE), t, six, inner).items()
            if key in ("rmse_24", "rmse_six", "spectral_angle_deg")
        }
        document["methods"]["white patch" if name == "none" else "white patch, paper field"] = (
            scores | {"reflectance": found}
        )
    field = fields[settings.flatten]
    level = truth[WHITE] / values[WHITE]
    cube = np.stack(
        [
            k * upright(rate / f, site, chart, settings.grid)
            for k, rate, f, site in zip(level, rates, field, sites)
        ]
    )
    if not np.isfinite(cube).all():
        raise NumericsError(
            "parts of the chart saturate in every exposure", folder, "add shorter exposures"
        )
    return document, np.clip(cube, 0, None)


def _denser(bands, cube):
    """(wavelengths, cube float32) with STEP between the measured bands too, which stay as they are:
    monotone cubics (F. N. Fritsch, R. E. Carlson 1980), without the kinks that straight lines would
    have at the bands and without going below 0.
    """
    from scipy.interpolate import PchipInterpolator

    if len(bands) < 2:
        return bands, cube.astype(np.float32)
    every = (
        np.unique(np.round(np.concatenate([bands, np.arange(bands[0], bands[-1], STEP)]) * 1e12))
        * 1e-12
    )
    return every, PchipInterpolator(bands, cube, axis=0)(every).astype(np.float32)


def _filter(filters, band):
    near = min(filters, key=lambda label: abs(label - band), default=None)
    return filters[near] if near is not None and abs(near - band) < TOLD_APART else None


def _mean(picture, where):
    values = picture[where]
    values = values[np.isfinite(values)]
    return values.mean() if values.size else np.nan


def table(document):
    """The measures as text: errors by band and method, linearity, then every patch by band."""
    bands = [f"{band:.0f}" for band in document["bands_nm"]]
    row = "{:<42}" + "{:>8}" * (len(bands) + 1)
    lines = [row.format("RMSE of reflectance, nm", *bands, "mean")]
    for name, scores in document["methods"].items():
        for key, what in (("24", "24 patches"), ("six", "six patches")):
            lines.append(
                row.format(
                    f"{name}: {what}",
                    *(f"{v:.4f}" for v in scores[f"rmse_{key}_per_band"]),
                    f"{scores[f'rmse_{key}']:.4f}",
                )
            )
    lines.append(
        row.format(
            "linearity: median of rate ratios",
            *(
                f"{document['linearity'][b]['median']:.4f}" if b in document["linearity"] else "-"
                for b in bands
            ),
            "",
        )
    )
    for name, scores in document["methods"].items():
        lines.append(
            (
                f"{name}: spectral angle {scores['spectral_angle_deg']:.2f} deg, worst "
                f"{scores['spectral_angle_worst_deg']:.2f}; largest error "
                f"{scores['worst_error']:.3f}"
            )
            + (
                (
                    f"; 10 nm bands at the labels: 24 patches {scores['nominal_rmse_24']:.4f}, six "
                    f"{scores['nominal_rmse_six']:.4f}"
                )
                if "nominal_rmse_24" in scores
                else ""
            )
        )
    name, scores = list(document["methods"].items())[-1]
    lines += ["", row.format(f"{name}, less spectrometer", *bands, "rms")]
    for k, patch in enumerate(document["patch_names"]):
        error = [a - b for a, b in zip(scores["reflectance"][k], document["truth"][k])]
        lines.append(
            row.format(
                patch, *(f"{v:+.3f}" for v in error), f"{np.sqrt(np.mean(np.square(error))):.3f}"
            )
        )
    return "\n".join(line.rstrip() for line in lines)
