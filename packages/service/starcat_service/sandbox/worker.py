"""The process that reads uploads and makes files, for `starcat_service.sandbox.sandbox`.

A request is a line of JSON, and so is the answer: nothing that was uploaded can make the server
run anything.
"""

from __future__ import annotations

import errno
import json
import math
import os
import signal
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.query.confinement import forbid_writing, limit_memory, limit_time
from starcat_service.protocols.uploads import upload_facts
from starcat_service.sandbox.child import own_output, return_free_memory

if TYPE_CHECKING:
    from starcat.images.identify_options import IdentifyOptions
    from starcat.images.solve_files import FileAnswers, FrameAnswer
    from starcat.matcher.matcher import Matcher

FULL = (errno.ENOSPC, errno.EDQUOT)
MATCHERS = 4
"""Databases that are kept open with the options that they were opened with."""


def identify(
    folder: str,
    file: str,
    artifact: str,
    options: dict[str, Any],
    picture: str | None = None,
    *,
    for_page: bool = False,
    either_way: bool = False,
) -> dict[str, Any]:
    """Identify the frames of a file in a folder; draw the first one beside it, as PNG or SVG.

    A page is told more of each frame: the brightness of its centroids, and its WCS. Either way, the
    rows of a picture that matches mirrored are turned over.
    """
    from starcat.images.identify_options import MATCHER_OPTIONS, IdentifyOptions
    from starcat.images.solve_files import identify_either_way, identify_file

    os.chdir(folder)  # so that messages say the name of the file alone
    chosen = IdentifyOptions.model_validate(options)
    # What is not about the matcher does not open another.
    own = IdentifyOptions(**chosen.model_dump(include=set(MATCHER_OPTIONS)))
    matcher = _matcher(artifact, own)
    if either_way:
        answers, found = identify_either_way(Path(file), matcher, chosen)
    else:
        answers = identify_file(Path(file), matcher, chosen)
        found = list(answers)
    if picture is not None and found:
        answers.draw(Path(f"picture.{picture}"), found[0])
    is_any = any(answer.result.ok for answer in found)
    return {
        "database": answers.matcher.database.name,
        "method": answers.matcher.method,
        "frames": [answer.content() for answer in found],
        "notes": answers.notes(found[0] if found else None, is_any_identified=is_any),
        "more": [_for_page(answers, answer) for answer in found] if for_page else [],
        "size_px": [answers.camera.width_px, answers.camera.height_px],
    }


def _for_page(answers: FileAnswers, answer: FrameAnswer) -> dict[str, Any]:
    """Return what a page keeps of a frame beside its answer, to link to it and to save it."""
    from starcat.images.image_file import wcs_header

    mag, wcs = answer.frame.mag, None
    if answer.result.ok:
        header = wcs_header(answer.result, answers.path, flip=answers.options.flip)
        wcs = header.decode("ascii")
    brightness = None
    if mag is not None:
        brightness = [value if math.isfinite(value) else None for value in mag.tolist()]
    return {"mag": brightness, "wcs": wcs}


@lru_cache(maxsize=MATCHERS)
def _matcher(artifact: str, options: IdentifyOptions) -> Matcher:
    from starcat.images.solve_files import open_matcher

    return open_matcher(Path(artifact), options)


def convert(source: str, target: str, form: str, label: dict[str, str] | None = None) -> int:
    """Write a table to a file of another format: some are held in memory as a whole."""
    import pyarrow as pa

    from starcat.exchange.columns import UNLABELLED, Label
    from starcat.exchange.writers import write_batches

    named = UNLABELLED if label is None else Label(**label)
    with pa.OSFile(source) as file, pa.ipc.open_stream(file) as stream:
        return write_batches(stream, Path(target), form, named)


def flight_image(artifact: str, target: str, method: str, endian: str) -> int:
    """Write the image of a database for flight software; return its size, bytes."""
    from starcat.exchange.onboard import export_image

    made = export_image(Path(artifact), "onboard", Path(target), method=method, endian=endian)
    return len(made.made.data)


TASKS: dict[str, Callable[..., Any]] = {
    "identify": identify,
    "convert": convert,
    "flight_image": flight_image,
    "upload": upload_facts,
}


def serve() -> None:
    """Answer requests until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = own_output()
    opening = json.loads(sys.stdin.buffer.readline() or b"{}")
    if not opening:
        return
    home = Path(opening["scratch"])
    forbid_writing(except_in=home)
    limit_memory(opening["memory_bytes"])
    for line in sys.stdin.buffer:
        request = json.loads(line)
        limit_time(request["time_s"] * (os.cpu_count() or 1) + 1.0)
        content = _answer(TASKS[request["task"]], request["arguments"])
        os.chdir(home)
        try:
            answers.write(json.dumps(content).encode() + b"\n")
            answers.flush()
        except BrokenPipeError:
            return
        # What one request has left must not be missing in the next.
        return_free_memory()


def _answer(task: Callable[..., Any], arguments: dict[str, Any]) -> dict[str, Any]:
    try:
        return {"found": task(**arguments)}
    except Exception as error:
        kind = "MemoryError" if isinstance(error, MemoryError) else type(error).__name__
        key = getattr(error, "key", None)
        return {
            "kind": kind,
            "message": str(error)[:4000],
            "key": None if key is None else str(key),
            "fields": list(getattr(error, "fields", ())),
            "errno": _system_error(error),
        }


def _system_error(error: BaseException) -> int | None:
    """Return the number of the system's error; of a full disk also if another error tells of it."""
    number = getattr(error, "errno", None)
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in FULL:
            return cause.errno
        cause = cause.__cause__
    return number
