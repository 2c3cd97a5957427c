"""The page *Tokens*: the tokens of the users of the service."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Form, Request
from fastapi.responses import RedirectResponse, Response
from pydantic import ValidationError

from starcat.errors import ConfigError
from starcat.failures import validation_message
from starcat_service.access import TokenManager
from starcat_service.api import tokens as api
from starcat_service.pages.rendering import page_router, render
from starcat_service.service import Service, TheService

router = page_router()


@router.get("/tokens")
def tokens_page(request: Request, service: TheService, manager: TokenManager) -> Response:
    """Show all tokens, and the form for another."""
    return _page(request, service, manager)


@router.post("/tokens")
def create_page(
    request: Request,
    service: TheService,
    manager: TokenManager,
    name: Annotated[str, Form(max_length=200)],
    role: Annotated[str, Form(max_length=20)] = "reader",
    expires_days: Annotated[str, Form(max_length=20)] = "",
) -> Response:
    """Create a token and show it, once."""
    fields = {"name": name.strip(), "role": role, "expires_days": expires_days}
    try:
        new_token = api.NewToken.model_validate(fields)
        created = api.create_token(new_token, service, manager)
    except ValidationError as error:
        key, words = validation_message(error)
        return _page(request, service, manager, status=422, fields=fields, errors={key: words})
    except ConfigError as error:
        errors = {"name": str(error)}
        return _page(request, service, manager, status=422, fields=fields, errors=errors)
    return _page(request, service, manager, created=created)


@router.post("/tokens/{token_id}/revoke")
def revoke_page(token_id: api.TokenId, service: TheService, manager: TokenManager) -> Response:
    """Revoke a token, and show the others."""
    api.revoke_token(token_id, service, manager)
    return RedirectResponse("/tokens", 303)


def _page(
    request: Request, service: Service, manager: TokenManager, status: int = 200, **more: Any
) -> Response:
    empty = {"name": "", "role": "reader", "expires_days": "90"}
    content = {"fields": empty, "errors": {}, "created": None, **more}
    tokens = api.all_tokens(service, manager).tokens
    return render(request, "tokens.html", status=status, tokens=tokens, **content)
