"""What the command line shows: tables that fit 100 columns, progress bars, JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars
from rich.table import Table

from starcat.progress import Progress

MAX_WIDTH = 100


def out() -> Console:
    """Return the console for results.

    Returns
    -------
    rich.console.Console
        On stdout, at most 100 columns wide, plain where it is not a terminal.
    """
    width = min(Console().width, MAX_WIDTH) if sys.stdout.isatty() else MAX_WIDTH
    # Brackets are units and indices here, no markup.
    return Console(highlight=False, markup=False, width=width)


def print_json(content: Any) -> None:
    """Print a value as JSON on stdout.

    Parameters
    ----------
    content : object
        Plain values.
    """
    sys.stdout.write(json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def print_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], numbers: Sequence[int] = ()
) -> None:
    """Print a table on stdout.

    Parameters
    ----------
    title : str
        Above the table; none if empty.
    columns : sequence of str
        Headings.
    rows : sequence of sequence
        Cells; anything that prints.
    numbers : sequence of int
        Columns to align at the right.
    """
    table = Table(title=title or None, title_justify="left", box=None, pad_edge=False)
    for k, name in enumerate(columns):
        table.add_column(name, justify="right" if k in numbers else "left", overflow="fold")
    for row in rows:
        table.add_row(*(str(cell) for cell in row))
    out().print(table)


def say(text: str) -> None:
    """Print a message on stderr.

    Parameters
    ----------
    text : str
        One or more lines.
    """
    sys.stderr.write(text + "\n")


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Draw a bar a stage on stderr while work goes on; nothing where it is not a terminal.

    Yields
    ------
    Progress
        The callback to hand to the work.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda stage, done, total: None
        return
    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Bars(*columns, console=console, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def draw(stage: str, done: int, total: int | None) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield draw
