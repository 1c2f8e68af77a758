"""The noise that reconstruct believes.

One rule, wherever a method needs it: the noise given by the user; else the capture's own; but where
MISFIT times more than that is found in what the system matrix cannot produce, what is found,
doubled as long as photographs would need more contrast than they have to explain the rest.
"""

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.base.progress import note

MISFIT = 1.5
"""Noise found over the capture's own from which on it is believed: the capture holds light that
the matrix does not know.
"""
GIVEN, TOLD, FOUND, UNEXPLAINED = (
    "given",
    "from the capture",
    "estimated from what the system matrix cannot produce",
    "what photographs do not explain",
)


def outside(svd, y, known):
    """Root mean square of what no object gives in superpixels y (.., pixel); None where the matrix
    reaches every direction and the noise is `known` anyway.
    """
    from plenocli.inverse.picture.solvers.least_squares import estimate_noise

    try:
        return estimate_noise(svd, y.reshape(-1, y.shape[-1]).T)
    except NumericsError:
        if not known:
            raise
        return None


def believed(y, known, found, report, *, hint="", implausible=None):
    """Standard deviation of what in superpixels y (.., pixel) is taken for noise; the report says
    which it is ("noise_source"), and how much is found beyond the known noise, root mean square,
    where both are known ("excess").

    known: the capture's own, or None.
    found: root mean square of what A x does not give, or None where that was not looked at.
    implausible: says of a noise whether photographs would need more contrast than they have to
        explain y. What the matrix cannot produce tells of light that it does not know; what it can
        produce by chance of such light looks like an enormous contrast, in which every
        method would drown.
    """
    # rounding of the data
    floor = max(1e-9 * float(np.abs(y).max(initial=0)), np.finfo(float).tiny)
    sigma, source = max(known or 0.0, floor), TOLD
    if found is not None and known:
        report["excess"] = float(np.sqrt(max(max(found, floor) ** 2 - known**2, 0.0)))
    if known is None:
        sigma, source = max(found, floor), FOUND
        note(f"the capture does not say its noise: sigma = {sigma:.3g}, {FOUND}")
    elif found is not None and found > MISFIT * sigma:
        note(
            f"the capture holds {found / sigma:.3g} times more than its noise that the system "
            f"matrix cannot produce: sigma = {found:.3g} is used{hint}"
        )
        sigma, source = found, FOUND
        while implausible is not None and implausible(sigma):
            sigma, source = 2 * sigma, UNEXPLAINED
        if source == UNEXPLAINED:
            note(
                f"photographs explain this capture only if sigma = {sigma:.3g}: most of the "
                "picture's detail is lost to light that the system matrix does not know"
            )
    report |= {"noise_sigma": float(sigma), "noise_source": source}
    return float(sigma)
