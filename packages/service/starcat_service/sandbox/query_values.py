"""Values of queries as JSON can hold them, and rows of values as the content of a message.

JSON has no dates, decimals, bytes or tuples. A value of such a type is a JSON list with the name of
its type first, and so is a list; numbers, texts, truth values and null are themselves.
"""

from __future__ import annotations

import base64
import datetime as dt
import struct
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from decimal import Decimal
from itertools import chain
from typing import Any

from starcat.query import plain_value
from starcat_service.sandbox.messages import MalformedMessage, from_json, json_content, malformed

_PLAIN = {bool, int, float, str, type(None)}
_BETWEEN = "\n"
"""Separator of texts in a column, if none contains it. It is short in JSON and rare in columns."""
_INTEGERS = ("TINYINT", "SMALLINT", "INTEGER", "BIGINT", "UTINYINT", "USMALLINT", "UINTEGER")
_CODES = {"DOUBLE": "d", "FLOAT": "d", "BOOLEAN": "?", **dict.fromkeys(_INTEGERS, "q")}
"""How `struct` packs the values of a column, by DuckDB's type."""

_SIZES = {"d": 8, "q": 8, "?": 1}


def encoded(value: Any) -> Any:
    """Return a value as JSON can hold it, for `decoded`; TypeError if its type is not known."""
    if type(value) in _PLAIN:
        return value
    for kind, (classes, write, _) in _TYPES.items():
        if isinstance(value, classes):
            return [kind, *write(value)]
    if isinstance(value, str | int | float):  # subclasses
        return value
    plain = plain_value(value)
    if plain is not value:
        return encoded(plain)
    raise TypeError(f"values of the type {type(value).__name__} are not known")


def decoded(value: Any) -> Any:
    """Return the value that `encoded` was given, or raise MalformedMessage."""
    if type(value) in _PLAIN:
        return value
    try:
        kind, *parts = value
        return _TYPES[kind][2](*parts)
    except MalformedMessage:
        raise
    except Exception as error:  # any error that malformed parts cause
        raise malformed(error) from error


def encoded_rows(rows: Sequence[Sequence[Any]], types: Sequence[str]) -> bytes:
    """Return rows as the content of a message, for `decoded_rows`.

    Numbers of 64 bits and texts are packed behind the JSON, which is much faster. ``types`` are
    DuckDB's types of the columns.
    """
    packed: list[bytes] = []
    values = list(chain.from_iterable(rows))
    columns = [
        _encoded_column(values[k :: len(types)], kind, packed) for k, kind in enumerate(types)
    ]
    return b"\n".join((json_content([len(rows), columns, list(map(len, packed))]), *packed))


def decoded_rows(content: bytes | bytearray) -> list[tuple[Any, ...]]:
    """Return the rows of a message; MalformedMessage if there are none in it."""
    end = content.find(b"\n") % (len(content) + 1)
    header = from_json(content[:end])
    try:
        count, columns, sizes = header
        packed, view = [], memoryview(content)
        for size in sizes:
            if not 0 <= size < len(content) - end:
                raise ValueError("a packed column is cut off")
            packed.append(view[end + 1 : end + 1 + size])
            end += 1 + size
        parts = iter(packed)
        values = [_decoded_column(column, parts) for column in columns]
        if {len(column) for column in values} != {count}:
            raise ValueError("the columns have different lengths")
        return list(zip(*values, strict=True))
    except MalformedMessage:
        raise
    except Exception as error:  # any error that malformed parts cause
        raise malformed(error) from error


def _encoded_column(column: Sequence[Any], kind: str, packed: list[bytes]) -> list[Any]:
    code = _CODES.get(kind)
    if code is not None:
        nulls = [k for k, value in enumerate(column) if value is None] if None in column else []
        try:
            numbers = [0 if value is None else value for value in column] if nulls else column
            packed.append(struct.pack(f"<{len(column)}{code}", *numbers))
            return [code, nulls]
        except struct.error:  # larger than 64 bits
            pass
    if kind == "VARCHAR" and None not in column:
        joined = _BETWEEN.join(column)
        if joined.count(_BETWEEN) == len(column) - 1:
            packed.append(joined.encode())
            return ["text"]
    return ["any", [encoded(value) for value in column]]


def _decoded_column(column: Any, packed: Iterator[memoryview]) -> Sequence[Any]:
    code, *rest = column
    if code == "text":
        return str(next(packed), "utf-8").split(_BETWEEN)
    if code == "any":
        return [decoded(value) for value in rest[0]]
    if code not in _SIZES:
        raise ValueError("an unknown form of a column")
    part = next(packed)
    values: Sequence[Any] = struct.unpack(f"<{len(part) // _SIZES[code]}{code}", part)
    if rest[0]:
        values = list(values)
        for k in rest[0]:
            values[k] = None
    return values


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
"""Types that JSON lacks: their classes, how a value is written, and how it is read again."""
