"""The commands that a service can do instead: building, asking, identifying."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from starcat.errors import ConfigError, QueryError

if TYPE_CHECKING:
    from starcat.client import Client
    from starcat.specs.build_spec import BuildSpec

COMMANDS = ("build", "sql", "identify")

NOT_THERE = {
    "build": ("inputs", "replace", "workers", "max_memory"),
    "sql": ("show_views", "preamble", "memory_limit_gb"),
    "identify": ("dark", "mask", "time", "velocity", "orbit", "wcs", "track"),
}
"""Options that mean nothing there, or that a service does not take."""

OF_IDENTIFY = (
    *("method", "tolerance_px", "noise_px", "noise_mag", "max_false_match_probability"),
    *("min_share", "max_steps", "time_limit_s", "flip", "psf_sigma_px", "threshold"),
    *("most_spots", "plane", "bayer", "prior_error_deg"),
)
"""Options that have the same name and value there."""


def there(url: str, token: str | None, command: str) -> Client:
    """Return the service that a command line names."""
    if not url.startswith(("http://", "https://")):
        raise ConfigError(
            f"--server {url!r}: expected an address such as http://127.0.0.1:8000", key="server"
        )
    if command not in COMMANDS:
        raise ConfigError(
            f"--server does not go with 'starcat {command}', which runs here; it goes with "
            + ", ".join(COMMANDS),
            key="server",
        )
    from starcat.client import Client

    return Client(url, token)


def build_there(context: typer.Context, spec: BuildSpec, output: Path, *, as_json: bool) -> None:
    """Have a database built by a service, bring it here, and print what it holds."""
    from starcat.artifact.reader import open_artifact
    from starcat.cli.terminal.builds import print_artifact, print_rates
    from starcat.cli.terminal.console import print_json, progress_bars, say
    from starcat.simulation.selftest import rates_of

    client = _client(context)
    with progress_bars() as progress:
        job = client.build(spec.recorded(), progress)
        database = str(job["result"]["database"])
        folder, outcome = client.download(database, output, progress)
    report = client.report(database)
    for warning in report["warnings"]:
        say(f"warning: {warning}")
    artifact = open_artifact(folder)
    if as_json:
        kept = ("filters", "coverage", "self_test", "warnings")
        print_json(
            {
                "artifact": str(folder),
                "report": str(folder / "report" / "index.html"),
                "outcome": outcome,
                "database": database,
                "job": job["id"],
                **{key: report[key] for key in kept},
                **{key: artifact.manifest[key] for key in ("sources", "products", "files")},
            }
        )
        return
    print_artifact(artifact, as_json=False)
    print_rates(list(map(rates_of, report["self_test"])), as_json=False)
    say(f"{outcome}: {folder}")
    say(f"database {database} of {client.url}")


def sql_there(
    context: typer.Context,
    targets: list[str],
    query: str | None,
    named: str | None,
    values: Mapping[str, str],
    form: str | None,
    output: Path | None,
    rows: int,
    time_limit_s: float,
) -> None:
    """Ask a service a question in SQL, and print or keep the answer."""
    from starcat.cli.terminal.asking import Wish, format_of_wish
    from starcat.cli.terminal.console import say
    from starcat.cli.terminal.queries import print_result
    from starcat.query.gallery import guessed
    from starcat.query.result import ResultTable

    client = _client(context)
    if query is None and named is None:
        raise QueryError("--server needs the query on the line, or --named; there is no prompt")
    if not targets:
        raise QueryError("name what the query is about: the id or the title of a database")
    wanted = format_of_wish(Wish(query, named, values, form, output))
    texts = dict(values) if named else {name: guessed(text) for name, text in values.items()}
    if wanted == "table":
        found = client.sql(
            targets, query, texts, named=named, max_rows=rows, time_limit_s=time_limit_s
        )
        print_result(ResultTable.from_json(found))
        return
    asked = (targets, query, texts)
    if output is not None:
        count = client.sql_file(output, wanted, *asked, named=named, time_limit_s=time_limit_s)
        say(f"{output}: {count:,} rows")
        return
    with tempfile.TemporaryDirectory(prefix="starcat-") as folder:
        path = Path(folder) / "answer"
        client.sql_file(path, wanted, *asked, named=named, time_limit_s=time_limit_s)
        sys.stdout.write(path.read_text(encoding="utf-8"))


def identify_there(context: typer.Context, database: str, file: Path) -> None:
    """Have a service identify frames, and print the answers."""
    from starcat.cli.terminal.console import say
    from starcat.cli.terminal.matches import print_contents

    client, given = _client(context), context.params
    picture: Path | None = given["picture"]
    if picture is not None and picture.suffix.lower() not in (".png", ".svg"):
        raise ConfigError(f"{picture}: the picture is PNG or SVG; end its name so", key="picture")
    options = _options_of(given)
    with tempfile.TemporaryDirectory(prefix="starcat-") as folder:
        frames = file if str(file) != "-" else _of_stdin(Path(folder))
        if not frames.is_file():
            raise ConfigError(f"{frames}: cannot be read (No such file or directory)")
        found = client.identify(database, frames, options)
        if picture is not None:
            drawn = client.picture(database, frames, options, picture.suffix.lower()[1:])
            picture.write_bytes(drawn)
    told = print_contents(
        found["frames"], found["database"], as_json=given["json"], as_lines=given["ndjson"]
    )
    for note in found["notes"]:
        say(note)
    if given["fail_on_no_match"]:
        told.expect_all_identified()


def _options_of(given: Mapping[str, Any]) -> dict[str, Any]:
    from starcat.cli.commands.expected import chosen_prior
    from starcat.cli.commands.shared import share_of_percent, unknown_field

    options = {name: given[name] for name in OF_IDENTIFY if given[name] is not None}
    prior = chosen_prior(given["prior_q"], given["prior_error_deg"], track=False)
    size_px, fov_deg = unknown_field(given["size"], given["fov"], given["fov_error"])
    camera: Path | None = given["camera"]
    try:
        text = None if camera is None else camera.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{camera}: cannot be read ({error})", key="camera") from error
    more = {
        "prior_q": None if prior is None else prior[0],
        "size_px": size_px,
        "fov_deg": fov_deg,
        "fov_error": share_of_percent(given["fov_error"]),
        "camera": text,
    }
    return options | {name: value for name, value in more.items() if value is not None}


def _of_stdin(folder: Path) -> Path:
    text = sys.stdin.read()
    path = folder / ("stdin.json" if text.lstrip()[:1] in ("{", "[") else "stdin.csv")
    path.write_text(text, encoding="utf-8")
    return path


def _client(context: typer.Context) -> Client:
    """Return the service; refuse options that it does not take."""
    for name in NOT_THERE[context.info_name or ""]:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            option = next(one for one in context.command.params if one.name == name).opts[0]
            raise ConfigError(f"{option} does not go with --server; leave it out", key=name)
    client: Client = context.obj
    return client
