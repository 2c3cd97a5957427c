"""TAP: queries answered at once and later, uploads, jobs, and the metadata of the service."""

from __future__ import annotations

import io
import re
import shutil
import threading
import time
from collections.abc import Callable, Generator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyarrow.parquet as pq
import pytest
from astropy.io.votable import from_table, parse_single_table
from astropy.table import MaskedColumn, Table
from fastapi.testclient import TestClient
from httpx2 import Response
from services import LOCAL, add_database, client_of

from starcat.errors import QueryError
from starcat.ship.exchange.formats import response_format
from starcat_service.app import make_app
from starcat_service.jobs.job import QUERY, begin_next
from starcat_service.jobs.slots import ENDED_WITH_SERVER
from starcat_service.paths import ServicePaths
from starcat_service.protocols.parameters import TapQuestion
from starcat_service.sandbox.limiter import asker
from starcat_service.service import Service
from starcat_service.settings import ServiceSettings
from starcat_service.vo.tap import ClientGone, Spool

SETTINGS = {"queries": 1, "upload_mib": 0.5}
BRIGHT = "SELECT star_id, ra_deg, mag FROM small.stars WHERE mag < 2.5 ORDER BY star_id"
SLOW = "SELECT COUNT(*) AS n FROM small.pairs a, small.pairs b, small.pairs c WHERE a.i < b.j + c.i"
UWS = {"uws": "http://www.ivoa.net/xml/UWS/v1.0", "xlink": "http://www.w3.org/1999/xlink"}


@pytest.fixture(scope="module")
def ask(client) -> Callable[..., Response]:
    """Send a query to /tap/sync."""

    def send(query: str, **parameters: str) -> Response:
        return client.get("/tap/sync", params={"LANG": "ADQL", "QUERY": query, **parameters})

    return send


def table_of(answer: Response) -> Table:
    assert answer.status_code == 200, answer.text
    return parse_single_table(io.BytesIO(answer.content)).to_table()


def error_of(answer: Response) -> str:
    """Return the words of an error as DALI has it."""
    assert answer.headers["content-type"].startswith("application/x-votable+xml")
    tree = ElementTree.fromstring(answer.content)
    [status] = [element for element in tree.iter() if element.get("name") == "QUERY_STATUS"]
    assert status.get("value") == "ERROR"
    return status.text or ""


# Queries that are answered at once.


@pytest.fixture(scope="module")
def bright(small_database: Path) -> list[tuple[int, float, float]]:
    """The rows of the answer to BRIGHT."""
    columns = ["star_id", "ra_deg", "mag"]
    stars = pq.read_table(small_database / "stars.parquet", columns=columns).sort_by("star_id")
    return [tuple(row.values()) for row in stars.to_pylist() if row["mag"] < 2.5]


def test_votables_have_the_rows_of_sql(client, ask, bright):
    """Other formats, and their names, are tested in test_result_formats.py."""
    form = {"request": "doQuery", "lang": "ADQL-2.1", "query": BRIGHT, "maxrec": "1000"}
    for answer in (ask(BRIGHT, RESPONSEFORMAT="votable/td"), client.post("/tap/sync", data=form)):
        assert answer.headers["content-type"].startswith("application/x-votable+xml")
        rows = table_of(answer)
        assert [tuple(row) for row in rows] == bright
        assert rows["mag"].unit == "mag"
        assert rows["ra_deg"].meta["ucd"] == "pos.eq.ra;meta.main"


def test_rows_that_are_left_out_are_reported(ask, bright):
    answer = ask(BRIGHT, MAXREC="2")
    assert [tuple(row) for row in table_of(answer)] == bright[:2]
    assert 'value="OVERFLOW"' in answer.text
    whole = ask(BRIGHT, MAXREC=str(len(bright)))
    assert len(table_of(whole)) == len(bright)
    assert "OVERFLOW" not in whole.text
    assert ask(BRIGHT, MAXREC="2", FORMAT="csv").text.count("\n") == 3
    assert "OVERFLOW" not in ask(BRIGHT, MAXREC="9" * 50).text
    columns = table_of(ask(BRIGHT, MAXREC="0"))
    assert (columns.colnames, len(columns)) == (["star_id", "ra_deg", "mag"], 0)


def whole_of(spool: Spool) -> bytes:
    whole = b""
    while part := spool.part(len(whole)):
        whole += part
    return whole


def test_a_slow_reader_does_not_block_others(client):
    """More clients than places begin to read large answers and stop; the next is answered."""
    service = client.app.state.service
    asked = TapQuestion("SELECT * FROM small.pairs", response_format("csv"), 1_000_000)
    spools = []
    for _ in range(4):
        parts = service.tap.answer(asked, {})
        next(parts)
        spools.append(Spool(parts, service.settings, threading.Event()))
        assert spools[-1].part(0)
    assert len(table_of(client.get("/tap/sync", params={"QUERY": BRIGHT}))) > 0
    whole = [whole_of(spool) for spool in spools]
    assert whole[0].count(b"\n") > 1000
    assert len(set(whole)) == 1
    for spool in spools:
        spool.close()


def test_what_fails_halfway_is_raised_behind_what_was_made(tmp_path):
    def parts() -> Generator[bytes, None, None]:
        yield b"a"
        raise QueryError("no more")

    ServicePaths(tmp_path).make()
    spool = Spool(parts(), ServiceSettings(root=tmp_path), threading.Event())
    assert spool.part(0) == b"a"
    with pytest.raises(QueryError, match="no more"):
        spool.part(1)
    spool.close()


def test_a_query_ends_when_its_client_goes(client):
    service = client.app.state.service
    gone = threading.Event()

    def watch(*_: object) -> None:
        if gone.is_set():
            raise ClientGone

    asked = TapQuestion(SLOW, response_format("csv"), 10)
    spool = Spool(service.tap.answer(asked, {}, progress=watch), service.settings, gone)
    time.sleep(0.5)
    spool.close()
    assert len(table_of(client.get("/tap/sync", params={"QUERY": BRIGHT}))) > 0


# TAP_SCHEMA and VOSI.


def test_tap_schema_has_what_released_schemas_say(ask):
    of_stars = "WHERE table_name = 'small.stars' ORDER BY column_index"
    rows = table_of(ask(f"SELECT * FROM TAP_SCHEMA.columns {of_stars}"))
    by_name = {row["column_name"]: row for row in rows}
    assert rows["column_name"][0] == "star_id"
    assert '"catalog"' in by_name, "a word of ADQL stands in quotes"
    assert by_name["pm_dec_mas_yr"]["unit"] == "mas.yr**-1"
    assert by_name["ra_deg"]["ucd"] == "pos.eq.ra;meta.main"
    assert by_name["star_id"]["datatype"] == "long"
    assert by_name["star_id"]["indexed"] == by_name["mag"]["principal"] == 1
    assert "larger is fainter" in by_name["mag"]["description"]


def test_tap_schema_describes_itself_and_every_table(ask):
    names = set(table_of(ask("SELECT table_name FROM tap_schema.tables"))["table_name"])
    assert {f"tap_schema.{name}" for name in ("schemas", "tables", "columns", "keys")} < names
    described = table_of(ask("SELECT DISTINCT table_name FROM tap_schema.columns"))
    assert set(described["table_name"]) == names
    joined = ask(
        "SELECT k.from_table, c.from_column FROM tap_schema.keys AS k JOIN tap_schema.key_columns "
        "AS c ON k.key_id = c.key_id WHERE k.target_table = 'tap_schema.schemas'"
    )
    assert [tuple(row) for row in table_of(joined)] == [("tap_schema.tables", "schema_name")]


def test_every_column_of_every_table_can_be_asked_for(ask):
    columns = table_of(
        ask("SELECT table_name, column_name, datatype, unit FROM tap_schema.columns")
    )
    for table in sorted(set(columns["table_name"])):
        rows = columns[columns["table_name"] == table]
        answer = ask(f"SELECT TOP 1 {', '.join(rows['column_name'])} FROM {table}")
        fields = parse_single_table(io.BytesIO(answer.content)).fields
        assert [field.datatype for field in fields] == list(rows["datatype"])
        units = ["" if field.unit is None else field.unit.to_string("vounit") for field in fields]
        assert units == [str(unit) if unit is not np.ma.masked else "" for unit in rows["unit"]]


def test_tables_are_described_with_and_without_columns(client):
    text = client.get("/tap/tables").text
    assert not re.search("&amp;(lt|gt|amp);", text), "descriptions are escaped once"
    whole = ElementTree.fromstring(text.encode())
    short = ElementTree.fromstring(client.get("/tap/tables", params={"detail": "min"}).content)
    names = [table.findtext("name") for table in whole.iter("table")]
    assert "small.stars" in names
    assert len(list(whole.iter("column"))) > 90
    assert not list(short.iter("column"))
    assert names == [table.findtext("name") for table in short.iter("table")]
    table = ElementTree.fromstring(client.get("/tap/tables/small.stars").content)
    assert table.findtext("name") == "small.stars"


def test_tables_are_described_as_tap_plus_reads_them(client):
    described = client.get("/tap/tables", params={"tables": "small.stars"}).text
    assert re.findall(r"<table .*?<name>(.*?)</name>", described) == ["small.stars"]
    assert described.count('<column esatapplus:flags="0">') == described.count("</column>") > 20
    assert "esatapplus" not in client.get("/tap/tables").text
    short = client.get("/tap/tables", params={"only_tables": "true"}).text
    assert "small.stars" in short
    assert "<column" not in short


def test_capabilities_name_what_there_is_and_every_example_runs(client, ask):
    text = client.get("/tap/capabilities").text
    for words in (
        "features-adqlgeo", "<form>POLYGON</form>", "upload-inline", "votable-td",
        f'use="base">{LOCAL}/tap<', "VOSI#tables-1.1", "<form>IN_UNIT</form>",
    ):  # fmt: skip
        assert words in text
    assert "<available>true</available>" in client.get("/tap/availability").text
    page = ElementTree.fromstring(client.get("/tap/examples").content)
    queries = [element.text for element in page.iter() if element.get("property") == "query"]
    assert len(queries) == 4
    for query in queries:
        assert len(table_of(ask(query))) > 0, query


# Uploads.


def votable(table: Table, serialization: str = "tabledata") -> bytes:
    stream = io.BytesIO()
    from_table(table).to_xml(stream, tabledata_format=serialization)
    return stream.getvalue()


UPLOADED = Table(
    {
        "id": MaskedColumn([1, 2, 3], mask=[False, True, False], dtype="int32"),
        "ra": MaskedColumn([10.5, 20.0, 30.0], unit="deg"),
        "Name": ["α Cas", "b", ""],
        "flag": [True, False, True],
        "group": np.array([[1, 2], [3, 4], [5, 6]], dtype=np.int16),
        "x": np.array([1.5, 2.5, 3.5], dtype=np.float32),
    }
)


def ask_with(client: TestClient, name: str, content: bytes, query: str) -> Response:
    """Send a query together with a table."""
    parameters = {"QUERY": query, "UPLOAD": f"{name},param:file1"}
    return client.post("/tap/sync", data=parameters, files={"file1": ("any.vot", content)})


@pytest.mark.parametrize("serialization", ["tabledata", "binary", "binary2"])
def test_an_uploaded_table_comes_back(client, serialization):
    # BINARY has no way to say that an integer is missing.
    has_nulls = serialization != "binary"
    sent = votable(UPLOADED if has_nulls else UPLOADED.filled(2), serialization)
    rows = table_of(ask_with(client, "Group", sent, 'SELECT * FROM TAP_UPLOAD."Group" ORDER BY ra'))
    assert rows.colnames == UPLOADED.colnames
    assert np.ma.getmaskarray(rows["id"]).tolist() == [False, has_nulls, False]
    assert rows["id"].dtype == np.int32
    assert rows["x"].dtype == np.float32
    assert rows["ra"].unit == "deg"
    assert list(rows["Name"]) == ["α Cas", "b", ""]
    assert rows["flag"].tolist() == [True, False, True]
    assert [list(group) for group in rows["group"]] == [[1, 2], [3, 4], [5, 6]]


def test_an_uploaded_table_is_joined(client, bright):
    ids = Table({"star_id": [*(row[0] for row in bright[::2]), 999_999]})
    query = (
        "SELECT s.star_id FROM TAP_UPLOAD.mine AS m JOIN small.stars AS s USING (star_id) "
        "ORDER BY star_id"
    )
    answer = ask_with(client, "mine", votable(ids), query)
    assert list(table_of(answer)["star_id"]) == [row[0] for row in bright][::2]
    scratch = client.app.state.service.paths.scratch
    names = {path.name.split("-")[0] for path in scratch.iterdir()}
    assert not names & {"upload", "sync", "answer"}


def document(fields: str, data: str = "", **facts: object) -> bytes:
    attributes = "".join(f' {name}="{value}"' for name, value in facts.items())
    space = "http://www.ivoa.net/xml/VOTable/v1.3"
    table = f"<TABLE{attributes}>{fields}<DATA>{data}</DATA></TABLE>"
    return f'<VOTABLE version="1.4" xmlns="{space}"><RESOURCE>{table}</RESOURCE></VOTABLE>'.encode()


def field(datatype: str, arraysize: int | str = 1) -> str:
    return f'<FIELD name="a" datatype="{datatype}" arraysize="{arraysize}"/>'


def elsewhere(address: str) -> bytes:
    return document(field("double"), f'<BINARY><STREAM href="{address}"/></BINARY>')


ROWS = "<TABLEDATA>" + "<TR><TD/></TR>" * 100 + "</TABLEDATA>"
HOSTILE = [
    (b"", 422, "is not readable XML"),
    (b"a,b\n1,2\n", 422, "is not readable XML"),
    (b"<html/>", 422, "cannot be read as a VOTable"),
    (elsewhere("file:///etc/passwd"), 422, "has its rows elsewhere"),
    (elsewhere("http://127.0.0.1/"), 422, "has its rows elsewhere"),
    (document(field("char", 100_000_000), ROWS), 422, "give fields an"),
    (document(field("int"), ROWS, nrows=9999999999), 422, "rows"),
    (b'<!DOCTYPE v [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]><VOTABLE>&b;</VOTABLE>', 422, "entity"),
    (document(field("int") * 1001, ROWS), 422, "more than 1000"),
    (document(field("int") * 2), 422, "two columns 'a'"),
    (document(field("int"), ROWS.replace("<TD/>", f"<TD>{'9' * 20}</TD>")), 422, "a 32-bit int"),
    (document(field("long"), ROWS.replace("<TD/>", f"<TD>-{'9' * 20}</TD>")), 422, "a 64-bit int"),
    (b"<VOTABLE>" + b" " * 600_000, 413, "0.5 MiB"),
    (document(field("int"), ROWS.replace("<TD/>", f"<TD>{'7' * 5_000}</TD>")), 422, ""),
    (document(field("strange"), ROWS), 422, ""),
    (document(field("double", "9999999999x9999999999"), ROWS), 422, ""),
    (b"<VOTABLE>" + b"<RESOURCE>" * 20_000, 422, ""),
    *(
        (f'<?xml version="1.0" encoding="{name}"?>'.encode() + document(field("int")), 422, "")
        for name in ("utf-16", "idna", "base64", "x")
    ),
]


@pytest.mark.parametrize(("content", "status", "words"), HOSTILE, ids=range(len(HOSTILE)))
def test_uploads_that_must_not_be_read_are_refused(client, content, status, words):
    answer = ask_with(client, "t", content, "SELECT * FROM TAP_UPLOAD.t")
    assert answer.status_code == status
    assert words in answer.text
    assert "defect" not in answer.text


# Jobs.


@pytest.fixture
def make(client) -> Callable[..., str]:
    """Make a job; return its address."""

    def job_address(query: str, **parameters: str) -> str:
        data = {"LANG": "ADQL", "QUERY": query, **parameters}
        answer = client.post("/tap/async", data=data, follow_redirects=False)
        assert answer.status_code == 303, answer.text
        return answer.headers["location"]

    return job_address


def phase_of(client: TestClient, job: str) -> str:
    return str(client.get(f"{job}/phase").text)


def wait_for(client: TestClient, job: str, *phases: str) -> str:
    ends = time.monotonic() + 30.0
    while (phase := phase_of(client, job)) not in phases:
        assert time.monotonic() < ends, phase
        client.get(job, params={"WAIT": "5", "PHASE": phase})
    return phase


def test_a_job_gives_what_a_query_gives(client, make, bright):
    job = make(BRIGHT, RUNID="mine")
    assert phase_of(client, job) == "PENDING"
    seen = client.post(f"{job}/phase", data={"PHASE": "RUN"}, follow_redirects=False)
    assert (seen.status_code, seen.headers["location"]) == (303, job)
    assert wait_for(client, job, "COMPLETED", "ERROR") == "COMPLETED"
    document = ElementTree.fromstring(client.get(job).content)
    [result] = document.iterfind(".//uws:result", UWS)
    href = result.get(f"{{{UWS['xlink']}}}href")
    assert href == f"{job}/results/result"
    assert [tuple(row) for row in table_of(client.get(href))] == bright
    assert document.findtext("uws:runId", namespaces=UWS) == "mine"
    parameters = {p.get("id"): p.text for p in document.iterfind(".//uws:parameter", UWS)}
    assert parameters["QUERY"] == BRIGHT
    assert client.get(f"{job}/error").status_code == 404
    again = client.post(f"{job}/parameters", data={"QUERY": "SELECT 1"})
    assert "COMPLETED" in error_of(again)


def test_a_job_that_fails_says_why(client, make):
    job = make("SELECT nothing FROM small.stars", PHASE="RUN")
    assert wait_for(client, job, "COMPLETED", "ERROR") == "ERROR"
    assert "no column 'nothing'" in error_of(client.get(f"{job}/error"))
    document = ElementTree.fromstring(client.get(job).content)
    assert "no column" in document.findtext("uws:errorSummary/uws:message", namespaces=UWS)
    assert client.get(f"{job}/results/result").status_code == 404


def test_a_job_takes_parameters_and_uploads_until_it_runs(client, make):
    job = make("SELECT 1", UPLOAD="t,param:f")
    client.post(f"{job}/parameters", data={"QUERY": "SELECT x FROM tap_upload.t"},
                files={"f": ("f", votable(UPLOADED))})  # fmt: skip
    parameters = client.get(f"{job}/parameters").text
    assert "tap_upload.t" in parameters
    assert "SELECT 1" not in parameters
    client.post(f"{job}/phase", data={"PHASE": "RUN"})
    assert wait_for(client, job, "COMPLETED", "ERROR") == "COMPLETED"
    result = f"{job}/results/result"
    assert list(table_of(client.get(result))["x"]) == [1.5, 2.5, 3.5]
    # The answer of a job is a table for the next question, and nothing is fetched for that.
    chained = client.get("/tap/sync", params={
        "QUERY": "SELECT MAX(x) AS m FROM TAP_UPLOAD.u", "UPLOAD": f"u,{result}"})  # fmt: skip
    assert list(table_of(chained)["m"]) == [3.5]


def test_a_job_can_be_aborted(client, make):
    job = make(SLOW, PHASE="RUN")
    wait_for(client, job, "EXECUTING")
    began = time.monotonic()
    client.post(f"{job}/phase", data={"PHASE": "ABORT"})
    assert phase_of(client, job) == "ABORTED"
    # The next job has the process for itself.
    next_ = make(BRIGHT, PHASE="RUN")
    assert wait_for(client, next_, "COMPLETED", "ERROR") == "COMPLETED"
    assert time.monotonic() - began < 20.0
    assert phase_of(client, job) == "ABORTED"


def test_a_job_ends_when_its_time_is_over(client, make):
    job = make(SLOW)
    client.post(f"{job}/executionduration", data={"EXECUTIONDURATION": "1"})
    assert client.get(f"{job}/executionduration").text == "1"
    client.post(f"{job}/phase", data={"PHASE": "RUN"})
    assert wait_for(client, job, "COMPLETED", "ERROR") == "ERROR"
    assert "stopped after" in error_of(client.get(f"{job}/error"))


def test_jobs_are_listed_and_chosen_from(client, make):
    jobs = [make(BRIGHT) for _ in range(3)]
    client.post(jobs[0], data={"PHASE": "ABORT"})

    def listed(**parameters: str) -> list[str]:
        tree = ElementTree.fromstring(client.get("/tap/async", params=parameters).content)
        return [str(reference.get(f"{{{UWS['xlink']}}}href")) for reference in tree]

    assert listed(LAST="2") == jobs[:0:-1]
    assert jobs[0] in listed(PHASE="ABORTED")
    assert jobs[1] not in listed(PHASE="ABORTED")
    assert {jobs[1], jobs[2]} <= set(listed(PHASE="PENDING"))
    assert listed(AFTER="2999-01-01T00:00:00Z") == []
    assert client.get("/tap/async", params={"PHASE": "WAITING"}).status_code == 422


def test_a_job_is_deleted_with_its_answer(client, make, root):
    for method, data in (("DELETE", None), ("POST", {"ACTION": "DELETE"})):
        job = make(BRIGHT, PHASE="RUN")
        wait_for(client, job, "COMPLETED")
        folder = root / "results" / job.rpartition("/")[2]
        assert folder.is_dir()
        answer = client.request(method, job, data=data, follow_redirects=False)
        assert (answer.status_code, answer.headers["location"]) == (303, f"{LOCAL}/tap/async")
        assert client.get(job).status_code == 404
        assert not folder.exists()


def test_waiting_ends_with_the_phase_and_with_the_time(client, make):
    job = make(BRIGHT)
    began = time.monotonic()
    client.get(job, params={"WAIT": "1"})
    assert 0.9 < time.monotonic() - began < 10.0
    client.get(job, params={"WAIT": "30", "PHASE": "QUEUED"})
    assert time.monotonic() - began < 10.0, "it waits for the end of a phase that it is in only"


def test_times_of_a_job_are_set_within_what_is_granted(client, make):
    job = make(BRIGHT)
    granted = client.get(f"{job}/destruction").text
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", granted)
    client.post(f"{job}/destruction", data={"DESTRUCTION": "2999-01-01T00:00:00Z"})
    assert client.get(f"{job}/destruction").text == granted
    client.post(f"{job}/executionduration", data={"EXECUTIONDURATION": "99999999"})
    assert client.get(f"{job}/executionduration").text == "3600"
    for text, status in (("soon", 422), ("", 422), ("9999-12-31T23:59:59-23:59", 200)):
        answer = client.post(f"{job}/destruction", data={"DESTRUCTION": text})
        assert answer.status_code == status
    assert client.get(f"{job}/destruction").text == granted
    assert client.get(job, params={"WAIT": "9" * 400, "PHASE": "QUEUED"}).status_code == 200
    assert client.post(f"{job}/phase", data={"PHASE": "STOP"}).status_code == 422
    assert client.get(f"{job}/owner").text == "anonymous"
    assert client.get(f"{job}/quote").text == ""
    client.post(f"{job}/destruction", data={"DESTRUCTION": "2001-01-01T00:00:00"})
    assert client.get(job).status_code == 404


def test_jobs_outlive_the_server(tmp_path, small_database, bright):
    root = tmp_path / "service"
    add_database(root, small_database)
    settings = ServiceSettings(root=root)
    service = Service(settings)
    jobs = service.query_jobs
    client_of_jobs = asker.set("testclient")  # without a token, jobs belong to their client
    ids = [jobs.create("anonymous").job_id for _ in range(3)]
    asker.reset(client_of_jobs)
    for job_id in ids:
        jobs.set_parameters(job_id, [("QUERY", BRIGHT)], {})
    for job_id in ids[:2]:
        jobs.run(job_id)
    begin_next(service.records, (QUERY,))
    service.close()
    with TestClient(make_app(settings), base_url=LOCAL) as client:
        addresses = [f"{LOCAL}/tap/async/{job_id}" for job_id in ids]
        assert error_of(client.get(f"{addresses[0]}/error")) == ENDED_WITH_SERVER
        assert wait_for(client, addresses[1], "COMPLETED", "ERROR") == "COMPLETED"
        assert len(table_of(client.get(f"{addresses[1]}/results/result"))) == len(bright)
        assert phase_of(client, addresses[2]) == "PENDING"


@pytest.mark.slow
def test_databases_and_catalogs_are_seen_as_they_come(tmp_path, small_database):
    root = tmp_path / "service"
    stars = small_database / "stars.parquet"
    with client_of(root) as client:

        def names() -> list[str]:
            query = "SELECT schema_name FROM tap_schema.schemas ORDER BY schema_index"
            return list(table_of(client.get("/tap/sync", params={"QUERY": query}))["schema_name"])

        assert names() == ["tap_schema"]
        add_database(root, small_database)
        assert names() == ["small", "small_1_0_0", "tap_schema"]
        other = add_database(root, small_database, "fedcba9876543210")
        catalog = f"2mass-{'0' * 16}.parquet"
        shutil.copyfile(stars, root / "catalogs" / catalog)
        quoted = f'"_2mass_{"0" * 16}"'
        assert names() == [quoted, "small", "small_1_0_0", "small_1_0_0_2", "tap_schema"]
        query = f"SELECT COUNT(*) AS n FROM {quoted}.stars"
        table = table_of(client.get("/tap/sync", params={"QUERY": query}))
        assert list(table["n"]) == [pq.read_metadata(stars).num_rows]
        # Databases that cannot be opened are left out, and the others are there.
        (other / "stars.parquet").write_bytes(b"PAR1 no table PAR1")
        (other / "manifest.json").touch()
        catalogs = root / "catalogs"
        (catalogs / catalog).rename(catalogs / f"2mass-{'1' * 16}.parquet")
        assert names() == [quoted.replace("0", "1"), "small", "small_1_0_0", "tap_schema"]


@pytest.mark.slow
def test_a_new_build_renames_no_table(tmp_path, small_database, picky_database, database_version):
    root = tmp_path / "service"
    newer = {"1.10.0": "a" * 16, "1.9.0": "b" * 16}
    queries = [
        f"SELECT star_id, mag FROM {table} ORDER BY star_id"
        for table in ("small_1_0_0.stars", "small.stars")
    ]
    with client_of(root) as client:

        def rows(query: str) -> list[tuple[int, float]]:
            return [
                tuple(row) for row in table_of(client.get("/tap/sync", params={"QUERY": query}))
            ]

        add_database(root, small_database)
        before = rows(queries[0])
        assert rows(queries[1]) == rows("SELECT star_id, mag FROM stars ORDER BY star_id") == before
        for version, name in newer.items():
            add_database(root, database_version(version), name)
        # A database of the same name and version comes after the present ones.
        add_database(root, picky_database, "0" * 16)
        assert [rows(query) for query in queries] == [before, before]
        about = "SELECT schema_name, description FROM tap_schema.schemas ORDER BY schema_name"
        descriptions = dict(rows(about))
        versions = ["small_1_0_0", "small_1_0_0_2", "small_1_10_0", "small_1_9_0"]
        assert list(descriptions) == ["small", *versions, "tap_schema"]
        assert descriptions["small"].startswith("The newest version: the tables of small_1_10_0.")
        assert len(rows(queries[0].replace("1_0_0", "1_0_0_2"))) < len(before)
