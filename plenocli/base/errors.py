"""The errors a user can meet, each with the exit code that the command line gives for it.

A message says what is wrong, where (file, field, option) and what to do about it.
"""

from __future__ import annotations

import errno

from plenocli.base.text import printable


class PlenoError(Exception):
    """Root of all expected failures. `exit_code` is what the process returns."""

    exit_code = 70

    def __init__(self, what: object, where: object = None, fix: str | None = None) -> None:
        """what: is wrong, a predicate of `where` where that is a file.
        where: file, field or option.
        fix: what to do about it.
        """
        super().__init__(what)
        where = None if where is None else printable(str(where))
        self.what, self.where, self.fix = str(what), where, fix

    def __str__(self) -> str:
        text = f"{self.where}: {self.what}" if self.where else self.what
        return f"{text}; {self.fix}" if self.fix else text

    def at(self, where: object) -> PlenoError:
        """The same error, with the place that whoever raised it could not know."""
        return type(self)(self.what, where, self.fix)


class UsageError(PlenoError):
    """The command line asks for something that makes no sense."""

    exit_code = 2


class ConfigError(UsageError):
    """A configuration file breaks its rules; the message lists every violation."""


class InputError(PlenoError):
    """An input file is missing, unreadable, damaged, implausible or of the wrong kind."""

    exit_code = 3


class OutputError(PlenoError):
    """The result could not be written; what stood at the target before is untouched."""

    exit_code = 4


class NumericsError(PlenoError):
    """The numbers do not allow an answer, or not to the accuracy asked for."""

    exit_code = 5


def remedy(error: OSError) -> str:
    """What to do where a file or folder cannot be made."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "free some space or choose another folder"
    return "check the folder and its permissions"
