"""S4: double-feature triangles in the short-wave infrared (Liao and Zhang 2024)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from starcat.pipeline.simulation import Noise
from starcat_lab.experiment import (
    Attitudes,
    Experiment,
    ExperimentRow,
    Paper,
    Statistic,
    paper_experiment,
    product_mib,
)

PRESET = "2mass-8x6"

LIMIT_MAG = 4.4

METHODS = {"triangle": "double-feature triangle", "pairs": "improved triangle"}

MIXED = Noise(noise_px=1.0, noise_mag=0.5, false_share=0.2, limit_mag=LIMIT_MAG)


def rows(quick: bool) -> list[ExperimentRow]:
    """Return the rows of S4."""
    count = 50 if quick else 1000
    return [
        *_curve("Position noise", "px", (0.2, 0.5, 1.0, 1.5, 2.0), (96.5, 83.5), 99.0, count),
        *_curve("False stars", "%", (10.0, 20.0, 30.0, 40.0, 50.0), (87.6, 78.3), 95.0, count),
        *_curve("Magnitude noise", "mag", (0.2, 0.4, 0.6, 0.8, 1.0), (98.0, None), 98.0, count),
        _unhidden(count),
        *_mixed(10 * count),
    ]


def _experiment(name: str, method: str, count: int, noise: Noise) -> Experiment:
    return paper_experiment(
        f"s4-{name}-{method}", method, Attitudes("random", count), noise,
        max_false_match_probability=1.0, seed=2024,
    )  # fmt: skip


def _curve(
    group: str,
    unit: str,
    values: tuple[float, ...],
    published: tuple[float | None, float | None],
    goal: float,
    count: int,
) -> list[ExperimentRow]:
    experiment_rows = []
    for value in values:
        is_last = value == values[-1]
        for (method, label), percent in zip(METHODS.items(), published, strict=True):
            experiment_rows.append(
                ExperimentRow(group, f"{label}, {value:g} {unit}", PRESET,
                    _experiment(f"{group}-{value:g}", method, count, _noise(group, value)),
                    "attitude",
                    percent if is_last else None, None,
                    goal if is_last and method == "triangle" else None, goal_over="4+", x=value)
            )  # fmt: skip
    return experiment_rows


def _unhidden(count: int) -> ExperimentRow:
    noise = replace(_noise("Magnitude noise", 1.0), is_limit_true=True)
    experiment = _experiment("seen-magnitude-1", "triangle", count, noise)
    return ExperimentRow("Magnitude noise, no star vanishes", f"{METHODS['triangle']}, 1 mag",
        PRESET,
               experiment, "attitude", 98.0, None, 98.0, goal_over="4+",
               note="the true magnitude decides what is seen, the noise only what is measured",
    )  # fmt: skip


def _noise(group: str, value: float) -> Noise:
    if group == "Position noise":
        return Noise(noise_px=value, limit_mag=LIMIT_MAG)
    if group == "False stars":
        return Noise(false_share=value / 100.0, limit_mag=LIMIT_MAG)
    return Noise(noise_mag=value, limit_mag=LIMIT_MAG)


def _mixed(count: int) -> list[ExperimentRow]:
    note = "1 px, 20 % false stars, 0.5 mag"
    group = "Mixed noise"
    return [
        ExperimentRow(group, METHODS["triangle"], PRESET, _experiment("mixed", "triangle", count,
            MIXED),
            "attitude", 95.5, 14.27, 98.0, 1.5, "4+", note=note),
        ExperimentRow(group, f"{METHODS['triangle']}, C library", PRESET,
            replace(_experiment("mixed-installed", "triangle", count, MIXED), engine="auto"),
            "attitude", 95.5, 14.27, 98.0, 1.5, "4+",
            note="as it is installed: the C library, numpy where there was no compiler"),
        ExperimentRow(group, METHODS["pairs"], PRESET, _experiment("mixed", "pairs", count, MIXED),
            "attitude", 82.4, 68.45, note=note),
    ]  # fmt: skip


def statistics(databases: dict[str, Path], quick: bool) -> list[Statistic]:
    """Return the sizes of the two feature bases."""
    folder = databases[PRESET]
    group = "Storage"
    return [
        Statistic(group, "triangles", product_mib(folder, "triangles"), "MiB", 8.2, 2.4, True),
        Statistic(group, "pairs", product_mib(folder, "pairs"), "MiB", 2.4, None, None,
                  "all pairs up to the field's diagonal"),
    ]  # fmt: skip


PAPER = Paper(
    name="S4",
    title="Short-wave-infrared double-feature triangles",
    citation="Liao and Zhang 2024, Electronics Optics & Control",
    presets=(PRESET,),
    rows=rows,
    statistics=statistics,
    deviations=(
        "The 7,274 stars are the brightest of an excerpt of 2MASS in (J+H)/2, which stands for "
        "the paper's unstated magnitude.",
        "The detector and the lens make 8.08 x 6.46 degrees; the tiling has the paper's 8 x 6.",
        "Images show every star of the excerpt up to the limit, guide star or not, and with "
        "magnitude noise also stars below it.",
        "False stars: so many that they are the stated share of all centroids; their magnitudes "
        "are those of stars drawn at random.",
        "Noises are Gaussian with the stated value as standard deviation (per axis for positions).",
        "The paper's rule: the attitude is right. A false-match probability of 0.01 ends the "
        "search, else the best agreement is the answer, as four stars of four do not reach "
        "starcat's own 1e-9.",
        "The paper does not say whether its noise of magnitudes hides stars. The curve takes it to "
        "do so; a row of its own has the other reading.",
    ),
)
