"""Commands about published versions: publish, pull, releases."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from starcat.cli.console import progress_bars, say, show_result, warn
from starcat.cli.options import Json, database
from starcat.cli.outputs import to_folder
from starcat.errors import ConfigError

app = typer.Typer()

Retries = Annotated[int, typer.Option(min=0, help="Further attempts per file of an address.")]


SIGNED = {
    "checked": "; signed by keys that you trust",
    "unchecked": "; signed, but the signature was not checked: give a key that you trust, --trust",
    "unsigned": "; this registry has no signatures",
    "pinned": "",
}
"""Text about the signatures of a pulled database."""


@app.command("publish")
def publish_command(
    folder: Annotated[Path, database()],
    registry: Annotated[str, typer.Argument(help="Folder of the registry; made if missing.")],
    sign: Annotated[
        list[Path] | None, typer.Option(metavar="KEY", help="Key to sign with. Repeatable.")
    ] = None,
    threshold: Annotated[
        int | None, typer.Option(min=1, help="Signatures needed; the first --sign sets it.")
    ] = None,
    json: Json = False,
) -> None:
    """Check a database and put it into a registry, where it will never change.

    With --sign, users who pull can check who published it. 'starcat keys new' makes a key.

    Example: starcat publish dist/gaia-12deg-1.0.0 registry
    """
    from starcat.ship.releases.publishing import publish

    with progress_bars() as progress:
        published = publish(
            folder, registry, sign=sign or (), threshold=threshold, progress=progress
        )
    shown = ("name", "version", "files", "bytes", "new_blobs", "new_bytes", "manifest.sha256")
    show_result(published, as_json=json, columns={"": shown})
    if not json:
        signed = " and signed" if published.is_signed else ""
        say(f"{published.outcome}{signed}: {published.release.title} in {published.registry}")


@app.command("pull")
def pull_command(
    name_version: Annotated[
        str | None,
        typer.Argument(metavar="NAME@VERSION", help="NAME@latest or NAME for the latest."),
    ] = None,
    registry: Annotated[
        str | None, typer.Option(help="Folder or http(s) address; default: from the lock file.")
    ] = None,
    output: Annotated[Path, to_folder("Where <name>-<version>/ goes.")] = Path("dist"),
    locked: Annotated[
        bool,
        typer.Option(
            "--locked", help="Pull the versions pinned in the lock file: one database, or all."
        ),
    ] = False,
    lock: Annotated[Path, typer.Option(help="File that pins versions by digest.")] = Path(
        "starcat.lock"
    ),
    max_bytes: Annotated[
        int | None, typer.Option(min=0, help="Refuse a database with more bytes than this.")
    ] = None,
    trust: Annotated[
        Path | None,
        typer.Option(help="Public key or root.json that must have signed it; then remembered."),
    ] = None,
    retries: Retries = 3,
    json: Json = False,
) -> None:
    """Get a published version, check every file of it, and pin it in the lock file.

    Example: starcat pull gaia-12deg@latest --registry registry -o onboard
    """
    from starcat.ship.releases.lockfile import pull, pull_pinned
    from starcat.storage.download import DownloadOptions

    options = DownloadOptions(retries)
    with progress_bars() as progress:
        pull_options: dict[str, Any] = {
            "lock": lock, "options": options, "progress": progress, "max_bytes": max_bytes,
            "trust": trust,
        }  # fmt: skip
        if locked:
            pulled = pull_pinned(name_version, registry, output, **pull_options)
        elif name_version:
            pulled = [pull(name_version, registry, output, **pull_options)]
        else:
            raise ConfigError(
                "no database", hint="name one, NAME@VERSION, or give --locked for all pins"
            )
    warn(warning for release in pulled for warning in release.warnings)
    shown = ("name", "version", "manifest.sha256", "folder")
    show_result(pulled, as_json=json, columns={"": shown})
    if not json:
        for release in pulled:
            say(f"{release.outcome}: {release.folder}{SIGNED[release.signed]}")


@app.command("releases")
def releases(
    registry: Annotated[str, typer.Argument(help="Folder or http(s) address of the registry.")],
    retries: Retries = 3,
    json: Json = False,
) -> None:
    """List the versions in a registry, and whether each is signed.

    Example: starcat releases registry
    """
    from starcat.ship.releases.registry import open_registry
    from starcat.ship.releases.signing import signatures_of, signed_files
    from starcat.storage.download import DownloadOptions

    listed = open_registry(registry, DownloadOptions(retries)).releases()
    highest = {release.name: release for release in listed}
    signed = signatures_of(signed_files(registry), listed)
    facts = [
        release.model_dump() | {"is_latest": highest[release.name] is release, "signed": state}
        for release, state in zip(listed, signed, strict=True)
    ]
    shown = ("name", "version", "is_latest", "files", "bytes", "manifest.sha256", "signed")
    show_result(facts, as_json=json, columns={"": shown})
    if not json and "yes" in signed:
        say(
            "signed: by the keys that 'starcat keys show' lists. 'starcat pull --trust KEY' checks "
            "that they belong to the publisher"
        )
