"""The page *Releases*: the list of them, how to get one, and publishing."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Literal

from fastapi import Form, Query, Request
from fastapi.responses import RedirectResponse, Response
from starlette.concurrency import run_in_threadpool

from starcat.errors import StarcatError
from starcat_service.access import Publisher, Reader
from starcat_service.api import releases as api
from starcat_service.library import ListedDatabase
from starcat_service.pages.facts import database_rows
from starcat_service.pages.rendering import page_router, page_url, render
from starcat_service.problems import Problem, ProblemDetails, problem_of
from starcat_service.service import Service, TheService
from starcat_service.settings import Role

router = page_router()


@router.get("/releases")
def releases_page(
    request: Request,
    service: TheService,
    reader: Reader,
    database: Annotated[str, Query(max_length=64)] = "",
    published: Annotated[str, Query(max_length=200)] = "",
    q: Annotated[str, Query(max_length=100)] = "",
    order: Annotated[Literal["newest", "name", "size"], Query()] = "newest",
) -> Response:
    """Show the published releases, and a form to publish other databases."""
    return _page(request, service, reader, database=database, published=published, q=q, order=order)


@router.post("/releases")
async def publish_page(
    request: Request,
    service: TheService,
    publisher: Publisher,
    database: Annotated[str, Form(max_length=64)],
    note: Annotated[str, Form(max_length=api.MAX_NOTE)] = "",
    confirmed: Annotated[bool, Form()] = False,
) -> Response:
    """Ask for confirmation to publish a database, or publish it and show it."""
    publication = api.ToPublish(database=database, note=note.replace("\r\n", "\n").strip())
    if not confirmed:
        asked = service.library.database(database)
        show = partial(_page, request, service, publisher, database=database)
        return await run_in_threadpool(show, note=publication.note, asked=asked)
    try:
        released = await api.publish(publication, Response(), service, publisher)
    except (StarcatError, Problem) as error:
        problem = problem_of(error)
        show = partial(_page, request, service, publisher, database=database)
        return await run_in_threadpool(show, note=note, problem=problem)
    return RedirectResponse(f"/releases?published={released.title}#{released.title}", 303)


def _page(
    request: Request,
    service: Service,
    principal: Reader,
    *,
    database: str = "",
    note: str = "",
    published: str = "",
    q: str = "",
    order: str = "newest",
    problem: ProblemDetails | None = None,
    asked: ListedDatabase | None = None,
) -> Response:
    listed = api.all_releases(service, principal).releases
    releases = [release for release in listed if _has_words(release, q)]
    if order != "name":
        by = "bytes" if order == "size" else "published_s"
        releases.sort(key=lambda release: getattr(release, by) or 0.0, reverse=True)
    rows = database_rows(service)
    return render(
        request,
        "releases.html",
        status=problem.status if problem else 200,
        releases=releases,
        count=len(listed),
        q=q,
        order=order,
        address=page_url(request, service),
        unreleased=[
            (row.database.id, f"{row.database.name} {row.database.version}")
            for row in rows
            if not row.is_released
        ],
        has_databases=bool(rows),
        asked=asked,
        may_publish=principal.role >= Role.PUBLISHER,
        most_note=api.MAX_NOTE,
        database=database,
        note=note,
        published=published if published in {release.title for release in listed} else "",
        problem=problem,
    )


def _has_words(release: api.ReleaseFacts, text: str) -> bool:
    """Return whether a release has all words of a text."""
    words = f"{release.title} {release.owner or ''} {release.note or ''}".lower()
    return all(word in words for word in text.lower().split())
