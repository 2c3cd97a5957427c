"""Jobs on a Dask cluster: none is lost or done twice, and only whole databases get a place."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
import tarfile
import threading
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("distributed")

from distributed import Client
from services import client_of, states, until

from starcat.database.verify import verify
from starcat.errors import ProductError
from starcat.pipeline.specs.reading import spec_from_dict
from starcat_service.access import Principal
from starcat_service.jobs import slots as slots_module
from starcat_service.jobs.cluster import pack, store_result
from starcat_service.jobs.job import Job
from starcat_service.jobs.slots import JobSlots
from starcat_service.jobs.submission import (
    cancel_job,
    submit_build,
    submit_evaluation,
    submit_ingest,
)
from starcat_service.paths import ServicePaths
from starcat_service.service import Service
from starcat_service.settings import Role, ServiceSettings

CHIEF = Principal("chief", Role.PUBLISHER)
START = "from distributed.cli.dask_{0} import main; main()"


# What workers send.


@pytest.fixture
def service(tmp_path: Path, archive: Path) -> Iterator[Service]:
    service = Service(ServiceSettings(root=tmp_path / "service", workers=0))
    yield service
    service.close()


@pytest.fixture
def job(service: Service, small_spec: str) -> Job:
    return submit_build(service, spec_from_dict(tomllib.loads(small_spec), "small"), "anne").job


def tar_of(*members: tuple[tarfile.TarInfo, bytes]) -> bytes:
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as tar:
        for member, content in members:
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return data.getvalue()


def member(name: str, kind: bytes = tarfile.REGTYPE, link: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, link
    return info


HOSTILE = {
    "no archive": b"x" * 5000,
    "a way out": tar_of((member("../../x"), b"x")),
    "a way back": tar_of((member("a/../../x"), b"x")),
    "a link": tar_of((member("databases", tarfile.SYMTYPE, "/etc"), b"")),
    "a hard link": tar_of((member("databases/x", tarfile.LNKTYPE, "/etc/passwd"), b"")),
    "a device": tar_of((member("databases/x", tarfile.CHRTYPE), b"")),
    "no database": tar_of((member("databases/x"), b"x")),
    "cut off": tar_of((member("databases/x"), b"x" * 5000))[:2000],
}


def test_a_folder_that_is_not_a_database_gets_no_place(service, job, tmp_path):
    before = sorted(tmp_path.rglob("*"))
    for name, content in HOSTILE.items():
        unpacked = ServicePaths(tmp_path / "made")
        unpacked.root.mkdir()
        with pytest.raises((ProductError, tarfile.TarError, OSError)):
            store_result(content, job, unpacked, service.paths)
        shutil.rmtree(unpacked.root)
        assert sorted(tmp_path.rglob("*")) == before, name


def built(root: Path, job: Job, database: Path) -> bytes:
    """An archive of a database that is passed as the result of a job."""
    folder = root / "databases" / job.key[:16]
    shutil.copytree(database, folder / "small-1.0.0", copy_function=shutil.copyfile)
    return pack(root, root / "databases")


def test_only_the_whole_database_of_the_job_gets_its_place(
    service, job, tmp_path, small_database, database_version
):
    unpacked = ServicePaths(tmp_path / "made")
    with pytest.raises(ProductError):
        store_result(
            built(tmp_path / "b", job, database_version("2.0.0")), job, unpacked, service.paths
        )
    archive = bytearray(built(tmp_path / "a", job, small_database))
    archive[archive.index(b"PAR1", len(archive) // 2) - 100] ^= 1
    for damaged in (bytes(archive), bytes(archive[: len(archive) // 2])):
        with pytest.raises((ProductError, tarfile.TarError)):
            store_result(damaged, job, unpacked, service.paths)
    assert service.library.databases() == []
    shutil.rmtree(unpacked.root)
    for _ in range(2):  # Dask may do a task twice
        store_result(
            pack(tmp_path / "a", tmp_path / "a" / "databases"), job, unpacked, service.paths
        )
    [database] = service.library.databases()
    assert verify(database.folder).findings == ()
    assert {path.stat().st_mode & 0o222 for path in database.folder.iterdir()} == {0}


# Workers in processes of their own.


class Cluster:
    """A scheduler and workers of this test only, as an operator starts them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._processes: list[subprocess.Popen[bytes]] = []
        self.start_scheduler()

    def start_scheduler(self, port: int = 0) -> None:
        file = self.folder / "scheduler.json"
        file.unlink(missing_ok=True)
        options = ["--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
        self.scheduler = self._start("scheduler", *options, "--scheduler-file", str(file))
        until(lambda: file.exists() and '"address"' in file.read_text())
        self.address = str(json.loads(file.read_text())["address"])

    def worker(self, name: str, **env: str) -> subprocess.Popen[bytes]:
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--name", name]
        home = self.folder / name
        return self._start("worker", self.address, *options, "--local-directory", str(home), **env)

    def _start(self, kind: str, *arguments: str, **env: str) -> subprocess.Popen[bytes]:
        with (self.folder / "log.txt").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-c", START.format(kind), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, **env},
            )
        self._processes.append(process)
        return process

    def end(self) -> None:
        for process in reversed(self._processes):
            if process.poll() is None:
                process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path, archive: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    monkeypatch.setattr(slots_module, "PAUSE_S", 0.5)
    folder = tmp_path / "cluster"
    folder.mkdir()
    cluster = Cluster(folder)
    yield cluster
    cluster.end()


@pytest.fixture
def far(tmp_path: Path, cluster: Cluster) -> Iterator[Service]:
    """A service whose jobs are the cluster's."""
    settings = {"scheduler": cluster.address, "worker_silence_s": 5.0, "shutdown_s": 0.5}
    with client_of(tmp_path / "service", workers=2, **settings) as client:
        yield client.app.state.service


def submit(service: Service, spec: str, frames: int = 5) -> Job:
    content = tomllib.loads(spec.replace("frames = 5", f"frames = {frames}"))
    return submit_build(service, spec_from_dict(content, "small"), "anne").job


def ended(service: Service, job: Job) -> Job:
    until(lambda: service.jobs.get(job.id).has_ended)
    return service.jobs.get(job.id)


def logged(service: Service, job: Job) -> str:
    return " ".join(e.data["text"] for e in service.jobs.events(job.id) if e.kind == "log")


slow = [pytest.mark.slow, pytest.mark.timeout(240)]


class TestCluster:
    pytestmark = slow

    def test_every_kind_of_job_is_done_there(self, far, cluster, small_spec):
        waits = submit(far, small_spec)
        time.sleep(1.0)
        assert states(far, waits) == ["queued"]  # there is no worker yet
        cluster.worker("one")
        done = ended(far, waits)
        assert (done.state, done.stage) == ("done", "verify"), done.error
        assert f"runs on {cluster.address[:12]}" in logged(far, waits)
        [database] = far.library.databases()
        assert verify(database.folder).findings == ()
        measured = ended(far, submit_evaluation(far, database.id, "anne", frames=4).job)
        assert [rate["frames"] for rate in measured.result["rates"]] == [4, 4, 4, 4]
        for to in ("parquet", "hats"):
            read = ended(far, submit_ingest(far, "sao", "anne", to=to).job)
            assert (read.state, read.result["rows"]) == ("done", 600), read.error
            assert (far.paths.catalogs / read.result["catalog"]).exists()
        assert not list(far.paths.jobs.glob("*/work"))
        assert not [path for path in (cluster.folder / "one").rglob("starcat-*") if path.is_dir()]

    def test_a_worker_that_is_killed_loses_no_job(self, far, cluster, small_spec):
        first = cluster.worker("one")
        job = submit(far, small_spec, frames=1500)
        until(lambda: far.jobs.get(job.id).stage == "self-test")
        cluster.worker("two")
        first.kill()
        first.wait()
        assert ended(far, job).state == "done"
        assert states(far, job) in (
            ["queued", "running", "done"],  # Dask had it done by the other
            ["queued", "running", "queued", "running", "done"],
        )
        assert logged(far, job).count("runs on tcp") == 2
        assert len(far.library.databases()) == 1

    def test_a_scheduler_that_is_killed_loses_no_job(self, far, cluster, small_spec):
        worker = cluster.worker("one")
        job = submit(far, small_spec, frames=1500)
        until(lambda: far.jobs.get(job.id).stage == "self-test")
        for process in (cluster.scheduler, worker):
            process.kill()
            process.wait()
        until(lambda: far.jobs.get(job.id).state == "queued")
        cluster.start_scheduler(int(cluster.address.rpartition(":")[2]))
        cluster.worker("two")
        assert ended(far, job).state == "done"
        assert len(far.library.databases()) == 1

    def test_a_job_that_is_cancelled_leaves_the_worker(self, far, cluster, small_spec):
        cluster.worker("one")
        job = submit(far, small_spec, frames=100_000)
        until(lambda: far.jobs.get(job.id).stage == "self-test")
        cancel_job(far, job.id, CHIEF)
        assert ended(far, job).state == "cancelled"
        assert ended(far, submit(far, small_spec)).state == "done"

    def test_a_worker_with_other_catalogs_does_nothing(self, far, cluster, archive, small_spec):
        other = cluster.folder / "elsewhere"
        other.mkdir()
        (other / "sao.dat").write_bytes((archive / "sao.dat").read_bytes()[:-1000])
        cluster.worker("other", STARCAT_CATALOGS=str(other))
        failed = ended(far, submit(far, small_spec))
        assert "no worker of the cluster can do it: the catalogs of this" in failed.error["detail"]
        cluster.worker("one")
        with Client(cluster.address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        version = small_spec.replace("1.0.0", "1.0.1")
        assert ended(far, submit(far, version)).state == "done"

    def test_a_server_that_stops_leaves_its_jobs_to_the_next(
        self, tmp_path, archive, cluster, small_spec
    ):
        cluster.worker("one")
        settings = ServiceSettings(root=tmp_path / "s", scheduler=cluster.address, shutdown_s=0.0)
        service = Service(settings)
        slots = JobSlots(service)
        slots.start()
        job = submit(service, small_spec, frames=100_000)
        until(lambda: service.jobs.get(job.id).stage == "self-test")
        threading.Thread(target=slots.begin_stop).start()
        slots.stop()
        assert states(service, job) == ["queued", "running", "queued"]
        service.close()
