"""Download a table from a TAP service into a folder of Parquet files, by strips of declination.

The service first counts the rows of every strip. A strip with another number of rows is an error;
a strip that the service truncates is halved. Rows are sorted by all their values, so that the
same rows give the same files. The folder gets its name when all strips are there and their numbers
add up; until then it is a hidden folder with an account, from which a later run continues.

pyvo communicates with the service. `Asked` states the table, columns and rows to download.
"""

from __future__ import annotations

import math
import re
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal
from xml.parsers.expat import ExpatError

import pyarrow as pa
import requests
from pydantic import BaseModel, ConfigDict, ValidationError
from requests.adapters import HTTPAdapter
from urllib3.util import Retry

from starcat.catalog.archives.mapped import understand
from starcat.catalog.readers.tables import ANY, OpenTable, open_table
from starcat.catalog.source import RecordFile
from starcat.catalog.source_files import InputFile
from starcat.catalog.table_map import AnyMap
from starcat.errors import ConfigError, DownloadError, OutputError, ParseError, literal
from starcat.progress import Progress, no_progress
from starcat.storage.atomic import file_sha256, json_bytes, locked, whole_file, writing
from starcat.storage.download import DownloadOptions, download, forget_part, part_of
from starcat.storage.parquet import write_table

ACCOUNT_NAME = "fetched.json"
STRIP_ROWS = 500_000
"""Most rows of a strip; less if the service returns fewer rows at a time."""

MIN_WIDTH_DEG = 1e-4
LONGEST_JOB_S = 4 * 3600.0
_POLL_S = (0.1, 10.0)  # wait between two requests for the state of a job: first and longest
_REGULAR = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_WORDS = (
    *("date", "day", "first", "hour", "key", "last", "level", "max", "min", "minute", "month"),
    *("order", "point", "position", "section", "size", "second", "time", "timestamp", "user"),
    *("value", "year", "zone"),
)
_STATUS = re.compile(rb"<INFO\b[^>]*QUERY_STATUS[^>]*value=.(ERROR|OVERFLOW)[^>]*>([^<]{0,500})")
_STATUS_BYTES = 1 << 16


@dataclass(frozen=True)
class Asked:
    """A request for the rows of a TAP service."""

    service: str  # address
    table: str = ""  # table name for FROM
    query: str = ""  # a whole query instead of a table
    map: AnyMap | None = None  # request only the columns of this map; None: all columns
    limit_mag: float | None = None  # limit in the first band of the map
    strip_by: str = "dec"  # column in degrees, -90 to 90; a map's own declination replaces it


class Strip(BaseModel):
    """Rows between two declinations."""

    model_config = ConfigDict(extra="forbid")

    first_deg: float  # included
    end_deg: float  # included only at the pole
    rows: int = 0  # number of rows according to the service
    file: str | None = None  # name of its file in the folder, after download
    sha256: str | None = None


class Account(BaseModel):
    """The request, and the strips downloaded so far."""

    model_config = ConfigDict(extra="forbid")

    service: str
    query: str  # query without the limits of strips
    strip_by: str
    rows: int = 0  # number of rows in all strips
    strips: list[Strip] = []


@dataclass(frozen=True)
class TapReport:
    """What `fetch_table` did."""

    folder: Path
    status: Literal["fetched", "resumed", "present"]
    account: Account


def fetch_table(
    asked: Asked,
    folder: Path,
    options: DownloadOptions | None = None,
    progress: Progress = no_progress,
) -> TapReport:
    """Download the requested rows into a folder, or continue an earlier run."""
    work = folder.absolute().parent / f".{folder.name}.fetch"
    with writing(folder.parent, "finished strips are kept: make space, and run the same again"):
        work.mkdir(parents=True, exist_ok=True)
        with locked(work):
            fetch = _Fetch(asked, work, options or DownloadOptions(), progress)
            try:
                status = fetch.run(folder)
            finally:
                with suppress(OSError):  # nothing was downloaded, or the folder has been renamed
                    work.rmdir()
    return TapReport(folder, status, fetch.account)


class _Truncated(Exception):  # noqa: N818 - the strip is halved
    """The service reports that it left rows out."""


class _Fetch:
    """A fetch into a hidden folder."""

    account: Account

    def __init__(
        self, asked: Asked, work: Path, options: DownloadOptions, progress: Progress
    ) -> None:
        from pyvo.dal import TAPService

        self.asked, self.work, self.options, self.progress = asked, work, options, progress
        self.service = TAPService(asked.service, session=_Session(options))
        self.most = min(STRIP_ROWS, _hard_limit(asked.service, self.service) or STRIP_ROWS)
        query = asked.query.strip().rstrip(";")
        self.table = f"({query}) AS asked" if query else asked.table
        self.columns, self.limit = "*", ""

    def run(self, final: Path) -> Literal["fetched", "resumed", "present"]:
        """Download missing strips, check the number of rows, and rename the folder."""
        requested = self._understood()
        if final.exists():
            self.account = _account_in(final, requested)
            lost = [strip.file for strip in self.account.strips if not _is_there(strip, final)]
            if lost:
                raise OutputError(f"{lost[0]} is damaged", where=final, hint="remove the folder")
            return "present"
        is_begun = (self.work / ACCOUNT_NAME).is_file()
        self.account = _account_in(self.work, requested) if is_begun else requested
        if not is_begun:
            self._plan()
        had = any(strip.file and _is_there(strip, self.work) for strip in self.account.strips)
        self._bring_all()
        self._check_sum()
        self.work.rename(final)
        return "resumed" if had else "fetched"

    def _understood(self) -> Account:
        """Return the account of the request, before rows are counted."""
        asked, column = self.asked, self.asked.strip_by
        opened = self._ask(f"SELECT TOP 1 * FROM {self.table}")
        if asked.map is not None:
            understood = understand(asked.map, opened.columns, asked.table or "the answer")
            dec_key, mag_key = asked.map.asked_by
            dec, band = understood.get(dec_key), understood.get(mag_key)
            if dec is not None:
                column = dec.columns[0] if dec.is_column and dec.unit == "deg" else ""
            names = dict.fromkeys(name for entry in understood.values() for name in entry.columns)
            self.columns = ", ".join(map(_quoted, names))
            if asked.limit_mag is not None:
                if band is None or not band.is_column or band.unit != "mag":
                    raise ConfigError(
                        f"{mag_key.partition('.')[2] or 'remote.limit_by'} of the map is not a "
                        "column of magnitudes",
                        parameter="limit_mag",
                        hint="write the limit into a {query}",
                    )
                self.limit = f" WHERE {_quoted(band.columns[0])} <= {asked.limit_mag!r}"
        declination = opened.columns.get(column)
        if declination is None or declination.is_text:
            raise ConfigError(
                f"no column of declinations in degrees; the answer "
                f"has {', '.join(list(opened.columns)[:40])}",
                where=column or "dec of the map",
                hint="Name one with {strip_by}",
            )
        query = f"SELECT {self.columns} FROM {self.table}{self.limit}"
        return Account(service=asked.service, query=query, strip_by=_quoted(column))

    def _plan(self) -> None:
        """Count all rows, and the rows of strips of equal area."""
        rows = self.account.rows = self._count()
        if not rows:
            raise DownloadError(
                f"no row for {self.account.query!r}", where=self.asked.service, hint="ask for more"
            )
        number = -(-rows // self.most)
        edges = [math.degrees(math.asin(2 * k / number - 1)) for k in range(number + 1)]
        for first, end in pairwise(round(edge, 6) for edge in edges):
            self.account.strips += self._counted(first, end)
        self._check_sum()
        self._note()

    def _counted(self, first: float, end: float) -> list[Strip]:
        """Return a strip with its number of rows, or its halves if it has too many."""
        strip = Strip(first_deg=first, end_deg=end)
        strip.rows = self._count(strip)
        return [strip] if strip.rows <= self.most else self._halves(strip)

    def _halves(self, strip: Strip) -> list[Strip]:
        middle = round((strip.first_deg + strip.end_deg) / 2, 6)
        if strip.end_deg - strip.first_deg < MIN_WIDTH_DEG:
            raise DownloadError(
                f"{strip.rows:,} rows lie between declinations "
                f"{strip.first_deg} and {strip.end_deg}, more than the service gives at a time",
                where=self.asked.service,
                hint="ask for fewer with {limit_mag} or {query}",
            )
        return self._counted(strip.first_deg, middle) + self._counted(middle, strip.end_deg)

    def _count(self, strip: Strip | None = None) -> int:
        opened = self._ask(f"SELECT COUNT(*) AS n_rows FROM {self.table}{self._where(strip)}")
        rows = next(opened.rows(list(opened.columns)), None)
        counted = rows.table.column(0)[0].as_py() if rows and len(rows.table) else None
        if not isinstance(counted, int):
            raise DownloadError(f"COUNT(*) gives {counted!r}, no number", where=self.asked.service)
        return counted

    def _where(self, strip: Strip | None) -> str:
        if strip is None:
            return self.limit
        column, last = self.account.strip_by, "<=" if strip.end_deg >= 90.0 else "<"
        word = "AND" if self.limit else "WHERE"
        within = f"{column} >= {strip.first_deg:.6f} AND {column} {last} {strip.end_deg:.6f}"
        return f"{self.limit} {word} {within}"

    def _bring_all(self) -> None:
        strips, name, index = self.account.strips, self.work.name[1:].removesuffix(".fetch"), 0
        while index < len(strips):
            try:
                if not _is_there(strips[index], self.work):
                    self._bring(strips[index])
            except _Truncated:
                strips[index : index + 1] = self._halves(strips[index])
                self._check_sum()
                self._note()
                continue
            index += 1
            rows = sum(strip.rows for strip in strips[:index])
            self.progress(f"rows {name}", rows, self.account.rows)

    def _bring(self, strip: Strip) -> None:
        query = f"SELECT {self.columns} FROM {self.table}{self._where(strip)}"
        table = _as_arrow(self._ask(query, strip.rows + 1))
        if len(table) != strip.rows:
            raise DownloadError(
                f"{strip.rows:,} rows are counted between declinations "
                f"{strip.first_deg} and {strip.end_deg}, but {len(table):,} came; the table "
                "changes, or the service leaves rows out. Run the same again",
                where=self.asked.service,
                hint=f"if it stays so, remove {literal(self.work)} and begin again",
            )
        strip.file = f"strip{strip.first_deg:+011.6f}.parquet"
        keys = [(name, "ascending") for name in table.column_names]
        write_table(table.sort_by(keys), self.work / strip.file)
        strip.sha256 = file_sha256(self.work / strip.file)
        self._note()

    def _check_sum(self) -> None:
        rows = sum(strip.rows for strip in self.account.strips)
        if rows != self.account.rows:
            raise DownloadError(
                f"{self.account.rows:,} rows are counted, but {rows:,} by "
                f"declination; the others have no {self.account.strip_by} from -90 to 90, or the "
                "table changes",
                where=self.asked.service,
                hint=(
                    "Leave them out with a {query}",
                    f"remove {literal(self.work)} and begin again",
                ),
            )

    def _note(self) -> None:
        with whole_file(self.work / ACCOUNT_NAME) as partial:
            partial.write_bytes(json_bytes(self.account.model_dump()))

    def _ask(self, query: str, maxrec: int | None = None) -> OpenTable:
        """Run a query as a job, and read the VOTable with its result."""
        path = self.work / "answer.vot.gz"  # the service decides whether it is compressed
        try:
            return self._answer(query, path, maxrec)
        finally:
            forget_part(path)

    def _answer(self, query: str, path: Path, maxrec: int | None) -> OpenTable:
        with _tap_errors(self.asked.service, query):
            with self.service.submit_job(query, maxrec=maxrec) as job:
                job.run()
                _wait_for(job)
                job.raise_if_error()
                uri = str(job.result_uri)
                if not uri.startswith(("http://", "https://")):
                    raise DownloadError(f"the address of the result is {uri[:200]!r}")
                download(uri, path, self.options)
            part = part_of(path)
            _check_status(part)
            layout = RecordFile(name="answer", file_names=(path.name,), layout="table", table=ANY)
            opened = open_table(InputFile(part, layout, "tap"))
            if opened.form != "VOTable":
                raise DownloadError(f"the answer is {opened.form}, not a VOTable")
        return opened


def _is_there(strip: Strip, folder: Path) -> bool:
    """Return whether a strip was downloaded and is unchanged; a strip without rows has no file."""
    path = folder / (strip.file or "")
    return not strip.rows or (path.is_file() and file_sha256(path) == strip.sha256)


def _account_in(folder: Path, requested: Account) -> Account:
    """Read the account of a fetch; raise if it belongs to another query."""
    path = folder / ACCOUNT_NAME
    try:
        account = Account.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise OutputError(
            f"is there, and has no account of a fetch ({ACCOUNT_NAME})",
            where=folder,
            hint="choose another {output}",
        ) from error
    if (account.service, account.query, account.strip_by) != (
        requested.service, requested.query, requested.strip_by,
    ):  # fmt: skip
        raise OutputError(
            f"holds what another query gave ({account.query!r} of {account.service})",
            where=folder,
            hint=("choose another {output}", "remove it"),
        )
    return account


def _as_arrow(opened: OpenTable) -> pa.Table:
    """Return the rows of an answer with the units, UCDs and descriptions of the columns."""
    parts = [rows.table for rows in opened.rows(list(opened.columns))]
    if not parts:
        return pa.table({name: [] for name in opened.columns})
    table = pa.concat_tables(parts)
    fields = []
    for field in table.schema:
        column = opened.columns[field.name]
        facts = {"unit": column.unit, "ucd": column.ucd, "description": column.description}
        fields.append(field.with_metadata({key: text for key, text in facts.items() if text}))
    return pa.Table.from_arrays(table.columns, schema=pa.schema(fields))


def _quoted(name: str) -> str:
    """Return the name of a column for ADQL, quoted if needed."""
    is_plain = _REGULAR.fullmatch(name) and name.lower() not in _WORDS
    return name if is_plain else '"' + name.replace('"', '""') + '"'


def _check_status(path: Path) -> None:
    """Raise if a VOTable reports that the query failed, or that rows were left out."""
    with path.open("rb") as file:
        head = file.read(_STATUS_BYTES)
        file.seek(max(0, path.stat().st_size - _STATUS_BYTES))
        status = dict(_STATUS.findall(head + file.read()))
    if b"ERROR" in status:
        raise DownloadError(f"the query failed: {status[b'ERROR'].decode(errors='replace')}")
    if b"OVERFLOW" in status:
        raise _Truncated


def _wait_for(job: Any) -> None:
    """Wait until a job has ended, with or without success."""
    pause_s, most_s = _POLL_S
    end = time.monotonic() + LONGEST_JOB_S
    while (phase := job.phase) not in ("COMPLETED", "ERROR", "ABORTED"):
        if phase in ("HELD", "SUSPENDED", "ARCHIVED") or time.monotonic() > end:
            raise DownloadError(f"the job is {phase} and does not end")
        time.sleep(pause_s)
        pause_s = min(1.5 * pause_s, most_s)


class _Session(requests.Session):
    """HTTP requests with a time limit, repeated if the service is busy."""

    def __init__(self, options: DownloadOptions) -> None:
        super().__init__()
        self.timeout_s = options.timeout_s
        again = Retry(
            total=options.retries, backoff_factor=options.backoff_s, allowed_methods=None,
            status_forcelist=(408, 429, 500, 502, 503, 504), raise_on_status=False,
        )  # fmt: skip
        for scheme in ("http://", "https://"):
            self.mount(scheme, HTTPAdapter(max_retries=again))

    def request(self, *args: Any, **how: Any) -> requests.Response:
        """Send a request."""
        return super().request(*args, **{"timeout": self.timeout_s, **how})


def _hard_limit(address: str, service: Any) -> int | None:
    """Return the largest number of rows that a service returns, or None if it states none."""
    with _tap_errors(address, "its capabilities"):
        limits = service.get_tap_capability().outputlimit
    content = limits and limits.hard and limits.hard.content
    return int(content) if content else None


@contextmanager
def _tap_errors(service: str, query: str) -> Iterator[None]:
    """Convert errors of the service or of pyvo about a query to errors of starcat."""
    from pyvo.dal.exceptions import DALAccessError, DALQueryError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (_Truncated, OutputError):
        raise
    except DALQueryError as error:
        text = " ".join(str(error).split())[:600]
        raise DownloadError(f"refuses {query!r}: {text}", where=service) from error
    except DownloadError as error:
        raise DownloadError(f"{error} (asked for {query!r})", where=service) from error
    except (*_NO_TAP, DALAccessError) as error:
        text = " ".join(str(error).partition("This could mean")[0].split())[:300]
        text = text or type(error).__name__
        raise DownloadError(
            f"does not answer as a TAP service does when asked for {query!r} ({text})",
            where=service,
            hint="give the address of the service, without /sync, or try again later",
        ) from error


_NO_TAP = (
    *(requests.RequestException, ExpatError, ParseError, OSError, ValueError, TypeError),
    *(AttributeError, IndexError, KeyError, EOFError),
)
