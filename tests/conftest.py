"""Fixtures shared by all tests."""

import gc
import os
from pathlib import Path

import pytest

from tests.messages import all_places, listen, shown_places


def pytest_addoption(parser):
    parser.addoption(
        "--campaign",
        action="store_true",
        help="run the fault campaigns in full (make faults), not a seeded share of them",
    )
    parser.addoption(
        "--new-transcript",
        action="store_true",
        help="write the transcript of refusals anew (tests/faults/transcript.txt)",
    )


def pytest_configure(config):
    """Note from the start where messages for users are made, so that the end of a run can say
    how many of them tests have seen.
    """
    listen(_reached.add)
    os.environ["PLENOCLI_CACHE"] = "off"
    gc.disable()  # thousands of tests are made, of which none is garbage: two fifths of the time


def pytest_collection_finish():
    gc.freeze()
    gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """What a test made plenocli say goes into its report."""
    _reached.clear()
    try:
        return (yield)
    finally:
        item.user_properties.append(("places", " ".join(_reached)))


_reached = set()


@pytest.fixture
def count(record_property):
    """count(what, **numbers): numbers that the end of the run shows, added up over all tests
    that say the same `what`.
    """
    return lambda what, **numbers: record_property("count", [what, numbers])


def pytest_terminal_summary(terminalreporter):
    """What the tests counted."""
    totals, reached = {}, set()
    for report in (
        r
        for found in terminalreporter.stats.values()
        for r in found
        if getattr(r, "when", None) == "call"
    ):
        reached.update(
            word
            for name, value in report.user_properties
            if name == "places"
            for word in value.split()
        )
        for what, numbers in (value for name, value in report.user_properties if name == "count"):
            kept = totals.setdefault(what, {"tests": 0})
            for name, number in {"tests": 1, **numbers}.items():
                kept[name] = kept.get(name, 0) + number
    if reached:
        shown = shown_places(reached)
        totals["messages for users that tests saw made"] = {
            "places": len(shown),
            "in the code": len(all_places()),
        }
        never = sorted(set(all_places()) - shown)
        if terminalreporter.verbosity > 0 or len(never) < 20:
            terminalreporter.line("never made: " + " ".join(never))
    if totals:
        terminalreporter.section("counts")
    for what, numbers in sorted(totals.items()):
        terminalreporter.line(
            f"{what}: "
            + ", ".join(f"{number} {name.replace('_', ' ')}" for name, number in numbers.items())
        )


@pytest.fixture(scope="session")
def shared_data():
    """Folder of real RAW, plenoptic and spectral data beside the project; tests that need
    it skip without it.
    """
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the real data folder is not here: {folder.name}")
    return folder
