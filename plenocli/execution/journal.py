"""Results of many small tasks, kept as they come: one line each in a file that is
only ever added to.

A line is a short checksum and a JSON record. A run that is killed leaves at most its last line
torn; torn and damaged lines are left out when the file is read, so that their tasks are done again.
"""

import fcntl
import hashlib
import json
import os
from pathlib import Path
from typing import Any

from plenocli.base.errors import OutputError, remedy
from plenocli.base.text import json_value
from plenocli.files.atomic import sync_folder


class Journal:
    """Records by key in a file, which one run at a time holds.

    records: key -> what was kept, as JSON knows it.
    """

    def __init__(self, path: str | Path) -> None:
        """Open or make the file at `path`.

        Raises OutputError where it cannot be written, or another run holds it.
        """
        self.path = Path(path)
        self.records: dict[str, Any] = {}
        try:
            self._file = open(self.path, "a+b", buffering=0)
        except OSError as error:
            raise OutputError(
                f"cannot be written ({error.strerror})", path, remedy(error)
            ) from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise OutputError(
                "another run is working here", path, "wait for it, stop it, or choose another OUT"
            ) from None
        self._file.seek(0)
        content = self._file.read()
        for line in content.split(b"\n"):
            known = _read(line)
            if known is not None:
                self.records[known[0]] = known[1]
        if content and not content.endswith(b"\n"):
            self._write(b"\n")  # ends the torn line
        if not content:
            sync_folder(self.path.parent)  # else the power may take a new file with all its lines

    def add(self, key: str, record: Any) -> None:
        """Keep a record (JSON-able) for good before this returns."""
        text = json.dumps(
            [key, json_value(record)], sort_keys=True, ensure_ascii=True, allow_nan=False
        ).encode()
        self._write(_checksum(text) + b" " + text + b"\n")
        self.records[key] = json.loads(text)[1]

    def _write(self, data: bytes) -> None:
        try:
            while data:
                data = data[os.write(self._file.fileno(), data) :]
            os.fsync(self._file.fileno())
        except OSError as error:
            raise OutputError(
                f"cannot be written ({error.strerror})",
                self.path,
                "free some space, then run again: what is finished is kept",
            ) from None

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()


def _checksum(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest()[:16].encode()


def _read(line: bytes) -> tuple[str, Any] | None:
    """(key, record) of a whole and undamaged line, else None."""
    checksum, _, text = line.partition(b" ")
    if checksum != _checksum(text):
        return None
    try:
        key, record = json.loads(text)
        return str(key), record
    except (ValueError, TypeError, RecursionError):  # sealed, but none of ours
        return None
