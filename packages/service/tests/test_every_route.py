"""Every route of the service: who may use it, unknown names, other sites, odd bodies, its words."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from services import DATABASE, add_database, client_of, every_route, with_name

from starcat_service.settings import Role

ROUTES = list(every_route())
POSTS = [path for method, path in ROUTES if method == "POST"]

OPEN = re.compile(
    "/healthz|/sign-(in|out)|/static/.*|/tap/(availability|capabilities)"
    "|/api/(login|url_upload|submissions/.*|jobs/.*)|/wcs_file/.*|/joblog/.*"
)
"""Paths that everybody may use."""

NEEDED = {
    Role.BUILDER: (
        *("POST /api/v1/jobs", "POST /api/v1/jobs/{job_id}/cancel"),
        *("POST /api/v1/jobs/{job_id}/retry", "POST /jobs/{job_id}/cancel"),
        *("POST /jobs/{job_id}/retry", "POST /databases/{database_id}/evaluate", "POST /catalogs"),
        *("DELETE /api/v1/databases/{database}", "POST /databases/{database_id}/remove"),
    ),
    Role.PUBLISHER: (
        *("DELETE /api/v1/catalogs/stored/{name}", "POST /catalogs/{name}/remove"),
        *("POST /api/v1/releases", "POST /releases"),
        *("GET /api/v1/tokens", "POST /api/v1/tokens", "DELETE /api/v1/tokens/{token_id}"),
        *("GET /tokens", "POST /tokens", "POST /tokens/{token_id}/revoke"),
    ),
}
"""Routes that need more than the role of a reader."""

NAMES = {
    "f" * 16: (404, 422), "x" * 300: (404, 422), "*": (404, 422), "' OR 1=1 --": (404, 422),
    "glob('%2A')": (404, 422), "..%2f..%2frecords.sqlite": (400,), "%2e%2e": (400,),
    "..%5c..%5cx": (400,), "a%00": (400,),
}  # fmt: skip
"""Names that nothing has, and the statuses of their refusal."""

DEEP, HUGE, LONG = 200_000, "7" * 400, "7" * 5_000
ODD_JSON = {
    "deep": "[" * DEEP,
    "objects": '{"spec":' * DEEP,
    "long": '{"spec": {"epoch_jyear": ' + LONG + "}}",
    "huge": '{"spec": {"camera": {"fov_x_deg": ' + HUGE + "}}}",
    "surrogate": '{"spec": {"name": "\\ud800"}}',
    "value": '{"targets": ["a"], "query": "SELECT 1", "values": {"x": ' + HUGE + "}}",
}


@pytest.fixture(scope="module")
def client(small_database: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A client of a service that needs a token for everything."""
    root = tmp_path_factory.mktemp("routes")
    add_database(root, small_database)
    with client_of(root, anonymous="none", requests_per_minute=1_000_000) as client:
        yield client


@pytest.fixture(scope="module")
def users(client) -> dict[Role, dict[str, str]]:
    """The header of a user of each role."""
    store = client.app.state.identities.tokens
    named = {role: store.create(role.name, role)[1] for role in Role if role is not Role.NONE}
    return {Role.NONE: {}} | {
        role: {"Authorization": f"Bearer {token}"} for role, token in named.items()
    }


class TestEveryRoute:
    @pytest.mark.parametrize(("method", "path"), ROUTES)
    def test_it_is_for_those_who_may(self, client, users, method, path):
        [needed] = [role for role in NEEDED if f"{method} {path}" in NEEDED[role]] or [
            Role.NONE if OPEN.fullmatch(path) else Role.READER
        ]
        for role, headers in users.items():
            if path in ("/api/login", "/api/upload", "/sign-in") and role is Role.NONE:
                continue  # these take a token in their content
            answer = client.request(
                method, with_name(path, "f" * 16), headers=headers, follow_redirects=False
            )
            refused = 401 if role is Role.NONE else 403
            if role < needed:
                assert answer.status_code == refused, role
            else:
                assert answer.status_code not in (401, 403), role
                assert answer.status_code < 500, role

    @pytest.mark.parametrize(
        ("method", "path"),
        [route for route in ROUTES if "{" in route[1] and "digest" not in route[1]],
    )
    def test_nothing_has_an_unknown_name(self, client, users, method, path):
        is_rest = path.startswith("/api/v1/")
        body = {"json": {"centroids_px": []}} if is_rest else {"data": {"x": "y"}}
        request = body | {"headers": users[Role.PUBLISHER], "params": {"RA": 0, "DEC": 0, "SR": 1}}
        for name, statuses in NAMES.items():
            answer = client.request(method, with_name(path, name), **request)
            assert answer.status_code in statuses, name
            assert "Traceback" not in answer.text
            assert str(client.app.state.service.paths.root) not in answer.text

    @pytest.mark.parametrize(("method", "path"), [route for route in ROUTES if route[0] != "GET"])
    def test_other_sites_change_nothing(self, client, users, method, path):
        for site in ({"Sec-Fetch-Site": "cross-site"}, {"Origin": "https://evil.example"}):
            answer = client.request(
                method, with_name(path, DATABASE), headers=users[Role.PUBLISHER] | site
            )
            assert answer.status_code == 403 or method == "HEAD"

    @pytest.mark.parametrize("path", [path for path in POSTS if path.startswith("/api/v1/")])
    def test_odd_json_is_refused(self, client, users, path):
        headers = users[Role.PUBLISHER] | {"Content-Type": "application/json"}
        for name, body in ODD_JSON.items():
            content = body.encode("utf-8", "surrogatepass")
            answer = client.post(with_name(path, DATABASE), content=content, headers=headers)
            assert 400 <= answer.status_code < 500, (name, answer.text[:300])

    @pytest.mark.parametrize("path", POSTS)
    def test_little_of_a_body_is_read_before_a_user_is_refused(self, client, path):
        status, taken = taken_before_the_answer(client, with_name(path, "f" * 16))
        assert 300 <= status < 500
        assert taken <= (1 << 17 if path == "/api/upload" else (1 << 20) + (1 << 16))


def test_the_schema_and_its_page_explain_every_operation(client, users):
    headers = users[Role.READER]
    page = client.get("/api/docs", headers=headers).text
    schema = client.get("/api/openapi.json", headers=headers).json()
    assert schema["openapi"].startswith("3.")
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            where = f"{method.upper()}</span> <code>{re.escape(path)}</code>"
            assert re.search(f">{where}", page), where
            assert operation.get("summary"), where
            assert operation.get("description"), where
            if path.startswith("/api/"):
                assert "422" in operation["responses"] or "404" in operation["responses"], where


HEAD = (
    b'--b\r\nContent-Disposition: form-data; name="request-json"\r\n\r\n{"session": "wrong"}\r\n'
    b'--b\r\nContent-Disposition: form-data; name="file"; filename="a.fits"\r\n\r\n'
)


def taken_before_the_answer(client: TestClient, path: str) -> tuple[int, int]:
    """Send 60 MiB in pieces; return the status, and the bytes that were taken until it came."""
    taken, statuses = 0, []
    pieces = iter([HEAD, *[b"x" * (1 << 16)] * 960])

    async def receive() -> dict[str, Any]:
        nonlocal taken
        piece = next(pieces, b"")
        taken += 0 if statuses else len(piece)
        return {"type": "http.request", "body": piece, "more_body": bool(piece)}

    async def send(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            statuses.append(message["status"])

    headers = [(b"content-type", b"multipart/form-data; boundary=b"), (b"host", b"127.0.0.1:8000")]
    scope = {
        "type": "http", "method": "POST", "path": path, "raw_path": path.encode(),
        "query_string": b"", "headers": headers, "client": ("192.0.2.1", 1), "scheme": "http",
        "server": ("127.0.0.1", 8000), "http_version": "1.1", "root_path": "",
    }  # fmt: skip
    assert client.portal is not None
    client.portal.call(client.app, scope, receive, send)
    return statuses[0], taken
