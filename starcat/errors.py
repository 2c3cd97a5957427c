"""The exception tree: every error that starcat raises on purpose.

Each class holds the facts as attributes. Its message states the value that was found, the value
that was expected, and what to do next. ``exit_code`` is the exit code of the command line.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from difflib import get_close_matches
from enum import Enum
from pathlib import Path
from string import Formatter
from typing import Any, Self


def reason(error: OSError) -> str:
    """Return the operating system's reason without its path, which our messages state themselves.

    Examples
    --------
    >>> reason(OSError(28, "Error writing bytes to file. Detail: [errno 28] ..."))
    'No space left on device'
    """
    return os.strerror(error.errno) if error.errno else str(error)


def suggest(word: str, names: Iterable[str]) -> str:
    """Return the start of a hint if a word is similar to a known word; else an empty text.

    People rarely mistype the first letter, so that words which share it can differ by more.

    Examples
    --------
    >>> suggest("soa", ["sao", "gaia"])
    "did you mean 'sao'? "
    """
    words = list(names)
    alike = [name for name in words if name[:1].lower() == word[:1].lower()]
    near = get_close_matches(word, words, 1, cutoff=0.6) or get_close_matches(word, alike, 1, 0.5)
    return f"did you mean {near[0]!r}? " if near else ""


def count_of(count: int, noun: str) -> str:
    """Return a number of things in words.

    Examples
    --------
    >>> count_of(1, "row"), count_of(1200, "row")
    ('1 row', '1,200 rows')
    """
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def quoted(text: bytes | str, most: int = 60) -> str:
    """Return a text of an input in quotes for a message, cut if it is too long.

    Examples
    --------
    >>> quoted(b" x.2")
    "' x.2'"
    >>> quoted("7" * 20_000, most=5)
    "'77777' (the first 5 of 20,000 characters)"
    """
    words = text.decode("latin-1") if isinstance(text, bytes) else text
    if len(words) <= most:
        return repr(words)
    return f"{words[:most]!r} (the first {most} of {len(words):,} characters)"


NameOf = Callable[[str, str, str], str | None]
"""Returns the name of a parameter in an interface, or None if the interface does not have it.

The arguments are the parameter, the value that a hint gives it, and its item: the last two are
empty texts if the hint states none.
"""


def python_name(parameter: str, value: str = "", item: str = "") -> str:
    """Return the name of a parameter in Python.

    Examples
    --------
    >>> python_name("time_limit_s"), python_name("replace", "True"), python_name("inputs", item="a")
    ('time_limit_s', 'replace=True', 'inputs["a"]')
    """
    if item:
        return f'{parameter}["{item}"]'
    return f"{parameter}={value}" if value else parameter


class Unstated(Enum):
    """The value of an error whose message does not state a value."""

    UNSTATED = "unstated"


class AsWritten(str):
    """A value of an error in the words of the message: it is not put in quotes."""

    def __repr__(self) -> str:
        return str(self)


def literal(text: object) -> str:
    """Return a text of an input for a hint, in which braces would mark a parameter."""
    return str(text).replace("{", "{{").replace("}", "}}")


def filled(template: str, name_of: NameOf = python_name) -> str | None:
    """Return a part of a hint with the names of an interface; None if it does not have them.

    Examples
    --------
    >>> filled("allow more with {time_limit_s}, or pass {replace:True}")
    'allow more with time_limit_s, or pass replace=True'
    >>> filled("name it with {inputs[sao]}", lambda name, value, item: f"--{name} {item}=PATH")
    'name it with --inputs sao=PATH'
    >>> filled("use {flip}", lambda *_: None) is None
    True
    """
    parts = []
    try:
        for text, parameter, value, _ in Formatter().parse(template):
            parts.append(text)
            if parameter is not None:
                name, _, item = parameter.partition("[")
                named = name_of(name, value or "", item.removesuffix("]"))
                if named is None:
                    return None
                parts.append(named)
    except ValueError:  # braces of an input
        return template
    return "".join(parts)


def advice_in_words(advice: Sequence[str], name_of: NameOf = python_name) -> str:
    """Return alternatives of what to do with the names of an interface, without those it lacks.

    Examples
    --------
    >>> advice_in_words(["ask for less", "use fewer {workers}", "allow more"])
    'ask for less, use fewer workers, or allow more'
    """
    texts = [text for text in (filled(part, name_of) for part in advice) if text is not None]
    return ", or ".join([text for text in (", ".join(texts[:-1]), *texts[-1:]) if text])


def error_fields(error: StarcatError) -> dict[str, Any]:
    """Return an error as plain values of JSON, for `error_from_fields`."""
    key = getattr(error, "key", None)
    return {
        "kind": type(error).__name__,
        "where": str(error.where),
        "parameter": error.parameter,
        "value": None
        if error.value is Unstated.UNSTATED
        else repr(error.value)[:MAX_VALUE_CHARACTERS],
        "problem": error.problem,
        "advice": list(error.advice),
        "key": None if key is None else str(key),
    }


MAX_VALUE_CHARACTERS = 1000
"""Characters of a value that is sent to another process."""


def error_from_fields(content: Mapping[str, Any]) -> StarcatError | None:
    """Return the error that another process has reported; None if it is not one of starcat.

    Examples
    --------
    >>> error_from_fields({"kind": "QueryError", "problem": "no such column"})
    QueryError('no such column')
    >>> error_from_fields({"kind": "SystemExit", "problem": ""}) is None
    True
    """
    kind = globals().get(str(content["kind"]))
    if not (isinstance(kind, type) and issubclass(kind, StarcatError)) or kind is OnboardSizeError:
        return None
    error = kind(str(content["problem"]))
    error.where = str(content.get("where") or "")
    error.hint = tuple(map(str, content.get("advice") or ()))
    if content.get("parameter") is not None:
        error.parameter = str(content["parameter"])
    if content.get("value") is not None:
        error.value = AsWritten(content["value"])
    if content.get("key") is not None and isinstance(error, ConfigError | BuildError):
        error.key = str(content["key"])
    return error


@dataclass(eq=False, repr=False)
class StarcatError(Exception):
    """Base of all errors that starcat raises on purpose.

    An interface words an error with `message`, and names the parameters as its users do. ``str``
    gives the words of Python.
    """

    problem: str  # what was found, and what was expected
    _: KW_ONLY
    parameter: str | None = None  # the argument that is wrong; an item of it is "inputs[sao]"
    value: object = Unstated.UNSTATED  # the value of it that the message states
    hint: str | Sequence[str] = ()  # what to do, or alternatives; "{name}" stands for a parameter
    where: object = ""  # the file, the key or the frame with the problem
    path: Path | None = None  # the file or folder, if `where` is not it
    exit_code = 1

    def __post_init__(self) -> None:
        if self.path is None and isinstance(self.where, Path):
            self.path = self.where

    @property
    def advice(self) -> tuple[str, ...]:
        """The alternatives of the hint."""
        return (self.hint,) if isinstance(self.hint, str) else tuple(self.hint)

    def advice_for(self, name_of: NameOf = python_name) -> str:
        """Return what to do in the terms of an interface; empty if nothing can be done there."""
        return advice_in_words(self.advice, name_of)

    def message(self, name_of: NameOf = python_name) -> str:
        """Return the problem and what to do, in the terms of an interface.

        Examples
        --------
        >>> error = ConfigError("expected 1 to 9", parameter="count", value=0, hint="try {fewest}")
        >>> error.message(lambda name, *_: f"--{name}"), str(error)
        ('--count is 0; expected 1 to 9; try --fewest', 'count is 0; expected 1 to 9; try fewest')
        """
        text = self.problem
        if self.parameter is not None:
            name = filled(f"{{{self.parameter}}}", name_of) or self.parameter
            text = (
                f"{name}: {text}"
                if self.value is Unstated.UNSTATED
                else f"{name} is {self.value!r}; {text}"
            )
        if self.where:
            text = f"{self.where}: {text}"
        hint = self.advice_for(name_of)
        return f"{text}{'. ' if hint[:1].isupper() else '; '}{hint}" if hint else text

    def at(self, where: object) -> None:
        """State the file or the frame that has the problem."""
        self.where = f"{where}: {self.where}" if self.where else where

    def in_file(self, where: object) -> Self:
        """Return the error as one of a file, whose keys have the same names in every interface.

        Examples
        --------
        >>> error = ConfigError("expected 1 to 9", parameter="count", value=0, hint="try {fewest}")
        >>> error.in_file("a.toml").message(lambda name, *_: f"--{name}")
        'a.toml: count is 0; expected 1 to 9; try fewest'
        """
        texts = filter(None, map(filled, self.advice))
        found = replace(self, hint="").message()
        return replace(
            self, problem=found, parameter=None, hint=tuple(map(literal, texts)), where=where
        )

    def __str__(self) -> str:
        return self.message()


@dataclass(eq=False, repr=False, kw_only=True)
class ConfigError(StarcatError, ValueError):
    """A build spec, preset, option or data-source file that cannot be used."""

    exit_code = 2
    key: str | None = None  # the key of the file that is wrong


class FileMissing(ConfigError):  # noqa: N818 - the name reads as the fact
    """A spec, a camera file or a frame that is not there."""

    exit_code = 3


@dataclass(eq=False, repr=False, kw_only=True)
class SourceError(StarcatError):
    """A catalog file that is missing, damaged or of another kind than expected."""

    exit_code = 3
    source: str | None = None


class SourceMissing(SourceError):  # noqa: N818 - the name reads as the fact
    """No file of the source was found in any of the places searched."""


class ChecksumMismatch(SourceError):  # noqa: N818
    """A file whose digest is not the one recorded for it."""


@dataclass(eq=False, repr=False, kw_only=True)
class ParseError(SourceError):
    """A file whose content does not follow the source's record layout."""

    line: int | None = None
    byte_range: tuple[int, int] | None = None
    field: str | None = None


class DownloadError(SourceError):
    """A file that could not be fetched from any of its addresses."""


@dataclass(eq=False, repr=False, kw_only=True)
class BuildError(StarcatError):
    """A build that ran but has no usable result: no stars left, or a failed self-test."""

    key: str | None = None  # the key of the spec to change
    built: object = None  # after a self-test: a `starcat.pipeline.build.Built` without folder


class CalibrationError(StarcatError):
    """A calibration with too few identified frames."""


class NotIdentifiedError(StarcatError):
    """A frame that was not identified, although an identified frame is required."""

    exit_code = 6


@dataclass(eq=False, repr=False, kw_only=True)
class ServiceError(StarcatError):
    """A service that cannot be reached, or that refuses a request."""

    exit_code: int = 1
    status: int | None = None


class OutputError(StarcatError):
    """A place that cannot be written to, or already holds something else."""


@dataclass(eq=False, repr=False, kw_only=True)
class SchemaError(StarcatError):
    """A table or database that does not follow the schema of its product."""

    exit_code = 4
    product: str | None = None
    field: str | None = None
    found: object = None
    expected: object = None


class SchemaVersionError(SchemaError):
    """A product written with a schema version that this reader does not know."""


@dataclass(eq=False, repr=False, kw_only=True)
class ProductError(StarcatError):
    """A product or database that is corrupt, incomplete or does not match its manifest."""

    exit_code = 5
    product: str | None = None


class DatabaseMissing(ProductError):  # noqa: N818 - the name reads as the fact
    """No database at the place that was named."""

    exit_code = 3


def no_database(path: Path) -> DatabaseMissing:
    """Return the error for a folder that does not exist, or that is not a database."""
    what = "no database is in this folder" if path.is_dir() else "no such database"
    what = "a file, not the folder of a database" if path.is_file() else what
    return DatabaseMissing(
        what, where=path, hint="give the folder <name>-<version> that 'starcat build' made"
    )


@dataclass(eq=False, repr=False, kw_only=True)
class OnboardImageError(ProductError):
    """An onboard image that is damaged, cut short, or another file."""

    bad_blocks: Sequence[int] = ()


@dataclass(eq=False, repr=False, kw_only=True)
class OnboardSizeError(StarcatError):
    """An onboard image that cannot be made as small as requested."""

    max_bytes: int
    smallest_bytes: int


class QueryError(StarcatError):
    """A query that is not valid SQL, names unknown things, or does something not allowed."""

    exit_code = 2


class TargetMissing(QueryError):  # noqa: N818
    """A query about a database or a file that is not there."""

    exit_code = 3


class QueryLimitError(QueryError):
    """A query that was stopped because it exceeded its time or memory limit."""

    exit_code = 1


class AnswerTooLarge(QueryLimitError):  # noqa: N818 - the name reads as the fact
    """The answer to a query exceeds the size limit."""
