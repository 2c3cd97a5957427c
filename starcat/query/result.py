"""What a query finds: its first rows as a `ResultTable`, or all rows as a `QueryResult`.

A column keeps the unit and the meaning of the product's column whose name it has. Any other column
gets the unit that its name ends with, as everywhere in starcat: ``x_deg`` is in degrees.
"""

from __future__ import annotations

import datetime as dt
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from decimal import Decimal
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from starcat.errors import ConfigError, count_of
from starcat.html_tables import html_table
from starcat.progress import Progress, no_progress
from starcat.query.engine import Allowance, Engine
from starcat.query.locked_duckdb import Columns, Rows

if TYPE_CHECKING:
    import pandas as pd  # type: ignore[import-untyped, unused-ignore]
    import pyarrow as pa
    from astropy.table import Table

    from starcat.query.targets import View

SHOWN_ROWS = 20  # rows that a notebook shows
SHOWN_ITEMS = 6  # items of a list that a cell shows
LARGEST_WHOLE = 2**53 - 1  # the largest whole number that every reader of JSON keeps
_NUMERIC = re.compile(r"[UH]*(TINY|SMALL|BIG|HUGE)?INT|DOUBLE|FLOAT|DECIMAL")

UNIT_SUFFIXES = {
    "_mas_yr": "mas/yr",
    "_mas": "mas",
    "_arcsec": "arcsec",
    "_jyear": "yr",
    "_deg": "deg",
    "_rad": "rad",
    "_mag": "mag",
    "_px": "pix",
}


Facts = Mapping[str, str]
"""Unit, description and UCD of a column, if it has them."""


def facts_by_name(views: Iterable[View]) -> dict[str, Facts]:
    """Return the facts of columns by their name.

    If views disagree on the meaning of a name, only the unit is kept, if they agree on it.
    """
    facts: dict[str, Facts] = {}
    for view in views:
        for column in view.described:
            before = facts.setdefault(column.name, column.facts)
            if before != column.facts:
                unit = before.get("unit")
                facts[column.name] = {"unit": unit} if unit and unit == column.unit else {}
    return facts


def column_facts(name: str, named_facts: Mapping[str, Facts]) -> Facts:
    """Return the facts of the view's column of that name, else the unit that the name ends with."""
    if name in named_facts:
        return named_facts[name]
    return next(({"unit": u} for end, u in UNIT_SUFFIXES.items() if name.endswith(end)), {})


@dataclass(frozen=True)
class ResultColumn:
    """A column of a query's result."""

    name: str
    type: Annotated[str, Field(description="As DuckDB calls it.", examples=["DOUBLE"])]
    unit: str
    description: str

    @property
    def is_number(self) -> bool:
        """Whether its values are numbers, which stand at the right of a table."""
        return bool(_NUMERIC.match(self.type)) and "[" not in self.type


def result_column(name: str, kind: str, named_facts: Mapping[str, Facts]) -> ResultColumn:
    """Return a column with its known facts."""
    facts = column_facts(name, named_facts)
    return ResultColumn(name, kind, facts.get("unit", ""), facts.get("description", ""))


@dataclass(frozen=True)
class ResultTable:
    """The first rows that a query found."""

    columns: tuple[ResultColumn, ...]
    rows: Annotated[
        Sequence[Sequence[Any]],
        Field(description="In JSON, integers beyond 2^53 are text, NaN and infinities null."),
    ]
    is_cut: Annotated[bool, Field(description="Whether there are more rows.")]

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> ResultTable:
        """Return the table that a service sent."""
        columns = tuple(ResultColumn(**column) for column in content["columns"])
        return cls(columns, content["rows"], content["is_cut"])

    def with_json_values(self) -> ResultTable:
        """Return the same table with values that JSON supports."""
        return replace(self, rows=[[json_value(value) for value in row] for row in self.rows])

    def as_json(self) -> dict[str, Any]:
        """Return plain values for JSON, for `from_json`."""
        columns = [asdict(column) for column in self.columns]
        rows = self.with_json_values().rows
        return {"columns": columns, "rows": rows, "is_cut": self.is_cut}

    @property
    def texts(self) -> list[list[str]]:
        """The values as a table shows them."""
        return [[cell_text(value) for value in row] for row in self.rows]


class QueryResult:
    """What a query found.

    Parameters
    ----------
    found : pyarrow.Table
        All rows; units and meanings in the field metadata.
    """

    def __init__(self, table: pa.Table) -> None:
        self._table = table

    @property
    def columns(self) -> list[str]:
        """Names of the columns, in order."""
        return list(self._table.column_names)

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self._table.num_rows)

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        """Go through the rows, each a tuple of Python values."""
        for batch in self._table.to_batches():
            yield from zip(*(column.to_pylist() for column in batch.columns), strict=True)

    def to_arrow(self) -> pa.Table:
        """Return the rows as an Arrow table.

        Returns
        -------
        pyarrow.Table
            Units and meanings in the field metadata (``unit``, ``description``).
        """
        return self._table

    def to_pandas(self) -> pd.DataFrame:
        """Return the rows as a pandas data frame.

        Returns
        -------
        pandas.DataFrame
            One column each.

        Raises
        ------
        ConfigError
            If pandas is not installed.
        """
        try:
            import pandas  # noqa: F401 - the error of pyarrow is less clear if it is missing
        except ImportError:
            raise ConfigError("to_pandas needs pandas: python -m pip install pandas") from None
        return self._table.to_pandas()

    def to_table(self) -> Table:
        """Return the rows as an astropy table.

        Returns
        -------
        astropy.table.Table
            With units and meanings; nulls are masked.
        """
        from starcat.ship.exchange.array_files import astropy_table, numpy_columns

        return astropy_table(numpy_columns(self._table, signed=False))

    def __repr__(self) -> str:
        """Return the size and the first columns in one line."""
        names = ", ".join(self.columns[:6]) + (", ..." if len(self.columns) > 6 else "")
        return f"<QueryResult: {count_of(len(self), 'row')} of {names}>"

    def _repr_html_(self) -> str:
        """Return the first rows as a table for a notebook."""
        return html_table(self.columns, self, len(self))


class RunningQuery:
    """A query of a session; nothing runs before rows or columns are requested.

    Errors of the query, QueryError or QueryLimitError, are raised while it runs.
    """

    def __init__(
        self,
        engine: Engine,
        text: str,
        values: dict[str, Any] | None,
        named_facts: Mapping[str, Facts],
        allowance: Allowance,
        progress: Progress = no_progress,
    ) -> None:
        self._engine = engine
        self._text, self._values = text, values
        self._named_facts = named_facts
        self._allowance, self._progress = allowance, progress

    @cached_property
    def columns(self) -> Columns:
        """Names and DuckDB's types of the columns, in order."""
        return self._engine.columns(self._text, self._values, self._allowance)

    def table(self, count: int) -> ResultTable:
        """Return the first rows with the facts of their columns."""
        rows = self.rows(count + 1)
        columns = tuple(result_column(name, kind, self._named_facts) for name, kind in self.columns)
        return ResultTable(columns, rows[:count], len(rows) > count)

    def rows(self, count: int) -> Rows:
        """Return the first rows."""
        # The columns are known now, without looking at the files once more.
        self.columns, rows = self._engine.rows(
            self._text, self._values, count, self._allowance, self._progress
        )
        return rows

    def batches(self) -> pa.RecordBatchReader:
        """Return all rows as Arrow batches, with units and meanings in the field metadata.

        They are to be read before the next query.
        """
        import pyarrow as pa

        batches = self._engine.batches(self._text, self._values, self._allowance, self._progress)
        schema = pa.schema(
            field.with_metadata(column_facts(field.name, self._named_facts))
            for field in batches.schema
        )
        return pa.RecordBatchReader.from_batches(
            schema, (pa.record_batch(batch.columns, schema=schema) for batch in batches)
        )


def cell_text(value: Any) -> str:
    """Return a value as a table shows it.

    Examples
    --------
    >>> cell_text(0.1 + 0.2), cell_text(None), cell_text([1, 2])
    ('0.3', '', '[1, 2]')
    """
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.10g}"
    if isinstance(value, list):
        more = [f"… {len(value)} in all"] if len(value) > SHOWN_ITEMS else []
        return f"[{', '.join([cell_text(item) for item in value[:SHOWN_ITEMS]] + more)}]"
    return str(value)


def _json_decimal(value: Decimal) -> Any:
    """Return a decimal as a number, or as text if a double does not hold all of its digits."""
    if not value.is_finite():
        return None
    if value.as_tuple().exponent == 0:
        return json_value(int(value))
    number = float(value)
    return number if Decimal(repr(number)) == value else str(value)


def json_value(value: Any) -> Any:
    """Return a value as JSON has it: numbers that readers may round, and times, as texts.

    Examples
    --------
    >>> json_value(2**60), json_value(float("nan")), json_value([1, 0.5])
    ('1152921504606846976', None, [1, 0.5])
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int):
        return value if abs(value) <= LARGEST_WHOLE else str(value)
    if isinstance(value, Decimal):
        return _json_decimal(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [json_value(item) for item in value]
    if isinstance(value, dict):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, dt.date | dt.time):
        return value.isoformat()
    return value.hex() if isinstance(value, bytes) else str(value)
