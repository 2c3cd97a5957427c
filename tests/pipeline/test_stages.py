"""The stages of a build: their order, what they say that they will do, and what they share."""

import json
from pathlib import Path

import pytest
from frames import needs_c

from starcat.catalog.archives.gaia import completed_sky
from starcat.catalog.source_files import locate
from starcat.database.reader import open_database_folder
from starcat.errors import SourceMissing
from starcat.pipeline.draft import Draft, run, stage
from starcat.pipeline.finish import run_self_test
from starcat.pipeline.specs.reading import preset, preset_names, spec_of_database
from starcat.pipeline.stages import BUILD, explain
from starcat.progress import no_progress

EVERYTHING = {
    "catalog.motions": '["hipparcos"]',
    "camera.response.name": '"silicon-cmos"',
    "camera.response.photometry": '["2mass"]',
    "selection.variables.join": '["gcvs"]',
    "selection.doubles.join": '["wds"]',
    "selection.observed.colour_term": "0.01",
    "selection.max_stars_per_field": "12",
    "products.levels.enabled": "true",
    "products.crossmatch.enabled": "true",
    "products.crossmatch.catalogs": '["sao"]',
}
"""Keys with which every stage has something to do."""


@pytest.mark.parametrize("name", preset_names())
def test_stages_read_the_sources_of_a_spec(name):
    spec = preset(name)
    read = dict.fromkeys(source for each in explain(spec, {}) for source in each.reads)
    assert set(read) == set(spec.sources)
    for each in explain(spec, {}):
        assert each.does is not None or not each.reads


def test_every_stage_has_something_to_do_for_some_spec():
    spec = preset("gaia-12deg", EVERYTHING)
    stages = explain(spec, {"gcvs": [Path("there/gcvs.tsv")]})
    assert [each.name for each in stages if each.does is None] == []
    read = {source: files for each in stages for source, files in each.reads.items()}
    assert list(read) == ["gaia", "hipparcos", "gcvs", "wds", "2mass", "sao"]
    assert read["gcvs"] == ("there/gcvs.tsv",)


def test_stages_have_names_titles_and_summaries_of_their_own():
    for values in ({s.name for s in BUILD}, {s.title for s in BUILD}, {s.summary for s in BUILD}):
        assert len(values) == len(BUILD)
        assert all(values)


def test_a_build_is_explained_without_files(starcat, monkeypatch, tmp_path):
    monkeypatch.setenv("STARCAT_CATALOGS", str(tmp_path))
    asked = ["build", "--preset", "sao-12deg", "--explain", "--input", "sao=/nowhere/sao.dat"]
    shown = starcat(asked)
    assert shown.code == 0, shown.err
    lines = [line.rstrip() for line in shown.out.splitlines()]
    assert max(map(len, lines)) <= 100
    assert len([line for line in lines if line.startswith(tuple(s.title for s in BUILD))]) == 20
    assert any("amplitudes of variable stars from hipparcos" in line for line in lines)
    assert any(line.endswith("sao sao.dat") for line in lines)
    told = json.loads(starcat([*asked, "--json"]).out)
    assert [one["name"] for one in told] == [each.name for each in BUILD]
    assert told[0]["reads"] == {"sao": ["/nowhere/sao.dat"]}
    assert {one["title"]: one["does"] for one in told}["motions"] is None


def test_an_explained_build_names_the_files_that_it_finds_and_the_missing(
    starcat, monkeypatch, tmp_path
):
    monkeypatch.setenv("STARCAT_CATALOGS", str(tmp_path))
    asked = ["build", "--preset", "gaia-12deg-2026", "--explain"]
    shown = starcat(asked)
    assert shown.code == 0
    assert "gaia gaia_completed.csv" in shown.out
    assert "gaia_merged.bin" in shown.out
    assert "tycho2 (missing)" in shown.out
    for path in completed_sky():
        assert str(path.parent) in shown.err
    assert "warning: tycho2 (" in shown.err
    assert "--input tycho2=" in shown.err
    stages = explain(preset("gaia-12deg-2026"), {})
    told = {one["title"]: one for one in json.loads(starcat([*asked, "--json"]).out)}
    assert told["read catalogs"]["reads"] == {"gaia": [str(path) for path in completed_sky()]}
    assert told["motions"]["reads"] == {"tycho2": []}
    with pytest.raises(SourceMissing) as refused:
        locate("tycho2", {})
    [error] = [each.missing["tycho2"] for each in stages if each.missing]
    assert str(error) == str(refused.value) == told["motions"]["missing"]["tycho2"]


def test_what_has_nothing_to_do_is_skipped_and_notes_are_in_the_order_of_stages():
    called, events = [], []

    @stage("one", "read", lambda spec: "begin")
    def begin(draft: Draft) -> None:
        """Begin."""
        called.append("begin")

    @stage("two", "read", lambda spec: None)
    def never(draft: Draft) -> None:
        """Do nothing."""
        called.append("never")

    @stage("three", "write", lambda spec: "end", is_announced=True)
    def end(draft: Draft) -> None:
        """End, and say more of the beginning."""
        called.append("end")
        draft.note("end", "last", "", "first")
        draft.note("begin", "first")

    draft = Draft(preset("gaia-12deg"), progress=lambda *event: events.append(event))
    run(draft, (begin, never, end))
    assert called == ["begin", "end"]
    assert events == [("three", 0, None)]
    assert draft.warnings == ("first", "last")
    assert list(draft.clock.times_s) == ["read", "write", "total"]


def test_a_branch_leaves_the_draft_as_it_was():
    draft = Draft(preset("gaia-12deg"), refusals=[])
    draft.note("begin", "first")
    other = draft.branch(preset("sao-12deg"))
    other.note("begin", "second")
    other.refusals.append("never")
    other.sources.append(None)
    assert (draft.spec.name, draft.warnings) == ("gaia-12deg", ("first",))
    assert (draft.refusals, draft.sources) == ([], [])


@needs_c
def test_the_self_test_gives_the_same_rates_with_both_engines(small_database):
    # So the manifest of a build does not depend on a compiler.
    spec = spec_of_database(open_database_folder(small_database))
    by_engine = {
        engine: run_self_test(small_database, spec, no_progress, engine)
        for engine in ("numpy", "c")
    }
    assert by_engine["c"] == by_engine["numpy"]
    assert by_engine["c"][0].identified > 0
