"""The models: every way to compute a system matrix, where it holds, how far it is from the finest
one and what it costs.

The finest model is scalar and exact from the lenslets to the sensor
(plenocli.forward.propagation.exact.lenslets). Errors are relative L2 norms of the worst
column against it.
"""

from __future__ import annotations

import importlib
import math
from abc import ABC, abstractmethod
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from plenocli.forward.propagation.costs import law
from plenocli.forward.propagation.fresnel import paraxial_error
from plenocli.forward.propagation.plan import BandPlan, PifPlan
from plenocli.forward.propagation.sampling import coherent_window, is_symmetric, size_band, touch

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.costs import Cost, Features
    from plenocli.forward.propagation.lenslet_fields import LensletFields


TRIED = 1.05
"""Estimate over the error found on columns that were tried."""
FEW_CELLS = 4.0
"""Diffraction cells beyond which square lenslets that touch are as the law of paraxial errors was
found on.
"""


class Later:
    """A function or class of this room that is imported when it is first called: a command plans
    with one or two of the models, and starts without the code of the others.

    module: where it is;
    name: there.
    """

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = f"{__package__}.{module}", name

    def __call__(self, *args: Any) -> Any:
        return getattr(importlib.import_module(self.module), self.name)(*args)


def later(module: str, name: str) -> Any:
    """Later, for whoever checks types: anything that may be called."""
    return Later(module, name)


class Model(ABC):
    """One way to compute a system matrix.

    name: as plans and tables show it;
    kind: "ray", "fresnel" or "exact", what --model asks for;
    lenslets: the LensletFields that compute it, Later;
    libraries: with threads of their own, which it computes with beside numpy;
    on_device: whether a graphics card may do a part of it.
    """

    name: str
    kind: str
    lenslets: Later
    libraries: tuple[str, ...] = ()
    on_device: bool = False

    @abstractmethod
    def valid_for(self, camera: Camera, geometry: Geometry) -> str | None:
        """None, or one sentence why the model cannot serve the camera."""

    @abstractmethod
    def error_bound(
        self, camera: Camera, geometry: Geometry, superpixels: tuple[int, int], ring: int
    ) -> float:
        """Estimated relative L2 error of the worst column against the finest model.

        superpixels: (rows, columns) kept;
        ring: rings of coherent neighbours, 0 for isolated lenslets.
        """

    @abstractmethod
    def size(
        self,
        camera: Camera,
        geometry: Geometry,
        superpixels: tuple[int, int],
        ring: int,
        accuracy: float,
        tolerance: float,
    ) -> BandPlan:
        """Node counts at one wavelength.

        superpixels: (rows, columns) kept;
        ring: rings of coherent neighbours, 0 for isolated lenslets;
        accuracy: that sampling may use up;
        tolerance: root-energy cut of the spread function.

        Raises NumericsError where there is no affordable one.
        """

    @abstractmethod
    def features(
        self,
        camera: Camera,
        geometry: Geometry,
        band: BandPlan,
        shape: tuple[int, int, int, int],
        double: bool,
    ) -> Features:
        """What the matrix at one wavelength consists of.

        band: as `size` gives it;
        shape: (band, superpixel, pixel, point);
        double: whether its fields have double precision.

        Raises NumericsError where the model would need too much.
        """

    def cost(
        self,
        camera: Camera,
        geometry: Geometry,
        band: BandPlan,
        shape: tuple[int, int, int, int],
        double: bool,
    ) -> Cost:
        """Cost of the matrix at one wavelength, as `features`."""
        return law(self.name).cost(self.features(camera, geometry, band, shape, double))

    def fields(
        self, camera: Camera, geometry: Geometry, plan: PifPlan, band: BandPlan
    ) -> LensletFields:
        """The fields at one wavelength, as planned.

        geometry: at that wavelength;
        band: node counts there, one of the plan's.
        """
        return self.lenslets(camera, geometry, plan, band)


def _square_only(camera: Camera, geometry: Geometry) -> str | None:
    array = camera.lenslet_array
    if array.lattice != "square" or array.aperture_shape != "square":
        return f"{array.aperture_shape} lenslets on a {array.lattice} lattice are not separable"
    return None


def _parabolic(camera: Camera) -> bool:
    return camera.lenslet_array.profile == "parabolic"


def _paraxial_error(
    camera: Camera, geometry: Geometry, superpixels: tuple[int, int], ring: int
) -> float:
    """As Model.error_bound: by a law; of other lenslets than those it was found on, by columns of
    both models.
    """
    parabolic = _parabolic(camera)
    if touch(geometry) and geometry.diffraction_cells > FEW_CELLS:
        return paraxial_error.paraxial_error(geometry, parabolic)
    from plenocli.forward.propagation.exact.open_fields import too_near
    from plenocli.forward.propagation.exact.trial import paraxial_off

    found = None
    if too_near(geometry) is None:
        window = coherent_window(geometry, superpixels, ring)
        found = paraxial_off(camera, geometry, superpixels, window, is_symmetric(camera))
    least, most = found or (0.0, math.inf)
    return paraxial_error.paraxial_error(geometry, parabolic, (TRIED * least, TRIED * most))


def _error_off_the_axis(
    camera: Camera, geometry: Geometry, superpixels: tuple[int, int], ring: int
) -> float:
    """Of the exact models: none on the axis, where they are what others are measured by; off it
    spherical waves are.
    """
    from plenocli.forward.propagation.exact.oblique import neglected

    return min(1.0, neglected(geometry))


class Rays(Model):
    """Geometric optics."""

    name, kind = "rays", "ray"
    lenslets = later("ray.rays", "RayLenslets")
    valid_for = later("ray.rays", "valid_for")
    size = later("ray.rays", "size_band")
    features = later("ray.rays", "features")

    def error_bound(
        self, camera: Camera, geometry: Geometry, superpixels: tuple[int, int], ring: int
    ) -> float:
        """As Model.error_bound; a law that is within 2.5 of what was measured promises only what
        its double is.
        """
        from plenocli.forward.propagation.ray import rays

        waves = _paraxial_error(camera, geometry, superpixels, ring)
        return min(2.0, math.hypot(2 * rays.error_bound(camera, geometry, ring > 0), waves))


class FresnelLowRank(Model):
    """Paraxial waves through square lenslets."""

    name, kind = "fresnel, low rank", "fresnel"
    lenslets = later("fresnel.square", "SquareLenslets")
    valid_for = staticmethod(_square_only)
    error_bound = staticmethod(_paraxial_error)
    size = staticmethod(partial(size_band, dim=True))
    features = later("fresnel.square_cost", "features")


class FresnelTripleProduct(Model):
    """Paraxial waves through lenslets of any shape."""

    name, kind = "fresnel, triple product", "fresnel"
    lenslets = later("fresnel.shaped", "ShapedLenslets")
    valid_for = later("fresnel.shaped", "valid_for")
    error_bound = staticmethod(_paraxial_error)
    size = staticmethod(size_band)
    features = later("fresnel.shaped", "features")


class ExactLowRank(Model):
    """Scalar waves without the paraxial approximation, through square lenslets."""

    name, kind = "exact, low rank", "exact"
    libraries, on_device = ("scipy.linalg",), True
    lenslets = later("exact.lenslets", "ExactSquareLenslets")
    valid_for = later("exact.lenslets", "valid_for")
    size = later("exact.lenslets", "exact_band")
    features = later("exact.cost_law", "features")
    error_bound = staticmethod(_error_off_the_axis)


class ExactHarmonics(Model):
    """Scalar waves without the paraxial approximation, through round and hexagonal lenslets."""

    name, kind = "exact, harmonics", "exact"
    libraries = ("scipy.fft", "scipy.sparse")
    lenslets = later("harmonics.lenslets", "CentredLenslets")
    valid_for = later("harmonics.lenslets", "valid_for")
    size = later("harmonics.sizing", "harmonic_band")
    features = later("harmonics.cost_law", "features")

    def error_bound(
        self, camera: Camera, geometry: Geometry, superpixels: tuple[int, int], ring: int
    ) -> float:
        """None: it is what the others are measured by."""
        return 0.0


class ExactOpenings(Model):
    """Scalar waves without the paraxial approximation, through openings of any shape."""

    name, kind = "exact, openings", "exact"
    lenslets = later("exact.openings", "OpenLenslets")
    valid_for = later("exact.openings", "valid_for")
    size = later("exact.openings", "opening_band")
    features = later("exact.openings", "features")
    error_bound = staticmethod(_error_off_the_axis)


MODELS: tuple[Model, ...] = (
    Rays(),
    FresnelLowRank(),
    FresnelTripleProduct(),
    ExactLowRank(),
    ExactHarmonics(),
    ExactOpenings(),
)
"""Coarse to fine; of two that serve, the dial takes the one that costs less."""


def model_named(name: str) -> Model:
    """The model that plans and tables call so."""
    return next(model for model in MODELS if model.name == name)


def on_device(plan: PifPlan, device: str) -> PifPlan:
    """The plan with what of it a device can do there; as it is where that is nothing.

    device: as plenocli.base.device names it.
    """
    return replace(plan, device=device) if model_named(plan.rung).on_device else plan
