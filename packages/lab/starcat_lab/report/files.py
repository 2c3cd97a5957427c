"""The files of an evaluation: JSON, CSV, curves as PNG and SVG, and one page.

Times are part of it, so two evaluations differ; two reports of one evaluation do not.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from io import StringIO
from pathlib import Path
from typing import Any

from starcat.errors import ConfigError
from starcat.pipeline.report import figure, html_page, save_plot, table
from starcat_lab.rates import MEANINGS
from starcat_lab.report.plots import curves, draw_rates, save_small_svg, series_order
from starcat_lab.report.tables import (
    LEGEND,
    LONG,
    Line,
    ReportTable,
    failure_table,
    limit_tables,
    method_of,
    rate_tables,
    statistic_tables,
    summary_table,
)

SHARES = ("by_rule", "by_rule_enough", "starcat", "starcat_enough", "ceiling")

STATISTIC_HEADS = (
    "group", "label", "unit", "published", "measured", "goal", "is_goal_reached", "note",
)  # fmt: skip

RESULTS = "results.json"
"""All of an evaluation; the other files are made from it."""


def write_evaluation(
    folder: Path, title: str, contents: Sequence[Mapping[str, Any]], machine: str
) -> Path:
    """Write all files of an evaluation."""
    folder.mkdir(parents=True, exist_ok=True)
    results = {"title": title, "machine": machine, "evaluations": list(contents)}
    (folder / RESULTS).write_text(_json(results, indent=2), encoding="utf-8")
    plots: dict[str, bytes] = {}
    for content in contents:
        name = content["name"]
        if content["rows"]:
            (folder / f"{name}.csv").write_text(rates_csv(content["rows"]), encoding="utf-8")
        if content["statistics"]:
            text = _csv(STATISTIC_HEADS, content["statistics"])
            (folder / f"{name}_statistics.csv").write_text(text, encoding="utf-8")
        for plot, group, lines in curves(content):
            save_plot(draw_rates(group, lines, series_order(content)), folder, plot)
            plots[plot] = (folder / f"{plot}.svg").read_bytes()
    page = folder / "index.html"
    page.write_text(evaluation_page(title, contents, plots, machine), encoding="utf-8")
    return page


def rates_csv(lines: Sequence[Line]) -> str:
    """Return rows as CSV."""
    flat = [_flat(line) for line in lines]
    return _csv(tuple(flat[0]), flat)


def _flat(line: Line) -> dict[str, Any]:
    published, measured = line["published_percent"], line["by_rule"]["percent"]
    flat = {key: line[key] for key in ("group", "label", "preset")}
    flat |= {"trial": line["trial"]["name"], "method": method_of(line)}
    flat |= {key: line[key] for key in ("rule", "x", "axis", "frames", "published_percent")}
    flat["difference"] = None if published is None else round(measured - published, 4)
    for share in SHARES:
        for key in ("percent", "low_percent", "high_percent", "hits", "count"):
            flat[f"{share}_{key}"] = line[share][key]
    keys = (
        "wrong", "mean_ms", "median_ms", "p95_ms", "published_ms", "goal_percent", "goal_ms",
        "goal_over", "is_goal_reached", "note",
    )  # fmt: skip
    return flat | {key: line[key] for key in keys}


def _json(content: Any, indent: int | None = None) -> str:
    """Return JSON with the keys in their own order, the order of the tables."""
    return json.dumps(content, indent=indent, ensure_ascii=False, allow_nan=False) + "\n"


def _csv(heads: Sequence[str], lines: Iterable[Line]) -> str:
    text = StringIO()
    writer = csv.DictWriter(text, heads, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def write_reproduction(results: Path, docs: Path) -> Path:
    """Write the page of the documentation with all tables and curves."""
    try:
        stored = json.loads(results.read_bytes())
    except OSError as error:
        raise ConfigError(
            f"{results}: no evaluation there", hint="run 'starcat evaluate --paper all' first"
        ) from error
    contents = [_slim(content) for content in stored["evaluations"]]
    figures = docs / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    for content in contents:
        for old in figures.glob(f"{content['name']}_*.svg"):
            old.unlink()
        for name, group, lines in curves(content):
            drawn = draw_rates(group, lines, series_order(content))
            save_small_svg(drawn, figures / f"{name}.svg")
    text = _json({**stored, "evaluations": contents})
    (docs / "reproduction.json").write_text(text, encoding="utf-8")
    page = docs / "reproduction.md"
    page.write_text(reproduction_page(docs / "reproduction.json"), encoding="utf-8")
    return page


def _slim(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return an evaluation without the facts of its experiments that no table shows."""
    rows = [
        {**line, "trial": {key: line["trial"][key] for key in ("name", "method", "answer")}}
        for line in content["rows"]
    ]
    return {**content, "rows": rows}


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
        *([html_of(summary)] if summary else []),
        "<h2>What the columns mean</h2>",
        table("", ("column", "meaning"), legend(contents)),
        table("", ("rule", "a frame is a success if"), rules_of(contents)),
    ]
    for content in contents:
        parts += _paper_html(content, plots)
    return html_page(title, parts, _MORE_STYLE)


def legend(contents: Sequence[Content]) -> list[tuple[str, str]]:
    """Return what the columns mean."""
    used = {
        head
        for content in contents
        for report_table in rate_tables(content, LONG)
        for head in report_table.heads
    }
    is_of_papers = any(content["citation"] for content in contents)
    rule = "the paper's own rule" if is_of_papers else "starcat's rule"
    return [
        (heads, meaning.format(starcat=MEANINGS["starcat"], rule=rule))
        for heads, meaning in LEGEND
        if used.intersection(heads.split(", "))
    ]


def rules_of(contents: Sequence[Content]) -> list[tuple[str, str]]:
    """Return the rules for judging rows."""
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
    for report_table in rate_tables(content, LONG):
        yield f"<h3>{escape(_capital(report_table.title))}</h3>"
        yield html_of(report_table)
        if report_table.title in names:
            alt = f"Curve: {report_table.title}, rate of identification with intervals"
            yield figure(alt, plots[names[report_table.title]])
    for report_table in _other_tables(content):
        yield f"<h3>{escape(_capital(report_table.title))}</h3>"
        yield html_of(report_table)
    if content["deviations"]:
        yield "<h3>What the paper leaves unsaid, and what is done here</h3>"
        items = "".join(f"<li>{escape(text)}</li>" for text in content["deviations"])
        yield f"<ul>{items}</ul>"


def html_of(report_table: ReportTable) -> str:
    """Return a table as HTML."""
    notes = "<br>".join(map(escape, report_table.notes))
    below = f'<p class="notes">{notes}</p>' if notes else ""
    html = table("", report_table.heads, report_table.rows, report_table.numbers)
    return f'<div class="rates">{html}</div>{below}'


def reproduction_page(results: Path) -> str:
    """Return the page of the documentation, Markdown, from a stored evaluation."""
    stored = json.loads(results.read_bytes())
    contents = stored["evaluations"]
    summary = summary_table(contents)
    parts = [
        "<!-- Generated from reproduction.json by `make docs`; no figure is typed by hand. -->",
        "# Reproduction\n\nWhat the papers print, what starcat measures, and the difference. "
        f"`starcat evaluate --paper all`\nmakes all of it. Times: {stored['machine']}.",
        *([markdown_of(summary)] if summary else []),
        "## What the columns mean",
        _grid(("column", "meaning"), legend(contents), ()),
        _grid(("rule", "a frame is a success if"), rules_of(contents), ()),
    ]
    for content in contents:
        parts += _paper_markdown(content)
    return "\n\n".join(parts) + "\n"


def _paper_markdown(content: Content) -> Iterator[str]:
    yield f"## {_heading(content)}"
    if content["citation"]:
        yield content["citation"]
    names = {group: name for name, group, _ in curves(content)}
    for report_table in rate_tables(content, LONG):
        yield f"### {_capital(report_table.title)}"
        yield markdown_of(report_table)
        if report_table.title in names:
            yield f"![{_capital(report_table.title)}](figures/{names[report_table.title]}.svg)"
    for report_table in _other_tables(content):
        yield f"### {_capital(report_table.title)}"
        yield markdown_of(report_table)
    if content["deviations"]:
        yield "### What the paper leaves unsaid, and what is done here"
        yield "\n".join(f"- {text}" for text in content["deviations"])


def markdown_of(report_table: ReportTable) -> str:
    """Return a table as Markdown."""
    notes = "\n".join(f"- {note}" for note in report_table.notes)
    return _grid(report_table.heads, report_table.rows, report_table.numbers) + (
        f"\n\n{notes}" if notes else ""
    )


def _grid(heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int]) -> str:
    rule = ["---:" if k in numbers else "---" for k in range(len(heads))]
    lines = [heads, rule, *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _other_tables(content: Content) -> list[ReportTable]:
    failed = failure_table(content)
    return [
        *limit_tables(content), *statistic_tables(content), *([failed] if failed else []),
    ]  # fmt: skip


def _heading(content: Content) -> str:
    return f"{content['name']}: {content['title']}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
