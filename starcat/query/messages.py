"""What a session and the process that runs its queries say to each other.

A request is the name of a method of `starcat.query.worker.Worker` and its arguments. Each reply has
one of the kinds below. `starcat.query.frames` makes bytes of both. The process is confined and the
session is not, so the session trusts nothing that it reads.
"""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starcat.query.frames import MalformedMessage

REQUEST = "?"  # name of the method, seconds, arguments
PROGRESS = "%"  # a percentage; more replies follow
PART = "p"  # some rows; more replies follow
DONE = "d"  # the answer, or what follows the rows, as JSON
ARROW = "a"  # the answer, as an Arrow stream
REFUSED = "r"  # a text: the query cannot be answered
SHORT = "s"  # a text: memory or disk ran out
LARGE = "l"  # a text: the answer is larger than the session takes
BROKEN = "b"  # a text: DuckDB failed, and should answer nothing more
INTERRUPT = signal.SIGUSR1 if os.name == "posix" else signal.SIGTERM  # end what is asked
ENDINGS = {DONE, ARROW, REFUSED, SHORT, LARGE, BROKEN}
HARMLESS = {DONE, ARROW, REFUSED, LARGE}  # the process can be asked again afterwards


@dataclass(frozen=True)
class Opening:
    """What a process is told before it starts DuckDB."""

    spill: Path  # folder for what does not fit into the memory; the only one it may write in
    # Gigabytes that DuckDB may take of each.
    memory_gb: float
    disk_gb: float
    parent: int  # number of the process that asks; the worker ends when that one does
    message_bytes: int  # size of a message at most


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

    @classmethod
    def from_json(cls, found: Any) -> Statement:
        """Return the statement that a process sent as JSON; MalformedMessage if it is none."""
        try:
            view = found["view"]
            return cls(
                str(found["text"]),
                bool(found["is_description"]),
                None if view is None else (str(view[0]), str(view[1])),
                tuple(map(str, found["parameters"])),
            )
        except (TypeError, LookupError) as error:
            raise MalformedMessage("the process of the query sent no statement") from error
