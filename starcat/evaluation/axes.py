"""What can be varied from trial to trial, one quantity at a time: the abscissae of curves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from starcat.errors import ConfigError
from starcat.evaluation.trial import Attitudes, Trial
from starcat.geometry.camera import Camera
from starcat.simulation.simulate import Noise


@dataclass(frozen=True)
class Axis:
    """A quantity that a trial has one value of."""

    label: str  # the quantity in words, with its unit
    usual: tuple[float, ...]  # values that a sweep tries unless told otherwise; none for none
    low: float  # values outside of this range mean nothing
    high: float
    # function that returns its value in a trial; NaN where the trial has none
    read: Callable[[Trial], float]
    write: Callable[[Trial, float], Trial]  # the same trial with another value

    def with_value(self, trial: Trial, value: float) -> Trial:
        """Return a trial with another value of this quantity."""
        if not self.low <= value <= self.high:
            raise ConfigError(
                f"{self.label}: {value:g} is out of range; expected {self.low:g} to {self.high:g}",
                value=value,
            )
        try:
            return self.write(trial, value)
        except ValueError as error:
            raise ConfigError(f"{self.label}: {value:g}: {error}", value=value) from error


def _noise(name: str, label: str, usual: tuple[float, ...], low: float, high: float) -> Axis:
    """Return the axis of a field of `Noise`."""
    is_count = isinstance(getattr(Noise, name), int)

    def write(trial: Trial, value: float) -> Trial:
        if is_count and value != int(value):
            raise ValueError("expected a whole number")
        change: dict[str, Any] = {name: int(value) if is_count else value}
        return replace(trial, noise=replace(trial.noise, **change))

    return Axis(label, usual, low, high, lambda trial: float(getattr(trial.noise, name)), write)


def _cameras(trial: Trial) -> tuple[Camera, Camera]:
    """Return the camera as it is and as the matcher takes it to be."""
    if trial.camera is None or trial.assumed is None:
        raise ValueError("expected a trial that says which cameras it has")
    return trial.camera, trial.assumed


def _k1(trial: Trial) -> float:
    if trial.camera is None or trial.assumed is None:
        return math.nan
    return trial.camera.distortion.k1 - trial.assumed.distortion.k1


def _with_k1(trial: Trial, k1: float) -> Trial:
    camera, assumed = _cameras(trial)
    lens = replace(camera.distortion, k1=assumed.distortion.k1 + k1)
    return replace(trial, camera=replace(camera, distortion=lens))


def _scale(trial: Trial) -> float:
    if trial.camera is None or trial.assumed is None:
        return math.nan
    return trial.camera.focal_length_px / trial.assumed.focal_length_px


def _with_scale(trial: Trial, scale: float) -> Trial:
    camera, assumed = _cameras(trial)
    true = replace(camera, focal_length_px=scale * assumed.focal_length_px)
    return replace(trial, camera=true)


def _roll_deg(trial: Trial) -> float:
    roll_deg = trial.attitudes.roll_deg
    return math.nan if roll_deg is None else roll_deg


def _with_roll(trial: Trial, roll_deg: float) -> Trial:
    return replace(trial, attitudes=Attitudes("stars", trial.attitudes.count, roll_deg=roll_deg))


AXES: dict[str, Axis] = {
    "noise_px": _noise("noise_px", "position noise, px", (0.0, 0.5, 1.0, 1.5, 2.0), 0.0, 50.0),
    "noise_mag": _noise("noise_mag", "magnitude noise, mag", (0.0, 0.25, 0.5, 1.0), 0.0, 10.0),
    "false_stars": _noise("false_stars", "false stars", (0.0, 2.0, 5.0, 10.0), 0.0, 1000.0),
    "false_share": _noise(
        "false_share", "share of false stars among the spots", (0.0, 0.2, 0.35, 0.5), 0.0, 0.95
    ),
    "drop_probability": _noise(
        "drop_probability", "chance of a star to be missing", (0.0, 0.1, 0.2, 0.4), 0.0, 1.0
    ),
    "k1": Axis(
        "distortion k1 that the matcher does not know",
        (-0.5, -0.2, -0.1, 0.0), -10.0, 10.0, _k1, _with_k1,
    ),
    "roll_deg": Axis(
        "roll about a guide star, deg", (0.0, 45.0, 90.0, 135.0, 180.0), -360.0, 360.0,
        _roll_deg, _with_roll,
    ),
    "scale": Axis(
        "true focal length over the assumed one", (0.99, 0.995, 1.0, 1.005, 1.01), 0.1, 10.0,
        _scale, _with_scale,
    ),
    "limit_mag": _noise("limit_mag", "faintest magnitude that is seen, mag", (), -30.0, 40.0),
}  # fmt: skip
"""Quantities by name. Of a camera the true one changes, not the one that the matcher assumes."""


def axis_label(trials: Sequence[Trial], x: Sequence[float]) -> str:
    """Return what the abscissa of a curve is, from the trials along it."""
    for axis in AXES.values():
        values = [axis.read(trial) for trial in trials]
        for times, label in ((1.0, axis.label), (100.0, f"{axis.label}, percent")):
            if len(set(x)) > 1 and all(
                math.isclose(times * value, at, abs_tol=1e-9)
                for value, at in zip(values, x, strict=True)
            ):
                return label
    return ""
