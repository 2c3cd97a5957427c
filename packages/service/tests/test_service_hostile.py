"""Hostile requests, letter by letter, to a server that runs.

Each is refused with the right status. After each request the files next to the root, and the
databases, releases and settings in it are unchanged, and no answer contains a path or a
traceback. Neither queries by chance nor requests by the schema find a defect.
"""

from __future__ import annotations

import gzip
import json
import os
import random
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import pytest
import requests
from pictures import png_of
from served import Answer, Served, serve
from services import DATABASE, add_database, token_of

from starcat.pipeline.build import build
from starcat.pipeline.specs.reading import spec_from_dict

SCRIPT = "<script>alert(1)</script>"
UPLOAD_MIB = 2.0


Status = int | tuple[int, ...]


@dataclass(frozen=True)
class Hostile:
    """A request, and how it is to be refused."""

    name: str
    method: str
    target: str
    status: Status
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes | None = None

    @property
    def statuses(self) -> tuple[int, ...]:
        return (self.status,) if isinstance(self.status, int) else self.status


def get(name: str, target: str, status: Status, **headers: str) -> Hostile:
    return Hostile(
        name, "GET", target, status, {k.replace("_", "-"): v for k, v in headers.items()}
    )


def as_json(name: str, target: str, status: Status, content: object) -> Hostile:
    body = content if isinstance(content, bytes) else json.dumps(content).encode()
    return Hostile(name, "POST", target, status, {"Content-Type": "application/json"}, body)


def as_form(name: str, target: str, status: Status, **fields: str) -> Hostile:
    kind = {"Content-Type": "application/x-www-form-urlencoded"}
    return Hostile(name, "POST", target, status, kind, urlencode(fields).encode())


def as_files(
    name: str, target: str, status: Status, files: dict[str, tuple[str, bytes]], **fields: str
) -> Hostile:
    prepared = requests.Request("POST", "http://localhost", data=fields, files=files).prepare()
    kind = {"Content-Type": str(prepared.headers.get("Content-Type", ""))}
    return Hostile(name, "POST", target, status, kind, prepared.body or b"")


def huge_png() -> bytes:
    """A picture of 60,000 by 60,000 pixels in four kilobytes, as far as its head says."""
    return png_of(60_000, 60_000, bytes(4_000_000))


def huge_fits() -> bytes:
    """A FITS file whose header states 10 ** 10 pixels."""
    cards = [
        "SIMPLE  =                    T", "BITPIX  =                   16",
        "NAXIS   =                    2", "NAXIS1  =               100000",
        "NAXIS2  =               100000", "END",
    ]  # fmt: skip
    return "".join(card.ljust(80) for card in cards).encode().ljust(2880) + bytes(2880)


def bomb_gz() -> bytes:
    """A gigabyte of zeros in a megabyte, in 64 members."""
    return gzip.compress(bytes(1 << 24), mtime=0) * 64


OUTSIDE = (
    b'<?xml version="1.0"?><!DOCTYPE v [<!ENTITY a SYSTEM "file:///etc/passwd">]>'
    b"<VOTABLE><DESCRIPTION>&a;</DESCRIPTION></VOTABLE>"
)

DB = f"/api/v1/databases/{DATABASE}"
IDENTIFY = f"/api/v1/identify/{DATABASE}"

PATHS = [
    get("dots in a path", "/api/v1/databases/../../records.sqlite", 400),
    get("an absolute path behind files", f"{DB}/files//etc/passwd", 404),
    get("dots encoded twice", f"{DB}/files/%252e%252e%252f%252e%252e%252frecords.sqlite", 404),
    get("overlong UTF-8", f"{DB}/files/%c0%ae%c0%ae/records.sqlite", 404),
    get("dots between the blobs", "/registry/blobs/sha256/../../../records.sqlite", 400),
    get("an absolute path in the registry", "/registry//etc/passwd", 404),
]

JOBS = "/api/v1/jobs"


LONG = {f"x{k}": "{" + ".".join("a" * 950) + " = 1}" for k in range(190)}
BRACKETS = "SELECT " + "(" * 50_000 + "1" + ")" * 50_000
QUERIES = [
    as_json("changes", JOBS, 422, {"kind": "build", "preset": "gaia-12deg", "changes": LONG}),
    as_json("not a number", JOBS, 422, b'{"kind": "evaluate", "noise_px": NaN}'),
    as_json("SQL", "/api/v1/sql", (400, 422), {"query": BRACKETS, "targets": [DATABASE]}),
    as_form("ADQL", "/tap/sync", 400, LANG="ADQL", QUERY=f"{BRACKETS} FROM tap_schema.tables"),
]
"""Values that take long, all of them, and brackets within brackets."""


def image(name: str, file_name: str, content: bytes, status: Status) -> Hostile:
    return as_files(
        f"image: {name}", IDENTIFY, status, {"file": (file_name, content)}, database=DATABASE
    )


PACKED = {"Content-Type": "application/json", "Content-Encoding": "gzip"}
UPLOADS = [
    as_files(
        "upload of TAP: an entity from a file, and a path as its name", "/tap/sync", 422,
        {"t": ("../../../../tmp/starcat-hostile.xml", OUTSIDE)}, LANG="ADQL",
        QUERY="SELECT * FROM tap_upload.t", UPLOAD="t,param:t",
    ),
    image("a picture of 3.6 gigapixels", "f.png", huge_png(), 422),
    image("a FITS file of 10 ** 10 pixels", "f.fits", huge_fits(), 422),
    image("a gigabyte of zeros in a megabyte", "f.fits.gz", bomb_gz(), (413, 422)),
    Hostile("compressed JSON", "POST", JOBS, (400, 415, 422), PACKED, bomb_gz()[:100_000]),
    as_files("a thousand files", IDENTIFY, (400, 422), {f"f{k}": ("x", b"") for k in range(1_100)}),
]  # fmt: skip

MANIFEST = f"{DB}/files/manifest.json"
RANGES = "bytes=" + ",".join(f"{k}-{k}" for k in range(1_000))
SMUGGLED = {"Content-Length": "5", "Transfer-Encoding": "chunked, chunked"}
SIZES = [
    Hostile("too large a length", "POST", IDENTIFY, 413, {"Content-Length": str(10**12)}),
    Hostile("a length and parts (smuggling)", "POST", JOBS, 400, SMUGGLED),
    get("a header of 60,000 letters", "/healthz", (400, 431), X_Long="x" * 60_000),
    get("a thousand ranges", MANIFEST, (200, 400, 416), Range=RANGES),
    get("more jobs than there are numbers", "/api/v1/jobs?limit=" + "9" * 400, 422),
]

PEOPLE = [
    get("a password that is not text", "/api/v1/databases", 401, Authorization="Basic /////w=="),
    Hostile("a method that changes what is only read", "PUT", DB, 405, {}, b"x"),
    Hostile("a method that is made up", "BREW", "/healthz", 405),
    Hostile("a connection to elsewhere", "CONNECT", "evil.example:443", (400, 405)),
]  # fmt: skip

EVERY = [*PATHS, *QUERIES, *UPLOADS, *SIZES, *PEOPLE]


@dataclass(frozen=True)
class Target:
    """The server that is attacked."""

    served: Served
    token: str
    around: Path

    def send(self, hostile: Hostile) -> Answer:
        headers = {"Authorization": f"Bearer {self.token}"} | hostile.headers
        return self.served.raw(hostile.method, hostile.target, headers, hostile.body)

    def logged(self) -> list[dict[str, Any]]:
        """Return the requests in the log of the server."""
        lines = self.served.log.read_text().splitlines()
        return [json.loads(line) for line in lines if line.startswith("{")]

    def files(self) -> dict[str, bytes | None]:
        """What must not change: everything around the root, and what lasts in it."""
        root = self.served.root
        contents: dict[str, bytes | None] = {}
        for path in sorted(self.around.rglob("*")):
            within = path.relative_to(root).parts[:1] if path.is_relative_to(root) else ()
            if within and within[0] not in ("databases", "registry", "catalogs", "service.toml"):
                continue
            if path != self.served.log:
                contents[str(path)] = path.read_bytes() if path.is_file() else None
        return contents


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory, small_database: Path) -> Iterator[Target]:
    around = tmp_path_factory.mktemp("around")
    root = around / "within" / "root"
    root.mkdir(parents=True)
    (around / "secret.txt").write_text("what nobody is to see")
    add_database(root, small_database)
    token = token_of(root, "mallory")
    limits = {"upload_mib": UPLOAD_MIB, "upload_time_s": 1.5, "query_time_s": 6.0, "workers": 0}
    limits |= {"jobs_waiting": 5, "requests_per_minute": 1_000_000}
    with serve(root, around / "log", **limits) as served:
        yield Target(served, token, around)


@pytest.mark.parametrize("hostile", EVERY, ids=[hostile.name for hostile in EVERY])
def test_a_hostile_request_is_refused(hostile, target):
    before = target.files()
    begun_s = time.monotonic()
    answer = target.send(hostile)
    assert answer.status in hostile.statuses, answer.text[:500]
    assert time.monotonic() - begun_s < 15.0
    for secret in ("Traceback", 'File "', str(target.around), "site-packages", "root:x:0"):
        assert secret not in answer.text, answer.text[:500]
    assert "what nobody is to see" not in answer.text
    if "html" in answer.headers.get("content-type", ""):
        assert SCRIPT not in answer.text
    assert '"detail":"Not Found"' not in answer.text, "there is no such address to attack"
    if "x-request-id" in answer.headers:  # else the server itself took it for no request at all
        assert answer.headers["x-content-type-options"] == "nosniff"
    assert target.files() == before
    assert not list(Path("/tmp").glob("starcat-hostile*"))


def talk(served: Served, *parts: bytes, wait_s: float = 0.0) -> bytes:
    """Send bytes with pauses, and return all that comes."""
    with socket.create_connection(("127.0.0.1", served.port), timeout=20.0) as line:
        try:
            for part in parts:
                line.sendall(part)
                time.sleep(wait_s)
        except OSError:
            pass  # it was refused on the way
        received = b""
        try:
            while more := line.recv(65_536):
                received += more
        except ConnectionResetError:
            pass
        return received


PART = b'--edge\r\nContent-Disposition: form-data; name="file"; filename="f.png"\r\n\r\n'


def test_a_slow_upload_is_ended(target):
    head = (
        f"POST {IDENTIFY} HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {target.token}"
        "\r\nContent-Type: multipart/form-data; boundary=edge\r\nContent-Length: 1000\r\n\r\n"
    )
    begun_s = time.monotonic()
    received = talk(target.served, head.encode() + PART, *[b"x"] * 8, wait_s=0.25)
    assert received.startswith(b"HTTP/1.1 408 ")
    assert time.monotonic() - begun_s < 10.0


@pytest.mark.slow
@pytest.mark.parametrize("first", [b"", b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\nX-A: "])
def test_a_head_without_an_end_is_ended(target, first):
    begun_s = time.monotonic()
    received = talk(target.served, first, *[b"x"] * 12 if first else [], wait_s=1.0)
    assert received == b""
    assert 10.0 < time.monotonic() - begun_s < 19.0


ID = b"X-Request-ID: a"
FOLDED = [ID + b"\r\n b: c", ID + b"\x00b", ID + b"\x0bb", b"Host : 127.0.0.1", b"no colon at all"]


@pytest.mark.parametrize("header", FOLDED)
def test_headers_that_hold_others_are_refused(target, header):
    received = talk(
        target.served, b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n" + header +
        b"\r\nConnection: close\r\n\r\n",
    )  # fmt: skip
    status = int(received.split()[1])
    assert status in (200, 400)
    assert b"\r\n b: c" not in received
    if status == 200:
        head = received.split(b"\r\n\r\n")[0].lower()
        [name] = [line for line in head.split(b"\r\n") if line.startswith(b"x-request-id")]
        assert len(name) == len(b"x-request-id: ") + 16  # the service chose another id


def test_the_answers_hold_no_header_of_a_request(target):
    answer = target.send(get("next", "/sign-in?next=%0d%0aSet-Cookie:%20a=b", (200,)))
    assert "set-cookie" not in answer.headers
    assert "Set-Cookie" not in answer.text


def test_a_script_in_a_description_is_text_on_every_page(target, small_spec, sao_lines, tmp_path):
    (tmp_path / "sao.dat").write_bytes(b"".join(sao_lines))
    content = tomllib.loads(small_spec)
    content |= {"description": f'{SCRIPT}"onload=alert(1)', "name": "scripted"}
    built = build(spec_from_dict(content, "spec"), tmp_path, inputs={"sao": [tmp_path / "sao.dat"]})
    other = "f" * 16
    add_database(target.served.root, built.folder, other)
    for path in ("/", "/databases", f"/databases/{other}", f"/identify?database={other}"):
        page = target.send(get(path, path, 200))
        assert page.status == 200, page.text[:500]
        assert SCRIPT not in page.text
        assert '"onload=alert(1)' not in page.text
    assert "&lt;script&gt;" in target.send(get("page", f"/databases/{other}", 200)).text
    report = target.send(get("report", f"/databases/{other}/report", 200))
    assert SCRIPT not in report.text
    assert "unsafe-inline" not in page.headers["content-security-policy"]
    policy = report.headers["content-security-policy"]
    assert "default-src 'none'" in policy  # it has its styles within, and no script runs
    assert "sandbox" in policy
    assert "script-src" not in policy


def test_every_line_of_the_log_is_the_servers_own(target):
    forged = quote('x\n{"level": "error", "message": "forged"}')
    target.send(get("log", f"/nothing/{forged}", 400))
    target.send(get("log", "/nothing", 404, User_Agent='"}\x85{"message": "forged"}'))
    # A line is written when its answer has been sent.
    entries, until = [], time.monotonic() + 10.0
    while "/nothing" not in {entry.get("path") for entry in entries}:
        assert time.monotonic() < until
        entries = target.logged()
    assert all(entry["message"] != "forged" for entry in entries)
    text = target.served.log.read_text()
    assert target.token not in text
    assert "Traceback" not in text
    assert not [entry for entry in entries if entry["level"] == "error"]


# Queries by chance, the same each time. They are the last requests: the server still answers.

SQL = (
    "SELECT", "FROM", "stars", "pairs", "*", "count(*)", "WHERE", "mag", "<", "5", "ORDER BY", "(",
    ")", ",", "'", "\"", "cone(1, 2, 3)", "GROUP BY", "1", "NULL", "CASE", "WHEN", "THEN", "ELSE",
    "END", "AS", "x", "LIMIT 3", "UNION", "WITH", "a", "JOIN", "ON", "range(5)", "-", "/", "0",
    "CAST", "AS INTEGER", "BOX(1, 2, 3, 4)", "POINT('ICRS', ra_deg, dec_deg)", "TOP 3", "CONTAINS(",
    "CIRCLE(1, 2, 3)", "tap_schema.tables", "unnest([1, 2])", "lambda", "::", "[", "]", "{", "}",
    ";", "repeat('x', 10)", "DISTANCE(", "SUM(mag)", "OVER (ORDER BY mag)", "OFFSET", "9" * 30,
    "IN", "$a",
)  # fmt: skip
BEGIN = ("SELECT ", "SELECT 1 AS n ", "SELECT TOP 5 ", "FROM ", "WITH q AS (SELECT ", "")


def by_chance(number: int) -> list[Hostile]:
    """Return requests with the query of a number, which looks like SQL now and then."""
    draw = random.Random(number)
    query = draw.choice(BEGIN) + " ".join(draw.choices(SQL, k=draw.randrange(8)))
    return [
        as_form(str(number), "/tap/sync", 200, LANG="ADQL", QUERY=query),
        as_json(str(number), "/api/v1/sql", 200, {"targets": [DATABASE], "query": query}),
        get(str(number), f"/databases/{DATABASE}/sql?" + urlencode({"query": query}), 200),
    ]


@pytest.mark.timeout(1500)
@pytest.mark.parametrize("many", [8, pytest.param(1_000, marks=pytest.mark.slow)])
def test_no_query_by_chance_is_a_defect(target, many):
    sent = [hostile for number in range(many) for hostile in by_chance(number)]
    statuses = [target.send(hostile).status for hostile in sent]
    wrong = [
        (hostile.target, hostile.body)
        for hostile, status in zip(sent, statuses, strict=True)
        if status > 499
    ]
    assert wrong == []
    assert {200, 400} <= set(statuses)
    assert target.send(get("", "/readyz", 200)).status == 200
    assert [line for line in target.logged() if line["level"] == "error"] == []


# Requests by the schema: schemathesis runs as a command of its own, since its plugin for pytest
# warns of what other tests do.

CHECKS = (
    "status_code_conformance,content_type_conformance,response_headers_conformance,"
    "response_schema_conformance"
)

MAY_BE_BUSY = (503,)
"""With ``Retry-After``, and in the schema of the operations that read a catalog first."""

HOOKS = """
import schemathesis

@schemathesis.serializer("application/toml", "application/x-tar")
def as_text(context, value):
    return value.encode() if isinstance(value, str) else str(value).encode()
"""


# TAP and cone searches describe themselves in documents of the Virtual Observatory. OpenAPI has
# little about their answers, so that they are checked for server errors only.
PARTS = {
    "REST": ("--checks", CHECKS, "--exclude-path-regex", "/events$|^/metrics$|^/tap|^/scs"),
    "VO": ("--checks", "not_a_server_error", "--include-path-regex", "^/tap|^/scs"),
}

# Coverage tries each value of each field, whatever ``--max-examples`` says: for the thirty options
# of identifying 1,700 requests, ten minutes. Of these there are examples and chance.
NOT_COVERED = {"REST": "|/identify/", "VO": ""}

LONGEST_S = 900
"""A run is bounded by its examples; this limit is for a run that hangs, under any load."""


def fuzz(target: Target, report: Path, part: str, phase: str) -> None:
    """Run schemathesis with the same examples each time."""
    *checks, paths = PARTS[part]
    paths += NOT_COVERED[part] if phase == "coverage" else ""
    options = ("--max-examples", "12", "--phases", phase, *checks, paths)
    command = [
        sys.executable, "-m", "schemathesis.cli", "run",
        f"{target.served.address}/api/openapi.json", "--header",
        f"Authorization: Bearer {target.token}", "--seed", "1", "--generation-deterministic",
        "--no-color", "--request-timeout", "20", *options,
    ]  # fmt: skip
    hooks = report / "hooks.py"
    hooks.write_text(HOOKS)
    environment = os.environ | {"SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": str(report)}
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=report, env=environment,
        timeout=LONGEST_S,
    )  # fmt: skip
    said = f"{done.stdout[-8000:]}\n{done.stderr[-2000:]}"
    assert done.returncode == 0, said
    broken = [entry for entry in target.logged() if entry.get("status", 0) >= 500]
    assert not [entry for entry in broken if entry["status"] not in MAY_BE_BUSY]


@pytest.mark.slow
@pytest.mark.timeout(LONGEST_S + 60)
@pytest.mark.parametrize("phase", ["examples", "coverage", "fuzzing"])
@pytest.mark.parametrize("part", PARTS)
def test_no_request_that_the_schema_allows_or_forbids_breaks_it(target, tmp_path, part, phase):
    fuzz(target, tmp_path, part, phase)
