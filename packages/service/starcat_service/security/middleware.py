"""Layers around every request, from the outside to the inside.

`RequestContext` gives it an id, a line in the log and a place in the figures; `SafeHeaders` adds
headers to its answer that browsers obey; `Refusals` refuses it if a check fails; and `Defects`
answers unforeseen errors without a traceback.

The log has a line of JSON for each request and for other notable events, never a secret: it has the
path of a request, but not its query, which can contain private text, nor any header. JSON escapes
control characters, so that no request can begin a line of its own.
"""

from __future__ import annotations

import json
import logging
import re
import secrets
import sqlite3
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from starcat_service.problems import Problem, as_json, outage_of, problem_response
from starcat_service.sandbox.limiter import asker
from starcat_service.security.metrics import Metrics
from starcat_service.security.request_limits import OWN_CONNECTIONS, BodyLimits, Shares, client_ip
from starcat_service.settings import ServiceSettings

ID_HEADER = "X-Request-ID"
REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
"""Form of ids of requests from a proxy; a request with any other id gets a new one."""

POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; "
    "frame-ancestors 'none'; form-action 'self'"
)
"""Scripts, styles and data come only from the service; inline scripts do not run."""

ALWAYS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=(), payment=(), usb=()",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
A_YEAR = "max-age=31536000"

MOST = 500
"""Most characters of a path in the log."""

QUIET = ("/healthz", "/readyz", "/metrics")
"""Paths that machines request all the time: logged only if they fail."""

request_id: ContextVar[str | None] = ContextVar("request_id", default=None)

_logger = logging.getLogger(__name__)
_requests = logging.getLogger("starcat_service.requests")


class JsonFormatter(logging.Formatter):
    """A record of the log as an object on one line."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        content: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            "request_id": request_id.get(),
        }
        content |= getattr(record, "facts", {})
        if record.exc_info:
            content["exception"] = self.formatException(record.exc_info)
        return json.dumps({name: value for name, value in content.items() if value is not None})


def log_settings(level: str = "INFO") -> dict[str, Any]:
    """Return the configuration of `logging` for the server."""
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"json": {"()": JsonFormatter}},
        "handlers": {
            "stderr": {"class": "logging.StreamHandler", "formatter": "json", "stream": sys.stderr}
        },
        "root": {"handlers": ["stderr"], "level": "WARNING"},
        "loggers": {
            **{name: {"level": level} for name in ("starcat", "starcat_lab", "starcat_service")},
            "uvicorn": {"level": "WARNING"},
            "uvicorn.error": {"level": "WARNING"},
        },
    }


class _HttpMiddleware(ABC):
    """Middleware for requests; the server's lifespan events pass it untouched."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await (self.answer if scope["type"] == "http" else self._app)(scope, receive, send)

    @abstractmethod
    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it to the next layer."""


class RequestContext(_HttpMiddleware):
    """Gives each request an id, and logs its result."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        super().__init__(app)
        self._metrics = metrics

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        header = Headers(scope=scope).get(ID_HEADER, "")
        name = header if REQUEST_ID.fullmatch(header) else secrets.token_hex(8)
        begun_s, status, sent, is_endless = time.perf_counter(), 0, 0, False

        async def send_counted(message: Message) -> None:
            nonlocal status, sent, is_endless
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers[ID_HEADER] = name
                is_endless = headers.get("content-type", "").startswith("text/event-stream")
            sent += len(message.get("body", b""))
            await send(message)

        before = request_id.set(name)
        self._metrics.running.inc()
        try:
            await self._app(scope, receive, send_counted)
        finally:
            self._metrics.running.dec()
            taken_s = time.perf_counter() - begun_s
            self._metrics.count(scope, status, None if is_endless else taken_s)
            _log_request(scope, status, sent, taken_s)
            request_id.reset(before)


def _log_request(scope: Scope, status: int, sent: int, taken_s: float) -> None:
    if status < 500 and scope["path"] in QUIET:
        return
    principal = scope.get("state", {}).get("principal")
    facts = {
        "method": scope["method"][:20],
        "path": scope["path"][:MOST],
        "status": status,
        "bytes": sent,
        "seconds": round(taken_s, 4),
        "address": client_ip(scope),
        "who": getattr(principal, "name", None),
    }
    level = logging.ERROR if status >= 500 else logging.INFO
    _requests.log(level, "request", extra={"facts": facts})


class SafeHeaders(_HttpMiddleware):
    """Adds security headers. A handler's own policy is not changed."""

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        super().__init__(app)
        self._headers = dict(ALWAYS)
        if settings.is_secure:
            self._headers["Strict-Transport-Security"] = A_YEAR

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""

        async def send_safe(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(self._headers)
                headers.setdefault("Content-Security-Policy", POLICY)
                if not scope["path"].startswith("/static/"):
                    headers.setdefault("Cache-Control", "private, no-cache")
            await send(message)

        await self._app(scope, receive, send_safe)


Check = Callable[[Scope], None]
"""Raises `Problem` if a request must be refused."""


class Refusals(_HttpMiddleware):
    """Refuses requests that fail a check, in the order of checks, or whose body is too large."""

    def __init__(self, app: ASGIApp, checks: Sequence[Check], limits: BodyLimits) -> None:
        super().__init__(app)
        self._checks = checks
        self._limits = limits
        self._root = limits.settings.root
        self._shares = Shares(OWN_CONNECTIONS)

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        with ExitStack() as counted:
            try:
                for check in self._checks:
                    check(scope)
                counted.enter_context(self._shares.counted(asker.get()))
                limited = self._limits.limited(scope, receive)
            except Problem as problem:
                await as_json(problem)(scope, receive, send)
                return
            except (OSError, sqlite3.Error) as error:
                outage = outage_of(error, self._root)
                if outage is None:
                    raise
                _logger.error("%s", error)
                await as_json(outage)(scope, receive, send)
                return
            await self._app(scope, limited, send)


class Defects(_HttpMiddleware):
    """Answers unforeseen errors: the log gets the traceback, the client does not."""

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        is_begun = False

        async def send_noted(message: Message) -> None:
            nonlocal is_begun
            is_begun = True
            await send(message)

        try:
            await self._app(scope, receive, send_noted)
        except ClientDisconnect:
            return  # the client is gone
        except Exception as error:
            _logger.exception("a defect of starcat: %s %s", scope["method"], scope["path"][:MOST])
            if is_begun:
                raise  # the connection ends, so that the client sees an incomplete answer
            await _as_the_route_says(error, scope)(scope, receive, send)


def _as_the_route_says(error: Exception, scope: Scope) -> Response:
    """Return a page for the error of a page, a VOTable for an error of TAP, else JSON."""
    try:
        return problem_response(error, Request(scope))
    except Exception:  # the same failure can happen here again
        return as_json(error)
