"""The command that runs the service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from starcat.errors import ConfigError

app = typer.Typer()

Root = Annotated[Path, typer.Option(help="Folder with all that the service keeps.")]


@app.command()
def serve(
    root: Root = Path("service"),
    host: Annotated[str | None, typer.Option(help="Address; default: 127.0.0.1.")] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port; default: 8000, 0 for any.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=0, max=64, help="Jobs at the same time; default: 1.")
    ] = None,
) -> None:
    """Run the service: a page, a REST interface, TAP and a registry, from one folder.

    Example: starcat serve --root service --port 8000
    """
    try:
        from starcat.service.server import run_server
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the service needs {error.name}: python -m pip install 'starcat-guide-stars[service]'"
        ) from error
    from starcat.service.settings import read_settings

    run_server(read_settings(root, host=host, port=port, workers=workers))
