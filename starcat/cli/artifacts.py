"""Commands about artifacts: inspect, coverage, verify, diff, rebuild, and their tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.cli.builds import print_artifact, print_coverage_table
from starcat.cli.console import print_json, print_table, progress_bars, say
from starcat.cli.options import (
    Input,
    Json,
    inputs_by_source,
)
from starcat.errors import ConfigError, ProductError

if TYPE_CHECKING:
    from starcat.artifact.diff import Change, Difference, Moved, OneSided
    from starcat.artifact.reader import Artifact
    from starcat.artifact.verify import Verification
    from starcat.pipeline.rebuild import Rebuilt
    from starcat.report.report import CoverageReport

app = typer.Typer()


@app.command()
def inspect(
    artifact: Annotated[
        Path, typer.Argument(help="The folder <name>-<version>, or an onboard image.")
    ],
    json: Json = False,
) -> None:
    """Say what an artifact or an onboard image holds and what it was made from.

    Example: starcat inspect dist/gaia-12deg-1.0.0
    """
    if artifact.is_file():
        from starcat.cli.exchange import print_image
        from starcat.onboard.reading import read_image

        print_image(read_image(artifact), as_json=json)
        return
    from starcat.artifact.reader import open_artifact

    print_artifact(open_artifact(artifact), as_json=json)


@app.command()
def coverage(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for CSV, JSON, PNG and SVG.")
    ] = None,
    json: Json = False,
) -> None:
    """Say how many stars, pairs and triangles the fields of an artifact hold.

    Example: starcat coverage dist/gaia-12deg-1.0.0 -o coverage
    """
    from starcat.artifact.reader import open_artifact

    print_coverage(open_artifact(artifact), output, as_json=json)


@app.command()
def verify(
    artifact: Annotated[
        Path, typer.Argument(help="The folder <name>-<version>, or an onboard image.")
    ],
    against: Annotated[
        Path | None, typer.Option(help="The artifact that an onboard image should be of.")
    ] = None,
    json: Json = False,
) -> None:
    """Check an artifact or an onboard image: digests, contents, orders, indices, references.

    Exits with 5 if anything is wrong.

    Example: starcat verify dist/gaia-12deg-1.0.0
    """
    if artifact.is_file():
        from starcat.exchange.onboard import verify_image

        found = verify_image(artifact, against)
    elif against is not None:
        raise ConfigError(f"--against is for an onboard image; {artifact} is none", key="against")
    else:
        from starcat.artifact.verify import verify_artifact

        found = verify_artifact(artifact)
    print_verification(found, as_json=json)
    if found.findings:
        raise typer.Exit(ProductError.exit_code)


@app.command()
def diff(
    a: Annotated[Path, typer.Argument(metavar="A", help="The earlier artifact's folder.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="The later one's.")],
    json: Json = False,
) -> None:
    """Say what differs between two artifacts: spec, sources, stars and why, products.

    Example: starcat diff dist/gaia-12deg-1.0.0 dist/gaia-12deg-1.1.0
    """
    from starcat.artifact.diff import diff_artifacts
    from starcat.artifact.reader import open_artifact

    found = diff_artifacts(open_artifact(a), open_artifact(b))
    print_difference(found, (a.resolve().name, b.resolve().name), as_json=json)


@app.command()
def rebuild(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    inputs: Input = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder to keep the new artifact in.")
    ] = None,
    json: Json = False,
) -> None:
    """Build an artifact again from its manifest and compare every byte.

    Exits with 5 if a file differs.

    Example: starcat rebuild dist/gaia-12deg-1.0.0
    """
    from starcat.pipeline.rebuild import rebuild as build_again

    given = inputs_by_source(inputs)
    with progress_bars() as progress:
        rebuilt = build_again(artifact, given, output, progress)
    print_rebuilt(rebuilt, as_json=json)
    if not rebuilt.is_identical:
        raise typer.Exit(ProductError.exit_code)


MAX_STARS = 20
"""Stars of each kind that a table shows; JSON has all."""


def print_verification(found: Verification, *, as_json: bool) -> None:
    """Print what a verification found."""
    if as_json:
        print_json(found.as_dict())
        return
    name, count = found.folder.resolve().name, len(found.findings)
    outcome = f"{count} problem{'s' * (count != 1)}" if count else "sound"
    title = f"{name}: {outcome} ({found.checks} checks)"
    if not count:
        print_table("", (title,), [])
        return
    rows = [(f.file, f.product, f.problem) for f in found.findings]
    print_table(title, ("file", "product", "problem"), rows)


def print_difference(found: Difference, names: tuple[str, str], *, as_json: bool) -> None:
    """Print what differs between two artifacts."""
    if as_json:
        print_json({"a": names[0], "b": names[1], **found.as_dict()})
        return
    for title, changes in (
        ("Spec", found.spec),
        ("Sources", found.sources),
        ("Software", found.software),
    ):
        _print_changes(title, changes)
    _print_one_sided(f"{len(found.came):,} stars came", found.came)
    _print_one_sided(f"{len(found.went):,} stars went", found.went)
    _print_moved(found.moved)
    print_table(
        "Products",
        ("product", f"rows of {names[0]}", f"rows of {names[1]}", "content"),
        [
            (p.product, _count(p.rows_a), _count(p.rows_b), "same" if p.is_same else "differs")
            for p in found.products
        ],
        numbers=(1, 2),
    )


def _print_changes(title: str, changes: Sequence[Change]) -> None:
    if changes:
        rows = [(change.name, _value(change.a), _value(change.b)) for change in changes]
        print_table(title, ("", "A", "B"), rows)


def _print_one_sided(title: str, stars: Sequence[OneSided]) -> None:
    if stars:
        rows = [(star.designation, _mag(star.mag), star.reason) for star in stars[:MAX_STARS]]
        heading = ("star", "mag", "in the other")
        print_table(_capped(title, len(stars)), heading, rows, numbers=(1,))


def _print_moved(stars: Sequence[Moved]) -> None:
    if stars:
        rows = [
            (star.designation, f"{star.moved_arcsec:.4f}", _mag(star.mag_a), _mag(star.mag_b))
            for star in stars[:MAX_STARS]
        ]
        title = _capped(f"{len(stars):,} stars moved", len(stars))
        print_table(title, ("star", "arcsec", "mag A", "mag B"), rows, numbers=(1, 2, 3))


def print_rebuilt(rebuilt: Rebuilt, *, as_json: bool) -> None:
    """Print the outcome of a rebuild."""
    if as_json:
        print_json(rebuilt.as_dict())
        return
    if rebuilt.is_identical:
        print_table("", (f"{rebuilt.name}: {rebuilt.files} files, every byte the same",), [])
        return
    print_table(
        f"{rebuilt.name}: {len(rebuilt.changes)} of {rebuilt.files} files differ",
        ("file", "what differs"),
        [(change.file, change.what) for change in rebuilt.changes],
    )
    rows = [(change.name, _value(change.a), _value(change.b)) for change in rebuilt.software]
    if rows:
        print_table("Software", ("", "then", "now"), rows)


def _capped(title: str, count: int) -> str:
    return title if count <= MAX_STARS else f"{title} (first {MAX_STARS})"


def _value(value: Any) -> str:
    text = "-" if value is None else str(value)
    # The beginning of a digest is enough to tell it from another.
    return text[:16] if len(text) == 64 and " " not in text else text


def _count(rows: int | None) -> str:
    return "-" if rows is None else f"{rows:,}"


def _mag(mag: float | None) -> str:
    return "-" if mag is None else f"{mag:.2f}"


_BARS, _BAR_WIDTH = 20, 50


def print_coverage(artifact: Artifact, folder: Path | None, *, as_json: bool) -> None:
    """Print the coverage of an artifact, and write its tables and plots where asked to."""
    from starcat.pipeline.report_data import artifact_coverage
    from starcat.report.report import holes_warning, write_coverage

    report = artifact_coverage(artifact)
    if as_json:
        print_json(report.as_dict())
    else:
        print_coverage_table(report)
        print_table("", ("stars in a field", "fields", ""), histogram_rows(report), numbers=(1,))
    warning = holes_warning(report.gap)
    if warning:
        say(f"warning: {warning}")
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        title = f"{artifact.manifest['name']}-{artifact.manifest['version']}"
        names = write_coverage(folder, title, report)
        say(f"wrote {', '.join(names)} in {folder}")


def histogram_rows(report: CoverageReport) -> list[tuple[str, str, str]]:
    """Return the histogram of stars in a field as rows of text."""
    import numpy as np

    least = report.summary.stars.minimum
    counts = report.summary.histogram[least:]
    width = -(-len(counts) // _BARS)
    padded = np.append(counts, np.zeros(-len(counts) % width, dtype=np.int64))
    fields = padded.reshape(-1, width).sum(axis=1)
    rows = []
    for low, number in zip(range(least, 10**9, width), fields.tolist(), strict=False):
        label = f"{low}" if width == 1 else f"{low}-{low + width - 1}"
        rows.append((label, f"{number:,}", "#" * -(-number * _BAR_WIDTH // int(fields.max()))))
    return rows
