"""Documentation that cannot drift: generated pages are fresh, README's commands work."""

import re
import shlex
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "builders"))

from docs import pages
from starcat import cli


@pytest.mark.parametrize("name", ["cli.md", "products.md", "sources.md", "reproduction.md"])
def test_generated_pages_are_what_make_docs_writes(name):
    assert (ROOT / "docs" / name).read_text() == pages()[name].rstrip() + "\n"


def commands(page):
    """Return the starcat commands of a page's console blocks, in order."""
    blocks = re.findall(r"```console\n(.*?)```", page.read_text(), re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line[2:] for line in lines if line.startswith("$ starcat ")]


@pytest.mark.parametrize("name", ["README.md", "docs/tutorial.md"])
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
