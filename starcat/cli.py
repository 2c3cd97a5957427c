"""The command line: parse, call one function, print, exit code.

Results go to stdout as tables or, with ``--json``, as JSON; messages and progress bars go to
stderr. Exit codes: 0 done, 1 failed, 2 usage or spec, 3 source missing or damaged, 4 schema,
5 artifact damaged. The commands themselves are in ``starcat.commands``.
"""

from __future__ import annotations

import logging
import signal
import sys
from typing import Annotated, Any

import typer

from starcat.commands import (
    artifacts,
    catalogs,
    evaluating,
    exchanging,
    matching,
    querying,
    releasing,
    specs,
)
from starcat.errors import StarcatError, reason
from starcat.version import __version__

app = typer.Typer(
    name="starcat",
    help="Guide-star databases for star trackers, built from star catalogs.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
PARTS = (catalogs, specs, artifacts, querying, exchanging, releasing, matching, evaluating)
"""In the order of --help."""

for part in PARTS:
    app.add_typer(part.app)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"starcat {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of errors.")] = False,
) -> None:
    """Guide-star databases for star trackers, built from star catalogs."""


def _stop(number: int, frame: Any) -> None:
    """Turn a termination signal into an exit that cleans up."""
    sys.exit(128 + number)


def main() -> None:
    """Run the command line, and turn errors into a message and an exit code.

    What the operating system refuses at a place that nobody foresaw exits with 1.
    """
    signal.signal(signal.SIGTERM, _stop)
    logging.getLogger("starcat").addHandler(logging.NullHandler())  # the commands print their own
    try:
        app(prog_name="starcat")
    except StarcatError as error:
        if "--debug" in sys.argv:
            raise
        sys.stderr.write(f"starcat: error: {error}\n")
        sys.exit(error.exit_code)
    except OSError as error:
        if "--debug" in sys.argv:
            raise
        where = f"{error.filename}: " if error.filename else ""
        sys.stderr.write(f"starcat: error: {where}{reason(error)}\n")
        sys.exit(1)
