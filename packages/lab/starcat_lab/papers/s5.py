"""S5: rotation-invariant feature with a modified Hausdorff distance."""

from __future__ import annotations

from pathlib import Path

from starcat.pipeline.simulation import Noise
from starcat_lab.experiment import (
    Attitudes,
    ExperimentRow,
    Paper,
    Statistic,
    paper_experiment,
    product_mib,
)

PRESET = "sao-12deg"

LIMIT_MAG = 6.0

WAYS = {
    "starcat": ("hausdorff_angular", "matcher"),
    "mean of minima": ("hausdorff_angular", "S5 mean of minima"),
    "capped at 3 px": ("hausdorff_angular", "S5 capped"),
    "grid": ("grid", "matcher"),
}
"""Label to method and answer: ranked candidates with verification, and the bare method twice."""


def rows(quick: bool) -> list[ExperimentRow]:
    """Return the rows of S5."""
    count = 40 if quick else 1000
    experiment_rows = []
    for value in (0.0, 0.5, 1.0, 1.5, 2.0):
        noise = Noise(noise_px=value, limit_mag=LIMIT_MAG)
        experiment_rows += _point("Position noise", "px", value, noise, count, (1.0, 96.8, 98.5))
    for value in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0):
        noise = Noise(noise_px=0.5, false_stars=int(value), limit_mag=LIMIT_MAG)
        experiment_rows += _point("False stars, 0.5 px", "", value, noise, count, (2.0, 93.2, 98.0))
    for value in (0.1, 0.2, 0.3, 0.4, 0.5):
        noise = Noise(noise_px=0.5, drop_probability=value, limit_mag=LIMIT_MAG)
        experiment_rows += _point("Missing stars, 0.5 px", "", value, noise, count, None)
    exact = Noise(false_stars=2, limit_mag=LIMIT_MAG)
    experiment_rows += _point("False stars without noise", "", 2.0, exact, count, None)
    return experiment_rows


def _point(
    group: str,
    unit: str,
    value: float,
    noise: Noise,
    count: int,
    published: tuple[float, float, float] | None,
) -> list[ExperimentRow]:
    experiment_rows = []
    for label, (method, answer) in WAYS.items():
        # The bare method compares every reference set with every separation.
        frames = count if label != "mean of minima" else max(40, count // 4)
        name, attitudes = f"s5-{group}-{value:g}-{label}", Attitudes("random", frames)
        experiment = paper_experiment(name, method, attitudes, noise, answer=answer, seed=2005)
        here = published is not None and value == published[0]
        is_method = label in ("starcat", "mean of minima")
        percent = published[1] if published and here and is_method else None
        goal = published[2] if published and here and label == "starcat" else None
        experiment_rows.append(
            ExperimentRow(group, f"{label}, {value:g} {unit}".rstrip(), PRESET, experiment,
                "two_stars",
                percent, 112.5 if percent and group == "Position noise" else None, goal, x=value)
        )  # fmt: skip
    return experiment_rows


def statistics(databases: dict[str, Path], quick: bool) -> list[Statistic]:
    """Return the sizes of the feature bases."""
    published = {"hausdorff_angular": None, "grid": 312.0, "triangles": None}
    return [
        Statistic("Storage", name, 1024.0 * product_mib(databases[PRESET], name), "KiB", size)
        for name, size in published.items()
    ]


PAPER = Paper(
    name="S5",
    title="Rotation-invariant feature with modified Hausdorff distance",
    citation="source paper S5",
    presets=(PRESET,),
    rows=rows,
    statistics=statistics,
    deviations=(
        "The guide stars are the preset's, without doubles and large variables; the paper uses "
        "all 5,103 of SAO with V <= 6.",
        "Images show the whole catalog up to the limit; doubles that the camera cannot split are "
        "one spot.",
        "The paper does not state the noise of its frames with false or missing stars. Here 0.5 "
        "px, and a row without noise.",
        "Only separations within the reference radius of 8 degrees are compared.",
        "The bare method names each centroid by the smallest mean of minima and keeps the largest "
        "set of names that fits into a field of view; how the paper clusters is unstated. Its "
        "rows have a quarter of the frames.",
        "The paper's rule: at least two stars right and none wrong.",
        "The paper prints 112.5 ms for its method and 367.4 ms for triangles, on its own machine.",
    ),
)
