"""Commands of the additional packages, such as starcat-service.

A package adds commands by an entry point of the group ``starcat.commands``, whose value is a typer
application. If a known package is not installed, its commands are still listed, and each prints
what to install.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

import typer

from starcat.errors import ConfigError

GROUP = "starcat.commands"

KNOWN = {
    "starcat-lab": {"evaluate": "Measure identification rates over many simulated frames."},
    "starcat-service": {
        "serve": "Run the service: pages, REST, TAP and a registry.",
        "token": "Create, list and revoke tokens of the service.",
    },
}
"""Packages of this repository: their commands, each with its help text."""

ANYTHING = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": []}


def add_commands(app: typer.Typer) -> None:
    """Add the commands of all installed packages, and a hint for each command that is missing."""
    installed = sorted(entry_points(group=GROUP), key=lambda entry_point: entry_point.name)
    names = {entry_point.dist.name for entry_point in installed if entry_point.dist is not None}
    for entry_point in installed:
        app.add_typer(entry_point.load())
    for package, commands in KNOWN.items():
        for command, summary in commands.items() if package not in names else ():
            hint = _hint(command, package)
            app.command(command, help=summary, context_settings=dict(ANYTHING))(hint)


def _hint(command: str, package: str) -> Any:
    def refuse(context: typer.Context) -> None:
        raise ConfigError(
            f"'starcat {command}' is in the package {package}, which is not installed",
            hint=f"pip install {package}, or ./packages/{package.removeprefix('starcat-')} in a "
            "checkout of starcat",
        )

    return refuse
