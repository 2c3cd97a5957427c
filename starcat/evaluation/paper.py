"""What a paper printed, and the experiment that measures the same: the rows of the evaluation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from starcat.evaluation.experiment import Experiment
from starcat.matcher.database import open_database


@dataclass(frozen=True)
class Row:
    """One line of a paper's table or one point of its curves."""

    group: str  # title of the table or curve
    label: str  # name of the line
    preset: str  # the artifact that is used, by its preset
    experiment: Experiment  # the frames and the method
    rule: str  # what the paper counts as a success: a key of `RULES`
    published_percent: float | None = None  # what the paper prints
    published_ms: float | None = None
    goal_percent: float | None = None  # what starcat wants to reach
    goal_ms: float | None = None  # mean time that starcat wants to stay under
    # Whether the goal is over all frames or those that hold at least four guide stars
    goal_over: Literal["all", "4+"] = "all"
    x: float | None = None  # abscissa, where the group is a curve
    note: str = ""  # what differs from the paper


@dataclass(frozen=True)
class Statistic:
    """A number that needs no experiment, such as a count of triangles or bytes."""

    group: str  # title of the table, and name of the line
    label: str
    measured: float  # the number that starcat measures
    unit: str = ""  # unit of the numbers; empty for counts
    # the number that the paper prints, and the one that starcat wants to reach
    published: float | None = None
    goal: float | None = None
    # how to read the goal; None where it is to be met within 1 percent
    is_lower_better: bool | None = None
    note: str = ""  # what differs from the paper


@dataclass(frozen=True)
class Paper:
    """A paper and all that is reproduced of it."""

    name: str  # ``S1`` to ``S5``
    title: str  # what it is about; who, where, when
    citation: str
    presets: tuple[str, ...]  # artifacts that it needs
    # for a quick run (True) with fewer frames
    rows: Callable[[bool], list[Row]] = lambda quick: []
    # from the artifacts' folders by preset
    statistics: Callable[[dict[str, Path], bool], list[Statistic]] = lambda artifacts, quick: []
    deviations: tuple[str, ...] = ()  # what the paper leaves unsaid, and what is done instead


def tolerance_for(noise_px: float) -> float:
    """Return the tolerance that a matcher is given for a position noise."""
    return max(1.0, 3.0 * noise_px)


def product_mib(artifact: Path, product: str) -> float:
    """Return the size of a product in the database."""
    arrays = open_database(artifact, (product,)).products[product].arrays
    return sum(values.nbytes for values in arrays.values()) / 2**20
