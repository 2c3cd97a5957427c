"""The REST interface as a page: every address, what it does, what it takes and how it answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fastapi import Request
from fastapi.responses import Response

from starcat.service.access import Reader
from starcat.service.pages.rendering import page_router, render

router = page_router()


@dataclass(frozen=True)
class Operation:
    """What an address does.

    Attributes
    ----------
    method, path, summary, description : str
        As the schema has them.
    parameters : list of tuple of str
        Name, where it stands, and meaning of each.
    answers : list of tuple of str
        Status and meaning of each.
    """

    method: str
    path: str
    summary: str
    description: str
    parameters: list[tuple[str, str, str]]
    answers: list[tuple[str, str]]


@router.get("/api/docs")
def interface(request: Request, reader: Reader) -> Response:
    """Show the REST interface."""
    return render(request, "interface.html", groups=operations_of(request.app.openapi()))


def operations_of(schema: dict[str, Any]) -> dict[str, list[Operation]]:
    """Return the operations of a schema."""
    groups: dict[str, list[Operation]] = {}
    for path, methods in schema["paths"].items():
        for method, told in methods.items():
            [tag, *_] = told.get("tags") or ["other"]
            groups.setdefault(tag, []).append(_operation(method.upper(), path, told))
    return groups


def _operation(method: str, path: str, told: dict[str, Any]) -> Operation:
    parameters = [
        (str(one.get("name", "")), str(one.get("in", "")), str(one.get("description", "")))
        for one in told.get("parameters", [])
    ]
    answers = [
        (status, str(one.get("description", "")))
        for status, one in sorted(told.get("responses", {}).items())
    ]
    summary, description = str(told.get("summary", "")), str(told.get("description", ""))
    return Operation(method, path, summary, description, parameters, answers)
