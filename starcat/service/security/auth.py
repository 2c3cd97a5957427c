"""Who asks: the token of the header, or the session of the cookie; and how often they may ask."""

from __future__ import annotations

import base64
import binascii
import ipaddress
from typing import Any
from urllib.parse import quote

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from starcat.service.access import Principal, Role
from starcat.service.problems import Problem
from starcat.service.security.buckets import Buckets
from starcat.service.security.guard import Guard
from starcat.service.security.identities import Identities
from starcat.service.security.login_sessions import session_in
from starcat.service.security.refusing import address_of, later, refuse
from starcat.service.security.tokens import Token
from starcat.service.settings import Settings

VOSI = ("/tap/availability", "/tap/capabilities")
"""What clients look at before they know that a token is needed (VOSI 1.1)."""

OPEN_PATHS = ("/healthz", "/sign-in", "/sign-out", "/static/", *VOSI)
"""What everybody may see, also where a token is needed for all else."""

CHALLENGED = ("/tap", "/scs", "/registry")
"""Paths whose programs send a name and a password only when they are asked for them."""

BEARER, BASIC = 'Bearer realm="starcat"', 'Basic realm="starcat", charset="UTF-8"'


class Who(Guard):
    """Finds the principal of each request, and refuses those who may not ask, or not so often."""

    def __init__(self, app: ASGIApp, settings: Settings, identities: Identities) -> None:
        super().__init__(app)
        self._settings = settings
        self._identities = identities
        self._anonymous = Principal("anonymous", Role.named(settings.anonymous_role))
        self._asked = Buckets(settings.requests_per_minute)

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        try:
            principal = self._principal(scope)
        except Problem as problem:
            await refuse(scope, receive, send, problem)
            return
        scope.setdefault("state", {})["principal"] = principal
        await self._app(scope, receive, send)

    def _principal(self, scope: Scope) -> Principal:
        address = network_of(address_of(scope))
        found = self._found(Headers(scope=scope), address)
        path = scope["path"]
        if path != "/healthz":
            wait_s = self._asked.take(address if found is None else f"token {found.name}")
            if wait_s:
                raise Problem(
                    429,
                    f"more than {self._settings.requests_per_minute} requests in a minute; ask "
                    "again later, and less often",
                    headers=later(wait_s),
                )
        if found is not None:
            return Principal(found.name, found.role)
        if self._anonymous.role == Role.NONE and not path.startswith(OPEN_PATHS):
            raise self._unknown(scope)
        return self._anonymous

    def _found(self, headers: Headers, address: str) -> Token | None:
        given = headers.get("authorization")
        if given is not None:
            text = token_in(given)
            token = None if text is None else self._identities.of_token(text)
            if token is None:
                wait_s = self._identities.guessed.take(address)
                raise Problem(
                    429 if wait_s else 401,
                    "this token is not valid: unknown, expired or revoked; ask the operator for "
                    "another ('starcat token create')",
                    headers={"WWW-Authenticate": BEARER} | dict(later(wait_s) if wait_s else {}),
                )
            return token
        secret = session_in(headers.get("cookie", ""), self._settings)
        return None if secret is None else self._identities.of_session(secret)

    def _unknown(self, scope: Scope) -> Problem:
        path = scope["path"]
        if scope["method"] == "GET" and "text/html" in Headers(scope=scope).get("accept", ""):
            return Problem(
                303, "sign in first", headers={"Location": f"/sign-in?next={quote(path)}"}
            )
        return Problem(
            401,
            "this needs a token; send it as 'Authorization: Bearer TOKEN', or sign in on the page",
            headers={"WWW-Authenticate": BASIC if path.startswith(CHALLENGED) else BEARER},
        )


def token_in(authorization: str) -> str | None:
    """Return the token of a header.

    Examples
    --------
    >>> token_in("Bearer starcat_x"), token_in("Basic bWU6c3RhcmNhdF94"), token_in("Digest x")
    ('starcat_x', 'starcat_x', None)
    """
    scheme, _, rest = authorization.strip().partition(" ")
    if scheme.lower() == "bearer":
        return rest.strip()
    if scheme.lower() != "basic":
        return None
    try:
        _, _, password = base64.b64decode(rest, validate=True).decode().partition(":")
    except (binascii.Error, UnicodeDecodeError):
        return None
    return password


def network_of(address: str) -> str:
    """Return what is counted as one address: of IPv6 the network that one household has.

    Examples
    --------
    >>> network_of("2001:db8::1"), network_of("192.0.2.1"), network_of("unknown")
    ('2001:db8::', '192.0.2.1', 'unknown')
    """
    try:
        found: Any = ipaddress.ip_address(address)
    except ValueError:
        return address
    if found.version == 4:
        return address
    return str(ipaddress.ip_network(f"{found}/64", strict=False).network_address)
