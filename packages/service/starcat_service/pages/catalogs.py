"""The page *Catalogs*: sources of databases, and the star tables that jobs have read."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import Form, Request
from fastapi.responses import RedirectResponse, Response

from starcat_service.access import Builder, Publisher, Reader
from starcat_service.api import catalogs as api
from starcat_service.jobs.submission import submit_ingest
from starcat_service.pages.rendering import page_router, render
from starcat_service.sandbox.limiter import WAIT_S
from starcat_service.service import TheService
from starcat_service.settings import Role

router = page_router()


@router.get("/catalogs")
def catalogs_page(request: Request, service: TheService, reader: Reader) -> Response:
    """Show all catalogs."""
    return render(
        request,
        "catalogs.html",
        listing=api.all_catalogs(service, reader),
        may_read=reader.role >= Role.BUILDER,
        may_remove=reader.role >= Role.PUBLISHER,
    )


@router.post("/catalogs")
async def read_catalog(
    service: TheService, builder: Builder, source: Annotated[str, Form(max_length=64)]
) -> Response:
    """Start a job that reads a catalog into a star table, and show the job."""
    submitted = await service.designs.run(
        WAIT_S, partial(submit_ingest, service, source, builder.name)
    )
    return RedirectResponse(f"/jobs/{submitted.job.id}", 303)


@router.post("/catalogs/{name}/remove")
def remove_page(service: TheService, publisher: Publisher, name: str) -> Response:
    """Remove a star table, and show the others."""
    api.remove(name, service, publisher)
    return RedirectResponse("/catalogs", 303)
