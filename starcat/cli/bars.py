"""Progress bars: one per stage, with amounts and rates."""

from __future__ import annotations

from rich.console import Console
from rich.filesize import decimal
from rich.progress import BarColumn, ProgressColumn, Task, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars
from rich.text import Text

from starcat.progress import BYTE_STAGES, ROW_STAGE


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
