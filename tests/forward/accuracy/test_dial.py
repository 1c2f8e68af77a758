"""The dial: it takes the cheapest model that serves, says why the others lost, and refuses
what cannot be had.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from plenocli.base.errors import NumericsError, UsageError
from plenocli.forward.accuracy import dial
from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.accuracy.explain import considered, duration, expectation, explain
from plenocli.forward.accuracy.scene_needs import SceneNeeds, sensor_noise
from plenocli.forward.propagation.costs import Cost
from plenocli.forward.propagation.sampling import size_band
from tests.forward.propagation.cameras import small_camera


@dataclass(frozen=True)
class FakeModel:
    """A model of known error and cost, which computes nothing."""

    name: str
    kind: str
    error: float
    operations: float
    reason: str | None = None
    least: float = 0.0

    def valid_for(self, camera, geometry):
        return self.reason

    def error_bound(self, camera, geometry, superpixels, ring):
        return self.error

    def size(self, camera, geometry, superpixels, ring, accuracy, tolerance):
        if accuracy < self.least:
            raise NumericsError("a million terms", "model", "ask for less")
        return size_band(camera, geometry, superpixels, ring, accuracy, tolerance)

    def cost(self, camera, geometry, band, shape, double):
        return Cost(self.operations * (2 if double else 1), 0.0, 1000)


@pytest.fixture
def ladder(monkeypatch):
    """Three models whose errors and costs are known: 0.1 for one second, 1e-3 for ten, 0 for a
    hundred (nominal, single precision).
    """
    models = (
        FakeModel("coarse", "ray", 0.1, 60e9),
        FakeModel("middle", "fresnel", 1e-3, 600e9),
        FakeModel("fine", "exact", 0.0, 6000e9),
    )
    monkeypatch.setattr(dial, "MODELS", models)


@pytest.mark.parametrize(
    "accuracy, chosen",
    [
        (0.2, "coarse"),
        (0.101, "middle"),
        (0.09, "middle"),
        (2e-3, "middle"),
        (9e-4, "fine"),
        (2e-4, "fine"),
    ],
)
def test_the_cheapest_model_that_serves_is_taken(ladder, accuracy, chosen):
    plan = plan_pif(small_camera(), accuracy=accuracy)
    assert plan.rung == chosen and plan.estimated <= accuracy
    assert math.hypot(*plan.split.values()) == pytest.approx(plan.estimated)
    table = {c["rung"]: c for c in considered(plan)}
    assert [name for name, c in table.items() if c["chosen"]] == [chosen]
    for name, error in (("coarse", 0.1), ("middle", 1e-3), ("fine", 0.0)):
        assert table[name]["split"]["model"] == error
        if error > accuracy:
            assert "model error" in table[name]["reason"]
    if accuracy == 0.2:
        assert (
            "10 times the cost" in table["middle"]["reason"]
            and "1e+02 times" in table["fine"]["reason"]
        )
    text = explain(plan)
    assert all(name in text for name in table) and "chosen" in text and "error by source" in text


def test_a_named_model_is_accurate_within_itself(ladder):
    plan = plan_pif(small_camera(), accuracy=1e-3, model="ray")
    assert plan.rung == "coarse" and plan.split["model"] == 0 and plan.model_error == 0.1
    assert any("off by about 0.1 itself" in warning for warning in plan.warnings)


def test_what_cannot_be_reached_is_refused_with_what_can(ladder):
    small = small_camera()
    with pytest.raises(NumericsError, match="best is about") as caught:
        plan_pif(small, accuracy=2e-7)
    best = float(str(caught.value).split("best is about ")[1].split()[0])
    assert 2e-7 < best < 1e-4 and "neighbourhood" in str(caught.value)
    # what the message promises can be had
    assert plan_pif(small, accuracy=1.05 * best).estimated <= 1.05 * best
    # isolated lenslets are the user's model, and have no such limit
    assert plan_pif(small, accuracy=1e-8, coherent_ring=0).estimated <= 1e-8


def test_default_accuracy_is_what_noise_lets_be_seen(ladder):
    camera = small_camera()
    assert plan_pif(camera).accuracy == pytest.approx(0.3 * sensor_noise(camera))
    assert sensor_noise(camera) == pytest.approx(math.sqrt(15000 + 16) / 15000)
    quiet = plan_pif(camera, needs=SceneNeeds(noise=1e-2, source="night.toml"))
    assert quiet.accuracy == pytest.approx(3e-3) and "night.toml" in quiet.asked_by
    # a finer accuracy asked for is not computed where noise hides it, and the plan says so
    hidden = plan_pif(camera, accuracy=1e-4, needs=SceneNeeds(noise=0.1, source="night.toml"))
    assert hidden.accuracy == pytest.approx(0.03) and any(
        "hides" in text for text in hidden.left_out
    )


def test_default_accuracy_falls_back_to_the_best_there_is(monkeypatch):
    monkeypatch.setattr(dial, "MODELS", (FakeModel("only", "fresnel", 0.05, 1e9),))
    plan = plan_pif(small_camera())
    assert (
        plan.rung == "only"
        and plan.accuracy > 0.05
        and any("best there is" in warning for warning in plan.warnings)
    )
    with pytest.raises(NumericsError, match="name a model"):
        plan_pif(small_camera(), accuracy=1e-3)
    wet = FakeModel("only", "fresnel", 0.0, 1e9, reason="it rains")
    monkeypatch.setattr(dial, "MODELS", (wet,))
    with pytest.raises(NumericsError, match="it rains"):
        plan_pif(small_camera(), accuracy=1e-3)


FAR_OUT = {
    "main_lens__aperture_diameter": 55e-3,
    "object__distance": 0.15,
    "lenslet_array__pitch": 60e-6,
    "sensor__pixels_per_lenslet": (3, 3),
    "sensor__pixel_pitch": 20e-6,
}


def test_a_field_that_cannot_be_sampled_is_left_to_rays_before_any_work():
    camera = small_camera(**FAR_OUT)
    plan = plan_pif(camera)
    assert (
        plan.rung == "rays"
        and plan.estimated <= plan.accuracy <= dial.COARSEST
        and any("best there is" in warning for warning in plan.warnings)
    )
    waves = [c for c in plan.candidates if c.model != "ray"]
    known = "nodes per axis", "not round or hexagonal", "left to separable terms"
    assert all(any(words in c.why for words in known) for c in waves)
    with pytest.raises(NumericsError, match="best is about 0.37"):
        plan_pif(camera, accuracy=1e-3)
    # nor is a default that has little to do with the camera taken silently
    with pytest.raises(NumericsError, match="no model comes nearer"):
        plan_pif(small_camera(**FAR_OUT, light__wavelengths=(2e-6,)))
    with pytest.raises(
        NumericsError, match="fresnel, low rank and fresnel, triple product: the field"
    ):
        plan_pif(camera, model="fresnel")


def test_what_too_many_terms_refuse_may_be_had_coarser(monkeypatch):
    """The message and the default name what the fine model can do, not the coarse one's error."""
    coarse = FakeModel("coarse", "ray", 0.7, 60e9)
    fine = FakeModel("fine", "exact", 0.0, 6000e9, least=0.0123)
    monkeypatch.setattr(dial, "MODELS", (coarse, fine))
    with pytest.raises(NumericsError, match="fine: a million terms") as caught:
        plan_pif(small_camera(), accuracy=1e-4)
    best = float(str(caught.value).split("best is about ")[1].split()[0])
    assert 0.0123 <= best < 0.016 and "name a model" not in str(caught.value)
    assert plan_pif(small_camera(), accuracy=best).rung == "fine"
    plan = plan_pif(small_camera())
    assert plan.rung == "fine" and 0.0123 <= plan.accuracy < 0.016


def test_a_scene_narrows_the_model(ladder):
    camera = small_camera(light__wavelengths=(450e-9, 550e-9, 650e-9))
    plan = plan_pif(
        camera, accuracy=1e-2, needs=SceneNeeds(spectrum=(500e-9, 700e-9), lenslets=(1, 2))
    )
    assert [b.wavelength for b in plan.bands] == [550e-9, 650e-9]
    assert any("1 of 3 wavelength" in text for text in plan.left_out) and any(
        "7 of 9 lenslets" in text for text in plan.left_out
    )
    # depth is a matter of several plans, each with the neighbourhood of its own distance
    assert (
        plan_pif(camera, accuracy=1e-2, needs=SceneNeeds(depth=(0.45, 0.55))).superpixels
        == plan_pif(camera, accuracy=1e-2).superpixels
    )
    # what has light only between two of the camera's wavelengths has some at both
    lamp = SceneNeeds(light=((430e-9, 480e-9, 520e-9, 800e-9), (0.0, 1.0, 0.0, 0.0)))
    assert [
        b.wavelength
        for b in plan_pif(
            small_camera(light__wavelengths=(450e-9, 500e-9, 550e-9)), accuracy=1e-2, needs=lamp
        ).bands
    ] == [450e-9, 500e-9]
    # light outside the camera's wavelengths changes nothing
    assert (
        len(plan_pif(camera, accuracy=1e-2, needs=SceneNeeds(spectrum=(900e-9, 1e-6))).bands) == 3
    )


def test_double_precision_and_storage_follow_the_accuracy(ladder):
    camera = small_camera()
    fine, coarse = (plan_pif(camera, accuracy=a, coherent_ring=0) for a in (1e-7, 1e-3))
    assert (
        fine.double and fine.dtype == "float64" and not coarse.double and coarse.dtype == "float32"
    )
    assert plan_pif(camera, accuracy=1e-3, dtype=np.float64).bytes == 2 * coarse.bytes


@pytest.mark.parametrize(
    "request_, error",
    [
        ({"model": "magic"}, UsageError),
        ({"coherent_ring": -1}, UsageError),
        ({"coherent_ring": 1.5}, UsageError),
        ({"superpixels": (2, 2)}, UsageError),
        ({"accuracy": 0.0}, NumericsError),
        ({"accuracy": 2.0}, NumericsError),
        ({"accuracy": float("nan")}, NumericsError),
    ],
    ids=str,
)
def test_refusals(ladder, request_, error):
    with pytest.raises(error):
        plan_pif(small_camera(), **request_)


def test_plans_do_not_depend_on_the_machine(ladder, monkeypatch):
    first = plan_pif(small_camera(), accuracy=1e-3)
    monkeypatch.setattr("plenocli.forward.accuracy.explain.seconds_here", lambda candidate: 1e9)
    assert plan_pif(small_camera(), accuracy=1e-3) == first
    assert replace(first) == first


def test_long_work_is_announced_with_what_would_take_less(ladder, monkeypatch):
    monkeypatch.setattr(
        "plenocli.forward.accuracy.explain.seconds_here", lambda candidate: 2 * candidate.seconds()
    )
    camera = small_camera()
    assert expectation(plan_pif(camera, accuracy=2e-3)) is None  # ten seconds
    assert (
        expectation(plan_pif(camera, accuracy=2e-3), times=3)
        == "about 60 s on one core (middle, error 0.001); --model ray takes 6 s at an error of 0.1"
    )
    assert expectation(plan_pif(camera, accuracy=2e-4), 3 << 30) == (
        "about 3.3 min on one core and 3.00 GiB of memory (fine, error 0.0001); --model "
        "fresnel takes 20 s at an error of 0.001"
    )
    assert (
        expectation(plan_pif(camera, accuracy=2e-3, model="fresnel"), times=3)
        == "about 60 s on one core (middle, error 0.002)"
    )


@pytest.mark.parametrize(
    "seconds, words",
    [
        (0.0123, "0.012 s"),
        (9.96, "10 s"),
        (99.4, "99 s"),
        (99.6, "1.7 min"),
        (5969, "99 min"),
        (5971, "1.7 h"),
        (71.4 * 3600, "71 h"),
        (1e7, "116 days"),
    ],
)
def test_durations_as_people_say_them(seconds, words):
    assert duration(seconds) == words
