"""Messages have the names of the reader's interface: options, parameters, or labels."""

from __future__ import annotations

import ast
import io
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image
from services import DATABASE, add_database, client_of

import starcat
import starcat_service
from starcat.cli import REFERENCE
from starcat.errors import ConfigError, QueryError, worded
from starcat.failures import failure_of, option_of
from starcat.matcher.refusal import HINTS, bracketed

PACKAGE = Path(starcat.__file__).parent
SERVICE = Path(starcat_service.__file__).parent
OPTION = re.compile(r"(?<![\w-])--[a-z]")
COMMAND = re.compile(r"'starcat [^']*(?:'|$)")

COMMAND_LINE = ("cli", "commands.py")
"""Rooms and modules that only the command line uses."""

ALLOWED = {
    # The end of a command in quotes that begins in another part of the text.
    "catalog/source_files.py": 1,
    "releases/trust.py": 1,
    "store/reading.py": 2,
    # Comments of files that people read, and the failure of the command line itself.
    "catalog/table_draft.py": 1,
    "failures.py": 2,
    "specs/star_sensor.py": 1,
    "onboard/c_source.py": 1,
    # Commands that an operator or a visitor is to copy.
    "api/releases.py": 2,
    "server.py": 1,
}
"""Literals with an option, by module; the numbers may only become smaller."""


def literals(tree: ast.Module) -> list[str]:
    """Return the texts of a module without its docstrings and its styles of pages."""
    remarks: set[ast.expr] = set()
    found = []
    for node in ast.walk(tree):  # a node comes before its parts
        if isinstance(node, ast.Expr):
            remarks.add(node.value)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found += [] if node in remarks or "{" in node.value[:40] else [node.value]
    return found


@cache
def modules() -> dict[str, ast.Module]:
    """Return the modules that other interfaces than the command line use, by name."""
    paths = {
        path.relative_to(package): path
        for package in (PACKAGE, SERVICE)
        for path in sorted(package.rglob("*.py"))
        if path.name != "__init__.py"
    }
    return {
        name.as_posix(): ast.parse(path.read_text(encoding="utf-8"))
        for name, path in paths.items()
        if name.parts[0] not in COMMAND_LINE
    }


def test_messages_of_the_library_name_no_option_of_the_command_line():
    found = {
        name: [text for text in literals(tree) if OPTION.search(COMMAND.sub("", text))]
        for name, tree in modules().items()
    }
    counts = {name: len(texts) for name, texts in found.items() if texts}
    assert counts == ALLOWED, {name: found[name] for name in counts if name not in ALLOWED}


def test_every_parameter_of_a_message_has_an_option():
    known = set(re.findall(r"--[a-z][a-z-]+", REFERENCE["cli"]()))
    of_python = {"--centroids-px", "--matcher", "--host", "--port", "--root"}
    fields = [
        element.value
        for tree in modules().values()
        for node in ast.walk(tree)
        if isinstance(node, ast.keyword) and node.arg == "fields"
        if isinstance(node.value, ast.Tuple)
        for element in node.value.elts
        if isinstance(element, ast.Constant)
    ]
    names = {*fields, *(name for hint in HINTS.values() for name in bracketed(hint))}
    assert len(names) > 30
    options = {option_of(name, "starcat bands").split()[0] for name in names}
    assert options - known - of_python == set()


def test_an_input_of_a_query_is_named_as_the_query_takes_it():
    error = ConfigError('Name it with inputs["sao"], or not', fields=('inputs["sao"]',))
    assert failure_of(error, "starcat build").message == "Name it with --input sao=PATH, or not"
    assert failure_of(error, "starcat sql").message == "Name it with 'starcat sql sao=PATH', or not"
    assert failure_of(error, "starcat serve", str).message == str(error)


@pytest.mark.parametrize(
    ("text", "fields", "words"),
    [
        ("output/a is there; choose another output", ["output"],
         "output/a is there; choose another --output"),
        ("output: not there; see 'output'", ["output"], "--output: not there; see 'output'"),
        ("camera is 5; expected a camera", ["camera"], "--camera is 5; expected a camera"),
        ("a.time_s and time_s", ["time_s"], "a.time_s and --time-s"),
    ],
)  # fmt: skip
def test_only_the_parameter_is_translated(text, fields, words):
    assert worded(QueryError(text, fields=tuple(fields)), option_of) == words


@pytest.fixture(scope="module")
def client(tmp_path_factory, small_artifact):
    root = tmp_path_factory.mktemp("wording")
    add_database(root, small_artifact)
    with client_of(root, anonymous="publisher", query_time_s=60.0) as client:
        yield client


ENDLESS = (
    "SELECT count(*) FROM stars a, stars b, stars c, stars d, stars e "
    "WHERE a.mag + b.mag + c.mag > e.mag + d.mag"
)


def sql(**asked):
    return ("/api/v1/sql", {"json": {"targets": [DATABASE], **asked}})


def tap(query: str):
    return ("/tap/sync", {"data": {"REQUEST": "doQuery", "LANG": "ADQL", "QUERY": query}})


def identify(name: str, content: bytes):
    return (f"/api/v1/identify/{DATABASE}", {"files": {"file": (name, content)}})


def picture() -> bytes:
    """Return a frame whose size differs from the camera's."""
    pixels = np.random.default_rng(1).normal(100, 3, (200, 300))
    pixels[20:180:16, 20:280:26] = 250
    file = io.BytesIO()
    Image.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(file, "PNG")
    return file.getvalue()


def cube() -> bytes:
    file = io.BytesIO()
    fits.PrimaryHDU(np.zeros((5, 32, 32), np.float32)).writeto(file)
    return file.getvalue()


REQUESTS = {
    "sql: a value": (*sql(query="SELECT $ra"), 'give its value with values["ra"]'),
    "sql: too slow": (*sql(query=ENDLESS, time_limit_s=0.3), "stopped after"),
    "sql: a table function": (*sql(query="FROM read_csv('a')"), "cone"),
    "sql: writing": (*sql(query="COPY stars TO 'a'"), "a query only reads"),
    "sql: a pivot in parentheses": (
        *sql(query="FROM (PIVOT stars ON star_id USING count(*))"), "give the values of a pivot"),
    "sql: SELECT of a pivot": (
        *sql(query="SELECT * FROM (PIVOT stars ON star_id USING count(*))"),
        "give the values of a pivot"),
    "sql: no such query": (*sql(named="nothing"), "known queries"),
    "sql: a wrong value": (*sql(named="densest-fields", values={"count": "x"}), 'values["count"]'),
    "tap: no table": (*tap("SELECT * FROM nothing"), "nothing"),
    "identify: a cube": (*identify("a.fits", cube()), "such as plane=0"),
    "identify: of another size": (*identify("a.png", picture()), "that took it (camera)"),
    "catalog": ("/api/v1/jobs", {"json": {"kind": "ingest", "source": "2mass"}}, "operator"),
}  # fmt: skip


@pytest.mark.parametrize("name", list(REQUESTS))
def test_an_answer_of_the_service_names_no_option(client, name):
    assert_no_option(client, *REQUESTS[name])


@pytest.mark.slow
def test_the_answer_to_a_slow_query_of_tap_names_no_option(tmp_path, small_artifact):
    add_database(tmp_path, small_artifact)
    with client_of(tmp_path, anonymous="publisher", query_time_s=1.0) as client:
        asked = tap(ENDLESS.replace("stars", "small.stars"))
        assert_no_option(client, *asked, "stopped after")


def assert_no_option(client, address, given, words):
    answer = client.post(address, **given)
    assert answer.status_code >= 400, answer.text
    assert not OPTION.search(answer.text)
    assert "'starcat " not in answer.text
    assert words in answer.text.replace('\\"', '"'), answer.text
