# SPDX-License-Identifier: MIT
"""HTML of the evidence: one look for every page, tables, and nothing that is loaded."""

from __future__ import annotations

from html import escape as escape
from pathlib import Path

STYLE = (
    "body{font:15px/1.45 sans-serif;max-width:72em;margin:2em auto;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;margin:1em 0}td,th{border:1px solid #bbb;padding:.25em .6em;"
    "text-align:left;vertical-align:top}th{background:#eee}.bad{background:#fbb}.good{background:#dfd}"
    "pre{background:#f4f4f4;padding:1em;overflow:auto}"
)


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a table; a cell that ends with "pass" or begins with "fail" has its colour."""
    lines = ["<table><tr>" + "".join(f"<th>{escape(text)}</th>" for text in head) + "</tr>"]
    for row in rows:
        cells = []
        for text in row:
            kind = (
                " class=good"
                if text.endswith("pass")
                else " class=bad"
                if text.startswith("fail")
                else ""
            )
            link = text.startswith("<a ")
            cells.append(
                f"<td{kind}>{text if link else escape(text).replace(chr(10), '<br>')}</td>"
            )
        lines.append("<tr>" + "".join(cells) + "</tr>")
    return "\n".join([*lines, "</table>"])


def write(path: Path, title: str, *parts: str) -> None:
    """Write a page."""
    body = "\n".join(parts)
    path.write_text(
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{escape(title)}</title>"
        f"<style>{STYLE}</style><h1>{escape(title)}</h1>\n{body}\n</html>\n",
        encoding="utf-8",
    )
