"""Commands about databases: inspect, coverage, verify, diff, rebuild, and their tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from starcat.cli.builds import print_database, show_coverage
from starcat.cli.console import (
    print_json,
    print_rows,
    print_table,
    print_things,
    progress_bars,
    say,
    show,
    show_result,
    warn,
)
from starcat.cli.options import Input, Json, database, inputs_by_source, refuse_part_of_database
from starcat.cli.outputs import Replace, expect_free, to_folder
from starcat.errors import ConfigError, ProductError, count_of
from starcat.results import to_dict

if TYPE_CHECKING:
    from starcat.database.diff import Difference
    from starcat.database.verify import Verification
    from starcat.pipeline.report.report import CoverageReport

app = typer.Typer()


@app.command("inspect")
def inspect(
    database: Annotated[
        Path,
        typer.Argument(
            metavar="DATABASE", help="The folder <name>-<version>, or an onboard image."
        ),
    ],
    json: Json = False,
) -> None:
    """Show what a database or an onboard image contains and what it was made from.

    Example: starcat inspect dist/gaia-12deg-1.0.0
    """
    if database.is_file():
        refuse_part_of_database(database)
        from starcat.database.onboard.patching import image_signatures
        from starcat.database.onboard.reading import read_onboard_image

        image = read_onboard_image(database)
        signatures = image_signatures(image.data, image.byte_order)
        record = to_dict(image) | {"signed_by": [signature.public_key for signature in signatures]}
        if not json:
            record |= {"camera": image.camera.in_words, "bytes": len(image.data)}
        shown = (
            *("name", "format", "byte_order", "header.epoch_jyear", "camera", "method"),
            *("header.n_stars", "header.most_near", "header.n_features", "manifest_sha256"),
            *("bytes", "crc", "signed_by"),
        )
        show_result(record, as_json=json, columns={"": shown})
        return
    from starcat.database.reader import open_database_folder

    opened = open_database_folder(database)
    show(json, opened.manifest, print_database, opened)


@app.command("coverage")
def coverage_command(
    folder: Annotated[Path, database()],
    output: Annotated[Path | None, to_folder("Where CSV, JSON, PNG and SVG go.")] = None,
    replace: Replace = False,
    json: Json = False,
) -> None:
    """Show how many stars, pairs and triangles the fields of a database contain.

    Example: starcat coverage dist/gaia-12deg-1.0.0 -o coverage
    """
    from starcat.database.reader import open_database_folder
    from starcat.pipeline.report.report import coverage_warnings, write_coverage
    from starcat.pipeline.report_data import database_coverage

    expect_free(output, replace=replace)
    opened = open_database_folder(folder)
    report = database_coverage(opened)
    title = f"{opened.manifest['name']}-{opened.manifest['version']}"
    show_coverage(report, f"{title}: coverage", as_json=json)
    if not json:
        print_rows(histogram(report))
    warn(coverage_warnings(report.summary, report.gap))
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
        names = write_coverage(output, title, report)
        say(f"wrote {', '.join(names)} in {output}")


@app.command("verify")
def verify_command(
    database: Annotated[
        str,
        typer.Argument(
            metavar="DATABASE",
            help="The folder <name>-<version>, an onboard image, or a registry: folder or address.",
        ),
    ],
    against: Annotated[
        Path | None, typer.Option(help="The database from which an onboard image should be made.")
    ] = None,
    trust: Annotated[
        Path | None,
        typer.Option(help="Public key that must have signed the onboard image or the registry."),
    ] = None,
    json: Json = False,
) -> None:
    """Check a database, an onboard image or a registry: digests, contents, orders, references.

    In a registry all releases are read. The exit code is 5 if anything is wrong.

    Example: starcat verify dist/gaia-12deg-1.0.0
    """
    from starcat.ship.releases.registry import is_registry

    if Path(database).is_file():
        refuse_part_of_database(Path(database))
        from starcat.ship.exchange.onboard import verify_image

        verification = verify_image(Path(database), against, trust)
    elif against is None and is_registry(database):
        from starcat.ship.releases.verifying import verify_registry

        with progress_bars() as progress:
            verification = verify_registry(database, trust, progress)
    elif against is not None or trust is not None:
        name = "against" if against is not None else "trust"
        raise ConfigError(f"--{name} is for an onboard image; {database} is not one", key=name)
    else:
        from starcat.database.verify import verify

        verification = verify(database)
    if json:
        print_json(to_dict(verification))
    else:
        print_verification(verification)
    if verification.findings:
        raise typer.Exit(ProductError.exit_code)


@app.command("diff")
def diff_command(
    a: Annotated[Path, database("The earlier database's folder.", name="A")],
    b: Annotated[Path, database("The later one's.", name="B")],
    json: Json = False,
) -> None:
    """Show what differs between two databases: spec, sources, stars and why, products.

    Example: starcat diff dist/gaia-12deg-1.0.0 dist/gaia-12deg-1.1.0
    """
    from starcat.database.diff import diff

    difference = diff(a, b)
    names = {"a": a.resolve().name, "b": b.resolve().name}
    if json:
        print_json(names | to_dict(difference))
    else:
        print_difference(difference, *names.values())


@app.command("rebuild")
def rebuild_command(
    folder: Annotated[Path, database()],
    inputs: Input = None,
    output: Annotated[
        Path | None, to_folder("Where the new database goes; default: it is not kept.")
    ] = None,
    json: Json = False,
) -> None:
    """Build a database again from its manifest and compare every byte.

    The exit code is 7 if the products are the same and other software wrote files that differ, and
    5 if anything else differs.

    Example: starcat rebuild dist/gaia-12deg-1.0.0
    """
    from starcat.catalog.source import known_maps
    from starcat.database.manifest import read_manifest
    from starcat.pipeline.rebuild import maps_in
    from starcat.pipeline.rebuild import rebuild as build_again

    with known_maps(maps_in(read_manifest(folder))), progress_bars() as progress:
        rebuilt = build_again(folder, inputs_by_source(inputs), output, progress)
    show_result(rebuilt, as_json=json, columns={"": ("name", "files", "verdict")})
    if not rebuilt.is_identical:
        is_same = rebuilt.verdict == "same products"
        raise typer.Exit(SAME_PRODUCTS if is_same else ProductError.exit_code)


SAME_PRODUCTS = 7
"""Exit code of a rebuild by other software that has the same products, but not every byte."""


def print_verification(verification: Verification) -> None:
    """Print what a verification found."""
    name, count = verification.folder.resolve().name, len(verification.findings)
    outcome = f"{count} problem{'s' * (count != 1)}" if count else "sound"
    title = f"{name}: {outcome} ({count_of(verification.checks, 'check')})"
    if not count:
        print_table("", (title,), [])
        return
    columns = {"file": "{0.file}", "product": "{0.product}", "problem": "{0.problem}"}
    print_things(title, verification.findings, columns)


def print_difference(difference: Difference, name_a: str, name_b: str) -> None:
    """Print the differences of two databases."""
    if difference.is_same and not difference.software:
        typer.echo(f"{name_a} and {name_b} are identical: spec, sources, stars and products")
        return
    one_sided = ("designation", "mag", "reason")
    stars: dict[str, tuple[str, ...]] = {"came": one_sided, "went": one_sided}
    stars["moved"] = ("designation", "moved_arcsec", "mag_a", "mag_b")
    products = ("product", "rows_a", "rows_b", "content")
    show_result(difference, f"A: {name_a}; B: {name_b}", columns={**stars, "products": products})


_BARS, _BAR_WIDTH = 20, 50


def histogram(report: CoverageReport) -> list[dict[str, int | str]]:
    """Return the rows of the histogram of stars in a field, each with its bar."""
    import numpy as np

    least = report.summary.stars.minimum
    counts = report.summary.histogram[least:]
    width = -(-len(counts) // _BARS)
    padded = np.append(counts, np.zeros(-len(counts) % width, dtype=np.int64))
    fields = padded.reshape(-1, width).sum(axis=1)
    rows = []
    for low, number in zip(range(least, 10**9, width), fields.tolist(), strict=False):
        label = f"{low}" if width == 1 else f"{low}-{low + width - 1}"
        bar = "#" * -(-number * _BAR_WIDTH // int(fields.max()))
        rows.append({"stars_in_a_field": label, "fields": number, "": bar})
    return rows
