"""The command line: help, exit codes, tables, JSON, and the way from archive to attitude."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.main import get_command

import starcat as package
from starcat.catalog.ingest import ingest_catalog, write_star_tables
from starcat.catalog.source import source_names
from starcat.cli.console import PANELS, OptionsInPanels
from starcat.cli.main import app
from starcat.cli.reference import every_command
from starcat.database.writer import content_sha256
from starcat.matcher.c_engine import library_version
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods.table import METHODS
from starcat.pipeline.specs.reading import preset_names
from starcat.storage.schema import product_schema

EVERY = every_command()
COMMANDS = tuple(EVERY)

Run = Callable[[list[Any]], Any]


@pytest.fixture
def frame(starcat: Run, small_database: Path, tmp_path: Path) -> Path:
    path = tmp_path / "frame.csv"
    made = starcat(["simulate", small_database, "-o", path, "--seed", "7"])
    assert (made.code, made.out) == (0, "")
    return path


def fits(text: str) -> bool:
    return all(len(line) <= 100 for line in text.splitlines())


# Help ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", COMMANDS)
class TestEveryCommand:
    def test_has_help_with_an_example(self, name, starcat):
        run = starcat([*name.split(), "--help"])
        assert (run.code, run.err) == (0, "")
        assert re.search(rf"Example: starcat {name}\b", run.out)

    def test_has_options_that_are_alike_in_all_commands(self, name):
        """Each has a help; ``-o`` names the result, and a file can be replaced."""
        options = {option: each for each in EVERY[name].params for option in each.opts}
        assert all(getattr(each, "help", None) for each in options.values())
        assert "--json" in options
        output = options.get("-o")
        if output is not None:
            assert output.opts == ["--output", "-o"]
            assert output.metavar in ("FILE", "FOLDER", "FILE|FOLDER")
            assert output.help.startswith("Where ")
            assert "--replace" in options or output.metavar == "FOLDER"


def test_every_command_has_its_panel_in_the_help(starcat):
    assert sum("-o" in each.opts for name in COMMANDS for each in EVERY[name].params) == 13
    told = [name for names in PANELS.values() for name in names]
    assert sorted(told) == sorted(get_command(app).commands)
    run = starcat(["--help"])
    assert run.code == 0
    assert [line[:-1] for line in run.out.splitlines() if line[:-1] in PANELS] == list(PANELS)
    assert all(re.search(rf"^  {name.split()[0]} ", run.out, re.MULTILINE) for name in COMMANDS)


def test_every_option_of_identify_has_its_panel(starcat):
    panels, shown = OptionsInPanels.panels, starcat(["identify", "--help"]).out
    assert [line[:-1] for line in shown.splitlines() if line[:-1] in panels] == list(panels)
    for param in get_command(app).commands["identify"].params:
        if param.param_type_name == "option":
            assert f"  {param.opts[0]}" in shown
            assert param.rich_help_panel in (*panels, None)


def test_no_command_shows_the_help(starcat):
    run = starcat([])
    assert "Design a database:" in run.out + run.err
    assert run.code == 2
    assert "Usage: starcat" in starcat(["biuld"]).err


def test_version(starcat):
    ours, matcher = starcat(["--version"]).out.splitlines()
    assert ours == f"starcat {package.__version__}"
    library = library_version()
    assert matcher == f"matcher: {f'C library {library}' if library else 'numpy, no C library'}"


# Lists --------------------------------------------------------------------------------------


def listed(starcat: Run, command: str, names: Sequence[str]) -> str:
    """Return the table of a command, after checking that each name has a line."""
    run = starcat([command])
    assert run.code == 0
    assert fits(run.out)
    assert all(re.search(rf"^{name} ", run.out, re.MULTILINE) for name in names)
    return run.out


def test_sources(starcat, sao_file, monkeypatch):
    assert "not found" in listed(starcat, "sources", source_names())
    monkeypatch.setenv("STARCAT_CATALOGS", str(sao_file.parent))
    found = {entry["name"]: entry for entry in json.loads(starcat(["sources", "--json"]).out)}
    assert tuple(sorted(found)) == source_names()
    for entry in found.values():
        assert list(entry) == [
            "name", "kind", "identifier", "rows", "bands", "epoch_jyear", "licence", "citation",
            "found_at",
        ]  # fmt: skip
    assert found["sao"]["found_at"] == str(sao_file.parent)
    assert found["hipparcos"]["found_at"] is None
    assert found["sao"]["rows"] == 258_997


def test_methods(starcat):
    listed(starcat, "methods", list(METHODS))


def test_presets(starcat):
    listed(starcat, "presets", preset_names())
    specs = json.loads(starcat(["presets", "--json"]).out)
    assert [spec["name"] for spec in specs] == list(preset_names())
    assert all(spec["selection"]["faint_limit_mag"] > 0 for spec in specs)
    one = starcat(["presets", "gaia-12deg"])
    assert one.code == 0
    assert fits(one.out)
    assert re.search(r"^selection faint limit +6\.000 mag +$", one.out, re.MULTILINE)
    assert json.loads(starcat(["presets", "gaia-12deg", "--json"]).out) in specs


# Ingest -------------------------------------------------------------------------------------


def test_ingest_writes_a_star_table(starcat, sao_file, tmp_path):
    out = tmp_path / "made" / "out.parquet"
    run = starcat(["ingest", "sao", "--input", sao_file, "-o", out, "--epoch-jyear", "2026"])
    assert run.code == 0
    assert run.err == f"wrote {out}\n"
    assert re.search(r"^kept +600$", run.out, re.MULTILINE)
    table, schema = pq.read_table(out), product_schema("stars")
    schema.check(table)
    assert set(table["epoch_jyear"].to_pylist()) == {2026.0}
    assert table["star_id"].to_pylist() == list(range(1, 601))
    assert table.schema.field("ra_deg").metadata[b"unit"] == b"deg"
    assert sorted(path.name for path in out.parent.iterdir()) == ["out.parquet"]


def test_a_star_table_never_has_the_rejected_rows_of_another_run(tmp_path, sao_file, monkeypatch):
    """It gets its name last, whatever ends the process before."""
    out = tmp_path / "out.parquet"
    records = sao_file.read_bytes()
    sao_file.write_bytes(records + b"short\n")
    write_star_tables(ingest_catalog("sao", [sao_file]), out)
    rename, ends = Path.replace, []

    def stop(self: Path, target: Path) -> Path:
        if target.name in ends:
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", stop)
    sao_file.write_bytes(records + b"tiny\n")
    read = ingest_catalog("sao", [sao_file])
    for name in ("out.rejected.parquet", "out.parquet"):
        ends[:] = [name]
        with pytest.raises(KeyboardInterrupt):
            write_star_tables(read, out)
        assert not out.exists()
    ends.clear()
    write_star_tables(read, out)
    assert len(pq.read_table(out.with_name("out.rejected.parquet"))) == len(read.rejected) == 1


def test_ingest_writes_the_rejected_rows_beside_it(starcat, sao_file, tmp_path):
    out = tmp_path / "out.parquet"
    sao_file.write_bytes(sao_file.read_bytes() + b"short\n")
    run = starcat(["ingest", "sao", "--input", sao_file, "-o", out, "--read-limit-mag", "6.0"])
    assert run.code == 0
    assert "malformed: sao.dat line 601, record: found 5 bytes; expected 204 bytes" in run.err
    assert run.err.endswith(f"wrote {out} and out.rejected.parquet\n")
    rejected = pq.read_table(tmp_path / "out.rejected.parquet")
    product_schema("rejected").check(rejected)
    assert rejected["reason"].to_pylist() == ["malformed_record"]
    beyond = 600 - len(pq.read_table(out))
    assert beyond > 0
    assert re.search(rf"beyond_read_limit.* {beyond}\b", " ".join(run.out.split()))
    assert fits(run.out)
    # A second run without malformed records takes the old file of them away.
    sao_file.write_bytes(sao_file.read_bytes().removesuffix(b"short\n"))
    again = ["ingest", "sao", "--input", sao_file, "-o", out]
    assert starcat(again).code == 1
    assert starcat([*again, "--replace"]).code == 0
    assert not (tmp_path / "out.rejected.parquet").exists()


def test_ingest_as_json(starcat, sao_file, tmp_path):
    """The input is named as in other commands, with its source before it."""
    out = tmp_path / "out.parquet"
    command = ["ingest", "sao", "--input", f"sao={sao_file}", "-o", out, "--json", "--band", "V"]
    run = starcat(command)
    facts = json.loads(run.out)
    assert run.err == ""
    assert facts["rows_read"] == facts["kept"] == facts["files"][0]["rows"] == 600
    assert facts["files"][0]["name"] == "sao.dat"
    assert (facts["source"], facts["band"], facts["rejected"]) == ("sao", "V", {})
    assert (facts["stars"], facts["rejected_rows"], facts["problems"]) == (str(out), None, [])


# Build, inspect, identify -------------------------------------------------------------------


def test_build_prints_what_it_made(starcat, sao_file, small_spec, tmp_path):
    spec = tmp_path / "spec.toml"
    spec.write_text(small_spec)
    folder = tmp_path / "für später"
    arguments = ["build", spec, "--input", f"sao={sao_file}", "-o", folder]
    run = starcat(arguments)
    assert run.code == 0
    database = folder / "small-1.0.0"
    estimate, _, rest = run.err.partition("\n")
    assert estimate.startswith("estimate: ")
    written, report, go_on, *commands = rest.splitlines()
    assert written == f"written: {database}"
    assert report == f"report: {database / 'report' / 'index.html'}"
    assert go_on == "go on with:"
    assert [shlex.split(line)[:3] for line in commands] == [
        ["starcat", name, str(database)] for name in ("simulate", "identify", "export")
    ]
    assert (database / "report" / "index.html").is_file()
    assert fits(run.out)
    for words in ("read", "kept", "rejected: too_faint", "fields below 4", "pairs-1.0.0", "clean"):
        assert words in run.out
    again = starcat([*arguments, "--json"])
    made = json.loads(again.out)
    assert again.err == f"{estimate}\n"
    assert made["outcome"] == "unchanged"
    assert list(made) == [
        "folder", "report", "outcome", "filters", "coverage", "self_test", "warnings", "times_s",
        "sources", "products", "files",
    ]  # fmt: skip
    assert made["folder"] == str(database)
    assert [step["step"] for step in made["filters"]] == ["magnitude", "doubles", "variables"]
    assert made["self_test"][0]["identified_share"] == 1.0


def test_inspect(starcat, small_database):
    run = starcat(["inspect", small_database])
    assert run.code == 0
    assert fits(run.out)
    camera, source = "512 x 512 px, 40 x 40 deg", "sao from sao.dat"
    for words in ("small-1.0.0", "ICRS, J2026", camera, source, "pairs-1.0.0"):
        assert words in run.out
    manifest = json.loads(starcat(["inspect", small_database, "--json"]).out)
    assert manifest == json.loads((small_database / "manifest.json").read_bytes())
    table = pq.read_table(small_database / "stars.parquet")
    digest = content_sha256(table, product_schema("stars"))
    assert manifest["products"]["stars"]["content_sha256"] == digest


def test_simulate_says_what_it_wrote_and_the_true_attitude(starcat, small_database, tmp_path):
    path = tmp_path / "frame.csv"
    command = ["simulate", small_database, "-o", path, "--seed", "7", "--false-stars", "2"]
    [said] = starcat(command).err.splitlines()
    count = len(path.read_text().splitlines()) - 1
    assert said.startswith(f"wrote {path}: {count} centroids, {count - 2} of guide stars; true att")
    truth = json.loads(starcat([*command, "--replace", "--json"]).out)
    assert (truth["file"], truth["false_stars"], truth["centroids"]) == (str(path), 2, count)
    assert truth["guide_stars"] == count - 2
    names = ("boresight_ra_deg", "boresight_dec_deg", "roll_deg")
    angles = [float(number) for number in re.findall(r"[-+]?\d+\.\d{4}", said)]
    assert [truth[name] for name in names] == pytest.approx(angles, abs=1e-4)
    [found] = json.loads(starcat(["identify", small_database, path, "--json"]).out)
    assert found["boresight_dec_deg"] == pytest.approx(truth["boresight_dec_deg"], abs=0.05)
    assert found["q_body_from_icrs"] == pytest.approx(truth["q_body_from_icrs"], abs=1e-3)


def test_the_ending_of_a_frame_says_its_kind(starcat, small_database, tmp_path):
    for name in ("F.CSV", "f.TIFF", "f.fts"):
        assert starcat(["simulate", small_database, "-o", tmp_path / name]).code == 0
    path = tmp_path / "frame.JPG"
    assert starcat(["simulate", small_database, "-o", path, "--seed", 3]).code == 0
    assert path.read_bytes()[:3] == b"\xff\xd8\xff"
    run = starcat(["identify", small_database, path, "--psf-sigma-px", 1, "--threshold", 6])
    assert run.code == 0
    assert "identified" in run.out


def test_a_simulated_frame_is_identified(starcat, frame, small_database):
    run = starcat(["identify", small_database, frame])
    assert run.code == 0
    assert fits(run.out)
    assert re.search(r"status +identified", run.out)
    assert re.search(
        r"SAO \d+ +\d\.\d\d +\d+\.\d{5} +[+-]\d+\.\d{5} +[+-]0\.\d{3} +[+-]0\.\d{3}$",
        run.out,
        re.MULTILINE,
    )


def test_identify_as_json(starcat, frame, small_database):
    [answer] = json.loads(starcat(["identify", small_database, frame, "--json"]).out)
    assert list(answer) == [
        "frame", "status", "origin", "n_matched", "remarks", "database", "camera",
        "boresight_ra_deg", "boresight_dec_deg", "roll_deg",
        "q_body_from_icrs", "covariance_arcsec2", "residual_arcsec",
        "reduced_chi_square", "false_match_probability",
        "focal_length_px", "focal_length_error_px", "frame_shape", "time_s", "stars",
    ]  # fmt: skip
    assert answer["status"] == "identified"
    assert len(answer["stars"]) == len(frame.read_text().splitlines()) - 1
    assert answer["n_matched"] == sum(star["star"] is not None for star in answer["stars"])
    assert sum(part**2 for part in answer["q_body_from_icrs"]) == pytest.approx(1.0)
    one = next(star for star in answer["stars"] if star["star"])
    assert list(one) == [
        "x_px", "y_px", "observed_mag", "star", "mag", "star_id", "ra_deg", "dec_deg",
        "dx_px", "dy_px", "separation_arcsec", "difference_mag",
    ]  # fmt: skip
    assert one["star"] == f"SAO {one['star_id']}"
    assert all(value > 0.0 for value in np.diagonal(answer["covariance_arcsec2"]))


def test_many_frames_of_one_file(starcat, frame, small_database, tmp_path):
    rows = [line.split(",") for line in frame.read_text().splitlines()[1:]]
    pixels = [[float(x), float(y)] for x, y, _ in rows]
    frames = [
        {"name": "whole", "centroids_px": pixels, "mag": [float(mag) for *_, mag in rows]},
        {"centroids_px": [*pixels[:-1], [1e300, 2.0], pixels[0]]},
        {"centroids_px": pixels[:3]},
    ]
    path = tmp_path / "frames.json"
    path.write_text(json.dumps({"frames": frames}))
    run = starcat(["identify", small_database, path])
    assert fits(run.out)
    assert re.search(r"^whole +identified +", run.out, re.MULTILINE)
    answers = json.loads(starcat(["identify", small_database, path, "--json"]).out)
    assert [answer["frame"] for answer in answers] == ["whole", "frames 2", "frames 3"]
    assert [a["status"] for a in answers] == ["identified", "identified", "too_few_stars"]
    assert [star.get("dropped") for star in answers[1]["stars"][-2:]] == [
        "out_of_frame", "duplicate",
    ]  # fmt: skip
    one = np.array([answers[0]["q_body_from_icrs"], answers[1]["q_body_from_icrs"]])
    assert np.abs(one[0] - one[1]).max() < 1e-3


def test_the_camera_of_a_file_is_used(starcat, frame, small_database, tmp_path):
    camera = tmp_path / "camera.toml"
    camera.write_text("width_px = 512\nheight_px = 512\nfov_x_deg = 40.0\n")
    arguments = ["identify", small_database, frame, "--json", "--camera", camera]
    assert json.loads(starcat(arguments).out)[0]["status"] == "identified"
    camera.write_text("width_px = 512\nheight_px = 512\nfov_x_deg = 20.0\n")
    assert json.loads(starcat(arguments).out)[0]["status"] == "no_match"


def test_selftest(starcat, small_database):
    arguments = ["selftest", small_database, "--frames", "20", "--seed", "3"]
    run = starcat(arguments)
    assert (run.code, run.err) == (0, "")  # progress is drawn for terminals only
    assert fits(run.out)
    assert re.search(r"^clean +0\.5 +0\.2 +0% +0 +20 ", run.out, re.MULTILINE)
    rates = json.loads(starcat([*arguments, "--json"]).out)
    names = ["clean", "hard", "clean, no magnitudes", "hard, no magnitudes"]
    assert [rate["name"] for rate in rates] == names
    assert [rate["frames"] for rate in rates] == [20] * 4
    assert [rate["noise_mag"] for rate in rates] == [0.2, 0.2, None, None]
    assert all(rate["wrong"] == 0 for rate in rates)


def test_progress_is_drawn_on_a_terminal(small_database):
    pty = pytest.importorskip("pty")
    import os

    leader, follower = pty.openpty()
    arguments = [sys.executable, "-m", "starcat", "selftest", str(small_database), "--frames", "5"]
    environment = {**os.environ, "TERM": "xterm"}
    run = subprocess.run(
        arguments, stdout=subprocess.PIPE, stderr=follower, check=True, env=environment
    )
    os.close(follower)
    drawn = os.read(leader, 1 << 16).decode()
    os.close(leader)
    assert "self-test" in drawn
    assert "self-test" not in run.stdout.decode()
    assert "Simulated fields" in run.stdout.decode()


def test_a_database_is_identical_to_itself(starcat, small_database):
    run = starcat(["diff", small_database, small_database])
    assert (
        run.out == "small-1.0.0 and small-1.0.0 are identical: spec, sources, stars and products\n"
    )


def test_results_of_frames_are_compared_without_an_error(small_database):
    result = Matcher.open(small_database).identify(np.zeros((0, 2)))
    again = Matcher.open(small_database).identify(np.zeros((0, 2)))
    assert result == again
    assert len({result, again}) == 1
