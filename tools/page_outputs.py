"""Run the commands and snippets of documentation pages, and compare or rewrite their outputs.

A page is one session of a shell in an empty folder. These blocks are run, from top to bottom:

- ``console``: lines that begin with ``$`` are commands. The lines below a command are its output.
- ``python``: a program. A ``text`` block that follows it is its output. A snippet that does not
  begin with an import continues the program of the snippet above it.
- a block of any language whose first line is ``# NAME.SUFFIX`` is a file of this name.

Blocks of other languages (``sh``, ``py``, ``text``) are not run.

In an output a line ``...`` stands for any number of lines. ``~`` before a figure means that the
figure differs between runs or machines, such as a time or a date (`VARYING`). The other figures
have to be equal, up to two units of the last digit or one part in ten million.

The page ``notebook-NAME.md`` has the cells of ``notebooks/NAME.py``, and the figures that each cell
draws.

``make docs-outputs`` rewrites the outputs of all pages. A rewritten output keeps as many lines
above and below its ``...`` as the page has.
"""

from __future__ import annotations

import os
import re
import shlex
import socket
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
MAX_LINES = 24
"""Lines of an output that a page shows in full if nobody has shortened it."""
HEAD_LINES, TAIL_LINES = 14, 3
MAX_WIDTH = 118
"""Longer lines, which a terminal wraps, are folded; their other lines begin with four blanks."""
ADDRESS = "127.0.0.1:8000"

BLOCK = re.compile(r"^```(\w+)\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", re.DOTALL | re.MULTILINE)
FILE_NAME = re.compile(r"# ([\w-]+\.\w+)(?:, [^\n]*)?\n")
IS_PROGRAM = re.compile(r"(?:#[^\n]*\n)*(?:import|from) ")
NUMBER = re.compile(r"[+-]?\d[\d,]*(?:\.\d+)?(?:[eE][+-]?\d+)?")

_FIGURE = r"\d[\d,]*(?:\.\d+)?(?:e[+-]\d+)?"
VARYING = (
    # Computing times, and what is estimated from the cores and the memory of the machine.
    re.compile(rf'(?<=time_s)"?:?\s+()(?={_FIGURE})'),
    re.compile(rf"(?<![\d.,-])()(?={_FIGURE} (?:ms|µs|s|seconds?|minutes?)\b)"),
    re.compile(r"\[[\d.]+, [\d.]+\](?: +[\d.]+){3} +()(?=[\d.]+$)"),  # "ms" of `starcat evaluate`
    re.compile(r"^(?:read|select|products|write|self-test|report|verify|total) +()(?=[\d.]+$)"),
    # Dates of signatures and of jobs, numbers of keys, tokens and jobs, which are random.
    re.compile(r"()(?=\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?(?:Z|\+00:00))"),
    re.compile(r"()(?=\d{4}-\d\d-\d\d$)"),
    re.compile(r"^()(?=[0-9a-f]{8}  )"),
    # Bytes of a release or of numbers as text, and checksums of an image: the last digits of
    # computed numbers in them depend on the processor (docs/decisions.md).
    re.compile(r"^(?:new )?bytes +()(?=[1-9][\d,]*$)"),
    re.compile(r"\b()(?=0x[0-9a-f]{8}\b)"),
    re.compile(r"(?<=csv, )()(?=[\d,]+ bytes)"),
    # Random keys, and digests, in which the versions of libraries are.
    re.compile(r"(?<![\w.])()(?=[0-9a-f]{64}\b|[0-9a-f]{16}\b)(?!\d+\b)"),
)
"""Places in a line of an output before which ``~`` marks a figure that varies."""
DIGEST = re.compile(r"~[0-9a-f]{16}")


@dataclass(frozen=True)
class Step:
    """A command or a snippet of a page, with the output that the page shows."""

    text: str
    is_python: bool
    shown: tuple[str, ...]
    start: int
    """Where the output begins in the text of the page."""
    end: int


def steps_of(page: str) -> list[Step]:
    """Return what a page runs, in its order."""
    found = []
    for block in BLOCK.finditer(page):
        language, text = block[1], block[2]
        if FILE_NAME.match(text):
            continue
        if language == "python":
            shown = () if block[3] is None else tuple(block[3].splitlines())
            found.append(Step(text, True, shown, block.end(2) + len("```\n"), block.end()))
        elif language == "console":
            found += _commands_of(text, block.start(2))
    return found


def _commands_of(text: str, offset: int) -> list[Step]:
    """Return the commands of a block, each with the lines below it."""
    found = []
    for one in re.finditer(r"^\$ ((?:.*\\\n)*.*\n)((?:(?!\$ ).*\n)*)", text, re.MULTILINE):
        shown = tuple(one[2].splitlines())
        found.append(Step(one[1], False, shown, offset + one.start(2), offset + one.end(2)))
    return found


def files_of(page: str) -> dict[str, str]:
    """Return the files that a page shows, by name."""
    found = {}
    for block in BLOCK.finditer(page):
        if name := FILE_NAME.match(block[2]):
            found[name[1]] = block[2]
    return found


def free_port() -> int:
    """Return a port of this machine that nothing listens at."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


FIGURES = """
_plots = __import__("sys").modules.get("matplotlib.pyplot")
for _number in _plots.get_fignums() if _plots else ():
    _plots.figure(_number).savefig(f"figure_{step}_{_number}.png", dpi=72)
if _plots:
    _plots.close("all")
"""
"""Code after a snippet: it saves the figures that the snippet has drawn."""
DRAWN = re.compile(r"\.plot\(\"([\w-]+\.png)\"\)")
"""A call in a snippet that writes a picture of a result."""

HEAD = """\
starcat() { "$PYTHON" -m starcat "$@"; }
python() { "$PYTHON" "$@"; }
python3() { "$PYTHON" "$@"; }
finish() { code=$?; if [ -f .server.pid ]; then kill "$(cat .server.pid)"; wait; fi; exit $code; }
trap finish EXIT
"""
SERVER = """\
"$PYTHON" -m starcat serve {options} --port {port} > .server.log 2>&1 &
echo $! > .server.pid
curl -s --retry 60 --retry-connrefused --retry-delay 1 -o /dev/null http://127.0.0.1:{port}/readyz
grep -v '^{{' .server.log
"""


def script_of(steps: Sequence[Step], mark: str, port: int) -> str:
    """Return the session of a page as a script of bash that prints ``mark`` after each step."""
    lines = [HEAD]
    for number, step in enumerate(steps):
        if step.is_python and not IS_PROGRAM.match(step.text):
            continue  # its program has been run with it
        if step.is_python:
            program = step.text
            for at in range(number + 1, len(steps)):
                if steps[at].is_python and IS_PROGRAM.match(steps[at].text):
                    break
                if steps[at].is_python:
                    program += FIGURES.replace("{step}", str(number))
                    program += f"\nprint('\\n{mark}', {number}, 0)\n{steps[at].text}"
                    number = at
            program += FIGURES.replace("{step}", str(number))
            lines.append(f'"$PYTHON" -W error::DeprecationWarning -c {shlex.quote(program)}')
        elif step.text.startswith("starcat serve "):
            options = step.text.removeprefix("starcat serve ").strip()
            lines.append(SERVER.format(options=options, port=port))
        else:
            lines.append(step.text.rstrip("\n"))
        end = f'code=$?; printf "\\n{mark} {number} $code\\n"; [ $code = 0 ] || exit $code'
        lines.append(end)
    return "\n".join(lines).replace(ADDRESS, f"127.0.0.1:{port}")


def run_page(page: str, folder: Path, environment: Mapping[str, str]) -> list[list[str]]:
    """Run a page in an empty folder; return what each of its steps printed.

    Raises
    ------
    RuntimeError
        If a step fails; the message has its output.
    """
    steps, mark, port = steps_of(page), "--- end of step", free_port()
    for name, text in files_of(page).items():
        (folder / name).write_text(text, encoding="utf-8")
    settings = {
        "PYTHON": sys.executable,
        "PYTHONUNBUFFERED": "1",
        "MPLBACKEND": "Agg",
        "STARCAT": str(ROOT),
        "XDG_STATE_HOME": str(folder / ".state"),
    }
    done = subprocess.run(
        ["bash", "-c", script_of(steps, mark, port)],
        cwd=folder,
        env={**os.environ, **settings, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        stdin=subprocess.DEVNULL,
        text=True,
        check=False,
    )
    printed = done.stdout.replace(f"127.0.0.1:{port}", ADDRESS)
    printed = printed.replace(str(ROOT), "$STARCAT").replace(f"{folder}/", "")
    parts = re.split(rf"^{mark} (\d+) 0\n", printed, flags=re.MULTILINE)
    outputs = dict(zip(map(int, parts[1::2]), parts[::2], strict=False))
    if done.returncode or len(outputs) != len(steps):
        failed = next(number for number in range(len(steps)) if number not in outputs)
        raise RuntimeError(f"{steps[failed].text}\n{parts[-1]}"[-4000:])
    return [marked(outputs[number]) for number in range(len(steps))]


def marked(printed: str) -> list[str]:
    """Return the lines of an output with ``~`` before each figure that varies."""
    found = []
    for line in map(str.rstrip, printed.splitlines()):
        places = {match.start(1) for rule in VARYING for match in rule.finditer(line)}
        for place in sorted(places, reverse=True):
            line = line[:place] + "~" + line[place:]
        found += textwrap.wrap(
            line, MAX_WIDTH, subsequent_indent="    ", break_long_words=False,
            break_on_hyphens=False, drop_whitespace=len(line) > MAX_WIDTH,
        ) or [""]  # fmt: skip
    while found and not found[-1]:
        found.pop()
    return found


def _compared(line: str) -> list[str]:
    """Return the words of a line, those that vary without their figures."""
    return re.sub(r"~[^\s;)]*[^\s,;)]", "~", line).split()


def is_same_word(shown: str, printed: str) -> bool:
    """Return whether two words are equal but for the last digit of their numbers."""
    if shown == printed:
        return True
    if NUMBER.sub("#", shown) != NUMBER.sub("#", printed):
        return False
    for first, second in zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True):
        if "." not in first:
            if first != second:
                return False
            continue
        digits, _, power = first.lower().partition("e")
        unit = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
        a, b = (float(number.replace(",", "")) for number in (first, second))
        if abs(a - b) > max(2.1 * unit, 1e-7 * abs(a)):
            return False
    return True


def is_same_line(shown: str, printed: str) -> bool:
    """Return whether a line of a page is what was printed, widths of columns apart."""
    first, second = _compared(shown), _compared(printed)
    if "~" in shown or "~" in printed:  # a column is as wide as its widest figure
        first, second = ([re.sub("─+", "─", word) for word in line] for line in (first, second))
    return len(first) == len(second) and all(map(is_same_word, first, second))


def difference(shown: Sequence[str], printed: Sequence[str]) -> str | None:
    """Return the first line in which an output differs from the page, or ``None``."""
    if "..." in shown:
        at = shown.index("...")
        tail = len(shown) - at - 1
        if len(printed) < at + tail:
            return f"the page shows {at + tail} lines; printed are {len(printed)}: {printed}"
        printed = [*printed[:at], *printed[len(printed) - tail :]]
        shown = [*shown[:at], *shown[at + 1 :]]
    for first, second in zip(shown, printed, strict=False):
        if not is_same_line(first, second):
            return f"the page shows\n  {first}\nprinted is\n  {second}"
    if len(shown) != len(printed):
        return f"the page shows {len(shown)} lines; printed are {len(printed)}: {printed[:40]}"
    return None


def shortened(printed: Sequence[str], shown: Sequence[str]) -> list[str]:
    """Return an output as a page shows it, with as many lines as it shows now."""
    if "..." in shown:
        head, tail = shown.index("..."), len(shown) - shown.index("...") - 1
    elif len(printed) <= MAX_LINES:
        return list(printed)
    else:
        head, tail = HEAD_LINES, TAIL_LINES
    if head + tail >= len(printed):
        return list(printed)
    return [*printed[:head], "...", *printed[len(printed) - tail :]]


def rewritten(page: str, outputs: Iterable[Sequence[str]]) -> str:
    """Return a page with the outputs of its steps; equal outputs stay as they are.

    If any output of a page differs, those with digests are rewritten too, so that a digest is the
    same in all outputs.
    """
    pairs = list(zip(steps_of(page), outputs, strict=True))
    is_equal = [difference(step.shown, printed) is None for step, printed in pairs]
    if all(is_equal):
        return page
    for (step, printed), is_kept in reversed(list(zip(pairs, is_equal, strict=True))):
        if is_kept and not any(map(DIGEST.search, step.shown)):
            continue
        text = "".join(f"{line}\n" for line in shortened(printed, step.shown))
        if step.is_python:
            text = f"\n```text\n{text}```\n" if text else ""
        page = page[: step.start] + text + page[step.end :]
    return page


def cells_of(notebook: str) -> list[tuple[bool, str]]:
    """Return the cells of a notebook: whether each is code, and its text."""
    found = []
    for cell in re.split(r"^# %%", notebook, flags=re.MULTILINE)[1:]:
        head, _, text = cell.partition("\n")
        is_code = "[markdown]" not in head
        text = text.strip("\n") + "\n"
        found.append((is_code, text if is_code else re.sub("^# ?", "", text, flags=re.MULTILINE)))
    return found


def notebook_page(notebook: str) -> str:
    """Return a notebook as a page without outputs."""
    cells = cells_of(notebook)
    return "\n".join(f"```python\n{text}```\n" if is_code else text for is_code, text in cells)


def add_figures(page: str, name: str, folder: Path) -> str:
    """Copy what the steps of a page have drawn to the figures, and show it below their outputs."""
    from figures import FIGURES as PLACE
    from figures import save_small_png

    for number, step in reversed(list(enumerate(steps_of(page)))):
        drawn = [folder / file for file in DRAWN.findall(step.text)]
        drawn += sorted(folder.glob(f"figure_{number}_*.png"))
        for at, path in enumerate(drawn):
            title = f"{name}_{number}_{at}.png"
            save_small_png(path.read_bytes(), PLACE / title)
            image = f"\n![What the cell draws](figures/{title})\n"
            page = page[: step.end] + image + page[step.end :]
    return page


def pages() -> list[Path]:
    """Return the pages that have something to run."""
    found = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
    return [page for page in found if steps_of(page.read_text(encoding="utf-8"))]


def rewrite(path: Path, environment: Mapping[str, str]) -> None:
    """Run a page and write what its steps print into it."""
    notebook = DOCS / "notebooks" / f"{path.stem.removeprefix('notebook-')}.py"
    if path.stem.startswith("notebook-"):
        text = notebook_page(notebook.read_text(encoding="utf-8"))
    else:
        text = path.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        outputs = run_page(text, Path(folder), environment)
        text = rewritten(text, outputs)
        if path.stem.startswith("notebook-"):
            text = add_figures(text, path.stem.replace("-", "_"), Path(folder))
    path.write_text(text, encoding="utf-8")
    sys.stderr.write(f"{path.name}: {len(outputs)} outputs\n")


def main() -> None:
    """Rewrite the outputs of the named pages, or of all."""
    sys.path.append(str(ROOT / "tests" / "builders"))
    from catalog_folder import write_catalog_folder

    with tempfile.TemporaryDirectory() as common:
        write_catalog_folder(Path(common))
        environment = {"STARCAT_CATALOGS": common, "STARCAT_CACHE": f"{common}/cache"}
        for name in sys.argv[1:] or pages():
            rewrite(Path(name), environment)


if __name__ == "__main__":
    main()
