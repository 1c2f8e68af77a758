"""Smooth maps from lattice indices to pixels: affine, homography, polynomials; fitted robustly and chosen by the data."""

from dataclasses import dataclass

import numpy as np

POLYNOMIAL_ORDER = {"affine": 1, "poly2": 2, "poly3": 3, "poly5": 5}
PARAMETERS = {"affine": 3, "homography": 4, "poly2": 6, "poly3": 10, "poly5": 21}  # per axis


@dataclass(frozen=True)
class GridModel:
    """Map from lattice index (m, n) to (row, column) px. `at` evaluates it; kind names its form."""

    kind: str
    coefficients: np.ndarray
    shift: np.ndarray
    scale: float

    def at(self, index):
        """Positions (..., 2), px, of indices (..., 2) (need not be integers)."""
        u = (np.asarray(index, float) - self.shift) / self.scale
        if self.kind == "homography":
            top = _monomials(u, 1) @ self.coefficients[:3]
            return top / (1 + u @ self.coefficients[3:, 0])[..., None]
        return _monomials(u, POLYNOMIAL_ORDER[self.kind]) @ self.coefficients


def fit_model(kind, index, position, rounds=6):
    """Robust fit (Tukey weights on the residual's median scale) of one kind of map.

    index (N, 2), position (N, 2) px. Returns GridModel.
    """
    index, position = np.asarray(index, float), np.asarray(position, float)
    shift = index.mean(axis=0)
    scale = max(1.0, np.abs(index - shift).max())
    u = (index - shift) / scale
    weight = np.ones(len(u))
    coefficients = None
    for _ in range(rounds):
        coefficients = _weighted_fit(kind, u, position, weight, coefficients)
        model = GridModel(kind, coefficients, shift, scale)
        miss = np.hypot(*(position - model.at(index)).T)
        spread = max(1.48 * np.median(miss), 1e-9)
        weight = np.clip(1 - (miss / (5 * spread)) ** 2, 0, None) ** 2
    return model


def choose_model(index, position, folds=8, seed=0):
    """The simplest map whose cross-validated residual is within the scatter of the best one.

    All kinds are compared on one common set of inliers (trimming each by its own residual would flatter the
    stiff ones). The margin is two standard errors of an rms over N sites, at least 3 %.
    Returns (GridModel fitted to all, {kind: cross-validated rms in px}).
    """
    count = len(index)
    allowed = [kind for kind, size in PARAMETERS.items() if count >= 3 * size]
    if not allowed:
        return fit_model("affine", index, position), {}
    rich = fit_model(allowed[-1], index, position)
    miss = np.hypot(*(position - rich.at(index)).T)
    keep = np.flatnonzero(miss < 6 * max(1.48 * np.median(miss), 1e-9))
    rng = np.random.default_rng(seed)
    keep = rng.permutation(keep)[:20000]
    error = {}
    for kind in allowed:
        total = 0.0
        for fold in range(folds):
            out = np.arange(len(keep)) % folds == fold
            model = fit_model(kind, index[keep[~out]], position[keep[~out]], rounds=3)
            total += ((position[keep[out]] - model.at(index[keep[out]])) ** 2).sum()
        error[kind] = float(np.sqrt(total / len(keep)))
    margin = 1 + max(0.03, 2 / np.sqrt(2 * len(keep)))
    best = min(error.values())
    kind = next(kind for kind in allowed if error[kind] <= margin * best + 1e-9)
    return fit_model(kind, index, position), error


def _monomials(u, order):
    return np.stack([u[..., 0] ** (total - j) * u[..., 1] ** j for total in range(order + 1) for j in range(total + 1)], axis=-1)


def _weighted_fit(kind, u, position, weight, start):
    root = np.sqrt(weight)[:, None]
    if kind != "homography":
        design = _monomials(u, POLYNOMIAL_ORDER[kind])
        return np.linalg.lstsq(design * root, position * root, rcond=None)[0]
    if start is None:
        affine = np.linalg.lstsq(_monomials(u, 1) * root, position * root, rcond=None)[0]
        start = np.vstack([affine, np.zeros((2, 2))])
    p = start.copy()
    for _ in range(4):  # Gauss-Newton on (top / bottom)
        basis, bottom = _monomials(u, 1), 1 + u @ p[3:, 0]
        value = (basis @ p[:3]) / bottom[:, None]
        left = basis / bottom[:, None]
        blocks = []
        for axis in range(2):
            row = np.zeros((len(u), 8))
            row[:, 3 * axis : 3 * axis + 3] = left
            row[:, 6:] = -value[:, axis : axis + 1] * u / bottom[:, None]
            blocks.append(row * root)
        step = np.linalg.lstsq(np.vstack(blocks), ((position - value) * root).T.ravel(), rcond=None)[0]
        p[:3, 0] += step[:3]
        p[:3, 1] += step[3:6]
        p[3:] += step[6:, None]
    return p
