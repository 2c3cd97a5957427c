"""The page *Identify*: a frame in, its attitude and its named stars out."""

from __future__ import annotations

import base64
import io
import math
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import Query, Request
from fastapi.responses import Response
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile

from starcat.errors import ConfigError, StarcatError, quoted
from starcat.frames.images import write_simulated
from starcat.geometry import Camera
from starcat.matcher import METHODS, IdentifyOptions, is_number, open_database
from starcat.pipeline.simulation import Noise, simulate_frames
from starcat.pipeline.specs import camera_toml, parse_camera
from starcat_service.access import Reader
from starcat_service.api.identify import (
    MIB,
    SUFFIXES,
    FrameUpload,
    checked_options,
    identify_upload,
)
from starcat_service.candidates import (
    MAX_SEARCH_S,
    FieldsDeg,
    databases_in_order,
    field_line,
    spec_of,
    try_each,
)
from starcat_service.library import ListedDatabase
from starcat_service.pages.answers import Shown, ShownFrame, marks_of, shown_frames, unusable_frame
from starcat_service.pages.notebook import Notebook, identify_code
from starcat_service.pages.rendering import page_router, page_url, render
from starcat_service.pages.sky import sky_view
from starcat_service.pages.wording import OPTION_FIELDS, option_hints, page_problem
from starcat_service.problems import Problem
from starcat_service.service import Service, TheService
from starcat_service.transfers import scratch_folder

router = page_router()

MAX_SEED = 2**31 - 1
MAX_PIXELS = 2**23  # larger frames are centroids, not pictures
NOISE_PX = 0.3  # noise of a centroid, each axis

CAMERA = ("width_px", "height_px", "fov_x_deg", "focal_length_mm", "pixel_um")
"""Fields of another camera, named ``camera.`` and this."""

FIELDS = (
    "database", "method", "field_error", "fov_from", "fov_to", "time",
    "centroids", "brightness", "seed", "lens", "camera.flip", "camera_file",
    *(f"camera.{name}" for name in CAMERA), *OPTION_FIELDS,
)  # fmt: skip
"""Fields of the form that are texts."""

MAX_FILES = 50  # pictures at once

NO_FRAME = {"status": "identified"}
"""Stands for the frames of a file without any: no other database would find some."""

ANY = "the one that fits the frame"
"""The choice of a database by the field of view; others are tried if it does not identify."""


@router.get("/identify")
async def identify_page(request: Request, service: TheService, _: Reader) -> Response:
    """Show the form, with the answer if the address contains a frame."""
    fields = {name: request.query_params.get(name, "")[:MIB] for name in FIELDS}
    if not (fields["centroids"] or fields["seed"]):
        return await run_in_threadpool(_page, request, service, fields)
    return await _answered(request, service, FormData(), fields)


@router.post("/identify")
async def identify_form(request: Request, service: TheService, _: Reader) -> Response:
    """Identify the frames of a form, and show the form again with the answer."""
    async with request.form(max_files=MAX_FILES, max_fields=40) as form:
        fields = {name: str(form.get(name) or "")[:MIB] for name in FIELDS}
        return await _answered(request, service, form, fields)


async def _answered(
    request: Request, service: Service, form: FormData, fields: dict[str, str]
) -> Response:
    try:
        asked = await service.sandbox.run(_asked, service, form, fields)
        answer = await _answer(service, asked, fields)
    except (StarcatError, Problem) as error:
        answer = {"problem": page_problem(error)}
    return await run_in_threadpool(_page, request, service, fields, **answer)


@dataclass(frozen=True)
class _Asked:
    databases: list[ListedDatabase]  # databases to try, in this order
    uploads: list[FrameUpload]


@dataclass(frozen=True)
class _FileAnswer:
    """The results of the databases for a file."""

    database: ListedDatabase  # database that identified a frame, else the first one
    frames: list[ShownFrame]
    picture: bytes
    method: str
    options: IdentifyOptions
    camera: Camera
    tried: tuple[str, ...]  # databases that did not identify a frame, and reasons


def _asked(service: Service, form: FormData, fields: dict[str, str]) -> _Asked:
    if fields["database"]:
        databases = [service.library.database(fields["database"])]
    else:
        databases = databases_in_order(service.library.databases(), _fields_deg(fields))
    if not databases:
        raise Problem(404, "this service has no database yet; build one first", key="database")
    return _Asked(databases, frames_of(form, fields, databases[0], service))


def _fields_deg(fields: Mapping[str, str]) -> FieldsDeg | None:
    """Return the fields of view that a form states, degrees; None if it states none."""
    ends = [typed_number(fields[name], name) for name in ("fov_from", "fov_to")]
    if ends[0] is not None and ends[1] is not None:
        return ends[0], ends[1]
    field_deg = typed_number(fields["camera.fov_x_deg"], "camera.fov_x_deg")
    if field_deg is None and fields["camera_file"].strip():
        field_deg = parse_camera(fields["camera_file"], Path("camera file"), (1, 1)).fov_x_deg
    return None if field_deg is None else (field_deg, field_deg)


async def _answer(service: Service, asked: _Asked, fields: dict[str, str]) -> dict[str, Any]:
    """Return the shown results of all files; other requests have their turn between files."""
    until_s = time.monotonic() + service.settings.query_time_s
    frames: list[ShownFrame] = []
    first, shown, picture = None, None, b""
    for upload in asked.uploads:
        if time.monotonic() > until_s:
            frames.append(unusable_frame(upload.name, "not looked at, the others took the time"))
            continue
        is_drawn = first is None or not first.is_identified
        try:
            answer = await service.sandbox.run(
                _frames, service, asked, upload, fields, draw=is_drawn
            )
        except (StarcatError, Problem) as error:
            if len(asked.uploads) == 1:
                raise
            frames.append(unusable_frame(upload.name, page_problem(error).detail))
            continue
        if answer.frames and (first is None or (is_drawn and answer.frames[0].is_identified)):
            first, picture, shown = answer.frames[0], answer.picture, answer
        frames += answer.frames
    if first is None or shown is None:
        return {"shown": Shown(asked.databases[0].title, "", frames, frames[0])}
    return {
        "shown": Shown(shown.database.title, shown.method, frames, first),
        "used": shown.database,
        "tried": shown.tried,
        "picture": _address(picture),
        "errors_arcsec": _errors(first.content),
        "field_deg": _field_deg(first.content, shown.camera),
        "view": _view(first, shown.database, shown.camera),
        "options": _stated_options(shown.options),
    }


def _frames(
    service: Service, asked: _Asked, upload: FrameUpload, fields: dict[str, str], *, draw: bool
) -> _FileAnswer:
    """Identify the frames of one file with one database after another, until one succeeds."""
    kind: Literal["svg"] | None = "svg" if draw else None
    has_database = bool(fields["database"])

    def in_order(fields_deg: FieldsDeg | None) -> list[ListedDatabase]:
        return databases_in_order(asked.databases, fields_deg)

    def identify(
        database: ListedDatabase, fields_deg: FieldsDeg | None
    ) -> tuple[dict[str, Any], bytes, IdentifyOptions]:
        options = form_options(fields, service, database, fields_deg)
        if not has_database:
            limit_s = min(options.time_limit_s or MAX_SEARCH_S, MAX_SEARCH_S)
            options = replace(options, time_limit_s=limit_s)
        upload.content.seek(0)
        content, drawn = identify_upload(service, database.id, upload, options, kind, for_page=True)
        return content, drawn, options

    attempts = try_each(
        in_order, _fields_deg(fields), identify, lambda answer: _best(answer[0]),
        lambda error: page_problem(error).detail,
    )  # fmt: skip
    if attempts.best is None:
        raise Problem(422, f"not identified: {attempts.words}")
    database, (content, drawn, options) = attempts.best
    camera = database.camera
    if options.camera is not None:
        width, height = content["size_px"]
        camera = parse_camera(options.camera, Path("camera"), (width, height))
        options = replace(options, camera=camera_toml(camera))
    frames = shown_frames(content, fields, float(database.manifest["epoch_jyear"]))
    method, tried = str(content["method"]), tuple(attempts.reasons)
    return _FileAnswer(database, frames, drawn, method, options, camera, tried)


def _best(content: dict[str, Any]) -> dict[str, Any]:
    """Return the frame that tells how a file went: one that is identified, else the first."""
    frames: list[dict[str, Any]] = content["frames"] or [NO_FRAME]
    return next((frame for frame in frames if frame["status"] == "identified"), frames[0])


def _stated_options(options: IdentifyOptions) -> dict[str, Any]:
    """Return options in a program's form, for centroids whose y counts down."""
    stated = options.stated()
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in stated.items()
        if name not in ("time_limit_s", "flip")
    }


def _view(frame: ShownFrame, database: ListedDatabase, camera: Camera) -> dict[str, Any] | None:
    """Return the data of an answer that the view of the sky needs."""
    content = frame.content
    if not frame.is_identified:
        return None
    fitted_camera = camera.with_focal_length(float(content["focal_length_px"]))
    ra, dec, roll = (content[f"{name}_deg"] for name in ("boresight_ra", "boresight_dec", "roll"))
    return sky_view(
        database,
        fitted_camera,
        frame={"ra": ra, "dec": dec, "roll": roll},
        at={"ra": ra, "dec": dec, "size": min(2.2 * fitted_camera.fov_x_deg, 360.0)},
        marks=marks_of(frame),
    )


@router.get("/identify/frame/{database_id}")
async def simulated_frame(
    service: TheService,
    _: Reader,
    database_id: str,
    seed: Annotated[int, Query(ge=0, le=MAX_SEED)] = 0,
) -> Response:
    """Return a simulated frame of a database's camera, as an example."""
    database = service.library.database(database_id)
    name = f"{database.title}-{seed}{frame_suffix(database)}"
    content = await service.sandbox.run(_simulated, service, database, name, seed)
    kind = "image/png" if name.endswith(".png") else "text/csv; charset=utf-8"
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(content, media_type=kind, headers=headers)


def _page(request: Request, service: Service, fields: dict[str, str], **answer: Any) -> Response:
    databases = service.library.databases()
    problem = answer.get("problem")
    nothing = dict.fromkeys(
        ("shown", "picture", "problem", "errors_arcsec", "field_deg", "view", "tried")
    )
    used: ListedDatabase | None = answer.pop("used", None)
    used = used or next(
        (database for database in databases if database.id == fields["database"]), None
    )
    camera = (used or databases[0]).camera if databases else None
    shown: Shown | None = answer.get("shown")
    notebook = None
    if shown is not None and shown.first.measured and used is not None:
        asked = shown.first.measured, answer.pop("options")
        code = identify_code(page_url(request, service), used.id, *asked)
        notebook = Notebook(f"{shown.first.content['frame']}-answer", code)
    return render(
        request,
        "identify.html",
        option_help=option_hints(),
        more=OPTION_FIELDS,
        status=problem.status if problem else 200,
        databases=[("", ANY), *((database.id, database.title) for database in databases)]
        if databases
        else [],
        used=used.id if used else "",
        any=ANY,
        methods=[(name, f"{name}: {method.description}") for name, method in METHODS.items()],
        fields=fields,
        placeholders={
            name: f"{getattr(camera, name):.6g}" for name in ("width_px", "height_px", "fov_x_deg")
        }
        if camera
        else {},
        errors={problem.key: problem.detail} if problem and problem.key else {},
        suffixes=",".join(SUFFIXES),
        most_mib=service.settings.upload_mib,
        most_files=MAX_FILES,
        notebook=notebook,
        **{**nothing, **answer},
    )


def frames_of(
    form: FormData, fields: dict[str, str], database: ListedDatabase, service: Service
) -> list[FrameUpload]:
    """Return the files of frames in a form."""
    if fields["seed"]:
        number = typed_number(fields["seed"], "seed")
        seed = int(min(max(number or 0, 0), MAX_SEED))
        name = f"simulated-{seed}{frame_suffix(database)}"
        return [FrameUpload(name, io.BytesIO(_simulated(service, database, name, seed)))]
    uploads = [
        file for file in form.getlist("file") if isinstance(file, UploadFile) and file.filename
    ]
    if uploads:
        return [FrameUpload.of_form(file, service.settings.upload_mib) for file in uploads]
    if not fields["centroids"].strip():
        raise Problem(
            422,
            "no frame was given; choose an image or a file of centroids, paste centroids, or try "
            "a simulated frame",
            key="file",
        )
    third = "mag" if fields["brightness"] == "mag" else "flux"
    suffix, text = centroid_file(fields["centroids"], third)
    return [FrameUpload(f"pasted{suffix}", io.BytesIO(text.encode()))]


def form_options(
    fields: dict[str, str], service: Service, database: ListedDatabase, fields_deg: FieldsDeg | None
) -> IdentifyOptions:
    """Return the options for identifying a frame.

    ``fields_deg`` are the fields of view that the form states, or that an attempt has found.
    """
    percent = typed_number(fields["field_error"], "field_error")
    ends = [typed_number(fields[name], name) for name in ("fov_from", "fov_to")]
    if (ends[0] is None) != (ends[1] is None):
        missing = "fov_from" if ends[0] is None else "fov_to"
        raise Problem(
            422, "give both ends of the range of fields, or leave both empty", key=missing
        )
    camera, fov_deg = camera_text(fields, database), None
    spec = spec_of(database)
    if ends[0] is not None:
        fov_deg = ends
        if not fields["database"] and not spec.is_for_a_range:
            # One of the fields is tried: the database serves no range.
            fov_deg, camera = None, camera or field_line(database, fields_deg) or None
    elif not fields["database"] and not fields["seed"] and camera is None:
        if spec.is_for_a_range:
            fov_deg = list(spec.fields_deg)
        elif fields_deg is not None:
            camera = field_line(database, fields_deg) or None
    content = {
        "method": fields["method"] or None,
        "fov_error": None if percent is None else percent / 100.0,
        "fov_deg": fov_deg,
        "flip": True if fields["camera.flip"] else None,
        "time": fields["time"].strip() or None,
        "camera": camera,
        **{
            name: option.value_of(text)
            for name, option in OPTION_FIELDS.items()
            if (text := fields[name].strip())
        },
    }
    return replace(checked_options(content), time_limit_s=service.settings.query_time_s)


def camera_text(fields: Mapping[str, str], database: ListedDatabase) -> str | None:
    """Return the text of the camera that a form describes; None for the database's camera.

    If the form states no size, the camera has the size of the picture, or for centroids the size of
    the database's camera. The default focal length is also the database's.
    """
    camera = database.camera
    if fields["camera_file"].strip():
        parse_camera(
            fields["camera_file"], Path("camera file"), (camera.width_px, camera.height_px)
        )
        return fields["camera_file"]
    scale = CAMERA[3:] if fields["lens"] == "focal" else CAMERA[2:3]
    numbers = {
        name: typed_number(fields[f"camera.{name}"], f"camera.{name}")
        for name in CAMERA[:2] + scale
    }
    if all(value is None for value in numbers.values()):
        return None
    size = {
        name: value or getattr(camera, name)
        for name, value in numbers.items()
        if name in CAMERA[:2]
    }
    if all(numbers[name] is None for name in CAMERA[:2]):
        size = {}
    lens = {name: value for name in scale if (value := numbers[name]) is not None}
    values = {**size, **(lens or {"focal_length_px": camera.focal_length_px})}
    lines = [f"{name} = {_toml_number(float(value))}" for name, value in values.items()]
    text = "\n".join(lines)
    try:
        parse_camera(text, Path("camera"), (camera.width_px, camera.height_px))
    except ConfigError as error:
        raise Problem(422, str(error), key=f"camera.{error.key or CAMERA[0]}") from None
    return text


def _toml_number(value: float) -> str:
    return str(int(value)) if value.is_integer() else repr(value)


def _simulated(service: Service, database: ListedDatabase, name: str, seed: int) -> bytes:
    stars = open_database(database.folder, ())
    frame = next(
        simulate_frames(stars.directions, stars.camera, 1, Noise(NOISE_PX), seed, mag=stars.mag)
    )
    with scratch_folder(service.paths) as folder:
        write_simulated(folder / name, frame, stars.camera, seed)
        return (folder / name).read_bytes()


def _address(picture: bytes) -> str | None:
    """Return a picture as an address that contains it, without margins: nothing is stored."""
    if not picture:
        return None
    if area := _AREA.search(picture):
        left, bottom, right, top = map(float, area.groups())
        size = right - left, bottom - top
        box = b'width="%gpt" height="%gpt" viewBox="%g %g %g %g"' % (*size, left, top, *size)
        picture = _SIZE.sub(box, picture, count=1)
    return f"data:image/svg+xml;base64,{base64.b64encode(picture).decode()}"


_SIZE = re.compile(rb'width="[^"]*" height="[^"]*" viewBox="[^"]*"')
_AREA = re.compile(
    rb'<g id="patch_2">\s*<path d="M ([\d.]+) ([\d.]+)\s+L ([\d.]+) [\d.]+\s+L [\d.]+ ([\d.]+)'
)
"""Corners of the sky in a picture of `starcat.frames.images`: the second patch that is drawn."""


def _errors(answer: dict[str, Any]) -> list[str] | None:
    """Return the standard deviations of the attitude about the three axes, arcseconds."""
    rows: list[list[float | None]] = answer.get("covariance_arcsec2") or []
    squares = [row[k] for k, row in enumerate(rows)]
    texts = [f"{math.sqrt(square):.3g}" for square in squares if square is not None]
    return texts if len(texts) == 3 else None


def _field_deg(answer: dict[str, Any], camera: Camera) -> float | None:
    """Return the full angle across the width, degrees, by the focal length that was found."""
    focal_length_px = answer.get("focal_length_px")
    if not focal_length_px:
        return None
    half = 0.5 * camera.width_px / float(focal_length_px)
    return 2.0 * math.degrees(math.atan(half))


def typed_number(text: str, name: str) -> float | None:
    """Return the number that a field of a form has; None if the field is empty."""
    if not text.strip():
        return None
    try:
        return float(text)
    except ValueError:
        raise Problem(
            422, f"{name}: {text[:40]!r} is not a number; give one, or leave it empty", key=name
        ) from None


def frame_suffix(database: ListedDatabase) -> str:
    """Return the suffix of the file of a simulated frame: a picture unless it is too large."""
    camera = database.camera
    return ".png" if camera.width_px * camera.height_px <= MAX_PIXELS else ".csv"


MAX_LINES = 20_000

_SEPARATORS = re.compile(r"[\s,;]+")


def centroid_file(text: str, third: str = "flux") -> tuple[str, str]:
    """Return pasted centroids as a centroid file; ``third`` is the meaning of a third number."""
    stripped = text.strip()
    if stripped[:1] in ("{", "["):
        return ".json", stripped
    if "x_px" in stripped.partition("\n")[0]:
        return ".csv", stripped + "\n"
    rows = _rows(text)
    if not rows:
        raise ConfigError(
            "no centroid was pasted",
            key="centroids",
            hint="give a line 'x y' or 'x y brightness' for each, in pixels",
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
                f"line {number}: more than {MAX_LINES:,} centroids; a frame has far fewer stars",
                key="centroids",
                hint="Leave out the faint ones",
            )
        if not (2 <= len(words) <= 3 and all(map(is_number, words))):
            raise ConfigError(
                f"line {number}: {quoted(line.strip())}; expected two or three numbers, 'x y' or "
                "'x y brightness'",
                key="centroids",
                value=line.strip()[:80],
            )
        if rows and len(words) != len(rows[0]):
            raise ConfigError(
                f"line {number}: {len(words)} numbers, the lines before have {len(rows[0])}",
                key="centroids",
                hint="give all of them a brightness, or none",
            )
        rows.append(words)
    return rows
