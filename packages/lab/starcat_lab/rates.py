"""Rates, intervals and times of experiments, and why frames failed, by SQL over their records."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import duckdb

from starcat.matcher import CERTAIN
from starcat.pipeline.simulation import wilson_interval
from starcat.results import entry, in_record

_ACCEPTED = f"status = 'identified' AND false_match_probability <= {CERTAIN!r}"
_HOLDS = "coalesce(attitude_error_px <= $reach_px, false)"
_BEST_HOLDS = "coalesce(best_error_px <= $reach_px, false)"

RULES = {
    "starcat": f"{_ACCEPTED} AND {_HOLDS} AND n_wrong = 0",
    "attitude": _BEST_HOLDS,
    "reference": "is_reference_right",
    "two_stars": "n_right >= 2 AND n_wrong = 0",
}
"""Rules of success as conditions on a record: the rules of starcat, S4, S1 and S2, and S5.

The papers answer every frame. Their rules judge the best attitude of a frame, whatever its
probability is: the answer, or the candidate of a refused frame.
"""

WRONG = {
    "starcat": f"{_ACCEPTED} AND NOT {_HOLDS}",
    "attitude": "coalesce(best_error_px > $reach_px, false)",
    "reference": "n_named > 0 AND NOT is_reference_right",
    "two_stars": "n_wrong > 0",
}
"""Conditions on a record: the frame has an answer by the rule, and the answer is wrong."""

MEANINGS = {
    "starcat": "accepted at a false-match probability of 1e-9, the attitude right, no star wrong",
    "attitude": "the best attitude is right",
    "reference": "the guide star nearest to the centre of the frame has its own name",
    "two_stars": "at least two stars right, none wrong",
}
"""The meaning of each rule, in words."""

CAUSES = {
    "under 4 guide stars": "n_guide_stars < 4",
    "4 or 5 guide stars": "n_guide_stars < 6",
    "no answer": "status <> 'identified'",
    "wrong answer": "true",
}
"""Causes of a failure, as conditions on a frame's record; the first that holds counts."""

LIMITS = (1e-9, 1e-6, 1e-4, 1e-2)
"""Values of ``max_false_match_probability`` for which answers are counted."""

_AT_LIMITS = ", ".join(
    f"count(*) FILTER (best_probability <= {limit!r}), "
    f"count(*) FILTER (best_probability <= {limit!r} AND "
    "NOT coalesce(best_error_px <= $reach_px, false))"
    for limit in LIMITS
)
"""Answered and wrong frames by limit; frames have a candidate, so one run serves all limits."""

_RATES = """
WITH record AS (
    SELECT *, n_guide_stars >= 4 AS enough, ({rule}) AS success, ({starcat}) AS success_starcat,
           ({wrong}) AS wrong, ({wrong_by_rule}) AS wrong_by_rule
    FROM read_parquet($records)
)
SELECT count(*), count(*) FILTER (enough),
       count(*) FILTER (success), count(*) FILTER (success AND enough),
       count(*) FILTER (success_starcat), count(*) FILTER (success_starcat AND enough),
       count(*) FILTER (wrong), count(*) FILTER (wrong_by_rule),
       avg(time_ms), median(time_ms), quantile_cont(time_ms, 0.95),
       {at_limits}
FROM record
"""

_FAILURES = """
SELECT CASE {cases} END AS cause, count(*)
FROM read_parquet($records)
WHERE NOT ({rule})
GROUP BY cause
"""


@dataclass(frozen=True)
class Share:
    """Hits out of a count."""

    hits: int  # successes and frames
    count: int

    @property
    @in_record(decimals=4)
    def percent(self) -> float:
        """The share in percent; NaN for a count of 0."""
        return 100.0 * self.hits / self.count if self.count else float("nan")

    @property
    def interval_percent(self) -> tuple[float, float]:
        """Wilson's interval of 95 %, in percent; all of 0 to 100 for no frames."""
        least, most = wilson_interval(self.hits, self.count)
        return 100.0 * least, 100.0 * most

    @property
    @in_record(decimals=4)
    def low_percent(self) -> float:
        """Lower end of the interval."""
        return self.interval_percent[0]

    @property
    @in_record(decimals=4)
    def high_percent(self) -> float:
        """Upper end of the interval."""
        return self.interval_percent[1]


@dataclass(frozen=True)
class ExperimentRates:
    """How an experiment went."""

    ceiling: Share  # frames with at least four guide stars
    # successes by the paper's rule: of all frames, and of frames with four guide stars
    by_rule: Share
    by_rule_enough: Share
    # successes by starcat's own rule: accepted at 1e-9, attitude right, no star wrong
    starcat: Share
    starcat_enough: Share
    wrong: int  # frames that starcat itself would have accepted with a wrong attitude
    wrong_by_rule: Share  # frames that the paper's rule would have answered wrongly
    mean_ms: float = field(metadata=entry(decimals=4))  # time of an identification
    median_ms: float = field(metadata=entry(decimals=4))
    p95_ms: float = field(metadata=entry(decimals=4))
    # frames with an answer, and frames with a wrong one, by the largest accepted probability
    at_limits: dict[str, dict[str, int]]


def rates_by_condition(records: Path, rule: str, reach_px: float) -> ExperimentRates:
    """Return the rates of an experiment."""
    query = _RATES.format(
        rule=RULES[rule], starcat=RULES["starcat"], wrong=WRONG["starcat"],
        wrong_by_rule=WRONG[rule], at_limits=_AT_LIMITS,
    )  # fmt: skip
    (row,) = _rows(query, records, reach_px)
    (
        count,
        enough,
        hits,
        hits_enough,
        starcat_hits,
        starcat_hits_enough,
        wrong,
        by_rule,
        mean,
        median,
        p95,
        *numbers,
    ) = row
    pairs = zip(numbers[::2], numbers[1::2], strict=True)
    return ExperimentRates(
        Share(enough, count),
        Share(hits, count),
        Share(hits_enough, enough),
        Share(starcat_hits, count),
        Share(starcat_hits_enough, enough),
        wrong,
        Share(by_rule, count),
        mean or 0.0,
        median or 0.0,
        p95 or 0.0,
        {
            f"{limit:g}": {"answered": answered, "wrong": is_wrong}
            for limit, (answered, is_wrong) in zip(LIMITS, pairs, strict=True)
        },
    )


def failures_of(records: Path, rule: str, reach_px: float) -> dict[str, int]:
    """Count the frames of an experiment that failed, by cause."""
    cases = " ".join(f"WHEN {condition} THEN '{cause}'" for cause, condition in CAUSES.items())
    query = _FAILURES.format(cases=cases, rule=RULES[rule])
    return dict.fromkeys(CAUSES, 0) | dict(_rows(query, records, reach_px))


def _rows(query: str, records: Path, reach_px: float) -> list[Any]:
    values = {"records": str(records), "reach_px": float(reach_px)}
    # It is an error to pass a value that the query does not use.
    named = {name: value for name, value in values.items() if f"${name}" in query}
    with _database().cursor() as cursor:
        return list(cursor.execute(query, named).fetchall())


@cache
def _database() -> duckdb.DuckDBPyConnection:
    """Return an empty database: opening one takes longer than a query does."""
    return duckdb.connect()
