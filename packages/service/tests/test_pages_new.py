"""The page *New database*: designs as addresses, suggestions and verdicts."""

from __future__ import annotations

import re
import tomllib
from typing import Any

import pytest
from fastapi.testclient import TestClient
from services import SPEC as SMALL
from services import client_of, posted, service_photographs, token_of

from starcat.database.products import USUAL_PRODUCTS
from starcat.pipeline.specs.reading import preset_names
from starcat_service.jobs.job import Attempt, begin_next, failed
from starcat_service.pages.design import design_query, draft_of_query, pinned_draft
from starcat_service.pages.draft import SpecForm, draft_of_form, draft_of_text, draft_with
from starcat_service.pages.response import keys_of_file

SPEC = SMALL.replace('"small"', '"mine"').replace("30.0", "20.0")


def _sent(client: TestClient, address: str, text: str, **more: str):
    return posted(client, address, {"toml": text, "toml-before": "", **more})


# The address


def test_a_preset_has_a_short_address():
    default, *others = preset_names()
    assert design_query(draft_of_query({"preset": default}), default) == ""
    for name in others:
        assert design_query(draft_of_query({"preset": name}), name) == f"?preset={name}"


@pytest.mark.parametrize(
    "changes",
    [
        {"camera.fov_x_deg": 20.0, "selection.faint_limit_mag": 5.6},
        {"catalog.motions": ["tycho2"], "products.grid.enabled": False},
        {"name": "12", "description": 'a "b" & c=d; ü #1'},
        {"camera.fov_x_deg": None, "camera.focal_length_mm": 25.0, "camera.pixel_um": 5.5},
        {"selection.faint_limit_mag": 99.0, "epoch_jyear": "soon"},
        {"selection.nothing": 3, "catalog.band": ""},
        {
            "epoch_jyear": [2027.0, 2042.0],
            "selection.thinning": "voronoi",
            "selection.neighbours.psf_sigma_px": 0.9,
            "camera.response.name": "mine",
            "camera.response.per": "energy",
            "camera.response.wavelength_nm": [400.0, 450.0, 500.0],
            "camera.response.value": [0.0, 1.0, 0.5],
        },
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_an_address_gives_the_design_again(changes):
    for base in ("gaia-12deg", "sao-12deg-512"):
        draft = draft_with(draft_of_query({"preset": base}), changes)
        again = pinned_draft(design_query(draft, base))
        assert again.content == draft.content
        assert again.errors == draft.errors


@pytest.mark.parametrize(
    "text",
    [f"# mine\n{SPEC}", "name = ", f"{SPEC}[a.'b.c']\nd = 1\n", "", "preset = 3\n"],
    ids=["a comment", "no TOML", "a dotted name", "nothing", "a name of the address"],
)
def test_a_text_that_is_more_than_keys_is_in_the_address_as_it_is(text):
    assert pinned_draft(design_query(draft_of_text(text), "gaia-12deg")).text == text


def test_a_design_that_is_too_long_for_an_address_has_none(client):
    nm = [300.0 + k * 1.123456789 for k in range(350)]
    table = {"wavelength_nm": nm, "value": [0.1234567890123456] * len(nm)}
    changes = {f"camera.response.{key}": value for key, value in table.items()}
    draft = draft_with(draft_of_query({}), {"camera.fov_x_deg": 500.0, **changes})
    assert design_query(draft, "") is None
    sent = {"toml": draft.text, "toml-before": "", "do": "pin", "pinned": ""}
    state = client.post("/new/preview", data=sent).json()
    assert (state["address"], state["pinned_query"]) == ("", "")
    assert "too long to be pinned" in state["wrong"]


@pytest.mark.parametrize("gap", ["\n\n", "\n"], ids=["empty lines", "none"])
def test_a_new_key_of_a_table_keeps_the_empty_lines_between_tables(gap):
    before = re.sub(r"\n+\[", f"{gap}[", SPEC)
    text = draft_with(draft_of_text(before), {"selection.max_stars_per_field": 7}).text
    assert text == before.replace("4.5\n", "4.5\nmax_stars_per_field = 7\n")


def test_a_reader_signs_in_and_comes_back_to_the_design_as_it_was_typed(tmp_path):
    token = token_of(tmp_path, "anna")
    with client_of(tmp_path, anonymous="reader") as reader:
        page = reader.get("/new?selection.faint_limit_mag=99").text
        assert "/sign-in?next=%2Fnew%3Fselection.faint_limit_mag%3D99" in page
        assert re.search('<button [^>]*value="sign-in"[^>]*>Sign in to build', page)
        text = draft_of_query({}).text
        typed = {"camera.fov_x_deg": "17", "toml": text, "toml-before": text, "do": "sign-in"}
        reader.headers["Origin"] = str(reader.base_url)
        form = reader.post("/new", data=typed)
        assert form.url.path == "/sign-in"
        [kept] = re.findall(r'name="next" value="([^"]*)"', form.text)
        assert kept == "/new?camera.fov_x_deg=17.0"
        assert reader.post("/new/address", data=typed).json() == {"address": kept}
        answer = reader.post("/sign-in", data={"token": token, "next": kept})
        assert answer.url.path == "/new"
        assert "fov_x_deg = 17" in answer.text
        assert re.search(r'<button [^>]*id="build"', answer.text)


def test_a_design_that_is_too_long_for_an_address_is_not_lost_at_the_sign_in(tmp_path):
    text = SPEC + "# a remark\n" * 2000
    with client_of(tmp_path, anonymous="reader") as reader:
        page = reader.post("/new", data={"toml": text, "toml-before": "", "do": "sign-in"})
        assert page.url.path == "/new"
        assert "Copy its text, sign in, and paste it there." in page.text
        assert page.text.count("# a remark") == 4000


# The description


def test_the_description_follows_the_design_until_its_user_writes_one():
    first = draft_of_query({"preset": "gaia-12deg"})
    wider = _changed(first.text, camera__fov_x_deg="17", selection__faint_limit_mag="5.1")
    words = "Guide stars for a field of 17 x 17 deg, from gaia, G <= 5.1"
    assert wider.spec.description == wider.values["description"] == words
    again = _changed(wider.text, camera__fov_x_deg="12.5")
    assert again.spec.description == words.replace("17", "12.5")
    assert "description" not in design_query(again, "gaia-12deg")
    assert pinned_draft(design_query(again, "gaia-12deg")).content == again.content
    described = _changed(again.text, description="For Anna's camera")
    assert _changed(described.text, camera__fov_x_deg="20").spec.description == "For Anna's camera"
    typed = draft_of_form({"toml": first.text.replace("= 12.0", "= 19.0"), "toml-before": ""})
    assert typed.spec.description.startswith("Guide stars for a field of 19 x 19 deg")
    renamed = _changed(first.text, name="mine", version="2.0.0")
    assert renamed.spec.description == first.spec.description


@pytest.mark.slow
def test_who_may_only_read_builds_nothing(tmp_path):
    with client_of(tmp_path, anonymous="reader") as reader:
        refused = reader.post("/new", data={"toml": SPEC, "toml-before": "", "do": "build"})
        assert refused.status_code == 403
        assert "needs the role builder" in refused.text
        assert reader.app.state.service.jobs.count() == 0


# The sensor


def _changed(text: str, **changes: str) -> SpecForm:
    draft = draft_of_text(text)
    form = {**draft.values, "toml": draft.text, "toml-before": draft.text}
    return draft_of_form(form | {key.replace("__", "."): value for key, value in changes.items()})


def test_the_years_of_a_mission_and_the_rules_of_the_sensor_are_fields():
    rule = "selection__neighbours__"
    draft = _changed(
        SPEC,
        epoch_jyear="2027-2042",
        selection__max_drift_arcsec="2",
        selection__thinning="information",
        selection__max_stars_per_field="12",
        **{f"{rule}psf_sigma_px": "0.9", f"{rule}max_offset_px": "0.05", f"{rule}action": "merge"},
    )
    assert draft.errors == {}
    assert draft.spec.epoch_jyear == (2027.0, 2042.0)
    assert draft.values["epoch_jyear"] == "2027-2042"
    selection = draft.spec.selection
    assert (selection.max_drift_arcsec, selection.thinning, selection.neighbours.action) == (
        2.0, "information", "merge",
    )  # fmt: skip
    assert _changed(draft.text).text == draft.text
    assert _changed(draft.text, epoch_jyear="2030").spec is None  # one year has no drift
    wrong = _changed(SPEC, epoch_jyear="2042-2027", selection__neighbours__action="keep")
    assert set(wrong.errors) == {"epoch_jyear", "selection.neighbours.psf_sigma_px"}


def test_a_response_is_picked_and_another_takes_the_table_of_the_first_away():
    csv = b"# counts: energy\nwavelength_nm,response\n400,0\n450,1\n500,0.5\n"
    draft = draft_with(draft_of_text(SPEC), keys_of_file("My sensor (2).csv", csv, "photon"))
    assert draft.spec.camera.response.response().counts == "energy"
    assert draft.values["camera.response.name"] == "My-sensor-2"
    assert draft.responses[-1] == ("My-sensor-2", "My-sensor-2: from a file")
    assert _changed(draft.text).text == draft.text
    shipped = _changed(draft.text, camera__response__name="silicon-cmos")
    assert shipped.spec.camera.response.response().name == "silicon-cmos"
    assert "wavelength_nm" not in shipped.text
    none = _changed(draft.text, camera__response__name="")
    assert none.spec == draft_of_text(SPEC).spec


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"wavelength_nm,value\n4000,1\n4500,1\n25000,1\n", "angstroms: divide them by 10"),
        (b"a,b,c\n1,2,3\n", "line 1: found 'a,b,c'"),
        (b"\xff\xfe\x00", "it is no text"),
        (b"400,1\n" * 100_000, "more than 500,000 bytes"),
    ],
    ids=["angstroms", "three columns", "a picture", "too large"],
)
def test_a_file_that_is_not_a_response_is_reported_next_to_its_field(client, content, words):
    sent = {"toml": SPEC.replace("20.0", "500.0"), "toml-before": "", "response_per": "photon"}
    file = {"response_file": ("sensor.csv", content, "text/csv")}
    state = client.post("/new/preview", data=sent, files=file).json()
    assert words in state["errors"]["response_file"]
    assert "sensor.csv" in state["errors"]["response_file"]
    assert not state["can_build"]
    assert "camera.response" not in state["toml"]


# Names


def test_a_second_database_of_one_name_and_version_is_refused(client):
    first = client.post(
        "/new", data={"toml": SPEC, "toml-before": "", "do": "build"}, follow_redirects=False
    )
    assert first.status_code == 303
    other = SPEC.replace("4.5", "4.4")
    page = _sent(client, "/new", other, do="build")
    assert page.status_code == 422
    [message] = re.findall(r'id="version-error">([^<]*)<', page.text)
    assert "mine 1.0.0 is there already" in message
    assert "such as 1.0.1" in message
    wish = {"kind": "build", "spec": other}
    answer = client.post("/api/v1/jobs", json=wish)
    assert (answer.status_code, answer.json()["key"]) == (409, "version")
    again = client.post("/api/v1/jobs", json={"kind": "build", "spec": SPEC})
    assert again.status_code == 200  # the same database: the job that makes it
    later = other.replace("1.0.0", "1.0.1")
    assert client.post("/api/v1/jobs", json={"kind": "build", "spec": later}).status_code == 201


# What it would give


def test_a_build_that_would_fail_is_not_begun_before_its_estimate_has_answered(client):
    """A script disables the button as soon as the estimate has answered, not before."""
    text = SPEC.replace("mine", "blind").replace("4.5", "2.5")
    page = _sent(client, "/new", text, do="build")
    assert page.status_code == 422
    assert "% of the sky is blind" in page.text
    assert "Not built." in page.text
    assert client.app.state.service.jobs.count(text="blind") == 0


def test_a_build_whose_estimate_does_not_answer_asks_first(client, monkeypatch):
    catalogs = client.app.state.service.catalogs
    monkeypatch.setattr(catalogs, "_wait_s", 0.0)
    text = SPEC.replace("mine", "unknown").replace("4.5", "4.7")
    sent = {"toml": text, "toml-before": ""}
    page = client.post("/new", data={**sent, "do": "build"})
    assert page.status_code == 409
    assert "The estimate has not answered yet" in page.text
    [anyway] = re.findall(r'value="([^"]*)">Build without an estimate', page.text)
    built = client.post("/new", data={**sent, "do": anyway}, follow_redirects=False)
    assert built.status_code == 303


def test_the_database_for_photographs_is_a_job_that_is_begun_once(client, tmp_path, monkeypatch):
    service = client.app.state.service
    monkeypatch.setattr(service.paths, "blind", tmp_path / "blind")
    states = [with_photographs(client, ("a.png", b"a picture")) for _ in range(3)]
    assert "is being built, once for all users" in states[0]["wrong"]
    [job] = {state["job"] for state in states}
    assert f'href="/jobs/{job}"' in states[0]["wrong"]
    assert service.jobs.get(job).kind == "photographs"
    begun = begin_next(service.records, ("photographs",))
    assert begun is not None
    Attempt(service.records, begun).end(failed("Out of memory", 422, "it took too much"))
    state = with_photographs(client, ("a.png", b"a picture"))
    assert state["job"] is None
    assert "could not be built: it took too much. A publisher can retry" in state["wrong"]
    assert client.post(f"/api/v1/jobs/{job}/retry").status_code == 200


@pytest.mark.slow
def test_limits_are_suggested_for_the_camera(client):
    state = _sent(client, "/new/preview", SPEC.replace("4.5", "3"), do="suggest").json()
    draft = draft_of_text(state["toml"])
    assert draft.spec is not None
    assert draft.spec.selection.faint_limit_mag == 5.2
    assert draft.spec.selection.max_stars_per_field == 12
    assert draft.spec.boresights.count == 2000
    assert draft.spec.name == "mine"
    assert "For 20 x 20 deg: faint limit 5.2" in state["wrong"]
    assert "Good: 99 % of the fields have 12 guide stars" in state["result"]
    page = _sent(client, "/new", SPEC, do="suggest")  # without scripts
    assert "faint_limit_mag = 5.2" in page.text


@pytest.fixture(scope="module")
def photographs(client, tmp_path_factory) -> list[bytes]:
    paths = service_photographs(client.app.state.service.paths.root, tmp_path_factory)
    return [path.read_bytes() for path in paths]


@pytest.mark.slow
@pytest.mark.timeout(150)
def test_photographs_tell_their_camera(client, photographs):
    state = with_photographs(client, *(("../a.png", content) for content in photographs))
    draft = draft_of_text(state["toml"])
    assert draft.spec is not None
    assert (draft.spec.camera.width_px, draft.spec.camera.height_px) == (1024, 768)
    assert draft.spec.camera.fov_x_deg == pytest.approx(31.7, rel=0.003)
    assert float(state["values"]["camera.fov_x_deg"]) == draft.spec.camera.fov_x_deg
    assert draft.spec.selection.faint_limit_mag >= 4.5
    assert 0.02 < draft.spec.self_test.noise_px < 0.6
    assert "From 2 files, 2 identified: a, 2-a." in state["wrong"]
    for key in ("camera.fov_x_deg", "selection.faint_limit_mag", "self_test.noise_px"):
        assert f"# {key} = " in state["toml"]
    assert state["can_build"]
    form = {"toml": SPEC, "toml-before": SPEC, "do": "photos"}  # without scripts
    page = client.post("/new", data=form, files=[("photos", ("../a.png", photographs[0]))])
    assert "From 1 file, 1 identified: a." in page.text


def with_photographs(client: TestClient, *files: tuple[str, bytes]) -> dict[str, Any]:
    form = {"toml": SPEC, "toml-before": SPEC, "do": "photos"}
    sent = [("photos", file) for file in files]
    return client.post("/new/preview", data=form, files=sent or None).json()


@pytest.mark.parametrize("count", [0, 6])
def test_one_to_five_photographs_tell_a_camera(client, count):
    state = with_photographs(client, *[("a.png", b"a picture")] * count)
    assert f"{count} photographs were given; choose 1 to 5" in state["wrong"]
    assert state["toml"] == SPEC


@pytest.mark.slow
def test_what_is_no_photograph_tells_no_camera(client):
    for file, words in (
        (("a.png", b"not a picture"), "No camera was found: a.png"),
        (("a.csv", b"x_px,y_px\n1,2\n"), "(a: fewer than 4 centroids"),
    ):
        state = with_photographs(client, file)
        assert words in state["wrong"]
        assert state["toml"] == SPEC


@pytest.mark.parametrize(
    ("limit", "level", "words"),
    [
        ("3.5", "bad", r"\d\d % of the sky is blind: .* identify 90 % .* limit to G 5\.2\."),
        ("4.3", "bad", r"^\d(\.\d)? % of the sky is blind: [^,]*stars\. Set .* limit to G 5\.2\."),
        ("4.9", "warn", r"Thin: 1 % of the fields have 7 .* Set the faint limit to G 5\.2\."),
        ("5.5", "good", r"Good: 99 % of the fields have \d\d guide stars"),
        ("6.7", "good", r"more than are needed: G 5\.2, or a limit of stars per field"),
    ],
)
def test_an_estimate_has_a_verdict_in_words(client, limit, level, words):
    text = SPEC.replace("4.5", limit).replace("mine", "judged")
    text = text.replace('source = "gaia"', 'source = "gaia"\nband = "G"')
    state = _sent(client, "/new/preview", text).json()
    verdict = re.search(r'<p class="verdict (\w+)" id="verdict">([^<]*)<', state["result"])
    assert verdict is not None
    assert verdict[1] == level
    assert re.search(words, verdict[2]), verdict[2]
    assert state["can_build"] == ("has to identify" not in verdict[2]), state["summary"]


def test_where_a_faint_limit_does_not_help_the_verdict_says_so(client):
    text = f"{SPEC}brightest = 3\n".replace("4.5", "6.0\nmax_stars = 400")
    state = _sent(client, "/new/preview", text).json()
    assert "is faint enough: the other rules remove the stars" in state["result"]


def test_presets_of_catalogs_that_are_not_here_are_in_one_closed_line(client, monkeypatch):
    monkeypatch.setenv("STARCAT_CACHE", "/nonexistent")
    monkeypatch.setenv("STARCAT_CATALOGS", "/nonexistent")
    text = client.get("/new").text
    assert 'href="/new?preset=gaia-12deg"' in text
    assert 'href="/new?preset=sao-12deg"' not in text
    details = re.search(
        r"<details>\s*<summary>(\d) more need catalogs.*?</details>", text, re.DOTALL
    )
    assert details is not None
    assert details[0].count("<li>") == int(details[1])
    assert (
        "sao-12deg: its operator gets the files with "
        "<code>starcat fetch sao</code> and <code>starcat fetch hipparcos</code>" in details[0]
    )


def test_a_box_makes_a_database_of_many_fields(client):
    usual = {f"products.{name}.enabled": "on" for name in USUAL_PRODUCTS} | {"products": "shown"}
    box = usual | {"products.levels.enabled": "on"}
    state = _sent(client, "/new/preview", SPEC, **box, **{"toml-before": SPEC}).json()
    assert tomllib.loads(state["toml"])["products"] == {"levels": {"enabled": True}}
    assert state["products"]["levels"]
    text = state["toml"]
    changed = {"toml-before": text, "products.levels.widest_fov_x_deg": "40"}
    state = _sent(client, "/new/preview", text, **box, **changed).json()
    levels = {"enabled": True, "widest_fov_x_deg": 40.0}
    assert tomllib.loads(state["toml"])["products"] == {"levels": levels}
    state = _sent(client, "/new/preview", text, **usual, **{"toml-before": text}).json()
    assert "enabled" not in state["toml"]


@pytest.mark.parametrize(
    ("limit", "keys"),
    [
        ("4.6", []), ("99\nmax_stars_per_field = -1", ["selection.faint_limit_mag"] * 2),
        ("-28", ["selection.faint_limit_mag"]), ("7.5", ["selection.max_stars_per_field"]),
    ],
)  # fmt: skip
def test_nothing_is_built_while_anything_is_wrong(client, limit, keys):
    """A limit of -28 leaves no star, one of 7.5 takes too much memory."""
    text = SPEC.replace("mine", "checked").replace("= 4.5", f"= {limit}")
    state = _sent(client, "/new/preview", text).json()
    assert state["can_build"] == (not keys)
    assert len(state["errors"]) == len(keys)
    assert set(keys) <= set(state["errors"])
    page = _sent(client, "/new", text, do="preview").text
    [button] = re.findall(r'<button [^>]*id="build"[^>]*>', page)
    assert ("disabled" in button) == bool(keys)
    for key in state["errors"]:
        assert re.search(rf'id="{re.escape(key)}-error">[^<]+<', page), key


def test_a_pinned_design_is_compared_with_the_present_one(client):
    pinned = _sent(client, "/new/preview", SPEC, do="pin").json()
    query = pinned["pinned_query"]
    assert "It is the same as this one" in pinned["result"]
    text = SPEC.replace("4.5", "5.5")
    state = _sent(client, "/new/preview", text, pinned=query).json()
    row = re.search(r"selection.faint_limit_mag</th><td>(.*?)</td><td>(.*?)</td>", state["result"])
    assert row is not None
    assert row.groups() == ("5.5", "4.5")
    assert state["result"].count("data:image/png") == 2
    legends = re.findall(r'<ul class="legend".*?</ul>', state["result"], re.DOTALL)
    assert legends[0] == legends[1]  # the colours mean the same
    assert "pinned=" in state["address"]
    page = client.get(state["address"]).text
    assert "faint_limit_mag = 5.5" in page
    assert re.search('id="pinned" value="[^"]*name=mine', page)
    gone = _sent(client, "/new/preview", text, pinned=query, do="unpin").json()
    assert gone["result"].count("data:image/png") == 1
    assert "pinned" not in gone["address"]


def test_a_region_is_typed_as_numbers_and_shown_as_they_were_typed():
    typed = {"cone": "266.4, -29, 20", "zone": "[-30, 30]", "moc": "0/0-3"}
    form = {f"selection.region.{name}": text for name, text in typed.items()}
    draft = draft_of_form({"toml": SPEC, "toml-before": SPEC, **form})
    assert draft.spec is not None, draft.errors
    region = draft.spec.selection.region
    assert (region.cone, region.zone, region.moc) == ((266.4, -29, 20), (-30, 30), "0/0-3")
    assert draft.values["selection.region.cone"] == "266.4, -29, 20"
    same = {**draft.values, "toml": draft.text, "toml-before": draft.text}
    assert draft_of_form(same).text == draft.text
    emptied = draft_of_form({**same, **dict.fromkeys(form, "")})
    assert emptied.spec == draft_of_text(SPEC).spec


@pytest.mark.parametrize("text", ["somewhere", "1, 2", "10, 95, 3", "1,,2"])
def test_what_is_wrong_with_a_region_is_said_next_to_its_field(text):
    form = {"toml": SPEC, "toml-before": SPEC, "selection.region.cone": text}
    assert list(draft_of_form(form).errors) == ["selection.region.cone"]
