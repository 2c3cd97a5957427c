"""The tables of an evaluation: one description for terminal, HTML and Markdown.

All is made of the plain values of `Outcome.as_dict`, so a stored evaluation prints as a fresh
one does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from starcat.evaluation.report.columns import LONG, Column, Line, marked_verdict


@dataclass(frozen=True)
class Table:
    """A table of texts."""

    title: str
    heads: tuple[str, ...]  # headings of the columns
    rows: tuple[tuple[str, ...], ...]
    numbers: tuple[int, ...]  # columns that are aligned at the right
    notes: tuple[str, ...] = ()


def groups_of(lines: Iterable[Line]) -> dict[str, list[Line]]:
    """Return lines by their group."""
    groups: dict[str, list[Line]] = {}
    for line in lines:
        groups.setdefault(line["group"], []).append(line)
    return groups


def rate_tables(content: Mapping[str, Any], columns: Sequence[Column]) -> list[Table]:
    """Return a table of rates a group."""
    tables = []
    for group, lines in groups_of(content["rows"]).items():
        shown = [column for column in columns if column.is_wanted(lines)]
        cells = tuple((line["label"], *(column.cell(line) for column in shown)) for line in lines)
        heads = ("", *(column.head for column in shown))
        texts = {"", "method", "goal" if columns is LONG else "", "reached"}
        numbers = tuple(k for k, head in enumerate(heads) if head not in texts)
        tables.append(Table(group, heads, cells, numbers, _notes(lines)))
    return tables


def statistic_tables(
    content: Mapping[str, Any], reached: Callable[[Line], str] = marked_verdict
) -> list[Table]:
    """Return a table of the numbers that need no trial, a group."""
    tables = []
    for group, lines in groups_of(content["statistics"]).items():
        has_goal = any(line["goal"] is not None for line in lines)
        rows = []
        for line in lines:
            values = [_number(line[key]) for key in ("published", "measured", "goal")]
            ends = [values[2], reached(line)] if has_goal else []
            rows.append((line["label"], line["unit"], *values[:2], *ends))
        heads = ("", "unit", "paper", "measured", *(("goal", "reached") if has_goal else ()))
        numbers = (2, 3, 4) if has_goal else (2, 3)
        tables.append(Table(group, heads, tuple(rows), numbers, _notes(lines)))
    return tables


def _notes(lines: Sequence[Line]) -> tuple[str, ...]:
    """Return each note once, with the labels it belongs to unless that is all of them."""
    labels: dict[str, list[str]] = {}
    for line in lines:
        labels.setdefault(line["note"], []).append(line["label"])
    return tuple(
        note if len(labels) == 1 else f"{', '.join(dict.fromkeys(owners))}: {note}"
        for note, owners in labels.items()
        if note
    )


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:,.0f}" if value == int(value) else f"{value:,.4g}"


def failure_table(content: Mapping[str, Any]) -> Table | None:
    """Return why frames failed, for the rows that miss their goal."""
    lines = [line for line in content["rows"] if line["is_goal_reached"] is False]
    if not lines:
        return None
    causes = tuple(lines[0]["failures"])
    rows = tuple(
        (
            f"{line['group']}: {line['label']}",
            f"{line['frames']:,}",
            f"{sum(line['failures'].values()):,}",
            *(f"{line['failures'][cause]:,}" for cause in causes),
        )
        for line in lines
    )
    heads = ("", "frames", "failed", *causes)
    return Table("Goals that are missed: what failed", heads, rows, tuple(range(1, len(heads))))


def summary_table(contents: Sequence[Mapping[str, Any]]) -> Table | None:
    """Return what each paper came to."""
    rows, has_any = [], False
    for content in contents:
        lines = [*content["rows"], *content["statistics"]]
        goals = [line["is_goal_reached"] for line in lines if line["is_goal_reached"] is not None]
        trials = {line["trial"]["name"]: line["frames"] for line in content["rows"]}
        printed = [line for line in content["rows"] if line["published_percent"] is not None]
        above = [line["by_rule"]["high_percent"] >= line["published_percent"] for line in printed]
        has_any = has_any or bool(above or goals)
        rows.append(
            (
                content["name"],
                content["title"],
                f"{sum(trials.values()):,}",
                f"{sum(above)} of {len(above)}" if above else "",
                f"{sum(goals)} of {len(goals)}" if goals else "",
            )
        )
    heads = ("", "about", "frames", "as good as the paper", "goals reached")
    note = "As good as the paper: its figure is not above the interval of the measured one."
    if not has_any:
        return None
    return Table("At a glance", heads, tuple(rows), (2, 3, 4), (note,))
