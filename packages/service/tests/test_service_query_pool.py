"""Query sessions of the service: kept, bounded, and thrown away when their process was ended."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from starcat.errors import QueryError, QueryLimitError
from starcat.query.session import MAX_CHECKED, Session
from starcat_service.sandbox.pool import Pool, QueryPool
from starcat_service.settings import ServiceSettings

COUNT = "SELECT count(*) > 100 FROM stars"


@pytest.fixture
def sessions(tmp_path: Path) -> Iterator[QueryPool]:
    opened = QueryPool(ServiceSettings(root=tmp_path, queries=1))
    yield opened
    opened.close()


def process_of(session: Session) -> int:
    return session._engine._process.pid


def rows_of(session: Session, query: str) -> list[tuple[object, ...]]:
    with session.ask(query) as running:
        return running.rows(1)


def is_there(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def test_the_next_question_has_the_same_process(sessions, small_artifact):
    with sessions.session([small_artifact]) as session:
        first = process_of(session)
        assert rows_of(session, COUNT) == [(True,)]
    with pytest.raises(QueryError, match="nowhere"), sessions.session([small_artifact]) as session:
        rows_of(session, "SELECT count(*) FROM nowhere")
    with sessions.session([small_artifact]) as session:
        assert process_of(session) == first
    sessions.close()
    assert not is_there(first)


def test_one_that_took_too_long_is_thrown_away(sessions, small_artifact):
    processes: list[int] = []

    def ask() -> None:
        with sessions.session([small_artifact], time_s=0.3) as session:
            processes.append(process_of(session))
            rows_of(session, "SELECT sum(a.mag + d.mag) FROM stars a, stars b, stars c, stars d")

    with pytest.raises(QueryLimitError, match=r"stopped after 0\.3 s"):
        ask()
    assert not is_there(processes[0])
    with sessions.session([small_artifact]) as session:
        assert session.limits.time_s == 60.0
        assert rows_of(session, COUNT) == [(True,)]


def test_one_that_was_left_halfway_is_thrown_away(sessions, small_artifact):
    processes: list[int] = []

    def leave() -> None:
        with (
            sessions.session([small_artifact]) as session,
            session.ask("SELECT * FROM stars") as running,
        ):
            processes.append(process_of(session))
            next(iter(running.batches()))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        leave()
    assert not is_there(processes[0])


def test_only_some_are_kept(sessions, artifact_version):
    processes = []
    sessions._open._max_idle = 2
    for number in range(3):
        with sessions.session([artifact_version(f"1.0.{number}")]) as session:
            processes.append(process_of(session))
    assert [is_there(one) for one in processes] == [False, True, True]


def test_a_target_that_was_replaced_is_opened_again(sessions, small_artifact, tmp_path):
    folder = tmp_path / small_artifact.name
    shutil.copytree(small_artifact, folder)
    with sessions.session([folder]) as session:
        first = process_of(session)
    folder.rename(tmp_path / "old")
    shutil.copytree(small_artifact, folder)
    with sessions.session([folder]) as session:
        second = process_of(session)
    assert second != first
    sessions.forget(folder)
    assert not is_there(second)


def test_checked_queries_do_not_grow_without_end(sessions, small_artifact):
    with sessions.session([small_artifact]) as session:
        for number in range(MAX_CHECKED + 20):
            session.check(f"SELECT {number}")
        assert len(session._checked) == MAX_CHECKED


class Still:
    """A process that runs until it is closed."""

    is_running = True


def test_a_process_that_cannot_begin_is_reported_once():
    begun: list[str] = []

    @contextmanager
    def begin(key: str) -> Iterator[Still]:
        begun.append(key)
        if len(begun) == 1:
            raise QueryError("it cannot begin")
        yield Still()

    shared = Pool(begin, 1)
    with pytest.raises(QueryError, match="cannot begin"), shared.lend("a"):
        pass
    with shared.lend("a") as process:
        assert process.is_running
    assert begun == ["a", "a"]


def test_who_waits_while_a_pool_is_closed_has_the_process_that_begins():
    begun: list[str] = []

    @contextmanager
    def begin(key: str) -> Iterator[Still]:
        begun.append(key)
        shared.close()
        yield Still()

    shared = Pool(begin, 1)
    with shared.lend("a"):
        assert begun == ["a"]
    with shared.lend("a"):
        assert begun == ["a", "a"], "nothing is kept"
