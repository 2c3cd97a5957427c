# SPDX-License-Identifier: MIT
"""Count the findings of cppcheck's MISRA addon by rule, with README.md's reason for each.

    misra.py FOLDER

Fails if a rule is broken that README.md does not explain, or if an explained rule is not broken.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pages

ONBOARD = Path(__file__).resolve().parents[2]
FLAGS = [
    "--std=c99",
    "--enable=warning,style,performance,portability",
    "--addon=misra",
    "-USTARCAT_MATH_HEADER",
]


def explained() -> dict[str, tuple[str, str]]:
    """Return where and why README.md says that rules are broken."""
    text = (ONBOARD / "README.md").read_text(encoding="utf-8")
    section = text.split("## MISRA C:2012")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `?([\w.]+)`? \| (.*?) \| (.*?) \|$", section, re.MULTILINE)
    return {rule: (where, why) for rule, where, why in rows if rule != "rule"}


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


def main(folder: Path) -> int:
    reasons, found = explained(), findings()
    wrong = [f"{rule}: found, and not in README.md" for rule in sorted(set(found) - set(reasons))]
    wrong += [f"{rule}: in README.md, and not found" for rule in sorted(set(reasons) - set(found))]
    rows = []
    for rule, (_, why) in reasons.items():
        by_file = Counter(Path(file).name for file, _ in found.get(rule, set()))
        rows.append(
            [
                rule,
                str(sum(by_file.values())),
                ", ".join(f"{name} {n}" for name, n in sorted(by_file.items())),
                why,
            ]
        )
    count = sum(len(places) for places in found.values())
    figure = (
        f"{count} places of {len(found)} rules, {len(set(found) & set(reasons))} of them explained"
    )
    pages.write(
        folder / "misra.html",
        "MISRA C:2012",
        f"<p>{figure}. Found by cppcheck's addon in src/ and include/, in both precisions; rules "
        "that are not listed are kept, as far as the addon checks them.</p>",
        pages.table(["rule", "places", "where", "why"], rows),
        pages.table(["fail"], [[f"fail: {line}"] for line in wrong]) if wrong else "",
    )
    print(*wrong, f"misra: {figure}", sep="\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
