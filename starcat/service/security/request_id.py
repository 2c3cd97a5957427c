"""A name for each request: in its answer, in the log, and so in what people report."""

from __future__ import annotations

import re
import secrets
from contextvars import ContextVar

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import Message, Receive, Scope, Send

from starcat.service.security.guard import Guard

HEADER = "X-Request-ID"
GIVEN = re.compile(r"[A-Za-z0-9._-]{1,64}")
"""What a proxy may call a request; anything else gets another name."""

request_id: ContextVar[str | None] = ContextVar("request_id", default=None)


class RequestId(Guard):
    """Names each request."""

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        given = Headers(scope=scope).get(HEADER, "")
        name = given if GIVEN.fullmatch(given) else secrets.token_hex(8)

        async def send_named(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)[HEADER] = name
            await send(message)

        before = request_id.set(name)
        try:
            await self._app(scope, receive, send_named)
        finally:
            request_id.reset(before)
