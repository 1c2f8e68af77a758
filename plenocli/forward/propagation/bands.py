"""Bands of light: A of a band is the sum of A at a few wavelengths, each with its share of
the band's photons.

A band has a Gaussian number of photons per wavelength, cut off at BAND_END times its full width at
half maximum on either side (that keeps all but 4e-4 of an uncut one), or a constant one ("box").
The nodes are those of Gauss's rule for that shape. Fields of different wavelengths never add,
intensities do. As a function of the wave number the intensity is band-limited by the longest path
difference, so a rule of n nodes is either enough or useless; see docs/model.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.camera.geometry import geometry as geometry_of
from plenocli.forward.camera.quadrature import gauss
from plenocli.forward.propagation.lenslet_fields import LensletFields, PixelEnergies

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.camera.sections.light import Band
    from plenocli.forward.propagation.models import Model
    from plenocli.forward.propagation.plan import BandPlan, PifPlan

MAX_NODES = 64
"""More wavelengths than this in one band are a spectrum, not a band."""
BAND_END = 1.5
"""Where a Gaussian band ends, in full widths at half maximum from its centre."""
CORE, RIM = 1.0, 1.5e-2
"""Effect on a column of missing the fringes of a quarter of the longest path difference, and of all
of it, times the lenslet's diffraction cells (measured, within a factor of 3).
"""


def spectral_nodes(band: Band, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths that stand for a band of light.

    band: its centre, width and shape;
    count: how many.

    Returns (wavelengths (count,) m, ascending; shares of the photons (count,), of sum 1).
    Golub and Welsch 1969, for the polynomials orthogonal over the band.
    """
    x, w = _rule(band.shape, count)
    wavelengths = band.center + band.fwhm / 2 * x
    return wavelengths, w / w.sum()


@lru_cache(maxsize=256)
def _rule(shape: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes in half widths (at half maximum) and weights of a band's spectral shape."""
    if shape == "box":
        return gauss(count)
    # Stieltjes: the three-term recurrence of the polynomials orthogonal over the cut Gaussian,
    # then Golub and Welsch
    t, w = gauss(400)
    t = 2 * BAND_END * t
    w = w * np.exp(-math.log(2) * t * t)
    previous, current, norms = np.zeros_like(t), np.ones_like(t), [w.sum()]
    for _ in range(count - 1):
        following = t * current - (norms[-1] / norms[-2] if len(norms) > 1 else 0.0) * previous
        previous, current = current, following
        norms.append(w @ current**2)
    side = np.sqrt(np.array(norms[1:]) / np.array(norms[:-1]))
    x, vectors = np.linalg.eigh(np.diag(side, 1) + np.diag(side, -1))
    return x, vectors[0] ** 2


@lru_cache(maxsize=64)
def _transform(shape: str, phase: float) -> tuple[np.ndarray, np.ndarray]:
    """(p, mean of cos(p x) over the band) for 65 phases p up to `phase`."""
    p = np.linspace(0, phase, 65)
    if shape == "box":
        return p, np.sinc(p / np.pi)
    t, w = gauss(400 + int(phase))
    w = w * np.exp(-math.log(2) * (2 * BAND_END * t) ** 2)
    return p, np.cos(np.outer(p, 2 * BAND_END * t)) @ w / w.sum()


def rule_error(shape: str, count: int, phase: float) -> float:
    """Largest error of a band's rule for cos(p x), relative to the band's weight.

    shape: "gaussian" or "box";
    count: nodes of the rule;
    phase: largest p, rad per half width.
    """
    x, w = _rule(shape, count)
    p, exact = _transform(shape, float(phase))
    return float(np.abs(np.cos(np.outer(p, x)) @ w / w.sum() - exact).max())


def spectral_error(geometry: Geometry, band: Band, count: int, window: int | None = None) -> float:
    """Estimated error of a few wavelengths in the place of a band.

    The longest path difference within one lenslet's light is about N wavelengths, N = D2 D1/(lambda
    z2); the light of neighbours, which mostly meets next to its border, doubles it. Long paths
    carry little of the light, hence two weights.

    geometry: at the centre of the band;
    count: wavelengths;
    window: coherent lenslets on either side, None for isolated ones.

    Returns the relative L2 error of the worst column.
    """
    cells = geometry.diffraction_cells
    phase = math.pi * cells * band.fwhm / band.center * (1 if window is None else 2)
    return (
        2
        / cells
        * (
            CORE * rule_error(band.shape, count, phase / 4)
            + RIM * rule_error(band.shape, count, phase)
        )
    )


def node_count(geometry: Geometry, band: Band, accuracy: float, window: int | None = None) -> int:
    """Fewest wavelengths that stand for a band.

    geometry: at its centre;
    accuracy: largest spectral_error;
    window: as for spectral_error.

    Raises NumericsError beyond MAX_NODES.
    """
    for count in range(1, MAX_NODES + 1):
        if spectral_error(geometry, band, count, window) <= accuracy:
            return count
    raise NumericsError(
        (
            f"a band of {band.fwhm * 1e9:g} nm around {band.center * 1e9:g} nm needs more than "
            f"{MAX_NODES} wavelengths for accuracy {accuracy:g}"
        ),
        "light.band",
        "ask for a coarser accuracy or a narrower band",
    )


class BandFields(LensletFields):
    """Fields at several wavelengths, or of both polarisations, as one: pixel energies are the
    weighted sums of theirs.
    """

    def __init__(
        self,
        fields: Sequence[LensletFields],
        weights: Sequence[float] | np.ndarray,
        nodes: int | None = None,
    ) -> None:
        """`fields` of one plan, the share of the photons of each, and how many wavelengths they
        are; None: as many as each of them has.
        """
        self._fields, self._weights = list(fields), [float(w) for w in weights]
        self.superpixels, self.shared_axis = fields[0].superpixels, fields[0].shared_axis
        rows, columns, turn = (all(flags) for flags in zip(*(f.symmetry for f in fields)))
        self.symmetry = rows, columns, turn
        self.by_superpixel = all(f.by_superpixel for f in fields)
        notes = [f.notes for f in fields]
        self.notes = replace(
            notes[0],
            separable_terms=max(n.separable_terms for n in notes),
            field_tail=max(n.field_tail for n in notes),
            band_nodes=notes[0].band_nodes if nodes is None else nodes,
        )

    def incident(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """As LensletFields.incident."""
        return np.asarray(
            sum(w * f.incident(rows, columns) for f, w in zip(self._fields, self._weights))
        )

    def columns(self, rows: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
        """As LensletFields.columns."""
        self._sum([f.columns for f in self._fields], rows, columns, out)

    def on_superpixel(self, sy: int, sx: int) -> PixelEnergies:
        """As LensletFields.on_superpixel."""
        return partial(self._sum, [f.on_superpixel(sy, sx) for f in self._fields])

    def _sum(
        self,
        energies: Sequence[PixelEnergies],
        rows: np.ndarray,
        columns: np.ndarray,
        out: np.ndarray,
    ) -> None:
        part = np.empty_like(out)
        total = np.zeros(out.shape)
        for fill, weight in zip(energies, self._weights):
            fill(rows, columns, part)
            total += weight * part
        out[...] = total


def band_fields(
    model: Model, camera: Camera, geometry: Geometry, plan: PifPlan, band: BandPlan
) -> BandFields:
    """Fields of a camera whose light is a band: the sum of those at plan.band_nodes wavelengths.

    model: that computes each of them;
    geometry: at the centre of the band;
    band: sized for the shortest of the wavelengths; it serves all of them.
    """
    assert camera.light.band is not None
    wavelengths, weights = spectral_nodes(camera.light.band, plan.band_nodes)
    return BandFields(
        [
            model.fields(
                camera,
                geometry_of(camera, w, geometry.pixel_shift, geometry.chief).parted(
                    plan.superpixels
                ),
                plan,
                replace(band, wavelength=w),
            )
            for w in wavelengths
        ],
        weights,
        plan.band_nodes,
    )
