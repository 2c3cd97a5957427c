"""What a session and the process that runs its queries tell each other beside values and rows.

A request is the name of a method of `starcat.query.worker.QueryWorker`, a time and its arguments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from starcat.errors import AnswerTooLarge
from starcat.workers.messages import MalformedMessage


@dataclass(frozen=True)
class Opening:
    """What a process is told before it starts DuckDB."""

    spill: str  # folder for what does not fit into the memory; the only one it may write in
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


def too_large(max_bytes: int) -> AnswerTooLarge:
    """Return the error for an answer of more bytes than wanted."""
    return AnswerTooLarge(
        f"the answer has more than {max_bytes / 1e6:,.0f} MB; ask for fewer rows or columns"
    )
