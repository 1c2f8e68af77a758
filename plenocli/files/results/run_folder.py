"""What lies in a run folder: artefacts, EXR and DNG files and score documents, and which was made
from which.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plenocli.base.errors import InputError
from plenocli.evaluation.scores import ScoreDocument

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact

_PATTERNS = ("*.h5", "*.exr", "*.dng", "*.json")
_KEPT_BYTES = 32 << 20
"""Larger artefacts are read again when they are drawn."""


LONG_COMMAND = 160
"""Letters from which on the middle of a command is left out on pages."""


@dataclass(frozen=True, kw_only=True)
class RunFile:
    """One readable file.

    name: its path in the run folder.
    kind: that of the artefact, "capture" for a mosaic, or "score".
    digest: SHA-256 of its bytes, hex.
    command, config: of its provenance, or "".
    sources: role -> SHA-256 of its inputs.
    kept: the artefact, where it is small.
    scores: what a score document says, None for other files.
    """

    path: Path
    name: str
    kind: str
    digest: str
    command: str = ""
    config: str = ""
    sources: Mapping[str, str] = field(default_factory=dict)
    kept: "Artefact | None" = None
    scores: ScoreDocument | None = None

    @property
    def folder(self) -> Path:
        """The folder it lies in."""
        return self.path.parent

    @property
    def made_by(self) -> str:
        """The command, its middle left out where it names many files."""
        if len(self.command) <= LONG_COMMAND:
            return self.command
        half = LONG_COMMAND // 2
        begin, end = self.command[:half].rpartition(" "), self.command[-half:].partition(" ")
        return f"{begin[0] or begin[2]} … {end[2] or end[0]}"

    def artefact(self) -> "Artefact":
        """The artefact itself, verified."""
        from plenocli.files.artefacts.reading import read_artefact

        return self.kept if self.kept is not None else read_artefact(self.path, self.kind)


class RunFolder:
    """All files below a folder.

    files: by name.
    unreadable: (name, what is wrong) of those that are left out.
    """

    def __init__(self, root: Path | str) -> None:
        """Survey the folder `root`.

        Raises InputError where it is none, or holds no result; NumericsError where a file does not
        fit the memory: a page without it would look complete.
        """
        root = Path(root)
        if not root.is_dir():
            raise InputError("is no folder", root, "name the folder of a run, such as runs/demo")
        self.root = root
        self.files: list[RunFile] = []
        self.unreadable: list[tuple[str, str]] = []
        for path in sorted(
            {p for pattern in _PATTERNS for p in root.rglob(pattern) if p.is_file()}
        ):
            name = path.relative_to(root).as_posix()
            if path.name.startswith("."):
                continue
            try:
                found = _survey(path, name)
            except InputError as error:
                self.unreadable.append((name, error.what))
            else:
                self.files += [found] if found else []
        if not self.files:
            raise InputError(
                "holds no result of plenocli", root, "run a pipeline first, such as make demo"
            )

    def of_kind(self, kind: str) -> list[RunFile]:
        """All files of a kind, by name."""
        return [file for file in self.files if file.kind == kind]

    def by_digest(self, digest: str | None) -> RunFile | None:
        """The file with these bytes, or None."""
        return None if digest is None else self._digests.get(digest)

    @cached_property
    def _digests(self) -> dict[str, RunFile]:
        return {file.digest: file for file in self.files}

    @cached_property
    def _users(self) -> dict[str, list[RunFile]]:
        users: dict[str, list[RunFile]] = {}
        for file in self.files:
            for digest in file.sources.values():
                users.setdefault(digest, []).append(file)
        return users

    def users(self, file: RunFile) -> list[RunFile]:
        """Files that were made from `file`."""
        return self._users.get(file.digest, [])

    def source_of_kind(self, file: RunFile, kind: str) -> RunFile | None:
        """The first file of a kind that `file` was made from, or None."""
        sources = (self.by_digest(digest) for digest in file.sources.values())
        return next((found for found in sources if found and found.kind == kind), None)


def _survey(path: Path, name: str) -> RunFile | None:
    from plenocli.files.artefacts.provenance import file_digest
    from plenocli.files.results.scores import read_scores

    if path.suffix == ".json":
        scores = read_scores(path)
        if scores is None:
            return None
        return RunFile(
            path=path,
            name=name,
            kind="score",
            digest=file_digest(path),
            command=scores.command,
            sources={role: file.sha256 for role, file in scores.inputs.items()},
            scores=scores,
        )
    if path.suffix == ".h5":
        return _survey_artefact(path, name)
    if path.suffix == ".exr":
        return _survey_exr(path, name)
    return RunFile(path=path, name=name, kind="capture", digest=file_digest(path))


def _digests_of(inputs: Mapping[str, Any]) -> dict[str, str]:
    """Role -> SHA-256 of the inputs of a provenance that have one."""
    told = {role: about.get("sha256") for role, about in inputs.items() if isinstance(about, dict)}
    return {role: digest for role, digest in told.items() if isinstance(digest, str)}


def _survey_artefact(path: Path, name: str) -> RunFile:
    from plenocli.files.artefacts.provenance import file_digest
    from plenocli.files.artefacts.reading import read_artefact

    artefact = read_artefact(path)
    origin = artefact.provenance
    size = sum(values.nbytes for values in artefact.data.values())
    return RunFile(
        path=path,
        name=name,
        kind=artefact.kind,
        digest=file_digest(path),
        command=origin.command,
        config=origin.config,
        sources=_digests_of(origin.inputs),
        kept=artefact if size <= _KEPT_BYTES else None,
    )


def _survey_exr(path: Path, name: str) -> RunFile:
    from plenocli.files.artefacts.provenance import file_digest, read_provenance_texts
    from plenocli.files.images.exr import read_exr
    from plenocli.files.images.mosaic import CAPTURE
    from plenocli.files.images.spectral_exr import is_spectral

    attrs = read_exr(path)[1]
    kind = "spectra" if is_spectral(path) else "capture" if CAPTURE in attrs else "image"
    origin = read_provenance_texts(attrs)
    return RunFile(
        path=path,
        name=name,
        kind=kind,
        digest=file_digest(path),
        command=origin.command,
        config=origin.config,
        sources=_digests_of(origin.inputs),
    )
