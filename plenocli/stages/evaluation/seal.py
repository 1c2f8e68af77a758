"""Vouching for what is there: a run folder gets its manifest, an edited file a digest that fits."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from plenocli.base.errors import InputError, UsageError

EDITED = "before an edit"
"""Role of a file's earlier self among its inputs."""


@dataclass(frozen=True, kw_only=True)
class Sealed:
    """What was sealed.

    files: of a folder, or 1.
    changes: against what was sealed before, a line each; None where nothing says how it was.
    """

    path: Path
    files: int
    changes: tuple[str, ...] | None

    def as_json(self) -> dict[str, Any]:
        """JSON-able."""
        changes = None if self.changes is None else list(self.changes)
        return {"path": str(self.path), "files": self.files, "changes": changes}

    def line(self) -> str:
        """In words."""
        from plenocli.base.text import counted, printable

        if self.changes is None:
            told = "what was changed in it is not known; --was ORIGINAL tells"
            if self.path.is_dir():
                return f"{self.path}: {counted(self.files, 'file')} sealed"
        elif not self.changes:
            told = "nothing has changed"
        else:
            told = "\n".join(["changed since:", *(f"  {printable(c)}" for c in self.changes)])
        return f"{self.path}: sealed; {told}"


def run_seal(path: Path, *, was: Path | None = None, key: Path | None = None) -> Sealed:
    """Write the manifest of a folder, or an edited file's digest anew.

    path: folder, or file of ours that was edited by hand or by another program.
    was: the file before the edit, to be compared with.
    key: SSH key that signs the manifest.

    Raises UsageError for options that do not go together, InputError where the file cannot be read
    as what it is, OutputError where it cannot be written.
    """
    if path.is_dir():
        if was is not None:
            raise UsageError("--was takes a file", path, "name a file, or leave --was away")
        return _seal_folder(path, key)
    if key is not None:
        raise UsageError("folders are signed, not files", path, "name the folder of its run")
    return _seal_file(path, was)


def _seal_folder(root: Path, key: Path | None) -> Sealed:
    from plenocli.files import manifest

    if key is None and (root / manifest.SIGNATURE).exists():
        raise UsageError(
            "is signed, and would not fit its signature any more",
            root / manifest.NAME,
            f"sign anew with --sign KEY, or remove {manifest.SIGNATURE}",
        )
    found = manifest.digests(root)
    changes = None
    if (root / manifest.NAME).exists():
        changes = manifest.differences(found, manifest.read_manifest(root))
    manifest.write_manifest(root, found, key)
    return Sealed(path=root, files=len(found), changes=changes)


def _seal_file(path: Path, was: Path | None) -> Sealed:
    from plenocli.files.images.mosaic import is_hdf5

    if _is_whole(path):
        return Sealed(path=path, files=1, changes=())
    return _seal_artefact(path, was) if is_hdf5(path) else _seal_other(path, was)


def _is_whole(path: Path) -> bool:
    from plenocli.stages.evaluation.verify import run_verify

    try:
        run_verify(path)
    except InputError:
        return False
    return True


def _seal_artefact(path: Path, was: Path | None) -> Sealed:
    from plenocli.files.artefacts.reading import read_artefact, read_edited
    from plenocli.files.artefacts.writing import write_artefact
    from plenocli.files.results.contents import artefact_contents, changes

    artefact, digest = read_edited(path)
    found = None
    if was is not None:
        found = tuple(changes(artefact_contents(read_artefact(was)), artefact_contents(artefact)))
    origin = artefact.provenance
    before = {EDITED: {"name": path.name, "sha256": digest}}
    origin = replace(origin, inputs={**origin.inputs, **before})
    write_artefact(path, replace(artefact, provenance=origin), overwrite=True)
    return Sealed(path=path, files=1, changes=found)


def _seal_other(path: Path, was: Path | None) -> Sealed:
    from plenocli.files.artefacts.provenance import require_file
    from plenocli.files.atomic import publish
    from plenocli.files.results.contents import changes, file_contents
    from plenocli.files.seal import resealed

    require_file(path)
    try:
        content = resealed(path.read_bytes())
    except ValueError:
        raise InputError(
            "holds no place for a digest: it is none of the files that have one, or lost it",
            path,
            "edit a copy of the original so that its seal stays in it",
        ) from None
    with tempfile.TemporaryDirectory(prefix="plenocli-") as folder:
        copy = Path(folder, path.name)
        copy.write_bytes(content)
        try:
            after = file_contents(copy)
        except InputError as error:
            raise error.at(path) from None
    found = None if was is None else tuple(changes(file_contents(was), after))
    publish(path, content, overwrite=True)
    return Sealed(path=path, files=1, changes=found)
