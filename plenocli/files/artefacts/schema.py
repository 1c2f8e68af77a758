"""What a schema is: a table of datasets and attributes from which the writer's checks, the reader's
checks, the plotting attributes, `plenocli inspect` and the documentation all come. The tables
themselves stand in kinds.toml.

`python -m plenocli.files.artefacts` prints them as a Markdown page.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

FURTHEST = 1e100
"""Of any number in a file from 0: no number holds the squares of what lies further."""

Declared = Mapping[str, tuple[tuple[int, ...], Any]]
"""Dataset path -> (shape, dtype), before there are values."""

# Root attributes of every artefact, in the order in which they are shown.
ROOT_ATTRIBUTES = {
    "plenocli_kind": "which of the tables below the file follows",
    "schema_version": "version of that table",
    "plenocli_version": "version of the program that wrote the file",
    "command": "the command that made it, without folders",
    "config": "the resolved camera description, TOML text",
    "inputs": "JSON: role -> file name and SHA-256 of each input",
    "seed": "seed of the random numbers, or the text `none`",
    "accuracy": "JSON: accuracy asked for, estimated, model chosen, reasons",
}


@dataclass(frozen=True, kw_only=True)
class Field:
    """One dataset.

    path: in the file; one that ends in /* stands for any number of datasets below that group.
    dims: names of the axes ("band row column"); a number is a fixed length, alternatives are
        separated by "|", None takes any shape.
    dtype: what it may hold: f (f4 or f8), i (integers), b (true/false), S (short ASCII text).
    unit, doc: for the file and for people.
    optional: whether it may be left out.
    maskable: whether NaN marks "not measured".
    minimum, maximum: least and largest value, or None.
    ascending: whether each value is above the one before.
    compress: whether it is stored in compressed chunks, not as one run of numbers.
    """

    path: str
    dims: str | None
    dtype: str
    unit: str
    doc: str
    optional: bool = False
    maskable: bool = False
    minimum: float | None = None
    maximum: float | None = None
    ascending: bool = False
    compress: bool = True

    def alternatives(self) -> list[tuple[str, ...]] | None:
        """The allowed axis-name tuples, or None where any shape will do."""
        return None if self.dims is None else [tuple(part.split()) for part in self.dims.split("|")]


@dataclass(frozen=True, kw_only=True)
class Attr:
    """One attribute of a group or dataset.

    type: number (one, or a short list), text, json or flag.
    unit, doc: for people.
    finite: whether a number may not be infinite.
    minimum: least number, or None.
    size: how many numbers (1: no list), or None for any.
    pattern: regular expression of a whole text, or None for any.
    """

    name: str
    type: str
    unit: str
    doc: str
    finite: bool = True
    minimum: float | None = None
    size: int | None = None
    pattern: str | None = None


@dataclass(frozen=True, kw_only=True)
class Schema:
    """All that an artefact of one kind may hold.

    kind, version, doc: name of the kind, version of this table, what it is.
    fields: its datasets.
    attrs: group or dataset path -> its attributes; all may be left out.
    plots: group -> (signal dataset, names of its companions).
    default: the groups to draw first.
    rules: what must hold between datasets; each says what is wrong of (path -> array) and the paths
        that there are, or None.
    """

    kind: str
    version: int
    doc: str
    fields: tuple[Field, ...]
    attrs: dict[str, tuple[Attr, ...]] = field(default_factory=dict)
    plots: dict[str, tuple[str, tuple[str, ...]]] = field(default_factory=dict)
    default: tuple[str, ...] = ()
    rules: tuple[Callable[[Mapping[str, np.ndarray], Collection[str]], str | None], ...] = ()

    def field_for(self, path: str) -> Field | None:
        """The Field that describes dataset `path`, or None."""
        for entry in self.fields:
            if entry.path == path or (
                entry.path.endswith("/*") and path.startswith(entry.path[:-1])
            ):
                return entry
        return None

    def attr_for(self, where: str, name: str) -> Attr | None:
        """The Attr `name` of group or dataset `where`, or None."""
        return next((attr for attr in self.attrs.get(where, ()) if attr.name == name), None)


def _dtype_fits(dtype: Any, spec: str) -> bool:
    dtype = np.dtype(dtype)
    for code in spec.split():
        if code == "f" and dtype.kind == "f" and dtype.itemsize in (4, 8):
            return True
        if code == "i" and dtype.kind in "iu":
            return True
        if code == "b" and dtype.kind == "b":
            return True
        if code == "S" and dtype.kind == "S" and dtype.itemsize <= 64:
            return True
    return False


def _shape_problem(
    entry: Field, shape: tuple[int, ...], lengths: dict[str, tuple[int, str]]
) -> str | None:
    """Why `shape` does not fit the axes of `entry`, or None; `lengths` collects the length
    of each named axis.
    """
    alternatives = entry.alternatives()
    if alternatives is None:
        return None
    dims = next((names for names in alternatives if len(names) == len(shape)), None)
    if dims is None:
        wanted = " or ".join("(" + ", ".join(names) + ")" for names in alternatives)
        return f"has shape {tuple(shape)} where {wanted} is due"
    for name, size in zip(dims, shape):
        if size == 0:
            return f"is empty along '{name}'"
        if name.isdigit():
            if size != int(name):
                return f"has shape {tuple(shape)}: length {size} where {name} is due"
        elif lengths.setdefault(name, (size, entry.path))[0] != size:
            known, owner = lengths[name]
            return f"has {size} along '{name}', but '{owner}' has {known}"
    return None


def declared_problems(schema: Schema, declared: Declared) -> list[str]:
    """Every way in which datasets break their table, as sentences.

    schema: the table.
    declared: the datasets, before there are values.
    """
    problems: list[str] = []
    lengths: dict[str, tuple[int, str]] = {}
    for entry in schema.fields:
        if not entry.path.endswith("/*") and not entry.optional and entry.path not in declared:
            problems.append(f"dataset '{entry.path}' is missing ({entry.doc})")
    ordered = [e.path for e in schema.fields if e.path in declared]
    ordered += sorted(set(declared) - set(ordered))
    for path in ordered:
        shape, dtype = declared[path]
        found = schema.field_for(path)
        if found is None:
            problems.append(
                f"dataset '{path}' is unknown in kind '{schema.kind}' (known: {_known(schema)})"
            )
            continue
        if not _dtype_fits(dtype, found.dtype):
            problems.append(f"dataset '{path}' holds {dtype} where {found.dtype} is due")
        problem = _shape_problem(found, shape, lengths)
        if problem:
            problems.append(f"dataset '{path}' {problem}")
    return problems


def _known(schema: Schema) -> str:
    return ", ".join(entry.path for entry in schema.fields)


def value_problems(
    schema: Schema, data: Mapping[str, np.ndarray], others: Collection[str] = ()
) -> list[str]:
    """Every way in which the values of `data` (path -> array) break the table: NaN, infinities,
    below minimum, above maximum, beyond FURTHEST, order, and what must hold between datasets.

    others: paths of datasets that there are, too, whose values are not at hand.
    """
    problems = []
    for path, values in data.items():
        entry = schema.field_for(path)
        if entry is None or values.size == 0 or values.dtype.kind not in "fiu":
            continue
        with np.errstate(invalid="ignore"):
            # NaN and infinities show in the extremes: no array-sized copy needed
            low, high = values.min(), values.max()
            if values.dtype.kind == "f" and not (np.isfinite(low) and np.isfinite(high)):
                if np.isinf(values).any():
                    problems.append(f"dataset '{path}' holds infinities")
                if np.isnan(low) and not entry.maskable:
                    problems.append(f"dataset '{path}' holds {int(np.isnan(values).sum())} NaN")
                low = np.nanmin(values) if not np.isnan(values).all() else 0.0
        if max(abs(float(low)), abs(float(high if np.isfinite(high) else 0))) > FURTHEST:
            problems.append(f"dataset '{path}' holds values beyond {FURTHEST:g}")
        if entry.minimum is not None and low < entry.minimum:
            problems.append(f"dataset '{path}' goes down to {low:.6g}, below {entry.minimum:g}")
        if entry.maximum is not None and high > entry.maximum:
            problems.append(f"dataset '{path}' goes up to {high:.6g}, above {entry.maximum:g}")
        if entry.ascending and values.size > 1 and not (np.diff(values) > 0).all():
            problems.append(f"dataset '{path}' does not ascend")
    return problems + [said for rule in schema.rules if (said := rule(data, {*data, *others}))]


def attribute_problems(schema: Schema, attrs: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Every way in which `attrs` (path -> name -> value) breaks the table."""
    problems = []
    for where, named in attrs.items():
        for name, value in named.items():
            attr = schema.attr_for(where, name)
            if attr is None:
                known = ", ".join(a.name for a in schema.attrs.get(where, ())) or "none"
                problems.append(
                    f"attribute '{name}' of '{where}' is unknown in kind "
                    f"'{schema.kind}' (known: {known})"
                )
            elif not _attribute_fits(attr, value):
                problems.append(
                    f"attribute '{name}' of '{where}' is {value!r:.80} where {_due(attr)} is due"
                )
    return problems


def _due(attr: Attr) -> str:
    """What an attribute may hold, in words."""
    if attr.pattern is not None:
        return attr.pattern.replace("|", " or ")
    some = f"{attr.size} times a " if attr.size not in (None, 1) else "a "
    least = "" if attr.minimum is None else f" of at least {attr.minimum:g}"
    return f"{some}{attr.type}{least}"


def _attribute_fits(attr: Attr, value: Any) -> bool:
    if attr.type == "text":
        return (
            isinstance(value, str)
            and "\0" not in value
            and (attr.pattern is None or re.fullmatch(attr.pattern, value) is not None)
        )
    if attr.type == "flag":
        return isinstance(value, (bool, np.bool_))
    if attr.type == "json":
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError):
            return False
        return True
    values = np.asarray(value)
    if values.dtype.kind not in "iuf" or values.size == 0 or values.ndim > 2 or values.size > 4096:
        return False
    if attr.size is not None and (values.size != attr.size or (attr.size == 1 and values.ndim)):
        return False
    if attr.minimum is not None and not (values >= attr.minimum).all():
        return False
    known = values if attr.finite else values[~np.isinf(values)]
    return bool((np.abs(known.astype(float)) <= FURTHEST).all())


def plot_attributes(schema: Schema, declared: Declared) -> dict[str, dict[str, Any]]:
    """NXdata attributes of a file, from which other programs draw it.

    schema: the table.
    declared: the datasets of the file.

    Returns path -> name -> text, list or int. Groups get NX_class, signal, axes and
    <axis>_indices; datasets get units and long_name; the root gets `default` (NeXus NXdata; silx,
    h5web and HDFView draw such a group at once).
    """
    found = {"": {"NX_class": "NXroot"}}
    for group in sorted(
        {path.rsplit("/", depth)[0] for path in declared for depth in range(1, path.count("/") + 1)}
    ):
        found[group] = {"NX_class": "NXcollection"}
    for group, (signal, companions) in schema.plots.items():
        if f"{group}/{signal}" not in declared:
            continue
        found[group] = _plot_group(schema, group, signal, companions, declared)
    default = next(
        (group for group in schema.default if found.get(group, {}).get("NX_class") == "NXdata"),
        None,
    )
    if default is not None:
        found[""]["default"] = default
    for path in declared:
        entry = schema.field_for(path)
        if entry is not None:
            found[path] = {"units": entry.unit, "long_name": _long_name(path, entry)}
    return found


def _plot_group(
    schema: Schema, group: str, signal: str, companions: tuple[str, ...], declared: Declared
) -> dict[str, Any]:
    """NXdata attributes of one group: axes are the datasets of the group whose single dimension
    names an axis of the signal.
    """
    path = f"{group}/{signal}"
    shape = declared[path][0]
    entry = schema.field_for(path)
    dims = next(
        (d for d in (entry and entry.alternatives()) or [] if len(d) == len(shape)),
        tuple("." for _ in shape),
    )
    scales = {
        e.dims: e.path.rsplit("/", 1)[1]
        for e in schema.fields
        if e.ascending and e.path in declared and e.path.rsplit("/", 1)[0] == group
    }
    attrs: dict[str, Any] = {"NX_class": "NXdata", "signal": signal}
    if shape:
        attrs["axes"] = [scales.get(dim, ".") for dim in dims]
    attrs |= {
        f"{scales[dim]}_indices": position for position, dim in enumerate(dims) if dim in scales
    }
    beside = [name for name in companions if f"{group}/{name}" in declared]
    if beside:
        attrs["auxiliary_signals"] = beside
    return attrs


def axis_names(schema: Schema, declared: Declared) -> dict[str, tuple[str, ...]]:
    """Name of the dimension scale of each axis: dataset path -> names in the dataset's group.

    schema: table of the kind.
    declared: dataset path -> (shape, dtype).

    A dataset whose one axis it is and which ascends gives its name to the axis, as wavelength to
    band; other axes have the name of the table, a fixed length n is length_n. Datasets whose axes
    the table leaves open are left out.
    """
    found = {}
    for path, (shape, _) in declared.items():
        entry, group = schema.field_for(path), path.rpartition("/")[0]
        known = (entry and entry.alternatives()) or []
        dims = next((d for d in known if len(d) == len(shape)), ())
        names: list[str] = []
        for dim in dims:
            name = _scale_of(schema, declared, group, dim)
            names.append(f"{name}_{len(names)}" if name in names else name)
        if names:
            found[path] = tuple(names)
    return found


def _scale_of(schema: Schema, declared: Declared, group: str, dim: str) -> str:
    if dim.isdigit():
        return f"length_{dim}"
    own = (e.path for e in schema.fields if e.ascending and e.dims == dim and e.path in declared)
    beside = [path.rsplit("/", 1)[1] for path in own if path.rpartition("/")[0] == group]
    if beside:
        return beside[0]
    return f"{dim}_axis" if f"{group}/{dim}" in declared else dim


def _long_name(path: str, entry: Field) -> str:
    name = path.rsplit("/", 1)[1].replace("_", " ")
    return name if entry.unit in ("", "1") else f"{name} ({entry.unit})"


def markdown(schemas: Mapping[str, Schema]) -> str:
    """The tables of `schemas` (kind -> Schema) as one Markdown page."""
    lines = [
        "# Artefacts",
        "",
        "Every result is one HDF5 file. Generated by `python -m plenocli.files.artefacts`.",
        "",
        "Axes carry HDF5 dimension scales with the names given here, so that xarray shows them; an "
        "axis with ascending values of its own goes by their name, as band by wavelength.",
        "",
        "Root attributes of every kind:",
        "",
        "| attribute | meaning |",
        "|---|---|",
    ]
    lines += [f"| `{name}` | {doc} |" for name, doc in ROOT_ATTRIBUTES.items()]
    for schema in schemas.values():
        lines += [
            "",
            f"## {schema.kind} (version {schema.version})",
            "",
            schema.doc,
            "",
            "| dataset | axes | holds | unit | meaning |",
            "|---|---|---|---|---|",
        ]
        for e in schema.fields:
            axes = (
                "any"
                if e.dims is None
                else " or ".join(f"({', '.join(a)})" for a in e.alternatives() or ())
            )
            notes = [
                n for n, on in (("optional", e.optional), ("NaN = not measured", e.maskable)) if on
            ]
            meaning = e.doc + (f" ({'; '.join(notes)})" if notes else "")
            lines.append(f"| `/{e.path}` | {axes} | {e.dtype} | {e.unit} | {meaning} |")
        rows = [
            f"| `/{where}` | `{a.name}` | {a.type} | {a.unit} | {a.doc} |"
            for where, named in schema.attrs.items()
            for a in named
        ]
        if rows:
            lines += [
                "",
                "| on | attribute | type | unit | meaning |",
                "|---|---|---|---|---|",
                *rows,
            ]
    return "\n".join(lines) + "\n"
