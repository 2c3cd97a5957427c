"""The REST interface about databases, the registry and releases, on a small artifact."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import tarfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from shelved import DATABASE, shelve, waiting_build

from starcat.artifact.verify import verify_artifact
from starcat.releases.pulling import pull_release
from starcat.releases.registry import FolderRegistry
from starcat.service.app import make_app
from starcat.service.settings import Settings

OTHER = "fedcba9876543210"
LOCAL = "http://127.0.0.1:8000"
API = f"/api/v1/databases/{DATABASE}"


@pytest.fixture
def root(tmp_path: Path, small_artifact: Path) -> Path:
    shelve(tmp_path / "service", small_artifact)
    return tmp_path / "service"


@pytest.fixture
def client(root: Path) -> Iterator[TestClient]:
    with TestClient(
        make_app(Settings(root=root, anonymous="publisher", workers=0)), base_url=LOCAL
    ) as client:
        yield client


def manifest_of(folder: Path) -> dict:
    return json.loads((folder / "manifest.json").read_bytes())


def test_databases_are_listed_with_their_facts(client, small_artifact):
    [one] = client.get("/api/v1/databases").json()["databases"]
    manifest = manifest_of(small_artifact)
    assert one["id"] == DATABASE
    assert one["title"] == "small-1.0.0"
    assert one["stars"] == manifest["products"]["stars"]["rows"]
    assert one["manifest_sha256"] == manifest["manifest_sha256"]
    assert client.get(API).json() == one


@pytest.mark.parametrize("database", ["0" * 16, "..", "0123456789ABCDEF", "%2e%2e%2f", "x" * 500])
@pytest.mark.parametrize("what", ["", "/manifest", "/files", "/coverage", "/archive"])
def test_a_database_that_is_not_there_is_not_found(client, database, what):
    answer = client.get(f"/api/v1/databases/{database}{what}")
    assert answer.status_code in (400, 404)
    assert answer.headers["content-type"] == "application/problem+json"


def test_the_manifest_comes_once(client, small_artifact):
    answer = client.get(f"{API}/manifest")
    data = (small_artifact / "manifest.json").read_bytes()
    assert answer.content == data
    assert answer.headers["etag"] == f'"{hashlib.sha256(data).hexdigest()}"'
    again = client.get(f"{API}/manifest", headers={"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_report_and_coverage_are_those_of_the_build(client, small_artifact):
    report = client.get(f"{API}/report").json()
    assert report == json.loads((small_artifact / "report" / "report.json").read_bytes())
    coverage = client.get(f"{API}/coverage")
    fields = coverage.json()["fields"]
    summary = coverage.json()["summary"]
    assert summary == report["coverage"]
    assert len(fields["stars"]) == summary["fields"] == 200
    assert min(fields["stars"]) == summary["stars"]["minimum"]
    tag = {"If-None-Match": coverage.headers["etag"]}
    assert client.get(f"{API}/coverage", headers=tag).status_code == 304


def test_every_file_of_the_list_can_be_had(client, small_artifact):
    listed = client.get(f"{API}/files").json()
    on_disk = {str(p.relative_to(small_artifact)) for p in small_artifact.rglob("*") if p.is_file()}
    assert {one["path"] for one in listed} == on_disk
    for one in listed:
        answer = client.get(f"{API}/files/{one['path']}")
        assert hashlib.sha256(answer.content).hexdigest() == one["sha256"]
        assert answer.headers["etag"] == f'"{one["sha256"]}"'
        assert answer.headers["content-type"] == one["content_type"]
        assert answer.headers["content-disposition"].startswith("attachment")
        assert "immutable" in answer.headers["cache-control"]
        head = client.head(f"{API}/files/{one['path']}")
        assert (head.content, int(head.headers["content-length"])) == (b"", one["bytes"])


@pytest.mark.parametrize(
    ("asked", "start", "end"),
    [("bytes=0-9", 0, 10), ("bytes=10-", 10, None), ("bytes=-7", -7, None), ("Bytes = 5-5", 5, 6)],
)
def test_a_range_is_a_part(client, small_artifact, asked, start, end):
    data = (small_artifact / "stars.parquet").read_bytes()
    answer = client.get(f"{API}/files/stars.parquet", headers={"Range": asked})
    assert (answer.status_code, answer.content) == (206, data[start:end])
    first = start % len(data)
    assert answer.headers["content-range"] == f"bytes {first}-{(end or len(data)) - 1}/{len(data)}"


@pytest.mark.parametrize(
    "asked",
    ["bytes=9-3", "bytes=a-b", "lines=1-2", "bytes", "bytes=0-1,5-6", "bytes=-", "bytes=1_0-"],
)
def test_what_is_no_single_range_is_the_whole_file(client, small_artifact, asked):
    answer = client.get(f"{API}/files/stars.parquet", headers={"Range": asked})
    assert answer.status_code == 200
    assert answer.content == (small_artifact / "stars.parquet").read_bytes()


def test_a_range_beyond_the_end_is_told(client, small_artifact):
    size = (small_artifact / "stars.parquet").stat().st_size
    for asked in (f"bytes={size}-", "bytes=-0"):
        answer = client.get(f"{API}/files/stars.parquet", headers={"Range": asked})
        assert answer.status_code == 416
        assert answer.headers["content-range"] == f"bytes */{size}"
        assert answer.json()["status"] == 416


def test_a_range_of_another_content_is_the_whole_file(client):
    path = f"{API}/files/stars.parquet"
    tag = client.head(path).headers["etag"]
    asked = {"Range": "bytes=0-9", "If-Range": tag}
    assert client.get(path, headers=asked).status_code == 206
    assert client.get(path, headers={**asked, "If-Range": '"another"'}).status_code == 200


@pytest.mark.parametrize(
    "path",
    [
        "../small-1.0.0.build.json",
        "..%2f..%2f..%2frecords.sqlite",
        "%2e%2e/%2e%2e/%2e%2e/records.sqlite",
        "/etc/passwd",
        "report",
        "report%2f..%2fstars.parquet",
        "stars.parquet%00.json",
        "STARS.parquet",
        "secret.txt",
    ],
)
def test_only_files_of_the_manifest_are_there(client, root, path):
    (root / "databases" / DATABASE / "small-1.0.0" / "secret.txt").write_text("secret")
    assert client.get(f"{API}/files/{path}").status_code in (400, 404)


def test_a_link_is_no_file(client, root, tmp_path):
    path = root / "databases" / DATABASE / "small-1.0.0" / "stars.parquet"
    (tmp_path / "elsewhere").write_bytes(path.read_bytes())
    path.unlink()
    path.symlink_to(tmp_path / "elsewhere")
    assert client.get(f"{API}/files/stars.parquet").status_code == 404
    path.unlink()
    assert client.get(f"{API}/files/stars.parquet").status_code == 404


def test_the_archive_is_the_artifact(client, tmp_path):
    answer = client.get(f"{API}/archive")
    assert int(answer.headers["content-length"]) == len(answer.content)
    with tarfile.open(fileobj=io.BytesIO(answer.content)) as archive:
        archive.extractall(tmp_path / "out", filter="data")
    assert not verify_artifact(tmp_path / "out" / "small-1.0.0").findings
    assert client.get(f"{API}/archive").content == answer.content


def test_two_databases_are_compared(client, root, artifact_version):
    shelve(root, artifact_version("1.1.0"), OTHER)
    found = client.get(f"{API}/diff/{OTHER}").json()
    assert [change["name"] for change in found["spec"]] == ["version"]
    assert found["counts"] == {"came": 0, "went": 0, "moved": 0}
    assert client.get(f"{API}/diff/{DATABASE}").json()["is_same"]
    assert client.get(f"{API}/diff/{'0' * 16}").status_code == 404


def test_a_removed_database_is_gone_and_its_release_stays(client, root):
    client.post("/api/v1/releases", json={"database": DATABASE})
    assert client.delete(API).status_code == 204
    assert client.get(API).status_code == 404
    assert not (root / "databases" / DATABASE).exists()
    assert not list((root / "scratch").iterdir())
    assert client.get("/api/v1/releases/small/1.0.0").status_code == 200


def test_a_database_that_a_job_makes_is_not_removed(client):
    job = waiting_build(client.app.state.service, DATABASE)
    answer = client.delete(API)
    assert answer.status_code == 409
    assert job.id in answer.json()["detail"]
    assert client.get(API).status_code == 200


def test_who_may_only_read_neither_removes_nor_publishes(root):
    with TestClient(make_app(Settings(root=root, workers=0)), base_url=LOCAL) as client:
        assert client.delete(API).status_code == 401
        assert client.post("/api/v1/releases", json={"database": DATABASE}).status_code == 401
        assert client.get(API).status_code == 200
    with TestClient(
        make_app(Settings(root=root, anonymous="none", workers=0)), base_url=LOCAL
    ) as client:
        for path in (API, f"{API}/files/stars.parquet", "/registry/index.json", "/api/v1/releases"):
            assert client.get(path).status_code == 401


def test_publishing_makes_a_release_that_can_be_pulled(client, root, tmp_path):
    first = client.post("/api/v1/releases", json={"database": DATABASE, "note": "<b>first</b>"})
    assert (first.status_code, first.json()["outcome"]) == (201, "published")
    again = client.post("/api/v1/releases", json={"database": DATABASE, "note": "again"})
    assert (again.status_code, again.json()["outcome"]) == (200, "unchanged")
    [listed] = client.get("/api/v1/releases").json()["releases"]
    assert (listed["note"], listed["owner"]) == ("<b>first</b>", "anonymous")
    assert listed == client.get("/api/v1/releases/small/1.0.0").json()
    [release] = FolderRegistry(root / "registry").releases()
    assert release.title == "small-1.0.0"
    pull_release(FolderRegistry(root / "registry"), release, tmp_path / "out")
    assert not verify_artifact(tmp_path / "out" / "small-1.0.0").findings


def test_another_content_under_a_published_version_is_refused(
    client, root, tmp_path, artifact_version
):
    client.post("/api/v1/releases", json={"database": DATABASE})
    other = tmp_path / "small-1.0.0"
    shutil.copytree(artifact_version("1.0.0"), other)
    changed_content(other)
    shelve(root, other, OTHER)
    answer = client.post("/api/v1/releases", json={"database": OTHER})
    assert answer.status_code == 409
    assert "raise the version" in answer.json()["detail"]
    [listed] = client.get("/api/v1/releases").json()["releases"]
    assert listed["database"] == DATABASE


def changed_content(artifact: Path) -> None:
    from starcat.artifact.manifest import manifest_digest
    from starcat.storage.digests import file_sha256, json_bytes

    page = artifact / "report" / "index.html"
    page.write_bytes(page.read_bytes() + b"<!-- other -->")
    manifest = manifest_of(artifact)
    facts = {"bytes": page.stat().st_size, "sha256": file_sha256(page)}
    manifest["files"]["report/index.html"] |= facts
    manifest["manifest_sha256"] = manifest_digest(manifest)
    (artifact / "manifest.json").write_bytes(json_bytes(manifest))


def test_the_registry_is_its_own_files_only(client, root):
    assert client.get("/registry/index.json").status_code == 404
    client.post("/api/v1/releases", json={"database": DATABASE})
    (root / "registry" / ".lock").touch()
    index = client.get("/registry/index.json")
    assert index.content == (root / "registry" / "index.json").read_bytes()
    assert "no-cache" in index.headers["cache-control"]
    tag = {"If-None-Match": index.headers["etag"]}
    assert client.get("/registry/index.json", headers=tag).status_code == 304
    release = client.get("/registry/versions/small/1.0.0.json").json()
    digest = release["manifest"]["sha256"]
    path = f"/registry/blobs/sha256/{digest[:2]}/{digest}"
    blob = client.get(path)
    assert hashlib.sha256(blob.content).hexdigest() == digest
    assert "immutable" in blob.headers["cache-control"]
    part = client.get(path, headers={"Range": "bytes=3-"})
    assert (part.status_code, part.content) == (206, blob.content[3:])
    assert client.head(path).status_code == 200


@pytest.mark.parametrize(
    "path",
    [
        ".lock",
        "",
        "..%2frecords.sqlite",
        "versions/%2e%2e%2findex.json",
        "versions/small/..%2f..%2findex.json",
        "versions/small/01.0.0.json",
        f"blobs/sha256/00/{'0' * 64}",
        f"blobs/sha256/ab/{'0' * 64}",
        ".incoming/x",
    ],
)
def test_no_other_file_of_the_registry_is_there(client, root, path):
    client.post("/api/v1/releases", json={"database": DATABASE})
    assert client.get(f"/registry/{path}").status_code in (400, 404)
