"""Questions in SQL that requests ask: to rows, or to a file of any format."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from starcat.errors import QueryError
from starcat.query.gallery import named_query
from starcat.service.answer_files import file_of_rows, keep_rows
from starcat.service.service import Service
from starcat.service.uploading import scratch_folder

LARGEST_WHOLE = 2**53 - 1
"""The largest whole number that every reader of JSON keeps."""


@dataclass(frozen=True)
class Question:
    """What is asked.

    Attributes
    ----------
    targets : sequence of str
        What it is about, as `target_paths` takes it.
    text : str
        SQL.
    values : mapping of str to object
        The values of the ``$name`` in it.
    max_rows : int
        Rows that are wanted at most.
    time_s : float
        Seconds that it may take.
    """

    targets: Sequence[str]
    text: str
    values: Mapping[str, Any]
    max_rows: int
    time_s: float


@dataclass(frozen=True)
class Rows:
    """The rows that were found.

    Attributes
    ----------
    columns : list of dict
        ``name``, ``type``, ``unit`` and ``description`` of each.
    rows : list of list
        Values that JSON has.
    is_cut : bool
        Whether there are more.
    """

    columns: list[dict[str, str]]
    rows: list[list[Any]]
    is_cut: bool


@dataclass(frozen=True)
class Answered:
    """An answer in a file.

    Attributes
    ----------
    chunks : iterator of bytes
        The content.
    size : int
        Bytes.
    rows : int
        Rows.
    is_cut : bool
        Whether there are more.
    """

    chunks: Iterator[bytes]
    size: int
    rows: int
    is_cut: bool


def named_text(
    name: str, values: Mapping[str, Any], targets: int
) -> tuple[str, dict[str, int | float | str]]:
    """Return a query of the gallery."""
    query = named_query(name)
    if query.targets != targets:
        raise QueryError(f"{query.name} is about {query.targets} targets; {targets} given")
    return query.text, query.with_values({key: str(value) for key, value in values.items()})


def rows_of(service: Service, question: Question) -> Rows:
    """Answer a question with rows."""
    paths = [service.library.target(name) for name in question.targets]
    with (
        service.query_pool.session(paths, question.time_s) as session,
        session.ask(question.text, question.values) as running,
    ):
        found = running.rows(question.max_rows + 1)
        columns = [
            {"name": name, "type": kind, "unit": facts.unit, "description": facts.description}
            for name, kind, facts in zip(running.columns, running.types, running.facts, strict=True)
        ]
    shown = [[plain(value) for value in row] for row in found[: question.max_rows]]
    return Rows(columns, shown, len(found) > question.max_rows)


def file_of(service: Service, question: Question, form: str) -> Answered:
    """Answer a question with a file."""
    paths = [service.library.target(name) for name in question.targets]
    with scratch_folder(service.paths) as folder:
        source, target = folder / "rows.arrow", folder / "answer"
        with (
            service.query_pool.session(paths, question.time_s) as session,
            session.ask(question.text, question.values) as running,
        ):
            count, is_cut = keep_rows(running.batches(), source, question.max_rows)
        chunks, size = file_of_rows(service.sandbox, source, target, form)
    return Answered(chunks, size, count, is_cut)


def plain(value: Any) -> Any:
    """Return a value as JSON has it.

    Examples
    --------
    >>> plain(2**60), plain(float("nan")), plain([1, 0.5])
    ('1152921504606846976', None, [1, 0.5])
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int):
        return value if abs(value) <= LARGEST_WHOLE else str(value)
    if isinstance(value, float | Decimal):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, dt.date | dt.time):
        return value.isoformat()
    return value.hex() if isinstance(value, bytes) else str(value)
