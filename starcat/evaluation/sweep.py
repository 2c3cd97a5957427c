"""An evaluation of any artifact with any camera: one quantity varied at a time.

It is laid out as a paper's rows are, so the same trials, tables and plots serve.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from starcat.artifact.reader import open_artifact
from starcat.errors import ConfigError
from starcat.evaluation.axes import AXES
from starcat.evaluation.paper import Paper, Row, Statistic, tolerance_for
from starcat.evaluation.trial import Attitudes, Trial
from starcat.geometry.camera import Camera
from starcat.matcher.database import open_database, products_in
from starcat.matcher.methods.table import METHODS, best_method, method_named
from starcat.simulation.simulate import Noise

FRAMES, FEW_FRAMES = 500, 100
"""Frames of a trial, and of a quick trial, unless a sweep says otherwise."""

NOISE_PX = 0.5
"""Noise of the centroids while another quantity is varied, unless a sweep says otherwise."""


@dataclass(frozen=True)
class Sweep:
    """What is to be tried."""

    artifact: Path  # the artifact's folder
    # what the matcher takes the camera to be; the true one differs where ``k1`` and ``scale`` say
    # so
    camera: Camera
    methods: tuple[str, ...]  # ways to identify
    limit_mag: float  # fainter stars are not seen
    # values of each quantity, by key of `AXES`. A single value holds for all trials; several
    # values are tried one after the other while the other quantities keep theirs
    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    frames: int = FRAMES  # frames of each trial
    # tolerance of the matcher; by default what the position noise asks for (`tolerance_for`)
    tolerance_px: float | None = None
    seed: int = 1  # seed of all that is random
    is_quick: bool = False  # whether few frames were asked for


def sweep_values(**texts: str | None) -> dict[str, tuple[float, ...]]:
    """Read the values that a user gives to quantities.

    Examples
    --------
    >>> sweep_values(noise_px="0,0.5,1", k1=None)
    {'noise_px': (0.0, 0.5, 1.0)}
    """
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
    artifact: Path,
    values: Mapping[str, Sequence[float]],
    *,
    method: str | None = None,
    camera: Camera | None = None,
    frames: int | None = None,
    tolerance_px: float | None = None,
    seed: int = 1,
    quick: bool = False,
) -> Sweep:
    """Fill in what a user did not say."""
    manifest = open_artifact(artifact).manifest
    return Sweep(
        artifact,
        camera or open_database(artifact).camera,
        _methods(artifact, method),
        manifest["spec"]["selection"]["faint_limit_mag"],
        _wanted(values),
        frames or (FEW_FRAMES if quick else FRAMES),
        tolerance_px,
        seed,
        quick,
    )


def _wanted(values: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, ...]]:
    """Return the values to try: those given, each once and in order, or the usual ones."""
    for name, given in values.items():
        if name not in AXES or not given:
            raise ConfigError(
                f"quantity {name!r} has {len(given)} values; expected one or more of one of "
                + ", ".join(AXES),
                key=name,
            )
    wanted = {name: tuple(sorted(set(given))) for name, given in values.items()}
    return wanted or {name: axis.usual for name, axis in AXES.items() if axis.usual}


def _methods(artifact: Path, method: str | None) -> tuple[str, ...]:
    products = set(products_in(artifact))
    if method is None:
        return (best_method(products),)
    if method == "all":
        return tuple(n for n, known in METHODS.items() if products.issuperset(known.products))
    open_database(artifact, method_named(method).products)
    return (method,)


def sweep_paper(sweep: Sweep) -> Paper:
    """Return a sweep as something that `run_paper` runs."""
    name = sweep.artifact.resolve().name
    rows = _rows(sweep, name)

    def no_statistics(artifacts: Mapping[str, Path], is_quick: bool) -> list[Statistic]:
        return []

    size = f"{sweep.camera.width_px} x {sweep.camera.height_px} px"
    field_of_view = f"{sweep.camera.fov_x_deg:.3g} x {sweep.camera.fov_y_deg:.3g} deg"
    title = f"{field_of_view}, {size}, stars to {sweep.limit_mag:g} mag"
    return Paper(name, title, "", (name,), lambda is_quick: rows, no_statistics)


def _rows(sweep: Sweep, preset: str) -> list[Row]:
    """Return a group a quantity that varies, or one group of a single point.

    What is held at another value than usual is part of a group's title and of a trial's name,
    so that sweeps of the same quantity under other conditions stand beside each other.
    """
    single = {name: v[0] for name, v in sweep.values.items() if len(v) == 1}
    varied = {name: v for name, v in sweep.values.items() if name not in single}
    held = ", ".join(f"{AXES[name].label} {value:g}" for name, value in single.items())
    prefix = "".join(f"{name}_{value:g}_" for name, value in single.items())
    note = f"{sweep.frames:,} frames, seed {sweep.seed}"
    rows = []
    if not varied:
        for method in sweep.methods:
            trial = _trial(sweep, method, single, prefix)
            rows.append(Row(held or "clean", method, preset, trial, "starcat", note=note))
    for name, values in varied.items():
        group = AXES[name].label + (f" ({held})" if held else "")
        for method in sweep.methods:
            for value in values:
                trial = _trial(sweep, method, single | {name: value}, f"{prefix}{name}_{value:g}_")
                rows.append(Row(group, f"{value:g}", preset, trial, "starcat", x=value, note=note))
    return rows


def _trial(sweep: Sweep, method: str, values: Mapping[str, float], prefix: str) -> Trial:
    trial = Trial(
        f"{prefix}{method}",
        method,
        Attitudes("random", sweep.frames),
        Noise(NOISE_PX, limit_mag=sweep.limit_mag),
        camera=sweep.camera,
        assumed=sweep.camera,
        seed=sweep.seed,
    )
    for axis, value in values.items():
        trial = AXES[axis].with_value(trial, value)
    tolerance_px = sweep.tolerance_px or tolerance_for(trial.noise.noise_px)
    return replace(trial, tolerance_px=tolerance_px)
