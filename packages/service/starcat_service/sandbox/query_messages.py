"""Messages between the server and a process that runs queries, without values and rows.

A request is the name of a method of `starcat_service.sandbox.query_worker.QueryWorker`, a time and
its arguments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from starcat.errors import AnswerTooLarge
from starcat.query import Columns, Statement
from starcat_service.sandbox.messages import MalformedMessage


@dataclass(frozen=True)
class Opening:
    """The settings of a process, sent before it starts DuckDB."""

    spill: str  # folder for data that do not fit into memory; the only folder it may write in
    # Gigabytes of memory and of disk that DuckDB may take.
    memory_gb: float
    disk_gb: float
    parent: int  # number of the parent process; the worker ends when the parent does
    message_bytes: int  # size of a message at most


def read_statement(content: Any) -> Statement:
    """Return the statement that a process sent as JSON, or raise MalformedMessage."""
    try:
        view = content["view"]
        return Statement(
            str(content["text"]),
            bool(content["is_description"]),
            None if view is None else (str(view[0]), str(view[1])),
            tuple(map(str, content["parameters"])),
            {str(name): str(argument) for name, argument in content["numbers"].items()},
        )
    except (TypeError, LookupError, AttributeError) as error:
        raise MalformedMessage("the process of the query sent no statement") from error


def read_columns(content: Any) -> Columns:
    """Return the columns that a process sent; MalformedMessage if there are none."""
    try:
        return [(str(name), str(kind)) for name, kind in content]
    except (TypeError, ValueError) as error:
        raise MalformedMessage("the process of the query sent no columns") from error


def read_footer(content: Any) -> tuple[str, dict[str, str]]:
    """Return the schema's name and the columns of a footer that a process sent."""
    try:
        name, columns = content
        return str(name), {str(column): str(kind) for column, kind in columns.items()}
    except (TypeError, ValueError, AttributeError) as error:
        raise MalformedMessage("the process of the query sent no footer") from error


def too_large(max_bytes: int) -> AnswerTooLarge:
    """Return the error for an answer of more than ``max_bytes``."""
    return AnswerTooLarge(
        f"the answer has more than {max_bytes / 1e6:,.0f} MB; ask for fewer rows or columns"
    )
