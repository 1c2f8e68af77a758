"""Processor seconds of the points of a sweep: measured, and so in a file of their own beside the
table, which is the same on every run: among the parts of the sweep.
"""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError

NOT_INVERTED = ("capture-sim cpu_s", "score cpu_s")
"""Stages that a person with a camera has no need of: a capture is there, its truth is not."""


def measured_path(table: Path) -> Path:
    """Where the seconds of a table lie."""
    return table.with_suffix(".parts") / "measured.csv"


def read_measured(table: Path, points: int) -> Mapping[str, np.ndarray] | None:
    """Seconds of each stage of the points of a table, NaN where there are none; None without the
    file.

    points: how many the table has.

    Raises InputError for a file that is not of this table.
    """
    path = measured_path(table)
    if not path.is_file():
        return None
    try:
        with open(path, newline="", encoding="utf-8") as file:
            head, *rows = csv.reader(file)
        found = [[float(cell) if cell else np.nan for cell in row] for row in rows]
        columns = np.array(found, float).reshape(len(rows), len(head)).T
    except (ValueError, OSError, csv.Error) as error:
        raise InputError(f"is no table of seconds ({error})", path, "run sweep again") from None
    if columns.shape[1] != points or not np.array_equal(columns[0], np.arange(points)):
        raise InputError("is not of this table", path, "run sweep again")
    return dict(zip(head[1:], columns[1:]))


def inversion_seconds(measured: Mapping[str, np.ndarray]) -> np.ndarray:
    """(point,) seconds of all stages from the camera's description and its capture to the result:
    without the capture's own and the score's. NaN where nothing was measured.
    """
    kept = [values for stage, values in measured.items() if stage not in NOT_INVERTED]
    spent = np.array(kept)
    return np.where(np.isfinite(spent).any(axis=0), np.nansum(spent, axis=0), np.nan)
