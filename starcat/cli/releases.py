"""Commands about published versions: publish, pull, releases."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from starcat.cli.console import print_json, print_table, progress_bars, say
from starcat.cli.options import Json
from starcat.errors import ConfigError

if TYPE_CHECKING:
    from starcat.releases.publishing import Published
    from starcat.releases.pulling import Pulled
    from starcat.releases.tree import Listed

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
    from starcat.releases.lockfile import pull_pinned, pull_wanted
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
    from starcat.releases.registry import open_registry
    from starcat.storage.download import DownloadOptions

    opened = open_registry(registry, DownloadOptions(retries))
    print_releases(opened.releases(), as_json=json)


DIGEST_LETTERS = 16
"""Letters of a digest that a table shows; JSON has all."""


def print_published(published: Published, *, as_json: bool) -> None:
    """Print what became of a publication."""
    release = published.release
    if as_json:
        print_json(published.as_dict())
        return
    row = (
        release.name,
        release.version,
        release.files,
        f"{release.bytes:,}",
        published.new_blobs,
        f"{published.new_bytes:,}",
        release.manifest.sha256[:DIGEST_LETTERS],
    )
    columns = ("artifact", "version", "files", "bytes", "new files", "new bytes", "manifest")
    print_table("", columns, [row], numbers=(2, 3, 4, 5))
    say(f"{published.outcome}: {release.title} in {published.registry}")


def print_pulled(pulled: Sequence[Pulled], *, as_json: bool) -> None:
    """Print what became of pulls."""
    if as_json:
        print_json([one.as_dict() for one in pulled])
        return
    rows = [
        (
            one.release.name,
            one.release.version,
            one.release.manifest.sha256[:DIGEST_LETTERS],
            str(one.folder),
        )
        for one in pulled
    ]
    print_table("", ("artifact", "version", "manifest", "folder"), rows)
    for one in pulled:
        say(f"{one.outcome}: {one.folder}")


def print_releases(releases: Sequence[Listed], *, as_json: bool) -> None:
    """Print what a registry lists."""
    highest = {release.name: release for release in releases}
    if as_json:
        marked = [r.model_dump() | {"is_latest": highest[r.name] is r} for r in releases]
        print_json(marked)
        return
    rows = [
        (
            release.name,
            release.version,
            "latest" if highest[release.name] is release else "",
            release.files,
            f"{release.bytes:,}",
            release.manifest.sha256[:DIGEST_LETTERS],
        )
        for release in releases
    ]
    columns = ("artifact", "version", "", "files", "bytes", "manifest")
    print_table("", columns, rows, numbers=(3, 4))
