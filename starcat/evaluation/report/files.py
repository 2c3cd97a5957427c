"""The files of an evaluation: JSON, CSV, curves as PNG and SVG, and one page.

Times are part of it, so two evaluations differ; two reports of one evaluation do not.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

from starcat.errors import ConfigError
from starcat.evaluation.report.columns import Line, method_of
from starcat.evaluation.report.page import evaluation_page, reproduction_markdown
from starcat.evaluation.report.plots import curves, draw_rates, save_small_svg, series_order
from starcat.report.plots import save_plot

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
    """Return JSON with the keys in their own order, which is that of the tables."""
    return json.dumps(content, indent=indent, ensure_ascii=False, allow_nan=False) + "\n"


def _csv(heads: Sequence[str], lines: Iterable[Line]) -> str:
    text = StringIO()
    writer = csv.DictWriter(text, heads, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def write_reproduction(results: Path, docs: Path) -> Path:
    """Write the page of the documentation that holds all tables and curves."""
    try:
        stored = json.loads(results.read_bytes())
    except OSError as error:
        raise ConfigError(
            f"{results}: no evaluation there; run 'starcat evaluate --paper all' first"
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


def reproduction_page(results: Path) -> str:
    """Return the page of the documentation from a stored evaluation."""
    stored = json.loads(results.read_bytes())
    return reproduction_markdown(stored["evaluations"], stored["machine"], "figures")


def _slim(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return an evaluation without what no table shows of its trials."""
    rows = [
        {**line, "trial": {key: line["trial"][key] for key in ("name", "method", "answer")}}
        for line in content["rows"]
    ]
    return {**content, "rows": rows}
