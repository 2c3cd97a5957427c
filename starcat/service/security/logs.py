"""The log: a line of JSON for each request and for whatever else is worth it; never a secret.

Of a request its path is written, not its query, which may hold what somebody asks; nor any header.
JSON writes every control character as an escape, so no request can begin a line of its own.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from datetime import UTC, datetime
from typing import Any

from starlette.types import Message, Receive, Scope, Send

from starcat.service.problems import as_json
from starcat.service.security.guard import Guard
from starcat.service.security.refusing import address_of
from starcat.service.security.request_id import request_id

MOST = 500
"""Characters of a path that are written."""

QUIET = ("/healthz", "/readyz", "/metrics")
"""Paths that machines ask for all the time: logged only where they fail."""

_logger = logging.getLogger("starcat.service.requests")


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
            "starcat": {"level": level},
            "uvicorn": {"level": "WARNING"},
            "uvicorn.error": {"level": "WARNING"},
        },
    }


class RequestLog(Guard):
    """Writes a line for each request when it has been answered."""

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        begun_s, status, sent = time.perf_counter(), 0, 0

        async def send_counted(message: Message) -> None:
            nonlocal status, sent
            if message["type"] == "http.response.start":
                status = message["status"]
            sent += len(message.get("body", b""))
            await send(message)

        try:
            await self._app(scope, receive, send_counted)
        finally:
            if status >= 500 or scope["path"] not in QUIET:
                _write(scope, status, sent, time.perf_counter() - begun_s)


def _write(scope: Scope, status: int, sent: int, taken_s: float) -> None:
    principal = scope.get("state", {}).get("principal")
    facts = {
        "method": scope["method"][:20],
        "path": scope["path"][:MOST],
        "status": status,
        "bytes": sent,
        "seconds": round(taken_s, 4),
        "address": address_of(scope),
        "who": getattr(principal, "name", None),
    }
    level = logging.ERROR if status >= 500 else logging.INFO
    _logger.log(level, "request", extra={"facts": facts})


class Defects(Guard):
    """Answers what no handler foresaw: the log gets the traceback, the client gets none."""

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        is_begun = False

        async def send_noted(message: Message) -> None:
            nonlocal is_begun
            is_begun = True
            await send(message)

        try:
            await self._app(scope, receive, send_noted)
        except Exception as error:
            _logger.exception("a defect of starcat: %s %s", scope["method"], scope["path"][:MOST])
            if is_begun:
                raise  # the server ends the connection, so that the client sees it is not whole
            await as_json(error)(scope, receive, send)
