"""From the records of trials to the figures of a star sensor, each with its confidence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2, norm, t

from starcat.arrays import Array
from starcat.matcher.stars import ARCSEC
from starcat_lab.ecss.bench import Bench
from starcat_lab.ecss.errors import CONTRIBUTORS
from starcat_lab.ecss.trials import NOMINAL, WORST, SensorTrial, expected_noise
from starcat_lab.rates import Share

Records = Sequence[Mapping[str, Any]]

SUMS = {
    "pixel": ("pixel spatial error, all", ("sampling", "prnu", "dsnu")),
    "fov": ("FOV spatial error, all", ("distortion", "catalog")),
}
RESIDUALS = ("no_orbit", "no_aberration")
"""Contributors that are shown, and in no sum: what correcting for aberration saves."""


def sensor_figures(
    bench: Bench,
    trials: Sequence[SensorTrial],
    records: Mapping[str, Records],
    stars: Sequence[Mapping[str, float]],
) -> dict[str, Any]:
    """Return all figures as plain values."""
    nominal, confidence = records[NOMINAL], bench.sensor.confidence
    found = {trial.name: _trial(trial, records[trial.name], confidence) for trial in trials}
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
        "trials": found,
        "acquisition": _acquisition(bench, nominal),
        "false_attitude": _false_attitudes(bench, records),
        "sky": _sky(bench, records[WORST]),
        "frames": sum(len(one["right"]) for many in records.values() for one in many),
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
    found = spread((apart**2).sum(axis=0), len(errors) - 1, confidence)
    return found | {"largest_arcsec": np.abs(apart).max(axis=0).tolist()}


def temporal_noise(records: Records, confidence: float) -> dict[str, Any] | None:
    """Return the noise between the frames of a pointing; None where too few were right."""
    squares, degrees, largest = np.zeros(3), 0, np.zeros(3)
    for one in records:
        right = np.array(one["error"])[np.array(one["right"])]
        if len(right) > 1:
            apart = right - right.mean(axis=0)
            squares += (apart**2).sum(axis=0)
            degrees += len(right) - 1
            largest = np.maximum(largest, np.abs(apart).max(axis=0))
    if not degrees:
        return None
    found = spread(squares, degrees, confidence) | {"largest_arcsec": largest.tolist()}
    expected = [one["noise_variance"] for one in records if "noise_variance" in one]
    if expected:
        found["closed_form_arcsec"] = np.sqrt(np.mean(expected, axis=0)).tolist()
    return found


def _budget(records: Records, confidence: float) -> list[dict[str, Any]]:
    """Return the contributors of the nominal frames, and how they come to their sum."""
    parts = [one["contributions"] for one in records if "contributions" in one]
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
    first = np.array([_first_right(one) for one in records if any(one["right"])])
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
    """Return the mean error, its interval of 95 %, and what alignment and axis come to."""
    means = np.array(
        [np.array(one["error"])[one["right"]].mean(axis=0) for one in records if any(one["right"])]
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
    frames = [flag for one in records for flag in one["acquired"]]
    right = [flag for one in records for flag in one["right"]]
    return {
        "pointings": count,
        "frames": len(frames),
        "first_frame": Share(sum(one["right"][0] for one in records), count).as_dict(),
        "false": Share(sum(frames) - sum(right), len(frames)).as_dict(),
        "guide_stars_median": float(np.median([one["guide_stars"] for one in records])),
        "temporal": temporal_noise(records, confidence) if trial.frames > 1 else None,
    }


def _acquisition(bench: Bench, records: Records) -> list[dict[str, Any]]:
    """Return the share of pointings with the right attitude within so many frames, and the time."""
    rows = []
    for frames in range(1, len(records[0]["right"]) + 1):
        hits = sum(any(one["right"][:frames]) for one in records)
        sensor = bench.sensor
        time_s = (frames - 1) / sensor.update_rate_hz + sensor.exposure_s + sensor.processing_s
        rows.append({"frames": frames, "time_s": time_s} | Share(hits, len(records)).as_dict())
    return rows


def _false_attitudes(bench: Bench, records: Mapping[str, Records]) -> dict[str, Any]:
    acquired = [flag for many in records.values() for one in many for flag in one["acquired"]]
    right = [flag for many in records.values() for one in many for flag in one["right"]]
    chances = [chance for many in records.values() for one in many for chance in one["chance"]]
    return Share(sum(acquired) - sum(right), len(acquired)).as_dict() | {
        "bound_of_a_frame": bench.matcher.max_false_match_probability,
        "largest_stated": max(chances, default=0.0),
        "sum_stated": math.fsum(chances),
    }


def _sky(bench: Bench, worst: Records) -> dict[str, Any]:
    found = expected_noise(bench)
    across = np.hypot(found["sigma"][:, 0], found["sigma"][:, 1]) / math.sqrt(2.0)
    parts = {"fewest": 0.0, "one_percent": 0.01, "median": 0.5}
    counts = {
        name: float(np.quantile(found["stars"], q, method="inverted_cdf"))
        for name, q in parts.items()
    }
    noise = {
        f"{name}_arcsec": [
            float(np.quantile(values, q, method="inverted_cdf"))
            for values in (across, found["sigma"][:, 2])
        ]
        for name, q in (("median", 0.5), ("worst_one_percent", 0.99))
    }
    return {
        "boresights": len(across),
        "below_four": Share(int((found["stars"] < 4).sum()), len(across)).as_dict(),
        "guide_stars": counts,
        **{k: [v if math.isfinite(v) else None for v in both] for k, both in noise.items()},
        "worst_first_frame": Share(sum(one["right"][0] for one in worst), len(worst)).as_dict(),
    }
