"""Sequential ray tracing through a lens: exact refraction in three dimensions, ray aiming at the
stop, paraxial optics.

Coordinates (x, y, z) as in plenocli.forward.camera.prescription, x along columns, y along rows. A
bundle of rays holds positions and unit directions as arrays (3, ray) and optical path lengths
(ray,), all in metres. Rays that miss a surface, are totally reflected or (where asked for) fall
outside a clear aperture carry NaN.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.camera.prescription import Prescription, Surface

_NEWTON_STEPS, _AIM_STEPS = 50, 40
_BLOCK = 8192
"""Rays that are traced at a time: what a cache holds."""


@dataclass(frozen=True)
class Rays:
    """A bundle of rays.

    position: (3, ray) m;
    direction: (3, ray) unit vectors;
    path: (ray,) m of index times distance, NaN for rays that are lost.
    """

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray

    @property
    def alive(self) -> np.ndarray:
        """(ray,) bool: which rays got here."""
        return np.isfinite(self.path)


# exact rays


def sag(surface: Surface, square: np.ndarray) -> np.ndarray:
    """Height of a surface above its vertex plane.

    square: squared distance from the axis, m^2.

    Returns m, NaN beyond the surface's rim.
    """
    c, conic = surface.curvature, 1 + surface.conic
    with np.errstate(invalid="ignore"):
        z = c * square / (1 + np.sqrt(1 - conic * c * c * square))
    return z + _polynomial(surface.asphere, square) * square


def sag_slope(surface: Surface, square: np.ndarray) -> np.ndarray:
    """Slope dz/d(r^2) of a surface.

    square: squared distance from the axis, m^2.

    Returns 1/m.
    """
    c, conic = surface.curvature, 1 + surface.conic
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = c / (2 * np.sqrt(1 - conic * c * c * square))
    return slope + _polynomial([i * a for i, a in enumerate(surface.asphere, 1)], square)


def _polynomial(coefficients: Sequence[float], square: np.ndarray) -> np.ndarray:
    total = np.zeros_like(square)
    for a in reversed(coefficients):
        total = total * square + a
    return total


def intersect(surface: Surface, position: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Signed distance along each ray to a surface.

    Conics in closed form on the branch through the vertex, in the form that does not cancel; even
    aspheres by Newton's method from there.

    position: (3, ray) m from the surface's vertex;
    direction: (3, ray) unit vectors.

    Returns (ray,) m, NaN where a ray misses.
    """
    x, y, z = position
    l, m, n = direction
    c, k = surface.curvature, surface.conic
    with np.errstate(invalid="ignore", divide="ignore"):
        a = c * (1 + k * n * n)
        b = n - c * (x * l + y * m + (1 + k) * z * n)
        d = c * (x * x + y * y + (1 + k) * z * z) - 2 * z
        root = np.sqrt(b * b - a * d)
        t = d / (b + np.where(n < 0, -root, root))
        # the sheet that does not hold the vertex is no part of the surface
        t = np.where(1 - c * (1 + k) * (z + t * n) > 0, t, np.nan)
    return _newton(surface, position, direction, t) if any(surface.asphere) else t


def _newton(
    surface: Surface, position: np.ndarray, direction: np.ndarray, t: np.ndarray
) -> np.ndarray:
    """Distances to an even asphere from first guesses `t`; where there is none,
    from the vertex plane.
    """
    x, y, z = position
    l, m, n = direction
    t = np.where(np.isfinite(t), t, -z / n)
    scale = np.abs(z) + np.abs(t) + np.hypot(x, y)
    for _ in range(_NEWTON_STEPS):
        px, py = x + t * l, y + t * m
        square = px * px + py * py
        gap = z + t * n - sag(surface, square)
        step = gap / (n - 2 * sag_slope(surface, square) * (px * l + py * m))
        t = t - step
        done = ~(np.abs(step) > 4e-16 * scale)  # NaN counts as done
        if done.all():
            break
    return np.where(done, t, np.nan)


def refract(
    surface: Surface, position: np.ndarray, direction: np.ndarray, ratio: float
) -> np.ndarray:
    """Directions behind a surface.

    Snell's law as vectors, D' = r D + (cos t - r cos i) N with N the normal towards +z.

    position: (3, ray) m, where rays meet the surface;
    direction: (3, ray) unit vectors before it;
    ratio: n before over n behind.

    Returns (3, ray) unit vectors, NaN for total reflection.
    """
    x, y, _ = position
    slope = 2 * sag_slope(surface, x * x + y * y)
    normal = np.stack([-slope * x, -slope * y, np.ones_like(x)])
    normal /= np.sqrt((normal * normal).sum(axis=0))
    cosine = (normal * direction).sum(axis=0)
    with np.errstate(invalid="ignore"):
        behind = np.copysign(np.sqrt(1 - ratio * ratio * (1 - cosine * cosine)), cosine)
    out = ratio * direction + (behind - ratio * cosine) * normal
    return out / np.sqrt((out * out).sum(axis=0))


def trace(
    surfaces: Sequence[Surface],
    rays: Rays,
    wavelength: float,
    *,
    clip: bool = False,
    upto: int | None = None,
) -> Rays:
    """Carry rays, given in the frame of the first vertex, in air, through surfaces.

    wavelength: m;
    clip: whether rays outside a surface's semi_diameter are lost;
    upto: index of the surface to stop at, None: the last.

    Returns Rays on that surface, refracted, in the frame of ITS vertex.
    """
    chosen = surfaces if upto is None else surfaces[: upto + 1]
    indices = [1.0] + [s.medium.index(wavelength) for s in chosen]
    total = rays.path.size
    out = Rays(np.empty((3, total)), np.empty((3, total)), np.empty(total))
    for start in range(0, total, _BLOCK):
        part = slice(start, start + _BLOCK)
        _trace_block(chosen, indices, rays, clip, part, out)
    return out


def _trace_block(
    surfaces: Sequence[Surface],
    indices: Sequence[float],
    rays: Rays,
    clip: bool,
    part: slice,
    out: Rays,
) -> None:
    p, d, path = rays.position[:, part].copy(), rays.direction[:, part], rays.path[part]
    for i, surface in enumerate(surfaces):
        if i:
            p[2] -= surfaces[i - 1].thickness
        t = intersect(surface, p, d)
        p = p + t * d
        path = path + indices[i] * t
        if clip and math.isfinite(surface.semi_diameter):
            with np.errstate(invalid="ignore"):
                lost = p[0] * p[0] + p[1] * p[1] > (surface.semi_diameter * (1 + 1e-9)) ** 2
            path = np.where(lost, np.nan, path)
        if indices[i] != indices[i + 1]:
            d = refract(surface, p, d, indices[i] / indices[i + 1])
    path = np.where(np.isfinite(d[2]), path, np.nan)
    dead = ~np.isfinite(path)
    out.position[:, part] = np.where(dead, np.nan, p)
    out.direction[:, part] = np.where(dead, np.nan, d)
    out.path[part] = path


def to_plane(rays: Rays, distance: float, index: float = 1.0) -> Rays:
    """Rays carried on to a plane, in the frame of that plane.

    distance: z of the plane, m;
    index: of refraction on the way.
    """
    t = (distance - rays.position[2]) / rays.direction[2]
    position = rays.position + t * rays.direction
    position[2] = 0.0
    return Rays(position, rays.direction, rays.path + index * t)


# paraxial optics


def paraxial_matrix(
    surfaces: Sequence[Surface], wavelength: float, index_before: float = 1.0
) -> np.ndarray:
    """System matrix [[A, B], [C, D]] from just before the first vertex to just behind the last:
    (y, n u) -> (y', n' u').

    Refraction [[1, 0], [-(n' - n) c, 1]] and transfer [[1, d/n], [0, 1]]; the determinant is 1
    (Lagrange's invariant).

    wavelength: m;
    index_before: of refraction before the first surface.

    Returns (2, 2), B in m and C in 1/m.
    """
    matrix, n = np.eye(2), index_before
    for i, surface in enumerate(surfaces):
        if i:
            matrix = np.array([[1.0, surfaces[i - 1].thickness / n], [0.0, 1.0]]) @ matrix
        behind = surface.medium.index(wavelength)
        matrix = np.array([[1.0, 0.0], [-(behind - n) * surface.vertex_curvature, 1.0]]) @ matrix
        n = behind
    return matrix


@dataclass(frozen=True)
class Pupil:
    """Paraxial image of the stop; infinite if telecentric.

    position: m, of the entrance pupil from the first vertex, of the exit pupil from the last;
    radius: m, for the lens's stop radius;
    magnification: radius over stop radius, signed.
    """

    position: float
    radius: float
    magnification: float


_TELECENTRIC = Pupil(math.inf, math.inf, math.inf)


def entrance_pupil(lens: Prescription, wavelength: float) -> Pupil:
    """The stop as seen from the object, a Pupil."""
    front = paraxial_matrix(lens.surfaces[: lens.stop], wavelength) if lens.stop else np.eye(2)
    n = lens.surfaces[lens.stop - 1].medium.index(wavelength) if lens.stop else 1.0
    gap = lens.surfaces[lens.stop - 1].thickness / n if lens.stop else 0.0
    # height at the stop = a y + b u of the ray at the first vertex
    (a, b), _ = np.array([[1.0, gap], [0.0, 1.0]]) @ front
    return _TELECENTRIC if abs(a) < 1e-12 else _pupil(b / a, 1 / a, lens.stop_radius)


def exit_pupil(lens: Prescription, wavelength: float) -> Pupil:
    """The stop as seen from the image, a Pupil."""
    behind = lens.surfaces[lens.stop :]
    n = lens.surfaces[lens.stop - 1].medium.index(wavelength) if lens.stop else 1.0
    (_, b), (_, d) = paraxial_matrix(behind, wavelength, n)
    last = lens.surfaces[-1].medium.index(wavelength)
    return _TELECENTRIC if abs(d) < 1e-12 else _pupil(-b / d * last, 1 / d, lens.stop_radius)


def _pupil(position: float, magnification: float, stop_radius: float) -> Pupil:
    return Pupil(float(position), abs(float(magnification)) * stop_radius, float(magnification))


# aiming


def aim(
    lens: Prescription,
    wavelength: float,
    points: np.ndarray,
    *,
    angle: float = 0.0,
    object_distance: float = math.inf,
    real: bool = True,
) -> Rays:
    """Rays from one object point that meet the stop at given points.

    wavelength: m;
    points: (2, ray) x, y over the stop's radius;
    angle: of the field, rad: the object lies at infinity in the direction whose rays climb towards
        +y by it, or that far off axis that its paraxial chief ray has this angle;
    object_distance: m before the first vertex;
    real: aim at the stop, else at the paraxial entrance pupil.

    Returns Rays with paths counted from the object point, from infinity from the wavefront through
    the entrance pupil's centre; NaN where none reaches the point.
    Raises NumericsError where the chief ray fails.
    """
    source = _Source(lens, wavelength, angle, object_distance)
    target = np.asarray(points, dtype=float) * lens.stop_radius
    start = target * source.pupil.magnification
    if not real:
        return source.rays(start)
    chief = _chief(lens, wavelength, angle, object_distance)
    aimed, ok = _solve(lens, wavelength, source, chief + start, target)
    if not ok.all():
        walked, fine = _walk(lens, wavelength, source, chief, start, target)
        aimed, ok = np.where(ok, aimed, walked), ok | fine
    return source.rays(np.where(ok, aimed, np.nan))


def _walk(
    lens: Prescription,
    wavelength: float,
    source: _Source,
    chief: np.ndarray,
    start: np.ndarray,
    target: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """`_solve` from the chief ray outwards in four steps, for strongly deformed pupils."""
    at, before = chief + start / 4, None
    for share in (0.25, 0.5, 0.75, 1.0):
        if before is not None:
            at = chief + (at - chief) * (share / before)
        at, ok = _solve(lens, wavelength, source, at, target * share)
        before = share
    return at, ok


class _Source:
    """The rays of one object point, named by where they meet the plane of the entrance pupil."""

    def __init__(
        self, lens: Prescription, wavelength: float, angle: float, object_distance: float
    ) -> None:
        self.pupil = entrance_pupil(lens, wavelength)
        if not math.isfinite(self.pupil.position):
            raise NumericsError(
                "the stop's image lies at infinity on the object's side",
                "lens",
                "telecentric entrance pupils cannot be aimed at",
            )
        self.direction = np.array([0.0, math.sin(angle), math.cos(angle)])
        self.point = None
        if math.isfinite(object_distance):
            self.point = np.array(
                [0.0, -math.tan(angle) * (object_distance + self.pupil.position), -object_distance]
            )

    def rays(self, crossing: np.ndarray) -> Rays:
        """Rays through `crossing` (2, ray) (m) of the entrance pupil's plane, placed on the
        first vertex plane.
        """
        at = np.stack([crossing[0], crossing[1], np.full(crossing.shape[1], self.pupil.position)])
        if self.point is None:
            direction = np.broadcast_to(self.direction[:, None], at.shape).copy()
            path = self.direction[0] * crossing[0] + self.direction[1] * crossing[1]
            t = -at[2] / direction[2]
            return Rays(at + t * direction, direction, path + t)
        way = at - self.point[:, None]
        direction = (
            way
            / np.sqrt((way * way).sum(axis=0))
            * math.copysign(1.0, self.pupil.position - self.point[2])
        )
        t = -self.point[2] / direction[2]
        return Rays(self.point[:, None] + t * direction, direction, t)


def _chief(
    lens: Prescription, wavelength: float, angle: float, object_distance: float
) -> np.ndarray:
    """Where the ray to the stop's centre crosses the entrance pupil's plane, (2, 1) m; wide
    fields are reached in steps.
    """
    zero, reached = np.zeros((2, 1)), None
    for steps in (1, 4, 16, 64):
        # heights at the first vertex, which change less with the angle than those at the pupil
        height, before = zero, zero
        for i in range(1, steps + 1):
            source = _Source(lens, wavelength, angle * i / steps, object_distance)
            climb = source.pupil.position * math.tan(angle * i / steps) * np.array([[0.0], [1.0]])
            start = zero if i == 1 else 2 * height - before + climb
            at, ok = _solve(lens, wavelength, source, start, zero)
            if not ok.all():
                break
            height, before = at - climb, height
        else:
            # far off the axis other rays reach the stop, by ways that end on a later surface
            if trace(lens.surfaces, source.rays(at), wavelength).alive.all():
                return at
            reached = at
    if reached is not None:
        return reached
    raise NumericsError(
        f"no ray from {math.degrees(angle):.4g} degrees reaches the centre of the stop",
        "lens",
        "use a smaller field",
    )


def _solve(
    lens: Prescription,
    wavelength: float,
    source: _Source,
    start: np.ndarray,
    target: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Newton's method on the two pupil coordinates of every ray, with differences over 1e-4 of the
    pupil's radius and steps halved where they fail. Returns (crossings (2, ray), converged (ray,)).
    """
    ahead = lens.surfaces[: lens.stop + 1]
    tolerance = 1e-12 * lens.stop_radius
    h = 1e-4 * source.pupil.radius

    def miss(crossing: np.ndarray) -> np.ndarray:
        rays = trace(ahead, source.rays(crossing), wavelength)
        return rays.position[:2] - target

    at = np.array(np.broadcast_to(start, target.shape), dtype=float)
    error = miss(at)
    best = np.hypot(*error)
    damping = np.ones(at.shape[1])
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for _ in range(_AIM_STEPS):
            if not (best > tolerance).any():
                break
            jx, jy = (
                (miss(at + e[:, None] * h) - miss(at - e[:, None] * h)) / (2 * h) for e in np.eye(2)
            )
            det = jx[0] * jy[1] - jx[1] * jy[0]
            step = (
                -np.stack(
                    [jy[1] * error[0] - jy[0] * error[1], jx[0] * error[1] - jx[1] * error[0]]
                )
                / det
            )
            tried = at + damping * np.where(np.isfinite(step), step, 0.0)
            new = miss(tried)
            size = np.hypot(*new)
            better = size < best
            at, error, best = (
                np.where(better, tried, at),
                np.where(better, new, error),
                np.where(better, size, best),
            )
            damping = np.where(better, 1.0, damping / 2)
            if not (better | ~(best > tolerance)).any() and (damping < 1e-3).all():
                break
    return at, best <= 100 * tolerance
