"""What pages let people remove, grant and find again: databases, evaluations, tokens, catalogs."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from services import DATABASE, OTHER, add_database, client_of, token_of, waiting_build

from starcat_service import access
from starcat_service.jobs.job import Attempt, Outcome, begin_next
from starcat_service.jobs.submission import submit_evaluation
from starcat_service.pages.rendering import time_text
from starcat_service.records import Records
from starcat_service.removal import remove_old
from starcat_service.security.tokens import DAY_S, TokenStore
from starcat_service.settings import Role

PAGE = f"/databases/{DATABASE}"
TABLE = "gaia-0123456789abcdef.parquet"


@pytest.fixture
def client(own_root: Path) -> Iterator[TestClient]:
    """A client of a service of the test's own, in which everybody may publish."""
    with client_of(own_root, anonymous="publisher") as client:
        yield client


def evaluated(client: TestClient, database: Path, frames: int = 40) -> dict:
    """An evaluation that is done: its job, as the REST interface shows it."""
    service = client.app.state.service
    job = submit_evaluation(service, DATABASE, "me", frames=frames).job
    attempt = Attempt(service.records, begin_next(service.records, ["evaluate"]))
    report = json.loads((database / "report" / "report.json").read_bytes())
    point = {"percent": 97.5, "low_percent": 87.1, "high_percent": 99.6, "hits": 39, "count": 40}
    points = [{**point, "x": x, "wrong": 0} for x in (0.0, 1.0)]
    curves = [{"quantity": "noise_px", "label": "position noise", "held": "", "points": points}]
    attempt.end(Outcome("done", {"rates": report["self_test"], "curves": curves}))
    return client.get(f"/api/v1/jobs/{job.id}").json()


def test_an_evaluation_is_on_the_page_of_its_database_and_stays_with_it(client, small_database):
    assert "not measured yet" in client.get(PAGE).text
    job = evaluated(client, small_database)
    page = client.get(PAGE).text
    assert f'href="/jobs/{job["id"]}"' in page
    clean = 100 * job["result"]["rates"][0]["identified_share"]
    [headline] = re.findall(r'id="headline">([\d.]+)<', page)
    assert headline == f"{clean:.1f}"
    assert page.count('class="point"') == 2
    # One axis for all curves, from below the lowest end of an interval.
    assert re.findall(r'class="tick" x="-6"[^>]*>([\d.]+)<', page) == ["80", "90", "100"]
    listed = client.get("/api/v1/jobs", params={"database": DATABASE}).json()
    assert [listed_job["id"] for listed_job in listed["jobs"]] == [job["id"]]
    assert client.get("/api/v1/jobs", params={"database": "0" * 16}).json()["total"] == 0
    service = client.app.state.service
    other = waiting_build(service, "a" * 16)
    with service.records.writing() as connection:
        connection.execute("UPDATE jobs SET state = 'failed', ended_s = 1 WHERE id = ?", [other.id])
    assert remove_old(service, time.time() + 1000 * DAY_S)["jobs"] == 1
    assert client.get(f"/api/v1/jobs/{job['id']}").status_code == 200
    assert client.post(f"{PAGE}/remove").status_code == 200
    assert remove_old(service, time.time() + 1000 * DAY_S)["jobs"] == 1


def test_a_database_is_removed_unless_a_job_needs_it_and_its_release_stays(client, own_root):
    address = client.post(f"{PAGE}/evaluate", data={"frames": "77"}).url.path
    assert client.get(f"/api/v1{address}").json()["request"]["frames"] == 77
    for page in (address, "/"):
        assert re.search(r"small-1\.0\.0\s+evaluated", client.get(page).text)
    assert client.post(f"{PAGE}/evaluate", data={"frames": "20001"}).status_code == 422
    assert "Remove small-1.0.0 for good" in client.get(PAGE).text
    client.post("/api/v1/releases", json={"database": DATABASE})
    for refused in (client.post(f"{PAGE}/remove"), client.delete(f"/api/v1{PAGE}")):
        assert refused.status_code == 409
        assert address.removeprefix("/jobs/") in refused.text
    assert client.post(f"{address}/cancel").status_code == 200
    assert client.post(f"{PAGE}/remove").url.path == "/databases"
    assert client.get(PAGE).status_code == 404
    assert not (own_root / "databases" / DATABASE).exists()
    assert not list((own_root / "scratch").iterdir())
    assert client.get("/api/v1/releases/small/1.0.0").status_code == 200


def test_a_builder_removes_own_databases_and_no_others(own_root):
    tokens = {name: builder_of(own_root, name) for name in ("anna", "bob")}
    with client_of(own_root, anonymous="reader") as client:
        records = client.app.state.service.records
        with records.writing() as connection:
            connection.execute(
                "INSERT INTO jobs (id, kind, key, owner, title, state, request, created_s, result) "
                "VALUES (?, 'build', ?, 'anna', 'small 1.0.0', 'done', '{}', 0, ?)",
                ("0" * 32, DATABASE, json.dumps({"database": DATABASE})),
            )
        heads = {name: {"Authorization": f"Bearer {token}"} for name, token in tokens.items()} | {
            "": {}
        }
        for name in ("", "bob"):
            assert "Remove small-1.0.0" not in client.get(PAGE, headers=heads[name]).text
            refused = client.delete(f"/api/v1{PAGE}", headers=heads[name])
            assert refused.status_code == (403 if name else 401)
        assert "was not built for bob" in refused.text
        assert "Remove small-1.0.0" in client.get(PAGE, headers=heads["anna"]).text
        assert client.delete(f"/api/v1{PAGE}", headers=heads["anna"]).status_code == 204


def builder_of(root, name: str) -> str:
    records = Records(root / "records.sqlite")
    _, token = TokenStore(records).create(name, Role.BUILDER)
    records.close()
    return token


def test_the_time_of_a_build_is_that_of_its_job(client):
    service, ended_s = client.app.state.service, time.time() - DAY_S
    job = waiting_build(service, DATABASE)
    with service.records.writing() as connection:
        connection.execute(
            "UPDATE jobs SET state = 'done', ended_s = ?, result = ? WHERE id = ?",
            (ended_s, json.dumps({"database": DATABASE}), job.id),
        )
    assert time_text(ended_s)[:16] in client.get("/databases").text


def test_a_page_offers_what_its_user_may_do(own_root):
    with client_of(own_root, anonymous="reader") as client:
        (own_root / "catalogs" / TABLE).write_bytes(b"1")
        shown = {address: client.get(address).text for address in (PAGE, "/catalogs", "/releases")}
        assert "Evaluate" not in shown[PAGE]
        assert "Remove" not in shown[PAGE] + shown["/catalogs"]
        assert "Read for SQL" not in shown["/catalogs"]
        assert re.search(r"needs a\s+token with the role publisher", shown["/releases"])


def test_two_databases_are_compared_by_rates_and_maps(
    client, own_root, database_version, small_database
):
    add_database(own_root, database_version("1.1.0"), OTHER)
    add_database(own_root, database_version("0.1.0"), "1" * 16)
    job = evaluated(client, small_database)
    page = client.get(f"{PAGE}/compare?other={OTHER}").text
    shown = f"{100 * job['result']['rates'][0]['identified_share']:.1f}&nbsp;%"
    # The self-test of both databases, and the evaluation of one.
    assert re.search(rf"self-test: clean</th><td[^>]*>{shown} .*{shown} ", page)
    assert re.search(rf"evaluation: clean</th><td[^>]*>{shown} .*–</td></tr>", page)
    pictures = re.findall(r'<image href="([^"]+)"', page)
    assert [picture.split("/")[2] for picture in pictures] == [DATABASE, OTHER]
    maps = [client.get(picture).content for picture in pictures]
    assert maps[0] == maps[1]  # of the same stars in the same colours
    assert len(maps[0]) > 1000


# Tokens


def test_tokens_are_created_shown_once_and_revoked(own_root, monkeypatch):
    monkeypatch.setattr(access, "CACHED_TOKEN_S", 0.0)
    headers = {"Authorization": f"Bearer {token_of(own_root, 'operator')}"}
    form = {"name": "anna", "role": "builder", "expires_days": "30"}
    with client_of(own_root, anonymous="publisher") as client:
        # Tokens are managed with a token only, even if everybody may publish.
        assert client.post("/api/v1/tokens", json={"name": "me"}).status_code == 401
        assert client.get("/tokens").url.path == "/sign-in"
        page = client.post("/tokens", data=form, headers=headers).text
        [token] = re.findall(r'id="new-token"[^>]*>(starcat_[\w-]{43})<', page)
        assert token not in client.get("/tokens", headers=headers).text
        anna_headers = {"Authorization": f"Bearer {token}"}
        assert client.get("/jobs", headers=anna_headers).status_code == 200
        wrong = {
            ("name", "anna"): "there is a valid token with the name &#39;anna&#39;",
            ("role", "operator"): "reader",
            ("expires_days", "0"): "expected at least 0.001",
            ("expires_days", "1e9"): "expected at most 366",
        }
        for (field, value), words in wrong.items():
            again = client.post("/tokens", data=form | {field: value}, headers=headers)
            assert again.status_code == 422, field
            assert words in again.text
        listed = client.get("/api/v1/tokens", headers=headers).json()["tokens"]
        assert [(entry["name"], entry["role"], entry["state"]) for entry in listed] == [
            ("operator", "publisher", "valid"),
            ("anna", "builder", "valid"),
        ]
        operator, anna = (entry["id"] for entry in listed)
        assert client.post(f"/tokens/{operator}/revoke", headers=headers).status_code == 409
        assert client.post(f"/tokens/{anna}/revoke", headers=headers).status_code == 200
        assert client.delete(f"/api/v1/tokens/{anna}", headers=headers).status_code == 404
        assert client.get("/jobs", headers=anna_headers).status_code == 401


# Catalogs


def test_a_catalog_is_read_and_its_table_removed(client, own_root):
    (own_root / "catalogs" / TABLE).write_bytes(b"1234567")
    (own_root / "catalogs" / "not-of-a-job").write_bytes(b"")
    page = client.get("/catalogs").text
    assert TABLE in page
    assert "not-of-a-job" not in page
    stored = client.get("/api/v1/catalogs").json()["stored"]
    assert stored == [{"name": TABLE, "source": "gaia", "bytes": 7}]
    assert client.post("/catalogs", data={"source": "gaia"}).url.path.startswith("/jobs/")
    assert client.post("/catalogs", data={"source": "../x"}).status_code in (404, 422)
    for name in ("not-of-a-job", "gaia-0123456789abcdee.parquet"):
        assert client.post(f"/catalogs/{name}/remove").status_code in (400, 404), name
        assert client.delete(f"/api/v1/catalogs/stored/{name}").status_code in (400, 404), name
    assert client.post(f"/catalogs/{TABLE}/remove").url.path == "/catalogs"
    assert [path.name for path in (own_root / "catalogs").iterdir()] == ["not-of-a-job"]


# Searching


def test_jobs_are_searched_by_words_and_by_what_they_are(client):
    service = client.app.state.service
    job = submit_evaluation(service, DATABASE, "me", frames=9).job
    waiting_build(service, "b")
    for text, count in (("EVALUATE small", 1), ("me", 2), ("100%_", 0), (job.id, 1), ("", 2)):
        listed = client.get("/jobs", params={"q": text}).text
        assert listed.count("<tr data-job=") == count, text
        assert client.get("/api/v1/jobs", params={"text": text}).json()["total"] == count
    assert 'value="&#34;&gt;&lt;b&gt;"' in client.get("/jobs", params={"q": '"><b>'}).text
    kinds = ({"kind": "build"}, {"state": "queued"}, {"owner": "nobody"}, {"offset": 1, "limit": 5})
    listed = [client.get("/api/v1/jobs", params=conditions).json()["jobs"] for conditions in kinds]
    assert [len(jobs) for jobs in listed] == [1, 2, 0, 1]


def test_releases_are_searched_and_ordered(client, own_root, database_version):
    add_database(own_root, database_version("1.1.0"), OTHER)
    for database, note in ((DATABASE, "For June"), (OTHER, "For May")):
        publication = {"database": database, "note": note}
        assert client.post("/api/v1/releases", json=publication).status_code == 201

    def titles(**query: str) -> list[str]:
        page = client.get("/releases", params=query).text
        return re.findall(r'<section class="card" id="(small-[\d.]+)"', page)

    assert titles() == ["small-1.1.0", "small-1.0.0"]
    assert titles(order="name") == ["small-1.0.0", "small-1.1.0"]
    assert titles(q="june") == ["small-1.0.0"]
    assert titles(q="december") == []
    assert "Nothing was published" not in client.get("/releases?q=december").text
    assert client.get("/releases?order=x").status_code == 422
