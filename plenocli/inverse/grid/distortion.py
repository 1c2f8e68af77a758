"""Smooth maps from lattice indices to pixels: affine, homography, homography with cubic
distortion, polynomials; fitted robustly and chosen by the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

ORDER = {"affine": 1, "poly2": 2, "poly3": 3, "poly5": 5}
"""Polynomials' degrees."""
FREEDOM = {"affine": 6, "homography": 8, "radial": 11, "poly2": 12, "poly3": 20, "poly5": 42}
"""Parameters of each kind of map, simplest first."""
MARGIN = 0.12
"""Of the residual, by which a richer map must be better."""
STRAIGHT = ("affine", "homography")
"""Maps that keep lines straight."""
CERTAIN = 4.0
"""Standard deviations from which on a lattice is believed that it would bend."""
BLOCKS = 5
"""Blocks a side of the array, of which the map must foretell each from the others where
neighbouring places err alike.
"""
FEW = 8
"""Sites of little weight from which on they are asked whether a map goes astray there."""
ENOUGH = 2000
"""Sites for the first, rough part of a fit."""


@dataclass(frozen=True, kw_only=True)
class GridModel:
    """Map from lattice index (m, n) to (row, column) px.

    With u = (index - shift) / scale, coefficients are those of the monomials of u for "affine" and
    "polyN". Homography: rows 0-2 affine q, row 3 the perspective p: q / (1 + u.p). Radial: that,
    then with d = (q - middle) / span q + span (k |d|^2 d + 2 (d.g) d + |d|^2 g); row 4 is g, which
    moves the centre of the distortion, row 5 is (k, 0).
    kind: name of its form.
    coefficients: (K, 2).
    shift: (2,), of indices.
    scale: of indices.
    middle: (2,) px.
    span: px.
    """

    kind: str
    coefficients: np.ndarray
    shift: np.ndarray
    scale: float
    middle: np.ndarray
    span: float

    def at(self, index: np.ndarray) -> np.ndarray:
        """Positions (..., 2), px, of indices (..., 2) (need not be integers)."""
        u = (np.asarray(index, float) - self.shift) / self.scale
        if self.kind in ORDER:
            return _monomials(u, ORDER[self.kind]) @ self.coefficients
        q = _monomials(u, 1) @ self.coefficients[:3] / (1 + u @ self.coefficients[3])[..., None]
        if self.kind == "homography":
            return q
        d = (q - self.middle) / self.span
        g, k = self.coefficients[4], self.coefficients[5, 0]
        square = (d**2).sum(axis=-1, keepdims=True)
        return q + self.span * ((k * square + 2 * (d @ g)[..., None]) * d + square * g)


def fit_model(
    kind: str,
    index: np.ndarray,
    position: np.ndarray,
    weight: np.ndarray | None = None,
    robust: bool = True,
) -> GridModel:
    """Robust fit of one kind of map: least absolute residuals first, which a wrong border row does
    not tilt, then Tukey weights.

    kind: of FREEDOM.
    index: (N, 2) of the sites.
    position: (N, 2) px.
    weight: (N,); None: all alike.
    robust: False takes plain least squares.
    """
    index, position = np.asarray(index, float), np.asarray(position, float)
    prior = np.ones(len(index)) if weight is None else np.asarray(weight, float)
    model = _start(kind, index, position)
    few = slice(None, None, -(-len(index) // ENOUGH)) if robust else slice(None)
    for _ in range(1 if kind in ORDER else 4):
        model = _least_squares(model, index[few], position[few], prior[few])
    if not robust:
        return model
    for _ in range(8):
        miss = _miss(model, index[few], position[few])
        model = _least_squares(
            model,
            index[few],
            position[few],
            prior[few] / np.maximum(miss, 0.05 * np.median(miss) + 1e-9),
        )
    for _ in range(4):
        model = _least_squares(
            model, index, position, prior * _tukey(_miss(model, index, position))
        )
    return model


def choose_model(
    index: np.ndarray, position: np.ndarray, weight: np.ndarray | None = None
) -> tuple[GridModel, dict[str, float]]:
    """The simplest map whose leave-one-out residual is within a margin of the best one.

    All kinds are compared with one common set of weights, those of the richest (trimming each by
    its own residual would flatter the stiff ones) and the weights squared: sites of little weight
    shall not choose. Leaving one out needs no second fit: the residual grows by 1 / (1 - leverage).
    The margin is
    two standard errors of an rms over N sites, at least MARGIN: what sampling and the frame's edges
        do
    to exact lattices (a bend of half a site's own scatter passes unseen).
    index: (N, 2) of the sites.
    position: (N, 2) px.
    weight: (N,); None: all alike.

    Returns the map fitted to all, and {kind: leave-one-out rms in px}.
    """
    count = len(index) if weight is None else weight.sum()
    allowed = [kind for kind, size in FREEDOM.items() if count >= 1.5 * size]
    if len(allowed) < 2:
        return fit_model("affine", index, position, weight), {}
    index, position = np.asarray(index, float), np.asarray(position, float)
    fitted = {kind: fit_model(kind, index, position, weight) for kind in allowed}
    common = _tukey(_miss(fitted[allowed[-1]], index, position)) * (
        1 if weight is None else np.asarray(weight) ** 2
    )
    error = {kind: _left_out(model, index, position, common) for kind, model in fitted.items()}
    wild = set() if weight is None else _wild(fitted, index, position, np.asarray(weight))
    error = {kind: miss for kind, miss in error.items() if kind not in wild}
    margin = 1 + max(MARGIN, 2 / np.sqrt(2 * count))
    best = min(error.values())
    kind = next(kind for kind in error if error[kind] <= margin * best + 1e-9)
    return fitted[kind], error


def _wild(
    fitted: dict[str, GridModel], index: np.ndarray, position: np.ndarray, weight: np.ndarray
) -> set[str]:
    """Kinds of maps that go astray on the border of a small array, where sites have little weight:
    those of few lenslets follow what pixels do to edges.
    """
    border = weight < weight.max()
    if border.sum() < FEW:
        return set()
    index, position = index[border], position[border]
    miss = {k: float(np.quantile(_miss(m, index, position), 0.65)) for k, m in fitted.items()}
    return {kind for kind, far in miss.items() if far > 1.5 * min(miss.values()) + 0.01}


def choose_by_blocks(
    index: np.ndarray,
    position: np.ndarray,
    weight: np.ndarray,
    kinds: Sequence[str] = ("affine", "homography", "radial", "poly3"),
) -> tuple[GridModel, float]:
    """The simplest map that foretells blocks of lenslets, each left out in turn, nearly as well as
    the best one, and how far off it is expected to be, px rms over the sites (the jackknife over
    blocks): for places whose errors neighbours share, as those in captures of a scene.

    kinds: of maps, simplest first; the others as choose_model's.
    """
    place = (index - index.min(axis=0)) / (np.ptp(index, axis=0) + 1)
    block = np.floor(place * BLOCKS).astype(int) @ (BLOCKS, 1)
    labels, block = np.unique(block, return_inverse=True)
    found = {}
    for kind in kinds:
        model = fit_model(kind, index, position, weight)
        heavy = weight * _tukey(_miss(model, index, position))
        spread, misses = np.zeros(len(index)), []
        for label in range(len(labels)):
            out = block == label
            part = model
            for _ in range(1 if kind in ORDER else 2):
                part = _least_squares(part, index, position, np.where(out, 0.0, heavy))
            spread += ((part.at(index) - model.at(index)) ** 2).sum(axis=1)
            if heavy[out].sum() > 0:
                miss = (position[out] - part.at(index[out])) * heavy[out, None]
                misses.append((miss.sum(axis=0) / heavy[out].sum()) ** 2)
        share = (len(labels) - 1) / len(labels)
        found[kind] = model, np.sqrt(np.mean(misses)), np.sqrt(share * spread.mean())
    best = min(miss for _, miss, _ in found.values())
    model, _, error = next(one for one in found.values() if one[1] <= (1 + MARGIN) * best)
    return model, float(error)


def share_between(
    index: np.ndarray, position: np.ndarray, other: np.ndarray, weight: np.ndarray
) -> float:
    """How far (0..1) on the way from `position` to `other` a map without bends fits best.

    Least squares of the homography and the share together: what a homography takes up says
    nothing. 0 unless the share is CERTAIN standard deviations above it.
    index: (N, 2) of the sites.
    position, other: (N, 2) px.
    weight: (N,).
    """
    model = fit_model("homography", index, position, weight)
    heavy = np.repeat(np.sqrt(weight * _tukey(_miss(model, index, position))), 2)
    design = _jacobian(model, np.asarray(index, float)).reshape(2 * len(index), -1)
    columns = np.stack([(other - position).ravel(), (model.at(index) - position).ravel()], axis=1)
    design, columns = design * heavy[:, None], columns * heavy[:, None]
    design = design / np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    way, miss = (columns - design @ np.linalg.lstsq(design, columns, rcond=None)[0]).T
    share = way @ miss / max(way @ way, 1e-300)
    noise = np.sum((miss - share * way) ** 2) / max(heavy @ heavy - FREEDOM["homography"] - 1, 1)
    sure = share * np.sqrt(way @ way) > CERTAIN * np.sqrt(noise)
    return float(np.clip(share, 0, 1)) if sure else 0.0


def _tukey(miss: np.ndarray) -> np.ndarray:
    return np.clip(1 - (miss / (5 * max(1.48 * np.median(miss), 1e-9))) ** 2, 0, None) ** 2


def _miss(model: GridModel, index: np.ndarray, position: np.ndarray) -> np.ndarray:
    return np.hypot(*(position - model.at(index)).T)


def _left_out(
    model: GridModel, index: np.ndarray, position: np.ndarray, weight: np.ndarray
) -> float:
    """Weighted rms of the residuals, px, each as if its site had had no part in the fit."""
    for _ in range(1 if model.kind in ORDER else 2):
        model = _least_squares(model, index, position, weight)
    design = _jacobian(model, index)
    rows = design.reshape(-1, design.shape[-1])
    normal = rows.T @ (rows * np.repeat(weight, 2)[:, None])
    leverage = (
        (design @ np.linalg.pinv(normal, rcond=1e-13, hermitian=True))
        @ design.transpose(0, 2, 1)
        * weight[:, None, None]
    )
    rest = np.linalg.solve(
        np.eye(2) - np.minimum(leverage, 0.98), (position - model.at(index))[..., None]
    )[..., 0]
    return float(np.sqrt((weight[:, None] * rest**2).sum() / weight.sum()))


def _start(kind: str, index: np.ndarray, position: np.ndarray) -> GridModel:
    shift = index.mean(axis=0)
    scale = max(1.0, np.abs(index - shift).max())
    middle, span = position.mean(axis=0), max(1.0, np.abs(position - position.mean(axis=0)).max())
    rows = (
        _monomials(np.zeros(2), ORDER[kind]).size
        if kind in ORDER
        else {"homography": 4, "radial": 6}[kind]
    )
    blank = GridModel(
        kind=kind,
        coefficients=np.zeros((rows, 2)),
        shift=shift,
        scale=scale,
        middle=middle,
        span=span,
    )
    if kind in ORDER:
        return blank
    affine = _least_squares(
        replace(blank, kind="affine", coefficients=np.zeros((3, 2))),
        index,
        position,
        np.ones(len(index)),
    )
    blank.coefficients[:3] = affine.coefficients
    return blank


def _least_squares(
    model: GridModel, index: np.ndarray, position: np.ndarray, weight: np.ndarray
) -> GridModel:
    """The model after weighted least squares; for kinds not linear in their parameters, after
    one step towards it.
    """
    if model.kind in ORDER:
        basis = _monomials((index - model.shift) / model.scale, ORDER[model.kind])
        return replace(
            model,
            coefficients=_solve(
                basis.T @ (basis * weight[:, None]), basis.T @ (position * weight[:, None])
            ),
        )
    design, rest = _jacobian(model, index), position - model.at(index)  # a Gauss-Newton step
    rows, heavy = design.reshape(-1, design.shape[-1]), np.repeat(weight, 2)
    step = _solve(rows.T @ (rows * heavy[:, None]), rows.T @ (rest.ravel() * heavy))
    step = np.concatenate([step, np.zeros(2 * len(model.coefficients) - len(step))])
    return replace(model, coefficients=model.coefficients + step.reshape(-1, 2))


def _solve(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solution of the normal equations, columns scaled to one, null directions left at zero."""
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal * scale[:, None] * scale, rcond=1e-13, hermitian=True)
    return (
        scale[:, None] * (inverse @ (scale[:, None] * right))
        if right.ndim == 2
        else scale * (inverse @ (scale * right))
    )


def _jacobian(model: GridModel, index: np.ndarray) -> np.ndarray:
    """Derivatives (N, 2, parameters) of the position with the parameters: the
    coefficients, row by row.
    """
    u = (index - model.shift) / model.scale
    both = np.eye(2)
    if model.kind in ORDER:
        return np.einsum("nk,ab->nakb", _monomials(u, ORDER[model.kind]), both).reshape(
            len(u), 2, -1
        )
    basis, bottom = _monomials(u, 1), 1 + u @ model.coefficients[3]
    q = basis @ model.coefficients[:3] / bottom[:, None]
    linear = np.einsum("nk,ab->nakb", basis / bottom[:, None], both).reshape(len(u), 2, 6)
    design = np.concatenate([linear, -q[:, :, None] * (u / bottom[:, None])[:, None, :]], axis=2)
    if model.kind == "homography":
        return design
    d = (q - model.middle) / model.span
    g, k = model.coefficients[4], model.coefficients[5, 0]
    square, outer = (d**2).sum(axis=1)[:, None, None] * both, d[:, :, None] * d[:, None, :]
    along = 2 * (d[:, :, None] * g + (d @ g)[:, None, None] * both + g[:, None] * d[:, None, :])
    turn = both + k * (square + 2 * outer) + along
    shift = model.span * np.concatenate([2 * outer + square, (square @ d[:, :, None])], axis=2)
    return np.concatenate([turn @ design, shift], axis=2)


def _monomials(u: np.ndarray, order: int) -> np.ndarray:
    powers = [np.ones(u.shape)]
    for _ in range(order):
        powers.append(powers[-1] * u)
    return np.stack(
        [
            powers[total - j][..., 0] * powers[j][..., 1]
            for total in range(order + 1)
            for j in range(total + 1)
        ],
        axis=-1,
    )
