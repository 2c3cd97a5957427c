"""Messages between a process and its workers, for queries, uploads, estimates and jobs.

A message consists of one letter for its kind, the length of the content, and the content (JSON or
an Arrow stream). No content can make the reader run code. The reader refuses a message that is too
long before it allocates memory, and JSON that is nested too deep for Python.
"""

from __future__ import annotations

import errno
import json
import struct
from typing import Any

from starcat.errors import QueryError, StarcatError, error_fields, error_from_fields

HEAD = struct.Struct(">cQ")
"""Kind and length of a message."""

REQUEST = "?"  # a request
PROGRESS = "%"  # progress; more replies follow
PART = "p"  # a part of the answer; more replies follow
DONE = "d"  # the answer, or the end of it
ARROW = "a"  # the answer, as an Arrow stream
ERROR = "e"  # an error instead of an answer: `error_content`
ENDINGS = frozenset({DONE, ARROW, ERROR})

MAX_ERROR_CHARACTERS = 4000
FULL = (errno.ENOSPC, errno.EDQUOT)
PLAIN_ERRORS: tuple[type[Exception], ...] = (MemoryError, RecursionError)
"""Built-in exceptions that a worker reports in addition to the errors of `starcat.errors`."""

_JSON = json.JSONEncoder(separators=(",", ":"), default=lambda value: value.tolist())
"""Encoder of JSON: numbers and arrays of numpy become numbers and lists."""


class MalformedMessage(QueryError):  # noqa: N818 - the name reads as the fact
    """A process sent bytes that are not a message, or a message that is too long."""


def json_content(value: Any) -> bytes:
    """Return plain values as the content of a message."""
    return _JSON.encode(value).encode()


def from_json(content: bytes | bytearray) -> Any:
    """Return the plain values of a message; MalformedMessage if it is not JSON."""
    try:
        return json.loads(str(content, "utf-8"))
    except (ValueError, RecursionError) as error:
        raise malformed(error) from error


def malformed(error: Exception) -> MalformedMessage:
    """Return the error for data that cannot be read, from the exception of the reader."""
    return MalformedMessage(
        f"the process sent data that cannot be read ({type(error).__name__}), and was ended",
        hint="ask again",
    )


def error_content(error: Exception) -> dict[str, Any]:
    """Return an error as plain values, for `error_of`."""
    plain = next((kind for kind in PLAIN_ERRORS if isinstance(error, kind)), type(error))
    text = str(error).strip() or plain.__name__
    fields = error_fields(error) if isinstance(error, StarcatError) else {"problem": text}
    return fields | {
        "kind": plain.__name__,
        "problem": fields["problem"][:MAX_ERROR_CHARACTERS],
        "errno": _system_error(error),
    }


def error_of(content: Any) -> Exception:
    """Return the error that a worker has reported, one of a fixed set of classes.

    The classes are the errors of `starcat.errors`, `PLAIN_ERRORS`, OSError, and RuntimeError for
    all others. A content that is not an error gives a `MalformedMessage`.
    """
    try:
        kind, problem, number = str(content["kind"]), str(content["problem"]), content["errno"]
        if number is not None:
            return OSError(int(number), problem)
        reported = error_from_fields(content)
    except (TypeError, ValueError, LookupError) as error:
        return malformed(error)
    for plain in PLAIN_ERRORS:
        if kind == plain.__name__:
            return plain(problem)
    return reported or RuntimeError(f"{kind}: {problem}")


def _system_error(error: BaseException) -> int | None:
    """Return the number of a system error; a full disk is recognised in other errors too."""
    number = getattr(error, "errno", None)
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in FULL:
            return cause.errno
        cause = cause.__cause__
    return number if isinstance(number, int) else None
