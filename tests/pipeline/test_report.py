"""The report of a build: whole, the same every time, and saying what the products say."""

from __future__ import annotations

import csv
import json
import re
from base64 import b64decode
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import matplotlib.image
import numpy as np
import pytest
from drafts import spec_with

from starcat.cli.databases import histogram
from starcat.database.products.coverage import coverage_from_counts
from starcat.database.products.evenness import Evenness
from starcat.database.reader import DatabaseFolder, open_database_folder
from starcat.geometry.sphere import directions_from_radec, saff_kuijlaars
from starcat.pipeline.build import build
from starcat.pipeline.report.coverage_map import (
    HALF_HEIGHT,
    HALF_WIDTH,
    nearest_raster,
    project_sky,
)
from starcat.pipeline.report.page import table
from starcat.pipeline.report.plots import draw_histogram, draw_magnitudes, save_plot
from starcat.pipeline.report.report import count_magnitudes, report_coverage
from starcat.pipeline.report_data import database_coverage
from starcat.pipeline.specs.build_spec import BuildSpec

PLOTS = ["attitude_error", "coverage_histogram", "coverage_map", "stars_by_magnitude"]
FILES = {
    *(f"{name}.{kind}" for name in PLOTS for kind in ("png", "svg")),
    *(f"{name}.csv" for name in PLOTS if name != "coverage_map"),
    "coverage.csv",
    *(f"{name}.json" for name in ("coverage", "report", "self_test")),
    "index.html",
}
pytestmark = pytest.mark.usefixtures("drawn_pictures")

EVEN = Evenness(np.ones(4), np.ones(4), 1.0, 4)
VOID = {"meta", "img", "br", "hr", "link", "input"}


@pytest.fixture(scope="module")
def spec(small_spec: str) -> BuildSpec:
    """SAO to V = 5.5 in 300 fields of 20 deg."""
    return spec_with(
        small_spec,
        name="report",
        version="1.2.3",
        description="for <tests> & nothing else",
        selection={"faint_limit_mag": 5.5, "max_stars_per_field": 12},
        camera={"fov_x_deg": 20.0},
        boresights={"count": 300},
        self_test={"min_identified": 0.0},
    )


@pytest.fixture(scope="module")
def database(
    spec: BuildSpec, catalogs: Path, tmp_path_factory: pytest.TempPathFactory
) -> DatabaseFolder:
    folder = tmp_path_factory.mktemp("report")
    return open_database_folder(
        build(spec, folder, inputs={"sao": [catalogs / "sao.dat.gz"]}).folder
    )


@pytest.fixture(scope="module")
def report(database: DatabaseFolder) -> dict[str, Any]:
    content = json.loads((database.folder / "report" / "report.json").read_bytes())
    assert isinstance(content, dict)
    return content


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


# Files --------------------------------------------------------------------------------------


def test_all_files_are_there_and_in_the_manifest(database):
    folder = database.folder / "report"
    assert {path.name for path in folder.iterdir()} == FILES
    assert {f"report/{name}" for name in FILES} <= set(database.manifest["files"])


@pytest.mark.parametrize("name", PLOTS)
def test_plots_open_and_are_small(name, database):
    png, svg = (database.folder / "report" / f"{name}.{kind}" for kind in ("png", "svg"))
    image = matplotlib.image.imread(png)
    assert image.shape[1] > image.shape[0] > 300
    # Something is drawn, and the background is opaque and white.
    assert len(np.unique((image * 255).astype(np.uint8).view(np.uint32))) > 20
    assert image[0, 0].tolist() == [1.0, 1.0, 1.0, 1.0]
    assert png.stat().st_size < 150_000
    assert svg.stat().st_size < 400_000
    assert ElementTree.parse(svg).getroot().tag.endswith("svg")
    assert not re.search(r'(href|src)="(?!#|data:)', svg.read_text())
    assert b"Software" not in png.read_bytes()
    assert b"tIME" not in png.read_bytes()
    assert "date" not in svg.read_text()[:2000]


# What they say ------------------------------------------------------------------------------


def test_csv_says_what_the_product_says(database, report):
    rows = rows_of(database.folder / "report" / "coverage.csv")
    product = database.table("boresights").to_pylist()
    assert [int(row["boresight"]) for row in rows] == list(range(300))
    assert [int(row["stars"]) for row in rows] == [row["star_count"] for row in product]
    for name in ("ra_deg", "dec_deg"):
        found = np.array([float(row[name]) for row in rows])
        assert np.allclose(found, [row[name] for row in product], atol=5.1e-7, rtol=0)
    for row in rows:
        stars = int(row["stars"])
        most = min(stars, 8)
        assert int(row["pairs"]) == stars * (stars - 1) // 2
        assert int(row["triangles"]) == most * (most - 1) * (most - 2) // 6
    # Triangles of all fields, repeats included, are what the product has seen.
    seen = sum(database.table("triangles")["times_seen"].to_pylist())
    assert sum(int(row["triangles"]) for row in rows) == seen
    coverage = report["coverage"]
    worst = min(rows, key=lambda row: int(row["stars"]))
    assert coverage["worst_field"]["boresight"] == int(worst["boresight"])
    assert coverage["worst_field"]["ra_deg"] == pytest.approx(float(worst["ra_deg"]), abs=1e-6)
    assert coverage["stars"]["minimum"] == coverage["worst_field"]["stars"] == int(worst["stars"])


def test_histograms_add_up(database, report):
    folder = database.folder / "report"
    rows = rows_of(folder / "coverage_histogram.csv")
    fields = [int(row["fields"]) for row in rows]
    assert fields == report["coverage"]["fields_by_stars"]
    assert sum(fields) == 300
    stars = sum(database.table("boresights")["star_count"].to_pylist())
    assert sum(n * count for n, count in enumerate(fields)) == stars
    rows = rows_of(folder / "stars_by_magnitude.csv")
    kept, rejected = (sum(int(row[name]) for row in rows) for name in ("guide_stars", "rejected"))
    assert kept == report["sources"][0]["kept"]
    assert kept + rejected == report["sources"][0]["rows_read"]
    edges = [(float(row["from_mag"]), float(row["to_mag"])) for row in rows]
    assert all(a[1] == b[0] for a, b in pairwise(edges))
    # The faint limit belongs to the guide stars, and no fainter bin has any.
    assert [int(row["guide_stars"]) > 0 for row in rows if float(row["to_mag"]) >= 5.5] == [
        float(row["to_mag"]) == 5.5 for row in rows if float(row["to_mag"]) >= 5.5
    ]


def test_json_says_what_the_manifest_says(database, report):
    manifest, folder = database.manifest, database.folder / "report"
    for key in ("name", "version", "spec", "sources", "software", "frame", "epoch_jyear"):
        assert report[key] == manifest[key], key
    for name, facts in manifest["products"].items():
        assert report["products"][name]["content_sha256"] == facts["content_sha256"]
        assert report["products"][name]["rows"] == facts["rows"]
        assert report["products"][name]["bytes"] == manifest["files"][facts["parquet"]]["bytes"]
    assert report["database_bytes"] == manifest["files"]["database.h5"]["bytes"]
    assert report["self_test"] == json.loads((folder / "self_test.json").read_bytes())
    assert report["coverage"] == json.loads((folder / "coverage.json").read_bytes())
    assert report["filters"][-1]["stars"] == report["products"]["stars"]["rows"]
    assert set(report["reasons"]) == set(report["sources"][0]["rejected"]) >= {"density"}


class Page(HTMLParser):
    """The structure of a page: its tables, what it loads, and whether tags match."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag not in {"script", "link", "iframe", "object", "base"}
        self.loads += [str(value) for name, value in attrs if name in {"src", "href", "srcset"}]
        if tag == "img":
            assert dict(attrs).get("alt")
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in {"td", "th"}:
            self.tables[-1][-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data
        if self.open and self.open[-1] in {"td", "th"}:
            self.tables[-1][-1][-1] += data


@pytest.fixture(scope="module")
def page(database: DatabaseFolder) -> Page:
    page = Page()
    page.feed((database.folder / "report" / "index.html").read_text(encoding="utf-8"))
    page.close()
    return page


def test_the_page_needs_nothing_else(page, database):
    text = (database.folder / "report" / "index.html").read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>\n<html lang=")
    assert page.open == []
    assert not [word for word in ("http:", "https:", "url(", "@import") if word in text]
    kind = "data:image/svg+xml;base64,"
    assert [source[: len(kind)] for source in page.loads] == [kind] * len(PLOTS)
    drawn = {b64decode(source[len(kind) :]) for source in page.loads}
    assert drawn == {(database.folder / "report" / f"{name}.svg").read_bytes() for name in PLOTS}


def test_the_page_says_what_the_json_says(page, report):
    def rows(heading: str) -> dict[str, list[str]]:
        found = next(t for t in page.tables if t[0][0] == heading)
        return {row[0]: row[1:] for row in found[1:]}

    products = rows("product")
    for name, facts in report["products"].items():
        assert products[name] == [
            facts["schema"], f"{facts['rows']:,}", f"{facts['bytes']:,}", facts["content_sha256"]
        ]  # fmt: skip
    verdicts = rows("verdict")
    (source,) = report["sources"]
    assert verdicts["read"][1] == f"{source['rows_read']:,}"
    for reason, count in source["rejected"].items():
        assert verdicts[reason] == [report["reasons"][reason], f"{count:,}"]
    (file,) = rows("file").values()
    assert file[2] == source["files"][0]["sha256"]
    assert [row[0] for row in rows("after").values()] == [
        f"{step['stars']:,}" for step in report["filters"]
    ]
    coverage = rows("in a field")
    for kind in ("stars", "pairs", "triangles"):
        spread = report["coverage"][kind]
        assert coverage[kind][0] == f"{spread['minimum']:,}"
        assert coverage[kind][1] == f"{spread['one_percent']:,}"
        assert coverage[kind][3:] == [f"{spread['mean']:,.1f}", f"{spread['maximum']:,}"]
    rates = rows("fields")
    for rate in report["self_test"]:
        assert rates[rate["name"]][-1] == f"{rate['identified_share']:.2%}"
    assert report["description"] in page.text
    assert '"max_stars_per_field": 12' in page.text
    assert ["camera", "512 x 512 px, 20 x 20 deg"] in page.tables[0]


def test_the_page_and_its_plots_turn_dark(database):
    """Paper, ink and grid of a light drawing have other colours in the dark drawing."""
    folder, dark = database.folder / "report", "@media (prefers-color-scheme: dark)"
    assert dark in (folder / "index.html").read_text(encoding="utf-8")
    for name in PLOTS:
        text = (folder / f"{name}.svg").read_text(encoding="utf-8")
        style, drawn = text.split("</style>", 1)
        assert dark in style
        for colour in ("fill: #ffffff", "stroke: #000000", "stroke: #e3e7ea", "fill: #2c6e9e"):
            assert colour not in drawn or f'[style*="{colour}"]' in style, (name, colour)


def test_a_table_escapes_texts_and_breaks_digests() -> None:
    digest = "0123456789abcdef" * 4
    assert f'<td class="digest">{digest}</td>' in table("", ("x",), [(digest,)])
    assert "<thead>" not in table("", ("", ""), [("a", "b")])
    assert "<td>a&lt;b</td>" in table("", ("x",), [("a<b",)])
    assert "1,234,567" in table("", ("x",), [(1234567,)], (0,))


# Parts --------------------------------------------------------------------------------------


def test_a_magnitude_at_an_edge_belongs_to_the_brighter_bin():
    counts = count_magnitudes(np.array([5.0, 5.01, 5.5]), np.array([6.0, np.nan, -1.2]))
    table = zip(counts["to_mag"], counts["guide_stars"], counts["rejected"], strict=True)
    filled = [(-1.0, 0, 1), (5.0, 1, 0), (5.5, 2, 0), (6.0, 0, 1)]
    assert [row for row in table if row[1] or row[2]] == filled


def test_no_magnitudes_are_no_bins(tmp_path):
    counts = count_magnitudes(np.array([]), np.array([np.nan]))
    assert counts == {"from_mag": [], "to_mag": [], "guide_stars": [], "rejected": []}
    save_plot(draw_magnitudes("none", "V", counts), tmp_path, "none")
    assert (tmp_path / "none.png").is_file()


def test_the_map_is_of_equal_area():
    """Bands of declination of the same area take the same share of the ellipse."""
    raster = nearest_raster(saff_kuijlaars(2000), 400)
    inside = raster >= 0
    assert inside.mean() == pytest.approx(np.pi / 4.0, abs=1e-3)
    # Boresights go from south to north in steps of the same area.
    share = np.histogram(raster[inside], bins=10, range=(0, 2000))[0] / inside.sum()
    assert np.abs(share - 0.1).max() < 0.01


def test_the_raster_is_where_the_projection_says():
    generator = np.random.default_rng(3)
    ra_deg, dec_deg = generator.uniform(0.0, 360.0, 50), generator.uniform(-85.0, 85.0, 50)
    raster = nearest_raster(directions_from_radec(ra_deg, dec_deg), 1200)
    x, y = project_sky(ra_deg, dec_deg)
    column = np.floor((x / HALF_WIDTH + 1.0) * 600).astype(int)
    row = np.floor((1.0 - y / HALF_HEIGHT) * 300).astype(int)
    assert np.array_equal(raster[row, column], np.arange(50))
    x, y = project_sky([0.0, 123.0], [90.0, -90.0])
    assert np.allclose(x, 0.0, atol=1e-4)
    assert np.allclose(y, [HALF_HEIGHT, -HALF_HEIGHT])


@pytest.mark.parametrize("counts", [[0, 0, 0, 0], [3, 3, 3, 3], [1, 900, 4, 250]])
def test_histograms_of_any_counts_are_drawn(counts, tmp_path):
    coverage = coverage_from_counts(saff_kuijlaars(4), np.array(counts), 6)
    made = report_coverage(coverage, 0.1, EVEN)
    rows = histogram(made)
    assert sum(int(row["fields"]) for row in rows) == 4
    assert len(rows) <= 20
    assert str(rows[0]["stars_in_a_field"]).split("-")[0] == str(min(counts))
    assert max(len(str(row[""])) for row in rows) == 50
    save_plot(draw_histogram("any", made.summary), tmp_path, "any")
    assert matplotlib.image.imread(tmp_path / "any.png").shape[1] == 720


def test_drawing_leaves_the_users_settings_alone(tmp_path):
    with matplotlib.rc_context({"font.size": 23.0}):
        before = dict(matplotlib.rcParams)
        made = report_coverage(coverage_from_counts(saff_kuijlaars(4), np.arange(4), 6), 0.1, EVEN)
        save_plot(draw_histogram("any", made.summary), tmp_path, "any")
        assert dict(matplotlib.rcParams) == before


# Command line -------------------------------------------------------------------------------


def test_coverage_prints_the_summary(starcat, database, report):
    run = starcat(["coverage", database.folder])
    assert (run.code, run.err) == (0, "")
    assert all(len(line) <= 100 for line in run.out.splitlines())
    for words in ("coverage", "300", "triangles", "worst field stars", "#####", "boresight"):
        assert words in run.out
    run = starcat(["coverage", database.folder, "--json"])
    assert json.loads(run.out) == report["coverage"] == database_coverage(database).as_dict()


def test_coverage_writes_the_files_of_the_report(starcat, database, tmp_path):
    run = starcat(["coverage", database.folder, "-o", tmp_path / "new" / "folder"])
    assert run.code == 0
    made = {path.name for path in (tmp_path / "new" / "folder").iterdir()}
    assert made == {name for name in FILES if name.startswith(("attitude", "coverage"))}
    for name in made:
        again = (tmp_path / "new" / "folder" / name).read_bytes()
        assert again == (database.folder / "report" / name).read_bytes(), name
        assert name in run.err


def test_times_stand_beside_the_database(database):
    path = database.folder.with_name("report-1.2.3.build.json")
    log = json.loads(path.read_bytes())
    assert log["artifact"] == "report-1.2.3"
    stages = set(log["times_s"]) - {"total"}
    assert stages == {"read", "select", "products", "write", "self-test", "report", "verify"}
    assert sum(log["times_s"][stage] for stage in stages) == pytest.approx(
        log["times_s"]["total"], abs=1e-3
    )
    assert log["peak_memory_bytes"] > 10_000_000
    assert log["software"] == database.manifest["software"]
    assert path.name not in database.manifest["files"]
    assert sorted(p.name for p in database.folder.parent.iterdir()) == [
        "report-1.2.3",
        "report-1.2.3.build.json",
    ]
