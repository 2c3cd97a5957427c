"""The process that reads uploads and makes files, for `starcat_service.sandbox.sandbox`.

Requests and answers are JSON: an uploaded file cannot make the server run code.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat_service.protocols.uploads import upload_facts
from starcat_service.sandbox.channel import Channel, return_free_memory
from starcat_service.sandbox.confinement import forbid_writing, limit_memory, limit_time
from starcat_service.sandbox.messages import DONE, ERROR, error_content

if TYPE_CHECKING:
    from starcat.frames.images import FileAnswers, FrameAnswer
    from starcat.matcher import Matcher, SearchOptions

MATCHERS = 4
"""Open databases, with the options with which they were opened."""


def identify_confined(
    folder: str,
    file: str,
    database: str,
    options: dict[str, Any],
    picture: str | None = None,
    *,
    for_page: bool = False,
    either_way: bool = False,
) -> dict[str, Any]:
    """Identify the frames of a file in a folder; draw the first one next to it, as PNG or SVG.

    A page gets more about each frame: the brightness of its centroids, and its WCS. With
    ``either_way`` a picture that matches mirrored has its rows reversed.
    """
    from starcat.frames.images import answer_file, identify_either_way
    from starcat.matcher import IdentifyOptions

    os.chdir(folder)  # so that messages contain only the name of the file
    identify_options = IdentifyOptions(**options)
    # Options that do not concern the matcher must not open another one.
    matcher = _matcher(database, identify_options.search())
    if either_way:
        answers, frame_answers = identify_either_way(Path(file), matcher, identify_options)
    else:
        answers = answer_file(Path(file), matcher, identify_options)
        frame_answers = list(answers)
    if picture is not None and frame_answers:
        answers.draw(Path(f"picture.{picture}"), frame_answers[0])
    return {
        "database": answers.matcher.database.name,
        "method": answers.matcher.settings.method,
        "frames": [answer.content() for answer in frame_answers],
        "notes": answers.notes(frame_answers[0] if frame_answers else None),
        "more": [_for_page(answers, answer) for answer in frame_answers] if for_page else [],
        "size_px": [answers.camera.width_px, answers.camera.height_px],
    }


def _for_page(answers: FileAnswers, answer: FrameAnswer) -> dict[str, Any]:
    """Return the data of a frame that a page needs, besides its answer, to link and save it."""
    from starcat.frames.images import wcs_header

    mag, wcs = answer.frame.mag, None
    if answer.result.ok:
        header = wcs_header(answer.result, answers.path, flip=answers.options.flip)
        wcs = header.decode("ascii")
    brightness = None
    if mag is not None:
        brightness = [value if math.isfinite(value) else None for value in mag.tolist()]
    return {"mag": brightness, "wcs": wcs}


@lru_cache(maxsize=MATCHERS)
def _matcher(database: str, options: SearchOptions) -> Matcher:
    from starcat.frames.images import open_matcher

    return open_matcher(Path(database), options)


def convert(source: str, target: str, form: str, label: dict[str, str] | None = None) -> int:
    """Write a table to a file of another format; some formats need the whole table in memory."""
    import pyarrow as pa

    from starcat.ship.exchange import UNLABELLED, Label, write_batches

    named = UNLABELLED if label is None else Label(**label)
    with pa.OSFile(source) as file, pa.ipc.open_stream(file) as stream:
        return write_batches(stream, Path(target), form, named)


def make_flight_image(
    database: str, target: str, method: str | None, endian: str, profile: str
) -> int:
    """Write the image of a database for flight software; return its size, bytes."""
    from starcat.ship.exchange import export_image

    options: dict[str, Any] = {"method": method, "endian": endian, "profile": profile}
    exported = export_image(Path(database), "onboard", Path(target), **options)
    return len(exported.image.data)


def first_camera_confined(folder: str, files: list[str], blind: str) -> dict[str, Any]:
    """Find the camera of the pictures in a folder with the database for unknown cameras."""
    from starcat.matcher import SearchOptions
    from starcat.pipeline import FIELDS_DEG, first_camera

    os.chdir(folder)
    camera = first_camera(_matcher(blind, SearchOptions()), list(map(Path, files)), FIELDS_DEG)
    return {
        "camera": camera.spec_camera.model_dump(mode="json"),
        "noise_px": camera.noise_px,
        "reach_mag": camera.reach_mag,
        "remarks": camera.remarks("G"),
    }


def plan_confined(
    folder: str, database: str, orbit: str | None, expected: dict[str, Any], most: int
) -> dict[str, Any]:
    """Plan the attitudes of the file *attitudes* in a folder; return the first attitudes and gaps.

    The plot and the whole plan as JSON are written beside the file.
    """
    import starcat

    os.chdir(folder)
    plan = starcat.plan(database, "attitudes", orbit=orbit, plot="plan.svg", **expected)
    content: dict[str, Any] = {
        "database": plan.database.name,
        "camera": plan.camera.in_words,
        "summary": plan.summary,
        "gaps": [asdict(gap) for gap in plan.gaps],
        "attitudes": [plan.attitude(row) for row in range(len(plan))],
        "first_stars": plan.stars_of(0),
    }
    Path("plan.json").write_text(json.dumps(content, separators=(",", ":")), encoding="utf-8")
    return content | {name: content[name][:most] for name in ("gaps", "attitudes")}


TASKS: dict[str, Callable[..., Any]] = {
    "identify": identify_confined,
    "first_camera": first_camera_confined,
    "plan": plan_confined,
    "convert": convert,
    "flight_image": make_flight_image,
    "upload": upload_facts,
}


def serve() -> None:
    """Answer requests until there are no more."""
    channel = Channel()
    with suppress(EOFError, BrokenPipeError):
        scratch, memory_bytes = channel.receive()
        forbid_writing(except_in=Path(scratch))
        limit_memory(memory_bytes)
        while True:
            name, arguments, time_s = channel.receive()
            limit_time(time_s * (os.cpu_count() or 1) + 1.0)
            try:
                kind, content = DONE, TASKS[name](**arguments)
            except Exception as error:
                kind, content = ERROR, error_content(error)
            os.chdir(scratch)
            channel.send(kind, content)
            # Memory that one request has not freed must not be missing in the next.
            return_free_memory()
