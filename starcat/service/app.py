"""The web application: one router a resource, behind the same guards."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import APIRouter, FastAPI

from starcat.service.problems import REFUSALS, add_problem_handlers
from starcat.service.service import Service, open_service
from starcat.service.settings import Settings
from starcat.service.vo import tap, tap_jobs
from starcat.version import __version__

API = "/api/v1"

RESOURCES: tuple[APIRouter, ...] = ()
"""Routers of the REST interface, under `API`."""

OTHERS: tuple[APIRouter, ...] = (tap.router, tap_jobs.router)
"""Routers of everything else: pages, the registry, TAP, cone searches, health."""


def make_app(settings: Settings) -> FastAPI:
    """Make the application.

    Parameters
    ----------
    settings : Settings
        What the operator set.

    Returns
    -------
    FastAPI
        With the service as ``app.state.service``. Its workers run while its lifespan lasts.
    """
    service = open_service(settings)
    app = FastAPI(
        title="starcat",
        version=__version__,
        description="Guide-star databases for star trackers: designed, built, asked and shipped.",
        lifespan=_lifespan,
        openapi_url="/api/openapi.json",
        docs_url=None,
        redoc_url=None,
    )
    app.state.service = service
    add_problem_handlers(app)
    for router in RESOURCES:
        app.include_router(router, prefix=API, responses=REFUSALS)
    for router in OTHERS:
        app.include_router(router)
    return app


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    service: Service = app.state.service
    service.tap.runner.start()
    try:
        yield
    finally:
        service.tap.close()
        service.sessions.close()
        service.records.close()
