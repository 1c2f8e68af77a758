"""Whether files are as they were written: each by its own digest, a run folder by its manifest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from plenocli.base.errors import InputError
from plenocli.base.text import Record

_FEW = 5
"""Names of a list that are told in one line."""


@dataclass(frozen=True, kw_only=True)
class Verified(Record):
    """A file or folder that is as it was written.

    files: that were compared.
    signer: who signed the manifest, None where nobody was asked for.
    """

    path: Path
    files: int = 1
    signer: str | None = None

    def line(self) -> str:
        """In words."""
        told = f"{self.path}: as it was written"
        if self.path.is_dir():
            told = f"{self.path}: {self.files} files as they were sealed"
        if self.signer is not None:
            told += f", signed by {self.signer}"
        return told


def few(names: Sequence[str]) -> str:
    """Names, or the first ones and how many more."""
    from plenocli.base.text import printable

    shown = ", ".join(printable(name) for name in names[:_FEW])
    return shown if len(names) <= _FEW else f"{shown} and {len(names) - _FEW} more"


def run_verify(path: Path, *, signers: Path | None = None) -> Verified:
    """Compare a file with the digest in it, or a folder with its manifest.

    path: artefact, DNG, EXR, OME-TIFF or JSON of ours; or a folder with SHA256SUMS.
    signers: file of the signers of which one must have signed the manifest.

    Raises InputError naming what was altered or is missing, or where nothing says how it was.
    """
    from plenocli.files.artefacts.reading import read_artefact
    from plenocli.files.images.mosaic import is_hdf5
    from plenocli.files.seal import require_seal

    if path.is_dir():
        return _folder(path, signers)
    if signers is not None:
        raise InputError("is a file, and folders are signed", path, "name the folder of its run")
    if is_hdf5(path):
        read_artefact(path)
    elif not require_seal(path):
        raise InputError(
            "holds no digest: it is none of the files that have one",
            path,
            "name the folder of its run, whose manifest lists every file",
        )
    return Verified(path=path)


def _folder(root: Path, signers: Path | None) -> Verified:
    from plenocli.files import manifest

    signer = None if signers is None else manifest.signer(root, signers)
    listed = manifest.read_manifest(root)
    changes = manifest.differences(manifest.digests(root), listed)
    if changes:
        raise InputError(
            f"is not as it was sealed: {few(changes)}",
            root,
            "make them again, or accept them: plenocli seal FOLDER",
        )
    return Verified(path=root, files=len(listed), signer=signer)
