"""The command that downloads catalogs: files of archives, and tables of TAP services."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from starcat.cli.console import progress_bars, say, show_result
from starcat.cli.options import Json
from starcat.cli.outputs import to_folder
from starcat.errors import count_of

if TYPE_CHECKING:
    from starcat.catalog.tap import Asked

app = typer.Typer()


@app.command("fetch")
def fetch(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE|tap:ADDRESS",
            help="A source that 'starcat sources' lists, or a TAP service.",
        ),
    ],
    output: Annotated[
        Path | None,
        to_folder("Where the files go; default: the download cache. TAP has no default."),
    ] = None,
    part: Annotated[
        list[str] | None, typer.Option("--part", help="Only this part. Repeatable.")
    ] = None,
    query: Annotated[str | None, typer.Option(help="ADQL for the TAP service.")] = None,
    table: Annotated[str | None, typer.Option(help="Table of the TAP service.")] = None,
    columns: Annotated[
        str | None,
        typer.Option("--source", metavar="MAP.toml", help="Map with the columns to request."),
    ] = None,
    limit_mag: Annotated[
        float | None, typer.Option(min=-30, max=40, help="Faintest magnitude, in the first band.")
    ] = None,
    strip_by: Annotated[
        str, typer.Option(help="Column of declinations in degrees, without a map.")
    ] = "dec",
    retries: Annotated[int, typer.Option(min=0, help="Further attempts per address.")] = 3,
    json: Json = False,
) -> None:
    """Download a catalog, check it, and record its digest.

    A table or query of a TAP service is read in strips of declination, counted and resumable.

    Example: starcat fetch tycho2
    """
    asked = _asked_of_tap(source, query, table, columns, limit_mag, strip_by)
    if asked is not None:
        _fetch_table(asked, output, retries, as_json=json)
        return
    from starcat.catalog.fetch import fetch_source
    from starcat.catalog.source import source_given
    from starcat.storage.cache import cache_folder

    with progress_bars() as progress:
        report = fetch_source(
            source_given(source), output or cache_folder(), parts=tuple(part or ()),
            retries=retries,
            progress=lambda name, done, total: progress(f"fetch {name}", done, total),
        )  # fmt: skip
    rows = [
        {name: getattr(file, name) for name in ("name", "status", "rows", "bytes", "sha256")}
        | {"path": str(file.path)}
        for file in report.files
    ]
    shown = ("name", "status", "rows", "bytes")
    show_result(rows, report.source, as_json=json, columns={"": shown})


def _asked_of_tap(
    source: str,
    query: str | None,
    table: str | None,
    columns: str | None,
    limit_mag: float | None,
    strip_by: str,
) -> Asked | None:
    """Return the request to a TAP service; None if the source is the files of an archive."""
    from starcat.catalog.source import source_given
    from starcat.catalog.tap import Asked
    from starcat.errors import ConfigError
    from starcat.storage.download import is_address

    kind, _, address = source.partition(":")
    if kind == "tap":
        table_map = source_given(columns).table if columns else None
    else:
        table_map = source_given(source).table
        remote = table_map.remote if table_map else None
        if remote is None or not remote.tap:
            for name, value in (("query", query), ("table", table), ("limit-mag", limit_mag)):
                if value is not None:
                    raise ConfigError(
                        f"--{name} is for a TAP service", hint="write 'starcat fetch tap:ADDRESS'"
                    )
            return None
        address, table = remote.tap, table or remote.table
        say(f"note: {source}: {remote.checked}")
    if not is_address(address, "TAP service") or (query is None) == (table is None):
        raise ConfigError(
            "a TAP service needs its address and one of --query and --table",
            key="query",
            hint="write 'starcat fetch tap:https://HOST/tap -o DIR --table NAME', best with "
            "--source MAP.toml and --limit-mag",
        )
    if limit_mag is not None and (table_map is None or query is not None):
        raise ConfigError(
            "--limit-mag needs the map of a --table",
            key="limit_mag",
            hint="write the limit into the --query, or give --source MAP.toml and --table",
        )
    return Asked(address.rstrip("/"), table or "", query or "", table_map, limit_mag, strip_by)


def _fetch_table(asked: Asked, output: Path | None, retries: int, *, as_json: bool) -> None:
    from starcat.catalog.tap import fetch_table
    from starcat.errors import ConfigError
    from starcat.storage.download import DownloadOptions

    if output is None:
        raise ConfigError(
            "a table of a TAP service needs a folder", key="output", hint="name it with --output"
        )
    with progress_bars() as progress:
        report = fetch_table(asked, output, DownloadOptions(retries=retries), progress)
    facts = {"folder": str(output), "status": report.status, **report.account.model_dump()}
    shown = ("first_deg", "end_deg", "rows", "file")
    columns = {"": ("folder", "status", "rows"), "strips": shown}
    show_result(facts, asked.service, as_json=as_json, columns=columns)
    if not as_json:
        say(f"{report.status}: {output}: {count_of(report.account.rows, 'row')}")
