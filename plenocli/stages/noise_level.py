"""The noise that reconstruct believes: given, told by the capture, or estimated from what the system matrix cannot produce."""

import numpy as np

from plenocli.errors import NumericsError
from plenocli.stages.progress import note

MISFIT = 1.5
"""Estimated noise over the capture's own from which on the estimate is believed."""
ESTIMATED = "estimated from what the system matrix cannot produce"


def own_noise(svd, y, known, given, report, hint=""):
    """Standard deviation of what in superpixels y (.., pixel) is not A x; the report says which one it is.

    known: the capture's own or None; given: by the user or None. The estimate also wins over the capture's figure where it is
    MISFIT times larger: then y holds more than A x and the sensor's noise (neighbours' light, another matrix), which would be
    amplified if it were trusted as signal.
    """
    if given is not None:
        sigma, source = given, "given"
    else:
        sigma, source, found = _estimated(svd, y.reshape(-1, y.shape[-1]).T, known, hint)
        excess(report, found, known)
    report |= {"noise_sigma": float(sigma), "noise_source": source}
    return float(sigma)


def excess(report, found, known):
    """Keeps in the report what is found beyond the known noise, root mean square, where both are known."""
    if found is not None and known:
        report["excess"] = float(np.sqrt(max(found**2 - known**2, 0.0)))


def told_noise(y, known, report):
    """The capture's own noise `known`, but not less than rounding, where a matrix models all of the light."""
    report |= {"noise_sigma": max(known, _floor(y)), "noise_source": "from the capture"}
    return report["noise_sigma"]


def _estimated(svd, stacked, known, hint):
    from plenocli.solvers.linear import estimate_noise

    floor = _floor(stacked)
    try:
        sigma = max(estimate_noise(svd, stacked), floor)
    except NumericsError:
        if not known:
            raise
        return known, "from the capture", None
    if known is None:
        note(f"the capture does not say its noise: sigma = {sigma:.3g}, {ESTIMATED}")
    elif sigma <= MISFIT * max(known, floor):
        return max(known, floor), "from the capture", sigma
    else:
        note(f"the capture holds {sigma / max(known, floor):.3g} times more than its noise that the system matrix cannot produce: sigma = {sigma:.3g} is used{hint}")
    return sigma, ESTIMATED, sigma


def _floor(y):
    """The least noise that is believed: rounding of the data."""
    return max(1e-9 * float(np.abs(y).max(initial=0)), np.finfo(float).tiny)
