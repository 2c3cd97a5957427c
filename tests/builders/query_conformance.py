"""What every session of queries does, in the user's process and in one of its own.

A test class that inherits from one of these classes has a fixture ``session``, and ``limited`` with
`TIGHT` limits; `beside_secrets` makes the ``folder`` that they have open.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pyarrow as pa
import pytest
from folder_bytes import bytes_of
from hostile_queries import ATTEMPTS, RUNAWAY
from sql_values import GIVEN, VALUES

from starcat.errors import QueryError, QueryLimitError
from starcat.query.session import Limits, Session

TIGHT = Limits(time_s=0.5, memory_gb=0.2, disk_gb=0.1)
EXCEEDED = r"stopped after 0\.5 s|needs more than 0\.2 GB"


def beside_secrets(database: Path, parent: Path) -> Path:
    """Return a copy of a database, next to files that no query names."""
    copied = parent / "database"
    shutil.copytree(database, copied, copy_function=shutil.copyfile)
    shutil.copy(copied / "stars.parquet", parent / "secret.parquet")
    (parent / "secret.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    return copied


def rows_of(
    session: Session, text: str, most: int = 1, values: dict[str, object] | None = None
) -> list[tuple[object, ...]]:
    with session.ask(text, values) as answer:
        return answer.rows(most)


class KeepsWithinItsLimits:
    """Nothing gets out of the session, and what takes too much is stopped."""

    @pytest.mark.parametrize("attempt", ATTEMPTS)
    def test_no_query_gets_out(self, session, folder, attempt):
        text = ATTEMPTS[attempt].replace("{near}", str(folder.parent)).replace("{in}", str(folder))
        before = bytes_of(folder.parent)
        with pytest.raises(QueryError) as raised:
            rows_of(session, text, 10)
        assert str(raised.value), "the error names the refused file"
        assert "root:" not in str(raised.value), "and nothing from inside the file"
        assert bytes_of(folder.parent) == before
        assert rows_of(session, "SELECT count(*) > 100 FROM stars") == [(True,)]

    @pytest.mark.parametrize("name", RUNAWAY)
    @pytest.mark.parametrize("form", ["rows", pytest.param("batches", marks=pytest.mark.slow)])
    def test_what_takes_too_much_is_stopped(self, limited, name, form):
        with pytest.raises(QueryLimitError, match=EXCEEDED), limited.ask(RUNAWAY[name]) as answer:
            answer.rows(1) if form == "rows" else sum(len(batch) for batch in answer.batches())


class KnowsEveryType:
    """Values that queries take and return are those of DuckDB's Python client."""

    @pytest.mark.parametrize("text", VALUES)
    def test_every_type_has_its_value_in_python(self, session, text):
        """Alone, in one column with null, and as 5,000 rows in several parts."""
        expected = VALUES[text]
        for query, count in (
            (f"SELECT {text} AS v", 1),
            (f"SELECT {text} AS v UNION ALL SELECT NULL ORDER BY v NULLS LAST", 2),
            (f"SELECT {text} AS v FROM range(5000)", 5000),
        ):
            [first, *rest] = rows_of(session, query, 100_000)
            assert repr(first[0]) == repr(expected)
            assert type(first[0]) is type(expected)
            assert len(rest) == count - 1
            assert count != 2 or rest == [(None,)]

    @pytest.mark.parametrize(("value", "found"), GIVEN, ids=lambda value: repr(value)[:30])
    def test_every_value_of_a_parameter_arrives(self, session, value, found):
        [(answer,)] = rows_of(session, "SELECT $v", 100_000, {"v": value})
        assert answer == found
        assert type(answer) is type(found)

    @pytest.mark.parametrize("value", [{1, 2}, object(), 1j])
    def test_a_value_of_no_type_of_sql_is_refused(self, session, value):
        with pytest.raises(QueryError, match="cannot be passed on"):
            rows_of(session, "SELECT $v", 100_000, {"v": value})

    def test_every_type_arrives_in_batches(self, session):
        columns = ", ".join(f"{text} AS v{number}" for number, text in enumerate(VALUES))
        with session.ask(f"SELECT {columns}, range AS n FROM range(70000)") as answer:
            found = pa.Table.from_batches(answer.batches())
        assert found.num_rows == 70_000
        assert found.num_columns == len(VALUES) + 1
