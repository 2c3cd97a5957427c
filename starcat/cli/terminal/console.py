"""What the command line shows: tables that fit 100 columns, progress bars, JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from rich.console import Console
from rich.filesize import decimal
from rich.progress import (
    BarColumn,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.progress import Progress as Bars
from rich.table import Table
from rich.text import Text

from starcat.failures import AT_STAGE
from starcat.progress import BYTE_STAGES, ROW_STAGE, Progress

MAX_WIDTH = 100


def out() -> Console:
    """Return the console for results."""
    width = min(Console().width, MAX_WIDTH) if sys.stdout.isatty() else MAX_WIDTH
    return Console(highlight=False, markup=False, width=width)


def print_json(content: Any) -> None:
    """Print a value as JSON on stdout."""
    sys.stdout.write(json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def print_json_line(content: Any) -> None:
    """Print a value as JSON on a line of its own, and see that it arrives at once."""
    sys.stdout.write(json.dumps(content, ensure_ascii=False) + "\n")
    sys.stdout.flush()


def print_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], numbers: Sequence[int] = ()
) -> None:
    """Print a table on stdout."""
    # Texts, not strings: rich takes strings for markup, and brackets are units and folders here.
    heading = Text(title, style="italic") if title else None
    table = Table(title=heading, title_justify="left", box=None, pad_edge=False)
    for k, name in enumerate(columns):
        table.add_column(Text(name), justify="right" if k in numbers else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(str(cell)) for cell in row))
    out().print(table)


def say(text: str) -> None:
    """Print a message on stderr."""
    sys.stderr.write(text + "\n")


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Draw a bar a stage on stderr while work goes on; nothing where it is not a terminal.

    An exception that passes gets a note with the stage that it was raised in.
    """
    console = Console(stderr=True, markup=False)
    reached = [""]
    with ExitStack() as stack:
        bars = stack.enter_context(StageBars(console)) if console.is_terminal else None

        def draw(stage: str, done: int, total: int | None) -> None:
            reached[0] = stage
            if bars is not None:
                bars.show(stage, done, total)

        try:
            yield draw
        except Exception as error:
            if reached[0]:
                error.add_note(f"{AT_STAGE}{reached[0]}")
            raise


class StageBars(Bars):
    """A bar a stage, one below the other."""

    def __init__(self, console: Console) -> None:
        columns = (
            TextColumn("{task.description:<22}", markup=False),
            BarColumn(),
            AmountColumn(),
            TimeElapsedColumn(),
            RateColumn(),
        )
        super().__init__(*columns, console=console, transient=True)
        self.stages: dict[str, TaskID] = {}

    def show(self, stage: str, done: int, total: int | None) -> None:
        """Draw an event."""
        if stage not in self.stages:
            self.end_open()
            self.stages[stage] = self.add_task(stage, total=total)
        self.update(self.stages[stage], completed=done, total=total)

    def end_open(self) -> None:
        """Fill the bars, and stop the clocks, of the stages that do not know their total."""
        for task in self.tasks:
            if task.total is None:
                end = max(1, int(task.completed))
                self.update(task.id, completed=end, total=end, is_uncounted=True)


class AmountColumn(ProgressColumn):
    """How much of a stage is done: bytes with units, other things with separators."""

    def render(self, task: Task) -> Text:
        """Return the amount."""
        done, total = int(task.completed), task.total
        if task.fields.get("is_uncounted"):
            return Text("done" if done == 1 else f"{done:,}")
        if total is None:
            return Text(f"{done:,}" if done else "")
        if task.description.split(" ")[0] in BYTE_STAGES:
            return Text(f"{decimal(done)} / {decimal(int(total))}")
        return Text(f"{done:,} / {int(total):,}")


class RateColumn(ProgressColumn):
    """How fast rows go, and the time that is left; empty for other stages."""

    def render(self, task: Task) -> Text:
        """Return rate and time."""
        elapsed, total = task.finished_time or task.elapsed, task.total
        if task.description.split(" ")[0] != ROW_STAGE or not elapsed or not task.completed:
            return Text("")
        rate = task.completed / elapsed
        left = 0 if total is None else round(max(0.0, total - task.completed) / rate)
        ending = f", {left // 60}:{left % 60:02} left" if left else ""
        return Text(f"{rate:,.0f}/s{ending}")
