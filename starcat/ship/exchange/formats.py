"""The formats for writing tables: one list for commands, requests, TAP and pages.

`starcat.ship.exchange.writers` writes them. This module imports only the standard library.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from starcat.errors import ConfigError, quoted

PageFormat = Literal["csv", "json", "parquet", "votable", "fits", "ecsv"]
FileFormat = Literal[PageFormat, "npz"]


@dataclass(frozen=True)
class Format:
    """A format of a table."""

    name: str
    title: str  # name on pages
    suffixes: tuple[str, ...]  # suffixes of files, with the dot; the usual one first
    media_type: str  # media type of a file
    is_text: bool = False  # True if it may be printed on a terminal
    has_units: bool = True  # True if a file states the units and meanings of its columns
    tap_type: str = ""  # media type of an answer of TAP; empty if TAP does not offer it
    aliases: tuple[str, ...] = ()  # other values of RESPONSEFORMAT, lower case, without spaces
    standard_id: str = ""  # identifier of TAPRegExt

    @property
    def suffix(self) -> str:
        """The usual suffix, with the dot."""
        return self.suffixes[0]

    @property
    def is_votable(self) -> bool:
        """Whether it is a VOTable, which can state that rows were left out."""
        return self.suffix == ".vot"


_VOTABLE = "application/x-votable+xml"
_VOTABLE_ID = "ivo://ivoa.net/std/TAPRegExt#output-votable-"

FORMATS = {
    table_format.name: table_format
    for table_format in (
        Format(
            "csv", "CSV", (".csv",), "text/csv; charset=utf-8",
            is_text=True, has_units=False,
            tap_type="text/csv;header=present", aliases=("text/csv",),
        ),
        Format(
            "json", "JSON", (".json",), "application/json",
            is_text=True, tap_type="application/json",
        ),
        Format(
            "parquet", "Parquet", (".parquet",), "application/vnd.apache.parquet",
            tap_type="application/vnd.apache.parquet",
            aliases=("application/x-parquet", "application/parquet"),
        ),
        # Files have rows as text, which every tool reads; answers of TAP have BINARY2.
        Format(
            "votable", "VOTable", (".vot", ".xml"), _VOTABLE,
            tap_type=f"{_VOTABLE};serialization=binary2",
            aliases=(
                _VOTABLE, "text/xml", "votable/b2", "votable/binary2",
                f"{_VOTABLE};serialization=binary2;content=votable",
            ),
            standard_id=f"{_VOTABLE_ID}binary2",
        ),
        Format(
            "fits", "FITS", (".fits",), "application/fits",
            tap_type="application/fits", aliases=("image/fits",),
        ),
        Format("ecsv", "ECSV", (".ecsv",), "text/plain; charset=utf-8"),
        Format("npz", "npz", (".npz",), "application/octet-stream", has_units=False),
        Format(
            "votable/td", "VOTable", (".vot",), _VOTABLE,
            tap_type=f"{_VOTABLE};serialization=tabledata",
            aliases=("votable/tabledata",), standard_id=f"{_VOTABLE_ID}td",
        ),
        Format(
            "tsv", "TSV", (".tsv",), "text/tab-separated-values",
            has_units=False, tap_type="text/tab-separated-values",
        ),
    )
}  # fmt: skip
"""All formats by name."""

FILE_FORMATS: tuple[FileFormat, ...] = get_args(FileFormat)
WHOLE_FORMATS = ("fits", "ecsv", "npz")
"""Formats for which the whole table must be in memory."""

PAGE_FORMATS: tuple[PageFormat, ...] = get_args(PageFormat)
TEXT_FORMATS = tuple(name for name in FILE_FORMATS if FORMATS[name].is_text)
EXPORT_FORMATS = (*FILE_FORMATS, "hats")
ONBOARD_FORMATS = ("onboard", "c")
SOLVER_FORMATS = ("tetra3", "cedar-solve", "tetra3rs", "lost", "astrometry-net", "astap")

TAP_FORMATS = tuple(
    FORMATS[name] for name in ("votable", "votable/td", "fits", "csv", "tsv", "json", "parquet")
)
"""Formats of TAP answers; the first is the default."""


def format_of(path: str | Path) -> FileFormat:
    """Return the format for the suffix of a file's name (upper or lower case)."""
    file_format = suffix_format(path)
    if file_format is not None:
        return file_format
    choices = ", ".join(suffix for name in FILE_FORMATS for suffix in FORMATS[name].suffixes)
    raise ConfigError(
        "the suffix is of no format that starcat writes",
        where=path,
        value=str(path),
        hint=f"end it with one of {choices}",
    )


def suffix_format(path: str | Path) -> FileFormat | None:
    """Return the format for the suffix of a file's name (upper or lower case), or None.

    Examples
    --------
    >>> suffix_format("stars.FITS"), suffix_format("dist/cube-1.0.0")
    ('fits', None)
    """
    suffix = Path(path).suffix.lower()
    return next((name for name in FILE_FORMATS if suffix in FORMATS[name].suffixes), None)


def expect_parquet(path: Path) -> None:
    """Refuse another suffix for a file that is written as Parquet."""
    if path.suffix.lower() not in FORMATS["parquet"].suffixes:
        raise ConfigError(
            "this file is written as Parquet",
            where=path,
            key="output",
            value=str(path),
            hint="end its name with .parquet, and convert it to another format with 'starcat "
            "sql' or 'starcat export'",
        )


def response_format(text: str | None) -> Format:
    """Return the format for RESPONSEFORMAT of TAP, a name or media type."""
    requested = "".join((text or "votable").lower().split()).replace('"', "")
    # A plus sign that was not escaped in the address arrives as a blank.
    requested = requested.replace("x-votablexml", "x-votable+xml")
    for tap_format in TAP_FORMATS:
        if requested in (tap_format.name, tap_format.tap_type, *tap_format.aliases):
            return tap_format
    choices = ", ".join(tap_format.name for tap_format in TAP_FORMATS)
    raise ConfigError(
        f"RESPONSEFORMAT {quoted(text or '')} is unknown",
        key="RESPONSEFORMAT",
        value=text,
        hint=f"choose one of {choices}",
    )
