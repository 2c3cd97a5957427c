"""The start: what this service has, what to do first, and how programs reach it."""

from __future__ import annotations

from fastapi import Request
from fastapi.responses import Response

from starcat.service.access import Reader
from starcat.service.api import releases as api
from starcat.service.jobs.job import ENDED
from starcat.service.pages.facts import database_rows
from starcat.service.pages.releases import address_of
from starcat.service.pages.rendering import page_router, render
from starcat.service.service import TheService

router = page_router()

SHOWN = 8
"""Databases, jobs and releases that are shown of each."""


@router.get("/")
def home(request: Request, service: TheService, reader: Reader) -> Response:
    """Show the start."""
    rows = database_rows(service)
    newest_first = sorted(rows, key=lambda row: -row.built_s)
    releases = api.all_releases(service, reader).releases
    jobs = service.jobs.all(most=SHOWN)
    return render(
        request,
        "home.html",
        rows=newest_first[:SHOWN],
        count=len(rows),
        releases=sorted(releases, key=lambda one: -(one.published_s or 0.0))[:SHOWN],
        release_count=len(releases),
        jobs=[job for job in jobs if job.state not in ENDED],
        address=address_of(request, service),
        example=newest_first[0] if newest_first else None,
        needs_token=reader.name != "anonymous",
    )
