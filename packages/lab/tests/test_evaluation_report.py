"""Evaluations: rates by hand, campaigns that continue after a stop, complete reports."""

from __future__ import annotations

import csv
import html
import json
import math
import re
import shutil
import tomllib
from base64 import b64decode
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.stats import binom_conf_interval

from starcat.errors import ConfigError, ProductError
from starcat.geometry.camera import Camera
from starcat.matcher.methods.table import METHODS, Method
from starcat.pipeline.simulation.simulate import Noise
from starcat.pipeline.specs.reading import spec_from_dict
from starcat.results import to_dict
from starcat_lab import experiment
from starcat_lab import rates as rating
from starcat_lab import run as evaluate
from starcat_lab.campaign import CampaignOutcome, _measured, is_goal_reached, run_paper
from starcat_lab.commands import print_evaluation
from starcat_lab.experiment import Attitudes, Experiment, ExperimentRow, Paper, Statistic
from starcat_lab.rates import CAUSES, RULES, ExperimentRates, Share
from starcat_lab.report import files, tables
from starcat_lab.report.files import RESULTS, write_evaluation, write_reproduction
from starcat_lab.report.plots import curves, draw_rates, save_small_svg, series_of, series_order
from starcat_lab.report.tables import LONG, SHORT, rate_tables
from starcat_lab.run import Evaluation, evaluate_database, evaluate_papers, with_earlier
from starcat_lab.score import FIELDS
from starcat_lab.sweep import PARAMETERS, axis_label, plan_sweep, sweep_paper, sweep_values

FRAMES = Attitudes("random", 8)


def experiment_of(name: str, method: str = "triangle", **noise: Any) -> Experiment:
    return Experiment(name, method, FRAMES, Noise(**{"limit_mag": 6.0, **noise}))


def rows(quick: bool) -> list[ExperimentRow]:
    few = experiment_of("few", limit_mag=2.6)  # mostly frames with fewer than four stars
    row, own = partial(ExperimentRow, "A table"), "of the same experiment"
    table = [
        row("few & <far>", "small", few, "attitude", 90.0, 12.3, 99.0, 0.1, "4+"),
        row("few | again", "small", few, "two_stars", 1.5, note=own),
        row("all", "small", experiment_of("all"), "reference", goal_percent=10.0),
    ]
    curve = [
        ExperimentRow("Position noise", f"{method}, {x:g} px", "small",
            experiment_of(f"noise-{x:g}-{method}", method, noise_px=x), "starcat",
            95.0 if x == 1.0 and method == "pairs" else None, x=x)
        for method in ("triangle", "pairs") for x in (1.0, 0.0)
    ]  # fmt: skip
    return table if quick else [*curve, *table]


def statistics(databases: dict[str, Path], quick: bool) -> list[Statistic]:
    return [
        Statistic("Storage", "triangles", 1.729, "MiB", 8.2, 2.4, True, "with <K-vectors>"),
        Statistic("Storage", "records", 166_799.0, published=170_551.0),
        Statistic("Counts", "failing", 3.0, published=2.0, goal=2.0, is_lower_better=True),
    ]


PAPER = Paper(
    "S0", "a made-up paper", "Nobody 1900, Nowhere", ("small",), rows, statistics, ("one", "two"),
)  # fmt: skip


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("records")


@pytest.fixture(scope="module")
def outcome(small_database: Path, records: Path) -> CampaignOutcome:
    return run_paper(PAPER, {"small": small_database}, records, workers=1)


@pytest.fixture(scope="module")
def content(outcome: CampaignOutcome) -> dict[str, Any]:
    return outcome.as_dict()


# Rates --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("hits", "count"), [(0, 1), (49, 50), (1234, 16200)])
def test_intervals_are_wilsons(hits, count):
    low, high = binom_conf_interval(hits, count, 0.95, "wilson")
    assert Share(hits, count).interval_percent == pytest.approx((100 * low, 100 * high), abs=1e-9)
    none = Share(0, 0)
    assert math.isnan(none.percent)
    assert none.interval_percent == (0.0, 100.0)
    assert to_dict(none)["percent"] is None


REACH_PX = 3.0


def random_records(seed: int, count: int) -> list[dict[str, Any]]:
    """Records with values on both sides of every limit, and on it."""
    generator = np.random.default_rng(seed)

    def draw(*values: Any) -> Any:
        return values[generator.integers(len(values))]

    return [
        {
            **dict.fromkeys(FIELDS, 0),
            "frame": number,
            "status": draw("identified", "identified", "identified", "no_match", "too_few_stars"),
            "n_guide_stars": draw(0, 3, 4, 5, 6, 9),
            "n_right": draw(0, 1, 2, 5),
            "n_wrong": draw(0, 0, 1),
            "is_reference_right": draw(True, False),
            "attitude_error_px": draw(None, 0.0, REACH_PX, REACH_PX + 1e-9, 700.0),
            "false_match_probability": draw(0.0, 1e-9, 1.1e-9, 1.0),
            "n_named": draw(0, 3),
            "best_error_px": draw(None, 0.0, REACH_PX, REACH_PX + 1e-9, 700.0),
            "best_probability": draw(0.0, 1e-9, 1e-6, 1.1e-4, 1.0),
            "time_ms": float(generator.exponential(5.0)),
        }
        for number in range(count)
    ]


def accepted(r: dict[str, Any]) -> bool:
    return bool(r["status"] == "identified" and r["false_match_probability"] <= 1e-9)


def right(r: dict[str, Any]) -> bool:
    return bool(r["attitude_error_px"] is not None and r["attitude_error_px"] <= REACH_PX)


BY_HAND: dict[str, Callable[[dict[str, Any]], bool]] = {
    "starcat": lambda r: accepted(r) and right(r) and not r["n_wrong"],
    "attitude": lambda r: r["best_error_px"] is not None and r["best_error_px"] <= REACH_PX,
    "reference": lambda r: bool(r["is_reference_right"]),
    "two_stars": lambda r: bool(r["n_right"] >= 2 and r["n_wrong"] == 0),
}

WRONG_BY_HAND: dict[str, Callable[[dict[str, Any]], bool]] = {
    "starcat": lambda r: accepted(r) and not right(r),
    "attitude": lambda r: r["best_error_px"] is not None and r["best_error_px"] > REACH_PX,
    "reference": lambda r: r["n_named"] > 0 and not r["is_reference_right"],
    "two_stars": lambda r: r["n_wrong"] > 0,
}


def at_limit(made: list[dict[str, Any]], limit: float) -> dict[str, int]:
    """Count the frames that an accepted probability answers, and answers wrongly."""
    answered = [r for r in made if r["best_probability"] <= limit]
    return {"answered": len(answered), "wrong": sum(not BY_HAND["attitude"](r) for r in answered)}


@pytest.fixture(scope="module", params=[(1, 400), (2, 61), (3, 1)])
def random_file(request, tmp_path_factory):
    made = random_records(*request.param)
    path = tmp_path_factory.mktemp("random") / "experiment.parquet"
    pq.write_table(pa.Table.from_pylist(made), path)
    return made, path


def cause(r: dict[str, Any]) -> int:
    """The first cause of a failure that holds."""
    if r["n_guide_stars"] < 6:
        return int(r["n_guide_stars"] >= 4)
    return 2 if r["status"] != "identified" else 3


@pytest.mark.parametrize("rule", RULES)
def test_rates_and_failures_are_what_a_loop_counts(rule, random_file):
    assert set(RULES) == set(rating.MEANINGS) == set(BY_HAND) == set(rating.WRONG)
    made, path = random_file
    rates, own = rating.rates_by_condition(path, rule, REACH_PX), BY_HAND["starcat"]
    enough = [r for r in made if r["n_guide_stars"] >= 4]
    times = [r["time_ms"] for r in made]
    expected = ExperimentRates(
        Share(len(enough), len(made)),
        Share(sum(map(BY_HAND[rule], made)), len(made)),
        Share(sum(map(BY_HAND[rule], enough)), len(enough)),
        Share(sum(map(own, made)), len(made)),
        Share(sum(map(own, enough)), len(enough)),
        sum(map(WRONG_BY_HAND["starcat"], made)),
        Share(sum(map(WRONG_BY_HAND[rule], made)), len(made)),
        rates.mean_ms,
        rates.median_ms,
        rates.p95_ms,
        {f"{limit:g}": at_limit(made, limit) for limit in rating.LIMITS},
    )
    assert rates == expected
    assert (rates.mean_ms, rates.median_ms) == pytest.approx((np.mean(times), np.median(times)))
    assert rates.p95_ms == pytest.approx(np.quantile(times, 0.95))
    causes = [cause(r) for r in made if not BY_HAND[rule](r)]
    found = rating.failures_of(path, rule, REACH_PX)
    assert list(found) == list(CAUSES)
    assert list(found.values()) == [causes.count(k) for k in range(4)]
    # Rows are judged by the limit of their trials.
    trial = replace(experiment_of("t"), tolerance_px=1.0)
    assert trial.attitude_limit_px == pytest.approx(REACH_PX)
    judged = _measured(ExperimentRow("g", "l", "small", trial, rule), path)
    assert judged.rates == rates
    assert sum(judged.failures.values()) == len(causes)


# Campaigns ----------------------------------------------------------------------------------


def test_a_campaign_measures_every_row(outcome, records):
    assert [one.row for one in outcome.rows] == rows(False)
    assert all(one.rates.by_rule.count == 8 for one in outcome.rows)
    names = {path.stem for path in (records / "S0").iterdir()}
    assert names == {row.experiment.name for row in rows(False)}
    clean = next(one for one in outcome.rows if one.row.experiment.name == "noise-0-triangle")
    assert clean.rates.by_rule.percent == 100.0
    # The ceiling is the share of frames with four stars.
    few = outcome.rows[-3]
    stars = pq.read_table(records / "S0" / "few.parquet")["n_guide_stars"].to_numpy()
    assert few.rates.ceiling == Share(int((stars >= 4).sum()), 8)
    assert 0 < few.rates.ceiling.hits < 8
    assert sum(few.failures.values()) == 8 - few.rates.by_rule.hits
    assert few.failures["under 4 guide stars"] == int((stars < 4).sum())


def without_times(path: Path) -> dict[str, Any]:
    columns: dict[str, Any] = pq.read_table(path).drop(["time_ms"]).to_pydict()
    return columns


def test_a_stopped_campaign_goes_on_where_it_was(
    small_database, records, outcome, tmp_path, monkeypatch
):
    shutil.copytree(records / "S0", tmp_path / "S0")
    lost = tmp_path / "S0" / "all.parquet"
    left = lost.with_name(".all.parquet.0.partial")
    lost.rename(left)  # as if killed just before it was done
    ran, whole = [], experiment.score_frames

    def counted(one: Experiment, database: Path) -> Any:
        ran.append(one.name)
        return whole(one, database)

    monkeypatch.setattr(experiment, "score_frames", counted)
    again = run_paper(PAPER, {"small": small_database}, tmp_path, workers=1)
    assert ran == ["all"]
    for name in ("all", "few", "noise-1-pairs"):
        old, new = (folder / "S0" / f"{name}.parquet" for folder in (records, tmp_path))
        assert without_times(old) == without_times(new)
    for one, other in zip(again.rows, outcome.rows, strict=True):
        assert (one.rates.by_rule, one.failures) == (other.rates.by_rule, other.failures)
    assert list(tmp_path.rglob("*.partial")) == [left]  # of a killed process; this one leaves none
    twice = [again.rows[0].row, again.rows[1].row]
    twice[1] = replace(twice[1], experiment=replace(twice[0].experiment, seed=2))
    paper = replace(PAPER, rows=lambda quick: twice)
    with pytest.raises(ValueError, match=f"'{twice[0].experiment.name}'"):
        run_paper(paper, {"small": small_database}, tmp_path / "twice", workers=1)


@pytest.mark.slow
def test_processes_give_the_same_records(small_database, records, outcome, tmp_path):
    seen: list[tuple[str, int, int | None]] = []
    run_paper(
        PAPER, {"small": small_database}, tmp_path, quick=True, workers=2,
        progress=lambda *event: seen.append(event),
    )  # fmt: skip
    for name in ("all", "few"):
        new = tmp_path / "S0-quick" / f"{name}.parquet"
        assert without_times(records / "S0" / f"{name}.parquet") == without_times(new)
    assert seen == [("S0", 0, 16), ("S0", 8, 16), ("S0", 16, 16)]


@pytest.mark.parametrize(
    ("is_lower_better", "good", "bad"),
    [(True, (10.0, 1.0), (10.1,)), (False, (10.0, 99.0), (9.9,)),
     (None, (10.1, 9.9), (10.11, 9.89))],
)  # fmt: skip
def test_goals_of_statistics(is_lower_better, good, bad):
    for value in (*good, *bad):
        line = Statistic("g", "l", value, goal=10.0, is_lower_better=is_lower_better)
        assert is_goal_reached(line) is (value in good)
        assert is_goal_reached(replace(line, goal=None)) is None


# Axes and sweeps ----------------------------------------------------------------------------

LENS = Camera(512, 512, fov_x_deg=40.0)


BASE = replace(experiment_of("t"), camera=LENS, assumed=LENS)


@pytest.mark.parametrize("name", PARAMETERS)
def test_an_axis_reads_what_it_writes(name):
    axis = PARAMETERS[name]
    values = axis.usual or (5.0, 6.0)
    made = [axis.with_value(BASE, value) for value in values]
    assert [axis.read(one) for one in made] == pytest.approx(values, abs=1e-12)
    assert axis_label(made, values) == axis.label
    assert axis_label(made, [100.0 * x for x in values]) == f"{axis.label}, percent"
    assert axis_label(made, [x + 0.1 for x in values]) == ""
    assert {one.assumed for one in made} == {LENS}


def test_axes_keep_each_other_s_values_and_refuse_what_is_out_of_range():
    one = BASE
    values = (("k1", -0.05), ("scale", 1.02), ("k1", -0.02), ("noise_mag", 0.5), ("scale", 1.01))
    for name, value in values:
        one = PARAMETERS[name].with_value(one, value)
    assert one.camera is not None
    assert one.camera.distortion.k1 == -0.02
    assert one.camera.focal_length_px == pytest.approx(1.01 * LENS.focal_length_px)
    assert one.noise == Noise(noise_mag=0.5, limit_mag=6.0)
    wrong = {"noise_px": -0.1, "false_stars": 1.5, "false_share": 1.0, "k1": -9.0, "scale": 0.0,
             "drop_probability": math.nan}  # fmt: skip
    for name, value in wrong.items():
        with pytest.raises(ConfigError, match=f"^{name} is .*; expected"):
            PARAMETERS[name].with_value(BASE, value)


def test_a_sweep_varies_one_quantity_at_a_time(small_database, monkeypatch):
    other = Method(METHODS["triangle"].propose, ("moons",))
    monkeypatch.setitem(METHODS, "other", other)  # the database has none
    given = {"noise_px": (0.4,), "false_stars": (3.0, 0.0), "scale": (1.0, 1.01)}
    paper = sweep_paper(plan_sweep(small_database, given, method="all", camera=LENS, frames=7))
    made = paper.rows(False)
    methods = {row.experiment.method for row in made}
    assert methods == set(METHODS) - {"other"}
    assert len(made) == 4 * len(methods)
    assert len({row.experiment.name for row in made}) == len(made)
    assert {row.experiment.noise.noise_px for row in made} == {0.4}
    assert {row.experiment.attitudes.count for row in made} == {7}
    first = [row for row in made if row.experiment.method == "triangle"]
    assert [row.x for row in first] == [0.0, 3.0, 1.0, 1.01]
    assert [row.experiment.noise.false_stars for row in first] == [0, 3, 0, 0]
    assert all(row.experiment.assumed == LENS for row in first)


def test_a_sweep_of_nothing_varies_all_and_of_single_values_none(small_database):
    usual = sweep_paper(plan_sweep(small_database, {}, quick=True)).rows(True)
    labels = [axis.label for axis in PARAMETERS.values() if axis.usual]
    assert list(dict.fromkeys(row.group for row in usual)) == labels
    tried = {(row.experiment.attitudes.count, row.experiment.method) for row in usual}
    assert tried == {(100, "triangle")}
    plan = plan_sweep(small_database, {"false_stars": (2.0,), "noise_px": (2.0, 2.0)})
    (one,) = sweep_paper(plan).rows(False)
    assert one.experiment.noise == Noise(2.0, false_stars=2, limit_mag=6.0)
    assert (one.x, one.label, one.experiment.tolerance_px) == (None, "triangle", 6.0)


def test_values_of_a_sweep(small_database, tmp_path):
    for values, method in (({"dust": (1.0,)}, None), ({}, "magic")):
        with pytest.raises(ConfigError, match=r"dust|magic"):
            plan_sweep(small_database, values, method=method)
    with pytest.raises(ProductError):
        plan_sweep(tmp_path, {})
    read = sweep_values(noise_px="0,0.5,1", k1="-0.1", scale=None)
    assert read == {"noise_px": (0.0, 0.5, 1.0), "k1": (-0.1,)}
    for wrong in ("", "1,", "1,x", "1;2"):
        with pytest.raises(ConfigError, match=r"--false-stars .*commas"):
            sweep_values(false_stars=wrong)


# Tables, files, pages -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def report(content: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    assert write_evaluation(folder, "A <title>", [content], "a machine") == folder / "index.html"
    return folder


def test_the_terminal_shows_every_row_within_100_columns(content, capsys):
    print_evaluation(Evaluation((content,), Path("index.html")), as_json=False)
    shown = capsys.readouterr()
    lines = shown.out.splitlines()
    assert max(map(len, lines)) <= 100
    assert shown.out.isascii()
    for row in content["rows"]:
        line = next(text for text in lines if text.startswith(row["label"] + "  "))
        share = row["by_rule"]
        assert f"{share['percent']:.2f} [{share['low_percent']:.1f}" in line
    assert re.search(r"few & <far>  +90\.00 .* \(12\) +no", shown.out)
    assert re.search(r"triangles +MiB +8\.2 +1\.729 +2\.4 +yes", shown.out)
    assert re.search(r"records +170,551 +166,799", shown.out)
    assert re.search(r"S0 +a made-up paper +48 ", shown.out)
    *columns, wrote = shown.err.splitlines()
    assert wrote == "wrote index.html"
    told = dict(column.split(": ", 1) for column in columns)
    assert told["ceiling"].startswith("frames that hold at least four guide stars")
    print_evaluation(Evaluation((content,), Path("index.html")), as_json=True)
    assert json.loads(capsys.readouterr().out) == [content]


def test_csv_has_a_line_a_row_with_all_digits(content, report):
    with (report / "S0.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(content["rows"])
    for line, row in zip(lines, content["rows"], strict=True):
        assert (line["group"], line["label"]) == (row["group"], row["label"])
        assert line["trial"] == row["trial"]["name"]
        for share in ("by_rule", "by_rule_enough", "starcat", "starcat_enough", "ceiling"):
            assert float(line[f"{share}_low_percent"]) == row[share]["low_percent"]
            assert int(line[f"{share}_hits"]) == row[share]["hits"]
    few = lines[-3]
    measured_percent = content["rows"][-3]["by_rule"]["percent"]
    assert float(few["difference"]) == pytest.approx(measured_percent - 90.0)
    assert lines[-1]["difference"] == lines[-1]["x"] == ""
    with (report / "S0_statistics.csv").open(newline="") as file:
        assert [line["measured"] for line in csv.DictReader(file)] == ["1.729", "166799.0", "3.0"]
    assert files.rates_csv(content["rows"]) == (report / "S0.csv").read_text()


def test_the_page_has_every_row_and_needs_nothing_else(content, report, tmp_path):
    text = (report / "index.html").read_text(encoding="utf-8")
    cells = [html.unescape(cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", text)]
    for line in [*content["rows"], *content["statistics"]]:
        assert line["label"] in cells
    assert not re.search(r"<(script|link|iframe)|(href|srcset)=", text)
    (picture,) = re.findall(r'<img [^>]*src="([^"]*)"', text)
    kind, data = picture.split(",")
    assert kind == "data:image/svg+xml;base64"
    assert b64decode(data) == (report / "S0_01_position_noise.svg").read_bytes()
    assert "<title>A &lt;title&gt;</title>" in text
    assert "few | again: of the same experiment" in text
    assert "<li>one</li><li>two</li>" in text
    assert "✗ no" in cells
    titles = re.findall("<h3>(.*?)</h3>", text)
    assert titles[:4] == ["Position noise", "A table", "Storage", "Counts"]
    assert "with &lt;K-vectors&gt;" in text
    # The report of a quick run names it as quick.
    write_evaluation(tmp_path, "t", [{**content, "is_quick": True, "rows": []}], "m")
    assert "A quick run" in (tmp_path / "index.html").read_text(encoding="utf-8")
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"index.html", RESULTS, "S0_statistics.csv"}


def test_the_same_evaluation_gives_the_same_files(content, report, tmp_path):
    write_evaluation(tmp_path, "A <title>", [content], "a machine")
    names = {path.name for path in report.iterdir()}
    assert names == {path.name for path in tmp_path.iterdir()}
    assert {"S0.csv", "S0_01_position_noise.png", "index.html", RESULTS} <= names
    for name in names:
        assert (report / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_the_reproduction_is_made_from_what_is_stored(content, report, tmp_path):
    with pytest.raises(ConfigError, match="evaluate --paper all"):  # it needs a full run
        write_reproduction(tmp_path / RESULTS, tmp_path)
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "S0_09_gone.svg").touch()
    (tmp_path / "figures" / "other.svg").touch()
    page = write_reproduction(report / RESULTS, tmp_path)
    text = page.read_text(encoding="utf-8")
    assert text == files.reproduction_page(tmp_path / "reproduction.json")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    write_reproduction(tmp_path / "reproduction.json", tmp_path)
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    figures = re.findall(r"!\[.*\]\((.*)\)", text)
    assert figures == ["figures/S0_01_position_noise.svg"]
    kept = {path.name for path in (tmp_path / "figures").iterdir()}
    assert kept == {"other.svg", "S0_01_position_noise.svg"}
    for line in content["rows"]:
        label = line["label"].replace("|", "\\|")
        assert f"| {label} |" in text
    tables = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
    assert len(tables) == 8  # glance, columns, rules, two of rates, two of statistics, failures
    for table in tables:
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}) == 1


def test_tables_leave_out_columns_without_content(content):
    curve, table = rate_tables(content, LONG)
    assert curve.title == "Position noise"
    assert "method" in curve.heads
    assert not {"own 4+", "goal", "paper ms"} & set(curve.heads)
    assert {"own rule", "own 4+", "goal", "reached", "paper ms", "difference"} <= set(table.heads)
    assert "method" not in table.heads
    assert all(len(row) == len(table.heads) for row in table.rows)
    cells = dict(zip(table.heads, table.rows[0], strict=True))
    assert (cells["goal"], cells["reached"]) == ("99 % of 4+, 0.1 ms", "✗ no")
    # Notes are said once.
    lines = [{**line, "note": "n"} for line in content["rows"]]
    assert [t.notes for t in rate_tables({"rows": lines}, LONG)] == [("n",), ("n",)]
    (note,) = rate_tables({"rows": [*lines[:2], {**lines[2], "note": ""}]}, LONG)[0].notes
    assert note == f"{lines[0]['label']}, {lines[1]['label']}: n"
    # Times have two digits.
    for value, text in ((0.0, "0"), (0.0996, "0.1"), (0.104, "0.10"), (9.96, "10"), (14.27, "14")):
        assert float(tables.milliseconds(value)) == float(text)
    assert tables.milliseconds(None) == ""


def test_each_column_holds_its_own_number(content):
    names = ("by_rule", "by_rule_enough", "starcat", "starcat_enough", "ceiling", "wrong_by_rule")
    shares = {name: to_dict(Share(10 + k, 40)) for k, name in enumerate(names)}
    line = {**content["rows"][-3], **shares, "wrong": 7, "mean_ms": 4.44}
    (table,) = rate_tables({"rows": [line]}, LONG)
    assert dict(zip(table.heads[1:-2], table.rows[0][1:-2], strict=True)) == {
        "paper": "90.00", "measured [95 %]": "25.00 [14.2, 40.2]", "difference": "-65.00",
        "wrong": "37.50", "ceiling": "35.00", "4+": "27.50", "own rule": "30.00",
        "own 4+": "32.50", "own wrong": "7", "ms": "4.4", "paper ms": "12",
    }  # fmt: skip
    (table,) = rate_tables({"rows": [line]}, SHORT)
    assert table.rows[0][1:] == (
        "90.00", "25.00 [14.2, 40.2]", "37.50", "35.00", "27.50", "32.50", "7", "4.4 (12)", "no",
    )  # fmt: skip


def test_failures_are_listed_where_a_goal_is_missed(content):
    table = tables.failure_table(content)
    assert table is not None
    (row,) = table.rows
    failures = content["rows"][-3]["failures"]
    assert row[:3] == ("A table: few & <far>", "8", str(sum(failures.values())))
    assert row[3:] == tuple(str(count) for count in failures.values())
    assert tables.failure_table({"rows": content["rows"][:4]}) is None
    # The summary counts goals and papers.
    table = tables.summary_table([content])
    assert table is not None
    printed = [line for line in content["rows"] if line["published_percent"] is not None]
    good = sum(line["by_rule"]["high_percent"] >= line["published_percent"] for line in printed)
    assert table.rows == (("S0", "a made-up paper", "48", f"{good} of 3", "2 of 4"),)
    none = {**content, "rows": content["rows"][:2], "statistics": []}
    assert tables.summary_table([none]) is None


def test_a_curve_shows_all_methods_the_paper_and_the_ceiling(content, tmp_path):
    ((name, group, lines),) = curves(content)
    assert (name, len(lines)) == ("S0_01_position_noise", 4)
    assert not list(curves({**content, "rows": lines[::2]}))  # all at one place
    figure = draw_rates(group, lines, series_order(content))
    (axes,) = figure.axes
    legend = axes.get_legend()
    assert legend is not None
    labels = [text.get_text() for text in legend.get_texts()]
    assert labels == ["triangle", "pairs", "pairs: paper", "4 guide stars or more"]
    assert axes.get_xlabel() == "position noise, px"
    low, high = axes.get_ylim()
    shares = [line["by_rule"] for line in lines]
    assert low <= min(share["low_percent"] for share in shares)
    assert high > 100.0
    paper = next(line for line in axes.get_lines() if line.get_label() == "pairs: paper")
    assert np.asarray(paper.get_ydata()) == pytest.approx([95.0])
    boxes: list[Any] = list(axes.collections)
    bars = [segment for box in boxes for segment in box.get_segments()]
    drawn = sorted(float(segment[0][1]) for segment in bars)
    assert drawn == pytest.approx(sorted(share["low_percent"] for share in shares))
    for label, name in (
        ("mean of minima, 1.5 px", "mean of minima"), ("a, b, 1", "a, b"), ("0.5", "triangle"),
    ):  # fmt: skip
        assert series_of({**content["rows"][0], "label": label}) == name
    # Uneven abscissae are drawn evenly.
    points = [{**lines[0], "x": x, "axis": ""} for x in (0.0, 1.0, 45.0)]
    (uneven,) = draw_rates(group, points, series_order(content)).axes
    assert [tick.get_text() for tick in uneven.get_xticklabels()] == ["0", "1", "45"]
    assert uneven.get_xlabel() == "Position noise (not to scale)"
    assert list(uneven.get_xticks()) == [0.0, 1.0, 2.0]
    save_small_svg(figure, tmp_path / "one.svg")
    words = {e.text for e in ElementTree.parse(tmp_path / "one.svg").iter() if e.text}
    assert "pairs: paper" in words


# The command's work -------------------------------------------------------------------------


def test_papers_are_evaluated_end_to_end(monkeypatch, small_database, tmp_path):
    monkeypatch.setattr(evaluate, "PAPERS", {"S2": PAPER, "S1": replace(PAPER, name="S1")})
    assert [paper.name for paper in evaluate.papers_named("ALL")] == ["S1", "S0"]
    assert evaluate.papers_named("s2") == [PAPER]
    with pytest.raises(ConfigError, match="S1, S2, all"):
        evaluate.papers_named("S9")
    monkeypatch.setattr(evaluate, "PAPERS", {"S0": PAPER})
    monkeypatch.setattr(evaluate, "prepare_databases", lambda *_, **__: {"small": small_database})
    done = evaluate_papers("S0", {}, tmp_path, quick=True, workers=1)
    assert done.page == tmp_path / "S0-quick" / "index.html"
    assert done.contents[0]["is_quick"]
    assert (tmp_path / "records" / "S0-quick" / "few.parquet").is_file()
    done = evaluate_papers("all", {}, tmp_path, workers=1)
    assert done.page == tmp_path / "all" / "index.html"
    page = write_reproduction(tmp_path / "all" / RESULTS, tmp_path / "docs")
    assert "## S0: a made-up paper" in page.read_text(encoding="utf-8")


@pytest.mark.slow
def test_databases_are_built_from_presets(monkeypatch, small_spec, sao_lines, tmp_path):
    (tmp_path / "sao.dat").write_bytes(b"".join(sao_lines))
    spec = spec_from_dict(tomllib.loads(small_spec), "small.toml")
    monkeypatch.setattr(evaluate, "preset", lambda name: spec.model_copy(update={"name": name}))
    seen: set[str] = set()
    arguments = (["a", "b", "a"], {"sao": [tmp_path / "sao.dat"]}, tmp_path / "dist")
    made = evaluate.prepare_databases(*arguments, progress=lambda stage, *_: seen.add(stage))
    assert made == {name: tmp_path / "dist" / f"{name}-1.0.0" for name in "ab"}
    assert seen == {"build a", "build b"}
    manifest = made["a"] / "manifest.json"
    before = manifest.stat()
    evaluate.prepare_databases(["a"], *arguments[1:])
    assert manifest.stat().st_mtime_ns == before.st_mtime_ns  # the same database is left alone
    changed = spec.model_copy(update={"name": "a", "description": "another"})
    monkeypatch.setattr(evaluate, "preset", lambda name: changed)
    evaluate.prepare_databases(["a"], *arguments[1:])
    assert json.loads(manifest.read_bytes())["spec"]["description"] == "another"


@pytest.mark.slow
def test_sweeps_into_one_folder_stand_beside_each_other(small_database, tmp_path):
    """As the how-to's recipe makes them: two commands, one folder."""

    def sweep(frames: int = 3, **values: tuple[float, ...]) -> Evaluation:
        planned = plan_sweep(small_database, values, frames=frames)
        return evaluate_database(planned, tmp_path, workers=1)

    sweep(noise_px=(0.0, 1.0))
    done = sweep(false_stars=(0.0, 2.0))
    assert [row["group"] for row in done.contents[0]["rows"]] == ["false stars"] * 2
    sweep(4, noise_px=(1.0, 2.0))
    sweep(noise_px=(0.0, 1.0), false_stars=(3.0,))  # under other conditions: a group of its own
    (content,) = json.loads((done.page.parent / RESULTS).read_bytes())["evaluations"]
    points = [(row["group"], row["x"], row["frames"]) for row in content["rows"]]
    noise, false = "position noise, px", "false stars"
    assert points == [
        (noise, 0.0, 3), (noise, 1.0, 4), (noise, 2.0, 4), (false, 0.0, 3), (false, 2.0, 3),
        (f"{noise} (false stars 3)", 0.0, 3), (f"{noise} (false stars 3)", 1.0, 3),
    ]  # fmt: skip
    page = done.page.read_text(encoding="utf-8")
    assert page.count("<figure>") == 3
    assert "0: 3 frames, seed 1<br>1, 2: 4 frames, seed 1" in page
    assert "the paper" not in page
    with (done.page.parent / "small-1.0.0.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 7


def test_a_sweep_with_another_camera_has_a_section_of_its_own(small_database, tmp_path):
    for camera in (None, replace(LENS, focal_length_px=700.0), LENS):
        sweep = plan_sweep(small_database, {"noise_px": (0.0, 0.5)}, camera=camera, frames=2)
        done = evaluate_database(sweep, tmp_path, workers=1)
    assert done.page == tmp_path / "small-1.0.0" / "index.html"
    assert "At a glance" not in done.page.read_text(encoding="utf-8")
    rates = [row["by_rule"] for row in done.contents[0]["rows"]]
    assert [(rate["hits"], rate["count"]) for rate in rates] == [(2, 2), (2, 2)]
    stored = json.loads((done.page.parent / RESULTS).read_bytes())["evaluations"]
    assert [content["name"] for content in stored] == ["small-1.0.0", "small-1.0.0-camera-2"]
    for name in ("small-1.0.0-camera-2.csv", "small-1.0.0_01_position_noise_px.svg"):
        assert (done.page.parent / name).is_file()
    # Sweeps of another database or code are left out.
    one, results = stored[0], done.page.parent / RESULTS
    other = {**one, "measured_with": {**one["measured_with"], "code_sha256": "0" * 64}}
    for kept in ({"evaluations": [other]}, {"evaluations": [{}]}, []):
        results.write_text(json.dumps(kept))
        assert with_earlier(results, one, small_database) == [one]


def test_curves_are_of_all_pointings_with_their_intervals(small_database, tmp_path):
    from starcat_lab.curves import QUANTITIES, measure_curves

    seen = []
    curves = measure_curves(
        small_database, tmp_path, 2, 1, lambda stage, done, total: seen.append((stage, done))
    )
    assert [curve["quantity"] for curve in curves] == list(QUANTITIES)
    assert seen[-1] == ("curves", sum(len(curve["points"]) for curve in curves))
    for curve in curves:
        assert [point["count"] for point in curve["points"]] == [2] * len(curve["points"])
        for point in curve["points"]:
            assert point["low_percent"] <= point["percent"] <= point["high_percent"]
            assert point["percent"] == 50.0 * point["hits"]


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [("--drop-probability", "0,1.5", "0 to 1"), ("--false-stars", "1.5", "a whole number")],
)
def test_a_wrong_value_is_said_before_the_place_of_the_results(
    small_database, starcat, tmp_path, option, value, expected
):
    ran = starcat(["evaluate", small_database, option, value, "-o", tmp_path / "out"])
    assert ran.err.strip() == f"starcat: error: {option} is 1.5; expected {expected}"
    assert not list(tmp_path.iterdir())
