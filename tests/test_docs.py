"""Documentation that cannot drift: generated pages are fresh, README's commands work."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "builders"))

from docs import pages
from starcat import cli


@pytest.mark.parametrize("name", pages())
def test_generated_pages_are_what_make_docs_writes(name):
    assert (ROOT / "docs" / name).read_text() == pages()[name].rstrip() + "\n"


def commands(page):
    """Return the starcat commands of a page's console blocks, in order."""
    blocks = re.findall(r"```console\n(.*?)```", page.read_text(), re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line[2:] for line in lines if line.startswith("$ starcat ")]


WALKED = [
    "README.md",
    "docs/tutorial.md",
    "docs/howto-prove.md",
    "docs/howto-query.md",
    "docs/howto-release.md",
]


@pytest.mark.parametrize("name", WALKED)
def test_every_command_of_a_page_runs(name, catalogs, tmp_path, monkeypatch):
    found = commands(ROOT / name)
    assert found
    monkeypatch.setenv("STARCAT_CATALOGS", str(catalogs))
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


def test_links_between_pages_lead_somewhere():
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\((?!https?://|#)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_site_builds_without_a_warning(tmp_path):
    # In a process of its own: Sphinx 9 itself uses what Python will drop.
    made = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    done = subprocess.run(
        [*made, ROOT / "docs", tmp_path], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    every = {page.stem for page in (ROOT / "docs").glob("*.md")}
    assert every == {page.stem for page in tmp_path.glob("*.html")} - {"genindex", "search"}
