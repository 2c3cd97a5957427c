# SPDX-License-Identifier: MIT
"""Count the findings of cppcheck's MISRA addon by rule, with README.md's reason for each.

    misra.py FOLDER

Fails if a rule is broken that README.md does not explain, or in other files than it says.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import pages

ONBOARD = Path(__file__).resolve().parents[2]
FLAGS = [
    "--std=c99",
    "--enable=warning,style,performance,portability",
    "--addon=misra",
    "-USTARCAT_MATH_HEADER",
]

MOST_FILES = 3
"""Files that README.md lists by name; of more it has the number."""


class Record(NamedTuple):
    """A row of README.md's table of deviations."""

    rule: str
    category: str
    files: str
    why: str
    risk: str


def recorded() -> list[Record]:
    """Return the rows of README.md's table."""
    text = (ONBOARD / "README.md").read_text(encoding="utf-8")
    section = text.split("## MISRA C:2012")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("| ")]
    records = [Record(*(cell.strip() for cell in row)) for row in rows[1:]]
    return [
        record._replace(rule=record.rule.strip("`"), files=record.files.replace("`", ""))
        for record in records
    ]


def findings() -> dict[str, set[tuple[str, str]]]:
    """Return the places of each finding, of both precisions."""
    sources = sorted(str(path.relative_to(ONBOARD)) for path in (ONBOARD / "src").glob("*.c"))
    found: dict[str, set[tuple[str, str]]] = {}
    for single in ("-DSTARCAT_SINGLE", "-USTARCAT_SINGLE"):
        command = [
            "cppcheck",
            "--quiet",
            *FLAGS,
            single,
            "--template={id},{file},{line}",
            "-Iinclude",
            *sources,
        ]
        done = subprocess.run(command, cwd=ONBOARD, capture_output=True, text=True, check=False)
        for rule, file, line in re.findall(r"^([\w.-]+),(.+),(\d+)$", done.stderr, re.MULTILINE):
            found.setdefault(rule.removeprefix("misra-c2012-"), set()).add((file, line))
    return found


def in_words(by_file: Counter[str]) -> str:
    """Return the files of a deviation as README.md has them."""
    return ", ".join(sorted(by_file)) if len(by_file) <= MOST_FILES else f"{len(by_file)} files"


def main(folder: Path) -> int:
    records, found = {record.rule: record for record in recorded()}, findings()
    wrong = [f"{rule}: found, and not in README.md" for rule in sorted(set(found) - set(records))]
    rows = []
    for rule, record in records.items():
        by_file = Counter(Path(file).name for file, _ in found.get(rule, set()))
        if in_words(by_file) != record.files:
            wrong.append(f"{rule}: README.md has {record.files}; found: {in_words(by_file)}")
        rows.append(
            [
                rule,
                record.category,
                str(sum(by_file.values())),
                ", ".join(f"{name} {n}" for name, n in sorted(by_file.items())),
                record.why,
                record.risk,
            ]
        )
    count = sum(len(places) for places in found.values())
    figure = (
        f"{count} places of {len(found)} rules, {len(set(found) & set(records))} of them explained"
    )
    pages.write(
        folder / "misra.html",
        "MISRA C:2012",
        f"<p>{figure}. Found by cppcheck's addon in src/ and include/, in both precisions; rules "
        "that are not listed are kept, as far as the addon checks them.</p>",
        pages.table(["rule", "category", "places", "where", "why", "risk"], rows),
        pages.table(["fail"], [[f"fail: {line}"] for line in wrong]) if wrong else "",
    )
    print(*wrong, f"misra: {figure}", sep="\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
