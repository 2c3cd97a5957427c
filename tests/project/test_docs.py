"""Documentation that cannot drift: commands and snippets run, links lead somewhere."""

import posixpath
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import duckdb
import page_outputs
import pytest
from sphinx.util.inventory import InventoryFile
from typer import Exit

import starcat
from starcat.cli import REFERENCE
from starcat.cli.reference import every_command

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def written_pages():
    """Return the hand-written pages, without the generated pages of reference."""
    return [page for page in DOCS.glob("*.md") if page.stem not in REFERENCE]


PAGES = [path.relative_to(ROOT).as_posix() for path in page_outputs.pages()]


def steps(name):
    """Return the commands and snippets of a page, in order."""
    return page_outputs.steps_of((ROOT / name).read_text(encoding="utf-8"))


def calls(text):
    """Return the arguments of each call of starcat in a command of the shell."""
    words = shlex.shlex(text.replace("\\\n", " "), posix=True, punctuation_chars=True)
    words.whitespace_split = True
    found, is_inside = [], False
    for word in words:
        if word == "starcat":
            is_inside = True
            found.append([])
        elif set(word) <= set("|()<>;&"):
            is_inside = False
        elif is_inside:
            found[-1].append(word)
    return found


def test_all_tutorials_and_guides_are_run():
    guides = {path.name for kind in ("tutorial*", "howto-*") for path in DOCS.glob(f"{kind}.md")}
    tables = {"howto-which.md"}  # commands in tables, which are checked as options of messages are
    assert (guides - tables) | {"index.md"} <= {Path(name).name for name in PAGES}


@pytest.mark.parametrize("name", PAGES)
def test_every_command_of_a_page_is_understood(name):
    """Its options and arguments exist in the command; the slow test runs it."""
    known = every_command()
    for step in steps(name):
        for words in [] if step.is_python else calls(step.text):
            if words[0] == "--server":
                words = words[2:]
            count = 2 if " ".join(words[:2]) in known else 1
            command = " ".join(words[:count])
            with suppress(Exit):  # an option that prints and ends, such as --ecss-example
                known[command].make_context(command, words[count:])


@pytest.mark.parametrize("name", PAGES)
def test_every_command_that_prints_is_followed_by_its_output(name):
    """These commands always print; the slow test compares the outputs of all."""
    for step in steps(name):
        prints = step.text.startswith("starcat ") and ">" not in step.text
        if prints or "print(" in step.text:
            assert step.shown, f"{name}: {step.text}: run make docs-outputs"


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", PAGES)
def test_every_command_of_a_page_prints_what_the_page_shows(name, catalogs, tmp_path):
    """If a page differs on purpose, ``make docs-outputs`` writes what is printed into it."""
    text = (ROOT / name).read_text(encoding="utf-8")
    if re.search(r"^\$ cc ", text, re.MULTILINE) and shutil.which("cc") is None:
        pytest.skip("no C compiler")
    outputs = page_outputs.run_page(text, tmp_path, {"STARCAT_CATALOGS": str(catalogs)})
    for step, printed in zip(steps(name), outputs, strict=True):
        found = page_outputs.difference(step.shown, printed)
        assert found is None, f"$ {step.text}{found}"


@pytest.mark.parametrize(
    ("shown", "printed", "is_same"),
    [
        ("roll_deg  287.3451", "roll_deg 287.3452", True),
        ("roll_deg  287.3451", "roll_deg 287.3455", False),
        ("chance 2.15e-63", "chance 2.16e-63", True),
        ("arcsec 25.369883120337253", "arcsec 25.369883120339111", True),
        ("chance 2.15e-63", "chance 2.15e-62", False),
        ("20 centroids", "21 centroids", False),
        ("identified", "no_match", False),
        ("time_s  ~0.0006", "time_s  ~1.25", True),
        ("time_s  ~0.0006", "time_s  0.0006", False),
        ("6,713 stars, ~4 s", "6,713 stars, ~11 s", True),
        ("~60,097,760 bytes, 3 files", "~60,095,603 bytes, 3 files", True),
        ("~60,097,760 bytes, 3 files", "~60,095,603 bytes, 4 files", False),
        ("6,713 stars, ~4 s", "6,714 stars, ~4 s", False),
    ],
)
def test_a_line_of_a_page_is_compared_by_words(shown, printed, is_same):
    assert page_outputs.is_same_line(shown, printed) is is_same


def test_an_output_is_shortened_and_compared_around_its_points():
    printed = [f"line {number}" for number in range(50)]
    shown = page_outputs.shortened(printed, ["line 0", "...", "old line", "last"])
    assert shown == ["line 0", "...", "line 48", "line 49"]
    assert page_outputs.difference(shown, printed) is None
    assert page_outputs.difference(["..."], []) is None
    for wrong in (["line 1", "..."], ["...", "line 48"], printed[:-1], [*printed, "line 50"]):
        assert page_outputs.difference(wrong, printed)
    assert page_outputs.difference(["line 0", "...", "line 1"], ["line 1"])


def test_figures_that_vary_get_a_mark():
    assert page_outputs.marked("time_s       0.000674\n   total   9.56 s\n\n") == [
        "time_s       ~0.000674",
        "   total   ~9.56 s",
    ]
    [rate] = page_outputs.marked("0.5  100.00 [92.9, 100.0]   100.00  100.00      0  4.9")
    assert rate.endswith("  0  ~4.9")
    [key] = page_outputs.marked(f"root  anna {16 * 'a'}  1  2036-11-25")
    assert key == f"root  anna ~{16 * 'a'}  1  ~2036-11-25"
    assert page_outputs.marked("new bytes  25,006,142\nnew bytes  0\ncrc 0x809d2270") == [
        "new bytes  ~25,006,142",
        "new bytes  0",
        "crc ~0x809d2270",
    ]
    for figure in ("Gaia DR3 1575017391376658", "separation 2.317810950862069e-07"):
        assert page_outputs.marked(figure) == [figure]
    long = "warning: " + 40 * "many words "
    assert max(map(len, page_outputs.marked(long))) <= page_outputs.MAX_WIDTH


PAGE = """\
```console
$ echo one \\
  two
old
$ true
```

```python
import math

print(math.pi)
```

```python
print(math.e)
```
"""


def test_the_outputs_of_a_page_are_run_and_rewritten(tmp_path):
    assert [step.is_python for step in page_outputs.steps_of(PAGE)] == [False, False, True, True]
    outputs = page_outputs.run_page(PAGE, tmp_path, {})
    assert outputs[:2] == [["one two"], []]
    written = page_outputs.rewritten(PAGE, outputs)
    assert "$ echo one \\\n  two\none two\n$ true\n```" in written
    assert "print(math.e)\n```\n\n```text\n2.718281828459045\n```\n" in written
    assert page_outputs.rewritten(written, outputs) == written
    first, second = f"key ~{16 * 'a'}", f"key ~{16 * 'b'}"
    shown = page_outputs.rewritten(PAGE, [["~2 s"], [first], *outputs[2:]])
    assert page_outputs.rewritten(shown, [["~3 s"], [second], *outputs[2:]]) == shown
    newer = page_outputs.rewritten(shown, [["~3 s"], [second], ["3.2"], *outputs[3:]])
    assert f"\n~2 s\n$ true\n{second}\n" in newer
    assert PAGE.replace("old\n", "one two\n") != written
    with pytest.raises(RuntimeError, match="nothing-of-this-name"):
        page_outputs.run_page("```console\n$ nothing-of-this-name\n```\n", tmp_path, {})


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
def test_other_projects_find_every_public_name(site):
    """As intersphinx reads the inventory: a name leads to the page that documents it."""
    with (site / "objects.inv").open("rb") as file:
        inventory = InventoryFile.load(file, "https://example.org", posixpath.join)
    objects = {name: entry for kind in inventory.values() for name, entry in kind.items()}
    for name in set(starcat.__all__) - {"__version__"}:
        assert "/python" in objects[f"starcat.{name}"].uri, name
    assert objects["starcat.Matcher"].uri == (
        "https://example.org/python-identify.html#starcat.Matcher"
    )
    assert "starcat.Matcher.identify" in objects


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
