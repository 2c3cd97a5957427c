"""How much a request may bring along, and in what time."""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from starcat.service.problems import Problem
from starcat.service.security.guard import Guard
from starcat.service.security.refusing import refuse
from starcat.service.settings import Settings

TEXT_MIB = 1.0
"""Size of a form or of JSON at most: whoever sends more has a file, and may upload that."""

TEXTS = ("application/json", "application/x-www-form-urlencoded", "text/")
MIB, GIB = 2**20, 2**30

FILLING = ("/tap/async",)
"""Where a POST makes something that stays on the disk; jobs see to their room themselves."""


class Bodies(Guard):
    """Refuses bodies that are too large, too slow, or for which the disk has no room."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        super().__init__(app)
        self._settings = settings

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["method"] in ("GET", "HEAD", "OPTIONS"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        kind = headers.get("content-type", "").strip().lower()
        most_mib = self._settings.upload_mib
        most_mib = min(TEXT_MIB, most_mib) if kind.startswith(TEXTS) else most_mib
        problem = self._refusal(scope, headers, kind, round(most_mib * MIB))
        if problem is not None:
            await refuse(scope, receive, send, problem)
            return
        limited = _limited(receive, round(most_mib * MIB), self._settings.upload_time_s)
        await self._app(scope, limited, send)

    def _refusal(self, scope: Scope, headers: Headers, kind: str, most: int) -> Problem | None:
        length = headers.get("content-length")
        if length is not None and not (length.isascii() and length.isdigit()):
            return Problem(400, "the header Content-Length is no number")
        if length is not None and int(length) > most:
            return Problem(413, too_large(most))
        fills = kind.startswith("multipart/") or scope["path"].startswith(FILLING)
        if fills and scope["method"] != "DELETE":
            return lack_of_room(self._settings)
        return None


def lack_of_room(settings: Settings) -> Problem | None:
    """Return why nothing may be added to the disk."""
    if free_gib(settings.root) >= settings.free_gib:
        return None
    return Problem(
        507,
        f"the disk of the service has less than {settings.free_gib:g} GiB left; remove databases "
        "or results that nobody needs, or tell the operator",
    )


def free_gib(folder: Path) -> float:
    """Return the room that is left on the disk of a folder, GiB."""
    return shutil.disk_usage(folder).free / GIB


def too_large(most: int) -> str:
    """Return what is said of a body with more bytes than it may have."""
    return f"the body has more than {most / MIB:g} MiB, which is the most that is taken; send less"


def _limited(receive: Receive, most: int, time_s: float) -> Receive:
    """Return a function that receives what another does, so much and so long at most.

    What it raises reaches the client as any other refusal of a handler does.
    """
    got, is_whole, until_s = 0, False, asyncio.get_running_loop().time() + time_s

    async def receive_limited() -> Message:
        nonlocal got, is_whole
        if is_whole:  # nothing more comes but the end of the connection, whenever that is
            return await receive()
        try:
            async with asyncio.timeout_at(until_s):
                message = await receive()
        except TimeoutError:
            raise HTTPException(
                408,
                f"the body took more than {time_s:g} s to arrive; send less, or on a faster line",
                {"Connection": "close"},
            ) from None
        if message["type"] != "http.request":
            return message
        got += len(message.get("body", b""))
        is_whole = not message.get("more_body", False)
        if got > most:
            raise HTTPException(413, too_large(most), {"Connection": "close"})
        return message

    return receive_limited
