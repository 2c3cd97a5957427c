"""A hundred requests at once from one reader: other users are answered all the time."""

from __future__ import annotations

import http.client
import json
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from pictures import png_of
from served import Served, serve
from services import add_database, client_of, service_photographs, until

from starcat_service.problems import Problem

CROWD = 100
READER, OTHER = "127.0.0.1", "127.0.0.2"
"""Addresses of clients: two users without a token."""

MAX_PAGE_S = 1.0
MAX_SERVER_BYTES = 700e6
JSON = {"Content-Type": "application/json"}


@pytest.fixture
def sky_of_its_own(tmp_path: Path, sao_lines: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sao").mkdir()
    (tmp_path / "sao" / "sao.dat").write_bytes(b"".join(sao_lines))
    monkeypatch.setenv("STARCAT_CATALOGS", str(tmp_path / "sao"))
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "no-cache"))


def test_a_crowd_that_waits_for_an_estimate_keeps_no_page_waiting(
    tmp_path: Path, small_spec: str, sky_of_its_own: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: list[Future[Any]] = []

    def never(*_: object) -> Future[Any]:
        answers.append(Future())
        return answers[-1]

    with client_of(tmp_path / "root") as client:
        monkeypatch.setattr(client.app.state.service.catalogs, "_sent", never)
        other = TestClient(client.app, base_url=client.base_url, client=(OTHER, 50_000))
        quiet_s = max(page_s(other) for _ in range(3))
        statuses: list[int] = []

        def ask(number: int) -> None:
            changes = {} if number % 2 else {"selection.faint_limit_mag": f"{3 + number / 100}"}
            asked = {"toml": small_spec, "changes": changes}
            path = f"/api/v1/specs/{('estimate', 'coverage')[number // 2 % 2]}"
            statuses.append(client.post(path, json=asked).status_code)

        threads = [threading.Thread(target=ask, args=(number,)) for number in range(60)]
        for thread in threads:
            thread.start()
        until(lambda: len(answers) == 2 and len(statuses) >= 20)
        assert set(statuses) == {503}, "more than a few different ones are refused at once"
        assert page_s(other) < max(MAX_PAGE_S, 4.0 * quiet_s)
        while any(thread.is_alive() for thread in threads):
            for answer in answers:
                if not answer.done():
                    answer.set_exception(Problem(503, "the process is not there"))
            time.sleep(0.01)


def page_s(client: TestClient) -> float:
    began_s = time.monotonic()
    assert client.get("/databases").status_code == 200
    return time.monotonic() - began_s


@dataclass
class Crowd:
    """Requests of one reader at the same time, and the pages of another user meanwhile."""

    served: Served
    statuses: list[int] = field(default_factory=list)
    page_s: list[float] = field(default_factory=list)

    def run(self, send: Callable[[int], int]) -> None:
        threads = [
            threading.Thread(target=lambda k=k: self.statuses.append(send(k))) for k in range(CROWD)
        ]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            self.page_s.append(self.look())
            time.sleep(0.1)

    def look(self) -> float:
        began_s = time.monotonic()
        assert request(self.served, "GET", "/databases", address=OTHER)[0] == 200
        return time.monotonic() - began_s


def request(
    served: Served,
    method: str,
    path: str,
    body: bytes = b"",
    headers: dict[str, str] | None = None,
    address: str = READER,
) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(
        "127.0.0.1", served.port, timeout=120.0, source_address=(address, 0)
    )
    try:
        connection.request(method, path, body or None, headers or {})
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def photographs_of(pictures: list[bytes]) -> tuple[bytes, dict[str, str]]:
    """Return the form of *Find the camera*, and its headers."""
    parts = [b'--x\r\nContent-Disposition: form-data; name="do"\r\n\r\nphotos\r\n']
    for number, picture in enumerate(pictures):
        head = f'--x\r\nContent-Disposition: form-data; name="photos"; filename="{number}.png"'
        parts += [head.encode(), b"\r\n\r\n", picture, b"\r\n"]
    return b"".join([*parts, b"--x--\r\n"]), {"Content-Type": "multipart/form-data; boundary=x"}


def memory_bytes(served: Served) -> int:
    """Return the most memory that the server has had."""
    text = Path(f"/proc/{served.process.pid}/status").read_text()
    [kilobytes] = re.findall(r"VmHWM:\s+(\d+)", text)
    return 1024 * int(kilobytes)


@pytest.fixture(scope="module")
def crowded(
    tmp_path_factory: pytest.TempPathFactory, small_database: Path, sao_lines: list[bytes]
) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("crowd")
    (folder / "catalogs").mkdir()
    (folder / "catalogs" / "sao.dat").write_bytes(b"".join(sao_lines))
    add_database(folder / "root", small_database)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STARCAT_CATALOGS", str(folder / "catalogs"))
        with serve(folder / "root", folder / "log", anonymous="reader") as served:
            yield served


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    paths = service_photographs(tmp_path_factory.mktemp("sky"), tmp_path_factory)
    return [path.read_bytes() for path in paths]


def with_camera(served: Served, pictures: list[bytes]) -> str:
    """Find the camera of photographs as the page does: wait for the job, then ask again."""
    body, headers = photographs_of(pictures)
    until_s = time.monotonic() + 240.0
    while time.monotonic() < until_s:
        status, content = request(served, "POST", "/new/preview", body, headers, OTHER)
        state = json.loads(content)
        if status == 200 and not state["job"] and "many requests" not in state["wrong"]:
            return str(state["wrong"])
        time.sleep(1.0)
    raise AssertionError("the camera was not found in time")


KINDS = ("photos", "estimate", "coverage", "starter", "different")


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", KINDS)
def test_a_crowd_keeps_no_page_of_another_user_waiting(
    crowded: Served, pictures: list[bytes], small_spec: str, kind: str
) -> None:
    quiet, crowd = Crowd(crowded), Crowd(crowded)
    quiet.page_s = [quiet.look() for _ in range(20)]
    spoilt, form = photographs_of([png_of(32, 32, bytes(33 * 32))])
    camera = {"width_px": 640, "height_px": 480, "fov_x_deg": 50.0}
    bodies = {
        "estimate": ("estimate", {"toml": small_spec}),
        "coverage": ("coverage", {"preset": "gaia-12deg"}),
        "starter": ("starter", {"name": "mine", "camera": camera}),
    }

    def send(number: int) -> int:
        if kind == "photos":
            return request(crowded, "POST", "/new/preview", spoilt, form)[0]
        path, content = bodies.get(kind, ("estimate", {"preset": "gaia-12deg"}))
        if kind == "different":
            limit = f"{4.0 + 0.01 * number:.2f}"
            content = {**content, "changes": {"selection.faint_limit_mag": limit}}
        body = json.dumps(content).encode()
        return request(crowded, "POST", f"/api/v1/specs/{path}", body, JSON)[0]

    cameras: list[str] = []
    camera_of = threading.Thread(target=lambda: cameras.append(with_camera(crowded, pictures)))
    camera_of.start()
    crowd.run(send)
    camera_of.join()
    counts = {code: crowd.statuses.count(code) for code in sorted(set(crowd.statuses))}
    sys.stdout.write(
        f"{kind}: {counts}; pages of another user: quiet at most {max(quiet.page_s):.2f} s, "
        f"meanwhile {max(crowd.page_s):.2f} s ({len(crowd.page_s)} pages); the server had at most "
        f"{memory_bytes(crowded) / 1e6:.0f} MB\n"
    )
    assert cameras == [
        camera_text for camera_text in cameras if "2 files, 2 identified" in camera_text
    ], cameras
    assert "2 files, 2 identified" in with_camera(crowded, pictures)
    assert set(counts) <= {200, 503}
    assert max(crowd.page_s) < max(MAX_PAGE_S, 4.0 * max(quiet.page_s))
    assert memory_bytes(crowded) < MAX_SERVER_BYTES
