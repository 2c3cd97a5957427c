"""No request names a file of the server; and a server with blocked threads answers, and stops."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import requests
import tomlkit
from served import Served, serve
from services import SPEC, client_of, every_route, until, with_name

import starcat_service
from starcat.local_files import keys_of_files
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.specs.reading import local_preset, preset, put_key
from starcat_service.app import API

SERVICE = Path(starcat_service.__file__).parent
READS_FILES = ("read_spec", "local_preset", "with_files_read", "read_response", "read_camera")
UNKNOWN = "camera.response.no_such_key"
REFUSED = "names a file"
CANARY = "wavelength_nm,response\n500,0.0313373\n550,1\n600,0.0313373\n"

KEYS = keys_of_files(BuildSpec)


def test_keys_that_look_like_files_are_local_files() -> None:
    assert {"camera.response.file", "camera.response.optics_file"} <= set(KEYS)
    pattern = re.compile(r"(file|path|folder|directory)$")
    properties = {
        name
        for section in BuildSpec.model_json_schema()["$defs"].values()
        for name in section.get("properties", {})
    }
    assert {name for name in properties if pattern.search(name)} == {
        key.rpartition(".")[2] for key in KEYS
    }


def test_the_service_calls_no_function_that_reads_the_files_of_a_spec() -> None:
    for path in SERVICE.rglob("*.py"):
        used = [name for name in READS_FILES if re.search(rf"\b{name}\b", path.read_text())]
        assert not used, f"{path.name} uses {', '.join(used)}"


def test_only_the_user_of_the_machine_has_files_read(tmp_path: Path) -> None:
    canary = tmp_path / "own.csv"
    canary.write_text(CANARY)
    changes = {"camera.response.file": str(canary), "camera.response.per": "photon"}
    assert local_preset("gaia-12deg", changes).camera.response.value[0] == 0.0313373
    with pytest.raises(ValueError, match=REFUSED):
        preset("gaia-12deg", changes)


def with_key(key: str, value: Any) -> dict[str, Any]:
    content = tomllib.loads(SPEC)
    put_key(content, key, value)
    return content


def as_toml(content: dict[str, Any]) -> str:
    return tomlkit.dumps(content)


Shape = tuple[str, dict[str, Any]]


def bodies(key: str, value: Any) -> Iterator[Shape]:
    """Give the arguments of requests that bring a spec with a key, in every form there is."""
    content, text = with_key(key, value), tomlkit.item(value).as_string()
    table, _, name = key.rpartition(".")
    inline = {table: f"{{{name} = {text}}}"}
    keys = {key: str(value)}
    dotted = f"{SPEC}\n[{table}]\n{name} = {text}\n"
    arrays = f"{SPEC}\n[[{table}]]\n{name} = {text}\n"
    of_preset = {"preset": "gaia-12deg"}
    yield "spec", {"json": {"spec": content}}
    yield "toml", {"json": {"toml": as_toml(content)}}
    yield "dotted", {"json": {"toml": dotted}}
    yield "arrays", {"json": {"toml": arrays}}
    for changes in (keys, inline, {table.partition(".")[0]: inline_of(content, table)}):
        yield "changes", {"json": {**of_preset, "changes": changes}}
        yield "changed spec", {"json": {"spec": tomllib.loads(SPEC), "changes": changes}}
        yield "changed toml", {"json": {"toml": SPEC, "changes": changes}}
        yield "job changes", {"json": {"kind": "build", **of_preset, "changes": changes}}
    for spec in (content, as_toml(content), dotted):
        yield "job", {"json": {"kind": "build", "spec": spec}}
    yield "camera", {"json": {"name": "mycam", "camera": content["camera"]}}
    yield "raw", {"json": content}
    yield ("text", {"content": as_toml(content), "headers": {"Content-Type": "application/toml"}})
    yield "form", {"data": {"toml": as_toml(content), "toml-before": ""}}
    yield "same form", {"data": {"toml": as_toml(content), "toml-before": as_toml(content)}}
    yield "build form", {"data": {"toml": as_toml(content), "toml-before": "", "do": "build"}}
    yield "suggest", {"data": {"toml": as_toml(content), "toml-before": "", "do": "suggest"}}
    yield "pin", {"data": {"toml": SPEC, "pinned": f"preset=&{key}={value}"}}
    yield "field", {"data": {"toml": SPEC, "toml-before": SPEC, key: str(value)}}


def inline_of(content: dict[str, Any], table: str) -> str:
    """Return the outermost table of a spec as an inline table of TOML."""
    inline = tomlkit.inline_table()
    inline.update(content[table.partition(".")[0]])
    return inline.as_string()


def queries(key: str, value: Any) -> Iterator[Shape]:
    for base in ({}, {"preset": "gaia-12deg"}):
        yield "query", {"params": {**base, key: str(value)}}
    yield "query text", {"params": {"toml": as_toml(with_key(key, value))}}
    yield "pinned", {"params": {"pinned": f"preset=&{key}={value}"}}


KNOWN = {
    *(("POST", f"{API}/specs/{name}") for name in ("validate", "estimate", "coverage", "starter")),
    ("POST", f"{API}/jobs"),
    *(("GET", "/new"), ("POST", "/new"), ("POST", "/new/preview")),
}


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_every_endpoint_that_takes_a_spec_refuses_every_key_that_names_a_file(
    tmp_path: Path,
) -> None:
    canary = tmp_path / "canary.csv"
    canary.write_text(CANARY)
    names = (str(canary), "/etc/passwd", "/dev/zero")
    opened: list[str] = []
    is_watched = True

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if is_watched and event == "open" and str(arguments[0]) in names:
            opened.append(str(arguments[0]))

    sys.addaudithook(watch)
    takes: set[tuple[str, str]] = set()
    with client_of(tmp_path / "root", anonymous="publisher") as client:
        for method, path in every_route():
            path = with_name(path, "f" * 16)
            shapes = queries if method == "GET" else bodies
            for number, (name, request) in enumerate(shapes(UNKNOWN, str(canary))):
                control = client.request(method, path, follow_redirects=False, **request).text
                if not re.search(r"no_such_key: (unknown key|Extra inputs)", control):
                    continue
                takes.add((method, path))
                for key in KEYS:
                    has_camera_only = name == "camera" or path.endswith("/starter")
                    if has_camera_only and not key.startswith("camera."):
                        continue  # this request has nothing else of a spec
                    for value in names:
                        [*_, (_, again)] = list(shapes(key, value))[: number + 1]
                        answer = client.request(method, path, follow_redirects=False, **again)
                        assert REFUSED in answer.text, (method, path, name, key)
                        assert answer.status_code in (200, 422), (method, path, name, key)
                        if not path.startswith("/new"):
                            assert answer.status_code == 422, (method, path, name, key)
                        assert "0.0313373" not in answer.text
                        assert "root:x:0" not in answer.text
    is_watched = False
    assert takes >= KNOWN, KNOWN - takes
    assert not opened


BLOCKING = """
import os, runpy
from starcat_service import server
make_app = server.make_app
def with_block(settings):
    app = make_app(settings)
    app.add_api_route("/block", lambda: open(os.environ["BLOCKING_PIPE"]).read())
    return app
server.make_app = with_block
runpy.run_module("starcat", run_name="__main__", alter_sys=True)
"""
THREADS = 40
"""Threads for requests in the server: anyio's default."""


def seconds_to_end(served: Served) -> float:
    """Send SIGTERM, and return how long the server took to end with 0."""
    begun_s = time.monotonic()
    served.process.send_signal(signal.SIGTERM)
    assert served.process.wait(20.0) == 0
    return time.monotonic() - begun_s


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_with_all_threads_blocked_the_server_says_that_it_lives_and_ends_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    monkeypatch.setenv("BLOCKING_PIPE", str(pipe))
    with serve(tmp_path / "root", tmp_path / "log", BLOCKING) as served:

        def block() -> None:
            with suppress(requests.RequestException):
                requests.get(f"{served.address}/block", timeout=60)

        for _ in range(THREADS + 5):
            threading.Thread(target=block, daemon=True).start()
        until(lambda: threads_of(served) >= THREADS)
        with pytest.raises(requests.Timeout):
            requests.get(f"{served.address}/api/v1/specs/presets", timeout=2)
        assert requests.get(f"{served.address}/healthz", timeout=5).json() == {"status": "alive"}
        assert seconds_to_end(served) < 10.0
    assert "the server ended without them" in (tmp_path / "log").read_text()


def threads_of(served: Served) -> int:
    return len(os.listdir(f"/proc/{served.process.pid}/task"))
