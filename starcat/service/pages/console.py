"""The SQL console: a question about a database, the first rows of its answer, or all in a file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from fastapi import Depends, Query, Request
from fastapi.responses import Response, StreamingResponse
from starlette.concurrency import run_in_threadpool

from starcat.errors import QueryError, StarcatError, TargetMissing
from starcat.exchange.formats import FORMATS, PAGE_FORMATS, PageFormat
from starcat.query.gallery import NamedQuery, gallery, guessed, macros, named_query
from starcat.query.result import ResultTable
from starcat.service.access import Reader
from starcat.service.pages.facts import database_row, products_of
from starcat.service.pages.rendering import page_router, render
from starcat.service.problems import Problem, ProblemDetails, problem_of
from starcat.service.service import Service, TheService
from starcat.service.sql import SqlQuery, result_file, result_table

router = page_router()

ROWS = (20, 100, 500, 2000)
"""Rows that can be shown."""

VALUE = "value."
"""What the names of fields with values of ``$name`` begin with."""

MAX_TEXT = 8_000
"""Characters of a query, which is part of an address."""

FIRST = "SELECT designation, mag, ra_deg, dec_deg\nFROM stars\nORDER BY mag\nLIMIT 20"
"""What stands in the console before anything was asked."""

_NAMES = re.compile(r"\$([A-Za-z_]\w{0,63})")


@dataclass(frozen=True)
class Asked:
    """What the form of the console says.

    Attributes
    ----------
    query : str
        SQL; empty where nothing was asked yet.
    named : str
        Query of the gallery that was chosen; empty without one.
    other : str
        Id of a second database; empty without one.
    rows : int
        Rows to show at most.
    values : dict of str to str
        Texts of the values of the ``$name`` in it.
    """

    query: str = ""
    named: str = ""
    other: str = ""
    rows: int = 100
    values: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Shown:
    """What the console shows, or its answer alone."""

    asked: Asked
    answer: ResultTable | None
    problem: ProblemDetails | None
    is_part: bool


def asked_of(
    request: Request,
    query: Annotated[str, Query(max_length=MAX_TEXT)] = "",
    named: Annotated[str, Query(max_length=100)] = "",
    other: Annotated[str, Query(max_length=64)] = "",
    rows: Annotated[int, Query(ge=1, le=max(ROWS))] = 100,
) -> Asked:
    """Return what the form of the console says."""
    values = {
        name.removeprefix(VALUE): text
        for name, text in request.query_params.items()
        if name.startswith(VALUE) and len(name) < 80
    }
    return Asked(query.replace("\r\n", "\n"), named, other, rows, values)


TheAsked = Annotated[Asked, Depends(asked_of)]


@router.get("/databases/{database_id}/sql")
async def console(
    request: Request,
    service: TheService,
    _: Reader,
    database_id: str,
    asked: TheAsked,
    part: Annotated[Literal["", "answer"], Query()] = "",
) -> Response:
    """Show the console with the answer to what was asked; the script wants the answer alone."""
    answer: ResultTable | None = None
    problem: ProblemDetails | None = None
    if asked.query:
        try:
            answer = await service.query_pool.run(_rows, service, database_id, asked)
        except TargetMissing:
            raise  # the page itself is not there
        except (StarcatError, Problem) as error:
            problem = problem_of(error)
    shown = _Shown(asked, answer, problem, is_part=bool(part))
    return await run_in_threadpool(_page, request, service, database_id, shown)


@router.get("/databases/{database_id}/sql/file")
async def answer_file(
    service: TheService, _: Reader, database_id: str, asked: TheAsked, form: PageFormat = "csv"
) -> Response:
    """Give all rows of an answer as a file."""
    database = service.library.database(database_id)
    question = question_of(service, database.id, asked, service.settings.max_rows)
    found = await service.query_pool.run(result_file, service, question, form)
    kind = FORMATS[form]
    headers = {
        "Content-Length": str(found.size),
        "Content-Disposition": f'attachment; filename="{database.title}{kind.suffix}"',
    }
    return StreamingResponse(found.chunks, media_type=kind.media_type, headers=headers)


def question_of(service: Service, database_id: str, asked: Asked, most: int) -> SqlQuery:
    """Return what is asked as the service answers it."""
    if not asked.query.strip():
        raise QueryError('the query is empty; try "SELECT count(*) FROM stars"')
    targets = [database_id, *([asked.other] if asked.other else [])]
    chosen = _chosen(asked.named)
    values: Mapping[str, Any]
    if chosen is not None and asked.query.strip() == chosen.text.strip():
        if chosen.targets != len(targets):
            raise QueryError(f"{chosen.name} is about {chosen.targets} targets; choose the other")
        known = {value.name for value in chosen.values}
        values = chosen.with_values({n: t for n, t in asked.values.items() if n in known})
    else:
        values = {name: guessed(text) for name, text in asked.values.items()}
    return SqlQuery(targets, asked.query, values, most, service.settings.query_time_s)


def _rows(service: Service, database_id: str, asked: Asked) -> ResultTable:
    most = min(asked.rows, service.settings.max_rows)
    found = result_table(service, question_of(service, database_id, asked, most))
    return found.with_json_values()


def _page(request: Request, service: Service, database_id: str, shown: _Shown) -> Response:
    database = service.library.database(database_id)
    asked, problem = shown.asked, shown.problem
    content = {
        "row": database_row(service, database),
        "asked": asked,
        "answer": shown.answer,
        "problem": problem,
        "formats": {name: FORMATS[name].title for name in PAGE_FORMATS},
    }
    status = 200 if problem is None else problem.status
    if shown.is_part:
        return render(request, "console_answer.html", status=status, **content)
    chosen = _chosen(asked.named)
    text = asked.query or (chosen.text if chosen else FIRST)
    return render(
        request,
        "console.html",
        status=status,
        **content,
        tab="sql",
        text=text,
        chosen=chosen,
        values=values_in(text, chosen, asked.values),
        others=[
            (one.id, one.title) for one in service.library.databases() if one.id != database.id
        ],
        queries=list(gallery().values()),
        macros=sorted(macros(), key=lambda macro: (not macro.is_table, macro.name)),
        products=products_of(database.manifest),
        row_choices=ROWS,
        max_text=MAX_TEXT,
    )


def _chosen(name: str) -> NamedQuery | None:
    return named_query(name) if name else None


def values_in(
    text: str, chosen: NamedQuery | None, given: Mapping[str, str]
) -> list[tuple[str, str, str]]:
    """Return the values that a query can be given."""
    known = {value.name: value for value in chosen.values} if chosen else {}
    return [
        (
            name,
            given.get(name, str(known[name].default) if name in known else ""),
            known[name].help if name in known else "",
        )
        for name in dict.fromkeys(_NAMES.findall(text))
    ]
