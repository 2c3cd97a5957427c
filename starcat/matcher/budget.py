"""The budget of a search: how many steps, and how long, it may take.

A step is a candidate that is compared with the frame, and takes some microseconds. Looking up a
pattern of the frame counts as `LOOKUP` steps, working out an agreement as `AGREEMENT`. The same
budget in steps gives the same answer everywhere; a limit of time does not.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Literal

LOOKUP = 10
"""Steps of looking up one pattern of a frame."""

AGREEMENT = 50
"""Steps of working out one agreement."""


class BudgetSpentError(Exception):
    """A search is over before it has come to its end."""

    def __init__(self, limit: Literal["time", "steps"]) -> None:
        super().__init__(f"the {limit} of a search are used up")
        self.limit: Literal["time", "steps"] = limit


@dataclass
class Budget:
    """What is left of a search.

    Attributes
    ----------
    max_steps : float
        Steps that it may take; infinite by default.
    time_limit_s : float
        Seconds that it may take from now on; infinite by default.
    steps : int
        Steps that it has taken.
    """

    max_steps: float = math.inf
    time_limit_s: float = math.inf
    steps: int = 0
    _start_s: float = field(default_factory=time.perf_counter, repr=False)

    def spend(self, steps: int) -> None:
        """Take steps."""
        if self.steps + steps > self.max_steps:
            raise BudgetSpentError("steps")
        self.steps += steps
        limit_s = self.time_limit_s
        if limit_s != math.inf and time.perf_counter() - self._start_s > limit_s:
            raise BudgetSpentError("time")
