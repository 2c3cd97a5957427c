"""The commands about catalogs: what there is, fetching, reading."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.cli.commands.shared import Json, Scheduler, Workers, inputs_by_source

if TYPE_CHECKING:
    from starcat.store.options import StoreOptions

app = typer.Typer()


@app.command()
def sources(json: Json = False) -> None:
    """List the catalogs that starcat knows, and where each would be read from.

    Example: starcat sources
    """
    from starcat.cli.terminal.builds import print_sources

    print_sources(as_json=json)


@app.command()
def fetch(
    source: Annotated[str, typer.Argument(help="A source, as 'starcat sources' lists them.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder; default: the download cache.")
    ] = None,
    part: Annotated[
        list[str] | None, typer.Option("--part", help="Only this part. Repeatable.")
    ] = None,
    retries: Annotated[int, typer.Option(min=0, help="Tries again per address.")] = 3,
    json: Json = False,
) -> None:
    """Download a catalog, check it, and remember its digest.

    Example: starcat fetch tycho2
    """
    from starcat.catalog.fetch import fetch_source
    from starcat.catalog.source import data_source
    from starcat.catalog.source_files import cache_folder
    from starcat.cli.terminal.builds import print_fetched
    from starcat.cli.terminal.console import progress_bars

    with progress_bars() as progress:
        report = fetch_source(
            data_source(source),
            output or cache_folder(),
            parts=tuple(part or ()),
            retries=retries,
            progress=lambda name, done, total: progress(f"fetch {name}", done, total),
        )
    print_fetched(report, as_json=json)


ToFormat = Annotated[
    str, typer.Option(help="parquet: one file; hats: a store of any size, by Dask.")
]
EpochJyear = Annotated[
    float | None,
    typer.Option(min=1800, max=2200, help="Julian year to move positions to; default: its own."),
]
ReadLimitMag = Annotated[
    float | None, typer.Option(min=-30, max=40, help="Count fainter records, without listing them.")
]
MemoryGib = Annotated[
    float, typer.Option("--memory", min=0.1, help="GiB of all processes together (hats).")
]
PartitionRows = Annotated[int, typer.Option(min=1, help="Stars of a partition at most (hats).")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with a run that was ended (hats).")]
Replace = Annotated[bool, typer.Option("--replace", help="Replace a store that differs (hats).")]


@app.command()
def ingest(
    source: Annotated[str, typer.Argument(help="A star catalog, such as sao.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Parquet file to write; for hats the folder.")
    ],
    inputs: Annotated[
        list[str] | None,
        typer.Option(
            "--input",
            metavar="[SOURCE=]PATH",
            help="File or folder of the catalog. Repeatable.",
        ),
    ] = None,
    to: ToFormat = "parquet",
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
    """Read an archive into a star table (Parquet) or a store (HATS), with a reason for every row.

    Example: starcat ingest sao --input sao.dat.gz -o sao.parquet --epoch-jyear 2026.0
    """
    from starcat.catalog.source_files import locate
    from starcat.errors import ConfigError
    from starcat.store.options import StoreOptions

    if to not in ("parquet", "hats"):
        raise ConfigError(f"--to {to}: choose parquet or hats", key="to", value=to)
    paths = locate(source, inputs_by_source(inputs, source))
    how = {"band": band, "epoch_jyear": epoch_jyear, "read_limit_mag": read_limit_mag}
    if to == "hats":
        options = StoreOptions(
            max_partition_rows=max_partition_rows,
            memory_bytes=int(memory_gib * 2**30),
            workers=workers,
            scheduler=scheduler,
            resume=resume,
            replace=replace,
        )
        _ingest_to_store(source, paths, output, how, options, as_json=json)
    else:
        _ingest_to_file(source, paths, output, how, workers, as_json=json)


def _ingest_to_store(
    source: str,
    paths: Sequence[Path],
    output: Path,
    how: dict[str, Any],
    options: StoreOptions,
    *,
    as_json: bool,
) -> None:
    from starcat.cli.terminal.builds import print_stored
    from starcat.cli.terminal.console import progress_bars
    from starcat.store.ingest import ingest_to_store

    with progress_bars() as progress:
        stored = ingest_to_store(source, paths, output, **how, options=options, progress=progress)
    print_stored(stored, as_json=as_json)


def _ingest_to_file(
    source: str,
    paths: Sequence[Path],
    output: Path,
    how: dict[str, Any],
    workers: int,
    *,
    as_json: bool,
) -> None:
    from starcat.catalog.ingest import write_star_tables
    from starcat.cli.terminal.builds import print_ingested
    from starcat.cli.terminal.console import progress_bars
    from starcat.store.reading import read_catalog

    with progress_bars() as progress:
        read = read_catalog(source, paths, **how, workers=workers, progress=progress)
        write_star_tables(read, output)
    print_ingested(read, output, as_json=as_json)


@app.command()
def crossmatch(
    a: Annotated[
        Path, typer.Argument(metavar="A", help="Star table (Parquet) or catalog store (HATS).")
    ],
    b: Annotated[
        Path, typer.Argument(metavar="B", help="The same, to look for their counterparts in.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Parquet file to write.")],
    radius_arcsec: Annotated[
        float, typer.Option(min=0.001, max=600, help="Largest separation.")
    ] = 10.0,
    workers: Workers = 2,
    scheduler: Scheduler = None,
    json: Json = False,
) -> None:
    """Find the counterparts of stars in another catalog by position, epoch and magnitude.

    Every candidate is written with its odds; the verdicts say how sure the likeliest one is.
    Catalog stores are matched partition by partition, whatever their size.

    Example: starcat crossmatch sao.parquet gaia.parquet -o both.parquet
    """
    from starcat.cli.terminal.console import progress_bars
    from starcat.cli.terminal.crossmatches import print_crossmatch
    from starcat.pipeline.counterparts import match_files
    from starcat.pipeline.match_stores import match_on_cluster
    from starcat.specs.product_sections import Crossmatch
    from starcat.store.layout import is_store

    wanted = Crossmatch(radius_arcsec=radius_arcsec)
    if is_store(a) or is_store(b):
        with progress_bars() as progress:
            found = match_on_cluster(a, b, output, wanted, workers, scheduler, progress)
    else:
        found = match_files(a, b, output, wanted)
    print_crossmatch(found, (a.stem, b.stem), output, as_json=json)
