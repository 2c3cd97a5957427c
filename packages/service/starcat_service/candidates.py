"""Databases with which a frame is identified if its user does not choose one.

The field of view of the frame determines their order: databases that have this field of view come
first, then databases with many fields, then all others; the newest first. They are tried in turn.
An attempt that fails can tell the field of view of the frame, which determines the next database.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from starcat.errors import StarcatError
from starcat.frames.images import FOV_ERROR
from starcat.pipeline.specs import BuildSpec, spec_from_dict
from starcat_service.library import ListedDatabase
from starcat_service.problems import Problem, problem_of

MAX_DATABASES = 5
"""Databases that are tried for a frame."""

MAX_TOTAL_S = 60.0
"""Seconds after which no further database is tried for a frame."""

MAX_SEARCH_S = 20.0
"""Seconds that the search for one frame in one of several databases may take."""

FOUND_ERROR = 0.01
"""Relative error of a field of view that an attempt has found."""

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


def databases_in_order(
    databases: Sequence[ListedDatabase],
    fields_deg: FieldsDeg | None,
    first: ListedDatabase | None = None,
) -> list[ListedDatabase]:
    """Return databases in the order in which they are tried on a frame."""

    def order(database: ListedDatabase) -> tuple[bool, bool, bool, float, str]:
        is_for_a_range = spec_of(database).is_for_a_range
        is_fitting = fields_deg is not None and fits(database, fields_deg)
        is_first = first is not None and database.id == first.id
        age = -database.folder.stat().st_mtime_ns
        return not is_first, not is_fitting, not is_for_a_range, age, database.id

    return sorted(databases, key=order)


@dataclass
class Attempts(Generic[T]):
    """The result of trying several databases on a frame."""

    reasons: list[str] = field(default_factory=list)  # why each did not identify it
    best: tuple[ListedDatabase, T] | None = None  # the last answer; the first if none identifies it
    is_identified: bool = False

    @property
    def words(self) -> str:
        """Which databases were tried without success, and why."""
        return "; ".join(self.reasons)


def try_each(
    in_order: Callable[[FieldsDeg | None], Sequence[ListedDatabase]],
    fields_deg: FieldsDeg | None,
    identify: Callable[[ListedDatabase, FieldsDeg | None], T],
    frame_of: Callable[[T], Mapping[str, Any]],
    words_of: Callable[[Exception], str] = lambda error: problem_of(error).detail,
) -> Attempts[T]:
    """Identify a frame with one database after another until one succeeds.

    ``in_order`` returns the databases for known fields of view, ``frame_of`` the frame of an answer
    in the form of ``starcat identify --json``, ``words_of`` the message of an error. If no
    database answers at all, the error of the first one is raised.
    """
    until_s = time.monotonic() + MAX_TOTAL_S
    attempts: Attempts[T] = Attempts()
    error: Exception | None = None
    tried: set[str] = set()
    while len(tried) < MAX_DATABASES:
        database = next(
            (candidate for candidate in in_order(fields_deg) if candidate.id not in tried), None
        )
        if database is None:
            break
        if attempts.reasons and time.monotonic() > until_s:
            attempts.reasons.append(f"no other database was tried after {MAX_TOTAL_S:g} s")
            break
        tried.add(database.id)
        try:
            answer = identify(database, fields_deg)
        except (Problem, StarcatError) as failed:
            if isinstance(failed, Problem) and failed.status in PASSED_ON:
                raise
            error = error or failed
            attempts.reasons.append(f"{database.title}: {words_of(failed)}")
            continue
        frame = frame_of(answer)
        if frame["status"] == "identified":
            attempts.best, attempts.is_identified = (database, answer), True
            return attempts
        reason = (frame.get("refusal") or {"message": frame["status"]})["message"]
        attempts.reasons.append(f"{database.title}: {reason}")
        attempts.best = attempts.best or (database, answer)
        if fitted_deg := frame.get("fits_fov_deg"):
            fields_deg = fitted_deg * (1.0 - FOUND_ERROR), fitted_deg * (1.0 + FOUND_ERROR)
    if attempts.best is None and error is not None:
        raise error
    return attempts
