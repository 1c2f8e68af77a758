"""A file of any kind that can be looked at, verified and named by what it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact


LARGE = ("image/value", "image/sigma", "capture/mosaic", "capture/scene")


@dataclass(frozen=True, kw_only=True)
class OpenedFile:
    """A file to look at: its kind, and its artefact, verified, where it is one, without what may
    not fit the memory: LARGE.
    """

    path: Path
    kind: str
    artefact: Artefact | None

    def stored(self) -> Artefact:
        """The artefact of a file that is one."""
        if self.artefact is None:
            raise ValueError(f"{self.path} is no artefact")
        return self.artefact


def open_file(file: Path | str) -> OpenedFile:
    """A file of any kind that can be drawn.

    file: an artefact, EXR, RAW, DNG or photograph; all that is no artefact is a capture, but for
        EXR of bands (spectra) and of results (image).

    Raises InputError where it is none.
    """
    from plenocli.files.artefacts.provenance import require_file
    from plenocli.files.artefacts.reading import opened_artefact
    from plenocli.files.artefacts.shards import PIF_KINDS, read_pif
    from plenocli.files.images.exr import read_header
    from plenocli.files.images.mosaic import CAPTURE, is_hdf5
    from plenocli.files.images.pictures import file_type
    from plenocli.files.images.spectral_exr import is_spectral

    path = Path(file)
    require_file(path)
    if is_hdf5(path):
        with opened_artefact(path, None, LARGE) as (artefact, _):
            pass
        if artefact.kind != "pif" and artefact.kind in PIF_KINDS:
            return OpenedFile(path=path, kind="pif", artefact=read_pif(path))
        return OpenedFile(path=path, kind=artefact.kind, artefact=artefact)
    kind = "capture"
    if file_type(path) == "exr" and is_spectral(path):
        kind = "spectra"
    elif file_type(path) == "exr" and CAPTURE not in read_header(path).attrs:
        kind = "image"
    return OpenedFile(path=path, kind=kind, artefact=None)
