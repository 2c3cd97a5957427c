"""All rows of an answer in memory: as Arrow, pandas or astropy, or to be looked at."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from typing import TYPE_CHECKING, Any

from starcat.errors import ConfigError

if TYPE_CHECKING:
    import pandas as pd  # type: ignore[import-untyped, unused-ignore]
    import pyarrow as pa
    from astropy.table import Table

SHOWN_ROWS = 20
"""Rows that a notebook shows."""

SHOWN_ITEMS = 6
"""How many items of a list a cell shows."""


class Answer:
    """What a query found.

    Parameters
    ----------
    found : pyarrow.Table
        All rows; units and meanings in the field metadata.
    """

    def __init__(self, found: pa.Table) -> None:
        self._found = found

    @property
    def columns(self) -> list[str]:
        """Names of the columns, in order."""
        return list(self._found.column_names)

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self._found.num_rows)

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        """Go through the rows, each a tuple of Python values."""
        for batch in self._found.to_batches():
            yield from zip(*(column.to_pylist() for column in batch.columns), strict=True)

    def to_arrow(self) -> pa.Table:
        """Return the rows as an Arrow table.

        Returns
        -------
        pyarrow.Table
            Units and meanings in the field metadata (``unit``, ``description``).
        """
        return self._found

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
            import pandas  # noqa: F401 - pyarrow says less clearly that it is missing
        except ImportError:
            raise ConfigError("to_pandas needs pandas: python -m pip install pandas") from None
        return self._found.to_pandas()

    def to_table(self) -> Table:
        """Return the rows as an astropy table.

        Returns
        -------
        astropy.table.Table
            With units and meanings; nulls are masked.
        """
        import pyarrow as pa

        from starcat.exchange.array_files import astropy_table
        from starcat.exchange.columns import plain_batch, plain_schema
        from starcat.exchange.numpy_columns import numpy_columns

        schema = plain_schema(self._found.schema)
        batches = [plain_batch(batch, schema) for batch in self._found.to_batches()]
        plain = pa.Table.from_batches(batches, schema)
        return astropy_table(numpy_columns(plain.combine_chunks(), signed=False))

    def __repr__(self) -> str:
        """Return the size and the first columns in one line."""
        names = ", ".join(self.columns[:6]) + (", ..." if len(self.columns) > 6 else "")
        return f"<Answer: {len(self):,} rows of {names}>"

    def _repr_html_(self) -> str:
        """Return the first rows as a table for a notebook."""
        heads = "".join(f"<th>{escape(name)}</th>" for name in self.columns)
        rows = "".join(
            f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in row)}</tr>"
            for row, _ in zip(self, range(SHOWN_ROWS), strict=False)
        )
        more = len(self) - SHOWN_ROWS
        rest = f"<p>and {more:,} more rows</p>" if more > 0 else ""
        return f"<table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table>{rest}"


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
