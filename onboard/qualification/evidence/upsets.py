# SPDX-License-Identifier: MIT
"""Flip bits of image, workspace and table of neighbours during calls, and count the results.

    upsets.py FOLDER FLIPS SEED [ASAN_CLANG]

runs upsets.c, half of the flips in double and half in single precision, and a twentieth of them
again under ASan and UBSan if a clang for that is given. Writes upsets.html and upsets.csv; fails
if an answer is wrong beyond the bound, if a call crashes or does not end, or if
starcat_scrub_image does not name the block of a flip.
"""

from __future__ import annotations

import csv
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pages

HERE = Path(__file__).resolve().parent
ONBOARD = HERE.parents[1]
OUTCOMES = ["none", "caught", "right", "wrong", "crash"]
WORDS = [
    "none: the same answer, in every number",
    "caught: no answer, or an error",
    "right: another answer, none of whose corners is off by more than two reaches of a match",
    "wrong: an attitude that is farther off",
    "crash: a call that dies, leaves its memory or does not end",
]
SANITIZE = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
Counts = dict[tuple[str, str], Counter[str]]


def build(folder: Path, compiler: list[str], hook: str, single: list[str]) -> Path:
    """Compile the library with a call at each basic block, and the program without."""
    folder.mkdir(parents=True, exist_ok=True)
    flags = [*compiler, "-std=c99", *single, f"-I{ONBOARD / 'include'}", f"-I{ONBOARD / 'tests'}"]
    objects = []
    for source in sorted((ONBOARD / "src").glob("*.c")):
        objects.append(folder / f"{source.stem}.o")
        command = [*flags, f"-fsanitize-coverage={hook}", "-c", source, "-o", objects[-1]]
        subprocess.run(command, check=True)
    own = [HERE / "upsets.c", ONBOARD / "tests" / "random_sky.c"]
    program = folder / "upsets"
    subprocess.run([*flags, *own, *objects, "-lm", "-o", program], check=True)
    return program


def run(program: Path, flips: int, seed: int, counts: Counts) -> dict[str, float]:
    """Run the program; add its counts to those given, and return its other numbers."""
    command = [program, str(flips), str(seed)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    print(done.stderr, end="")
    numbers = {}
    for row in csv.reader(done.stdout.splitlines()):
        if len(row) == 2:
            numbers[row[0]] = float(row[1])
        else:
            counts.setdefault((row[0], row[1]), Counter()).update(
                dict(zip(OUTCOMES, map(int, row[2:]), strict=True))
            )
    return numbers


def in_all(counts: Counts, where: str) -> list[str]:
    """Return the sums of one memory: image, workspace or table."""
    total = sum((count for (place, _), count in counts.items() if place == where), Counter())
    return [str(total[name]) for name in OUTCOMES]


def main(folder: Path, flips: int, seed: int, clang: str) -> int:
    counts: Counts = {}
    again: Counts = {}
    numbers, sanitized = [], [{}]
    for name, single in (("double", []), ("single", ["-DSTARCAT_SINGLE"])):
        place = folder / "upsets" / name
        program = build(place, ["gcc", "-O2"], "trace-pc", single)
        numbers.append(run(program, flips // 2, seed, counts))
        if clang:
            sanitizer = [clang, "-O1", "-g", *SANITIZE]
            program = build(place / "sanitize", sanitizer, "bb,trace-pc", single)
            sanitized.append(run(program, max(1, flips // 40), seed + 1, again))
    total = sum(counts.values(), Counter())
    bad = total["wrong"] + total["crash"] + sum(int(n["missed"]) for n in numbers)
    bad += sum(count["wrong"] + count["crash"] for count in again.values())
    rows = [[*key, *(str(count[name]) for name in OUTCOMES)] for key, count in counts.items()]
    with (folder / "upsets.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([["memory", "part", *OUTCOMES], *rows])
    came_to = ", ".join(f"{total[name]:,} {name}" for name in OUTCOMES)
    figure = (
        f"{sum(total.values()):,} flips: {came_to}; "
        f"largest error {max(n['largest'] for n in numbers):.2f} reaches"
    )
    runs = sum(sum(count.values()) for count in again.values())
    pages.write(
        folder / "upsets.html",
        "Single-event upsets",
        f"<p>{figure}.</p><ul>{''.join(f'<li>{text}</li>' for text in WORDS)}</ul>",
        f"<p>The longest call took {int(max(n['longest'] for n in numbers)):,} basic blocks; "
        f"{int(sum(n['traps'] for n in numbers)):,} calls raised a floating-point exception. "
        f"starcat_scrub_image named the block of every flip in the image but "
        f"{int(sum(n['missed'] for n in numbers))}. {runs:,} more flips under ASan and UBSan: "
        f"{sum(count['crash'] for count in again.values())} crashes. "
        f"make upsets SEU_FLIPS={flips} SEU_SEED={seed}</p>",
        pages.table(
            ["memory", *OUTCOMES],
            [[where, *in_all(counts, where)] for where in ("image", "workspace", "table")],
        ),
        pages.table(["memory", "part", *OUTCOMES], rows),
    )
    print(f"upsets: {figure}")
    return 1 if bad else 0


if __name__ == "__main__":
    CLANG = sys.argv[4] if len(sys.argv) > 4 else ""
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), CLANG))
