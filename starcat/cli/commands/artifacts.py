"""The commands about artifacts: building, checking, comparing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from starcat.cli.commands.shared import (
    Changes,
    Input,
    Json,
    PresetName,
    SpecFile,
    chosen_spec,
    inputs_by_source,
)
from starcat.errors import BuildError, ConfigError, ProductError

app = typer.Typer()


@app.command()
def build(
    context: typer.Context,
    spec: SpecFile = None,
    preset: PresetName = None,
    changes: Changes = None,
    inputs: Input = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder to put <name>-<version>/ into.")
    ] = Path("dist"),
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace a different artifact of that name.")
    ] = False,
    workers: Annotated[
        int, typer.Option(min=1, max=64, help="Threads; the artifact is the same for any number.")
    ] = 2,
    max_memory: Annotated[
        float | None,
        typer.Option(min=0.1, help="GiB; refuse a build that takes more. Default: what is left."),
    ] = None,
    json: Json = False,
) -> None:
    """Build a guide-star database, check it, and prove that it identifies its own fields.

    Example: starcat build --preset gaia-12deg -o dist
    """
    if context.obj is not None:
        from starcat.cli.commands.there import build_there

        build_there(context, chosen_spec(spec, preset, changes), output, as_json=json)
        return
    from starcat.cli.terminal.builds import print_built, print_cost, print_refused
    from starcat.cli.terminal.console import progress_bars
    from starcat.pipeline.build import Built
    from starcat.pipeline.build import build as run_build

    given, chosen = inputs_by_source(inputs), chosen_spec(spec, preset, changes)
    most = None if max_memory is None else int(max_memory * 2**30)
    try:
        with progress_bars() as progress:
            built = run_build(
                chosen, given, output, replace=replace, workers=workers, progress=progress,
                announce=print_cost, max_memory_bytes=most,
            )  # fmt: skip
    except BuildError as error:
        if isinstance(error.built, Built):
            print_refused(error.built, as_json=json)
        raise
    print_built(built, as_json=json)


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
        from starcat.cli.terminal.onboard import print_image
        from starcat.onboard.reading import read_image

        print_image(read_image(artifact), as_json=json)
        return
    from starcat.artifact.reader import open_artifact
    from starcat.cli.terminal.builds import print_artifact

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
    from starcat.cli.terminal.coverage_tables import print_coverage

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
    from starcat.cli.terminal.artifacts import print_verification

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
    from starcat.cli.terminal.artifacts import print_difference

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
    from starcat.cli.terminal.artifacts import print_rebuilt
    from starcat.cli.terminal.console import progress_bars
    from starcat.pipeline.rebuild import rebuild as build_again

    given = inputs_by_source(inputs)
    with progress_bars() as progress:
        rebuilt = build_again(artifact, given, output, progress)
    print_rebuilt(rebuilt, as_json=json)
    if not rebuilt.is_identical:
        raise typer.Exit(ProductError.exit_code)
