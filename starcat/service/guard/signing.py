"""Signing in on the page with a token, and out again."""

from __future__ import annotations

from html import escape
from typing import Annotated

from fastapi import APIRouter, Form, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from starcat.service.guard.identities import Identities
from starcat.service.guard.refusing import address_of, later
from starcat.service.guard.sessions import cookie_name, session_in
from starcat.service.guard.who import network_of
from starcat.service.problems import Problem
from starcat.service.service import TheService

router = APIRouter(include_in_schema=False)

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>Sign in - starcat</title>
</head>
<body>
<main>
<h1>Sign in</h1>
<form method="post" action="/sign-in">
<p><label for="token">Token</label><br>
<input id="token" name="token" type="password" autocomplete="current-password" required></p>
<input type="hidden" name="next" value="{next}">
<p><button type="submit">Sign in</button></p>
</form>
<p>Who runs the service makes one: <code>starcat token create NAME --role builder</code></p>
</main>
</body>
</html>
"""


@router.get("/sign-in", response_class=HTMLResponse)
def ask(next: str = "/") -> Response:  # noqa: A002 - the name in the address
    """Show the form."""
    return HTMLResponse(PAGE.replace("{next}", escape(own_path(next))))


@router.post("/sign-in")
def sign_in(
    request: Request,
    service: TheService,
    token: Annotated[str, Form(max_length=200)],
    next: Annotated[str, Form(max_length=2000)] = "/",  # noqa: A002
) -> Response:
    """Begin a session, if the token is valid."""
    identities: Identities = request.app.state.identities
    found = identities.of_token(token.strip())
    if found is None:
        wait_s = identities.guessed.take(network_of(address_of(request.scope)))
        raise Problem(
            429 if wait_s else 401,
            "this token is not valid: unknown, expired or revoked; ask the operator for another",
            headers=later(wait_s) if wait_s else None,
        )
    answer = RedirectResponse(own_path(next), 303)
    answer.set_cookie(
        cookie_name(service.settings),
        identities.sessions.open(found),
        max_age=round(service.settings.session_hours * 3600),
        secure=service.settings.is_secure,
        httponly=True,
        samesite="strict",
    )
    return answer


@router.post("/sign-out")
def sign_out(request: Request, service: TheService) -> Response:
    """End the session."""
    secret = session_in(request.headers.get("cookie", ""), service.settings)
    if secret is not None:
        request.app.state.identities.sign_out(secret)
    answer = RedirectResponse("/", 303)
    answer.delete_cookie(
        cookie_name(service.settings),
        secure=service.settings.is_secure,
        httponly=True,
        samesite="strict",
    )
    return answer


def own_path(wanted: str) -> str:
    """Return where to go after a sign-in: a path of this service, whatever was asked for.

    Parameters
    ----------
    wanted : str
        As the request has it.

    Returns
    -------
    str
        The same, or ``/`` where a browser would take it for the address of another site.

    Examples
    --------
    >>> own_path("/jobs?state=done"), own_path("//evil.example"), own_path("https://evil.example")
    ('/jobs?state=done', '/', '/')
    """
    is_path = wanted.startswith("/") and not wanted.startswith("//")
    return wanted if is_path and wanted.isprintable() and "\\" not in wanted else "/"
