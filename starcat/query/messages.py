"""What a session and the process that runs its queries say to each other.

A request is the name of a method of `starcat.query.worker.Worker` and its arguments; the replies
are pairs of a kind and what it brings. Both are pickled: each end is a process of this starcat.
"""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path

PROGRESS = "progress"  # a percentage; more replies follow
PART = "part"  # a part of the answer; more replies follow
DONE = "done"  # the answer, or the last part of it
REFUSED = "refused"  # a message: the query cannot be answered
SHORT = "short"  # a message: memory or disk ran out
BROKEN = "broken"  # a message: DuckDB failed, and should answer nothing more
INTERRUPT = signal.SIGUSR1 if os.name == "posix" else signal.SIGTERM  # end what is asked
ENDINGS = {DONE, REFUSED, SHORT, BROKEN}


@dataclass(frozen=True)
class Opening:
    """What a process is told before it starts DuckDB."""

    spill: Path  # folder for what does not fit into the memory; the only one it may write in
    # Gigabytes that DuckDB may take of each.
    memory_gb: float
    disk_gb: float
    parent: int  # number of the process that asks; the worker ends when that one does


@dataclass(frozen=True)
class Statement:
    """A query that may run."""

    # SQL that DuckDB wrote from the syntax tree that was checked, with EXPLAIN before it where that
    # was asked for. Nothing else of the text that was given runs.
    text: str
    is_description: bool = False  # whether it is a DESCRIBE, whose rows are columns
    # Schema and name of the view that a DESCRIBE is about; the schema is empty where it has none.
    view: tuple[str, str] | None = None
    parameters: tuple[str, ...] = ()  # names of the $name in it
