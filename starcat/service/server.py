"""The web server: one for each root, and what happens when it is to stop."""

from __future__ import annotations

import shutil
import signal
from signal import SIGINT, SIGTERM
from types import FrameType

import uvicorn
from fastapi import FastAPI

from starcat.errors import ConfigError, OutputError, reason
from starcat.service.app import make_app
from starcat.service.jobs.pool import WorkerPool
from starcat.service.places import Places
from starcat.service.service import Service
from starcat.service.settings import Settings
from starcat.storage.atomic import make_folder
from starcat.storage.locks import locked


class Server(uvicorn.Server):
    """A web server that has jobs end as soon as it is told to stop.

    Parameters
    ----------
    config : uvicorn.Config
        Of the server.
    app : FastAPI
        The application, as `make_app` makes it.
    """

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._service: Service = app.state.service
        self._workers: WorkerPool = app.state.workers

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to stop: requests, streams of events and jobs end at the same time.

        Parameters
        ----------
        sig : int
            The signal.
        frame : FrameType, optional
            Where it arrived.
        """
        self._service.stopping.set()
        self._workers.begin_stop()
        super().handle_exit(sig, frame)


def run_server(settings: Settings) -> None:
    """Serve until a signal ends it.

    Parameters
    ----------
    settings : Settings
        What the operator set.

    Raises
    ------
    ConfigError
        If another server runs with the same root.
    OutputError
        If the root cannot be written to.
    """
    places = Places(settings.root)
    try:
        make_folder(places.root)
        with locked(places.lock, wait=False):
            _serve(settings, places)
    except BlockingIOError:
        raise ConfigError(
            f"another server runs with --root {places.root}; stop it, or choose another root",
            key="root",
            value=str(places.root),
        ) from None
    except OSError as error:
        raise OutputError(
            f"{places.root}: cannot be used ({reason(error)}); choose another --root",
            path=places.root,
        ) from error


def _serve(settings: Settings, places: Places) -> None:
    shutil.rmtree(places.scratch, ignore_errors=True)
    app = make_app(settings)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        timeout_graceful_shutdown=round(settings.shutdown_s),
    )
    # uvicorn raises the signal that ended it once more when it has ended, for whoever is outside.
    before = {number: signal.signal(number, _is_heard) for number in (SIGINT, SIGTERM)}
    try:
        Server(config, app).run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_heard(number: int, frame: FrameType | None) -> None:
    """Do nothing more about a signal: the server has ended because of it."""
