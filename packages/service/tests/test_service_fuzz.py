"""Requests by chance, the same each time, to all addresses: none of them is a defect.

Each is made from its number alone. A failure names the number; `asked(operations, NUMBER)` is it.
"""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import pytest

pytest.importorskip("fastapi")

from served import Served, serve
from services import DATABASE, add_database

MANY = 3_000
FEW = 60

ODD = (
    "", " ", "0", "-1", "1e309", "NaN", "9" * 400, "null", "[]", "{}", "'", '"', "--", "/*", "\\",
    "%", "%00", "\u0000", "\u202e", "\ud7ff", "\U0001f4a9", "ä" * 300, "../../etc/passwd", "a/b",
    "<script>", "$(id)", "${jndi:x}", "true", "1;DROP TABLE jobs", "\r\nX: y", DATABASE, "f" * 32,
    "small-1.0.0", "stars", "csv", "fits", "2026-11-23", "9999-99-99T99:99:99", "inf", "0x10",
)  # fmt: skip

SQL = (
    "SELECT", "FROM", "stars", "pairs", "*", "count(*)", "WHERE", "mag", "<", "5", "ORDER BY", "(",
    ")", ",", "'", "\"", "cone(1, 2, 3)", "GROUP BY", "1", "NULL", "CASE", "WHEN", "THEN", "ELSE",
    "END", "AS", "x", "LIMIT 3", "UNION", "WITH", "a", "JOIN", "ON", "range(5)", "-", "/", "0",
    "CAST", "AS INTEGER", "BOX(1, 2, 3, 4)", "POINT('ICRS', ra_deg, dec_deg)", "TOP 3", "CONTAINS(",
    "CIRCLE(1, 2, 3)", "tap_schema.tables", "unnest([1, 2])", "lambda", "::", "[", "]", "{", "}",
    ";", "repeat('x', 10)", "DISTANCE(", "SUM(mag)", "OVER (ORDER BY mag)", "OFFSET", "9" * 30,
    "IN", "$a",
)  # fmt: skip


@dataclass(frozen=True)
class Asked:
    """A request."""

    method: str
    target: str
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes | None = None


def words(draw: random.Random) -> str:
    """Return something that looks like a query now and then."""
    many = draw.randrange(1, 14)
    start = draw.choice(["SELECT ", "SELECT TOP 5 ", "FROM ", "WITH q AS (SELECT ", "", "EXPLAIN "])
    return start + " ".join(draw.choices(SQL, k=many))


def value(draw: random.Random, depth: int = 0) -> Any:
    """Return a value as JSON has it."""
    kind = draw.randrange(9)
    if kind < 3:
        return draw.choice(ODD)
    if kind == 3:
        return draw.choice([0, -1, 1, 2**63, -(2**70), 1e308, 1.5, 10**6])
    if kind == 4:
        return draw.choice([None, True, False])
    if depth > 3:
        return draw.random()
    if kind < 7:
        return [value(draw, depth + 1) for _ in range(draw.randrange(4))]
    return {draw.choice(ODD)[:20]: value(draw, depth + 1) for _ in range(draw.randrange(4))}


def changed(draw: random.Random, content: Any) -> Any:
    """Return a value with a part that is another."""
    if isinstance(content, dict) and content and draw.random() < 0.8:
        key = draw.choice(sorted(content))
        if draw.random() < 0.2:
            return {one: content[one] for one in content if one != key}
        return {**content, key: changed(draw, content[key])}
    if isinstance(content, list) and content and draw.random() < 0.8:
        place = draw.randrange(len(content))
        return [*content[:place], changed(draw, content[place]), *content[place + 1 :]]
    return words(draw) if isinstance(content, str) and draw.random() < 0.5 else value(draw)


def multipart(draw: random.Random) -> tuple[str, bytes]:
    """Return a type and a body with files in it."""
    content = draw.choice(
        [b"x,y\n1,2\n3,4\n", b"\x89PNG\r\n\x1a\n", draw.randbytes(300), b"SIMPLE  =", b"{",
         b"[" * 9000, b"<VOTABLE><RESOURCE><TABLE/></RESOURCE></VOTABLE>", b"II*\0",
         b'{"centroids_px": [[1, 2]]}']
    )  # fmt: skip
    name = draw.choice(["a.csv", "a.png", "a.fits", "a.json", "a.tiff", "../a", "", "a.vot"])
    parts = [(draw.choice(["file", "options", "UPLOAD", "x"]), name, content)]
    lines = b"".join(
        f'--e\r\nContent-Disposition: form-data; name="{key}"; filename="{given}"\r\n\r\n'.encode()
        + data
        + b"\r\n"
        for key, given, data in parts
    )
    query = f'--e\r\nContent-Disposition: form-data; name="QUERY"\r\n\r\n{words(draw)}\r\n'
    end = draw.choice([b"--e--\r\n", b"--e--\r\n", b""])
    return "multipart/form-data; boundary=e", lines + query.encode() + end


def body_of(draw: random.Random, operation: dict[str, Any]) -> tuple[str, bytes]:
    """Return a type and a body, near to what an address takes or far from it."""
    kind = draw.randrange(8)
    contents = operation.get("requestBody", {}).get("content", {})
    example = contents.get("application/json", {}).get("example") or {
        "targets": [DATABASE], "query": words(draw), "database": DATABASE, "format": "csv",
        "centroids_px": [[1.0, 2.0], [30.0, 40.0], [50.0, 60.5], [70.0, 80.0]], "options": {},
        "spec": 'name = "a"\nversion = "1.0.0"', "source": "gaia", "frames": 3, "name": "a",
    }  # fmt: skip
    if kind < 4:
        for _ in range(draw.randrange(4)):
            example = changed(draw, example)
        return "application/json", json.dumps(example).encode()
    if kind == 4:
        return multipart(draw)
    if kind == 5:
        names = ["QUERY", "LANG", "MAXREC", "FORMAT", "PHASE", "UPLOAD", "ACTION", "token", "spec"]
        fields = [(draw.choice(names), draw.choice([words(draw), draw.choice(ODD)]))
                  for _ in range(4)]  # fmt: skip
        return "application/x-www-form-urlencoded", urlencode(fields, errors="replace").encode()
    if kind == 6:
        return "application/json", draw.choice([b"[" * 9000, b"{", b"\xff", b"1", b'"\\ud800"'])
    return draw.choice(["text/plain", "a/b", "", "application/json"]), draw.randbytes(200)


def asked(operations: list[tuple[str, str, dict[str, Any]]], number: int) -> Asked:
    """Return the request of a number."""
    draw = random.Random(number)
    method, path, operation = draw.choice(operations)
    if draw.random() < 0.3:
        method, path, operation = draw.choice(
            [one for one in operations if one[1].startswith(("/tap", "/api/v1/sql", "/scs"))]
        )
    target = path
    while "{" in target:
        before, _, rest = target.partition("{")
        given = DATABASE if draw.random() < 0.6 else draw.choice(ODD)
        target = before + quote(given, safe="") + rest.partition("}")[2]
    known = [one["name"] for one in operation.get("parameters", ()) if one["in"] == "query"]
    chosen = [name for name in [*known, *known, "x", "PHASE"] if draw.random() < 0.4]
    texts = {name: words(draw) if name.upper() == "QUERY" else draw.choice(ODD) for name in chosen}
    if texts:
        target += "?" + urlencode(texts, errors="replace")
    headers, body = {}, None
    if method in ("POST", "PUT", "PATCH", "DELETE") and draw.random() < 0.9:
        headers["Content-Type"], body = body_of(draw, operation)
    extra = ["Range", "If-None-Match", "Accept", "Cookie", "Authorization", "X-Request-ID"]
    if draw.random() < 0.2:
        text = draw.choice(["bytes=5-", "bytes=-0", "*", "starcat=x", "Basic eA==", "text/html"])
        headers[draw.choice(extra)] = text
    return Asked(method, target, headers, body)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, small_artifact: Path) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("fuzz")
    add_database(folder / "root", small_artifact)
    limits = {"query_time_s": 2.0, "requests_per_minute": 10**6, "upload_mib": 2.0, "workers": 0}
    with serve(folder / "root", folder / "log", anonymous="publisher", **limits) as running:
        yield running


@pytest.mark.timeout(1500)
@pytest.mark.parametrize("many", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_no_request_is_a_defect(served, many):
    described = json.loads(served.raw("GET", "/api/openapi.json").body)["paths"]
    removes = {"delete": lambda path: path.startswith("/api/v1/databases")}
    operations = [
        (method.upper(), path, operation)
        for path, methods in sorted(described.items())
        for method, operation in sorted(methods.items())
        if not path.endswith("/events") and not removes.get(method, lambda _: False)(path)
    ]
    assert len(operations) > 40
    wrong, statuses = [], set()
    for number in range(many):
        one = asked(operations, number)
        answer = served.raw(one.method, one.target, one.headers, one.body, timeout_s=60.0)
        statuses.add(answer.status)
        if answer.status >= 500:
            wrong.append((number, answer.status, one.method, one.target[:200], answer.text[:200]))
    assert wrong == []
    assert {200, 404, 422} <= statuses
    assert served.raw("GET", "/readyz").status == 200
    lines = [json.loads(text) for text in served.log.read_text().splitlines() if text[:1] == "{"]
    assert [one for one in lines if one["level"] == "error"] == []
