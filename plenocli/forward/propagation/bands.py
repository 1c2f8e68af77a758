"""Bands of light: A of a band is the sum of A at a few wavelengths, each with its share of
the band's photons.

A band has a Gaussian number of photons per wavelength, cut off at CUT times its full width at half
maximum on either side (that keeps all but 4e-4 of an uncut one), or a constant one ("box"). The
nodes are those of Gauss's rule for that shape. Fields of different wavelengths never add,
intensities do. As a function of the wave number the intensity is band-limited by the longest path
difference, so a rule of n nodes is either enough or useless; see docs/model.md.
"""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.camera.quadrature import gauss

MAX_NODES = 64
"""More wavelengths than this in one band are a spectrum, not a band."""
CUT = 1.5
"""Where a Gaussian band ends, in full widths at half maximum from its centre."""
CORE, RIM = 1.0, 1.5e-2
"""Effect on a column of missing the fringes of a quarter of the longest path difference, and of all
of it, times the lenslet's diffraction cells (measured, within a factor of 3).
"""


def spectral_nodes(band, count):
    """Wavelengths (m, ascending) and shares of the photons (sum 1) that stand for `band`
    (plenocli.forward.camera.model.Band): (count,) each.
    """
    x, w = _rule(band.shape, count)
    wavelengths = band.center + band.fwhm / 2 * x
    return wavelengths, w / w.sum()


@lru_cache(maxsize=256)
def _rule(shape, count):
    """Nodes in half widths (at half maximum) and weights of a band's spectral shape."""
    if shape == "box":
        return gauss(count)
    # Stieltjes: the three-term recurrence of the polynomials orthogonal over the cut Gaussian,
    # then Golub and Welsch
    t, w = gauss(400)
    t = 2 * CUT * t
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
def _transform(shape, phase):
    """(p, mean of cos(p x) over the band) for 65 phases p up to `phase`."""
    p = np.linspace(0, phase, 65)
    if shape == "box":
        return p, np.sinc(p / np.pi)
    t, w = gauss(400 + int(phase))
    w = w * np.exp(-math.log(2) * (2 * CUT * t) ** 2)
    return p, np.cos(np.outer(p, 2 * CUT * t)) @ w / w.sum()


def rule_error(shape, count, phase):
    """Largest error of the rule for cos(p x), p up to `phase` (rad per half width), relative to
    the band's weight.
    """
    x, w = _rule(shape, count)
    p, exact = _transform(shape, float(phase))
    return float(np.abs(np.cos(np.outer(p, x)) @ w / w.sum() - exact).max())


def spectral_error(view, band, count, window=None):
    """Estimated relative L2 error of the worst column when `count` wavelengths stand for `band`.

    view: Geometry at the centre;
    window: coherent lenslets on either side (None: isolated). The longest path difference within
        one lenslet's light is about N wavelengths, N = D2 D1/(lambda z2); the light of neighbours,
        which mostly meets next to its border, doubles it. Long paths carry little of the light,
        hence two weights.
    """
    cells = view.diffraction_cells
    phase = math.pi * cells * band.fwhm / band.center * (1 if window is None else 2)
    return (
        2
        / cells
        * (
            CORE * rule_error(band.shape, count, phase / 4)
            + RIM * rule_error(band.shape, count, phase)
        )
    )


def node_count(view, band, accuracy, window=None):
    """Fewest wavelengths whose spectral_error is at most `accuracy`;
    NumericsError beyond MAX_NODES.
    """
    for count in range(1, MAX_NODES + 1):
        if spectral_error(view, band, count, window) <= accuracy:
            return count
    raise NumericsError(
        (
            f"a band of {band.fwhm * 1e9:g} nm around {band.center * 1e9:g} nm needs more than "
            f"{MAX_NODES} wavelengths for accuracy {accuracy:g}"
        ),
        "light.band",
        "ask for a coarser accuracy or a narrower band",
    )


class CombinedBands:
    """Several makers of one plan as one: pixel energies are the weighted sums of theirs."""

    def __init__(self, makers, weights):
        self.makers, self.weights = list(makers), [float(w) for w in weights]
        self.symmetry = tuple(all(flags) for flags in zip(*(m.symmetry for m in self.makers)))
        self.shared_axis = getattr(self.makers[0], "shared_axis", 1)
        notes = [m.notes for m in self.makers]
        self.notes = (
            notes[0]
            | {key: max(n[key] for n in notes) for key in ("separable_terms", "field_tail")}
            | {"band_nodes": len(self.makers)}
        )
        if all(hasattr(m, "superpixel") for m in self.makers):
            self.superpixel = self._superpixel

    def incident(self, rows, columns):
        """As every maker: share of light entering the lenslets, (points,)."""
        return sum(w * m.incident(rows, columns) for m, w in zip(self.makers, self.weights))

    def columns(self, rows, columns, out):
        """As every maker: pixel energies into out (points, superpixel rows, superpixel columns,
        pixel rows, pixel columns).
        """
        self._sum(out, lambda maker, part: maker.columns(rows, columns, part))

    def _superpixel(self, sy, sx, rows, columns, out):
        """As every maker that computes superpixels one by one: into out (points, pixel
        rows, pixel columns).
        """
        self._sum(out, lambda maker, part: maker.superpixel(sy, sx, rows, columns, part))

    def _sum(self, out, compute):
        part = np.empty_like(out)
        total = np.zeros(out.shape)
        for maker, weight in zip(self.makers, self.weights):
            compute(maker, part)
            total += weight * part
        out[...] = total


def combined(maker, nodes):
    """A maker class for a camera whose light is a band: `maker` at `nodes` wavelengths
    of camera.light.band.

    It is called as any maker, (camera, geometry, plan, band); the BandPlan must have been sized for
    the shortest of the wavelengths, and serves all of them.
    """

    def make(camera, view, plan, band):
        wavelengths, weights = spectral_nodes(camera.light.band, nodes)
        views = [geometry(camera, w, view.pixel_shift) for w in wavelengths]
        return CombinedBands(
            [maker(camera, v, plan, replace(band, wavelength=v.wavelength)) for v in views], weights
        )

    return make


def band_matrix(camera, plan, nodes, *, workers=1):
    """A (superpixel, pixel, point) of camera.light.band, wavelength by wavelength into one array;
    `plan` as for `combined`.

    Holds the sum, one matrix and one wavelength's tables, where `combined` holds the tables of all.
    """
    from plenocli.forward.propagation.system_matrix import PifBuilder

    total, work = None, None
    for wavelength, weight in zip(*spectral_nodes(camera.light.band, nodes)):
        here = replace(
            plan, band_nodes=0, bands=(replace(plan.bands[0], wavelength=float(wavelength)),)
        )
        builder = PifBuilder(camera, float(wavelength), here, dtype=plan.dtype)
        if total is None:
            total = np.zeros((*builder.shape, builder.points), plan.dtype)
            work = np.empty_like(total)
        builder.fill(work, workers=workers)
        work *= weight
        total += work
    return total
