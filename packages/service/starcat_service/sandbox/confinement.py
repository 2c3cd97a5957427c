"""Limits of a process by the operating system: memory, processor time, files to write.

The process that runs queries (`starcat_service.sandbox.query_worker`) drops permissions that it
does not need before it reads a target. Memory and processor time are limited on POSIX systems,
where Python has the module ``resource``. On Linux 5.13 and later Landlock forbids writing outside
of one folder. On other systems only the checks of starcat itself apply (`starcat.query.statement`).
"""

from __future__ import annotations

import ctypes
import math
import os
import struct
import sys
from pathlib import Path

if sys.platform != "win32":
    import resource

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
"""Numbers of the system calls of Landlock, on every architecture."""

_SET_NO_NEW_PRIVILEGES = 38

_WRITES = {1: 0x1FF2, 2: 0x2000, 3: 0x4000}
"""Flags of changes to files by the version of Landlock that introduced them: writing, removing and
making files and folders (1), moving (2), truncating (3). From linux/landlock.h."""


def forbid_writing(except_in: Path) -> bool:
    """Forbid this process to write, make or remove files, even if their permissions allow it.

    It also applies to threads that start later, and cannot be undone.
    """
    if sys.platform != "linux":
        return False
    system = ctypes.CDLL(None, use_errno=True)
    version = system.syscall(_CREATE_RULESET, None, 0, 1)
    if version < 1:
        return False
    writes = sum(bits for since, bits in _WRITES.items() if version >= since)
    handled = struct.pack("Q", writes)
    rules = system.syscall(_CREATE_RULESET, handled, len(handled), 0)
    folder = os.open(except_in, os.O_PATH | os.O_DIRECTORY)
    try:
        steps = (
            rules >= 0
            and not system.syscall(_ADD_RULE, rules, 1, struct.pack("=Qi", writes, folder), 0)
            and not system.prctl(_SET_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
            and not system.syscall(_RESTRICT_SELF, rules, 0)
        )
    finally:
        os.close(folder)
        if rules >= 0:
            os.close(rules)
    return steps


def limit_memory(more_bytes: int) -> None:
    """Limit the memory of this process."""
    if sys.platform == "win32":
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # Limit the writable memory (data). Reserved addresses (RLIMIT_AS) are many times larger on
    # machines with many processors, and not meaningful.
    if sys.platform == "linux":
        _lower(resource.RLIMIT_DATA, _data_bytes() + more_bytes)
    else:
        _lower(resource.RLIMIT_AS, more_bytes)


def limit_time(more_s: float) -> None:
    """Limit the processor time of this process; the system ends it when it takes more."""
    if sys.platform == "win32":
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    soft = math.ceil(used.ru_utime + used.ru_stime + more_s)
    if hard in (resource.RLIM_INFINITY, -1) or soft <= hard:
        resource.setrlimit(resource.RLIMIT_CPU, (soft, hard))


def _lower(kind: int, limit: int) -> None:
    """Set a limit permanently, unless a lower limit exists."""
    if sys.platform == "win32":
        return
    _, hard = resource.getrlimit(kind)
    if hard in (resource.RLIM_INFINITY, -1) or limit < hard:
        try:
            resource.setrlimit(kind, (limit, limit))
        except (OSError, ValueError):  # macOS has the limit but refuses to set it
            return


def _data_bytes() -> int:
    """Return the writable memory of this process, bytes."""
    lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmData:"))
