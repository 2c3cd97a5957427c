"""Messages between a session and the process that runs its queries, as bytes.

A message is one letter for its kind, the length of its content, and the content: JSON, or an Arrow
stream. Nothing in it can make the reader run code, and the reader refuses what is longer than it
allows before it takes memory for it. JSON has no dates, decimals, bytes or tuples. A value of such
a type is a JSON list with the name of its type first, and so is a list; numbers, texts, truth
values and null are themselves.
"""

from __future__ import annotations

import base64
import datetime as dt
import json
import os
import select
import struct
import sys
import uuid
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import Decimal
from typing import IO, Any

from starcat.errors import QueryError

HEAD = struct.Struct(">cQ")
"""Kind and length of a message."""

READ_BYTES = 1 << 20
LOOK_S = 0.5
"""Seconds after which a reader that waits looks whether the writer is still running."""

_PLAIN = {bool, int, float, str, type(None)}
_PACKED = {"d": float, "q": int}
"""Types of columns that are sent as packed numbers, by the letter of `array.array`."""


class MalformedMessage(QueryError):  # noqa: N818 - the name reads as the fact
    """A process sent bytes that are not a message, or a message that is too long."""


def write_message(stream: IO[bytes], kind: str, content: bytes) -> None:
    """Write a message."""
    stream.write(HEAD.pack(kind.encode(), len(content)))
    stream.write(content)
    stream.flush()


def read_message(stream: IO[bytes]) -> tuple[str, bytes]:
    """Read a message of a writer that is trusted; EOFError if there is none."""
    kind, size = HEAD.unpack(_exactly(stream, HEAD.size))
    return kind.decode(), _exactly(stream, size)


def _exactly(stream: IO[bytes], size: int) -> bytes:
    found = stream.read(size)
    if len(found) < size:
        raise EOFError
    return found


def receive_message(
    stream: IO[bytes], max_bytes: int, is_over: Callable[[], bool]
) -> tuple[str, bytes]:
    """Read a message of a process that is not trusted.

    Memory is taken only for bytes that arrived. EOFError if the process ended, or if ``is_over``
    becomes true: a process that it started may keep the pipe open.
    """
    kind, size = HEAD.unpack(_arrived(stream, HEAD.size, is_over))
    if size > max_bytes:
        raise MalformedMessage(
            f"the process of the query sent a message of {size:,} bytes; at most {max_bytes:,} "
            "are read"
        )
    return kind.decode("latin-1"), _arrived(stream, size, is_over)


def _arrived(stream: IO[bytes], size: int, is_over: Callable[[], bool]) -> bytes:
    found = bytearray()
    while len(found) < size:
        if is_over():
            raise EOFError
        if os.name == "posix" and not select.select([stream], [], [], LOOK_S)[0]:
            continue
        part = os.read(stream.fileno(), min(READ_BYTES, size - len(found)))
        if not part:
            raise EOFError
        found += part
    return bytes(found)


def send_message(stream: IO[bytes], kind: str, content: bytes, is_over: Callable[[], bool]) -> None:
    """Send a message to a process that is not trusted, and may not read it; OSError if it ended."""
    if os.name != "posix":
        write_message(stream, kind, content)
        return
    left = memoryview(HEAD.pack(kind.encode(), len(content)) + content)
    os.set_blocking(stream.fileno(), False)
    while left:
        if is_over():
            raise BrokenPipeError
        if select.select([], [stream], [], LOOK_S)[1]:
            left = left[os.write(stream.fileno(), left) :]


def json_content(found: Any) -> bytes:
    """Return plain values as the content of a message."""
    return json.dumps(found, separators=(",", ":")).encode()


def from_json(content: bytes) -> Any:
    """Return the plain values of a message; MalformedMessage if it is not JSON."""
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise _malformed(error) from error


def encoded(value: Any) -> Any:
    """Return a value as JSON can hold it, for `decoded`; TypeError if its type is not known."""
    if type(value) in _PLAIN:
        return value
    for kind, (classes, write, _) in _TYPES.items():
        if isinstance(value, classes):
            return [kind, *write(value)]
    if isinstance(value, str | int | float):  # subclasses
        return value
    if type(value).__module__.partition(".")[0] == "numpy":
        if type(value).__name__ == "datetime64":
            nanoseconds = "[ns]" in str(value.dtype)
            return encoded((value.astype("datetime64[us]") if nanoseconds else value).item())
        return encoded(value.tolist())
    raise TypeError(f"values of the type {type(value).__name__} are not known")


def decoded(value: Any) -> Any:
    """Return the value that `encoded` was given; MalformedMessage if it is none."""
    if type(value) in _PLAIN:
        return value
    try:
        kind, *parts = value
        return _TYPES[kind][2](*parts)
    except MalformedMessage:
        raise
    except Exception as error:  # whatever wrong parts lead to
        raise _malformed(error) from error


def encoded_rows(rows: Sequence[Sequence[Any]]) -> bytes:
    """Return rows as the content of a message, for `decoded_rows`."""
    columns = list(zip(*rows, strict=True))
    return json_content([len(rows), [_encoded_column(column) for column in columns]])


def decoded_rows(content: bytes) -> list[tuple[Any, ...]]:
    """Return the rows of a message; MalformedMessage if there are none in it."""
    found = from_json(content)
    try:
        count, columns = found
        values = [_decoded_column(column) for column in columns]
        if {len(column) for column in values} != {count}:
            raise ValueError("the columns have different lengths")
        return list(zip(*values, strict=True))
    except (TypeError, ValueError, KeyError, RecursionError) as error:
        raise _malformed(error) from error


def _encoded_column(column: Sequence[Any]) -> list[Any]:
    kinds = set(map(type, column))
    has_nulls = type(None) in kinds
    kinds.discard(type(None))
    for code, kind in _PACKED.items():
        if kinds == {kind}:
            nulls = [k for k, value in enumerate(column) if value is None] if has_nulls else []
            values = [kind() if value is None else value for value in column] if nulls else column
            try:
                packed = array(code, values)
            except OverflowError:  # larger than 64 bits
                break
            if sys.byteorder == "big":
                packed.byteswap()
            return [code, base64.b64encode(packed.tobytes()).decode("ascii"), nulls]
    if kinds <= _PLAIN:
        return ["plain", column]
    return ["any", [encoded(value) for value in column]]


def _decoded_column(column: Any) -> list[Any]:
    code, content, *rest = column
    if code == "plain":
        if any(type(value) not in _PLAIN for value in content):
            raise ValueError("a plain column has other values")
        return list(content)
    if code == "any":
        return [decoded(value) for value in content]
    if code not in _PACKED:
        raise ValueError("an unknown form of a column")
    packed = array(code)
    packed.frombytes(base64.b64decode(content, validate=True))
    if sys.byteorder == "big":
        packed.byteswap()
    values: list[Any] = packed.tolist()
    [nulls] = rest
    for k in nulls:
        values[k] = None
    return values


def _malformed(error: Exception) -> MalformedMessage:
    return MalformedMessage(
        f"the process of the query sent data that cannot be read ({type(error).__name__}), and was "
        "ended; ask again"
    )


def _items(values: Iterable[Any]) -> tuple[list[Any]]:
    return ([encoded(value) for value in values],)


def _entries(value: Mapping[Any, Any]) -> tuple[list[Any], list[Any]]:
    return *_items(value), *_items(value.values())


def _dictionary(keys: list[Any], values: list[Any]) -> dict[Any, Any]:
    return dict(zip(map(decoded, keys), map(decoded, values), strict=True))


_TYPES: dict[str, tuple[tuple[type, ...], Callable[[Any], Iterable[Any]], Callable[..., Any]]] = {
    "list": ((list,), _items, lambda items: list(map(decoded, items))),
    "tuple": ((tuple,), _items, lambda items: tuple(map(decoded, items))),
    "dict": ((dict,), _entries, _dictionary),
    "bytes": (
        (bytes, bytearray, memoryview),
        lambda value: (base64.b64encode(value).decode("ascii"),),
        lambda text: base64.b64decode(text, validate=True),
    ),
    "decimal": ((Decimal,), lambda value: (str(value),), Decimal),
    "datetime": (
        (dt.datetime,),
        lambda value: (dt.datetime.isoformat(value),),
        dt.datetime.fromisoformat,
    ),
    "date": ((dt.date,), lambda value: (value.isoformat(),), dt.date.fromisoformat),
    "time": ((dt.time,), lambda value: (value.isoformat(),), dt.time.fromisoformat),
    "interval": (
        (dt.timedelta,),
        lambda value: (value.days, value.seconds, value.microseconds),
        dt.timedelta,
    ),
    "uuid": ((uuid.UUID,), lambda value: (value.hex,), uuid.UUID),
}
"""Types beside those of JSON: the classes, what is written of a value, and how it is read again."""
