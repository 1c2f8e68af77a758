"""The tables of every kind of artefact (`kinds.toml` beside this file), and what must hold between
datasets of one.
"""

import re
import tomllib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.files.artefacts.schema import Attr, Field, Schema


def _lit_lenslets(data: Mapping[str, np.ndarray], there: Collection[str]) -> str | None:
    valid = data["grid/valid"].astype(bool)
    if not valid.any():
        return "no lenslet of 'grid/valid' is lit"
    if not np.isfinite(data["grid/centre"][valid]).all():
        return "lenslets of 'grid/valid' have no 'grid/centre'"
    return None


def _whole_response(data: Mapping[str, np.ndarray], there: Collection[str]) -> str | None:
    for name, needed in (
        ("response/F", "response/wavelength"),
        ("response/F", "response/window"),
        ("response/window", "response/origin"),
        ("response/origin", "response/window"),
        ("response/polarised", "response/F"),
    ):
        if name in there and needed not in there:
            return f"'{name}' lacks '{needed}'"
    if "response/F" in data:
        known = np.isfinite(data["response/F"])
        if not known.any():
            return "'response/F' has no value that counts"
        return scale_problem(np.abs(data["response/F"][known]).max())
    return None


def scale_problem(largest: float) -> str | None:
    """What is wrong with a response whose largest value (without a sign) this is."""
    if largest and not 1e-30 <= largest <= 1e30:  # radiances are single precision
        return f"'response/F' has values up to {largest:.3g}, which are of no scale"
    return None


def _one_entry_each(data: Mapping[str, np.ndarray], there: Collection[str]) -> str | None:
    offset = data["stack/lenslet_offset"]
    if np.abs(offset.astype(float)).max() > 1e4:
        return "'stack/lenslet_offset' lies beyond any array"
    entries = np.column_stack([data["stack/plane"], offset])
    return (
        "an entry of 'stack' is twice" if len(np.unique(entries, axis=0)) < len(entries) else None
    )


def _even_history(data: Mapping[str, np.ndarray], there: Collection[str]) -> str | None:
    kept = {v.shape for path, v in data.items() if path.startswith("dictionary/state/history_")}
    even = len(kept) <= 1 and all(len(shape) == 1 for shape in kept)
    return None if even else "'dictionary/state' has histories of several lengths"


_RULES = {
    "calibration": (_lit_lenslets, _whole_response),
    "pif-stack": (_one_entry_each,),
    "dictionary": (_even_history,),
    "checkpoint": (_even_history,),
}


def _field(path: str, axes: str, dtype: str, unit: str, doc: str, rare: Any = ()) -> Field:
    dims = None if axes == "*" else axes
    return Field(path=path, dims=dims, dtype=dtype, unit=unit, doc=doc, **dict(rare))


def _attr(name: str, type: str, unit: str, doc: str, rare: Any = ()) -> Attr:
    return Attr(name=name, type=type, unit=unit, doc=doc, **dict(rare))


def _schema(kind: str, table: dict[str, Any], known: Mapping[str, Schema]) -> Schema:
    """The Schema of one table of kinds.toml; `known` holds the one that it takes over."""
    none = Schema(kind="", version=1, doc="", fields=())
    like = known[table["like"]] if "like" in table else none
    kept = (field for field in like.fields if field.path not in table.get("without", ()))
    attrs = dict(like.attrs)
    for where, rows in table.get("attributes", {}).items():
        attrs[where] = (*attrs.get(where, ()), *(_attr(*row) for row in rows))
    plots = {
        group: (first, tuple(rest)) for group, (first, *rest) in table.get("plots", {}).items()
    }
    return Schema(
        kind=kind,
        version=table["version"],
        doc=table["doc"],
        fields=(*kept, *(_field(*row) for row in table.get("datasets", ()))),
        attrs=attrs,
        plots=plots or like.plots,
        default=tuple(table.get("default", like.default)),
        rules=_RULES.get(kind, ()),
    )


class _Tables(Mapping[str, Schema]):
    """The tables by kind, each parsed when it is first asked for: a command needs one or two."""

    def __init__(self, text: str) -> None:
        starts = [*_KIND.finditer(text)]
        ends = [start.start() for start in starts[1:]] + [len(text)]
        self._texts = {s[1]: text[s.start() : end] for s, end in zip(starts, ends)}
        self._made: dict[str, Schema] = {}

    def __getitem__(self, kind: str) -> Schema:
        if kind not in self._made:
            table = tomllib.loads(self._texts[kind])[kind]
            self._made[kind] = _schema(kind, table, self)
        return self._made[kind]

    def __iter__(self) -> Iterator[str]:
        return iter(self._texts)

    def __len__(self) -> int:
        return len(self._texts)


_KIND = re.compile(r"^\[([a-z-]+)\]$", re.MULTILINE)

SCHEMAS: Mapping[str, Schema] = _Tables(Path(__file__).with_name("kinds.toml").read_text("ascii"))
"""Kind -> its table."""
