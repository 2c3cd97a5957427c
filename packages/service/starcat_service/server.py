"""The web server: one for each root."""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from starcat.errors import ConfigError, OutputError, reason
from starcat.storage import locked, make_folder
from starcat_service.access import network_of
from starcat_service.app import make_app
from starcat_service.jobs.slots import JobSlots
from starcat_service.paths import ServicePaths
from starcat_service.sandbox.channel import limit_arenas
from starcat_service.security.middleware import log_settings
from starcat_service.security.request_limits import (
    CONNECTIONS,
    MAX_HEADER_BYTES,
    MAX_TARGET_BYTES,
    OWN_CONNECTIONS,
)
from starcat_service.security.tokens import TokenStore
from starcat_service.service import Service
from starcat_service.settings import Role, ServiceSettings

SWITCH_S = 0.001
"""Seconds until a working thread lets other threads run, a fifth of Python's default: the event
loop is one of them, and each request waits for it several times."""

FIRST = "operator"
"""Name of the token that the first start makes."""

Announce = Callable[[str], None]
"""Called with the address for users when the server listens."""


TOO_MANY = (
    b"HTTP/1.1 429 Too Many Requests\r\nConnection: close\r\nRetry-After: 1\r\n"
    b"Content-Type: text/plain\r\nContent-Length: 46\r\n\r\n"
    b"too many connections of this address; use less"
)

MONITORED = (b"GET /healthz ", b"GET /readyz ", b"GET /metrics ", b"HEAD /healthz ")
PROBES, PROBE_S = 20, 1.0
"""Connections of an address beyond its limit that wait so long for a request of a monitor."""

HEAD_S = 15.0
"""Seconds within which the head of a request must arrive, and the rest of the previous request."""


MIN_END_S = 8.0
LAST_S = 1.5
"""Seconds from ``shutdown_s``, or from `MIN_END_S` if that is later, until the process is ended
without waiting for its threads. A signal has ended the server within 10 s if ``shutdown_s`` is not
longer than by default."""

CLEAN_S = 0.3
"""Seconds for ending the processes that the server has started, before it ends itself."""

_logger = logging.getLogger(__name__)


class OurProtocol(H11Protocol):
    """The protocol of the server, with a time limit between requests.

    While a request is answered its handler limits the time; `BodyLimits` limits the time of reading
    the body. Connections per address are limited, except for monitors. Behind a proxy all requests
    come from the address of the proxy, so that requests are counted instead (`Shares`).
    """

    _waiting: asyncio.TimerHandle | None = None
    _is_probe = False
    _network = ""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timer for the first request."""
        super().connection_made(transport)
        self._network = network_of(self.client[0]) if self.client else ""
        others = (
            connection for connection in self.connections if isinstance(connection, OurProtocol)
        )
        count = sum(connection._network == self._network for connection in others)
        if count > OWN_CONNECTIONS and not self.config.proxy_headers:
            if count > OWN_CONNECTIONS + PROBES:
                self._refuse()
            else:  # it may ask for what a monitor asks for
                self._waiting = self.loop.call_later(PROBE_S, self._refuse)
                self._is_probe = True
            return
        self._watch()

    def data_received(self, data: bytes) -> None:
        """Take what has come."""
        if self._is_probe:
            self._is_probe = False
            if not data.startswith(MONITORED):
                self._refuse()
                return
            self._forget()
        super().data_received(data)
        self._watch()

    def _refuse(self) -> None:
        self._forget()
        if not self.transport.is_closing():
            self.transport.write(TOO_MANY)
            self.transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no longer."""
        self._forget()
        super().connection_lost(exc)

    def _watch(self) -> None:
        if self._is_answering():
            self._forget()
        elif self._waiting is None:
            self._waiting = self.loop.call_later(HEAD_S, self._lose)

    def _is_answering(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _forget(self) -> None:
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    def _lose(self) -> None:
        self._waiting = None
        if not self._is_answering() and not self.transport.is_closing():
            self.transport.close()


def run_server(settings: ServiceSettings, announce: Announce) -> None:
    """Serve until a signal ends it."""
    paths = ServicePaths(settings.root)
    if not settings.is_private and not paths.records.exists():
        raise _without_token(settings)  # before anything is made
    with _only_server(paths):
        shutil.rmtree(paths.scratch, ignore_errors=True)
        # For uploads larger than a megabyte, and for files of child processes.
        os.environ["TMPDIR"] = tempfile.tempdir = str(paths.scratch)
        _serve(settings, announce)


@contextmanager
def _only_server(paths: ServicePaths) -> Iterator[None]:
    with ExitStack() as stack:
        try:
            make_folder(paths.root)
            stack.enter_context(locked(paths.lock, wait=False))
        except BlockingIOError:
            raise ConfigError(
                f"{paths.root}: another server runs there",
                hint=("stop it", "choose another {root}"),
            ) from None
        except OSError as error:
            raise OutputError(
                f"{paths.root}: cannot be used ({reason(error)})",
                path=paths.root,
                hint="choose another {root}",
            ) from error
        yield


def _serve(settings: ServiceSettings, announce: Announce) -> None:
    sys.setswitchinterval(SWITCH_S)
    limit_arenas()
    listening = listen(settings)
    with listening:
        settings = settings.model_copy(update={"port": listening.getsockname()[1]})
        app = make_app(settings)
        _see_to_tokens(app.state.identities.tokens, settings)
        _serve_app(settings, app, listening, announce)


def _serve_app(
    settings: ServiceSettings, app: FastAPI, listening: socket.socket, announce: Announce
) -> None:
    config = uvicorn.Config(
        app,
        http=OurProtocol,
        log_config=log_settings(),
        access_log=False,
        server_header=False,
        proxy_headers=settings.public_url is not None,
        limit_concurrency=CONNECTIONS,
        h11_max_incomplete_event_size=MAX_HEADER_BYTES + MAX_TARGET_BYTES,
        timeout_graceful_shutdown=round(settings.shutdown_s),
    )
    with _signals_end_nothing_else():
        _Server(config, app, announce).run([listening])


class _Server(uvicorn.Server):
    """A server that prints its address, and ends jobs and event streams as soon as it must stop."""

    def __init__(self, config: uvicorn.Config, app: FastAPI, announce: Announce) -> None:
        super().__init__(config)
        self._service: Service = app.state.service
        self._slots: JobSlots = app.state.slots
        self._announce = announce

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to stop; make sure that the process ends in time even if a thread is blocked."""
        if not self.should_exit:
            after_s = max(self._service.settings.shutdown_s, MIN_END_S) + LAST_S - CLEAN_S
            threading.Thread(target=self._end_after, args=(after_s,), daemon=True).start()
        super().handle_exit(sig, frame)

    def _end_after(self, wait_s: float) -> None:
        """End the process, with the processes that it has started, after some time.

        At its end Python waits for threads that are not daemons, and so does the event loop. A
        thread that is blocked in the system would keep both waiting for ever.
        """
        time.sleep(wait_s)
        service = self._service
        closing = (
            self._slots.processes.end_all,
            service.query_pool.close,
            service.sandbox.close,
            lambda: _logger.warning("threads were blocked: the server ended without them"),
        )
        # Each call has its own thread: closing can wait for blocked threads.
        threads = [threading.Thread(target=call, daemon=True) for call in closing]
        for thread in threads:
            thread.start()
        until_s = time.monotonic() + CLEAN_S
        for thread in threads:
            thread.join(max(0.0, until_s - time.monotonic()))
        os._exit(0)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to answer."""
        await super().startup(sockets)
        if self.started and sockets:
            self._announce(_address(self._service.settings, sockets[0].getsockname()[1]))

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop: streams of events end at once, requests and jobs within their time limits."""
        self._service.stopping.set()
        self._slots.begin_stop()
        await super().shutdown(sockets)


def _address(settings: ServiceSettings, port: int) -> str:
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    return f"{(settings.public_url or f'http://{host}:{port}').rstrip('/')}/"


def listen(settings: ServiceSettings) -> socket.socket:
    """Return the socket on which the server listens."""
    try:
        [(family, _, _, _, address), *_] = socket.getaddrinfo(
            settings.host, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        listening = socket.create_server(address[:2], family=family, backlog=2048)
        # asyncio sets it only for sockets that name their protocol, as this one does not. Without
        # it, the end of a short answer waits 40 ms for the acknowledgement of its head.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except OSError as error:
        raise ConfigError(
            f"cannot listen at {settings.host}:{settings.port}: {reason(error)}",
            hint=("choose another with {host} and {port}", "end what uses it"),
        ) from error
    return listening


@contextmanager
def _signals_end_nothing_else() -> Iterator[None]:
    """Make sure that a signal that ended the server normally is not an error of the command."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        for number in handlers:
            signal.signal(number, lambda number, frame: None)
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _see_to_tokens(tokens: TokenStore, settings: ServiceSettings) -> None:
    """Make sure that a user can do more than read: make the first token, or print how to."""
    if tokens.has_valid():
        return
    if not settings.is_private:
        raise _without_token(settings)
    if settings.anonymous_role >= Role.PUBLISHER:
        return
    if not sys.stderr.isatty():  # a log would keep the secret; a terminal does not
        how = _how_to_make_one(settings)
        _say(f"no token exists yet, so nobody can build or publish; create one: {how}")
        return
    _, text = tokens.create(FIRST, Role.PUBLISHER)
    _say(f"the first token, shown once: {text}\nuse it to sign in on the page, or with curl")


def _without_token(settings: ServiceSettings) -> ConfigError:
    return ConfigError(
        f"others are to reach {settings.public_url or settings.host}, and no token exists",
        key="host",
        value=settings.host,
        hint=f"make one first: {_how_to_make_one(settings)}",
    )


def _how_to_make_one(settings: ServiceSettings) -> str:
    return f"starcat token create NAME --role publisher --root {settings.root}"


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
