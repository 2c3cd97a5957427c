"""What verify, diff and rebuild print: tables for people or JSON for machines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from starcat.artifact.diff import Change, Difference, Moved, OneSided
from starcat.artifact.verify import Verification
from starcat.cli.terminal.console import print_json, print_table
from starcat.pipeline.rebuild import Rebuilt

MAX_STARS = 20
"""Stars of each kind that a table shows; JSON has all."""


def print_verification(found: Verification, *, as_json: bool) -> None:
    """Print what a verification found."""
    if as_json:
        print_json(found.as_dict())
        return
    name, count = found.folder.resolve().name, len(found.findings)
    outcome = f"{count} problem{'s' * (count != 1)}" if count else "sound"
    title = f"{name}: {outcome} ({found.checks} checks)"
    if not count:
        print_table("", (title,), [])
        return
    rows = [(f.file, f.product, f.problem) for f in found.findings]
    print_table(title, ("file", "product", "problem"), rows)


def print_difference(found: Difference, names: tuple[str, str], *, as_json: bool) -> None:
    """Print what differs between two artifacts."""
    if as_json:
        print_json({"a": names[0], "b": names[1], **found.as_dict()})
        return
    for title, changes in (
        ("Spec", found.spec),
        ("Sources", found.sources),
        ("Software", found.software),
    ):
        _print_changes(title, changes)
    _print_one_sided(f"{len(found.came):,} stars came", found.came)
    _print_one_sided(f"{len(found.went):,} stars went", found.went)
    _print_moved(found.moved)
    print_table(
        "Products",
        ("product", f"rows of {names[0]}", f"rows of {names[1]}", "content"),
        [
            (p.product, _count(p.rows_a), _count(p.rows_b), "same" if p.is_same else "differs")
            for p in found.products
        ],
        numbers=(1, 2),
    )


def _print_changes(title: str, changes: Sequence[Change]) -> None:
    if changes:
        rows = [(change.name, _value(change.a), _value(change.b)) for change in changes]
        print_table(title, ("", "A", "B"), rows)


def _print_one_sided(title: str, stars: Sequence[OneSided]) -> None:
    if stars:
        rows = [(star.designation, _mag(star.mag), star.reason) for star in stars[:MAX_STARS]]
        heading = ("star", "mag", "in the other")
        print_table(_capped(title, len(stars)), heading, rows, numbers=(1,))


def _print_moved(stars: Sequence[Moved]) -> None:
    if stars:
        rows = [
            (star.designation, f"{star.moved_arcsec:.4f}", _mag(star.mag_a), _mag(star.mag_b))
            for star in stars[:MAX_STARS]
        ]
        title = _capped(f"{len(stars):,} stars moved", len(stars))
        print_table(title, ("star", "arcsec", "mag A", "mag B"), rows, numbers=(1, 2, 3))


def print_rebuilt(rebuilt: Rebuilt, *, as_json: bool) -> None:
    """Print the outcome of a rebuild."""
    if as_json:
        print_json(rebuilt.as_dict())
        return
    if rebuilt.is_identical:
        print_table("", (f"{rebuilt.name}: {rebuilt.files} files, every byte the same",), [])
        return
    print_table(
        f"{rebuilt.name}: {len(rebuilt.changes)} of {rebuilt.files} files differ",
        ("file", "what differs"),
        [(change.file, change.what) for change in rebuilt.changes],
    )
    rows = [(change.name, _value(change.a), _value(change.b)) for change in rebuilt.software]
    if rows:
        print_table("Software", ("", "then", "now"), rows)


def _capped(title: str, count: int) -> str:
    return title if count <= MAX_STARS else f"{title} (first {MAX_STARS})"


def _value(value: Any) -> str:
    text = "-" if value is None else str(value)
    # The beginning of a digest is enough to tell it from another.
    return text[:16] if len(text) == 64 and " " not in text else text


def _count(rows: int | None) -> str:
    return "-" if rows is None else f"{rows:,}"


def _mag(mag: float | None) -> str:
    return "-" if mag is None else f"{mag:.2f}"
