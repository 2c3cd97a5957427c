"""What export prints: a table for people or JSON for machines."""

from __future__ import annotations

from starcat.cli.terminal.console import print_json, print_table, say
from starcat.exchange.export import COLUMNS_NAME, Exported


def print_exported(exported: Exported, *, as_json: bool) -> None:
    """Print what was written where; rows left out are told on stderr."""
    for file in exported.files:
        if file.left_out:
            say(f"{file.product}: {file.left_out:,} rows without a position are left out")
    if as_json:
        print_json(exported.as_dict())
        return
    rows = [
        (file.product, file.name, f"{file.rows:,}", f"{file.bytes:,}") for file in exported.files
    ]
    title = f"{exported.source} as {exported.file_format}"
    print_table(title, ("product", "file", "rows", "bytes"), rows, numbers=(2, 3))
    beside = f", {COLUMNS_NAME} says what the columns are" if exported.has_columns else ""
    print_table("", (f"in {exported.folder}{beside}",), [])
