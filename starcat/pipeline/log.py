"""The build log: seconds and memory of one run, in a file next to the database.

They differ between runs, so they are not a part of the database and not in any digest.
"""

from __future__ import annotations

import glob
import os
import platform
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from starcat.database.manifest import software_versions
from starcat.storage.atomic import json_bytes, locked, whole_file


class Stopwatch:
    """Seconds that each stage of a build has taken."""

    def __init__(self) -> None:
        self._began = self._last = time.perf_counter()
        self._seconds: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        """Record the end of a stage."""
        now = time.perf_counter()
        self._seconds[stage] = self._seconds.get(stage, 0.0) + now - self._last
        self._last = now

    @property
    def times_s(self) -> dict[str, float]:
        """Seconds by stage, in order, and the total up to the last stage."""
        total = {"total": self._last - self._began}
        return {stage: round(taken, 4) for stage, taken in (self._seconds | total).items()}


def peak_memory_bytes() -> int | None:
    """Return the peak memory of this process."""
    if sys.platform == "win32":
        return None
    status = Path("/proc/self/status")
    if status.is_file():
        # Unlike ru_maxrss, VmHWM does not include the peak of the parent process.
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def available_memory_bytes() -> int | None:
    """Return the memory available to this process."""
    try:
        fields = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        available = 1024 * int(fields["MemAvailable"].split()[0]) + resident
    except (OSError, KeyError, ValueError, IndexError):
        try:
            return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        except (AttributeError, OSError, ValueError):
            return None
    try:
        return min(available, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, ValueError):  # no control group, or no limit
        return available


def write_build_log(database: Path, outcome: str, times_s: Mapping[str, float]) -> Path:
    """Write the log of a build next to its database.

    The lock of the folder shows that unfinished logs in it are of killed processes.
    """
    content: dict[str, Any] = {
        "artifact": database.name,
        "outcome": outcome,
        "times_s": dict(times_s),
        "peak_memory_bytes": peak_memory_bytes(),
        "processors": os.cpu_count(),
        "platform": platform.platform(),
        "software": software_versions(),
    }
    final = database.with_name(f"{database.name}.build.json")
    with locked(final.parent) as is_certain:
        for unfinished in final.parent.glob(f".{glob.escape(final.name)}.*.partial"):
            if is_certain:
                unfinished.unlink(missing_ok=True)
        with whole_file(final) as partial:
            partial.write_bytes(json_bytes(content))
    return final
