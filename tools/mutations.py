"""Change one operator, bound or constant of starcat at a time; count the changes that tests find.

    python -m pytest -q -n 2 -m 'not slow and not real' --cov=starcat --cov-branch \\
        --cov-context=test --cov-report=  &&  coverage json --show-contexts -o lines.json
    python tools/mutations.py lines.json [--count 60] [--seed 1] [--slow] [--output found.json]

The first command needs pytest-cov. It writes which tests execute each line. Each change is tried
with up to ``--most`` tests that execute its line, the tests of the least code first, until one
fails. ``--slow`` runs tests that are marked slow, too. Real data is not used.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
LIMIT_S = 240.0
"""Longest run of the tests of a change; a change that makes them run longer is found."""

OTHERS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Add: ("+", "-"), ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
    ast.And: (" and ", " or "), ast.Or: (" or ", " and "),
}  # fmt: skip


class Change(NamedTuple):
    """Characters of a file, and the ones that replace them."""

    path: str
    line: int
    start: int
    old: str
    new: str


def changes(path: Path) -> list[Change]:
    """Return every change of one module."""
    lines = path.read_bytes().splitlines()
    name, found = path.relative_to(ROOT).as_posix(), []
    tree = ast.parse(path.read_bytes())
    skipped = {
        id(part)
        for node in ast.walk(tree)
        for note in (getattr(node, "annotation", None), getattr(node, "returns", None))
        if note is not None
        for part in ast.walk(note)
    }
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            text = lines[node.lineno - 1][node.col_offset : node.end_col_offset].decode()
            new = (
                str(node.value + 1) if isinstance(node.value, int) else repr(node.value * 1.2 + 0.1)
            )
            found.append(Change(name, node.lineno, node.col_offset, text, new))
            continue
        for left, operator, right in _operators(node):
            if left.end_lineno != right.lineno or type(operator) not in OTHERS:
                continue
            old, new = OTHERS[type(operator)]
            between = lines[left.end_lineno - 1][left.end_col_offset : right.col_offset].decode()
            if between.strip(" ()") == old.strip():
                start = (left.end_col_offset or 0) + between.index(old)
                found.append(Change(name, right.lineno, start, old, new))
    return found


def _operators(node: ast.AST) -> list[tuple[ast.expr, ast.AST, ast.expr]]:
    if isinstance(node, ast.BinOp):
        return [(node.left, node.op, node.right)]
    if isinstance(node, ast.BoolOp):
        return [(a, node.op, b) for a, b in zip(node.values, node.values[1:], strict=False)]
    if isinstance(node, ast.Compare):
        sides = [node.left, *node.comparators]
        return list(zip(sides, node.ops, sides[1:], strict=False))
    return []


def changed(change: Change) -> bytes:
    """Return the module with the change."""
    lines = (ROOT / change.path).read_bytes().splitlines(keepends=True)
    line = lines[change.line - 1]
    end = change.start + len(change.old.encode())
    lines[change.line - 1] = line[: change.start] + change.new.encode() + line[end:]
    return b"".join(lines)


def tests_of(covered: dict[str, Any], change: Change, sizes: Counter[str]) -> list[str]:
    """Return the tests that execute the line of a change, the tests of the least code first.

    For a line that runs when the module is imported they are the tests of the whole module.
    """
    lines = covered[change.path]["contexts"]
    named = _names(lines.get(str(change.line), []))
    if not named and str(change.line) in lines:
        named = {name for contexts in lines.values() for name in _names(contexts)}
    return sorted(named, key=lambda one: (sizes[one], one))


def _names(contexts: list[str]) -> set[str]:
    return {one.partition("|")[0] for one in contexts if "::" in one}


def is_found(change: Change, tests: list[str], *, slow: bool) -> str | None:
    """Return the first line of the failure with the change, or None."""
    path = ROOT / change.path
    before = path.read_bytes()
    marked = "not real" if slow else "not slow and not real"
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", marked]
    try:
        path.write_bytes(changed(change))
        ran = subprocess.run(
            [*command, *tests], cwd=ROOT, capture_output=True, text=True, timeout=LIMIT_S,
            env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return "timeout"
    finally:
        path.write_bytes(before)
    if "ERROR: not found" in ran.stderr:  # the change is in the name of a test, so that none ran
        return None
    said = [line for line in ran.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return (said or [ran.stdout[-200:]])[0] if ran.returncode not in (0, 5) else None


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("lines", type=Path)
    options.add_argument("--count", type=int, default=60)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--most", type=int, default=40, help="tests of a change")
    options.add_argument("--slow", action="store_true")
    options.add_argument("--output", type=Path)
    asked = options.parse_args()
    covered = json.loads(asked.lines.read_text())["files"]
    sizes = Counter(
        name
        for file in covered.values()
        for contexts in file["contexts"].values()
        for name in _names(contexts)
    )
    every = [one for path in sorted((ROOT / "starcat").rglob("*.py")) for one in changes(path)]
    found: list[dict[str, Any]] = []
    for change in random.Random(asked.seed).sample(every, asked.count):
        tests = tests_of(covered, change, sizes) if change.path in covered else []
        by = is_found(change, tests[: asked.most], slow=asked.slow) if tests else None
        found.append({**change._asdict(), "tests": len(tests), "found_by": by})
        sys.stdout.write(
            f"{change.path}:{change.line} {change.old.strip()} -> "
            f"{change.new.strip()}: {len(tests)} tests, {by or 'NOT FOUND'}\n"
        )
        sys.stdout.flush()
    count = sum(one["found_by"] is not None for one in found)
    sys.stdout.write(f"{count} of {len(found)} changes of {len(every):,} are found\n")
    if asked.output:
        asked.output.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
