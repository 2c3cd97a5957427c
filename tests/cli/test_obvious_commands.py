"""What people type first is understood, and every command that writes has one rule for ``-o``."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from astropy.table import Table
from registry_files import serving

import starcat as starcat_package
from starcat.catalog.ingest import ingest_catalog
from starcat.pipeline.specs.keys import spec_toml
from starcat.pipeline.specs.reading import spec_from_dict
from starcat.ship.releases.metadata import read_signing
from starcat.ship.releases.publishing import publish
from starcat.storage.keys import new_key

ONBOARD = Path(__file__).parents[2] / "onboard"


@pytest.fixture
def signed(small_database: Path, tmp_path: Path) -> Path:
    """A registry with one signed release."""
    private, _ = new_key(tmp_path / "flight")
    publish(small_database, str(tmp_path / "registry"), sign=read_signing([private], None))
    return tmp_path / "registry"


# -o ----------------------------------------------------------------------------------------


def test_replace_replaces(starcat, small_database, tmp_path):
    path, other, texts = tmp_path / "a.csv", tmp_path / "b.csv", []
    for seed, options in ((1, []), (2, ["--replace"])):
        ran = starcat(["simulate", small_database, "-o", path, "--seed", seed, *options])
        assert ran.code == 0, ran.err
        texts.append(path.read_text())
    starcat(["simulate", small_database, "-o", other, "--seed", 2])
    assert texts[0] != texts[1] == other.read_text()


def test_one_product_with_a_suffix_is_a_file(starcat, small_database, tmp_path):
    for name in ("stars.fits", "stars.csv"):
        path = tmp_path / name
        ran = starcat(["export", small_database, "--product", "stars", "-o", path])
        assert ran.code == 0, ran.err
        assert len(Table.read(path)) == len(pq.read_table(small_database / "stars.parquet"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["stars.csv", "stars.fits"]


def test_the_suffix_selects_the_format_of_counterparts(starcat, sao_file, tmp_path):
    stars = tmp_path / "stars.parquet"
    assert starcat(["ingest", "sao", "--input", sao_file, "-o", stars]).code == 0
    count = len(ingest_catalog("sao", [sao_file]).stars)
    for name in ("pairs.csv", "pairs.fits", "pairs.parquet"):
        ran = starcat(["crossmatch", stars, stars, "-o", tmp_path / name])
        assert ran.code == 0, ran.err
    assert len(Table.read(tmp_path / "pairs.fits")) >= count
    assert (tmp_path / "pairs.csv").read_text().startswith('"star_id","star_designation",')


def test_a_build_that_cannot_equal_what_exists_does_not_start(starcat, small_database, tmp_path):
    """No archive file is given: the build would end at the first of its stages."""
    shutil.copytree(small_database, tmp_path / "small-1.0.0")
    spec = tmp_path / "spec.toml"
    manifest = json.loads((small_database / "manifest.json").read_text())
    spec.write_text(spec_toml(spec_from_dict(manifest["spec"], "spec")))
    build = ["build", spec, "-o", tmp_path]
    changed = starcat([*build, "--set", "selection.faint_limit_mag=5.5"])
    assert changed.code == 1
    assert "already exists and differs; raise the version in the spec" in changed.err
    same = starcat(build)
    assert same.code == 3
    assert "no file found" in same.err


# What people type first ---------------------------------------------------------------------


def test_help_version_and_json_where_people_put_them(starcat):
    assert starcat(["help", "build"]).out == starcat(["build", "--help"]).out
    assert starcat(["help"]).out == starcat(["--help"]).out
    assert starcat(["version"]).out == starcat(["--version"]).out
    assert json.loads(starcat(["--json", "methods"]).out) == json.loads(
        starcat(["methods", "--json"]).out
    )


def test_doctor_says_what_is_found(starcat, tmp_path, monkeypatch, sao_file):
    monkeypatch.setenv("STARCAT_CATALOGS", str(sao_file.parent))
    facts = json.loads(starcat(["doctor", "--json"]).out)
    assert facts["catalogs"]["sao"] == str(sao_file.parent)
    assert facts["catalogs"]["2mass"] is None
    assert facts["software"]["starcat"]
    assert facts["memory_bytes"] > 0
    assert facts["disk_free_bytes"] > 0
    assert facts["cache"] == {"folder": str(tmp_path / "no-cache"), "files": 0, "bytes": 0}
    table = starcat(["doctor"]).out
    for words in ("c library", "memory bytes", "disk free bytes", "catalogs sao", "catalogs 2mass"):
        assert words in table


# Registries ---------------------------------------------------------------------------------


@pytest.fixture
def address(signed: Path):
    """The same registry, of a web server."""
    with serving(signed) as server:
        yield server.url("")


def test_verify_releases_and_keys_read_addresses(starcat, signed, address, tmp_path):
    for place in (signed, address):
        ran = starcat(["verify", place, "--json"])
        assert ran.code == 0, ran.err
        assert json.loads(ran.out)["checks"] > 10
        [release] = json.loads(starcat(["releases", place, "--json"]).out)
        assert release["signed"] == "yes"
    shown = [starcat(["keys", "show", place, "--json"]) for place in (signed, address)]
    assert shown[0].out == shown[1].out
    assert {one["role"] for one in json.loads(shown[1].out)} >= {"root", "targets"}
    assert starcat(["verify", address, "--trust", tmp_path / "flight.pub"]).code == 0


def test_verify_finds_a_changed_index_and_a_damaged_file(starcat, signed):
    index = signed / "index.json"
    text = index.read_text()
    files = json.loads(text)["releases"][0]["files"]
    index.write_text(text.replace(f'"files": {files}', f'"files": {files + 1}'))
    assert "changed since it was signed" in starcat(["releases", signed]).out
    blob = max(
        (path for path in signed.rglob("*") if path.is_file()), key=lambda p: p.stat().st_size
    )
    blob.chmod(0o644)
    blob.write_bytes(blob.read_bytes()[:-1] + b"?")
    ran = starcat(["verify", signed, "--json"])
    assert ran.code == 5
    problems = [finding["problem"] for finding in json.loads(ran.out)["findings"]]
    assert problems[0] == "changed since it was signed"
    assert "not the release that index.json lists; the registry is damaged" in problems[1]
    assert "not the content that its name says. The registry is damaged" in problems[-1]


def test_an_unsigned_registry_says_no(starcat, published):
    [release] = json.loads(starcat(["releases", published, "--json"]).out)
    assert release["signed"] == "no"


# The calibrated camera for C ----------------------------------------------------------------


def test_the_calibrated_camera_is_written_for_c(starcat, small_database, tmp_path):
    (tmp_path / "camera.toml").write_text(
        "width_px = 512\nheight_px = 512\nfocal_length_px = 703.25\n"
        "principal_point_px = [250.5, 260.25]\n[distortion]\nk1 = -0.125\np2 = 0.001\n"
    )
    image = tmp_path / "small.img"
    command = ["export", small_database, "-o", image, "--camera", tmp_path / "camera.toml"]
    ran = starcat(command)
    assert ran.code == 0, ran.err
    header = (tmp_path / "small_camera.h").read_text()
    assert "static const starcat_camera starcat_small_1_0_0_camera = {" in header
    if shutil.which("cc") is None:
        pytest.skip("this test needs a C compiler")
    (tmp_path / "main.c").write_text(
        '#include <stdio.h>\n#include "small_camera.h"\nint main(void) {\n'
        "  starcat_camera c = starcat_small_1_0_0_camera;\n"
        '  printf("%g %g %g %g %g", (double)c.focal_length_px, (double)c.x0_px, (double)c.y0_px,\n'
        "         (double)c.k1, (double)c.p2);\n  return c.fold_radius > 0 ? 0 : 1;\n}\n"
    )
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", f"-I{ONBOARD / 'include'}"]
    for kind in ([], ["-DSTARCAT_SINGLE"]):
        build = ["cc", *flags, *kind, "main.c", "-o", "main"]
        subprocess.run(build, cwd=tmp_path, check=True)
        ran = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=True)
        assert ran.stdout == "703.25 250.5 260.25 -0.125 0.001"


def test_folders_and_patterns_are_taken_where_frames_are(starcat, small_database, tmp_path):
    night = tmp_path / "night"
    night.mkdir()
    for seed in range(5):
        starcat(["simulate", small_database, "-o", night / f"{seed}.csv", "--seed", seed])
    ran = starcat(["calibrate", small_database, night / "*.csv", "-o", tmp_path / "camera.toml"])
    assert ran.code == 0, ran.err
    answers = tmp_path / "answers"
    answers.mkdir()
    (answers / "a.ndjson").write_text(starcat(["identify", small_database, night, "--ndjson"]).out)
    facts = [
        json.loads(starcat(["learn", small_database, given, "--json"]).out)
        for given in (answers, answers / "*.ndjson", answers / "a.ndjson")
    ]
    assert [one["frames"] for one in facts] == [5, 5, 5]


@pytest.mark.slow
def test_init_takes_a_response_of_a_file(starcat, tmp_path):
    response = tmp_path / "sensor.csv"
    response.write_text("400,0.1\n500,0.5\n600,0.6\n700,0.4\n800,0.1\n")
    command = ["init", tmp_path / "cam.toml", "--size", "512x512", "--fov-x-deg", "20"]
    ran = starcat([*command, "--response", response, "--per", "photon"])
    assert ran.code == 0, ran.err
    written = tomllib.loads((tmp_path / "cam.toml").read_text())
    assert written["camera"]["response"]["wavelength_nm"][0] == 400.0


def test_every_pattern_that_a_message_may_be_about_has_words():
    """A pattern without words would say no more than that other characters were expected."""
    from starcat.sections import PATTERN_WORDS

    text = "".join(path.read_text() for path in Path(starcat_package.__file__).parent.rglob("*.py"))
    written = set(re.findall(r'pattern=r"([^"]+)"', text))
    assert written
    assert written <= set(PATTERN_WORDS)
