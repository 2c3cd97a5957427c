"""The output of ``starcat calibrate``."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

from starcat.cli.console import print_json, say, show_result
from starcat.frames.calibration.calibrate import Calibration
from starcat.frames.calibration.earth_rotation import EarthRotation
from starcat.frames.calibration.fit import AXES, PARAMETERS, Fit
from starcat.results import to_dict


def print_calibration(
    calibration: Calibration, output: Path, turned: EarthRotation | None = None, *, as_json: bool
) -> None:
    """Print a calibration: the camera with its errors, the comparison of models, the frames."""
    record = {"file": str(output), **to_dict(calibration)}
    if turned is not None:
        record["earth_rotation"] = to_dict(turned)
    if as_json:
        print_json(record)
        return
    moves = ("stretch", "shear", "turn_deg_s") if calibration.has_motion else ()
    columns = {
        "": ("n_frames", "n_identified", "stars", "residual_px"),
        "supported": (),
        "frames": (
            *("frame", "status", "n_centroids", "n_matched", "residual_px"), *moves, "reason",
        ),
    }  # fmt: skip
    counted = {"n_frames": len(calibration.frames), "n_identified": calibration.n_identified}
    show_result(counted | {"parameters": _parameters(calibration)} | record, columns=columns)
    if calibration.has_motion:
        say(
            "Each frame has a stretch and a shear of its own, as if the camera turned while its "
            "rows were read (rolling shutter). The camera file has the lens alone; whether the "
            "pixels are square cannot be determined from these frames."
        )
    if turned is not None:
        show_result(turned, "Against the rotation of the Earth")
    remarks = Counter(remark for frame in calibration.frames for remark in frame.remarks)
    for remark, count in remarks.items():
        say(f"{remark} ({count} of {len(calibration.frames)} frames)")
    if not calibration.has_square_pixels:
        say(
            "Aspect and skew (above) differ from 0 by more than their errors, but a camera file "
            "cannot state them. If the difference across the detector matters, look for resized "
            "images or another model of the lens."
        )


def _parameters(calibration: Calibration) -> list[dict[str, Any]]:
    """Return each parameter as it was fitted with the supported terms, and with all terms."""
    rows = []
    for name in PARAMETERS:
        every = calibration.axes if name in AXES else calibration.complete
        if name in every.free:
            value, error = _rounded(calibration.fit, name)
            value_of_all, error_of_all = _rounded(every, name)
            rows.append({
                "parameter": name, "value": value, "error": error,
                "value of all": value_of_all, "error of all": error_of_all,
            })  # fmt: skip
    return rows


def _rounded(fit: Fit, name: str) -> tuple[str, str]:
    """Return value and error of a parameter with two digits of the error."""
    if name not in fit.free:
        return "-", ""
    error = fit.errors[name]
    digits = max(0, 1 - math.floor(math.log10(error))) if error > 0.0 else 6
    return f"{fit.values[PARAMETERS.index(name)]:.{digits}f}", f"{error:.{digits}f}"
