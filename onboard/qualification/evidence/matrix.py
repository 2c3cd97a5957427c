# SPDX-License-Identifier: MIT
"""Make the matrix of requirements and tests; fail if it is not complete.

    matrix.py FOLDER

writes matrix.html and matrix.csv. A requirement without a test, a test that does not exist, and a
function of the unit test that no requirement names are errors.
"""

from __future__ import annotations

import csv
import re
import sys
import tomllib
from pathlib import Path

import pages

HERE = Path(__file__).resolve().parent
ONBOARD = HERE.parents[1]
FUNCTION = re.compile(r"^(?:static )?void ((?:test|check)_\w+)\(", re.MULTILINE)


def functions_of(file: Path) -> set[str]:
    """Return the test functions of a file."""
    text = file.read_text(encoding="utf-8")
    found = (
        FUNCTION.findall(text)
        if file.suffix == ".c"
        else re.findall(r"^def (test_\w+)", text, re.M)
    )
    return set(found)


def problem(test: str, targets: set[str]) -> str:
    """Say what is wrong with a test that a requirement names; nothing if it exists."""
    kind, _, name = test.partition(" ")
    if kind == "make":
        return "" if name in targets else "no such target"
    if kind == "proof":
        return "" if (HERE / "proofs" / f"{name}.c").exists() else "no such proof"
    file = ONBOARD.parent / kind if kind.startswith("tests/") else ONBOARD / "tests" / kind
    if not file.exists():
        alone = kind.startswith("tests/") and not (ONBOARD.parent / "tests").exists()
        return "" if alone else "no such file"
    return "" if name in functions_of(file) else "no such function"


def check(requirements: list[dict], targets: set[str]) -> list[str]:
    """Return what is missing."""
    wrong, named, seen = [], set(), set()
    for requirement in requirements:
        wrong += [f"{requirement['id']}: twice"] if requirement["id"] in seen else []
        seen.add(requirement["id"])
        wrong += [] if requirement["tests"] else [f"{requirement['id']}: no test"]
        for test in requirement["tests"]:
            named.add(test)
            fault = problem(test, targets)
            wrong += [f"{requirement['id']}: {test}: {fault}"] if fault else []
    for file in sorted((ONBOARD / "tests").glob("test_*.c")):
        for name in sorted(functions_of(file)):
            if f"{file.name} {name}" not in named:
                wrong.append(f"{file.name} {name}: named by no requirement")
    return wrong


def main(folder: Path) -> int:
    requirements = tomllib.loads((HERE / "requirements.toml").read_text(encoding="utf-8"))[
        "requirement"
    ]
    makefile = (ONBOARD / "Makefile").read_text(encoding="utf-8")
    targets = {
        name for line in re.findall(r"^([a-z -]+):", makefile, re.M) for name in line.split()
    }
    wrong = check(requirements, targets)
    folder.mkdir(parents=True, exist_ok=True)
    head = ["requirement", "text", "from", "verified by", "tests"]
    rows = [[r["id"], r["text"], r["from"], r["by"], "\n".join(r["tests"])] for r in requirements]
    with (folder / "matrix.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [head, *([*row[:4], row[4].replace("\n", "; ")] for row in rows)]
        )
    functions = sum(len(functions_of(file)) for file in (ONBOARD / "tests").glob("test_*.c"))
    figure = (
        f"{len(requirements)} requirements, {sum(len(r['tests']) for r in requirements)} links, "
        f"{functions} functions of the unit test, {len(wrong)} missing"
    )
    faults = pages.table(["fail"], [[f"fail: {line}"] for line in wrong]) if wrong else ""
    pages.write(
        folder / "matrix.html",
        "Requirements and tests",
        f"<p>{figure}</p>",
        faults,
        pages.table(head, rows),
    )
    print(f"matrix: {figure}", *wrong, sep="\n  ")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
