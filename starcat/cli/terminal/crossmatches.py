"""What ``starcat crossmatch`` prints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from starcat.cli.terminal.console import print_json, print_table, say

if TYPE_CHECKING:
    from starcat.pipeline.match_summary import Summary

MEANINGS = {
    "unique": "the only candidate, and no other star's",
    "best": "others are far less likely",
    "ambiguous": "another is nearly as likely",
    "taken": "the candidate fits another star better",
    "doubtful": "more likely no candidate at all",
}
"""What the verdicts on a star's likeliest candidate mean."""


def print_crossmatch(
    found: Summary, names: tuple[str, str], output: Path, *, as_json: bool
) -> None:
    """Print the summary of a cross-identification."""
    if as_json:
        print_json({"a": names[0], "b": names[1], **found.as_dict(), "output": str(output)})
        return
    a, b = names
    rows = [(f"stars of {a}", found.stars, ""), ("matched", found.matched, f"a counterpart in {b}")]
    rows += [(f"  {name}", found.verdicts[name], MEANINGS[name]) for name in list(MEANINGS)[:3]]
    rows.append(("unmatched", found.unmatched, ""))
    rows += [(f"  {name}", found.verdicts[name], MEANINGS[name]) for name in list(MEANINGS)[3:]]
    rows.append(("  no candidate", found.no_candidate, f"within {found.radius_arcsec:g} arcsec"))
    rows.append(("each other's likeliest", found.mutual, ""))
    title = f"{a} in {b} ({found.counterparts:,} rows)"
    cells = [(name, f"{count:,}", meaning) for name, count, meaning in rows]
    print_table(title, ("", "stars", ""), cells, numbers=(1,))
    figures = [
        ("median separation", _number(found.median_separation_arcsec, 4, "arcsec"), "matched"),
        ("median magnitude offset", _number(found.median_delta_mag, 3, "mag"), f"{b} - {a}"),
        ("position error", _number(found.position_error_arcsec, 4, "arcsec"), "assumed, each axis"),
        ("magnitude offset", _number(found.expected_delta_mag, 3, "mag"), "assumed"),
        ("completeness", f"{found.completeness:.2%}", f"assumed share of {a} that {b} has"),
    ]
    print_table("Figures", ("", "", ""), figures, numbers=(1,))
    say(f"wrote {output}")


def _number(value: float | None, digits: int, unit: str) -> str:
    return "" if value is None else f"{value:.{digits}f} {unit}"
