"""The web application: one router per resource, behind the same guards."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from fastapi import APIRouter, FastAPI
from starlette.middleware import Middleware

from starcat.version import __version__
from starcat_service import pages
from starcat_service.access import Authentication, Identities
from starcat_service.api import (
    catalogs,
    databases,
    identify,
    jobs,
    nova,
    releases,
    specs,
    sql,
    tokens,
)
from starcat_service.jobs.slots import JobSlots
from starcat_service.pages.rendering import add_missing_page
from starcat_service.problems import REFUSALS, add_problem_handlers
from starcat_service.removal import keep_removing
from starcat_service.sandbox.limiter import in_thread
from starcat_service.security import metrics
from starcat_service.security.middleware import Defects, Refusals, RequestContext, SafeHeaders
from starcat_service.security.origin import Origins
from starcat_service.security.request_limits import BodyLimits, check_shape
from starcat_service.service import Service
from starcat_service.settings import ServiceSettings
from starcat_service.vo import cone_search, tap, tap_async

API = "/api/v1"

RESOURCES: tuple[APIRouter, ...] = (
    specs.router,
    catalogs.router,
    jobs.router,
    databases.router,
    releases.router,
    identify.router,
    sql.router,
    tokens.router,
)
"""Routers of the REST interface, under `API`."""

OTHERS: tuple[APIRouter, ...] = (
    releases.registry_router,
    metrics.router,
    pages.home.sign_in_router,
    cone_search.router,
    tap.router,
    tap_async.router,
    nova.router,
    *pages.ROUTERS,
)
"""Routers of everything else: pages, the registry, TAP, cone searches, health."""


def make_app(settings: ServiceSettings) -> FastAPI:
    """Make the application."""
    service = Service(settings)
    figures, identities = metrics.Metrics(service), Identities(service.records, settings)
    checks = (check_shape, Origins(settings).check, Authentication(settings, identities).check)
    app = FastAPI(
        title="starcat",
        version=__version__,
        description="Guide-star databases for star trackers: design, build, query, release.",
        lifespan=_lifespan,
        openapi_url="/api/openapi.json",
        docs_url=None,
        redoc_url=None,
        middleware=[  # layers around a request, the outermost first
            Middleware(RequestContext, metrics=figures),
            Middleware(SafeHeaders, settings=settings),
            Middleware(Refusals, checks=checks, limits=BodyLimits(settings)),
            Middleware(Defects),
        ],
    )
    app.state.service, app.state.metrics, app.state.identities = service, figures, identities
    app.state.slots, app.state.solutions = JobSlots(service), nova.Solutions()
    add_problem_handlers(app)
    add_missing_page(app)
    for router in RESOURCES:
        app.include_router(router, prefix=API, responses=REFUSALS)
    for router in OTHERS:
        app.include_router(router)
    return app


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    service: Service = app.state.service
    slots: JobSlots = app.state.slots
    await in_thread(slots.start)
    removing = asyncio.create_task(keep_removing(service))
    try:
        yield
    finally:
        service.stopping.set()
        removing.cancel()
        with suppress(asyncio.CancelledError):
            await removing
        await in_thread(slots.stop)  # a separate thread: all threads of requests can be busy
        service.close()
