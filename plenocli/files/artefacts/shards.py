"""A system matrix in one file or in several: numbered artefacts of kind pif, each some
superpixels, and an index of kind pif-index; or each a plane of a scene's depth, and an index of
kind pif-planes; or each a place of the field, and an index of kind pif-field.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import InputError
from plenocli.base.text import by
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance, file_digest
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.stream import streamed_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.atomic import check_output, staged_path, together
from plenocli.files.config.camera_file import parse_camera, to_toml
from plenocli.forward.accuracy.depth_planes import plane_weights
from plenocli.forward.accuracy.field_nodes import FieldNodes, Place, turned_blocks
from plenocli.forward.propagation.symmetry import Turn


def shard_path(index: str | os.PathLike, number: int) -> Path:
    """Where shard `number` of the product at `index` stands: pif.h5 -> pif.000.h5."""
    index = Path(index)
    return index.with_name(f"{index.stem}.{number:03d}{index.suffix}")


class PifWriter:
    """A pif that is written superpixel by superpixel, into one file or into shards.

    shape: (band, lenslet, pixel, point);
    groups: the lenslets of each shard, or None for one file. Use `writing_pif`.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        shape: tuple[int, ...],
        dtype: Any,
        groups: Sequence[Sequence[int]] | None,
        stack: contextlib.ExitStack,
        overwrite: bool,
    ) -> None:
        self.path, self._groups, self._overwrite = Path(path), groups, overwrite
        self.files = (
            [self.path] if groups is None else [shard_path(path, n) for n in range(len(groups))]
        )
        self._home = {
            lenslet: (n, i)
            for n, group in enumerate(groups or [range(shape[1])])
            for i, lenslet in enumerate(group)
        }
        self._streams = []
        for n, file in enumerate(self.files):
            count = shape[1] if groups is None else len(groups[n])
            self._streams.append(
                stack.enter_context(
                    streamed_artefact(
                        file,
                        "pif",
                        "pif/A",
                        (shape[0], count, *shape[2:]),
                        dtype,
                        overwrite=overwrite,
                    )
                )
            )
        self._energy = np.zeros((len(self.files), shape[0], shape[3]))

    def put(self, band: int, lenslet: int, slab: np.ndarray) -> None:
        """Write A (pixel, point) of one band and superpixel."""
        file, place = self._home[lenslet]
        self._streams[file].put((band, place), slab)
        self._energy[file, band] += slab.sum(axis=0, dtype=float)

    @property
    def energy(self) -> np.ndarray:
        """Column energies (band, point) of all that was put."""
        return self._energy.sum(axis=0)

    def close(self, artefact: Artefact) -> None:
        """Seal all files with what `artefact`, of kind pif, holds beside A."""
        if self._groups is None:
            self._streams[0].close(artefact)
            return
        for stream, group, energy in zip(self._streams, self._groups, self._energy):
            part = {
                "pif/lenslet_offset": artefact.data["pif/lenslet_offset"][list(group)],
                "pif/column_energy": energy,
            }
            data = {
                name: values
                for name, values in artefact.data.items()
                if name != "pif/singular_values"
            } | part
            attrs = {
                name: value
                for name, value in artefact.attrs["pif"].items()
                if name not in ("rank", "condition", "resolution", "symmetry_defect")
            }
            stream.close(Artefact("pif", data, {"pif": attrs}, artefact.provenance))
        self._index = artefact

    def index(self) -> None:
        """Write the index, once the shards are written."""
        if self._groups is None:
            return
        home = np.array([self._home[lenslet][0] for lenslet in sorted(self._home)], np.int32)
        shards = _described(self.files)
        artefact = self._index
        write_artefact(
            self.path,
            Artefact(
                "pif-index",
                artefact.data | {"pif/shard": home},
                {"pif": artefact.attrs["pif"] | {"shards": shards}},
                artefact.provenance,
            ),
            overwrite=self._overwrite,
        )


@contextlib.contextmanager
def writing_pif(
    path: str | os.PathLike,
    shape: tuple[int, ...],
    dtype: Any,
    *,
    groups: Sequence[Sequence[int]] | None = None,
    overwrite: bool = False,
) -> Iterator[PifWriter]:
    """Yield a PifWriter; all files appear together when the block ends well.

    Errors as write_artefact.
    """
    check_output(path, overwrite=overwrite)
    with together():
        with contextlib.ExitStack() as stack:
            writer = PifWriter(path, shape, dtype, groups, stack, overwrite)
            yield writer
        writer.index()


PIF_KINDS = ("pif", "pif-index", "pif-planes", "pif-field")


def read_pif(
    path: str | os.PathLike, distance: float | None = None, place: Place | None = None
) -> Artefact:
    """The Artefact of kind pif at `path`; that of an index with its shards put together, that of
    planes or of places of the field interpolated.

    distance: of the plane, m, which counts among planes only;
    place: of a lenslet on the array, m, which counts among places of the field only.

    Errors as read_artefact.
    """
    artefact = read_artefact(path, PIF_KINDS)
    if artefact.kind == "pif-planes":
        return _between_planes(Path(path), artefact, distance)
    if artefact.kind == "pif-field":
        nodes, parts = read_field(path, artefact)
        if place is None:
            raise InputError(
                f"holds the matrices of {len(parts)} places of the field, of which one is due",
                path,
                f"name the file of one of them, such as {shard_path(path, 0).name}",
            )
        return at_place(nodes, parts, place)
    if artefact.kind == "pif":
        return artefact
    A = None
    for lenslets, part in pif_parts(path, artefact):
        if A is None:
            shape = (part.shape[0], len(artefact.data["pif/lenslet_offset"]), *part.shape[2:])
            size = int(np.prod(shape)) * part.itemsize
            budget().require_reading(path, size)
            A = np.empty(shape, part.dtype)
        A[:, lenslets] = part
    attrs = {name: value for name, value in artefact.attrs["pif"].items() if name != "shards"}
    data = {name: values for name, values in artefact.data.items() if name != "pif/shard"}
    return Artefact("pif", data | {"pif/A": A}, {"pif": attrs}, artefact.provenance)


def pif_parts(
    path: str | os.PathLike, artefact: Artefact | None = None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The matrix of a pif or pif-index shard by shard: yields (lenslet numbers, A of these (band,
    lenslet, pixel, point)).

    One shard is in memory at a time; each is verified against the index. Errors as read_artefact.
    """
    path = Path(path)
    artefact = artefact or read_artefact(path, ("pif", "pif-index"))
    if artefact.kind == "pif":
        yield np.arange(artefact.data["pif/A"].shape[1]), artefact.data["pif/A"]
        return
    home, offsets = artefact.data["pif/shard"], artefact.data["pif/lenslet_offset"]
    listed = _named(path, artefact.attrs.get("pif", {}).get("shards"), int(home.max()) + 1)
    for number, entry in enumerate(listed):
        lenslets = np.flatnonzero(home == number)
        file = _same_file(path, entry)
        part = read_artefact(file, "pif")
        if not np.array_equal(part.data["pif/lenslet_offset"], offsets[lenslets]):
            raise InputError(
                f"holds other superpixels than {path.name} says", file, "make both again"
            )
        yield lenslets, part.data["pif/A"]


def write_planes(
    path: str | os.PathLike,
    distances: Sequence[float],
    error: float,
    provenance: Provenance,
    *,
    overwrite: bool = False,
) -> None:
    """Write the index of planes whose files are written to shard_path(path, 0), 1, ... already.

    distances: m, nearest first;
    error: relative, of a column in between.

    Errors as write_artefact.
    """
    named = _described([shard_path(path, number) for number in range(len(distances))])
    write_artefact(
        path,
        Artefact(
            "pif-planes",
            {"planes/distance": np.asarray(distances, float)},
            {"planes": {"files": named, "error": error}},
            provenance,
        ),
        overwrite=overwrite,
    )


def write_field(
    path: str | os.PathLike, nodes: FieldNodes, provenance: Provenance, *, overwrite: bool = False
) -> None:
    """Write the index of places whose files are written to shard_path(path, 0), 1, ... already.

    Errors as write_artefact.
    """
    named = _described([shard_path(path, number) for number in nodes.numbers])
    data = {
        "field/row": nodes.rows,
        "field/column": nodes.columns,
        "field/file": nodes.file.astype(np.int32),
        "field/turn": nodes.turn,
    }
    attrs = {"field": {"files": named, "error": nodes.error}}
    write_artefact(path, Artefact("pif-field", data, attrs, provenance), overwrite=overwrite)


def _described(files: Sequence[Path]) -> list[dict[str, str]]:
    """Name and digest of the files that an index holds."""
    return [{"name": file.name, "sha256": file_digest(staged_path(file))} for file in files]


def read_field(
    path: str | os.PathLike, artefact: Artefact | None = None
) -> tuple[FieldNodes, list[Artefact]]:
    """Places of the field and their matrices, Artefacts of kind pif with the same superpixels.

    Errors as read_artefact.
    """
    path = Path(path)
    artefact = artefact or read_artefact(path, "pif-field")
    about = artefact.attrs.get("field", {})
    nodes = FieldNodes(
        rows=artefact.data["field/row"],
        columns=artefact.data["field/column"],
        file=artefact.data["field/file"],
        turn=artefact.data["field/turn"],
        error=float(about.get("error", math.nan)),
    )
    listed = _named(path, about.get("files"), len(nodes.numbers))
    parts = [read_pif(_same_file(path, listed[number])) for number in nodes.numbers]
    same = ("lenslet_offset", "pixel_shape", "object_shape", "wavelength")
    for part, entry in zip(parts, listed):
        if any(
            not np.array_equal(part.data[f"pif/{name}"], parts[0].data[f"pif/{name}"])
            for name in same
        ):
            raise InputError(
                f"holds another kind of matrix than {listed[0]['name']}",
                path.with_name(entry["name"]),
                "make all again",
            )
    return nodes, parts


def shapes_of(
    artefact: Artefact, path: str | os.PathLike | None = None
) -> tuple[tuple[int, int], tuple[int, int]]:
    """(rows, columns) of a superpixel's pixels and of an object's points, of the kind pif.

    Raises InputError where its matrices have others.
    """
    pixels, points = (
        (int(rows), int(columns))
        for rows, columns in (artefact.data[f"pif/{name}_shape"] for name in ("pixel", "object"))
    )
    sizes = artefact.data["pif/A"].shape[2:]
    if sizes != (math.prod(pixels), math.prod(points)):
        raise InputError(
            f"has matrices of {by(sizes)} for superpixels of {by(pixels)} pixels and blocks of "
            f"{by(points)} points",
            path,
            "run simulate-pif again",
        )
    return pixels, points


def turned_part(part: Artefact, how: Turn) -> np.ndarray:
    """A (band, lenslet, pixel, point) of a place from the pif that serves it, as the Turn says."""
    data = part.data
    shapes = data["pif/pixel_shape"], data["pif/object_shape"]
    return turned_blocks(data["pif/A"], data["pif/lenslet_offset"], shapes, how)


def at_place(nodes: FieldNodes, parts: Sequence[Artefact], place: Place) -> Artefact:
    """The Artefact of kind pif of a lenslet at a place (rows, columns; m) of the field."""
    first = parts[0]
    A = np.zeros(first.data["pif/A"].shape)
    for weight, number, how in nodes.mix(place):
        A += weight * turned_part(parts[number], how)
    np.maximum(A, 0, out=A)
    A = A.astype(first.data["pif/A"].dtype)
    data = first.data | {"pif/A": A, "pif/column_energy": A.sum(axis=(1, 2), dtype=float)}
    data.pop("pif/singular_values", None)
    attrs = _without_figures(first)
    attrs["notes"] = (attrs.get("notes") or {}) | {"chief": list(place)}
    return Artefact("pif", data, {"pif": attrs}, first.provenance)


def _without_figures(artefact: Artefact) -> dict[str, Any]:
    """Attributes of a pif that hold for one mixed with others, too."""
    own = ("rank", "condition", "resolution", "symmetry_defect", "eps")
    return {name: value for name, value in artefact.attrs["pif"].items() if name not in own}


def _between_planes(path: Path, artefact: Artefact, distance: float | None) -> Artefact:
    """The Artefact of kind pif at a distance (m) between the planes of an index."""
    distances = artefact.data["planes/distance"]
    listed = _named(path, artefact.attrs.get("planes", {}).get("files"), len(distances))
    near, far = float(distances[0]), float(distances[-1])
    if distance is None or not near * (1 - 1e-9) <= distance <= far * (1 + 1e-9):
        raise InputError(
            f"holds the matrices of {len(distances)} planes from {near:.4g} to {far:.4g} m",
            path,
            "name the file of one of them, such as "
            f"{listed[0]['name']}, or a camera focused among them where a camera is named",
        )
    used, weights = plane_weights(distances, distance)
    parts = [read_pif(_same_file(path, listed[number])) for number in used]
    offsets = np.unique(np.concatenate([p.data["pif/lenslet_offset"] for p in parts]), axis=0)
    first = parts[int(np.argmax(weights))]
    shape = first.data["pif/A"].shape
    A = np.zeros((shape[0], len(offsets), *shape[2:]), first.data["pif/A"].dtype)
    places = {tuple(offset): number for number, offset in enumerate(offsets.tolist())}
    for part, weight in zip(parts, weights):
        home = [places[tuple(offset)] for offset in part.data["pif/lenslet_offset"].tolist()]
        A[:, home] += weight * part.data["pif/A"]
    np.maximum(A, 0, out=A)
    data = first.data | {
        "pif/A": A,
        "pif/lenslet_offset": offsets.astype(np.int32),
        "pif/column_energy": A.sum(axis=(1, 2), dtype=float),
    }
    attrs = _without_figures(first)
    data.pop("pif/singular_values", None)
    camera = parse_camera(first.provenance.config, path)
    config = to_toml(camera.replace(**{"object.distance": distance}))
    return Artefact("pif", data, {"pif": attrs}, replace(first.provenance, config=config))


def _named(path: Path, listed: Any, count: int) -> list[dict[str, str]]:
    """The list of files that an index holds, `count` of them at least, each a name and a digest."""
    if (
        not isinstance(listed, list)
        or not all(
            isinstance(e, dict)
            and isinstance(e.get("name"), str)
            and re.fullmatch(r"[^/\0]{1,255}", e["name"])
            for e in listed
        )
        or count > len(listed)
    ):
        raise InputError("does not name the files that hold its superpixels", path, "make it again")
    return listed


def _same_file(path: Path, entry: dict[str, str]) -> Path:
    """The file that an entry of an index names, beside the index; InputError where it is not the
    one that was written.
    """
    file = path.with_name(Path(entry["name"]).name)
    if file_digest(file) != entry.get("sha256"):
        raise InputError(
            f"is not the file that {path.name} was written with", file, "make both again"
        )
    return file
