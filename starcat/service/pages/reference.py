"""The page that explains the REST interface: what its OpenAPI document says, for people."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fastapi import Request
from fastapi.responses import Response

from starcat.service.access import Reader
from starcat.service.pages.rendering import page_router, render

METHODS = ("get", "put", "post", "patch", "delete")

router = page_router()


@dataclass(frozen=True)
class Operation:
    """What can be done at an address.

    Attributes
    ----------
    method, path : str
        Such as ``GET`` and ``/api/v1/jobs``.
    anchor : str
        Its place on the page.
    summary, description : str
        What it does.
    parameters : list of (str, str, str)
        Name, where it stands, meaning.
    bodies : list of str
        Media types of what is sent.
    answers : list of (str, str)
        Status and what it means.
    """

    method: str
    path: str
    anchor: str
    summary: str
    description: str
    parameters: list[tuple[str, str, str]]
    bodies: list[str]
    answers: list[tuple[str, str]]


@router.get("/api/docs")
def reference_page(request: Request, _: Reader) -> Response:
    """Explain the REST interface."""
    return render(
        request,
        "reference.html",
        groups=operations(request.app.openapi()),
        base=str(request.base_url).rstrip("/"),
    )


def operations(document: Mapping[str, Any]) -> dict[str, list[Operation]]:
    """Return what can be done, by its tag.

    Parameters
    ----------
    document : mapping
        OpenAPI 3.1.

    Returns
    -------
    dict of str to list of Operation
        In the order of the document.
    """
    groups: dict[str, list[Operation]] = {}
    for path, methods in document["paths"].items():
        for method in METHODS:
            if method in methods:
                found = methods[method]
                tag = (found.get("tags") or ["other"])[0]
                groups.setdefault(tag, []).append(_operation(method, path, found))
    return groups


def _operation(method: str, path: str, found: Mapping[str, Any]) -> Operation:
    parameters = [
        (
            str(one["name"]) + (" *" if one.get("required") else ""),
            str(one["in"]),
            _told(one.get("description") or one.get("schema", {}).get("description", "")),
        )
        for one in found.get("parameters", ())
    ]
    answers = [
        (str(status), _told(one.get("description", "")))
        for status, one in found.get("responses", {}).items()
    ]
    return Operation(
        method.upper(),
        path,
        re.sub(r"[^a-z0-9]+", "-", f"{method}-{path}".lower()).strip("-"),
        found.get("summary", ""),
        _told(found.get("description", "")),
        parameters,
        list(found.get("requestBody", {}).get("content", {})),
        answers,
    )


def _told(text: str) -> str:
    return text.replace("``", "").strip()
