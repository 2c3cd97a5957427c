"""The page *Plan*: a table of attitudes in, what the sensor of a database will see at them out."""

from __future__ import annotations

import base64
from typing import Any

from fastapi import Request
from fastapi.responses import Response
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile

from starcat.errors import StarcatError
from starcat_service.access import Reader
from starcat_service.api.identify import MIB
from starcat_service.pages.identify import typed_number
from starcat_service.pages.rendering import page_router, render
from starcat_service.pages.wording import page_problem
from starcat_service.problems import Problem
from starcat_service.service import Service, TheService
from starcat_service.transfers import scratch_folder

router = page_router()

BODIES = ("Sun", "Moon", "Earth")
NUMBERS = ("limit_mag", "noise_px", "min_acquisition")
FIELDS = ("database", "attitudes", *NUMBERS, *(f"keep_out.{name}" for name in BODIES))
"""Fields of the form that are texts."""

MAX_PLAN_BYTES = MIB  # size of a table of attitudes or of an orbit
MAX_PLAN_LINES = 10_000
MAX_PLAN_SHOWN = 200  # attitudes and gaps on the page; the JSON file has all


@router.get("/plan")
def plan_page(request: Request, service: TheService, _: Reader, database: str = "") -> Response:
    """Show the form."""
    return _page(request, service, {**dict.fromkeys(FIELDS, ""), "database": database})


@router.post("/plan")
async def plan_form(request: Request, service: TheService, _: Reader) -> Response:
    """Plan the attitudes of a form, and show the form again with the plan."""
    async with request.form(max_files=2, max_fields=20) as form:
        fields = {name: str(form.get(name) or "") for name in FIELDS}
        try:
            texts = await _texts(form, fields)
            answer = await service.sandbox.run(_plan, service, fields, texts)
        except (StarcatError, Problem) as error:
            answer = {"problem": page_problem(error)}
    return await run_in_threadpool(_page, request, service, fields, **answer)


async def _texts(form: FormData, fields: dict[str, str]) -> dict[str, bytes]:
    """Return the tables that a form brings, by the names that messages call them."""
    texts = {"attitudes": fields["attitudes"].strip().encode()}
    for name, field in (("attitudes", "file"), ("orbit", "orbit")):
        upload = form.get(field)
        if isinstance(upload, UploadFile) and upload.filename:
            texts[name] = await upload.read(MAX_PLAN_BYTES + 1)
    for name, text in texts.items():
        if len(text) > MAX_PLAN_BYTES or len(text.splitlines()) > MAX_PLAN_LINES:
            raise Problem(
                413,
                f"{name}: the table has more than {MAX_PLAN_LINES:,} lines or 1 MiB; send a part "
                "of it, or use 'starcat plan' on your own computer",
            )
    if not texts["attitudes"]:
        raise Problem(422, "no attitude was given; choose a file, or paste a table", key="file")
    return texts


def _plan(service: Service, fields: dict[str, str], texts: dict[str, bytes]) -> dict[str, Any]:
    expected: dict[str, Any] = {name: typed_number(fields[name], name) for name in NUMBERS}
    angles = {name: typed_number(fields[f"keep_out.{name}"], f"keep_out.{name}") for name in BODIES}
    expected["keep_out_deg"] = {name: angle for name, angle in angles.items() if angle is not None}
    database = service.library.database(fields["database"])
    with scratch_folder(service.paths) as folder:
        for name, text in texts.items():
            (folder / name).write_bytes(text)
        arguments = {
            "folder": str(folder),
            "database": str(database.folder),
            "orbit": "orbit" if "orbit" in texts else None,
            "expected": {name: value for name, value in expected.items() if value is not None},
            "most": MAX_PLAN_SHOWN,
        }
        plan = service.sandbox.call("plan", arguments)
        picture, whole = (
            base64.b64encode((folder / f"plan.{suffix}").read_bytes()).decode()
            for suffix in ("svg", "json")
        )
    return {
        "plan": plan,
        "bodies_seen": [
            name
            for name in BODIES
            if any(attitude["angles_deg"].get(name) is not None for attitude in plan["attitudes"])
        ],
        "picture": f"data:image/svg+xml;base64,{picture}",
        "json": f"data:application/json;base64,{whole}",
    }


def _page(request: Request, service: Service, fields: dict[str, str], **answer: Any) -> Response:
    problem = answer.get("problem")
    return render(
        request,
        "plan.html",
        status=problem.status if problem else 200,
        databases=[(database.id, database.title) for database in service.library.databases()],
        fields=fields,
        bodies=BODIES,
        errors={problem.key: problem.detail} if problem and problem.key else {},
        most_lines=MAX_PLAN_LINES,
        most_shown=MAX_PLAN_SHOWN,
        **{**dict.fromkeys(("problem", "plan", "bodies_seen", "picture", "json")), **answer},
    )
