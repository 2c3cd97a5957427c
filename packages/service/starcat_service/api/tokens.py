"""Tokens of the users of the service, for publishers who have a token themselves."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Path
from pydantic import BaseModel, ConfigDict, Field

from starcat_service.access import TokenManager
from starcat_service.problems import Problem
from starcat_service.security.tokens import Token, TokenStore
from starcat_service.service import TheService
from starcat_service.settings import Role

router = APIRouter(prefix="/tokens", tags=["tokens"])

MAX_DAYS = 366.0
"""Validity of tokens that are created over HTTP; the command line sets no limit."""

TokenId = Annotated[
    str, Path(pattern="^[0-9a-f]{8}$", description="Id of a token.", examples=["0123abcd"])
]


class TokenFacts(BaseModel):
    """The recorded facts of a token; the token itself is not stored."""

    id: str = Field(description="Eight hexadecimal digits.")
    name: str = Field(description="Name of its user.")
    role: str
    state: str = Field(description="``valid``, ``expired`` or ``revoked``.")
    created: str = Field(description="ISO 8601.")
    expires: str | None
    revoked: str | None


class Tokens(BaseModel):
    """All tokens, the oldest first."""

    tokens: list[TokenFacts]


class NewToken(BaseModel):
    """A token to be created."""

    model_config = ConfigDict(extra="forbid")

    name: str = Field(max_length=64, description="Of its user.", examples=["anna"])
    role: Literal["reader", "builder", "publisher"]
    expires_days: float = Field(90.0, ge=0.001, le=MAX_DAYS, description="Days of validity.")


class CreatedToken(TokenFacts):
    """A token that was created."""

    token: str = Field(description="The secret; it is returned this once.")


@router.get("", summary="All tokens")
def all_tokens(service: TheService, manager: TokenManager) -> Tokens:
    """Return all tokens without their secrets, including tokens that are no longer valid."""
    return Tokens(tokens=[_facts(token) for token in TokenStore(service.records).all()])


@router.post("", status_code=201, summary="Create a token")
def create_token(new_token: NewToken, service: TheService, manager: TokenManager) -> CreatedToken:
    """Create a token and return its secret, once."""
    store, role = TokenStore(service.records), Role.named(new_token.role)
    token, secret = store.create(new_token.name, role, new_token.expires_days)
    return CreatedToken(**_facts(token).model_dump(), token=secret)


@router.delete("/{token_id}", status_code=204, summary="Revoke a token")
def revoke_token(token_id: TokenId, service: TheService, manager: TokenManager) -> None:
    """Revoke a token, and end the sessions that were begun with it."""
    store = TokenStore(service.records)
    if any(token.id == token_id and token.name == manager.name for token in store.all()):
        raise Problem(409, "this is your own token; another publisher can revoke it")
    store.revoke(token_id)


def _facts(token: Token) -> TokenFacts:
    return TokenFacts.model_validate(token.as_dict())
