"""Fixtures shared by all tests."""

from pathlib import Path

import pytest


def pytest_addoption(parser):
    parser.addoption("--campaign", action="store_true", help="run the fault campaigns in full (make faults), not a seeded share of them")


@pytest.fixture(scope="session")
def shared_data():
    """Folder of real RAW, plenoptic and spectral data beside the project; tests that need it skip without it."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the real data folder is not here: {folder.name}")
    return folder
