"""Commands about keys: making them, and saying which of them a registry is signed with."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from starcat.cli.console import print_facts, show
from starcat.cli.options import Json

app = typer.Typer()
keys = typer.Typer(
    name="keys",
    help="Make keys that sign databases and images, and say which of them count.\n\n"
    "Example: starcat keys new flight",
    no_args_is_help=True,
)
app.add_typer(keys)


@keys.command()
def new(
    name: Annotated[Path, typer.Argument(help="Of the two files, without an ending.")],
    json: Json = False,
) -> None:
    """Make a key pair: NAME.key signs and is yours alone, NAME.pub is for everybody.

    Example: starcat keys new flight
    """
    from starcat.storage.keys import new_key, raw_public, read_public

    private, public = new_key(name)
    facts = {
        "signs": str(private),
        "checks": str(public),
        "public key": raw_public(read_public(public)).hex(),
    }
    show(json, facts, print_facts, "", facts)
