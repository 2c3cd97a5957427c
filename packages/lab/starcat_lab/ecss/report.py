"""The work of ``starcat evaluate --ecss``: trials, figures, and the files of the report."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2, norm, t

from starcat.arrays import Array
from starcat.database import read_manifest
from starcat.matcher import ARCSEC
from starcat.pipeline.report import save_plot
from starcat.pipeline.specs import Sensor, sensor_toml
from starcat.progress import Progress, no_progress
from starcat.results import to_dict
from starcat.storage import write_file
from starcat_lab.ecss.bench import Bench, cached_bench
from starcat_lab.ecss.pages import draw_noise, markdown_page, sensor_page, sensor_tables
from starcat_lab.ecss.trials import (
    CONTRIBUTORS,
    NOMINAL,
    WORST,
    SensorTrial,
    expected_noise,
    run_trials,
    trials_of,
)
from starcat_lab.rates import Share
from starcat_lab.report.tables import ReportTable

Records = Sequence[Mapping[str, Any]]

SUMS = {
    "pixel": ("pixel spatial error, all", ("sampling", "prnu", "dsnu")),
    "fov": ("FOV spatial error, all", ("distortion", "catalog")),
}
RESIDUALS = ("no_orbit", "no_aberration")
"""Contributors that are shown but not summed: the gain from correcting aberration."""


def sensor_figures(
    bench: Bench,
    trials: Sequence[SensorTrial],
    records: Mapping[str, Records],
    stars: Sequence[Mapping[str, float]],
) -> dict[str, Any]:
    """Return all figures as plain values."""
    nominal, confidence = records[NOMINAL], bench.sensor.confidence
    trial_figures = {trial.name: _trial(trial, records[trial.name], confidence) for trial in trials}
    return {
        "confidence": confidence,
        "sigmas": float(norm.ppf(0.5 + 0.5 * confidence)),
        "budget": _budget(nominal, confidence),
        "bias": _bias(bench, nominal),
        "temporal": [
            {"trial": trial.name, "rate_deg_s": trial.condition.rate_deg_s}
            | (temporal_noise(records[trial.name], confidence) or {})
            for trial in trials
            if trial.frames > 1 and trial.name != WORST
        ],
        "stars": list(stars),
        "trials": trial_figures,
        "acquisition": _acquisition(bench, nominal),
        "false_attitude": _false_attitudes(bench, records),
        "sky": _sky(bench, records[WORST]),
        "frames": sum(len(record["right"]) for many in records.values() for record in many),
    }


def spread(values: Array, degrees: int, confidence: float) -> dict[str, Any]:
    """Return standard deviations about x, y and z, and their interval of 95 % (chi-square).

    ``values`` are squared deviations that were summed, over the degrees of freedom.
    """
    sigma = np.sqrt(values / degrees)
    low, high = (math.sqrt(degrees / chi2.ppf(end, degrees)) for end in (0.975, 0.025))
    return {
        "sigma_arcsec": sigma.tolist(),
        "at_confidence_arcsec": (sigma * norm.ppf(0.5 + 0.5 * confidence)).tolist(),
        "interval": [low, high],
        "degrees": degrees,
    }


def _about_mean(errors: Array, confidence: float) -> dict[str, Any]:
    apart = errors - errors.mean(axis=0)
    figures = spread((apart**2).sum(axis=0), len(errors) - 1, confidence)
    return figures | {"largest_arcsec": np.abs(apart).max(axis=0).tolist()}


def temporal_noise(records: Records, confidence: float) -> dict[str, Any] | None:
    """Return the noise between the frames of a pointing; None if too few were right."""
    squares, degrees, largest = np.zeros(3), 0, np.zeros(3)
    for record in records:
        right = np.array(record["error"])[np.array(record["right"])]
        if len(right) > 1:
            apart = right - right.mean(axis=0)
            squares += (apart**2).sum(axis=0)
            degrees += len(right) - 1
            largest = np.maximum(largest, np.abs(apart).max(axis=0))
    if not degrees:
        return None
    figures = spread(squares, degrees, confidence) | {"largest_arcsec": largest.tolist()}
    expected = [record["noise_variance"] for record in records if "noise_variance" in record]
    if expected:
        figures["closed_form_arcsec"] = np.sqrt(np.mean(expected, axis=0)).tolist()
    return figures


def _budget(records: Records, confidence: float) -> list[dict[str, Any]]:
    """Return the contributors of the nominal frames, and how they add up."""
    parts = [record["contributions"] for record in records if "contributions" in record]
    noise = temporal_noise(records, confidence)
    if len(parts) < 2 or noise is None:
        return []
    errors = {name: np.array([part[name] for part in parts]) for name in CONTRIBUTORS}
    rows = [{"name": "temporal", "label": "temporal noise (NEA)"} | noise]
    for name, label in CONTRIBUTORS.items():
        rows.append({"name": name, "label": label} | _about_mean(errors[name], confidence))
    for name, (label, names) in SUMS.items():
        added = np.sum([errors[part] for part in names], axis=0)
        rows.append({"name": name, "label": label} | _about_mean(added, confidence))
    first = np.array([_first_right(record) for record in records if any(record["right"])])
    # Frames are simulated without aberration.
    alone = ["temporal", *(n for n in CONTRIBUTORS if n not in ("aberration", *RESIDUALS))]
    squares = sum(np.square(row["sigma_arcsec"]) for row in rows if row["name"] in alone)
    rows.append(
        {"name": "all", "label": "all together, measured from electrons to attitude"}
        | _about_mean(first, confidence)
        | {"root_sum_square_arcsec": np.sqrt(squares).tolist()}
    )
    return rows


def _first_right(record: Mapping[str, Any]) -> list[float]:
    return next(e for e, ok in zip(record["error"], record["right"], strict=True) if ok)


def _bias(bench: Bench, records: Records) -> dict[str, Any] | None:
    """Return the mean error, its interval of 95 %, and the effect of alignment and axis."""
    means = np.array(
        [
            np.array(record["error"])[record["right"]].mean(axis=0)
            for record in records
            if any(record["right"])
        ]
    )
    if len(means) < 2:
        return None
    half = t.ppf(0.975, len(means) - 1) * means.std(axis=0, ddof=1) / math.sqrt(len(means))
    return {
        "mean_arcsec": means.mean(axis=0).tolist(),
        "half_interval_arcsec": half.tolist(),
        "closed_form_arcsec": expected_bias(bench),
        "thermo_elastic_arcsec": list(bench.sensor.thermo_elastic_arcsec),
        "pointings": len(means),
    }


def expected_bias(bench: Bench) -> list[float]:
    """Return the bias about x, y, z in closed form: alignment, and the axis off by (dx, dy).

    An axis that is off by dx turns the camera by -dx/f about y, one that is off by dy by dy/f
    about x, where stars are near the axis.
    """
    dx, dy = bench.sensor.principal_point_error_px
    scale = ARCSEC / bench.camera.focal_length_px
    x, y, z = bench.sensor.alignment_arcsec
    return [x + dy * scale, y - dx * scale, z]


def _trial(trial: SensorTrial, records: Records, confidence: float) -> dict[str, Any]:
    count = len(records)
    frames = [flag for record in records for flag in record["acquired"]]
    right = [flag for record in records for flag in record["right"]]
    return {
        "pointings": count,
        "frames": len(frames),
        "first_frame": to_dict(Share(sum(record["right"][0] for record in records), count)),
        "false": to_dict(Share(sum(frames) - sum(right), len(frames))),
        "guide_stars_median": float(np.median([record["guide_stars"] for record in records])),
        "temporal": temporal_noise(records, confidence) if trial.frames > 1 else None,
    }


def _acquisition(bench: Bench, records: Records) -> list[dict[str, Any]]:
    """Return the share of pointings with the right attitude within N frames, and the time."""
    rows = []
    for frames in range(1, len(records[0]["right"]) + 1):
        hits = sum(any(record["right"][:frames]) for record in records)
        sensor = bench.sensor
        time_s = (frames - 1) / sensor.update_rate_hz + sensor.exposure_s + sensor.processing_s
        rows.append({"frames": frames, "time_s": time_s} | to_dict(Share(hits, len(records))))
    return rows


def _false_attitudes(bench: Bench, records: Mapping[str, Records]) -> dict[str, Any]:
    acquired = [flag for many in records.values() for record in many for flag in record["acquired"]]
    right = [flag for many in records.values() for record in many for flag in record["right"]]
    chances = [
        chance for many in records.values() for record in many for chance in record["chance"]
    ]
    return to_dict(Share(sum(acquired) - sum(right), len(acquired))) | {
        "bound_of_a_frame": bench.matcher.settings.max_false_match_probability,
        "largest_stated": max(chances, default=0.0),
        "sum_stated": math.fsum(chances),
    }


def _sky(bench: Bench, worst: Records) -> dict[str, Any]:
    expected = expected_noise(bench)
    across = np.hypot(expected["sigma"][:, 0], expected["sigma"][:, 1]) / math.sqrt(2.0)
    parts = {"fewest": 0.0, "one_percent": 0.01, "median": 0.5}
    counts = {
        name: float(np.quantile(expected["stars"], q, method="inverted_cdf"))
        for name, q in parts.items()
    }
    noise = {
        f"{name}_arcsec": [
            float(np.quantile(values, q, method="inverted_cdf"))
            for values in (across, expected["sigma"][:, 2])
        ]
        for name, q in (("median", 0.5), ("worst_one_percent", 0.99))
    }
    return {
        "boresights": len(across),
        "below_four": to_dict(Share(int((expected["stars"] < 4).sum()), len(across))),
        "guide_stars": counts,
        **{k: [v if math.isfinite(v) else None for v in both] for k, both in noise.items()},
        "worst_first_frame": to_dict(
            Share(sum(record["right"][0] for record in worst), len(worst))
        ),
    }


POINTINGS, FEW_POINTINGS = 100, 10
"""Pointings of each trial, and of a quick one."""

_MAGNITUDES = 6  # whole magnitudes down to the limit


def evaluate_sensor(
    database: Path,
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
    bench = cached_bench(database, sensor, seed, method)
    trials = trials_of(bench, pointings)
    faintest = math.floor(bench.limit_mag)
    stars = [
        (float(mag), rate)
        for rate in sorted({0.0, *sensor.rates_deg_s})
        for mag in range(faintest - _MAGNITUDES + 1, faintest + 1)
    ]
    records, noise = run_trials(
        database, sensor, seed, method, trials, stars, workers, progress
    )  # fmt: skip
    content = _header(bench, database, seed) | sensor_figures(bench, trials, records, noise)
    folder = output / f"{database.name}-ecss"
    return finite(content), write_sensor_report(folder, content)


def _header(bench: Bench, database: Path, seed: int) -> dict[str, Any]:
    sky = bench.sky.mag
    return {
        "artifact": database.name,
        "manifest_sha256": read_manifest(database)["manifest_sha256"],
        "camera": bench.camera.in_words,
        "fov_deg": [bench.camera.fov_x_deg, bench.camera.fov_y_deg],
        "method": bench.matcher.settings.method,
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
        **{
            f"{name}.csv": _csv(report_table)
            for name, report_table in sensor_tables(content).items()
        },
    }
    if content["budget"]:
        files["SC_star_tracker_42.txt"] = input_of_42(content)
        files["star_tracker_basilisk.py"] = input_of_basilisk(content)
    for name, text in files.items():
        write_file(folder / name, text.encode())
    return folder / "index.html"


def _csv(report_table: ReportTable) -> str:
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows([report_table.heads, *report_table.rows])
    return text.getvalue()


def finite(value: Any) -> Any:
    """Return a value without the numbers that JSON does not have."""
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
    rows = [line if isinstance(line, str) else f"{line[0]:<28}! {line[1]}" for line in lines]
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
