"""The dial: which computation of a system matrix meets the accuracy asked for at the least
cost (docs/model.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import NumericsError, UsageError
from plenocli.base.units import format_length
from plenocli.forward.accuracy.machine_rate import product_rate
from plenocli.forward.accuracy.scene_needs import seen_wavelengths, sensor_noise, visible_accuracy
from plenocli.forward.camera.field import at_field, pupil_change
from plenocli.forward.camera.geometry import chief_ray, corner_ray, lenslet_shift
from plenocli.forward.camera.geometry import geometry as geometry_of
from plenocli.forward.propagation.bands import MAX_NODES, node_count, spectral_error, spectral_nodes
from plenocli.forward.propagation.fresnel.left_out import window_error
from plenocli.forward.propagation.fresnel.paraxial_error import oblique_error
from plenocli.forward.propagation.models import MODELS
from plenocli.forward.propagation.plan import Candidate, PifPlan
from plenocli.forward.propagation.sampling import (
    blur_ring,
    coherent_window,
    predicted_outside,
)
from plenocli.forward.propagation.system_matrix import PifBuilder, build_pif

if TYPE_CHECKING:
    from plenocli.forward.accuracy.scene_needs import SceneNeeds
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.models import Model
    from plenocli.forward.propagation.system_matrix import Progress, SystemMatrix

BEST_ACCURACY = 1e-8
"""Finest sampling on offer: double precision."""
Superpixels = tuple[int, int] | str
"""Odd (rows, columns), or "auto"."""
KINDS = ("auto", "ray", "fresnel", "exact")
"""What --model takes."""
MAX_RING = 8
"""Rings of coherent neighbours that the dial adds by itself."""
SINGLE_LIMIT = 3e-6
"""Single precision serves sampling errors down to this: ten times its rounding."""
ROUNDING = {False: 3e-7, True: 3e-10}
"""Error of a column from rounding in single and double precision (measured)."""
BAND_SHARE = 0.5
"""Share of the accuracy that the wavelengths of a band may use up."""
STEPS = 6
"""Halvings, on a logarithmic scale, of the range in which the finest accuracy that can be
reached is sought.
"""
STEEPEST = 1.75
"""Tangent of the angle from a lenslet's axis up to which the exact model takes coherent
neighbours in by itself.
"""
COARSEST = 0.5
"""A default accuracy beyond this is refused: such columns are not the camera's. Who can use
them asks for them.
"""
SHARE = 0.2
"""Least share of the accuracy that must be left for sampling; below it the other errors count as
the accuracy's whole.
"""


def plan_pif(
    camera: Camera,
    *,
    wavelengths: Sequence[float] | None = None,
    superpixels: Superpixels = "auto",
    coherent_ring: int | str = "auto",
    accuracy: float | None = None,
    model: str = "auto",
    dtype: np.typing.DTypeLike = "auto",
    points: slice | None = None,
    needs: SceneNeeds | None = None,
    lenslet: tuple[int, int] | None = None,
    chief: tuple[float, float] | None = None,
) -> PifPlan:
    """Choose how to compute a system matrix; no optics is computed.

    wavelengths: m (default: the camera's);
    superpixels: "auto" or odd (rows, columns);
    coherent_ring: "auto" or a number of rings, 0 for isolated lenslets;
    accuracy: relative L2 error of the worst column, against the finest model for model "auto" and
        within the model where one is named; None takes what the noise of the sensor or of the scene
        lets be seen, or the best there is;
    model: "auto", "ray", "fresnel" or "exact";
    dtype: "auto", float32 or float64 of the stored matrix;
    points: slice of flat point indices;
    needs: what is known of the scene, which narrows the request; its depth is for depth_planes;
    lenslet: (row, column) of an off-axis lenslet whose pixels lie on the sensor's raster;
    chief: instead, where a lenslet stands from the axis (rows, columns; m) whose pixels lie as
        those of the one on the axis do.

    Returns the plan.
    Raises UsageError or NumericsError where the request cannot be met.
    docs/model.md, "The dial".
    """
    request = _Request(
        camera,
        wavelengths,
        superpixels,
        coherent_ring,
        accuracy,
        model,
        dtype,
        points,
        needs,
        lenslet,
        chief,
    )
    found = [_consider(request, each) for each in MODELS if model in ("auto", each.kind)]
    best = _cheapest(found)
    if best is None:
        request, found, best = _fall_back(request, found)
    return _plan(request, found, best)


class _Request:
    """What was asked, narrowed to what the scene needs, with the geometry at each wavelength."""

    def __init__(
        self,
        camera: Camera,
        wavelengths: Sequence[float] | None,
        superpixels: Superpixels,
        coherent_ring: int | str,
        accuracy: float | None,
        model: str,
        dtype: np.typing.DTypeLike,
        points: slice | None,
        needs: SceneNeeds | None,
        lenslet: tuple[int, int] | None,
        chief: tuple[float, float] | None,
    ) -> None:
        if model not in KINDS:
            raise UsageError(f"model {model!r} is not one of {', '.join(KINDS)}", "model")
        if coherent_ring != "auto" and not (
            isinstance(coherent_ring, int) and 0 <= coherent_ring <= 20
        ):
            raise UsageError(
                f"coherent ring {coherent_ring!r} is not auto or a whole number from 0 to 20",
                "coherent_ring",
            )
        if accuracy is not None and not BEST_ACCURACY <= accuracy < 1:
            raise NumericsError(
                f"accuracy {accuracy:g} cannot be reached",
                "accuracy",
                f"ask for {BEST_ACCURACY:g} to below 1",
            )
        self.camera, self.model, self.needs, self.points = camera, model, needs, points
        self.reasons: list[str] = []
        self.left_out: list[str] = []
        self.warnings: list[str] = []
        self.explicit = accuracy is not None
        self.accuracy, self.asked_by = self._accuracy(accuracy)
        every = wavelengths or camera.light.wavelengths
        kept, self.dim = seen_wavelengths(every, needs, self.accuracy)
        if len(kept) < len(every):
            self.left_out.append(
                f"{len(every) - len(kept)} of {len(every)} wavelength(s) with little or no light "
                f"in the scene: {f'error up to {self.dim:.1g}' if self.dim else 'no error'}"
            )
        self.pixel_shift, self.chief = _place(camera, lenslet)
        self.chief = chief or self.chief
        if camera.lenslet_array.pitch < max(kept):
            raise UsageError(
                f"wavelength {format_length(max(kept))} is longer than lenslets are wide, "
                f"{format_length(camera.lenslet_array.pitch)}: such openings are no lenses",
                "wavelengths",
                "check its unit, or that of lenslet_array.pitch",
            )
        self.geometries = [geometry_of(camera, w, self.pixel_shift, self.chief) for w in kept]
        # one matrix for all lenslets is that of the one on the axis
        alone = lenslet is not None or chief is not None
        self.corner = None if alone else corner_ray(camera)
        # a band goes by its centre
        self.band = (
            camera.light.band
            if camera.light.band is not None and kept == (camera.light.band.center,)
            else None
        )
        self.dtype = np.dtype(
            (np.float32 if self.accuracy >= 1e-6 else np.float64)
            if isinstance(dtype, str) and dtype == "auto"
            else dtype
        )
        self.superpixels = _superpixels(superpixels, self.geometries, self.accuracy, self.reasons)
        self.rings = self._rings(coherent_ring)
        if needs is not None and needs.lenslets is not None:
            total, lit = int(np.prod(camera.lenslet_array.count)), int(np.prod(needs.lenslets))
            if lit < total:
                self.left_out.append(
                    f"{total - lit} of {total} lenslets see no light of the scene: no error"
                )

    def _accuracy(self, asked: float | None) -> tuple[float, str]:
        noise, who = (
            (sensor_noise(self.camera), "sensor noise")
            if self.needs is None or self.needs.noise is None
            else (self.needs.noise, f"noise of the {self.needs.source}")
        )
        seen = visible_accuracy(noise)
        if asked is None:
            self.reasons.append(
                f"accuracy {seen:.2g}: {who} is {noise:.2g} of the signal, and a third of that "
                "cannot be seen beside it"
            )
            return seen, who
        if self.needs is not None and self.needs.noise is not None and seen > asked:
            self.left_out.append(
                f"accuracy beyond {seen:.2g} ({asked:g} asked): the {who} is {noise:.2g} of "
                "the signal and hides it"
            )
            return seen, who
        return asked, "request"

    def _rings(self, asked: int | str) -> tuple[int, ...]:
        if asked != "auto":
            if asked == 0:
                self.reasons.append("isolated lenslets as asked: light of neighbours is left out")
            return (int(asked),)
        return tuple(range(1, MAX_RING + 1))

    def seen(self, geometry: Geometry) -> Camera:
        """The camera with the main lens as the lenslet sees it at the geometry's wavelength."""
        return at_field(self.camera, geometry.wavelength, geometry.chief)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(band, lenslet, pixel, point) of the matrix."""
        count = int(np.prod(self.geometries[0].object_shape))
        count = count if self.points is None else len(range(*self.points.indices(count)))
        return (
            len(self.geometries),
            self.superpixels[0] * self.superpixels[1],
            int(np.prod(self.geometries[0].pixel_shape)),
            count,
        )


def _place(
    camera: Camera, lenslet: tuple[int, int] | None
) -> tuple[tuple[float, float] | None, tuple[float, float]]:
    """(pixel_shift, chief) of lenslet (row, column) of the array; for the one on the axis the shift
    that a fit found, or None.
    """
    if lenslet is None:
        shift = (0.0, 0.0) if camera.fitted is None else camera.fitted.pixel_shift
        return (shift if any(shift) else None), (0.0, 0.0)
    count = camera.lenslet_array.count
    if not all(0 <= n < m for n, m in zip(lenslet, count)):
        raise UsageError(
            f"lenslet {lenslet[0]},{lenslet[1]} is not on the array of {count[0]} x {count[1]}",
            "lenslet",
            "count rows and columns from 0",
        )
    return lenslet_shift(camera, *lenslet)[2], chief_ray(camera, *lenslet)


def _consider(request: _Request, model: Model) -> Candidate:
    """The Candidate of one model: its error by source, and the rings, precision and node counts
    that it would take.
    """
    reason = next(
        (r for r in (model.valid_for(request.seen(v), v) for v in request.geometries) if r), None
    )
    if reason:
        return Candidate(name=model.name, model=model.kind, why=reason)
    tried = []
    for ring in _rings_of(request, model):
        # the rings that a user asks for are the user's model
        chosen = model.kind != "ray" and len(request.rings) > 1
        nodes, spectrum = _band_nodes(request, model, ring)
        split = {
            "model": 0.0 if request.model != "auto" else _error_bound(request, model, ring),
            "storage": 3e-8 if request.dtype == np.float32 else 0.0,
            "spectrum": math.hypot(spectrum, request.dim),
            "neighbourhood": _left_out(request, ring) if chosen else 0.0,
        }
        tried.append(_sized(request, model, ring, split, nodes))
        if tried[-1].why is None:
            return tried[-1]
        if not math.isfinite(tried[-1].error):  # nor with more rings
            break
    # none serves: the fewest rings that come as near as any
    least = min(c.error for c in tried)
    return next(c for c in tried if c.error <= 1.1 * least)


def _error_bound(request: _Request, model: Model, ring: int) -> float:
    """Of the model against the finest one, at the shortest, the middle and the longest wavelength:
    the pupil's image has most edges at one end, and diffraction is widest at the other.
    """
    return max(
        model.error_bound(request.seen(v), v, request.superpixels, ring) for v in _ends(request)
    )


def _left_out(request: _Request, ring: int) -> float:
    """Of lenslets beyond the coherent window, at the worst wavelength of those of _error_bound."""
    return max(window_error(request.seen(v), v, request.superpixels, ring) for v in _ends(request))


def _ends(request: _Request) -> list[Geometry]:
    """Of the shortest, the middle and the longest wavelength."""
    some = sorted(request.geometries, key=lambda v: v.wavelength)
    return list(dict.fromkeys([some[0], some[len(some) // 2], some[-1]]))


def _rings_of(request: _Request, model: Model) -> Sequence[int]:
    """The rings of coherent neighbours to choose from: of the least number only for rays, which
    end where the blur ends.
    """
    if model.kind == "ray" or len(request.rings) == 1:
        return request.rings[:1]
    if model.kind != "exact":
        return request.rings
    # what lies outside is known from the paraxial model, which says less than a third of
    # it 64 degrees aside
    return [
        ring
        for ring in request.rings
        if ring == 1
        or max(
            (coherent_window(v, request.superpixels, ring) or 0) * v.D2 / v.z3
            for v in request.geometries
        )
        <= STEEPEST
    ]


def _band_nodes(request: _Request, model: Model, ring: int) -> tuple[int, float]:
    """(wavelengths that stand for the camera's band of light, error that leaves);
    (0, 0.0) for lines.
    """
    if request.band is None:
        return 0, 0.0
    geometry = request.geometries[0]
    window = None if ring == 0 else coherent_window(geometry, request.superpixels, ring)
    try:
        count = node_count(geometry, request.band, BAND_SHARE * request.accuracy, window)
    except NumericsError:
        count = MAX_NODES
    return count, spectral_error(geometry, request.band, count, window)


def _sized(
    request: _Request, model: Model, ring: int, split: dict[str, float], nodes: int
) -> Candidate:
    """Node counts for the accuracy that the other errors leave to sampling."""
    rest = math.hypot(*split.values())
    room = math.sqrt(max(request.accuracy**2 - rest**2, 0))
    why = None
    if room < SHARE * request.accuracy:
        worst = max(split, key=lambda source: split[source])
        why = f"{worst} error {split[worst]:.1g}"
        room = max(rest, BEST_ACCURACY)
    sampling = min(max(room, 0.9 * BEST_ACCURACY), 0.5)
    try:
        bands = tuple(
            model.size(request.seen(v), v, request.superpixels, ring, sampling, sampling / 2)
            for v in _finest(request, nodes)
        )
        # single precision's rounding is of the size of the brightest points' light
        faintest = min(b.faintest for b in bands)
        double = request.dtype == np.float64 or sampling * faintest < SINGLE_LIMIT
        rounding = ROUNDING[double] / (1 if double else faintest)
        costs = [
            model.cost(request.seen(v), v, b, request.shape, double)
            for v, b in zip(request.geometries, bands)
        ]
    except NumericsError as error:
        return Candidate(name=model.name, model=model.kind, why=error.what)
    split = split | {"sampling": max(max(b.sampling for b in bands), rounding)}
    if why is None and rounding > request.accuracy:
        why = f"the dimmest point has {faintest**2:.1g} of the light: rounding error {rounding:.1g}"
    if nodes and request.band is not None:
        bands = (replace(bands[0], wavelength=request.band.center),)
    size = int(np.prod(request.shape)) * request.dtype.itemsize
    return Candidate(
        name=model.name,
        model=model.kind,
        why=why,
        error=math.hypot(*split.values()),
        split=split,
        ring=ring,
        sampling=sampling,
        double=double,
        bands=bands,
        operations=max(nodes, 1) * sum(c.operations for c in costs),
        fixed_seconds=max(nodes, 1) * sum(c.seconds for c in costs),
        bytes=size + max(nodes, 1) * max(c.bytes for c in costs),
        band_nodes=nodes,
    )


def _finest(request: _Request, nodes: int) -> list[Geometry]:
    """The geometries that node counts must serve: of a band, that of its shortest wavelength."""
    if not nodes or request.band is None:
        return request.geometries
    return [
        geometry_of(
            request.camera,
            float(spectral_nodes(request.band, nodes)[0].min()),
            request.pixel_shift,
            request.chief,
        )
    ]


def _cheapest(found: list[Candidate]) -> Candidate | None:
    serving = [c for c in found if c.why is None]
    return min(serving, key=Candidate.seconds) if serving else None


def _fall_back(
    request: _Request, found: list[Candidate]
) -> tuple[_Request, list[Candidate], Candidate]:
    """Where nothing serves: the best there is for a default accuracy, unless that is beyond
    COARSEST; exit 5 for one that was asked for.
    """
    asked, possible = request.accuracy, [c for c in found if math.isfinite(c.error)]
    least = min(
        (math.hypot(*(v for k, v in c.sources.items() if k != "sampling")) for c in possible),
        default=math.inf,
    )
    reached, again, best = _finest_served(
        request, found, max(asked, min(1.3 * least + 1.1 * BEST_ACCURACY, 0.99))
    )
    if best is None:
        raise NumericsError(
            f"model {request.model!r} does not serve this camera ({_reasons(found)})",
            "model",
            "change the camera, or "
            + (
                "name a model, such as --model ray, to be exact within it only"
                if request.model == "auto"
                else "leave --model at auto"
            ),
        )
    why = next(c.why for c in found if c.name == best.name)
    if request.explicit:
        advice = f"ask for {reached:.2g} or coarser"
        if request.model == "auto" and best.sources["model"] > 0.5 * best.error:
            advice += (
                f", or name a model (--model {best.model}) to ask for accuracy "
                "within that model only"
            )
        raise NumericsError(
            (
                f"accuracy {asked:g} cannot be reached: the best is about {reached:.2g} "
                f"({best.name}: {why})"
            ),
            "accuracy",
            advice,
        )
    if reached > COARSEST:
        raise NumericsError(
            f"no model comes nearer to this camera than {reached:.2g} ({_reasons(found)})",
            "accuracy",
            f"change the camera, or ask for {reached:.2g}",
        )
    request.warnings.append(
        f"the {request.asked_by} calls for accuracy {asked:.1g}; the best there is for this "
        f"camera is about {reached:.1g} ({best.name}: {why})"
    )
    request.accuracy = reached
    return request, again, best


def _reasons(found: list[Candidate]) -> str:
    """Why each model does not serve, models with the same reason together."""
    reasons = dict.fromkeys(c.why for c in found)
    return "; ".join(
        f"{' and '.join(c.name for c in found if c.why == why)}: {why}" for why in reasons
    )


def _finest_served(
    request: _Request, found: list[Candidate], limit: float
) -> tuple[float, list[Candidate], Candidate | None]:
    """(accuracy, candidates, the chosen one) of about the finest accuracy that something serves
    between the request's, which nothing does, and `limit`; the chosen one is None where
    nothing serves any.
    """
    asked = low = request.accuracy
    served: tuple[float, list[Candidate], Candidate | None] = limit, found, None
    # what limits a model that could be sized is known; others may serve what is coarser
    trials = [limit] if any(math.isfinite(c.error) for c in found) else []
    high = limit
    for accuracy in [*trials, 0.99]:
        served = _served(request, accuracy)
        high = accuracy
        if served[2] is not None:
            break
    for _ in range(STEPS if served[2] is not None else 0):
        middle = _rounded_up(math.sqrt(low * high))
        if not low < middle < high:
            break
        trial = _served(request, middle)
        low, high, served = (low, middle, trial) if trial[2] is not None else (middle, high, served)
    request.accuracy = asked
    return served


def _served(request: _Request, accuracy: float) -> tuple[float, list[Candidate], Candidate | None]:
    request.accuracy = accuracy
    found = [_consider(request, each) for each in MODELS if request.model in ("auto", each.kind)]
    return accuracy, found, _cheapest(found)


def _rounded_up(value: float) -> float:
    """To two digits, so that what is said can be asked for."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / unit - 1e-9) * unit


def _plan(request: _Request, found: list[Candidate], best: Candidate) -> PifPlan:
    """The PifPlan of the chosen Candidate, with what was considered and left out."""
    table = tuple(
        replace(
            c,
            why=c.why or f"serves, at {c.seconds() / max(best.seconds(), 1e-9):.2g} times the cost",
        )
        if c is not best
        else c
        for c in found
    )
    warnings = [*request.warnings, *_warnings(request, best)]
    if best.ring and best.model != "ray":
        window = _left_out(request, best.ring)
        request.left_out.append(
            f"lenslets beyond {best.ring} ring(s) of coherent neighbours: error about {window:.1g}"
        )
        if len(request.rings) == 1 and window > request.accuracy:
            warnings.append(
                f"lenslets beyond the coherent window change columns by about {window:.1g}, "
                f"more than the accuracy {request.accuracy:g}"
            )
    field_error, said = _over_the_field(request)
    if said:
        (warnings if field_error > request.accuracy else request.left_out).append(said)
    size = int(np.prod(request.shape)) * request.dtype.itemsize
    return PifPlan(
        model=best.model,
        rung=best.name,
        superpixels=request.superpixels,
        coherent_ring=best.ring,
        accuracy=request.accuracy,
        asked_by=request.asked_by,
        double=best.double,
        bands=best.bands,
        shape=request.shape,
        bytes=size,
        memory=best.bytes,
        estimated=best.error,
        split=best.sources,
        model_error=_model_error(request, best),
        field_error=field_error,
        dtype=request.dtype.name,
        reasons=tuple(request.reasons),
        left_out=tuple(request.left_out),
        warnings=tuple(warnings),
        candidates=table,
        pixel_shift=request.pixel_shift,
        chief=request.chief,
        band_nodes=best.band_nodes,
    )


def _model_error(request: _Request, best: Candidate) -> float:
    model = next(m for m in MODELS if m.name == best.name)
    error = _error_bound(request, model, best.ring)
    fitted = request.camera.fitted
    return error if fitted is None else math.hypot(error, fitted.model_error)


def _over_the_field(request: _Request) -> tuple[float, str | None]:
    """(error of one matrix where it serves the lenslet at the array's corner, a sentence about it);
    nothing of a matrix that is for one lenslet.
    """
    if request.corner is None:
        return 0.0, None
    there = [replace(v, chief=request.corner) for v in request.geometries]
    parabolic = request.camera.lenslet_array.profile == "parabolic"
    error = min(
        1.0,
        max(
            math.hypot(
                oblique_error(v, parabolic),
                pupil_change(request.camera, v.wavelength, request.corner),
            )
            for v in there
        ),
    )
    if error < BEST_ACCURACY:
        return 0.0, None
    angle = math.degrees(there[0].obliquity)
    return error, (
        f"one matrix for all lenslets: at the array's corner, {angle:.2g} degrees off the axis, "
        f"columns differ by about {error:.1g} (--lenslet ROW,COLUMN is for one there)"
    )


def seconds_here(candidate: Candidate) -> float:
    """Seconds of one core of this machine that a candidate will take."""
    return candidate.seconds(product_rate)


def _superpixels(
    asked: Superpixels, geometries: Sequence[Geometry], accuracy: float, reasons: list[str]
) -> tuple[int, int]:
    if asked != "auto":
        rows, columns = (int(n) for n in asked)
        if rows < 1 or columns < 1 or rows % 2 == 0 or columns % 2 == 0:
            raise UsageError(
                f"superpixels {rows}x{columns} are not centred on the object's lenslet",
                "superpixels",
                "give odd numbers such as 1x1 or 3x3",
            )
        reasons.append(f"superpixels {rows}x{columns} as asked")
        return rows, columns
    ring = max(blur_ring(geometry) for geometry in geometries)
    reasons.append(
        f"geometric blur {max(v.blur / v.D2 for v in geometries):.2f} lenslets: superpixels under "
        f"it kept, ring {ring}"
    )
    if accuracy < 0.05:
        wanted = ring
        while max(predicted_outside(v, wanted) for v in geometries) > 0.05 and wanted < ring + 4:
            wanted += 1
        if wanted > ring:
            reasons.append(
                f"ring {wanted} kept for diffraction: it leaves about "
                f"{max(predicted_outside(v, wanted) for v in geometries):.3f} of a corner point's "
                "light outside (limit 0.05)"
            )
        ring = wanted
    return 2 * ring + 1, 2 * ring + 1


def _warnings(request: _Request, best: Candidate) -> list[str]:
    geometry, superpixels, found = request.geometries[0], request.superpixels, []
    for axis, name in ((0, "rows"), (1, "columns")):
        size = geometry.pixel_shape[axis] * geometry.pixel_pitch
        spacing = geometry.superpixel_pitch * (1.0 if axis else geometry.row_spacing)
        if superpixels[axis] > 1 and size > spacing * (1 + 1e-9):
            found.append(
                f"windows of {geometry.pixel_shape[axis]} pixels overlap, as superpixels are "
                f"{spacing / geometry.pixel_pitch:.3f} pixels apart ({name}): light beyond the "
                "border between two counts for the nearer lenslet's window only"
            )
        elif request.pixel_shift is None and abs(size / spacing - 1) > 1e-4:
            found.append(
                f"superpixels are {spacing / geometry.pixel_pitch:.3f} pixels apart, not "
                f"{geometry.pixel_shape[axis]} ({name}): A is for the grid centred on each "
                "superpixel, not for one sensor raster (--lenslet)"
            )
    if request.model != "auto" and best.model != "exact":
        error = _model_error(request, best)
        if error > request.accuracy:
            found.append(
                f"accuracy {request.accuracy:.1g} holds within the {best.model} model as asked; "
                f"that model is off by about {error:.1g} itself"
            )
    if max(v.blur / (2 * v.D2) for v in request.geometries) > (min(superpixels) - 1) // 2 + 1e-9:
        found.append(
            "the geometric blur reaches beyond the superpixels kept: their light is "
            "missing from the columns"
        )
    return found


def system_matrix(
    camera: Camera, *, progress: Progress | None = None, **request: Any
) -> SystemMatrix:
    """Plan a system matrix and compute it; `request` as for plan_pif."""
    return build_pif(
        camera, plan_pif(camera, **request), points=request.get("points"), progress=progress
    )


def pif_builder(camera: Camera, wavelength: float, **request: Any) -> PifBuilder:
    """Columns of a system matrix on demand, as planned.

    wavelength: m;
    request: as for plan_pif.
    """
    return PifBuilder(
        camera,
        wavelength,
        plan_pif(camera, wavelengths=(wavelength,), **request),
        dtype=request.get("dtype", "float32"),
    )
