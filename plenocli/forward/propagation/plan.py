"""The plan of a system matrix: which model, with which node counts, and what else was considered.

The dial makes plans (plenocli.forward.accuracy.dial), the builder carries them out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from plenocli.base.budget import budget
from plenocli.forward.propagation.accuracy_record import AccuracyRecord

NOMINAL_RATE = {False: 60e9, True: 30e9}
"""Real operations a second of one core in complex matrix products, single and double precision:
plans are chosen by these, so that a file does not depend on the machine that made it.
"""


@dataclass(frozen=True, kw_only=True)
class BandPlan:
    """Node counts of one wavelength.

    wavelength: m;
    window: coherent lenslets on either side, see sampling.coherent_window;
    lenslet_nodes, pixel_nodes, psf_nodes: per axis across a lenslet, a pixel and the interval on
        which the spread function is needed;
    terms: separable ones that the spread function is expected to have;
    half: half width (m) of that interval;
    sampling: estimated relative error of the worst column from these counts;
    pixel_rule: which rule the pixels' nodes follow (quadrature.band_rule);
    beside: nodes and rule on superpixels beside the object's own, where these are fewer;
    spread_cut: root energy that may be cut from the spread function;
    faintest: root of the dimmest point's light, over that of lenslets without gaps.
    """

    wavelength: float
    window: int | None
    lenslet_nodes: int
    pixel_nodes: int
    psf_nodes: int
    terms: int
    half: float
    sampling: float = 0.0
    pixel_rule: int = 0
    beside: tuple[int, int] | None = None
    spread_cut: float = 1e-5
    faintest: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One model as it was considered.

    name: of the model; model: its kind, "ray", "fresnel" or "exact";
    why: it was not chosen, None where it was;
    error: estimated relative L2 error of the worst column, of which `split` names the parts by
        source, None where the model cannot serve at all;
    ring: of coherent neighbours;
    sampling: accuracy that its node counts are for;
    double: precision of the fields;
    bands: node counts by wavelength;
    operations: real ones in matrix products, fixed_seconds: of one core for all else;
    bytes: result and work;
    band_nodes: wavelengths that stand for a band of light, 0 for lines.
    """

    name: str
    model: str
    why: str | None
    error: float = math.inf
    split: dict[str, float] | None = None
    ring: int = 0
    sampling: float = 0.0
    double: bool = False
    bands: tuple[BandPlan, ...] = ()
    operations: float = 0.0
    fixed_seconds: float = 0.0
    bytes: int = 0
    band_nodes: int = 0

    @property
    def sources(self) -> dict[str, float]:
        """`split` of a candidate whose error is known; ValueError for another."""
        if self.split is None:
            raise ValueError(f"{self.name} without an error")
        return self.split

    def seconds(self, rate: Callable[[bool], float] | None = None) -> float:
        """Seconds of one core, at the nominal rate or at `rate` (double -> operations a second)."""
        return (
            self.operations / (rate(self.double) if rate else NOMINAL_RATE[self.double])
            + self.fixed_seconds
        )


@dataclass(frozen=True, kw_only=True)
class PifPlan:
    """The computation that was chosen.

    model: kind of propagation, "ray", "fresnel" or "exact";
    rung: name of the model, one of models.MODELS;
    superpixels: (rows, columns), odd numbers;
    coherent_ring: rings of lenslets beyond the superpixels kept and the blur whose fields add, too
        (sampling.coherent_window), 0 for isolated lenslets;
    accuracy: as asked or found, by `asked_by`;
    double: precision of the fields;
    bands: node counts by wavelength;
    shape: (band, superpixel, pixel, point) of the matrix;
    bytes: of the result;
    memory: bytes with the work;
    estimated: relative L2 error of the worst column, of which `split` names the parts by source;
    model_error: of the model itself against the finest one, whether asked for by name or not;
    field_error: of the matrix where it serves the lenslet at the array's corner, 0 where it is for
        one lenslet only;
    dtype: of the stored matrix;
    reasons, left_out, warnings: a sentence each;
    candidates: the models considered;
    pixel_shift: of an off-axis lenslet on the sensor's own raster
        (plenocli.forward.camera.geometry.lenslet_shift), None where windows are centred;
    chief: where that lenslet stands from the axis, m (rows, columns);
    band_nodes: wavelengths that stand for the camera's band of light, 0 for lines;
    device: where the products of an exact model are compressed, as plenocli.base.device names it.
    """

    model: str
    rung: str
    superpixels: tuple[int, int]
    coherent_ring: int
    accuracy: float
    asked_by: str
    double: bool
    bands: tuple[BandPlan, ...]
    shape: tuple[int, int, int, int]
    bytes: int
    memory: int
    estimated: float
    split: dict[str, float]
    model_error: float
    field_error: float = 0.0
    dtype: str = "float32"
    reasons: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    pixel_shift: tuple[float, float] | None = None
    chief: tuple[float, float] = (0.0, 0.0)
    band_nodes: int = 0
    device: str = "cpu"

    @property
    def chosen(self) -> Candidate:
        """The candidate that is carried out."""
        return next(c for c in self.candidates if c.why is None)

    @property
    def at_once(self) -> int:
        """Superpixels that a matrix is set up for at the same time: an exact one's on as many
        threads as the budget has, where its memory holds the work of each beside the result.
        """
        if self.model != "exact":
            return 1
        work, room = max(1, self.memory - self.bytes), budget().memory - 2 * self.bytes
        return max(1, min(budget().threads, self.shape[1], room // work))

    def accuracy_record(self) -> AccuracyRecord:
        """What a result of this plan says of its accuracy."""
        return AccuracyRecord(
            asked=self.accuracy,
            asked_by=self.asked_by,
            estimated=self.estimated,
            by_source=self.split,
            model=self.model,
            model_error=self.model_error,
            field_error=self.field_error,
            rung=self.rung,
            reasons=(*self.reasons, *self.warnings),
            left_out=tuple(self.left_out),
        )
