"""The prompt of `starcat sql`: queries one after the other, with history and completion."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from starcat.cli.terminal.console import say
from starcat.cli.terminal.queries import print_first_rows, print_gallery, print_macros, print_views
from starcat.errors import StarcatError
from starcat.query.gallery import gallery, macros, named_query
from starcat.query.session import Session

HELP = """\
A query ends with a semicolon. Also:
  .views            the views      (DESCRIBE stars; tells the columns of one)
  .macros           the macros
  .list             the named queries
  .named NAME [VALUE=…]   run one of them
  .rows N           rows of a table to show
  .quit             or Ctrl-D"""

HISTORY_LINES = 2000


def history_path() -> Path:
    """Return the file that keeps the queries of earlier prompts."""
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state) / "starcat" / "sql_history"


def prompt(session: Session, rows: int, read: Callable[[str], str] = input) -> None:
    """Ask for queries and answer them, until there are no more."""
    _complete(session)
    say("starcat sql: .help tells more, .quit or Ctrl-D ends")
    shell = _Shell(session, rows)
    while True:
        try:
            text = _read_query(read)
        except EOFError:
            break
        except KeyboardInterrupt:
            say("")
            continue
        if text.split()[:1] in ([".quit"], [".exit"]):
            break
        try:
            shell.run(text)
        except StarcatError as error:
            say(f"error: {error}")
        except KeyboardInterrupt:
            say("stopped")
    _keep_history()


def _read_query(read: Callable[[str], str]) -> str:
    """Read lines up to a semicolon; a line that begins with a point, or an empty one, is alone."""
    lines: list[str] = []
    while True:
        line = read("   ...> " if lines else "starcat> ")
        lines.append(line)
        text = "\n".join(lines).strip()
        if not text or text.startswith(".") or text.endswith(";"):
            return text


class _Shell:
    """What a prompt can be told."""

    def __init__(self, session: Session, rows: int) -> None:
        self.session = session
        self.rows = rows

    def run(self, text: str) -> None:
        """Run a query or a command."""
        word, *rest = text.split() or [""]
        if word == ".views":
            print_views(self.session, as_json=False)
        elif word == ".macros":
            print_macros(as_json=False)
        elif word == ".list":
            print_gallery(as_json=False)
        elif word == ".named" and rest:
            query = named_query(rest[0])
            given = dict(item.split("=", 1) for item in rest[1:] if "=" in item)
            print_first_rows(self.session, query.text, query.with_values(given), self.rows)
        elif word == ".rows" and rest and rest[0].isdigit():
            self.rows = max(1, int(rest[0]))
        elif word.startswith("."):
            say(HELP)
        elif text:
            print_first_rows(self.session, text, {}, self.rows)


def words(session: Session) -> list[str]:
    """Return what a prompt completes."""
    known = {".help", ".views", ".macros", ".list", ".named ", ".rows ", ".quit", *gallery()}
    known |= {f"{macro.name}(" for macro in macros() if not macro.name.startswith("_")}
    for target in session.targets:
        for view in target.views:
            known |= {view.name, f"{target.name}.{view.name}"}
            known |= {column.name for column in (view.schema.columns if view.schema else ())}
    return sorted(known)


def _complete(session: Session) -> None:
    """Let the tab key complete names, and the arrows find earlier queries."""
    try:
        import readline
    except ImportError:  # Windows: the prompt works without
        return
    known = words(session)

    def complete(text: str, state: int) -> str | None:
        fitting = [word for word in known if word.startswith(text)]
        return fitting[state] if state < len(fitting) else None

    readline.set_completer(complete)
    readline.set_completer_delims(" \t\n,()=<>*+/;'\"")
    readline.parse_and_bind("tab: complete")
    with suppress(OSError):
        readline.read_history_file(history_path())


def _keep_history() -> None:
    try:
        import readline
    except ImportError:
        return
    with suppress(OSError):
        history_path().parent.mkdir(parents=True, exist_ok=True)
        readline.set_history_length(HISTORY_LINES)
        readline.write_history_file(history_path())
