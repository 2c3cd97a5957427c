"""The output of ``starcat calibrate``."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from starcat.calibration.calibrate import CalibratedFrame, Calibration
from starcat.calibration.earth_rotation import EARTH_RATE_ARCSEC_S, EarthRotation
from starcat.calibration.fit import AXES, PARAMETERS, Fit, Trial
from starcat.cli.console import print_json, print_table, say

_SHORT = {
    "focal_length_px": "focal length",
    "principal_point_x_px": "principal point",
    "principal_point_y_px": "",
}


def print_calibration(
    calibration: Calibration, output: Path, turned: EarthRotation | None = None, *, as_json: bool
) -> None:
    """Print a calibration: the camera with its errors, the comparison of models, the frames."""
    if as_json:
        content = _as_dict(calibration, output)
        if turned is not None:
            content["earth_rotation"] = {**asdict(turned), "within_three_sigma": turned.within}
        print_json(content)
        return
    print_table(
        f"{calibration.n_identified} of {len(calibration.frames)} frames, "
        f"{len(calibration.fit.seen)} stars, residual {calibration.fit.noise_px:.3f} px an axis",
        ("", "value", "error", "if all are fitted", "error"),
        [_row(calibration, name) for name in PARAMETERS if name in _errors(calibration)],
        numbers=(1, 2, 3, 4),
    )
    print_table(
        "Cross-validation: models on frames that they were not fitted to",
        ("terms", "residual px", "worse than the best", ""),
        [_model(trial) for trial in calibration.trials],
        numbers=(1, 2),
    )
    moves = ("stretch %", "shear %", "turn deg/s") if calibration.has_motion else ()
    print_table(
        "Frames",
        ("frame", "status", "stars", "residual px", *moves, "because"),
        [_frame(frame, calibration.has_motion) for frame in calibration.frames],
        numbers=tuple(range(2, 4 + len(moves))),
    )
    if calibration.has_motion:
        say(
            "Each frame has a stretch and a shear of its own, as if the camera turned while its "
            "rows were read (rolling shutter). The camera file has the lens alone; whether the "
            "pixels are square cannot be determined from these frames."
        )
    if turned is not None:
        _print_turned(turned)
    remarks = Counter(remark for frame in calibration.frames for remark in frame.remarks)
    for remark, count in remarks.items():
        say(f"{remark} ({count} of {len(calibration.frames)} frames)")
    if not calibration.has_square_pixels:
        say(
            "Aspect and skew (above) differ from 0 by more than their errors, but a camera file "
            "cannot state them. If the difference across the detector matters, look for resized "
            "images or another model of the lens."
        )


def _print_turned(found: EarthRotation) -> None:
    """Print the errors of the attitudes according to the rotation of the Earth."""
    print_table(
        f"Against the rotation of the Earth: {len(found.frames)} frames, {found.n_sets} places",
        ("frame", "place", "UTC", "x arcsec", "y", "z", "error x", "y", "z", "clock s", "chi2"),
        [
            (
                one.name,
                one.set_number,
                one.time[11:22].removesuffix("Z"),
                *(f"{value:+.1f}" for value in one.error_arcsec),
                *(f"{value:.1f}" for value in one.sigma_arcsec),
                f"{one.clock_s:+.2f}",
                f"{one.chi2:.1f}",
            )
            for one in found.frames
        ],
        numbers=(1, 3, 4, 5, 6, 7, 8, 9, 10),
    )
    rows = [
        ("error of attitude about x, y, z", _three(found.rms_arcsec)),
        ("expected from the centroids", _three(found.expected_arcsec)),
        ("about the pole, with the error of the clock", f"{found.about_pole_arcsec:.1f} arcsec"),
        (
            "without the error of the clock",
            f"chi2 {found.chi2:.2f} (1 is expected), {found.within} of {len(found.frames)} frames "
            "within three sigma",
        ),
        (
            "rotation measured from the frames",
            f"{found.rate_arcsec_s:.3f} +- {found.rate_error_arcsec_s:.3f} arcsec/s "
            f"(the Earth: {EARTH_RATE_ARCSEC_S:.3f})",
        ),
    ]
    print_table("Attitude", ("", ""), rows)


def _three(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.1f}" for value in values) + " arcsec"


def _errors(calibration: Calibration) -> Mapping[str, float]:
    axes = calibration.axes.errors
    return {**calibration.complete.errors, **{name: axes[name] for name in AXES if name in axes}}


def _row(calibration: Calibration, name: str) -> tuple[str, ...]:
    chosen, other = calibration.fit, calibration.axes if name in AXES else calibration.complete
    cells = [*_cells(chosen, name), *_cells(other, name)]
    return (name, *cells)


def _cells(fit: Fit, name: str) -> tuple[str, str]:
    if name not in fit.free:
        return "-", ""
    error = fit.errors[name]
    digits = max(0, 1 - math.floor(math.log10(error))) if error > 0.0 else 6
    return f"{fit.values[PARAMETERS.index(name)]:.{digits}f}", f"{error:.{digits}f}"


def _model(trial: Trial) -> tuple[str, ...]:
    worse = "" if trial.worse_error_px2 == 0.0 else _in_errors(trial)
    terms = (_SHORT.get(name, name) for name in trial.free)
    return (
        " + ".join(filter(None, terms)),
        f"{trial.held_out_px:.4f}",
        worse if trial.worse_px2 else "best",
        "chosen" if trial.is_chosen else "",
    )


def _in_errors(trial: Trial) -> str:
    ratio = trial.worse_px2 / trial.worse_error_px2
    return (
        f"{ratio:.1f} standard errors"
        if math.isfinite(ratio)
        else "not usable: two directions fall on one pixel"
    )


def _frame(frame: CalibratedFrame, has_motion: bool) -> tuple[str, ...]:
    residual = "" if math.isnan(frame.residual_px) else f"{frame.residual_px:.3f}"
    matched = f"{frame.n_matched}/{frame.n_centroids}"
    moves: tuple[str, ...] = ()
    if has_motion:
        turn = "" if frame.turn_deg_s is None else f"{frame.turn_deg_s:.3g}"
        moves = (f"{100.0 * frame.stretch:+.2f}", f"{100.0 * frame.shear:+.2f}", turn)
        moves = ("", "", "") if math.isnan(frame.stretch) else moves
    return (frame.name, frame.status, matched, residual, *moves, frame.reason)


def _as_dict(calibration: Calibration, output: Path) -> dict[str, Any]:
    fit, camera = calibration.fit, calibration.camera
    return {
        "file": str(output),
        "camera": {
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "focal_length_px": camera.focal_length_px,
            "principal_point_px": list(camera.principal_point_px),
            "distortion": asdict(camera.distortion),
        },
        "residual_px": fit.noise_px,
        "stars": len(fit.seen),
        "supported": _parameters(fit),
        "all_terms": _parameters(calibration.complete),
        "axes": _parameters(calibration.axes),
        "models": [
            {
                "terms": list(trial.free),
                "held_out_px": _finite(trial.held_out_px),
                "worse_px2": _finite(trial.worse_px2),
                "worse_error_px2": _finite(trial.worse_error_px2),
                "is_chosen": trial.is_chosen,
            }
            for trial in calibration.trials
        ],
        "frames": [
            {
                "frame": frame.name,
                "status": frame.status,
                "n_centroids": frame.n_centroids,
                "n_matched": frame.n_matched,
                "residual_px": _finite(frame.residual_px),
                "stretch": _finite(frame.stretch),
                "shear": _finite(frame.shear),
                "turn_deg_s": frame.turn_deg_s,
                "reason": frame.reason or None,
                "remarks": list(frame.remarks),
                "q_body_from_icrs": None
                if np.isnan(frame.q_body_from_icrs).any()
                else frame.q_body_from_icrs.tolist(),
            }
            for frame in calibration.frames
        ],
    }  # fmt: skip


def _parameters(fit: Fit) -> dict[str, Any]:
    return {
        "names": list(fit.free),
        "values": [float(fit.values[PARAMETERS.index(name)]) for name in fit.free],
        "errors": list(fit.errors.values()),
        "covariance": fit.covariance.tolist(),
    }


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None
