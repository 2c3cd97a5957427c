"""The difference between databases: which stars came, went and moved, and why."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from typing import Any

import pyarrow.parquet as pq
import pytest
from database_copies import copied, seal

from starcat.database.diff import MOVED_ARCSEC, NOT_READ, Change, Difference, diff
from starcat.database.reader import DatabaseFolder, open_database_folder
from starcat.pipeline.build import build
from starcat.pipeline.specs.reading import spec_from_dict
from starcat.storage.schema import product_schema

Make = Callable[..., DatabaseFolder]


@pytest.fixture(scope="module")
def make(
    tmp_path_factory: pytest.TempPathFactory, sao_lines: list[bytes], small_spec: str,
) -> Make:  # fmt: skip
    """Build the small spec from some lines, with some of its keys replaced."""

    def run(lines: list[bytes] = sao_lines, **changes: Any) -> DatabaseFolder:
        folder = tmp_path_factory.mktemp("made")
        (folder / "sao.dat").write_bytes(b"".join(lines))
        content = {**tomllib.loads(small_spec), **changes}
        spec = spec_from_dict(content, "small.toml")
        return open_database_folder(
            build(spec, folder, inputs={"sao": [folder / "sao.dat"]}).folder
        )

    return run


@pytest.fixture(scope="module")
def brighter(make: Make) -> DatabaseFolder:
    """A later version with fewer stars."""
    return make(selection={"faint_limit_mag": 5.5}, version="1.1.0")


def with_text(line: bytes, place: int, text: bytes) -> bytes:
    return line[:place] + text + line[place + len(text) :]


def test_an_database_does_not_differ_from_itself(small_database):
    database = open_database_folder(small_database)
    found = diff(database, database)
    assert found.is_same
    assert not any((found.spec, found.sources, found.software, found.came, found.went, found.moved))
    assert [product.product for product in found.products] == list(database.products)
    assert all(product.is_same for product in found.products)


def test_a_brighter_limit_lets_stars_go(small_database, brighter):
    a, b = open_database_folder(small_database), brighter
    found = diff(a, b)
    assert Change("selection.faint_limit_mag", 6.0, 5.5) in found.spec
    assert {change.name for change in found.spec} == {"selection.faint_limit_mag", "version"}
    assert not found.is_same
    assert not found.came
    assert not found.moved
    rows_a, rows_b = (len(side.table("stars")) for side in (a, b))
    assert len(found.went) == rows_a - rows_b > 20
    # Stars of the two close pairs that the fainter limit made doubles may come back.
    assert {star.reason for star in found.went} == {"too_faint"}
    assert all(star.mag is not None and 5.5 < star.mag <= 6.0 for star in found.went)
    assert Change("sao kept", rows_a, rows_b) in found.sources
    back = diff(b, a)
    assert {star.star_id for star in back.came} == {star.star_id for star in found.went}
    assert {star.reason for star in back.came} == {"too_faint"}
    assert not back.went


def test_a_star_beyond_the_read_limit_of_the_other_is_said_to_be(small_database, make):
    a = open_database_folder(small_database)
    catalog = {"source": "sao", "read_limit_mag": 5.5}
    b = make(catalog=catalog, selection={"faint_limit_mag": 5.5})
    found = diff(a, b)
    # A merged star is brighter than each of its records.
    assert {star.reason for star in found.went} == {"beyond_read_limit"}
    assert all(star.mag is not None and star.mag > 5.5 for star in found.went)
    [source] = b.manifest["sources"]
    beyond = source["rejected"]["beyond_read_limit"]
    assert beyond > len(found.went) > 20
    assert source["rows_read"] == source["kept"] + sum(source["rejected"].values())
    assert len(b.table("rejected")) == sum(source["rejected"].values()) - beyond


def test_every_star_is_accounted_for(small_database, make, sao_lines):
    """One star leaves the catalog, one fades, one shifts, one brightens, one is new.

    Another star has a new number, and is paired by its position.
    """
    lines = list(sao_lines)
    gone, faded, shifted, brighter, renumbered = 99, 199, 299, 399, 499
    lines[faded] = with_text(lines[faded], 80, b" 9.9")
    lines[brighter] = with_text(lines[brighter], 80, b" 3.1")
    dec = float(lines[shifted][193:204])
    lines[shifted] = with_text(lines[shifted], 193, f"{dec + 1e-8:+11.8f}".encode())
    new = with_text(lines[gone], 0, b"   601")
    lines.append(with_text(new, 193, f"{float(new[193:204]) + 0.001:+11.8f}".encode()))
    lines.append(with_text(lines.pop(renumbered), 0, b"   602"))
    del lines[gone]
    a, b = open_database_folder(small_database), make(lines)
    found = diff(a, b)
    assert found.paired_by_number == len(a.table("stars")) - 3  # gone, faded, renumbered
    assert found.paired_by_position == 1
    assert [(s.star_id, s.designation, s.reason) for s in found.came] == [
        (601, "SAO 601", NOT_READ)
    ]
    assert {(s.star_id, s.reason) for s in found.went} == {
        (gone + 1, NOT_READ), (faded + 1, "too_faint")
    }  # fmt: skip
    moved = {star.star_id: star for star in found.moved}
    assert moved.keys() == {shifted + 1, brighter + 1}
    assert moved[shifted + 1].moved_arcsec == pytest.approx(0.0020626, rel=1e-3)
    assert moved[shifted + 1].mag_a == moved[shifted + 1].mag_b
    assert moved[brighter + 1].moved_arcsec < MOVED_ARCSEC
    assert moved[brighter + 1].mag_b == 3.1
    assert found.spec == ()
    assert {change.name for change in found.sources} == {
        "sao file sao.dat sha256", "sao kept", "sao rejected too_faint"
    }  # fmt: skip
    assert not any(p.is_same for p in found.products if p.product != "report")


@pytest.mark.slow
@pytest.mark.parametrize("is_repeated_first", [False, True])
def test_a_repeated_record_does_not_hide_the_reason(
    small_database, make, sao_lines, is_repeated_first
):
    """A guide star has a companion in the other catalog, and one more record there."""
    star = int(open_database_folder(small_database).table("stars")["star_id"][20].as_py())
    dec = float(sao_lines[star - 1][193:204])
    near = with_text(sao_lines[star - 1], 193, f"{dec + 1e-4:+11.8f}".encode())
    companion = with_text(near, 0, b"   601")
    again = with_text(sao_lines[star - 1], 80, b" 1.1" if is_repeated_first else b" 6.0")
    lines = [*sao_lines, companion]
    lines.insert(0 if is_repeated_first else len(lines), again)
    doubles = {"faint_limit_mag": 6.0, "doubles": {"min_separation_deg": 0.05}}
    made = make(lines, selection=doubles)
    found = diff(open_database_folder(small_database), made)
    rejected = made.table("rejected").to_pylist()
    reasons = [row["reason"] for row in rejected if row["star_id"] == star]
    assert sorted(reasons) == ["double", "duplicate_record"]
    assert {s.reason for s in found.went if s.star_id == star} == {"double"}


def test_products_of_one_side(small_database, database_copy):
    def leave_out(manifest: dict[str, Any]) -> None:
        manifest["spec"]["products"]["triangles"]["enabled"] = False
        del manifest["products"]["triangles"], manifest["files"]["triangles.parquet"]

    seal(database_copy, leave_out)
    without = open_database_folder(database_copy)
    a = open_database_folder(small_database)
    found = diff(a, without)
    by_name = {product.product: product for product in found.products}
    assert by_name["triangles"].rows_a == len(a.table("triangles"))
    assert by_name["triangles"].rows_b is None
    assert [product.product for product in found.products if not product.is_same] == ["triangles"]
    assert diff(without, a).products[-1].rows_a is None
    assert found.spec == (Change("products.triangles.enabled", True, False),)


def test_stars_of_two_catalogs_are_paired_by_position(small_database):
    a, b = open_database_folder(small_database), open_database_folder(small_database)
    b.manifest["spec"]["catalog"]["source"] = "tycho2"
    b.manifest["software"]["numpy"] = "1.0"
    found = diff(a, b)
    count = len(a.table("stars"))
    assert (len(found.came), len(found.went), len(found.moved)) == (0, 0, 0)
    assert found.paired_by_number == count  # the numbers are those of the same positions
    assert [(change.name, change.b) for change in found.software] == [("numpy", "1.0")]


def test_the_command_prints_some_and_json_has_all(small_database, brighter, starcat):
    ran = starcat(["diff", small_database, brighter.folder])
    assert ran.code == 0
    found: Difference = diff(open_database_folder(small_database), brighter)
    assert f"went, the first 40 of {len(found.went)}" in ran.out
    assert ran.out.count("too_faint") == 40 + ("sao rejected too_faint" in ran.out)
    assert "selection.faint_limit_mag" in ran.out
    ran = starcat(["diff", small_database, brighter.folder, "--json"])
    content = json.loads(ran.out)
    assert (content["a"], content["b"]) == ("small-1.0.0", "small-1.1.0")
    assert len(content["went"]) == len(found.went)
    assert content["is_same"] is False
    assert starcat(["diff", small_database, small_database, "--json"]).out.count('"is_same": true')


def test_columns_of_a_newer_schema_are_reported_and_the_others_compared(small_database, tmp_path):
    """A database of 0.1.0 has the stars of 1.0.0."""
    older = copied(small_database, tmp_path)
    schema = product_schema("stars", "1.0.0").arrow_schema
    table = pq.read_table(older / "stars.parquet").select(schema.names)
    pq.write_table(table.cast(schema), older / "stars.parquet")
    told = {"schema": "stars-1.0.0", "content_sha256": "0" * 64}
    seal(older, lambda manifest: manifest["products"]["stars"].update(told))
    found = diff(open_database_folder(older), open_database_folder(small_database))
    change = {one.product: one for one in found.products}["stars"]
    assert change.content == "23 columns more, the others are the same"
    assert not change.is_same
    assert not found.moved
