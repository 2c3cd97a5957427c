"""Principals of requests: their roles, and how often they may send requests.

A request has one principal: the owner of the token in its header, of the session in its cookie, or,
without either, the anonymous principal. `Authentication` determines it for every request; handlers
state which role they need.
"""

from __future__ import annotations

import base64
import binascii
import ipaddress
import threading
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Annotated, Any
from urllib.parse import quote

from fastapi import Depends, Request
from starlette.datastructures import Headers
from starlette.types import Scope

from starcat_service.problems import Problem
from starcat_service.records import Records
from starcat_service.sandbox.limiter import asker
from starcat_service.security.request_limits import Buckets, client_ip, later
from starcat_service.security.tokens import SessionStore, Token, TokenStore, digest_of
from starcat_service.settings import Role, ServiceSettings

VOSI = ("/tap/availability", "/tap/capabilities")
"""Paths that clients read before they know that a token is needed (VOSI 1.1)."""

NOVA = (
    *("/api/login", "/api/upload", "/api/url_upload"),
    *("/api/submissions/", "/api/jobs/", "/wcs_file/", "/joblog/"),
)
"""Paths whose clients send no header: their JSON has a session, or their address a number."""

OPEN_PATHS = ("/healthz", "/sign-in", "/sign-out", "/static/", *VOSI, *NOVA)
"""Paths that everybody may see, also if a token is needed for all others. A path that ends with a
slash stands for all paths below it."""

CHALLENGED = ("/tap", "/scs", "/registry")
"""Paths whose clients send a name and a password only after the server asks for them."""

BEARER, BASIC = 'Bearer realm="starcat"', 'Basic realm="starcat", charset="UTF-8"'

CACHED_TOKEN_S = 5.0
"""Seconds for which a checked secret is not looked up again; a revoked token works this long."""

MAX_CACHED_TOKENS = 1_000

GUESSES_PER_MINUTE = 10
"""Wrong tokens per minute of an address. Right tokens always work: 256 bits cannot be guessed, and
a colleague behind the same address must not be locked out by a stale script."""

ANONYMOUS = "anonymous"
"""Name of the principal without a token."""


@dataclass(frozen=True)
class Principal:
    """The sender of a request."""

    name: str  # name of the token; ``anonymous`` without one
    role: Role  # what the principal may do


def principal_of(request: Request) -> Principal:
    """Return the principal of a request."""
    principal: Principal = request.state.principal
    return principal


def needs(role: Role) -> Callable[[Request], Awaitable[Principal]]:
    """Return a dependency that refuses principals without a role."""

    async def check(request: Request) -> Principal:  # async: no thread is needed
        principal = principal_of(request)
        if principal.role >= role:
            return principal
        name = role.name.lower()
        if principal.name == "anonymous":
            raise Problem(
                401,
                f"this needs a token with the role {name}; send it as 'Authorization: Bearer "
                "TOKEN', or sign in on the page",
                headers={"WWW-Authenticate": BEARER},
            )
        raise Problem(
            403,
            f"the token {principal.name!r} has the role {principal.role.name.lower()}, and this "
            f"needs {name}; ask the operator for another ('starcat token create')",
        )

    return check


Reader = Annotated[Principal, Depends(needs(Role.READER))]
Builder = Annotated[Principal, Depends(needs(Role.BUILDER))]
Publisher = Annotated[Principal, Depends(needs(Role.PUBLISHER))]


async def _with_token(principal: Publisher) -> Principal:
    if principal.name != ANONYMOUS:
        return principal
    raise Problem(
        401,
        "this needs a token with the role publisher, even where everybody may publish; sign in",
        headers={"WWW-Authenticate": BEARER},
    )


TokenManager = Annotated[Principal, Depends(_with_token)]
"""A publisher with a token: an anonymous publisher could otherwise create a token."""


class Identities:
    """The known tokens and sessions."""

    def __init__(self, records: Records, settings: ServiceSettings) -> None:
        self.tokens = TokenStore(records)
        self.sessions = SessionStore(records, settings.session_hours)
        self.guessed = Buckets(GUESSES_PER_MINUTE)
        self._cached_tokens: OrderedDict[str, tuple[Token, float]] = OrderedDict()
        self._lock = threading.Lock()

    def of_token(self, text: str) -> Token | None:
        """Return the token of a text; None if the text is not a valid token."""
        return self._lookup(self.tokens, text)

    def of_session(self, secret: str) -> Token | None:
        """Return the token that a session was begun with; None if it is not valid (any more)."""
        return self._lookup(self.sessions, secret)

    def sign_out(self, secret: str) -> None:
        """End a session at once."""
        self.sessions.close(secret)
        with self._lock:  # look-ups of the session have ended
            self._cached_tokens.pop(f"{SessionStore.__name__} {digest_of(secret)}", None)

    def _lookup(self, store: TokenStore | SessionStore, secret: str) -> Token | None:
        key, now_s = f"{type(store).__name__} {digest_of(secret)}", time.monotonic()
        cached = self._cached_tokens.get(key)
        if cached is not None and cached[1] > now_s:
            return cached[0]
        with self._lock:
            # One indexed look-up in a cached file is cheaper than a thread.
            token = store.find(secret)
            if token is None:
                self._cached_tokens.pop(key, None)
                return None
            self._cached_tokens[key] = token, now_s + CACHED_TOKEN_S
            if len(self._cached_tokens) > MAX_CACHED_TOKENS:
                self._cached_tokens.popitem(last=False)
            return token


class Authentication:
    """Finds the principal of each request; refuses forbidden and too frequent requests."""

    def __init__(self, settings: ServiceSettings, identities: Identities) -> None:
        self._settings = settings
        self._identities = identities
        self._anonymous = Principal(ANONYMOUS, settings.anonymous_role)
        self._asked = Buckets(settings.requests_per_minute)

    def check(self, scope: Scope) -> None:
        """Give a request its principal, or refuse it."""
        address = network_of(client_ip(scope))
        token = self._token_of_request(Headers(scope=scope), address)
        who = address if token is None else f"token {token.name}"
        asker.set(who)
        path = scope["path"]
        if path != "/healthz":
            wait_s = self._asked.take(who)
            if wait_s:
                raise Problem(
                    429,
                    f"more than {self._settings.requests_per_minute} requests in a minute; ask "
                    "again later, and less often",
                    headers=later(wait_s),
                )
        principal = self._anonymous if token is None else Principal(token.name, token.role)
        if principal.role == Role.NONE and not is_open(path):
            raise self._unknown(scope)
        scope.setdefault("state", {})["principal"] = principal

    def _token_of_request(self, headers: Headers, address: str) -> Token | None:
        authorization = headers.get("authorization")
        if authorization is not None:
            text = token_in(authorization)
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


def is_open(path: str) -> bool:
    """Return whether a path needs no token.

    Examples
    --------
    >>> is_open("/sign-in"), is_open("/sign-inx"), is_open("/static/page.css")
    (True, False, True)
    """
    below = tuple(open_path for open_path in OPEN_PATHS if open_path.endswith("/"))
    return path in OPEN_PATHS or path.startswith(below)


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
    """Return the network that counts as one client: for IPv6 the network of one household.

    Examples
    --------
    >>> network_of("2001:db8::1"), network_of("192.0.2.1"), network_of("unknown")
    ('2001:db8::', '192.0.2.1', 'unknown')
    """
    try:
        ip: Any = ipaddress.ip_address(address)
    except ValueError:
        return address
    if ip.version == 4:
        return address
    return str(ipaddress.ip_network(f"{ip}/64", strict=False).network_address)


def cookie_name(settings: ServiceSettings) -> str:
    """Return the name of the cookie; behind https a name that only this exact host can set.

    Browsers send a cookie to every port of a host, so that the name contains the port.
    """
    return "__Host-starcat" if settings.is_secure else f"starcat-{settings.port}"


def session_in(cookies: str, settings: ServiceSettings) -> str | None:
    """Return the secret of a session."""
    name = cookie_name(settings)
    if name not in cookies:
        return None
    try:
        cookie = SimpleCookie(cookies).get(name)
    except CookieError:
        return None
    return cookie.value or None if cookie is not None else None
