"""What the command about estimates prints."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

from starcat.cli.terminal.console import print_json, print_table, say

if TYPE_CHECKING:
    from starcat.pipeline.estimate import Estimate


def print_estimate(found: Estimate, *, as_json: bool) -> None:
    """Print what a spec will give."""
    cost, stars = found.cost, found.coverage.stars
    if as_json:
        print_json(
            {
                **asdict(cost),
                "spread": asdict(stars),
                "enough_share": found.enough_share,
                "full_share": found.full_share,
                "filters": dict(found.filters),
                "rejected": dict(found.rejected),
                "total_bytes": found.total_bytes,
                "build_seconds": round(found.build_seconds, 2),
                "refusals": list(found.refusals),
                "warnings": list(found.warnings),
            }
        )
        return
    rows = {**cost.rows, "stars": cost.stars, "boresights": cost.fields}
    rows["rejected"] = sum(found.rejected.values())
    lines = [
        (name, _count(rows.get(name.removesuffix(".parquet"))), f"{size:,}")
        for name, size in cost.files.items()
    ]
    lines.append(("all files", "", f"{found.total_bytes:,}"))
    title = f"{found.spec.name}-{found.spec.version}, by estimate"
    print_table(title, ("file", "rows", "bytes"), lines, numbers=(1, 2))
    most = found.spec.boresights.brightest
    say(
        f"{cost.stars:,} guide stars; {cost.fields:,} fields have {stars.minimum} to "
        f"{stars.maximum}, {stars.median} in the middle, {found.enough_share:.2%} of them 4 or "
        f"more, {found.full_share:.2%} {most} or more"
    )
    say(
        f"{found.build_seconds:,.0f} s to build, {cost.memory_bytes / 2**30:.1f} GiB of memory; "
        "the stars are as the build will have them"
    )
    for text in found.warnings:
        say(f"warning: {text}")
    for text in found.refusals:
        say(f"the build will be refused: {text}")


def _count(rows: int | None) -> str:
    return "" if rows is None else f"{rows:,}"
