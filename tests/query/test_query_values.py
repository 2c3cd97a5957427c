"""Values that queries take and return: every type arrives as DuckDB's Python client gives it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pytest
from sql_values import GIVEN, VALUES

from starcat.errors import QueryError
from starcat.query.session import Session, open_session


@pytest.fixture(scope="module")
def session(small_database: Path) -> Iterator[Session]:
    with open_session([str(small_database)]) as opened:
        yield opened


def rows_of(session: Session, text: str, values: dict[str, object] | None = None) -> list[object]:
    with session.ask(text, values) as answer:
        return answer.rows(100_000)


@pytest.mark.parametrize("text", VALUES)
def test_every_type_has_its_value_in_python(session, text):
    """Alone, in one column with null, and as 5,000 rows in several parts."""
    expected = VALUES[text]
    for query, count in (
        (f"SELECT {text} AS v", 1),
        (f"SELECT {text} AS v UNION ALL SELECT NULL ORDER BY v NULLS LAST", 2),
        (f"SELECT {text} AS v FROM range(5000)", 5000),
    ):
        [first, *rest] = rows_of(session, query)
        assert repr(first[0]) == repr(expected)
        assert type(first[0]) is type(expected)
        assert len(rest) == count - 1
        assert count != 2 or rest == [(None,)]


@pytest.mark.parametrize(("value", "found"), GIVEN, ids=lambda value: repr(value)[:30])
def test_every_value_of_a_parameter_arrives(session, value, found):
    [(answer,)] = rows_of(session, "SELECT $v", {"v": value})
    assert answer == found
    assert type(answer) is type(found)


@pytest.mark.parametrize("value", [{1, 2}, object(), 1j])
def test_a_value_of_no_type_of_sql_is_refused(session, value):
    with pytest.raises(QueryError, match="cannot be passed on"):
        rows_of(session, "SELECT $v", {"v": value})


def test_every_type_arrives_in_batches(session):
    columns = ", ".join(f"{text} AS v{number}" for number, text in enumerate(VALUES))
    with session.ask(f"SELECT {columns}, range AS n FROM range(70000)") as answer:
        found = pa.Table.from_batches(answer.batches())
    assert found.num_rows == 70_000
    assert found.num_columns == len(VALUES) + 1
