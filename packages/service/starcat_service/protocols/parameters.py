"""The parameters of a request to TAP: names in any case, values checked.

References
----------
DALI 1.1, section 3; TAP 1.1, section 2.7.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from starcat.errors import ConfigError, literal, quoted
from starcat.ship.exchange import Format, response_format

LANGUAGES = ("ADQL", "ADQL-2.0", "ADQL-2.1")

MAX_UPLOADS = 10

_RESULT = re.compile(r"https?://[^/?#]+(?:/[^?#]*)?/tap/async/([0-9a-f]{32})/results/result")
"""Address of an answer of the service, under any host name that the client uses."""

_TABLE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}", re.ASCII)


@dataclass(frozen=True)
class Upload:
    """A table that comes with a query."""

    table: str  # its name after TAP_UPLOAD.
    # Name of its part of the request; empty if it is an answer of the service.
    part: str = ""
    job_id: str = ""  # job whose answer it is; empty if it is a part of the request


@dataclass(frozen=True)
class TapQuestion:
    """The question of a request."""

    query: str
    form: Format
    max_rows: int
    uploads: tuple[Upload, ...] = ()
    run_id: str = ""  # the client's name for it


class Parameters:
    """Parameters of a request, in the order in which they came."""

    def __init__(self, pairs: Iterable[tuple[str, str]]) -> None:
        self._pairs = [(name.upper(), value) for name, value in pairs]

    def all(self, name: str) -> list[str]:
        """Return all values of a parameter that are not empty."""
        return [value for key, value in self._pairs if key == name and value != ""]

    def value(self, name: str) -> str | None:
        """Return the value of a parameter."""
        values = list(dict.fromkeys(self.all(name)))
        if len(values) > 1:
            raise ConfigError(
                f"{name} is given {len(values)} times: {quoted(values[0])} and {quoted(values[1])}",
                key=name,
                value=values[1],
                hint="give it once",
            )
        return values[0] if values else None

    def items(self) -> list[tuple[str, str]]:
        """Return names, in capitals, and values."""
        return list(self._pairs)


def parameter_error(key: str, value: str | None, advice: str) -> ConfigError:
    """Return the error of a value of a parameter."""
    return ConfigError(f"{key} is {quoted(value or '')}; {advice}", key=key, value=value)


def question(parameters: Parameters, most_rows: int) -> TapQuestion:
    """Return what a request asks."""
    request = parameters.value("REQUEST")
    if request not in (None, "doQuery"):
        raise parameter_error("REQUEST", request, "it may be doQuery only, or be left out")
    language = parameters.value("LANG")
    if language is not None and language.upper() not in LANGUAGES:
        raise parameter_error(
            "LANG", language, f"queries are written in one of {', '.join(LANGUAGES)}"
        )
    query = parameters.value("QUERY")
    if query is None:
        raise ConfigError(
            "QUERY is missing; it has the query in ADQL, such as SELECT * FROM tap_schema.tables",
            key="QUERY",
        )
    return TapQuestion(
        query,
        response_format(parameters.value("RESPONSEFORMAT") or parameters.value("FORMAT")),
        max_rows(parameters.value("MAXREC"), most_rows),
        uploads(parameters.all("UPLOAD")),
        parameters.value("RUNID") or "",
    )


def max_rows(text: str | None, most: int) -> int:
    """Return the number of requested rows."""
    if text is None:
        return most
    if not (text.isascii() and text.isdigit()):
        raise parameter_error("MAXREC", text, "it is a whole number from 0 on")
    return most if len(text) > len(str(most)) + 10 else min(int(text), most)


def uploads(values: list[str]) -> tuple[Upload, ...]:
    """Return the tables that a request uploads."""
    tables: list[Upload] = []
    for pair in (pair for value in values for pair in value.split(";") if pair.strip()):
        name, comma, location = (word.strip() for word in pair.partition(","))
        if not comma or not _TABLE_NAME.fullmatch(name):
            raise parameter_error(
                "UPLOAD",
                pair,
                "it is a name of letters, digits and underscores, a "
                "comma and param: with the name of a part of the request",
            )
        scheme, _, part = location.partition(":")
        result = _RESULT.fullmatch(location)
        is_part = scheme.lower() == "param" and part
        if not is_part and not result:
            raise ConfigError(
                f"UPLOAD of {name} is at {quoted(location)}",
                key="UPLOAD",
                value=location,
                hint="nothing is fetched from elsewhere: send the table in the request and write "
                f"{literal(name)},param:PART, or give the address of an answer of this service",
            )
        if name.lower() in [upload.table.lower() for upload in tables]:
            raise ConfigError(
                f"UPLOAD has {name} twice", key="UPLOAD", hint="give each its own name"
            )
        tables.append(Upload(name, part="" if result else part, job_id=result[1] if result else ""))
    if len(tables) > MAX_UPLOADS:
        raise ConfigError(
            f"UPLOAD has {len(tables)} tables; at most {MAX_UPLOADS} come with a query",
            key="UPLOAD",
        )
    return tuple(tables)
