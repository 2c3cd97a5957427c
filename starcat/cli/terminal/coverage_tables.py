"""What the command line shows of coverage: a table, a histogram in text, or JSON."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starcat.cli.terminal.console import print_json, print_table, say

if TYPE_CHECKING:
    from starcat.artifact.reader import Artifact
    from starcat.report.coverage_report import CoverageReport

_BARS, _BAR_WIDTH = 20, 50


def print_coverage(artifact: Artifact, folder: Path | None, *, as_json: bool) -> None:
    """Print the coverage of an artifact, and write its tables and plots where asked to."""
    from starcat.pipeline.report_data import artifact_coverage
    from starcat.report.coverage_report import holes_warning, write_coverage

    report = artifact_coverage(artifact)
    if as_json:
        print_json(report.as_dict())
    else:
        print_coverage_table(report)
        print_table("", ("stars in a field", "fields", ""), histogram_rows(report), numbers=(1,))
    warning = holes_warning(report.gap)
    if warning:
        say(f"warning: {warning}")
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        title = f"{artifact.manifest['name']}-{artifact.manifest['version']}"
        names = write_coverage(folder, title, report)
        say(f"wrote {', '.join(names)} in {folder}")


def print_coverage_table(report: CoverageReport) -> None:
    """Print the coverage in a few numbers."""
    summary, gap = report.summary, report.gap
    spreads = {"stars": summary.stars, "pairs": summary.pairs, "triangles": summary.triangles}
    rows = [
        (
            kind,
            f"{spread.minimum:,}",
            f"{spread.one_percent:,}",
            f"{spread.median:,}",
            f"{spread.mean:,.1f}",
            f"{spread.maximum:,}",
        )
        for kind, spread in spreads.items()
    ]
    heads = ("in a field", "fewest", "1 %", "median", "mean", "most")
    print_table(f"Coverage: {summary.fields:,} fields", heads, rows, numbers=(1, 2, 3, 4, 5))
    worst = f"RA {summary.worst_ra_deg:.3f}, Dec {summary.worst_dec_deg:+.3f} deg"
    covering, tile = np.degrees([gap.covering_radius_rad, gap.tile_radius_rad])
    print_table(
        "",
        ("", ""),
        [
            ("fewest stars", f"boresight {summary.worst_boresight}, {worst}"),
            ("farthest from all boresights", f"{covering:.3f} deg; a field reaches {tile:.3f} deg"),
        ],
    )


def histogram_rows(report: CoverageReport) -> list[tuple[str, str, str]]:
    """Return the histogram of stars in a field as rows of text."""
    least = report.summary.stars.minimum
    counts = report.summary.histogram[least:]
    width = -(-len(counts) // _BARS)
    padded = np.append(counts, np.zeros(-len(counts) % width, dtype=np.int64))
    fields = padded.reshape(-1, width).sum(axis=1)
    rows = []
    for low, number in zip(range(least, 10**9, width), fields.tolist(), strict=False):
        label = f"{low}" if width == 1 else f"{low}-{low + width - 1}"
        rows.append((label, f"{number:,}", "#" * -(-number * _BAR_WIDTH // int(fields.max()))))
    return rows
