"""Specs and catalogs over REST: keys, presets, checks, estimates, the map, first specs."""

from __future__ import annotations

import asyncio
import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from services import client_of

from starcat.pipeline.draft import Draft
from starcat.pipeline.estimate import choose_stars, read_draft
from starcat.pipeline.specs.build_spec import BuildSpec, CameraSpec
from starcat.pipeline.specs.reading import preset, preset_names, spec_from_dict
from starcat.pipeline.starter import starter_spec
from starcat.storage.toml_files import content_of_toml
from starcat_service import catalogs as catalogs_module
from starcat_service.catalogs import Catalogs, offered_catalogs
from starcat_service.estimates import OWN_AT_ONCE, OWN_WAITING, ChildCatalogs
from starcat_service.problems import Problem
from starcat_service.sandbox.limiter import asker
from starcat_service.sandbox.messages import DONE

API = "/api/v1"
TOML = {"content-type": "application/toml"}
PROBLEM = "application/problem+json"


@pytest.fixture(scope="module")
def small(
    tmp_path_factory: pytest.TempPathFactory, sao_lines: list[bytes], small_spec: str
) -> Iterator[BuildSpec]:
    """A small spec, whose catalog the service finds by itself."""
    folder = tmp_path_factory.mktemp("sao")
    (folder / "sao.dat").write_bytes(b"".join(sao_lines))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STARCAT_CATALOGS", str(folder))
        patch.setenv("STARCAT_CACHE", str(folder / "no-cache"))
        yield spec_from_dict(content_of_toml(small_spec, "small.toml"), "small.toml")


@pytest.fixture(scope="module")
def client(small: BuildSpec, tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    with client_of(tmp_path_factory.mktemp("service")) as client:
        yield client


def refused(answer: Any, status: int) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == PROBLEM
    assert "Traceback" not in answer.text
    return answer.json()


# --- Keys, presets, checks


def test_the_keys_are_described(client):
    schema = client.get(f"{API}/specs/schema").json()
    limit = schema["$defs"]["Selection"]["properties"]["faint_limit_mag"]
    assert limit["description"] == "fainter stars are rejected; the limit itself is kept"
    assert (limit["minimum"], limit["maximum"]) == (-30.0, 40.0)


def test_presets_are_listed_and_explained(client):
    listed = client.get(f"{API}/specs/presets").json()["presets"]
    assert tuple(entry["name"] for entry in listed) == preset_names()
    explained = client.get(f"{API}/specs/presets/sao-12deg").json()
    assert explained["sources"] == ["sao", "hipparcos"]
    assert spec_from_dict(content_of_toml(explained["toml"], "text"), "text") == preset("sao-12deg")
    assert spec_from_dict(explained["spec"], "json") == preset("sao-12deg")
    wrong = refused(client.get(f"{API}/specs/presets/sao-12degs"), 422)
    assert "did you mean 'sao-12deg'?" in wrong["detail"]
    assert (wrong["code"], wrong["key"]) == (2, "preset")


def test_a_spec_is_checked_as_toml_as_json_and_as_a_changed_preset(client, small_spec, small):
    requests = [
        {"content": small_spec, "headers": TOML},
        {"json": {"toml": small_spec}},
        {"json": {"spec": small.model_dump(mode="json")}},
    ]
    for body in requests:
        answer = client.post(f"{API}/specs/validate", **body)
        assert answer.status_code == 200
        assert spec_from_dict(answer.json()["spec"], "answer") == small
        assert spec_from_dict(content_of_toml(answer.json()["toml"], "text"), "text") == small
    changes = {"selection.faint_limit_mag": "5.5", "selection.max_stars": "100"}
    answer = client.post(f"{API}/specs/validate", json={"preset": "gaia-12deg", "changes": changes})
    assert spec_from_dict(answer.json()["spec"], "answer") == preset("gaia-12deg", changes)


def test_no_request_reads_a_map_by_its_path(client, small_spec, tmp_path, monkeypatch):
    (tmp_path / "secret.toml").write_text('password = "hunter2"')
    monkeypatch.chdir(tmp_path)
    spec = small_spec.replace('"sao"', '"secret.toml"')
    for path in ("validate", "estimate", "coverage"):
        answer = client.post(f"{API}/specs/{path}", content=spec, headers=TOML)
        problem = refused(answer, 422)
        assert (problem["key"], "hunter2" in answer.text) == ("catalog.source", False)


JSON, PICTURE = {"content-type": "application/json"}, {"content-type": "image/png"}
NESTED = b'{"spec": ' + b'{"a": ' * 20_000 + b"1" + b"}" * 20_001
REFUSED = [
    ("validate", TOML, "a." * 20_000 + "a = 1", 422, "20,000 full stops"),
    ("validate", TOML, "a = " + "[" * 20_000, 422, "nested too deep"),
    ("validate", TOML, "x = 0x" + "f" * 50_000, 422, "found a number of 200,000 bits"),
    ("validate", TOML, "#" * 150_000, 422, "150,000 characters"),
    ("validate", TOML, "\ud800".encode("utf-8", "surrogatepass"), 422, "not a readable TOML file"),
    ("validate", PICTURE, b"x", 415, "application/toml"),
    ("validate", TOML, f"version = {'7' * 5_000}", 422, ""),
    ("validate", TOML, "name = 2026-99-99T00:00:00", 422, ""),
    ("estimate", JSON, b"", 422, "Invalid JSON"),
    ("estimate", JSON, NESTED, 422, "recursion limit"),
    ("estimate", JSON, b'{"spec": {"name": "' + b"x" * 500_000 + b'"}}', 413, "400,000 bytes"),
    ("estimate", JSON, b'{"spec": {"boresights": {"count": 1e400}}}', 422, "missing"),
]
"""Bodies that are long or deep, or not text. The table of refusals has all others."""


@pytest.mark.parametrize(("path", "kind", "content", "status", "words"), REFUSED, ids=range(12))
@pytest.mark.timeout(10)
def test_a_body_that_is_not_a_spec_is_refused(client, path, kind, content, status, words):
    wrong = refused(client.post(f"{API}/specs/{path}", content=content, headers=kind), status)
    assert words in wrong["detail"]
    assert len(wrong["detail"]) < 2000
    if kind is TOML:
        for target in ("/new", "/new/preview"):
            page = client.post(target, data={"toml": content, "toml-before": ""})
            assert page.status_code < 500, page.text[:300]


# --- Estimates


def test_an_estimate_is_that_of_the_pipeline(client, small, small_spec):
    answer = client.post(f"{API}/specs/estimate", content=small_spec, headers=TOML)
    assert answer.status_code == 200
    figures = answer.json()
    read = read_draft(small, {})
    choice = choose_stars(read, small)
    assert figures["guide_stars"] == len(choice.selected.guide_stars)
    assert figures["fields"]["count"] == small.boresights.count
    assert figures["fields"]["stars"]["minimum"] == choice.fields.count.min()
    assert figures["total_bytes"] == sum(figures["files"].values())
    assert figures["refusals"] == []
    assert figures["filters"][-1]["stars"] == figures["guide_stars"]
    assert figures["in_words"].startswith("estimate: ")


def test_a_catalog_that_is_not_here_is_reported(client):
    wrong = refused(client.post(f"{API}/specs/estimate", json={"preset": "tycho2-12deg"}), 404)
    assert wrong["detail"].startswith("tycho2 (The Tycho-2 Catalogue): no file found")
    assert wrong["code"] == 3


# --- First specs, catalogs


@pytest.mark.timeout(120)
@pytest.mark.slow
def test_a_first_spec_is_that_of_init(client):
    camera = {"width_px": 640, "height_px": 480, "fov_x_deg": 50.0}
    wish = {"name": "My cam", "camera": camera}
    answer = client.post(f"{API}/specs/starter", json=wish)
    while answer.status_code == 503:  # on a busy machine, while the sky is being read
        time.sleep(0.2 * int(answer.headers["retry-after"]))
        answer = client.post(f"{API}/specs/starter", json=wish)
    assert answer.status_code == 200
    figures = answer.json()
    expected = starter_spec("My cam", CameraSpec(**camera))
    assert figures["checked"]["spec"] == expected.spec.model_dump(mode="json")
    assert figures["thinned"]["guide_stars"] == expected.thinned.guide_stars
    assert figures["in_words"] == expected.cost.in_words
    wrong = {**camera, "fov_x_deg": 500.0}
    assert refused(client.post(f"{API}/specs/starter", json={"camera": wrong}), 422)
    deep = {"camera": {**camera, "fov_x_deg": 100.0}, "faint_limit_mag": 12.0}
    assert "limit 4,000,000" in refused(
        client.post(f"{API}/specs/starter", json=deep), 422
    )["detail"]  # fmt: skip


def test_catalogs_say_whether_they_are_here_and_what_was_read(client, small_spec):
    client.post(f"{API}/specs/estimate", content=small_spec, headers=TOML)
    catalogs = {
        catalog["name"]: catalog for catalog in client.get(f"{API}/catalogs").json()["catalogs"]
    }
    assert catalogs["sao"]["is_here"]
    assert catalogs["gaia"]["is_here"]
    assert not catalogs["2mass"]["is_here"]
    assert "starcat fetch 2mass" in catalogs["2mass"]["hint"]
    assert catalogs["sao"]["read"][0] == {
        "band": "V", "epoch_jyear": 2026.0, "stars": 600, "brightest_mag": 2.0,
        "faintest_mag": 6.4,
    }  # fmt: skip


# --- What is kept


def test_a_catalog_is_read_once_however_many_ask(small, monkeypatch):
    calls = []

    def counted(*arguments: Any, **options: Any) -> Draft:
        calls.append(arguments)
        time.sleep(0.2)
        return read_draft(*arguments, **options)

    monkeypatch.setattr(catalogs_module, "read_draft", counted)
    catalogs = Catalogs()
    counts: list[int] = []
    threads = [
        threading.Thread(target=lambda: counts.append(catalogs.estimate(small).cost.stars))
        for _ in range(6)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(calls) == 1
    assert len(set(counts)) == 1
    assert len(counts) == 6
    [sao] = [
        catalog for catalog in offered_catalogs(catalogs.catalogs_read()) if catalog.name == "sao"
    ]
    assert [(catalog.source, catalog.stars) for catalog in sao.read] == [("sao", 600)]
    source = Path(os.environ["STARCAT_CATALOGS"]) / "sao.dat"
    os.utime(source)
    assert catalogs.estimate(small).cost.stars == counts[0]
    assert len(calls) == 2  # the file has changed
    catalogs.close()


def test_a_request_that_waits_too_long_gets_a_time_to_repeat_it(small, monkeypatch):
    answers: list[Future[Any]] = []

    def never(*_: object) -> Future[Any]:
        answers.append(Future())
        return answers[-1]

    async def ask() -> None:
        catalogs = ChildCatalogs(wait_s=0.05)
        monkeypatch.setattr(catalogs, "_sent", never)
        for _ in range(2):
            with pytest.raises(Problem, match="sao: being read, which takes longer") as caught:
                await catalogs.enough_limit(small)
            assert caught.value.status == 503
            assert caught.value.headers == {"Retry-After": "5"}
        answers[0].set_result((DONE, [4.0, 6.0]))
        assert await catalogs.enough_limit(small) == (4.0, 6.0)

    asyncio.run(ask())
    assert len(answers) == 1, "the same request waits for the same answer"


def test_a_user_can_have_few_requests_wait_and_others_are_answered(small, monkeypatch):
    answers: dict[str, Future[Any]] = {}

    def slow(_: str, arguments: Mapping[str, Any]) -> Future[Any]:
        name = arguments["spec"]["name"]
        answers[name] = Future()
        return answers[name]

    async def ask(catalogs: ChildCatalogs, who: str, name: str) -> object:
        asker.set(who)
        try:
            return await catalogs.enough_limit(small.model_copy(update={"name": name}))
        except Problem as problem:
            return problem.status

    async def until(condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(30.0):
            while not condition():
                await asyncio.sleep(0.01)

    async def attack() -> None:
        catalogs = ChildCatalogs()
        monkeypatch.setattr(catalogs, "_sent", slow)
        names = [f"a{number}" for number in range(20)]
        greedy = [asyncio.create_task(ask(catalogs, "greedy", name)) for name in names]
        equal = [asyncio.create_task(ask(catalogs, "greedy", "a0")) for _ in range(20)]
        n_refused = 20 - OWN_AT_ONCE - OWN_WAITING
        await until(lambda: sum(task.done() for task in greedy) >= n_refused)
        refused = [task for task in greedy if task.done()]
        assert len(refused) == n_refused
        assert {task.result() for task in refused} == {503}
        # What waits for the greedy user does not wait for another one.
        other = asyncio.create_task(ask(catalogs, "anna", "a5"))
        await until(lambda: "a5" in answers)
        assert sorted(answers) == ["a0", "a1", "a5"]
        answers["a5"].set_result((DONE, [5.0, 6.0]))
        assert await other == (5.0, 6.0)
        answers["a0"].set_result((DONE, [1.0, 6.0]))
        assert await asyncio.gather(*equal) == [(1.0, 6.0)] * 20
        for task in greedy:
            task.cancel()

    asyncio.run(attack())


def test_files_that_are_too_large_are_read_to_a_limit_only(small, monkeypatch):
    monkeypatch.setattr(catalogs_module, "MAX_INPUT_BYTES", 1000)
    catalogs = Catalogs()
    with pytest.raises(Problem, match="more than an estimate reads whole") as caught:
        catalogs.estimate(small)
    assert (caught.value.status, caught.value.key) == (413, "catalog.read_limit_mag")
    content = json.loads(small.model_dump_json())
    content["catalog"]["read_limit_mag"] = 6.2
    assert catalogs.estimate(spec_from_dict(content, "small")).cost.stars > 0
    catalogs.close()
