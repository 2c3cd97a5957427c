"""The tables of an evaluation: one description for terminal, HTML and Markdown.

All is made of the plain values of `Outcome.as_dict`, so a stored evaluation prints as a fresh
one does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

Line = Mapping[str, Any]
"""A row of `Outcome.as_dict`, or a statistic."""


@dataclass(frozen=True)
class ReportColumn:
    """A column of a table of rates."""

    head: str  # heading of the column
    cell: Callable[[Line], str]  # text of a row
    # whether the column has any text in a group of rows
    is_wanted: Callable[[Sequence[Line]], bool] = lambda lines: True


def percent(value: float | None) -> str:
    """Return a percentage as text."""
    return "" if value is None else f"{value:.2f}"


def milliseconds(value: float | None) -> str:
    """Return a time as text: two digits, because repeated runs differ in the third."""
    if value is None:
        return ""
    if value <= 0.0:
        return "0"
    digits = 1 - math.floor(math.log10(value))
    return f"{round(value, digits):.{max(0, digits)}f}"


def method_of(line: Line) -> str:
    """Return how the frames of a row were identified."""
    method, answer = line["trial"]["method"], line["trial"]["answer"]
    return str(method if answer == "matcher" else f"{method} ({answer.replace('_', ' ')})")


def rate_difference(line: Line) -> str:
    """Return measured less published."""
    published, measured = line["published_percent"], line["by_rule"]["percent"]
    return "" if None in (published, measured) else f"{measured - published:+.2f}"


def _with_interval(line: Line) -> str:
    share = line["by_rule"]
    return f"{percent(share['percent'])} [{share['low_percent']:.1f}, {share['high_percent']:.1f}]"


def _times(line: Line) -> str:
    published = milliseconds(line["published_ms"])
    return milliseconds(line["mean_ms"]) + (f" ({published})" if published else "")


def _goal(line: Line) -> str:
    wants = []
    if line["goal_percent"] is not None:
        over = " of 4+" if line["goal_over"] == "4+" else ""
        wants.append(f"{line['goal_percent']:g} %{over}")
    if line["goal_ms"] is not None:
        wants.append(f"{line['goal_ms']:g} ms")
    return ", ".join(wants)


def verdict(line: Line) -> str:
    """Return whether a goal is reached."""
    return {None: "", True: "yes", False: "no"}[line["is_goal_reached"]]


def marked_verdict(line: Line) -> str:
    """Return whether a goal is reached, with a visible mark."""
    return {None: "", True: "✓ yes", False: "✗ no"}[line["is_goal_reached"]]


def _any(key: str) -> Callable[[Sequence[Line]], bool]:
    return lambda lines: any(line[key] is not None for line in lines)


def _has_other_rule(lines: Sequence[Line]) -> bool:
    return any(line["rule"] != "starcat" for line in lines)


def _has_methods(lines: Sequence[Line]) -> bool:
    return len({method_of(line) for line in lines}) > 1


def _is_ambiguous(lines: Sequence[Line]) -> bool:
    return _has_methods(lines) and len({line["label"] for line in lines}) < len(lines)


def _share(key: str) -> Callable[[Line], str]:
    return lambda line: percent(line[key]["percent"])


_PAPER = ReportColumn(
    "paper", lambda line: percent(line["published_percent"]), _any("published_percent")
)
_PAPER_MS = ReportColumn(
    "paper ms", lambda line: milliseconds(line["published_ms"]), _any("published_ms")
)
_CEILING = ReportColumn("ceiling", _share("ceiling"))
_ENOUGH = ReportColumn("4+", _share("by_rule_enough"))
_OWN_ENOUGH = ReportColumn("own 4+", _share("starcat_enough"), _has_other_rule)
_WRONG_BY_RULE = ReportColumn("wrong", _share("wrong_by_rule"), _has_other_rule)
_WRONG = ReportColumn("own wrong", lambda line: f"{line['wrong']:,}")
_BOTH_MS = ReportColumn("ms (paper)", _times, _any("published_ms"))
_MS = ReportColumn("ms", lambda line: milliseconds(line["mean_ms"]))
_REACHED = ReportColumn("goal", verdict, _any("is_goal_reached"))

SHORT = (
    ReportColumn("method", method_of, _is_ambiguous),
    _PAPER,
    ReportColumn("measured", _with_interval),
    _WRONG_BY_RULE,
    _CEILING,
    _ENOUGH,
    _OWN_ENOUGH,
    _WRONG,
    ReportColumn("ms", _MS.cell, lambda lines: not _BOTH_MS.is_wanted(lines)),
    _BOTH_MS,
    _REACHED,
)
"""Columns that fit a terminal."""

LONG = (
    ReportColumn("method", method_of, _has_methods),
    _PAPER,
    ReportColumn("measured [95 %]", _with_interval),
    _WRONG_BY_RULE,
    ReportColumn("difference", rate_difference, _any("published_percent")),
    _CEILING,
    _ENOUGH,
    ReportColumn("own rule", _share("starcat"), _has_other_rule),
    _OWN_ENOUGH,
    _WRONG,
    _MS,
    _PAPER_MS,
    ReportColumn("goal", _goal, _any("is_goal_reached")),
    ReportColumn("reached", marked_verdict, _any("is_goal_reached")),
)
"""Columns of a page."""

LEGEND = (
    ("paper", "what the paper prints, percent and mean milliseconds"),
    ("measured [95 %]", "successes by {rule} over all frames, percent, and Wilson's interval"),
    ("wrong", "frames with a wrong best answer by {rule}, percent; the papers answer every frame"),
    ("difference", "measured less paper, percentage points"),
    ("ceiling", "frames that hold at least four guide stars, percent: what a method that needs "
     "four can reach"),
    ("4+", "successes by {rule} over the frames with at least four guide stars"),
    ("own rule, own 4+", "the same two by starcat's own rule: {starcat}"),
    ("own wrong", "frames that starcat would have accepted with a wrong attitude"),
    ("ms", "mean time of an identification"),
    ("goal, reached", "what starcat wants to reach, of all frames or of those with four guide "
     "stars"),
)  # fmt: skip
"""Meanings of the columns; ``{starcat}`` is starcat's rule, ``{rule}`` the rule that counts."""


@dataclass(frozen=True)
class ReportTable:
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


def rate_tables(content: Mapping[str, Any], columns: Sequence[ReportColumn]) -> list[ReportTable]:
    """Return a table of rates for a group."""
    tables = []
    for group, lines in groups_of(content["rows"]).items():
        shown = [column for column in columns if column.is_wanted(lines)]
        cells = tuple((line["label"], *(column.cell(line) for column in shown)) for line in lines)
        heads = ("", *(column.head for column in shown))
        texts = {"", "method", "goal" if columns is LONG else "", "reached"}
        numbers = tuple(k for k, head in enumerate(heads) if head not in texts)
        tables.append(ReportTable(group, heads, cells, numbers, _notes(lines)))
    return tables


def limit_tables(content: Mapping[str, Any]) -> list[ReportTable]:
    """Return answered and wrong frames of each group by the accepted probability.

    None for a paper, whose methods are judged by its own rule, and for earlier results.
    """
    lines = [line for line in content["rows"] if line.get("at_limits")]
    if content["citation"]:
        return []
    return [
        ReportTable(
            f"{group}: answered / wrong frames by max_false_match_probability, percent",
            ("", *lines[0]["at_limits"]),
            tuple(
                (line["label"], *map(partial(_answered, line), line["at_limits"])) for line in lines
            ),
            tuple(range(1, 1 + len(lines[0]["at_limits"]))),
        )
        for group, lines in groups_of(lines).items()
    ]


def _answered(line: Line, limit: str) -> str:
    at = line["at_limits"][limit]
    return " / ".join(percent(100.0 * at[name] / line["frames"]) for name in ("answered", "wrong"))


def statistic_tables(
    content: Mapping[str, Any], reached: Callable[[Line], str] = marked_verdict
) -> list[ReportTable]:
    """Return a table of the numbers of a group that need no experiment."""
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
        tables.append(ReportTable(group, heads, tuple(rows), numbers, _notes(lines)))
    return tables


def _notes(lines: Sequence[Line]) -> tuple[str, ...]:
    """Return each note once, with its labels unless it belongs to all of them."""
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


def failure_table(content: Mapping[str, Any]) -> ReportTable | None:
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
    return ReportTable(
        "Goals that are missed: what failed", heads, rows, tuple(range(1, len(heads)))
    )


def summary_table(contents: Sequence[Mapping[str, Any]]) -> ReportTable | None:
    """Return what each paper came to."""
    rows, has_any = [], False
    for content in contents:
        lines = [*content["rows"], *content["statistics"]]
        goals = [line["is_goal_reached"] for line in lines if line["is_goal_reached"] is not None]
        experiments = {line["trial"]["name"]: line["frames"] for line in content["rows"]}
        printed = [line for line in content["rows"] if line["published_percent"] is not None]
        above = [line["by_rule"]["high_percent"] >= line["published_percent"] for line in printed]
        has_any = has_any or bool(above or goals)
        rows.append(
            (
                content["name"],
                content["title"],
                f"{sum(experiments.values()):,}",
                f"{sum(above)} of {len(above)}" if above else "",
                f"{sum(goals)} of {len(goals)}" if goals else "",
            )
        )
    heads = ("", "about", "frames", "as good as the paper", "goals reached")
    note = "As good as the paper: its figure is not above the interval of the measured one."
    if not has_any:
        return None
    return ReportTable("At a glance", heads, tuple(rows), (2, 3, 4), (note,))
