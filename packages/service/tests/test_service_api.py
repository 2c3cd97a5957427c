"""The REST interface about databases, the registry and releases, on a small database."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from services import DATABASE, OTHER, add_database, client_of

from starcat.database.verify import verify
from starcat.errors import ConfigError
from starcat.ship.releases.lockfile import pull
from starcat.ship.releases.pulling import pull_release
from starcat.ship.releases.registry import FolderRegistry
from starcat.storage.download import DownloadOptions
from starcat.storage.keys import new_key
from starcat_service.jobs.cluster import unpack
from starcat_service.settings import read_settings

PUBLIC = {"anonymous": "publisher"}
API = f"/api/v1/databases/{DATABASE}"


@pytest.fixture
def own_client(own_root: Path) -> Iterator[TestClient]:
    """A client of a service of the test's own."""
    with client_of(own_root, **PUBLIC) as client:
        yield client


def manifest_of(folder: Path) -> dict:
    return json.loads((folder / "manifest.json").read_bytes())


def test_databases_are_listed_with_their_facts(client, small_database):
    listed = client.get("/api/v1/databases").json()["databases"]
    [facts] = [database for database in listed if database["id"] == DATABASE]
    manifest = manifest_of(small_database)
    assert facts["id"] == DATABASE
    assert facts["title"] == "small-1.0.0"
    assert facts["stars"] == manifest["products"]["stars"]["rows"]
    assert facts["manifest_sha256"] == manifest["manifest_sha256"]
    assert client.get(API).json() == facts


def test_the_manifest_comes_once(client, small_database):
    answer = client.get(f"{API}/manifest")
    data = (small_database / "manifest.json").read_bytes()
    assert answer.content == data
    assert answer.headers["etag"] == f'"{hashlib.sha256(data).hexdigest()}"'
    again = client.get(f"{API}/manifest", headers={"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_report_and_coverage_are_those_of_the_build(client, small_database):
    report = client.get(f"{API}/report").json()
    assert report == json.loads((small_database / "report" / "report.json").read_bytes())
    coverage = client.get(f"{API}/coverage")
    fields = coverage.json()["fields"]
    summary = coverage.json()["summary"]
    assert summary == report["coverage"]
    assert len(fields["stars"]) == summary["fields"] == 200
    assert min(fields["stars"]) == summary["stars"]["minimum"]
    tag = {"If-None-Match": coverage.headers["etag"]}
    assert client.get(f"{API}/coverage", headers=tag).status_code == 304


def test_every_file_of_the_list_can_be_had(client, small_database):
    listed = client.get(f"{API}/files").json()
    on_disk = {str(p.relative_to(small_database)) for p in small_database.rglob("*") if p.is_file()}
    assert {file["path"] for file in listed} == on_disk
    for file in listed:
        answer = client.get(f"{API}/files/{file['path']}")
        assert hashlib.sha256(answer.content).hexdigest() == file["sha256"]
        assert answer.headers["etag"] == f'"{file["sha256"]}"'
        assert answer.headers["content-type"] == file["content_type"]
        assert answer.headers["content-disposition"].startswith("attachment")
        assert "immutable" in answer.headers["cache-control"]
        head = client.head(f"{API}/files/{file['path']}")
        assert (head.content, int(head.headers["content-length"])) == (b"", file["bytes"])


PARTS = {
    "bytes=0-9": (0, 10),
    "bytes=10-": (10, None),
    "bytes=-7": (-7, None),
    "Bytes = 5-5": (5, 6),
}
WHOLE = ["bytes=9-3", "bytes=a-b", "lines=1-2", "bytes", "bytes=0-1,5-6", "bytes=-", "bytes=1_0-"]


def test_a_range_is_a_part(client, small_database):
    data = (small_database / "stars.parquet").read_bytes()
    size, path = len(data), f"{API}/files/stars.parquet"
    for asked, (start, end) in PARTS.items():
        answer = client.get(path, headers={"Range": asked})
        assert (answer.status_code, answer.content) == (206, data[start:end]), asked
        content_range = f"bytes {start % size}-{(end or size) - 1}/{size}"
        assert answer.headers["content-range"] == content_range
    for asked in WHOLE:  # several ranges, or invalid ones
        answer = client.get(path, headers={"Range": asked})
        assert (answer.status_code, answer.content) == (200, data), asked
    for asked in (f"bytes={size}-", "bytes=-0"):
        answer = client.get(path, headers={"Range": asked})
        assert answer.status_code == answer.json()["status"] == 416
        assert answer.headers["content-range"] == f"bytes */{size}"
    first = {"Range": "bytes=0-9", "If-Range": client.head(path).headers["etag"]}
    assert client.get(path, headers=first).status_code == 206
    assert client.get(path, headers={**first, "If-Range": '"another"'}).status_code == 200


def test_only_files_of_the_manifest_are_there(own_client, own_root, tmp_path):
    folder = own_root / "databases" / DATABASE / "small-1.0.0"
    (folder / "secret.txt").write_text("secret")
    for path in ("../small-1.0.0.build.json", "report", "STARS.parquet", "secret.txt"):
        assert own_client.get(f"{API}/files/{path}").status_code in (400, 404), path
    stars = folder / "stars.parquet"
    (tmp_path / "elsewhere").write_bytes(stars.read_bytes())
    stars.unlink()
    stars.symlink_to(tmp_path / "elsewhere")
    assert own_client.get(f"{API}/files/stars.parquet").status_code == 404
    stars.unlink()
    assert own_client.get(f"{API}/files/stars.parquet").status_code == 404


def test_the_archive_is_the_database(client, tmp_path):
    answer = client.get(f"{API}/archive")
    assert int(answer.headers["content-length"]) == len(answer.content)
    unpack(answer.content, tmp_path / "out")
    assert not verify(tmp_path / "out" / "small-1.0.0").findings
    assert client.get(f"{API}/archive").content == answer.content


def test_two_databases_are_compared(own_client, own_root, database_version):
    add_database(own_root, database_version("1.1.0"), OTHER)
    difference = own_client.get(f"{API}/diff/{OTHER}").json()
    assert [change["name"] for change in difference["spec"]] == ["version"]
    assert difference["counts"] == {"came": 0, "went": 0, "moved": 0}
    assert own_client.get(f"{API}/diff/{DATABASE}").json()["is_same"]
    assert own_client.get(f"{API}/diff/{'0' * 16}").status_code == 404


def test_publishing_makes_a_release_that_can_be_pulled(own_client, own_root, tmp_path):
    first = own_client.post("/api/v1/releases", json={"database": DATABASE, "note": "<b>first</b>"})
    assert (first.status_code, first.json()["outcome"]) == (201, "published")
    again = own_client.post("/api/v1/releases", json={"database": DATABASE, "note": "again"})
    assert (again.status_code, again.json()["outcome"]) == (200, "unchanged")
    [listed] = own_client.get("/api/v1/releases").json()["releases"]
    assert (listed["note"], listed["owner"]) == ("<b>first</b>", "anonymous")
    assert listed == own_client.get("/api/v1/releases/small/1.0.0").json()
    [release] = FolderRegistry(own_root / "registry").releases()
    assert release.title == "small-1.0.0"
    pull_release(FolderRegistry(own_root / "registry"), release, tmp_path / "out")
    assert not verify(tmp_path / "out" / "small-1.0.0").findings


def test_what_the_service_publishes_is_signed_with_its_operators_key(
    own_root, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    private, public = new_key(tmp_path / "service")
    with client_of(own_root, **PUBLIC, signing_key=private) as client:
        ran = client.post("/api/v1/releases", json={"database": DATABASE})
        assert ran.status_code == 201
        timestamp = client.get("/registry/metadata/timestamp.json")
        assert "no-cache" in timestamp.headers["cache-control"]
        assert client.get("/registry/metadata/1.targets.json").status_code == 200
        for path in ("1.snapshots.json", "../service.toml", "0.root.json", "root.json.key", ""):
            assert client.get(f"/registry/metadata/{path}").status_code == 404
    places = {"output": tmp_path / "out", "lock": tmp_path / "lock"}
    registry = str(own_root / "registry")
    pulled = pull("small", registry, options=DownloadOptions(), trust=public, **places)
    assert (pulled.folder.name, pulled.signed) == ("small-1.0.0", "checked")
    with client_of(own_root, **PUBLIC) as client:
        ran = client.post("/api/v1/releases", json={"database": DATABASE})
        assert ran.status_code == 422
        assert "its operator sets signing_key in service.toml" in ran.json()["detail"]


def test_a_key_among_the_files_of_the_service_is_refused(tmp_path):
    (tmp_path / "root").mkdir()
    private, public = new_key(tmp_path / "root" / "service")
    with pytest.raises(ConfigError, match=r"signing_key: .* is in the root"):
        read_settings(tmp_path / "root", signing_key=private)
    with pytest.raises(ConfigError, match="a public key, which only checks"):
        read_settings(tmp_path / "other", signing_key=public)


def test_the_registry_is_its_own_files_only(own_client, own_root):
    assert own_client.get("/registry/index.json").status_code == 404
    own_client.post("/api/v1/releases", json={"database": DATABASE})
    (own_root / "registry" / ".lock").touch()
    index = own_client.get("/registry/index.json")
    assert index.content == (own_root / "registry" / "index.json").read_bytes()
    assert "no-cache" in index.headers["cache-control"]
    tag = {"If-None-Match": index.headers["etag"]}
    assert own_client.get("/registry/index.json", headers=tag).status_code == 304
    release = own_client.get("/registry/versions/small/1.0.0.json").json()
    digest = release["manifest"]["sha256"]
    path = f"/registry/blobs/sha256/{digest[:2]}/{digest}"
    blob = own_client.get(path)
    assert hashlib.sha256(blob.content).hexdigest() == digest
    assert "immutable" in blob.headers["cache-control"]
    part = own_client.get(path, headers={"Range": "bytes=3-"})
    assert (part.status_code, part.content) == (206, blob.content[3:])
    assert own_client.head(path).status_code == 200
    for other in ("", "versions/small/01.0.0.json", f"blobs/sha256/00/{'0' * 64}", ".incoming/x"):
        assert own_client.get(f"/registry/{other}").status_code in (400, 404), other
