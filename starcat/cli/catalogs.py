"""Commands about catalogs: sources, ingest, crossmatch, and their tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.cli.console import print_json, print_table, progress_bars, say, show, show_result
from starcat.cli.options import Json, OwnSources, Scheduler, Workers, inputs_by_source
from starcat.cli.outputs import Replace, expect_free, to_either, to_file
from starcat.errors import SourceError, count_of
from starcat.results import plain, to_dict

if TYPE_CHECKING:
    from starcat.catalog.ingest import Ingested
    from starcat.catalog.store.ingest import Stored

app = typer.Typer()


@app.command("sources")
def sources(
    file: Annotated[
        Path | None, typer.Argument(help="A table of your own, for --check or --draft.")
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option(metavar="MAP.toml", help="Show how this map reads the table FILE."),
    ] = None,
    draft: Annotated[
        bool, typer.Option("--draft", help="Propose a map for the table FILE.")
    ] = False,
    json: Json = False,
) -> None:
    """List the catalogs that starcat can read, and the place from which each would be read.

    --draft proposes a map that makes a table of your own a source; --check checks such a map.

    Example: starcat sources
    """
    if check is not None or draft or file is not None:
        _about_table(file, check, draft=draft, as_json=json)
        return
    facts = source_facts()
    show(json, facts, _print_sources, facts)


ToFormat = Annotated[
    str, typer.Option(help="parquet: one file; hats: a store of any size, by Dask.")
]
EpochJyear = Annotated[
    float | None,
    typer.Option(min=1800, max=2200, help="Julian year to move positions to; default: no move."),
]
ReadLimitMag = Annotated[
    float | None, typer.Option(min=-30, max=40, help="Count fainter records, without listing them.")
]
MemoryGib = Annotated[
    float, typer.Option("--memory", min=0.1, help="Memory of all processes together, GiB (hats).")
]
PartitionRows = Annotated[int, typer.Option(min=1, help="Most stars in a partition (hats).")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue an interrupted run (hats).")]


@app.command("ingest")
def ingest_command(
    output: Annotated[Path, to_either("Where the Parquet file, or the folder for hats, goes.")],
    source: Annotated[
        str | None, typer.Argument(help="A star catalog, such as sao; default: from --source.")
    ] = None,
    sources: OwnSources = None,
    inputs: Annotated[
        list[str] | None,
        typer.Option(
            "--input",
            metavar="[SOURCE=]PATH",
            help="File, folder or address (HATS) of the catalog. Repeatable.",
        ),
    ] = None,
    to: ToFormat = "parquet",
    merge: Annotated[
        list[str] | None,
        typer.Option(help="A catalog that adds the stars missing in the others. Repeatable."),
    ] = None,
    epoch_jyear: EpochJyear = None,
    band: Annotated[str | None, typer.Option(help="Band of the magnitudes.")] = None,
    read_limit_mag: ReadLimitMag = None,
    workers: Workers = 2,
    scheduler: Scheduler = None,
    memory_gib: MemoryGib = 2.0,
    max_partition_rows: PartitionRows = 500_000,
    resume: Resume = False,
    replace: Replace = False,
    json: Json = False,
) -> None:
    """Read a catalog into a star table (Parquet) or a store (HATS), with reasons for rejected rows.

    Example: starcat ingest sao --input sao.dat.gz -o sao.parquet --epoch-jyear 2026.0
    """
    from starcat.catalog.source_files import locate
    from starcat.catalog.stars.verdict import rejected_path
    from starcat.catalog.store.plan import StoreOptions
    from starcat.catalog.store.reading import brought
    from starcat.errors import ConfigError
    from starcat.ship.exchange.formats import expect_parquet

    if to not in ("parquet", "hats") or (merge and to != "parquet"):
        advice = "several catalogs become one Parquet file" if merge else "choose parquet or hats"
        raise ConfigError(f"--to {to}: {advice}", key="to", value=to)
    source = _one_source(source, sources)
    paths_by_source = inputs_by_source(inputs, None if merge else source)
    how: Any = {"band": band, "epoch_jyear": epoch_jyear, "read_limit_mag": read_limit_mag}
    if to == "parquet":
        expect_parquet(output)
        expect_free(output, replace=replace)
        read = _read_to_file([source, *(merge or [])], paths_by_source, output, workers, **how)
        beside = rejected_path(output) if len(read.rejected) else None
        record = {**to_dict(read), "stars": str(output), "rejected_rows": plain(beside)}
        wrote = f"wrote {output}{f' and {beside.name}' if beside else ''}"
        _show_ingested(read, record, wrote, as_json=json)
        return
    from starcat.catalog.store.ingest import ingest_to_store

    options = StoreOptions(
        max_partition_rows=max_partition_rows, memory_bytes=int(memory_gib * 2**30),
        workers=workers, scheduler=scheduler, resume=resume, replace=replace,
    )  # fmt: skip
    with progress_bars() as progress:
        paths = brought(source, locate(source, paths_by_source), **how, progress=progress)
        stored = ingest_to_store(source, paths, output, **how, options=options, progress=progress)
    wrote = f"{stored.outcome} {stored.folder}: {count_of(stored.partitions, 'partition')}"
    _show_ingested(stored, to_dict(stored), wrote, as_json=json)


def _show_ingested(
    result: Ingested | Stored, record: dict[str, Any], wrote: str, *, as_json: bool
) -> None:
    """Print how many records of a catalog were kept, and rejected by reason."""
    from starcat.pipeline.selection.ruleset import ALL_REASONS

    for note in result.notes:
        say(f"note: {note}")
    if not as_json:
        rejected = record["rejected"].items()
        record["rejected"] = [
            {"reason": name, "records": count, "meaning": ALL_REASONS[name]}
            for name, count in rejected
        ]
    shown = ("source", "band", "rows_read", "kept")
    show_result(record, as_json=as_json, columns={"": shown, "files": ()})
    if not as_json:
        print_problems(result.problems)
        say(wrote)


def _read_to_file(
    names: Sequence[str],
    paths_by_source: Mapping[str, Sequence[Path]],
    output: Path,
    workers: int,
    **how: Any,
) -> Ingested:
    """Read one catalog, or several merged catalogs, into a Parquet file."""
    from starcat.catalog.ingest import write_star_tables
    from starcat.catalog.source_files import locate
    from starcat.database.products.crossmatch import Crossmatch
    from starcat.pipeline.merging import merged_catalog
    from starcat.pipeline.reading import read_all

    paths = {name: locate(name, paths_by_source) for name in names}
    with progress_bars() as progress:
        catalogs = read_all(names, paths, workers=workers, **how, progress=progress)
        progress("merge", 0, None)
        read = merged_catalog(catalogs, Crossmatch(), workers)
        write_star_tables(read, output)
    return read


def _one_source(name: str | None, maps: Sequence[Path] | None) -> str:
    """Return the source of a command: the named source, or the source of the first map."""
    from starcat.catalog.source import give_map, source_given
    from starcat.errors import ConfigError

    map_names = [give_map(path).name for path in maps or ()]
    if name is None and not map_names:
        raise ConfigError(
            "no source", key="source", hint="name one, such as sao, or a map with --source"
        )
    return map_names[0] if name is None else source_given(name).name


@app.command("crossmatch")
def crossmatch_command(
    a: Annotated[Path, typer.Argument(metavar="A", help="Star table (Parquet).")],
    b: Annotated[Path, typer.Argument(metavar="B", help="The same, with the counterparts.")],
    output: Annotated[Path, to_file("Where the counterparts go; the suffix selects the format.")],
    radius_arcsec: Annotated[
        float, typer.Option(min=0.001, max=600, help="Largest separation.")
    ] = 10.0,
    replace: Replace = False,
    json: Json = False,
) -> None:
    """Find the counterparts of stars in another catalog by position, epoch and magnitude.

    Every candidate is written with its odds. The verdicts state how certain the likeliest one is.
    For two catalog stores of any size use LSDB, or crossmatch() of 'starcat sql'.

    Example: starcat crossmatch sao.parquet gaia.parquet -o sao_gaia.parquet
    """
    from starcat.database.products.crossmatch import Crossmatch
    from starcat.pipeline.counterparts import match_files
    from starcat.ship.exchange.formats import format_of
    from starcat.ship.exchange.writers import write_batches

    form = format_of(output)
    expect_free(output, replace=replace)
    table, summary = match_files(a, b, Crossmatch(radius_arcsec=radius_arcsec))
    write_batches(table.to_reader(), output, form)
    names = {"a": a.stem, "b": b.stem}
    facts = {**names, **to_dict(summary), "output": str(output)}
    show_result(facts, as_json=json)
    if not json:
        say(f"wrote {output}")


def source_facts() -> list[dict[str, Any]]:
    """Return the facts about each catalog, with the place from which it would be read."""
    from starcat.catalog.source import data_source, source_names
    from starcat.catalog.source_files import locate

    names = ("name", "kind", "identifier", "rows", "bands", "epoch_jyear", "licence", "citation")
    records: list[dict[str, Any]] = []
    for name in source_names():
        source = data_source(name)
        try:
            locations = ", ".join(str(path) for path in locate(name, {}))
        except SourceError:
            locations = ""
        facts = {fact: getattr(source, fact) for fact in names}
        records.append({**facts, "found_at": locations or None})
    return records


def _about_table(file: Path | None, check: Path | None, *, draft: bool, as_json: bool) -> None:
    from starcat.catalog.source import give_map
    from starcat.catalog.table_check import check_map
    from starcat.catalog.table_draft import draft_map
    from starcat.errors import ConfigError

    if file is None or draft == (check is not None):
        raise ConfigError(
            "a table goes with one of --draft and --check",
            hint="write 'starcat sources --draft FILE' or 'starcat sources --check MAP.toml FILE'",
        )
    if check is None:
        proposal = draft_map(file)
        if as_json:
            print_json({"toml": proposal.as_toml(), "columns": proposal.used})
        else:
            typer.echo(proposal.as_toml().rstrip())
        if lacking := ", ".join(proposal.lacking):
            say(f"no column of {file.name} looks like {lacking}; name them in the map")
        return
    source = give_map(check)
    report = check_map(source, file)
    shown = ("key", "from", "unit", "becomes", "least", "greatest", "missing", "true")
    title = f"{report.source} ({report.form})"
    show_result(report, title, as_json=as_json, columns={"values": shown})
    if not as_json:
        say(report.verdict)
    if report.most_are_rejected:
        raise typer.Exit(1)


def _print_sources(facts: Sequence[dict[str, Any]]) -> None:
    rows = [
        (
            entry["name"],
            entry["identifier"],
            f"{entry['rows']:,}" if entry["rows"] else "",
            " ".join(entry["bands"]) or "(joined)",
            entry["found_at"] or "not found",
        )
        for entry in facts
    ]
    print_table("", ("source", "identifier", "rows", "bands", "read from"), rows, numbers=(2,))


def print_problems(problems: Sequence[str]) -> None:
    """Print the first malformed records on stderr."""
    for problem in problems[:5]:
        say(f"malformed: {problem}")


def record_rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Return table rows: records read, kept, and rejected by reason; they add up."""
    from starcat.pipeline.selection.ruleset import ALL_REASONS

    rows = [("read", f"{facts['rows_read']:,}"), ("kept", f"{facts['kept']:,}")]
    for name, count in facts["rejected"].items():
        rows.append((f"rejected: {name} ({ALL_REASONS[name]})", f"{count:,}"))
    if facts.get("role") == "crossmatch":
        rows.append(("guide stars with a counterpart", f"{facts['joined']:,}"))
    if facts.get("role") == "photometry":
        rows.append(("stars whose magnitude is partly from here", f"{facts['joined']:,}"))
    if facts.get("role") == "motions":
        rows.append(("guide stars whose motion is from here", f"{facts['joined']:,}"))
    for name, moved_arcsec in facts.get("moved_arcsec", {}).items():
        rows.append((f"{name} movement of these, arcsec", f"{moved_arcsec:.3f}"))
    return rows
