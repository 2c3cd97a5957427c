# SPDX-License-Identifier: MIT
"""Run the unit test with each compiler in both precisions, and report each part of it.

    unit.py FOLDER COMPILERS FLAG...

writes unit.html; fails if a check fails.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pages

ONBOARD = Path(__file__).resolve().parents[2]


def main(folder: Path, compilers: list[str], flags: list[str]) -> int:
    tests = ONBOARD / "tests"
    sources = [
        *sorted((ONBOARD / "src").glob("*.c")),
        tests / "unit.c",
        tests / "random_sky.c",
        *sorted(tests.glob("test_*.c")),
    ]
    includes = [f"-I{ONBOARD / name}" for name in ("include", "src")]
    program = folder.resolve() / "unit"
    heads, results, details, total, failed = [], {}, [], 0, 0
    for compiler in filter(shutil.which, compilers):
        for single in ([], ["-DSTARCAT_SINGLE"]):
            heads.append(f"{compiler}, {'single' if single else 'double'}")
            subprocess.run(
                [compiler, *flags, *single, *includes, *sources, "-lm", "-o", program], check=True
            )
            done = subprocess.run([program, "each"], capture_output=True, text=True, check=False)
            rows = re.findall(r"^(\w+): (\d+) checks, (\d+) failed$", done.stdout, re.MULTILINE)
            for name, checks, failures in rows:
                total, failed = total + int(checks), failed + int(failures)
                results.setdefault(name, {})[heads[-1]] = (
                    f"fail: {failures} of {checks}" if int(failures) else f"{checks} checks, pass"
                )
            if done.returncode != 0 or not rows:
                failed += not rows
                details.append(f"{heads[-1]}: {done.stderr[-4000:]}")
    program.unlink(missing_ok=True)
    figure = f"{len(results)} parts, {len(heads)} builds, {total} checks, {failed} failed"
    pages.write(
        folder / "unit.html",
        "Unit test",
        f"<p>{figure}. Floating-point traps are on.</p>",
        pages.table(
            ["part", *heads],
            [
                [f"test_{name}", *(of.get(head, "fail: not run") for head in heads)]
                for name, of in results.items()
            ],
        ),
        *(f"<pre>{pages.escape(text)}</pre>" for text in details),
    )
    print(f"unit: {figure}")
    return 1 if failed or details or not heads else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2].split(), sys.argv[3:]))
