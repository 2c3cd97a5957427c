"""Whether the service lives, whether it can work, and its figures."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse, Response
from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4
from pydantic import BaseModel, Field

from starcat.service.access import Reader
from starcat.service.jobs.slots import JobSlots
from starcat.service.security.bodies import free_gib
from starcat.service.service import Service, TheService

router = APIRouter(tags=["operations"])


class Alive(BaseModel):
    """The service answers."""

    status: str = Field("alive", description="Always this.")


class Readiness(BaseModel):
    """Whether the service can do all of its work."""

    ready: bool = Field(description="Whether nothing is wrong.")
    reasons: list[str] = Field(description="What is wrong.")


@router.get("/healthz", summary="Whether the service lives")
def alive() -> Alive:
    """Answer, which is all that this is for."""
    return Alive(status="alive")


@router.get(
    "/readyz",
    summary="Whether the service can work",
    responses={503: {"model": Readiness, "description": "Something is wrong."}},
)
def ready(request: Request, service: TheService, who: Reader) -> Response:
    """Look at the records, the disk and the slots of jobs."""
    reasons = [reason for check in CHECKS if (reason := check(service)) is not None]
    slots: JobSlots = request.app.state.slots
    if not slots.is_alive:
        reasons.append("a slot of jobs has ended; start the service again")
    if slots.cluster is not None and slots.cluster.problem is not None:
        reasons.append(f"jobs wait for the cluster: {slots.cluster.problem}")
    content = Readiness(ready=not reasons, reasons=reasons)
    return JSONResponse(content.model_dump(), 503 if reasons else 200)


@router.get("/metrics", summary="Figures for Prometheus", response_class=Response)
def figures(request: Request, who: Reader) -> Response:
    """Return all figures as text."""
    return Response(request.app.state.metrics.text(), media_type=CONTENT_TYPE_PLAIN_0_0_4)


def _lack_of_records(service: Service) -> str | None:
    try:
        with service.records.writing() as connection:
            connection.execute("SELECT 1")
    except sqlite3.Error as error:
        return f"the records cannot be written: {error}"
    return None


def _lack_of_disk(service: Service) -> str | None:
    free, least = free_gib(service.settings.root), service.settings.free_gib
    return None if free >= least else f"{free:.1f} GiB of disk are left, less than {least:g}"


CHECKS: tuple[Callable[[Service], str | None], ...] = (_lack_of_records, _lack_of_disk)
"""Each returns what is wrong, or None."""
