"""The page of `view` in one file: panels as JSON, their numbers compressed, script and style."""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.base.text import printable_lines

UNKNOWN = 65535
"""Stands for NaN; other values are whole steps from the least to the largest of their array."""
KEYS = (
    ("← →", "focus, band, plane or column"),
    ("↑ ↓", "the wipe between two pictures, or the row of a slice"),
    (", .", "the plane of a volume"),
    ("w a s d", "another view through the pupil"),
    ("f p v", "refocus, stored planes, views"),
    ("x", "exchange the two pictures"),
    ("c", "clear the spectra"),
    ("+ -", "brighter, darker"),
    ("[ ]", "the panel before, the next one"),
    ("t", "light or dark"),
    ("?", "this list"),
)


def view_page(title: str, panels: Sequence[Any]) -> str:
    """The page as text; the same panels give the same bytes.

    panels: of plenocli.report.viewer.panels, in order.
    """
    folder = Path(__file__).parent
    style = (folder / "viewer.css").read_text(encoding="utf-8")
    script = (folder / "viewer.js").read_text(encoding="utf-8")
    content = json.dumps([_plain(panel) for panel in panels], allow_nan=False).replace(
        "<", "\\u003c"
    )
    name = html.escape(printable_lines(title))
    keys = "".join(f"<dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd>" for k, v in KEYS)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{name}</title><link rel="icon" href="data:,">\n<style>\n{style}</style></head>\n'
        f'<body><header><h1>{name}</h1><button id="theme" title="light or dark (t)">◐</button>'
        '<button id="help" title="keys (?)">?</button></header>\n'
        '<nav id="tabs"></nav><main id="panels"></main>\n'
        f'<dialog id="keys"><h2>Keys</h2><dl>{keys}</dl><p>Click a picture for the spectrum or '
        "the slices there; drag it for the wipe or another view.</p>"
        "<form method=dialog><button>close</button></form></dialog>\n"
        "<noscript>This page needs JavaScript; it asks no network for anything.</noscript>\n"
        f'<script type="application/json" id="content">{content}</script>\n'
        f"<script>\n{script}</script></body></html>\n"
    )


def _plain(value: Any) -> Any:
    """What JSON can hold: dataclasses as objects with their kind, arrays packed."""
    if is_dataclass(value) and not isinstance(value, type):
        named = {field.name: _plain(value.__dict__.get(field.name)) for field in fields(value)}
        return {"kind": type(value).__name__.lower(), **named}
    if isinstance(value, np.ndarray):
        return packed(value)
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return printable_lines(value) if isinstance(value, str) else value


def packed(values: np.ndarray) -> dict[str, Any]:
    """An array in 16 bits a value: `low` plus steps of (high - low) / 65534, NaN as UNKNOWN.

    values: any shape; infinite ones count as NaN.

    Returns shape, low, high, and data: base64 of the zlib stream of all low bytes, then all high
    bytes.
    """
    values = np.asarray(values, dtype=np.float64)
    known = np.isfinite(values)
    low, high = (
        (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
    )
    steps = np.full(values.shape, UNKNOWN, dtype="<u2")
    steps[known] = np.rint((values[known] - low) * (65534 / (high - low) if high > low else 0.0))
    both = steps.reshape(-1, 1).view(np.uint8).T
    return {
        "shape": list(values.shape),
        "low": low,
        "high": high,
        "data": base64.b64encode(zlib.compress(both.tobytes(), 9)).decode("ascii"),
    }
