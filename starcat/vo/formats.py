"""Formats of answers, by the names that TAP gives them."""

from __future__ import annotations

from dataclasses import dataclass

from starcat.errors import ConfigError, quoted


@dataclass(frozen=True)
class Format:
    """A format of an answer.

    Attributes
    ----------
    name : str
        The short name, and the first of its aliases.
    media_type : str
        As the answer is labelled.
    aliases : tuple of str
        Other values of RESPONSEFORMAT that mean it, lower case and without spaces.
    suffix : str
        End of the name of a file of it.
    standard_id : str
        Identifier of TAPRegExt, where it has one.
    """

    name: str
    media_type: str
    aliases: tuple[str, ...]
    suffix: str
    standard_id: str = ""

    @property
    def is_votable(self) -> bool:
        """Whether it is a VOTable, which can say that rows were left out."""
        return self.suffix == "vot"


_OUTPUT = "ivo://ivoa.net/std/TAPRegExt#output-votable-"

FORMATS = (
    Format(
        "votable",
        "application/x-votable+xml;serialization=binary2",
        (
            "application/x-votable+xml", "text/xml", "votable/b2", "votable/binary2",
            "application/x-votable+xml;serialization=binary2;content=votable",
        ),
        "vot", f"{_OUTPUT}binary2",
    ),
    Format(
        "votable/td",
        "application/x-votable+xml;serialization=tabledata",
        ("votable/tabledata",),
        "vot", f"{_OUTPUT}td",
    ),
    Format("fits", "application/fits", ("image/fits",), "fits"),
    Format("csv", "text/csv;header=present", ("text/csv",), "csv"),
    Format("tsv", "text/tab-separated-values", (), "tsv"),
    Format("json", "application/json", (), "json"),
    Format(
        "parquet", "application/vnd.apache.parquet",
        ("application/x-parquet", "application/parquet"), "parquet",
    ),
)  # fmt: skip
"""What answers may be written in; the first is that of questions that name none."""


def format_named(text: str | None) -> Format:
    """Return the format that a request asks for.

    Examples
    --------
    >>> format_named("text/csv; header=present").name
    'csv'
    """
    wanted = "".join((text or "votable").lower().split()).replace('"', "")
    # The plus of a media type that nobody has escaped in an address arrives as a blank.
    wanted = wanted.replace("x-votablexml", "x-votable+xml")
    for one in FORMATS:
        if wanted in (one.name, one.media_type, *one.aliases):
            return one
    known = ", ".join(one.name for one in FORMATS)
    raise ConfigError(
        f"RESPONSEFORMAT {quoted(text or '')} is not known; choose one of {known}",
        key="RESPONSEFORMAT",
        value=text,
    )
