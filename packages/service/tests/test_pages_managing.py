"""What pages let people remove, grant and find again: databases, evaluations, tokens, catalogs."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from services import DATABASE, add_database, client_of, token_of, waiting_build

from starcat_service.access import KNOWN_S
from starcat_service.jobs.job import Attempt, Outcome, begin_next
from starcat_service.jobs.submission import submit_evaluation
from starcat_service.removal import remove_old
from starcat_service.security.tokens import DAY_S

PAGE = f"/databases/{DATABASE}"
TABLE = "gaia-0123456789abcdef.parquet"
FOREIGN = {"Sec-Fetch-Site": "cross-site"}


@pytest.fixture
def root(tmp_path: Path, small_artifact: Path) -> Path:
    add_database(tmp_path / "root", small_artifact)
    return tmp_path / "root"


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def evaluated(client: TestClient, artifact: Path, frames: int = 40) -> dict:
    """An evaluation that is done: its job, as the REST interface shows it."""
    service = client.app.state.service
    job = submit_evaluation(service, DATABASE, "me", frames=frames).job
    attempt = Attempt(service.records, begin_next(service.records, ["evaluate"]))
    report = json.loads((artifact / "report" / "report.json").read_bytes())
    point = {"percent": 97.5, "low_percent": 87.1, "high_percent": 99.6, "hits": 39, "count": 40}
    points = [{**point, "x": x, "wrong": 0} for x in (0.0, 1.0)]
    curves = [{"quantity": "noise_px", "label": "position noise", "held": "", "points": points}]
    attempt.end(Outcome("done", {"rates": report["self_test"], "curves": curves}))
    return client.get(f"/api/v1/jobs/{job.id}").json()


def test_an_evaluation_is_on_the_page_of_its_database_and_stays_with_it(root, small_artifact):
    with client_of(root, anonymous="publisher") as client:
        assert "not measured yet" in client.get(PAGE).text
        job = evaluated(client, small_artifact)
        page = client.get(PAGE).text
        assert f'href="/jobs/{job["id"]}"' in page
        clean = 100 * job["result"]["rates"][0]["identified_share"]
        [headline] = re.findall(r'id="headline">([\d.]+)<', page)
        assert headline == f"{clean:.1f}"
        assert page.count('class="point"') == 2
        # One axis for all curves, from below the lowest end of an interval.
        assert re.findall(r'class="tick" x="-6"[^>]*>([\d.]+)<', page) == ["80", "90", "100"]
        listed = client.get("/api/v1/jobs", params={"database": DATABASE}).json()
        assert [one["id"] for one in listed["jobs"]] == [job["id"]]
        assert client.get("/api/v1/jobs", params={"database": "0" * 16}).json()["total"] == 0
        service = client.app.state.service
        other = waiting_build(service, "a" * 16)
        with service.records.writing() as connection:
            connection.execute(
                "UPDATE jobs SET state = 'failed', ended_s = 1 WHERE id = ?", [other.id]
            )
        assert remove_old(service, time.time() + 1000 * DAY_S)["jobs"] == 1
        assert client.get(f"/api/v1/jobs/{job['id']}").status_code == 200
        assert client.post(f"{PAGE}/remove").status_code == 200
        assert remove_old(service, time.time() + 1000 * DAY_S)["jobs"] == 1


def test_the_number_of_frames_of_an_evaluation_is_chosen(root):
    with client_of(root, anonymous="builder") as client:
        address = client.post(f"{PAGE}/evaluate", data={"frames": "77"}).url.path
        assert client.get(f"/api/v1{address}").json()["request"]["frames"] == 77
        assert client.post(f"{PAGE}/evaluate", data={"frames": "20001"}).status_code == 422


def test_a_database_is_removed_by_a_publisher_only(root):
    with client_of(root, anonymous="builder") as builder:
        assert "Remove this database" not in builder.get(PAGE).text
        assert builder.post(f"{PAGE}/remove").status_code == 401
    with client_of(root, anonymous="publisher") as client:
        assert "Remove small-1.0.0 for good" in client.get(PAGE).text
        assert client.post(f"{PAGE}/remove", headers=FOREIGN).status_code == 403
        job = submit_evaluation(client.app.state.service, DATABASE, "me").job
        refused = client.post(f"{PAGE}/remove")
        assert refused.status_code == 409
        assert job.id in refused.text
        assert client.post(f"/jobs/{job.id}/cancel").status_code == 200
        assert client.post(f"{PAGE}/remove").url.path == "/databases"
        assert client.get(PAGE).status_code == 404
        assert not (root / "databases" / DATABASE).exists()


def test_two_databases_are_compared_by_rates_and_maps(root, artifact_version, small_artifact):
    later = add_database(root, artifact_version("1.1.0"), "fedcba9876543210").parent.name
    add_database(root, artifact_version("0.1.0"), "1" * 16)
    with client_of(root, anonymous="publisher") as client:
        job = evaluated(client, small_artifact)
        page = client.get(f"{PAGE}/compare?other={later}").text
        clean = job["result"]["rates"][0]
        shown = f"{100 * clean['identified_share']:.1f}&nbsp;%"
        # The self-test of both databases, and the evaluation of one.
        assert re.search(rf"self-test: clean</th><td[^>]*>{shown} .*{shown} ", page)
        assert re.search(rf"evaluation: clean</th><td[^>]*>{shown} .*–</td></tr>", page)
        pictures = re.findall(r'<image href="([^"]+)"', page)
        assert [one.split("/")[2] for one in pictures] == [DATABASE, later]
        maps = [client.get(one).content for one in pictures]
        assert maps[0] == maps[1]  # of the same stars in the same colours
        assert maps[0] != client.get(f"{PAGE}/coverage.png").content or len(maps[0]) > 1000


# Tokens


def test_tokens_are_created_shown_once_and_revoked(root):
    own = token_of(root, "operator")
    with client_of(root, anonymous="publisher", address="http://127.0.0.1:8000") as client:
        headers = bearer(own)
        form = {"name": "anna", "role": "builder", "expires_days": "30"}
        assert client.post("/tokens", data=form, headers=headers | FOREIGN).status_code == 403
        made = client.post("/tokens", data=form, headers=headers).text
        [token] = re.findall(r'id="new-token"[^>]*>(starcat_[\w-]{43})<', made)
        assert token not in client.get("/tokens", headers=headers).text
        assert client.get("/jobs", headers=bearer(token)).status_code == 200
        listed = client.get("/api/v1/tokens", headers=headers).json()["tokens"]
        assert [(one["name"], one["role"], one["state"]) for one in listed] == [
            ("operator", "publisher", "valid"),
            ("anna", "builder", "valid"),
        ]
        again = client.post("/tokens", data=form, headers=headers)
        assert again.status_code == 422
        assert "there is a valid token with the name &#39;anna&#39;" in again.text
        anna, operator = listed[1]["id"], listed[0]["id"]
        assert client.post(f"/tokens/{operator}/revoke", headers=headers).status_code == 409
        assert client.post(f"/tokens/{anna}/revoke", headers=headers).status_code == 200
        assert client.delete(f"/api/v1/tokens/{anna}", headers=headers).status_code == 404
        time.sleep(KNOWN_S)
        assert client.get("/jobs", headers=bearer(token)).status_code == 401


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "a b"}, "cannot be the name of a token"),
        ({"role": "operator"}, "reader"),
        ({"expires_days": "0"}, "expected at least 0.001"),
        ({"expires_days": "1e9"}, "expected at most 366"),
    ],
)
def test_a_wrong_token_is_not_created(root, changes, words):
    own = bearer(token_of(root, "operator"))
    form = {"name": "anna", "role": "builder", "expires_days": "30"} | changes
    with client_of(root) as client:
        answer = client.post("/tokens", data=form, headers=own)
        assert answer.status_code == 422
        assert words in answer.text
        assert len(client.get("/api/v1/tokens", headers=own).json()["tokens"]) == 1


def test_who_has_no_token_manages_none_even_where_everybody_publishes(root):
    with client_of(root, anonymous="publisher") as client:
        assert client.get("/api/v1/tokens").status_code == 401
        wanted = {"name": "me", "role": "publisher"}
        assert client.post("/api/v1/tokens", json=wanted).status_code == 401
        assert client.post("/tokens", data=wanted).status_code == 401
        assert client.post("/tokens/0123abcd/revoke").status_code == 401
        assert client.get("/tokens").url.path == "/sign-in"


# Catalogs


def test_a_catalog_is_read_and_its_table_removed(root):
    with client_of(root, anonymous="publisher") as client:
        (root / "catalogs" / TABLE).write_bytes(b"1234567")
        (root / "catalogs" / "not-of-a-job").write_bytes(b"")
        page = client.get("/catalogs").text
        assert TABLE in page
        assert "not-of-a-job" not in page
        stored = client.get("/api/v1/catalogs").json()["stored"]
        assert stored == [{"name": TABLE, "source": "gaia", "bytes": 7}]
        assert client.post("/catalogs", data={"source": "gaia"}).url.path.startswith("/jobs/")
        assert client.post("/catalogs", data={"source": "../x"}).status_code in (404, 422)
        for name in ("not-of-a-job", "..%2Frecords.sqlite", "gaia-0123456789abcdee.parquet"):
            assert client.post(f"/catalogs/{name}/remove").status_code in (400, 404), name
            assert client.delete(f"/api/v1/catalogs/stored/{name}").status_code in (400, 404), name
        assert client.post(f"/catalogs/{TABLE}/remove", headers=FOREIGN).status_code == 403
        assert client.post(f"/catalogs/{TABLE}/remove").url.path == "/catalogs"
        assert [one.name for one in (root / "catalogs").iterdir()] == ["not-of-a-job"]
        assert (root / "records.sqlite").exists()


def test_who_only_reads_changes_no_catalog(root):
    with client_of(root, anonymous="reader") as client:
        (root / "catalogs" / TABLE).write_bytes(b"1")
        page = client.get("/catalogs").text
        assert "Read for SQL" not in page
        assert "Remove" not in page
        assert client.post("/catalogs", data={"source": "gaia"}).status_code == 401
        assert client.post(f"/catalogs/{TABLE}/remove").status_code == 401


# Searching


def test_jobs_are_searched_by_words(root):
    with client_of(root, anonymous="builder") as client:
        service = client.app.state.service
        job = submit_evaluation(service, DATABASE, "me", frames=9).job
        waiting_build(service, "b")
        for text, count in (("EVALUATE small", 1), ("me", 2), ("100%_", 0), (job.id, 1), ("", 2)):
            listed = client.get("/jobs", params={"q": text}).text
            assert listed.count("<tr data-job=") == count, text
            assert client.get("/api/v1/jobs", params={"text": text}).json()["total"] == count
        assert 'value="&#34;&gt;&lt;b&gt;"' in client.get("/jobs", params={"q": '"><b>'}).text


def test_releases_are_searched_and_ordered(root, artifact_version):
    add_database(root, artifact_version("1.1.0"), "fedcba9876543210")
    with client_of(root, anonymous="publisher") as client:
        for database, note in ((DATABASE, "For June"), ("fedcba9876543210", "For May")):
            wanted = {"database": database, "note": note}
            assert client.post("/api/v1/releases", json=wanted).status_code == 201

        def titles(**query: str) -> list[str]:
            page = client.get("/releases", params=query).text
            return re.findall(r'<section class="card" id="(small-[\d.]+)"', page)

        assert titles() == ["small-1.1.0", "small-1.0.0"]
        assert titles(order="name") == ["small-1.0.0", "small-1.1.0"]
        assert titles(q="june") == ["small-1.0.0"]
        assert titles(q="december") == []
        assert "Nothing was published" not in client.get("/releases?q=december").text
        assert client.get("/releases?order=x").status_code == 422
