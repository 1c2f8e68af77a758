"""Fixtures shared by all tests."""

from pathlib import Path

import pytest


def pytest_addoption(parser):
    parser.addoption("--campaign", action="store_true", help="run the fault campaigns in full (make faults), not a seeded share of them")


@pytest.fixture
def count(record_property):
    """count(what, **numbers): numbers that the end of the run shows, added up over all tests that say the same `what`."""
    return lambda what, **numbers: record_property("count", [what, numbers])


def pytest_terminal_summary(terminalreporter):
    """What the tests counted."""
    totals = {}
    for report in (r for found in terminalreporter.stats.values() for r in found if getattr(r, "when", None) == "call"):
        for what, numbers in (value for name, value in report.user_properties if name == "count"):
            kept = totals.setdefault(what, {"tests": 0})
            for name, number in {"tests": 1, **numbers}.items():
                kept[name] = kept.get(name, 0) + number
    if totals:
        terminalreporter.section("counts")
    for what, numbers in sorted(totals.items()):
        terminalreporter.line(f"{what}: " + ", ".join(f"{number} {name.replace('_', ' ')}" for name, number in numbers.items()))


@pytest.fixture(scope="session")
def shared_data():
    """Folder of real RAW, plenoptic and spectral data beside the project; tests that need it skip without it."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the real data folder is not here: {folder.name}")
    return folder
