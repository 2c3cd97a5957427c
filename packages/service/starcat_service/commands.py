"""The commands that run the service, and manage its tokens."""

from __future__ import annotations

import gc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from starcat.cli import Json, print_json, print_json_line, say, show_result
from starcat.errors import ConfigError, TargetMissing
from starcat.version import install_command

if TYPE_CHECKING:
    from starcat_service.security.tokens import Token, TokenStore

app = typer.Typer()
tokens = typer.Typer(
    name="token",
    help="Create, list and revoke tokens, which set a user's permissions.\n\n"
    "Example: starcat token create anna --role builder --root service",
    no_args_is_help=True,
)
app.add_typer(tokens)

Root = Annotated[Path, typer.Option(help="Folder with all data of the service.")]


@app.command("serve")
def serve_command(
    root: Root = Path("service"),
    host: Annotated[str | None, typer.Option(help="Address; default: 127.0.0.1.")] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port; default: 8000, 0 for any.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=0, max=64, help="Jobs at the same time; default: 1.")
    ] = None,
    json: Json = False,
) -> None:
    """Run the service: a page, a REST interface, TAP and a registry, from one folder.

    It prints its address when it listens, and ends at Ctrl-C or a termination signal.

    Example: starcat serve --root service --port 8000
    """
    with _service_installed(), _without_collection():
        from starcat_service.server import run_server
    from starcat_service.settings import read_settings

    def announce(address: str) -> None:

        if json:
            print_json_line({"address": address, "root": str(root)})
        else:
            say(f"starcat serves {root} at {address}")

    run_server(read_settings(root, host=host, port=port, workers=workers), announce)


@tokens.command("create")
def create(
    name: Annotated[str, typer.Argument(help="Of who gets it: letters, digits and ._@-.")],
    role: Annotated[
        Literal["reader", "builder", "publisher"],
        typer.Option(help="A builder may also read, a publisher also build."),
    ],
    expires: Annotated[
        float | None, typer.Option(min=0.001, metavar="DAYS", help="Days that it is valid.")
    ] = None,
    root: Root = Path("service"),
    json: Json = False,
) -> None:
    """Create a token and print it, once: only its digest is kept.

    Example: starcat token create anna --role builder --expires 365 --root service
    """
    with _tokens_of(root, name) as store:
        from starcat_service.settings import Role

        token, text = store.create(name, Role.named(role), expires)

    if json:
        print_json({**token.as_dict(), "token": text})
        return
    typer.echo(text)
    say(f"the token of {token.name}, a {role}; it is shown this once, so keep it now")


@tokens.command("list")
def list_tokens(root: Root = Path("service"), json: Json = False) -> None:
    """List the tokens: name, role, state, and end of validity.

    Example: starcat token list --root service
    """
    with _tokens_of(root) as store:
        _show_tokens(store.all(), as_json=json)


@tokens.command("revoke")
def revoke(
    name: Annotated[str, typer.Argument(help="Name or id of the token.")],
    root: Root = Path("service"),
    json: Json = False,
) -> None:
    """Revoke a token, and end the sessions that were begun with it.

    Example: starcat token revoke anna --root service
    """
    with _tokens_of(root) as store:
        _show_tokens(store.revoke(name), as_json=json)


def _show_tokens(listed: Sequence[Token], *, as_json: bool) -> None:
    shown = ("id", "name", "role", "state", "created", "expires")
    show_result([token.as_dict() for token in listed], as_json=as_json, columns={"": shown})


@contextmanager
def _tokens_of(root: Path, new: str | None = None) -> Iterator[TokenStore]:
    """Return the tokens of a service; create the service if `new` is to be its first token."""
    with _service_installed():
        from starcat_service.paths import ServicePaths
        from starcat_service.records import Records
        from starcat_service.security.tokens import TokenStore, check_name
    from starcat_service.settings import read_settings

    paths = ServicePaths(read_settings(root).root)
    if new is not None:
        check_name(new)
    elif not paths.records.exists():
        raise TargetMissing(f"{root}: no service has ever used this folder", hint="give its --root")
    paths.make()
    records = Records(paths.records)
    try:
        yield TokenStore(records)
    finally:
        records.close()


@contextmanager
def _without_collection() -> Iterator[None]:
    """Import without garbage collection, which finds nothing and takes a quarter of the time."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


@contextmanager
def _service_installed() -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the service needs {error.name}", hint=install_command("service")
        ) from error
