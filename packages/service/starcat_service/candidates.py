"""Databases with which a frame is identified if its user does not choose one.

The field of view of the frame determines their order: databases that have this field of view come
first, then databases with many fields, then all others; the newest first. They are tried in turn.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from starcat.errors import StarcatError
from starcat.images import FOV_ERROR
from starcat.specs import BuildSpec, spec_from_dict
from starcat_service.library import ListedDatabase
from starcat_service.problems import Problem, problem_of

MAX_DATABASES = 5
"""Databases that are tried for a frame."""

MAX_TOTAL_S = 60.0
"""Seconds after which no further database is tried for a frame."""

MAX_SEARCH_S = 20.0
"""Seconds that the search for one frame in one of several databases may take."""

MAX_FLAT_DEG = 180.0
"""Fields of a camera without distortion are narrower."""

PASSED_ON = (401, 413, 429, 503, 507)
"""Statuses of problems that another database would not solve."""

T = TypeVar("T")

FieldsDeg = tuple[float, float]
"""Narrowest and widest field of view across the width of a frame, degrees."""


def spec_of(database: ListedDatabase) -> BuildSpec:
    """Return the spec of a database."""
    return spec_from_dict(database.spec, database.title)


def fits(database: ListedDatabase, fields_deg: FieldsDeg) -> bool:
    """Return whether a database covers any of some fields, within the usual error of a field."""
    narrowest, widest = spec_of(database).fields_deg
    return (
        narrowest * (1.0 - FOV_ERROR) <= fields_deg[1]
        and widest * (1.0 + FOV_ERROR) >= fields_deg[0]
    )


def field_line(database: ListedDatabase, fields_deg: FieldsDeg | None) -> str:
    """Return a line of a camera file: the field nearest to the field of a database.

    It is empty if the camera of the database has such a field: then the camera counts, with the
    distortion of its lens.
    """
    camera = database.camera
    own_deg = nearest_deg = camera.fov_x_deg
    if fields_deg is not None:
        nearest_deg = min(max(own_deg, fields_deg[0]), fields_deg[1])
    is_own = nearest_deg == own_deg and not camera.distortion.is_none
    return "" if is_own or nearest_deg >= MAX_FLAT_DEG else f"fov_x_deg = {nearest_deg!r}"


def databases_to_try(
    databases: Sequence[ListedDatabase],
    fields_deg: FieldsDeg | None,
    first: ListedDatabase | None = None,
) -> list[ListedDatabase]:
    """Return the databases for identifying a frame, in the order of trying."""

    def order(one: ListedDatabase) -> tuple[bool, bool, bool, float, str]:
        is_for_a_range = spec_of(one).is_for_a_range
        is_fitting = fields_deg is not None and fits(one, fields_deg)
        is_first = first is not None and one.id == first.id
        age = -one.folder.stat().st_mtime_ns
        return not is_first, not is_fitting, not is_for_a_range, age, one.id

    return sorted(databases, key=order)[:MAX_DATABASES]


@dataclass
class Attempts(Generic[T]):
    """The result of trying several databases on a frame."""

    reasons: list[str] = field(default_factory=list)  # why each did not identify it
    found: tuple[ListedDatabase, T] | None = (
        None  # the last answer; the first if none identifies it
    )
    is_identified: bool = False

    @property
    def words(self) -> str:
        """Which databases were tried without success, and why."""
        return "; ".join(self.reasons)


def try_each(
    databases: Sequence[ListedDatabase],
    identify: Callable[[ListedDatabase], T],
    refusal_of: Callable[[T], str],
) -> Attempts[T]:
    """Identify a frame with one database after another until one succeeds.

    ``refusal_of`` returns why an answer has not identified the frame, and nothing if it has.
    If no database answers at all, the error of the first one is raised.
    """
    until_s = time.monotonic() + MAX_TOTAL_S
    attempts: Attempts[T] = Attempts()
    error: Exception | None = None
    for database in databases:
        if attempts.reasons and time.monotonic() > until_s:
            attempts.reasons.append(f"no other database was tried after {MAX_TOTAL_S:g} s")
            break
        try:
            answer = identify(database)
        except (Problem, StarcatError) as failed:
            if isinstance(failed, Problem) and failed.status in PASSED_ON:
                raise
            error = error or failed
            attempts.reasons.append(f"{database.title}: {problem_of(failed).detail}")
            continue
        reason = refusal_of(answer)
        if not reason:
            attempts.found, attempts.is_identified = (database, answer), True
            return attempts
        attempts.reasons.append(f"{database.title}: {reason}")
        attempts.found = attempts.found or (database, answer)
    if attempts.found is None and error is not None:
        raise error
    return attempts
