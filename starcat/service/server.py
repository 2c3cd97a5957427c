"""The web server."""

from __future__ import annotations

import uvicorn

from starcat.service.app import make_app
from starcat.service.settings import Settings


def run_server(settings: Settings) -> None:
    """Serve until a signal ends it.

    Parameters
    ----------
    settings : Settings
        What the operator set.
    """
    uvicorn.run(
        make_app(settings),
        host=settings.host,
        port=settings.port,
        timeout_graceful_shutdown=round(settings.shutdown_s),
    )
