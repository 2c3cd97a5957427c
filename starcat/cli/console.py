"""What the command line shows: tables that fit 100 columns, progress bars, JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from string import Formatter
from typing import TYPE_CHECKING, Any

from starcat.cli import interrupts
from starcat.failures import AT_STAGE
from starcat.progress import Progress

if TYPE_CHECKING:
    from rich.console import Console

MAX_WIDTH = 100


def out() -> Console:
    """Return the console for results."""
    from rich.console import Console

    width = min(Console().width, MAX_WIDTH) if sys.stdout.isatty() else MAX_WIDTH
    return Console(highlight=False, markup=False, width=width)


def print_json(content: Any) -> None:
    """Print a value as JSON on stdout."""
    sys.stdout.write(json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def show(as_json: bool, facts: Any, print_tables: Callable[..., object], *shown: Any) -> None:
    """Print facts as JSON, or what is shown of them as tables."""
    if as_json:
        print_json(facts)
    else:
        print_tables(*shown)


def print_json_line(content: Any) -> None:
    """Print a value as JSON on a line of its own, and see that it arrives at once."""
    sys.stdout.write(json.dumps(content, ensure_ascii=False) + "\n")
    sys.stdout.flush()


def print_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], numbers: Sequence[int] = ()
) -> None:
    """Print a table on stdout."""
    from rich.table import Table
    from rich.text import Text

    # Texts, not strings: rich takes strings for markup, and brackets are units and folders here.
    heading = Text(title, style="italic") if title else None
    table = Table(title=heading, title_justify="left", box=None, pad_edge=False)
    for k, name in enumerate(columns):
        table.add_column(Text(name), justify="right" if k in numbers else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(str(cell)) for cell in row))
    out().print(table)


def print_facts(title: str, facts: Mapping[str, Any]) -> None:
    """Print names and values as a table of two columns."""
    print_table(title, ("", ""), list(facts.items()))


class _Cells(Formatter):
    """Formats of cells, with a text for None."""

    def __init__(self, nothing: str) -> None:
        self.nothing = nothing

    def format_field(self, value: Any, format_spec: str) -> str:
        return self.nothing if value is None else str(super().format_field(value, format_spec))


def print_things(
    title: str,
    things: Iterable[Any],
    columns: Mapping[str, str],
    numbers: Sequence[int] = (),
    nothing: str = "",
) -> None:
    """Print a table with a row a thing; a column is a heading and the format of its cells."""
    cells = _Cells(nothing)
    rows = [[cells.format(text, thing) for text in columns.values()] for thing in things]
    print_table(title, list(columns), rows, numbers)


def warn(texts: Iterable[str]) -> None:
    """Print warnings on stderr."""
    for text in texts:
        say(f"warning: {text}")


def say(text: str) -> None:
    """Print a message on stderr."""
    sys.stderr.write(text + "\n")


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Draw a bar a stage on stderr while work goes on; nothing where it is not a terminal.

    An exception that passes gets a note with the stage that it was raised in.
    """
    from rich.console import Console

    console = Console(stderr=True, markup=False)
    reached = [""]
    with ExitStack() as stack:
        bars = None
        if console.is_terminal:
            from starcat.cli.bars import StageBars

            bars = stack.enter_context(StageBars(console))

        def draw(stage: str, done: int, total: int | None) -> None:
            interrupts.check_interrupt()
            reached[0] = stage
            if bars is not None:
                bars.show(stage, done, total)

        try:
            yield draw
        except Exception as error:
            if reached[0]:
                error.add_note(f"{AT_STAGE}{reached[0]}")
            raise
