"""The main lens's spread function as a product with a small core, and the derivatives of the core.

On a fixed grid of Gauss-Legendre nodes (d in lenslet pitches) the function h and its derivatives by
what its phases depend on share one basis of rows and one of columns, so that h = U C V^T and
dh = U dC V^T: a derivative costs a small matrix, and no singular value decomposition has to be
differentiated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from plenocli.forward.camera.pupil import aperture_area, unit_radius, wavefront, zernike
from plenocli.forward.camera.pupil_quadrature import pupil_rows
from plenocli.forward.camera.quadrature import gauss
from plenocli.forward.propagation.fresnel.spread_function import legendre, psf_nodes
from plenocli.inverse.fit.optics import DEFOCUS, PUPIL, WAVES, CameraFamily

ROOM = 1.25
"""Nodes are chosen for phases so many times those of the described camera: room for the fit."""
STEP = 0.02
"""Share of a tolerance that derivatives are for: how strongly they count in the common basis."""


@dataclass(frozen=True, kw_only=True)
class Core:
    """h = rows C columns^T at one camera.

    rows, columns: (node, term) complex, orthonormal with the quadrature weights of the grid;
    value: (row term, column term) C;
    slopes: its derivatives by optics, {place in the vector of optics: (row term, column term)}.
    """

    rows: np.ndarray
    columns: np.ndarray
    value: np.ndarray
    slopes: dict[int, np.ndarray]


class SpreadFamily:
    """The spread functions of a family of cameras on one grid.

    half: half width of the grid, pitches;
    places: of the optics that the function depends on.
    """

    def __init__(self, family: CameraFamily, half: float, tolerance: float) -> None:
        """half: as above; tolerance: root energy that the common basis may lose."""
        g, lens = family.geometry, family.camera.main_lens
        self.half, self.tolerance = half, tolerance
        nodes, weights = gauss(psf_nodes(g, ROOM * half * g.D2))
        self.nodes, self.weights = half * nodes, half * weights
        reach = half * g.D2 * math.sqrt(2)
        rows = pupil_rows(family.camera, g, ROOM * g.k * reach / g.z2)
        self._panels = []
        for panel in rows:
            y = np.broadcast_to(panel.y[:, None], panel.x.shape)
            square = (y * y + panel.x * panel.x) / 2
            whole = wavefront(lens, panel.y[:, None], panel.x)
            # the amplitude alone: what the described camera adds as phase is taken off again
            bare = panel.weight * np.exp(-1j * g.k * (whole + g.eps * square))
            unit = unit_radius(lens)
            terms = [zernike(j, y / unit, panel.x / unit) for j in family.nolls]
            fitted = sum(
                (
                    a.coefficient * terms[family.nolls.index(a.noll)]
                    for a in lens.aberrations
                    if a.noll in family.nolls
                ),
                np.zeros(panel.x.shape),
            )
            self._panels.append((panel.y, panel.x, bare, [square, whole - fitted, *terms]))
        self._scale = 1 / math.sqrt(aperture_area(lens))
        fitted_places = range(7, 7 + len(family.nolls))
        self.places = (PUPIL, DEFOCUS, WAVES, *fitted_places)
        spread = np.abs(family.jacobian(family.start)) @ family.tolerance
        self._step = {place: STEP * spread[place] for place in self.places}
        basis = legendre(nodes, len(nodes), 1).T * weights
        self._project = basis * (np.arange(len(nodes)) + 0.5)[:, None]

    def interpolation(self, d: np.ndarray) -> np.ndarray:
        """What carries values at the grid to positions d (place,), pitches: (place, node)."""
        return legendre(d / self.half, len(self.nodes), 1) @ self._project

    def core(self, optics: np.ndarray) -> Core:
        """The Core at a vector of optics."""
        fields = self._fields(optics)
        root = np.sqrt(self.weights)
        fields = root[:, None] * fields * root
        weight = np.array([1.0, *(self._step[p] for p in self.places)])
        scaled = fields * weight[:, None, None]
        rows = self._basis(np.einsum("mij,mkj->ik", scaled, scaled.conj(), optimize=True))
        columns = self._basis(np.einsum("mji,mjk->ik", scaled, scaled.conj(), optimize=True))
        cores = rows.conj().T @ fields @ columns.conj()
        return Core(
            rows=rows / root[:, None],
            columns=columns / root[:, None],
            value=cores[0],
            slopes=dict(zip(self.places, cores[1:])),
        )

    def _basis(self, gram: np.ndarray) -> np.ndarray:
        """Orthonormal columns that hold all of a Gram matrix (node, node) but the tolerance."""
        values, vectors = np.linalg.eigh(gram)
        lost = np.sqrt(np.maximum(np.cumsum(np.maximum(values, 0)), 0) / np.trace(gram).real)
        return vectors[:, int(np.searchsorted(lost, self.tolerance)) :]

    def _fields(self, optics: np.ndarray) -> np.ndarray:
        """h and its derivatives by `places` on the grid, (field, node, node)."""
        beta, count = optics[PUPIL], len(self.nodes)
        total = np.zeros((1 + len(self.places), count, count), complex)
        for y, x, bare, phases in self._panels:
            turns = optics[DEFOCUS] * phases[0] + optics[WAVES] * phases[1]
            for omega, term in zip(optics[7:], phases[2:]):
                turns = turns + omega * term
            weight = bare * np.exp(2j * np.pi * turns)
            rising = 2j * np.pi * weight
            across = np.matmul(
                np.stack([weight, rising * x, *(rising * p for p in phases)], axis=1),
                np.exp(-2j * np.pi * beta * x[:, :, None] * self.nodes),
            )
            down = np.exp(-2j * np.pi * beta * np.outer(self.nodes, y))
            fields = (down @ across.reshape(len(y), -1)).reshape(count, -1, count)
            fields = fields.transpose(1, 0, 2)
            by_row = ((down * (2j * np.pi * y)) @ across[:, 0]) * self.nodes[:, None]
            total[0] += fields[0]
            total[1] -= fields[1] * self.nodes + by_row
            total[2:] += fields[2:]
        return total * self._scale


def widened(family: CameraFamily, half: float) -> float:
    """`half` (m) of the described camera in pitches, with the room that its pitch may take.

    family: of cameras.
    """
    g = replace(family.geometry, pixel_shift=None)
    return half / g.D2 * 1.001
