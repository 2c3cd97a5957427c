"""The service under pressure: places that are shared, and what one user cannot take from others."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from served import serve
from services import DATABASE, add_database, client_of

from starcat.errors import QueryError, QueryLimitError
from starcat.query.session import Session, open_session
from starcat_service.jobs.job import QUERY, begin_next
from starcat_service.problems import Problem, problem_of
from starcat_service.sandbox import query_engine
from starcat_service.sandbox.limiter import Limiter, asker
from starcat_service.sandbox.pool import SHORT_S, SHORT_SLOTS, Pool, QueryPool
from starcat_service.sandbox.query_engine import ConfinedEngine
from starcat_service.sandbox.sandbox import Sandbox
from starcat_service.security.request_limits import OWN_CONNECTIONS, Shares
from starcat_service.settings import ServiceSettings
from starcat_service.vo import tap_jobs

ENDLESS = "SELECT sum(a.i * b.j + c.i) FROM pairs a, pairs b, pairs c"


@pytest.fixture
def pool(tmp_path: Path) -> Iterator[QueryPool]:
    opened = QueryPool(ServiceSettings(root=tmp_path, queries=2, query_time_s=30.0))
    yield opened
    opened.close()


# Places.


_stacks: list[ExitStack] = []  # a slot without a reference would be given back


def taken(shared: Limiter, who: str) -> ExitStack | None:
    """Return a place of a client that is given back by ``close``, None if there is none at once."""
    stack = ExitStack()
    try:
        stack.enter_context(shared.hold(who, 0.0))
    except Problem:
        return None
    _stacks.append(stack)
    return stack


def test_a_client_has_another_place_only_where_more_are_free_and_so_many_at_most():
    shared = Limiter(4, 2)
    slots = [taken(shared, "greedy") for _ in range(3)]
    assert [slot is not None for slot in slots] == [True, True, False]
    assert taken(shared, "anna")
    assert taken(shared, "anna") is None
    assert taken(shared, "bob")
    assert taken(shared, "carl") is None
    assert slots[0] is not None
    slots[0].close()
    assert taken(shared, "greedy") is None
    assert taken(shared, "carl")


def test_a_free_place_is_for_who_holds_fewest_and_then_for_who_waits_in_turn():
    shared, order = Limiter(2, 1), list[str]()
    stacks = {who: taken(shared, who) for who in ("greedy", "anna")}

    def wait(who: str) -> None:
        with shared.hold(who, 10.0):
            order.append(who)

    threads = []
    for number, who in enumerate(["greedy", "greedy", "anna", "anna", "bob"], start=1):
        threads.append(threading.Thread(target=wait, args=(who,)))
        threads[-1].start()
        while len(shared._waiting) < number:
            time.sleep(0.001)
    stacks["anna"].close()
    for thread in threads[-3:]:
        thread.join(10.0)
    assert order[:3] == ["anna", "bob", "anna"], "greedy asked before both, and holds a place"
    stacks["greedy"].close()
    for thread in threads:
        thread.join(10.0)
    assert order[3:] == ["greedy"] * 2


def test_a_request_that_waits_too_long_has_to_be_repeated():
    shared = Limiter(1, 1)
    with shared.hold("anna", 1.0):
        with pytest.raises(Problem, match="ask again later") as caught, shared.hold("bob", 0.01):
            pass
        assert caught.value.status == 503
        assert int(caught.value.headers["Retry-After"]) >= 1
        asker.set("anna")
        with pytest.raises(Problem, match=r"1 of your requests took more than 0\.01 s") as refused:
            asyncio.run(shared.run(0.01, str))
        assert refused.value.status == 429
    assert taken(shared, "bob"), "a client that went away does not keep the place"


def test_a_client_that_goes_while_it_waits_takes_no_place():
    shared = Limiter(1, 1)

    async def go() -> None:
        with shared.hold("anna", 1.0):
            asker.set("bob")
            waiting = asyncio.create_task(shared.run(10.0, str))
            await asyncio.sleep(0.01)
            waiting.cancel()
            await asyncio.gather(waiting, return_exceptions=True)

    asyncio.run(go())
    assert taken(shared, "carl")


def test_a_place_is_held_as_long_as_something_uses_it():
    shared, using = Limiter(1, 1), ExitStack()

    def begin() -> None:
        slot = shared.slot.get()
        assert slot is not None
        using.enter_context(slot.used())

    asyncio.run(shared.run(1.0, begin))
    assert taken(shared, "anna") is None
    using.close()
    assert taken(shared, "anna")


# Queries.


def ask(pool: QueryPool, target: Path, query: str) -> list[tuple[Any, ...]]:
    with pool.session([target]) as session, session.ask(query) as running:
        return running.rows(1)


@pytest.mark.timeout(60)
def test_short_queries_pass_those_that_take_long(pool, small_database):
    """Two users send queries without end; the queries of others are answered meanwhile."""

    async def of(who: str, query: str) -> object:
        asker.set(who)
        try:
            return await pool.run(ask, pool, small_database, query)
        except QueryLimitError as error:
            return error

    async def go() -> list[object]:
        greedy = [asyncio.create_task(of(who, ENDLESS)) for who in ("a", "b", "a", "b", "a")]
        await asyncio.sleep(3.0 * SHORT_S)
        took = []
        for number in range(12):
            began = time.monotonic()
            assert await of(f"user {number % 3}", f"SELECT {number}") == [(number,)]
            took.append(time.monotonic() - began)
        assert not any(task.done() for task in greedy), "they run, or wait"
        pool.close()
        for task in greedy:
            task.cancel()
        return took

    pool._limits = type(pool._limits)(time_s=100.0, memory_gb=0.5, disk_gb=0.1)
    assert len(asyncio.run(go())) == 12


def test_check_and_run_have_one_allowance(small_database, monkeypatch):
    requests: list[tuple[str, object]] = []
    original = ConfinedEngine.ask

    def noted(self: ConfinedEngine, name: str, *arguments: Any, **options: Any) -> Any:
        requests.append((name, options.get("allowance")))
        return original(self, name, *arguments, **options)

    with open_session([str(small_database)], new_engine=ConfinedEngine) as session:
        monkeypatch.setattr(ConfinedEngine, "ask", noted)
        with session.ask("SELECT count(*) FROM stars") as running:
            running.rows(1)
    assert [name for name, _ in requests] == ["check", "rows"]
    assert requests[0][1] is requests[1][1] is not None


def test_a_request_has_one_allowance(pool, small_database):
    with pool.session([small_database], time_s=20.0) as session:
        with session.ask("SELECT 1") as running:
            assert running.rows(1) == [(1,)]
        session.allowance.left_s = 0.2
        with pytest.raises(QueryLimitError, match="stopped after"), session.ask(ENDLESS) as it:
            it.rows(1)


def test_the_next_session_gets_a_process_that_was_started_in_advance(
    pool, small_database, monkeypatch
):
    monkeypatch.setattr("starcat_service.sandbox.pool.SPARE", 1)
    monkeypatch.setattr(query_engine, "_waiting", [])
    with pool.session([small_database]):
        [spare] = query_engine._waiting
    with pool.session([small_database / "stars.parquet"]) as session:
        assert session._engine._process is spare
        [other] = query_engine._waiting
        assert other is not spare
    query_engine._end_waiting()


# TAP.


@pytest.mark.timeout(60)
def test_answers_of_tap_hold_a_place_until_they_are_sent(root):
    with client_of(root, queries=2) as client:
        answers = [
            client.get("/tap/sync", params={"QUERY": query, "FORMAT": "csv"})
            for query in (
                "SELECT TOP 3 i, j FROM small.pairs ORDER BY i, j",
                "SELECT COUNT(*) AS n FROM small.pairs AS a, small.stars AS b WHERE a.i < b.mag",
            )
        ]
        assert [answer.status_code for answer in answers] == [200, 200]
        assert [answer.text.count("\n") for answer in answers] == [4, 2]
        limiter = client.app.state.service.query_pool._limiter
        assert limiter._free == SHORT_SLOTS + 2, "all slots are given back"


def client_at(client: TestClient, address: str) -> TestClient:
    return TestClient(client.app, base_url=client.base_url, client=(address, 50_000))


def test_jobs_of_tap_are_shared_by_address(root, monkeypatch):
    monkeypatch.setattr(tap_jobs, "MAX_WAITING", 2)
    with client_of(root) as client:
        first, other = (client_at(client, address) for address in ("192.0.2.1", "192.0.2.2"))
        for at in (first, first, other):
            assert at.post("/tap/async", data={"QUERY": "SELECT 1"}).status_code == 200
        refused = first.post("/tap/async", data={"QUERY": "SELECT 1"})
        assert refused.status_code == 422
        assert "2 of your jobs have not ended" in refused.text
        assert other.post("/tap/async", data={"QUERY": "SELECT 1"}).status_code == 200
        jobs = client.app.state.service.query_jobs
        for address in ("192.0.2.1", "192.0.2.2"):
            for job in jobs.jobs("anonymous", address):
                jobs.delete(job.job_id)


def test_jobs_that_wait_are_begun_in_turns(root):
    with client_of(root) as client:
        jobs, records = client.app.state.service.query_jobs, client.app.state.service.records
        client.app.state.slots.begin_stop()
        names: dict[str, str] = {}
        for name in ("greedy", "greedy", "greedy", "anna", "bob"):
            asker.set(name)
            names[jobs.create("anonymous").job_id] = name
        for job_id in names:
            jobs.run(job_id)
        begun = [begin_next(records, (QUERY,)) for _ in names]
        order = [names[job.id] for job in begun if job is not None]
        assert order == ["greedy", "anna", "bob", "greedy", "greedy"]
        for job_id in names:
            jobs.delete(job_id)


# Connections.


def test_requests_at_the_same_time_are_counted_by_user():
    shares = Shares(1)
    with shares.counted("anna"), shares.counted("bob"):
        with pytest.raises(Problem) as caught, shares.counted("anna"):
            pass
        assert caught.value.status == 429
    with shares.counted("anna"):
        pass


@pytest.mark.slow
def test_connections_are_shared_by_address(tmp_path, small_database):
    add_database(tmp_path / "root", small_database)
    with serve(tmp_path / "root", tmp_path / "log") as served:

        def connection(source_ip: str) -> socket.socket:
            return socket.create_connection(("127.0.0.1", served.port), 10.0, (source_ip, 0))

        lines = [connection("127.0.0.1") for _ in range(OWN_CONNECTIONS)]
        try:
            time.sleep(0.2)
            with connection("127.0.0.1") as refused:
                assert refused.recv(1000).startswith(b"HTTP/1.1 429 ")
            with connection("127.0.0.1") as refused:
                refused.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
                assert refused.recv(1000).startswith(b"HTTP/1.1 429 ")
            with connection("127.0.0.1") as probe:  # a monitor on this machine
                probe.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
                assert probe.recv(1000).startswith(b"HTTP/1.1 200 ")
            with connection("127.0.0.2") as other:
                path = f"/api/v1/databases/{DATABASE}"
                other.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
                assert other.recv(1000).startswith(b"HTTP/1.1 200 ")
        finally:
            for line in lines:
                line.close()


# Time.


class Starved:
    """A process of the sandbox that gets a part of a processor, and answers nothing."""

    def __init__(self, fraction: float) -> None:
        self._fraction = fraction

    def send(self, *_: object) -> None:
        pass

    def receive(self, wait_s: float) -> None:
        time.sleep(min(wait_s, 0.01))

    def used_s(self) -> float:
        return self._fraction * time.monotonic()


@pytest.mark.parametrize(
    ("fraction", "words", "status"), [(1.0, r"stopped after 0\.1 s; send less", 422),
                                      (0.1, "too busy: your request had 0.0 s of processor", 503)]
)  # fmt: skip
def test_a_starved_process_is_not_told_to_send_less(tmp_path, fraction, words, status):
    sandbox = Sandbox(ServiceSettings(root=tmp_path, query_time_s=0.1), tmp_path)
    began_s = time.monotonic()
    with pytest.raises((Problem, QueryLimitError), match=words) as caught:
        sandbox._answer(Starved(fraction), ["identify", {}, 0.1])
    assert problem_of(caught.value).status == status
    assert (time.monotonic() - began_s > 0.28) == (status == 503), "it had more time"
    sandbox.close()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_process_has_no_thread_for_each_processor(tmp_path, small_database, monkeypatch):
    # Each thread reserves 8 MB, or 40 MB: those of 64 processors take more than a task may.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, "64")
    sandbox = Sandbox(ServiceSettings(root=tmp_path), tmp_path)
    image = {
        "database": str(small_database), "target": str(tmp_path / "sky.img"),
        "method": None, "endian": "little", "profile": "full",
    }  # fmt: skip
    assert sandbox.call("flight_image", image) == (tmp_path / "sky.img").stat().st_size
    with sandbox._children.lend(None) as worker:
        status = Path(f"/proc/{worker.pid}/status").read_text(encoding="ascii")
    threads = re.search(r"Threads:\t(\d+)", status)
    assert int(threads[1]) <= 12, "of Arrow, most of them for input and output"
    sandbox.close()


# Sessions that are kept, bounded, and thrown away when their process was ended.

COUNT = "SELECT count(*) > 100 FROM stars"


@pytest.fixture
def single(tmp_path: Path) -> Iterator[QueryPool]:
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


def test_the_next_question_has_the_same_process(single, small_database, monkeypatch):
    monkeypatch.setattr("starcat.query.session.MAX_CHECKED", 3)
    with single.session([small_database]) as session:
        first = process_of(session)
        assert rows_of(session, COUNT) == [(True,)]
    with pytest.raises(QueryError, match="nowhere"), single.session([small_database]) as session:
        rows_of(session, "SELECT count(*) FROM nowhere")
    with single.session([small_database]) as session:
        assert process_of(session) == first
        for number in range(5):
            session.check(f"SELECT {number}")
        assert len(session._checked) == 3
    single.close()
    assert not is_there(first)


def test_one_that_took_too_long_or_was_left_halfway_is_thrown_away(single, small_database):
    processes: list[int] = []

    def ask() -> None:
        with single.session([small_database], time_s=0.3) as session:
            processes.append(process_of(session))
            rows_of(session, "SELECT sum(a.mag + d.mag) FROM stars a, stars b, stars c, stars d")

    def leave() -> None:
        with single.session([small_database]) as session, session.ask("FROM stars") as running:
            processes.append(process_of(session))
            next(iter(running.batches()))
            raise ZeroDivisionError

    with pytest.raises(QueryLimitError, match="stopped after"):
        ask()
    with pytest.raises(ZeroDivisionError):
        leave()
    assert [is_there(process) for process in processes] == [False, False]
    with single.session([small_database]) as session:
        assert session.limits.time_s == 60.0
        assert rows_of(session, COUNT) == [(True,)]


def test_only_some_are_kept(single, database_version):
    processes = []
    single._open._max_idle = 1
    for version in ("1.0.0", "1.1.0"):
        with single.session([database_version(version)]) as session:
            processes.append(process_of(session))
    assert [is_there(process) for process in processes] == [False, True]


def test_a_target_that_was_replaced_is_opened_again(single, small_database, tmp_path):
    folder = tmp_path / small_database.name
    shutil.copytree(small_database, folder)
    with single.session([folder]) as session:
        first = process_of(session)
    folder.rename(tmp_path / "old")
    shutil.copytree(small_database, folder)
    with single.session([folder]) as session:
        second = process_of(session)
    assert second != first
    single.forget(folder)
    assert not is_there(second)


class Still:
    """A process that runs until it is closed."""

    is_running = True


def test_a_pool_begins_again_what_could_not_begin_and_keeps_nothing_after_it_was_closed():
    begun: list[str] = []

    @contextmanager
    def begin(key: str) -> Iterator[Still]:
        begun.append(key)
        if begun == ["fails"]:
            raise QueryError("it cannot begin")
        if key == "closes":
            shared.close()
        yield Still()

    shared = Pool(begin, 1)
    with pytest.raises(QueryError, match="cannot begin"), shared.lend("fails"):
        pass
    for key in ("fails", "closes", "closes"):
        with shared.lend(key) as process:
            assert process.is_running
    assert begun == ["fails", "fails", "closes", "closes"]
