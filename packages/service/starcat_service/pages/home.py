"""The entry: the start page, the page for signing in, and the REST interface in words."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Form, Query, Request
from fastapi.responses import RedirectResponse, Response

from starcat_service.access import Identities, Reader, cookie_name, network_of, session_in
from starcat_service.api import releases as api
from starcat_service.jobs.job import ENDED
from starcat_service.pages.facts import database_rows
from starcat_service.pages.rendering import page_router, page_url, render
from starcat_service.security import request_limits
from starcat_service.service import TheService
from starcat_service.settings import ServiceSettings

router = page_router()
MAX_ADDRESS = 16_000  # most characters of an address, which can contain a design
SHOWN = 8  # most databases, jobs and releases that the page shows of each


@router.get("/")
def home(request: Request, service: TheService, reader: Reader) -> Response:
    """Show the start."""
    rows = database_rows(service)
    newest_first = sorted(rows, key=lambda row: -row.built_s)
    releases = api.all_releases(service, reader).releases
    jobs = service.jobs.all(most=SHOWN)
    return render(
        request,
        "home.html",
        rows=newest_first[:SHOWN],
        count=len(rows),
        releases=sorted(releases, key=lambda release: -(release.published_s or 0.0))[:SHOWN],
        release_count=len(releases),
        jobs=[job for job in jobs if job.state not in ENDED],
        address=page_url(request, service),
        example=newest_first[0].database if newest_first else None,
        needs_token=reader.name != "anonymous",
    )


@router.get("/sign-in")
def sign_in_page(
    request: Request, next_address: Annotated[str, Query(alias="next")] = "/"
) -> Response:
    """Show who is signed in, and the form for a token."""
    return sign_in_form(request, next_address)


def sign_in_form(
    request: Request, next_address: str, error: str | None = None, status: int = 200
) -> Response:
    """Return the page to sign in at."""
    address = own_path(next_address)
    return render(request, "sign_in.html", status=status, next=address, error=error)


def own_path(address: str) -> str:
    """Return a path of this service to which a browser can be redirected.

    Examples
    --------
    >>> [own_path(one) for one in ("/jobs?state=done", "//elsewhere.example", "https://x.example")]
    ['/jobs?state=done', '/', '/']
    """
    is_own = address.startswith("/") and not address.startswith("//") and "\\" not in address
    return address if is_own and address.isprintable() else "/"


sign_in_router = APIRouter(include_in_schema=False)
"""Router of the form for signing in; its errors are not pages."""

NOT_VALID = "this token is not valid: unknown, expired or revoked"


@sign_in_router.post("/sign-in")
def sign_in(
    request: Request,
    service: TheService,
    token: Annotated[str, Form(max_length=200)],
    next_address: Annotated[str, Form(alias="next", max_length=MAX_ADDRESS)] = "/",
) -> Response:
    """Begin a session, if the token is valid."""
    identities: Identities = request.app.state.identities
    valid_token = identities.of_token(token.strip())
    if valid_token is None:
        wait_s = identities.guessed.take(network_of(request_limits.client_ip(request.scope)))
        form = sign_in_form(request, next_address, NOT_VALID, 429 if wait_s else 401)
        form.headers.update(request_limits.later(wait_s) if wait_s else {})
        return form
    answer = RedirectResponse(own_path(next_address), 303)
    answer.set_cookie(
        value=identities.sessions.open(valid_token),
        max_age=round(service.settings.session_hours * 3600),
        **_cookie(service.settings),
    )
    return answer


def _cookie(settings: ServiceSettings) -> dict[str, Any]:
    """Return the attributes that setting and deleting the cookie of a session must share."""
    secure = settings.is_secure
    return {"key": cookie_name(settings), "secure": secure, "httponly": True, "samesite": "strict"}


@sign_in_router.post("/sign-out")
def sign_out(request: Request, service: TheService) -> Response:
    """End the session."""
    secret = session_in(request.headers.get("cookie", ""), service.settings)
    if secret is not None:
        request.app.state.identities.sign_out(secret)
    answer = RedirectResponse("/", 303)
    answer.delete_cookie(**_cookie(service.settings))
    return answer


@router.get("/api/docs")
def interface(request: Request, reader: Reader) -> Response:
    """Show the REST interface."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for path, methods in request.app.openapi()["paths"].items():
        for method, operation in methods.items():
            tag = next(iter(operation.get("tags", ())), "other")
            groups.setdefault(tag, []).append(
                {
                    **operation,
                    "method": method.upper(),
                    "path": path,
                    "parameters": [
                        (parameter["name"], parameter["in"], parameter.get("description", ""))
                        for parameter in operation.get("parameters", ())
                    ],
                    "answers": [
                        (status, response["description"])
                        for status, response in sorted(operation["responses"].items())
                    ],
                }
            )
    return render(request, "interface.html", groups=groups)
