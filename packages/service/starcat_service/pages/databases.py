"""The pages of databases: the list, one database, its coverage, its report, two versions."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import Form, Query, Request
from fastapi.responses import JSONResponse, RedirectResponse, Response
from starlette.concurrency import run_in_threadpool

from starcat.database import Difference
from starcat.errors import TargetMissing
from starcat.geometry import directions_from_radec
from starcat.matcher import METHODS
from starcat.pipeline.report import (
    FIXED_BINS,
    Fields,
    colour_bins,
    field_at,
    nearest_raster,
    raster_png,
    sky_map,
)
from starcat.pipeline.simulation import part_of_database
from starcat.sections import version_numbers
from starcat_service.access import Builder, Reader
from starcat_service.api.databases import difference_of, fields_of, remove
from starcat_service.jobs.submission import submit_evaluation
from starcat_service.library import ListedDatabase
from starcat_service.pages.downloads import image_choices
from starcat_service.pages.facts import (
    database_rows,
    products_of,
    readable_report,
    rejections_of,
    report_of,
    star_fact_columns,
)
from starcat_service.pages.jobs import evaluation_of
from starcat_service.pages.notebook import Notebook, database_code, difference_code, query_code
from starcat_service.pages.rendering import ENVIRONMENT, page_router, page_url, render
from starcat_service.pages.sky import CACHED, sky_view
from starcat_service.removal import may_remove
from starcat_service.service import Service, TheService
from starcat_service.settings import Role

router = page_router()

REPORT_PAGE = "report/index.html"
REPORT_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; sandbox allow-same-origin"
)
"""A report contains its style and its plots, and nothing else; scripts in it do not run.

It keeps the origin of the service: from a page without an origin a browser follows the link back
without the cookie of the sign-in, which is SameSite=Strict.
"""

RASTER_WIDTH = 960
FIELDS_SHOWN = 25  # fields of the tiling on a page
DIFFERENCES_SHOWN = 100  # stars of each kind that a comparison lists

CHANGED = """\
SELECT 'added' AS reason, designation, mag, ra_deg, dec_deg
FROM b.stars ANTI JOIN a.stars USING (catalog, star_id)
UNION ALL
SELECT 'removed', designation, mag, ra_deg, dec_deg
FROM a.stars ANTI JOIN b.stars USING (catalog, star_id)
ORDER BY mag"""
"""Stars that only one of two databases has, with their positions."""

Order = Literal["fewest", "most", "number", "ra", "dec"]


@router.get("/databases")
def list_of_databases(request: Request, service: TheService, _: Reader) -> Response:
    """Show all databases."""
    return render(request, "databases.html", rows=database_rows(service))


@router.get("/databases/{database_id}")
def database_page(
    request: Request, service: TheService, reader: Reader, database_id: str
) -> Response:
    """Show the facts of a database."""
    database = service.library.database(database_id)
    manifest = database.manifest
    evaluations = service.jobs.all(kind="evaluate", database=database.id)
    done = next((job for job in evaluations if job.state == "done"), None)
    return render(
        request,
        "database.html",
        **_head(service, database, "overview"),
        report=report_of(database),
        products=products_of(manifest),
        rejections=rejections_of(manifest),
        image=image_choices(database),
        notebook=Notebook(database.title, database_code(page_url(request, service), database.id)),
        methods=[
            name
            for name, method in METHODS.items()
            if set(method.products) <= set(manifest["products"])
        ],
        files=sorted(manifest["files"].items()),
        digest=database.manifest_sha256,
        may_evaluate=reader.role >= Role.BUILDER,
        may_remove=may_remove(service, database.id, reader),
        evaluations=evaluations,
        done=done,
        **evaluation_of(done),
    )


@router.get("/databases/{database_id}/coverage")
def coverage_page(
    request: Request,
    service: TheService,
    _: Reader,
    database_id: str,
    order: Annotated[Order, Query()] = "fewest",
    page: Annotated[int, Query(ge=1, le=1_000_000)] = 1,
    at_most: Annotated[str, Query(pattern=r"^\d{0,9}$")] = "",
) -> Response:
    """Show the view of the sky and the fields of the tiling."""
    database = service.library.database(database_id)
    fields = fields_of(database)
    matching = [
        number
        for number in _ordered(fields, order)
        if not at_most or fields.stars[number] <= int(at_most)
    ]
    pages = max(1, -(-len(matching) // FIELDS_SHOWN))
    page = min(page, pages)
    numbers = matching[(page - 1) * FIELDS_SHOWN : page * FIELDS_SHOWN]
    return render(
        request,
        "coverage.html",
        **_head(service, database, "coverage"),
        report=report_of(database),
        sky_map=sky_map(fields),
        fields=[field_at(fields, number) for number in numbers],
        star_columns=["designation", "mag", *star_fact_columns(database.manifest)],
        fov=(database.camera.fov_x_deg, database.camera.fov_y_deg),
        view=sky_view(database, fields=f"/databases/{database.id}/fields.json"),
        order=order,
        page=page,
        pages=pages,
        at_most=at_most,
        count=len(fields),
        matching=len(matching),
        notebook=_fields_notebook(request, service, database, order, page, at_most),
    )


_SQL_ORDER = {
    "fewest": "star_count, boresight",
    "most": "star_count DESC, boresight",
    "number": "boresight",
    "ra": "ra_deg, boresight",
    "dec": "dec_deg, boresight",
}


def _fields_notebook(
    request: Request,
    service: Service,
    database: ListedDatabase,
    order: Order,
    page: int,
    at_most: str,
) -> Notebook | None:
    """Return Python that queries the fields on the page; None if no product has them."""
    if "boresights" not in database.products:
        return None
    query = (
        "SELECT boresight, ra_deg, dec_deg, star_count FROM boresights\n"
        + (f"WHERE star_count <= {int(at_most)}\n" if at_most else "")
        + f"ORDER BY {_SQL_ORDER[order]} LIMIT {FIELDS_SHOWN} OFFSET {(page - 1) * FIELDS_SHOWN}"
    )
    code = query_code(page_url(request, service), [database.id], query, {}, FIELDS_SHOWN)
    return Notebook(f"{database.title}-fields", code)


def _ordered(fields: Fields, order: Order) -> list[int]:
    keys = {"fewest": fields.stars, "most": -fields.stars, "ra": fields.ra_deg}
    keys |= {"dec": fields.dec_deg, "number": np.arange(len(fields))}
    return list(np.argsort(keys[order], kind="stable").tolist())


@lru_cache(maxsize=16)
def _map_png(folder: Path, fields: Fields, *, is_compared: bool) -> bytes:
    directions = directions_from_radec(fields.ra_deg, fields.dec_deg)
    nearest = nearest_raster(directions, RASTER_WIDTH, part_of_database(folder))
    return raster_png(nearest, fields.stars, FIXED_BINS if is_compared else ())


@router.get("/databases/{database_id}/coverage.png")
def coverage_raster(
    service: TheService, _: Reader, database_id: str, compared: Annotated[bool, Query()] = False
) -> Response:
    """Return the raster of the map of the sky; maps that are compared have the same colours."""
    database = service.library.database(database_id)
    picture = _map_png(database.folder, fields_of(database), is_compared=compared)
    return Response(picture, media_type="image/png", headers=CACHED)


@router.get("/databases/{database_id}/fields.json")
def fields_of_map(service: TheService, _: Reader, database_id: str) -> Response:
    """Return the fields of the tiling for the script of the map."""
    fields = fields_of(service.library.database(database_id))
    content = {
        "ra_deg": fields.ra_deg.round(4).tolist(),
        "dec_deg": fields.dec_deg.round(4).tolist(),
        "stars": fields.stars.tolist(),
        "bins": [
            {"least": colour_bin.least, "colour": colour_bin.colour}
            for colour_bin in colour_bins(fields.stars)
        ],
    }
    return JSONResponse(content, headers=CACHED)


@router.get("/databases/{database_id}/report")
def build_report(service: TheService, _: Reader, database_id: str) -> Response:
    """Return the page that the build wrote; its content cannot run anything."""
    database = service.library.database(database_id)
    path = database.folder / REPORT_PAGE
    if REPORT_PAGE not in database.manifest["files"] or not path.is_file():
        raise TargetMissing(f"{database.title} has no report", hint="build it again to get one")
    headers = {**CACHED, "Content-Security-Policy": REPORT_POLICY}
    head = ENVIRONMENT.get_template("report_head.html").render(database=database)
    page = path.read_bytes().replace(b"<body>", b"<body>" + head.encode(), 1)
    page = _COUNT.sub(
        lambda match: match[0].replace(b",", "\N{NARROW NO-BREAK SPACE}".encode()), page
    )
    return Response(page, media_type="text/html; charset=utf-8", headers=headers)


_COUNT = re.compile(rb"(?<=>)\d{1,3}(,\d{3})+(?=<)")
"""A count as reports write it; pages have a thin space between thousands."""


@router.get("/databases/{database_id}/compare")
async def compare(
    request: Request,
    service: TheService,
    _: Reader,
    database_id: str,
    other: Annotated[str, Query(max_length=64)] = "",
) -> Response:
    """Show the differences between this database and a later or other one."""
    difference = None
    other = other or await run_in_threadpool(_another_version, service, database_id)
    if other:
        # It waits its turn like a query, because it reads whole tables.
        sides = await run_in_threadpool(_older_first, service, database_id, other)
        ids = [side.id for side in sides]
        difference = await service.query_pool.run(difference_of, service, *ids)
    return await run_in_threadpool(_comparison, request, service, database_id, other, difference)


def _comparison(
    request: Request, service: Service, database_id: str, other: str, difference: Difference | None
) -> Response:
    database = service.library.database(database_id)
    others = [candidate for candidate in service.library.databases() if candidate.id != database.id]
    others.sort(key=lambda candidate: candidate.name != database.name)  # other versions of it first
    earlier, later = _older_first(service, database_id, other) if other else (database, None)
    code = later and difference_code(page_url(request, service), earlier.id, later.id)
    return render(
        request,
        "compare.html",
        **_head(service, database, "compare"),
        others=others,
        suggested=other,
        earlier=earlier,
        later=later,
        difference=difference,
        sides=[_side(service, side) for side in (earlier, later)] if later else [],
        notebook=Notebook(f"{earlier.title}-{later.title}", code) if later and code else None,
        changed=CHANGED,
        most=DIFFERENCES_SHOWN,
    )


def _another_version(service: Service, database_id: str) -> str:
    """Return the id of the newest other version of a database; empty if there is none."""
    database = service.library.database(database_id)
    others = [candidate for candidate in service.library.databases() if candidate.id != database.id]
    return next(
        (candidate.id for candidate in reversed(others) if candidate.name == database.name), ""
    )


def _side(service: Service, database: ListedDatabase) -> dict[str, Any]:
    """Return the facts that a comparison shows of one of the two databases."""
    newest = service.jobs.all(kind="evaluate", state="done", database=database.id, most=1)
    return {
        "row": database_rows(service, database)[0],
        "coverage": readable_report(database).get("coverage"),
        "map": sky_map(fields_of(database), FIXED_BINS),
        "measured": evaluation_of(newest[0] if newest else None)["rates"],
    }


def _older_first(
    service: Service, database_id: str, other: str
) -> tuple[ListedDatabase, ListedDatabase]:
    """Return two databases in the chosen order, but two versions of one with the older first."""
    first, second = map(service.library.database, (database_id, other))
    is_newer = first.name == second.name and (
        version_numbers(first.version) > version_numbers(second.version)
    )
    return (second, first) if is_newer else (first, second)


@router.post("/databases/{database_id}/evaluate")
def evaluate_page(
    service: TheService,
    builder: Builder,
    database_id: str,
    frames: Annotated[int, Form(ge=1, le=20_000)] = 500,
) -> Response:
    """Start a job that measures how often frames are identified, and show the job."""
    submitted = submit_evaluation(service, database_id, builder.name, frames=frames)
    return RedirectResponse(f"/jobs/{submitted.job.id}", 303)


@router.post("/databases/{database_id}/remove")
def remove_page(service: TheService, builder: Builder, database_id: str) -> Response:
    """Remove a database, and show the others."""
    remove(database_id, service, builder)
    return RedirectResponse("/databases", 303)


def _head(service: Service, database: ListedDatabase, tab: str) -> dict[str, Any]:
    return {"row": database_rows(service, database)[0], "database": database, "tab": tab}
