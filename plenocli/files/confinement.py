"""What a process that decodes foreign files may still do: compute within limits, read, and answer.

Limits of memory, processor time and file sizes hold everywhere; Linux adds Landlock (no writing, no
programs, no TCP) and a filter of system calls (no sockets at all).
"""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import struct
import sys

from plenocli.base.memory import hold

_NO_NEW_PRIVILEGES, _SECCOMP, _FILTER = 38, 22, 2
_CREATE_RULESET, _RESTRICT_SELF = 444, 446
_FS_RIGHTS = {1: 0x1FF3, 2: 0x3FF3, 3: 0x7FF3, 5: 0xFFF3}
"""By version of Landlock: all rights over files but to read them and to list folders."""
_TCP, _SCOPES = 0x3, 0x3
_CALLS = {
    "x86_64": (
        0xC000003E,
        (41, 425, 101, 311, 90, 91, 92, 93, 94, 188, 189, 190, 197, 198, 199, 260, 268, 280, 452),
    ),
    "aarch64": (0xC00000B7, (198, 425, 117, 271, 5, 6, 7, 14, 15, 16, 52, 53, 54, 55, 88, 452)),
}
"""By machine, its mark and the numbers of calls that are refused: socket, io_uring_setup, ptrace,
process_vm_writev, and those that change permissions, owners, attributes and times of files, which
Landlock lets pass.
"""


def confine(memory: int) -> list[str]:
    """Bind this process for good, before any foreign byte is parsed.

    memory: bytes for data, as `hold` grants them.

    Returns what the kernel lacks, in words: nothing where all holds.
    """
    hold(memory)
    for kind in (resource.RLIMIT_DATA, resource.RLIMIT_FSIZE, resource.RLIMIT_CORE):
        most = resource.getrlimit(kind)[0] if kind == resource.RLIMIT_DATA else 0
        resource.setrlimit(kind, (most, most))
    if sys.platform != "linux":
        return ["Landlock", "filter of system calls"]
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    found = (("Landlock", _landlock(libc)), ("filter of system calls", _no_sockets(libc)))
    return [name for name, holds in found if not holds]


def grant_seconds(seconds: int) -> None:
    """The processor time, s, that this process may take from now on."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    most = int(used.ru_utime + used.ru_stime) + seconds + 1
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    if hard != resource.RLIM_INFINITY:
        most = min(most, hard)
    resource.setrlimit(resource.RLIMIT_CPU, (most, hard))


def _landlock(libc: ctypes.CDLL) -> bool:
    """Whether files can no longer be written, made, renamed, removed or run."""
    version = libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), 1)
    if version < 1:
        return False
    rights = _FS_RIGHTS[max(v for v in _FS_RIGHTS if v <= version)]
    tcp, scopes = _TCP if version >= 4 else 0, _SCOPES if version >= 6 else 0
    rules = struct.pack("=QQQ", rights, tcp, scopes)
    size = 8 if version < 4 else 16 if version < 6 else 24
    ruleset = libc.syscall(_CREATE_RULESET, rules, ctypes.c_size_t(size), 0)
    if ruleset < 0:
        return False
    done = libc.syscall(_RESTRICT_SELF, ruleset, 0)
    os.close(ruleset)
    return done == 0


def _no_sockets(libc: ctypes.CDLL) -> bool:
    """Whether the kernel now refuses _CALLS."""
    if platform.machine() not in _CALLS or sys.maxsize < 2**32:
        return False
    machine, calls = _CALLS[platform.machine()]
    deny = len(calls) + 2  # where the last but one instruction stands, counted from the fifth
    code = [(0x20, 0, 0, 4), (0x15, 1, 0, machine), (0x06, 0, 0, 0x00050001), (0x20, 0, 0, 0)]
    code += [(0x35, deny - 1, 0, 0x40000000)]  # calls by the numbers of another interface
    code += [(0x15, deny - 2 - i, 0, call) for i, call in enumerate(calls)]
    code += [(0x06, 0, 0, 0x7FFF0000), (0x06, 0, 0, 0x00050001)]
    program = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *line) for line in code))
    described = struct.pack("@HP", len(code), ctypes.addressof(program))
    return libc.prctl(_SECCOMP, _FILTER, described, 0, 0) == 0
