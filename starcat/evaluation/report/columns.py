"""The columns of a table of rates: what each is called, holds and means."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Line = Mapping[str, Any]
"""A row of `Outcome.as_dict`, or a statistic."""


@dataclass(frozen=True)
class Column:
    """A column of a table of rates."""

    head: str  # heading of the column
    cell: Callable[[Line], str]  # text of a row
    # whether a group of rows has anything to say in it
    is_wanted: Callable[[Sequence[Line]], bool] = lambda lines: True


def percent(value: float | None) -> str:
    """Return a percentage as text."""
    return "" if value is None else f"{value:.2f}"


def milliseconds(value: float | None) -> str:
    """Return a time as text: two digits, as a second run would not agree in the third.

    Examples
    --------
    >>> [milliseconds(value) for value in (0.0434, 7.21, 68.45, 367.4, None)]
    ['0.043', '7.2', '68', '370', '']
    """
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


def difference(line: Line) -> str:
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
    """Return a row's goal in words."""
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
    """Return whether a goal is reached, with a sign that catches the eye."""
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


_PAPER = Column("paper", lambda line: percent(line["published_percent"]), _any("published_percent"))
_PAPER_MS = Column(
    "paper ms", lambda line: milliseconds(line["published_ms"]), _any("published_ms")
)
_CEILING = Column("ceiling", _share("ceiling"))
_ENOUGH = Column("4+", _share("by_rule_enough"))
_OWN_ENOUGH = Column("own 4+", _share("starcat_enough"), _has_other_rule)
_WRONG = Column("wrong", lambda line: f"{line['wrong']:,}")
_BOTH_MS = Column("ms (paper)", _times, _any("published_ms"))
_MS = Column("ms", lambda line: milliseconds(line["mean_ms"]))
_REACHED = Column("goal", verdict, _any("is_goal_reached"))

SHORT = (
    Column("method", method_of, _is_ambiguous),
    _PAPER,
    Column("measured", _with_interval),
    _CEILING,
    _ENOUGH,
    _OWN_ENOUGH,
    _WRONG,
    Column("ms", _MS.cell, lambda lines: not _BOTH_MS.is_wanted(lines)),
    _BOTH_MS,
    _REACHED,
)
"""Columns that fit a terminal."""

LONG = (
    Column("method", method_of, _has_methods),
    _PAPER,
    Column("measured [95 %]", _with_interval),
    Column("difference", difference, _any("published_percent")),
    _CEILING,
    _ENOUGH,
    Column("own rule", _share("starcat"), _has_other_rule),
    _OWN_ENOUGH,
    _WRONG,
    _MS,
    _PAPER_MS,
    Column("goal", _goal, _any("is_goal_reached")),
    Column("reached", marked_verdict, _any("is_goal_reached")),
)
"""Columns of a page."""

LEGEND = (
    ("paper", "what the paper prints, percent and mean milliseconds"),
    ("measured [95 %]", "successes by {own} over all frames, percent, and Wilson's interval"),
    ("difference", "measured less paper, percentage points"),
    ("ceiling", "frames that hold at least four guide stars, percent: what a method that needs "
     "four can reach"),
    ("4+", "successes by {own} over the frames with at least four guide stars"),
    ("own rule, own 4+", "the same two by starcat's own rule: {starcat}"),
    ("wrong", "frames that starcat would have accepted with a wrong attitude"),
    ("ms", "mean time of an identification"),
    ("goal, reached", "what starcat wants to reach, of all frames or of those with four guide "
     "stars"),
)  # fmt: skip
"""What the columns mean; ``{starcat}`` is starcat's rule, ``{own}`` says whose rule counts."""
