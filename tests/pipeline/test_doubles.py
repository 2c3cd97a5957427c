"""Doubles of other sources: joined by number or place, reported if the sensor sees one star."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pyarrow as pa
import pytest
from archives import archive_records, record
from catalog_folder import bright_sky
from drafts import merged

from starcat.catalog.doubles import PairTable, join_pairs, read_wds
from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.integrity import check_download, expected_files
from starcat.catalog.joins import MATCH_ARCSEC, Keys
from starcat.catalog.source import data_source
from starcat.catalog.stars.proper_motion import Motion, propagate
from starcat.catalog.stars.star_table import floats_of, table_from_columns
from starcat.catalog.variability import join_amplitudes, read_amplitudes
from starcat.database.verify import check_database
from starcat.geometry.sphere import directions_from_radec
from starcat.pipeline.build import build
from starcat.pipeline.estimate import reading_keys
from starcat.pipeline.selection.rules.doubles import Doubles
from starcat.pipeline.selection.ruleset import Selection
from starcat.pipeline.selection.selecting import select_guide_stars
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.specs.reading import preset
from starcat.pipeline.supply import supply_doubles
from starcat.resources import resource_folder

FILES = {"hipparcos": "hip_main.dat.gz", "wds": "wds_hip.dat.gz"}

LIMIT_DEG = 10.0 / 3600.0
LIMIT = Doubles(min_separation_deg=LIMIT_DEG, max_delta_mag=3.0, join=("wds",))


def stars_of(count: int, **columns: Any) -> pa.Table:
    number = np.arange(1, count + 1)
    given: dict[str, Any] = {
        "star_id": number, "catalog": "hipparcos", "hip_number": number, "ra_deg": 10.0 * number,
        "dec_deg": 0.0 * number, "epoch_jyear": 2000.0, "mag": 5.0,
    }  # fmt: skip
    given |= dict(zip("xyz", directions_from_radec(given["ra_deg"], 0.0 * number).T, strict=True))
    return table_from_columns("stars", {**given, **columns}, count)


def pairs(*rows: tuple[int, float, float | None], places: Any = None) -> PairTable:
    """Pairs by HIP number, separation and magnitude difference."""
    hip = np.array([row[0] for row in rows])
    delta = np.array([np.nan if row[2] is None else row[2] for row in rows])
    names = np.array([f"pair{k}" for k in range(len(rows))], dtype=object)
    apart = np.array([row[1] for row in rows])
    keys = Keys({"hip_number": hip}, places)
    return PairTable("wds", (), len(rows), {}, apart, delta, names, keys)


def reasons(stars: pa.Table, table: PairTable, doubles: Doubles = LIMIT) -> list[str]:
    joined, _ = join_pairs(stars, table, doubles.min_separation_deg)
    rejected = select_guide_stars(joined, Selection(faint_limit_mag=6.0, doubles=doubles)).rejected
    found = dict(zip(rejected["star_id"].to_pylist(), rejected["reason"].to_pylist(), strict=True))
    return [found.get(number, "kept") for number in stars["star_id"].to_pylist()]


def test_a_close_pair_is_a_flagged_double():
    table = pairs((1, 10.0, 3.0), (2, 10.1, 0.0), (3, 2.0, 3.1), (4, 5.0, None), (5, 5.1, None))
    assert reasons(stars_of(6), table) == [
        "flagged_double", "kept", "kept", "flagged_double", "kept", "kept",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"flags": "ignore"}, ["kept", "kept", "kept"]),
        ({"flags": "strict"}, ["flagged_double", "kept", "flagged_double"]),
        ({"max_delta_mag": None}, ["flagged_double", "kept", "flagged_double"]),
        ({"action": "keep"}, ["kept", "kept", "kept"]),
        ({"min_separation_deg": 0.01}, ["flagged_double", "flagged_double", "kept"]),
    ],
)
def test_the_rule_of_the_spec(change, expected):
    table = pairs((1, 10.0, 3.0), (2, 20.0, 0.0), (3, 2.0, 9.0))
    assert reasons(stars_of(3), table, LIMIT.model_copy(update=change)) == expected


def test_of_several_pairs_the_most_alike_counts():
    table = pairs((1, 1.0, 8.0), (1, 5.0, 0.5), (1, 4.0, 0.5), (1, 30.0, 0.0), (2, 30.0, 0.0))
    found, count = join_pairs(stars_of(2), table, LIMIT_DEG)
    assert count == 1
    assert found["companion_separation_arcsec"].to_pylist() == [4.0, None]
    assert found["companion_delta_mag"].to_pylist() == [0.5, None]
    assert found["is_flagged_double"].to_pylist() == [True, False]
    assert found["double_flag"].to_pylist() == ["wds:pair2;wds:pair1;wds:pair0", None]


@pytest.mark.parametrize(
    ("own", "pair", "expected"),
    [
        ((5.0, 4.0), (5.6, None), "kept"),  # the same pair, whose magnitudes the catalog has
        ((5.0, 4.0), (0.3, None), "flagged_double"),  # another one
        ((None, 4.0), (0.3, None), "kept"),
        ((5.0, 1.0), (2.0, 8.0), "flagged_double"),  # its own is the more alike
        ((None, None), (2.0, 8.0), "kept"),
    ],
)
def test_what_the_catalog_says_itself(own, pair, expected):
    columns = {
        "companion_separation_arcsec": pa.array([own[0]], pa.float64()),
        "companion_delta_mag": pa.array([own[1]], pa.float64()),
        "is_flagged_double": np.array([True]),
    }
    assert reasons(stars_of(1, **columns), pairs((1, *pair))) == [expected]


def test_joining_twice_changes_nothing():
    table = pairs((1, 2.0, 1.0), (1, 3.0, None), (2, 2.0, None))
    once, _ = join_pairs(stars_of(3), table, LIMIT_DEG)
    assert join_pairs(once, table, LIMIT_DEG)[0].equals(once)


def test_a_place_is_that_of_j2000():
    moved = propagate(Motion(*(np.array([v]) for v in (80.0, 40.0, 5000.0, -4000.0))), 26.0)
    stars = stars_of(1, **vars(moved), epoch_jyear=2026.0)
    step = MATCH_ARCSEC / 3600.0
    for shift, expected in ((0.0, 1), (0.9 * step, 1), (1.1 * step, 0)):
        place = directions_from_radec([80.0], [40.0 + shift])
        assert join_pairs(stars, pairs((0, 1.0, None), places=place), LIMIT_DEG)[1] == expected
    nowhere = np.full((1, 3), np.nan)
    assert join_pairs(stars, pairs((0, 1.0, None), places=nowhere), LIMIT_DEG)[1] == 0


# The sources


def wds_file(folder: Path, *changes: dict[str, str], head: Sequence[bytes] = ()) -> Path:
    layout = data_source("wds").files[1]
    good = {
        "wds": "00057+4549", "components": "AB", "obs_first": "1876", "sep_first": "  5.2",
        "sep_last": "  6.1", "mag_first": " 8.98", "mag_second": " 9.15",
        "place": "000541.02+454843.6",
    }  # fmt: skip
    lines = [record(layout, {**good, **change}).rstrip() for change in changes]
    path = folder / "wdsweb_summ2.txt"
    path.write_bytes(b"\n".join([*head, *lines]) + b"\n")
    return path


def test_a_record_of_wds(tmp_path):
    table = read_wds([wds_file(tmp_path, {})])
    assert (table.kept, table.rejected, table.name.tolist()) == (1, {}, ["00057+4549"])
    assert table.separation_arcsec.tolist() == [6.1]
    np.testing.assert_allclose(table.delta_mag, [0.17], rtol=0, atol=1e-9)
    assert table.keys.places is not None
    ra_deg, dec_deg = 15.0 * (5 / 60 + 41.02 / 3600), 45 + 48 / 60 + 43.6 / 3600
    expected = directions_from_radec([ra_deg], [dec_deg])
    np.testing.assert_allclose(table.keys.places, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"notes": "NX"}, "deleted"),
        ({"place": ""}, "no_position"),
        ({"place": "000541.02 454843.6"}, "no_position"),
        ({"place": "000541.02+914843.6"}, "no_position"),
        ({"sep_first": "", "sep_last": " -1.0"}, "no_position"),
        ({"obs_first": ""}, "malformed_record"),
    ],
)
def test_a_record_of_wds_that_says_nothing(tmp_path, change, reason):
    table = read_wds([wds_file(tmp_path, {}, change)])
    assert (table.kept, table.rejected) == (1, {reason: 1})


def test_fields_of_wds_without_a_value(tmp_path):
    last, first, close = {"sep_last": "-1.0"}, {"sep_last": ""}, {"sep_last": "0.0"}
    blank = {"mag_second": "."}, {"mag_first": ""}
    table = read_wds([wds_file(tmp_path, last, first, close, *blank)])
    assert table.separation_arcsec.tolist() == [5.2, 5.2, 0.0, 6.1, 6.1]
    assert np.isnan(table.delta_mag).tolist() == [False, False, False, True, True]


def test_lines_before_the_first_record_of_wds(tmp_path):
    head = [b"<pre>", b"WDS        Discoverer", b""]
    path = wds_file(tmp_path, {}, {}, head=head)
    table = read_wds([path])
    assert (table.kept, table.rejected) == (2, {"malformed_record": 2})
    [expected] = expected_files(data_source("wds"))
    assert check_download(expected, path, path, url="").rows == 4


def test_the_file_of_hipparcos_stars(catalogs, expected):
    table = read_wds([catalogs / FILES["wds"]])
    kept, rejected = expected(generated=(513, {}), genuine=(22_961, {"no_position": 30}))
    assert (table.kept, table.rejected) == (kept, rejected)
    if rejected:
        sirius = table.keys.numbers["hip_number"].tolist().index(32349)
        assert (table.separation_arcsec[sirius], table.name[sirius]) == (125.7, "06451-1643")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Path]]:
    """Stars of Hipparcos-2 that do not exist, and what WDS and VSX say of them."""
    folder = tmp_path_factory.mktemp("joins")
    sky = bright_sky().where(np.arange(1500))
    varies = sky.amplitude_mag > 0
    sky = replace(
        sky,
        amplitude_mag=np.where(varies, sky.amplitude_mag + 0.3, 0),
        rho_arcsec=np.minimum(sky.rho_arcsec, 5.0),
    )
    for source in ("hipparcos2", "wds", "vsx"):
        for layout in data_source(source).files:
            lines = archive_records(source, sky)[layout.name]
            (folder / layout.file_names[0]).write_bytes(
                b"".join(line.rstrip() + b"\n" if source == "vsx" else line for line in lines)
            )
    return folder, {"sky": sky}


def test_wds_by_number_and_by_place_flag_the_same_stars(made):
    folder, _ = made
    stars = ingest_catalog("hipparcos2", [folder / "hip2.dat"], epoch_jyear=2030.0).stars
    tables = [read_wds([folder / name]) for name in ("wds_hip.dat", "wdsweb_summ2.txt")]
    by_number, by_place = (join_pairs(stars, table, LIMIT_DEG)[0] for table in tables)
    assert tables[0].kept == tables[1].kept > 50
    flags = [np.array(joined["double_flag"].to_pylist()) for joined in (by_number, by_place)]
    is_joined = [np.array([":" in (text or "") for text in each]) for each in flags]
    assert is_joined[0].sum() == tables[0].kept
    # Of two stars within an arcsecond one has the place.
    assert (is_joined[0] != is_joined[1]).sum() <= 2
    both = is_joined[0] & is_joined[1]
    assert np.allclose(floats_of(by_place, "companion_delta_mag")[both], 0.66, atol=0.011)


def test_vsx_by_place(made):
    folder, others = made
    stars = ingest_catalog("hipparcos2", [folder / "hip2.dat"], epoch_jyear=2030.0).stars
    table = read_amplitudes("vsx", [folder / "vsx.dat"])
    given = others["sky"].amplitude_mag[np.argsort(others["sky"].hip)]
    found, count = join_amplitudes(stars, table)
    own = floats_of(found, "amplitude_mag")
    # Of two stars within an arcsecond one has the place.
    known = ~np.isnan(own)
    varies = int((given > 0.0).sum())
    assert (table.kept, table.rejected) == (varies, {})
    assert min(count, (known & (given > 0.0)).sum()) >= varies - 2
    assert (np.abs(own[known] - given[known]) < 0.002).sum() >= known.sum() - 2
    assert set(found["amplitude_source"].to_pylist()) == {None, "vsx"}


@pytest.mark.parametrize(
    ("fields", "amplitude"),
    [
        ({"mag_max": " 8.100", "mag_min": " 9.300"}, 1.2),
        ({"mag_max": " 8.100", "f_min": "(", "mag_min": " 0.300"}, 0.3),
        ({"mag_max": " 8.100", "f_min": "(", "mag_min": "12.300"}, 4.2),
        ({"mag_max": " 8.100"}, None),
        ({"mag_min": " 9.300"}, None),
    ],
)
def test_amplitudes_of_vsx(tmp_path, fields, amplitude):
    layout = data_source("vsx").files[0]
    good = {"oid": 1, "var_flag": 1, "ra_deg": 10.5, "de_deg": -20.25, "var_type": "EA"}
    constant = {**good, "var_flag": 2}
    lines = [record(layout, {**one, **fields}).rstrip() for one in (good, constant)]
    (tmp_path / "vsx.dat").write_bytes(b"\n".join(lines))
    table = read_amplitudes("vsx", [tmp_path])
    expected = np.nan if amplitude is None else amplitude
    np.testing.assert_allclose(table.amplitude_mag, [expected], rtol=0, atol=1e-9)
    assert (table.flag.tolist(), table.rejected) == (["EA"], {"deleted": 1})


# The spec


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_build_of_hipparcos2_with_everything_by_place(tmp_path, made):
    folder, _ = made
    changes = {
        "catalog.source": "hipparcos2", "catalog.band": "Hp", "boresights.count": "500",
        "camera.response.name": "silicon-cmos", "epoch_jyear": "[2027.0, 2042.0]",
        "selection.doubles.join": '["wds"]', "selection.variables.join": '["vsx"]',
        "self_test.frames": "10", "self_test.min_identified": "0.0",
    }  # fmt: skip
    inputs = {name: [folder] for name in ("hipparcos2", "vsx")}
    inputs["wds"] = [folder / "wdsweb_summ2.txt"]
    built = build(preset("gaia-12deg", changes), tmp_path, inputs=inputs)
    check_database(built.folder)
    schema = json.loads((resource_folder("schemas") / "manifest-1.0.0.json").read_text())
    jsonschema.validate(built.manifest, schema)
    stars, variables, doubles = built.manifest["sources"]
    assert doubles["kept"] + sum(doubles["rejected"].values()) == doubles["rows_read"]
    assert [one["role"] for one in (variables, doubles)] == ["variability", "doubles"]
    assert min(variables["joined"], doubles["joined"]) > 50
    assert stars["rejected"]["variable"] > 0 < stars["rejected"]["flagged_double"]


def test_catalogs_are_read_again_if_other_pairs_would_count():
    joined = {"selection.doubles.join": '["wds"]'}
    wide = {"selection.doubles.min_separation_deg": "0.1"}
    keys = [reading_keys(preset("gaia-12deg", each)) for each in ({}, wide, joined, joined | wide)]
    assert keys[0] == keys[1]
    assert keys[2] != keys[3]


def test_a_source_that_knows_no_star_is_reported(ingested, catalogs):
    spec = preset("sao-12deg", {"selection.doubles.join": '["wds"]'})
    draft = merged(ingested("sao", "sao.dat.gz"), spec, {"wds": [catalogs / FILES["wds"]]})
    supply_doubles(draft)
    assert draft.sources[-1].joined == 0  # SAO has HD numbers
    assert [note[:39] for note in draft.notes["supply_doubles"]] == [
        "wds says nothing of any star of sao: a "
    ]


def test_the_key_is_recorded_only_where_it_is_used():
    plain = preset("gaia-12deg")
    assert "join" not in plain.recorded()["selection"]["doubles"]
    used = preset("gaia-12deg", {"selection.doubles.join": '["wds"]'})
    assert used.recorded()["selection"]["doubles"]["join"] == ["wds"]
    assert used.sources == ("gaia", "wds")
    assert BuildSpec.model_validate(used.recorded()) == used
