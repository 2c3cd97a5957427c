"""Write ``lock.txt`` from what uv resolved: ``python tools/lock.py ALL RUN SERVICE``.

Each requirement of ALL is written once, in the section of those who need it: first what starcat
runs with, then what the service needs besides, then the tools of developers. The Makefile installs
the file up to the end of a section.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

SECTIONS = {"run": "what starcat runs with", "service": "what the service needs besides",
            "dev": "the tools of developers"}  # fmt: skip


def entries(path: str) -> dict[str, str]:
    """Return the text of each requirement of a file that uv wrote, by package."""
    text = re.sub(r"(?m)^#.*\n", "", Path(path).read_text())
    found = re.findall(r"(?m)^\S.*\n(?:[ \t].*\n)*", text)
    by_name: dict[str, str] = {}
    for each in found:
        name = re.split(r"[=\[ ]", each, maxsplit=1)[0]
        by_name[name] = by_name.get(name, "") + each
    return by_name


def main() -> None:
    """Print the lock file."""
    every, run, service = map(entries, sys.argv[1:4])
    section = {name: "run" if name in run else "service" if name in service else "dev"
               for name in every}  # fmt: skip
    print("# Versions and hashes of all libraries, for every platform, from 'make lock'.")
    for wanted, words in SECTIONS.items():
        print(f"# --- {wanted}: {words}")
        print("".join(every[name] for name in every if section[name] == wanted), end="")


if __name__ == "__main__":
    main()
