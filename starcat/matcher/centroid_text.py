"""Tables of centroids as text: which character separates the columns, and which line names them.

Columns are separated by commas, semicolons, tabs, bars or blanks, decimals by a point or a comma.
Lines that begin with ``#`` are comments. They name the columns in files of SExtractor and of
``numpy.savetxt``. ECSV is such a table, too.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.errors import ConfigError, quoted
from starcat.matcher.centroid_columns import (
    ChosenColumns,
    choose_columns,
    columns_of_positions,
    listed,
)

HEADLESS = {2: ("x_px", "y_px"), 3: ("x_px", "y_px", "mag")}
"""Columns of a table whose first line is numbers, and which no comment names."""

SEPARATORS = (";", "\t", ",", "|", " ")
_MISSING = ("", "-", "--", "---", "na", "n/a", "none", "null")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
# A line of the header of SExtractor: the number of a column, its name, and what it is.
_NUMBERED = re.compile(r"#\s*(\d+)\s+([A-Za-z]\w*)(\s|$)")
# Characters of a text: all but control characters, and those that end or indent a line.
_NO_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1f]")

HEADER_ADVICE = "give it a first line such as x_px,y_px,mag"


def is_number(text: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def decoded_text(data: bytes) -> str | None:
    r"""Return a text in UTF-8, UTF-16 with its mark, or Latin-1; None if the bytes are no text.

    Examples
    --------
    >>> decoded_text("x;y".encode("utf-16")), decoded_text("Größe".encode("latin-1"))
    ('x;y', 'Größe')
    >>> decoded_text(b"\0a") is None
    True
    """
    is_wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        # Spreadsheets write a byte order mark before the header.
        text = data.decode("utf-16" if is_wide else "utf-8-sig")
    except UnicodeDecodeError:
        return None if is_wide or _NO_TEXT.search(data) else data.decode("latin-1")
    return None if "\0" in text else text


@dataclass(frozen=True, eq=False)
class TextTable:
    """The chosen columns of a table of text, as numbers."""

    layout: ChosenColumns
    values: dict[str, Array]
    frame: NDArray[np.str_] | None  # name of the frame of each row
    remarks: tuple[str, ...]


def read_text_table(text: str, where: str) -> TextTable:
    """Read a table of centroids."""
    filled = [(n, line) for n, line in enumerate(text.splitlines(), start=1) if line.strip()]
    rows = [(n, line) for n, line in filled if not line.lstrip().startswith("#")]
    if not filled:
        raise ConfigError(f"{where}: the file is empty; {_EXPECTED_LINES}")
    before = rows[0][0] if rows else filled[-1][0] + 1
    comments = [line.strip() for n, line in filled if n < before]
    try:
        header = _header(rows[0][1] if rows else "", comments, where)
        return _read_rows(rows[header.lines :], header, where)
    except csv.Error as error:
        raise ConfigError(
            f"{where}: not a CSV file ({error}); expected a header with x_px and y_px"
        ) from error


_EXPECTED_LINES = "expected a first line x_px,y_px or x_px,y_px,mag, and a line for each centroid"


@dataclass(frozen=True)
class _Header:
    names: tuple[str, ...]
    separator: str
    lines: int  # lines of the table that are the header: 0 or 1
    remarks: tuple[str, ...] = ()


def _header(first: str, comments: Sequence[str], where: str) -> _Header:
    """Return the names and the separator of the columns."""
    numbered = _names_of_sextractor(comments)
    if numbered:
        return _Header(numbered, " ", 0)
    ways = [(_fields(first, separator), separator) for separator in SEPARATORS]
    if not _is_row(first):
        if not first:
            raise ConfigError(f"{where}: has only comments; {_EXPECTED_LINES}")
        readable = [way for way in ways if choose_columns(way[0]) is not None]
        names, separator = readable[0] if readable else max(ways, key=lambda way: len(way[0]))
        return _Header(tuple(names), separator, 1)
    fields, separator = _numbers_of_first_line(first)
    for comment in reversed(comments):  # `numpy.savetxt` writes its header as a comment
        for other in (separator, *SEPARATORS):
            names = _fields(comment.lstrip("#").strip(), other)
            if len(names) == len(fields) and choose_columns(names) is not None:
                return _Header(tuple(names), separator, 0)
    if len(fields) not in HEADLESS:
        raise ConfigError(
            f"{where}: the first line is {len(fields)} numbers and no header names them",
            hint=HEADER_ADVICE,
        )
    assumed = HEADLESS[len(fields)]
    words = _fields(comments[-1].lstrip("#").strip(), separator) if comments else []
    if len(words) != len(fields):
        return _Header(assumed, separator, 0)
    return _Header(assumed, separator, 0, (
        f"the columns were read as {', '.join(assumed)}, because the comment "
        f"{quoted(comments[-1])} has no known names of columns",
    ))  # fmt: skip


def _numbers_of_first_line(line: str) -> tuple[list[str], str]:
    """Return the fields of a line of numbers, and what separates them.

    A comma is a separator, unless there is another one and it can be a decimal comma.
    """
    ways = {separator: _fields(line, separator) for separator in SEPARATORS}
    surest = next((separator for separator in (";", "\t") if len(ways[separator]) > 1), None)
    if surest is not None:
        return ways[surest], surest
    blanks = ways[" "]
    has_decimals = len(blanks) > 1 and any(map(_is_decimal, blanks))
    if has_decimals and all(_is_decimal(field) or is_number(field) for field in blanks):
        return blanks, " "
    separator = max(SEPARATORS, key=lambda candidate: len(ways[candidate]))
    return ways[separator], separator


def _names_of_sextractor(comments: Sequence[str]) -> tuple[str, ...]:
    """Return the names that numbered comments give the columns; none unless there are two."""
    matches = [match for comment in comments if (match := _NUMBERED.match(comment))]
    numbers = [int(match[1]) for match in matches]
    if (
        len(matches) < 2
        or numbers[0] != 1
        or numbers != sorted(set(numbers))
        or numbers[-1] > 10_000
    ):
        return ()
    names: list[str] = []
    for number, match in zip(numbers, matches, strict=True):
        # A column of several values takes several numbers, and has only one line.
        names += [f"{names[-1]}_{extra}" for extra in range(len(names) + 1, number)]
        names.append(match[2])
    return tuple(names)


def _fields(line: str, separator: str) -> list[str]:
    line = line.strip() if separator == " " else line
    fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    return [field.strip() for field in fields] or [""]


def _is_row(line: str) -> bool:
    """Return whether a line is numbers, in any separation."""
    words = [word for word in re.split(r"[\s,;|]+", line.replace('"', " ")) if word]
    return bool(words) and all(map(is_number, words))


def _is_decimal(text: str) -> bool:
    return _DECIMAL_COMMA.fullmatch(text) is not None


def _read_rows(rows: Sequence[tuple[int, str]], header: _Header, where: str) -> TextTable:
    names, separator = header.names, header.separator
    layout = columns_of_positions(names, f"{where}: has")
    twice = [name for name in (layout.x, layout.y, *layout.beside) if names.count(name) > 1]
    if twice:
        raise ConfigError(f"{where}: two columns are called {twice[0]}", hint="rename one of them")
    places = [names.index(name) for name in (layout.x, layout.y)]
    beside = [names.index(name) for name in layout.beside]
    frame = None if layout.frame is None else names.index(layout.frame)
    cells = [_fields(line, separator) for _, line in rows]
    long = [n for (n, _), row in zip(rows, cells, strict=True) if any(row[len(names) :])]
    if rows and len(long) == len(rows):
        raise ConfigError(
            f"{where}: line {long[0]} has {len(cells[0])} values for the {len(names)} columns "
            f"{listed(names)}",
            hint="name every column, and separate columns by semicolons if decimals have commas",
        )
    if separator == " ":
        short = [n for (n, _), row in zip(rows, cells, strict=True) if len(row) < len(names)]
        if short and len(names) > 2:
            raise ConfigError(
                f"{where}: line {short[0]} has fewer values than the {len(names)} columns "
                f"{listed(names)}",
                hint="write nan for a missing value",
            )
    has_points = any("." in row[index] for row in cells for index in places if index < len(row))
    with_commas = separator != "," and not has_points

    def number(row: Sequence[str], index: int, line: int) -> float:
        text = row[index] if index < len(row) else ""
        if with_commas and _is_decimal(text):
            text = text.replace(",", ".")
        if is_number(text):
            return float(text)
        if text.lower() not in _MISSING:
            raise ConfigError(
                f"{where}: line {line}: {names[index]} is {quoted(text)}; expected a number"
            )
        # A place that is empty is dropped by the matcher and reported, as NaN is.
        if index in beside or index < len(row):
            return np.nan
        raise ConfigError(
            f"{where}: line {line}: {names[index]} is missing; expected a number, or leave the "
            "line out"
        )

    indices = [*places, *beside]
    table = np.array(
        [
            [number(row, index, n) for index in indices]
            for (n, _), row in zip(rows, cells, strict=True)
        ],
        dtype=np.float64,
    ).reshape(-1, len(indices))
    remarks = (*header.remarks, *layout.remarks)
    if long:
        lines = listed([str(n) for n in long])
        remarks += (f"values beyond the {len(names)} columns are not used (line {lines})",)
    return TextTable(
        layout,
        {names[index]: table[:, column] for column, index in enumerate(indices)},
        None
        if frame is None
        else np.array([row[frame] if frame < len(row) else "" for row in cells]),
        remarks,
    )
