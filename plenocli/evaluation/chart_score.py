"""A real ColorChecker from exposure brackets under narrow-band light: reflectances by band, how far
they are from a spectrometer's, and the chart as a scene.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from plenocli.base.errors import InputError, NumericsError
from plenocli.base.text import json_value
from plenocli.evaluation.metrics.chart import (
    ChartScore,
    against_white,
    compare_chart,
    lobe_reflectance,
    nominal_reflectance,
)
from plenocli.evaluation.metrics.figures import figures
from plenocli.evaluation.scores import InputFile
from plenocli.forward.scene.tables import SIX_PATCHES, colorchecker, patch_index
from plenocli.forward.scene.target import find_chart, outside, paper_field, patch_cores, upright
from plenocli.forward.sensor.bracket import linearity, merge_bracket
from plenocli.forward.sensor.cfa import cfa_map

COLOURS = ((490e-9, "B"), (590e-9, "G"), (np.inf, "R"))
"""Up to which wavelength which colour of a mosaic serves a band: its brightest one. Others see
leaked light.
"""
INNER = (450e-9, 650e-9)
"""Bands over which means are taken; a camera sees little beyond."""
WHITE = 18
"""Index of the white patch."""
STEP = 10e-9
"""Between the bands of the scene, m."""
TOLD_APART = 12e-9
"""A filter's label may differ this much from its captures' name, m."""


@dataclass(frozen=True)
class Shot:
    """One exposure: its time (s) and values (row, column), DN."""

    seconds: float
    values: np.ndarray


@dataclass(frozen=True, kw_only=True)
class ChartCaptures:
    """Captures of a chart with what is known of it.

    captures: band (m) -> exposures, bands ascending.
    darks: exposures without light.
    white: saturation level, DN.
    cfa: "mono" or the four letters of the colour filter array.
    labels: (row, column), 0 for nothing, 1 to 24 the patches row by row.
    wavelengths: (n,) m, of the spectrometer.
    patches: (24, n) its reflectances.
    filters: label (m) -> (n,) transmission.
    """

    captures: Mapping[float, Sequence[Shot]]
    darks: Sequence[Shot]
    white: float
    cfa: str
    labels: np.ndarray
    wavelengths: np.ndarray
    patches: np.ndarray
    filters: Mapping[float, np.ndarray]

    @property
    def bands(self) -> np.ndarray:
        """(band,) m."""
        return np.array(list(self.captures))


@dataclass(frozen=True)
class Linearity:
    """Ratios of the rates of two exposures of a band, 1 for a linear sensor."""

    median: float
    least: float
    most: float
    pairs: int


@dataclass(frozen=True)
class ChartRates:
    """What the sensor collects: rates (band, row, column) DN/s, sites (band, row, column) of the
    colour that serves a band, and the linearity by the name of a band in nm.
    """

    rates: np.ndarray
    sites: np.ndarray
    linearity: dict[str, Linearity]


@dataclass(frozen=True, kw_only=True)
class ChartMethod:
    """Reflectances (patch, band) by one way to even out the light.

    score: against the target.
    nominal: against bands of 10 nm at the labels, None where these are the target.
    """

    name: str
    score: ChartScore
    nominal: ChartScore | None
    reflectance: np.ndarray

    def as_json(self) -> dict[str, Any]:
        """As it stands in the document."""
        told = figures(self.score)
        if self.nominal is not None:
            told |= {
                "nominal_rmse_24": self.nominal.rmse_24,
                "nominal_rmse_six": self.nominal.rmse_six,
                "nominal_spectral_angle_deg": self.nominal.spectral_angle_deg,
            }
        return told | {"reflectance": json_value(self.reflectance)}


@dataclass(frozen=True, kw_only=True)
class ChartMeasures:
    """A chart as measured.

    bands_nm: nominal centres.
    patch_names: of the 24 patches; six: indices of the paper's.
    truth: (patch, band) what the spectrometer says, seen through `target`: "lobe" or "nominal".
    paper_blocks: of white paper that the light was told from, None where it was not.
    methods: the plain one first.
    cube: (band, row, column) the chart upright, by the method that was chosen.
    """

    bands_nm: list[float]
    patch_names: Sequence[str]
    six: Sequence[int]
    truth: np.ndarray
    target: str
    paper_blocks: Any
    methods: Sequence[ChartMethod]
    cube: np.ndarray


@dataclass(frozen=True, kw_only=True)
class ChartDocument:
    """All that colorchecker found, with the command and the files that it used by role."""

    measures: ChartMeasures
    linearity: Mapping[str, Linearity]
    command: str
    inputs: Mapping[str, InputFile]

    def as_json(self) -> dict[str, Any]:
        """The document as it is written."""
        measures = self.measures
        return json_value(
            {
                "bands_nm": measures.bands_nm,
                "patch_names": measures.patch_names,
                "six": measures.six,
                "truth": measures.truth,
                "target": measures.target,
                "paper_blocks": measures.paper_blocks,
                "methods": {method.name: method.as_json() for method in measures.methods},
                "linearity": {band: figures(one) for band, one in self.linearity.items()},
                "command": self.command,
                "inputs": {
                    role: {"name": file.name, "sha256": file.sha256}
                    for role, file in self.inputs.items()
                },
            }
        )


def band_rates(data: ChartCaptures) -> ChartRates:
    """The exposures of each band merged into one picture of rates.

    Raises NumericsError where a band shows no white patch.
    """
    colours = cfa_map(data.labels.shape, data.cfa)
    cores = patch_cores(data.labels)
    rates, sites, linear = [], [], {}
    for band, shots in data.captures.items():
        colour = (
            colours[0, 0]
            if data.cfa == "mono"
            else next(letter for limit, letter in COLOURS if band < limit)
        )
        seconds, frames = [shot.seconds for shot in shots], [shot.values for shot in shots]
        darks = [_dark(data.darks, s) for s in seconds]
        rates.append(merge_bracket(frames, seconds, darks, data.white))
        sites.append(colours == colour)
        pairs = linearity(frames, seconds, darks, np.where(sites[-1], cores, 0), data.white)
        ratios = np.array([ratio for *_, ratio in pairs])
        if ratios.size:
            linear[f"{band * 1e9:.0f}"] = Linearity(
                float(np.median(ratios)),
                float(ratios.min()),
                float(ratios.max()),
                int(ratios.size),
            )
        if not np.isfinite(rates[-1][sites[-1] & (cores == WHITE + 1)]).any():
            raise NumericsError(
                f"the white patch is saturated in every exposure at {band * 1e9:.0f} nm",
                fix="add a shorter exposure",
            )
    return ChartRates(np.array(rates), np.array(sites), linear)


def _dark(darks: Sequence[Shot], seconds: float) -> np.ndarray | float:
    """Mean of the dark frames of this exposure time, 0 where there are none."""
    same = [shot.values for shot in darks if abs(shot.seconds / seconds - 1) < 0.01]
    return np.mean(same, axis=0) if same else 0.0


def measure_chart(
    data: ChartCaptures, found: ChartRates, flatten: bool, grid: tuple[int, int]
) -> ChartMeasures:
    """Reflectances against the spectrometer with the white patch alone and, where the light is
    evened out by the paper around the chart, with that; the chart as a scene.

    flatten: even out the light.
    grid: (rows, columns) of the scene.

    Raises InputError without an inner band, NumericsError where the white patch shows no light, the
    paper does not tell it, or parts of the chart saturate.
    """
    bands, cores = data.bands, patch_cores(data.labels)
    chart = find_chart(data.labels)
    inner = (bands > INNER[0] - 1e-9) & (bands < INNER[1] + 1e-9)
    if not inner.any():
        raise InputError("holds no band from 450 to 650 nm", fix="add captures of such bands")
    light, blocks = np.ones_like(found.rates), None
    fields = {"white patch": light}
    if flatten:
        light, blocks = paper_field(found.rates, found.sites, outside(chart, data.labels.shape))
        fields |= {"white patch, paper field": light}
    nominal = nominal_reflectance(data.wavelengths, bands, data.patches)
    lobe = _seen_through_filters(data, bands)
    truth = nominal if lobe is None else lobe
    six = [patch_index(name) for name in SIX_PATCHES]
    methods = []
    for name, field in fields.items():
        values = _patch_values(found, field, cores)
        measured = against_white(values, truth, WHITE)
        methods.append(
            ChartMethod(
                name=name,
                score=compare_chart(measured, truth, six, inner),
                nominal=None
                if lobe is None
                else compare_chart(against_white(values, nominal, WHITE), nominal, six, inner),
                reflectance=measured,
            )
        )
    level = truth[WHITE] / values[WHITE]
    return ChartMeasures(
        bands_nm=np.round(bands * 1e9, 6).tolist(),
        patch_names=colorchecker()[0],
        six=six,
        truth=truth,
        target="nominal" if lobe is None else "lobe",
        paper_blocks=blocks,
        methods=methods,
        cube=_upright_cube(found, light, level, chart, grid),
    )


def _upright_cube(
    found: ChartRates, light: np.ndarray, level: np.ndarray, chart: Any, grid: tuple[int, int]
) -> np.ndarray:
    """The chart as a scene (band, row, column); `level`: reflectance of a unit of rate, by band."""
    cube = np.stack(
        [
            k * upright(rate / f, site, chart, grid)
            for k, rate, f, site in zip(level, found.rates, light, found.sites)
        ]
    )
    if not np.isfinite(cube).all():
        raise NumericsError(
            "parts of the chart saturate in every exposure", fix="add shorter exposures"
        )
    return np.clip(cube, 0, None)


def _patch_values(found: ChartRates, field: np.ndarray, cores: np.ndarray) -> np.ndarray:
    """Means (patch, band) over the patches, of rates over the light `field` (band, row, column)."""
    values = np.array(
        [
            [
                _mean(rate / light, site & (cores == k))
                for rate, site, light in zip(found.rates, found.sites, field)
            ]
            for k in range(1, 25)
        ]
    )
    if not (values[WHITE] > 0).all():
        raise NumericsError(
            "the white patch shows no light", fix="check the label map and the dark frames"
        )
    return values


def _mean(picture: np.ndarray, where: np.ndarray) -> float:
    values = picture[where]
    values = values[np.isfinite(values)]
    return values.mean() if values.size else np.nan


def _seen_through_filters(data: ChartCaptures, bands: np.ndarray) -> np.ndarray | None:
    """Reflectances (patch, band) through the filters' own curves, None where one is not known."""
    filters = [_filter(data.filters, band) for band in bands]
    known = [one for one in filters if one is not None]
    if len(known) < len(filters):
        return None
    return lobe_reflectance(data.wavelengths, known, bands, data.patches)


def _filter(filters: Mapping[float, np.ndarray], band: float) -> np.ndarray | None:
    near = min(filters, key=lambda label: abs(label - band), default=None)
    return filters[near] if near is not None and abs(near - band) < TOLD_APART else None


def denser(bands: np.ndarray, cube: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A scene with STEP between the measured bands too, which stay as they are.

    bands: (band,) m.
    cube: (band, row, column).

    Monotone cubics, without the kinks that straight lines would have at the bands and without going
    below 0.

    Returns (wavelengths, cube float32).
    F. N. Fritsch, R. E. Carlson 1980.
    """
    from scipy.interpolate import PchipInterpolator

    if len(bands) < 2:
        return bands, cube.astype(np.float32)
    every = (
        np.unique(np.round(np.concatenate([bands, np.arange(bands[0], bands[-1], STEP)]) * 1e12))
        * 1e-12
    )
    return every, PchipInterpolator(bands, cube, axis=0)(every).astype(np.float32)
