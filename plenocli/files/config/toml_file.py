"""The text of a description file: found, of a sensible size, UTF-8."""

from pathlib import Path

from plenocli.base.errors import InputError

MAX_BYTES = 1 << 20
"""No camera description is longer; what is, is some other file."""


def read_text(path: Path, what: str, wanted: str | None = None) -> str:
    """The text of a file that describes something.

    path: of the file.
    what: it describes (camera, scene), for messages.
    wanted: what to give instead where it cannot be read; None: the TOML file of `what`.

    Raises InputError where it cannot be read.
    """
    fix = wanted or f"give the TOML file of a {what}"
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"is {'a folder' if path.is_dir() else 'no ordinary file'}", path, fix)
        if path.stat().st_size > MAX_BYTES:
            raise InputError(
                f"is larger than {MAX_BYTES} bytes and so no {what} description", path, fix
            )
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}",
            path,
            wanted or f"{fix}, see `plenocli schema {what}`",
        ) from None
    except UnicodeDecodeError:
        raise InputError("is not UTF-8 text", path, fix) from None
