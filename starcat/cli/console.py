"""The output of the command line: tables, messages, progress bars, and panels of options."""

from __future__ import annotations

import json
import shlex
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from string import Formatter
from typing import TYPE_CHECKING, Any, get_args

from rich.console import Console
from rich.filesize import decimal
from rich.progress import BarColumn, ProgressColumn, Task, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars
from rich.text import Text
from typer.core import TyperCommand, TyperGroup

from starcat.cli import interrupts
from starcat.failures import AT_STAGE
from starcat.matcher.options import Panel
from starcat.progress import BYTE_STAGES, ROW_STAGE, Progress
from starcat.results import flat, label_and_unit, plain, text_of

if TYPE_CHECKING:
    from rich.console import Console


class StageBars(Bars):
    """One progress bar per stage."""

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
        """Fill the bars, and stop the clocks, of stages whose total is unknown."""
        for task in self.tasks:
            if task.total is None:
                end = max(1, int(task.completed))
                self.update(task.id, completed=end, total=end, is_uncounted=True)


class AmountColumn(ProgressColumn):
    """The finished amount of a stage: bytes with units, other things with separators."""

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
    """Rows per second and the time left; empty for stages that do not count rows."""

    def render(self, task: Task) -> Text:
        """Return rate and time."""
        elapsed, total = task.finished_time or task.elapsed, task.total
        if task.description.split(" ")[0] != ROW_STAGE or not elapsed or not task.completed:
            return Text("")
        rate = task.completed / elapsed
        remaining_s = 0 if total is None else round(max(0.0, total - task.completed) / rate)
        ending = f", {remaining_s // 60}:{remaining_s % 60:02} left" if remaining_s else ""
        return Text(f"{rate:,.0f}/s{ending}")


PANELS = {
    "Design a database": ("sources", "bands", "presets", "init", "estimate", "blend"),
    "Build it": ("fetch", "ingest", "crossmatch", "build", "rebuild"),
    "Check it": ("inspect", "verify", "coverage", "diff", "selftest", "evaluate", "doctor"),
    "Use it": ("simulate", "identify", "plan", "calibrate", "learn", "methods", "sql"),
    "Ship it": ("export", "publish", "pull", "releases", "keys"),
    "Serve it": ("serve", "token"),
}
"""The commands in the order of --help."""


class WholeSummaries(TyperGroup):
    """The list of commands in the help; each has its whole first sentence."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the commands in the order of the panels."""
        return [name for names in PANELS.values() for name in names]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a panel for each step of the work, with one or more lines per command."""
        for panel, names in PANELS.items():
            with formatter.section(panel):
                formatter.write_dl(
                    [(name, self.commands[name].get_short_help_str(limit=1000)) for name in names]
                )


class OptionsInPanels(TyperCommand):
    """A command with many options: its help groups them by their panels, in this order.

    Options without a panel are about the output.
    """

    panels: tuple[str, ...] = get_args(Panel)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write a panel for the arguments, and one for each group of options."""
        records: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is not None:
                is_option = param.param_type_name == "option"
                panel = getattr(param, "rich_help_panel", None) or self.panels[-1]
                records.setdefault(panel if is_option else "Arguments", []).append(record)
        for panel in ("Arguments", *self.panels):
            with formatter.section(panel):
                formatter.write_dl(records[panel])


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
    """Print facts as JSON, or ``shown`` as tables."""
    if as_json:
        print_json(facts)
    else:
        print_tables(*shown)


def show_result(
    result: Any,
    title: str = "",
    *,
    as_json: bool = False,
    columns: Mapping[str, Sequence[str]] | None = None,
) -> None:
    """Print a result, or a list of results, as JSON or as tables.

    A list of results is a table. Any other result is a table of its values, and a table for each
    list of records in it, for each dictionary of records, and for records with the same fields.
    ``columns`` has the keys to be shown of each table, by its key, and of the values of the result
    itself by ``""``; by default all are shown. For a dictionary of numbers it names a column of
    keys and a column of values, which makes it a table.
    """
    content, columns = plain(result), columns or {}
    if as_json:
        print_json(content)
        return
    if isinstance(content, list):
        print_rows(content, title, columns.get("", ()))
        return
    tables = _tables_in(content, columns)
    facts = {key: value for key, value in content.items() if not any(key in k for k in tables)}
    print_record(facts, title, columns.get("", ()))
    for keys, rows in tables.items():
        if columns.get(keys[0]) != ():
            name = ", ".join(filter(None, label_and_unit(keys[0]))) if len(keys) == 1 else ""
            print_rows(rows, name, columns.get(keys[0], ()))


Row = dict[str, Any]


def _tables_in(
    content: Mapping[str, Any], columns: Mapping[str, Sequence[str]]
) -> dict[tuple[str, ...], list[Row]]:
    """Return the rows of each table in a record, by the keys that the table shows."""
    tables: dict[tuple[str, ...], list[Row]] = {}
    alike: dict[tuple[str, ...], list[str]] = {}
    for key, value in content.items():
        if rows := _rows_of(key, value, columns):
            tables[key,] = rows
        elif isinstance(value, dict) and value:
            alike.setdefault(tuple(value), []).append(key)
    for keys in alike.values():
        if len(keys) > 1:
            tables[tuple(keys)] = [{"": label_and_unit(key)[0], **content[key]} for key in keys]
    return tables


def _rows_of(key: str, value: Any, columns: Mapping[str, Sequence[str]]) -> list[Row]:
    """Return the rows of a list of records, or of a dictionary; none of other values."""
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return value
    if not isinstance(value, dict):
        return []
    if not any(isinstance(item, dict) for item in value.values()):
        names = columns.get(key, ())
        return [dict(zip(names, item, strict=True)) for item in value.items()] if names else []
    if (
        all(isinstance(item, dict) for item in value.values())
        and len(set(map(tuple, value.values()))) == 1
    ):
        return [{"": name, **item} for name, item in value.items()]
    return []


def print_record(record: Mapping[str, Any], title: str = "", columns: Sequence[str] = ()) -> None:
    """Print the labels, values and units of a record; a value that is None is "-"."""
    facts = flat(record)
    rows = []
    for key in columns or facts:
        label, unit = label_and_unit(key)
        is_number = isinstance(facts[key], int | float | list)
        rows.append((label, f"{text_of(key, facts[key])} {unit if is_number else ''}".rstrip()))
    _print_title(title)
    print_table("", ("", ""), rows, has_heads=False)


def _print_title(title: str) -> None:
    if title:  # above the table, because rich folds the title of a narrow table
        out().print(Text(title, style="italic"))


MAX_ROWS = 40
"""Most rows of a list of records in a table; ``--json`` has all."""
MAX_HEAD = 12
"""Width in characters; a heading that is wider, and wider than its column, has more lines."""
FOLDED_CHARACTERS = 28
"""Width in characters; longer texts in a column are folded."""


def print_rows(
    rows: Sequence[Mapping[str, Any]], title: str = "", columns: Sequence[str] = ()
) -> None:
    """Print a table with one row per record, or each record by itself if the table is too wide.

    ``columns`` are the keys to be shown; by default all.
    A column without a value is left out.
    """
    if not rows:
        return
    shown = [flat(row) for row in rows[:MAX_ROWS]]
    all_keys = dict.fromkeys(key for row in shown for key in row)
    keys = [key for key in columns or all_keys if any(row.get(key) is not None for row in shown)]
    cells = [[_cell(key, row.get(key)) for key in keys] for row in shown]
    heads = [_head(key, column) for key, column in zip(keys, zip(*cells, strict=True), strict=True)]
    more = f"the first {len(shown)} of {len(rows):,}" if len(rows) > len(shown) else ""
    title = ", ".join(filter(None, (title, more)))
    if table_width(heads, cells) > MAX_WIDTH:
        for number, row in enumerate(shown, 1):
            named = ", ".join(filter(None, (title, f"row {number}")))
            print_record(row, named, keys)
        return
    numbers = [k for k, key in enumerate(keys) if all(_is_number(row.get(key)) for row in shown)]
    _print_title(title)
    print_table("", heads, cells, numbers)


def _head(key: str, cells: Sequence[str]) -> str:
    """Return the heading of a column; the words of a wide one stand below each other."""
    label, unit = label_and_unit(key)
    lines = textwrap.wrap(label, max(MAX_HEAD, *map(len, cells)), break_long_words=False)
    return "\n".join([*lines, unit] if unit and unit != label else lines)


def _cell(key: str, value: Any) -> str:
    # The beginning of a digest is enough to distinguish it.
    is_digest = isinstance(value, str) and len(value) == 64 and " " not in value
    return value[:16] if is_digest else "" if value is None else text_of(key, value)


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def table_width(heads: Sequence[str], cells: Sequence[Sequence[str]]) -> int:
    """Return the width of a table whose long texts are folded."""
    widths = []
    for head, column in zip(heads, zip(*cells, strict=True), strict=True):
        widest = max(len(line) for cell in column for line in cell.split("\n"))
        widths.append(max(*map(len, head.split("\n")), 0, min(widest, FOLDED_CHARACTERS)))
    return sum(widths) + 2 * len(widths)


def print_json_line(content: Any) -> None:
    """Print a value as JSON on its own line, and flush."""
    sys.stdout.write(json.dumps(content, ensure_ascii=False) + "\n")
    sys.stdout.flush()


def print_table(
    title: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    numbers: Sequence[int] = (),
    *,
    has_heads: bool = True,
) -> None:
    """Print a table on stdout."""
    from rich.table import Table
    from rich.text import Text

    # Use Text: rich would read strings as markup, and brackets here are units and folders.
    heading = Text(title, style="italic") if title else None
    table = Table(
        title=heading, title_justify="left", box=None, pad_edge=False, show_header=has_heads
    )
    for k, name in enumerate(columns):
        table.add_column(Text(name), justify="right" if k in numbers else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(str(cell)) for cell in row))
    out().print(table)


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
    """Print a table with one row per thing; a column has a heading and the format of its cells."""
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


def command_line(*words: object) -> str:
    """Return a command to copy into a shell, with quotes where words need them.

    Examples
    --------
    >>> command_line("starcat", "build", "cam.toml", "--input", "mk=my catalog.csv")
    "starcat build cam.toml --input 'mk=my catalog.csv'"
    """
    return shlex.join(map(str, words))


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Draw one bar per stage on stderr during work, if stderr is a terminal.

    An exception that passes through gets a note with the stage in which it was raised.
    """
    from rich.console import Console

    console = Console(stderr=True, markup=False)
    reached = [""]
    with ExitStack() as stack:
        bars = None
        if console.is_terminal:
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
