"""The commands about published versions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from starcat.cli.commands.shared import Json
from starcat.errors import ConfigError

app = typer.Typer()

Retries = Annotated[int, typer.Option(min=0, help="Tries again per file of an address.")]


@app.command()
def publish(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    registry: Annotated[str, typer.Argument(help="Folder of the registry; made if need be.")],
    json: Json = False,
) -> None:
    """Check an artifact and put it into a registry, where it will never change.

    Example: starcat publish dist/gaia-12deg-1.0.0 registry
    """
    from starcat.cli.terminal.console import progress_bars
    from starcat.cli.terminal.published import print_published
    from starcat.releases.publishing import publish_artifact

    with progress_bars() as progress:
        published = publish_artifact(artifact, registry, progress)
    print_published(published, as_json=json)


@app.command()
def pull(
    wanted: Annotated[
        str | None,
        typer.Argument(metavar="NAME@VERSION", help="Or NAME@latest, or NAME for the latest."),
    ] = None,
    registry: Annotated[
        str | None, typer.Option(help="Folder or http(s) address; default: what the lock says.")
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder to put <name>-<version>/ into.")
    ] = Path("dist"),
    locked: Annotated[
        bool, typer.Option("--locked", help="Exactly what the lock says: one artifact, or all.")
    ] = False,
    lock: Annotated[Path, typer.Option(help="File that pins versions by digest.")] = Path(
        "starcat.lock"
    ),
    max_bytes: Annotated[
        int | None, typer.Option(min=0, help="Refuse an artifact with more bytes than this.")
    ] = None,
    retries: Retries = 3,
    json: Json = False,
) -> None:
    """Get a published version, check every file of it, and pin it in the lock file.

    Example: starcat pull gaia-12deg@latest --registry registry -o onboard
    """
    from starcat.cli.terminal.console import progress_bars
    from starcat.cli.terminal.published import print_pulled
    from starcat.releases.project import pull_pinned, pull_wanted
    from starcat.storage.download import DownloadOptions

    options = DownloadOptions(retries)
    with progress_bars() as progress:
        if locked:
            pulled = pull_pinned(wanted, registry, output, lock, options, progress, max_bytes)
        elif wanted:
            pulled = [pull_wanted(wanted, registry, output, lock, options, progress, max_bytes)]
        else:
            raise ConfigError("pull what? Name it, NAME@VERSION, or say --locked for all pins")
    print_pulled(pulled, as_json=json)


@app.command()
def releases(
    registry: Annotated[str, typer.Argument(help="Folder or http(s) address of the registry.")],
    retries: Retries = 3,
    json: Json = False,
) -> None:
    """List the versions that a registry has.

    Example: starcat releases registry
    """
    from starcat.cli.terminal.published import print_releases
    from starcat.releases.registry import open_registry
    from starcat.storage.download import DownloadOptions

    opened = open_registry(registry, DownloadOptions(retries))
    print_releases(opened.releases(), as_json=json)
