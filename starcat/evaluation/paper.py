"""What a paper printed, and the trial that measures the same: the rows of the evaluation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from starcat.evaluation.trial import Trial
from starcat.matcher.database import open_database


@dataclass(frozen=True)
class Row:
    """One line of a paper's table or one point of its curves.

    Attributes
    ----------
    group : str
        Title of the table or curve.
    label : str
        Name of the line.
    preset : str
        The artifact that is used, by its preset.
    trial : Trial
        The frames and the method.
    rule : str
        What the paper counts as a success: a key of `RULES`.
    published_percent, published_ms : float, optional
        What the paper prints.
    goal_percent : float, optional
        What starcat wants to reach.
    goal_ms : float, optional
        Mean time that starcat wants to stay under.
    goal_over : {"all", "4+"}
        Whether the goal is over all frames or those that hold at least four guide stars.
    x : float, optional
        Abscissa, where the group is a curve.
    note : str
        What differs from the paper.
    """

    group: str
    label: str
    preset: str
    trial: Trial
    rule: str
    published_percent: float | None = None
    published_ms: float | None = None
    goal_percent: float | None = None
    goal_ms: float | None = None
    goal_over: Literal["all", "4+"] = "all"
    x: float | None = None
    note: str = ""


@dataclass(frozen=True)
class Statistic:
    """A number that needs no trial, such as a count of triangles or bytes.

    Attributes
    ----------
    group, label : str
        Title of the table, and name of the line.
    measured : float
        The number that starcat measures.
    unit : str
        Unit of the numbers; empty for counts.
    published, goal : float, optional
        The number that the paper prints, and the one that starcat wants to reach.
    is_lower_better : bool or None
        How to read the goal; None where it is to be met within 1 percent.
    note : str
        What differs from the paper.
    """

    group: str
    label: str
    measured: float
    unit: str = ""
    published: float | None = None
    goal: float | None = None
    is_lower_better: bool | None = None
    note: str = ""


@dataclass(frozen=True)
class Paper:
    """A paper and all that is reproduced of it.

    Attributes
    ----------
    name : str
        ``S1`` to ``S5``.
    title, citation : str
        What it is about; who, where, when.
    presets : tuple of str
        Artifacts that it needs.
    rows : callable
        Function that returns the rows; for a quick run (True) with fewer frames.
    statistics : callable
        Function that returns the other numbers, from the artifacts' folders by preset.
    deviations : tuple of str
        What the paper leaves unsaid, and what is done instead.
    """

    name: str
    title: str
    citation: str
    presets: tuple[str, ...]
    rows: Callable[[bool], list[Row]]
    statistics: Callable[[dict[str, Path], bool], list[Statistic]]
    deviations: tuple[str, ...] = ()


def tolerance_for(noise_px: float) -> float:
    """Return the tolerance that a matcher is given for a position noise."""
    return max(1.0, 3.0 * noise_px)


def product_mib(artifact: Path, product: str) -> float:
    """Return the size of a product in the database."""
    arrays = open_database(artifact, (product,)).products[product].arrays
    return sum(values.nbytes for values in arrays.values()) / 2**20
