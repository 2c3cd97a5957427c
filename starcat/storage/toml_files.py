"""Files in TOML: read with limits, with errors that name the place and the expected value."""

from __future__ import annotations

import codecs
import datetime
import reprlib
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError

from starcat.errors import ConfigError, FileMissing, SourceError, Unstated, literal, quoted, suggest
from starcat.failures import expected_words
from starcat.storage.regular_files import read_regular_file

MAX_CHARACTERS, MAX_POINTS = 100_000, 200
"""Most characters in the text of a spec, and most full stops in a line."""

MAX_BYTES = 4 * MAX_CHARACTERS
"""Largest size of the file of a spec or of a camera."""


def text_of_toml(path: Path, missing: str) -> str:
    """Read a TOML file; ``missing`` is the error message if the file does not exist."""
    try:
        content = read_regular_file(path, MAX_BYTES)
    except FileMissing:
        raise FileMissing(missing, where=path) from None
    except SourceError as error:
        raise ConfigError(f"{error}; expected a TOML file") from error
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        where = f"line {line} has the byte 0x{content[error.start]:02x}"
        if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            where = "it is in UTF-16"
        raise ConfigError(
            f"is not in UTF-8, the encoding of TOML: {where}; save it again as UTF-8", where=path
        ) from error


def content_of_toml(text: str, origin: str) -> dict[str, Any]:
    """Read the text of a spec or of a camera.

    A byte order mark, with which some editors of Windows begin a text, is left out.

    The parser's time grows with the square of the number of parts in a dotted key: 40 kB of them
    take 8 s. Such lines are refused before parsing.
    """
    if len(text) > MAX_CHARACTERS:
        raise ConfigError(
            f"{len(text):,} characters; at most {MAX_CHARACTERS:,} are read, and a spec "
            "with every key explained has 12,000. Leave out what is no spec",
            where=origin,
        )
    for number, line in enumerate(text.split("\n"), start=1):
        if line.count(".") > MAX_POINTS:
            raise ConfigError(
                f"line {number} has {line.count('.'):,} full stops; at most "
                f"{MAX_POINTS} are read, and a key of a spec has two",
                where=origin,
            )
    try:
        content = tomllib.loads(text.removeprefix("\ufeff"))
    except (ValueError, RecursionError) as error:
        why = "nested too deep" if isinstance(error, RecursionError) else error
        raise ConfigError(f"not a readable TOML file: {why}", where=origin) from error
    _check_integers(content, origin)
    return content


def _check_integers(content: dict[str, Any], origin: str) -> None:
    """Refuse integers beyond TOML's range: Python cannot print an integer of 4,300 digits."""
    unchecked: list[tuple[str, Any]] = list(content.items())
    while unchecked:
        key, value = unchecked.pop()
        if isinstance(value, dict):
            unchecked += [(f"{key}.{name}", item) for name, item in value.items()]
        elif isinstance(value, list):
            unchecked += [(key, item) for item in value]
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            shown = _shown_key(key)
            raise ConfigError(
                f"found {toml_shown(value)}; an integer of TOML is from -2^63 to 2^63 - 1",
                where=f"{origin}: {shown}",
                key=shown,
            )


def what_is_wrong(
    error: ValidationError, origin: str, model: type[BaseModel], kind: str
) -> ConfigError:
    """Return the error for the first wrong key; misspelt keys come before missing ones."""
    return all_that_is_wrong(error, origin, model, kind)[0]


def all_that_is_wrong(
    error: ValidationError, origin: str, model: type[BaseModel], kind: str
) -> list[ConfigError]:
    """Return an error for each wrong key of a file, in the order of `what_is_wrong`."""
    errors = []
    for wrong in wrong_keys(error, model, kind):
        wrong.key = wrong.key or kind
        errors.append(wrong.in_file(f"{origin}: {wrong.key}"))
    return errors


def wrong_keys(error: ValidationError, model: type[BaseModel], kind: str) -> Iterator[ConfigError]:
    """Yield an error for each wrong key, whose hint names parameters in braces."""
    for entry in sorted(error.errors(), key=lambda entry: entry["type"] != "extra_forbidden"):
        wrong = _explain(dict(entry), model, kind)
        wrong.key = ".".join(_shown_key(str(part)) for part in entry["loc"]) or None
        if wrong.value is Unstated.UNSTATED:
            wrong.value = entry["input"]
        yield wrong


def _shown_key(name: str) -> str:
    return name if name.isprintable() and len(name) <= 60 else quoted(name)


def _explain(error: dict[str, Any], model: type[BaseModel], kind_of_file: str) -> ConfigError:
    kind, context, location = error["type"], error.get("ctx", {}), error["loc"]
    if kind == "extra_forbidden":
        around = _model_at(location[:-1], model)
        advice = getattr(around, "not_keys", {}).get(location[-1])
        if advice is not None:
            return ConfigError("not needed, and not read", hint=advice)
        known_keys = sorted(getattr(around, "model_fields", ()))
        hint = suggest(str(location[-1])[:100], known_keys)
        return ConfigError(
            "unknown key", hint=literal(f"{hint}known keys here: {', '.join(known_keys)}")
        )
    if kind == "missing" and not isinstance(location[-1], int):
        return ConfigError(f"missing; every {kind_of_file} needs it")
    if kind == "value_error":
        cause = context.get("error", error["msg"])
        return replace(cause) if isinstance(cause, ConfigError) else ConfigError(str(cause))
    value = error["input"]
    shown = toml_shown(value)
    expected = expected_words(error)
    if kind in ("missing", "too_long", "too_short") and isinstance(value, list | tuple):
        fixed = _list_at(location, model)
        expected = f"expected {fixed}" if fixed else expected
        return ConfigError(f"found a list of {len(value):,}; {expected}")
    if kind == "less_than" and str(location[-1]).startswith("fov_"):
        expected += ": specs are for a flat detector; give the part of a wider field that is used"
    if kind == "tuple_type":
        name = ".".join(map(str, location))
        if isinstance(value, dict) and hasattr(_model_at(location, model), "model_fields"):
            expected = f"expected an array of tables; write [[{name}]], with double brackets"
        elif isinstance(value, str):
            expected += f"; write {location[-1]} = [{toml_shown(value)}]"
    if kind == "model_type" and isinstance(value, list) and not isinstance(location[-1], int):
        expected += f"; write [{'.'.join(map(str, location))}], with single brackets"
    return ConfigError(f"found {shown if len(shown) < 60 else shown[:57] + '...'}; {expected}")


def _annotation_at(location: tuple[Any, ...], model: Any) -> Any:
    """Return the type of a key: of its value, or of the items of a list."""
    kind = model
    for part in location:
        fields = getattr(_section_in(kind), "model_fields", {})
        kind = fields[part].annotation if part in fields else kind
    return kind


def _section_in(kind: Any) -> Any:
    """Return the section that a type is or holds; the type itself if there is none."""
    return next(
        (
            alternative
            for alternative in (kind, *get_args(kind))
            if hasattr(alternative, "model_fields")
        ),
        kind,
    )


def _model_at(location: tuple[Any, ...], model: Any) -> Any:
    return _section_in(_annotation_at(location, model))


def _list_at(location: tuple[Any, ...], model: Any) -> str | None:
    """Return the expected list in words, if a key has a list of fixed length; else None."""
    keys = tuple(part for part in location if not isinstance(part, int))
    kind = _annotation_at(keys, model)
    for alternative in (kind, *get_args(kind)):
        items = get_args(alternative)
        if get_origin(alternative) is tuple and Ellipsis not in items:
            field = _model_at(keys[:-1], model).model_fields[keys[-1]]
            return f"a list of {len(items)}: {field.description}"
    return None


class _Shown(reprlib.Repr):
    """Shows a value of any length or depth in a message, as TOML writes it."""

    def repr_bool(self, x: bool, level: int) -> str:
        """Return true or false."""
        return str(x).lower()

    def repr_dict(self, x: dict[str, Any], level: int) -> str:
        """Return an inline table."""
        if level <= 0 and x:
            return "{...}"
        some = islice(x.items(), self.maxdict)
        shown = [f"{key} = {self.repr1(value, level - 1)}" for key, value in some]
        more = ["..."] if len(x) > self.maxdict else []
        return f"{{{', '.join([*shown, *more])}}}"

    def repr_date(self, x: datetime.date | datetime.time, level: int) -> str:
        """Return a date, a time or both."""
        return x.isoformat()

    repr_datetime = repr_time = repr_date

    def repr_int(self, x: int, level: int) -> str:
        """Return a number; Python refuses to write one of more than 4,300 digits."""
        if x.bit_length() > 1000:
            return f"a number of {x.bit_length():,} bits"
        return super().repr_int(x, level)


_SHOWN = _Shown()
_SHOWN.maxstring = _SHOWN.maxlong = _SHOWN.maxother = 100


def toml_shown(value: Any) -> str:
    """Return a value as TOML writes it, cut if it is long or deep.

    Examples
    --------
    >>> toml_shown({"a": [True, 1.5], "b": "text"})
    "{a = [true, 1.5], b = 'text'}"
    """
    return _SHOWN.repr(value)
