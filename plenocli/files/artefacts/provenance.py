"""Where a result came from: the command, its inputs by name and digest, the seed.

No clock, host, folder or user.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plenocli.base.errors import InputError
from plenocli.base.text import printable, utf8
from plenocli.files.atomic import settle


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Where a result came from.

    command: that made it, without folders.
    inputs: role -> {"name": file name without folder, "sha256": hex}.
    seed: of the random numbers, or None.
    config: resolved TOML text.
    accuracy: JSON-able dict.
    """

    command: str
    inputs: dict[str, dict[str, str]] = field(default_factory=dict)
    seed: int | None = None
    config: str = ""
    accuracy: dict[str, Any] = field(default_factory=dict)


def describe_inputs(roles: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """Name and SHA-256 of each input file, for Provenance.inputs.

    roles: role -> path, or role -> sequence of paths (they become "role 1", "role 2", ...); a
        None path is left out; a folder stands for the files in it and in its folders.
    Raises InputError for a file that cannot be read.
    """
    described = {}
    for role, paths in roles.items():
        if paths is None:
            continue
        several = not isinstance(paths, (str, os.PathLike))
        for number, path in enumerate(paths if several else [paths], start=1):
            described[f"{role} {number}" if several else role] = {
                "name": printable(Path(path).name),
                "sha256": content_digest(path),
            }
    return described


_TEXT = "plenocli:{}"


def provenance_texts(provenance: Provenance) -> dict[str, str]:
    """The Provenance as text attributes of an EXR, name -> text; what is empty is left out."""
    texts = {
        "command": provenance.command,
        "config": provenance.config,
        "seed": "" if provenance.seed is None else str(provenance.seed),
    }
    texts |= {
        name: json.dumps(value, sort_keys=True)
        for name, value in (("inputs", provenance.inputs), ("accuracy", provenance.accuracy))
        if value
    }
    captured = provenance.inputs.get("capture", {}).get("captured")
    # the camera's clock, as EXIF and OpenEXR's capDate write it
    clock = {"DateTime": captured.replace("-", ":").replace("T", " ")} if captured else {}
    return {_TEXT.format(name): text for name, text in texts.items() if text} | clock


def read_provenance_texts(attrs: Mapping[str, str]) -> Provenance:
    """The Provenance that `provenance_texts` put into the text attributes of an EXR; empty where
    they lack it or it is broken.
    """
    found = {
        name: attrs.get(_TEXT.format(name), "")
        for name in ("command", "config", "seed", "inputs", "accuracy")
    }
    try:
        inputs, accuracy = (json.loads(found[name] or "{}") for name in ("inputs", "accuracy"))
        seed = int(found["seed"]) if found["seed"] else None
    except ValueError:
        inputs, accuracy, seed = {}, {}, None
    inputs, accuracy = (value if isinstance(value, dict) else {} for value in (inputs, accuracy))
    return Provenance(
        command=found["command"],
        inputs=inputs,
        seed=seed,
        config=found["config"],
        accuracy=accuracy,
    )


def content_digest(path: str | os.PathLike) -> str:
    """SHA-256 of a file's bytes, or of the names and digests of the files in a folder and in its
    folders, hex. Raises InputError.
    """
    if not os.path.isdir(path):
        return file_digest(path)
    parts = [
        f"{file.relative_to(path)} {file_digest(file)}"
        for pattern in ("*", "*/*")
        for file in sorted(Path(path).glob(pattern))
        if file.is_file()
    ]
    return hashlib.sha256(utf8("\n".join(parts))).hexdigest()


def file_digest(path: str | os.PathLike) -> str:
    """SHA-256 of a file's bytes, hex. Raises InputError."""
    require_file(path)
    with reading(path), open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def first_bytes(path: str | os.PathLike, count: int) -> bytes:
    """The first `count` bytes of a file, or all of a shorter one. Raises InputError."""
    require_file(path)
    with reading(path), open(path, "rb") as stream:
        return stream.read(count)


@contextlib.contextmanager
def reading(path: str | os.PathLike) -> Iterator[None]:
    """OSError within the block becomes the InputError for a file."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror})", path, "check the file and its permissions"
        ) from error


def require_file(path: str | os.PathLike) -> int:
    """Raise InputError, saying which, unless `path` is an existing, non-empty, ordinary file.

    Returns its size in bytes.
    """
    path = Path(path)
    settle(path)
    try:
        if path.is_dir():
            raise InputError("is a folder, not a file", path, "name a file in it")
        if not path.exists():
            raise InputError(
                "does not exist", path, "check the name, or run the stage that makes it"
            )
        if not path.is_file():
            raise InputError("is not an ordinary file", path, "copy it to a file first")
        size = path.stat().st_size
    except OSError as error:
        raise InputError(
            f"cannot be reached ({error.strerror})", path, "check the name and the permissions"
        ) from error
    if size == 0:
        raise InputError("is empty (0 bytes)", path, "make or copy it again")
    return size
