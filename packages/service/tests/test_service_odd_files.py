"""Files that libraries stumble over are refused by the service with a 4xx, and pages stay pages."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient
from services import DATABASE, add_database, client_of, token_of

from starcat_service.app import API, OTHERS, RESOURCES

DEEP = 200_000
HUGE = "7" * 400  # more than a float can be
LONG = "7" * 5_000  # more digits than Python reads


@pytest.fixture(scope="module")
def client(small_artifact: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    root = tmp_path_factory.mktemp("odd") / "root"
    add_database(root, small_artifact)
    with client_of(root, anonymous="publisher", requests_per_minute=1_000_000) as client:
        yield client


def votable(encoding: str, datatype: str = "double", cell: str = "1") -> bytes:
    return (
        f'<?xml version="1.0" encoding="{encoding}"?><VOTABLE version="1.4"><RESOURCE><TABLE>'
        f'<FIELD name="a" datatype="{datatype}"/><DATA><TABLEDATA><TR><TD>{cell}</TD></TR>'
        "</TABLEDATA></DATA></TABLE></RESOURCE></VOTABLE>"
    ).encode()


FRAMES = {
    "deep.json": b"[" * DEEP,
    "deep-pair.json": b'{"centroids_px": [[' + b"[" * DEEP,
    "deep-closed.json": b'{"centroids_px": ' + b"[" * 900 + b"]" * 900 + b"}",
    "deep-object.json": b'{"a":' * DEEP,
    "huge.json": f'{{"centroids_px": [[{HUGE}, 1]]}}'.encode(),
    "long.json": f'{{"centroids_px": [[{LONG}, 1]]}}'.encode(),
    "huge-mag.json": f'{{"centroids_px": [[1, 1]], "mag": [{HUGE}]}}'.encode(),
    "huge-list.json": f'{{"centroids_px": [{HUGE}]}}'.encode(),
    "utf-16.json": '{"centroids_px": [[1, 2]]}'.encode("utf-16"),
    "utf-32.csv": "x_px,y_px\n1,2\n".encode("utf-32"),
    "nulls.csv": b"x_px,y_px\n\0,\0\n",
    "quotes.csv": b'x_px,y_px\n"' + b"1" * 200_000,
    "surrogate.json": b'{"centroids_px": [[1, 2]], "name": "\\ud800", "mag": ["\\ud800"]}',
    "text.json": b'"x"',
    "true.json": b"true",
}


@pytest.mark.parametrize("name", FRAMES)
def test_a_file_of_frames_is_refused_and_the_page_stays_a_page(client, name):
    file = {"file": (name, FRAMES[name])}
    for path in ("", "/picture"):
        answer = client.post(f"/api/v1/identify/{DATABASE}{path}", files=file)
        assert 400 <= answer.status_code < 500, answer.text[:300]
    page = client.post("/identify", files=file, data={"database": DATABASE})
    assert page.status_code < 500
    assert page.headers["content-type"].startswith("text/html")


@pytest.mark.parametrize(
    "encoding",
    [
        "utf-7",
        "utf-16",
        "utf-32",
        "idna",
        "punycode",
        "rot13",
        "base64",
        "zip",
        "x",
        "cp037",
        "gbk",
    ],
)
def test_a_votable_in_an_odd_encoding_is_refused(client, encoding):
    assert_refused(client, votable(encoding))


@pytest.mark.parametrize(
    "content",
    [
        votable("utf-8", "int", LONG),
        votable("utf-8", "strange"),
        votable("utf-8", 'double" arraysize="9999999999x9999999999', "1"),
        b"<a>" * DEEP,
        b"<VOTABLE>" + b"<RESOURCE>" * 20_000,
        votable("utf-8").decode().encode("utf-16"),
        b"\0" * 100,
        b"",
    ],
    ids=["long", "datatype", "arraysize", "deep", "resources", "utf-16", "nulls", "empty"],
)
def test_an_odd_votable_is_refused(client, content):
    assert_refused(client, content)


def assert_refused(client: TestClient, content: bytes) -> None:
    answer = client.post(
        "/tap/sync",
        data={"LANG": "ADQL", "QUERY": "SELECT * FROM TAP_UPLOAD.t", "UPLOAD": "t,param:f"},
        files={"f": ("t.xml", content)},
    )
    assert 400 <= answer.status_code < 500, answer.text[:400]
    assert "defect" not in answer.text


DEEP_TOML = {
    "array": "name = " + "[" * 50_000,
    "inline": "name = " + "{a=" * 50_000,
    "tables": "".join(f"[{'a.' * 150}b{k}]\n" for k in range(300)),
    "long": f"version = {LONG}",
    "huge": f"epoch_jyear = {HUGE}",
    "hex": f"epoch_jyear = 0x{'f' * 90_000}",
    "time": "name = 2026-99-99T00:00:00",
    "surrogate": 'name = "\\ud800"',
}


@pytest.mark.parametrize("name", DEEP_TOML)
def test_an_odd_spec_is_refused(client, name):
    text = DEEP_TOML[name]
    for body in (
        {"content": text, "headers": {"Content-Type": "application/toml"}},
        {"json": {"toml": text}},
        {"json": {"preset": "gaia-12deg", "changes": {"camera": text.partition("=")[2][:2000]}}},
    ):
        answer = client.post("/api/v1/specs/validate", **body)
        assert 400 <= answer.status_code < 500, answer.text[:300]
    for target in ("/new", "/new/preview"):
        answer = client.post(target, data={"toml": text, "toml-before": ""})
        assert answer.status_code < 500, answer.text[:300]


@pytest.fixture
def locked_out(tmp_path: Path, small_artifact: Path) -> Iterator[tuple[TestClient, str]]:
    """A client without a token of a service that needs one, and a token."""
    root = tmp_path / "root"
    add_database(root, small_artifact)
    with client_of(root):
        pass  # makes the records
    token = token_of(root, "anna")
    with client_of(root, anonymous="none") as client:
        yield client, token


def test_a_session_lets_an_upload_in_and_a_file_before_it_does_not(locked_out):
    client, token = locked_out
    login = client.post("/api/login", data={"request-json": json.dumps({"apikey": token})}).json()
    given = json.dumps({"session": login["session"]})
    picture = ("a.fits", b"x" * 200_000)
    answer = client.post("/api/upload", data={"request-json": given}, files={"file": picture})
    assert "session" not in answer.json()["errormessage"]  # the picture is wrong, the session not
    text = client.post("/api/upload", data={"request-json": given})
    assert "centroids" in text.json()["errormessage"]


def test_bad_json_at_the_login_is_answered_as_nova_does(client):
    for given in ("{", "[]", "[" * DEEP):
        answer = client.post("/api/login", data={"request-json": given}).json()
        assert answer["status"] == "error"
        assert "request-json" in answer["errormessage"]
