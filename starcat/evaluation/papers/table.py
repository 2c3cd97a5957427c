"""The papers whose figures are reproduced, by name."""

from __future__ import annotations

from starcat.errors import ConfigError
from starcat.evaluation.paper import Paper
from starcat.evaluation.papers import s1, s2, s3, s4, s5

PAPERS: dict[str, Paper] = {
    paper.name: paper for paper in (s1.PAPER, s2.PAPER, s3.PAPER, s4.PAPER, s5.PAPER)
}
"""``S1`` to ``S5``, each from its own module of ``starcat.evaluation.papers``."""


def papers_named(name: str) -> list[Paper]:
    """Return the papers that a user asks for."""
    if name.lower() == "all":
        return [PAPERS[known] for known in sorted(PAPERS)]
    try:
        return [PAPERS[name.upper()]]
    except KeyError:
        known = ", ".join([*sorted(PAPERS), "all"])
        raise ConfigError(f"paper {name!r} is unknown; choose one of {known}", value=name) from None
