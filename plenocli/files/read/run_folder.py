"""What lies in a run folder: artefacts, EXR and DNG files and score documents, and which
was made from which.
"""

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from plenocli.base.errors import InputError

_PATTERNS = ("*.h5", "*.exr", "*.dng", "*.json")
_KEPT_BYTES = 32 << 20  # larger artefacts are read again when they are drawn


@dataclass
class RunFile:
    """One readable file.

    kind: that of the artefact, "capture" for a mosaic, or "score";
    sources: SHA-256 of its inputs.
    """

    path: Path
    name: str
    kind: str
    digest: str
    command: str = ""
    config: str = ""
    sources: dict = field(default_factory=dict)
    content: object = None

    @property
    def folder(self):
        return self.path.parent

    def artefact(self):
        """The artefact itself, verified."""
        from plenocli.files.artefacts.container import read_artefact

        return self.content if self.content is not None else read_artefact(self.path, self.kind)


class RunFolder:
    """All files below a folder, by name; `unreadable` holds (name, what is wrong).

    Raises NumericsError where one does not fit the memory: a page without it would look complete.
    """

    def __init__(self, root):
        root = Path(root)
        if not root.is_dir():
            raise InputError("is no folder", root, "name the folder of a run, such as runs/demo")
        self.root, self.files, self.unreadable = root, [], []
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

    def of_kind(self, kind):
        return [file for file in self.files if file.kind == kind]

    def by_digest(self, digest):
        """The file with these bytes, or None."""
        return self._digests.get(digest)

    @cached_property
    def _digests(self):
        return {file.digest: file for file in self.files}

    @cached_property
    def _users(self):
        users = {}
        for file in self.files:
            for digest in file.sources.values():
                users.setdefault(digest, []).append(file)
        return users

    def users(self, file):
        """Files that were made from `file`."""
        return self._users.get(file.digest, [])


def _survey(path, name):
    from plenocli.files.artefacts.provenance import file_digest

    if path.suffix == ".json":
        document = _score_document(path)
        if document is None:
            return None
        return RunFile(
            path,
            name,
            "score",
            file_digest(path),
            document["command"],
            sources=_digests_of(document["inputs"]),
            content=document,
        )
    if path.suffix == ".h5":
        return _survey_artefact(path, name)
    if path.suffix == ".exr":
        return _survey_exr(path, name)
    return RunFile(path, name, "capture", file_digest(path))


def _digests_of(inputs):
    return {
        role: about["sha256"]
        for role, about in inputs.items()
        if isinstance(about, dict) and "sha256" in about
    }


def _survey_artefact(path, name):
    from plenocli.files.artefacts.container import read_artefact
    from plenocli.files.artefacts.provenance import file_digest

    artefact = read_artefact(path)
    origin = artefact.provenance
    size = sum(values.nbytes for values in artefact.data.values())
    return RunFile(
        path,
        name,
        artefact.kind,
        file_digest(path),
        origin.command,
        origin.config,
        _digests_of(origin.inputs),
        artefact if size <= _KEPT_BYTES else None,
    )


def _survey_exr(path, name):
    from plenocli.files.artefacts.provenance import file_digest, read_provenance_texts
    from plenocli.files.images.exr import read_exr
    from plenocli.files.images.mosaic import CAPTURE
    from plenocli.files.images.spectral_exr import is_spectral

    attrs = read_exr(path)[1]
    kind = "spectra" if is_spectral(path) else "capture" if CAPTURE in attrs else "image"
    origin = read_provenance_texts(attrs)
    return RunFile(
        path,
        name,
        kind,
        file_digest(path),
        origin.command,
        origin.config,
        _digests_of(origin.inputs),
    )


def _score_document(path):
    """A score document with all the keys that the page reads; None for JSON of another kind."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"is no readable JSON ({error})", path, "run score again") from error
    if not isinstance(document, dict) or not isinstance(document.get("results"), list):
        return None
    for entry in document["results"]:
        if (
            not isinstance(entry, dict)
            or not isinstance(entry.get("metrics"), dict)
            or not isinstance(entry.get("name"), str)
        ):
            raise InputError(
                "is not a score document: a result lacks its name or metrics",
                path,
                "run score again",
            )
        entry.setdefault("label", Path(entry["name"]).stem)
    for key in ("definitions", "inputs"):
        if not isinstance(document.setdefault(key, {}), dict):
            raise InputError(f"is not a score document: {key} is no table", path, "run score again")
    document["command"] = str(document.get("command", ""))
    return document
