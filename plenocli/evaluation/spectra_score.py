"""Spectral results: errors, patches, classification, SNR, and each method against single pixel."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.text import by
from plenocli.evaluation.metrics.classes import Classes, ClassScore, score_classes
from plenocli.evaluation.metrics.classify import ClassificationScore, score_classification
from plenocli.evaluation.metrics.quality import PictureScore, score_picture
from plenocli.evaluation.metrics.snr import SnrScore, score_snr
from plenocli.evaluation.metrics.spectral import (
    CubeScore,
    PatchesScore,
    PatchStatistics,
    patch_statistics,
    score_cube,
    score_patches,
)
from plenocli.evaluation.results import Result, WhiteTarget
from plenocli.evaluation.scores import PatchScore
from plenocli.forward.scene.tables import SIX_PATCHES, colorchecker, patch_index
from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE

WHITE_LABEL = 19
"""Of the chart's patches row by row, the first of the last row."""
SINGLE = "single-pixel"


@dataclass(frozen=True, kw_only=True)
class SpectraScore:
    """Figures of a spectral cube; None where what a group needs is not known.

    picture: of an image with bands, whose rmse then stands for that of the cube.
    """

    cube: CubeScore
    picture: PictureScore | None
    patches: PatchesScore | None
    classification: ClassificationScore | None
    classes: ClassScore | None
    snr: SnrScore | None

    @property
    def rmse(self) -> float:
        """The error that is reported by this name."""
        return self.cube.rmse if self.picture is None else self.picture.rmse

    @property
    def six_patch_rmse(self) -> float | None:
        """Over the paper's six patches, None where none is seen."""
        return self.patches.six.six_patch_rmse if self.patches and self.patches.six else None


@dataclass(frozen=True)
class SinglePixelScore:
    """Ratios to the result of single pixel extraction, and the gain in SNR over it, dB."""

    rmse_over_single_pixel: float | None
    six_patch_rmse_over_single_pixel: float | None
    delta_e_over_single_pixel: float | None
    snr_over_single_pixel_db: float | None


def score_spectra(
    result: Result,
    truth: np.ndarray,
    *,
    labels: np.ndarray | None = None,
    light: str = "D65",
    whites: Mapping[str, WhiteTarget] | None = None,
    needs_reflectance: bool = False,
    classes: Classes | None = None,
    detect: str | None = None,
    learnt: bool = False,
) -> tuple[SpectraScore, tuple[PatchScore, ...]]:
    """Figures of a spectral cube, and what each patch shows.

    truth: (band, row, column) like the result.
    labels: (row, column) of the chart's patches, 0 for nothing.
    light: name of the illuminant for colour differences.
    whites: method -> spectra of a white target.
    needs_reflectance: the truth is reflectance for sure; radiance without a white is refused.
    classes: what a user wants told apart, in the bands of the result; detect: the one of them
        that is looked for; learnt: whether they are judged by other lenslets of each.

    Raises InputError where no lenslet has values, UsageError where no white target fits.
    docs/model.md, "Measures".
    """
    white = _white_of(result, whites or {})
    values = _reflectance(result, white, needs_reflectance)
    cube = score_cube(values, truth, result.bands, light)
    if cube is None:
        raise InputError(
            "has no lenslet with values in all bands",
            result.path,
            "check the calibration it was made with",
        )
    picture = score_picture(values, truth, sigma=result.sigma) if result.kind == "image" else None
    patches, classification = None, None
    listed: tuple[PatchScore, ...] = ()
    if labels is not None:
        six = tuple(patch_index(name) + 1 for name in SIX_PATCHES)
        patches = score_patches(values, truth, labels, six)
        true = patch_statistics(truth, labels)
        classification = score_classification(
            values, labels, {label: one.mean for label, one in true.items()}
        )
        listed = _patches(patch_statistics(values, labels), true, six)
    return SpectraScore(
        cube=cube,
        picture=picture,
        patches=patches,
        classification=classification,
        classes=None
        if classes is None
        else score_classes(values, truth, _relative_sigma(result, values), classes, detect, learnt),
        snr=_snr(result, labels, white),
    ), listed


def _relative_sigma(result: Result, values: np.ndarray) -> np.ndarray | None:
    """Standard deviation in the units of `values`, which are the result's over a white's."""
    if result.sigma is None:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        return result.sigma * np.abs(values / result.values)


def _patches(
    found: dict[int, PatchStatistics], true: dict[int, PatchStatistics], six: tuple[int, ...]
) -> tuple[PatchScore, ...]:
    names = colorchecker()[0]
    return tuple(
        PatchScore(
            label=label,
            name=names[label - 1],
            lenslets=patch.count,
            mean=patch.mean.tolist(),
            std=patch.std.tolist(),
            truth=true[label].mean.tolist() if label in true else None,
            one_of_six=label in six,
        )
        for label, patch in found.items()
    )


def _reflectance(result: Result, white: WhiteTarget | None, needs_reflectance: bool) -> np.ndarray:
    """The result's values as reflectance: as they are, or radiance divided by that of the white
    target.
    """
    if result.quantity != "radiance":
        return result.values
    if white is None:
        if needs_reflectance:
            raise UsageError(
                "holds radiance, the truth is reflectance",
                result.path,
                "demux with --reference, or name the spectra of a white target with --white",
            )
        return result.values
    level = white.frames.mean(axis=0)
    if level.shape != result.values.shape:
        raise UsageError(
            (
                f"has {by(result.values.shape)} values (band x row x column), the white "
                f"target {by(level.shape)}"
            ),
            result.path,
            "demultiplex both with one calibration",
        )
    return (
        np.divide(result.values, level, out=np.full_like(level, np.nan), where=level > 0)
        * REFERENCE_REFLECTANCE
    )


def _snr(result: Result, labels: np.ndarray | None, white: WhiteTarget | None) -> SnrScore | None:
    """SNR on the white target, or on the chart's white patch where there is none."""
    if white is not None:
        count = len(white.frames)
        over = f"{count} frames over time" if count > 1 else "one frame over its lenslets"
        return score_snr(f"white target, {over}", white.frames, white.sigma)
    if labels is None or not (labels == WHITE_LABEL).any():
        return None
    patch = labels == WHITE_LABEL
    return score_snr(
        "white patch of the chart, over its lenslets",
        result.values[None][:, :, patch],
        None if result.sigma is None else np.asarray(result.sigma)[:, patch],
    )


def _white_of(result: Result, whites: Mapping[str, WhiteTarget]) -> WhiteTarget | None:
    """The white target made by the method of the result, else the only one there is."""
    if not whites:
        return None
    if result.method in whites:
        return whites[result.method]
    if len(whites) > 1:
        raise UsageError(
            (
                f"was made by {result.method or 'an unknown method'}, the white targets by "
                f"{', '.join(sorted(whites))}"
            ),
            result.path,
            "demultiplex a white target by the same method",
        )
    return next(iter(whites.values()))


def over_single_pixel(own: SpectraScore, single: SpectraScore) -> SinglePixelScore:
    """What a method gains over single pixel extraction; None where one of the two is not known."""
    pair = [score.snr.snr_capture_mean_db if score.snr else np.nan for score in (own, single)]
    return SinglePixelScore(
        _ratio(own.rmse, single.rmse),
        _ratio(own.six_patch_rmse, single.six_patch_rmse),
        _ratio(own.cube.delta_e_2000, single.cube.delta_e_2000),
        pair[0] - pair[1] if np.isfinite(pair).all() else None,
    )


def _ratio(own: float | None, single: float | None) -> float | None:
    return own / single if own is not None and single else None
