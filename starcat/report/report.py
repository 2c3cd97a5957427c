"""The report of a build: what went in, what came out, and how good it is.

All of it is plain data of the stages before; the files hold neither clock nor host nor path.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from starcat.arrays import Array
from starcat.report.coverage_report import CoverageReport, write_coverage
from starcat.report.page import report_page
from starcat.report.plots import MAG_BIN, draw_magnitudes, save_plot
from starcat.storage.digests import json_bytes


def count_magnitudes(guide_star_mag: Array, rejected_mag: Array) -> dict[str, list[Any]]:
    """Count guide stars and rejected stars by magnitude; NaN is left out.

    Bins are half a magnitude wide, none between is left out, and ``to_mag`` belongs to its bin.

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
        np.bincount((one - first).astype(np.int64), minlength=count).tolist() for one in bins
    )
    edges = ((first + np.arange(count + 1)) * MAG_BIN).tolist()
    return {
        "from_mag": edges[:-1],
        "to_mag": edges[1:],
        "guide_stars": kept,
        "rejected": rejected,
    }


def write_report(folder: Path, content: Mapping[str, Any], coverage: CoverageReport) -> None:
    """Write all files of a report; ``content`` is that of report.json."""
    title, counts = f"{content['name']}-{content['version']}", content["magnitudes"]
    write_coverage(folder, title, coverage)
    (folder / "stars_by_magnitude.csv").write_bytes(_magnitude_csv(counts))
    save_plot(draw_magnitudes(title, counts["band"], counts), folder, "stars_by_magnitude")
    (folder / "self_test.json").write_bytes(json_bytes(content["self_test"]))
    (folder / "report.json").write_bytes(json_bytes(content))
    plots = {
        name: (folder / f"{name}.svg").read_bytes()
        for name in ("coverage_map", "coverage_histogram", "stars_by_magnitude")
    }
    (folder / "index.html").write_text(report_page(content, plots), encoding="utf-8")


def _magnitude_csv(counts: Mapping[str, Any]) -> bytes:
    names = ("from_mag", "to_mag", "guide_stars", "rejected")
    rows = zip(*(counts[name] for name in names), strict=True)
    lines = [",".join(names), *(f"{a:g},{b:g},{kept},{out}" for a, b, kept, out in rows)]
    return ("\n".join(lines) + "\n").encode()
