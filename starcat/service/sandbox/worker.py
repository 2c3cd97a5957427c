"""The process that reads uploads and makes files, for `starcat.service.sandbox.sandbox`.

A request is a line of JSON, and so is the answer: nothing that was uploaded can make the server
run anything.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from starcat.query.confinement import forbid_writing, limit_memory, limit_time
from starcat.service.identifying import identify
from starcat.service.sandbox.child import own_output
from starcat.vo.uploads import upload_facts


def convert(source: str, target: str, form: str) -> int:
    """Write a table to a file of another format: some are held in memory as a whole."""
    import pyarrow as pa

    from starcat.exchange.writers import write_batches

    with pa.OSFile(source) as file, pa.ipc.open_stream(file) as stream:
        return write_batches(stream, Path(target), form)


TASKS: dict[str, Callable[..., Any]] = {
    "identify": identify,
    "convert": convert,
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
        }
