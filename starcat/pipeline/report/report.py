"""The report of a build: its inputs, its results, and their quality.

The report is plain data from the earlier stages; its files contain no time, host or path.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from starcat.arrays import Array
from starcat.catalog.sensor_band import InBand
from starcat.database.products.coverage import (
    MIN_GUIDE_STARS,
    Coverage,
    CoverageSummary,
    TilingGap,
    summarise_coverage,
    tiling_gap,
)
from starcat.database.products.evenness import Evenness
from starcat.geometry.footprint import Footprint
from starcat.geometry.sphere import radec_from_directions
from starcat.pipeline.report.coverage_map import nearest_raster
from starcat.pipeline.report.page import report_page
from starcat.pipeline.report.plots import (
    MAG_BIN,
    MAP_PIXELS,
    draw_error_map,
    draw_histogram,
    draw_magnitudes,
    draw_map,
    save_plot,
)
from starcat.pipeline.report.sensor_band import band_section, draw_band
from starcat.storage.atomic import json_bytes

DECIMALS = 6
"""Decimals of degrees in a report; six are 4 milliarcseconds."""


@dataclass(frozen=True)
class CoverageReport:
    """The coverage in a report.

    Attributes
    ----------
    coverage : Coverage
        Stars, pairs and triangles by boresight.
    summary : CoverageSummary
        The coverage in a few numbers.
    gap : TilingGap
        The widest gap between the boresights.
    evenness : Evenness
        The attitude error that the stars of each field allow.
    part : Footprint or None
        The part of the sphere that is covered; None: all of it.
    """

    coverage: Coverage
    summary: CoverageSummary
    gap: TilingGap
    evenness: Evenness
    part: Footprint | None = None

    def __repr__(self) -> str:
        stars = self.summary.stars
        return (
            f"<CoverageReport: {self.summary.fields:,} fields of {stars.minimum} to "
            f"{stars.maximum} stars, median {stars.median}>"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as values for JSON."""
        summary, gap = self.summary, self.gap
        spreads = (summary.stars, summary.pairs, summary.triangles)
        stars, pairs, triangles = (
            {**asdict(spread), "mean": round(spread.mean, DECIMALS)} for spread in spreads
        )
        return {
            "fields": summary.fields,
            "stars": stars,
            "pairs": pairs,
            "triangles": triangles,
            "worst_field": {
                "boresight": summary.worst_boresight,
                "ra_deg": round(summary.worst_ra_deg, DECIMALS),
                "dec_deg": round(summary.worst_dec_deg, DECIMALS),
                "stars": summary.stars.minimum,
            },
            "fields_by_stars": summary.histogram.tolist(),
            "attitude_error_arcsec_per_px": {
                axis: {name: _finite(value) for name, value in asdict(spread).items()}
                for axis, spread in self.evenness.spreads.items()
            },
            "entropy": round(self.evenness.entropy, DECIMALS),
            "entropy_cells": self.evenness.cells,
            "tiling": {
                "holes": gap.has_holes,
                "tile_radius_deg": round(float(np.degrees(gap.tile_radius_rad)), DECIMALS),
                "covering_radius_deg": round(float(np.degrees(gap.covering_radius_rad)), DECIMALS),
                "gap_ra_deg": round(gap.ra_deg, DECIMALS),
                "gap_dec_deg": round(gap.dec_deg, DECIMALS),
            },
        }


def _finite(error_arcsec: float) -> float | None:
    """Return an error for JSON: null without an attitude."""
    return round(error_arcsec, DECIMALS) if np.isfinite(error_arcsec) else None


def report_coverage(
    coverage: Coverage,
    tile_radius_rad: float,
    evenness: Evenness,
    count: int | None = None,
    part: Footprint | None = None,
) -> CoverageReport:
    """Summarise a coverage and look for holes in its tiling.

    The boresights can be those in a part of the sphere, of ``count`` on the whole sphere.
    """
    gap = tiling_gap(coverage.boresights, tile_radius_rad, count, part)
    return CoverageReport(coverage, summarise_coverage(coverage), gap, evenness, part)


def _holes(gap: TilingGap) -> str:
    return (
        f"boresights.count = {gap.boresights:,} leaves holes: RA {gap.ra_deg:.3f}, Dec "
        f"{gap.dec_deg:+.3f} deg lies {np.degrees(gap.covering_radius_rad):.3f} deg from every "
        f"boresight, and a field reaches {np.degrees(gap.tile_radius_rad):.3f} deg at any roll; "
        f"about {gap.boresights_needed:,} boresights leave none"
    )


BLIND_SHARE = 0.001
"""A larger share of fields with fewer than `MIN_GUIDE_STARS` stars causes a warning."""


def coverage_warnings(summary: CoverageSummary, gap: TilingGap | None) -> tuple[str, ...]:
    """Return warnings about holes of a tiling and about fields with too few stars."""
    warnings = [] if gap is None or not gap.has_holes else [_holes(gap)]
    blind = int(summary.histogram[:MIN_GUIDE_STARS].sum())
    if blind > BLIND_SHARE * summary.fields:
        warnings.append(
            f"{blind:,} of {summary.fields:,} fields ({blind / summary.fields:.2%}) hold fewer "
            f"than {MIN_GUIDE_STARS} guide stars and cannot be identified: a fainter "
            "selection.faint_limit_mag or a wider camera gives more stars a field"
        )
    return tuple(warnings)


def coverage_csv(coverage: Coverage) -> bytes:
    """Return the coverage by boresight as CSV."""
    ra_deg, dec_deg = radec_from_directions(coverage.boresights)
    columns = (ra_deg, dec_deg, coverage.stars, coverage.pairs, coverage.triangles)
    rows = enumerate(zip(*(column.tolist() for column in columns), strict=True))
    return _csv(
        "boresight,ra_deg,dec_deg,stars,pairs,triangles",
        (f"{n},{ra:.6f},{dec:.6f},{a},{b},{c}" for n, (ra, dec, a, b, c) in rows),
    )


def attitude_error_csv(coverage: Coverage, evenness: Evenness) -> bytes:
    """Return the attitude errors by boresight as CSV; empty without an attitude."""
    ra_deg, dec_deg = radec_from_directions(coverage.boresights)
    columns = (ra_deg, dec_deg, coverage.stars, evenness.across, evenness.about)
    rows = enumerate(zip(*(column.tolist() for column in columns), strict=True))
    return _csv(
        "boresight,ra_deg,dec_deg,stars,across_arcsec_per_px,about_arcsec_per_px",
        (
            f"{n},{ra:.6f},{dec:.6f},{stars}," + (f"{a:.4f},{b:.4f}" if np.isfinite(a) else ",")
            for n, (ra, dec, stars, a, b) in rows
        ),
    )


def _csv(head: str, rows: Iterable[str]) -> bytes:
    return ("\n".join([head, *rows]) + "\n").encode()


def write_coverage(folder: Path, title: str, report: CoverageReport) -> list[str]:
    """Write tables and plots of a coverage."""
    (folder / "coverage.csv").write_bytes(coverage_csv(report.coverage))
    histogram = (f"{n},{fields}" for n, fields in enumerate(report.summary.histogram.tolist()))
    (folder / "coverage_histogram.csv").write_bytes(_csv("stars,fields", histogram))
    (folder / "coverage.json").write_bytes(json_bytes(report.as_dict()))
    errors = attitude_error_csv(report.coverage, report.evenness)
    (folder / "attitude_error.csv").write_bytes(errors)
    nearest = nearest_raster(report.coverage.boresights, MAP_PIXELS, report.part)
    save_plot(draw_map(title, report.coverage, report.summary, nearest), folder, "coverage_map")
    drawn = draw_error_map(title, report.coverage.boresights, report.evenness, nearest)
    save_plot(drawn, folder, "attitude_error")
    save_plot(draw_histogram(title, report.summary), folder, "coverage_histogram")
    return [
        "coverage.csv",
        "coverage.json",
        *(f"coverage_map.{kind}" for kind in ("png", "svg")),
        *(f"attitude_error.{kind}" for kind in ("csv", "png", "svg")),
        *(f"coverage_histogram.{kind}" for kind in ("csv", "png", "svg")),
    ]


def count_magnitudes(guide_star_mag: Array, rejected_mag: Array) -> dict[str, list[Any]]:
    """Count guide stars and rejected stars by magnitude; NaN is left out.

    Bins are half a magnitude wide and without gaps; ``to_mag`` is included in its bin.

    Examples
    --------
    >>> count_magnitudes(np.array([1.0, 1.2]), np.array([2.1, np.nan]))["guide_stars"]
    [1, 1, 0, 0]
    """
    bins = [np.ceil(mag[~np.isnan(mag)] / MAG_BIN) - 1.0 for mag in (guide_star_mag, rejected_mag)]
    every = np.concatenate(bins)
    if not len(every):
        return {"from_mag": [], "to_mag": [], "guide_stars": [], "rejected": []}
    first, count = int(every.min()), int(every.max() - every.min()) + 1
    kept, rejected = (
        np.bincount((star_bins - first).astype(np.int64), minlength=count).tolist()
        for star_bins in bins
    )
    edges = ((first + np.arange(count + 1)) * MAG_BIN).tolist()
    return {"from_mag": edges[:-1], "to_mag": edges[1:], "guide_stars": kept, "rejected": rejected}


def write_report(
    folder: Path,
    content: Mapping[str, Any],
    coverage: CoverageReport,
    in_band: InBand | None = None,
) -> None:
    """Write all files of a report; ``content`` is the content of report.json."""
    title, counts = f"{content['name']}-{content['version']}", content["magnitudes"]
    write_coverage(folder, title, coverage)
    names = ("from_mag", "to_mag", "guide_stars", "rejected")
    rows = zip(*(counts[name] for name in names), strict=True)
    bars = _csv(",".join(names), (f"{a:g},{b:g},{kept},{out}" for a, b, kept, out in rows))
    (folder / "stars_by_magnitude.csv").write_bytes(bars)
    save_plot(draw_magnitudes(title, counts["band"], counts), folder, "stars_by_magnitude")
    (folder / "self_test.json").write_bytes(json_bytes(content["self_test"]))
    (folder / "report.json").write_bytes(json_bytes(content))
    plots = {
        name: (folder / f"{name}.svg").read_bytes()
        for name in ("coverage_map", "coverage_histogram", "attitude_error", "stars_by_magnitude")
    }
    more: list[str] = []
    if in_band is not None:
        save_plot(draw_band(title, in_band), folder, "sensor_band")
        more = band_section(content["band"], (folder / "sensor_band.svg").read_bytes())
    (folder / "index.html").write_text(report_page(content, plots, more), encoding="utf-8")
