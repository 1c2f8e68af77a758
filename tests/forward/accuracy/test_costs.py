"""Costs: what they are counted from (the columns that symmetry leaves, the separable terms of the
spread function), and that a fit finds the laws that made its cases.
"""

import dataclasses
import importlib
from pathlib import Path

import numpy as np
import pytest

from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.propagation import costs
from plenocli.forward.propagation.fresnel.shaped import _chord_counts, chords
from plenocli.forward.propagation.fresnel.spread_function import separable_field
from plenocli.forward.propagation.fresnel.spread_terms import expected_terms
from plenocli.forward.propagation.models import MODELS
from plenocli.forward.propagation.sampling import distinct
from plenocli.forward.propagation.system_matrix import PifBuilder
from tests.forward.propagation.cameras import small_camera

SAMPLES = Path(__file__).resolve().parents[3] / "sample_configs"
CHANGES = {
    "plain": {},
    "odd": {"object.samples_per_lenslet": (5, 5)},
    "oblong": {"object.samples_per_lenslet": (4, 6)},
    "oblong pixels": {"sensor.pixels_per_lenslet": (8, 6)},
    "coma": {"main_lens.aberrations": ({"noll": 8, "coefficient": 30e-9},)},
}


def counted(camera, plan):
    """Columns that a builder asks the lenslets' fields for: pairs of a superpixel and a point."""
    builder, asked = PifBuilder(camera, plan.bands[0].wavelength, plan), []
    original = builder.lenslets.on_superpixel

    def on_superpixel(sy, sx):
        energies = original(sy, sx)
        return lambda rows, columns, out: asked.append(len(rows)) or energies(rows, columns, out)

    builder.lenslets.on_superpixel = on_superpixel
    builder.fill(np.empty(plan.shape[1:]))
    return sum(asked)


@pytest.mark.parametrize("superpixels", [(1, 1), (3, 3)])
@pytest.mark.parametrize("name", CHANGES)
def test_columns_left_by_symmetry_are_those_computed(name, superpixels):
    camera = small_camera().replace(**CHANGES[name])
    plan = plan_pif(camera, model="fresnel", accuracy=1e-2, superpixels=superpixels)
    assert plan.rung == "fresnel, low rank"
    _, pairs = distinct(camera, geometry(camera, plan.bands[0].wavelength), plan.shape)
    # an aberrated pupil may have one mirror left, on which the plan does not count
    assert pairs == (2 if name == "coma" else 1) * counted(camera, plan)


@pytest.mark.parametrize(
    "half_pitches, tolerance", [(1, 1e-2), (1, 1e-5), (3, 1e-3), (3, 1e-7), (7, 1e-4), (7, 1e-8)]
)
def test_expected_terms_are_those_found(half_pitches, tolerance):
    camera = small_camera()
    view = geometry(camera, camera.light.wavelengths[0])
    half = half_pitches * view.D2 / 2
    found = separable_field(camera, view, half, tolerance).terms
    assert (
        abs(expected_terms(view.k * view.D1 / 2 * half / view.z2, tolerance) - found)
        <= 2 + 0.1 * found
    )


@pytest.mark.parametrize("shape", ["square", "circle", "hexagon"])
@pytest.mark.parametrize("slope, error", [(1e4, 1e-10), (3e5, 1e-6), (2e6, 1e-4)])
def test_chords_are_counted_as_they_are_made(shape, slope, error):
    cut = chords(shape, 200e-6, slope, error)
    assert _chord_counts(shape, 200e-6, slope, error) == (
        cut.axis,
        len(cut.at),
        cut.at.size,
        sum(x.size for x, _ in cut.pieces),
    )


@pytest.mark.parametrize("shape, lattice", [("circle", "square"), ("hexagon", "hexagonal")])
def test_chords_are_shared_by_the_points_of_a_line(shape, lattice):
    """What the cost of the triple product counts on: blocks of columns begin a line of points
    anew at their borders only.
    """
    camera = small_camera().replace(
        **{
            "lenslet_array.aperture_shape": shape,
            "lenslet_array.lattice": lattice,
            "lenslet_array.fill_factor": 0.9,
            "object.samples_per_lenslet": (9, 7),
            "main_lens.aberrations": ({"noll": 7, "coefficient": 30e-9},),
        }
    )
    plan = plan_pif(camera, model="fresnel", accuracy=1e-2, superpixels=(1, 1), coherent_ring=0)
    assert plan.rung == "fresnel, triple product"
    builder, begun, blocks = PifBuilder(camera, plan.bands[0].wavelength, plan), [], []
    spread, columns = builder.lenslets._spread, builder.lenslets.columns
    builder.lenslets._spread = lambda product, across, index: (
        begun.append(index) or spread(product, across, index)
    )
    builder.lenslets.columns = lambda *block: blocks.append(len(block[0])) or columns(*block)
    builder.fill(np.empty(plan.shape[1:]))
    assert len(blocks) > 4 and len(begun) <= len(set(begun)) + len(blocks)


def test_every_model_has_a_law_without_names_that_nothing_counts():
    laws = costs.read(costs.FITTED)
    assert laws.pop("spread function").counts
    assert laws.pop("diagnosis").seconds and laws.pop("whole command").seconds
    assert list(laws) == [model.name for model in MODELS]
    for law in laws.values():
        numbers = [*law.operations.values(), *law.seconds.values(), *law.bytes.values()]
        assert min(numbers) >= 0 and {"origin", "cases", "time_within_factor_2"} <= set(law.fit)


def test_a_cost_is_the_sum_of_its_features_and_the_highest_moment():
    law = costs.Law(operations={"a": 2.0}, seconds={"b": 0.5, "c": 1.0}, bytes={"d": 8.0})
    features = costs.Features({"a": 3}, {"b": 4, "c": 1}, ({"d": 1}, {"d": 5}))
    assert law.cost(features) == costs.Cost(6.0, 3.0, 40)
    assert costs.summed([{"a": 1.0, "b": 2.0}, {"b": 3.0}]) == {"a": 1.0, "b": 5.0}
    with pytest.raises(KeyError):
        law.cost(costs.Features({"unknown": 1}, {}, ({},)))


@pytest.fixture
def fit_costs(monkeypatch):
    monkeypatch.syspath_prepend(SAMPLES.parent / "pipelines" / "benchmarks")
    return importlib.import_module("fit_costs")


def test_a_file_of_laws_is_written_as_it_is_read(fit_costs, tmp_path):
    laws = costs.read(costs.FITTED)
    (tmp_path / "costs.toml").write_text(fit_costs.to_toml(laws))
    assert costs.read(tmp_path / "costs.toml") == laws


@pytest.mark.parametrize(
    "name, changed",
    [
        ("fresnel, low rank", ""),
        ("exact, low rank", "rank_joined"),
        ("spread function", "terms_by_phase"),
    ],
)
def test_a_fit_finds_the_law_that_made_its_cases(fit_costs, name, changed):
    laws, took = costs.read(costs.FITTED), {}
    model = "fresnel, low rank" if name == fit_costs.SPREAD else name
    law, terms = laws[name], laws[fit_costs.EXACT if model == fit_costs.EXACT else fit_costs.SPREAD]
    for scope in fit_costs.SCOPES:
        for camera in ("f/22", "20 um pixels", "10 um LWIR"):
            for accuracy in (1e-1, 1e-2, 1e-3):
                case = fit_costs.Case(model, scope, camera, accuracy)
                cost = laws[model].cost(fit_costs.features_of(case))
                counts = (*fit_costs.expected(case, terms.counts), 0.0)
                took[case] = fit_costs.Measured(
                    seconds=cost.operations / 5e10 + cost.seconds,
                    bytes=cost.bytes,
                    rate=5e10,
                    terms=counts[0],
                    products=counts[1],
                )
    other = dataclasses.replace(
        law,
        seconds={n: 3 * c for n, c in law.seconds.items()},
        bytes={n: 0.5 * c for n, c in law.bytes.items()},
        counts={n: 1.2 * c if n == changed else c for n, c in law.counts.items()},
    )
    before = fit_costs.residuals(name, other, took)
    after = fit_costs.residuals(name, fit_costs.refitted(name, other, took, 1e-6), took)
    for wrong, right in zip(*((r.times, r.memory, r.counts) for r in (before, after))):
        assert len(wrong) == len(right) and np.abs(right - 1).max(initial=0) < 0.02
    worst = np.concatenate([before.times, before.counts])
    assert np.abs(worst - 1).max() > 0.1
