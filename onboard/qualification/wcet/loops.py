# SPDX-License-Identifier: MIT
"""Compare the loops in the library's source with the loops that loops.txt lists.

Run as a program it prints the differences.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).resolve().parent
SOURCE = HERE.parents[1] / "src"
TABLE = HERE / "loops.txt"
FUNCTION = re.compile(r"^[A-Za-z_][^;{}#=]*?\b(\w+)\([^;{}]*\)\s*\{", re.MULTILINE)
LOOP = re.compile(r"\b(?:for|while) ?\(")


@dataclass
class Loop:
    """A loop: its place, its head, and how often it runs."""

    file: str
    function: str
    head: str
    first: int = 0  # line of the head
    body: int = 0  # line after the head
    last: int = 0
    longest: str = ""
    counts: str = ""


@dataclass
class Source:
    """Loops and functions of the library, by file."""

    loops: list[Loop] = field(default_factory=list)
    functions: dict[tuple[str, str], tuple[int, int]] = field(default_factory=dict)


def without_comments(text: str) -> str:
    """Blank comments and strings out; line numbers do not change."""
    return re.sub(
        r'/\*.*?\*/|//[^\n]*|"(?:\\.|[^"\\])*"',
        lambda found: re.sub(r"[^\n]", " ", found[0]),
        text,
        flags=re.DOTALL,
    )


def end_of(text: str, at: int, opening: str, closing: str) -> int:
    """The place behind the bracket that closes the one at a place."""
    depth = 0
    for k in range(at, len(text)):
        depth += (text[k] == opening) - (text[k] == closing)
        if depth == 0:
            return k + 1
    raise ValueError(f"no {closing} for the {opening} at {at}")


def read_file(path: Path, source: Source) -> None:
    text = without_comments(path.read_text(encoding="utf-8"))
    for head in FUNCTION.finditer(text):
        start = text.index("{", head.start())
        stop = end_of(text, start, "{", "}")
        name = head[1]
        lines = text.count("\n", 0, head.start()) + 1, text.count("\n", 0, stop) + 1
        source.functions[path.name, name] = lines
        for found in LOOP.finditer(text, start, stop):
            close = end_of(text, text.index("(", found.start()), "(", ")")
            opening = re.compile(r"\s*\{").match(text, close)
            if opening is None:
                raise ValueError(f"{path.name}: {name}: a loop without braces")
            last = end_of(text, opening.end() - 1, "{", "}")
            numbers = [text.count("\n", 0, at) + 1 for at in (found.start(), close, last)]
            told = " ".join(text[found.start() : close].split())
            source.loops.append(Loop(path.name, name, told, numbers[0], numbers[1] + 1, numbers[2]))


def read_source(folder: Path = SOURCE) -> Source:
    source = Source()
    for path in sorted([*folder.glob("*.c"), *folder.glob("*.h")]):
        read_file(path, source)
    return source


def rows_of(heading: str, table: Path = TABLE) -> list[list[str]]:
    """The rows of the table below a heading."""
    part = table.read_text(encoding="utf-8").split(f"\n## {heading}\n")[1].split("\n## ")[0]
    rows = [line.strip().strip("|") for line in part.splitlines() if line.startswith("|")]
    return [[cell.strip().strip("`") for cell in re.split(r"(?<!\\)\|", row)] for row in rows[2:]]


def check(source: Source) -> list[str]:
    """Give the loops their rows; returns what the table lacks, or has and should not."""
    listed = [(row[0], row[1], row[2].replace("\\|", "|")) for row in rows_of("Loops")]
    found = [(loop.file, loop.function, loop.head) for loop in source.loops]
    wrong = [f"not in loops.txt: {' '.join(loop)}" for loop in found if loop not in listed]
    wrong += [f"only in loops.txt: {' '.join(row)}" for row in listed if row not in found]
    functions = {(row[0], row[1]) for row in rows_of("Functions")}
    gone = sorted(functions - set(source.functions))
    wrong += [f"only in loops.txt: {' '.join(function)}" for function in gone]
    if wrong:
        return wrong
    if listed != found:
        return ["loops.txt has the loops in another order than the source"]
    for loop, row in zip(source.loops, rows_of("Loops"), strict=True):
        loop.longest, loop.counts = row[3], row[4]
    return [f"no count: {loop.head}" for loop in source.loops if not loop.counts]


def main() -> int:
    source = read_source()
    wrong = check(source)
    print("\n".join(wrong) or f"loops.txt has all {len(source.loops)} loops of the library")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
