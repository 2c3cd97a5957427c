"""The result of a map for a table: each value with units and range, and the first rows."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.catalog.archives.mapped import Understood, needed_columns, records_of, understand
from starcat.catalog.ingest import Ingested, ingest_catalog
from starcat.catalog.readers.tables import open_table, read_tables
from starcat.catalog.source import DataSource
from starcat.catalog.source_files import SourceFiles
from starcat.errors import ConfigError
from starcat.results import entry, in_record

FIRST = 5
SHOWN = ("designation", "ra_deg", "dec_deg", "epoch_jyear", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr")


@dataclass
class _Range:
    """Range and counts of the values of a key, during reading."""

    least: float = np.inf
    greatest: float = -np.inf
    missing: int = 0
    yes: int = 0

    def add(self, values: np.ndarray[Any, Any]) -> None:
        """Add the values of some rows."""
        if values.dtype == bool:
            self.yes += int(values.sum())
        elif values.dtype == object:
            self.missing += sum(value is None for value in values)
        elif values.dtype.kind == "S":
            self.missing += int(np.count_nonzero(values == b""))
        else:
            numbers = values[~np.isnan(values.astype(np.float64))]
            self.missing += len(values) - len(numbers)
            self.least = min(self.least, float(numbers.min(initial=np.inf)))
            self.greatest = max(self.greatest, float(numbers.max(initial=-np.inf)))


@dataclass(frozen=True)
class Checked:
    """The result of a map for a table."""

    source: str
    form: str = field(metadata=entry(key="format"))  # of the first file
    values: list[dict[str, Any]]  # key, columns, units, range, and number of rows without a value
    # columns that the map does not name
    unused: list[str] = field(metadata=entry(key="unused_columns"))
    # the first rows as stars or rejected
    first: list[dict[str, Any]] = field(metadata=entry(key="first_rows"))
    read: Ingested = field(repr=False)

    @property
    def most_are_rejected(self) -> bool:
        """Whether fewer than half of the rows are kept, as with a wrong unit."""
        return 2 * self.kept < self.rows

    @property
    def verdict(self) -> str:
        """What the result means, in a sentence."""
        if not self.most_are_rejected:
            return f"{self.source}: understood"
        reason = max(self.rejected, key=lambda name: self.rejected[name])
        return (
            f"{self.source}: {self.rows - self.kept:,} of "
            f"{self.rows:,} rows are rejected, most of them as {reason}; check the units "
            "and columns of the map against the least and greatest values above"
        )

    @property
    @in_record()
    def rows(self) -> int:
        """Rows of the table."""
        return self.read.rows_read

    @property
    @in_record()
    def kept(self) -> int:
        """Rows that became stars."""
        return len(self.read.stars)

    @property
    @in_record()
    def rejected(self) -> dict[str, int]:
        """Other rows, by reason."""
        return self.read.rejected_by_reason

    @property
    @in_record()
    def problems(self) -> tuple[str, ...]:
        """The first malformed rows."""
        return self.read.problems


def check_map(source: DataSource, path: Path) -> Checked:
    """Read a table with its map, and return how its columns were understood."""
    table = source.table
    if table is None:
        raise ConfigError(f"{source.name} is an archive, not a map of a table", key="source")
    files = SourceFiles.find(source, [path]).files
    opened = open_table(files[0])
    understood = understand(table, opened.columns, files[0].path.name)
    ranges = {key: _Range() for key in understood}
    for file in files:
        choose_columns = partial(needed_columns, table, where=file.path.name)
        for rows in read_tables(file, choose_columns, lambda _: None):
            records = records_of(table, rows, file)
            for key, values in ranges.items():
                name = "star_text" if key == "columns.star_id" else key.removeprefix("fields.")
                values.add(records[name])
    read = ingest_catalog(source.name, [path], neighbours=False)
    used = {name for entry in understood.values() for name in entry.columns}
    return Checked(
        source.name,
        opened.form,
        [_value_facts(key, entry, ranges[key]) for key, entry in understood.items()],
        [name for name in opened.columns if name not in used],
        _first_rows(read),
        read,
    )


def _value_facts(key: str, entry: Understood, values: _Range) -> dict[str, Any]:
    is_number = np.isfinite(values.least)
    return {
        "key": key,
        "from": entry.value.value,
        "unit": entry.unit,
        "becomes": entry.becomes.replace(" ", ""),
        "least": values.least if is_number else None,
        "greatest": values.greatest if is_number else None,
        "missing": values.missing,
        "true": values.yes if key.split(".")[0] in ("flags", "reject", "quality") else None,
    }


def _first_rows(read: Ingested) -> list[dict[str, Any]]:
    names = ["source_file", "source_line", *SHOWN, "mag", "band", "is_flagged_double"]
    names.append("is_flagged_variable")
    stars = read.stars.select(names)
    rejected = read.rejected.select(["source_file", "source_line", "reason", "detail"])
    both = pa.concat_tables([stars, rejected], promote_options="default")
    order = pc.sort_indices(both, [("source_file", "ascending"), ("source_line", "ascending")])
    return [
        {"row": row.pop("source_line"), **{k: v for k, v in row.items() if k != "source_file"}}
        for row in both.take(order[:FIRST]).to_pylist()
    ]
