"""The command line: parse, call one function, print, exit code.

Results go to stdout as tables or, with ``--json``, as JSON; messages and progress bars go to
stderr. With ``--json`` an error is one JSON object on stderr. The exit codes are in
``docs/errors.md``, the commands in the other modules of this folder.
"""

from __future__ import annotations

import copy
import logging
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from functools import cache, partial
from typing import Annotated, Any

import typer
from typer.main import get_command_name

from starcat.cli import (
    bands,
    blending,
    builds,
    catalogs,
    databases,
    doctor,
    exchange,
    fetching,
    interrupts,
    keys,
    learning,
    matching,
    planning,
    releases,
    specs,
    sql,
)
from starcat.cli.console import PANELS, WholeSummaries
from starcat.cli.messages import print_messages
from starcat.cli.options import option_of
from starcat.cli.packages import add_commands
from starcat.cli.remote import open_remote
from starcat.failures import failure_of
from starcat.version import __version__

# Exit codes after a signal, as in a shell.
INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM


app = typer.Typer(
    cls=WholeSummaries,
    name="starcat",
    help="Guide-star databases for star trackers, built from star catalogs.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"]},
)
for part in (
    *(catalogs, fetching, bands, blending, specs, builds, databases, sql, exchange),
    *(releases, keys, matching, planning, learning, doctor),
):
    app.add_typer(part.app)
add_commands(app)


def _version(is_requested: bool) -> None:
    if is_requested:
        from starcat.matcher.c_engine import library_version

        library = library_version()
        typer.echo(f"starcat {__version__}")
        typer.echo(f"matcher: {f'C library {library}' if library else 'numpy, no C library'}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the versions."),
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of errors; anywhere on the line.")
    ] = False,
    server: Annotated[
        str | None, typer.Option(metavar="URL", help="Address of a service that runs the command.")
    ] = None,
    token: Annotated[
        str | None,
        typer.Option(envvar="STARCAT_TOKEN", show_envvar=False, help="Or in STARCAT_TOKEN."),
    ] = None,
) -> None:
    """Guide-star databases for star trackers, built from star catalogs."""
    if server is not None:
        context.obj = open_remote(server, token, context.invoked_subcommand or "")


def main() -> None:
    """Run the command line, and turn every exception into a message and an exit code.

    ``--debug``, anywhere on the line, shows the traceback before the message. The exit code stays
    the same.
    """
    interrupts.catch_signals()
    logging.getLogger("starcat").addHandler(logging.NullHandler())  # the commands print their own
    print_messages()
    arguments, behind = _parted(sys.argv[1:])
    arguments = _as_typed_often(arguments)
    is_debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    try:
        code = _run([*arguments, *behind])
        interrupts.check_interrupt()
    except Exception as error:
        if is_debug:
            traceback.print_exc()
        code = _tell(error, arguments)
    except KeyboardInterrupt:
        sys.stderr.write(interrupts.left_by(_command_of(arguments)))
        code = INTERRUPTED
    except SystemExit as ended:
        if ended.code == TERMINATED:
            sys.stderr.write(interrupts.left_by(_command_of(arguments)))
        raise
    sys.exit(code)


def _as_typed_often(arguments: list[str]) -> list[str]:
    """Return arguments in the order that the parser expects: people type some words first.

    Examples
    --------
    >>> _as_typed_often(["help", "build"]), _as_typed_often(["version"])
    (['build', '--help'], ['--version'])
    >>> _as_typed_often(["--json", "sources"])
    ['sources', '--json']
    """
    if arguments[:1] == ["help"]:
        return [*arguments[1:], "--help"]
    if arguments == ["version"]:
        return ["--version"]
    command_names = {name for names in PANELS.values() for name in names}
    start = next((n for n, word in enumerate(arguments) if word in command_names), 0)
    moved = [word for word in arguments[:start] if word == "--json"]
    return [word for word in arguments[:start] if word != "--json"] + arguments[start:] + moved


def _command_of(arguments: Sequence[str]) -> str:
    return next((argument for argument in arguments if not argument.startswith("-")), "")


def _parted(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the arguments before ``--``, which can be options, and the rest."""
    end = list(arguments).index("--") if "--" in arguments else len(arguments)
    return list(arguments[:end]), list(arguments[end:])


@cache
def _parser_of(name: str) -> Any:
    """Return the parser of a command, or of the whole command line, which takes 0.1 s to make."""
    for group in app.registered_groups:
        part = group.typer_instance
        if part is None:
            continue
        named = {
            command.name or get_command_name(command.callback.__name__)
            for command in part.registered_commands
            if command.callback is not None
        }
        if name in named:
            reduced_app = copy.copy(app)
            reduced_app.registered_groups = [group]
            return typer.main.get_command(reduced_app)
    return typer.main.get_command(app)


def _run(arguments: Sequence[str]) -> int:
    """Run a command, and flush its output."""
    try:
        code = _parser_of(_command_of(arguments)).main(
            list(arguments), "starcat", standalone_mode=False
        )
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of the output is gone: drop the rest of the output without a message.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return code if isinstance(code, int) else 0


def _tell(error: Exception, arguments: Sequence[str]) -> int:
    """Print the error on stderr and return the exit code."""
    doing = f"starcat {_command_of(arguments)}".strip()
    failure = failure_of(error, doing, partial(option_of, command=doing))
    if "--json" in arguments or "--ndjson" in arguments:
        sys.stderr.write(failure.as_json())
    elif hasattr(error, "show"):  # a usage error, with the usage above the message
        error.show()
    else:
        sys.stderr.write(failure.as_text())
    return failure.code
