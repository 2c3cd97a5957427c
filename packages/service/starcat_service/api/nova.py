"""The interface of nova.astrometry.net, so that its clients can have pictures solved here.

A picture is solved while it is uploaded. The solution is kept in memory for an hour, under a number
that cannot be guessed and is submission, image and job at once: a client with the number may read
it. A session is the same as that of a sign-in on the page, and is sent in the JSON of a request.
"""

from __future__ import annotations

import io
import json
import math
import re
import secrets
import threading
from dataclasses import dataclass, field, replace
from typing import Any
from urllib.parse import unquote_to_bytes

from cachetools import TTLCache
from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse, Response
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException
from starlette.types import Message

from starcat.errors import StarcatError, TargetMissing
from starcat.matcher import IdentifyOptions
from starcat_service.access import Identities, network_of, principal_of
from starcat_service.api.identify import FrameUpload, identify_upload
from starcat_service.candidates import (
    MAX_SEARCH_S,
    FieldsDeg,
    databases_in_order,
    field_line,
    spec_of,
    try_each,
)
from starcat_service.library import ListedDatabase
from starcat_service.problems import Problem, problem_of
from starcat_service.security.request_limits import client_ip
from starcat_service.service import Service, TheService
from starcat_service.settings import Role

router = APIRouter(include_in_schema=False)

_MOST, _KEPT_S = 2_000, 3_600.0
_ANONYMOUS = "anonymous"
_HEAD_BYTES = 1 << 16
_SESSION = re.compile(rb'"session"[\s+]*:[\s+]*"([A-Za-z0-9._-]{1,200})"')
_URLENCODED = "application/x-www-form-urlencoded"
_DEG = {"degwidth": 1.0, "arcminwidth": 1.0 / 60.0}
"""Units of a scale that mean the width of a picture, degrees."""


@dataclass(frozen=True)
class Solution:
    """The solution of a picture."""

    file: str
    wcs: str  # a FITS header; empty if there is no solution
    frame: dict[str, Any]  # in the form of 'starcat identify --json'
    database: str  # title of the database that identified the frame, else of the first
    tried: tuple[str, ...] = ()  # databases that did not identify it, and reasons

    @property
    def status(self) -> str:
        """Outcome in nova's words."""
        return "success" if self.wcs else "failure"

    @property
    def reason(self) -> str:
        """Reason why the picture has no solution."""
        return "not solved with any database; " + "; ".join(self.tried)

    @property
    def facts(self) -> dict[str, str]:
        """Facts that nova does not have: the database, or the reason for no solution."""
        return {"database": self.database} if self.wcs else {"errormessage": self.reason}


@dataclass(frozen=True)
class Solutions:
    """The solutions of the last hour."""

    by_number: TTLCache[int, Solution] = field(default_factory=lambda: TTLCache(_MOST, _KEPT_S))
    lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, solution: Solution) -> int:
        """Keep a solution and return its number."""
        number = secrets.randbits(52)  # numbers in JSON are exact up to this size
        with self.lock:
            self.by_number[number] = solution
        return number

    def get(self, number: int) -> Solution | None:
        """Return the solution with a number, if it is still kept."""
        with self.lock:
            return self.by_number.get(number)


def solution_of(request: Request, number: int) -> Solution:
    """Return the solution with a number, or refuse."""
    solutions: Solutions = request.app.state.solutions
    solution = solutions.get(number)
    if solution is None:
        raise Problem(404, f"no job {number}: results are kept for an hour, until a restart")
    return solution


@router.post("/api/login")
async def login(request: Request) -> Response:
    """Begin a session: the key is a token of this service, or anything if no token is needed."""
    try:
        async with request.form(max_files=0, max_fields=2) as form:
            key = str(_arguments(form).get("apikey") or "")
    except (Problem, HTTPException) as error:
        return _error_of(error)
    identities: Identities = request.app.state.identities
    token = identities.of_token(key.strip())
    if token is not None:
        return JSONResponse({"status": "success", "session": identities.sessions.open(token)})
    if principal_of(request).role >= Role.READER:
        return JSONResponse({"status": "success", "session": _ANONYMOUS})
    wait_s = identities.guessed.take(network_of(client_ip(request.scope)))
    return _error(
        429 if wait_s else 401, "bad apikey: give a token of this service ('starcat token create')"
    )


@router.post("/api/upload")
async def upload(request: Request, service: TheService) -> Response:
    """Solve a picture, and return the number of its submission."""
    try:
        async with (await _with_session(request)).form(max_files=1, max_fields=4) as form:
            arguments, file = _arguments(form), form.get("file")
            _check_session(request, arguments)
            if isinstance(file, UploadFile):
                frames = FrameUpload.of_form(file, service.settings.upload_mib)
            else:
                frames = _centroids(arguments)
            solution = await service.sandbox.run(_solve, service, frames, arguments)
    except (Problem, StarcatError, HTTPException) as error:
        return _error_of(error)
    number = request.app.state.solutions.add(solution)
    return JSONResponse({"status": "success", "subid": number, "hash": f"{number:013x}"})


@router.post("/api/url_upload")
def url_upload() -> Response:
    """Refuse to fetch pictures from other addresses."""
    return _error(422, "this service fetches nothing from addresses; upload the picture")


@router.get("/api/submissions/{number}")
def submission(number: int, request: Request) -> Response:
    """Return the jobs of a submission: one job, which is done."""
    solution = solution_of(request, number)
    return JSONResponse(
        {
            "user_images": [number],
            "images": [number],
            "jobs": [number],
            "job_calibrations": [[number, number]] if solution.wcs else [],
        }
    )


@router.get("/api/jobs/{number}")
def job(number: int, request: Request) -> Response:
    """Return whether a picture was solved, and if not, the reason."""
    solution = solution_of(request, number)
    return JSONResponse({"status": solution.status, **({} if solution.wcs else solution.facts)})


@router.get("/joblog/{number}")
def job_log(number: int, request: Request) -> Response:
    """Return the databases that were tried, one per line, as text."""
    solution = solution_of(request, number)
    lines = [f"{solution.file}: {solution.status}", *solution.tried]
    if solution.wcs:
        lines.append(f"{solution.database}: identified with {solution.frame['n_matched']} stars")
    return Response("\n".join(lines) + "\n", media_type="text/plain; charset=utf-8")


@router.get("/api/jobs/{number}/calibration")
@router.get("/api/jobs/{number}/calibration/")
def calibration(number: int, request: Request) -> Response:
    """Return the position of the picture on the sky."""
    solution = solution_of(request, number)
    return JSONResponse(calibration_of(solution.wcs)) if solution.wcs else _unsolved(solution)


@router.get("/api/jobs/{number}/info")
@router.get("/api/jobs/{number}/info/")
def info(number: int, request: Request) -> Response:
    """Return all facts of a job."""
    solution = solution_of(request, number)
    facts: dict[str, Any] = {
        "status": solution.status,
        **solution.facts,
        "original_filename": solution.file,
        "objects_in_field": _names(solution),
        "machine_tags": _names(solution),
        "tags": _names(solution),
    }
    if solution.wcs:
        facts["calibration"] = calibration_of(solution.wcs)
    return JSONResponse(facts)


@router.get("/api/jobs/{number}/objects_in_field")
@router.get("/api/jobs/{number}/objects_in_field/")
def objects_in_field(number: int, request: Request) -> Response:
    """Return the names of the stars."""
    return JSONResponse({"objects_in_field": _names(solution_of(request, number))})


@router.get("/api/jobs/{number}/annotations")
@router.get("/api/jobs/{number}/annotations/")
def places_of_stars(number: int, request: Request) -> Response:
    """Return the stars with their positions in the picture."""
    stars = [star for star in solution_of(request, number).frame["stars"] if star["star"]]
    star_marks = [
        {
            "type": "star",
            "names": [star["star"]],
            "pixelx": star["x_px"] + 0.5,  # the centre of nova's first pixel is at 1
            "pixely": star["y_px"] + 0.5,
            "radius": 0.0,
        }
        for star in stars
    ]
    return JSONResponse({"annotations": star_marks})


@router.get("/wcs_file/{number}")
def wcs_file(number: int, request: Request) -> Response:
    """Return the FITS header of a solved picture."""
    solution = solution_of(request, number)
    if not solution.wcs:
        return _unsolved(solution)
    name = {"Content-Disposition": 'attachment; filename="wcs.fits"'}
    return Response(solution.wcs.encode("ascii"), media_type="application/fits", headers=name)


def calibration_of(wcs: str) -> dict[str, float]:
    """Return centre, size and orientation of a picture in nova's convention.

    ``orientation`` is the angle of up from north to east, degrees; ``parity`` is 1 if east is left
    of north when north is up, in rows from the bottom.
    """
    from astropy.io import fits
    from astropy.wcs import WCS

    header = fits.Header.fromstring(wcs)
    width, height = float(header["IMAGEW"]), float(header["IMAGEH"])
    projection = WCS(header, naxis=2)
    middle = [[0.5 * width + 0.5, 0.5 * height + 0.5]]
    ra_deg, dec_deg = projection.all_pix2world(middle, 1)[0]
    (a, b), (c, d) = projection.pixel_scale_matrix
    parity = 1.0 if a * d - b * c >= 0.0 else -1.0
    pixscale = 3600.0 * math.sqrt(abs(a * d - b * c))
    turn = math.degrees(math.atan2(parity * c - b, parity * a + d))
    return {
        "ra": float(ra_deg),
        "dec": float(dec_deg),
        "radius": 0.5 * pixscale * math.hypot(width, height) / 3600.0,
        "pixscale": pixscale,
        "orientation": -turn,
        "parity": parity,
        "width_arcsec": pixscale * width,
        "height_arcsec": pixscale * height,
    }


def _solve(service: Service, frames: FrameUpload, arguments: dict[str, Any]) -> Solution:
    preferred = service.settings.plate_solver
    first = None if preferred is None else service.library.find(preferred)

    def in_order(fields_deg: FieldsDeg | None) -> list[ListedDatabase]:
        return databases_in_order(service.library.databases(), fields_deg, first)

    def identify(database: ListedDatabase, fields_deg: FieldsDeg | None) -> dict[str, Any]:
        options = _options_for(database, fields_deg, arguments)
        options = replace(options, time_limit_s=MAX_SEARCH_S)
        frames.content.seek(0)
        answer, _ = identify_upload(
            service, database.id, frames, options, None, for_page=True, either_way=True
        )
        return answer

    attempts = try_each(
        in_order, _scale_deg(arguments), identify, lambda answer: answer["frames"][0]
    )
    if attempts.best is None:
        raise TargetMissing("this service has no database to solve pictures with yet")
    database, answer = attempts.best
    wcs, frame = answer["more"][0]["wcs"] or "", answer["frames"][0]
    return Solution(frames.name, wcs, frame, database.title, tuple(attempts.reasons))


def _centroids(arguments: dict[str, Any]) -> FrameUpload:
    """Return the frame of a client that has sent the positions of stars."""
    x, y = arguments.get("x"), arguments.get("y")
    if not (isinstance(x, list) and isinstance(y, list) and len(x) == len(y)):
        raise Problem(
            422, "send a picture as 'file', or centroids as lists 'x' and 'y' of a length"
        )
    try:  # the centre of the first pixel is at 1
        centroids = [[float(a) - 0.5, float(b) - 0.5] for a, b in zip(x, y, strict=True)]
    except (TypeError, ValueError):
        raise Problem(422, "x, y: expected numbers") from None
    return FrameUpload("frame.json", io.BytesIO(json.dumps({"centroids_px": centroids}).encode()))


def _size_of(arguments: dict[str, Any]) -> tuple[int, int] | None:
    """Return the size of a picture of which only centroids were sent."""
    if "x" not in arguments:
        return None
    width, height = arguments.get("image_width"), arguments.get("image_height")
    if not (isinstance(width, int) and isinstance(height, int)):
        raise Problem(422, "image_width, image_height: expected whole numbers of pixels")
    return width, height


def _options_for(
    database: ListedDatabase, scale_deg: FieldsDeg | None, arguments: dict[str, Any]
) -> IdentifyOptions:
    """Return the options for identifying a picture of some scale with a database."""
    if spec_of(database).is_for_a_range:
        fov_deg = _fields_of(database, scale_deg)
        return IdentifyOptions(fov_deg=fov_deg, size_px=_size_of(arguments))
    field = field_line(database, scale_deg)
    if not field:
        return IdentifyOptions()
    lines = [field]  # a picture has its own size
    if "x" in arguments and "image_width" in arguments:
        width, height = _size_of(arguments) or (0, 0)
        lines += [f"width_px = {width}", f"height_px = {height}"]
    return IdentifyOptions(camera="\n".join(lines))


def _fields_of(database: ListedDatabase, scale_deg: FieldsDeg | None) -> FieldsDeg:
    """Return the fields to try: the fields of the database within the given scale."""
    narrow, wide = fields_deg = spec_of(database).fields_deg
    if scale_deg is not None:
        narrow, wide = max(narrow, scale_deg[0]), min(wide, scale_deg[1])
    if narrow > wide:
        raise Problem(
            422,
            f"no field of {database.title} is within the given scale; its fields are from "
            f"{fields_deg[0]:.4g} to {fields_deg[1]:.4g} deg",
        )
    return narrow, wide


def _scale_deg(arguments: dict[str, Any]) -> FieldsDeg | None:
    """Return the fields across the width that a request states; None if it states none."""
    unit = _DEG.get(str(arguments.get("scale_units") or "degwidth"))
    width = arguments.get("image_width")
    if arguments.get("scale_units") == "arcsecperpix" and isinstance(width, int):
        unit = width / 3600.0
    if unit is None:
        return None
    low, high = _scale(arguments)
    return None if (low, high) == (0.0, math.inf) else (low * unit, high * unit)


def _scale(arguments: dict[str, Any]) -> tuple[float, float]:
    try:
        if arguments.get("scale_type") == "ev" or arguments.get("scale_est") is not None:
            about, percent = (
                float(arguments["scale_est"]),
                float(arguments.get("scale_err") or 10.0),
            )
            return about * (1.0 - percent / 100.0), about * (1.0 + percent / 100.0)
        return float(arguments.get("scale_lower") or 0.0), float(
            arguments.get("scale_upper") or math.inf
        )
    except (KeyError, TypeError, ValueError, OverflowError):
        raise Problem(
            422, "scale: expected scale_est and scale_err, or scale_lower and scale_upper, numbers"
        ) from None


def _arguments(form: FormData) -> dict[str, Any]:
    try:
        arguments = json.loads(str(form.get("request-json") or "{}"))
    except (ValueError, RecursionError):
        arguments = None
    if not isinstance(arguments, dict):
        raise Problem(422, "request-json: expected an object as JSON")
    return arguments


def _check_session(request: Request, arguments: dict[str, Any]) -> None:
    if principal_of(request).role >= Role.READER:
        return
    identities: Identities = request.app.state.identities
    token = identities.of_session(str(arguments.get("session") or ""))
    if token is None or token.role < Role.READER:
        raise Problem(401, "no valid session: log in at /api/login first, with a token as apikey")


async def _with_session(request: Request) -> Request:
    """Return a request whose file may be read: its principal or its session is a reader.

    Clients send the session before the file, so the first bytes of the body have it.
    """
    if principal_of(request).role >= Role.READER:
        return request
    received: list[Message] = []
    begin = b""
    is_whole = False
    while len(begin) < _HEAD_BYTES and not is_whole:
        received.append(await request.receive())
        begin += received[-1].get("body", b"")
        is_whole = not received[-1].get("more_body", False)
    if request.headers.get("content-type", "").startswith(_URLENCODED):
        begin = unquote_to_bytes(begin)
    session = _SESSION.search(begin[:_HEAD_BYTES])
    _check_session(request, {"session": session[1].decode() if session else ""})

    async def receive() -> Message:
        return received.pop(0) if received else await request.receive()

    return Request(request.scope, receive)


def _names(solution: Solution) -> list[str]:
    return [star["star"] for star in solution.frame["stars"] if star["star"]]


def _error_of(error: Exception) -> Response:
    problem = problem_of(error)
    return _error(problem.status, problem.detail)


def _error(status: int, text: str) -> Response:
    return JSONResponse({"status": "error", "errormessage": text}, status_code=status)


def _unsolved(solution: Solution) -> Response:
    return _error(404, solution.reason)
