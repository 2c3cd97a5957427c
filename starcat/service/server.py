"""The web server."""

from __future__ import annotations

import sys
from types import FrameType

import uvicorn
from fastapi import FastAPI

from starcat.errors import ConfigError
from starcat.service.access import Role
from starcat.service.app import make_app
from starcat.service.guard.logs import log_settings
from starcat.service.guard.shape import MOST_HEADER_BYTES, MOST_TARGET_BYTES
from starcat.service.guard.tokens import TokenStore
from starcat.service.settings import Settings

CONNECTIONS = 1_000
"""Requests that are answered at the same time; of more, the server says that it is busy."""

FIRST = "operator"
"""Name of the token that the first start makes."""


def run_server(settings: Settings) -> None:
    """Serve until a signal ends it.

    Parameters
    ----------
    settings : Settings
        What the operator set.

    Raises
    ------
    ConfigError
        If others than this machine are to reach it, and nobody has a token.
    """
    app = make_app(settings)
    _see_to_tokens(app.state.identities.tokens, settings)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_config=log_settings(),
        access_log=False,
        server_header=False,
        proxy_headers=settings.public_url is not None,
        limit_concurrency=CONNECTIONS,
        h11_max_incomplete_event_size=MOST_HEADER_BYTES + MOST_TARGET_BYTES,
        timeout_graceful_shutdown=round(settings.shutdown_s),
    )
    _Server(config, app, settings).run()


class _Server(uvicorn.Server):
    """Says where it is, and ends streams of events when it is told to stop."""

    def __init__(self, config: uvicorn.Config, app: FastAPI, settings: Settings) -> None:
        super().__init__(config)
        self._app = app
        self._settings = settings

    async def startup(self, sockets: list[object] | None = None) -> None:  # type: ignore[override]
        """Begin to listen."""
        await super().startup(sockets)  # type: ignore[arg-type]
        if self.started:
            port = self.servers[0].sockets[0].getsockname()[1]
            host = f"[{self._settings.host}]" if ":" in self._settings.host else self._settings.host
            address = self._settings.public_url or f"http://{host}:{port}"
            _say(f"starcat serves {self._settings.root} at {address.rstrip('/')}/")

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to stop."""
        self._app.state.stopping.stop()
        super().handle_exit(sig, frame)


def _see_to_tokens(tokens: TokenStore, settings: Settings) -> None:
    """See that somebody can do more than read: make the first token, or say how."""
    if tokens.has_valid():
        return
    command = f"starcat token create NAME --role publisher --root {settings.root}"
    if not settings.is_private:
        raise ConfigError(
            f"others are to reach {settings.public_url or settings.host}, and nobody has a token; "
            f"make one first: {command}",
            key="host",
            value=settings.host,
        )
    if Role.named(settings.anonymous_role) >= Role.PUBLISHER:
        return
    if not sys.stderr.isatty():  # a log keeps what is written to it; a terminal is only seen
        _say(f"nobody has a token, so nobody can build or publish yet; make one: {command}")
        return
    _, text = tokens.create(FIRST, Role.PUBLISHER)
    _say(f"the first token, shown once: {text}\nuse it to sign in on the page, or with curl")


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
