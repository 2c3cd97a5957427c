"""Messages between a session and the process that runs its queries, without values and rows.

A request is the name of a method of `starcat.query.worker.QueryWorker`, a time and its arguments.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from starcat.errors import AnswerTooLarge
from starcat.workers.messages import MalformedMessage


@dataclass(frozen=True)
class Opening:
    """The settings of a process, sent before it starts DuckDB."""

    spill: str  # folder for data that do not fit into memory; the only folder it may write in
    # Gigabytes of memory and of disk that DuckDB may take.
    memory_gb: float
    disk_gb: float
    parent: int  # number of the parent process; the worker ends when the parent does
    message_bytes: int  # size of a message at most


@dataclass(frozen=True)
class Statement:
    """A query that may run."""

    # SQL that DuckDB wrote from the checked syntax tree, after EXPLAIN if the user wrote that.
    # Nothing else of the user's text runs.
    text: str
    is_description: bool = False  # true for a DESCRIBE, whose rows are columns
    # Schema and name of the view of a DESCRIBE; the schema is empty if it is not given.
    view: tuple[str, str] | None = None
    parameters: tuple[str, ...] = ()  # names of the $name in it
    # For a $name that has to be a number: the argument of a macro that it is given for.
    numbers: dict[str, str] = field(default_factory=dict)

    @classmethod
    def from_json(cls, found: Any) -> Statement:
        """Return the statement that a process sent as JSON, or raise MalformedMessage."""
        try:
            view = found["view"]
            return cls(
                str(found["text"]),
                bool(found["is_description"]),
                None if view is None else (str(view[0]), str(view[1])),
                tuple(map(str, found["parameters"])),
                {str(name): str(argument) for name, argument in found["numbers"].items()},
            )
        except (TypeError, LookupError, AttributeError) as error:
            raise MalformedMessage("the process of the query sent no statement") from error


def too_large(max_bytes: int) -> AnswerTooLarge:
    """Return the error for an answer of more than ``max_bytes``."""
    return AnswerTooLarge(
        f"the answer has more than {max_bytes / 1e6:,.0f} MB; ask for fewer rows or columns"
    )
