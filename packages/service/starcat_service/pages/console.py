"""The SQL console: a query of a database, the first rows of its answer, or all in a file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from fastapi import Depends, Query, Request
from fastapi.responses import Response
from starlette.concurrency import run_in_threadpool

from starcat.errors import QueryError, StarcatError, TargetMissing
from starcat.query import NamedQuery, ResultTable, guessed, macros, named_queries, named_query
from starcat.ship.exchange import FORMATS, PAGE_FORMATS, PageFormat
from starcat_service.access import Reader
from starcat_service.api.sql import Form, SqlQuery, SqlQuestion, query_of, result_file, result_table
from starcat_service.library import ListedDatabase
from starcat_service.pages.facts import database_rows, products_of
from starcat_service.pages.notebook import Notebook, query_code
from starcat_service.pages.rendering import page_router, page_url, render
from starcat_service.pages.sky import SkyStar, around, in_words, sky_view
from starcat_service.problems import Problem, ProblemDetails, problem_of
from starcat_service.service import Service, TheService

router = page_router()
ROWS = (20, 100, 500, 2000)  # rows that can be shown
VALUE = "value."  # prefix of the fields with values of ``$name``
MARKS = 2000  # rows that are shown in the sky
MAX_TEXT = 8_000  # characters of a query, which is part of an address

FIRST = "SELECT designation, mag, ra_deg, dec_deg\nFROM stars\nORDER BY mag\nLIMIT 20"
"""Content of the console before the first query."""

_NAMES = re.compile(r"\$([A-Za-z_]\w{0,63})")


@dataclass(frozen=True)
class ConsoleForm:
    """The fields of the console."""

    query: str = ""  # SQL; empty before the first query
    named: str = ""  # query of the gallery that was chosen
    other: str = ""  # id of a second database
    rows: int = 100  # most rows to show
    values: dict[str, str] = field(default_factory=dict)  # texts of the ``$name`` in it


def console_form(
    request: Request,
    query: Annotated[str, Query(max_length=MAX_TEXT)] = "",
    named: Annotated[str, Query(max_length=100)] = "",
    other: Annotated[str, Query(max_length=64)] = "",
    rows: Annotated[int, Query(ge=1, le=max(ROWS))] = 100,
) -> ConsoleForm:
    """Return the fields of the console from an address."""
    values = {
        name.removeprefix(VALUE): text
        for name, text in request.query_params.items()
        if name.startswith(VALUE) and len(name) < 80
    }
    return ConsoleForm(query.replace("\r\n", "\n"), named, other, rows, values)


TheForm = Annotated[ConsoleForm, Depends(console_form)]


@router.get("/databases/{database_id}/sql")
async def console(
    request: Request,
    service: TheService,
    _: Reader,
    database_id: str,
    form: TheForm,
    part: Annotated[Literal["", "answer"], Query()] = "",
) -> Response:
    """Show the console with the answer to its query, or only the answer for the script."""
    answer: ResultTable | None = None
    problem: ProblemDetails | None = None
    if form.query:
        try:
            answer = await service.query_pool.run(_rows, service, database_id, form)
        except TargetMissing:
            raise  # the page itself does not exist
        except (StarcatError, Problem) as error:
            problem = problem_of(error)
    content = {"asked": form, "answer": answer, "problem": problem, "notebook": None, "view": None}
    return await run_in_threadpool(
        _page, request, service, database_id, content, is_part=bool(part)
    )


@router.get("/databases/{database_id}/sql/file")
async def answer_file(
    service: TheService, _: Reader, database_id: str, asked: TheForm, form: PageFormat = "csv"
) -> Response:
    """Return all rows of an answer as a file."""
    database = service.library.database(database_id)
    query = _query(service, database.id, asked, form)
    file = await service.query_pool.run(result_file, service, query, form, database.title)
    return file[0]


def _rows(service: Service, database_id: str, form: ConsoleForm) -> ResultTable:
    return result_table(service, _query(service, database_id, form)).with_json_values()


def _query(
    service: Service, database_id: str, form: ConsoleForm, file_format: Form = "rows"
) -> SqlQuery:
    """Return the query of a form; values that look like numbers become numbers."""
    if not form.query.strip():
        raise QueryError("the query is empty", hint='try "SELECT count(*) FROM stars"')
    question = SqlQuestion(
        targets=[database_id, *([form.other] if form.other else [])],
        query=form.query,
        values={name: guessed(text) for name, text in form.values.items()},
        format=file_format,
        max_rows=form.rows if file_format == "rows" else None,
    )
    named = _named_query(form.named)
    if named is not None and form.query.strip() == named.text.strip():
        names = {value.name for value in named.values}
        values = {name: text for name, text in form.values.items() if name in names}
        changes = {"query": None, "named": named.name, "values": values}
        question = question.model_copy(update=changes)
    return query_of(service, question)


def _page(
    request: Request, service: Service, database_id: str, content: dict[str, Any], *, is_part: bool
) -> Response:
    database = service.library.database(database_id)
    problem: ProblemDetails | None = content["problem"]
    status = 200 if problem is None else problem.status
    if content["answer"] is not None:
        content["notebook"] = _notebook(request, service, database, content["asked"])
        content["view"] = _view(database, content["answer"])
    if is_part:
        return render(request, "console_answer.html", status=status, **content)
    form: ConsoleForm = content["asked"]
    named = _named_query(form.named)
    text = form.query or (named.text if named else FIRST)
    others = [other for other in service.library.databases() if other.id != database.id]
    return render(
        request,
        "console.html",
        status=status,
        **content,
        row=database_rows(service, database)[0],
        formats={name: FORMATS[name].title for name in PAGE_FORMATS},
        tab="sql",
        text=text,
        named=named,
        values=_values_in(text, named, form.values),
        others=[(other.id, other.title) for other in others],
        queries=list(named_queries().values()),
        macros=sorted(macros(), key=lambda macro: (not macro.is_table, macro.name)),
        products=products_of(database.manifest),
        row_choices=ROWS,
        max_text=MAX_TEXT,
    )


def _notebook(
    request: Request, service: Service, database: ListedDatabase, form: ConsoleForm
) -> Notebook:
    asked = _query(service, database.id, form)
    code = query_code(
        page_url(request, service), list(asked.targets), asked.text, asked.values, asked.max_rows
    )
    return Notebook(f"{database.title}-query", code)


def _view(database: ListedDatabase, answer: ResultTable) -> dict[str, Any] | None:
    """Return the rows of an answer as positions on the sky, if they have them."""
    columns = {column.name: k for k, column in enumerate(answer.columns)}
    if not {"ra_deg", "dec_deg"} <= set(columns):
        return None
    column_numbers = {
        name: columns.get(name) for name in ("designation", "mag", "star_id", "reason")
    }
    marks = []
    for row in answer.rows[:MARKS]:
        ra, dec = row[columns["ra_deg"]], row[columns["dec_deg"]]
        if not all(isinstance(angle, int | float) for angle in (ra, dec)):
            continue
        said = {name: None if k is None else row[k] for name, k in column_numbers.items()}
        mag = said["mag"] if isinstance(said["mag"], int | float) else None
        label = str(said["designation"] or f"{answer.columns[0].name} {row[0]}")
        star_id = None if said["star_id"] is None else str(said["star_id"])
        marks.append(SkyStar(label, ra, dec, mag, star_id, reason=in_words(said["reason"])))
    if not marks:
        return None
    return sky_view(database, marks=marks, at=around([vars(mark) for mark in marks]))


def _named_query(name: str) -> NamedQuery | None:
    return named_query(name) if name else None


def _values_in(
    text: str, named: NamedQuery | None, texts: Mapping[str, str]
) -> list[tuple[str, str, str]]:
    """Return name, text and meaning of the values that a query accepts."""
    declared = {value.name: value for value in named.values} if named else {}
    return [
        (
            name,
            texts.get(name, str(declared[name].default) if name in declared else ""),
            declared[name].help if name in declared else "",
        )
        for name in dict.fromkeys(_NAMES.findall(text))
    ]
