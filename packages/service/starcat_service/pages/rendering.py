"""Pages from templates, errors as pages, and the files that pages need.

The digest of style sheets, scripts and pictures is in their address.
"""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fastapi import APIRouter, FastAPI, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from jinja2 import Environment, PackageLoader, StrictUndefined
from starlette.exceptions import HTTPException

from starcat.version import __version__
from starcat_service.access import principal_of
from starcat_service.pages.wording import advice_in_page_words, problem_in_page_words
from starcat_service.problems import Problem, RenderingRoute, as_json, problem_of
from starcat_service.service import Service

NAVIGATION = (
    ("/new", "New database"),
    ("/jobs", "Jobs"),
    ("/databases", "Databases"),
    ("/identify", "Identify"),
    ("/plan", "Plan"),
    ("/catalogs", "Catalogs"),
    ("/releases", "Releases"),
    ("/docs", "Help"),
)
"""Address and name of each link in the head of every page."""


DATABASE_TABS = (
    ("overview", "Overview"),
    ("coverage", "Sky and coverage"),
    ("sql", "SQL"),
    ("compare", "Compare"),
    ("report", "Build report"),
)
"""End of the address, and name, of the pages of a database."""

MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}

FILES = {
    path.name: path.read_bytes()
    for path in sorted((Path(__file__).parent / "static").iterdir())
    if path.suffix in MEDIA_TYPES
}
"""All static files by name, read once: a request never becomes part of a path."""

DIGEST = hashlib.sha256(b"".join(FILES[name] for name in sorted(FILES))).hexdigest()[:12]
"""One digest for all files, so that a script can import another by its name."""


def static_address(name: str) -> str:
    """Return the address of a static file."""
    if name not in FILES:
        raise KeyError(name)
    return f"/static/{DIGEST}/{name}"


def count_text(value: float | None) -> str:
    """Return a count with commas between thousands, as in all messages of starcat.

    Examples
    --------
    >>> count_text(4999), count_text(None)
    ('4,999', '–')
    """
    return "–" if value is None else f"{round(value):,}"


def size_text(value: float | None) -> str:
    """Return a size with its unit, such as ``4.2 MB``.

    Examples
    --------
    >>> [size_text(number).replace("\N{NO-BREAK SPACE}", " ") for number in (999, 1000, 4.2e6)]
    ['999 B', '1.0 kB', '4.2 MB']
    """
    if value is None:
        return "–"
    number, unit = float(value), "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if number < 999.5:
            break
        number, unit = number / 1000.0, larger
    digits = 1 if unit != "B" and number < 99.95 else 0
    return f"{number:.{digits}f}\N{NO-BREAK SPACE}{unit}"


def duration_text(value: float | None) -> str:
    """Return a duration, such as ``4.2 s`` or ``3 min 20 s``.

    Examples
    --------
    >>> [duration_text(s).replace("\N{NO-BREAK SPACE}", " ") for s in (0.04, 4.21, 200, 7260)]
    ['0.04 s', '4.2 s', '3 min 20 s', '2 h 1 min']
    """
    if value is None:
        return "–"
    if value < 59.5:
        digits = 2 if value < 0.995 else (1 if value < 9.95 else 0)
        text = f"{value:.{digits}f} s"
    elif value < 3570.0:
        text = "{} min {} s".format(*divmod(round(value), 60))
    else:
        text = "{} h {} min".format(*divmod(round(value / 60.0), 60))
    return text.replace(" ", "\N{NO-BREAK SPACE}")


def time_text(value: float | None) -> str:
    """Return a moment as ``2026-11-22 14:05:09``, UTC."""
    return "–" if value is None else f"{datetime.fromtimestamp(value, UTC):%Y-%m-%d %H:%M:%S}"


def moment_text(value: float) -> str:
    """Return a moment as ``2026-11-22T14:05:09Z``, for the attribute ``datetime``."""
    return f"{datetime.fromtimestamp(value, UTC):%Y-%m-%dT%H:%M:%SZ}"


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("starcat_service.pages"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "count": count_text,
        "size": size_text,
        "duration": duration_text,
        "time": time_text,
        "moment": moment_text,
        "detail": problem_in_page_words,
        "advice": advice_in_page_words,
    }
    environment.globals |= {
        "static": static_address,
        "navigation": NAVIGATION,
        "tabs": DATABASE_TABS,
        "starcat_version": __version__,
    }
    return environment


ENVIRONMENT = _environment()


def render(request: Request, template: str, *, status: int = 200, **content: Any) -> HTMLResponse:
    """Return a page."""
    page = ENVIRONMENT.get_template(template).render(
        principal=principal_of(request),
        path=request.url.path,
        **{"sign_in": sign_in_address(_asked_page(request)), **content},
    )
    return HTMLResponse(page, status, {"Cache-Control": "no-store"})


def page_url(request: Request, service: Service) -> str:
    """Return the address under which the client of a request reaches the service."""
    return (service.settings.public_url or str(request.base_url)).rstrip("/")


def sign_in_address(page: str) -> str:
    """Return the address for signing in, which leads back to a page of the service.

    Examples
    --------
    >>> sign_in_address("/new?name=a"), sign_in_address("")
    ('/sign-in?next=%2Fnew%3Fname%3Da', '/sign-in')
    """
    return f"/sign-in?next={quote(page, safe='')}" if page else "/sign-in"


def _asked_page(request: Request) -> str:
    """Return the address of the requested page within the service, if it can be shown again."""
    if request.method != "GET" or request.url.path in ("/", "/sign-in"):
        return ""
    return request.url.path + (f"?{request.url.query}" if request.url.query else "")


class _PageRoute(RenderingRoute):
    """A route whose errors are pages with the messages of the REST interface."""

    def render(self, error: Exception, request: Request) -> Response:
        """Return the page of an error; redirect to the sign-in if only that is missing."""
        if isinstance(error, HTTPException) and error.status_code == 405:
            return as_json(error)
        problem = problem_of(error)
        if problem.status == 401 and request.method == "GET":
            return RedirectResponse(sign_in_address(_asked_page(request)), 303)
        return _error_page(request, error)


def page_router() -> APIRouter:
    """Return a router for pages: not in the schema, and its errors are pages."""
    return APIRouter(route_class=_PageRoute, include_in_schema=False)


def add_missing_page(app: FastAPI) -> None:
    """Make an application show a page to browsers if nothing exists at an address."""

    @app.exception_handler(404)
    def tell_missing(request: Request, error: Exception) -> Response:
        is_for_people = "text/html" in request.headers.get("accept", "")
        if is_for_people and request.method == "GET" and not request.url.path.startswith("/api/"):
            detail = "there is nothing at this address; every part of the service is linked above"
            return _error_page(request, Problem(404, detail))
        return as_json(error)


def _error_page(request: Request, error: Exception) -> Response:
    problem = problem_of(error)
    return render(request, "error.html", status=problem.status, problem=problem)


static_router = APIRouter(include_in_schema=False)


@static_router.get("/static/{digest}/{name}")
def static_file(digest: str, name: str) -> Response:
    """Return a static file; files of an older version do not exist any more."""
    if digest != DIGEST or name not in FILES:
        raise Problem(404, "there is no such file of the page; load the page again")
    return Response(
        FILES[name],
        media_type=MEDIA_TYPES[Path(name).suffix],
        headers={"Cache-Control": "public, max-age=31536000, immutable", "ETag": f'"{DIGEST}"'},
    )
