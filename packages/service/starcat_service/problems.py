"""Errors as problem details (RFC 9457), with the messages and codes of the command line."""

from __future__ import annotations

import errno
import logging
import re
import sqlite3
from abc import ABC, abstractmethod
from collections.abc import Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from fastapi.routing import APIRoute
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from starcat.errors import (
    BuildError,
    CalibrationError,
    ConfigError,
    OutputError,
    ProductError,
    QueryError,
    QueryLimitError,
    SourceError,
    SourceMissing,
    StarcatError,
    TargetMissing,
    error_fields,
    python_name,
)
from starcat.failures import DEFECT, failure_of, shown, validation_message

MEDIA_TYPE = "application/problem+json"

STATUS: tuple[tuple[type[Exception], int], ...] = (
    (TargetMissing, 404),
    (QueryLimitError, 422),
    (QueryError, 400),
    (ConfigError, 422),
    (SourceMissing, 404),
    (SourceError, 422),
    (OutputError, 409),
    (ProductError, 422),
    (BuildError, 422),
    (CalibrationError, 422),
    (StarcatError, 400),
)
"""The status of each of starcat's errors; the first match counts."""

_logger = logging.getLogger(__name__)


class ProblemDetails(BaseModel):
    """The answer to a request that failed."""

    type: str = Field("about:blank", description="Kind of the problem (RFC 9457).")
    title: str = Field(description="Text of the status.")
    status: int = Field(description="Status of the answer.")
    detail: str = Field(description="States what was found, what was expected and what to do next.")
    code: int = Field(1, description="Exit code that the command line gives for it.")
    kind: str | None = Field(None, description="Class of the error.")
    hint: str | None = Field(None, description="Part of the detail that states the next step.")
    key: str | None = Field(None, description="Key of the spec, or parameter, that is wrong.")
    where: str | None = Field(None, description="File or frame with the problem.")
    parameter: str | None = Field(None, description="Parameter that is wrong.")
    value: str | None = Field(None, description="Value of the parameter, as Python writes it.")
    problem: str | None = Field(None, description="What was found, and what was expected.")
    advice: list[str] | None = Field(
        None, description="Alternatives of the hint; {name} stands for a parameter."
    )


class Problem(Exception):  # noqa: N818 - the name is from RFC 9457
    """An error that the service itself raises."""

    def __init__(
        self,
        status: int,
        detail: str,
        *,
        headers: Mapping[str, str] | None = None,
        key: str | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.detail = detail
        self.headers = dict(headers or {})
        self.key = key


def problem_of(error: Exception) -> ProblemDetails:
    """Return the problem details of any exception that a handler raised."""
    if isinstance(error, Problem):
        return _problem(error.status, error.detail, key=error.key)
    if isinstance(error, HTTPException):
        return _problem(error.status_code, shown(str(error.detail), 500))
    if isinstance(error, RequestValidationError):
        where, message = validation_message(error)
        part, _, name = where.partition(".")
        detail = f"{part} {name}".strip() + f": {message}; /api/docs shows what is expected"
        return ProblemDetails(
            title=title_of(422), status=422, detail=shown(detail, 500), code=2, key=name or None
        )
    status = next((number for kind, number in STATUS if isinstance(error, kind)), 500)
    if status == 500:
        detail = "this is a defect of starcat; see the log of the server"
        return _problem(500, detail, code=DEFECT)
    fields: dict[str, Any] = {}
    if isinstance(error, StarcatError):
        if any(map(_FOR_OPERATOR.search, error.advice)):
            error.hint = ASK_OPERATOR
        fields = {
            name: without_folders(text) if isinstance(text, str) else text
            for name, text in error_fields(error).items()
        }
        fields["advice"] = [without_folders(text) for text in fields["advice"]]
        fields["key"] = fields["parameter"] or fields["key"]
    failure = failure_of(error, "starcat serve", parameter_of)
    return _problem(
        status,
        without_folders(failure.message),
        **fields
        | {
            "code": failure.code,
            "kind": failure.kind,
            "hint": None if failure.hint is None else without_folders(failure.hint),
        },
    )


_FOR_OPERATOR = re.compile(r"'starcat [a-z]|\$STARCAT_")
"""Advice that only the operator of the service can follow: commands, environment variables."""

ASK_OPERATOR = "Ask the operator of this service"


def parameter_of(parameter: str, value: str = "", item: str = "") -> str:
    """Return the name of a parameter in the service: its own name, or the name of a setting.

    Examples
    --------
    >>> parameter_of("time_limit_s"), parameter_of("memory_limit_gb")
    ('time_limit_s', 'query_memory_gib')
    """
    if parameter == "memory_limit_gb":
        return "query_memory_gib"
    return python_name(parameter, value, item)


def _problem(status: int, detail: str, **facts: Any) -> ProblemDetails:
    return ProblemDetails(title=title_of(status), status=status, detail=detail, **facts)


_TITLES = {
    413: "Content Too Large",
    414: "URI Too Long",
    416: "Range Not Satisfiable",
    422: "Unprocessable Content",
}
"""Titles of RFC 9110. Python before 3.13 has the titles of older RFCs."""


def title_of(status: int) -> str:
    """Return the title of a status, the same on all versions of Python.

    Examples
    --------
    >>> title_of(422), title_of(404)
    ('Unprocessable Content', 'Not Found')
    """
    return _TITLES.get(status) or HTTPStatus(status).phrase


_FOLDERS = re.compile(r"(?<![\w.:/])/(?:[^\s/:;,'\"()]+/)+")
"""The folders of a full path; an address has a colon and a second slash before them."""


def without_folders(message: str) -> str:
    """Return a message in which files have only their names: folders are private to the operator.

    Examples
    --------
    >>> without_folders("/srv/starcat/catalogs/sao.dat: line 3; see http://host/docs/errors.html")
    'sao.dat: line 3; see http://host/docs/errors.html'
    """
    return _FOLDERS.sub("", message)


FULL = (errno.ENOSPC, errno.EDQUOT)


def outage_of(error: BaseException, root: Path) -> Problem | None:
    """Return the problem for an error of the disk or of the records, None for other errors."""
    cause: BaseException | None = error
    while cause is not None:
        if (isinstance(cause, OSError) and cause.errno in FULL) or "disk is full" in str(cause):
            return Problem(
                507,
                "the disk of the service is full; remove unused databases or results, or ask the "
                "operator",
            )
        if not root.is_dir() and isinstance(cause, (OSError, sqlite3.Error)):
            return Problem(
                503,
                "the folder of the service is gone; the operator has to put it back, from the "
                "backup if need be",
            )
        if isinstance(cause, sqlite3.DatabaseError):
            return Problem(503, damaged_records("records.sqlite", cause))
        cause = cause.__cause__
    return None


def damaged_records(name: str, error: sqlite3.Error) -> str:
    """Return the message for records that cannot be read."""
    return (
        f"{name} cannot be used ({error}); stop the service and put {Path(name).name} of the last "
        "backup in its place ('Backup and restore' of docs/howto-serve.md)"
    )


class RenderingRoute(APIRoute, ABC):
    """A route that answers its errors in a form of its own: pages, or the documents of TAP."""

    @abstractmethod
    def render(self, error: Exception, request: Request) -> Response:
        """Return the response that shows an error."""


def problem_response(error: Exception, request: Request) -> Response:
    """Return the response that shows an error, in the format of the request's route."""
    route = request.scope.get("route")
    return route.render(error, request) if isinstance(route, RenderingRoute) else as_json(error)


def as_json(error: Exception) -> Response:
    """Return the problem details of an error."""
    problem = problem_of(error)
    headers = dict(getattr(error, "headers", None) or {})
    return JSONResponse(problem.model_dump(exclude_none=True), problem.status, headers, MEDIA_TYPE)


def add_problem_handlers(app: FastAPI) -> None:
    """Make an application answer all of its errors with problem details."""

    @app.exception_handler(StarcatError)
    @app.exception_handler(Problem)
    @app.exception_handler(RequestValidationError)
    @app.exception_handler(HTTPException)
    def refuse(request: Request, error: Exception) -> Response:
        outage = isinstance(error, StarcatError) and outage_of(
            error, request.app.state.service.settings.root
        )
        return problem_response(outage or error, request)

    @app.exception_handler(OSError)
    @app.exception_handler(sqlite3.Error)
    def tell_outage(request: Request, error: Exception) -> Response:
        outage = outage_of(error, request.app.state.service.settings.root)
        if outage is None:
            raise error
        _logger.error("%s", error)
        return problem_response(outage, request)

    @app.exception_handler(Exception)
    def tell_defect(request: Request, error: Exception) -> Response:
        outage = outage_of(error, request.app.state.service.settings.root)
        message = "a defect" if outage is None else "the service cannot go on"
        _logger.exception(message, exc_info=error)
        return problem_response(outage or error, request)


def refusals(texts: Mapping[int, str]) -> dict[int | str, dict[str, Any]]:
    """Return the meanings of refusals by status, for ``responses=``."""
    return {
        status: {"model": ProblemDetails, "content": {MEDIA_TYPE: {}}, "description": text}
        for status, text in texts.items()
    }


REFUSALS = refusals(
    {
        400: "The request cannot be understood.",
        401: "A token is needed.",
        403: "The token has not the role that is needed.",
        404: "There is no such thing.",
        409: "It contradicts what is there.",
        413: "Too large.",
        415: "This content type is not accepted here.",
        422: "Something in the request is wrong.",
        429: "Too many requests; ``Retry-After`` states when to try again.",
        503: "The service is busy; ``Retry-After`` states when to try again.",
    }
)
"""For ``responses=`` of routers: the answers to refused requests."""
