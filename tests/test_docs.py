"""Documentation that cannot drift: generated pages are fresh, README's commands work."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import duckdb
import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "builders"))

from every_command import every_command

from docs import PAGES
from starcat.cli import main as cli


@pytest.mark.parametrize("name", PAGES)
def test_generated_pages_are_what_make_docs_writes(name):
    assert (ROOT / "docs" / name).read_text() == PAGES[name]().rstrip() + "\n"


def commands(page):
    """Return the starcat commands of a page's console blocks, in order."""
    blocks = re.findall(r"```console\n(.*?)```", page.read_text(), re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line[2:] for line in lines if line.startswith("$ starcat ")]


WALKED = [
    "README.md",
    "docs/tutorial.md",
    "docs/howto-prove.md",
    "docs/howto-calibrate.md",
    "docs/howto-plan.md",
    "docs/howto-query.md",
    "docs/howto-release.md",
    "docs/howto-own-catalog.md",
    "docs/howto-new-release.md",
]


@pytest.mark.parametrize("name", WALKED)
def test_every_command_of_a_page_is_understood(name):
    """Its options and arguments are those of the command; what it does is for the slow test."""
    found, known = commands(ROOT / name), every_command()
    assert found
    for text in found:
        words = shlex.split(text)[1:]
        count = 2 if " ".join(words[:2]) in known else 1
        command = " ".join(words[:count])
        known[command].make_context(command, words[count:])


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", WALKED)
def test_every_command_of_a_page_runs(name, catalogs, tmp_path, monkeypatch):
    found = commands(ROOT / name)
    assert found
    monkeypatch.setenv("STARCAT_CATALOGS", str(catalogs))
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    for spec in re.findall(r"```toml\n# (\S+)\n(.*?)```", (ROOT / name).read_text(), re.DOTALL):
        Path(spec[0]).write_text(spec[1])
    for command in found:
        arguments = shlex.split(command)
        if arguments[1] == "fetch":  # needs the archives' servers; test_fetch has its own
            continue
        monkeypatch.setattr(sys, "argv", arguments)
        with pytest.raises(SystemExit) as done:
            cli.main()
        assert not done.value.code, command


def test_the_two_kinds_of_steps_are_told_apart():
    """The numpy matcher and the C library count other things, a thousand times apart in time."""
    for path in ("docs/cli.md", "onboard/README.md"):
        text = " ".join((ROOT / path).read_text().split())
        assert re.search(r"[Cc]andidates that the numpy matcher .{0,14}, 2 to 20 micro", text), path
    text = " ".join((ROOT / "docs" / "algorithms.md").read_text().split())
    assert "A step takes 2 to 20 µs" in text
    assert "1 to 5 ns each (`options.max_steps`)" in text


@pytest.mark.parametrize("name", ["README.md", "docs/scale.md", "docs/cli.md"])
def test_files_of_examples_have_names_that_sql_takes_as_they_are(name):
    """A file is a table of its name, but BOTH, for instance, is a word of SQL."""
    names = re.findall(r"-o (\w+)\.parquet", (ROOT / name).read_text())
    assert names
    for table in names:
        duckdb.sql(f"SELECT * FROM (SELECT 1) AS {table}")


def test_links_between_pages_lead_somewhere():
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\((?!https?://|#)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site; warnings are errors."""
    folder = tmp_path_factory.mktemp("site")
    # In a process of its own: Sphinx 9 itself uses what Python will drop.
    made = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    done = subprocess.run(
        [*made, ROOT / "docs", folder], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    return folder


@pytest.mark.slow
def test_the_site_has_every_page(site):
    every = {page.stem for page in (ROOT / "docs").glob("*.md")}
    assert every == {page.stem for page in site.glob("*.html")} - {"genindex", "search"}


@pytest.mark.slow
def test_the_site_loads_nothing_from_elsewhere(site):
    """Formulas included: they are MathML, which needs no script."""
    for page in site.rglob("*.html"):
        for tag in re.findall(r"<(?:script|link|img|iframe)\b[^>]*>", page.read_text()):
            assert not re.search(r"(?:src|href)=[\"'](?:https?:)?//", tag), f"{page.name}: {tag}"
    text = (site / "algorithms.html").read_text()
    source = (ROOT / "docs" / "algorithms.md").read_text()
    blocks = source.count("$$") // 2
    assert text.count('<div class="math"><math') == blocks > 20
    inline = re.findall(r"\$[^$]+\$", re.sub(r"\$\$.*?\$\$", "", source, flags=re.DOTALL))
    assert text.count("<math ") == blocks + len(inline)
    assert "$" not in re.sub(r"<(script|pre|code)\b.*?</\1>", "", text, flags=re.DOTALL)
