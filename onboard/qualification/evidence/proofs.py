# SPDX-License-Identifier: MIT
"""Prove the absence of run-time errors with Frama-C's Eva: no alarm on the claims of proofs/*.c.

    proofs.py FOLDER

Each file states its claim and its preconditions at its head. Alarms are reads and writes outside
of memory, memory that was not set, overflows of signed integers, shifts, divisions by 0 and
conversions that do not fit; floats can be infinite or NaN. Writes proofs.html; fails on any alarm,
on a precondition that is not proven, and if a claimed function is not reached.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pages

HERE = Path(__file__).resolve().parent
ONBOARD = HERE.parents[1]
RUNS = [
    ("start", [], ["image.c", "frame.c"]),
    *(("open", [f"-DBLOCKS={n}u"], ["image.c", "frame.c"]) for n in (1, 2, 15, 1022, 1023)),
    ("lookups", [], ["triangles.c", "verify.c"]),
]
"""Proofs, with their definitions and the sources that they need."""
CLAIMED = {
    "start": {"starcat_open_image", "starcat_scrub_image", "check_start"},
    "open": {
        "starcat_open_image",
        "starcat_scrub_image",
        "find_sections",
        "is_complete",
        "starcat_update_crc",
    },
    "lookups": {
        "starcat_find_rows",
        "starcat_read_rows",
        "starcat_read_star",
        "gather_sectors",
        "cell",
    },
}
OPTIONS = ["-eva", "-eva-precision", "1", "-eva-auto-loop-unroll", "16", "-main", "main"]
SEMANTICS = ["-machdep", "gcc_x86_64", "-warn-special-float", "none"]


def prove(name: str, defines: list[str], sources: list[str]) -> tuple[list[str], list[str]]:
    """Run Eva; return its complete output, and the list of problems."""
    flags = " ".join(["-Iinclude", "-Isrc", "-Ievidence/proofs", *defines])
    files = [f"qualification/evidence/proofs/{name}.c", *(f"src/{source}" for source in sources)]
    command = ["frama-c", f"-cpp-extra-args={flags}", *files, *SEMANTICS, *OPTIONS]
    done = subprocess.run(command, cwd=ONBOARD, capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    alarms = re.search(r"(\d+) alarms? generated", said)
    wrong = [] if done.returncode == 0 and alarms else [f"frama-c failed: {said[-500:]}"]
    wrong += re.findall(r"^\[eva:alarm\][^\n]*\n[^\n]*", said, re.MULTILINE)
    for kind, unknown, invalid in re.findall(r"(\w+) +\d+ valid +(\d+) unknown +(\d+) inv", said):
        wrong += (
            [f"{kind}: {unknown} unknown, {invalid} invalid"] if unknown + invalid != "00" else []
        )
    reached = set(re.findall(r"Values at end of function (\w+?)(?:_64_192_double)?:", said))
    wrong += [f"{function} is not reached" for function in sorted(CLAIMED[name] - reached)]
    statements = re.search(r"(\d+) statements reached \(out of (\d+)\)", said)
    figures = [
        alarms[1] if alarms else "?",
        " of ".join(statements.groups()) if statements else "?",
    ]
    return figures, wrong


def main(folder: Path) -> int:
    rows, wrong, alarms = [], [], 0
    for name, defines, sources in RUNS:
        figures, faults = prove(name, defines, sources)
        head = (HERE / "proofs" / f"{name}.c").read_text(encoding="utf-8").split("*/")[0]
        claim = re.sub(r"\n \* ?", "\n", head.removeprefix("/* ")).split("\nSPDX")[0].strip()
        functions = ", ".join(sorted(CLAIMED[name]))
        rows.append([" ".join([name, *defines]), functions, claim, *figures])
        wrong += [f"{name} {' '.join(defines)}: {fault}" for fault in faults]
        alarms += int(figures[0]) if figures[0].isdigit() else 1
    functions = len(set().union(*CLAIMED.values()))
    figure = f"{len(RUNS)} runs, {functions} functions claimed, {alarms} alarms"
    pages.write(
        folder / "proofs.html",
        "Absence of run-time errors",
        f"<p>{figure}. Frama-C's Eva: {' '.join([*SEMANTICS, *OPTIONS])}</p>",
        pages.table(["run", "functions", "claim", "alarms", "statements reached"], rows),
        pages.table(["fail"], [[f"fail: {line}"] for line in wrong]) if wrong else "",
    )
    print(*wrong, f"proofs: {figure}", sep="\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
