"""What no honest request looks like: refused before anything of it is used."""

from __future__ import annotations

import re
from collections.abc import Iterable
from urllib.parse import unquote_to_bytes

from starlette.types import Receive, Scope, Send

from starcat.service.problems import Problem
from starcat.service.security.guard import Guard
from starcat.service.security.refusing import refuse

MOST_HEADERS, MOST_HEADER_BYTES, MOST_TARGET_BYTES = 100, 32_768, 16_384

CONTROL = re.compile(r"[\x00-\x1f\x7f]")
UPWARDS = re.compile(r"(^|[/\\])\.{1,2}($|[/\\])")
METHODS = ("GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE")


class Shape(Guard):
    """Refuses requests that are too long, hold control characters, or climb out of folders."""

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        problem = misshapen(scope)
        if problem is not None:
            await refuse(scope, receive, send, problem)
            return
        await self._app(scope, receive, send)


def misshapen(scope: Scope) -> Problem | None:
    """Return what is wrong with the shape of a request."""
    headers: list[tuple[bytes, bytes]] = scope["headers"]
    path, query = scope["path"], scope["query_string"]
    if scope["method"] not in METHODS:
        allowed = ", ".join(METHODS)
        return Problem(
            405, f"the method is none of {allowed}; use one of them", headers={"Allow": allowed}
        )
    if len(scope.get("raw_path") or b"") + len(query) > MOST_TARGET_BYTES:
        return Problem(
            414, f"the address has more than {MOST_TARGET_BYTES:,} bytes; send a long query by POST"
        )
    size = sum(len(name) + len(value) for name, value in headers)
    if len(headers) > MOST_HEADERS or size > MOST_HEADER_BYTES:
        return Problem(
            431,
            f"the request has {len(headers)} headers of {size:,} bytes; at most {MOST_HEADERS} of "
            f"{MOST_HEADER_BYTES:,} bytes together are taken",
        )
    if CONTROL.search(path) or UPWARDS.search(path) or "\\" in path:
        return Problem(
            400, "the path holds '.', '..', a backslash or a control character; send a plain one"
        )
    if b"\x00" in unquote_to_bytes(query) or _is_doubtful(value for _, value in headers):
        return Problem(
            400, "the query or a header holds a character that none may hold; leave it out"
        )
    return None


def _is_doubtful(values: Iterable[bytes]) -> bool:
    return any(b"\x00" in value or b"\n" in value or b"\r" in value for value in values)
