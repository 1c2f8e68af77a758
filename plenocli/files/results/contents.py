"""What two files of one kind say differently, value by value."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.files.artefacts.container import Artefact

_LONG = 60
"""Characters of a value that are shown."""


def artefact_contents(artefact: Artefact) -> dict[str, Any]:
    """Name -> array, number or text, of all that an artefact holds."""
    origin = artefact.provenance
    return {
        **artefact.data,
        **{
            f"{where}.{name}".lstrip("/"): value
            for where, named in artefact.attrs.items()
            for name, value in named.items()
        },
        "provenance.command": origin.command,
        "provenance.config": origin.config,
        "provenance.seed": origin.seed,
        **dict(_flat(origin.inputs, "provenance.inputs")),
        **dict(_flat(origin.accuracy, "provenance.accuracy")),
    }


def file_contents(path: Path) -> dict[str, Any]:
    """Name -> array, number or text, of all that an EXR, DNG, JSON or TIFF volume holds.

    Raises InputError where it cannot be read.
    """
    from plenocli.files.images.dng import read_notes
    from plenocli.files.images.exr import SEALED, read_exr
    from plenocli.files.images.mosaic import read_capture
    from plenocli.files.images.pictures import file_type
    from plenocli.files.images.tiff_stack import read_tiff_volume
    from plenocli.files.results.scores import read_sealed_json

    if path.suffix.lower() == ".json":
        return _unsealed(dict(_flat(read_sealed_json(path) or {}, "")))
    if path.name.lower().endswith((".ome.tif", ".ome.tiff")):
        volume = read_tiff_volume(path)
        return {"volume": volume.value, "step": volume.step, "spacing": volume.spacing}
    if file_type(path) == "exr":
        channels, attrs = read_exr(path)
        return {**channels, **{k: v for k, v in attrs.items() if k != SEALED}}
    capture = read_capture(path)
    return {"mosaic": capture.mosaic, **_unsealed(dict(_flat(read_notes(path), "")))}


def _unsealed(found: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in found.items() if name != "seal"}


def changes(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """A line for each name whose value differs, is new or gone."""
    lines = [f"{name} is gone" for name in before if name not in after]
    lines += [f"{name} is new" for name in after if name not in before]
    for name in before.keys() & after.keys():
        old, new = before[name], after[name]
        if isinstance(old, np.ndarray) or isinstance(new, np.ndarray):
            lines += _arrays(name, np.asarray(old), np.asarray(new))
        elif old != new:
            lines.append(f"{name}: {_short(old)} -> {_short(new)}")
    return sorted(lines)


def _arrays(name: str, old: np.ndarray, new: np.ndarray) -> list[str]:
    if old.shape != new.shape or old.dtype.kind != new.dtype.kind:
        return [f"{name}: {old.dtype}{list(old.shape)} -> {new.dtype}{list(new.shape)}"]
    numbers = old.dtype.kind in "fc"
    other = ~((old == new) | ((old != old) & (new != new))) if numbers else old != new
    count = int(np.count_nonzero(other))
    if not count:
        return []
    first = tuple(int(i) for i in np.argwhere(other)[0])
    where = f" {list(first)}" if first else ""
    told = f"{_short(old[first])} -> {_short(new[first])}"
    return [
        f"{name}: {count} of {old.size} values, first{where} {told}" if where else f"{name}: {told}"
    ]


def _short(value: Any) -> str:
    text = str(value.decode(errors="replace") if isinstance(value, bytes) else value)
    return text if len(text) <= _LONG else text[: _LONG - 3] + "..."


def _flat(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    """JSON's leaves by dotted name."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _flat(part, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list):
        for number, part in enumerate(value):
            yield from _flat(part, f"{name}[{number}]")
    else:
        yield (
            name,
            value if isinstance(value, (str, int, float, type(None))) else json.dumps(str(value)),
        )
