"""Accuracy against cost: what a scene requires, what each model costs, which is cheapest."""

from plenocli.accuracy.dial import plan_pif
from plenocli.optics.pif import PifBuilder, build_pif

__all__ = ["pif_builder", "plan_pif", "system_matrix"]


def system_matrix(camera, *, progress=None, **request):
    """Plan and compute the system matrix of `camera`, a Pif; `request` as for plan_pif."""
    return build_pif(camera, plan_pif(camera, **request), points=request.get("points"), progress=progress)


def pif_builder(camera, wavelength, **request):
    """A PifBuilder of `camera` at `wavelength` (m), planned by plan_pif with `request`."""
    return PifBuilder(camera, wavelength, plan_pif(camera, wavelengths=(wavelength,), **request), dtype=request.get("dtype", "float32"))
