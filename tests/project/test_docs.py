"""Documentation that cannot drift: commands and snippets run, links lead somewhere."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import duckdb
import pytest
from programs import printed_by

from starcat.cli import REFERENCE
from starcat.cli import main as cli
from starcat.cli.reference import every_command

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def written_pages():
    """Return the hand-written pages, without the generated pages of reference."""
    return [page for page in DOCS.glob("*.md") if page.stem not in REFERENCE]


def commands(page):
    """Return the starcat commands of a page's console blocks, in order."""
    blocks = re.findall(r"```console\n(.*?)```", page.read_text(), re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line[2:] for line in lines if line.startswith("$ starcat ")]


WALKED = [
    "README.md",
    "docs/tutorial-photo.md",
    "docs/tutorial.md",
    "docs/tutorial-flight.md",
    "docs/howto-prove.md",
    "docs/howto-calibrate.md",
    "docs/howto-new-release.md",
    "docs/howto-plan.md",
    "docs/howto-query.md",
    "docs/howto-release.md",
    "docs/howto-own-catalog.md",
]


@pytest.mark.parametrize("name", WALKED)
def test_every_command_of_a_page_is_understood(name):
    """Its options and arguments exist in the command; the slow test runs it."""
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
    monkeypatch.chdir(tmp_path)
    text = (ROOT / name).read_text()
    for spec in re.findall(r"```toml\n# (\S+)\n(.*?)```", text, re.DOTALL):
        Path(spec[0]).write_text(spec[1])
    for command in found:
        arguments = shlex.split(command)
        if arguments[1] == "fetch":  # needs the archives' servers; test_fetch has its own
            continue
        monkeypatch.setattr(sys, "argv", arguments)
        with pytest.raises(SystemExit) as done:
            cli.main()
        assert not done.value.code, command
    for snippet in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        printed_by("-W", "error", "-c", snippet, cwd=tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["README.md", "docs/index.md"])
def test_the_first_program_prints_what_the_page_shows(name, tmp_path):
    text = (ROOT / name).read_text()
    [(program, shown)] = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", text, re.DOTALL)
    assert printed_by("-W", "error", "-c", program, cwd=tmp_path) == shown


@pytest.mark.slow
def test_the_tutorial_of_flight_runs_with_the_c_library(tmp_path, monkeypatch):
    if shutil.which("cc") is None:
        pytest.skip("no C compiler")
    text = (DOCS / "tutorial-flight.md").read_text()
    monkeypatch.chdir(tmp_path)
    for command in commands(DOCS / "tutorial-flight.md")[:2]:
        monkeypatch.setattr(sys, "argv", shlex.split(command))
        with pytest.raises(SystemExit):
            cli.main()
    script, shown = re.search(r"```sh\n(.*?)```\n\n```text\n(.*?)```", text, re.DOTALL).groups()
    head = f'set -eu\nSTARCAT="{ROOT}"\nstarcat() {{ "{sys.executable}" -m starcat "$@"; }}\n'
    ran = subprocess.run(["bash", "-c", head + script], capture_output=True, text=True, check=True)
    said = ran.stdout.splitlines()
    assert "status 0" in said[0]
    assert "17 stars, chance below 1e-62" in said[1]
    first, _, *centroids, rest = shown.splitlines()
    assert first == said[0]
    assert centroids == said[2 : 2 + len(centroids)]
    assert (rest, len(said)) == ("...", 22)


def test_the_two_kinds_of_steps_are_distinguished():
    """The numpy matcher and the C library count other things, a thousand times apart in time."""
    for text in (REFERENCE["cli"](), (DOCS / "onboard.md").read_text()):
        words = " ".join(text.split())
        assert re.search(r"[Cc]andidates that the numpy matcher .{0,14}, 2 to 20 micro", words)
    text = " ".join((DOCS / "algorithms.md").read_text().split())
    assert "A step takes 2 to 20 µs" in text
    assert "1 to 5 ns each (`options.max_steps`)" in text


def test_files_of_examples_have_names_that_sql_takes_as_they_are():
    """A file is a table of its name, but BOTH, for instance, is a word of SQL."""
    texts = [page.read_text() for page in (ROOT / "README.md", DOCS / "scale.md")]
    for text in (*texts, REFERENCE["cli"]()):
        names = re.findall(r"-o (\w+)\.parquet", text)
        assert names
        for table in names:
            duckdb.sql(f"SELECT * FROM (SELECT 1) AS {table}")


def test_links_between_pages_lead_somewhere():
    for page in [*ROOT.glob("*.md"), ROOT / "onboard" / "README.md", *written_pages()]:
        for target in re.findall(r"\]\((?!https?://|#)([^)#]+)", page.read_text()):
            is_page = target.removesuffix(".md") in REFERENCE and page.parent == DOCS
            assert is_page or (page.parent / target).exists(), f"{page.name}: {target}"


def test_pages_of_reference_are_not_kept():
    """They are made from the program, which the copy could contradict."""
    listed = (ROOT / ".gitignore").read_text()
    assert all(f"/docs/{name}.md\n" in listed for name in REFERENCE)


@pytest.mark.parametrize("name", REFERENCE)
def test_a_page_of_reference_has_tables_or_blocks(name):
    text = REFERENCE[name]()
    assert re.match(r"# [A-Z]", text)
    assert text.count("\n## ") + text.count("\n### ") >= 4
    assert "|---" in text or "```" in text


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site; warnings are errors."""
    folder = tmp_path_factory.mktemp("site")
    # In a process of its own: Sphinx 9 itself uses what Python will drop.
    made = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    done = subprocess.run([*made, DOCS, folder], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return folder


@pytest.mark.slow
def test_the_site_has_every_page(site):
    every = {page.stem for page in written_pages()} | REFERENCE.keys()
    assert every == {page.stem for page in site.glob("*.html")} - {"genindex", "search"}


@pytest.mark.slow
def test_the_search_finds_the_words_of_readers(site):
    index = (site / "searchindex.js").read_text()
    for word in ("quaternion", "nois", "blend", "lens"):  # stems, as the index has them
        assert re.search(rf'[{{,]"?{word}"?:', index), word


@pytest.mark.slow
def test_the_site_loads_nothing_from_elsewhere(site):
    """Formulas included: they are MathML, which needs no script."""
    for page in site.rglob("*.html"):
        for tag in re.findall(r"<(?:script|link|img|iframe)\b[^>]*>", page.read_text()):
            assert not re.search(r"(?:src|href)=[\"'](?:https?:)?//", tag), f"{page.name}: {tag}"
    count = 0
    for source in DOCS.glob("algorithms*.md"):
        text, written = (site / f"{source.stem}.html").read_text(), source.read_text()
        blocks = written.count("$$") // 2
        count += blocks
        assert text.count('<div class="math"><math') == blocks > 3
        inline = re.findall(r"\$[^$]+\$", re.sub(r"\$\$.*?\$\$", "", written, flags=re.DOTALL))
        assert text.count("<math ") == blocks + len(inline)
        assert "$" not in re.sub(r"<(script|pre|code)\b.*?</\1>", "", text, flags=re.DOTALL)
    assert count > 20
