"""The public face: few names, imported when used, strings for paths, one line to look at."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from programs import ONLY_NUMPY_AND_H5PY, printed_by

import starcat
from starcat.cli import REFERENCE
from starcat.errors import ConfigError, QueryError, StarcatError
from starcat.frames.images.render import write_simulated

ROOT = Path(__file__).parents[2]
PUBLIC = [
    "BatchResult", "BodyInFrame", "BuildSpec", "Built", "CalibratedFrame", "Calibration",
    "Camera", "Connection", "CoverageReport", "Database", "Difference", "Distortion",
    "Expected", "Exported", "ExportedImage", "ExportedSolver", "Fit", "FrameShape",
    "IdentifyOptions", "Ingested",
    "Learnt", "Limits", "MatchResult", "MatchedStars", "Matcher", "MatcherDatabase",
    "MeasuredFrame", "Observer", "Plan", "Published", "Pulled", "QueryResult", "Refusal",
    "Settings", "SimulatedFrame", "SkyInTime", "StageOfLimits", "StarcatError", "Starter",
    "Tracker", "Trial", "TriangleOrder", "Verification", "__version__", "build", "calibrate",
    "connect", "diff", "export", "identify_file", "ingest", "init", "learn", "open", "plan",
    "preset", "publish", "pull", "read_frames", "read_spec", "simulate", "sky_in_time",
    "verify", "with_planets",
]  # fmt: skip


def test_the_public_names_are_these():
    assert starcat.__all__ == PUBLIC == dir(starcat)
    assert all(getattr(starcat, name) is not None for name in PUBLIC)


def test_another_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'starcat' has no attribute 'nothing'"):
        _ = starcat.nothing


def test_importing_starcat_imports_nothing_else():
    program = (
        "import sys; before = set(sys.modules); import starcat; print(*set(sys.modules)-before)"
    )
    assert set(printed_by("-c", program).split()) <= {"starcat", "starcat.version", "__future__"}


def test_a_program_that_matches_needs_numpy_and_h5py_only(small_database):
    program = f"""{ONLY_NUMPY_AND_H5PY}
import starcat
database = starcat.open({str(small_database)!r})
print(database, starcat.Camera(64, 64, fov_x_deg=10.0))
print(database.matcher().identify([[1.0, 2.0]]).status, starcat.Matcher.open(database.folder))
"""
    assert "too_few_stars" in printed_by("-c", program)


def example() -> str:
    """Return the example that docs/python.md begins with."""
    found = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.DOTALL)
    assert found is not None
    return found[1]


def test_the_example_of_the_page_is_ten_lines():
    assert len([line for line in example().splitlines() if line.strip()]) == 10


def test_a_file_is_identified(small_database, tmp_path):
    [made] = starcat.simulate(small_database, seed=7)
    picture, two = tmp_path / "frame.png", tmp_path / "two.json"
    write_simulated(picture, made, starcat.Matcher.open(small_database).database.camera, 7)
    matcher = starcat.Matcher.open(small_database)
    found = starcat.identify_file(matcher, picture)
    assert np.abs(found.matrix @ made.matrix.T - np.eye(3)).max() < 1e-3
    [read] = starcat.read_frames(picture)
    assert len(read.centroids_px) == len(found.star_index)
    two.write_text(json.dumps({"frames": [{"centroids_px": [[1, 2]]}] * 2}))
    with pytest.raises(starcat.StarcatError, match="2 frames; read them with"):
        starcat.identify_file(matcher, two)


def test_mistakes_get_sentences(small_database):
    matcher = starcat.Matcher.open(small_database)
    for identify, given, words in (
        (matcher.identify, ([[1.0, 2.0]], [3.0]), "camera is of type list; expected a starcat.Cam"),
        (starcat.identify_file, (matcher, "nope.png"), r"nope\.png: no such file"),
        (matcher.identify, ("frame.csv",), "is a file; identify it with starcat.identify"),
    ):
        with pytest.raises((ConfigError, TypeError), match=words):
            identify(*given)


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("with_c", [True, False], ids=["with a compiler", "without"])
def test_the_example_runs_from_an_installed_wheel_in_an_empty_folder(tmp_path, with_c):
    if with_c and shutil.which("cc") is None:
        pytest.skip("no C compiler")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    wheel = [*pip, "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path / "wheel", ROOT]
    environment = {**os.environ, "STARCAT_WITHOUT_C": "" if with_c else "1"}
    subprocess.run(wheel, check=True, env=environment)
    (built,) = (tmp_path / "wheel").glob("*.whl")
    assert built.name.count("-abi3-") == with_c
    pages = [path.name for path in (ROOT / "docs").glob("*.md") if path.stem not in REFERENCE]
    docs = {f"starcat/docs/{name}" for name in pages}
    assert docs | {"starcat/py.typed"} <= set(zipfile.ZipFile(built).namelist())
    site, empty = tmp_path / "site", tmp_path / "empty"
    subprocess.run([*pip, "install", "--quiet", "--no-deps", "--target", site, built], check=True)
    empty.mkdir()
    program = f"import sys; sys.path.insert(0, {str(site)!r})\n{example()}\nprint(starcat.__file__)"
    program += "\nfrom starcat.matcher import c_engine\nprint(c_engine.is_compiled())"
    printed = printed_by("-I", "-c", program, cwd=empty)
    assert "<Database gaia-12deg-1.0.0: " in printed
    assert "<MatchResult" in printed
    *_, place, is_compiled = printed.splitlines()
    assert place.startswith(str(site))
    assert is_compiled == str(with_c)


def test_a_database_is_opened_looked_at_and_asked(small_database):
    database = starcat.open(str(small_database))
    assert len(database.stars) == database.manifest["products"]["stars"]["rows"]
    assert list(database.products) == list(database.manifest["products"])
    assert len(database.products["pairs"]) > 0
    assert database.spec.name == "small"
    assert database.coverage().summary.fields == database.spec.boresights.count
    assert not database.verify().findings
    assert not starcat.verify(small_database).findings
    with pytest.raises(KeyError):
        database.products["nothing"]


def test_an_answer_is_what_each_library_likes(small_database):
    found = starcat.open(small_database).sql(
        "SELECT star_id, ra_deg, mag FROM stars WHERE mag < $limit ORDER BY star_id", limit=4.0
    )
    stars = starcat.open(small_database).stars.to_pandas()
    expected = stars[stars.mag < 4.0].sort_values("star_id")
    assert found.columns == ["star_id", "ra_deg", "mag"]
    assert len(found) == len(expected) > 10
    assert found.to_pandas()["mag"].tolist() == expected["mag"].tolist()
    assert next(iter(found)) == tuple(expected.iloc[0][["star_id", "ra_deg", "mag"]])
    table = found.to_table()
    assert str(table["ra_deg"].unit) == "deg"
    assert np.array_equal(table["star_id"], expected["star_id"])
    assert found.to_arrow().schema.field("ra_deg").metadata[b"unit"] == b"deg"


def test_values_of_a_query_are_python_arguments(small_database):
    database = starcat.open(small_database)
    query = "SELECT count(*) FROM stars WHERE mag < $limit_mag"
    with pytest.raises(
        QueryError, match=r"the query has \$limit_mag; give its value with limit_mag="
    ):
        database.sql(query)
    expected = list(database.sql(query, limit_mag=4.0))
    assert list(database.sql(query, limit_mag=4.0 * u.mag)) == expected
    assert list(database.sql(query, limit_mag=np.float32(4.0))) == expected
    query = "SELECT $width_deg AS width"
    assert list(database.sql(query, width_deg=30.0 * u.arcmin)) == [(0.5,)]
    with pytest.raises(StarcatError, match=r"m: its unit is 'mag'; .* as in \$limit_mag"):
        database.sql("SELECT $m", m=3.0 * u.mag)
    with pytest.raises(StarcatError, match="width_deg: its unit is 'mag'; expected deg"):
        database.sql(query, width_deg=3.0 * u.mag)


def test_an_answer_prints_its_class_and_size(small_database):
    database = starcat.open(small_database)
    found = database.sql("SELECT 1 AS one, 2 AS two")
    assert repr(found) == "<QueryResult: 1 row of one, two>"
    assert repr(database.sql("SELECT 1 AS one WHERE false")) == "<QueryResult: 0 rows of one>"
    assert "and 1 more row<" in database.sql("FROM range(21)")._repr_html_()


def test_several_targets_are_joined(small_database):
    with starcat.connect(small_database, str(small_database)) as connection:
        found = connection.sql("SELECT count(*) FROM a.stars JOIN b.stars USING (star_id)")
    assert next(iter(found)) == (starcat.open(small_database).stars.num_rows,)


def test_a_closed_connection_says_so(small_database):
    connection = starcat.connect(small_database)
    for _ in range(2):
        connection.close()
        with pytest.raises(QueryError, match=r"^the connection is closed; open it again with"):
            connection.sql("SELECT 1")


def test_a_catalog_and_a_spec_are_read_from_strings(tmp_path, sao_file, small_spec):
    (tmp_path / "small.toml").write_text(small_spec)
    read = starcat.ingest("sao", str(sao_file))
    assert read.rows_read == 600
    built = starcat.build(
        str(tmp_path / "small.toml"), str(tmp_path), inputs={"sao": str(sao_file)}
    )
    assert built.folder == tmp_path / "small-1.0.0"
    for thing in (read, built):
        assert_one_line(repr(thing))


def assert_one_line(text: str) -> None:
    assert 10 < len(text) < 200
    assert "\n" not in text


def test_everything_public_says_what_it_is_in_one_line(small_database):
    database = starcat.open(small_database)
    matcher = database.matcher()
    answer = database.sql("SELECT * FROM stars")
    with starcat.connect(small_database) as connection:
        shown = [connection, database, database.products, database.spec, answer, matcher]
    shown += [database.coverage(), database.verify(), matcher.identify([[1.0, 2.0]])]
    for thing in (*shown, matcher.database, matcher.database.camera):
        assert_one_line(repr(thing))
    assert answer._repr_html_().count("<tr>") == 21
    assert "<td>pairs</td>" in database._repr_html_()


def test_a_star_name_is_no_html():
    import pyarrow as pa

    from starcat.query.result import QueryResult

    shown = QueryResult(pa.table({"<b>": ["<script>"]}))._repr_html_()
    assert "<script>" not in shown
    assert "<b>" not in shown


def test_pip_installs_it_by_one_name():
    from starcat.version import DISTRIBUTION

    assert f'\nname = "{DISTRIBUTION}"' in (ROOT / "pyproject.toml").read_text()
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "starcat").rglob("*.py")]
    for page in pages:
        for wrong in re.findall(r"install[^\n]*'?\bstarcat\[", page.read_text()):
            pytest.fail(f"{page.name}: {wrong} is another project's")
