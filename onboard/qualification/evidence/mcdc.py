"""MC/DC of the library by its unit test, double and single precision together.

    mcdc.py FOLDER SUFFIX FLAG...

compiles with clangSUFFIX and writes mcdc.html. A condition counts as covered if either precision
shows that it alone decides. Fails below 98 %; if a condition that is not covered, or a decision
that clang cannot follow, is missing in mcdc.txt; or if a condition listed there is covered.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pages

HERE = Path(__file__).resolve().parent
ONBOARD = HERE.parents[1]
LEAST_PERCENT = 98.0
FLAGS = ["-O1", "-fprofile-instr-generate", "-fcoverage-mapping", "-fcoverage-mcdc"]


def run(*command: object) -> subprocess.CompletedProcess[str]:
    """Run a command; exit if it fails."""
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        sys.exit(f"mcdc: {command[0]} failed:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done


def measure(folder: Path, suffix: str, flags: list[str]) -> tuple[dict, set[tuple[str, int]]]:
    """Run the unit test of one precision.

    Returns the files of llvm-cov's export, and the decisions that clang did not follow.
    """
    sources = sorted((ONBOARD / "src").glob("*.c"))
    tests = [ONBOARD / "tests" / "unit.c", ONBOARD / "tests" / "random_sky.c"]
    tests += sorted((ONBOARD / "tests").glob("test_*.c"))
    includes = [f"-I{ONBOARD / name}" for name in ("include", "src")]
    program, raw, data = folder / "unit", folder / "unit.profraw", folder / "unit.profdata"
    said = run(
        f"clang{suffix}", *flags, *FLAGS, *includes, *sources, *tests, "-lm", "-o", program
    ).stderr
    run("env", f"LLVM_PROFILE_FILE={raw}", program)
    run(f"llvm-profdata{suffix}", "merge", raw, "-o", data)
    export = run(f"llvm-cov{suffix}", "export", program, f"-instr-profile={data}", ONBOARD / "src")
    pattern = r"(\w+\.[ch]):(\d+):\d+: warning: unsupported MC/DC"
    unsupported = {(name, int(line)) for name, line in re.findall(pattern, said)}
    return json.loads(export.stdout)["data"][0]["files"], unsupported


def merged(exports: list[dict]) -> dict[tuple[str, int, int], list[bool]]:
    """Return which conditions of each decision, by file, line and column, are covered by any."""
    found: dict[tuple[str, int, int], list[bool]] = {}
    for file in (file for export in exports for file in export):
        for record in file.get("mcdc_records", []):
            conditions = next(part for part in record if isinstance(part, list))
            key = (Path(file["filename"]).name, record[0], record[1])
            before = found.get(key, [False] * len(conditions))
            found[key] = [a or b for a, b in zip(before, conditions, strict=True)]
    return found


def excused() -> dict[tuple[str, int, str], str]:
    """Return what mcdc.txt names, by file, number and source line, and the reasons."""
    named = {}
    for line in (HERE / "mcdc.txt").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            name, number, source, reason = (part.strip() for part in line.split(" | "))
            named[name, int(number), source] = reason
    return named


def main(folder: Path, suffix: str, flags: list[str]) -> int:
    exports, unsupported = [], set()
    for single in ([], ["-DSTARCAT_SINGLE"]):
        place = folder / "mcdc" / ("single" if single else "double")
        place.mkdir(parents=True, exist_ok=True)
        export, unknown = measure(place, suffix, [*flags, *single])
        exports.append(export)
        unsupported |= unknown
    decisions = merged(exports)
    lines = {
        file.name: file.read_text(encoding="utf-8").splitlines()
        for file in (ONBOARD / "src").iterdir()
    }
    missing = {
        (name, number, lines[name][line - 1].strip())
        for (name, line, _), conditions in decisions.items()
        for number, covered in enumerate(conditions, 1)
        if not covered
    } | {(name, 0, lines[name][line - 1].strip()) for name, line in unsupported}
    named = excused()
    wrong = [
        f"{name}, condition {n} of `{text}`: not covered, and not in mcdc.txt"
        for name, n, text in sorted(missing - set(named))
    ]
    wrong += [
        f"{name}, condition {n} of `{text}`: in mcdc.txt, but covered"
        for name, n, text in sorted(set(named) - missing)
    ]
    rows = []
    for name in sorted({name for name, _, _ in decisions}):
        own = [conditions for (file, _, _), conditions in decisions.items() if file == name]
        count, covered = sum(map(len, own)), sum(map(sum, own))
        rows.append(
            [name, str(len(own)), str(count), str(covered), f"{100.0 * covered / count:.2f} %"]
        )
    count, covered = sum(map(len, decisions.values())), sum(map(sum, decisions.values()))
    percent = 100.0 * covered / count
    wrong += [f"{percent:.2f} % is below {LEAST_PERCENT} %"] if percent < LEAST_PERCENT else []
    figure = (
        f"{covered} of {count} conditions of {len(decisions)} decisions ({percent:.2f} %), "
        f"{len(named)} explained"
    )
    reasons = [[name, str(n), text, reason] for (name, n, text), reason in named.items()]
    pages.write(
        folder / "mcdc.html",
        "MC/DC of the unit test",
        f"<p>{figure}. Decisions of two conditions or more; those of one are branches, all of "
        "which are taken (make coverage).</p>",
        pages.table(["file", "decisions", "conditions", "covered", "share"], rows),
        pages.table(["file", "condition", "decision", "why it is not covered"], reasons)
        if reasons
        else "",
        pages.table(["fail"], [[f"fail: {line}"] for line in wrong]) if wrong else "",
    )
    print(*wrong, f"mcdc: {figure}", sep="\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:]))
