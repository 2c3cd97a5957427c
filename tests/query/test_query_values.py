"""Values that queries take and return: every type arrives as DuckDB's Python client gives it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from query_conformance import KnowsEveryType

from starcat.query.session import Session, open_session


@pytest.fixture(scope="module")
def session(small_database: Path) -> Iterator[Session]:
    with open_session([str(small_database)]) as opened:
        yield opened


class TestQueriesOfTheUser(KnowsEveryType):
    pass
