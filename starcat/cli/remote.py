"""Commands that a service can run instead: build, sql, identify."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from starcat.cli.console import say
from starcat.errors import ConfigError, FileMissing, QueryError, SourceError, count_of

if TYPE_CHECKING:
    from starcat.cli.queries import Question
    from starcat.client import Client

LOCAL_OPTIONS = {
    "build": ("inputs", "replace", "workers", "max_memory"),
    "sql": ("show_views", "preamble", "memory_limit_gb"),
    "identify": ("dark", "mask", "velocity", "orbit", "wcs", "track"),
}
"""Options that a service does not accept."""


def open_remote(url: str, token: str | None, command: str) -> Client:
    """Return a client of the service that a command line names."""
    if not url.startswith(("http://", "https://")):
        raise ConfigError(
            f"--server {url!r}: expected an address such as http://127.0.0.1:8000", key="server"
        )
    if command not in LOCAL_OPTIONS:
        raise ConfigError(
            f"--server does not go with 'starcat {command}', which runs here",
            key="server",
            hint=f"it goes with {', '.join(LOCAL_OPTIONS)}",
        )
    from starcat.client import Client

    return Client(url, token)


def sql_remotely(
    context: typer.Context, targets: list[str], question: Question, rows: int, time_limit_s: float
) -> None:
    """Run an SQL query on a service, and print or write the answer."""
    from starcat.cli.queries import format_of_answer, print_result
    from starcat.query.gallery import guessed
    from starcat.query.result import ResultTable

    client, output, named = client_of(context), question.output, question.named
    if question.query is None and named is None:
        raise QueryError(
            "no query", hint="with --server write it on the line, or choose one with --named"
        )
    if not targets:
        raise QueryError("a query without a target", hint="name the id or the title of a database")
    form = format_of_answer(question)
    values: dict[str, Any] = dict(question.values)
    if named is None:
        values = {name: guessed(text) for name, text in values.items()}
    asked: dict[str, Any] = {
        "targets": targets,
        "query": question.query,
        "values": values,
        "named": named,
        "time_limit_s": time_limit_s,
    }
    if form == "table":
        print_result(ResultTable.from_json(client.sql(**asked, max_rows=rows)))
        return
    if output is not None:
        say(f"{output}: {count_of(client.sql_file(output, form, **asked), 'row')}")
        return
    with tempfile.TemporaryDirectory(prefix="starcat-") as folder:
        path = Path(folder) / "answer"
        client.sql_file(path, form, **asked)
        sys.stdout.write(path.read_text(encoding="utf-8"))


def identify_remotely(context: typer.Context, database: str, file: Path) -> None:
    """Identify frames on a service, and print the answers."""
    from starcat.cli.matches import print_contents

    client, parameters = client_of(context), context.params
    picture: Path | None = parameters["picture"]
    if picture is not None and picture.suffix.lower() not in (".png", ".svg"):
        raise ConfigError(
            "expected a name that ends with .png or .svg", where=picture, key="picture"
        )
    options = _options_of(parameters)
    with tempfile.TemporaryDirectory(prefix="starcat-") as folder:
        frames = file if str(file) != "-" else _of_stdin(Path(folder))
        if not frames.is_file():
            raise FileMissing(
                "no such file", where=frames, hint="give centroids (CSV, JSON) or an image"
            )
        response = client.identify(database, frames, options)
        if picture is not None:
            drawn = client.picture(database, frames, options, picture.suffix.lower()[1:])
            picture.write_bytes(drawn)
    tally = print_contents(
        response["frames"],
        response["database"],
        as_json=parameters["json"],
        as_lines=parameters["ndjson"],
    )
    for note in response["notes"]:
        say(note)
    if parameters["fail_on_no_match"]:
        tally.expect_all_identified()


def _options_of(parameters: Mapping[str, Any]) -> dict[str, Any]:
    from starcat.cli.options import options_of_line
    from starcat.storage.regular_files import read_regular_file
    from starcat.storage.toml_files import MAX_BYTES

    camera: Path | None = parameters["camera"]
    try:
        text = None
        if camera is not None:
            text = read_regular_file(camera, MAX_BYTES).decode("utf-8")
    except (SourceError, UnicodeDecodeError) as error:
        raise ConfigError(f"{error}; expected a camera file", key="camera") from error
    return replace(options_of_line(parameters), camera=text).stated()


def _of_stdin(folder: Path) -> Path:
    text = sys.stdin.read()
    path = folder / ("stdin.json" if text.lstrip()[:1] in ("{", "[") else "stdin.csv")
    path.write_text(text, encoding="utf-8")
    return path


def client_of(context: typer.Context) -> Client:
    """Return a client of the service; refuse options that the service does not accept."""
    for name in LOCAL_OPTIONS[context.info_name or ""]:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            option = next(
                parameter for parameter in context.command.params if parameter.name == name
            ).opts[0]
            raise ConfigError(f"{option} does not go with --server", key=name, hint="leave it out")
    client: Client = context.obj
    return client
