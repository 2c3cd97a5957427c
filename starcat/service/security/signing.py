"""Signing in on the page with a token, and out again."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response

from starcat.service.pages.home import own_path, sign_in_form
from starcat.service.security.auth import Identities, network_of
from starcat.service.security.login_sessions import cookie_name, session_in
from starcat.service.security.request_limits import address_of, later
from starcat.service.service import TheService

router = APIRouter(include_in_schema=False)

NOT_VALID = "this token is not valid: unknown, expired or revoked"


@router.post("/sign-in")
def sign_in(
    request: Request,
    service: TheService,
    token: Annotated[str, Form(max_length=200)],
    next_address: Annotated[str, Form(alias="next", max_length=2000)] = "/",
) -> Response:
    """Begin a session, if the token is valid."""
    identities: Identities = request.app.state.identities
    found = identities.of_token(token.strip())
    if found is None:
        wait_s = identities.guessed.take(network_of(address_of(request.scope)))
        form = sign_in_form(request, next_address, NOT_VALID, 429 if wait_s else 401)
        form.headers.update(later(wait_s) if wait_s else {})
        return form
    answer = RedirectResponse(own_path(next_address), 303)
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
