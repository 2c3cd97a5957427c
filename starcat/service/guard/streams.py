"""Streams without an end, which are ended when the server is to stop."""

from __future__ import annotations

import asyncio
from typing import Any

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

ENDLESS = "text/event-stream"


class Stopping:
    """Whether the server is to stop, and the tasks of streams that would keep it from that."""

    def __init__(self) -> None:
        self.is_stopping = False
        self._tasks: set[asyncio.Task[Any]] = set()
        self._loop: asyncio.AbstractEventLoop | None = None

    def add(self, task: asyncio.Task[Any]) -> None:
        """Remember the task of a stream."""
        self._loop = task.get_loop()
        self._tasks.add(task)
        if self.is_stopping:
            task.cancel()

    def remove(self, task: asyncio.Task[Any]) -> None:
        """Forget a task that has ended."""
        self._tasks.discard(task)

    def stop(self) -> None:
        """End all streams, now and from now on; may be called by a signal."""
        self.is_stopping = True
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._cancel)

    def _cancel(self) -> None:
        for task in self._tasks:
            task.cancel()


class Streams:
    """Ends streams of events when the server stops, each as a whole answer.

    Parameters
    ----------
    app : ASGIApp
        What comes behind.
    stopping : Stopping
        Says when.
    """

    def __init__(self, app: ASGIApp, stopping: Stopping) -> None:
        self._app = app
        self._stopping = stopping

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        task = asyncio.current_task()
        if scope["type"] != "http" or task is None:
            await self._app(scope, receive, send)
            return

        async def send_watched(message: Message) -> None:
            if message["type"] == "http.response.start":
                kind = Headers(raw=message.get("headers", [])).get("content-type", "")
                if kind.startswith(ENDLESS):
                    self._stopping.add(task)
            await send(message)

        try:
            await self._app(scope, receive, send_watched)
        except asyncio.CancelledError:
            if not self._stopping.is_stopping:
                raise
            task.uncancel()
            await send({"type": "http.response.body", "body": b"", "more_body": False})
        finally:
            self._stopping.remove(task)
