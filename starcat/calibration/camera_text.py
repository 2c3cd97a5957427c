"""A calibration as a camera file, with what is known about its errors in comments."""

from __future__ import annotations

from pathlib import Path

from starcat.calibration.calibrate import Calibration
from starcat.calibration.lens import PARAMETERS
from starcat.errors import OutputError, reason
from starcat.specs.camera_file import camera_toml


def calibrated_toml(calibration: Calibration) -> str:
    """Return the TOML text of a calibrated camera."""
    fit = calibration.fit
    lines = [
        f"# Calibrated from {calibration.n_identified} frames with {len(fit.seen)} stars.",
        f"# Residual: {fit.noise_px:.3f} px on each axis. Standard errors:",
    ]
    for name, error in fit.errors.items():
        value = fit.values[PARAMETERS.index(name)]
        lines.append(f"#   {name} = {value:.6g} +- {error:.2g}")
    return "\n".join([*lines, "", camera_toml(calibration.camera)])


def write_camera(calibration: Calibration, path: Path) -> None:
    """Write a calibrated camera as a camera file."""
    try:
        path.write_text(calibrated_toml(calibration), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({reason(error)})", path=path) from error
