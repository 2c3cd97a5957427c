"""Every command of the command line by its words, those of groups included."""

from __future__ import annotations

from typing import Any

import typer

from starcat.cli.main import app


def every_command() -> dict[str, Any]:
    """Return the commands: ``build`` and ``token create`` alike, in the order of their names."""
    found: dict[str, Any] = {}
    for name, command in sorted(typer.main.get_command(app).commands.items()):  # type: ignore[attr-defined]
        within = getattr(command, "commands", None)
        if within is None:
            found[name] = command
        else:
            found |= {f"{name} {word}": one for word, one in sorted(within.items())}
    return found
