"""Coverage as files: the table by field, the summary, the map and the histogram."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from starcat.geometry.sphere import radec_from_directions
from starcat.products.coverage import (
    Coverage,
    CoverageSummary,
    TilingGap,
    summarise_coverage,
    tiling_gap,
)
from starcat.report.plots import draw_histogram, draw_map, save_plot
from starcat.storage.digests import json_bytes

DECIMALS = 6
"""Decimals of degrees in a report; six are 4 milliarcseconds."""


@dataclass(frozen=True)
class CoverageReport:
    """What a report says about coverage."""

    coverage: Coverage  # stars, pairs and triangles by boresight
    summary: CoverageSummary  # the coverage in a few numbers
    gap: TilingGap  # the widest gap between the boresights

    def __repr__(self) -> str:
        """Return the stars of a field in one line."""
        stars = self.summary.stars
        return (
            f"<CoverageReport: {self.summary.fields:,} fields of {stars.minimum} to "
            f"{stars.maximum} stars, median {stars.median}>"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as JSON holds it."""
        summary, gap = self.summary, self.gap
        counts = {
            name: {**asdict(spread), "mean": round(spread.mean, DECIMALS)}
            for name, spread in (
                ("stars", summary.stars),
                ("pairs", summary.pairs),
                ("triangles", summary.triangles),
            )
        }
        return {
            "fields": summary.fields,
            **counts,
            "worst_field": {
                "boresight": summary.worst_boresight,
                "ra_deg": round(summary.worst_ra_deg, DECIMALS),
                "dec_deg": round(summary.worst_dec_deg, DECIMALS),
                "stars": summary.stars.minimum,
            },
            "fields_by_stars": summary.histogram.tolist(),
            "tiling": {
                "holes": gap.has_holes,
                "tile_radius_deg": round(float(np.degrees(gap.tile_radius_rad)), DECIMALS),
                "covering_radius_deg": round(float(np.degrees(gap.covering_radius_rad)), DECIMALS),
                "gap_ra_deg": round(gap.ra_deg, DECIMALS),
                "gap_dec_deg": round(gap.dec_deg, DECIMALS),
            },
        }


def report_coverage(coverage: Coverage, tile_radius_rad: float) -> CoverageReport:
    """Summarise a coverage and look for holes in its tiling."""
    gap = tiling_gap(coverage.boresights, tile_radius_rad)
    return CoverageReport(coverage, summarise_coverage(coverage), gap)


def holes_warning(gap: TilingGap) -> str | None:
    """Return what to say about holes of a tiling."""
    if not gap.has_holes:
        return None
    return (
        f"boresights.count = {gap.boresights:,} leaves holes: RA {gap.ra_deg:.3f}, Dec "
        f"{gap.dec_deg:+.3f} deg lies {np.degrees(gap.covering_radius_rad):.3f} deg from every "
        f"boresight, and a field reaches {np.degrees(gap.tile_radius_rad):.3f} deg at any roll; "
        f"about {gap.boresights_needed:,} boresights leave none"
    )


def coverage_csv(coverage: Coverage) -> bytes:
    """Return the coverage by boresight as CSV."""
    ra_deg, dec_deg = radec_from_directions(coverage.boresights)
    columns = (ra_deg, dec_deg, coverage.stars, coverage.pairs, coverage.triangles)
    lines = ["boresight,ra_deg,dec_deg,stars,pairs,triangles"]
    for number, (ra, dec, *counts) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
        lines.append(f"{number},{ra:.6f},{dec:.6f},{counts[0]},{counts[1]},{counts[2]}")
    return ("\n".join(lines) + "\n").encode()


def histogram_csv(summary: CoverageSummary) -> bytes:
    """Return the histogram of stars in a field as CSV."""
    rows = (f"{stars},{fields}" for stars, fields in enumerate(summary.histogram.tolist()))
    return ("\n".join(["stars,fields", *rows]) + "\n").encode()


def write_coverage(folder: Path, title: str, report: CoverageReport) -> list[str]:
    """Write tables and plots of a coverage."""
    (folder / "coverage.csv").write_bytes(coverage_csv(report.coverage))
    (folder / "coverage_histogram.csv").write_bytes(histogram_csv(report.summary))
    (folder / "coverage.json").write_bytes(json_bytes(report.as_dict()))
    save_plot(draw_map(title, report.coverage, report.summary), folder, "coverage_map")
    save_plot(draw_histogram(title, report.summary), folder, "coverage_histogram")
    return [
        "coverage.csv",
        "coverage.json",
        *(f"coverage_map.{kind}" for kind in ("png", "svg")),
        *(f"coverage_histogram.{kind}" for kind in ("csv", "png", "svg")),
    ]
