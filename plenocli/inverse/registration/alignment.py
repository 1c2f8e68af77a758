"""What stands between a capture and its calibration: moved lenslets, an offset, light that the
calibration does not know.
"""

from dataclasses import replace

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.base.progress import note

MODES = ("auto", "on", "off")
# residual over noise, mean squares, above which the calibration does not describe the capture
POOR_FIT = 1.5
FITS = 1.02  # residual over noise up to which a correction is believed without further question
# share of the residual's excess over noise that a correction may leave where the capture
# fits worse than that
BELIEVED = 0.15
ALIKE = 0.02  # px: a shared response stays shared where displacements differ by less
# standard deviations of one pixel in the dark: less costs less than the noise of one lenslet
LEAST_OFFSET = 0.1


def align(calibration, signal, noise, mode, path, levels=True):
    """(calibration, signal, stray, record) with the response moved to where the
    capture's lenslets are.

    calibration: plenocli.stages.inverse.demux.Response;
    signal (rows, columns), dark removed;
    noise: (gain, read variance) or None.
    mode: auto corrects what is more than chance, on corrects whatever is found and fails where
        nothing can be, off looks at nothing. stray:
        plenocli.inverse.registration.moved_response.even_light, patterns that deserve unknowns of
        their own where there is more of it than chance (None: there is not). record: what was
        found, for the file and the report (None: off).
    levels: whether offset and stray light are corrected, which mean nothing where the motion cannot
        be followed. A predicted response errs in shape by more than either, and would pass its
        errors off as both: there motion alone is corrected.
    """
    from plenocli.inverse.registration.motion import REACH, motion_since
    from plenocli.inverse.registration.moved_response import even_light

    c = calibration
    if mode == "off":
        return c, signal, None, None
    motion = motion_since(c.reference, signal, noise)
    if motion is None:
        if mode == "on":
            raise NumericsError(
                "cannot be registered: fewer than three lenslets hold light",
                path,
                "expose longer, or use --register off",
            )
        return c, signal, None, {"corrected": [], "reason": "fewer than three lenslets hold light"}
    better = motion.after < motion.before
    dark = np.sqrt(noise[1]) if noise is not None else 0.0
    corrected = []
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
    if better and (mode == "on" or motion.moved):
        corrected.append("motion")
    levels = levels and not lost and not c.predicted
    if levels and motion.lifted and (mode == "on" or abs(motion.offset) > LEAST_OFFSET * dark):
        corrected.append("offset")
    if levels and motion.strayed:
        corrected.append("stray light")
    if "motion" in corrected:
        c = _moved(c, motion)
    if "offset" in corrected:
        signal = signal - np.float32(motion.offset)
    return (
        c,
        signal,
        even_light(c.window, c.cfa) if "stray light" in corrected else None,
        _record(motion, corrected),
    )


def _moved(c, motion):
    """The calibration with windows moved by whole pixels (whole periods of a colour mosaic) and
    responses by what is left.
    """
    from plenocli.inverse.registration.motion import Smooth
    from plenocli.inverse.registration.moved_response import Moved

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
    variance = _carried(
        c, Smooth.of(None, c.window, c.cfa, gains), corners[0], rest[c.sites].mean(axis=0)
    )
    if together:
        smooth = Smooth(c.response[None], corners[:1], c.window, c.cfa, gains)
        return replace(
            c,
            response=smooth.at(origin[c.sites][:1], rest[c.sites].mean(axis=0, keepdims=True))[0],
            origin=origin,
            variance=variance,
        )
    return replace(
        c,
        response=Moved(c.response, c.origin, origin, rest, c.reference),
        origin=origin,
        variance=variance,
    )


def _carried(c, smooth, corner, shift):
    """Variance of the moved response (pixel, band): that of one for all is moved with it; that of
    own ones stays, and what is left of it in the pictures that they have in common comes on top.
    """
    if c.variance is None:
        return None
    if c.shared:
        return smooth.noise(c.variance, corner, corner, shift)
    return c.variance + smooth.noise(c.reference.variance, corner, corner, shift)


def _record(motion, corrected):
    return {
        "corrected": corrected,
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


def _or_none(value):
    return float(value) if np.isfinite(value) else None


def misfit(residual):
    """Median over lenslets of the residual's mean square over the expected one; 0 where the
    noise is not known.
    """
    return (
        float(np.nanmedian(residual))
        if residual is not None and np.isfinite(residual).any()
        else 0.0
    )


def doubtful(residual, record):
    """Whether something was corrected although the calibration does not quite describe the capture:
    another shape of the superpixels (focus, filters), or neighbours' light, passes for a little
    motion, an offset and stray light.
    """
    return misfit(residual) > FITS and record is not None and bool(record["corrected"])


def believed(residual, plain):
    """Whether the residuals with a correction are as far below those without (plain) as they are
    if that is what was wrong.
    """
    return misfit(residual) - 1 <= BELIEVED * (misfit(plain) - 1)


def judge(residual, record, path):
    """Warn where the calibration does not describe the capture; returns the sentence, or None."""
    middle = misfit(residual)
    if middle <= POOR_FIT:
        return None
    tried = (
        "it was not registered"
        if record is None
        else "after registration"
        if record["corrected"]
        else "and no motion explains it"
    )
    text = (
        f"the calibration does not describe this capture: residuals have {middle:.3g} times the "
        f"power of the noise ({tried}). Predicted errors are too small; filters, leak between "
        "bands, focus or the scene within a lenslet's field may differ: calibrate again"
    )
    note(f"warning: {path}: {text}")
    return text
