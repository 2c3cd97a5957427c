"""Jobs: equal requests share one job, and its result is kept."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import threading
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from services import client_of, states, until

from starcat.database.verify import verify
from starcat.errors import ConfigError, SourceMissing, TargetMissing
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.specs.keys import spec_toml
from starcat.pipeline.specs.reading import spec_from_dict
from starcat.storage.atomic import locked
from starcat_lab.curves import QUANTITIES
from starcat_service.access import Principal
from starcat_service.jobs import job as job_module
from starcat_service.jobs.job import MAX_INTERRUPTED, Attempt, Job, Outcome, begin_next, interrupt
from starcat_service.jobs.keys import build_key, file_digests
from starcat_service.jobs.slots import JobSlots, recover
from starcat_service.jobs.submission import (
    cancel_job,
    retry_job,
    submit_build,
    submit_evaluation,
    submit_ingest,
)
from starcat_service.problems import Problem
from starcat_service.quota import folder_bytes
from starcat_service.records import MIGRATIONS
from starcat_service.server import run_server
from starcat_service.service import Service
from starcat_service.settings import Role, ServiceSettings, read_settings

JOBS = "/api/v1/jobs"
ANNE, BOB = Principal("anne", Role.BUILDER), Principal("bob", Role.BUILDER)
CHIEF = Principal("chief", Role.PUBLISHER)


@pytest.fixture
def spec(archive: Path, small_spec: str) -> BuildSpec:
    return spec_from_dict(tomllib.loads(small_spec), "small.toml")


Open = Callable[..., Service]


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Open]:
    """Services of one root, with settings; without workers."""
    services = []

    def make(**options: Any) -> Service:
        service = Service(ServiceSettings(root=tmp_path / "service", **options))
        services.append(service)
        return service

    yield make
    for service in services:
        service.close()


@pytest.fixture
def service(opened: Open) -> Service:
    return opened()


def begin(service: Service, job: Job) -> Attempt:
    begun = begin_next(service.records, (job.kind,))
    assert begun is not None
    assert begun.id == job.id
    return Attempt(service.records, begun)


def end(service: Service, job: Job, how: str) -> None:
    attempt = begin(service, job)
    if how == "failed":
        attempt.end(Outcome("failed", {"title": "x", "status": 422, "detail": "it went wrong"}))
    elif how == "cancelled":
        attempt.end(Outcome("cancelled"))
    else:
        attempt.end(Outcome("done", {"database": job.key[:16]}))


def test_each_job_is_begun_once_and_the_first_first(service, spec):
    job = submit_build(service, spec, "anne").job
    others = [submit_ingest(service, "sao", "anne", read_limit_mag=k).job for k in range(3)]
    begun: list[Job | None] = []

    def try_it() -> None:
        begun.append(begin_next(service.records, ("build", "ingest")))

    threads = [threading.Thread(target=try_it) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    jobs = [begun_job for begun_job in begun if begun_job is not None]
    assert {begun_job.id for begun_job in jobs} == {begun_job.id for begun_job in (job, *others)}
    assert {(begun_job.state, begun_job.attempt) for begun_job in jobs} == {("running", 1)}
    assert min(jobs, key=lambda begun_job: begun_job.started_s).id == job.id
    assert len(jobs) == 4
    assert states(service, job) == ["queued", "running"]
    again = submit_build(service, spec, "bob")
    assert (again.is_new, again.job.id) == (False, job.id)


def test_an_attempt_that_is_over_is_not_heard(service, spec):
    job = submit_build(service, spec, "anne").job
    first = begin(service, job)
    interrupt(service.records, first.job)
    second = begin(service, job)
    assert first.cancel_requested()
    first.report({"stage": "read", "done": 1, "total": 2})
    first.report({"log": "hello", "level": "info"})
    for outcome in (Outcome("done", {"database": "0" * 16}), Outcome("failed"), Outcome("queued")):
        first.end(outcome)
    interrupt(service.records, first.job)
    assert service.jobs.get(job.id) == second.job
    assert {event.kind for event in service.jobs.events(job.id)} == {"state"}
    assert not second.cancel_requested()
    second.end(Outcome("done", {"database": "0" * 16}))
    assert service.jobs.get(job.id).state == "done"


def test_a_key_is_of_what_the_result_depends_on(service, spec, archive, small_spec):
    key = build_key(service.records, spec)
    written = spec_from_dict(tomllib.loads(spec_toml(spec)), "all keys")
    recorded = spec_from_dict(json.loads(json.dumps(spec.recorded())), "recorded")
    assert {build_key(service.records, same) for same in (spec, written, recorded)} == {key}
    others = ('version = "1.0.1"', "epoch_jyear = 2026.5", 'name = "smaller"')
    for text in others:
        name = text.split()[0]
        lines = [text if line.startswith(f"{name} ") else line for line in small_spec.splitlines()]
        other = spec_from_dict(tomllib.loads("\n".join(lines)), "other")
        assert build_key(service.records, other) != key
    (archive / "elsewhere").mkdir()
    (archive / "sao.dat").rename(archive / "elsewhere" / "sao.dat")
    with pytest.raises(SourceMissing):
        build_key(service.records, spec)
    (archive / "elsewhere" / "sao.dat").rename(archive / "sao.dat")
    assert build_key(service.records, spec) == key
    data = (archive / "sao.dat").read_bytes()
    (archive / "sao.dat").write_bytes(data.replace(b"A0V", b"B0V", 1))
    assert build_key(service.records, spec) != key


def test_a_file_is_read_once_while_it_does_not_change(service, tmp_path, monkeypatch):
    from starcat_service.jobs import keys

    read = []
    monkeypatch.setattr(keys, "file_sha256", lambda path: read.append(path) or f"{len(read)}")
    path = tmp_path / "file"
    path.write_bytes(b"abc")
    assert file_digests(service.records, [path, path]) == ["1", "1"]
    os.utime(path, ns=(1, 1))
    assert file_digests(service.records, [path]) == ["2"]
    path.write_bytes(b"abcd")
    os.utime(path, ns=(1, 1))
    assert file_digests(service.records, [path]) == ["3"]


def test_what_has_no_result_is_done_again(service, spec):
    for how in ("failed", "cancelled", "done"):
        end(service, submit_build(service, spec, "anne").job, how)
        again = submit_build(service, spec, "anne")  # the database of a job that is done is gone
        assert again.is_new
        end(service, again.job, how)


def test_other_kinds_have_keys_too(service, spec, archive):
    bare = submit_ingest(service, "sao", "anne")
    assert bare.job.request["band"] == "V"
    assert submit_ingest(service, "sao", "bob", band="V").job.id == bare.job.id
    assert submit_ingest(service, "sao", "anne", to="hats").is_new
    assert submit_ingest(service, "sao", "anne", read_limit_mag=5.0).is_new
    with pytest.raises(ConfigError, match="band"):
        submit_ingest(service, "sao", "anne", band="Q")
    with pytest.raises(TargetMissing, match="no database"):
        submit_evaluation(service, "0" * 16, "anne")


def test_users_wait_in_moderation(opened, spec):
    service = opened(jobs_waiting=2)
    first = submit_ingest(service, "sao", "anne").job
    submit_ingest(service, "sao", "anne", to="hats")
    with pytest.raises(Problem, match="2 jobs of anne are waiting, and 2 may") as refused:
        submit_build(service, spec, "anne")
    assert refused.value.status == 429
    assert submit_build(service, spec, "bob").is_new
    begin(service, first)
    assert submit_ingest(service, "sao", "anne", read_limit_mag=5.0).is_new


def test_a_full_disk_takes_no_job(opened, spec):
    with pytest.raises(Problem, match=r"GiB free, and 1e\+09 have to be left") as refused:
        submit_build(opened(free_gib=1e9), spec, "anne")
    assert refused.value.status == 507
    service = opened()
    job = submit_build(service, spec, "anne").job
    JobSlots(opened(free_gib=1e9)).run_next()
    ended = service.jobs.get(job.id)
    assert (ended.state, ended.error["status"]) == ("failed", 507)


def test_a_user_has_so_much_of_the_disk(opened, spec, small_database):
    service = opened(disk_gib=1e-5)
    job = submit_build(service, spec, "anne").job
    end(service, job, "done")
    folder = service.paths.database(job.key[:16])
    folder.mkdir()
    (folder / small_database.name).symlink_to(small_database)
    with pytest.raises(Problem, match=r"the databases of anne take .* \(disk_gib\)") as refused:
        submit_ingest(service, "sao", "anne")
    assert refused.value.status == 409
    assert submit_build(service, spec, "anne").job.id == job.id  # which takes nothing more
    assert submit_ingest(service, "sao", "bob").is_new


def test_jobs_are_ended_and_tried_again_by_those_who_may(service, spec):
    job = submit_build(service, spec, "anne").job
    for change in (cancel_job, retry_job):
        with pytest.raises(Problem, match="belongs to anne, and bob may not") as refused:
            change(service, job.id, BOB)
        assert refused.value.status == 403
        with pytest.raises(TargetMissing):
            change(service, "0" * 32, CHIEF)
        with pytest.raises(TargetMissing):
            change(service, "../../etc/passwd", CHIEF)
    with pytest.raises(Problem, match="need not be tried again: it is queued"):
        retry_job(service, job.id, ANNE)
    assert cancel_job(service, job.id, ANNE).state == "cancelled"
    assert cancel_job(service, job.id, CHIEF).state == "cancelled"
    assert begin_next(service.records, ("build",)) is None
    assert retry_job(service, job.id, CHIEF).state == "queued"
    attempt = begin(service, job)
    assert cancel_job(service, job.id, ANNE).state == "running"
    assert attempt.cancel_requested()
    attempt.end(Outcome("cancelled"))
    other = submit_build(service, spec, "bob").job
    with pytest.raises(Problem, match=f"job {other.id} does the same and is queued"):
        retry_job(service, job.id, ANNE)
    end(service, other, "failed")
    with pytest.raises(Problem, match="has ended already; it is failed") as refused:
        cancel_job(service, other.id, BOB)
    assert refused.value.status == 409
    assert retry_job(service, other.id, BOB).error is None
    assert states(service, job)[-1] == "cancelled"


def test_of_each_stage_the_last_event_is_kept(service, spec):
    attempt = begin(service, submit_build(service, spec, "anne").job)
    for done in range(50):
        attempt.report_stage("read", done, 50)
    attempt.log("info", "half")
    attempt.report_stage("self-test", 0, None)
    attempt.report_stage("self-test", 1, None)
    events = service.jobs.events(attempt.job.id)
    kept = [(event.number, event.kind, event.data.get("done")) for event in events]
    assert kept == [
        (1, "state", None), (2, "state", None), (52, "stage", 49), (53, "log", None),
        (55, "stage", 1),
    ]  # fmt: skip
    assert service.jobs.events(attempt.job.id, after=53) == events[-1:]
    current = service.jobs.get(attempt.job.id)
    assert (current.stage, current.done, current.total) == ("self-test", 1, None)


def test_a_log_has_an_end(service, spec, monkeypatch):
    monkeypatch.setattr(job_module, "MAX_LOG_LINES", 3)
    attempt = begin(service, submit_build(service, spec, "anne").job)
    for number in range(9):
        attempt.log("info", f"line {number}")
    lines = [e.data["text"] for e in service.jobs.events(attempt.job.id) if e.kind == "log"]
    assert lines == ["line 0", "line 1", "line 2", "the log ends here, after 3 lines"]


def test_a_job_that_loses_its_server_waits_again_but_not_for_ever(service, spec):
    job = submit_build(service, spec, "anne").job
    for attempt in range(1, MAX_INTERRUPTED + 1):
        begun = begin(service, job).job
        assert begun.attempt == attempt
        interrupt(service.records, begun)
    ended = service.jobs.get(job.id)
    assert ended.state == "failed"
    assert "the service ended 8 times while this job ran" in ended.error["detail"]
    retry_job(service, job.id, ANNE)
    interrupt(service.records, begin(service, job).job)
    assert service.jobs.get(job.id).state == "queued"
    begun = begin(service, job).job
    cancel_job(service, job.id, ANNE)
    interrupt(service.records, begun)
    assert service.jobs.get(job.id).state == "cancelled"


def test_a_server_takes_up_what_another_has_left(service, spec):
    ran = submit_build(service, spec, "anne").job
    begin(service, ran)
    service.paths.job_work(ran.id).mkdir(parents=True)
    (service.paths.job_work(ran.id) / "half").write_text("")
    service.paths.database("0" * 16).mkdir()
    recover(service)
    assert service.jobs.get(ran.id).state == "queued"
    assert not service.paths.job_work(ran.id).exists()
    assert list(service.paths.databases.iterdir()) == []


def test_jobs_of_redis_get_their_new_address(tmp_path):
    (tmp_path / "service.toml").write_text('queue_url = "redis://10.0.0.1:6379/0"')
    with pytest.raises(ConfigError, match=r'write scheduler = "tcp://HOST:8786" instead'):
        read_settings(tmp_path)


def test_a_service_of_an_earlier_version_opens(tmp_path):
    old = f"""
        INSERT INTO jobs (id, kind, key, owner, title, state, request, created_s, heard_s)
        VALUES ('{1:032x}', 'build', 'k', 'anne', 't', 'queued', '{{}}', 5.0, 6.0);
        INSERT INTO tap_jobs VALUES ('{2:032x}', 'anne', 'ERROR', '[["QUERY", "SELECT 1"]]',
            '{{"f": "upload-0.vot"}}', 'mine', 1.0, 2.0, 3.0, 4.0, 9e9, 60.0, 'no column', '');
        INSERT INTO tap_jobs VALUES ('{3:032x}', 'anne', 'COMPLETED', '[]', '{{}}', '', 1.5, 2.0,
            3.0, 4.0, 9e9, 60.0, '', 'text/csv');
    """
    with sqlite3.connect(tmp_path / "records.sqlite") as connection:
        connection.executescript(";".join([*MIGRATIONS[:3], "PRAGMA user_version = 3", old]))
    connection.close()
    service = Service(ServiceSettings(root=tmp_path))
    assert begin(service, service.jobs.all()[0]).job.id == f"{1:032x}"
    assert service.jobs.count() == 1
    csv, failed = service.query_jobs.jobs("anne", "")
    assert (csv.phase, csv.media_type, csv.error) == ("COMPLETED", "text/csv", "")
    assert (failed.phase, failed.error, failed.run_id) == ("ERROR", "no column", "mine")
    assert failed.parameters == (("QUERY", "SELECT 1"),)
    assert (failed.created_s, failed.ended_s, failed.limit_s) == (1.0, 4.0, 60.0)
    service.close()


def test_two_servers_do_not_share_a_root(tmp_path):
    settings = ServiceSettings(root=tmp_path / "service", port=0)
    with (
        locked(tmp_path / "service" / "server.lock"),
        pytest.raises(ConfigError, match=r"service: another server runs there"),
    ):
        run_server(settings, print)


def test_the_space_of_a_folder_is_known_while_its_folders_come_and_go(tmp_path):
    is_over = threading.Event()

    def come_and_go() -> None:
        while not is_over.is_set():
            (tmp_path / "work" / "build" / "report").mkdir(parents=True)
            shutil.rmtree(tmp_path / "work")

    worker = threading.Thread(target=come_and_go)
    worker.start()
    try:
        assert all(folder_bytes(tmp_path) >= 0 for _ in range(300))
    finally:
        is_over.set()
        worker.join()


def test_a_build_is_done_and_watched_over_http(archive, tmp_path, small_spec):
    with client_of(tmp_path / "service", workers=1, anonymous="publisher") as client:
        answer = client.post(JOBS, json={"kind": "build", "spec": small_spec})
        job = answer.json()
        assert (answer.status_code, job["state"] in ("queued", "running")) == (201, True)
        assert answer.headers["location"] == f"{JOBS}/{job['id']}"
        events = sent_events(client.get(f"{JOBS}/{job['id']}/events").text)
        states_seen = [data["state"] for kind, _, data in events if kind == "state"]
        assert states_seen == ["queued", "running", "done"]
        stages = [data["stage"] for kind, _, data in events if kind == "stage"]
        assert "self-test" in stages
        assert "verify" in stages
        database = events[-1][2]["result"]["database"]
        again = client.post(JOBS, json={"kind": "build", "spec": tomllib.loads(small_spec)})
        assert (again.status_code, again.json()["id"]) == (200, job["id"])
        plain = client.get(f"{JOBS}/{job['id']}/events.json").json()
        last = plain[-2]["number"]
        resumed = client.get(f"{JOBS}/{job['id']}/events", headers={"Last-Event-ID": str(last)})
        assert [number for _, number, _ in sent_events(resumed.text)] == [plain[-1]["number"]]
        log = client.get(f"{JOBS}/{job['id']}/log").text
        assert "info: estimate: " in log
        assert log.endswith("Z done\n")
        wish = {"kind": "evaluate", "database": database, "frames": 2, "seed": 1}
        measured = client.post(JOBS, json=wish).json()["id"]
        client.get(f"{JOBS}/{measured}/events")
        evaluation = client.get(f"{JOBS}/{measured}").json()["result"]
        assert [rate["frames"] for rate in evaluation["rates"]] == [2, 2, 2, 2]
        assert [curve["quantity"] for curve in evaluation["curves"]] == list(QUANTITIES)
        page = client.get(f"/jobs/{measured}").text
        headline = f"{100 * evaluation['rates'][0]['identified_share']:.1f}"
        assert f'id="headline">{headline}<' in page
        assert page.count('<figure class="chart">') == 3
        assert page.count('class="point"') == sum(
            len(curve["points"]) for curve in evaluation["curves"]
        )
        listed = client.get(JOBS, params={"kind": "evaluate", "limit": 1}).json()
        assert (listed["total"], listed["jobs"][0]["id"]) == (1, measured)
        service = client.app.state.service
        folder = service.library.database(database).folder
        assert verify(folder).findings == ()
        assert {path.stat().st_mode & 0o222 for path in folder.iterdir() if path.is_file()} == {0}
        assert not list(service.paths.jobs.glob("*/work"))


def sent_events(text: str) -> list[tuple[str, int, dict[str, Any]]]:
    """Return kind, number and data of server-sent events."""
    events = []
    for block in text.strip().split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if line[0] != ":")
        if fields:
            events.append((fields["event"], int(fields["id"]), json.loads(fields["data"])))
    return events


LONG = {"self_test": {"frames": 100_000, "min_identified": 0.0}}
"""Changes that make a build of the small spec take minutes."""


def long_build(service: Service, spec: BuildSpec) -> Job:
    content = {**spec.recorded(), **LONG}
    return submit_build(service, spec_from_dict(content, "long"), "anne").job


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"job_time_s": 0.5}, "the job took more than 0.5 s (job_time_s)"),
        ({"job_memory_gib": 0.01}, "the job took more than the 0.01 GiB of memory that it may"),
    ],
)
def test_a_job_has_limits(opened, spec, limits, words):
    service = opened(**limits)
    job = long_build(service, spec)
    JobSlots(service).run_next()
    failed = service.jobs.get(job.id)
    assert failed.state == "failed"
    assert words in failed.error["detail"]
    assert failed.error["status"] == 422


@pytest.mark.slow
def test_a_process_that_is_killed_is_reported(service, spec):
    slots, job = JobSlots(service), long_build(service, spec)
    thread = threading.Thread(target=slots.run_next)
    thread.start()
    until(lambda: service.jobs.get(job.id).stage)
    for worker in slots.processes.running:
        os.kill(worker.pid, signal.SIGKILL)
    thread.join(30.0)
    assert not thread.is_alive()
    assert not service.paths.job_work(job.id).exists()
    assert list(service.paths.databases.iterdir()) == []
    with locked(service.paths.job_lock(job.id), wait=False):  # its process is gone
        failed = service.jobs.get(job.id)
    assert failed.state == "failed"
    assert "ended by SIGKILL, as a system does that runs out of memory" in failed.error["detail"]


@pytest.mark.slow
def test_a_build_that_fails_says_why(service, spec, archive):
    job = submit_build(service, spec, "anne").job
    (archive / "sao.dat").write_bytes(b"no star\n" * 100)
    JobSlots(service).run_next()
    failed = service.jobs.get(job.id)
    assert (failed.state, failed.error["kind"]) == ("failed", "ParseError")
    assert "sao.dat" in failed.error["detail"]
    assert service.paths.job_stderr(job.id).read_text() == ""


@pytest.mark.slow
def test_a_catalog_is_read_either_way(service, archive):
    for to in ("parquet", "hats"):
        job = submit_ingest(service, "sao", "anne", to=to).job
        JobSlots(service).run_next()
        done = service.jobs.get(job.id)
        assert done.state == "done", done.error
        assert done.result["rows"] == 600
        assert (service.paths.catalogs / done.result["catalog"]).exists()
        assert not submit_ingest(service, "sao", "bob", to=to).is_new


@pytest.mark.slow
def test_a_database_that_is_there_is_not_built_again(service, spec):
    job = submit_build(service, spec, "anne").job
    JobSlots(service).run_next()
    database = service.library.database(job.key[:16])
    with sqlite3.connect(service.paths.records) as records:  # killed before that was written
        records.execute("UPDATE jobs SET state = 'queued', result = NULL")
    records.close()
    before = database.folder.stat()
    JobSlots(service).run_next()
    assert service.jobs.get(job.id).result == {"database": database.id}
    assert os.path.samestat(database.folder.stat(), before)
