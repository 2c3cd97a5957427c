"""Add new schema files to ``schemas/RELEASED.sha256``: ``make release``.

A file that is listed is released and never changes; a change is a new version, in a new file.
Lines are as ``sha256sum`` writes them: ``cd schemas && sha256sum --check RELEASED.sha256``.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

SCHEMAS = Path(__file__).parents[1] / "schemas"
LIST_NAME = "RELEASED.sha256"


def digests(folder: Path) -> dict[str, str]:
    """Return the digest of every schema file by name."""
    files = sorted(folder.glob("*.json"))
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def released(folder: Path) -> dict[str, str]:
    """Return the digests that were released, by name."""
    path = folder / LIST_NAME
    lines = path.read_text(encoding="ascii").splitlines() if path.is_file() else []
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}


def broken(folder: Path) -> list[str]:
    """Return what is wrong with the released files of a folder."""
    found = digests(folder)
    problems = []
    for name, digest in released(folder).items():
        if name not in found:
            problems.append(f"{name} is released and missing: put it back")
        elif found[name] != digest:
            problems.append(f"{name} is released and changed: put it back, write a new version")
    return problems


def release(folder: Path) -> list[str]:
    """Append the files that are not listed, and return their names, if no released one changed."""
    problems = broken(folder)
    if problems:
        raise ValueError("; ".join(problems))
    known, found = released(folder), digests(folder)
    new = [name for name in found if name not in known]
    with (folder / LIST_NAME).open("a", encoding="ascii", newline="\n") as file:
        file.writelines(f"{found[name]}  {name}\n" for name in new)
    return new


def main() -> None:
    """Release what is new."""
    try:
        new = release(SCHEMAS)
    except ValueError as error:
        sys.exit(f"release_schemas: {error}")
    print("released:", ", ".join(new) or "nothing new")


if __name__ == "__main__":
    main()
