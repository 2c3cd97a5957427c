"""S2: dynamic-angle matching (Sun et al. 2021), and the four baselines of its table."""

from __future__ import annotations

from dataclasses import replace

from starcat.geometry import Camera, Distortion
from starcat.pipeline.simulation import Noise
from starcat_lab.experiment import Attitudes, Experiment, ExperimentRow, Paper, paper_experiment

PRESET = "sao-12deg"

LIMIT_MAG = 6.0

GRID = Attitudes("grid", 0, 2.0)
"""Attitudes of the paper: every 2 degrees in both coordinates, 16,200 images, rolls at random."""

FEWER = Attitudes("grid", 2025, 2.0)
"""Attitudes of the inner points of curves: every eighth of the grid."""

QUARTER = Attitudes("grid", 4050, 2.0)
"""Attitudes of the baselines behind a distorting lens: every fourth of the grid."""

PUBLISHED = {
    "pairs": ("improved triangle", 93.75, 2.38, 44.75),
    "radial": ("radial and cyclic", 96.29, 1.62, 27.12),
    "grid": ("grid", 97.53, 1.49, 95.83),
    "pyramid": ("pyramid", 99.69, 2.34, 11.34),
    "dynamic_angle": ("dynamic angle", 99.80, 7.21, 99.54),
}
"""Method to its name in the paper, tables 3 and 4: percent and ms ideal, percent distorted."""

BARREL = Distortion(k1=-0.5)
"""The paper does not print its lens. This one moves the corner by 8.0 px and the edge by 2.8."""

BARREL_TOLERANCE_PX = 8.0
"""Tolerance of a matcher for a lens that it does not know."""


def rows(quick: bool) -> list[ExperimentRow]:
    """Return the rows of S2."""
    grid = Attitudes("grid", 180, 2.0) if quick else GRID
    fewer = Attitudes("grid", 180, 2.0) if quick else FEWER
    return [
        *_ideal(grid),
        *_curve("Position noise", "px", (0.5, 1.0, 1.5, 2.0), 98.30, 99.0, grid, fewer),
        *_curve("False stars", "", (1.0, 2.0, 3.0, 4.0, 5.0), 97.83, 98.8, grid, fewer),
        *_curve("Magnitude noise", "mag", (0.2, 0.4, 0.6, 0.8, 1.0), 98.84, 98.9, grid, fewer),
        _guide_stars_alone(grid),
        _no_star_vanishes(grid),
        *_distorted(grid, Attitudes("grid", 180, 2.0) if quick else QUARTER),
    ]


def _experiment(name: str, method: str, attitudes: Attitudes, noise: Noise) -> Experiment:
    return paper_experiment(f"s2-{name}-{method}", method, attitudes, noise, seed=2021)


def _ideal(grid: Attitudes) -> list[ExperimentRow]:
    experiment_rows = []
    for method, (label, percent, ms, _) in PUBLISHED.items():
        is_own = method == "dynamic_angle"
        goal_percent, goal_ms = (99.81, 7.2) if is_own else (percent, None)
        experiment_rows.append(
            ExperimentRow("Ideal images (table 3)", label, PRESET,
                _experiment("ideal", method, grid, Noise(limit_mag=LIMIT_MAG)), "reference",
                percent, ms, goal_percent, goal_ms)
        )  # fmt: skip
    experiment_rows.append(
        ExperimentRow("Ideal images (table 3)", "triangle of S4", PRESET,
            _experiment("ideal", "triangle", grid, Noise(limit_mag=LIMIT_MAG)), "reference",
            note="not in the paper: starcat's default")
    )  # fmt: skip
    return experiment_rows


def _curve(
    group: str,
    unit: str,
    values: tuple[float, ...],
    percent: float,
    goal: float,
    grid: Attitudes,
    fewer: Attitudes,
) -> list[ExperimentRow]:
    experiment_rows = []
    for value in values:
        is_last = value == values[-1]
        for method in ("dynamic_angle", "triangle"):
            is_own = method == "dynamic_angle"
            attitudes = grid if is_last and is_own else fewer
            experiment = _experiment(f"{group}-{value:g}", method, attitudes, _noise(group, value))
            published, row_goal = (percent, goal) if is_last and is_own else (None, None)
            experiment_rows.append(
                ExperimentRow(group,
                    f"{PUBLISHED.get(method, ('triangle of S4',))[0]}, {value:g} {unit}",
                    PRESET, experiment, "reference",
                    published, None, row_goal, x=value)
            )  # fmt: skip
    return experiment_rows


def _guide_stars_alone(grid: Attitudes) -> ExperimentRow:
    experiment = _experiment(
        "guides-magnitude-1", "dynamic_angle", grid, _noise("Magnitude noise", 1.0)
    )
    return ExperimentRow("Magnitude noise, guide stars alone", "dynamic angle, 1 mag", PRESET,
               replace(experiment, guide_stars_only=True), "reference", 98.84, None, 98.9,
               note="nothing else shines, as in the paper's images it seems")  # fmt: skip


def _no_star_vanishes(grid: Attitudes) -> ExperimentRow:
    noise = replace(_noise("Magnitude noise", 1.0), is_limit_true=True)
    experiment = _experiment("seen-magnitude-1", "dynamic_angle", grid, noise)
    note = "the true magnitude decides what is seen, the noise only what is measured"
    return ExperimentRow("Magnitude noise, no star vanishes", "dynamic angle, 1 mag", PRESET,
            experiment,
               "reference", 98.84, None, 98.9, note=note)  # fmt: skip


def _noise(group: str, value: float) -> Noise:
    if group == "Position noise":
        return Noise(noise_px=value, limit_mag=LIMIT_MAG)
    if group == "False stars":
        return Noise(false_stars=int(value), limit_mag=LIMIT_MAG)
    return Noise(noise_mag=value, limit_mag=LIMIT_MAG)


def _distorted(grid: Attitudes, fewer: Attitudes) -> list[ExperimentRow]:
    lens = Camera(1024, 1024, fov_x_deg=12.0, distortion=BARREL)
    assumed = Camera(1024, 1024, fov_x_deg=12.0)
    experiment_rows = []
    for method, (label, _, _, percent) in PUBLISHED.items():
        is_own = method == "dynamic_angle"
        undistorted = _experiment(
            "barrel", method, grid if is_own else fewer, Noise(limit_mag=LIMIT_MAG)
        )
        experiment = replace(
            undistorted, camera=lens, assumed=assumed, tolerance_px=BARREL_TOLERANCE_PX
        )
        experiment_rows.append(
            ExperimentRow("Barrel distortion (table 4)", label, PRESET,
            experiment, "reference", percent,
                None, 99.6 if is_own else None, note=f"k1 = {BARREL.k1:g}, the matcher is not told")
        )  # fmt: skip
    return experiment_rows


PAPER = Paper(
    name="S2",
    title="Dynamic-angle matching",
    citation="Sun et al. 2021, Acta Optica Sinica",
    presets=(PRESET,),
    rows=rows,
    deviations=(
        "Images show the whole catalog up to the limit: doubles that the camera cannot split as "
        "one spot, variables, and with magnitude noise also stars below the limit. The paper "
        "seems to show its guide stars alone.",
        "Noise of 1 mag is read in two other ways, each in a row of its own: guide stars alone "
        "shine; the noise hides no star.",
        "The roll of each image is drawn at random; the paper does not state one.",
        "Noises are Gaussian with the stated value as standard deviation (per axis for positions).",
        "The paper does not print its distortion. Here r' = r (1 + k1 r^2) with k1 = -0.5 in units "
        "of the focal length, and the matcher is given the lens without distortion and a tolerance "
        f"of {BARREL_TOLERANCE_PX:g} px.",
        "The paper's rule: the guide star nearest to the centre has its own name. The matcher "
        "answers from a false-match probability of 0.001 down; starcat's own rule asks for 1e-9.",
        "Inner points of the curves are every eighth image, baselines behind the lens every "
        "fourth.",
    ),
)
