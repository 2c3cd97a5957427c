"""The work of ``starcat evaluate --ecss``: trials, figures, and the files of the report."""

from __future__ import annotations

import csv
import json
import math
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from starcat.artifact.manifest import read_manifest
from starcat.matcher.stars import ARCSEC
from starcat.progress import Progress, no_progress
from starcat.report.plots import save_plot
from starcat.specs.star_sensor import Sensor, sensor_toml
from starcat.storage.atomic import write_file
from starcat_lab.ecss.bench import Bench, cached_bench
from starcat_lab.ecss.figures import sensor_figures
from starcat_lab.ecss.pages import draw_noise, markdown_page, sensor_page, sensor_tables
from starcat_lab.ecss.trials import run_trials, trials_of
from starcat_lab.report.tables import ReportTable

POINTINGS, FEW_POINTINGS = 100, 10
"""Pointings of each trial, and of a quick one."""

_MAGNITUDES = 6  # whole magnitudes down to the limit


def evaluate_sensor(
    artifact: Path,
    sensor: Sensor,
    output: Path,
    *,
    method: str | None = None,
    pointings: int = POINTINGS,
    seed: int = 1,
    workers: int = 2,
    progress: Progress = no_progress,
) -> tuple[dict[str, Any], Path]:
    """Simulate a star sensor with a database; return the figures and the page of the report."""
    bench = cached_bench(artifact, sensor, seed, method)
    trials = trials_of(bench, pointings)
    faintest = math.floor(bench.limit_mag)
    stars = [
        (float(mag), rate)
        for rate in sorted({0.0, *sensor.rates_deg_s})
        for mag in range(faintest - _MAGNITUDES + 1, faintest + 1)
    ]
    records, noise = run_trials(
        artifact, sensor, seed, method, trials, stars, workers, progress
    )  # fmt: skip
    content = _header(bench, artifact, seed) | sensor_figures(bench, trials, records, noise)
    folder = output / f"{artifact.name}-ecss"
    return finite(content), write_sensor_report(folder, content)


def _header(bench: Bench, artifact: Path, seed: int) -> dict[str, Any]:
    sky = bench.sky.mag
    return {
        "artifact": artifact.name,
        "manifest_sha256": read_manifest(artifact)["manifest_sha256"],
        "camera": bench.camera.in_words,
        "fov_deg": [bench.camera.fov_x_deg, bench.camera.fov_y_deg],
        "method": bench.matcher.method,
        "seed": seed,
        "sky_in_words": f"{len(sky):,} of the database's catalog, down to {sky.max():.2f} mag",
        "sensor": bench.sensor.model_dump(mode="json"),
        "sensor_toml": sensor_toml(bench.sensor),
    }


def write_sensor_report(folder: Path, content: dict[str, Any]) -> Path:
    """Write all files of a report."""
    folder.mkdir(parents=True, exist_ok=True)
    save_plot(draw_noise(content), folder, "noise_by_magnitude")
    files = {
        "report.json": json.dumps(finite(content), indent=2, ensure_ascii=False) + "\n",
        "report.md": markdown_page(content),
        "index.html": sensor_page(content, (folder / "noise_by_magnitude.svg").read_bytes()),
        **{f"{name}.csv": _csv(one) for name, one in sensor_tables(content).items()},
    }
    if content["budget"]:
        files["SC_star_tracker_42.txt"] = input_of_42(content)
        files["star_tracker_basilisk.py"] = input_of_basilisk(content)
    for name, text in files.items():
        write_file(folder / name, text.encode())
    return folder / "index.html"


def _csv(one: ReportTable) -> str:
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows([one.heads, *one.rows])
    return text.getvalue()


def finite(value: Any) -> Any:
    """Return a value without the numbers that JSON has no word for."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _noise_arcsec(content: dict[str, Any]) -> list[float]:
    return list(next(r for r in content["budget"] if r["name"] == "temporal")["sigma_arcsec"])


def input_of_42(content: dict[str, Any]) -> str:
    """Return the star tracker of a spacecraft file of NASA's simulator 42.

    The layout is that of ``InOut/SC_Simple.txt`` in github.com/ericstoneking/42 at commit
    0019f2475f60; 42 adds white noise about the axes of the tracker.
    """
    sensor = content["sensor"]
    lines = [
        ("1", "Number of Star Trackers"),
        f"=============================== ST 0  {'=' * 34}",
        (f"{1.0 / sensor['update_rate_hz']:.6g}", "Sample Time,sec"),
        ("0.0  0.0  0.0  321", "Mounting Angles (deg), Seq in Body"),
        ("Z_AXIS", "Boresight Axis X_AXIS, Y_AXIS, or Z_AXIS"),
        ("  ".join(f"{v:.6g}" for v in content["fov_deg"]), "H, V FOV Size, deg"),
        ("  ".join(f"{v:g}" for v in sensor["exclusion_deg"]),
         "Sun, Earth, Moon Exclusion Angles, deg"),
        ("  ".join(f"{v:.4g}" for v in _noise_arcsec(content)),
         "Noise Equivalent Angle, arcsec RMS"),
        ("0", "Node"),
    ]  # fmt: skip
    rows = [one if isinstance(one, str) else f"{one[0]:<28}! {one[1]}" for one in lines]
    return "\n".join([f"{'*' * 26} Star Tracker {'*' * 33}", *rows]) + "\n"


def input_of_basilisk(content: dict[str, Any]) -> str:
    """Return Python that gives Basilisk's star tracker the same noise (tried with 2.12.1)."""
    noise = (np.array(_noise_arcsec(content)) / ARCSEC).tolist()
    period_s = 1.0 / content["sensor"]["update_rate_hz"]
    rows = ",\n        ".join(
        str([noise[i] if i == k else 0.0 for i in range(3)]) for k in range(3)
    )
    return f'''"""Star tracker on {content["artifact"]} for Basilisk's module starTracker.

Temporal noise about x, y (across the boresight) and z, 1 sigma, white from frame to frame;
bias and spatial errors are not in it. Run it in a task of {period_s:.6g} s.
"""


def configure(tracker):
    """Set the noise of a starTracker.StarTracker, radians."""
    tracker.PMatrix = [
        {rows},
    ]  # square root of the covariance
    tracker.setAMatrix([[0.0] * 3] * 3)  # no memory: white noise
    tracker.setWalkBounds([0.0] * 3)  # no bounds
'''
