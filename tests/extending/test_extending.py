"""The recipes of CONTRIBUTING as patches: each is applied to a copy of the tree, whose tests pass.

A patch has only the files that its recipe names. If a recipe needs another file, the recipe in
CONTRIBUTING and the list in `RECIPES` change with it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PATCHES = Path(__file__).parent
COPIED = (
    *("starcat", "schemas", "data_sources", "docs", "tests", "packages", "benchmarks", "tools"),
    *("onboard", "binding"),
)
FORM = ("tests/project/test_layers.py", "tests/project/test_docs.py")
"""Tests of form, which every extension has to pass without an edit."""


@dataclass(frozen=True)
class Recipe:
    """What a recipe of CONTRIBUTING adds, and what shows that it works."""

    files: tuple[str, ...]  # of the patch
    tests: tuple[str, ...]  # that find the extension without further code
    named: str  # what the names of tests of the extension contain
    shows: str  # Python that uses the extension in the copy


RECIPES = {
    "product": Recipe(
        (
            "schemas/third_neighbour-1.0.0.json",
            "starcat/database/products/table.py",
            "starcat/database/products/third_neighbour.py",
        ),
        ("tests/database/test_every_product.py", "tests/pipeline/test_spec_keys.py"),
        "third_neighbour",
        """
import numpy as np
from starcat.database.products.third_neighbour import third_neighbours
from starcat.geometry.sphere import separation
u = np.random.default_rng(2).normal(size=(50, 3))
u /= np.linalg.norm(u, axis=1)[:, None]
made = third_neighbours(u, 4.0)
apart = np.sort(separation(u[:, None], u[None, :]), axis=1)
assert np.allclose(made.separation_rad, apart[:, 3])
""",
    ),
    "rule": Recipe(
        ("starcat/pipeline/selection/rules/fast.py", "starcat/pipeline/selection/ruleset.py"),
        ("tests/pipeline/test_rules.py", "tests/pipeline/test_spec_keys.py"),
        "",
        """
from starcat.pipeline.specs.reading import spec_from_dict
import tomllib
spec = tomllib.load(open("starcat/pipeline/specs/presets/gaia-12deg.toml", "rb"))
spec["selection"]["max_proper_motion_mas_yr"] = 300.0
assert spec_from_dict(spec, "a spec").selection.max_proper_motion_mas_yr == 300.0
""",
    ),
    "method": Recipe(
        ("starcat/matcher/methods/nearest.py", "starcat/matcher/methods/table.py"),
        ("tests/matcher/test_every_method.py",),
        "nearest",
        """
from starcat.matcher.methods.table import METHODS
assert METHODS["nearest"].products == ("pairs",)
""",
    ),
    "option": Recipe(
        ("starcat/frames/images/measure.py", "starcat/matcher/options.py"),
        ("tests/cli/test_option_ranges.py",),
        "border_px",
        """
import numpy as np
import pytest
import starcat
from pydantic import TypeAdapter
from pathlib import Path
from tempfile import mkdtemp
from typer.testing import CliRunner
from starcat.cli.main import app
from starcat.cli.reference import cli_page
from starcat.frames.images.image_file import write_image
from starcat.frames.images.measure import measure_file
from starcat_service.pages.wording import OPTION_FIELDS, option_hints
words = "Spots nearer to an edge are ignored."
with pytest.raises(starcat.StarcatError, match="border_px is 100; expected 0 to 99"):
    starcat.IdentifyOptions(border_px=100)
for page in (CliRunner().invoke(app, ["identify", "--help"]).output, cli_page()):
    assert "--border-px" in page and words in " ".join(page.split())
field = TypeAdapter(starcat.IdentifyOptions).json_schema()["properties"]["border_px"]
assert (field["minimum"], field["maximum"], field["description"]) == (0, 99, words)
assert (OPTION_FIELDS["border_px"].unit, option_hints()["border_px"]) == ("px", words)
assert "border_px : float, default 0.0" in starcat.IdentifyOptions.__doc__
y, x = np.mgrid[:64, :64] + 0.5
light = [np.exp(-0.5 * ((x - at) ** 2 + (y - 32.0) ** 2)) for at in (5.0, 40.0)]
noise = np.random.default_rng(1).normal(100.0, 2.0, x.shape)
picture = Path(mkdtemp()) / "stars.png"
write_image(picture, (noise + 1000.0 * sum(light)).astype(np.uint16))
for border_px, count in ((0.0, 2), (10.0, 1)):
    options = starcat.IdentifyOptions(border_px=border_px)
    assert len(measure_file(picture, options).frames[0].centroids_px) == count
""",
    ),
    "command": Recipe(
        ("starcat/cli/console.py", "starcat/cli/databases.py"),
        ("tests/cli/test_cli.py", "tests/cli/test_help_examples.py"),
        "count",
        """
from typer.testing import CliRunner
from starcat.cli.main import app
assert "how many stars a database has" in CliRunner().invoke(app, ["--help"]).output
""",
    ),
    "catalog": Recipe(
        ("data_sources/zonal.toml", "starcat/catalog/archives/zonal.py"),
        ("tests/catalog/test_source.py",),
        "",
        """
from pathlib import Path
from tempfile import mkdtemp
from starcat.catalog.ingest import ingest_catalog
table = Path(mkdtemp()) / "zonal.csv"
table.write_text("number,ra_h,dec_deg,pm_ra,pm_dec,v\\n7,1.0,0.5,0.0,3.0,4.5\\n")
stars = ingest_catalog("zonal", [table]).stars
assert stars["star_id"].to_pylist() == [90_000_007]
assert abs(stars["pm_dec_mas_yr"].to_pylist()[0] - 30.0) < 1e-9
""",
    ),
}


def files_of(patch: Path) -> tuple[str, ...]:
    """Return the files that a patch changes or adds, sorted."""
    lines = patch.read_text(encoding="utf-8").splitlines()
    return tuple(sorted(line[6:] for line in lines if line.startswith("+++ b/")))


def test_every_patch_has_a_recipe_and_only_its_files():
    assert {path.stem for path in PATCHES.glob("*.patch")} == RECIPES.keys()
    for name, recipe in RECIPES.items():
        assert files_of(PATCHES / f"{name}.patch") == recipe.files
        # A product, a rule and a method are new files and lines of one list. A command is added to
        # a module and to the help; an option has its declaration and the code that reads it.
        edited = [file for file in recipe.files if (ROOT / file).exists()]
        assert len(edited) == {"catalog": 0, "command": 2, "option": 2}.get(name, 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", RECIPES)
def test_an_extension_passes_without_another_edit(name, tmp_path):
    recipe, copy = RECIPES[name], tmp_path / "starcat"
    copy.mkdir()
    for folder in COPIED:
        skipped = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / folder, copy / folder, ignore=skipped, symlinks=True)
    for path in ROOT.iterdir():
        if path.is_file():
            shutil.copy2(path, copy)
    applied = ["git", "apply", str(PATCHES / f"{name}.patch")]
    subprocess.run(
        applied, cwd=copy, check=True, env={**os.environ, "GIT_DIR": str(tmp_path / "no")}
    )
    environment = {**os.environ, "PYTHONPATH": str(copy)}
    for variable in [name for name in environment if name.startswith("PYTEST_")]:
        del environment[variable]
    run = {"cwd": copy, "env": environment, "text": True, "capture_output": True, "check": False}
    shown = subprocess.run([sys.executable, "-c", recipe.shows], **run)
    assert shown.returncode == 0, shown.stderr
    command = [sys.executable, "-m", "pytest", "-p", "no:xdist", "-p", "no:cacheprovider"]
    command += ["-m", "not slow and not real"]
    own = subprocess.run([*command, *recipe.tests, "-k", recipe.named, "-v"], **run)
    assert own.returncode == 0, own.stdout[-3000:]
    assert recipe.named in own.stdout
    form = subprocess.run([*command, *FORM], **run)
    assert form.returncode == 0, form.stdout[-3000:]
