"""Units and meanings of the columns of an answer.

A column keeps the unit and the meaning of the product's column whose name it has. Any other column
gets the unit that its name ends with, as everywhere in starcat: ``x_deg`` is in degrees.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from starcat.query.targets import View

UNIT_SUFFIXES = {
    "_mas_yr": "mas/yr",
    "_mas": "mas",
    "_arcsec": "arcsec",
    "_jyear": "yr",
    "_deg": "deg",
    "_rad": "rad",
    "_mag": "mag",
    "_px": "pix",
}


@dataclass(frozen=True)
class Facts:
    """What is known of a column.

    Attributes
    ----------
    unit, description, ucd : str
        Empty where there is none.
    """

    unit: str = ""
    description: str = ""
    ucd: str = ""

    def as_metadata(self) -> dict[str, str]:
        """Return the facts as the metadata of an Arrow field."""
        return {key: value for key, value in vars(self).items() if value}

    def __str__(self) -> str:
        return f"{self.description} [{self.unit}]" if self.unit else self.description


def facts_by_name(views: Iterable[View]) -> dict[str, Facts]:
    """Return what is known of columns by their name."""
    found: dict[str, Facts] = {}
    for view in views:
        for column in view.schema.columns if view.schema else ():
            facts = Facts(column.unit, column.description, column.ucd)
            before = found.setdefault(column.name, facts)
            if before != facts:
                found[column.name] = Facts(facts.unit if facts.unit == before.unit else "")
    return found


def column_facts(name: str, known: Mapping[str, Facts]) -> Facts:
    """Return what is known of a column of an answer.

    Examples
    --------
    >>> column_facts("width_deg", {}).unit
    'deg'
    """
    if name in known:
        return known[name]
    return Facts(next((unit for end, unit in UNIT_SUFFIXES.items() if name.endswith(end)), ""))
