"""The text of a description file: found, of a sensible size, UTF-8."""

from pathlib import Path

from plenocli.base.errors import InputError

MAX_BYTES = 1 << 20
"""No camera description is longer; what is, is some other file."""


def read_text(path: Path, what: str) -> str:
    """The text of a TOML file.

    path: of the file.
    what: it describes (camera, scene), for messages.

    Raises InputError where it cannot be read.
    """
    try:
        if path.exists() and not path.is_file():
            raise InputError(
                f"is {'a folder' if path.is_dir() else 'no ordinary file'}",
                path,
                f"give the TOML file of a {what}",
            )
        if path.stat().st_size > MAX_BYTES:
            raise InputError(
                f"is larger than {MAX_BYTES} bytes and so no {what} description",
                path,
                "give a TOML file",
            )
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}",
            path,
            f"give the TOML file of a {what}, see `plenocli schema {what}`",
        ) from None
    except UnicodeDecodeError:
        raise InputError("is not UTF-8 text", path, f"give the TOML file of a {what}") from None
