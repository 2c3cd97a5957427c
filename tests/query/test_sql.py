"""`starcat sql`: targets, views, the gallery, the formats of answers."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from table_formats import check_read

from starcat.database.reader import open_database_folder
from starcat.errors import ProductError, QueryError, SchemaVersionError
from starcat.query.gallery import gallery, guessed, named_query
from starcat.query.names import identifier
from starcat.query.session import Session, open_session
from starcat.ship.exchange.formats import format_of

HEAVY = {"numpy", "pyarrow", "pandas", "astropy", "scipy", "matplotlib", "h5py", "duckdb"}
"""Loaded by no query: DuckDB is loaded by the process that runs it, while this one starts."""


@pytest.fixture(scope="module")
def session(small_database: Path) -> Iterator[Session]:
    with open_session([str(small_database)]) as opened:
        yield opened


@pytest.fixture(scope="module")
def both(small_database: Path, database_version: Callable[[str], Path]) -> Iterator[Session]:
    """Two versions of the database."""
    with open_session([str(small_database), str(database_version("1.1.0"))]) as opened:
        yield opened


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory, sao_lines: list[bytes]) -> Path:
    path = tmp_path_factory.mktemp("archive") / "sao.dat"
    path.write_bytes(b"".join(sao_lines))
    return path


def rows(session: Session, text: str, **values: Any) -> list[tuple[Any, ...]]:
    with session.ask(text, values) as answer:
        return answer.rows(100_000)


def asked(session: Session, name: str, **values: str) -> list[tuple[Any, ...]]:
    """Return the rows of a named query."""
    query = named_query(name)
    return rows(session, query.text, **query.with_values(values))


# Targets and views ----------------------------------------------------------------------------


def test_every_product_is_a_view_with_all_its_rows(session, small_database):
    database = open_database_folder(small_database)
    for product in database.products:
        assert rows(session, f"SELECT count(*) FROM {product}") == [(len(database.table(product)),)]
        assert rows(session, f"SELECT count(*) FROM small.{product}")


def test_columns_are_described_with_their_units(session, small_database):
    schema = open_database_folder(small_database).schema("pairs")
    described = rows(session, "DESCRIBE pairs")
    assert [row[0] for row in described] == [column.name for column in schema.columns]
    assert [row[2:] for row in described] == [(c.unit, c.description) for c in schema.columns]


@pytest.mark.parametrize(
    "asked",
    [
        "comment FROM duckdb_columns() WHERE schema_name",
        '"COLUMN_COMMENT" FROM information_schema.columns WHERE table_schema',
    ],
)
def test_tables_of_duckdb_describe_columns(small_database, asked):
    with open_session([str(small_database)]) as fresh:
        text = f"SELECT column_name, {asked} = 'main' AND table_name = 'pairs'"
        comments = dict(rows(fresh, text))
    assert comments["separation_rad"].endswith("[rad]")
    assert "[" not in comments["i"]


def test_stars_have_the_number_of_their_row(session, small_database):
    table = open_database_folder(small_database).table("stars")
    assert "row" not in table.column_names
    found = rows(session, "SELECT designation, row FROM stars")
    assert [name for name, _ in sorted(found, key=lambda one: one[1])] == (
        table["designation"].to_pylist()
    )
    [(row, *_)] = rows(session, "SELECT row FROM stars WHERE star_id = 33")
    assert table["star_id"][row].as_py() == 33
    placed = rows(session, "SELECT row FROM cone(0, 0, 45) ORDER BY row")
    inside = (table["ra_deg"].to_numpy() <= 45.0) | (table["ra_deg"].to_numpy() >= 315.0)
    assert 0 < len(placed) <= inside.sum()
    assert all(inside[row] for (row,) in placed)
    described = {name: text for name, *_, text in rows(session, "DESCRIBE stars")}
    assert described["row"].startswith("Number of the row, from 0")


def test_pairs_are_joined_by_rows(session, small_database):
    database = open_database_folder(small_database)
    stars, pairs = database.table("stars"), database.table("pairs")
    names = stars["designation"].to_pylist()
    found = rows(
        session,
        "SELECT a.designation, b.designation FROM pairs JOIN stars a ON a.row = i "
        "JOIN stars b ON b.row = j ORDER BY i, j",
    )
    ends = zip(pairs["i"].to_pylist(), pairs["j"].to_pylist(), strict=True)
    assert found == [(names[i], names[j]) for i, j in sorted(ends)]


def test_units_of_an_answer_are_those_of_the_columns_and_of_the_names(session):
    text = "SELECT ra_deg, mag, mag - 1 AS other_mag, 1.5 AS x_mas_yr, 3 AS plain FROM stars"
    with session.ask(text) as answer:
        units = [column.unit for column in answer.table(1).columns]
        assert units == ["deg", "mag", "mag", "mas/yr", ""]
        assert answer.batches().schema.field("mag").metadata[b"unit"] == b"mag"


def test_several_targets_have_schemas(small_database, archive):
    given = [str(small_database), str(archive)]
    with open_session(given) as session:
        for schema in ("a", "small", "b", "sao"):
            assert rows(session, f"SELECT count(*) FROM {schema}.stars")[0][0] > 500
        assert len(rows(session, "SELECT * FROM small.stars JOIN sao.stars USING (star_id)")) > 500
        with pytest.raises(QueryError, match="stars"):
            rows(session, "FROM stars")


def test_versions_of_an_database_have_schemas_of_their_own(small_database, database_version):
    given = [small_database, database_version("1.1.0"), small_database]
    with open_session(list(map(str, given))) as session:
        names = [target.name for target in session.targets]
    assert names == ["small_1_0_0", "small_1_1_0", "small_1_0_0_2"]


def test_archives_of_another_name_are_read_with_their_rejected_rows(archive, tmp_path):
    lines = archive.read_bytes().splitlines(keepends=True)
    (tmp_path / "mine.txt").write_bytes(b"".join([b"garbage\n", *lines]))
    with open_session([f"sao={tmp_path / 'mine.txt'}"]) as session:
        assert rows(session, "SELECT count(*) FROM stars") == [(len(lines),)]
        found = rows(session, "SELECT reason, source_line FROM rejected")
    assert found == [("malformed_record", 1)]


def test_ingested_tables_are_targets(starcat, archive, tmp_path):
    assert starcat(["ingest", "sao", "--input", archive, "-o", tmp_path / "t.parquet"]).code == 0
    with open_session([str(tmp_path / "t.parquet")]) as session:
        assert session.targets[0].name == "t"
        assert [facts for _, _, facts, _ in rows(session, "DESCRIBE stars")][5] == "deg"


def test_a_folder_of_parquet_files_is_a_schema(tmp_path):
    folder = tmp_path / "My-tables"
    folder.mkdir()
    for name in ("first", "Group"):
        pq.write_table(pa.table({"a": [1, 2]}), folder / f"{name}.parquet")
    (folder / "notes.txt").write_text("not a table")
    with open_session([str(folder)]) as opened:
        assert [view.name for view in opened.views] == ["group_", "first"]
        assert rows(opened, "SELECT sum(a) FROM my_tables.group_") == [(3,)]
    elsewhere = tmp_path / "elsewhere.parquet"
    pq.write_table(pa.table({"a": [1]}), elsewhere)
    (folder / "third.parquet").symlink_to(elsewhere)
    with pytest.raises(ProductError, match="a link to"), open_session([str(folder)]):
        pass


def test_hats_catalogs_are_one_table(starcat, small_database, session, tmp_path):
    exported = ["export", small_database, "--format", "hats", "--product", "stars", "-o", tmp_path]
    assert starcat(exported).code == 0
    count = "SELECT count(*), min(ra_deg), sum(mag) FROM stars"
    with open_session([str(tmp_path / "stars")]) as opened:
        assert len(opened.views[0].paths) > 1
        assert rows(opened, count) == [pytest.approx(row) for row in rows(session, count)]


def test_no_identifier_needs_quotes():
    with duckdb.connect() as connection:
        kept = "SELECT keyword_name FROM duckdb_keywords() WHERE keyword_category != 'unreserved'"
        words = [word for (word,) in connection.execute(kept).fetchall()]
        assert len(words) > 100
        for word in (*words, "2MASS 8x6", "a.b-c", "", "Ä", "main", "Temp"):
            name = identifier(word)
            assert name.isidentifier()
            short = word.strip("_")
            assert word not in words or name in (word, f"{word}_", short, f"{short}_")
            connection.execute(f"CREATE SCHEMA IF NOT EXISTS {name}")
            connection.execute(f"CREATE OR REPLACE VIEW {name} AS SELECT 1 AS one")
            connection.execute(f"CREATE OR REPLACE VIEW {name}.{name} AS SELECT 2 AS two")
            query = f"SELECT {name}.one, b.two FROM {name}, {name}.{name} AS b WHERE {name}.one = 1"
            assert connection.execute(query).fetchall() == [(1, 2)]


def tables_named(folder: Path, *names: str) -> list[str]:
    """Write tables of one row, which has the number of the table; return their files."""
    for number, name in enumerate(names):
        pq.write_table(pa.table({"n": [number]}), folder / f"{name}.parquet")
    return [str(folder / f"{name}.parquet") for name in names]


def test_parquet_files_of_others_are_tables_of_their_name(tmp_path):
    given = tables_named(tmp_path, "group", "order", "a", "My Table")
    for one, name in ((given[0], "group_"), (given[3], "my_table")):
        with open_session([one]) as session:
            assert rows(session, f"SELECT n FROM {name}") == [(given.index(one),)]
    with open_session(given) as session:
        joined = "SELECT group_.n, order_.n, a_.n FROM group_.group_, b.order_, a_.a AS a_"
        assert rows(session, joined) == [(0, 1, 2)]
        assert rows(session, "SELECT n FROM a.group_") == [(0,)], "a is the first target"


def test_more_targets_than_letters(tmp_path):
    with open_session(tables_named(tmp_path, *(f"t{k}" for k in range(30)))) as session:
        found = rows(session, "SELECT z.t25.n, ad.t29.n, t7.t7.n FROM z.t25, ad.t29, t7.t7")
        assert found == [(25, 29, 7)]


def with_footer_beyond(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-8] + b"\xff\xff\xff\x0fPAR1")


def led_away(path: Path) -> None:
    path.unlink()
    path.symlink_to("/etc/passwd")


def renamed(path: Path, name: str = "pairs", **change: str) -> None:
    """Change the product of a file in the manifest."""
    manifest = json.loads((path.parent / "manifest.json").read_text())
    manifest["products"][name] = manifest["products"].pop("pairs") | change
    (path.parent / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (with_footer_beyond, ProductError),
        (Path.unlink, ProductError),
        (led_away, ProductError),
        (lambda path: renamed(path, parquet="../../secret.parquet"), ProductError),
        (lambda path: renamed(path, "x; DROP VIEW stars"), ProductError),
        (lambda path: renamed(path, schema="pairs-9.0.0"), SchemaVersionError),
    ],
)
def test_damaged_databases_are_reported(database_copy, damage, expected):
    damage(database_copy / "pairs.parquet")
    with pytest.raises(expected, match=r"pairs|small"), open_session([str(database_copy)]):
        pass


# The gallery ----------------------------------------------------------------------------------


@pytest.mark.parametrize("query", gallery().values(), ids=gallery())
def test_every_named_query_answers(query, session, both):
    asked = both if query.targets == 2 else session
    with asked.ask(query.text, query.with_values({})) as answer:
        found = answer.rows(1000)
        assert answer.columns
    needs_none = {"rejected-near", "changed-stars", "star", "near-equal-pairs"}
    needs_none |= {"blends", "position-errors", "rejected-stars"}  # of stars without them
    assert found or query.name in needs_none
    assert query.help.endswith(".")
    assert {value.name for value in query.values} == set(re.findall(r"\$(\w+)", query.text))


def test_the_values_of_a_named_query_have_its_types():
    query = named_query("crossmatch")
    given = query.with_values({"radius_arcsec": "3"})
    assert given == {"radius_arcsec": 3.0, "epoch_jyear": 2000.0}
    assert named_query("star").with_values({"designation": "007"}) == {"designation": "007"}
    assert named_query("closest-pairs").with_values({"count": "007"}) == {"count": 7}
    with pytest.raises(QueryError, match="no value 'radius'; it has: radius_arcsec"):
        query.with_values({"radius": "1"})


def test_only_plain_numbers_are_numbers_where_no_type_is_declared():
    for text in ("007", "1_000", "nan", "inf", "+5", "٧", "７", " 7", "0x1F", "1e9999"):
        assert guessed(text) == text
    for text, value in {"7": 7, "-0.5": -0.5, "0": 0, "1e-3": 0.001, ".5": 0.5}.items():
        assert guessed(text) == value
        assert type(guessed(text)) is type(value)


def test_a_value_keeps_its_zeros(starcat, small_database):
    query = "SELECT $a AS a, typeof($a) AS text, $b AS b, typeof($b) AS number"
    given = ["--set", "a=007", "--set", "b=7", "--format", "csv"]
    run = starcat(["sql", small_database, query, *given])
    assert run.out.splitlines()[1] == '"007","VARCHAR",7,"INTEGER"'


def test_emptiest_fields_are_those_of_the_boresights(session, small_database):
    counts = np.sort(
        open_database_folder(small_database).table("boresights")["star_count"].to_numpy()
    )
    for name, expected in (("emptiest-fields", counts), ("densest-fields", counts[::-1])):
        found = asked(session, name, count="7")
        assert [row[3] for row in found] == expected[:7].tolist()


def test_near_equal_pairs_are_those_of_numpy(session, small_database):
    table = open_database_folder(small_database).table("pairs")
    gaps = 3600 * np.degrees(np.diff(table["separation_rad"].to_numpy()))
    found = asked(session, "near-equal-pairs", difference_arcsec="20", count="5")
    assert np.allclose([row[3] for row in found], np.sort(gaps)[:5], rtol=1e-6)


def test_the_cells_of_the_sky_hold_all_stars(session, small_database):
    found = asked(session, "sky-density", cell_order="1", count="48")
    assert len(found) == 48
    assert sum(row[1] for row in found) == len(open_database_folder(small_database).table("stars"))


def test_what_changed_between_versions(archive, small_database, tmp_path):
    table = open_database_folder(small_database).table("stars")
    changed = table
    for name, row, more in (("mag", 5, 0.5), ("dec_deg", 7, 1e-5)):
        values = table[name].to_numpy().copy()
        values[row] += more
        place = table.column_names.index(name)
        changed = changed.set_column(place, table.schema.field(name), pa.array(values))
    pq.write_table(table.slice(1), tmp_path / "old.parquet")
    pq.write_table(changed.slice(0, len(table) - 2), tmp_path / "new.parquet")
    with open_session([str(tmp_path / "old.parquet"), str(tmp_path / "new.parquet")]) as session:
        found = asked(session, "changed-stars")
    names = table["designation"].to_pylist()
    expected = [("came", names[0]), ("magnitude", names[5]), ("moved", names[7]),
                ("went", names[-2]), ("went", names[-1])]  # fmt: skip
    assert [row[:2] for row in found] == expected
    assert found[2][4] == pytest.approx(36.0, rel=1e-6)


def test_stars_of_two_tables_are_matched_by_place(session, both):
    found = asked(both, "crossmatch", radius_arcsec="36000")
    [(count,)] = rows(session, "SELECT count(*) FROM stars")
    [(near,)] = rows(session, "SELECT count(*) FROM stars a JOIN stars b ON separation(a.ra_deg, "
                              "a.dec_deg, b.ra_deg, b.dec_deg) <= 10")  # fmt: skip
    assert len(found) == near > count
    assert sum(row[0] == row[2] and row[4] == 0.0 for row in found) == count


# Files of answers -----------------------------------------------------------------------------

QUERY = "SELECT star_id, designation, mag, ra_deg, hip_number FROM stars ORDER BY mag LIMIT 7"


def test_a_table_fits_and_has_its_units(starcat, small_database):
    run = starcat(["sql", small_database, QUERY])
    assert run.code == 0
    assert re.findall(r"\[\w+\]", run.out) == ["[mag]", "[deg]"]
    assert len(run.out.splitlines()) == 9


def test_wide_answers_stand_one_row_below_the_other(starcat, small_database):
    run = starcat(["sql", small_database, "FROM stars", "--rows", "2"])
    assert all(len(line) <= 100 for line in run.out.splitlines())
    assert "row 2" in run.out
    assert "row 3" not in run.out
    assert "the first 2 rows" in run.err


def test_text_goes_to_the_terminal(starcat, small_database):
    run = starcat(["sql", small_database, QUERY, "--format", "json"])
    assert (run.code, len(json.loads(run.out))) == (0, 7)
    assert run.out == starcat(["sql", small_database, QUERY, "--json"]).out


@pytest.mark.parametrize("suffix", ["vot", "parquet"])
def test_files_have_the_same_values_and_units(starcat, session, small_database, tmp_path, suffix):
    path = tmp_path / f"answer.{suffix}"
    run = starcat(["sql", small_database, QUERY, "-o", path])
    assert (run.code, run.out) == (0, "")
    with session.ask(QUERY) as answer:
        check_read(answer.batches().read_all(), path, format_of(path))


STOPS = (
    "SELECT CASE WHEN range < 900000 THEN range ELSE error('no more') END AS n FROM range(2000000)"
)
LASTS = "SELECT range AS n FROM range(100000000000) WHERE range < 200000"


@pytest.mark.parametrize(
    ("query", "limit_s", "code", "words"),
    [(STOPS, 60, 2, "no more"), (LASTS, 0.3, 1, "stopped after")],
)
def test_an_answer_that_stops_halfway_leaves_no_file(
    starcat, small_database, tmp_path, query, limit_s, code, words
):
    path = tmp_path / "answer.csv"
    run = starcat(["sql", small_database, query, "-o", path, "--time-limit-s", limit_s])
    assert run.code == code
    assert words in run.err
    assert not list(tmp_path.iterdir())


def test_the_lists(starcat, small_database):
    for arguments, found in (
        (["--list"], "densest-fields"),
        (["--macros"], "FROM cone(ra, dec, radius"),
        ([small_database, "--views"], "triangles"),
    ):
        shown = starcat(["sql", *arguments]).out
        assert found in shown
        assert all(len(line) <= 100 for line in shown.splitlines())
        assert json.loads(starcat(["sql", *arguments, "--json"]).out)


def test_the_preamble_gives_any_duckdb_the_same_views(starcat, small_database, session):
    text = starcat(["sql", small_database, "--preamble"]).out
    count = "SELECT count(*) FROM cone(10, 20, 30)"
    with duckdb.connect() as connection:
        connection.execute(text)
        assert connection.execute(count).fetchall() == rows(session, count)


@pytest.fixture
def ask_stdin(starcat, small_database, monkeypatch):
    """The command with a text at its standard input."""

    def ask(text: str, *arguments: object):
        monkeypatch.setattr(sys, "stdin", io.StringIO(text))
        return starcat(["sql", small_database, *arguments])

    return ask


def test_a_query_comes_from_stdin(ask_stdin):
    run = ask_stdin("SELECT 1 AS one;\nSELECT ';' AS two", "--format", "csv")
    assert (run.code, run.err, run.out) == (0, "", '"one"\n1\n"two"\n";"\n')
    run = ask_stdin("SELECT 1 AS one", "-", "--format", "csv")
    assert (run.code, run.err, run.out) == (0, "", '"one"\n1\n')
    run = ask_stdin("SELEC 1; SELECT 2")
    assert (run.code, run.out) == (2, "")
    assert run.err.startswith("starcat: error: no valid SQL")


@pytest.mark.parametrize("query", ["", "  ", "-", None], ids=["empty", "blanks", "stdin", "none"])
def test_a_query_without_words_is_reported(ask_stdin, query):
    run = ask_stdin("", *([] if query is None else [query]))
    assert (run.code, run.out) == (2, "")
    assert run.err == 'starcat: error: the query is empty; try "SELECT count(*) FROM stars"\n'


@pytest.mark.parametrize(
    ("query", "argument"),
    [
        ("SELECT * FROM cone('5h35m', -5, 5)", "ra of cone() is '5h35m'"),
        ("SELECT * FROM cone(83, dec := '-5d', radius := 5)", "dec of cone() is '-5d'"),
        ("SELECT * FROM box(1, 2, $value, 4)", "dec_min of box() is '5h35m'"),
        (
            "FROM stars WHERE separation(ra_deg, dec_deg, '5h', 1) < 1",
            "ra2 of separation() is '5h'",
        ),
        ("FROM crossmatch('stars', 'stars', '1 arcsec')", "radius_arcsec of crossmatch()"),
        ("EXPLAIN SELECT in_moc('x', 1, '0/1')", "ra of in_moc() is 'x'"),
    ],
)
def test_a_text_in_the_place_of_an_angle_is_reported(session, query, argument):
    with pytest.raises(QueryError) as told:
        rows(session, query, value="5h35m")
    assert str(told.value).startswith(argument)
    assert str(told.value).endswith("expected a number. Angles are in degrees: 5h 35m are 83.75")


def test_texts_of_numbers_are_angles(session):
    query = "SELECT count(*) FROM cone({}, -5, 5)"
    expected = rows(session, query.format("83.75"))
    assert rows(session, query.format("'83.75'")) == expected
    assert rows(session, query.format("$ra"), ra="83.75") == expected


def test_one_row_is_one_row(starcat, small_database, tmp_path):
    for count, told in ((1, "1 row"), (2, "2 rows")):
        target = tmp_path / f"{count}.csv"
        run = starcat(["sql", small_database, f"FROM stars LIMIT {count}", "-o", target])
        assert run.err == f"{target}: {told}\n"


def test_two_answers_do_not_share_a_file(ask_stdin, tmp_path):
    run = ask_stdin("SELECT 1; SELECT 2", "-o", tmp_path / "a.csv")
    assert run.code == 2
    assert "2 queries for one file" in run.err
    assert not (tmp_path / "a.csv").exists()


def test_a_query_loads_nothing_heavy(small_database):
    code = (
        "import sys\nsys.argv = ['starcat', 'sql', sys.argv[1], 'SELECT 1']\n"
        "from starcat.cli.main import main\ntry:\n    main()\nexcept SystemExit:\n    pass\n"
        "print(*{name.split('.')[0] for name in sys.modules})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(small_database)], capture_output=True, text=True,
        check=True, timeout=50,
    )  # fmt: skip
    loaded = set(done.stdout.split())
    assert done.stderr == ""
    assert loaded & HEAVY == {"duckdb"}


def test_the_progress_of_a_query_is_reported(session):
    events: list[tuple[str, int, int | None]] = []
    text = "SELECT sum(sin(range)) FROM range(40000000)"
    with session.ask(text, progress=lambda *event: events.append(event)) as answer:
        answer.rows(1)
    assert events
    assert {(stage, total) for stage, _, total in events} == {("query", 100)}
    done = [done for _, done, _ in events]
    assert done == sorted(done)
