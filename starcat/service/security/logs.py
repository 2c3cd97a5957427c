"""The log: a line of JSON for each request and for whatever else is worth it; never a secret.

Of a request its path is written, not its query, which may hold what somebody asks; nor any header.
JSON writes every control character as an escape, so no request can begin a line of its own.
"""

from __future__ import annotations

import json
import logging
import sys
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any

from starlette.types import Scope

from starcat.service.security.request_limits import address_of

MOST = 500
"""Characters of a path that are written."""

QUIET = ("/healthz", "/readyz", "/metrics")
"""Paths that machines ask for all the time: logged only where they fail."""

request_id: ContextVar[str | None] = ContextVar("request_id", default=None)

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


def log_request(scope: Scope, status: int, sent: int, taken_s: float) -> None:
    """Write the line of a request that has been answered."""
    if status < 500 and scope["path"] in QUIET:
        return
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
