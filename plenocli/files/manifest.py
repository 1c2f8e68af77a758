"""What a folder holds, file by file: SHA256SUMS as coreutils writes it, so that `sha256sum -c`
reads it too, and its signature by `ssh-keygen -Y`.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

from plenocli.base.errors import InputError, OutputError
from plenocli.base.text import printable
from plenocli.files.artefacts.provenance import file_digest, first_bytes
from plenocli.files.atomic import publish, together

NAME, SIGNATURE = "SHA256SUMS", "SHA256SUMS.sig"
"""In the folder that they speak of."""
_NAMESPACE = "plenocli"
_LINE = re.compile(rb"(\\?)([0-9a-f]{64})  (.+)", re.DOTALL)
_ESCAPES = {b"\\\\": b"\\", b"\\n": b"\n", b"\\r": b"\r"}
_MOST_BYTES = 64 << 20
_OF_NOTHING = hashlib.sha256().hexdigest()


def digests(root: Path) -> dict[str, str]:
    """Name within the folder -> SHA-256, hex, of every ordinary file in it and its folders; hidden
    ones and the folder's own manifest are left out, links to folders not followed.

    Raises InputError where one cannot be read, or the folder holds none.
    """
    if not root.is_dir():
        raise InputError("is no folder", root, "name the folder of a run, such as runs/demo")
    found = {}
    for name in _names(root):
        file = root / name
        found[name] = file_digest(file) if file.stat().st_size else _OF_NOTHING
    if not found:
        raise InputError("holds no file", root, "name the folder of a run, such as runs/demo")
    return found


def _names(root: Path) -> Iterator[str]:
    def told(error: OSError) -> None:
        raise InputError(
            f"cannot be read ({error.strerror})", error.filename or root, "check its permissions"
        )

    for folder, folders, files in os.walk(root, onerror=told):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            path = Path(folder, name)
            if name.startswith(".") or not path.is_file():
                continue
            within = path.relative_to(root).as_posix()
            if within not in (NAME, SIGNATURE):
                yield within


def write_manifest(root: Path, found: Mapping[str, str], key: Path | None = None) -> None:
    """Put digests into the manifest of a folder, in the place of one that is there, and sign it.

    key: SSH key (`ssh-keygen -Y sign`, which asks for its passphrase); None leaves it unsigned.

    Raises OutputError where it cannot be written or signed; all is as it was then.
    """
    content = b"".join(_line(name, digest) for name, digest in sorted(found.items()))
    with together():
        if key is not None:
            made = _ssh(["sign", "-q", "-f", str(key)], content)
            if made.returncode:
                raise OutputError(
                    f"cannot be signed ({_reason(made)})", root / NAME, "give --sign an SSH key"
                )
            publish(root / SIGNATURE, made.stdout, overwrite=True)
        publish(root / NAME, content, overwrite=True)


def _line(name: str, digest: str) -> bytes:
    plain = os.fsencode(name)
    written = plain
    for escape, byte in _ESCAPES.items():
        written = written.replace(byte, escape)
    mark = b"\\" if written != plain else b""
    return mark + digest.encode() + b"  " + written + b"\n"


def read_manifest(root: Path) -> dict[str, str]:
    """Name -> SHA-256, hex, as the manifest of a folder has them.

    Raises InputError where it is missing, is none, or names a file outside its folder.
    """
    path = root / NAME
    content = first_bytes(path, _MOST_BYTES + 1)
    if len(content) > _MOST_BYTES or not content.endswith(b"\n"):
        raise InputError("is damaged: it does not end as a list of digests", path, _ANEW)
    found: dict[str, str] = {}
    for number, line in enumerate(content[:-1].split(b"\n"), start=1):
        parts = _LINE.fullmatch(line)
        if parts is None:
            raise InputError(f"is damaged: line {number} is no digest and name", path, _ANEW)
        mark, digest, written = parts.groups()
        name = os.fsdecode(_unescaped(written) if mark else written)
        inside = PurePosixPath(name)
        if inside.is_absolute() or ".." in inside.parts or "\0" in name or name in found:
            raise InputError(
                f"line {number} names {printable(name)}, which is no file of this folder or is "
                "listed twice",
                path,
                _ANEW,
            )
        found[name] = digest.decode()
    return found


_ANEW = "write it anew: plenocli seal FOLDER"


def _unescaped(written: bytes) -> bytes:
    return re.sub(rb"\\[\\nr]", lambda found: _ESCAPES[found[0]], written)


def differences(found: Mapping[str, str], listed: Mapping[str, str]) -> tuple[str, ...]:
    """What a folder holds (`digests`) against what a manifest says: sorted names of the folder,
    each with what is wrong with it.
    """
    names = sorted(n for n in found.keys() | listed.keys() if found.get(n) != listed.get(n))
    return tuple(
        f"{n} {'missing' if n not in found else 'altered' if n in listed else 'not listed'}"
        for n in names
    )


def signer(root: Path, allowed: Path) -> str:
    """Who of the allowed signers signed the manifest of a folder.

    allowed: file as `ssh-keygen` describes under ALLOWED SIGNERS.

    Raises InputError where it is not signed, by none of them, or altered since.
    """
    signature = root / SIGNATURE
    first_bytes(signature, 1)
    first_bytes(allowed, 1)
    files = ["-f", str(allowed), "-s", str(signature)]
    content = (root / NAME).read_bytes()
    who = _ssh(["find-principals", *files], content)
    name = who.stdout.decode(errors="replace").split("\n")[0].strip()
    if who.returncode or not name:
        raise InputError("is not by an allowed signer", signature, "ask who made the run")
    checked = _ssh(["verify", *files, "-I", name], content)
    if checked.returncode:
        raise InputError(
            f"does not fit {NAME}, which was altered after it was signed ({_reason(checked)})",
            signature,
            "ask who made the run",
        )
    return printable(name)


def _ssh(arguments: list[str], content: bytes) -> subprocess.CompletedProcess:
    action, *rest = arguments
    try:
        return subprocess.run(
            ["ssh-keygen", "-Y", action, "-n", _NAMESPACE, *rest],
            input=content,
            capture_output=True,
            check=False,
        )
    except FileNotFoundError:
        raise OutputError(
            "ssh-keygen is not installed, which signs and checks signatures",
            None,
            "install OpenSSH",
        ) from None


def _reason(made: subprocess.CompletedProcess) -> str:
    return printable(made.stderr.decode(errors="replace").strip() or "it does not say why")
