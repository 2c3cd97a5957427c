"""An evaluation as one HTML page and as Markdown: the papers' figures beside the measured."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from typing import Any

from starcat.evaluation.rates import MEANINGS
from starcat.evaluation.report.columns import LEGEND, LONG
from starcat.evaluation.report.plots import curves
from starcat.evaluation.report.tables import (
    Table,
    failure_table,
    rate_tables,
    statistic_tables,
    summary_table,
)
from starcat.report.page import STYLE, table

Content = Mapping[str, Any]

_MORE_STYLE = """
h3 { margin: 1.8rem 0 0.3rem; font-size: 1.02rem; }
body { max-width: 72rem; }
.rates table { font-size: 0.86rem; }
.rates td, .rates th { padding: 0.2rem 0.55rem 0.2rem 0.35rem; }
.rates td { white-space: nowrap; }
.rates td:first-child { white-space: normal; min-width: 8rem; }
.notes { color: var(--soft); font-size: 0.9rem; }
"""


def evaluation_page(
    title: str, contents: Sequence[Content], plots: Mapping[str, bytes], machine: str
) -> str:
    """Return an evaluation as an HTML page."""
    summary = summary_table(contents)
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="lead">Times: {escape(machine)}.</p>',
        *([_html(summary)] if summary else []),
        "<h2>What the columns mean</h2>",
        table("", ("column", "meaning"), legend(contents)),
        table("", ("rule", "a frame is a success if"), rules_of(contents)),
    ]
    for content in contents:
        parts += _paper_html(content, plots)
    body = "\n".join(parts)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}{_MORE_STYLE}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def legend(contents: Sequence[Content]) -> list[tuple[str, str]]:
    """Return what the columns mean."""
    used = {
        head for content in contents for one in rate_tables(content, LONG) for head in one.heads
    }
    is_of_papers = any(content["citation"] for content in contents)
    own = "the paper's own rule" if is_of_papers else "starcat's rule"
    return [
        (heads, meaning.format(starcat=MEANINGS["starcat"], own=own))
        for heads, meaning in LEGEND
        if used.intersection(heads.split(", "))
    ]


def rules_of(contents: Sequence[Content]) -> list[tuple[str, str]]:
    """Return the rules that rows are judged by."""
    users: dict[str, list[str]] = {}
    for content in contents:
        for rule in dict.fromkeys(line["rule"] for line in content["rows"]):
            users.setdefault(rule, []).append(content["name"])
    return [(f"{rule} ({', '.join(names)})", MEANINGS[rule]) for rule, names in users.items()]


def _paper_html(content: Content, plots: Mapping[str, bytes]) -> Iterator[str]:
    yield f"<h2>{escape(_heading(content))}</h2>"
    if content["citation"]:
        yield f'<p class="lead">{escape(content["citation"])}</p>'
    if content["is_quick"]:
        usual = "the paper's" if content["citation"] else "usual"
        yield f'<p class="warning">A quick run: fewer frames than {usual}.</p>'
    names = {group: name for name, group, _ in curves(content)}
    for one in rate_tables(content, LONG):
        yield f"<h3>{escape(_capital(one.title))}</h3>"
        yield _html(one)
        if one.title in names:
            data = base64.b64encode(plots[names[one.title]]).decode()
            alt = escape(f"Curve: {one.title}, rate of identification with intervals")
            yield f'<figure><img alt="{alt}" src="data:image/svg+xml;base64,{data}"></figure>'
    for one in _other_tables(content):
        yield f"<h3>{escape(_capital(one.title))}</h3>"
        yield _html(one)
    if content["deviations"]:
        yield "<h3>What the paper leaves unsaid, and what is done here</h3>"
        items = "".join(f"<li>{escape(text)}</li>" for text in content["deviations"])
        yield f"<ul>{items}</ul>"


def _html(one: Table) -> str:
    notes = "".join(f"<br>{escape(note)}" for note in one.notes)
    below = f'<p class="notes">{notes[4:]}</p>' if notes else ""
    return f'<div class="rates">{table("", one.heads, one.rows, one.numbers)}</div>{below}'


def reproduction_markdown(contents: Sequence[Content], machine: str, figures: str) -> str:
    """Return an evaluation as Markdown."""
    summary = summary_table(contents)
    parts = [
        "<!-- Generated from reproduction.json by `make docs`; no figure is typed by hand. -->",
        "# Reproduction\n\nWhat the papers print, what starcat measures, and the difference. "
        f"`starcat evaluate --paper all`\nmakes all of it. Times: {machine}.",
        *([_markdown(summary)] if summary else []),
        "## What the columns mean",
        _grid(("column", "meaning"), legend(contents), ()),
        _grid(("rule", "a frame is a success if"), rules_of(contents), ()),
    ]
    for content in contents:
        parts += _paper_markdown(content, figures)
    return "\n\n".join(parts) + "\n"


def _paper_markdown(content: Content, figures: str) -> Iterator[str]:
    yield f"## {_heading(content)}"
    if content["citation"]:
        yield content["citation"]
    names = {group: name for name, group, _ in curves(content)}
    for one in rate_tables(content, LONG):
        yield f"### {_capital(one.title)}"
        yield _markdown(one)
        if one.title in names:
            yield f"![{_capital(one.title)}]({figures}/{names[one.title]}.svg)"
    for one in _other_tables(content):
        yield f"### {_capital(one.title)}"
        yield _markdown(one)
    if content["deviations"]:
        yield "### What the paper leaves unsaid, and what is done here"
        yield "\n".join(f"- {text}" for text in content["deviations"])


def _markdown(one: Table) -> str:
    notes = "\n".join(f"- {note}" for note in one.notes)
    return _grid(one.heads, one.rows, one.numbers) + (f"\n\n{notes}" if notes else "")


def _grid(heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int]) -> str:
    rule = ["---:" if k in numbers else "---" for k in range(len(heads))]
    lines = [heads, rule, *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _other_tables(content: Content) -> list[Table]:
    failed = failure_table(content)
    return [*statistic_tables(content), *([failed] if failed else [])]


def _heading(content: Content) -> str:
    return f"{content['name']}: {content['title']}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
