"""The client and ``starcat --server``, against a server that runs."""

from __future__ import annotations

import json
import tomllib

import pytest
from served import Served
from services import DATABASE

from starcat.client import Client
from starcat.database.verify import verify
from starcat.errors import ConfigError, OutputError, QueryError, ServiceError, TargetMissing

STARS = "SELECT designation, mag FROM stars ORDER BY mag, star_id LIMIT 5"


@pytest.fixture(scope="module")
def client(served: Served) -> Client:
    return Client(served.address)


@pytest.fixture
def remote(served: Served, starcat):
    """Run a command of that server."""
    return lambda *arguments: starcat(["--server", served.address, *arguments])


def spec_of(small_spec: str, name: str) -> str:
    return small_spec.replace('name = "small"', f'name = "{name}"')


@pytest.mark.slow
def test_a_database_is_built_there_and_brought_here(client, small_spec, tmp_path):
    stages: list[str] = []
    spec = spec_of(small_spec, "there")
    job = client.build(spec, lambda stage, done, total: stages.append(stage))
    database = job["result"]["database"]
    assert stages
    folder, outcome = client.download(database, tmp_path)
    assert (folder, outcome) == (tmp_path / "there-1.0.0", "written")
    assert not verify(folder).findings
    assert client.download(database, tmp_path)[1] == "unchanged"
    (folder / "report" / "index.html").chmod(0o644)
    (folder / "report" / "index.html").write_text("mine")
    with pytest.raises(OutputError, match="already exists"):
        client.download(database, tmp_path)
    assert client.build(tomllib.loads(spec))["result"]["database"] == database


@pytest.mark.slow
def test_the_command_builds_as_it_does_here(remote, starcat, small_spec, sao_lines, tmp_path):
    (tmp_path / "spec.toml").write_text(spec_of(small_spec, "both"))
    (tmp_path / "sao.dat").write_bytes(b"".join(sao_lines))
    there = remote("build", tmp_path / "spec.toml", "--json", "-o", tmp_path / "there")
    options = ["--input", f"sao={tmp_path / 'sao.dat'}", "--json", "-o", tmp_path / "here"]
    here = starcat(["build", tmp_path / "spec.toml", *options])
    assert (there.code, here.code) == (0, 0), there.err
    mine, theirs = json.loads(here.out), json.loads(there.out)
    assert theirs["products"] == mine["products"]
    assert theirs["files"]["stars.parquet"] == mine["files"]["stars.parquet"]
    assert theirs["self_test"] == json.loads(json.dumps(mine["self_test"]))
    assert set(mine) - {"times_s"} <= set(theirs)
    assert not verify(tmp_path / "there" / "both-1.0.0").findings
    table = remote("build", tmp_path / "spec.toml", "-o", tmp_path / "there")
    assert (table.code, "unchanged: " in table.err) == (0, True)


@pytest.mark.parametrize("more", [["--json"], ["--format", "csv"], ["--rows", "3"]])
def test_the_command_asks_as_it_does_here(remote, starcat, small_database, more):
    there = remote("sql", DATABASE, STARS, *more)
    here = starcat(["sql", small_database, STARS, *more])
    assert (there.code, there.out) == (0, here.out), there.err


def test_the_command_keeps_answers_in_files(remote, starcat, small_database, tmp_path):
    there, here = tmp_path / "there.vot", tmp_path / "here.vot"
    named = ["--named", "densest-fields", "--set", "count=3"]
    ran = remote("sql", DATABASE, *named, "-o", there)
    assert (ran.code, ran.err) == (0, f"{there}: 3 rows\n")
    starcat(["sql", small_database, *named, "-o", here])
    assert there.read_bytes() == here.read_bytes()


@pytest.mark.slow
def test_the_command_identifies_as_it_does_here(remote, starcat, small_database, tmp_path):
    frame, picture = tmp_path / "frame.csv", tmp_path / "frame.svg"
    starcat(["simulate", small_database, "-o", frame, "--seed", 3, "--noise-px", 0.2])
    asked = [frame, "--json", "--picture", picture, "--tolerance-px", 1]
    there = remote("identify", DATABASE, *asked)
    here = starcat(["identify", small_database, *asked])
    assert there.code == 0, there.err
    [mine], [theirs] = json.loads(here.out), json.loads(there.out)
    assert {**theirs, "time_s": 0} == {**mine, "time_s": 0}
    assert "<svg" in picture.read_text()
    at = [frame, "--tolerance-px", 1, "--time", "2026-11-22T10:00:00"]
    there, here = remote("identify", DATABASE, *at), starcat(["identify", small_database, *at])
    shown, mine = (
        [line.split() for line in run.out.splitlines() if "time_s" not in line]
        for run in (there, here)
    )
    assert [row for row in shown if row] == [row for row in mine if row]
    assert "corrected boresight_ra_deg" in there.out
    frame.write_text("x_px,y_px\n1,1\n2,2\n3,3\n")
    ran = remote("identify", DATABASE, frame, "--fail-on-no-match", "--json")
    assert ran.code == 6
    assert json.loads(ran.out)[0]["refusal"]["message"]


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["sql", DATABASE, "SELECT nothing FROM stars"], 2, "nothing"),
        (["sql", "unknown", "SELECT 1 FROM stars"], 3, "no database or catalog 'unknown'"),
        (["build", "--preset", "gaia-12deg", "--workers", "1"], 2, "--workers"),
        (["identify", DATABASE, "nowhere.csv"], 3, "nowhere.csv"),
        (["identify", DATABASE, "nowhere.csv", "--track"], 2, "--track"),
    ],
)
def test_what_is_refused_has_the_same_code(remote, arguments, code, words):
    ran = remote(*arguments)
    assert (ran.code, words in ran.err, ran.out) == (code, True, ""), ran.err


def test_a_published_database_is_pulled_as_from_any_registry(client, served, starcat, tmp_path):
    assert client.publish(DATABASE, "the first")["outcome"] == "published"
    registry = ["--registry", f"{served.address}/registry", "--lock", tmp_path / "starcat.lock"]
    ran = starcat(["pull", "small", *registry, "-o", tmp_path / "out"])
    assert ran.code == 0, ran.err
    assert not verify(tmp_path / "out" / "small-1.0.0").findings
    ran = starcat(["releases", f"{served.address}/registry", "--json"])
    assert [release["version"] for release in json.loads(ran.out)] == ["1.0.0"]


def test_errors_are_those_of_the_library(client, served, tmp_path):
    with pytest.raises(QueryError, match="nothing"):
        client.sql([DATABASE], "SELECT nothing FROM stars")
    with pytest.raises(TargetMissing, match="no database"):
        client.download("0" * 16, tmp_path)
    with pytest.raises(ConfigError, match="version: missing") as caught:
        client.build({"name": "x"})
    assert caught.value.exit_code == 2
    with pytest.raises(ServiceError, match="is 'starcat serve' running there"):
        Client("http://127.0.0.1:9").sql([DATABASE], "SELECT 1")
    with pytest.raises(ServiceError) as refused:
        Client(served.address, "wrong-token").sql([DATABASE], "SELECT 1")
    assert refused.value.status == 401
