"""Tables in HTML, as notebooks show objects."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from itertools import islice

from starcat.errors import count_of

SHOWN_ROWS = 20
"""Rows of a table that are shown."""


def html_table(
    heads: Sequence[str], rows: Iterable[Sequence[object]], count: int, title: str = ""
) -> str:
    """Return the first of ``count`` rows as HTML, below a title.

    Examples
    --------
    >>> html_table(["x<y"], [["1"]], 1)
    '<table><thead><tr><th>x&lt;y</th></tr></thead><tbody><tr><td>1</td></tr></tbody></table>'
    """
    head = "".join(f"<th>{escape(name)}</th>" for name in heads)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in row)}</tr>"
        for row in islice(rows, SHOWN_ROWS)
    )
    above = f"<p>{escape(title)}</p>" if title else ""
    more = count - SHOWN_ROWS
    below = f"<p>and {count_of(more, 'more row')}</p>" if more > 0 else ""
    return f"{above}<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{below}"
