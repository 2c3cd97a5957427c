"""An evaluation of any database with any camera: one quantity varied at a time.

It has the structure of a paper's rows, so that the same experiments, tables and plots are used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from starcat.database import open_database_folder
from starcat.errors import ConfigError
from starcat.geometry import Camera
from starcat.matcher import METHODS, best_method, method_named, open_database, products_in
from starcat.pipeline.simulation import Noise
from starcat_lab.experiment import Attitudes, Experiment, ExperimentRow, Paper, tolerance_for


@dataclass(frozen=True)
class Parameter:
    """A quantity with one value per experiment."""

    name: str  # its key of `PARAMETERS`, the option of the command line
    label: str  # the quantity in words, with its unit
    usual: tuple[float, ...]  # default values of a sweep; empty: not varied by default
    low: float  # values outside of this range are invalid
    high: float
    # function that returns its value in an experiment; NaN if the experiment has none
    read: Callable[[Experiment], float]
    write: Callable[[Experiment, float], Experiment]  # the same experiment with another value
    is_count: bool = False  # whether its values are whole numbers

    def check(self, value: float) -> None:
        """Check that this quantity can have a value."""
        expected = ""
        if not self.low <= value <= self.high:
            expected = f"{self.low:g} to {self.high:g}"
        elif self.is_count and value != int(value):
            expected = "a whole number"
        if expected:
            raise ConfigError(f"expected {expected}", parameter=self.name, value=value)

    def with_value(self, experiment: Experiment, value: float) -> Experiment:
        """Return an experiment with another value of this quantity."""
        self.check(value)
        try:
            return self.write(experiment, value)
        except ValueError as error:
            raise ConfigError(str(error), parameter=self.name, value=value) from error


def _noise(name: str, label: str, usual: tuple[float, ...], low: float, high: float) -> Parameter:
    is_count = isinstance(getattr(Noise, name), int)

    def write(experiment: Experiment, value: float) -> Experiment:
        change: dict[str, Any] = {name: int(value) if is_count else value}
        return replace(experiment, noise=replace(experiment.noise, **change))

    return Parameter(
        name, label, usual, low, high,
        lambda experiment: float(getattr(experiment.noise, name)), write, is_count,
    )  # fmt: skip


def _cameras(experiment: Experiment) -> tuple[Camera, Camera]:
    if experiment.camera is None or experiment.assumed is None:
        raise ValueError("expected an experiment with camera and assumed camera")
    return experiment.camera, experiment.assumed


def _k1(experiment: Experiment) -> float:
    if experiment.camera is None or experiment.assumed is None:
        return math.nan
    return experiment.camera.distortion.k1 - experiment.assumed.distortion.k1


def _with_k1(experiment: Experiment, k1: float) -> Experiment:
    camera, assumed = _cameras(experiment)
    lens = replace(camera.distortion, k1=assumed.distortion.k1 + k1)
    return replace(experiment, camera=replace(camera, distortion=lens))


def _scale(experiment: Experiment) -> float:
    if experiment.camera is None or experiment.assumed is None:
        return math.nan
    return experiment.camera.focal_length_px / experiment.assumed.focal_length_px


def _with_scale(experiment: Experiment, scale: float) -> Experiment:
    camera, assumed = _cameras(experiment)
    true = replace(camera, focal_length_px=scale * assumed.focal_length_px)
    return replace(experiment, camera=true)


def _roll_deg(experiment: Experiment) -> float:
    roll_deg = experiment.attitudes.roll_deg
    return math.nan if roll_deg is None else roll_deg


def _with_roll(experiment: Experiment, roll_deg: float) -> Experiment:
    return replace(
        experiment, attitudes=Attitudes("stars", experiment.attitudes.count, roll_deg=roll_deg)
    )


PARAMETERS: dict[str, Parameter] = {
    "noise_px": _noise("noise_px", "position noise, px", (0.0, 0.5, 1.0, 1.5, 2.0), 0.0, 50.0),
    "noise_mag": _noise("noise_mag", "magnitude noise, mag", (0.0, 0.25, 0.5, 1.0), 0.0, 10.0),
    "false_stars": _noise("false_stars", "false stars", (0.0, 2.0, 5.0, 10.0), 0.0, 1000.0),
    "false_share": _noise(
        "false_share", "share of false stars among the centroids", (0.0, 0.2, 0.35, 0.5), 0.0, 0.95
    ),
    "drop_probability": _noise(
        "drop_probability", "chance of a star to be missing", (0.0, 0.1, 0.2, 0.4), 0.0, 1.0
    ),
    "k1": Parameter(
        "k1", "distortion k1 that the matcher does not know",
        (-0.5, -0.2, -0.1, 0.0), -10.0, 10.0, _k1, _with_k1,
    ),
    "roll_deg": Parameter(
        "roll_deg", "roll about a guide star, deg", (0.0, 45.0, 90.0, 135.0, 180.0), -360.0, 360.0,
        _roll_deg, _with_roll,
    ),
    "scale": Parameter(
        "scale", "true focal length over the assumed one",
        (0.99, 0.995, 1.0, 1.005, 1.01), 0.1, 10.0, _scale, _with_scale,
    ),
    "limit_mag": _noise("limit_mag", "faintest magnitude that is seen, mag", (), -30.0, 40.0),
}  # fmt: skip
"""Quantities by name. A sweep changes the true camera, not the camera that the matcher assumes."""


def axis_label(experiments: Sequence[Experiment], x: Sequence[float]) -> str:
    """Return the label of the abscissa of a curve, from the experiments along it."""
    for axis in PARAMETERS.values():
        values = [axis.read(experiment) for experiment in experiments]
        for times, label in ((1.0, axis.label), (100.0, f"{axis.label}, percent")):
            if len(set(x)) > 1 and all(
                math.isclose(times * value, at, abs_tol=1e-9)
                for value, at in zip(values, x, strict=True)
            ):
                return label
    return ""


FRAMES, FEW_FRAMES = 500, 100
"""Default number of frames of an experiment, and of a quick experiment."""

NOISE_PX = 0.5
"""Default noise of the centroids while another quantity is varied."""


@dataclass(frozen=True)
class Sweep:
    """The experiments to run."""

    database: Path  # the database's folder
    # the camera that the matcher assumes; the true one differs if ``k1`` or ``scale`` are varied
    camera: Camera
    methods: tuple[str, ...]  # ways to identify
    limit_mag: float  # fainter stars are not seen
    # by key of `PARAMETERS`: a single value applies to all experiments; several values are tried in
    # turn while the other quantities keep theirs
    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    frames: int = FRAMES  # frames of each experiment
    # tolerance of the matcher; by default derived from the position noise (`tolerance_for`)
    tolerance_px: float | None = None
    seed: int = 1  # seed of all random numbers
    is_quick: bool = False  # whether fewer frames were requested


def sweep_values(**texts: str | None) -> dict[str, tuple[float, ...]]:
    """Read the values that a user gives to quantities."""
    values = {}
    for name, text in texts.items():
        if text is None:
            continue
        try:
            values[name] = tuple(float(number) for number in text.split(","))
        except ValueError as error:
            raise ConfigError(
                f"--{name.replace('_', '-')} {text!r}: expected one number, or several with commas "
                "between them, such as 0,0.5,1",
                key=name,
                value=text,
            ) from error
    return values


def plan_sweep(
    database: Path,
    values: Mapping[str, Sequence[float]],
    *,
    method: str | None = None,
    camera: Camera | None = None,
    frames: int | None = None,
    tolerance_px: float | None = None,
    seed: int = 1,
    quick: bool = False,
) -> Sweep:
    """Fill in defaults for values that a user did not give."""
    manifest = open_database_folder(database).manifest
    return Sweep(
        database,
        camera or open_database(database).camera,
        _methods(database, method),
        manifest["spec"]["selection"]["faint_limit_mag"],
        _values_to_try(values),
        frames or (FEW_FRAMES if quick else FRAMES),
        tolerance_px,
        seed,
        quick,
    )


def _values_to_try(values: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, ...]]:
    """Return the values to try: the given ones, each once and in order, or the usual ones."""
    for name, points in values.items():
        if name not in PARAMETERS or not points:
            raise ConfigError(
                f"quantity {name!r} has {len(points)} values; expected one or more of one of "
                + ", ".join(PARAMETERS),
                key=name,
            )
        for value in points:
            PARAMETERS[name].check(value)
    ordered = {name: tuple(sorted(set(points))) for name, points in values.items()}
    return ordered or {name: axis.usual for name, axis in PARAMETERS.items() if axis.usual}


def _methods(database: Path, method: str | None) -> tuple[str, ...]:
    products = set(products_in(database))
    if method is None:
        return (best_method(products),)
    if method == "all":
        return tuple(n for n, entry in METHODS.items() if products.issuperset(entry.products))
    open_database(database, method_named(method).products)
    return (method,)


def sweep_paper(sweep: Sweep) -> Paper:
    """Return a sweep in a form that `run_paper` runs."""
    name = sweep.database.resolve().name
    rows = _rows(sweep, name)

    size = f"{sweep.camera.width_px} x {sweep.camera.height_px} px"
    field_of_view = f"{sweep.camera.fov_x_deg:.3g} x {sweep.camera.fov_y_deg:.3g} deg"
    title = f"{field_of_view}, {size}, stars to {sweep.limit_mag:g} mag"
    return Paper(name, title, "", (name,), lambda is_quick: rows)


def _rows(sweep: Sweep, preset: str) -> list[ExperimentRow]:
    """Return one group per quantity that varies, or one group of a single point.

    A value that differs from the default is part of the title of the group and of the name of an
    experiment, so that sweeps of a quantity under different conditions appear next to each other.
    """
    single = {name: v[0] for name, v in sweep.values.items() if len(v) == 1}
    varied = {name: v for name, v in sweep.values.items() if name not in single}
    fixed = ", ".join(f"{PARAMETERS[name].label} {value:g}" for name, value in single.items())
    prefix = "".join(f"{name}_{value:g}_" for name, value in single.items())
    note = f"{sweep.frames:,} frames, seed {sweep.seed}"
    rows = []
    if not varied:
        for method in sweep.methods:
            experiment = _experiment(sweep, method, single, prefix)
            rows.append(
                ExperimentRow(fixed or "clean", method, preset, experiment, "starcat", note=note)
            )
    for name, values in varied.items():
        group = PARAMETERS[name].label + (f" ({fixed})" if fixed else "")
        for method in sweep.methods:
            for value in values:
                experiment = _experiment(
                    sweep, method, single | {name: value}, f"{prefix}{name}_{value:g}_"
                )
                rows.append(
                    ExperimentRow(
                        group, f"{value:g}", preset, experiment, "starcat", x=value, note=note
                    )
                )
    return rows


def _experiment(sweep: Sweep, method: str, values: Mapping[str, float], prefix: str) -> Experiment:
    experiment = Experiment(
        f"{prefix}{method}",
        method,
        Attitudes("random", sweep.frames),
        Noise(NOISE_PX, limit_mag=sweep.limit_mag),
        camera=sweep.camera,
        assumed=sweep.camera,
        seed=sweep.seed,
    )
    for axis, value in values.items():
        experiment = PARAMETERS[axis].with_value(experiment, value)
    tolerance_px = sweep.tolerance_px or tolerance_for(experiment.noise.noise_px)
    return replace(experiment, tolerance_px=tolerance_px)
