"""The non-negative volume of least total variation that explains what was seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import prod

import numpy as np

from plenocli.base.budget import budget, spread
from plenocli.base.progress import bar
from plenocli.inverse.volume.lattice import Lattice, lattice_of
from plenocli.inverse.volume.lmmse import class_variance
from plenocli.inverse.volume.measurement import Problem
from plenocli.inverse.volume.volume import Likeness, Trial, Volume

PENALTY, SIGN = 3e-2, 0.5
"""Of differences and of the sign, over the data's, where A' A has a mean diagonal of 1."""
RELAXED = np.float32(1.6)
"""How far each round goes."""
STRENGTHS = (3e-2, 1e-2, 3e-3, 1e-3, 5e-4, 2.5e-4)
"""Of the total variation, over the root mean square of the signal."""
ROUNDS, LAST = 10, 36
"""At each strength, and more of them at the best, in which surfaces are free to be steep."""
LOOKED_AT = 12
"""Rounds after which it is looked again at where surfaces are."""
BLUR, ABOUT = 1.0, 1.5
"""Pitches of voxels over which a volume is smoothed, and about a voxel, to see surfaces."""
LITTLE = 1e-2
"""Share of a volume's variation below which another one explains none of it."""
VETO = 0.1
"""Share by which a volume that is like another one may have a larger held-out error."""
GAIN = 0.01
"""Share by which weaker total variation must make the held-out error smaller to be preferred."""


def total_variation(
    problem: Problem,
    strengths: tuple[float, ...] = STRENGTHS,
    rounds: int = LAST,
    like: np.ndarray | None = None,
) -> Volume:
    """min over x >= 0 of |A x - y|^2 / 2 + strength TV(x), pixels weighted with their noise.

    problem: pixels that do not count are left out.
    strengths: of the total variation, from strong to weak, over the root mean square of the
        signal; the strongest that predicts held-out pixels about as well as weaker ones is taken,
        without such pixels the weakest.
    rounds: at that one, after those that chose it.
    like: (plane, row, column) a volume of the same voxels, of another colour: as many rounds more
        with TV(x - f like), least over f >= 0 as well, where that is LITTLE less than TV(x) and
        held-out pixels do not object.

    Returns a volume without sigma.
    Raises NumericsError where memory is lacking.

    TV is isotropic in space: differences from plane to plane count less the further planes are
    apart, beside the pitch of voxels. In the last rounds differences across a surface, which
    `Surfaces` sees in the volume so far, count the less the more it is one. By the alternating
    direction method of multipliers on w = A x, v = D x and u = x >= 0: all maps are invariant
    under shifts by lenslets, so that the step in x is exact, by one matrix a lattice frequency.
    Boyd et al. 2011; Afonso, Bioucas-Dias and Figueiredo 2011. The strength belongs to differences
    as long as they are on the mean: of what is left of a volume that is like another they are
    shorter, and it is stronger by as much.
    """
    descent = _Descent(problem)
    state, trace, least, chosen = descent.start(), [], np.inf, strengths[0]
    for strength in bar(strengths, len(strengths), "total variation"):
        tried = descent.rounds(state, strength, ROUNDS)
        misfit = problem.misfit(tried.light)
        trace.append(Trial(f"strength {strength:g}", misfit))
        if misfit > (1 - GAIN) * least:
            break
        state, least, chosen = tried, misfit, strength
    state = descent.last(state, chosen, rounds)
    trace.append(Trial(f"strength {chosen:g}, to the end", problem.misfit(state.light)))
    u, light = state.u, state.light
    likeness = None if like is None else descent.tie_to(like, state)
    if like is not None and likeness is not None and likeness.factor:
        stronger = chosen / max(1 - likeness.share, LITTLE)
        for _ in range(0, rounds, LOOKED_AT):
            state = descent.last(state, stronger, min(LOOKED_AT, rounds))
            likeness = descent.tie_to(like, state)
        told = f"of what is not {likeness.factor:.3g} of the other volume"
        alone = trace[-1].misfit
        trace.append(Trial(told, problem.misfit(state.light)))
        if trace[-1].misfit > (1 + VETO) * alone:
            likeness = Likeness(factor=0.0, share=0.0)
        else:
            u, light = state.u, state.light
    return Volume(
        value=problem.inside(problem.voxels.lenslets(u)),
        sigma=None,
        method="tv",
        trace=tuple(trace),
        background=float(problem.measurement.offset.mean()),
        prior=None,
        held_out=problem.judged(light),
        margin=problem.margin,
        likeness=likeness,
    )


def memory(torus: tuple[int, int], pixels: int, unknowns: int, itemsize: int = 4) -> int:
    """Bytes of the steps, and of the arrays that rounds and surfaces take, as measured.

    torus: (rows, columns) of lenslets; pixels, unknowns: of one; itemsize: of a number.
    """
    steps = 2 * torus[0] * (torus[1] // 2 + 1) * unknowns**2
    return itemsize * (steps + prod(torus) * (62 * unknowns + 19 * pixels))


@dataclass(frozen=True, kw_only=True)
class _State:
    """w, v, u as above with their scaled multipliers, and the light of the non-negative volume."""

    w: np.ndarray
    v: tuple[np.ndarray, ...]
    u: np.ndarray
    of_w: np.ndarray
    of_v: tuple[np.ndarray, ...]
    of_u: np.ndarray
    light: np.ndarray


class _Descent:
    """The rounds of total_variation on one problem; the unit of x and y makes A' A 1 on average."""

    def __init__(self, problem: Problem) -> None:
        op = problem.op
        self.problem, self.whole = problem, op.on_torus()
        _, pixels, unknowns = op.spectrum.shape
        needed = memory(op.torus, pixels, unknowns, op.dtype.itemsize)
        budget().require(needed, "total variation", fewer="take fewer planes")
        variance = class_variance(problem)
        noise = float(np.mean(variance[np.isfinite(variance)]))
        whitening = np.sqrt(noise / variance)
        power = np.einsum("kpu,kpu->k", op.spectrum, op.spectrum.conj()).real / unknowns
        lattice = lattice_of(op.torus, problem.voxels)
        scale = float(np.sqrt(lattice.mean(power))) or 1.0
        self.scale = (whitening / scale).astype(op.dtype)
        voxels = problem.voxels
        self.along = (voxels.pitch / np.diff(voxels.depths)).astype(op.dtype)
        self.down = op.dtype.type(1 / voxels.row_spacing)
        steps = _inverses(problem, lattice, self.scale, self.along, float(self.down))
        self.solve = op.device.put(steps)
        rows, columns = op.range.shape[:2]
        self.y = np.zeros(self.whole.range.shape, op.dtype)
        self.counts = np.zeros(self.whole.range.shape, op.dtype)
        self.y[:rows, :columns] = problem.signal * self.scale
        self.counts[:rows, :columns] = problem.counts
        seen = problem.signal[problem.counts].astype(float)
        self.unit = float(np.sqrt(np.mean(seen**2))) / scale
        self.other: _Other | None = None

    def start(self) -> _State:
        """An empty volume."""
        planes, (rows, columns) = len(self.problem.voxels.depths), self.whole.torus
        s, t = self.problem.voxels.point_shape
        u = np.zeros((planes, rows * s, columns * t), self.whole.dtype)
        v = differences(u, self.along, self.down)
        return _State(
            w=self.y,
            v=v,
            u=u,
            of_w=np.zeros_like(self.y),
            of_v=v,
            of_u=u,
            light=np.zeros(self.problem.signal.shape, self.whole.dtype),
        )

    def tie_to(self, like: np.ndarray, state: _State) -> Likeness:
        """From here on what varies is the volume less that factor times `like`, (plane, row,
        column) before the lenslets, which makes its variation least.
        """
        _, rows, columns = like.shape
        inside = state.u[:, :rows, :columns]
        factor, share = least_variation(inside, like, self.along, self.down)
        self.other = None
        if factor:
            self.other = _other_of(factor * like, state.u.shape, self.along, self.down)
        return Likeness(factor=factor, share=share)

    def last(self, state: _State, strength: float, rounds: int) -> _State:
        """Rounds in which surfaces are free to be steep."""
        for done in range(0, rounds, LOOKED_AT):
            left = state.u if self.other is None else state.u - self.other.picture
            seen = surfaces_of(left, self.along, self.down)
            state = self.rounds(state, strength, min(LOOKED_AT, rounds - done), seen)
        return state

    def rounds(
        self, state: _State, strength: float, count: int, surfaces: Surfaces | None = None
    ) -> _State:
        """`count` rounds at a strength, and the light of the volume after them."""
        if not count:
            return state
        for _ in range(count):
            state = self._round(state, self.whole.dtype.type(strength * self.unit), surfaces)
        light = self.problem.op.forward(self.problem.voxels.lenslets(state.u))
        return _State(**{**vars(state), "light": light})

    def _round(self, state: _State, strength: np.floating, surfaces: Surfaces | None) -> _State:
        whole, voxels = self.whole, self.problem.voxels
        kind = whole.dtype.type
        left = tuple(v - d for v, d in zip(state.v, state.of_v))
        pull = back_differences(left, self.along, self.down)
        pull = kind(PENALTY) * pull + kind(SIGN) * (state.u - state.of_u)
        pull = voxels.lenslets(pull)
        data = whole.to_frequencies((state.w - state.of_w) * self.scale)
        of_x, of_light = whole.step_at_frequencies(self.solve, data, whole.to_frequencies(pull))
        x = voxels.picture(whole.from_frequencies(of_x))
        light = whole.from_frequencies(of_light) * self.scale
        aim = _beyond(light, state.w) + state.of_w
        w = (self.counts * self.y + aim) / (self.counts + 1)
        steps = zip(differences(x, self.along, self.down), state.v, state.of_v)
        aims = tuple(_beyond(g, v) + d for g, v, d in steps)
        others = () if self.other is None else self.other.steps
        for a, other in zip(aims, others):
            a -= other
        v = shrunk(aims, strength / kind(PENALTY), surfaces)
        of_v = tuple(a - b for a, b in zip(aims, v))
        for b, other in zip(v, others):
            b += other
        above = _beyond(x, state.u) + state.of_u
        u = np.maximum(above, 0)
        return _State(
            w=w,
            v=v,
            u=u,
            of_w=aim - w,
            of_v=of_v,
            of_u=above - u,
            light=state.light,
        )


@dataclass(frozen=True)
class _Other:
    """What a volume is like, on the torus.

    picture: (plane, row, column), beyond the lenslets as at their edge.
    steps: its differences, none from or to what is beyond.
    """

    picture: np.ndarray
    steps: tuple[np.ndarray, ...]


def _other_of(like: np.ndarray, shape: Sequence[int], along: np.ndarray, down: float) -> _Other:
    """`like`, (plane, row, column) before the lenslets, on a torus of `shape`."""
    _, rows, columns = like.shape
    beyond = (0, 0), (0, shape[1] - rows), (0, shape[2] - columns)
    steps = differences(like, along, down)
    steps[1][:, -1], steps[2][..., -1] = 0, 0  # from one side to the other
    return _Other(np.pad(like, beyond, mode="edge"), tuple(np.pad(d, beyond) for d in steps))


def least_variation(
    x: np.ndarray, like: np.ndarray, along: np.ndarray, down: float
) -> tuple[float, float]:
    """(f, share): the f >= 0 for which x - f like varies least, and the share of the variation of x
    that is gone then; (0, 0) where that is less than LITTLE.

    x, like: (plane, row, column); along, down: as in `differences`.
    """
    from scipy.optimize import minimize_scalar

    own, other = (_other_of(v.astype(float), v.shape, along, down).steps for v in (x, like))
    alone, of_other = (float(np.sqrt(_squares(v)).sum()) for v in (own, other))
    if not alone or not of_other:
        return 0.0, 0.0
    most = 2 * alone / of_other  # convex, and beyond it more than at 0

    def variation(part: float) -> float:
        rest = tuple(a - part * most * b for a, b in zip(own, other))
        return float(np.sqrt(_squares(rest)).sum())

    found = minimize_scalar(variation, bounds=(0, 1), method="bounded")
    share = 1 - float(found.fun) / alone
    return (float(found.x) * most, share) if share > LITTLE else (0.0, 0.0)


def differences(x: np.ndarray, along: np.ndarray, down: float = 1.0) -> tuple[np.ndarray, ...]:
    """Of (plane, row, column) with the next plane, times `along` (plane - 1,), with the next row on
    the torus, times `down`, and with the next column.
    """
    deep = along[:, None, None] * np.diff(x, axis=0)
    return deep, down * (np.roll(x, -1, 1) - x), np.roll(x, -1, 2) - x


def back_differences(v: tuple[np.ndarray, ...], along: np.ndarray, down: float = 1.0) -> np.ndarray:
    """The adjoint of `differences`."""
    deep, rows, right = v
    deep = along[:, None, None] * deep
    x = down * (np.roll(rows, 1, 1) - rows) + np.roll(right, 1, 2) - right
    x[1:] += deep
    x[:-1] -= deep
    return x


@dataclass(frozen=True)
class Surfaces:
    """Where a volume looks like a surface, and which way it faces.

    normal: (plane, row, column differences), each (plane, row, column), of length 1.
    free: (plane, row, column) 1 where the volume changes along the normal alone, 0 where half as
        much of the change, or more, is along another direction.
    """

    normal: tuple[np.ndarray, np.ndarray, np.ndarray]
    free: np.ndarray


def surfaces_of(x: np.ndarray, along: np.ndarray, down: float) -> Surfaces:
    """The surfaces of (plane, row, column), by its structure tensor: eigenvectors and eigenvalues
    of the mean g g' about a voxel, g the gradient of a smoothed volume.

    along, down: as in `differences`. Weickert 1998.
    """
    from scipy.ndimage import gaussian_filter

    depth = float(along.mean()) if len(along) else 1.0
    wide = np.array([depth, down, 1.0])
    edges = "nearest", "wrap", "wrap"
    smooth = gaussian_filter(x, BLUR * wide, mode=edges)
    deep = np.gradient(smooth, axis=0) if len(x) > 1 else np.zeros_like(x)
    across = (np.roll(smooth, -1, axis) - np.roll(smooth, 1, axis) for axis in (1, 2))
    gradient = [depth * deep, *(w / 2 * part for w, part in zip(wide[1:], across))]
    means = {
        (i, j): gaussian_filter(gradient[i] * gradient[j], ABOUT * wide, mode=edges)
        for i, j in combinations_with_replacement(range(3), 2)
    }
    normal, free = np.empty((3, *x.shape), x.dtype), np.empty_like(x)
    for plane in range(len(x)):
        tensor = {at: mean[plane].astype(float) for at, mean in means.items()}
        normal[:, plane], free[plane] = _one_way(tensor)
    return Surfaces((normal[0], normal[1], normal[2]), free)


def _one_way(tensor: dict[tuple[int, int], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Of symmetric 3 x 3 matrices, none below zero, given by their upper half: the eigenvector of
    the greatest eigenvalue, (3, ..), and max(1 - 2 (second over greatest), 0).

    By the roots of the characteristic polynomial and the greatest column of the adjugate, which
    stands well above rounding wherever the second number is not 0; else the vector is of no use.
    """
    a, b, c, d, e, f = (tensor[at] for at in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    tiny = np.finfo(float).tiny
    unit = np.maximum(a + d + f, tiny)
    a, b, c, d, e, f = (part / unit for part in (a, b, c, d, e, f))
    mean = (a + d + f) / 3
    spread = np.sqrt(((a - d) ** 2 + (d - f) ** 2 + (f - a) ** 2) / 18 + (b**2 + c**2 + e**2) / 3)
    a, d, f = a - mean, d - mean, f - mean
    turn = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    angle = np.arccos(np.clip(turn / np.maximum(2 * spread**3, tiny), -1, 1)) / 3
    greatest = 2 * spread * np.cos(angle)
    second = 2 * spread * np.cos(angle - 2 * np.pi / 3)
    free = np.maximum(1 - 2 * (second + mean) / np.maximum(greatest + mean, tiny), 0)
    a, d, f = a - greatest, d - greatest, f - greatest
    columns = np.array(
        [
            [d * f - e * e, c * e - b * f, b * e - c * d],
            [c * e - b * f, a * f - c * c, b * c - a * e],
            [b * e - c * d, b * c - a * e, a * d - b * b],
        ]
    )
    square = np.einsum("ij...,ij...->j...", columns, columns)
    found = np.take_along_axis(columns, square.argmax(axis=0)[None, None], axis=1)[:, 0]
    return found / np.sqrt(np.maximum(square.max(axis=0), tiny)), free


def shrunk(
    v: tuple[np.ndarray, ...], by: np.floating, surfaces: Surfaces | None = None
) -> tuple[np.ndarray, ...]:
    """Differences whose length at every voxel is shorter by `by`.

    As far as a surface is free that across it is instead shorter by less, down to nothing, and
    that along it by more, up to twice: the mean of both, which belongs to a convex measure of
    differences again (the proximal average; Bauschke, Goebel, Lucet and Wang 2008).
    """
    deep, down, right = v
    square = _squares(v)
    left = _left(np.sqrt(square), by)
    if surfaces is None:
        return deep * left[:-1], down * left, right * left
    normal, free = surfaces.normal, surfaces.free
    across = normal[1] * down + normal[2] * right
    across[:-1] += normal[0][:-1] * deep
    along = _left(np.sqrt(np.maximum(square - across**2, 0)), by * (1 + free))
    more = free * across * (_left(np.abs(across), by * (1 - free)) - along)
    left += free * (along - left)
    deep, down, right = deep * left[:-1], down * left, right * left
    return deep + (normal[0] * more)[:-1], down + normal[1] * more, right + normal[2] * more


def _squares(v: tuple[np.ndarray, ...]) -> np.ndarray:
    """Of the differences' length at every voxel."""
    deep, down, right = v
    square = down**2 + right**2
    square[:-1] += deep**2
    return square


def _left(length: np.ndarray, by: np.ndarray | np.floating) -> np.ndarray:
    """Share of a length that is left after it is shorter by `by`."""
    return 1 - by / np.maximum(length, np.maximum(by, np.finfo(np.float32).tiny))


def _beyond(new: np.ndarray, old: np.ndarray) -> np.ndarray:
    return RELAXED * new + (1 - RELAXED) * old


def _inverses(
    problem: Problem, lattice: Lattice, scale: np.ndarray, along: np.ndarray, down: float
) -> np.ndarray:
    """(A' A + p D' D + q)^-1 of every frequency, (frequency, unknown, unknown), in the precision of
    the map: no eigenvalue is below q, so that its rounding is that of A' A itself.
    """
    from scipy.linalg import get_blas_funcs, get_lapack_funcs

    spectrum, planes = problem.op.spectrum, len(problem.voxels.depths)
    frequencies, _, unknowns = spectrum.shape
    points = unknowns // planes
    herk = get_blas_funcs("herk", dtype=spectrum.dtype)
    potrf, potri = get_lapack_funcs(("potrf", "potri"), dtype=spectrum.dtype)
    inverse = np.empty((frequencies, unknowns, unknowns), spectrum.dtype)
    step = along[:, None] * np.diff(np.eye(planes), axis=0)
    own = np.kron(PENALTY * step.T @ step + SIGN * np.eye(planes), np.eye(points))
    own = own.astype(scale.dtype)
    each = np.arange(planes)

    with bar(None, frequencies, "steps") as shown:

        def work(some: range) -> None:
            for k in some:
                mixing = lattice.mixing[k]
                across = PENALTY * 4 * np.sin(np.pi * lattice.turns[k]) ** 2 @ [down**2, 1.0]
                # columns first, the lower triangle: rows first it is the upper one of A' A
                gram = herk(1.0, (scale[:, None] * spectrum[k]).T, lower=1).T
                gram += own
                layers = gram.reshape(planes, points, planes, points)
                layers[each, :, each] += mixing * across @ mixing.conj().T
                root = potrf(gram.T, lower=1, overwrite_a=1)[0]
                upper = np.triu(potri(root, lower=1, overwrite_c=1)[0].T)
                inverse[k] = upper + np.triu(upper, 1).conj().T
                shown.update()

        share = max(1, frequencies // 32)
        spread(
            [(range(i, min(i + share, frequencies)),) for i in range(0, frequencies, share)], work
        )
    return inverse
