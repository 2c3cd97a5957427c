"""What the terminal shows: brackets as they are, bars that say how much of what."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import pytest
from rich.console import Console

from starcat.cli.console import StageBars, print_table, show_result
from starcat.cli.databases import print_verification
from starcat.database.verify import Finding, Verification
from starcat.pipeline.rebuild import FileChange, Rebuilt
from starcat.progress import BYTE_STAGES
from starcat.ship.exchange.export import Exported

BRACKETS = "/data/[old]/a[0] [bold]b[/bold] \\[c]"


def test_brackets_are_shown_as_they_are(capsys):
    """In titles, headings and cells: rich would take them for markup."""
    print_table(f"t {BRACKETS}", (f"h {BRACKETS}",), [(f"c {BRACKETS}",)])
    lines = capsys.readouterr().out.splitlines()
    assert [line.rstrip() for line in lines] == [f"{k} {BRACKETS}" for k in "thc"]


def test_no_command_escapes_them_once_more(capsys):
    folder = Path("/data/[old]")
    show_result(Exported("a", "csv", folder, (), False))
    finding = Finding("stars.parquet", "stars", f"{folder}: gone")
    print_verification(Verification(folder / "a-1.0.0", 1, (finding,)))
    change = FileChange("stars.parquet", f"{folder}: differs")
    show_result(Rebuilt("a", 1, (change,), (), "different"))
    shown = capsys.readouterr().out
    assert shown.count("/data/[old]") == 3
    assert "\\" not in shown


@dataclass(frozen=True)
class Spread:
    """A record in a result."""

    least: int
    most: int


@dataclass(frozen=True)
class Counted:
    """A result with records in it."""

    fields: int
    stars: Spread
    pairs: Spread
    bytes_by_file: dict[str, int]


def test_records_with_the_same_fields_are_rows_of_one_table(capsys):
    counted = Counted(2, Spread(1, 3), Spread(0, 3000), {"stars.parquet": 1234})
    show_result(counted, columns={"bytes_by_file": ("file", "bytes")})
    assert [line.split() for line in capsys.readouterr().out.splitlines()] == [
        ["fields", "2"],
        ["bytes", "by", "file"],
        ["file", "bytes"],
        ["stars.parquet", "1,234"],
        ["least", "most"],
        ["stars", "1", "3"],
        ["pairs", "0", "3,000"],
    ]
    show_result(counted, columns={"stars": ()})
    assert [line.split() for line in capsys.readouterr().out.splitlines()] == [
        ["fields", "2"],
        ["bytes", "by", "file", "stars", "parquet", "1,234"],
    ]


def drawn(bars: StageBars) -> list[str]:
    """The lines of the bars, without colours."""
    out = io.StringIO()
    Console(file=out, width=100, color_system=None).print(bars.get_renderable())
    return out.getvalue().splitlines()


@pytest.fixture
def bars() -> StageBars:
    return StageBars(Console(file=io.StringIO(), force_terminal=True, width=100))


def test_bytes_have_units_and_counts_have_separators(bars):
    bars.show("read sao", 1_500_000, 51_000_000)
    bars.show("self-test", 1234, 5000)
    bars.show("fetch [a].gz", 10, None)
    lines = drawn(bars)
    assert "1.5 MB / 51.0 MB" in lines[0]
    assert "1,234 / 5,000" in lines[1]
    assert lines[2].startswith("fetch [a].gz")
    assert {"fetch", "publish", "pull", "read"} == {*BYTE_STAGES}


def test_a_stage_without_a_total_ends_when_the_next_begins(bars):
    bars.show("product pairs", 0, None)
    assert "done" not in drawn(bars)[0]
    bars.show("product grid", 0, None)
    first, second = bars.tasks
    assert first.finished
    assert not second.finished
    assert "done" in drawn(bars)[0]
    assert "done" not in drawn(bars)[1]
    stopped = first.finished_time
    bars.show("verify", 3, 10)
    assert (bars.tasks[1].finished, bars.tasks[2].finished) == (True, False)
    assert first.finished_time == stopped is not None


def test_a_stage_that_knows_its_total_ends_by_itself(bars):
    bars.show("read sao", 1, 10)
    bars.show("read gaia", 10, 10)
    assert [task.finished for task in bars.tasks] == [False, True]
    bars.show("read sao", 10, 10)
    assert [task.finished for task in bars.tasks] == [True, True]
