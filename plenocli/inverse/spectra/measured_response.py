"""The response F from narrow-band captures: gathered lenslet by lenslet, then one for each
lenslet or one for all, as the data say.
"""

import numpy as np

from plenocli.base.errors import NumericsError

KINDS = ("auto", "shared", "own", "low-rank")
SAME_PLACE = 0.1
"""px by which lenslets may sit at different places within their windows and
still share a response.
"""
OUTLIER = 10.0
"""Excess of a single lenslet (plenocli.inverse.spectra.sharing) that is worth a word."""
BLOCK = 256


def mean(cells):
    """Mean over the first axis of the values known; NaN where none is."""
    known = np.isfinite(cells)
    with np.errstate(invalid="ignore"):
        return (np.where(known, cells, 0).sum(axis=0, dtype=float) / known.sum(axis=0)).astype(
            np.float32
        )


class Gathered:
    """Responses of lenslets, filled band by band.

    origin (R, C, 2) and window (h, w) px;
    valid (R, C).

    response (lenslet, pixel, band) of the valid lenslets in their order;
    energy (band,): radiance of the sources;
    light and times (pixel, band): means over lenslets of signal / exposure^2 and of 1 / exposure,
        from which the variance follows.
    """

    def __init__(self, origin, window, valid, bands):
        self.origin, self.window, self.valid = origin, window, valid
        pixels = window[0] * window[1]
        self.response = np.empty((int(valid.sum()), pixels, bands), np.float32)
        self.energy, self.shares = np.ones(bands), np.ones(bands)
        self.light, self.times = np.full((2, pixels, bands), np.nan)

    def add(self, k, wavelength, signal, weight, share, energy):
        """Band k: signal (rows, columns), NaN where not known, and its exposure `weight`, both at
        the reference exposure;

        share: exposure of one frame over the reference's.
        NumericsError where there is no light.
        """
        from plenocli.forward.sensor.superpixel import extract

        sums, known, light, number = (
            np.zeros((2, len(self.light))),
            np.zeros(len(self.light)),
            np.zeros(2),
            0,
        )
        corners = self.origin[self.valid][:, None]
        for first in range(0, len(corners), BLOCK):
            cells = extract(signal, corners[first : first + BLOCK], self.window)[:, 0]
            times = extract(
                weight.astype(np.float32, copy=False), corners[first : first + BLOCK], self.window
            )[:, 0]
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

    def variance(self, gain, read_variance, dark_variance):
        """Variance (pixel, band) of one lenslet's response, mean over lenslets: shot noise, read
        noise, which comes once a frame, however short, and that of the dark image.
        """
        return (
            gain * self.light + read_variance / self.shares * self.times + dark_variance
        ) / self.energy**2


def decide(asked, gathered, variance, places, cfa):
    """(F, its variance (pixel, band) or None, record): F (R, C, pixel, band), or (pixel,
    band) for all lenslets.

    asked: "own", "shared", "low-rank" (noise taken off by what the lenslets have in common), or
        "auto": shared where lenslets sit at one place within their windows and differ by so little
        more than their noise that one F for all predicts the smaller error of radiances.
    places (lenslet, 2) px: of the lenslets within their windows.
    NumericsError where what is asked for cannot be.
    """
    from plenocli.inverse.spectra.sharing import differences

    valid, phase = (
        gathered.valid,
        gathered.origin[gathered.valid] % 2 @ [2, 1]
        if cfa != "mono"
        else np.zeros(int(gathered.valid.sum()), int),
    )
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
        return (
            _whole(gathered),
            variance,
            {"response": "own", "text": f"F of its own for each of {len(phase)} lenslets{why}"},
        )
    middle = mean(gathered.response)
    if not known:
        return middle, None, {"response": "shared", "text": f"one F for {len(phase)} lenslets"}
    found = differences(gathered.response, middle, variance)
    record = {
        "response": "shared" if asked == "shared" or found.error < 1 else "own",
        "excess": found.excess,
        "error_of_shared": found.error,
    }
    text = (
        f"lenslets differ by {found.excess:.3g} times what noise explains (mean square), an F for "
        f"all errs {found.error:.3g} times as much as one for each"
    )
    if found.worst > OUTLIER * max(1.0, found.excess):
        site = [int(n) for n in np.argwhere(valid)[found.number]]
        record |= {"worst_excess": found.worst, "worst_lenslet": site}
        text += f", lenslet {site} differs by {found.worst:.3g} times"
    if record["response"] == "own":
        return (
            _whole(gathered),
            variance,
            record | {"text": f"F of its own for each of {len(phase)} lenslets ({text})"},
        )
    return (
        middle,
        variance / len(phase) + found.spread,
        record | {"text": f"one F for {len(phase)} lenslets ({text})"},
    )


def _obstacle(places, phase):
    """Why no response can serve all lenslets, or None: every window must see its lenslet, and
    its colours, at the same place.
    """
    apart = float(np.ptp(places, axis=0).max())
    if apart > SAME_PLACE:
        return f"lenslets sit at different places within their windows, by up to {apart:.2f} px"
    return "windows start on different colours of the filter array" if np.ptp(phase) else None


def _whole(gathered):
    """(R, C, pixel, band), NaN at lenslets that are not valid; `gathered` gives its own array up
    where it is the same.
    """
    valid, response = gathered.valid, gathered.response
    if valid.all():
        return response.reshape(*valid.shape, *response.shape[1:])
    out = np.full((*valid.shape, *response.shape[1:]), np.nan, np.float32)
    out[valid] = response
    return out


def _low_rank(gathered, variance, phase):
    from plenocli.inverse.spectra.low_rank import low_rank

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
        {"response": "low-rank", "rank": rank, "noise_left": left, "text": text},
    )


def conditions(response, variance, valid, record):
    """What is said of F beside its values: condition, angles between columns, brightest pixels,
    bias by its noise, and `record`.
    """
    from plenocli.inverse.spectra.demultiplex import (
        calibration_bias,
        choose_pixels,
        column_angles,
        condition_number,
    )

    sample = (
        response[None]
        if response.ndim == 2
        else response[valid]
        if not valid.all()
        else response.reshape(-1, *response.shape[-2:])
    )
    blocks = [sample[first : first + BLOCK] for first in range(0, len(sample), BLOCK)]
    condition = np.concatenate([condition_number(one) for one in blocks])
    angles = np.concatenate([column_angles(one) for one in blocks])
    between = angles[(slice(None), *np.triu_indices(response.shape[-1], 1))]
    least = (
        f"smallest angle between two columns of F {between.min():.2f} deg"
        if between.size
        else "one band"
    )
    out = dict(
        condition=float(np.median(condition)),
        angles=np.median(angles, axis=0).tolist(),
        single_pixel=[int(p) for p in choose_pixels(mean(sample))],
        notes=record | {"text": f"{least}; {record['text']}"},
    )
    if variance is not None:
        bias = calibration_bias(sample[:: max(1, len(sample) // 32)], variance)
        out["bias"] = np.median(np.diagonal(bias, axis1=-2, axis2=-1), axis=0).tolist()
    return out
