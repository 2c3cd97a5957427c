"""Results as plain values: the fields of a result are the keys of its JSON and of its tables.

A result is a frozen dataclass with units in the names of its fields. `to_dict` makes its record.
``field(repr=False)`` leaves a field out of it, as out of its ``repr``; ``metadata=entry(...)``
changes the key or the rounding; `in_record` marks a property that belongs to it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import date
from functools import cached_property
from pathlib import PurePath
from typing import Any, TypeVar

Method = TypeVar("Method", bound=Callable[..., Any])

_ENTRY = "entry"

UNITS = {
    "arcsec_per_px": "arcsec/px",
    "arcsec2": "arcsec2",
    "arcsec_s": "arcsec/s",
    "mas_yr": "mas/yr",
    "deg_s": "deg/s",
    "arcsec": "arcsec",
    "percent": "%",
    "jyear": "Julian year",
    "px2": "px2",
    "deg": "deg",
    "rad": "rad",
    "mag": "mag",
    "mas": "mas",
    "px": "px",
    "nm": "nm",
    "ms": "ms",
    "s": "s",
}
"""Unit by the end of a name; a longer end stands above the ends that it contains."""

LABELS = {
    "one_percent": "worst 1 %",
    "enough_share": "share with 4 stars or more",
    "full_share": "share with boresights.brightest stars",
}
"""Words of names that need more words in a table."""

DECIMALS = {"%": 2, "arcsec": 3, "deg": 4, "mag": 3, "ms": 2, "nm": 0, "px": 3, "s": 2}
"""Decimals of a number in a text, by unit; other numbers have six digits."""

SHOWN_ITEMS = 8
"""Most items of an array or a list in a ``repr``."""


@dataclass(frozen=True)
class Entry:
    """How a field or a property stands in the record of its result."""

    key: str = ""  # its key; empty: its name
    decimals: int | None = None  # rounding; None: not rounded
    is_optional: bool = False  # left out if it is None
    is_none_if_empty: bool = False  # None in place of an empty text
    is_spread: bool = False  # its keys are keys of the record


def entry(**how: Any) -> dict[str, Entry]:
    """Return the metadata of a field that states how it stands in the record (`Entry`)."""
    return {_ENTRY: Entry(**how)}


def in_record(**how: Any) -> Callable[[Method], Method]:
    """Mark the function of a property: the record of the result contains it (`Entry`)."""

    def mark(function: Method) -> Method:
        vars(function)[_ENTRY] = Entry(**how)
        return function

    return mark


def to_dict(result: Any) -> dict[str, Any]:
    """Return the record of a result: plain values, which ``json.dumps`` writes.

    Parameters
    ----------
    result : dataclass or mapping
        Arrays and tuples become lists, paths and exceptions texts, times ISO 8601, bytes
        hexadecimal. NaN and infinite numbers become None, and so does an array of nothing else.

    Examples
    --------
    >>> @dataclass(frozen=True)
    ... class Spot:
    ...     x_px: float
    ...     peak: float = dataclasses.field(default=2.0, metadata=entry(key="maximum"))
    >>> to_dict(Spot(float("nan")))
    {'x_px': None, 'maximum': 2.0}
    """
    if isinstance(result, Mapping):
        return {str(key): plain(value) for key, value in result.items()}
    record: dict[str, Any] = {}
    for name, how in _entries(type(result)):
        value = plain(getattr(result, name))
        if how.is_none_if_empty:
            value = value or None
        if how.is_spread:
            record |= value
        elif value is not None or not how.is_optional:
            record[how.key or name] = value if how.decimals is None else _round(value, how.decimals)
    return record


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if hasattr(value, "tolist"):  # an array of numpy, or a number in one
        items = plain(value.tolist())
        return None if isinstance(items, list) and items and not _has_value(items) else items
    if isinstance(value, PurePath | BaseException):  # an exception can be a dataclass
        return str(value)
    if isinstance(value, Mapping) or dataclasses.is_dataclass(value):
        return to_dict(value)
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, bytes):
        return value.hex()
    if hasattr(value, "model_dump"):
        return value.model_dump(mode="json")
    raise TypeError(f"{type(value).__name__} has no plain value; a field of a result needs one")


def _has_value(items: list[Any]) -> bool:
    return any(_has_value(item) if isinstance(item, list) else item is not None for item in items)


def _entries(kind: type) -> Iterator[tuple[str, Entry]]:
    """Yield name and entry of the fields of a class, then of its marked properties."""
    for field in dataclasses.fields(kind):
        if field.repr:
            yield field.name, field.metadata.get(_ENTRY, Entry())
    for base in reversed(kind.__mro__):
        for name, member in vars(base).items():
            function = member.func if isinstance(member, cached_property) else member
            function = member.fget if isinstance(member, property) else function
            if isinstance(how := getattr(function, _ENTRY, None), Entry):
                yield name, how


def _round(value: Any, decimals: int) -> Any:
    if isinstance(value, dict):
        return {key: _round(item, decimals) for key, item in value.items()}
    if isinstance(value, list):
        return [_round(item, decimals) for item in value]
    return round(value, decimals) if isinstance(value, float) else value


def label_and_unit(key: str) -> tuple[str, str]:
    """Return the words of a key, and the unit that it ends with.

    Examples
    --------
    >>> label_and_unit("sun_angle_deg"), label_and_unit("is_latest"), label_and_unit("camera.px")
    (('sun angle', 'deg'), ('latest', ''), ('camera px', ''))
    >>> label_and_unit("stars.one_percent")
    ('stars, worst 1 %', '')
    """
    if key in UNITS:
        return key, UNITS[key]
    above, _, name = key.rpartition(".")
    if name in LABELS:
        return ", ".join(filter(None, (above.replace(".", " "), LABELS[name]))), ""
    unit_end = next((end for end in UNITS if key.endswith(f"_{end}")), "")
    words = key.removesuffix(f"_{unit_end}") if unit_end else key
    for prefix in ("is_", "n_"):
        words = words.removeprefix(prefix)
    return words.replace("_", " ").replace(".", " "), UNITS.get(unit_end, "")


def flat(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record without records in it: ``camera.width_px`` is a key of the flat one.

    Examples
    --------
    >>> flat({"name": "a", "manifest": {"bytes": 3}})
    {'name': 'a', 'manifest.bytes': 3}
    """
    found: dict[str, Any] = {}
    for key, value in record.items():
        if isinstance(value, dict):
            found |= {f"{key}.{inner}": item for inner, item in flat(value).items()}
        else:
            found[key] = value
    return found


def text_of(key: str, value: Any) -> str:
    """Return a plain value as text, without its unit.

    Examples
    --------
    >>> text_of("stars", 12345), text_of("is_signed", True), text_of("crc", 255)
    ('12,345', 'yes', '0x000000ff')
    >>> text_of("offset_px", [1.5, None]), text_of("offset_px", 1e-7)
    ('1.500, -', '1e-07')
    """
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(text_of(key, item) for item in value) or "-"
    if isinstance(value, dict):
        return ", ".join(f"{inner} {text_of(inner, item)}" for inner, item in value.items())
    if isinstance(value, int):
        return f"0x{value:08x}" if key == "crc" else f"{value:,}"
    if isinstance(value, float):
        decimals = DECIMALS.get(label_and_unit(key)[1])
        if decimals is None:
            return f"{value:.6g}"
        is_small = value != 0.0 and abs(value) < 10.0**-decimals
        return f"{value:.2g}" if is_small else f"{value:,.{decimals}f}"
    return str(value)


def readable(result: Any) -> str:
    """Return the ``repr`` of a result: its record in one line, with the sizes of large values."""
    facts = []
    for key, value in to_dict(result).items():
        if value is None or value == []:
            continue
        label, unit = label_and_unit(key)
        shape = _shape(value)
        if math.prod(shape) > SHOWN_ITEMS or isinstance(value, dict):
            text = " x ".join(map(str, shape or (len(value),))) + " values"
        else:
            text = f"{text_of(key, value)} {unit}".rstrip()
        facts.append(f"{label} {text}")
    return f"<{type(result).__name__} {'; '.join(facts)}>"


def _shape(value: Any) -> tuple[int, ...]:
    """Return the lengths of a list and of the lists in it."""
    if not isinstance(value, list):
        return ()
    return (len(value), *(_shape(value[0]) if value else ()))
