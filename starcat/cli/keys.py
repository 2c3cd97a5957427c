"""Commands that make keys, and that list and choose the keys with which a registry is signed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from starcat.cli.console import show_result
from starcat.cli.options import Json

if TYPE_CHECKING:
    from starcat.ship.releases.signing import RoleFacts

app = typer.Typer()
keys = typer.Typer(
    name="keys",
    help="Make signing keys for databases and images, and choose which keys a registry accepts.\n\n"
    "Example: starcat keys new flight",
    no_args_is_help=True,
)
app.add_typer(keys)

Registry = Annotated[Path, typer.Argument(help="Folder of the registry.")]
Sign = Annotated[list[Path], typer.Option(metavar="KEY", help="Key to sign with. Repeatable.")]


@keys.command("new")
def new(
    name: Annotated[Path, typer.Argument(help="Name of the two files, without suffix.")],
    json: Json = False,
) -> None:
    """Make a key pair: NAME.key is the private key for signing, NAME.pub the public key.

    Example: starcat keys new flight
    """
    from starcat.storage.keys import new_key, raw_public, read_public

    private, public = new_key(name)
    facts = {
        "signs": str(private),
        "checks": str(public),
        "public key": raw_public(read_public(public)).hex(),
    }
    show_result(facts, as_json=json)


@keys.command("show")
def show_roles(
    registry: Annotated[str, typer.Argument(help="Folder or http(s) address of the registry.")],
    json: Json = False,
) -> None:
    """Check the signatures of a registry, and show its keys and when they expire.

    Example: starcat keys show registry
    """
    from starcat.ship.releases.signing import roles_of

    _print_roles(roles_of(registry), json)


@keys.command("renew")
def renew_command(
    registry: Registry,
    sign: Sign,
    days: Annotated[
        float | None,
        typer.Option(
            min=0.001, help="Days until the next renewal. Default: as before, at first 90."
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Sign the newest state of a registry again, so that its signature is valid for longer.

    Signatures expire so that newer releases cannot be hidden: pull --trust refuses expired ones.

    Example: starcat keys renew registry --sign flight.key
    """
    from starcat.ship.releases.metadata import signing_with
    from starcat.ship.releases.signing import renew as run

    _print_roles(run(registry, signing_with(sign, days=days)), json)


@keys.command("roles")
def roles(
    registry: Registry,
    sign: Sign,
    root: Annotated[
        list[Path] | None, typer.Option(help="Public key that may change roles. Repeatable.")
    ] = None,
    release: Annotated[
        list[Path] | None, typer.Option(help="Public key that may sign releases. Repeatable.")
    ] = None,
    timestamp: Annotated[
        list[Path] | None, typer.Option(help="Public key that may only renew. Repeatable.")
    ] = None,
    root_threshold: Annotated[
        int | None, typer.Option(min=1, help="Signatures that a change of roles needs.")
    ] = None,
    release_threshold: Annotated[
        int | None, typer.Option(min=1, help="Signatures that a release needs.")
    ] = None,
    json: Json = False,
) -> None:
    """Choose which keys a registry accepts from now on; a role that is not named keeps its keys.

    --sign takes keys that may change roles now, and keys that may change them afterwards. Users
    who already trust the registry accept the new keys without doing anything.

    Example: starcat keys roles registry --sign flight.key --release flight.pub
    """
    from starcat.ship.releases.metadata import signing_with
    from starcat.ship.releases.signing import change_roles
    from starcat.storage.keys import raw_public, read_public

    key_files = {"root": root, "targets": release, "timestamp": timestamp}
    thresholds = {"root": root_threshold, "targets": release_threshold}
    named = {path: read_public(path) for paths in key_files.values() for path in paths or ()}
    changed = change_roles(
        registry,
        signing_with(sign),
        {role: [named[path] for path in paths] for role, paths in key_files.items() if paths},
        {role: count for role, count in thresholds.items() if count is not None},
        {raw_public(key).hex(): path.stem for path, key in named.items()},
    )
    _print_roles(changed, json)


def _print_roles(roles: Sequence[RoleFacts], json: bool) -> None:
    shown = ("role", "names", "keys", "threshold", "version", "until")
    show_result(roles, as_json=json, columns={"": shown})
