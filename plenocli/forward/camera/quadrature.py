"""Quadrature over lens apertures, sized by the phase the integrand runs through.

An integrand exp(j phi(t)) on [-1, 1] with |dphi/dt| <= K is integrated by n-point Gauss-Legendre to
about 1e-9 once n >= K/2 + 3 K^(1/3); below K/2 nodes the result is meaningless (measured cliffs,
see docs/model.md).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

Cell = tuple[float, float, float, float]
"""A rectangle (y0, y1, x0, x1), m."""
Disc = tuple[float, float, float]
"""A disc (y, x of its centre, radius), m."""
Chords = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
NEAR = 1e-9
"""Distance from the tip of a disc, over the height of what it cuts, that counts as none."""
SMOOTH = 14
"""Least nodes of a panel whose ends are arcs of several circles."""
STEEP = 1.5
"""Length of such an arc over the half circle about its panel, at most about."""
RULE_STEP = 0.1
"""Cycles over [-1, 1] for each node by which the bands of band_rule grow."""


@dataclass(frozen=True)
class Rows:
    """Nodes of a region scanned row by row.

    y: (row,) m;
    x: (row, node) m;
    weight: (row, node) m^2.
    """

    y: np.ndarray
    x: np.ndarray
    weight: np.ndarray


@lru_cache(maxsize=64)
def gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss and Legendre's rule of n points on [-1, 1], by Newton's method from Tricomi's
    first guess.

    Returns nodes and weights, (n,) each, read-only.
    """
    count = (n + 1) // 2
    t = np.cos(np.pi * (np.arange(count) + 0.75) / (n + 0.5)) * (1 - (n - 1) / (8 * n**3))
    if n % 2:
        t[-1] = 0.0
    for _ in range(10):
        previous, value = np.ones_like(t), t.copy()
        for degree in range(1, n):
            previous, value = value, t * value + degree / (degree + 1) * (t * value - previous)
        slope = n * (previous - t * value) / (1 - t * t)
        change = value / slope
        if np.abs(change).max() < 1e-15:
            break
        t = t - change
    half = 2 / ((1 - t * t) * slope * slope)
    nodes, weights = (
        np.concatenate([-t, t[n // 2 - 1 :: -1][: n // 2]]),
        np.concatenate([half, half[n // 2 - 1 :: -1][: n // 2]]),
    )
    nodes.flags.writeable = weights.flags.writeable = False
    return nodes, weights


@lru_cache(maxsize=512)
def band_rule(n: int, step: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A rule of n points on [-1, 1] made for frequencies: cos(pi c t), c up to RULE_STEP step n.

    Least squares over the band by Gauss and Newton, from the rule of the next narrower band; step 0
    is Gauss and Legendre's, which spends its nodes on polynomials. Constants are integrated
    exactly.

    Returns nodes and weights, (n,) each, read-only; those of a narrower band where none are found.
    Such rules exist for every band (Xiao, Rokhlin and Yarvin, Inverse Problems 17, 2001).
    """
    if step == 0:
        return gauss(n)
    nodes, weights = band_rule(n, step - 1)
    half, odd = n // 2, n % 2
    t, w = nodes[n - half :].copy(), weights[n - half :].copy()
    cycles, _ = gauss(2 * n + 8)
    cycles = RULE_STEP * step * n * cycles[n + 4 :]
    for _ in range(8):
        error = np.cos(np.pi * np.outer(cycles, nodes)) @ weights / 2 - np.sinc(cycles)
        phase = np.pi * np.outer(cycles, t)
        waves = np.cos(phase)
        # the weight of the innermost node follows from the others: together they are 2
        by_weight = waves - 1 if odd else waves[:, 1:] - waves[:, :1]
        slopes = np.hstack([-np.pi * cycles[:, None] * np.sin(phase) * w, by_weight])
        scale = np.linalg.norm(slopes, axis=0)
        change = np.linalg.lstsq(slopes / scale, -error, rcond=1e-13)[0] / scale
        t = t + change[:half]
        if odd:
            w = w + change[half:]
        else:
            w[1:] += change[half:]
            w[0] = 1 - w[1:].sum()
        middle = ([0.0], [2 - 2 * w.sum()]) if odd else ([], [])
        nodes, weights = (
            np.concatenate([-t[::-1], middle[0], t]),
            np.concatenate([w[::-1], middle[1], w]),
        )
        if np.abs(change).max() < 1e-13:
            break
    if not (np.diff(nodes) > 0).all() or nodes[-1] >= 1 or weights.min() <= 0:
        return band_rule(n, step - 1)
    nodes.flags.writeable = weights.flags.writeable = False
    return nodes, weights


def nodes_for(phase: float) -> int:
    """Number of Gauss-Legendre nodes on [-1, 1] for a phase slope of `phase` rad per unit of t."""
    return int(np.ceil(phase / 2 + 3 * np.cbrt(phase) + 4))


def smooth_nodes(phase: float, error: float = 1e-10) -> int:
    """Fewest Gauss-Legendre nodes that integrate exp(j phase t) on [-1, 1], for panels of little
    phase each.

    phase: rad per unit of t;
    error: of the integral.

    Returns the count where the remainder 2^(2n+1) n!^4 / ((2n+1) (2n)!^3) phase^(2n) of the rule
    falls below the error, never more than nodes_for.
    """
    for count in range(1, nodes_for(phase)):
        log = (
            (2 * count + 1) * math.log(2)
            + 4 * math.lgamma(count + 1)
            - math.log(2 * count + 1)
            - 3 * math.lgamma(2 * count + 1)
        )
        if log + 2 * count * math.log(max(phase, 1e-300)) < math.log(error):
            return count
    return nodes_for(phase)


def disc_rows(radius: float, slope: float) -> Rows:
    """Rows over a disc: y = radius sin(theta) with equidistant theta, which converges spectrally
    because the integrand is periodic in theta.

    radius: m;
    slope: rad/m that the integrand's phase changes by at most in any direction.
    """
    phase = slope * radius
    # phases that bend, as of aberrations, have a longer tail than waves aslant
    count = int(np.ceil(phase / 2 + 4 * np.cbrt(phase) + 8))
    theta = (np.arange(count) + 0.5) * np.pi / count - np.pi / 2
    half = radius * np.cos(theta)
    t, w = gauss(nodes_for(phase))
    return Rows(
        radius * np.sin(theta), half[:, None] * t, (np.pi / count * half * half)[:, None] * w
    )


def cell_rows(cell: Cell, discs: Sequence[Disc], slope: float) -> list[Rows]:
    """Rows over the part of a rectangle inside all of some discs.

    cell: (y0, y1, x0, x1) m;
    discs: none, one or several;
    slope: as in disc_rows.

    Returns panels, maybe none; they end where circles meet each other and the rectangle's sides, so
    that every integrand is smooth.
    """
    panels = []
    for y, weight, left, right in cell_chords(cell, discs, slope):
        t, w = gauss(nodes_for(slope * np.max(right - left) / 2))
        x = ((left + right) / 2)[:, None] + ((right - left) / 2)[:, None] * t
        panels.append(Rows(y, x, (weight * (right - left) / 2)[:, None] * w))
    return panels


def cell_chords(cell: Cell, discs: Sequence[Disc], slope: float) -> list[Chords]:
    """The region of cell_rows as chords.

    Returns panels (y, weight, left, right), (row,) each; weights integrate over y alone, m.
    """
    y0, y1, x0, x1 = cell
    low, high = (max([y0, *(y - r for y, _, r in discs)]), min([y1, *(y + r for y, _, r in discs)]))
    if high <= low:
        return []

    def ends(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        left, right = np.full_like(y, x0), np.full_like(y, x1)
        for cy, cx, r in discs:
            half = np.sqrt(np.maximum(r * r - (y - cy) ** 2, 0))
            left, right = np.maximum(left, cx - half), np.minimum(right, cx + half)
        return left, right

    cuts = sorted(c for c in _crossings(discs, (x0, x1)) if low < c < high)
    panels, rest = [], [*zip([low, *cuts], [*cuts, high])]
    tips = [y + s * r for y, _, r in discs for s in (-1, 1)] if len(discs) > 1 else []
    while rest:
        low, high = rest.pop(0)
        left, right = ends(np.array([(low + high) / 2]))
        if right[0] <= left[0] or high - low <= 1e-12 * (y1 - y0):
            continue
        gaps = [max(low - t, t - high) for t in tips]
        if any(NEAR * (y1 - y0) < gap < (high - low) / 4 for gap in gaps):
            rest[:0] = [(low, (low + high) / 2), ((low + high) / 2, high)]
            continue
        panels.append(_panel(low, high, ends, discs, slope))
    return panels


def _crossings(discs: Sequence[Disc], sides: tuple[float, float]) -> list[float]:
    """y where circles meet vertical lines x = sides and each other."""
    found = []
    for n, (cy, cx, r) in enumerate(discs):
        for x in sides:
            if abs(x - cx) < r:
                found += [cy + s * math.sqrt(r * r - (x - cx) ** 2) for s in (-1, 1)]
        for y, x, other in discs[:n]:
            apart = math.hypot(y - cy, x - cx)
            if abs(r - other) < apart < r + other:
                along = (apart**2 + r * r - other * other) / (2 * apart)
                aside = math.sqrt(max(r * r - along * along, 0.0))
                found += [cy + (along * (y - cy) + s * aside * (x - cx)) / apart for s in (-1, 1)]
    return found


def _panel(low: float, high: float, ends: Callable, discs: Sequence[Disc], slope: float) -> Chords:
    """Chords between y = low and high at Gauss-Legendre nodes: on one disc in its angle,
    where its rim is smooth, on several in the angle of a circle about the panel.
    """
    half = (high - low) / 2
    if not discs:
        t, w = gauss(nodes_for(slope * half))
        y, wy = (low + high) / 2 + half * t, half * w
    else:
        if len(discs) == 1:
            middle, _, radius = discs[0]
            a, b = np.arcsin((low - middle) / radius), np.arcsin((high - middle) / radius)
            least, steep = 1, 1.0
        else:
            middle, radius, a, b = (low + high) / 2, half, -np.pi / 2, np.pi / 2
            least, steep = SMOOTH, STEEP
        t, w = gauss(max(least, nodes_for(steep * slope * radius * (b - a) / 2)))
        theta = (a + b) / 2 + (b - a) / 2 * t
        y, wy = middle + radius * np.sin(theta), (b - a) / 2 * w * radius * np.cos(theta)
    return y, wy, *ends(y)


def opening_chords(
    shape: str, nodes: int, angles: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Chords along x of a lenslet's opening, the rectangle around it scaled to [-1, 1]^2.

    shape: "square", "circle" or "hexagon", with two flat sides facing +-x;
    nodes: of a square's height, or of each of a hexagon's three panels; angles: of a circle.

    Returns rows, weights and half lengths, (chord,).
    """
    t, w = gauss(nodes)
    if shape == "square":
        return t, w, np.ones(len(t))
    if shape == "circle":
        # equidistant angles converge spectrally, since the integrand is periodic in them
        theta = (np.arange(angles) + 0.5) * np.pi / angles - np.pi / 2
        return np.sin(theta), np.pi / angles * np.cos(theta), np.cos(theta)
    panels = ((-1.0, -0.5), (-0.5, 0.5), (0.5, 1.0))
    y = np.concatenate([(a + b) / 2 + (b - a) / 2 * t for a, b in panels])
    weights = np.concatenate([(b - a) / 2 * w for a, b in panels])
    return y, weights, np.minimum(1.0, 2 * (1 - np.abs(y)))


@lru_cache(maxsize=16)
def opening_weights(shape: str, count: int) -> np.ndarray:
    """Weights W with sum W_ij F(y_i, x_j) the integral of F over a lenslet's opening, for functions
    that the Gauss-Legendre nodes of the rectangle around it interpolate.

    shape: "square", "circle" or "hexagon", with two flat sides facing +-x; the rectangle around it
        is scaled to [-1, 1]^2;
    count: nodes along each axis.

    Returns (row node, column node), read-only.
    """
    t, w = gauss(count)
    if shape == "square":
        found = np.outer(w, w)
    else:
        y, rows, half = opening_chords(shape, count + 4, 2 * count + 16)
        degrees = np.arange(count)
        ends = np.polynomial.legendre.legvander(half, count)
        chords = np.zeros((len(y), count))
        chords[:, 0] = 2 * half
        # from one end of a chord to the other: nothing for odd degrees
        chords[:, 2::2] = (
            2 * (ends[:, 3::2] - ends[:, 1:-2:2])[:, : len(degrees[2::2])] / (2 * degrees[2::2] + 1)
        )
        series = np.polynomial.legendre.legvander(t, count - 1).T * w * (degrees + 0.5)[:, None]
        across = np.polynomial.legendre.legvander(y, count - 1) @ series
        found = across.T @ (rows[:, None] * (chords @ series))
    found.flags.writeable = False
    return found
