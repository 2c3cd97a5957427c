"""Questions in SQL."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query
from fastapi.responses import JSONResponse, Response, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field

from starcat.errors import AnswerTooLarge, QueryError
from starcat.query import Macro, NamedQuery, ResultTable, View, macros, named_queries, named_query
from starcat.ship.exchange import FILE_FORMATS, FORMATS, FileFormat
from starcat_service.access import Reader
from starcat_service.problems import Problem
from starcat_service.service import Service, TheService
from starcat_service.transfers import open_attachment, scratch_folder, within_disk, write_rows

router = APIRouter(prefix="/sql", tags=["sql"])

Form = Literal["rows", FileFormat]
MAX_SHOWN = 100_000  # most rows of an answer that is not a file
Plain = int | float | bool | str | None

TargetName = Annotated[str, Field(max_length=200)]


class SqlQuestion(BaseModel):
    """A query, and the form of its answer."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "targets": ["0123456789abcdef"],
                    "query": "SELECT designation, mag FROM cone($ra, $dec, 5) ORDER BY mag",
                    "values": {"ra": 37.95, "dec": 89.26},
                },
                {"targets": ["gaia-12deg-1.0.0"], "named": "densest-fields", "format": "csv"},
            ]
        },
    )

    targets: Annotated[list[TargetName], Field(min_length=1, max_length=8)] = Field(
        description="Ids or titles of databases, names of catalogs. One has its views in the main "
        "schema; several have a schema each, and are a, b, c ... too."
    )
    query: str | None = Field(None, max_length=100_000, description="SQL, one that reads.")
    named: str | None = Field(None, max_length=100, description="Instead: one of the gallery.")
    values: dict[str, Plain] = Field(
        default_factory=dict, description="The values of the $name in it."
    )
    format: Form = Field("rows", description="Rows as JSON lists, or a file.")
    max_rows: int | None = Field(None, ge=1, description="Rows at most; by default 1000, or all.")
    time_limit_s: float | None = Field(None, gt=0, description="Seconds that it may take.")


class ViewColumn(BaseModel):
    """A column of a view."""

    name: str
    dtype: str = Field(description="Empty if it is not known.")
    unit: str
    description: str


class ViewFacts(BaseModel):
    """A table that queries can use."""

    target: str = Field(description="Its schema, if there are several.")
    view: str
    description: str
    columns: list[ViewColumn]


@dataclass(frozen=True)
class SqlQuery:
    """A query and its limits."""

    targets: Sequence[str]  # names for `Library.target`
    text: str
    values: Mapping[str, Any]  # values of each ``$name`` in it
    max_rows: int
    time_s: float


def result_table(service: Service, query: SqlQuery) -> ResultTable:
    """Return the first rows of a result."""
    paths = [service.library.target(name) for name in query.targets]
    with (
        service.query_pool.session(paths, query.time_s) as session,
        session.ask(query.text, query.values) as running,
    ):
        try:
            table: ResultTable = running.table(query.max_rows)
        except AnswerTooLarge as error:
            raise _too_large(service) from error
    return table


def _too_large(service: Service) -> Problem:
    return Problem(
        413,
        f"the rows of the answer take more than {service.settings.rows_mib:g} MiB (rows_mib); ask "
        f"for fewer rows (max_rows) or columns, or for a file (format: {', '.join(FILE_FORMATS)})",
        key="max_rows",
    )


def result_file(
    service: Service, query: SqlQuery, form: str, stem: str
) -> tuple[StreamingResponse, int, bool]:
    """Return a result as a file, its number of rows, and whether there are more."""
    paths = [service.library.target(name) for name in query.targets]
    with scratch_folder(service.paths) as folder:
        source, target = folder / "rows.arrow", folder / "result"
        with (
            service.query_pool.session(paths, query.time_s) as session,
            session.ask(query.text, query.values) as running,
        ):
            count, is_cut = write_rows(
                within_disk(running.batches(), service.settings), source, query.max_rows
            )
        service.sandbox.convert(source, target, form)
        answer = open_attachment(target, f"{stem}{FORMATS[form].suffix}", FORMATS[form].media_type)
    return answer, count, is_cut


@router.post(
    "",
    summary="Run a query",
    response_model=ResultTable,
    responses={
        200: {
            "description": "Rows, or a file; ``X-Starcat-Rows`` is the number of its rows, and "
            "``X-Starcat-Cut`` whether there are more.",
            "content": {
                FORMATS[name].media_type.partition(";")[0]: {}
                for name in FILE_FORMATS
                if name != "json"
            },
        }
    },
)
async def ask(question: SqlQuestion, service: TheService, reader: Reader) -> Response:
    """Run an SQL query on databases and catalogs; queries cannot write."""
    asked = query_of(service, question)
    if question.format == "rows":
        return await service.query_pool.run(_rows, service, asked)
    return await service.query_pool.run(_file, service, asked, question.format)


@router.get("/queries", summary="Queries by name")
def queries(reader: Reader) -> list[NamedQuery]:
    """Return frequent queries, with their values."""
    return list(named_queries().values())


@router.get("/macros", summary="Functions of queries")
def all_macros(reader: Reader) -> list[Macro]:
    """Return the functions that queries have in addition to the functions of DuckDB."""
    return sorted(macros(), key=lambda macro: (macro.is_table, macro.name))


@router.get("/views", summary="Tables of targets")
async def views(
    service: TheService,
    reader: Reader,
    target: Annotated[
        list[TargetName],
        Query(min_length=1, max_length=8, description="As in a question. Repeatable."),
    ],
) -> list[ViewFacts]:
    """Return the tables that a query about some targets can use."""
    return await service.query_pool.run(_views, service, target)


def query_of(service: Service, question: SqlQuestion) -> SqlQuery:
    """Return the query of a question, within the operator's limits."""
    if (question.query is None) == (question.named is None):
        raise Problem(422, "give either a query or the name of one", key="query")
    settings = service.settings
    default, most = settings.max_rows, settings.max_rows
    if question.format == "rows":
        default, most = min(1000, most), min(MAX_SHOWN, most)
    count = len(question.targets)
    if question.named is not None:
        named = named_query(question.named)
        if named.targets != count:
            raise QueryError(f"{named.name} is about {named.targets} targets; {count} given")
        text = named.text
        values = named.with_values({key: str(value) for key, value in question.values.items()})
    else:
        text, values = question.query or "", dict(question.values)  # type: ignore[arg-type]
    time_s = min(question.time_limit_s or settings.query_time_s, settings.query_time_s)
    return SqlQuery(question.targets, text, values, min(question.max_rows or default, most), time_s)


def _rows(service: Service, query: SqlQuery) -> Response:
    # JSON guarantees these types: a model would check every value once more.
    answer = JSONResponse(result_table(service, query).as_json())
    if len(answer.body) > service.settings.rows_mib * 2**20:
        raise _too_large(service)
    return answer


def _file(service: Service, query: SqlQuery, form: str) -> Response:
    answer, rows, is_cut = result_file(service, query, form, "answer")
    answer.headers.update({"X-Starcat-Rows": str(rows), "X-Starcat-Cut": str(is_cut).lower()})
    return answer


def _views(service: Service, targets: list[str]) -> list[ViewFacts]:
    with service.query_pool.session([service.library.target(name) for name in targets]) as session:
        return [
            ViewFacts(
                target=target.short_name,
                view=view.name,
                description=view.schema.description if view.schema else "",
                columns=_columns(view),
            )
            for target in session.targets
            for view in target.views
        ]


def _columns(view: View) -> list[ViewColumn]:
    if view.schema is None:
        return [ViewColumn(name=name, dtype="", unit="", description="") for name in view.columns]
    return [
        ViewColumn(
            name=column.name,
            dtype=column.dtype,
            unit=column.unit or "",
            description=column.description,
        )
        for column in view.schema.columns
    ]
