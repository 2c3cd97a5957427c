"""HATS catalogs at an address: read like folders, in parts; faults are resumed or reported."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from archive_server import Archive
from hats_stores import write_catalog
from served import in_background

import starcat_service
from starcat import query
from starcat.catalog.ingest import Ingested, ingest_catalog, write_star_tables
from starcat.catalog.source import give_map
from starcat.catalog.store import wire
from starcat.catalog.store.ingest import ingest_to_store
from starcat.catalog.store.layout import open_store
from starcat.catalog.store.plan import StoreOptions
from starcat.catalog.store.reading import NEEDED, read_catalog
from starcat.catalog.store.wire import input_path
from starcat.database.reader import open_database_folder
from starcat.errors import ChecksumMismatch, ConfigError, DownloadError, ProductError, StarcatError
from starcat.pipeline.build import build
from starcat.pipeline.rebuild import rebuild
from starcat.pipeline.specs.reading import read_spec
from starcat.storage.download import DownloadOptions

SLOW = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, sao_lines: list[bytes]) -> Path:
    """A HATS catalog of others, whose row groups go from bright to faint."""
    made = tmp_path_factory.mktemp("others")
    (made / "sao.dat").write_bytes(b"".join(sao_lines))
    write_others(ingest_catalog("sao", [made / "sao.dat"]).stars, made / "catalog")
    return made / "catalog"


def write_others(stars: pa.Table, folder: Path) -> None:
    noise = np.random.default_rng(3).bytes(200 * len(stars))
    more = [noise[200 * k : 200 * (k + 1)] for k in range(len(stars))]
    columns = [*NEEDED, "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr"]
    write_catalog(stars.select(columns).append_column("more", pa.array(more)), folder, 100)
    for path in folder.rglob("*.parquet"):
        pq.write_table(pq.read_table(path).sort_by("mag"), path, row_group_size=20)


@pytest.fixture
def archive(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Archive]:
    """A server, and a client that reads small files as if they were large, and has no patience."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(wire, "FOOTER_BYTES", 512)
    monkeypatch.setattr(wire, "GAP_BYTES", 0)
    monkeypatch.setattr(wire, "HOW", DownloadOptions(retries=2, timeout_s=0.5, backoff_s=0.0))
    with Archive() as server, in_background(server):
        yield server


def read(place: str | Path, **limits: Any) -> Ingested:
    return read_catalog("sao", [input_path(str(place))], **limits)


def partition(archive: Archive, number: int = 1) -> Any:
    """Return a partition that the server has."""
    return archive.remotes[sorted(one for one in archive.remotes if "Npix" in one)[number]]


@SLOW
def test_a_store_of_starcat_gives_the_very_same_database(archive, sao_file, small_spec, tmp_path):
    (tmp_path / "spec.toml").write_text(small_spec)
    spec, store = read_spec(tmp_path / "spec.toml"), tmp_path / "store"
    # Next to the stars: one record twice, and one that is not a record.
    lines = sao_file.read_bytes().splitlines(keepends=True)
    sao_file.write_bytes(b"".join([*lines, lines[0], b"?" * (len(lines[0]) - 1) + b"\n"]))
    ingest_to_store("sao", [sao_file], store, options=StoreOptions(max_partition_rows=100))
    near = build(spec, tmp_path / "near", inputs={"sao": [store]}).folder
    address = archive.serve_folder("/store", store)
    far = build(spec, tmp_path / "far", inputs={"sao": [input_path(address)]}).folder
    files = [path.relative_to(near) for path in near.rglob("*") if path.is_file()]
    assert all((near / file).read_bytes() == (far / file).read_bytes() for file in files)
    assert rebuild(far, {"sao": [input_path(address)]}).is_identical
    counts = open_database_folder(far).manifest["sources"][0]["rejected"]
    assert counts["malformed_record"] == counts["duplicate_record"] == 1
    del archive.remotes["/store/rejected/file-00000.parquet"]
    with pytest.raises(ProductError, match=r"0 rejected records are there; the store has \d+"):
        read_catalog("sao", [input_path(address)], read_limit_mag=5.0)


def test_only_what_a_limit_leaves_is_asked_for(archive, folder):
    address = archive.serve_folder("/sky", folder)
    found, whole = read(address, read_limit_mag=3.0), read(folder, read_limit_mag=3.0)
    assert found.stars.equals(whole.stars)
    assert found.rejected_by_reason == whole.rejected_by_reason
    sent = sum(one.sent for one in archive.requests if "Npix" in one.path)
    size = sum(path.stat().st_size for path in folder.rglob("Npix*.parquet"))
    assert sent < 0.4 * size
    count = len(archive.requests)
    again = read(address, read_limit_mag=3.0)
    assert again.files == found.files
    ends = [one.range for one in archive.requests[count:] if "Npix" in one.path]
    assert ends == ["bytes=-512"] * len(open_store(folder).catalog.partitions)


MAP = """\
name = "others"
epoch = 2026.0
columns = { star_id = "star_id", ra = "ra_deg", dec = "dec_deg" }
magnitudes = { V = "mag" }
"""


def test_of_a_table_with_a_map_the_columns_of_the_map_are_asked_for(archive, folder, tmp_path):
    (tmp_path / "others.toml").write_text(MAP)
    assert give_map(tmp_path / "others.toml").name == "others"
    note = input_path(archive.serve_folder("/sky", folder))
    found, whole = (read_catalog("others", [one], read_limit_mag=4.0) for one in (note, folder))
    assert found.stars.equals(whole.stars)
    assert found.rejected_by_reason == whole.rejected_by_reason
    assert found.files[0].name.startswith(archive.url("/sky/dataset/Norder="))
    sent = sum(one.sent for one in archive.requests if "Npix" in one.path)
    assert sent < 0.5 * sum(path.stat().st_size for path in folder.rglob("Npix*.parquet"))


RESUMED: dict[str, dict[str, Any]] = {
    "cut in the end": {"cut_after": [100]},
    "cut twice": {"cut_after": [512, 4, 100, 50]},
    "cut in the columns": {"cut_after": [512, 4, 10_000, 200]},
    "500 once": {"statuses": [500]},
    "503 and 429": {"statuses": [503, 429]},
    "stalled": {"cut_after": [100], "stall": True, "stalls": 1},
    "slow": {"pause_s": 0.05},
    "without validators": {"validators": ()},
    "weak validators": {"validators": ("weak ETag",)},
}


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(name, marks=SLOW) if name not in ("cut twice", "500 once") else name
        for name in RESUMED
    ],
)
def test_a_fault_is_resumed(archive, folder, fault):
    address = archive.serve_folder("/sky", folder)
    keys = dict(RESUMED[fault])
    if keys.get("stall"):
        keys["stall"] = threading.Event()
    vars(partition(archive)).update(keys)
    assert read(address).stars.equals(read(folder).stars)


TOLD: dict[str, tuple[dict[str, Any], type[StarcatError], str]] = {
    "500 for ever": ({"statuses": [500] * 9}, DownloadError, r"Npix=.*500.*attempts: 3"),
    "missing": ({"statuses": [404]}, DownloadError, r"Npix=\d+\.parquet: the server answered 404"),
    "forbidden": ({"statuses": [403]}, DownloadError, "the server answered 403"),
    "no ranges": ({"ranges": False}, DownloadError, "sends the whole file.*give its folder"),
    "other bytes": ({"shift_206": -3}, DownloadError, "the server sends bytes"),
    "no total": ({"total_206": "*"}, DownloadError, "the server describes the part as"),
    "packed": ({"encoding": "gzip"}, DownloadError, "packs the body although"),
    "changed": ({"changes_to": b"x" * 5000}, ChecksumMismatch, "has changed.*remove that to read"),
    "no Parquet": ({"body": b"<html>" * 500}, ProductError, "is not a Parquet file"),
    "damaged": ({"body": b"?" * 900 + b"\x40\0\0\0PAR1"}, ProductError, "Npix=.*is damaged"),
    "empty": ({"body": b""}, DownloadError, "the server"),
    "stalled for ever": (
        {"stall": threading.Event(), "cut_after": [9] * 9},
        DownloadError,
        "in time",
    ),
}


QUICK = ("500 for ever", "no ranges", "changed", "no Parquet")


@pytest.mark.parametrize(
    "fault", [pytest.param(name, marks=SLOW) if name not in QUICK else name for name in TOLD]
)
def test_a_fault_is_reported(archive, folder, fault):
    address = archive.serve_folder("/sky", folder)
    keys, kind, told = TOLD[fault]
    vars(partition(archive)).update({k: list(v) if type(v) is list else v for k, v in keys.items()})
    with pytest.raises(kind, match=told):
        read(address)


def test_what_came_before_a_fault_is_kept(archive, folder):
    address = archive.serve_folder("/sky", folder)
    partition(archive, -1).statuses = [403]
    with pytest.raises(DownloadError):
        read(address)
    count = len(archive.requests)
    assert read(address).stars.equals(read(folder).stars)
    assert sum(one.range != "bytes=-512" for one in archive.requests[count:]) < count / 2


@SLOW
def test_a_killed_read_goes_on(archive, folder, tmp_path):
    address = archive.serve_folder("/sky", folder)
    for remote in archive.remotes.values():
        remote.pause_s = 0.05
    command = [sys.executable, "-m", "starcat", "ingest", "sao", "--input", address, "-o"]
    killed = subprocess.Popen([*command, tmp_path / "a.parquet"], stderr=subprocess.DEVNULL)
    while sum("Npix" in one.path for one in archive.requests) < 8:
        assert killed.poll() is None
        time.sleep(0.01)
    killed.kill()
    killed.wait()
    for remote in archive.remotes.values():
        remote.pause_s = 0.0
    assert not (tmp_path / "a.parquet").exists()
    subprocess.run([*command, tmp_path / "a.parquet"], check=True, stdout=subprocess.DEVNULL)
    write_star_tables(read(folder), tmp_path / "b.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


@SLOW
def test_a_file_that_changed_since_is_an_error(archive, folder, small_spec, tmp_path, monkeypatch):
    (tmp_path / "spec.toml").write_text(small_spec)
    spec, address = read_spec(tmp_path / "spec.toml"), archive.serve_folder("/sky", folder)
    made = build(spec, tmp_path, inputs={"sao": [input_path(address)]}).folder
    other = ingest_catalog("sao", [folder.parent / "sao.dat"]).stars.slice(0, 590)
    write_others(other, tmp_path / "other")
    archive.serve_folder("/sky", tmp_path / "other")
    with pytest.raises(ChecksumMismatch, match=r"has changed.*remove that to read"):
        rebuild(made, {"sao": [input_path(address)]})
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "another"))
    with pytest.raises(ChecksumMismatch, match="has changed: the part that was read has sha256"):
        rebuild(made, {"sao": [input_path(address)]})


@pytest.mark.parametrize(
    "account", ["", "[]", "{}", '{"partitions": [{"order": "../../x", "pixel": 1, "repeated": 1}]}']
)
def test_what_a_server_says_becomes_no_path(archive, folder, account):
    address = archive.serve_folder("/sky", folder)
    archive.serve("/sky/store.json", account.encode())
    with pytest.raises(ProductError, match=r"store\.json: cannot be read"):
        read(address)


LACKING: dict[str, tuple[str, str]] = {
    "hats.properties": ("", "expected the address of a HATS catalog"),
    "partition_info.csv": ("", "no partition_info.csv there, and an address lists no files"),
    "suffix": ("hats_npix_suffix=/\n", "its partitions are folders of files"),
}


@pytest.mark.parametrize("what", LACKING)
def test_what_an_address_lacks_is_reported(archive, folder, what):
    address = archive.serve_folder("/sky", folder)
    text, told = LACKING[what]
    if text:
        archive.remotes["/sky/hats.properties"].body = text.encode()
    else:
        del archive.remotes[f"/sky/{what}"]
    with pytest.raises(ProductError, match=told):
        read(address)


@pytest.mark.parametrize(
    "text",
    ["ftp://a.example/b", "http:///b", "https://a.example/b?c=1", "http://[b", "https://u:p@a.example/"],
)  # fmt: skip
def test_a_text_that_is_not_an_address_is_reported(archive, text):
    with pytest.raises(ConfigError, match="address"):
        input_path(text)


def test_an_address_without_a_server_is_reported(archive):
    with pytest.raises(DownloadError, match=r"127.0.0.1:9/sky/.*cannot be reached: Connection ref"):
        read("http://127.0.0.1:9/sky")


def test_a_note_elsewhere_is_no_address(archive, tmp_path):
    note: Callable[[str], Path] = input_path
    kept = note("http://127.0.0.1:9/sky")
    copy = kept.rename(tmp_path / kept.name)
    assert wire.url_of_input(copy) is None


def test_no_service_makes_an_address_an_input():
    folders = (Path(starcat_service.__file__).parent, Path(query.__file__).parent)
    sources = [path for folder in folders for path in folder.rglob("*.py")]
    words = ("input_path", "catalog.tap", "store.wire", "is_address")
    assert len(sources) > 50
    assert not [path for path in sources for word in words if word in path.read_text()]
