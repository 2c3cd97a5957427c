"""What ``starcat evaluate`` prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from starcat.cli.terminal.console import print_json, print_table, say
from starcat.evaluation.report.tables import (
    SHORT,
    Table,
    failure_table,
    rate_tables,
    statistic_tables,
    summary_table,
    verdict,
)

if TYPE_CHECKING:
    from starcat.evaluation.run import Evaluation


def print_evaluation(evaluation: Evaluation, *, as_json: bool) -> None:
    """Print what was measured."""
    if as_json:
        print_json(list(evaluation.contents))
    else:
        _print_tables(evaluation.contents)
    say(f"wrote {evaluation.page}")


def _print_tables(contents: Sequence[Mapping[str, Any]]) -> None:
    for content in contents:
        failed = failure_table(content)
        tables = [*rate_tables(content, SHORT), *statistic_tables(content, verdict)]
        for table in (*tables, *([failed] if failed else [])):
            _print(table, f"{content['name']}: ")
    if summary := summary_table(contents):
        _print(summary)


def _print(table: Table, prefix: str = "") -> None:
    heads = [head.replace(" guide stars", "\nguide stars") for head in table.heads]
    print_table(prefix + table.title, heads, table.rows, table.numbers)
