"""The page *Identify*: a frame in, its attitude and its named stars out."""

from __future__ import annotations

import base64
import io
import math
import re
from typing import Annotated, Any

from fastapi import Query, Request
from fastapi.responses import Response
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile

from starcat.errors import ConfigError, StarcatError, quoted
from starcat.images.render import write_simulated
from starcat.images.solve_files import IdentifyOptions
from starcat.matcher.database import open_database
from starcat.matcher.methods.table import METHODS
from starcat.service.access import Reader
from starcat.service.api.identify import (
    MIB,
    SUFFIXES,
    FrameUpload,
    checked_options,
    identify_upload,
)
from starcat.service.library import Database
from starcat.service.pages.rendering import page_router, render
from starcat.service.problems import Problem, problem_of
from starcat.service.service import Service, TheService
from starcat.service.transfers import scratch_folder
from starcat.simulation.simulate import Noise, simulate_frames

router = page_router()

MAX_SEED = 2**31 - 1
MAX_PIXELS = 2**23  # frames with more are given as centroids, not as pictures
NOISE_PX = 0.3  # noise of a centroid, each axis

FIELDS = (
    "database", "method", "field_error", "tolerance_px", "centroids", "brightness", "seed",
)  # fmt: skip
"""Fields of the form that are texts."""


@router.get("/identify")
def identify_page(
    request: Request,
    service: TheService,
    _: Reader,
    database: Annotated[str, Query(max_length=64)] = "",
) -> Response:
    """Show the form."""
    return _page(request, service, {"database": database})


@router.post("/identify")
async def identify(request: Request, service: TheService, _: Reader) -> Response:
    """Identify the frame of a form, and show the form again with the answer."""
    async with request.form(max_files=1, max_fields=20) as form:
        given = {name: str(form.get(name) or "")[:MIB] for name in FIELDS}
        try:
            answer = await service.sandbox.run(_answer, service, form, given)
        except (StarcatError, Problem) as error:
            answer = {"problem": problem_of(error)}
    return await run_in_threadpool(_page, request, service, given, **answer)


def _answer(service: Service, form: FormData, given: dict[str, str]) -> dict[str, Any]:
    database = service.library.database(given["database"])
    frame, options = frame_of(form, given, database, service), options_of(given, service)
    found, picture = identify_upload(service, database.id, frame, options, "png")
    first = found["frames"][0]
    return {
        "found": found,
        "picture": _address(picture),
        "errors": _errors(first),
        "field_deg": _field_deg(first, database),
    }


@router.get("/identify/frame/{database_id}")
async def simulated_frame(
    service: TheService,
    _: Reader,
    database_id: str,
    seed: Annotated[int, Query(ge=0, le=MAX_SEED)] = 0,
) -> Response:
    """Give a simulated frame of a database's camera, to try things with."""
    database = service.library.database(database_id)
    name = f"{database.title}-{seed}{frame_suffix(database)}"
    content = await service.sandbox.run(_simulated, service, database, name, seed)
    kind = "image/png" if name.endswith(".png") else "text/csv; charset=utf-8"
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(content, media_type=kind, headers=headers)


def _page(request: Request, service: Service, given: dict[str, str], **answer: Any) -> Response:
    databases = service.library.databases()
    problem = answer.get("problem")
    nothing = dict.fromkeys(("found", "picture", "problem", "errors", "field_deg"))
    return render(
        request,
        "identify.html",
        status=problem.status if problem else 200,
        databases=[(one.id, one.title) for one in databases],
        methods=[(name, f"{name}: {one.description}") for name, one in METHODS.items()],
        given={**dict.fromkeys(FIELDS, ""), **given},
        suffixes=",".join(SUFFIXES),
        most_mib=service.settings.upload_mib,
        **{**nothing, **answer},
    )


def frame_of(
    form: FormData, given: dict[str, str], database: Database, service: Service
) -> FrameUpload:
    """Return the frame that a form brings."""
    if given["seed"]:
        number = _number(given["seed"], "seed")
        seed = int(min(max(number or 0, 0), MAX_SEED))
        name = f"simulated-{seed}{frame_suffix(database)}"
        return FrameUpload(name, io.BytesIO(_simulated(service, database, name, seed)))
    upload = form.get("file")
    if isinstance(upload, UploadFile) and upload.filename:
        return FrameUpload.of_form(upload, service.settings.upload_mib)
    if not given["centroids"].strip():
        raise Problem(
            422,
            "no frame was given; choose an image or a file of centroids, paste centroids, or try "
            "a simulated frame",
            key="file",
        )
    third = "mag" if given["brightness"] == "mag" else "flux"
    suffix, text = centroid_file(given["centroids"], third)
    return FrameUpload(f"pasted{suffix}", io.BytesIO(text.encode()))


def options_of(given: dict[str, str], service: Service) -> IdentifyOptions:
    """Return how a frame is to be identified."""
    percent = _number(given["field_error"], "field_error")
    content = {
        "method": given["method"] or None,
        "fov_error": None if percent is None else percent / 100.0,
        "tolerance_px": _number(given["tolerance_px"], "tolerance_px"),
    }
    return checked_options(content).model_copy(
        update={"time_limit_s": service.settings.query_time_s}
    )


def _simulated(service: Service, database: Database, name: str, seed: int) -> bytes:
    stars = open_database(database.folder, ())
    frame = next(
        simulate_frames(stars.directions, stars.camera, 1, Noise(NOISE_PX), seed, mag=stars.mag)
    )
    with scratch_folder(service.paths) as folder:
        write_simulated(folder / name, frame, stars.camera, seed)
        return (folder / name).read_bytes()


def _address(picture: bytes) -> str | None:
    """Return a picture as an address that holds it, as JPEG: nothing of a frame is kept."""
    if not picture:
        return None
    from PIL import Image

    file = io.BytesIO()
    Image.open(io.BytesIO(picture)).convert("RGB").save(file, "JPEG", quality=85)
    return f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"


def _errors(answer: dict[str, Any]) -> list[str] | None:
    """Return the standard deviations of the attitude about the three axes, arcseconds."""
    rows: list[list[float | None]] = answer.get("covariance_arcsec2") or []
    squares = [row[k] for k, row in enumerate(rows)]
    known = [f"{math.sqrt(one):.3g}" for one in squares if one is not None]
    return known if len(known) == 3 else None


def _field_deg(answer: dict[str, Any], database: Database) -> float | None:
    """Return the full angle across the width, degrees, by the focal length that was found."""
    focal_length_px = answer.get("focal_length_px")
    if not focal_length_px:
        return None
    half = 0.5 * database.camera.width_px / float(focal_length_px)
    return 2.0 * math.degrees(math.atan(half))


def _number(text: str, name: str) -> float | None:
    if not text.strip():
        return None
    try:
        return float(text)
    except ValueError:
        raise Problem(
            422, f"{name}: {text[:40]!r} is not a number; give one, or leave it empty", key=name
        ) from None


def frame_suffix(database: Database) -> str:
    """Return the suffix of the file of a simulated frame: a picture unless it were too large."""
    camera = database.camera
    return ".png" if camera.width_px * camera.height_px <= MAX_PIXELS else ".csv"


MAX_LINES = 20_000

_SEPARATORS = re.compile(r"[\s,;]+")


def centroid_file(text: str, third: str = "flux") -> tuple[str, str]:
    """Return pasted centroids as a centroid file; ``third`` is what a third number is."""
    stripped = text.strip()
    if stripped[:1] in ("{", "["):
        return ".json", stripped
    if "x_px" in stripped.partition("\n")[0]:
        return ".csv", stripped + "\n"
    rows = _rows(text)
    if not rows:
        raise ConfigError(
            "no centroid was pasted; give a line 'x y' or 'x y brightness' for each, in pixels",
            key="centroids",
        )
    names = ("x_px", "y_px", third)[: len(rows[0])]
    return ".csv", "\n".join(map(",".join, (names, *rows))) + "\n"


def _rows(text: str) -> list[list[str]]:
    rows: list[list[str]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = _SEPARATORS.sub(" ", line.partition("#")[0]).split()
        if not words:
            continue
        if len(rows) == MAX_LINES:
            raise ConfigError(
                f"line {number}: more than {MAX_LINES:,} centroids; a frame of so many is no "
                "frame of stars. Leave out the faint ones",
                key="centroids",
            )
        if not (2 <= len(words) <= 3 and all(map(_is_number, words))):
            raise ConfigError(
                f"line {number}: {quoted(line.strip())}; expected two or three numbers, 'x y' or "
                "'x y brightness'",
                key="centroids",
                value=line.strip()[:80],
            )
        if rows and len(words) != len(rows[0]):
            raise ConfigError(
                f"line {number}: {len(words)} numbers, the lines before have {len(rows[0])}; "
                "give all of them a brightness, or none",
                key="centroids",
            )
        rows.append(words)
    return rows


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
