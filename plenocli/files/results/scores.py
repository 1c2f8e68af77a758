"""Score documents from their JSON, part by part: what is missing is left out, what is nonsense is
refused.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from plenocli.base.errors import InputError
from plenocli.evaluation.metrics.figures import Figure
from plenocli.evaluation.scores import InputFile, PatchScore, ResultScore, ScoreDocument
from plenocli.files.seal import SEAL, require_seal

PATCHES = 24
"""Of a ColorChecker."""


class _Nonsense(ValueError):
    """A part of a document that cannot be what it should be."""


def json_pieces(document: Mapping[str, Any]) -> list[bytes]:
    """A document as JSON, for publish_sealed."""
    told = {"seal": SEAL, **document}
    return [json.dumps(told, indent=1, allow_nan=False).encode() + b"\n"]


def read_scores(path: Path | str) -> ScoreDocument | None:
    """The score document at `path`; None for JSON of another kind.

    Raises InputError where it is no JSON, or no score document although it has results.
    """
    document = read_sealed_json(path)
    if document is None:
        return None
    if not isinstance(document.get("results"), list):
        return None
    try:
        return _document(document)
    except _Nonsense as error:
        raise InputError(f"is not a score document: {error}", path, "run score again") from None


def read_sealed_json(path: Path | str) -> dict[str, Any] | None:
    """A JSON document of ours, None for any other JSON.

    Raises InputError where it is no JSON, or was altered.
    """
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"is no readable JSON ({error})", path, "run score again") from error
    if not isinstance(document, dict) or not {"results", "seal"} & document.keys():
        return None
    require_seal(path)
    return document


def _document(document: dict[str, Any]) -> ScoreDocument:
    definitions, inputs = (_table(document, key) for key in ("definitions", "inputs"))
    return ScoreDocument(
        results=tuple(_result(entry) for entry in document.get("results", ())),
        definitions={str(name): str(text) for name, text in definitions.items()},
        command=str(document.get("command", "")),
        inputs={role: file for role, about in inputs.items() if (file := _input(about))},
    )


def _table(document: dict[str, Any], key: str) -> dict[str, Any]:
    value = document.get(key, {})
    if not isinstance(value, dict):
        raise _Nonsense(f"{key} is no table")
    return value


def _input(about: object) -> InputFile | None:
    """A file that was read; None where it has no digest to know it by."""
    if not isinstance(about, dict) or not isinstance(about.get("sha256"), str):
        return None
    return InputFile(str(about.get("name", "")), about.get("sha256", ""))


def _result(entry: object) -> ResultScore:
    if (
        not isinstance(entry, dict)
        or not isinstance(entry.get("metrics"), dict)
        or not isinstance(entry.get("name"), str)
    ):
        raise _Nonsense("a result lacks its name or metrics")
    name = entry.get("name", "")
    told = _numbers(entry.get("wavelengths_nm", []), "wavelengths_nm")
    bands = tuple(w for w in told if w is not None)
    if len(bands) < len(told):
        raise _Nonsense("wavelengths_nm are no numbers")
    patches = entry.get("patches")
    if patches is not None and not isinstance(patches, list):
        raise _Nonsense("patches are no list")
    return ResultScore(
        name=name,
        label=str(entry.get("label", Path(name).stem)),
        kind=str(entry.get("kind", "")),
        method=str(entry.get("method", "")),
        wavelengths_nm=bands,
        figures=_figures(entry.get("metrics", {}), len(bands)),
        patches=None if patches is None else tuple(_patch(one, len(bands)) for one in patches),
        error=str(entry.get("error", "")),
    )


def _figures(metrics: Mapping[str, object], bands: int) -> dict[str, Figure]:
    """Figures by name; a list goes with the bands of the result, where it has any."""
    found: dict[str, Figure] = {}
    for name, value in metrics.items():
        if isinstance(value, list):
            numbers = _numbers(value, name)
            if bands and len(numbers) != bands:
                raise _Nonsense(f"{name} has {len(numbers)} values for {bands} bands")
            found[name] = numbers
        else:
            found[name] = value if isinstance(value, str) else _number(value, name)
    return found


def _patch(patch: object, bands: int) -> PatchScore:
    if not isinstance(patch, dict):
        raise _Nonsense("a patch is no table")
    label = patch.get("label")
    if type(label) is not int or not 1 <= label <= PATCHES:
        raise _Nonsense(f"a patch has no label from 1 to {PATCHES}")
    count, truth = patch.get("lenslets"), patch.get("truth")
    return PatchScore(
        label=label,
        name=str(patch.get("name", label)),
        lenslets=count if type(count) is int else None,
        mean=_spectrum(patch.get("mean"), "mean", bands),
        std=_spectrum(patch.get("std"), "std", bands),
        truth=None if truth is None else _spectrum(truth, "truth", bands),
        one_of_six=patch.get("one_of_six") is True,
    )


def _spectrum(value: object, name: str, bands: int) -> list[float]:
    """One number a band; NaN where there is none."""
    numbers = _numbers(value, name)
    if len(numbers) != bands:
        raise _Nonsense(f"{name} of a patch has {len(numbers)} values for {bands} bands")
    return [math.nan if v is None else v for v in numbers]


def _numbers(value: object, name: str) -> list[float | None]:
    if not isinstance(value, list):
        raise _Nonsense(f"{name} is no list")
    return [_number(v, name) for v in value]


def _number(value: object, name: str) -> float | None:
    """A number as it stands, None for null and for what is not finite."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _Nonsense(f"{name} is no number")
    try:
        return value if math.isfinite(value) else None
    except OverflowError:
        raise _Nonsense(f"{name} is no number that counts") from None
