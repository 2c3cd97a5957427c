"""Checks of every request to the service: its user, rate, size and origin."""

from __future__ import annotations

import json
import logging
import shutil
import socket
import sqlite3
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI, Request
from prometheus_client.parser import text_string_to_metric_families
from services import add_database, waiting_build
from starlette.testclient import TestClient

from starcat.errors import ConfigError, TargetMissing
from starcat_service import access, removal
from starcat_service.access import Reader, principal_of
from starcat_service.app import make_app
from starcat_service.library import Library
from starcat_service.pages import home
from starcat_service.paths import ServicePaths
from starcat_service.security import request_limits
from starcat_service.security.middleware import JsonFormatter
from starcat_service.security.request_limits import Buckets
from starcat_service.security.tokens import TokenStore
from starcat_service.server import listen, run_server
from starcat_service.settings import Role, ServiceSettings, read_settings

Make = Callable[..., TestClient]


def with_probes(app: FastAPI) -> FastAPI:
    """Add addresses that act as handlers do: return the user, read a body, fail."""

    @app.get("/probe/who")
    def tell(request: Request) -> dict[str, str]:
        principal = principal_of(request)
        return {"name": principal.name, "role": principal.role.name}

    @app.get("/probe/{thing}/read")
    def read(thing: str, who: Reader) -> str:
        return thing

    @app.post("/probe/body")
    async def take(request: Request) -> int:
        return len(await request.body())

    @app.get("/probe/broken")
    def broken() -> None:
        raise RuntimeError("secret words of a library, with /a/path")

    return app


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    """Clients of services with settings, each at 127.0.0.1 by default."""
    opened = []

    def client(**options: Any) -> TestClient:
        app = with_probes(make_app(read_settings(tmp_path / "root", **options)))
        opened.append(app)
        return TestClient(app, base_url="http://127.0.0.1")

    yield client
    for app in opened:
        app.state.service.records.close()


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A client of a service with the usual settings."""
    app = with_probes(make_app(read_settings(tmp_path_factory.mktemp("guard"))))
    yield TestClient(app, base_url="http://127.0.0.1")
    app.state.service.records.close()


def token_for(client: TestClient, name: str, role: Role = Role.READER, **more: float) -> str:
    app: Any = client.app
    return TokenStore(app.state.service.records).create(name, role, **more)[1]


@pytest.fixture(scope="module")
def anna(client) -> str:
    """The token of a reader."""
    return token_for(client, "anna")


def bearer(text: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {text}"}


def test_a_token_is_kept_as_a_digest_only(make):
    at = make()
    text = token_for(at, "anna", Role.BUILDER)
    app: Any = at.app
    path = app.state.service.paths.records
    app.state.service.records.close()
    written = b"".join(file.read_bytes() for file in path.parent.glob("records.sqlite*"))
    assert b"anna" in written
    assert text.encode() not in written
    assert text.removeprefix("starcat_").encode() not in written
    assert text.startswith("starcat_")
    assert len(text) == 8 + 43  # 256 bits in base 64


def test_a_token_gives_its_role_by_each_way_to_send_it(client):
    text = token_for(client, "bea", Role.BUILDER)
    builder = {"name": "bea", "role": "BUILDER"}
    assert client.get("/probe/who").json() == {"name": "anonymous", "role": "READER"}
    assert client.get("/probe/who", headers=bearer(text)).json() == builder
    assert client.get("/probe/who", auth=("anyone", text)).json() == builder
    digest = {"Authorization": f"Digest {text}"}
    assert client.get("/probe/who", headers=digest).status_code == 401


@pytest.mark.parametrize(
    "wrong", ["starcat_", "starcat_x", "", "x" * 10_000, "starcat_\xe9", "'--"]
)
def test_a_wrong_token_is_refused_also_if_no_token_is_needed(client, wrong):
    header = {"Authorization": f"Bearer {wrong}".encode("latin-1")}
    answer = client.get("/probe/who", headers=header)
    assert answer.status_code == 401
    assert answer.headers["content-type"] == "application/problem+json"
    assert "not valid" in answer.json()["detail"]


def test_expired_and_revoked_tokens_are_worth_nothing(client, monkeypatch):
    monkeypatch.setattr(access, "CACHED_TOKEN_S", 0.0)
    short, text = token_for(client, "short", expires_days=1.0), token_for(client, "carl")
    store = TokenStore(client.app.state.service.records)
    assert client.get("/probe/who", headers=bearer(text)).status_code == 200
    assert [token.name for token in store.revoke("carl")] == ["carl"]
    assert client.get("/probe/who", headers=bearer(text)).status_code == 401
    assert client.get("/probe/who", headers=bearer(short)).status_code == 200
    tomorrow = time.time() + 86_401.0
    monkeypatch.setattr(time, "time", lambda: tomorrow)
    assert client.get("/probe/who", headers=bearer(short)).status_code == 401
    with pytest.raises(TargetMissing, match="no valid token"):
        store.revoke("carl")


def test_a_known_token_is_accepted_without_a_look_up(client, monkeypatch):
    text, lookups, asked = token_for(client, "dora"), list[int](), TokenStore.find
    monkeypatch.setattr(
        TokenStore, "find", lambda self, text: (lookups.append(1), asked(self, text))[1]
    )
    for _ in range(5):
        assert client.get("/probe/who", headers=bearer(text)).json()["name"] == "dora"
    assert len(lookups) == 1


def test_one_valid_token_has_a_plain_name(client):
    for name in ("", "-x", "a b", "anonymous", "x" * 65, "a\n", "<b>"):
        with pytest.raises(ConfigError, match="cannot be the name of a token"):
            token_for(client, name)
    token_for(client, "emil")
    store = TokenStore(client.app.state.service.records)
    store.revoke("emil")
    token_for(client, "emil")
    states = [token.state(time.time()) for token in store.all() if token.name == "emil"]
    assert states == ["revoked", "valid"]


def test_guessing_is_slowed_down_and_the_right_token_still_goes_through(make):
    at = make()
    text = token_for(at, "anna")
    wrong = [at.get("/probe/who", headers=bearer(f"starcat_{k}")) for k in range(15)]
    assert [answer.status_code for answer in wrong] == [401] * 10 + [429] * 5
    assert 1 <= int(wrong[-1].headers["retry-after"]) <= 6
    assert at.post("/sign-in", data={"token": "starcat_wrong"}).status_code == 429
    assert at.get("/probe/who", headers=bearer(text)).status_code == 200


def test_a_sign_in_is_a_cookie_that_is_not_the_token(make):
    at = make()
    text = token_for(at, "anna", Role.PUBLISHER)
    answer = at.post("/sign-in", data={"token": text, "next": "/jobs"}, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/jobs")
    cookie = answer.headers["set-cookie"]
    assert text not in cookie
    assert cookie.startswith("starcat-8000="), "another service of the host has another name"
    assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(cookie.split("; "))
    assert "Secure" not in cookie
    assert at.get("/probe/who").json() == {"name": "anna", "role": "PUBLISHER"}
    secret = at.cookies["starcat-8000"]
    same_origin = {"Origin": "http://127.0.0.1"}
    assert at.post("/sign-out", headers=same_origin, follow_redirects=False).status_code == 303
    at.cookies.set("starcat-8000", secret)
    assert at.get("/probe/who").json()["name"] == "anonymous"


def test_a_sign_in_ends_with_its_time_and_with_its_token(make, monkeypatch):
    monkeypatch.setattr(access, "CACHED_TOKEN_S", 0.0)
    at = make(session_hours=1.0)
    at.post("/sign-in", data={"token": token_for(at, "anna")})
    assert at.get("/probe/who").json()["name"] == "anna"
    secret, later = at.cookies["starcat-8000"], time.time() + 3601.0
    kept = {"Cookie": f"starcat-8000={secret}"}
    with monkeypatch.context() as changed:
        changed.setattr(time, "time", lambda: later)
        assert at.get("/probe/who", headers=kept).json()["name"] == "anonymous"
    assert at.get("/probe/who", headers=kept).json()["name"] == "anna"
    TokenStore(at.app.state.service.records).revoke("anna")
    assert at.get("/probe/who", headers=kept).json()["name"] == "anonymous"


def test_a_wrong_token_of_a_sign_in_shows_the_form_again(client):
    answer = client.post("/sign-in", data={"token": "starcat_x", "next": "//evil.example"})
    assert answer.status_code == 401
    assert "not valid" in answer.text
    assert "evil.example" not in answer.text
    assert "set-cookie" not in answer.headers


OTHERS = [{"host": "0.0.0.0"}, {"public_url": "https://stars.example"}]


@pytest.mark.parametrize("options", OTHERS)
def test_others_than_this_machine_need_a_token_for_all_but_signing_in(make, tmp_path, options):
    with pytest.raises(ConfigError, match="make one first: starcat token create NAME"):
        run_server(read_settings(tmp_path / "root", **options), print)
    at = make(**options)
    text = token_for(at, "anna")
    for path in ("/probe/who", "/metrics", "/readyz", "/api/openapi.json", "/nothing"):
        answer = at.get(path)
        assert answer.status_code == 401, path
        assert answer.headers["www-authenticate"] == 'Bearer realm="starcat"'
    assert at.get("/tap/tables").headers["www-authenticate"].startswith("Basic ")
    for path in ("/sign-inx", "/healthzx", "/api/uploads", "/tap/availability/x"):
        assert at.get(path).status_code == 401, "it only begins as an open path"
    seen = at.get("/jobs", headers={"Accept": "text/html"}, follow_redirects=False)
    assert (seen.status_code, seen.headers["location"]) == (303, "/sign-in?next=/jobs")
    page = at.get("/sign-in?next=/jobs").text
    assert 'name="next" value="/jobs"' in page
    assert "shows nothing without a token" in page
    assert at.get("/probe/who", headers=bearer(text)).json()["role"] == "READER"
    if "public_url" in options:  # people come by https, and the cookie is for https alone
        at.base_url = options["public_url"]
        cookie = at.post("/sign-in", data={"token": text}, follow_redirects=False).headers
        assert cookie["set-cookie"].startswith("__Host-starcat=")
        assert "Secure" in cookie["set-cookie"]
        assert cookie["strict-transport-security"] == "max-age=31536000"


def test_requests_of_one_address_or_token_are_limited(make):
    at = make(requests_per_minute=1)
    text = token_for(at, "anna")
    answers = [at.get("/probe/who") for _ in range(3)]
    assert [answer.status_code for answer in answers] == [200, 429, 429]
    assert 1 <= int(answers[-1].headers["retry-after"]) <= 60
    assert at.get("/healthz").status_code == 200
    assert at.get("/probe/who", headers=bearer(text)).status_code == 200


def test_a_bucket_fills_again_and_the_quietest_is_forgotten(monkeypatch):
    now = [0.0]
    buckets = Buckets(2.0, lambda: now[0])
    assert [buckets.take("a") for _ in range(3)] == [0.0, 0.0, 30.0]
    now[0] = 15.0
    assert buckets.take("a") == 15.0
    now[0] = 30.0
    assert buckets.take("a") == 0.0
    assert buckets.take("a") == 30.0
    monkeypatch.setattr("starcat_service.security.request_limits.MAX_BUCKETS", 2)
    buckets.take("b")
    buckets.take("c")
    assert buckets.take("a") == 0.0  # full again, for it was forgotten


FORGED = [
    {"Origin": "https://evil.example"}, {"Origin": "null"}, {"Origin": "http://127.0.0.1:9999"},
    {"Origin": "http://127.0.0.1.evil.example"}, {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site"}, {"Cookie": "starcat-8000=anything"},
]  # fmt: skip
HONEST = [
    {}, {"Origin": "http://127.0.0.1"}, {"Cookie": "other=1"},
    {"Sec-Fetch-Site": "same-origin", "Origin": "http://127.0.0.1"},
]  # fmt: skip


def test_what_another_site_makes_a_browser_send_is_refused(make):
    at = make(anonymous="publisher")
    for headers, status in (
        *((origin, 403) for origin in FORGED),
        *((origin, 200) for origin in HONEST),
    ):
        assert at.post("/probe/body", headers=headers).status_code == status, headers
        assert at.get("/probe/who", headers=headers).status_code == 200, headers


HOSTS = [
    ({}, {
        "localhost:8000": 200, "[::1]:8000": 200, "LOCALHOST": 200, "evil.example": 421,
        "localhost.evil.example": 421, "127.0.0.1.evil.example:8000": 421, "a b": 400, "": 400,
    }),
    ({"public_url": "https://stars.example"}, {"stars.example": 200, "evil.example": 421}),
    ({"host": "0.0.0.0"}, {"anything.example": 200}),
]  # fmt: skip


@pytest.mark.parametrize(("options", "hosts"), HOSTS)
def test_a_name_that_is_not_ours_is_refused(make, options, hosts):
    at = make(**options)
    statuses = {host: at.get("/healthz", headers={"Host": host}).status_code for host in hosts}
    assert statuses == hosts


TARGETS = {
    "/probe/%00/read": 400, "/probe/%0d%0aX:y/read": 400, "/probe/..%2f..%2fetc/read": 400,
    "/probe/%2e%2e/read": 400, "/probe/..%5c..%5cx/read": 400, "/probe/a/read?x=%00": 400,
    "/probe/a/read?x=" + "y" * 20_000: 414, "/probe/a..b/read": 200, "/probe/a/read?x=%0a..": 200,
}  # fmt: skip


def test_addresses_that_no_honest_client_sends_are_refused(client):
    assert {path: client.get(path).status_code for path in TARGETS} == TARGETS


def test_too_many_headers_and_odd_methods_are_refused(client):
    at = client
    many = {f"X-{k}": "v" for k in range(120)}
    assert at.get("/healthz", headers=many).status_code == 431
    assert at.get("/healthz", headers={"X-Long": "v" * 40_000}).status_code == 431
    assert at.request("TRACE", "/healthz").status_code == 405
    assert at.request("PURGE\u0130", "/healthz").status_code == 405


def test_a_body_is_too_large_by_what_it_says_and_by_what_it_is(make):
    at = make(upload_mib=0.5)
    large = b"x" * (2**19 + 1)
    assert at.post("/probe/body", content=large[:-1]).json() == 2**19
    assert at.post("/probe/body", content=large).status_code == 413
    assert at.post("/probe/body", content=iter([large[:100], large])).status_code == 413
    json_text = {"Content-Type": "application/json"}
    at = make()
    assert at.post("/probe/body", content=b"x" * (2**20 + 1), headers=json_text).status_code == 413
    assert at.post("/probe/body", content=b"x" * (2**20 + 1)).status_code == 200
    assert at.post("/probe/body", headers={"Content-Length": "-1"}).status_code == 400


def test_nothing_is_added_to_a_full_disk(client, monkeypatch):
    monkeypatch.setattr(request_limits, "free_gib", lambda folder: 0.99)
    answer = client.post("/probe/body", files={"file": b"x"})
    assert answer.status_code == 507
    assert "0.99 GiB free, and 1 have to be left" in answer.json()["detail"]
    assert client.post("/probe/body", content=b"x").status_code == 200
    assert client.get("/probe/who").status_code == 200


def test_a_defect_tells_the_log_and_not_the_client(client, caplog, monkeypatch):
    answer = client.get("/probe/broken", headers={"X-Request-ID": "mine-1"})
    assert answer.status_code == 500
    assert "secret words" not in answer.text
    assert "Traceback" not in answer.text
    assert answer.headers["x-request-id"] == "mine-1"
    assert answer.headers["content-security-policy"].startswith("default-src 'self'")
    [record] = [logged for logged in caplog.records if logged.exc_info]
    line = json.loads(JsonFormatter().format(record))
    assert "secret words" in line["exception"]
    monkeypatch.setattr(home, "render", lambda *_: 1 / 0)
    page = client.get("/")
    assert page.status_code == 500
    assert page.headers["content-type"].startswith("text/html")
    assert "division" not in page.text


def test_the_log_is_a_line_of_json_for_each_request(client, anna, caplog):
    caplog.set_level(logging.INFO, "starcat_service")
    caplog.clear()
    path = "/probe/%C2%85%7B%22level%22%3A%22forged%22/read?secret=hidden"
    client.get(path, headers={"User-Agent": "x\t{}", "X-Request-ID": "bad id\t", **bearer(anna)})
    [record] = caplog.records
    text_line = JsonFormatter().format(record)
    assert text_line.isascii()
    assert len(text_line.splitlines()) == 1
    line = json.loads(text_line)
    assert line["level"] == "info"
    assert (line["method"], line["status"], line["who"]) == ("GET", 200, "anna")
    assert line["path"].startswith("/probe/\x85{")
    assert "hidden" not in text_line
    assert anna not in text_line


def test_metrics_count_by_template_and_say_what_there_is(make):
    at = make()
    at.get("/probe/a/read")
    at.get("/probe/b/read")
    at.get("/made-up/17")
    families = {
        family.name: family for family in text_string_to_metric_families(at.get("/metrics").text)
    }
    counted = {
        (sample.labels["route"], sample.labels["status"]): sample.value
        for sample in families["starcat_requests"].samples
        if sample.name.endswith("_total")
    }
    assert counted[("/probe/{thing}/read", "200")] == 2.0
    assert counted[("unmatched", "404")] == 1.0
    assert {sample.labels["state"] for sample in families["starcat_jobs"].samples} == {
        "queued", "running", "done", "failed", "cancelled",
    }  # fmt: skip
    assert families["starcat_disk_free_bytes"].samples[0].value > 0
    assert families["starcat_build_info"].samples[0].labels["version"]


def test_ready_says_what_is_wrong(make, monkeypatch):
    at = make()
    app: Any = at.app
    monkeypatch.setattr(type(app.state.slots), "is_alive", False)
    assert "a slot of jobs has ended" in " ".join(at.get("/readyz").json()["reasons"])
    monkeypatch.setattr(type(app.state.slots), "is_alive", True)
    answer = at.get("/readyz")
    assert (answer.status_code, answer.json()) == (200, {"ready": True, "reasons": []})
    monkeypatch.setattr("starcat_service.security.request_limits.free_gib", lambda folder: 0.2)
    answer = at.get("/readyz")
    assert answer.status_code == 503
    assert "0.20 GiB free, and 1 have to be left" in answer.json()["reasons"][0]
    monkeypatch.setattr("starcat_service.records.WAIT_S", 0.05)
    other = sqlite3.connect(app.state.service.paths.records)
    other.execute("BEGIN IMMEDIATE")
    app.state.service.records.close()
    assert any(
        "records cannot be written" in reason for reason in at.get("/readyz").json()["reasons"]
    )
    other.close()


def test_what_is_old_is_removed_and_databases_and_releases_stay(make):
    at = make(keep_jobs_days=2.0, keep_results_days=1.0)
    app: Any = at.app
    service = app.state.service
    places = service.paths
    jobs = [waiting_build(service, f"{number}") for number in range(3)]
    now_s = time.time()
    with service.records.writing() as connection:
        for job, state, days in (
            (jobs[0], "done", 3),
            (jobs[1], "done", 1),
            (jobs[2], "queued", 9),
        ):
            connection.execute(
                "UPDATE jobs SET state = ?, ended_s = ? WHERE id = ?",
                (state, now_s - days * 86_400.0 if state == "done" else None, job.id),
            )
    for job in jobs:
        places.job(job.id).mkdir()
        (places.job(job.id) / "log").write_text("x")
    for folder in (places.results, places.scratch, places.databases / ("0" * 16), places.registry):
        folder.mkdir(exist_ok=True)
        (folder / "file").write_text("x")
    removed = removal.remove_old(service, now_s + 1.5 * 86_400.0)
    assert removed == {"jobs": 2, "results": 1, "scratch": 1, "sessions": 0}
    assert [path.name for path in places.jobs.iterdir()] == [jobs[2].id]
    assert [job.id for job in service.jobs.all()] == [jobs[2].id]
    assert (places.databases / ("0" * 16) / "file").exists()
    assert (places.registry / "file").exists()


def test_an_address_for_others_is_an_origin(tmp_path):
    for wrong in ("stars.example", "https://stars.example/path", "https://a@b", "ftp://x"):
        with pytest.raises(ConfigError, match="public_url"):
            read_settings(tmp_path, public_url=wrong)
    assert ServiceSettings(root=tmp_path, public_url="https://x:8443").is_secure


def test_short_answers_do_not_wait_and_a_port_that_is_taken_is_reported(tmp_path):
    with (
        listen(ServiceSettings(root=tmp_path, port=0)) as listening,
        socket.create_connection(listening.getsockname()),
        listening.accept()[0] as accepted,
    ):
        assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        port = listening.getsockname()[1]
        with pytest.raises(ConfigError, match=f"cannot listen at 127.0.0.1:{port}: .*port"):
            listen(ServiceSettings(root=tmp_path, port=port))


def test_a_library_forgets_databases_that_were_removed(tmp_path, small_database):
    folder = add_database(tmp_path, small_database)
    library = Library(ServicePaths(tmp_path))
    assert len(library.databases()) == len(library._cache) == 1
    shutil.rmtree(folder)
    assert library.databases() == []
    assert not library._cache
