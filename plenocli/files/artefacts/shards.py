"""A system matrix in one file or in several: numbered artefacts of kind pif, each some
superpixels, and an index of kind pif-index.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import InputError
from plenocli.files.artefacts.container import Artefact, read_artefact, write_artefact
from plenocli.files.artefacts.provenance import file_digest
from plenocli.files.artefacts.stream import streamed_artefact
from plenocli.files.atomic import check_output


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
                if name not in ("rank", "condition", "symmetry_defect")
            }
            stream.close(Artefact("pif", data, {"pif": attrs}, artefact.provenance))
        self._index = artefact

    def index(self) -> None:
        """Write the index, once the shards stand under their names."""
        if self._groups is None:
            return
        home = np.array([self._home[lenslet][0] for lenslet in sorted(self._home)], np.int32)
        shards = [{"name": file.name, "sha256": file_digest(file)} for file in self.files]
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
    """Yield a PifWriter; all files appear when the block ends well, the index last.

    After a failure no new file is left.

    Errors as write_artefact.
    """
    check_output(path, overwrite=overwrite)
    writer, before = None, set()
    try:
        with contextlib.ExitStack() as stack:
            before = {n for n in range(len(groups or ())) if shard_path(path, n).exists()}
            writer = PifWriter(path, shape, dtype, groups, stack, overwrite)
            yield writer
        writer.index()
    except BaseException:
        for n in range(len(groups or ())):
            if n not in before:
                shard_path(path, n).unlink(missing_ok=True)
        raise


def read_pif(path: str | os.PathLike) -> Artefact:
    """The Artefact of kind pif at `path`; that of an index with its shards put together.

    Errors as read_artefact.
    """
    artefact = read_artefact(path, ("pif", "pif-index"))
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
    listed = artefact.attrs.get("pif", {}).get("shards")
    if (
        not isinstance(listed, list)
        or not all(
            isinstance(e, dict)
            and isinstance(e.get("name"), str)
            and re.fullmatch(r"[^/\0]{1,255}", e["name"])
            for e in listed
        )
        or home.max() >= len(listed)
    ):
        raise InputError("does not name the files that hold its superpixels", path, "make it again")
    for number, entry in enumerate(listed):
        lenslets = np.flatnonzero(home == number)
        file = path.with_name(Path(entry["name"]).name)
        if file_digest(file) != entry.get("sha256"):
            raise InputError(
                f"is not the file that {path.name} was written with", file, "make both again"
            )
        part = read_artefact(file, "pif")
        if not np.array_equal(part.data["pif/lenslet_offset"], offsets[lenslets]):
            raise InputError(
                f"holds other superpixels than {path.name} says", file, "make both again"
            )
        yield lenslets, part.data["pif/A"]
