"""Messages have the names of the reader's interface: options, parameters, or labels."""

from __future__ import annotations

import ast
import io
import json
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image
from services import DATABASE, add_database, client_of

import starcat
import starcat_service
from starcat.cli import REFERENCE
from starcat.cli.options import option_of
from starcat.errors import (
    ConfigError,
    OutputError,
    error_fields,
    error_from_fields,
    filled,
    literal,
)
from starcat.failures import failure_of
from starcat.matcher.refusal import HINTS
from starcat_service.problems import parameter_of

PACKAGE = Path(starcat.__file__).parent
SERVICE = Path(starcat_service.__file__).parent
OPTION = re.compile(r"(?<![\w-])--[a-z]")
COMMAND = re.compile(r"'starcat [^']*(?:'|$)")

COMMAND_LINE = ("cli", "commands.py")
"""Rooms and modules that only the command line uses."""

ALLOWED = {
    # The end of a command in quotes that begins in another part of the text.
    "catalog/source_files.py": 1,
    "ship/releases/trust.py": 1,
    "catalog/store/reading.py": 2,
    # Comments of files that people read, and the failure of the command line itself.
    "catalog/table_draft.py": 1,
    "failures.py": 2,
    "pipeline/specs/star_sensor.py": 1,
    "database/onboard/c_source.py": 1,
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


def modules(pattern: re.Pattern[str]) -> dict[str, ast.Module]:
    """Return the modules that other interfaces than the command line use, by name.

    Only those with the pattern are read as Python, which takes most of the time.
    """
    texts = {
        path.relative_to(package): path.read_text(encoding="utf-8")
        for package in (PACKAGE, SERVICE)
        for path in sorted(package.rglob("*.py"))
        if path.name != "__init__.py"
    }
    return {
        name.as_posix(): ast.parse(text)
        for name, text in texts.items()
        if name.parts[0] not in COMMAND_LINE and pattern.search(text)
    }


def test_messages_of_the_library_name_no_option_of_the_command_line():
    found = {
        name: [text for text in literals(tree) if OPTION.search(COMMAND.sub("", text))]
        for name, tree in modules(OPTION).items()
    }
    counts = {name: len(texts) for name, texts in found.items() if texts}
    assert counts == ALLOWED, {name: found[name] for name in counts if name not in ALLOWED}


OF_PYTHON = {
    *("--distortion", "--engine", "--fov-y-deg", "--image", "--max-turn-deg", "--origin"),
    *("--parallax-mas", "--position-km", "--sigma-px", "--time-s", "--x"),
}
"""Parameters of functions that no command has; x is a name in a value."""


def test_every_parameter_of_a_message_has_an_option():
    known = set(re.findall(r"--[a-z][a-z-]+", REFERENCE["cli"]()))
    named = [
        text if node.arg == "hint" else f"{{{text}}}"
        for tree in modules(re.compile(r"\b(?:hint|parameter)\b")).values()
        for node in ast.walk(tree)
        if isinstance(node, ast.keyword) and node.arg in ("hint", "parameter")
        for text in texts_of(node.value)
    ]
    options: set[str] = set()

    def collected(parameter: str, value: str, item: str) -> str:
        options.add(option_of(parameter, value, item, "starcat bands").split()[0])
        return parameter

    for text in (*named, *(text for hint in HINTS.values() for text in hint)):
        filled(text, collected)
    assert len(options) > 30
    assert options - known == OF_PYTHON


def texts_of(value: ast.expr) -> list[str]:
    """Return the texts of an expression; a value in a text is written as x."""
    if isinstance(value, ast.JoinedStr):
        parts = (part.value if isinstance(part, ast.Constant) else "x" for part in value.values)
        return ["".join(map(str, parts))]
    if isinstance(value, ast.Constant):
        return [value.value] if isinstance(value.value, str) else []
    return [text for part in ast.iter_child_nodes(value) if isinstance(part, ast.expr)
            for text in texts_of(part)]  # fmt: skip


def test_an_input_of_a_query_is_named_as_the_query_takes_it():
    error = ConfigError("no file", hint=("name it with {inputs[sao]}", "do not"))
    words = {
        name: failure_of(error, name, partial(option_of, command=name))
        for name in ("starcat build", "starcat sql")
    }
    assert words["starcat build"].hint == "name it with --input sao=PATH, or do not"
    assert words["starcat sql"].hint == "name it with 'starcat sql sao=PATH', or do not"
    assert words["starcat sql"].message == f"no file; {words['starcat sql'].hint}"
    in_service = failure_of(error, "starcat serve", parameter_of)
    assert in_service.message == str(error) == 'no file; name it with inputs["sao"], or do not'


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OutputError("output/a is there", hint="choose another {output}"),
         "output/a is there; choose another --output"),
        (ConfigError("not there", parameter="output"), "--output: not there"),
        (ConfigError("expected 1", parameter="fov_deg", value=5), "--fov is 5; expected 1"),
        (ConfigError("a.time_s", hint="set {time_s}", where="a"), "a: a.time_s; set --time-s"),
        (ConfigError("{x}", hint=f"remove {literal('{time_s}')}"), "{x}; remove {time_s}"),
        (ConfigError("x", hint="see } and {"), "x; see } and {"),
    ],
)  # fmt: skip
def test_only_the_parameter_is_translated(error, words):
    assert error.message(option_of) == words
    again = error_from_fields(json.loads(json.dumps(error_fields(error))))
    assert (type(again), again.message(option_of), str(again)) == (type(error), words, str(error))


@pytest.fixture(scope="module")
def client(tmp_path_factory, small_database):
    root = tmp_path_factory.mktemp("wording")
    add_database(root, small_database)
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


TOO_SLOW = ("more with time_limit_s", "a busy machine left it")
"""What a query that is stopped is told: the second, if other processes had the processor."""

REQUESTS = {
    "sql: a value": (*sql(query="SELECT $ra"), 'give its value with values["ra"]'),
    "sql: too slow": (*sql(query=ENDLESS, time_limit_s=0.3), TOO_SLOW),
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
def test_the_answer_to_a_slow_query_of_tap_names_no_option(tmp_path, small_database):
    add_database(tmp_path, small_database)
    with client_of(tmp_path, anonymous="publisher", query_time_s=1.0) as client:
        asked = tap(ENDLESS.replace("stars", "small.stars"))
        assert_no_option(client, *asked, TOO_SLOW)


def assert_no_option(client, address, given, words):
    answer = client.post(address, **given)
    assert answer.status_code >= 400, answer.text
    assert not OPTION.search(answer.text)
    assert "'starcat " not in answer.text
    text = answer.text.replace('\\"', '"')
    assert any(one in text for one in ((words,) if isinstance(words, str) else words)), answer.text
