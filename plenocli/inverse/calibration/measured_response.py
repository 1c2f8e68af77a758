"""The response F from narrow-band captures: gathered lenslet by lenslet, then one for each
lenslet or one for all, as the data say.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.calibration.calibration import Response, Windows
from plenocli.inverse.calibration.quality import mean_of_known, quality_of

KINDS = ("auto", "shared", "own", "low-rank")
SAME_PLACE = 0.1
"""px by which lenslets may sit at different places within their windows and
still share a response.
"""
OUTLIER = 10.0
"""Excess of a single lenslet (plenocli.inverse.calibration.sharing) that is worth a word."""
BLOCK = 256


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Which response was taken, and what the lenslets say about it.

    response: "own", "shared" or "low-rank".
    text: the reasons, in words.
    excess: mean square by which lenslets differ over what their noise explains.
    error_of_shared: error of radiances by one F for all over that by one for each.
    worst_excess, worst_lenslet: the same for the lenslet that differs most, and where it is, if it
        is worth a word.
    rank, noise_left: of a low-rank response, and the share of the noise variance left in it.
    """

    response: str
    text: str
    excess: float | None = None
    error_of_shared: float | None = None
    worst_excess: float | None = None
    worst_lenslet: list[int] | None = None
    rank: int | None = None
    noise_left: float | None = None

    def as_json(self) -> dict[str, Any]:
        """The notes of a response in its file: what is known of the above."""
        return {name: value for name, value in asdict(self).items() if value is not None}


class GatheredResponses:
    """Responses of lenslets, filled band by band.

    windows: of all lenslets.
    valid: (lenslet_row, lenslet_column), which of them count.
    bands: how many there will be.

    response: (lenslet, pixel, band) of the valid lenslets in their order.
    energy: (band,), relative radiance of the sources.
    light, times: (pixel, band), means over lenslets of signal / exposure^2 and of 1 / exposure,
        from which the variance follows.
    """

    def __init__(self, windows: Windows, valid: np.ndarray, bands: int) -> None:
        self.windows, self.valid = windows, valid
        pixels = windows.shape[0] * windows.shape[1]
        self.response = np.empty((int(valid.sum()), pixels, bands), np.float32)
        self.energy, self.shares = np.ones(bands), np.ones(bands)
        self.light, self.times = np.full((2, pixels, bands), np.nan)

    def add(
        self,
        k: int,
        wavelength: float,
        signal: np.ndarray,
        weight: np.ndarray,
        share: float,
        energy: float,
    ) -> None:
        """Take in one band.

        k: its number.
        wavelength: m.
        signal: (row, column) at the reference exposure, NaN where not known.
        weight: (row, column), exposure of the signal over the reference's.
        share: exposure of one frame over the reference's.
        energy: relative radiance of the source.

        Raises NumericsError where there is no light.
        """
        from plenocli.forward.sensor.superpixel import extract

        sums, known = np.zeros((2, len(self.light))), np.zeros(len(self.light))
        light, number = np.zeros(2), 0
        corners, shape = self.windows.origin[self.valid][:, None], self.windows.shape
        weight = weight.astype(np.float32, copy=False)
        for first in range(0, len(corners), BLOCK):
            part = corners[first : first + BLOCK]
            cells, times = (extract(one, part, shape)[:, 0] for one in (signal, weight))
            self.response[first : first + BLOCK, :, k] = cells / np.float32(energy)
            good = np.isfinite(cells)
            cells, times = np.where(good, cells, 0), np.where(good, times, 1)
            light += cells.sum(dtype=float), np.square(cells, dtype=float).sum()
            number += int(good.sum())
            known += good.sum(axis=0)
            sums += (
                (np.clip(cells, 0, None) / times).sum(axis=0, dtype=float),
                (good / times).sum(axis=0, dtype=float),
            )
        middle = light[0] / max(number, 1)
        if not number or middle <= 6 * np.sqrt(max(light[1] / number - middle**2, 0) / number):
            raise NumericsError(
                f"the captures at {wavelength * 1e9:g} nm hold no light above the dark level",
                fix="check that dark and band files are not swapped",
            )
        with np.errstate(invalid="ignore"):
            self.light[:, k], self.times[:, k] = sums / known
        self.energy[k], self.shares[k] = energy, share

    def variance(self, noise: Noise, dark_variance: float) -> np.ndarray:
        """Variance of one lenslet's response, mean over lenslets: shot noise, read noise, which
        comes once a frame, however short, and that of the dark image.

        noise: of one frame.
        dark_variance: of the dark image, units^2.

        Returns (pixel, band), units^2.
        """
        return (
            noise.gain * self.light
            + noise.without_signal / self.shares * self.times
            + dark_variance
        ) / self.energy**2


def measured_response(
    asked: str,
    gathered: GatheredResponses,
    variance: np.ndarray | None,
    *,
    wavelengths: np.ndarray,
    centres: np.ndarray,
    cfa: str,
) -> Response:
    """The response of a camera from what its captures gathered, which may give its array up.

    asked: "own", "shared", "low-rank" (noise taken off by what the lenslets have in common), or
        "auto": shared where lenslets sit at one place within their windows and differ by so little
        more than their noise that one F for all predicts the smaller error of radiances.
    variance: (pixel, band) of one lenslet's response; None: unknown.
    wavelengths: (band,) m.
    centres: (lenslet_row, lenslet_column, 2) px.
    cfa: "mono" or four letters.

    Returns Response, its notes being those of a Verdict.
    Raises NumericsError where what is asked for cannot be.
    """
    matrix, variance, verdict = _decided(asked, gathered, variance, centres, cfa)
    quality, angle = quality_of(matrix, variance, gathered.valid)
    least = (
        "one band" if angle is None else f"smallest angle between two columns of F {angle:.2f} deg"
    )
    return Response(
        matrix=matrix,
        variance=variance,
        wavelengths=wavelengths,
        energy=gathered.energy,
        quality=quality,
        notes=replace(verdict, text=f"{least}; {verdict.text}").as_json(),
    )


def _decided(
    asked: str,
    gathered: GatheredResponses,
    variance: np.ndarray | None,
    centres: np.ndarray,
    cfa: str,
) -> tuple[np.ndarray, np.ndarray | None, Verdict]:
    """(F, its variance or None, Verdict), arguments as measured_response's."""
    valid, origin = gathered.valid, gathered.windows.origin
    places = (centres - origin)[valid]
    phase = origin[valid] % 2 @ [2, 1] if cfa != "mono" else np.zeros(int(valid.sum()), int)
    obstacle = _obstacle(places, phase)
    known = variance is not None and bool(np.isfinite(variance).all(axis=0).any())
    if asked == "shared" and obstacle:
        raise NumericsError(f"{obstacle}: no F serves them all", fix="leave --response to auto")
    if asked == "low-rank":
        return _low_rank(gathered, variance if known else None, phase)
    if asked == "own" or obstacle or (asked == "auto" and (not known or len(phase) < 2)):
        why = (
            ""
            if asked == "own"
            else f" ({obstacle})"
            if obstacle
            else " (the noise of the captures is not known)"
            if not known
            else " (there is but one lenslet)"
        )
        text = f"F of its own for each of {len(phase)} lenslets{why}"
        return _whole(gathered), variance, Verdict(response="own", text=text)
    middle = mean_of_known(gathered.response)
    if variance is None or not known:
        return middle, None, Verdict(response="shared", text=f"one F for {len(phase)} lenslets")
    return _own_or_shared(asked, gathered, middle, variance)


def _own_or_shared(
    asked: str, gathered: GatheredResponses, middle: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Verdict]:
    """As _decided where one F for all, `middle`, is possible and the noise of each is known."""
    from plenocli.inverse.calibration.sharing import differences

    found, count = differences(gathered.response, middle, variance), len(gathered.response)
    verdict = Verdict(
        response="shared" if asked == "shared" or found.error < 1 else "own",
        text="",
        excess=found.excess,
        error_of_shared=found.error,
    )
    text = (
        f"lenslets differ by {found.excess:.3g} times what noise explains (mean square), an F for "
        f"all errs {found.error:.3g} times as much as one for each"
    )
    if found.worst > OUTLIER * max(1.0, found.excess):
        site = [int(n) for n in np.argwhere(gathered.valid)[found.number]]
        verdict = replace(verdict, worst_excess=found.worst, worst_lenslet=site)
        text += f", lenslet {site} differs by {found.worst:.3g} times"
    if verdict.response == "own":
        text = f"F of its own for each of {count} lenslets ({text})"
        return _whole(gathered), variance, replace(verdict, text=text)
    text = f"one F for {count} lenslets ({text})"
    return middle, variance / count + found.spread, replace(verdict, text=text)


def _obstacle(places: np.ndarray, phase: np.ndarray) -> str | None:
    """Why no response can serve all lenslets, or None: every window must see its lenslet, and
    its colours, at the same place.
    """
    apart = float(np.ptp(places, axis=0).max())
    if apart > SAME_PLACE:
        return f"lenslets sit at different places within their windows, by up to {apart:.2f} px"
    return "windows start on different colours of the filter array" if np.ptp(phase) else None


def _whole(gathered: GatheredResponses) -> np.ndarray:
    """Responses (lenslet_row, lenslet_column, pixel, band), NaN at lenslets that are not valid;
    `gathered` gives its own array up where it is the same.
    """
    valid, response = gathered.valid, gathered.response
    if valid.all():
        return response.reshape(*valid.shape, *response.shape[1:])
    out = np.full((*valid.shape, *response.shape[1:]), np.nan, np.float32)
    out[valid] = response
    return out


def _low_rank(
    gathered: GatheredResponses, variance: np.ndarray | None, phase: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Verdict]:
    from plenocli.inverse.calibration.low_rank import low_rank

    if variance is None:
        raise NumericsError(
            "the noise of the captures is not known, and so not what stands out of it",
            fix="give --camera, or two frames of a scene, or leave --response to auto",
        )
    gathered.response, left, rank = low_rank(gathered.response, variance, phase)
    text = (
        f"F of its own for each of {len(phase)} lenslets, denoised to rank {rank}: {left:.1%} of "
        "the noise variance left"
    )
    return (
        _whole(gathered),
        variance * left,
        Verdict(response="low-rank", text=text, rank=rank, noise_left=left),
    )
