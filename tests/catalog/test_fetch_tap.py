"""Fetching from TAP: starcat's own service, behind a relay that does what networks do."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from archive_server import Fault, Relay
from served import in_background, serve
from services import add_database

from starcat.catalog import tap
from starcat.catalog.source import give_map
from starcat.catalog.store.reading import read_catalog
from starcat.catalog.table_map import AnyMap
from starcat.catalog.tap import ACCOUNT_NAME, Asked, fetch_table
from starcat.errors import ConfigError, DownloadError, OutputError, StarcatError
from starcat.storage.download import DownloadOptions
from starcat.storage.parquet import write_table

pytestmark = [
    pytest.mark.timeout(120),
    # pyvo leaves connections to the garbage collector.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
SLOW = pytest.mark.slow
HOW = DownloadOptions(retries=2, timeout_s=1.0, backoff_s=0.0)
MAP = """\
name = "own"
epoch = 2026.0
columns = { star_id = "star_id", ra = "ra_deg", dec = "dec_deg" }
magnitudes = { V = "mag" }
"""


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory, small_database: Path) -> Iterator[int]:
    folder = tmp_path_factory.mktemp("served")
    add_database(folder / "root", small_database)
    with serve(folder / "root", folder / "log") as served:
        yield served.port


@pytest.fixture
def relay(port: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Relay]:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(tap, "STRIP_ROWS", 300)
    monkeypatch.setattr(tap, "_POLL_S", (0.02, 0.2))
    with Relay(port) as server, in_background(server):
        yield server


@pytest.fixture
def own(tmp_path: Path) -> AnyMap:
    (tmp_path / "own.toml").write_text(MAP)
    table = give_map(tmp_path / "own.toml").table
    assert table is not None
    return table


def ask(relay: Relay, own: AnyMap | None, **more: Any) -> Asked:
    return Asked(relay.url("/tap"), **{"table": "small.stars", "map": own, **more})


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.parquet")}


@SLOW
def test_a_table_comes_in_strips_and_is_a_source(relay, own, small_database, tmp_path):
    report = fetch_table(ask(relay, own, limit_mag=5.0000001), tmp_path / "own", HOW)
    assert any("5.0000001" in one for one in relay.seen)  # all digits are in the queries
    stars = pq.read_table(small_database / "stars.parquet")
    bright = stars.filter(stars["mag"].to_numpy() <= 5.0)
    strips = report.account.strips
    assert (report.status, report.account.rows) == ("fetched", len(bright))
    assert len(strips) > 1
    assert sum(strip.rows for strip in strips) == len(bright)
    got = read_catalog("own", [report.folder])
    # From one file of the same rows: all but which file and line a star is from.
    write_table(bright.select(["star_id", "ra_deg", "dec_deg", "mag"]), tmp_path / "one.parquet")
    same = read_catalog("own", [tmp_path / "one.parquet"])
    places = ["source_file", "source_line"]
    assert got.stars.drop_columns(places).equals(same.stars.drop_columns(places))
    count = len(relay.seen)
    again = ask(relay, own, limit_mag=5.0000001)
    assert fetch_table(again, tmp_path / "own", HOW).status == "present"
    assert not any("COUNT" in one for one in relay.seen[count:])


OF_ARCHIVE = """\
name = "own"
archive = "gaia"
fields.source_id = "star_id"
fields.ra_deg = "ra_deg"
fields.dec_deg = "dec_deg"
fields.mag_g = "mag"
fields.bp_mag = 0
fields.rp_mag = 0
[remote]
checked = "by this test"
"""


@SLOW
def test_records_of_an_archive_come_in_strips_of_a_field(relay, small_database, tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(OF_ARCHIVE)
    with pytest.raises(ConfigError, match="no column of declinations"):
        fetch_table(ask(relay, give_map(path).table), tmp_path / "own", HOW)
    path.write_text(OF_ARCHIVE + 'strip_by = "dec_deg"\n')
    with pytest.raises(ConfigError, match=r"limit_mag: remote\.limit_by of the map"):
        fetch_table(ask(relay, give_map(path).table, limit_mag=5.0), tmp_path / "own", HOW)
    path.write_text(OF_ARCHIVE + 'strip_by = "dec_deg"\nlimit_by = "mag_g"\n')
    report = fetch_table(ask(relay, give_map(path).table, limit_mag=5.0), tmp_path / "own", HOW)
    bright = pq.read_table(small_database / "stars.parquet", filters=[("mag", "<=", 5.0)])
    assert report.account.rows == len(bright) > 300
    got = read_catalog("own", [report.folder])
    assert got.stars["star_id"].to_pylist() == sorted(bright["star_id"].to_pylist())


RESUMED = {
    "500 for the job": [Fault("POST /tap/async ", 500)],
    "503 for the start": [Fault("POST .*/phase", 503)],
    "500 for the state": [Fault("GET /tap/async/[0-9a-f]+ ", 500)],
    "result cut": [Fault("results/result", cut=700, times=2)],
    "result 502": [Fault("results/result", 502)],
    "result slow": [Fault("results/result", wait_s=1.5)],
    "result packed": [Fault("results/result", is_packed=True, times=99)],
    "no deletion": [Fault("DELETE ", 500, times=50)],
}


@SLOW
@pytest.mark.parametrize("fault", RESUMED)
def test_a_fault_is_resumed(relay, own, tmp_path, fault):
    clean = fetch_table(ask(relay, own), tmp_path / "clean", HOW)
    relay.faults = RESUMED[fault]
    assert files_of(fetch_table(ask(relay, own), tmp_path / "own", HOW).folder) == files_of(
        clean.folder
    )
    assert not any(one.times == 1 for one in relay.faults)


TOLD: dict[str, tuple[list[Fault], str]] = {
    "500 for ever": ([Fault("POST /tap/async ", 500, times=9)], "does not answer as a TAP"),
    "no result": ([Fault("results/result", 404)], "the server answered 404"),
    "no VOTable": ([Fault("results/result", swap=(b"<VOTABLE", b"<html"))], "a TAP service does"),
    "another count": (
        [Fault("POST .*COUNT", swap=(b"FROM+small.stars", b"FROM+small.pairs"))],
        "rows are counted, but 552 by declination",
    ),
    "other rows": (
        [Fault(r"POST .*SELECT\+star_id.*-90", swap=(b"-90.000000", b"-50.000000"))],
        r"rows are counted between declinations -90.0 and .* came; the table changes",
    ),
    "another address": (
        [Fault("GET /tap/async/[0-9a-f]+ ", swap=(b'href="http', b'href="file'), times=99)],
        "the address of the result is 'file",
    ),
    "a failed job": (
        [Fault("GET /tap/async/[0-9a-f]+ ", swap=(b"COMPLETED", b"ABORTED"), times=99)],
        "refuses 'SELECT TOP 1",
    ),
}


@SLOW
@pytest.mark.parametrize("fault", TOLD)
def test_a_fault_is_reported(relay, own, tmp_path, fault):
    relay.faults, told = TOLD[fault]
    with pytest.raises(DownloadError, match=told):
        fetch_table(ask(relay, own), tmp_path / "own", HOW)
    assert not (tmp_path / "own").exists()


@SLOW
def test_a_fetch_goes_on_with_the_strips_that_came(relay, own, tmp_path):
    clean = fetch_table(ask(relay, own), tmp_path / "clean", HOW)
    answers = sum("results/result" in one for one in relay.seen)
    relay.faults = [
        Fault("results/result", times=answers - 1), Fault("results/result", 404)
    ]  # fmt: skip
    with pytest.raises(DownloadError, match="404"):
        fetch_table(ask(relay, own), tmp_path / "own", HOW)
    assert not (tmp_path / "own").exists()
    with pytest.raises(OutputError, match="holds what another query gave"):
        fetch_table(ask(relay, own, limit_mag=4.0), tmp_path / "own", HOW)
    count = len(relay.seen)
    again = fetch_table(ask(relay, own), tmp_path / "own", HOW)
    assert again.status == "resumed"
    assert files_of(again.folder) == files_of(clean.folder)
    assert sum("results/result" in one for one in relay.seen[count:]) == 2


@SLOW
def test_a_strip_that_is_cut_short_is_halved(relay, own, tmp_path, monkeypatch):
    clean = fetch_table(ask(relay, own), tmp_path / "clean", HOW)
    overflow = b'<INFO name="QUERY_STATUS" value="OVERFLOW"/></RESOURCE>'
    rows = clean.account.strips[0].rows
    relay.faults = [
        Fault("results/result", times=4), Fault("results/result", swap=(b"</RESOURCE>", overflow))
    ]  # fmt: skip
    halved = fetch_table(ask(relay, own), tmp_path / "own", HOW)
    assert len(halved.account.strips) == len(clean.account.strips) + 1
    assert halved.account.strips[0].rows + halved.account.strips[1].rows == rows
    first = json.loads((halved.folder / ACCOUNT_NAME).read_bytes())["strips"][0]
    assert pq.read_metadata(halved.folder / first["file"]).num_rows == first["rows"]


@SLOW
@pytest.mark.parametrize(
    ("more", "kind", "told"),
    [
        ({"table": "small.nothing"}, DownloadError, "no table 'small.nothing'"),
        ({"query": "SELEC x", "map": None}, DownloadError, "refuses"),
        ({"map": None, "strip_by": "delta"}, ConfigError, "delta: no column of declinations"),
        ({"query": "SELECT star_id FROM small.stars"}, ConfigError, "columns.ra"),
        ({"limit_mag": -5.0}, DownloadError, "no row for"),
    ],
)
def test_a_wrong_question_is_reported(relay, own, tmp_path, more, kind: type[StarcatError], told):
    with pytest.raises(kind, match=told):
        fetch_table(ask(relay, own, **more), tmp_path / "own", HOW)
    assert [path.name for path in tmp_path.iterdir()] == ["own.toml"]


@SLOW
def test_the_command(relay, starcat, tmp_path):
    (tmp_path / "own.toml").write_text(MAP)
    address, folder = f"tap:{relay.url('/tap')}", tmp_path / "own"
    asked = ["--table", "small.stars", "--source", tmp_path / "own.toml", "--limit-mag", 4]
    ran = starcat(["fetch", address, *asked, "-o", folder])
    assert ran.code == 0, ran.err
    assert "fetched: " in ran.err + ran.out
    assert starcat(["sources", "--draft", folder]).code == 0


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("tap:http://a.example/tap --query x --table y", "TAP service needs its address"),
        ("tap:http://a.example/tap --table x", "needs a folder; name it"),
        ("tap:ftp://a.example --table x", "expected"),
        ("tycho2 --limit-mag 4", "--limit-mag is for a TAP service"),
    ],
)
def test_wrong_arguments_are_reported(starcat, arguments, told):
    ran = starcat(["fetch", *arguments.split()])
    assert (ran.code, told in ran.err) == (2, True), ran.err
