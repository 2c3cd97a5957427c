"""TAP as the field's own clients see it: taplint of STILTS, pyvo, and TapPlus of astroquery."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from astropy.table import Table
from pyvo.dal import DALQueryError, TAPService
from requests import HTTPError
from served import Served

from starcat.query.session import open_session

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(400),
    # The clients leave connections to the garbage collector.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

CONE = (
    "SELECT star_id, designation, ra_deg, dec_deg, mag FROM small.stars WHERE "
    "1 = CONTAINS(POINT('ICRS', ra_deg, dec_deg), CIRCLE('ICRS', 83.6, -5.4, 25)) ORDER BY star_id"
)
SAME_IN_SQL = (
    "SELECT star_id, designation, ra_deg, dec_deg, mag FROM cone(83.6, -5.4, 25) ORDER BY star_id"
)

EXPLAINED = {
    "CAP-CULF": "features beyond ADQL are declared under a type of starcat's own, as allowed",
    "UPL-TMDA": "texts come back as unicodeChar, which holds every text that SQL has",
    "CAP-SVR0": "the service does not name its software",
    "LOC-NOTP": "the service has and declares no table of ObsLocTAP",
}
"""Remarks of taplint that are not errors, and the reasons."""


@pytest.fixture(scope="module")
def rows(small_database: Path) -> list[tuple[object, ...]]:
    """What 'starcat sql' gives for the question of a cone."""
    with open_session([str(small_database)]) as session, session.ask(SAME_IN_SQL) as asked:
        answer = asked.rows(10_000)
    assert len(answer) > 10
    return answer


@pytest.fixture(scope="module")
def url(served: Served) -> str:
    """Address of TAP at a server that runs."""
    return f"{served.address}/tap"


def rows_of(table: Table) -> list[tuple[object, ...]]:
    return [tuple(cell.item() if hasattr(cell, "item") else cell for cell in row) for row in table]


@pytest.mark.skipif(shutil.which("stilts") is None, reason="stilts is not installed")
def test_taplint_finds_no_error(url, tmp_path):
    run = subprocess.run(
        ["stilts", "taplint", f"tapurl={url}"],
        capture_output=True, text=True, timeout=300, check=False, cwd=tmp_path,
    )  # fmt: skip
    remarks = [line for line in run.stdout.splitlines() if re.match("[EWF]-", line)]
    assert "Totals: Errors: 0;" in run.stdout, remarks
    unexplained = [line for line in remarks if line[2:10] not in EXPLAINED]
    assert not unexplained
    queried = re.findall(r"Successful/submitted TAP queries: (\d+)/(\d+)", run.stdout)
    assert len(queried) >= 5
    assert all(done == sent for done, sent in queried)


@pytest.fixture
def service(url):
    return TAPService(url)


def test_pyvo_asks_at_once_and_later(service, rows):
    assert rows_of(service.run_sync(CONE).to_table()) == rows
    assert rows_of(service.run_async(CONE, delete=True).to_table()) == rows


def test_pyvo_learns_what_there_is(service):
    assert service.maxrec == service.hardlimit == 10_000_000
    tables = service.tables
    assert {"small.stars", "tap_schema.columns"} <= set(tables.keys())
    mag = next(column for column in tables["small.stars"].columns if column.name == "mag")
    assert (str(mag.unit), mag.ucd) == ("mag", "phot.mag")
    adql = service.get_tap_capability().get_adql()
    assert adql.get_feature("ivo://ivoa.net/std/TAPRegExt#features-adqlgeo", "POLYGON")
    assert {method.ivo_id.rpartition("-")[2] for method in service.upload_methods} >= {"inline"}
    assert len(service.examples) == 4
    assert rows_of(service.examples[1].execute().to_table())


def test_pyvo_uploads(service, rows):
    ids = Table({"star_id": [row[0] for row in rows][::2]})
    query = (
        "SELECT s.star_id FROM TAP_UPLOAD.ids AS i JOIN small.stars AS s ON i.star_id = s.star_id "
        "ORDER BY s.star_id"
    )
    for run in (service.run_sync, service.run_async):
        table = run(query, uploads={"ids": ids}).to_table()
        assert list(table["star_id"]) == list(ids["star_id"])


def test_pyvo_follows_a_job(service, rows):
    job = service.submit_job(CONE, maxrec=3)
    assert job.phase == "PENDING"
    job.run()
    job.wait(phases=["COMPLETED", "ERROR"], timeout=60.0)
    assert job.phase == "COMPLETED"
    assert rows_of(job.fetch_result().to_table()) == rows[:3]
    assert job.job_id in [listed.jobid for listed in service.get_job_list()]
    job.delete()
    assert job.job_id not in [listed.jobid for listed in service.get_job_list()]


def test_pyvo_gets_the_error(service):
    for run in (service.run_sync, service.run_async):
        with pytest.raises(DALQueryError, match="no column 'nothing'"):
            run("SELECT nothing FROM small.stars")
    table = service.run_sync(CONE, maxrec=2)
    assert (len(table), table.query_status) == (2, "OVERFLOW")


@pytest.fixture
def tap_plus(url):
    from astroquery.utils.tap.core import TapPlus  # which looks for a server when it is loaded

    return TapPlus(url=url)


def test_astroquery_loads_tables(tap_plus):
    tables = {table.name: table for table in tap_plus.load_tables()}
    names = set(tables)
    assert any(name.endswith("small.stars") for name in names), names
    stars = next(table for name, table in tables.items() if name.endswith("small.stars"))
    assert "ra_deg" in [column.name for column in stars.columns]
    assert tap_plus.load_tables(only_names=True)
    stars_table = tap_plus.load_table("small.stars")
    assert "mag" in [column.name for column in stars_table.columns]


@pytest.mark.parametrize("launch", ["launch_job", "launch_job_async"])
@pytest.mark.parametrize("form", ["votable", "csv"])
def test_astroquery_asks_at_once_and_later(tap_plus, rows, launch, form):
    job = getattr(tap_plus, launch)(CONE, output_format=form)
    answer = rows_of(job.get_results())
    assert [row[0] for row in answer] == [row[0] for row in rows]
    assert [row[2:] for row in answer] == [row[2:] for row in rows]


def test_astroquery_gets_the_reason_of_a_failed_job(tap_plus):
    with pytest.raises(HTTPError, match=r"no column 'nothing'; .*there are"):
        tap_plus.launch_job_async("SELECT nothing FROM small.stars")
    with pytest.raises(HTTPError, match="no column 'nothing'"):
        tap_plus.launch_job("SELECT nothing FROM small.stars")


def test_astroquery_uploads(tap_plus, rows, tmp_path):
    path = tmp_path / "ids.vot"
    Table({"star_id": [row[0] for row in rows][:4]}).write(path, format="votable")
    job = tap_plus.launch_job(
        "SELECT COUNT(*) AS n FROM tap_upload.ids JOIN small.stars USING (star_id)",
        upload_resource=str(path),
        upload_table_name="ids",
    )
    assert list(job.get_results()["n"]) == [4]
