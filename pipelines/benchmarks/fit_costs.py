"""What one of each thing that a model counts costs, measured and fitted anew:
plenocli/forward/propagation/costs.toml.

Cases are drawn from the cameras of the measured trade (tradeoff_truth.CAMERAS) and from the sample
configurations, or at random (--foreign), for every model, isolated and with neighbours, at several
accuracies, until the budget is spent. Each is computed in a process of its own on one core; its
processor time, its memory and the numbers of terms that were found are kept. The numbers of the
laws that expect terms are fitted to the logarithm of what was found; then the coefficients, none
below 0, to the relative error of times and of memory. Both are drawn to the present file as if it
were so many further cases, so that features of which few cases tell do not run away. Run
from the project's root: python pipelines/benchmarks/fit_costs.py --help.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import math
import os
import platform
import random
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from multiprocessing import get_context
from pathlib import Path

from tradeoff import _resident, forced, request_of  # first: it keeps the products to one core
from tradeoff_truth import CAMERAS, ROOT, camera_of  # makes tests importable

# ruff: isort: split
import numpy as np
from scipy.optimize import least_squares, nnls

from plenocli.base.errors import NumericsError
from plenocli.files.config.camera_file import load_camera
from plenocli.forward.accuracy import dial
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.camera.model import Camera
from plenocli.forward.propagation import costs
from plenocli.forward.propagation.costs import Features, Law, priced
from plenocli.forward.propagation.exact import cost_law, openings
from plenocli.forward.propagation.exact.term_counts import ExactBand, TermLaw
from plenocli.forward.propagation.fresnel import shaped, square_cost
from plenocli.forward.propagation.fresnel.spread_terms import SpreadLaw
from plenocli.forward.propagation.harmonics import cost_law as harmonic_cost
from plenocli.forward.propagation.plan import NOMINAL_RATE
from plenocli.forward.propagation.ray import rays
from plenocli.forward.propagation.system_matrix import PifBuilder
from tests.forward.propagation import foreign

EXACT, SPREAD = "exact, low rank", "spread function"
HARMONICS, OPENINGS = "exact, harmonics", "exact, openings"
SHAPES: dict[str, dict[str, object]] = {
    ", round": {"lenslet_array.aperture_shape": "circle"},
    ", hexagonal": {
        "lenslet_array.aperture_shape": "hexagon",
        "lenslet_array.lattice": "hexagonal",
    },
}
"""What follows the name of a camera that is given other lenslets than square ones, for a model that
is for these.
"""
FEATURES: dict[str, tuple[str, Callable[..., Features]]] = {
    "rays": ("ray", rays.features),
    "fresnel, low rank": ("fresnel", square_cost.features),
    "fresnel, triple product": ("fresnel", shaped.features),
    EXACT: ("exact", cost_law.features),
    HARMONICS: ("exact", harmonic_cost.features),
    OPENINGS: ("exact", openings.features),
}
"""Name of a model in the file: name in a request, what counts its features."""
SAMPLES = ("hexagonal", "demo_spatial", "demo_spectral", "dslr", "tiny")
FOREIGN, MORE = 1000, (1, 2, 4)
"""Cameras of a seed of --foreign, and how many times as many points along an axis they get in turn:
those of the tests have few.
"""
ACCURACIES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-7)
SCOPES = ("isolated", "neighbours")
LEAST_BYTES = 32 << 20
"""Memory below which an allocator's habits count for more than what is held."""


@dataclass(frozen=True)
class Case:
    """One matrix: `camera` a name, `model` as in the file, `scope` isolated or neighbours."""

    model: str
    scope: str
    camera: str
    accuracy: float


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What a case took.

    seconds: processor time;
    bytes: resident memory beyond the result;
    rate: of matrix products at its precision, real operations a second;
    terms: of the spread function, of an exact case the most that any superpixel had;
    products: pairs of terms, most that any superpixel had, 0 of paraxial cases.
    """

    seconds: float
    bytes: float
    rate: float
    terms: float
    products: float

    @property
    def counts(self) -> tuple[float, ...]:
        """What the laws of terms expect."""
        return (self.terms, self.products) if self.products else (self.terms,)


# measuring


@cache
def camera_named(name: str) -> Camera:
    """A camera of the table or a sample, of its first wavelength alone."""
    shape = next((end for end in SHAPES if name.endswith(end)), "")
    plain = name.removesuffix(shape)
    if plain in CAMERAS:
        camera = camera_of(plain)
    elif plain.startswith("foreign"):
        seed, number = map(int, plain.split()[1:])
        camera = foreign.case(seed, number)[0]
        points = tuple(n * MORE[number % len(MORE)] for n in camera.object.samples_per_lenslet)
        camera = camera.replace(**{"object.samples_per_lenslet": points})
    else:
        camera = load_camera(ROOT / "sample_configs" / f"{plain}.toml")
    if shape:
        camera = camera.replace(**SHAPES[shape])
    return camera.replace(**{"light.wavelengths": camera.light.wavelengths[:1]})


@cache
def plan_of(case: Case) -> dial.PifPlan:
    """The plan of a case; NumericsError or UsageError where it has none."""
    cheapest = dial._cheapest
    forced(case.model)
    try:
        plan = dial.plan_pif(
            camera_named(case.camera),
            accuracy=case.accuracy,
            **request_of(FEATURES[case.model][0], case.scope),
        )
    except ValueError as error:  # a candidate that cannot be sized has no error by source
        raise NumericsError(f"{case.model} does not serve {case.camera}", "model", "") from error
    finally:
        dial._cheapest = cheapest
    return plan


def features_of(case: Case, **numbers: TermLaw) -> Features:
    """What the matrix of a case consists of."""
    plan, camera = plan_of(case), camera_named(case.camera)
    view = geometry(camera, plan.bands[0].wavelength, plan.pixel_shift)
    count = FEATURES[case.model][1]
    return count(camera, view, plan.bands[0], plan.shape, plan.double, **numbers)


def expected(case: Case, counts: Mapping[str, float]) -> tuple[float, ...]:
    """Terms, of an exact case also pairs of terms, that it is expected to have by `counts`."""
    plan, camera = plan_of(case), camera_named(case.camera)
    view = geometry(camera, plan.bands[0].wavelength, plan.pixel_shift)
    if case.model != EXACT:
        phase = view.k * view.D1 / 2 * plan.bands[0].half / view.z2
        return (SpreadLaw(**counts).terms(phase, plan.bands[0].spread_cut),)
    assert isinstance(plan.bands[0], ExactBand)
    # most terms, and most pairs of terms that they are compressed from, of any superpixel
    window = cost_law.superpixels_of(plan.shape[1])
    sizes = cost_law._sizes(camera, view, plan.bands[0], window, TermLaw(**counts))
    aside = [kind.aside for kind in sizes.kinds]
    return max(sizes.ranks[n] for n in aside), max(sizes.products[n] for n in aside)


def measure(case: Case) -> Measured | None:
    """What a case takes in this process; None where it is refused on the way."""
    plan, camera = plan_of(case), camera_named(case.camera)
    dial.product_rate.cache_clear()
    rate, before = dial.product_rate(plan.double), _resident(reset=True)
    start = time.process_time()
    try:
        builder = PifBuilder(camera, plan.bands[0].wavelength, plan, dtype=plan.dtype)
        builder.fill(np.empty(plan.shape[1:], plan.dtype))
    except NumericsError:
        return None
    seconds = time.process_time() - start
    notes = builder.notes
    return Measured(
        seconds=seconds,
        bytes=_resident() - before - plan.bytes,
        rate=rate,
        terms=float(notes.separable_terms),
        products=float(notes.products) if case.model == EXACT else 0.0,
    )


def drawn(most: float, seed: int, strangers: int | None) -> Iterator[Case]:
    """All cases expected to take at most `most` seconds, at random, models and scopes in turn; with
    a seed of `strangers` of these cameras alone.
    """
    chance, groups = random.Random(seed), []
    for model in FEATURES:
        for scope in SCOPES:
            ends = SHAPES if model in (HARMONICS, OPENINGS) else [""]
            names = [camera + end for camera in (*CAMERAS, *SAMPLES) for end in ends]
            if strangers is not None:
                names = [f"foreign {strangers} {number}" for number in range(FOREIGN)]
            group = [Case(model, scope, c, a) for c in names for a in ACCURACIES]
            chance.shuffle(group)
            groups.append(group)
    laws = costs.read(costs.FITTED)
    for turn in zip_longest(*groups):
        for case in turn:
            try:
                known = case is not None and laws[case.model].cost(features_of(case))
            except NumericsError:
                continue
            if known and known.seconds + known.operations / NOMINAL_RATE[False] <= most:
                yield case


def measured_cases(options: argparse.Namespace) -> dict[Case, Measured]:
    """Cases with what they took: those of the file KEEP, and new ones until the budget is spent."""
    keep, found = options.keep, {}
    if keep and keep.exists():
        for row in json.loads(keep.read_text()):
            case = Case(**{f.name: row.pop(f.name) for f in dataclasses.fields(Case)})
            found[case] = Measured(**row)
    spent, start = 0.0, time.monotonic()
    for case in drawn(options.most, options.seed, options.foreign) if options.budget > 0 else ():
        if case in found or (options.model and case.model not in options.model):
            continue
        # a fork has the imports but nothing that a matrix leaves behind
        with ProcessPoolExecutor(1, get_context("fork")) as pool:
            try:
                took = pool.submit(measure, case).result()
            except (BrokenProcessPool, MemoryError):
                took = None
        if took is not None:
            found[case], spent = took, spent + took.seconds
        if time.monotonic() - start > options.budget:
            break
    print(f"{len(found)} cases; {spent:.0f} s of processor time in matrices measured now")
    if keep:
        rows = [dataclasses.asdict(c) | dataclasses.asdict(m) for c, m in found.items()]
        keep.write_text(json.dumps(rows, indent=1) + "\n")
    return found


# fitting


def fitted_counts(law: Law, cases: Mapping[Case, Measured], prior: float) -> dict[str, float]:
    """Numbers of the laws of terms, fitted to those found; `prior` in cases."""
    names = [n for n in law.counts if n not in HELD]
    start = np.array([law.counts[n] for n in names])

    def missed(logs: np.ndarray) -> np.ndarray:
        numbers = dict(law.counts) | dict(zip(names, start * np.exp(logs)))
        found = [math.sqrt(prior) * logs]
        for case, took in counting(cases).items():
            found.append(np.log(np.divide(expected(case, numbers), took.counts)))
        return np.concatenate(found)

    logs = least_squares(missed, np.zeros(len(names)), loss="soft_l1", f_scale=0.2).x
    return dict(law.counts) | dict(zip(names, map(_rounded, start * np.exp(logs))))


def counting(cases: Mapping[Case, Measured]) -> dict[Case, Measured]:
    """Cases with a round pupil without filters: the laws do not know of others."""
    return {
        c: t
        for c, t in cases.items()
        if t.terms > 0
        and camera_named(c.camera).filter_array is None
        and camera_named(c.camera).main_lens.aperture_shape == "circle"
    }


HELD = {"coarsest_cut", "separable_pupil", "lenslets_coarse", "lenslets_a_decade", "nodes_beside"}
"""Numbers of these laws that the terms found say nothing of."""


def fitted(rows: list[dict[str, float]], present: Mapping[str, float], prior: float) -> dict:
    """Coefficients that make the features of each row, divided by what was measured, sum to 1."""
    names = list(present)
    table = np.array([[row.get(n, 0.0) * present[n] for n in names] for row in rows])
    pull = math.sqrt(prior) * np.eye(len(names))
    right = np.concatenate([np.ones(len(rows)), math.sqrt(prior) * np.ones(len(names))])
    factors, _ = nnls(np.concatenate([table.reshape(-1, len(names)), pull]), right)
    return {n: _rounded(f * present[n]) for n, f in zip(names, factors)}


def _rounded(value: float) -> float:
    """To four digits: measurements bear no more."""
    return float(f"{value:.4g}")


def refitted(model: str, law: Law, cases: Mapping[Case, Measured], prior: float) -> Law:
    """The Law of a model by these cases."""
    counts = dict(law.counts)
    if model in (EXACT, SPREAD):
        counts = fitted_counts(law, cases, prior)
    if model == SPREAD:
        return Law(counts=counts, fit=described(cases))
    times, memory = [], []
    for case, took in cases.items():
        found = counted(model, case, counts)
        products = {"*" + n: v / took.rate for n, v in found.operations.items()}
        times.append({n: v / took.seconds for n, v in (products | dict(found.seconds)).items()})
        highest = max(found.bytes, key=lambda moment: priced(law.bytes, moment))
        held = max(took.bytes, LEAST_BYTES)
        # what is little is as good as any other little
        if max(took.bytes, priced(law.bytes, highest)) > LEAST_BYTES:
            memory.append({n: v / held for n, v in highest.items()})
    starred = {"*" + n: c for n, c in law.operations.items()}
    both = fitted(times, starred | dict(law.seconds), prior)
    return Law(
        operations={n: both["*" + n] for n in law.operations},
        seconds={n: both[n] for n in law.seconds},
        bytes=fitted(memory, law.bytes, prior),
        counts=counts,
        fit=described(cases),
    )


def counted(model: str, case: Case, counts: Mapping[str, float]) -> Features:
    """The features of a case where terms are expected by `counts`."""
    return features_of(case, numbers=TermLaw(**counts)) if model == EXACT else features_of(case)


def described(cases: Mapping[Case, Measured]) -> dict[str, object]:
    """Origin of a fit: how many cases, on what machine, when."""
    return {
        "origin": "pipelines/benchmarks/fit_costs.py",
        "date": datetime.date.today().isoformat(),
        "machine": f"{os.cpu_count()} cores, {processor()}",
        "cases": len(cases),
        "seconds": round(sum(took.seconds for took in cases.values()), 1),
    }


def processor() -> str:
    """The processor's model."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


# residuals


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """Estimated over measured, of each case: times, memory where it is more than a little, and
    counts of terms and their products.
    """

    times: np.ndarray
    memory: np.ndarray
    counts: np.ndarray

    def as_toml(self) -> dict[str, object]:
        """What the file says of them."""
        found: dict[str, object] = {}
        if len(self.times):
            found["time_within_factor_2"] = within(self.times)
            found["estimated_over_measured"] = [
                round(float(self.times.min()), 3),
                round(float(self.times.max()), 3),
            ]
        if len(self.memory):
            found["memory_within_factor_2"] = within(self.memory)
        if len(self.counts):
            found["counts_within_factor_2"] = within(self.counts)
        return found


def residuals(model: str, law: Law, cases: Mapping[Case, Measured]) -> Residuals:
    """How a Law fares on these cases."""
    times, memory, counts = [], [], []
    for case, took in cases.items() if model in FEATURES else ():
        cost = law.cost(counted(model, case, law.counts))
        times.append((cost.operations / took.rate + cost.seconds) / took.seconds)
        if max(took.bytes, cost.bytes) > LEAST_BYTES:
            memory.append(cost.bytes / max(took.bytes, LEAST_BYTES))
    for case, took in counting(cases).items() if model in (EXACT, SPREAD) else ():
        counts += list(np.divide(expected(case, law.counts), took.counts))
    return Residuals(times=np.array(times), memory=np.array(memory), counts=np.array(counts))


def within(ratios: np.ndarray, factor: float = 2.0) -> float:
    """Share of ratios within a factor of 1."""
    return round(float(np.mean(np.abs(np.log(ratios)) <= math.log(factor))), 3)


def row(label: str, ratios: np.ndarray) -> str:
    """One line of the table."""
    if not len(ratios):
        return f"{label:38s} {0:5d}"
    spread = (ratios.min(), np.median(ratios), ratios.max())
    return f"{label:38s} {len(ratios):5d} {within(ratios):8.3f} " + "".join(
        f"{value:8.2f}" for value in spread
    )


def table(model: str, file: str, found: Residuals) -> list[str]:
    """Lines of the table about one Law."""
    parts = {"time": found.times, "memory": found.memory, "terms": found.counts}
    return [row(f"{model}, {file}, {part}", r) for part, r in parts.items() if len(r)]


# the file

HEAD = """\
# What one of each feature of a model costs (plenocli.forward.propagation.costs): operations in
# complex matrix products, seconds of one core for the rest, bytes beyond the result; `counts` are
# numbers of the laws that expect counts. Written by pipelines/benchmarks/fit_costs.py.
"""


def to_toml(laws: Mapping[str, Law]) -> str:
    """The text of the file."""
    lines = [HEAD]
    for model, law in laws.items():
        name = model if model.isalnum() else json.dumps(model)
        for part in ("fit", "operations", "seconds", "bytes", "counts"):
            values = getattr(law, part)
            if values:
                lines += [
                    f"[{name}.{part}]",
                    *(f"{k} = {json.dumps(v)}" for k, v in values.items()),
                ]
                lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--budget", type=float, default=600.0, help="seconds to measure for")
    parser.add_argument("--most", type=float, default=20.0, help="longest case, in seconds")
    parser.add_argument("--prior", type=float, default=0.3, help="cases that the file counts as")
    parser.add_argument("--seed", type=int, default=0, help="of the draw of cases")
    parser.add_argument("--foreign", type=int, help="cameras at random instead, by this seed")
    parser.add_argument(
        "--model", action="append", choices=list(FEATURES), help="only this one (repeatable)"
    )
    parser.add_argument(
        "--keep", type=Path, help="JSON file of what was measured, read and added to"
    )
    parser.add_argument("--out", type=Path, default=costs.FITTED, help="file that is written")
    parser.add_argument(
        "--check",
        action="store_true",
        help="compare the present file with measurements, write none",
    )
    options = parser.parse_args()
    cases, laws = measured_cases(options), costs.read(costs.FITTED)
    print(f"{'':38s} cases within 2  least  median    most (estimated over measured)")
    for model, law in list(laws.items()):
        models = ("fresnel, low rank", "fresnel, triple product") if model == SPREAD else (model,)
        own = {case: took for case, took in cases.items() if case.model in models}
        if not own:
            continue
        print(*table(model, "present", residuals(model, law, own)), sep="\n")
        if not options.check:
            new = refitted(model, law, own, options.prior)
            found = residuals(model, new, own)
            laws[model] = dataclasses.replace(new, fit={**new.fit, **found.as_toml()})
            print(*table(model, "fitted", found), sep="\n")
    if not options.check:
        options.out.write_text(to_toml(laws))


if __name__ == "__main__":
    main()
