# SPDX-License-Identifier: MIT
"""Write index.html of the evidence: every figure, with the command that made it.

    index.py FOLDER

reads steps.txt (lines of NAME, RESULT, COMMAND and TITLE, separated by tabs), and the last line
that each step printed.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import pages
import sbom

TOOLS = (
    "gcc",
    "clang",
    "clang-19",
    "frama-c",
    "cppcheck",
    "lcov",
    "arm-linux-gnueabihf-gcc",
    "python3",
)
PAGES = {
    "matrix": ["matrix.html", "matrix.csv"],
    "unit": ["unit.html"],
    "mcdc": ["mcdc.html"],
    "proofs": ["proofs.html"],
    "upsets": ["upsets.html", "upsets.csv"],
    "misra": ["misra.html"],
    "sbom": ["sbom.spdx.json"],
}


def version_of(tool: str) -> str:
    """Return the first line that a tool prints about its version."""
    if shutil.which(tool) is None:
        return "not there"
    flag = "-version" if tool == "frama-c" else "--version"
    done = subprocess.run([tool, flag], capture_output=True, text=True, check=False)
    return (done.stdout or done.stderr).splitlines()[0]


def link(name: str) -> str:
    return f'<a href="{name}">{name}</a>'


def main(folder: Path) -> int:
    rows, failed = [], 0
    for line in (folder / "steps.txt").read_text(encoding="utf-8").splitlines():
        name, result, command, title = line.split("\t")
        log = (folder / f"{name}.log").read_text(encoding="utf-8", errors="replace").strip()
        lines = log.splitlines() or ["nothing was printed"]
        figure = lines[0 if name == "size" else -1]
        links = [page for page in PAGES.get(name, []) if (folder / page).exists()]
        rows.append([title, result, figure, command, " ".join(map(link, [*links, f"{name}.log"]))])
        failed += result != "pass"
    commit, time = sbom.git("rev-parse", "HEAD"), sbom.epoch()
    when = datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d") if time else "no date is known"
    dirty = ", with changes" if sbom.git("status", "--porcelain", ".") else ""
    pages.write(
        folder / "index.html",
        f"Evidence of starcat onboard {sbom.version()}",
        f"<p>Commit {commit or 'unknown'}{dirty}, {when}. {link('README.md')} has the status "
        "codes and the tests; the page onboard-manual of the documentation has the promises.</p>",
        pages.table(["what", "result", "figure", "command", "pages"], rows),
        "<h2>Tools</h2>",
        pages.table(["tool", "version"], [[tool, version_of(tool)] for tool in TOOLS]),
    )
    width = max(len(row[0]) for row in rows)
    print(*(f"{row[0]:{width}}  {row[1]:5} {row[2]}" for row in rows), sep="\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
