"""Answers that were defects: full disks, damaged records, folders that are gone, odd uploads."""

from __future__ import annotations

import errno
import json
import os
import shutil
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("fastapi")

from pictures import png_of
from served import serve
from services import DATABASE, add_database, client_of

from starcat.errors import OutputError, ProductError
from starcat.images.background import subtract_background
from starcat.images.spots import sigma_of_stars
from starcat_service.problems import outage_of
from starcat_service.records import Records

QUESTION = {"targets": [DATABASE], "query": "SELECT count(*) FROM stars"}
IDENTIFY = f"/api/v1/identify/{DATABASE}"
ARCHIVE = f"/api/v1/databases/{DATABASE}/archive"


@pytest.fixture
def own(tmp_path: Path, small_artifact: Path) -> Path:
    """The folder of a service that no other test uses."""
    add_database(tmp_path / "root", small_artifact)
    return tmp_path / "root"


# Full disks.


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 48 MiB."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=48m", "tmpfs", str(place)]
    if sys.platform != "linux" or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("a disk can be mounted by root of Linux only")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def fill(place: Path) -> None:
    left = shutil.disk_usage(place).free
    with (place / "filler").open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, left)


def picture_of(image: Any) -> bytes:
    rows = b"".join(b"\0" + row.tobytes() for row in image)
    return png_of(image.shape[1], image.shape[0], rows)


BLACK = np.zeros((64, 64), np.uint8)


@pytest.mark.slow
def test_a_full_disk_is_reported_whatever_is_to_be_left_free(small_disk, small_artifact):
    root = small_disk / "root"
    add_database(root, small_artifact)
    with client_of(root, free_gib=0.0, anonymous="publisher") as client:
        assert client.get("/readyz").status_code == 200
        fill(small_disk)
        found = client.get("/readyz")
        assert found.status_code == 503
        assert any("GiB free" in one or "is full" in one for one in found.json()["reasons"])
        file = {"file": ("frame.png", picture_of(BLACK))}
        csv = {**QUESTION, "format": "csv"}
        for answer in (
            client.post(IDENTIFY, files=file),
            client.post("/tap/async", data={"QUERY": "SELECT 1"}),
            client.post("/api/v1/sql", json=csv),
        ):
            assert answer.status_code == 507, answer.text
        assert client.get(f"/api/v1/databases/{DATABASE}").status_code == 200
        (small_disk / "filler").unlink()
        assert client.get("/readyz").status_code == 200
        assert client.post("/api/v1/sql", json=csv).status_code == 200


OUTAGES = [
    (OSError(errno.ENOSPC, "No space left on device"), 507),
    (OSError(errno.EDQUOT, "Disk quota exceeded"), 507),
    (sqlite3.OperationalError("database or disk is full"), 507),
    (sqlite3.DatabaseError("database disk image is malformed"), 503),
    (OSError(errno.EIO, "Input/output error"), None),
    (ValueError("anything"), None),
]


@pytest.mark.parametrize(("error", "status"), OUTAGES)
def test_what_is_no_defect_of_starcat_has_a_status_of_its_own(tmp_path, error, status):
    found = outage_of(error, tmp_path)
    assert (found.status if found else None) == status
    wrapped = OutputError("cannot be written", path=tmp_path)
    wrapped.__cause__ = error
    assert (found := outage_of(wrapped, tmp_path)) is None or found.status == status


# Records.


def test_damaged_records_are_named_with_the_backup_at_the_start(tmp_path):
    (tmp_path / "records.sqlite").write_bytes(b"no database at all" * 1000)
    with pytest.raises(ProductError, match=r"records.sqlite cannot be used .*last backup") as told:
        Records(tmp_path / "records.sqlite")
    assert str(tmp_path / "records.sqlite") in str(told.value)


@pytest.mark.slow
def test_damaged_records_are_reported_while_the_service_runs(own):
    with client_of(own) as client:
        assert client.get("/readyz").status_code == 200
        other = sqlite3.connect(own / "records.sqlite")
        other.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        other.close()
        size = (own / "records.sqlite").stat().st_size
        (own / "records.sqlite").write_bytes(b"x" * size)
        found = client.get("/readyz")
        assert found.status_code == 503
        assert "records.sqlite cannot be used" in found.text
        assert "backup" in found.text
        for path in ("/api/v1/jobs", "/tap/async", "/jobs"):
            answer = client.get(path)
            assert answer.status_code == 503, path
            assert "records.sqlite" in answer.text
        signed = client.get("/api/v1/databases", headers={"Authorization": "Bearer starcat_x"})
        assert signed.status_code == 503


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_root_that_is_gone_is_reported(own):
    with client_of(own, anonymous="publisher") as client:
        assert client.get("/readyz").status_code == 200
        shutil.move(own, own.with_name("elsewhere"))
        found = client.get("/readyz")
        assert found.status_code == 503
        assert "the folder of the service is gone" in found.text
        file = {"file": ("frame.png", picture_of(BLACK))}
        answers = [
            client.post(IDENTIFY, files=file),
            client.post("/api/v1/sql", json={**QUESTION, "format": "csv"}),
            client.post("/tap/async", data={"QUERY": "SELECT 1"}),
            client.get("/tap/tables"),
            client.get("/api/v1/databases"),
        ]
        assert 500 not in [one.status_code for one in answers]
        shutil.move(own.with_name("elsewhere"), own)
        assert client.get("/readyz").status_code == 200


# Uploads.


@pytest.mark.slow
def test_an_interrupted_upload_is_no_defect(own, tmp_path):
    part = b'--edge\r\nContent-Disposition: form-data; name="file"; filename="f.png"\r\n\r\nxx'
    kinds = ["multipart/form-data; boundary=edge", "application/json"]
    with serve(own, tmp_path / "log") as served:
        for path in (IDENTIFY, "/tap/sync", "/identify"):
            for kind in kinds:
                with socket.create_connection(("127.0.0.1", served.port), 10.0) as line:
                    head = (
                        f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: {kind}\r\n"
                        "Content-Length: 5000\r\n\r\n"
                    )
                    line.sendall(head.encode() + part)
                    time.sleep(0.1)
        assert served.raw("GET", "/healthz").status == 200
        time.sleep(0.3)
        lines = [json.loads(one) for one in served.log.read_text().splitlines() if one[:1] == "{"]
    assert [one for one in lines if one["level"] == "error"] == []


def two_spots(*sigmas: float) -> Any:
    y, x = np.mgrid[0:512, 0:512]
    image = np.random.default_rng(5).normal(100.0, 2.0, (512, 512))
    for k, sigma in enumerate(sigmas):
        image += 9000.0 * np.exp(-((x - 80 - 150 * k) ** 2 + (y - 90) ** 2) / (2 * sigma**2))
    return np.clip(image / 40.0, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigmas", [(1.0, 3.5), (1.2, 2.4), (0.9, 2.0, 4.0)])
def test_spots_of_different_widths_have_a_width(sigmas):
    levels = subtract_background(two_spots(*sigmas).astype(np.float64))
    places = np.array([(80.5 + 150 * k, 90.5) for k in range(len(sigmas))])
    found = sigma_of_stars(levels, places, np.arange(9.0, 0.0, -1.0)[: len(places)])
    assert 0.5 < found < 5.0


def test_a_picture_of_two_spots_is_answered(client):
    found = client.post(IDENTIFY, files={"file": ("two.png", picture_of(two_spots(1.0, 3.5)))})
    assert found.status_code == 200, found.text
    assert found.json()["frames"][0]["status"] != "match"


def test_a_camera_of_brackets_is_refused(client):
    frame = {"centroids_px": [[1, 2], [3, 4], [5, 6], [7, 8]]}
    for text in ("a = " + "[" * 9000, "a = " + "{a = " * 3000, "a" + ".a" * 9000 + " = 1"):
        body = {**frame, "options": {"camera": text}}
        found = client.post(IDENTIFY, json=body)
        assert found.status_code == 422, found.text[:200]
    nested = "[" * 9000
    found = client.post(
        "/api/v1/sql", content=nested.encode(), headers={"Content-Type": "application/json"}
    )
    assert found.status_code in (400, 422)


# Archives.


def test_an_archive_follows_no_link_and_has_what_the_manifest_says(own, tmp_path):
    secret = tmp_path / "secret"
    [stars] = own.glob("databases/*/*/stars.parquet")
    secret.write_bytes(stars.read_bytes())
    with client_of(own) as client:
        assert client.get(ARCHIVE).status_code == 200
        content = stars.read_bytes()
        stars.unlink()
        stars.symlink_to(secret)
        found = client.get(ARCHIVE)
        assert (found.status_code, "stars.parquet" in found.text) == (404, True)
        stars.unlink()
        stars.write_bytes(content[:-1])
        found = client.get(ARCHIVE)
        assert (found.status_code, "the manifest says" in found.text) == (422, True)
        stars.unlink()
        assert client.get(ARCHIVE).status_code == 404
