"""How a guard refuses a request before any handler sees it."""

from __future__ import annotations

import math
from collections.abc import Mapping

from starlette.requests import HTTPConnection
from starlette.types import Receive, Scope, Send

from starcat.service.problems import Problem, as_json


async def refuse(scope: Scope, receive: Receive, send: Send, problem: Problem) -> None:
    """Answer a request with what is wrong with it."""
    await as_json(problem)(scope, receive, send)


def later(wait_s: float) -> Mapping[str, str]:
    """Return the header that says after how many seconds to ask again, at least one."""
    return {"Retry-After": str(max(1, math.ceil(wait_s)))}


def address_of(scope: Scope) -> str:
    """Return the address that a request came from, as far as the server knows it."""
    client = HTTPConnection(scope).client
    return client.host if client is not None else "unknown"
