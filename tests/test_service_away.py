"""What workers on other machines bring: only whole databases of the job, and only in time."""

from __future__ import annotations

import io
import shutil
import tarfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi")

from fastapi.testclient import TestClient

from starcat.service.app import make_app
from starcat.service.jobs.away import pack
from starcat.service.jobs.job import Job
from starcat.service.jobs.recovery import give_up_silent, recover
from starcat.service.jobs.submission import submit_build, submit_ingest
from starcat.service.service import Service
from starcat.service.settings import Settings
from starcat.specs.reading import spec_from_dict

TAR = {"Content-Type": "application/x-tar"}


@pytest.fixture
def client(
    tmp_path: Path, sao_lines: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> Iterator[TestClient]:
    (tmp_path / "sao.dat").write_bytes(b"".join(sao_lines))
    monkeypatch.setenv("STARCAT_CATALOGS", str(tmp_path))
    settings = Settings(root=tmp_path / "service", anonymous="publisher", workers=0)
    with TestClient(make_app(settings), base_url="http://127.0.0.1:8000") as client:
        yield client


@pytest.fixture
def service(client: TestClient) -> Service:
    app: Any = client.app
    found: Service = app.state.service
    return found


@pytest.fixture
def job(service: Service, small_spec: str) -> Job:
    spec = spec_from_dict(tomllib.loads(small_spec), "small.toml")
    return submit_build(service, spec, "anne").job


@pytest.fixture
def database(tmp_path: Path, small_artifact: Path) -> Path:
    """The folder of a database, as a worker has it."""
    folder = tmp_path / "built"
    shutil.copytree(small_artifact, folder / small_artifact.name, copy_function=shutil.copyfile)
    return folder


def packed(folder: Path) -> bytes:
    archive = folder.with_suffix(".tar")
    pack(folder, archive)
    return archive.read_bytes()


def test_a_database_is_brought_once(client, service, job, database):
    path = f"/api/v1/work/{job.id}"
    begun = client.post(f"{path}/claim").json()
    assert (begun["state"], begun["attempt"]) == ("running", 1)
    assert client.post(f"{path}/claim").status_code == 409
    lines = [{"stage": "read", "done": 1, "total": 2}, {"text": "hello"}]
    assert client.post(f"{path}/1/tell", json={"lines": lines}).json() == {"wants_end": False}
    assert service.jobs.get(job.id).stage == "read"
    client.post(f"/api/v1/jobs/{job.id}/cancel")
    assert client.post(f"{path}/1/tell", json={"lines": []}).json() == {"wants_end": True}
    data = packed(database)
    assert client.put(f"{path}/2/database", content=data, headers=TAR).status_code == 409
    done = client.put(f"{path}/1/database", content=data, headers=TAR).json()
    assert done["result"] == {"database": job.key[:16]}
    assert service.library.database(job.key[:16]).title == "small-1.0.0"
    assert list(service.paths.scratch.iterdir()) == []
    for late in (
        client.put(f"{path}/1/database", content=data, headers=TAR),
        client.post(f"{path}/1/tell", json={"lines": []}),
        client.post(f"{path}/1/end", json={"state": "queued"}),
    ):
        assert late.status_code == 409
    assert service.jobs.get(job.id).state == "done"


def test_other_ends_are_told(client, service, job):
    path = f"/api/v1/work/{job.id}"
    for number, state in enumerate(("queued", "failed"), 1):
        client.post(f"{path}/claim")
        content = {"state": state, "error": {"detail": "no"}}
        assert client.post(f"{path}/{number}/end", json=content).json()["state"] == state
    assert service.jobs.get(job.id).error == {"detail": "no"}
    ingest = submit_ingest(service, "sao", "anne").job
    assert client.post(f"/api/v1/work/{ingest.id}/claim").status_code == 409


def test_a_silent_worker_is_given_up_and_no_other(client, service, job):
    client.post(f"/api/v1/work/{job.id}/claim")
    recover(service)  # a server that starts again leaves the worker its job
    give_up_silent(service)
    assert service.jobs.get(job.id).state == "running"
    with service.records.writing() as connection:
        connection.execute("UPDATE jobs SET heard_s = heard_s - 100.0")
    give_up_silent(service)
    assert service.jobs.get(job.id).state == "queued"
    answer = client.post(f"/api/v1/work/{job.id}/1/tell", json={"lines": []})
    assert answer.status_code == 409


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
    "nothing": b"",
    "no archive": b"x" * 5000,
    "a way out": tar_of((member("../../x"), b"x")),
    "a whole path": tar_of((member("/tmp/x"), b"x")),
    "a hidden file": tar_of((member("small-1.0.0/.x"), b"x")),
    "a way back": tar_of((member("a/../../x"), b"x")),
    "a link": tar_of((member("small-1.0.0", tarfile.SYMTYPE, "/etc"), b"")),
    "a hard link": tar_of((member("small-1.0.0/x", tarfile.LNKTYPE, "/etc/passwd"), b"")),
    "a device": tar_of((member("small-1.0.0/x", tarfile.CHRTYPE), b"")),
    "the same twice": tar_of((member("small-1.0.0/x"), b"1"), (member("small-1.0.0/x"), b"2")),
    "a file for a folder": tar_of((member("small-1.0.0"), b"1"), (member("small-1.0.0/x"), b"2")),
    "too many": tar_of(*((member(f"small-1.0.0/{n}"), b"") for n in range(1001))),
    "no database": tar_of((member("small-1.0.0/x"), b"x")),
    "cut off": tar_of((member("small-1.0.0/x"), b"x" * 5000))[:2000],
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_no_database_is_refused(client, service, job, tmp_path, name):
    path = f"/api/v1/work/{job.id}"
    client.post(f"{path}/claim")
    before = sorted(one for one in tmp_path.rglob("*") if "sqlite" not in one.name)
    answer = client.put(f"{path}/1/database", content=HOSTILE[name], headers=TAR)
    assert answer.status_code == 422, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    after = sorted(one for one in tmp_path.rglob("*") if "sqlite" not in one.name)
    assert after == before
    assert service.jobs.get(job.id).state == "running"  # whoever has it may try once more


def test_a_damaged_or_another_database_is_refused(client, service, job, database, artifact_version):
    path = f"/api/v1/work/{job.id}"
    client.post(f"{path}/claim")
    stars = database / "small-1.0.0" / "stars.parquet"
    data = bytearray(stars.read_bytes())
    data[len(data) // 2] ^= 1
    stars.write_bytes(data)
    answer = client.put(f"{path}/1/database", content=packed(database), headers=TAR)
    assert (answer.status_code, service.library.databases()) == (422, [])
    other = database.with_name("other")
    shutil.copytree(artifact_version("2.0.0"), other / "small-1.0.0", copy_function=shutil.copyfile)
    answer = client.put(f"{path}/1/database", content=packed(other), headers=TAR)
    assert answer.status_code == 422
    assert service.library.databases() == []


def test_only_publishers_bring_databases(tmp_path):
    settings = Settings(root=tmp_path / "service", anonymous="builder", workers=0)
    with TestClient(make_app(settings), base_url="http://127.0.0.1:8000") as client:
        path = f"/api/v1/work/{'0' * 32}"
        for end in ("claim", "1/tell", "1/end"):
            assert client.post(f"{path}/{end}", json={}).status_code == 401
        assert client.put(f"{path}/1/database", content=b"x").status_code == 401
