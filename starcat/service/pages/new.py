"""The page *New database*: a spec is designed, and what it would give is seen at once."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from fastapi import Depends, Query, Request
from fastapi.responses import JSONResponse, RedirectResponse, Response

from starcat.arrays import Array
from starcat.errors import StarcatError
from starcat.geometry.sphere import radec_from_directions, saff_kuijlaars
from starcat.pipeline.estimate import Estimate
from starcat.report.coverage_map import (
    Bin,
    Counts,
    Fields,
    SkyMap,
    bins_of,
    nearest_raster,
    raster_png,
    sky_map,
)
from starcat.service.access import Reader, principal_of
from starcat.service.jobs.submission import submit_build
from starcat.service.pages.draft import (
    TEXT,
    Draft,
    draft_of_content,
    draft_of_form,
    without_defaults,
)
from starcat.service.pages.rendering import (
    ENVIRONMENT,
    count_text,
    duration_text,
    page_router,
    render,
    size_text,
)
from starcat.service.problems import Problem, ProblemDetails, problem_of
from starcat.service.service import Service, TheService
from starcat.service.settings import Role
from starcat.specs.reading import preset, preset_names

MOST_FIELDS = 100  # fields of a form; this one has 30
MAP_WIDTH = 720  # columns of the raster of a map: what a card of the page is wide
MOST_BARS = 48
MOST_MAPPED = 50_000
"""Of more boresights than these no map is drawn: their fields would be finer than its dots."""

router = page_router()


async def form_of(request: Request) -> dict[str, str]:
    """Return the fields of the form that a request brings; files are none of them."""
    async with request.form(max_files=1, max_fields=MOST_FIELDS) as form:
        return {name: value for name, value in form.items() if isinstance(value, str)}


Form = Annotated[dict[str, str], Depends(form_of)]


@router.get("/new")
def new_page(
    request: Request,
    service: TheService,
    _: Reader,
    chosen: Annotated[str | None, Query(alias="preset")] = None,
    job: Annotated[str | None, Query()] = None,
    database: Annotated[str | None, Query()] = None,
) -> Response:
    """Show the form with a preset, or with the spec of a job or of a database."""
    if job is not None:
        spec = service.jobs.get(job).request.get("spec")
    elif database is not None:
        spec = service.library.database(database).manifest["spec"]
    else:
        chosen = chosen or preset_names()[0]
        spec = preset(chosen).recorded()
    if spec is None:
        raise Problem(404, f"job {job} builds nothing; choose one that does")
    # A page that waits for no catalog is there at once; its script asks for the estimate.
    return _page(
        request, service, draft_of_content(without_defaults(spec)), chosen or "", is_first=True
    )


@router.post("/new")
def sent_page(request: Request, service: TheService, form: Form, _: Reader) -> Response:
    """Build what the form has, or show what it would give."""
    draft = draft_of_form(form)
    if form.get("do") != "build" or draft.spec is None:
        return _page(request, service, draft, form.get("preset", ""))
    who = principal_of(request)
    try:
        if who.role < Role.BUILDER:
            raise Problem(
                403,
                "building needs the role builder; sign in with a token that has it "
                "('starcat token create --role builder')",
            )
        job = submit_build(service, draft.spec, who.name).job
    except (StarcatError, Problem) as error:
        return _page(request, service, draft, form.get("preset", ""), error)
    return RedirectResponse(f"/jobs/{job.id}", 303)


@router.post("/new/preview")
def preview(request: Request, service: TheService, form: Form, _: Reader) -> Response:
    """Tell a script what the form has become, and what that would give."""
    draft = draft_of_form(form)
    seen, error = _preview(service, draft)
    told = {"problem": error and error.detail, "errors": draft.errors}
    content: dict[str, Any] = {
        "toml": draft.text,
        "values": draft.values,
        "lens": draft.lens,
        "products": draft.products,
        "bands": draft.bands,
        "errors": draft.errors,
        "wrong": ENVIRONMENT.get_template("new_wrong.html").render(told),
        "result": ENVIRONMENT.get_template("new_result.html").render(preview=seen),
        "summary": _summary(seen, draft, error),
        "is_busy": error is not None and error.status == 503,
        "is_known": seen is not None,
        "stars": [] if seen is None or seen.map is None else seen.estimate.fields.count.tolist(),
    }
    return JSONResponse(content, headers={"Cache-Control": "no-store"})


@router.get("/new/tiling")
def tiling(count: Annotated[int, Query(ge=1, le=MOST_MAPPED)], _: Reader) -> Response:
    """Tell a script where the fields of a tiling are."""
    ra_deg, dec_deg = _tiling(count)
    content = {"ra_deg": ra_deg.round(3).tolist(), "dec_deg": dec_deg.round(3).tolist()}
    return JSONResponse(content, headers={"Cache-Control": "private, max-age=86400"})


def _preview(service: Service, draft: Draft) -> tuple[Preview | None, ProblemDetails | None]:
    if draft.spec is None:
        return None, None
    try:
        return preview_of(service.catalogs.estimate(draft.spec)), None
    except (StarcatError, Problem) as error:
        return None, problem_of(error)


def _page(
    request: Request,
    service: Service,
    draft: Draft,
    chosen: str,
    refused: StarcatError | Problem | None = None,
    *,
    is_first: bool = False,
) -> Response:
    seen, error = (None, None) if is_first else _preview(service, draft)
    problem = None if refused is None else problem_of(refused)
    status = problem.status if problem else 422 if draft.errors else 200
    return render(
        request,
        "new.html",
        status=status,
        draft=draft,
        preview=seen,
        problem=error and error.detail,
        errors=draft.errors,
        refused=problem and problem.detail,
        summary=_summary(seen, draft, error),
        is_first=is_first,
        presets=[(name, preset(name).description) for name in preset_names()],
        chosen=chosen,
        sources=_sources(service),
        may_build=principal_of(request).role >= Role.BUILDER,
        text_error=draft.errors.get(TEXT),
    )


def _summary(seen: Preview | None, draft: Draft, problem: ProblemDetails | None) -> str:
    if seen is None:
        why = next(iter(draft.errors.values()), problem.detail if problem else "")
        return f"No estimate: {why}" if why else ""
    found = seen.estimate
    stars = found.coverage.stars
    return (
        f"{count_text(found.cost.stars)} guide stars, {count_text(stars.median)} in the middle "
        f"field ({stars.minimum} to {stars.maximum}), {size_text(found.total_bytes)}, built in "
        f"about {duration_text(max(1.0, found.build_seconds))}"
    )


def _sources(service: Service) -> list[tuple[str, str]]:
    """Return the star catalogs there are, those whose files are here first."""
    found = []
    for one in service.catalogs.offered():
        told = one.source.identifier if one.is_here else "its files are not here"
        found.append((one.source.name, f"{one.source.name} – {told}"))
    return found


# What a spec would give: sizes, a histogram, and the map of the sky.


@dataclass(frozen=True)
class Bar:
    """A bar of the histogram of stars in a field."""

    least: int  # stars of a field
    most: int
    fields: int
    colour: str  # class of the colour that the map has for them


@dataclass(frozen=True)
class Preview:
    """What a spec would give."""

    estimate: Estimate
    files: list[tuple[str, int | None, int]]  # name, rows of a product, bytes; the largest first
    bars: list[Bar]
    map: SkyMap | None  # None: the tiling is too fine for a map
    picture: str  # the raster, as an address that holds it


def preview_of(estimate: Estimate) -> Preview:
    """Return what the page shows of an estimate."""
    counts = estimate.fields.count.astype(np.int64)
    ra_deg, dec_deg = _tiling(len(counts))
    none = np.zeros_like(counts)
    fields = Fields(ra_deg, dec_deg, counts, none, none)
    bins = bins_of(counts)
    is_mapped = len(counts) <= MOST_MAPPED
    return Preview(
        estimate,
        sorted(estimate.files, key=lambda file: (-file[2], file[0])),
        _bars(counts, bins),
        sky_map(fields) if is_mapped else None,
        _picture(counts) if is_mapped else "",
    )


@lru_cache(maxsize=4)
def _tiling(count: int) -> tuple[Array, Array]:
    return radec_from_directions(saff_kuijlaars(count))


def _bars(counts: Counts, bins: tuple[Bin, ...]) -> list[Bar]:
    least, most = int(counts.min()), int(counts.max())
    step = -(-(most - least + 1) // MOST_BARS)
    fields = np.bincount((counts - least) // step)
    bars = []
    for low, count in zip(range(least, most + 1, step), fields.tolist(), strict=True):
        colour = next((one.name for one in reversed(bins) if one.least <= low), bins[0].name)
        bars.append(Bar(low, low + step - 1, count, colour))
    return bars


@lru_cache(maxsize=4)
def _nearest(count: int) -> Array:
    return nearest_raster(saff_kuijlaars(count), np.arange(count), MAP_WIDTH)


def _picture(counts: Counts) -> str:
    raster = raster_png(_nearest(len(counts)), counts)
    return f"data:image/png;base64,{base64.b64encode(raster).decode()}"
