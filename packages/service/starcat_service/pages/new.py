"""The page *New database*: a spec is designed, and what it would give is seen at once."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, Query, Request
from fastapi.responses import JSONResponse, RedirectResponse, Response
from pydantic import ValidationError
from starlette.datastructures import UploadFile

from starcat.arrays import Array
from starcat.catalog import data_source
from starcat.database.products import USUAL_PRODUCTS
from starcat.errors import ConfigError, SourceMissing, StarcatError
from starcat.frames.images import IMAGE_SUFFIXES
from starcat.geometry import radec_from_directions
from starcat.pipeline import Estimate
from starcat.pipeline.specs import BuildSpec, CameraSpec, preset, preset_names, unit_of
from starcat_service.access import Reader, principal_of
from starcat_service.api.identify import FrameUpload
from starcat_service.catalogs import is_here
from starcat_service.jobs.submission import (
    BeingBuilt,
    check_free,
    photographs_database,
    submit_build,
)
from starcat_service.pages.design import (
    PINNED,
    PRESET,
    design_query,
    differences,
    draft_of_query,
    pinned_draft,
)
from starcat_service.pages.draft import (
    RULE_FIELDS,
    TEXT,
    SpecForm,
    draft_of_content,
    draft_of_form,
    draft_of_text,
    draft_with,
    without_defaults,
)
from starcat_service.pages.preview import (
    MAX_MAPPED,
    Preview,
    Verdict,
    preview_of,
    tiling_of,
    verdict_of,
)
from starcat_service.pages.rendering import (
    ENVIRONMENT,
    count_text,
    page_router,
    render,
    sign_in_address,
    size_text,
)
from starcat_service.pages.response import FILE, MAX_BYTES, PER, keys_of_file
from starcat_service.pages.wording import page_problem
from starcat_service.problems import Problem, ProblemDetails
from starcat_service.sandbox.limiter import WAIT_S, in_thread
from starcat_service.security.request_limits import MAX_TARGET_BYTES
from starcat_service.service import Service, TheService
from starcat_service.settings import Role
from starcat_service.transfers import scratch_folder

MAX_FIELDS = 100  # fields of a form; this one has 41
MAX_KEYS = 200  # of an address
PHOTOS = "photos"  # name of the field with the photographs of a camera
MAX_PHOTOS = 5

BUILD_ANYWAY = "build-anyway"
ASKS = (
    "The estimate has not answered yet, so nobody knows whether this database would be good. Wait "
    "for the estimate, or build it without one."
)

router = page_router()


@dataclass(frozen=True)
class Sent:
    """What a form was sent with."""

    fields: dict[str, str]
    file: tuple[str, bytes] | None  # name and content of the CSV file of a response
    photos: list[FrameUpload]


async def sent_form(request: Request, service: TheService) -> AsyncIterator[Sent]:
    """Give what a request brings; of a file no more is read than may be taken."""
    async with request.form(max_files=MAX_PHOTOS + 2, max_fields=MAX_FIELDS) as form:
        fields = {name: value for name, value in form.items() if isinstance(value, str)}
        file, content = form.get(FILE), None
        if isinstance(file, UploadFile) and file.filename:
            content = (file.filename, await file.read(MAX_BYTES + 1))
        uploads = [upload for upload in form.getlist(PHOTOS) if isinstance(upload, UploadFile)]
        most_mib = service.settings.upload_mib
        photos = [FrameUpload.of_form(upload, most_mib) for upload in uploads if upload.filename]
        yield Sent(fields, content, photos)


Form = Annotated[Sent, Depends(sent_form)]


@router.get("/new")
def new_page(
    request: Request,
    service: TheService,
    _: Reader,
    preset_name: Annotated[str, Query(alias=PRESET)] = "",
    pinned: Annotated[str, Query()] = "",
    job: Annotated[str | None, Query()] = None,
    database: Annotated[str | None, Query()] = None,
) -> Response:
    """Show the form with the design of the address, or with that of a job or of a database."""
    if job is None and database is None:
        draft = draft_of_query(dict(request.query_params.multi_items()[:MAX_KEYS]))
    else:
        draft = draft_of_content(without_defaults(_spec_of(service, job, database)))
    # The page does not wait for a catalog; its script requests the estimate.
    form = {PRESET: preset_name or preset_names()[0], PINNED: pinned}
    shown = _first(service, draft, form)
    return _rendered(request, service, draft, form, shown, is_first=True)


def _spec_of(service: Service, job: str | None, database: str | None) -> dict[str, Any]:
    if job is None:
        return dict(service.library.database(database or "").manifest["spec"])
    spec = service.jobs.get(job).request.get("spec")
    if spec is None:
        raise Problem(404, f"job {job} builds nothing; choose one that does")
    return dict(spec)


@router.post("/new")
async def sent_page(request: Request, service: TheService, sent: Form, _: Reader) -> Response:
    """Build what the form has, sign in for it, or show what it would give."""
    form, action = sent.fields, sent.fields.get("do", "")
    if action == "sign-in":
        return await service.designs.run(WAIT_S, partial(_sign_in, request, service, form))
    change = await _asked(service, sent)
    draft = change.draft
    if not action.startswith("build") or draft.spec is None or draft.wrong:
        return await _page(request, service, change, form)
    who = principal_of(request)
    if who.role < Role.BUILDER:
        words = "building needs the role builder; sign in with a token that has it"
        return await _page(request, service, change, form, page_problem(Problem(403, words)))
    if action != BUILD_ANYWAY:
        seen = await _estimated(service, draft)
        shown = await service.designs.run(WAIT_S, partial(_shown, service, draft, form, [], seen))
        if shown["is_busy"] or not shown["can_build"]:
            asks = Problem(409, ASKS) if shown["is_busy"] else None
            refused = asks or Problem(422, shown["summary"].partition(": ")[2])
            return await _page(request, service, change, form, page_problem(refused))
    try:
        submitted = await service.designs.run(
            WAIT_S, partial(submit_build, service, draft.spec, who.name)
        )
    except (StarcatError, Problem) as error:
        return await _page(request, service, change, form, page_problem(error))
    return RedirectResponse(f"/jobs/{submitted.job.id}", 303)


def _sign_in(request: Request, service: Service, form: dict[str, str]) -> Response:
    """Go to the sign-in, which comes back to the design of a form."""
    draft = draft_of_form(form)
    target = sign_in_address(_address(draft, form))
    if len(target) <= MAX_TARGET_BYTES and target != sign_in_address(""):
        return RedirectResponse(target, 303)
    words = (
        "This design is too long for an address, and would be lost. Copy its text, sign in, and "
        "paste it there."
    )
    return _rendered(
        request, service, draft, form, _first(service, draft, form) | {"remarks": [words]}
    )


@router.post("/new/address")
def address(sent: Form, _: Reader) -> Response:
    """Tell a script the address of a design at once: its estimate can take long."""
    design_address = _address(draft_of_form(sent.fields), sent.fields)
    return JSONResponse({"address": design_address}, headers={"Cache-Control": "no-store"})


@router.post("/new/preview")
async def preview(service: TheService, sent: Form, _: Reader) -> Response:
    """Tell a script what the form has become, and what that would give."""
    change = await _asked(service, sent)
    seen = await _estimated(service, change.draft, sent.fields)
    return await service.designs.run(WAIT_S, partial(_state, service, change, sent.fields, seen))


def _state(service: Service, change: NewDesign, form: dict[str, str], seen: Seen) -> Response:
    draft = change.draft
    shown = _shown(service, draft, form, change.remarks, seen) | {"job": change.job}
    content: dict[str, Any] = {
        "toml": draft.text,
        "values": draft.values,
        "lens": draft.lens,
        "products": draft.products,
        "bands": draft.bands,
        "responses": draft.responses,
        **{name: shown[name] for name in ("errors", "summary", "address", "pinned_query", "job")},
        "wrong": ENVIRONMENT.get_template("new_wrong.html").render(shown),
        "result": ENVIRONMENT.get_template("new_result.html").render(shown),
        "is_busy": shown["is_busy"],
        "is_known": shown["preview"] is not None,
        "can_build": shown["can_build"],
        "stars": _counts(shown["preview"]),
        "region_tiling": _region_tiling(shown["preview"]),
    }
    return JSONResponse(content, headers={"Cache-Control": "no-store"})


@router.get("/new/tiling")
def tiling(count: Annotated[int, Query(ge=1, le=MAX_MAPPED)], _: Reader) -> Response:
    """Tell a script where the fields of a tiling are."""
    return JSONResponse(
        _positions(*tiling_of(count)), headers={"Cache-Control": "private, max-age=86400"}
    )


@dataclass(frozen=True)
class NewDesign:
    """The design that a form asks for."""

    draft: SpecForm
    remarks: list[str]  # for people
    job: str | None = None  # job that has to end before the form is sent again


async def _asked(service: Service, sent: Sent) -> NewDesign:
    """Return the design that a form asks for."""
    form = sent.fields
    draft = await service.designs.run(WAIT_S, partial(draft_of_form, form))
    if form.get("do") == PHOTOS:
        try:
            return await design_of_photos(service, sent.photos)
        except BeingBuilt as error:
            return NewDesign(draft, [f"{error.detail[0].upper()}{error.detail[1:]}."], error.job_id)
        except (StarcatError, Problem) as error:
            return NewDesign(draft, [f"No camera was found: {page_problem(error).detail}"])
    if sent.file is not None:
        try:
            return NewDesign(draft_with(draft, keys_of_file(*sent.file, form.get(PER, ""))), [])
        except ConfigError as error:
            return NewDesign(replace(draft, wrong=(*draft.wrong, error)), [])
    if form.get("do") == "pin":
        query = design_query(draft, form.get(PRESET, ""))
        if query is None:
            return NewDesign(
                draft, ["This design is too long to be pinned: keep its text instead."]
            )
        form[PINNED] = query.removeprefix("?") or f"{PRESET}="
    elif form.get("do") == "unpin":
        form[PINNED] = ""
    elif form.get("do") == "suggest":
        try:
            return await suggested(service, draft)
        except (StarcatError, Problem) as error:
            return NewDesign(draft, [f"No limits can be suggested: {page_problem(error).detail}"])
    return NewDesign(draft, [])


async def design_of_photos(service: Service, photos: list[FrameUpload]) -> NewDesign:
    """Return the design for the camera of photographs."""
    if not 0 < len(photos) <= MAX_PHOTOS:
        raise Problem(422, f"{len(photos)} photographs were given; choose 1 to {MAX_PHOTOS}")
    async with service.photographs.turn(WAIT_S):
        blind = await in_thread(partial(photographs_database, service))
        measured = await service.sandbox.run(_camera_of, service, photos, blind)
    camera = CameraSpec.model_validate(measured["camera"])
    starter = await service.catalogs.starter("camera", camera, reach_mag=measured["reach_mag"])
    return await service.designs.run(WAIT_S, partial(_design_of_camera, measured, starter.spec))


def _design_of_camera(measured: dict[str, Any], first: BuildSpec) -> NewDesign:
    """Return the design for what was measured in photographs, from a first spec."""
    from starcat.pipeline import spec_of_photos

    spec, remark = spec_of_photos(first, measured["noise_px"], measured["reach_mag"])
    remarks = "".join(f"# {line}\n" for line in (*measured["remarks"], remark))
    text = draft_of_content(without_defaults(spec.recorded())).text
    words = "Comments in the text of the spec have the uncertainty of each value."
    return NewDesign(draft_of_text(remarks + text), [f"{measured['remarks'][0]} {words}"])


def _camera_of(service: Service, photos: list[FrameUpload], blind: Path) -> dict[str, Any]:
    """Find the camera of photographs in the sandbox."""
    with scratch_folder(service.paths) as folder:
        names: list[str] = []
        for number, photo in enumerate(photos, 1):
            names.append(f"{number}-{photo.name}" if photo.name in names else photo.name)
            photo.write_to(folder / names[-1], service)
        arguments = {"folder": str(folder), "files": names, "blind": str(blind)}
        measured: dict[str, Any] = service.sandbox.call("first_camera", arguments)
        return measured


async def suggested(service: Service, draft: SpecForm) -> NewDesign:
    """Return a design with the limits that its camera needs."""
    try:
        camera = CameraSpec.model_validate(draft.content.get("camera"))
    except ValidationError:
        words = "No limits can be suggested before the fields of the camera are right."
        return NewDesign(draft, [words])
    starter = await service.catalogs.starter("camera", camera)
    limit = starter.spec.selection.faint_limit_mag
    source_response = draft.spec and (draft.spec.catalog.source, draft.spec.camera.response.name)
    if draft.spec is not None and source_response != (starter.spec.catalog.source, None):
        limit, _ = await service.catalogs.enough_limit(draft.spec)
    selection, boresights = starter.spec.selection, starter.spec.boresights
    changes: dict[str, Any] = {
        "selection.faint_limit_mag": limit,
        "selection.max_stars_per_field": selection.max_stars_per_field,
        "selection.doubles.min_separation_deg": selection.doubles.min_separation_deg,
        "selection.doubles.max_delta_mag": selection.doubles.max_delta_mag,
        "boresights.count": boresights.count,
        "boresights.brightest": boresights.brightest,
    }
    for name in USUAL_PRODUCTS:
        changes[f"products.{name}.enabled"] = False if name in starter.left_out else None
    fov = camera.camera()
    summary = (
        f"For {fov.fov_x_deg:.4g} x {fov.fov_y_deg:.4g} deg: faint limit {limit:g}, the "
        f"{selection.max_stars_per_field} brightest of each field, "
        f"{count_text(boresights.count)} boresights."
    )
    advice = [f"{sentence}." for sentence in starter.figures.advice]
    return NewDesign(draft_with(draft, changes), [summary, *advice])


@dataclass(frozen=True)
class Seen:
    """The estimates that a page shows: of its design, and of the design that is pinned."""

    estimated: tuple[Estimate, Verdict] | None = None
    problem: ProblemDetails | None = None  # why there is none
    pinned: tuple[Estimate, Verdict] | None = None


async def _estimated(service: Service, draft: SpecForm, form: Mapping[str, str] = {}) -> Seen:
    """Return the estimates for a page."""
    estimated, problem = await _estimate(service, draft)
    pinned = None
    if form.get(PINNED):
        with suppress(StarcatError):
            pinned, _ = await _estimate(service, pinned_draft(form[PINNED]))
    return Seen(estimated, problem, pinned)


async def _estimate(
    service: Service, draft: SpecForm
) -> tuple[tuple[Estimate, Verdict] | None, ProblemDetails | None]:
    if draft.spec is None:
        return None, None
    try:
        estimate = await service.catalogs.estimate(draft.spec)
        return (estimate, await verdict_of(estimate, service.catalogs)), None
    except SourceMissing as error:
        return None, page_problem(error).model_copy(update={"key": "catalog.source"})
    except (StarcatError, Problem) as error:
        return None, page_problem(error)


def _shown(
    service: Service, draft: SpecForm, form: dict[str, str], remarks: list[str], estimates: Seen
) -> dict[str, Any]:
    """Return what page and script are told of a design and of what it would give."""
    errors, problem = dict(draft.errors), None
    seen = None if estimates.estimated is None else preview_of(*estimates.estimated)
    failure = estimates.problem
    if failure is not None:
        field = draft.field_of(failure.key)
        if field is None or failure.status == 503:
            problem = failure
        else:
            errors[field] = failure.detail
    if draft.spec is not None:
        errors |= _taken(service, draft)
    refusals = []
    for error in seen.estimate.refusals if seen else ():
        field = draft.field_of(error.key)
        if field is None:
            refusals.append(str(error))
        else:
            errors.setdefault(field, str(error))
    is_refused = seen is not None and bool(refusals or seen.verdict.will_fail)
    is_busy = problem is not None and problem.status == 503
    return {
        "preview": seen,
        "problem": problem and problem.detail,
        "errors": errors,
        "refusals": refusals,
        "remarks": remarks,
        "summary": _summary(seen, [*errors.values(), *refusals], problem),
        "is_busy": is_busy,
        "can_build": not errors and not is_refused and (problem is None or is_busy),
        "address": _address(draft, form),
        "pinned_query": form.get(PINNED, ""),
        **_pinned(draft, form, estimates),
    }


def _first(service: Service, draft: SpecForm, form: dict[str, str]) -> dict[str, Any]:
    """Return what a page is told of a design of which no estimate was made yet."""
    errors = draft.errors | (_taken(service, draft) if draft.spec else {})
    return {
        **dict.fromkeys(("preview", "pinned", "problem", "job")),
        "errors": errors,
        "remarks": [],
        "differing": [],
        "summary": "",
        "can_build": not errors,
        "is_busy": False,
        "refusals": [],
        "address": _address(draft, form),
        "pinned_query": form.get(PINNED, ""),
    }


def _address(draft: SpecForm, form: dict[str, str]) -> str:
    """Return the address of a design; empty where it is too long for one."""
    query = design_query(draft, form.get(PRESET, ""), form.get(PINNED, ""))
    return "" if query is None else f"/new{query}"


def _taken(service: Service, draft: SpecForm) -> dict[str, str]:
    """Return the error where a database of this name and version is there already."""
    try:
        if draft.spec is not None:
            check_free(service, draft.spec)
    except Problem as error:
        return {error.key or TEXT: error.detail}
    except StarcatError:
        pass  # its catalog is missing, which is said elsewhere
    return {}


def _pinned(draft: SpecForm, form: dict[str, str], estimates: Seen) -> dict[str, Any]:
    """Return what is told of the design that is pinned, to compare this one with it."""
    query = form.get(PINNED, "")
    if not query:
        return {"pinned": None, "differing": []}
    try:
        other = pinned_draft(query)
    except StarcatError:
        return {"pinned": None, "differing": []}
    seen = estimates.pinned and preview_of(*estimates.pinned)
    return {"pinned": seen, "differing": differences(draft, other)}


def _counts(seen: Preview | None) -> list[int]:
    return [] if seen is None or seen.map is None else seen.estimate.fields.count.tolist()


def _region_tiling(seen: Preview | None) -> dict[str, list[float]] | None:
    """Return where the fields are, if they tile a region; a script asks for those of the sphere."""
    if seen is None or seen.estimate.spec.selection.region.footprint is None:
        return None
    return _positions(*radec_from_directions(seen.estimate.fields.boresights))


def _positions(ra_deg: Array, dec_deg: Array) -> dict[str, list[float]]:
    return {"ra_deg": ra_deg.round(3).tolist(), "dec_deg": dec_deg.round(3).tolist()}


async def _page(
    request: Request,
    service: Service,
    change: NewDesign,
    form: dict[str, str],
    refused: ProblemDetails | None = None,
) -> Response:
    seen, draft = await _estimated(service, change.draft, form), change.draft

    def make() -> Response:
        shown = _shown(service, draft, form, change.remarks, seen) | {"job": change.job}
        return _rendered(request, service, draft, form, shown, refused)

    return await service.designs.run(WAIT_S, make)


def _rendered(
    request: Request,
    service: Service,
    draft: SpecForm,
    form: dict[str, str],
    shown: dict[str, Any],
    refused: ProblemDetails | None = None,
    *,
    is_first: bool = False,
) -> Response:
    if refused is not None and refused.key in draft.values:
        shown["errors"][refused.key] = refused.detail
        refused = None
    status = refused.status if refused else 422 if shown["errors"] and not is_first else 200
    return render(
        request,
        "new.html",
        status=status,
        **shown,
        draft=draft,
        refused=refused and refused.detail,
        is_first=is_first,
        rule_fields=RULE_FIELDS,
        unit_of=unit_of,
        presets=_presets(),
        photo_suffixes=",".join(IMAGE_SUFFIXES),
        most_photos=MAX_PHOTOS,
        preset=form.get(PRESET, ""),
        sign_in=sign_in_address(str(shown["address"]) or "/new"),
        anyway=BUILD_ANYWAY,
        response_per=form.get(PER, ""),
        sources=_sources(service),
        may_build=principal_of(request).role >= Role.BUILDER,
        text_error=shown["errors"].get(TEXT),
    )


def _summary(seen: Preview | None, wrong: list[str], problem: ProblemDetails | None) -> str:
    if seen is None:
        why = next(iter(wrong), problem.detail if problem else "")
        return f"No estimate: {why}" if why else ""
    if wrong:
        return f"Cannot be built: {wrong[0]}"
    if seen.verdict.will_fail:
        return f"Not to be built: {seen.verdict.words}"
    figures = seen.figures
    stars = figures.fields.stars
    return (
        f"{count_text(figures.guide_stars)} guide stars, {stars.minimum} to {stars.maximum} in a "
        f"field (median {count_text(stars.median)}), {size_text(figures.total_bytes)}"
    )


def _presets() -> list[tuple[str, str, list[str]]]:
    """Return name, description, and the catalogs whose files are missing, of the presets."""
    presets = []
    for name in preset_names():
        spec = preset(name)
        missing = [source for source in spec.sources if not is_here(source)]
        presets.append((name, spec.description, missing))
    return presets


def _sources(service: Service) -> list[tuple[str, str]]:
    """Return the star catalogs there are, those whose files are here first."""
    sources = []
    for catalog in service.catalogs.offered():
        title = (
            data_source(catalog.name).identifier if catalog.is_here else "its files are not here"
        )
        sources.append((catalog.name, f"{catalog.name} – {title}"))
    return sources
