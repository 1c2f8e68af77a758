"""What stands between a capture and its calibration: moved lenslets, an offset, light that the
calibration does not know.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.inverse.calibration.calibration import there

if TYPE_CHECKING:
    from plenocli.forward.sensor.noise import Noise
    from plenocli.forward.sensor.readout import Readout
    from plenocli.inverse.registration.motion import Motion
    from plenocli.inverse.registration.smooth_response import SmoothResponses
    from plenocli.inverse.spectra.responses import LensletResponses

POOR_FIT = 1.5
"""Residual over noise, mean squares, above which the calibration does not describe the capture."""
FITS = 1.02
"""Residual over noise up to which a correction is believed without further question."""
BELIEVED = 0.15
"""Share of the residual's excess over noise that a correction may leave where the capture fits
worse than that.
"""
ALIKE = 0.02
"""px: a shared response stays shared where displacements differ by less."""
LEAST_OFFSET = 0.1
"""Standard deviations of one pixel in the dark: less costs less than the noise of one lenslet."""


@dataclass(frozen=True)
class Registration:
    """What was found between a capture and its calibration.

    corrected: what was corrected of "motion", "offset" and "stray light".
    motion: None where nothing could be found, which `reason` tells.
    """

    corrected: tuple[str, ...]
    motion: Motion | None
    reason: str | None = None

    def as_json(self) -> dict[str, Any]:
        """For the file and the report."""
        found, motion = {"corrected": list(self.corrected)}, self.motion
        if motion is None:
            return found | {"reason": self.reason}
        return found | {
            "shift_px": [float(v) for v in motion.shift],
            "shift_sigma_px": [float(v) for v in motion.sigma[:2]],
            "rotation_deg": float(np.degrees(motion.rotation)),
            "stretch": (motion.matrix + motion.matrix.T).tolist(),
            "largest_px": motion.reach,
            "offset": motion.offset,
            "offset_sigma": _or_none(motion.sigma[2]),
            "stray": motion.stray,
            "stray_sigma": _or_none(motion.stray_sigma),
            "residual_before": motion.before,
            "residual_after": motion.after,
            "lenslets": motion.lenslets,
        }


@dataclass(frozen=True)
class Aligned:
    """A capture and responses that go together.

    responses: where the capture's lenslets are.
    signal: of the capture, an offset taken off.
    stray: plenocli.inverse.registration.moved_response.even_light, patterns that deserve unknowns
        of their own where there is more of it than chance; None: there is not.
    registration: what was found; None: nobody looked.
    """

    responses: LensletResponses
    signal: Readout | np.ndarray
    stray: np.ndarray | None
    registration: Registration | None


def align(
    c: LensletResponses,
    signal: Readout | np.ndarray,
    noise: Noise | None,
    mode: str,
    path: str | Path,
    levels: bool = True,
) -> Aligned:
    """The responses moved to where the lenslets of a capture are.

    signal: (row, column), dark removed.
    noise: of the signal; None: unknown.
    mode: auto corrects what is more than chance, on corrects whatever is found and fails where
        nothing can be, off looks at nothing.
    path: of the capture, for messages.
    levels: whether offset and stray light are corrected, which mean nothing where the motion cannot
        be followed. A predicted response errs in shape by more than either, and would pass its
        errors off as both: there motion alone is corrected.

    Raises NumericsError where the mode is on and the motion cannot be told or followed.
    """
    from plenocli.inverse.registration.motion import motion_since
    from plenocli.inverse.registration.moved_response import even_light
    from plenocli.inverse.registration.reference import REACH

    if mode == "off":
        return Aligned(c, signal, None, None)
    motion = motion_since(c.reference, signal, noise)
    if motion is None:
        if mode == "on":
            raise NumericsError(
                "cannot be registered: fewer than three lenslets hold light",
                path,
                "expose longer, or use --register off",
            )
        reason = "fewer than three lenslets hold light"
        return Aligned(c, signal, None, Registration((), None, reason))
    lost = motion.reach > REACH + 2
    if mode == "on" and lost:
        raise NumericsError(
            (
                f"cannot be registered: the best motion is {motion.reach:.3g} px, further "
                "than it can be followed"
            ),
            path,
            "calibrate again, or use --register off",
        )
    levels = levels and not lost and not c.predicted
    corrected = _what_to_correct(motion, noise, mode == "on", levels)
    if "motion" in corrected:
        c = moved_with(c, motion)
    if "offset" in corrected:
        signal = signal - float(np.float32(motion.offset))
    stray = even_light(c.window, c.cfa) if "stray light" in corrected else None
    return Aligned(c, signal, stray, Registration(corrected, motion))


def _what_to_correct(
    motion: Motion, noise: Noise | None, asked: bool, levels: bool
) -> tuple[str, ...]:
    """What deserves a correction; asked: even by no more than chance."""
    dark = noise.sigma if noise is not None else 0.0
    large = abs(motion.offset) > LEAST_OFFSET * dark
    deserves = {
        "motion": motion.after < motion.before and (asked or motion.moved),
        "offset": levels and motion.lifted and (asked or large),
        "stray light": levels and motion.strayed,
    }
    return tuple(name for name, wanted in deserves.items() if wanted)


def moved_with(c: LensletResponses, motion: Motion) -> LensletResponses:
    """The responses after a motion: windows moved by whole pixels (whole periods of a colour
    mosaic) and responses by what is left.
    """
    from plenocli.inverse.registration.moved_response import MovedResponses
    from plenocli.inverse.registration.smooth_response import SmoothResponses

    shifts = np.zeros((*c.valid.shape, 2))
    shifts[c.sites] = motion.at(c.centres[c.sites])
    here, corners, gains = shifts[c.sites], c.origin[c.sites], c.reference.gains
    together = (
        c.shared and np.ptp(here, axis=0).max() < ALIKE and not np.ptp(corners % 2, axis=0).any()
    )
    period = 1 if c.cfa == "mono" else 2
    whole = np.zeros(shifts.shape, int)
    whole[c.sites] = period * np.rint(
        (here.mean(axis=0) if together else motion.at(motion.middle) if c.cfa == "mono" else here)
        / period
    )
    origin, rest = c.origin + whole, shifts - whole
    no_pictures = np.zeros((0, len(c.wavelengths), *c.window), np.float32)
    colours = SmoothResponses.of(no_pictures, c.window, c.cfa, gains)
    variance = _carried(c, colours, corners[0], rest[c.sites].mean(axis=0))
    if together:
        smooth = SmoothResponses(c.common[None], corners[:1], c.window, c.cfa, gains)
        return replace(
            c,
            response=smooth.at(origin[c.sites][:1], rest[c.sites].mean(axis=0, keepdims=True))[0],
            origin=origin,
            variance=variance,
        )
    return replace(
        c,
        response=MovedResponses(c.response, c.origin, origin, rest, c.reference),
        origin=origin,
        variance=variance,
    )


def _carried(
    c: LensletResponses, smooth: SmoothResponses, corner: np.ndarray, shift: np.ndarray
) -> np.ndarray | None:
    """Variance of the moved response (pixel, band): that of one for all is moved with it; that of
    own ones stays, and what is left of it in the pictures that they have in common comes on top.
    """
    if c.variance is None:
        return None
    if c.shared:
        return smooth.moved_variance(c.variance, corner, corner, shift)
    return c.variance + smooth.moved_variance(there(c.reference.variance), corner, corner, shift)


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def misfit(residual: np.ndarray | None) -> float:
    """Median over lenslets of the residual's mean square over the expected one; 0 where the
    noise is not known.
    """
    return (
        float(np.nanmedian(residual))
        if residual is not None and np.isfinite(residual).any()
        else 0.0
    )


def doubtful(residual: np.ndarray | None, registration: Registration | None) -> bool:
    """Whether something was corrected although the calibration does not quite describe the capture:
    another shape of the superpixels (focus, filters), or neighbours' light, passes for a little
    motion, an offset and stray light.
    """
    return misfit(residual) > FITS and registration is not None and bool(registration.corrected)


def believed(residual: np.ndarray | None, plain: np.ndarray | None) -> bool:
    """Whether the residuals with a correction are as far below those without (plain) as they are
    if that is what was wrong.
    """
    return misfit(residual) - 1 <= BELIEVED * (misfit(plain) - 1)


def misfit_told(residual: np.ndarray | None, registration: Registration | None) -> str | None:
    """The sentence where the calibration does not describe the capture, else None.

    residual: (lenslet_row, lenslet_column), of its mean square over the expected one.
    registration: what was found between the two.
    """
    middle = misfit(residual)
    if middle <= POOR_FIT:
        return None
    tried = (
        "it was not registered"
        if registration is None
        else "after registration"
        if registration.corrected
        else "no motion explains it"
    )
    return (
        f"residuals have {middle:.3g} times the power of the noise ({tried}), so that stated "
        "errors are too small. Broad light where bands were calibrated narrow does so, most of "
        "which divides out with --reference; so do another focus, a leak, edges within lenslets' "
        "fields: calibrate again"
    )
